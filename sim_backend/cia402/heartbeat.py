"""Heartbeat, produced and watched (CiA 301, 7.2.8.3.2; objects 1016 and 1017)."""

from drivers.cia402.codec import parse_heartbeat

_CLOCK_SLACK_S = 1e-9


class HeartbeatProducer:
    """Says when the next heartbeat is due."""

    __slots__ = ("_elapsed_s", "_period_s")

    def __init__(self) -> None:
        self.start(0)

    def start(self, period_ms: int) -> None:
        """Begin anew with a period; 0 is off."""
        self._period_s = period_ms * 1e-3
        self._elapsed_s = 0.0

    def is_due(self, dt_s: float) -> bool:
        """Advance by `dt_s`; True if a heartbeat is to be sent now."""
        if not self._period_s:
            return False
        self._elapsed_s += dt_s
        if self._elapsed_s < self._period_s - _CLOCK_SLACK_S:
            return False
        self._elapsed_s = max(0.0, self._elapsed_s - self._period_s)
        return True


class HeartbeatConsumer:
    """Watches one other node, from its first heartbeat on.

    Attributes:
        node_id: Whom it watches, 0 if nobody.
        is_lost: The heartbeat failed to come and has not come back.
    """

    __slots__ = ("_is_heard", "_silence_s", "_timeout_s", "is_lost", "node_id")

    def __init__(self) -> None:
        self.watch(0)

    def watch(self, setting: int) -> None:
        """Begin anew with an entry of 1016: node << 16 | milliseconds."""
        self._timeout_s = (setting & 0xFFFF) * 1e-3
        self.node_id = setting >> 16 if self._timeout_s else 0
        self._silence_s = 0.0
        self._is_heard = False
        self.is_lost = False

    def receive(self, data: bytes) -> bool:
        """Take a heartbeat of the watched node; True if it had been lost and is back."""
        if parse_heartbeat(data) is None:
            return False
        was_lost = self.is_lost
        self.is_lost = False
        self._is_heard = True
        self._silence_s = 0.0
        return was_lost

    def is_overdue(self, dt_s: float) -> bool:
        """Advance by `dt_s`; True once, when the heartbeat is lost."""
        if not self._is_heard or self.is_lost:
            return False
        self._silence_s += dt_s
        self.is_lost = self._silence_s >= self._timeout_s - _CLOCK_SLACK_S
        return self.is_lost
