"""Busy time of a control cycle over the 1000 us period, against a real `hil emulate` process.

A cycle is: send SYNC, receive, estimate, law, limits, send torques, by the real `Control` and
`ArmBus`. CPU time is the thread's. Wall time leaves out the waiting for feedback: the emulator's
work. Blocks with either clock alternate, since taking the one would cost the other time. With
`loop.spin` the thread never sleeps: its CPU time would say nothing, the wall clock counts.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from time import perf_counter_ns, thread_time_ns

from benchmarks import rig
from benchmarks.measure import (
    Target,
    at_most,
    percentile,
    row,
    title,
    us,
    without_garbage_collection,
)
from benchmarks.waiting import WaitTimer
from controller.machine import State, Trigger
from drivers.arm_bus import ArmBus
from drivers.bus import open_bus
from drivers.registry import make_axes
from hil.config import Config
from hil.control import Control
from hil.loop import Loop
from hil.realtime import Granted, Sleeper, now_ns, spin_until
from hil.shared import SharedMemory

PERIOD_NS = 1_000_000
BLOCK_CYCLES = 500
WARM_UP_CYCLES = 200
ENABLE_CYCLES = 1000
CYCLES = 10_000
ASLEEP = "control cycle at 1 kHz"
SPINNING = "control cycle at 1 kHz, loop.spin"
WHOLE_BODY_CYCLES = 4_000
TIMEOUT_NS = 400_000_000  # of feedback, as the loop's own in lockstep


@dataclass(slots=True)
class Busy:
    """Busy times of single cycles in us."""

    cpu: list[float] = field(default_factory=list)
    wall: list[float] = field(default_factory=list)
    waiting: list[float] = field(default_factory=list)


class Arm:
    """The controller's side of the unix bus, tracking scenario A.

    The trajectory begins anew when it is over.
    """

    def __init__(self, config: Config, *, is_whole_body: bool, is_spinning: bool) -> None:
        self.config = config
        self.bus = WaitTimer(open_bus(config.bus.address), is_spinning=is_spinning)
        self.arm = ArmBus(
            self.bus, make_axes(config.axes, period_s=config.loop.period_s), now_ns=now_ns
        )
        infos = self.arm.configure(heartbeat_cycles=100)
        self._loop: Loop | None = None
        if is_whole_body:
            shared = SharedMemory.create(config)
            self._loop = Loop(shared, self.arm, infos)
            self._loop._granted = Granted("", memory_locked=False, missing=())
            self.arm.log_frames(self._loop._log_frame)
            self.control = self._loop._control
        else:
            self.control = Control(config, self.arm, now_ns=now_ns, events=lambda *_: None)
        self.control.fire(Trigger.BUS_READY)
        self._enable()

    def _enable(self) -> None:
        self.control.enable()
        for _ in range(ENABLE_CYCLES):
            self.step(now_ns())
            if self.control.machine.state is State.READY:
                return

    def step(self, start_ns: int) -> None:
        """One cycle: `Control.step` alone, or everything the loop process does in it."""
        if self._loop is None:
            self.control.step(start_ns + TIMEOUT_NS, 1)
            return
        self._loop._run_cycle(start_ns, start_ns, 0)
        self._loop._cycle += 1

    def restart(self) -> None:
        """Compile and begin the trajectory anew if it is over, between two measured blocks."""
        if not self.control.player.is_moving:
            motion = rig.reference(self.config, self.control.player.setpoint.q_rad)
            rows = memoryview(motion.rows().tobytes()).cast("d")
            self.control.start(rows, motion.samples, at_index=None)

    def close(self) -> None:
        self.control.estop()
        self.step(now_ns())
        self.step(now_ns())
        self.bus.close()


def run(scale: float) -> list[Target]:
    title("cycle", "busy time of one control cycle, unix bus, lockstep, 2 joints, scenario A")
    row("", "cpu p50", "cpu p99", "wall p50", "wall p99", "of 1000 us")
    with rig.emulator_process() as address:
        config = rig.configuration(address)
        cycles = round(CYCLES * scale)
        asleep = _measure(config, cycles, _asleep)
        _print(ASLEEP, asleep)
        spinning = _measure(config, cycles, _spinning)
        _print(SPINNING, spinning)
        _print("control cycle, unpaced", _measure(config, cycles, now_ns))
        cycles = round(WHOLE_BODY_CYCLES * scale)
        for start, name in ((_asleep, ASLEEP), (_spinning, SPINNING)):
            whole = _measure(config, cycles, start, is_whole_body=True)
            _print(name.replace("control cycle", "whole body (*)"), whole)
    print(f"  waiting for feedback at 1 kHz (emulator's time): p50 {us(_p50(asleep.waiting))}")
    print("  (*) also commands, frame log, sample into the ring, timing, heartbeat")
    return [
        at_most(f"{ASLEEP}: busy p50, CPU", _p50(asleep.cpu) / 10.0, 10.0, " %"),
        at_most(f"{ASLEEP}: busy p50, wall", _p50(asleep.wall) / 10.0, 10.0, " %"),
        at_most(f"{SPINNING}: busy p50, wall", _p50(spinning.wall) / 10.0, 8.0, " %"),
        at_most(f"{SPINNING}: busy p99, wall", percentile(spinning.wall, 0.99) / 10.0, 20.0, " %"),
    ]


def _p50(values: list[float]) -> float:
    return percentile(values, 0.5)


def _print(label: str, busy: Busy) -> None:
    cells = [percentile(v, p) for v in (busy.cpu, busy.wall) if v for p in (0.5, 0.99)]
    shares = "/".join(f"{cell / 10.0:.1f}" for cell in cells[::2])
    row(label, *("-" for _ in range(4 - len(cells))), *map(us, cells), f"{shares} %")


def _measure(
    config: Config, cycles: int, start: Callable[[], int], *, is_whole_body: bool = False
) -> Busy:
    busy = Busy()
    is_spinning = start is _spinning
    arm = Arm(config, is_whole_body=is_whole_body, is_spinning=is_spinning)
    try:
        with rig.scheduled_as_loop(config.loop.priority), without_garbage_collection():
            _run_block(arm, WARM_UP_CYCLES, start, _time_cpu, Busy())
            blocks = max(1, cycles // BLOCK_CYCLES // 2)
            for _ in range(blocks):
                arm.restart()
                arm.bus.set_timed(False)
                if not is_spinning:
                    _run_block(arm, BLOCK_CYCLES, start, _time_cpu, busy)
                arm.bus.set_timed(True)
                _run_block(arm, BLOCK_CYCLES, start, _time_wall, busy)
                arm.bus.set_timed(False)
    finally:
        arm.close()
    return busy


_sleeper = Sleeper()


def _next_period() -> int:
    return (now_ns() // PERIOD_NS + 1) * PERIOD_NS


def _asleep() -> int:
    """Sleep until the next whole millisecond and return that instant."""
    start_ns = _next_period()
    _sleeper.until(start_ns)
    return start_ns


def _spinning() -> int:
    """Look at the clock until the next whole millisecond, as `loop.spin` does."""
    start_ns = _next_period()
    spin_until(start_ns)
    return start_ns


def _run_block(
    arm: Arm,
    cycles: int,
    start: Callable[[], int],
    time_cycle: Callable[[Arm, int, Busy], None],
    busy: Busy,
) -> None:
    for _ in range(cycles):
        time_cycle(arm, start(), busy)
    if not arm.control.machine.state.is_powered:
        machine = arm.control.machine
        raise RuntimeError(f"the arm tripped: {machine.state.name}, {machine.fault.name}")


def _time_cpu(arm: Arm, start_ns: int, busy: Busy) -> None:
    cpu_ns = thread_time_ns()
    arm.step(start_ns)
    busy.cpu.append((thread_time_ns() - cpu_ns) * 1e-3)


def _time_wall(arm: Arm, start_ns: int, busy: Busy) -> None:
    arm.bus.waited_ns = 0
    wall_ns = perf_counter_ns()
    arm.step(start_ns)
    elapsed_ns = perf_counter_ns() - wall_ns
    busy.wall.append((elapsed_ns - arm.bus.waited_ns) * 1e-3)
    busy.waiting.append(arm.bus.waited_ns * 1e-3)
