"""The reference scenarios: what is run, and the bounds a right implementation meets.

The bounds come from an independent closed-form simulation of the paper's controller. They leave
room for amplifier variants, a delay of 0 to 1 ms, rounding, integrator and encoder phase; they
leave none for a wrong sign, a swapped rule or a missing term.
"""

import math
from dataclasses import dataclass
from typing import Final, Literal

from hil.errors import HilError

COUNT_RAD: Final = 2.0 * math.pi / 4096
"""One count of a 12-bit encoder: the unit of the error figures, whatever encoder is fitted."""


class ScenarioError(HilError):
    """A scenario was asked for that does not exist."""


@dataclass(frozen=True, slots=True)
class KellyTrajectory:
    """q_d = b h + c h sin(w s), h = 1 - exp(-2 s^3), s = rate * t; one entry per joint.

    Source: Kelly, Santibanez, Loria, Control of Robot Manipulators in Joint Space, ch. 5.
    """

    rate: float
    b_rad: tuple[float, ...] = (math.pi / 4, math.pi / 3)
    c_rad: tuple[float, ...] = (math.pi / 9, math.pi / 6)
    w_rad_s: tuple[float, ...] = (4.0, 3.0)


@dataclass(frozen=True, slots=True)
class VelocitySource:
    """Where the law's joint rate comes from.

    Attributes:
        kind: `true` is the plant's own rate, possible in simulation only.
        cutoff_Hz: Of the first-order filter behind the difference.
        levant_C_rad_s2: Bound on acceleration per joint in the differentiator's gains.
    """

    kind: Literal["true", "filtered_difference", "levant"] = "filtered_difference"
    cutoff_Hz: float = 30.0
    levant_C_rad_s2: tuple[float, ...] = (50.0, 100.0)


@dataclass(frozen=True, slots=True)
class Bound:
    """Closed range in which one figure of one joint must lie; `joint` counts from 1."""

    metric: str
    joint: int
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class Scenario:
    """One reference run.

    Attributes:
        preset: Arm and amplifiers, `NAME_h` without gravity, `NAME_v` with.
        trajectory: Reference; runs from its own t = 0 without an approach.
        velocity: Source of the joint rate.
        adaptation: Rule for beta, paper (28).
        bounds: What a right implementation shows.
        remark: What the reader of a report should know beforehand.
        start_offset_rad: Initial pose minus the reference at t = 0; the arm starts at rest.
        duration_s: Length of the run along the trajectory.
        stat_start_s: Steady-state figures are taken from here to the end.
        encoder_bits: None reads the true angle.
        torque_lag_s: Time constant of the amplifier's torque.
        torque_delay_s: From the encoder's reading to the torque computed from it.
    """

    name: str
    preset: str
    trajectory: KellyTrajectory
    velocity: VelocitySource
    adaptation: Literal["off", "literal"]
    bounds: tuple[Bound, ...]
    remark: str = ""
    start_offset_rad: tuple[float, ...] = (0.4, -0.5)
    duration_s: float = 20.0
    stat_start_s: float = 12.0
    encoder_bits: int | None = 12
    torque_lag_s: float = 1.0 / (2.0 * math.pi * 250.0)
    torque_delay_s: float = 1e-3

    @property
    def q0_rad(self) -> tuple[float, ...]:
        """Initial pose: q_d(0), which is zero for this trajectory, plus the offset."""
        return self.start_offset_rad
