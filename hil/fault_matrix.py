"""The fault matrix: every fault on every target of every amplifier family, in virtual time.

Each cell is one run: enable, swing, the fault in mid-motion for a while, its end, reset, enable
again. What the arm did is taken from the plant itself, not from what the controller believes.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Final

from controller.faults import FaultCode
from controller.machine import State
from controller.reference import MotionLimits, MotionState
from drivers.fault_frame import FaultKind, FaultTarget
from drivers.registry import SETTINGS
from hil.config import Config, load_config
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
SETTLE_CYCLES: Final = 500
REST_Nm: Final = 1e-9


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
        recovered: The arm was READY again after the end of the fault, reset and enable.
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
    recovered: bool
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
    axes = {str(joint): {"family": family} for joint in (1, 2)}
    return load_config(None, {"axes": axes})


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
        control, plant = self.simulation.control, self.simulation._plant
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

    def recover(self) -> tuple[bool, float]:
        """End the fault, reset and enable; return whether that worked, and the pose's error."""
        simulation = self.simulation
        simulation.run(SETTLE_CYCLES)
        machine = simulation.control.machine
        if machine.state in (State.FAULT, State.ESTOP):
            simulation.execute("reset")
            simulation.run(20)
        if machine.state is State.IDLE:
            simulation.execute("enable")
        simulation.run(100)
        # The sample at hand was latched when the truth was.
        offset_rad = _distance(simulation.control.q_rad, simulation._plant.q_true_rad)
        return machine.state in (State.READY, State.ACTIVE), offset_rad

    def outcome(self, cell: Cell) -> Outcome:
        """Run the cell from beginning to end."""
        self.swing()
        self.disturb(cell.target, cell.kind)
        machine = self.simulation.control.machine
        state, fault = machine.state, machine.fault
        recovered, offset_rad = self.recover()
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
            recovered,
            offset_rad,
        )


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
