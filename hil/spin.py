"""A bus that waits for frames by looking for them, at the full load of one core (`loop.spin`)."""

from collections.abc import Collection
from time import clock_gettime_ns

from drivers.bus import Bus
from hil.realtime import CLOCK_MONOTONIC


class SpinningBus(Bus):
    """Another bus, whose `recv` never gives the core away.

    No wake-up by the scheduler is between a frame's arrival and the loop. Whoever sends the frames
    needs a core of its own.
    """

    def __init__(self, bus: Bus) -> None:
        """Wrap a bus, which is closed together with this one."""
        super().__init__()
        self.carries_fd = bus.carries_fd
        self.stats = bus.stats
        self._bus = bus
        self.send = bus.send  # type: ignore[method-assign]  # the hot path: no call in between

    def send(self, frame: bytes) -> bool:
        """See `Bus.send`."""
        return self._bus.send(frame)

    def recv(self, timeout_s: float) -> bytes | None:
        """See `Bus.recv`."""
        poll = self._bus.recv
        frame = poll(0.0)
        if frame is not None or timeout_s <= 0.0:
            return frame
        deadline_ns = clock_gettime_ns(CLOCK_MONOTONIC) + round(timeout_s * 1e9)
        while frame is None and clock_gettime_ns(CLOCK_MONOTONIC) < deadline_ns:
            frame = poll(0.0)
        return frame

    def accept(self, can_ids: Collection[int] | None) -> None:
        """See `Bus.accept`."""
        self._bus.accept(can_ids)

    def fileno(self) -> int:
        """See `Bus.fileno`."""
        return self._bus.fileno()

    def close(self) -> None:
        """See `Bus.close`."""
        self._bus.close()
