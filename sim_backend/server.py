"""The emulator as a process: frames from the wire, time from SYNC or from the clock."""

from collections.abc import Callable
from time import monotonic_ns

from drivers.frame import LOCKSTEP_ID, unpack_header
from sim_backend.emulator import SYNC_ID, Emulator
from sim_backend.hub import Wire
from sim_backend.settings import EmulatorSettings

TICK_NS = 500_000
"""Wall time advances the plant in steps of its current loops' period."""
CATCH_UP_NS = 1_000_000_000
"""A process that was stopped for longer than this does not make up for more."""
_TICKS = ((SYNC_ID, 0), (LOCKSTEP_ID, 0))


class EmulatorServer:
    """Runs an emulator on a wire.

    In lockstep the plant advances one period per SYNC (of an arm on several buses, when it has come
    on each), however long the master takes; without any SYNC for `stall_timeout_s` (a master that
    is not there yet, or died) time runs by the clock, so that the amplifiers' watchdogs act. By the
    clock, it always does.
    """

    def __init__(
        self,
        emulator: Emulator,
        wire: Wire,
        settings: EmulatorSettings,
        *,
        now_ns: Callable[[], int] = monotonic_ns,
    ) -> None:
        self.frames = 0
        self._emulator = emulator
        self._wire = wire
        self._wants_lockstep = settings.time == "lockstep"
        self._stall_ns = round(settings.stall_timeout_s * 1e9)
        self._now_ns = now_ns
        self._advanced_ns = now_ns()
        self._sync_ns = self._advanced_ns - self._stall_ns
        emulator.leave_lockstep()

    def run(self, is_ended: Callable[[], bool]) -> None:
        """Serve until `is_ended` says so; it is asked at least every 50 ms.

        Raises:
            SimError: If the wire or the plant broke down.
        """
        self._emulator.power_on()
        while not is_ended():
            self.serve(0.05 if self._emulator.is_lockstep else TICK_NS * 1e-9)

    def serve(self, timeout_s: float) -> None:
        """Handle the frames at hand, waiting `timeout_s` at most, and pass time on."""
        frames, bus = self._wire.wait(timeout_s), self._wire.bus
        if not self._emulator.is_lockstep:
            self._advance_by_clock()
        for frame in frames:
            self.frames += 1
            if unpack_header(frame) in _TICKS:
                self._take_sync()
            self._emulator.receive(frame, bus)
        if self._emulator.is_lockstep:  # also if others than the master talk on
            self._leave_stalled_lockstep()

    def _take_sync(self) -> None:
        self._sync_ns = self._now_ns()
        self._emulator.is_lockstep = self._wants_lockstep

    def _leave_stalled_lockstep(self) -> None:
        now_ns = self._now_ns()
        if now_ns - self._sync_ns > self._stall_ns:
            self._emulator.leave_lockstep()
            self._advanced_ns = now_ns

    def _advance_by_clock(self) -> None:
        now_ns = self._now_ns()
        self._emulator.advance(min(now_ns - self._advanced_ns, CATCH_UP_NS))
        self._advanced_ns = now_ns
