"""The reference scenarios: what is run, and the bounds a right implementation meets.

The bounds come from an independent closed-form simulation of the paper's controller. They leave
room for amplifier variants, a delay of 0 to 1 ms, rounding, integrator and encoder phase; they
leave none for a wrong sign, a swapped rule or a missing term.
"""

import math
from dataclasses import dataclass
from types import MappingProxyType
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
    """Closed range in which one figure of one joint must lie; `joint` counts from 1.

    `metric` is a key of `hil.metrics.UNITS`.
    """

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
        is_tracking: The controller is up to this arm. If not, the bounds describe how it fails.
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
    is_tracking: bool = True
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


_Range = tuple[float, float]
_ANY: Final = (0.0, math.inf)
_PEAK_TOLERANCE: Final = 0.02  # the table gives the peak torque as one figure
_KD_BOX: Final = (0.9995, 3.9805)  # [1.000, 3.980] as printed


def _bounds(
    *, peak_tau_Nm: tuple[float, float], **ranges: tuple[_Range, _Range]
) -> tuple[Bound, ...]:
    """Build one row of the table; every range is given for (joint 1, joint 2)."""
    peak = tuple((x * (1 - _PEAK_TOLERANCE), x * (1 + _PEAK_TOLERANCE)) for x in peak_tau_Nm)
    box = {"peak_tau_Nm": peak, "Kd_min": (_KD_BOX, _KD_BOX), "Kd_max": (_KD_BOX, _KD_BOX)}
    return tuple(
        Bound(metric, joint, low, high)
        for metric, pair in {**ranges, **box}.items()
        for joint, (low, high) in enumerate(pair, start=1)
        if (low, high) != _ANY
    )


_TABLE: Final = (
    Scenario(
        name="A0",
        preset="bench_h",
        trajectory=KellyTrajectory(rate=0.25),
        velocity=VelocitySource("true"),
        adaptation="off",
        encoder_bits=None,
        torque_lag_s=0.5e-3,
        torque_delay_s=0.5e-3,
        bounds=_bounds(
            rms_counts=((0.71, 1.11), (0.0, 0.39)),
            peak_counts=((1.7, 3.1), _ANY),
            ts20_s=((0.48, 0.65), (0.39, 0.53)),
            rate10_1_s=((13.6, 18.6), (67.0, 95.0)),
            tv_Nm_s=((0.0, 10.0), (0.0, 10.0)),
            peak_tau_Nm=(2.0, 3.75),
        ),
    ),
    Scenario(
        name="A",
        preset="bench_h",
        trajectory=KellyTrajectory(rate=0.25),
        velocity=VelocitySource("filtered_difference"),
        adaptation="literal",
        bounds=_bounds(
            rms_counts=((0.95, 1.65), (0.0, 0.83)),
            peak_counts=((2.0, 4.0), _ANY),
            ts20_s=((0.47, 0.66), (0.39, 0.54)),
            rate10_1_s=((12.8, 18.9), (84.0, 120.0)),
            tv_Nm_s=((209.0, 341.0), (217.0, 348.0)),
            peak_tau_Nm=(2.0, 3.75),
        ),
    ),
    Scenario(
        name="B",
        preset="bench_h",
        trajectory=KellyTrajectory(rate=0.25),
        velocity=VelocitySource("levant", levant_C_rad_s2=(50.0, 100.0)),
        adaptation="literal",
        bounds=_bounds(
            rms_counts=((4.15, 6.20), (2.7, 4.1)),
            peak_counts=((6.7, 10.3), _ANY),
            ts20_s=((0.45, 0.63), (0.34, 0.50)),
            rate10_1_s=((11.7, 18.4), (87.0, 132.0)),
            tv_Nm_s=((177.0, 241.0), (268.0, 378.0)),
            peak_tau_Nm=(2.0, 3.75),
        ),
    ),
    Scenario(
        name="E",
        preset="pelican_v",
        trajectory=KellyTrajectory(rate=0.25),
        velocity=VelocitySource("filtered_difference"),
        adaptation="off",
        duration_s=60.0,
        stat_start_s=40.0,
        is_tracking=False,
        bounds=_bounds(
            rms_counts=((96.0, 130.0), (0.93, 1.65)),
            peak_counts=((182.0, 246.0), _ANY),
            ts20_s=((51.0, math.inf), (0.40, 0.55)),
            rate10_1_s=((21.0, 29.0), (160.0, 241.0)),
            tv_Nm_s=((16.0, 42.0), (133.0, 210.0)),
            peak_tau_Nm=(9.25, 3.75),
        ),
    ),
)
SCENARIOS: Final = MappingProxyType({scenario.name: scenario for scenario in _TABLE})


def find_scenario(name: str) -> Scenario:
    """Return the scenario of that name.

    Raises:
        ScenarioError: If there is none; the message lists those there are.
    """
    try:
        return SCENARIOS[name]
    except KeyError:
        raise ScenarioError(f"scenario {name!r} is not one of: {', '.join(SCENARIOS)}") from None
