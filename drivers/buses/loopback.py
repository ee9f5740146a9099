"""The in-process bus of virtual-time simulation: no kernel, no clock, one thread."""

from collections import deque
from collections.abc import Callable
from typing import NoReturn

from drivers.bus import Bus
from drivers.errors import BusError
from drivers.frame import ERR_BIT, FLAGS_INDEX


class LoopbackBus(Bus):
    """One participant whose wire is a function call.

    Example:
        >>> bus = LoopbackBus()
        >>> bus.connect(bus.deliver)  # everything sent comes back
        >>> bus.send(bytes(16))
        True
        >>> bus.recv(0.0) == bytes(16)
        True
    """

    def __init__(self) -> None:
        super().__init__()
        self._queue: deque[bytes] = deque()
        self._on_frame: Callable[[bytes], None] = _lose
        self._on_wait: Callable[[float], None] | None = None

    def connect(
        self, on_frame: Callable[[bytes], None], on_wait: Callable[[float], None] | None = None
    ) -> None:
        """Attach the other side.

        Args:
            on_frame: Receives each frame at the instant it is sent. It may call `deliver`.
            on_wait: Called with the time-out in seconds when `recv` finds nothing, so that
                virtual time can advance and produce frames.
        """
        self._on_frame = on_frame
        self._on_wait = on_wait

    def deliver(self, frame: bytes) -> None:
        """Queue a frame for `recv`."""
        self._queue.append(frame)

    def send(self, frame: bytes) -> bool:
        """Hand one frame to `on_frame`; see `Bus.send`. Never fails while the bus is open."""
        self._on_frame(frame)
        self.stats.frames_sent += 1
        return True

    def recv(self, timeout_s: float) -> bytes | None:
        """Return the next frame; an empty queue asks `on_wait` once. No real time passes."""
        queue = self._queue
        if not queue:
            if self._on_wait is None:
                return None
            self._on_wait(timeout_s)
            if not queue:
                return None
        frame = queue.popleft()
        self.stats.frames_received += 1
        if frame[FLAGS_INDEX] & ERR_BIT:
            self._count_error_report()
        return frame

    def fileno(self) -> int:
        """Return -1: there is nothing to wait for."""
        return -1

    def close(self) -> None:
        """Leave the bus: queued frames are dropped, further use raises `BusError`."""
        self._queue.clear()
        self._on_frame = _raise_closed
        self._on_wait = _raise_closed


def _lose(_frame: bytes) -> None:
    """Take the frames of a bus that nobody is connected to."""


def _raise_closed(_argument: object) -> NoReturn:
    raise BusError("the loopback bus is closed")
