"""Process data of the emulated drive: received and transmitted PDOs (CiA 301, 7.2.2).

A PDO is compiled when its settings change, so that a cycle costs one `struct` call each.
"""

from struct import Struct

from drivers.cia402.codec import EmcyCode
from sim_backend.cia402.dictionary import ObjectDictionary
from sim_backend.cia402.emergency import Emergency
from sim_backend.cia402.objects import FORMATS
from sim_backend.cia402.pdo_settings import EVENT_DRIVEN_MIN, SYNCHRONOUS_MAX, PdoSettings
from sim_backend.node import Transmit

_HEADER = Struct("=IB3x")  # of a frame record, see drivers.frame
_INHIBIT_UNIT_S = 100e-6
_CLOCK_SLACK_S = 1e-9
"""Sums of tick lengths round; a deadline counts as reached this much early."""


class Rpdo(PdoSettings):
    """A received PDO. Synchronous data waits for the next SYNC, other data acts at once.

    The event timer is a deadline: it starts with the first PDO received while operation is
    enabled (the one that enables it included), and every further PDO restarts it.

    Attributes:
        is_synchronous: Its data takes effect at the next SYNC.
    """

    direction = "r"

    def __init__(self, dictionary: ObjectDictionary, parameter: int, emergency: Emergency) -> None:
        super().__init__(dictionary, parameter)
        self._emergency = emergency
        self._pending: bytes | None = None
        self._silence_s = 0.0
        self._is_heard = False
        self._error = 0
        self.compile()

    def compile(self) -> None:
        """Take over the settings."""
        mapped = self.mapped()
        layout = Struct("<" + "".join(FORMATS[entry.data_type] for entry in mapped))
        self._unpack_from = layout.unpack_from
        self._length = layout.size
        self._setters = [self._dictionary.setter(entry.index, entry.subindex) for entry in mapped]
        self._timeout_s = self.event_timer_s
        self.is_synchronous = self.transmission_type <= SYNCHRONOUS_MAX
        self.forget()

    def forget(self) -> None:
        """Drop data that waits for SYNC, and stop the deadline."""
        self._pending = None
        self._is_heard = False

    def receive(self, data: bytes) -> None:
        """Take the PDO from the wire. One that is too short is reported and ignored."""
        if len(data) < self._length:
            self.report(EmcyCode.PDO_LENGTH)
            return
        if self._error:
            self._emergency.clear(self._error)
            self._error = 0
        self._silence_s = 0.0
        self._is_heard = True
        if self.is_synchronous:
            self._pending = data
        else:
            self._write(data)

    def apply(self) -> None:
        """SYNC: let the data received before it take effect."""
        data = self._pending
        if data is not None:
            self._pending = None
            self._write(data)

    def is_overdue(self, dt_s: float, *, is_enabled: bool) -> bool:
        """Advance the deadline; True once, when it is missed.

        Args:
            dt_s: Time since the last call.
            is_enabled: Operation is enabled; otherwise the deadline waits for a new first PDO.
        """
        if not (self._timeout_s and is_enabled and self._is_heard):
            self._is_heard = self._is_heard and is_enabled
            return False
        self._silence_s += dt_s
        if self._silence_s < self._timeout_s - _CLOCK_SLACK_S:
            return False
        self._is_heard = False
        return True

    def report(self, code: EmcyCode) -> None:
        """Raise an error that the next good PDO takes back."""
        self._error = code
        self._emergency.raise_error(code)

    def _write(self, data: bytes) -> None:
        for setter, value in zip(self._setters, self._unpack_from(data), strict=True):
            setter(value)


class Tpdo(PdoSettings):
    """A transmitted PDO.

    Attributes:
        is_event_driven: Sent from `tick` when a value changed or the event timer ran out, not
            at SYNC.
    """

    direction = "t"

    def __init__(self, dictionary: ObjectDictionary, parameter: int, transmit: Transmit) -> None:
        super().__init__(dictionary, parameter)
        self._transmit = transmit
        self.compile()

    def compile(self) -> None:
        """Take over the settings."""
        mapped = self.mapped()
        letters = "".join(FORMATS[entry.data_type] for entry in mapped)
        length = Struct("<" + letters).size
        self._pack = Struct(f"<8s{letters}{8 - length}x").pack
        self._header = _HEADER.pack(self.can_id, length)
        self._getters = [self._dictionary.getter(entry.index, entry.subindex) for entry in mapped]
        self._every = self.transmission_type
        self.is_event_driven = self._every >= EVENT_DRIVEN_MIN
        self._event_s = self.event_timer_s
        self._inhibit_s = self._value(3) * _INHIBIT_UNIT_S
        self.forget()

    def forget(self) -> None:
        """Start afresh: the next event-driven value counts as changed."""
        self._count = 0
        self._last = b""
        self._silence_s = self._inhibit_s

    def sync(self) -> None:
        """SYNC: send the values of this instant, if it is this PDO's turn.

        Type n sends at every n-th SYNC, type 0 at a SYNC before which a value changed.
        """
        if self._every == 1:
            self._transmit(self._pack(self._header, *[get() for get in self._getters]))
            return
        self._count += 1
        if self._count >= self._every:
            self._count = 0
            self._send(is_forced=self._every > 0)

    def tick(self, dt_s: float) -> None:
        """Advance the timers of an event-driven PDO by `dt_s` and send it if it is due."""
        self._silence_s += dt_s
        is_due = 0 < self._event_s <= self._silence_s + _CLOCK_SLACK_S
        if self._silence_s >= self._inhibit_s - _CLOCK_SLACK_S:
            self._send(is_forced=is_due)

    def _send(self, *, is_forced: bool) -> None:
        frame = self._pack(self._header, *[get() for get in self._getters])
        if is_forced or frame != self._last:
            self._last = frame
            self._silence_s = 0.0
            self._transmit(frame)
