"""The fault matrix: every fault on every target of every amplifier family, in virtual time.

Each cell is one run: enable, swing, the fault in mid-motion for a while, its end, reset, enable
again. What the arm did is taken from the plant itself, not from what the controller believes.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Final, Literal

from controller.faults import FaultCode
from controller.machine import State
from controller.reference import MotionLimits, MotionState
from drivers.fault_frame import FaultKind, FaultTarget
from drivers.registry import SETTINGS
from hil.config import Config, load_config
from hil.control import AT_REST_RAD_S
from hil.messages import SinusoidRequest
from hil.planner import plan
from hil.simulation import Simulation

FAMILIES: Final = tuple(SETTINGS)
TARGETS: Final = tuple(target.name.lower() for target in FaultTarget)
KINDS: Final = tuple(kind.name.lower() for kind in FaultKind if kind is not FaultKind.OK)
JOINT: Final = 1
"""Joint whose encoder or amplifier has the fault."""
SWING_S: Final = 0.6
"""Into the swing when the fault comes: near the largest speed."""
FAULT_S: Final = 0.6
ENABLE_CYCLES: Final = 1500
SETTLE_CYCLES: Final = 100
SETTLE_MOST_CYCLES: Final = 6000
RECOVERY_CYCLES: Final = 100
REST_Nm: Final = 1e-9
STOP_RAD: Final = 3.0
"""Mechanical stops of the arm, beyond its hard limits: a joint cannot turn on and on."""


@dataclass(frozen=True, slots=True)
class Bound:
    """What a fault may lead to.

    Attributes:
        reaction_cycles: Latest trip, None if the motion may go on.
        off_cycles: From the trip until no motor makes torque, at most.
        travel_rad: Way after the trip, while the fault lasts, at most.
    """

    reaction_cycles: int | None
    off_cycles: int
    travel_rad: float


SEEN: Final = Bound(20, 20, 0.4)
"""Told by the first wrong value."""
GAP: Final = Bound(35, 60, 0.5)
"""Feedback is missing or late: n_hold + n_damp cycles; the amplifiers' watchdogs may act first."""
TOLERATED: Final = Bound(None, 0, 0.0)
_BOUNDS: Final = {
    ("amplifier", "off"): Bound(55, 20, 0.5),  # reported; of an ODrive with its heartbeat, 50 ms
    ("encoder", "stuck"): Bound(560, 90, 0.8),
    ("encoder", "slow"): TOLERATED,
    ("encoder", "delayed"): TOLERATED,
    ("amplifier", "stuck"): GAP,
    ("amplifier", "garbage"): GAP,
    ("amplifier", "wrong"): Bound(220, 150, 4.0),
    ("amplifier", "slow"): TOLERATED,
    ("amplifier", "delayed"): GAP,
    ("amplifier", "intermittent"): TOLERATED,
    ("bus", "off"): GAP,
    ("bus", "stuck"): GAP,
    ("bus", "garbage"): Bound(35, 120, 1.0),
    ("bus", "wrong"): TOLERATED,
    ("bus", "slow"): GAP,
    ("bus", "delayed"): GAP,
    ("bus", "intermittent"): TOLERATED,
    ("host", "off"): GAP,
    ("host", "stuck"): GAP,
    ("host", "garbage"): Bound(35, 120, 1.0),
    ("host", "wrong"): TOLERATED,
    ("host", "slow"): GAP,
    ("host", "delayed"): GAP,
    ("host", "intermittent"): TOLERATED,
}
"""(target, kind) -> bound of every family; what is not here is `SEEN`."""


@dataclass(frozen=True, slots=True)
class Cell:
    """One fault of one family."""

    family: str
    target: str
    kind: str


@dataclass(frozen=True, slots=True)
class Outcome:
    """What one cell showed. Cycles count from the fault's first one.

    Attributes:
        reaction_cycles: Until the controller left ACTIVE; None if the motion went on.
        off_cycles: Until the last cycle in which a motor made torque; None if the motion went on.
        tau_max_Nm: Largest motor torque after the fault came, of any joint.
        after_trip_rad: Largest way of any joint after the trip, until the fault ended; None if the
            motion went on.
        error_rad: Largest true distance from the reference before the trip, of any joint.
        speed_rad_s: Largest true speed of any joint after the fault came.
        end_state: While the fault still acted.
        fault: Latched by then.
        recovery: After the end of the fault and at rest, reset and enable lead to READY (`yes`), or
            the arm has come to rest beyond its hard limit and is refused until it is moved
            (`by hand`), or neither (`no`).
        offset_rad: How far the measured pose was then from the true one, at most.
    """

    cell: Cell
    reaction_cycles: int | None
    off_cycles: int | None
    tau_max_Nm: float
    after_trip_rad: float | None
    error_rad: float
    speed_rad_s: float
    end_state: State
    fault: FaultCode
    recovery: Literal["yes", "by hand", "no"]
    offset_rad: float


def cells(families: Sequence[str] = FAMILIES) -> Iterator[Cell]:
    """Return every cell of the matrix, in the order of the table."""
    for target in TARGETS:
        for kind in KINDS:
            for family in families:
                yield Cell(family, target, kind)


@cache
def matrix_config(family: str) -> Config:
    """Return the configuration of a family's runs: the default arm, nothing else set."""
    joints = ("1", "2")
    stops = {"q_min_rad": -STOP_RAD, "q_max_rad": STOP_RAD}
    return load_config(
        None,
        {
            "axes": {joint: {"family": family} for joint in joints},
            "plant": {"links": dict.fromkeys(joints, stops)},
        },
    )


class Run:
    """One cell, step by step.

    Attributes:
        simulation: The arm, its amplifiers and its controller.
    """

    def __init__(self, simulation: Simulation) -> None:
        self.simulation = simulation
        self._config = simulation.config
        self._tau_max_Nm = self._speed_rad_s = self._error_rad = 0.0
        self._torque_at = -1
        self._tripped_at: int | None = None
        self._pose_rad: list[float] = []
        self._after_trip_rad = 0.0

    def swing(self) -> None:
        """Enable and move; return in the middle of the motion."""
        simulation = self.simulation
        simulation.execute("enable")
        simulation.run_until(State.READY, ENABLE_CYCLES)
        center = list(simulation.control.player.setpoint.q_rad)
        request = SinusoidRequest(
            duration_s=30.0,
            center_rad=center,
            amplitude_rad=[0.5, 0.4],
            frequency_Hz=[0.5, 0.5],
            ramp_s=0.4,
        )
        limits = MotionLimits.of(self._config.controller.limits, 60.0)
        start = MotionState.at_rest(center)
        simulation.play(plan(request, start, limits, self._config.loop.period_s))
        simulation.run(round(SWING_S / self._config.loop.period_s))

    def disturb(self, target: str, kind: str) -> None:
        """Let the fault come, and watch the plant until it ends."""
        cycles = round(FAULT_S / self._config.loop.period_s)
        joint = JOINT if FaultTarget[target.upper()].has_joints else 0
        self.simulation.execute(
            "fault", joint=joint, target=target, kind=kind, duration_s=FAULT_S + 0.01
        )
        self.simulation.step()  # its frame goes out at the end of this cycle
        for cycle in range(cycles):
            self.simulation.step()
            self._watch(cycle)

    def _watch(self, cycle: int) -> None:
        control, plant = self.simulation.control, self.simulation.plant
        torque_Nm = max(abs(tau) for tau in plant.tau_applied_Nm)
        q_rad = plant.q_true_rad
        self._speed_rad_s = max(self._speed_rad_s, *(abs(dq) for dq in plant.dq_true_rad_s))
        self._tau_max_Nm = max(self._tau_max_Nm, torque_Nm)
        if torque_Nm > REST_Nm:
            self._torque_at = cycle
        if self._tripped_at is None and control.machine.state is not State.ACTIVE:
            self._tripped_at = cycle
            self._pose_rad = list(q_rad)
        if self._tripped_at is None:
            wanted = control.player.setpoint.q_rad
            self._error_rad = max(self._error_rad, _distance(q_rad, wanted))
        else:
            self._after_trip_rad = max(self._after_trip_rad, _distance(q_rad, self._pose_rad))

    def recover(self) -> tuple[Literal["yes", "by hand", "no"], float]:
        """Wait for rest, reset and enable; return whether that worked, and the pose's error."""
        simulation = self.simulation
        machine = simulation.control.machine
        simulation.run(SETTLE_CYCLES)
        for _ in range(SETTLE_MOST_CYCLES // SETTLE_CYCLES):
            if machine.state is State.ACTIVE or max(map(abs, self._rates())) < AT_REST_RAD_S:
                break
            simulation.run(SETTLE_CYCLES)
        if machine.state in (State.FAULT, State.ESTOP):
            simulation.execute("reset")
            simulation.run(RECOVERY_CYCLES // 2)
        if machine.state is State.IDLE:
            simulation.execute("enable")
        simulation.run(RECOVERY_CYCLES)
        # The sample at hand was latched when the truth was.
        offset_rad = _distance(simulation.control.q_rad, simulation.plant.q_true_rad)
        if machine.state in (State.READY, State.ACTIVE):
            return "yes", offset_rad
        is_out = machine.fault is FaultCode.POSITION_HARD
        return "by hand" if is_out else "no", offset_rad

    def _rates(self) -> Sequence[float]:
        return self.simulation.plant.dq_true_rad_s

    def outcome(self, cell: Cell) -> Outcome:
        """Run the cell from beginning to end."""
        self.swing()
        self.disturb(cell.target, cell.kind)
        machine = self.simulation.control.machine
        state, fault = machine.state, machine.fault
        recovery, offset_rad = self.recover()
        has_tripped = self._tripped_at is not None
        return Outcome(
            cell,
            self._tripped_at,
            self._torque_at + 1 if has_tripped else None,
            self._tau_max_Nm,
            self._after_trip_rad if has_tripped else None,
            self._error_rad,
            self._speed_rad_s,
            state,
            fault,
            recovery,
            offset_rad,
        )


def bound_of(cell: Cell) -> Bound:
    """Return the bound that a cell must keep."""
    return _BOUNDS.get((cell.target, cell.kind), SEEN)


def broken_bounds(outcome: Outcome, tau_max_Nm: float) -> list[str]:
    """Say what an outcome breaks, one line each; empty if it keeps all bounds."""
    bound = bound_of(outcome.cell)
    broken = []
    if outcome.tau_max_Nm > tau_max_Nm * 1.001:
        broken.append(f"torque {outcome.tau_max_Nm:.2f} Nm above {tau_max_Nm:g} Nm")
    if outcome.recovery == "no":
        broken.append("the arm does not come back after the fault")
    if outcome.offset_rad > 0.02:
        broken.append(f"the pose is {outcome.offset_rad:.3f} rad wrong after the fault")
    if outcome.reaction_cycles is None:
        if bound.reaction_cycles is not None:
            broken.append(f"no reaction within {bound.reaction_cycles} cycles")
        return broken
    if bound.reaction_cycles is not None and outcome.reaction_cycles > bound.reaction_cycles:
        broken.append(f"reaction after {outcome.reaction_cycles} > {bound.reaction_cycles} cycles")
    off = (outcome.off_cycles or 0) - outcome.reaction_cycles
    if off > bound.off_cycles:
        broken.append(f"torque off {off} > {bound.off_cycles} cycles after the trip")
    if (outcome.after_trip_rad or 0.0) > bound.travel_rad:
        broken.append(f"{outcome.after_trip_rad:.2f} > {bound.travel_rad:g} rad after the trip")
    return broken


def run_cell(cell: Cell) -> Outcome:
    """Run one cell."""
    return Run(Simulation(matrix_config(cell.family))).outcome(cell)


def run_matrix(
    families: Sequence[str] = FAMILIES, progress: Callable[[int], object] = lambda _: None
) -> list[Outcome]:
    """Run every cell, telling `progress` after each that it was one more."""
    outcomes = []
    for cell in cells(families):
        outcomes.append(run_cell(cell))
        progress(1)
    return outcomes


def _distance(a: Sequence[float], b: Sequence[float]) -> float:
    return max(abs(x - y) for x, y in zip(a, b, strict=True))
