"""A client of the daemon: commands with their replies, status, and telemetry as it comes."""

import json
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Any, Self

import numpy as np
import zenoh
from numpy.typing import NDArray

from hil.errors import HilError
from hil.fixed_protobuf import Records
from hil.messages import Reply
from hil.session import client_settings, open_session
from hil.telemetry import SampleLayout

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
REPLY_TIMEOUT_S = 15.0


REPEATED_NS = 60_000_000_000
"""Samples older than this are not repeated ones: the daemon's host was restarted."""


class NoDaemonError(HilError):
    """No daemon answers for this arm."""


class RefusedError(HilError):
    """The daemon refused a command; nothing has changed. `reply` says why, in numbers too."""

    def __init__(self, reply: Reply) -> None:
        super().__init__(reply.reason)
        self.reply = reply


class Client:
    """Connection to one arm's daemon. Use it in a `with` block.

    Args:
        arm: Name of the arm.
        endpoints: Zenoh endpoints of the daemon or of a router.

    Raises:
        SessionError: If none of the endpoints can be reached.

    Example:
        >>> with Client("bench") as arm:                                    # doctest: +SKIP
        ...     arm.command("enable")
        ...     arm.command("trajectory", kind="move", target_rad=[0.5, -0.3])
    """

    def __init__(self, arm: str, endpoints: Sequence[str] = (DEFAULT_ENDPOINT,)) -> None:
        self.arm = arm
        self._session = open_session(client_settings(endpoints))
        self._subscribers: list[object] = []

    def command(self, verb: str, **arguments: object) -> Reply:
        """Send a command and return its reply.

        Args:
            verb: `enable`, `disable`, `trajectory`, `gain_bounds`, `stop`, `estop`, `reset`,
                `fault`.
            arguments: Fields of its request (`hil.messages`).

        Raises:
            RefusedError: If the daemon refuses it.
            NoDaemonError: If nobody answers.
        """
        reply = Reply.model_validate_json(self._get(f"cmd/{verb}", json.dumps(arguments)))
        if not reply.ok:
            raise RefusedError(reply)
        return reply

    def config(self) -> dict[str, Any]:
        """Return the daemon's running configuration.

        Raises:
            NoDaemonError: If nobody answers.
        """
        config: dict[str, Any] = json.loads(self._get("config"))
        return config

    def schema(self) -> dict[str, Any]:
        """Return the JSON Schemas of all requests and of the reply.

        Raises:
            NoDaemonError: If nobody answers.
        """
        schema: dict[str, Any] = json.loads(self._get("schema"))
        return schema

    def on_telemetry(self, take: Callable[[Records], None]) -> None:
        """Have every sample passed to `take` once, in batches, in a thread of Zenoh's.

        A daemon whose gateway was killed and restarted publishes some samples again: these are
        dropped here.

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
        """Have every status (10 Hz) passed to `take`, in a thread of Zenoh's."""
        self._subscribe("status", lambda sample: take(json.loads(bytes(sample.payload))))

    def on_event(self, take: Callable[[dict[str, Any]], None]) -> None:
        """Have every event passed to `take`, in a thread of Zenoh's."""
        self._subscribe("event", lambda sample: take(json.loads(bytes(sample.payload))))

    def _subscribe(self, key: str, receive: Callable[[zenoh.Sample], None]) -> None:
        subscriber = self._session.declare_subscriber(f"hil/{self.arm}/{key}", receive)
        self._subscribers.append(subscriber)

    def _get(self, key: str, payload: str | None = None) -> bytes:
        replies = self._session.get(
            f"hil/{self.arm}/{key}", payload=payload, timeout=REPLY_TIMEOUT_S
        )
        for reply in replies:
            if reply.ok is not None:
                return bytes(reply.ok.payload)
        raise NoDaemonError(f"no daemon answers for arm {self.arm!r}; is `hil run` up?")

    def close(self) -> None:
        """End the session. Idempotent."""
        self._session.close()  # type: ignore[no-untyped-call] # untyped in zenoh's stubs

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def _is_new(rows: Records, last_ns: int) -> NDArray[np.bool_]:
    age_ns = last_ns - rows["t_ns"]
    is_new: NDArray[np.bool_] = (age_ns < 0) | (age_ns > REPEATED_NS)
    return is_new
