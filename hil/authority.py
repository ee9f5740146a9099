"""Who may move the arm: one operator at a time holds a lease.

The lease is tied to a liveliness token that the operator's session has declared: when the program
or its link dies, the token goes, and so does the lease. Zenoh itself is not in here; the gateway
says which tokens come and go. A gateway that succeeds a killed one finds the lease in the shared
memory and keeps it for its holder, who has some seconds to reconnect.
"""

import json
import secrets
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final, Protocol

from hil.config import RemoteSettings
from hil.errors import HilError
from hil.messages import AcquireRequest, Code, Reply

TOKEN_WAIT_S: Final = 2.0
"""A token may come later than the request that needs it: declarations travel on their own."""

Inform = Callable[[Mapping[str, Any]], None]
"""Passes a command on to the loop, which records it."""


class LeaseRing(Protocol):
    """Where the lease outlives this process; `hil.shared.Ring` is one."""

    def append(self, payload: bytes) -> None:
        """Write the newest state."""

    def last(self) -> bytes | None:
        """Return the newest state, None before the first."""


class AuthorityError(HilError):
    """A request is refused for who asks or when, not for what; nothing has changed.

    Attributes:
        code: See `Reply.code`.
        holder: Who has authority, if that is the reason.
    """

    def __init__(self, code: Code, reason: str, holder: str | None = None) -> None:
        super().__init__(reason)
        self.code = code
        self.holder = holder

    def reply(self, request_id: str | None) -> Reply:
        """Return the answer for the client."""
        return Reply(
            ok=False,
            reason=str(self),
            request_id=request_id,
            code=self.code,
            holder=self.holder,
        )


@dataclass(slots=True)
class Lease:
    """Authority of one operator.

    Attributes:
        operator: Name of the holder, and of the liveliness token.
        id: Known to the holder alone.
        request_id: Of the request that took it.
        since_ns: When it was taken.
        used_ns: When it was used last.
    """

    operator: str
    id: str
    request_id: str | None
    since_ns: int
    used_ns: int


class Authority:
    """The lease of one arm. Instants are CLOCK_MONOTONIC of the daemon's host.

    Args:
        settings: What happens to leases when.
        ring: Outlives this process.
        inform: Tells the loop, for the record and to act on a loss.
        is_moving: Whether the arm is in motion now.
        now_ns: The clock.
    """

    def __init__(
        self,
        settings: RemoteSettings,
        ring: LeaseRing,
        inform: Inform,
        is_moving: Callable[[], bool],
        now_ns: Callable[[], int],
    ) -> None:
        self._settings = settings
        self._ring = ring
        self._inform = inform
        self._is_moving = is_moving
        self._now_ns = now_ns
        self._change = threading.Condition()
        self._present: set[str] = set()
        self._lease = _stored(ring)
        self._recovered_ns = now_ns() if self._lease is not None else None

    @property
    def holder(self) -> str | None:
        """Name of the operator who has authority."""
        lease = self._lease
        return None if lease is None else lease.operator

    # --- tokens ------------------------------------------------------------------------------

    def note_present(self, operator: str) -> None:
        """An operator's token is there."""
        with self._change:
            self._present.add(operator)
            if self.holder == operator:
                self._recovered_ns = None
            self._change.notify_all()

    def note_gone(self, operator: str) -> None:
        """An operator's token is gone: so is the lease, and the loop follows the policy."""
        with self._change:
            self._present.discard(operator)
            if self.holder == operator:
                self._lose("token gone")

    def look_after(self) -> None:
        """Give up a recovered lease whose holder does not come back; call now and then."""
        recovered_ns = self._recovered_ns
        if recovered_ns is None:
            return
        with self._change:
            if self._recovered_ns is None:
                return
            if self._now_ns() - recovered_ns > self._settings.reconnect_s * 1e9:
                self._lose("not back after the gateway's restart")

    def _lose(self, cause: str) -> None:
        holder = self.holder
        self._store(None)
        policy = self._settings.on_operator_loss
        self._inform(
            {"verb": "operator_lost", "operator": holder, "policy": policy, "cause": cause}
        )

    # --- taking and giving back --------------------------------------------------------------

    def acquire(self, request: AcquireRequest) -> Reply:
        """Give the lease to an operator whose token is there. Waits for the token for a moment.

        Raises:
            AuthorityError: If another operator has it, or there is no token.
        """
        name = request.operator
        with self._change:
            self._require_free(request)
            if not self._change.wait_for(lambda: name in self._present, TOKEN_WAIT_S):
                reason = f"operator {name!r} has declared no liveliness token operator/{name}"
                raise AuthorityError("no_authority", reason)
            self._require_free(request)
            now_ns = self._now_ns()
            lease = self._lease
            if lease is None or lease.operator != name:
                if lease is not None:
                    self._inform(_taken_or_given("expired", lease.operator))
                lease = Lease(name, secrets.token_hex(8), request.request_id, now_ns, now_ns)
                self._store(lease)
                self._inform(_taken_or_given("taken", name))
            return Reply(ok=True, request_id=request.request_id, lease=lease.id, t_ns=now_ns)

    def _require_free(self, request: AcquireRequest) -> None:
        lease = self._lease
        if lease is None:
            return
        is_repeated = request.request_id is not None and request.request_id == lease.request_id
        if lease.operator == request.operator and is_repeated:
            return
        if self._is_expired(lease):
            return
        raise _held_by(lease, self._now_ns())

    def _is_expired(self, lease: Lease) -> bool:
        idle_s = self._settings.idle_s
        if idle_s is None or self._now_ns() - lease.used_ns <= idle_s * 1e9:
            return False
        return not self._is_moving()

    def release(self, lease_id: str | None) -> None:
        """Take the lease back from its holder.

        Raises:
            AuthorityError: If it is not the lease in force.
        """
        with self._change:
            lease = self._require(lease_id)
            self._store(None)
            self._inform(_taken_or_given("released", lease.operator))

    def check(self, lease_id: str | None, sent_ns: int | None) -> str:
        """Admit a request under a lease, sent not too long ago; return the operator's name.

        Raises:
            AuthorityError: If the lease is not in force, or the request stale or from the future.
        """
        with self._change:
            lease = self._require(lease_id)
            self._require_fresh(sent_ns)
            lease.used_ns = self._now_ns()
            return lease.operator

    def _require(self, lease_id: str | None) -> Lease:
        lease = self._lease
        if lease is not None and lease_id is not None and lease.id == lease_id:
            return lease
        if lease is not None:
            raise _held_by(lease, self._now_ns(), "no_authority")
        if lease_id is None:
            raise AuthorityError("no_authority", "nobody has authority; `acquire` it first")
        raise AuthorityError("no_authority", "this authority is over; `acquire` it again")

    def _require_fresh(self, sent_ns: int | None) -> None:
        if sent_ns is None:
            raise AuthorityError("stale", "sent_ns is missing: when the request was sent")
        age_s, most_s = (self._now_ns() - sent_ns) * 1e-9, self._settings.max_age_s
        if abs(age_s) > most_s:
            when = f"sent {age_s:.3g} s ago" if age_s > 0 else f"sent {-age_s:.3g} s from now"
            reason = f"{when}; remote.max_age_s is {most_s:g}: send it again if it is still meant"
            raise AuthorityError("stale", reason)

    def _store(self, lease: Lease | None) -> None:
        self._lease = lease
        self._recovered_ns = None
        fields = {name: getattr(lease, name) for name in Lease.__slots__} if lease else {}
        self._ring.append(json.dumps(fields).encode())


def _held_by(lease: Lease, now_ns: int, code: Code = "held") -> AuthorityError:
    since_s = (now_ns - lease.since_ns) * 1e-9
    reason = f"{lease.operator} has had authority for {since_s:.0f} s (estop needs none)"
    return AuthorityError(code, reason, lease.operator)


def _taken_or_given(action: str, operator: str) -> dict[str, str]:
    return {"verb": "authority", "operator": operator, "action": action}


def _stored(ring: LeaseRing) -> Lease | None:
    fields = json.loads(ring.last() or b"{}")
    return Lease(**fields) if fields else None
