"""What more joints and more buses cost the loop: CPU time of a cycle, per joint and per bus.

A cycle is that of `benchmarks.cycle`: `Control` and the drivers on real unix buses, here with the
hub and the emulated robot in the same process, in lockstep. What the loop's side does is timed in
slices of the thread's CPU time; while it waits for feedback, the emulator works, and that is not
counted. Configurations take turns, so that the machine's drift meets all alike.
"""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter_ns, thread_time_ns

from benchmarks.measure import (
    Target,
    at_most,
    median,
    percentile,
    row,
    title,
    us,
    without_garbage_collection,
)
from controller.machine import State, Trigger
from controller.reference import MotionLimits, MotionState
from drivers.arm_group import ArmLike, configure_arm, make_arm, open_buses
from drivers.bus import Bus
from drivers.frame import unpack_header
from hil.config import Config, load_config
from hil.control import Control
from hil.emulation import open_emulation
from hil.experiment import swing
from hil.planner import plan
from hil.realtime import now_ns
from sim_backend.emulator import SYNC_ID, Emulator
from sim_backend.hub import Wire

JOINTS = (2, 4, 7, 12)
BUSES = (1, 2, 4)
PERIOD_US = 1000.0
TURNS, CYCLES = 12, 250
ENABLE_CYCLES = 1000
TIMEOUT_NS = 400_000_000
GROWTH_MAX_US = 25.0


@dataclass(slots=True)
class Costs:
    """Of single cycles, in us."""

    busy: list[float] = field(default_factory=list)
    """CPU time of the loop's side."""
    skew: list[float] = field(default_factory=list)
    """Between the SYNC on the first and that on the last bus."""


class WatchedBus(Bus):
    """A bus that gives the emulator its turn before the loop looks, and leaves it out of the sum.

    Attributes:
        aside_ns: CPU time that was not the loop's.
        synced_ns: When the last SYNC went out.
    """

    def __init__(self, bus: Bus, robot: "Robot") -> None:
        super().__init__()
        self.stats = bus.stats
        self.aside_ns = self.synced_ns = 0
        self._bus, self._robot = bus, robot
        self.close, self.fileno, self.accept = bus.close, bus.fileno, bus.accept

    def send(self, frame: bytes) -> bool:
        if unpack_header(frame)[0] == SYNC_ID:
            self.synced_ns = perf_counter_ns()
        return self._bus.send(frame)

    def recv(self, timeout_s: float) -> bytes | None:
        if timeout_s > 0.0 and not self._robot.is_served:
            before_ns = thread_time_ns()
            self._robot.serve()
            self.aside_ns += thread_time_ns() - before_ns
        return self._bus.recv(timeout_s)

    def fileno(self) -> int:
        return self._bus.fileno()

    def close(self) -> None:
        self._bus.close()


class Robot:
    """The emulated robot in this process: it takes what has come on its wires when it is told to.

    Attributes:
        is_served: It has had its turn in this cycle.
    """

    def __init__(self, wire: Wire, emulator: Emulator) -> None:
        self._wire, self._emulator = wire, emulator
        self.is_served = False
        self.is_starting = True

    def serve(self) -> None:
        while frames := self._wire.wait(0.0):
            for frame in frames:
                self._emulator.receive(frame, self._wire.bus)
        if self.is_starting:
            self._emulator.advance(500_000)
        else:
            self.is_served = True


class Subject:
    """One arm on its buses, tracking a slow sinusoid."""

    def __init__(self, config: Config, wire: Wire, emulator: Emulator) -> None:
        self.config = config
        self.costs = Costs()
        self._robot = Robot(wire, emulator)
        self._buses = [WatchedBus(bus, self._robot) for bus in open_buses(config.bus.addresses)]
        self._robot.serve()
        emulator.power_on()
        period_s = config.loop.period_s
        self._arm: ArmLike = make_arm(self._buses, config.axes, period_s=period_s, now_ns=now_ns)
        configure_arm(self._arm, config.axes, period_s=period_s)
        self._robot.is_starting = False
        self._control = Control(config, self._arm, now_ns=now_ns, events=lambda *_: None)
        self._control.fire(Trigger.BUS_READY)
        self._control.enable()
        for _ in range(ENABLE_CYCLES):
            self._step()
            if self._control.machine.state is State.READY:
                break
        self.costs = Costs()

    def run(self, cycles: int) -> None:
        """Run some cycles, the motion begun anew if it is over."""
        control, config = self._control, self.config
        if not control.player.is_moving:
            limits = MotionLimits.of(config.controller.limits, config.trajectory.max_duration_s)
            start = MotionState.at_rest(control.player.setpoint.q_rad)
            motion = plan(swing(config), start, limits, config.loop.period_s)
            rows = memoryview(motion.rows().tobytes()).cast("d")
            control.start(rows, motion.samples, at_index=None)
        for _ in range(cycles):
            self._step()
        machine = control.machine
        if machine.state is not State.ACTIVE and machine.state is not State.HOLD:
            raise RuntimeError(f"the arm tripped: {machine.state.name}, {machine.fault.name}")

    def _step(self) -> None:
        buses, robot = self._buses, self._robot
        robot.is_served = False
        for bus in buses:
            bus.aside_ns = 0
        cpu_ns = thread_time_ns()
        self._control.step(now_ns() + TIMEOUT_NS, 1)
        cpu_ns = thread_time_ns() - cpu_ns
        self.costs.busy.append((cpu_ns - sum(bus.aside_ns for bus in buses)) * 1e-3)
        self.costs.skew.append((buses[-1].synced_ns - buses[0].synced_ns) * 1e-3)

    def close(self) -> None:
        self._arm.close()


def configuration(joints: int, buses: int, directory: Path) -> Config:
    """Return a chain whose axes are dealt out to the buses evenly, neighbours together."""
    axes = {str(j + 1): {"bus": 1 + j * buses // joints} for j in range(joints)}
    addresses = [f"unix:{directory}/{joints}-{buses}-{number}" for number in range(buses)]
    bus = {"address": addresses[0], "more": addresses[1:]}
    return load_config(None, {"arm": {"preset": f"chain_h:{joints}"}, "axes": axes, "bus": bus})


@contextmanager
def subjects() -> Iterator[dict[tuple[int, int], Subject]]:
    """Build every arm that has at least one joint on each of its buses."""
    with ExitStack() as stack:
        directory = Path(stack.enter_context(TemporaryDirectory(prefix="hil-bench-")))
        made: dict[tuple[int, int], Subject] = {}
        for joints in JOINTS:
            for buses in BUSES:
                if joints < buses:
                    continue
                config = configuration(joints, buses, directory)
                wire, emulator = open_emulation(config, config.emulator)
                stack.enter_context(wire)
                made[joints, buses] = Subject(config, wire, emulator)
                stack.callback(made[joints, buses].close)
        yield made


def run(scale: float) -> list[Target]:
    title("scale", "CPU time of one control cycle, unix buses, lockstep, chain_h:N")
    turns = max(2, round(TURNS * scale))
    with subjects() as arms, without_garbage_collection():
        for arm in arms.values():
            arm.run(CYCLES)
            arm.costs = Costs()
        for _ in range(turns):
            for arm in arms.values():
                arm.run(CYCLES)
        costs = {key: arm.costs for key, arm in arms.items()}
    row("joints, buses", "p50", "p99", "of 1000 us", "per joint", "SYNC skew")
    for (joints, buses), cost in costs.items():
        p50, p99 = median(cost.busy), percentile(cost.busy, 0.99)
        share = f"{100.0 * p50 / PERIOD_US:.1f} %"
        skew = us(median(cost.skew)) if buses > 1 else "-"
        row(f"{joints} joints, {buses} bus{'es' if buses > 1 else ''}", us(p50), us(p99), share,
            us(p50 / joints), skew)  # fmt: skip
    p50s = {key: median(cost.busy) for key, cost in costs.items()}
    growth = (p50s[12, 1] - p50s[2, 1]) / 10.0
    per_bus = (p50s[12, 4] - p50s[12, 1]) / 3.0
    print(f"  each joint more: {us(growth)} (2 to 12 on one bus); each bus more: {us(per_bus)}")
    return [
        at_most("growth per joint, one bus", growth, GROWTH_MAX_US, " us"),
        at_most("12 joints on 4 buses, p50 of the period", p50s[12, 4] / 10.0, 50.0, " %"),
    ]
