"""The connection to a daemon: commands with their replies, authority, status, and telemetry.

`hil.client.Arm` is what most programs want; this is what it is made of.
"""

import getpass
import json
import os
import re
import secrets
import socket
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from time import monotonic, monotonic_ns, sleep
from types import TracebackType
from typing import Any, Final, Self

import numpy as np
import zenoh
from numpy.typing import NDArray

from hil.errors import HilError
from hil.fixed_protobuf import Records
from hil.messages import Reply
from hil.session import client_settings, open_session
from hil.telemetry import SampleLayout

DEFAULT_ENDPOINT: Final = "tcp/127.0.0.1:7447"
REPLY_TIMEOUT_S: Final = 15.0
RETRY_S: Final = 8.0
"""A command whose answer does not come is sent again: its id keeps it from being done twice."""
RETRY_EVERY_S: Final = 0.1
REPEATED_NS: Final = 60_000_000_000
"""Samples older than this are not repeated ones: the daemon's host was restarted."""
BATCHES_KEPT: Final = 1000
"""What a slow program may be behind, some 10 s of telemetry; then the oldest are lost to it."""
END_TIMEOUT_S: Final = 5.0
_NAME_MOST: Final = 48


class NoDaemonError(HilError):
    """No daemon answers for this arm."""


class RefusedError(HilError):
    """The daemon refused a command; nothing has changed. `reply` says why, in numbers too."""

    def __init__(self, reply: Reply) -> None:
        super().__init__(reply.reason)
        self.reply = reply


class NoAuthorityError(RefusedError):
    """Another operator has authority over the arm, or this one has lost it.

    Attributes:
        holder: Who has it, if anybody.
    """

    def __init__(self, reply: Reply) -> None:
        super().__init__(reply)
        self.holder = reply.holder


@dataclass(frozen=True, slots=True)
class _Lease:
    id: str
    clock_ns: int
    """The daemon's clock less ours."""


class Client:
    """Connection to one arm's daemon. Use it in a `with` block; several threads may.

    A command takes authority for its own duration, unless `acquire` has taken it for longer.
    Observers take none: they just never send a command, or only `estop`.

    Args:
        arm: Name of the arm.
        endpoints: Zenoh endpoints of the daemon or of a router.
        operator: Who asks, for the record and for others who are refused; none: user and host.

    Attributes:
        arm: As given.
        operator: The name by which the daemon knows this session; unique.

    Raises:
        SessionError: If none of the endpoints can be reached.

    Example:
        >>> with Client("bench") as arm:                                    # doctest: +SKIP
        ...     arm.command("enable")
        ...     arm.command("trajectory", kind="move", target_rad=[0.5, -0.3])
    """

    def __init__(
        self,
        arm: str,
        endpoints: Sequence[str] = (DEFAULT_ENDPOINT,),
        operator: str | None = None,
    ) -> None:
        self.arm = arm
        self.operator = operator_name(operator)
        self._session = open_session(client_settings(endpoints))
        self._threads: list[threading.Thread] = []
        self._token: object | None = None
        self._lease: _Lease | None = None
        self._lock = threading.RLock()

    # --- commands ----------------------------------------------------------------------------

    def command(self, verb: str, **arguments: object) -> Reply:
        """Send a command and return its reply.

        Args:
            verb: `enable`, `disable`, `trajectory`, `gain_bounds`, `stop`, `estop`, `reset`,
                `fault`.
            arguments: Fields of its request (`hil.messages`).

        Raises:
            RefusedError: If the daemon refuses it; `NoAuthorityError` if for who asks.
            NoDaemonError: If nobody answers.
        """
        if verb == "estop":
            return self._ask(verb, {"operator": self.operator, **arguments})
        lease = self._lease
        if lease is not None:
            return self._order(lease, verb, arguments)
        with self._lock:
            lease = self._take()
            try:
                return self._order(lease, verb, arguments)
            finally:
                self._give(lease)

    def _order(self, lease: _Lease, verb: str, arguments: dict[str, Any]) -> Reply:
        sent_ns = max(0, monotonic_ns() + lease.clock_ns)
        fields = {"request_id": secrets.token_hex(8), "lease": lease.id, "sent_ns": sent_ns}
        return self._ask(verb, {**fields, **arguments}, RETRY_S)

    def _ask(self, verb: str, fields: dict[str, Any], retry_s: float = 0.0) -> Reply:
        payload = self._get(f"cmd/{verb}", json.dumps(fields), retry_s)
        reply = Reply.model_validate_json(payload)
        if reply.ok:
            return reply
        has_none = reply.code in ("held", "no_authority")
        raise NoAuthorityError(reply) if has_none else RefusedError(reply)

    # --- authority ---------------------------------------------------------------------------

    @property
    def has_authority(self) -> bool:
        """Authority was taken by `acquire` and not given back; it may have been lost since."""
        return self._lease is not None

    def acquire(self) -> None:
        """Take authority until `release`; no other operator can command the arm meanwhile.

        Raises:
            NoAuthorityError: If another operator has it; the message and `holder` say who.
            NoDaemonError: If nobody answers.
        """
        with self._lock:
            if self._lease is None:
                self._lease = self._take()

    def release(self) -> None:
        """Give authority back, if it is still there. The arm goes on with what it does."""
        with self._lock:
            lease, self._lease = self._lease, None
            if lease is not None:
                self._give(lease)

    @contextmanager
    def authority(self) -> Iterator[Self]:
        """Hold authority within a `with` block.

        Raises:
            NoAuthorityError: As for `acquire`.
        """
        self.acquire()
        try:
            yield self
        finally:
            self.release()

    def _take(self) -> _Lease:
        if self._token is None:
            key = f"hil/{self.arm}/operator/{self.operator}"
            self._token = self._session.liveliness().declare_token(key)
        fields = {"operator": self.operator, "request_id": secrets.token_hex(8)}
        reply = self._ask("acquire", fields)
        return _Lease(reply.lease or "", (reply.t_ns or 0) - monotonic_ns())

    def _give(self, lease: _Lease) -> None:
        try:
            self._order(lease, "release", {})
        except (RefusedError, NoDaemonError):
            return  # it was lost before: there is nothing to give back

    # --- what is known -----------------------------------------------------------------------

    def config(self) -> dict[str, Any]:
        """Return the daemon's running configuration.

        Raises:
            NoDaemonError: If nobody answers.
        """
        return self._read("config")

    def schema(self) -> dict[str, Any]:
        """Return the JSON Schemas of all requests and of the reply, with their version.

        Raises:
            NoDaemonError: If nobody answers.
        """
        return self._read("schema")

    def status(self) -> dict[str, Any]:
        """Return the daemon's last status.

        Raises:
            NoDaemonError: If nobody answers.
        """
        return self._read("status")

    def _read(self, key: str) -> dict[str, Any]:
        value: dict[str, Any] = json.loads(self._get(key))
        return value

    # --- streams -----------------------------------------------------------------------------

    def on_telemetry(self, take: Callable[[Records], None]) -> None:
        """Have every sample passed to `take` once, in batches, in a thread of its own.

        A daemon whose gateway was killed and restarted publishes some samples again: these are
        dropped here. One who takes too long for too long loses samples, and `seq` shows which.

        Args:
            take: Gets one row per cycle; columns are the fields of `hil.v1.Sample`.
        """
        layout: SampleLayout | None = None
        last_ns = 0

        def receive(sample: zenoh.Sample) -> None:
            nonlocal layout, last_ns
            payload = bytes(sample.payload)
            if layout is None:
                layout = SampleLayout.of(payload)
            rows = layout.decode_batch(payload)
            rows = rows[_is_new(rows, last_ns)]
            if len(rows):
                last_ns = int(rows["t_ns"][-1])
                take(rows)

        self._subscribe("telemetry", receive)

    def on_status(self, take: Callable[[dict[str, Any]], None]) -> None:
        """Have every status (10 Hz) passed to `take`, in a thread of its own."""
        self._subscribe("status", lambda sample: take(json.loads(bytes(sample.payload))))

    def on_event(self, take: Callable[[dict[str, Any]], None]) -> None:
        """Have every event passed to `take`, in a thread of its own."""
        self._subscribe("event", lambda sample: take(json.loads(bytes(sample.payload))))

    def _subscribe(self, key: str, receive: Callable[[zenoh.Sample], None]) -> None:
        subscriber = self._session.declare_subscriber(
            f"hil/{self.arm}/{key}", zenoh.handlers.RingChannel(BATCHES_KEPT)
        )
        thread = threading.Thread(target=_deliver, args=(subscriber, receive), daemon=True)
        self._threads.append(thread)
        thread.start()

    def _get(self, key: str, payload: str | None = None, retry_s: float = 0.0) -> bytes:
        until_s = monotonic() + retry_s
        while True:
            replies = self._session.get(
                f"hil/{self.arm}/{key}", payload=payload, timeout=REPLY_TIMEOUT_S
            )
            for reply in replies:
                if reply.ok is not None:
                    return bytes(reply.ok.payload)
            if monotonic() > until_s:
                raise NoDaemonError(f"no daemon answers for arm {self.arm!r}; is `hil run` up?")
            sleep(RETRY_EVERY_S)

    def close(self) -> None:
        """Give authority back and end the session. Idempotent."""
        if not self._session.is_closed():
            self.release()
        self._session.close()  # type: ignore[no-untyped-call] # untyped in zenoh's stubs
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join(END_TIMEOUT_S)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def operator_name(name: str | None = None) -> str:
    """Return a name for one session of an operator; none: of the user on this host."""
    if name is None:
        try:
            name = f"{getpass.getuser()}@{socket.gethostname()}"
        except (KeyError, OSError):  # a user without a name
            name = f"{os.getuid()}@{socket.gethostname()}"
    clean = re.sub(r"[^A-Za-z0-9_.@-]", "_", name).lstrip(".@-")[:_NAME_MOST] or "operator"
    return f"{clean}.{secrets.token_hex(3)}"


def _deliver(
    subscriber: Any,  # noqa: ANN401 - its type is generic in zenoh's stubs alone
    receive: Callable[[zenoh.Sample], None],
) -> None:
    """Pass on what comes until the session ends; Zenoh's own threads never wait for `receive`."""
    while True:
        try:
            sample = subscriber.recv()
        except zenoh.ZError:  # the session has ended
            return
        try:
            receive(sample)
        except Exception:  # noqa: BLE001 - of the program's own function; the next may go well
            traceback.print_exc()


def _is_new(rows: Records, last_ns: int) -> NDArray[np.bool_]:
    age_ns = last_ns - rows["t_ns"]
    is_new: NDArray[np.bool_] = (age_ns < 0) | (age_ns > REPEATED_NS)
    return is_new
