"""A node's CAN controller on the modelled wire: error counters, error states, its reports.

Sources: ISO 11898-1:2015, 12.1.4 (fault confinement); linux/can/error.h for the reports.
"""

from collections.abc import Callable
from struct import Struct

from drivers.frame import ERR_FLAG

WARNING_LIMIT = 96
PASSIVE_LIMIT = 128
BUS_OFF_LIMIT = 256
FORGIVEN_REC = 119
"""A passive receiver that has received a frame counts on from here: 119 to 127 are allowed."""

CLASS_CONTROLLER = 0x004
CLASS_PROTOCOL = 0x008
CLASS_BUS_OFF = 0x040
CLASS_BUS_ERROR = 0x080
CLASS_RESTARTED = 0x100
CLASS_COUNTERS = 0x200  # bytes 6 and 7 hold the counters
RX_WARNING, TX_WARNING, RX_PASSIVE, TX_PASSIVE, ACTIVE_AGAIN = 0x04, 0x08, 0x10, 0x20, 0x40
"""Byte 1 of a controller report."""
BIT_ERROR, STUFF_ERROR, WHILE_SENDING = 0x01, 0x04, 0x80
"""Byte 2 of a protocol report."""

ReportSink = Callable[[bytes], None]
"""Takes an error report, a 16-byte record with `ERR_FLAG`."""
_REPORT = Struct("=IB3xxBBxxxBB")


class CanController:
    """Counts errors as the standard asks, and tells its host about them.

    Attributes:
        name: Whose controller it is, for the wire's owner.
        on_report: Takes the reports; None if nobody asks.
        tec: Transmit error counter.
        rec: Receive error counter.
        is_bus_off: Neither sends nor receives.
        frames_dropped: Frames it could not send because it was bus-off.
        failures_left: Its next transmissions that are to fail.
        suspended_until_ns: Others go first until then: it is error passive and has transmitted.
        sequences_left: While bus-off: recessive sequences of 11 bits still to be seen.
        recessive_ns: While bus-off: since when the wire has been recessive, as counted so far.
    """

    __slots__ = (
        "failures_left",
        "frames_dropped",
        "is_bus_off",
        "name",
        "on_report",
        "rec",
        "recessive_ns",
        "sequences_left",
        "suspended_until_ns",
        "tec",
    )

    def __init__(self, name: str, on_report: ReportSink | None = None) -> None:
        self.name = name
        self.on_report = on_report
        self.tec = 0
        self.rec = 0
        self.is_bus_off = False
        self.frames_dropped = 0
        self.failures_left = 0
        self.suspended_until_ns = 0
        self.sequences_left = 0
        self.recessive_ns = 0

    @property
    def is_passive(self) -> bool:
        """Error passive: so many errors that it may no longer disturb others' frames."""
        return self.tec >= PASSIVE_LIMIT or self.rec >= PASSIVE_LIMIT

    def count_error(self, *, is_sender: bool) -> None:
        """Count an error frame. The caller looks at `tec` and takes the node off the bus."""
        before = self._level
        if is_sender:
            self.tec += 8
            kind = BIT_ERROR | WHILE_SENDING
        else:
            self.rec = min(self.rec + 1, BUS_OFF_LIMIT - 1)
            kind = STUFF_ERROR
        self._report(CLASS_PROTOCOL | CLASS_BUS_ERROR, kind=kind)
        self._report_level(before, is_sender=is_sender)

    def count_success(self, *, is_sender: bool) -> None:
        """Count a frame that came through."""
        before = self._level
        if is_sender:
            self.tec -= self.tec > 0
        elif self.rec >= PASSIVE_LIMIT:
            self.rec = FORGIVEN_REC
        else:
            self.rec -= self.rec > 0
        self._report_level(before, is_sender=is_sender)

    def go_bus_off(self) -> None:
        """Leave the bus."""
        self.is_bus_off = True
        self._report(CLASS_BUS_OFF)

    def rejoin(self) -> None:
        """Be on the bus again, with a clean slate."""
        self.is_bus_off = False
        self.tec = self.rec = 0
        self._report(CLASS_RESTARTED)

    @property
    def _level(self) -> int:
        highest = max(self.tec, self.rec)
        return (highest >= WARNING_LIMIT) + (highest >= PASSIVE_LIMIT)

    def _report_level(self, before: int, *, is_sender: bool) -> None:
        level = self._level
        if level == before:
            return
        states = (ACTIVE_AGAIN, TX_WARNING, TX_PASSIVE)
        if not is_sender:
            states = (ACTIVE_AGAIN, RX_WARNING, RX_PASSIVE)
        self._report(CLASS_CONTROLLER, state=states[level])

    def _report(self, error_class: int, *, state: int = 0, kind: int = 0) -> None:
        if self.on_report is not None:
            can_id = ERR_FLAG | CLASS_COUNTERS | error_class
            self.on_report(_REPORT.pack(can_id, 8, state, kind, min(self.tec, 255), self.rec))
