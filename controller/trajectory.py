"""Trajectories: functions that return a motion as a C2 reference, sampled once per period.

Curves through points are piecewise quintics (`controller.quintic`), in numpy alone. Every
function here raises `TrajectoryError` if what it is given does not define a motion; limits are a
matter of `Reference.check`, except where a motion is made as short as the limits allow.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from math import ceil, floor, inf, isfinite, pi
from types import MappingProxyType

import numpy as np

from controller import quintic
from controller.errors import LimitError, TrajectoryError
from controller.reference import (
    FloatArray,
    MotionLimits,
    MotionState,
    Reference,
    Violation,
    concatenate,
)

__all__ = [
    "KELLY",
    "KELLY_RATES",
    "ExponentialSine",
    "MotionLimits",
    "MotionState",
    "Reference",
    "Sinusoid",
    "Violation",
    "approach_duration",
    "blend",
    "brake",
    "concatenate",
    "exponential_sine",
    "kelly",
    "samples",
    "sinusoid",
    "waypoints",
]

MIN_PERIODS = 10
"""Shortest approach, braking and sinusoid ramp, in periods."""
_SAMPLES_PER_CYCLE = 10
"""A sinusoid needs as many samples per cycle, or its samples say nothing of what lies between."""
_SCAN_SAMPLES = 256
"""Resolution at which durations are compared; the result is checked sample by sample."""


@dataclass(frozen=True, slots=True)
class ExponentialSine:
    """Shape of q_d = b h + c h sin(w s), h = 1 - exp(-2 s^3), s = rate * t; one entry per joint.

    Starts at zero, at rest and without acceleration. Source: Kelly, Santibanez, Loria, Control
    of Robot Manipulators in Joint Space, ch. 5.

    Attributes:
        b_rad: Final offset.
        c_rad: Final amplitude.
        w_rad_s: Angular frequency at rate 1.
    """

    b_rad: tuple[float, ...]
    c_rad: tuple[float, ...]
    w_rad_s: tuple[float, ...]


KELLY = ExponentialSine((pi / 4, pi / 3), (pi / 9, pi / 6), (4.0, 3.0))
"""The book's figures for its two-joint arm."""
KELLY_RATES = MappingProxyType({"kelly": 1.0, "kelly_2": 0.5, "kelly_4": 0.25})
"""Names of the rates at which it is usually run."""


@dataclass(frozen=True, slots=True)
class Sinusoid:
    """Shape of q_d = center + r(t) amplitude sin(2 pi f t + phase); one entry per joint.

    Attributes:
        center_rad: Where the motion starts, at rest, and about which it swings.
        amplitude_rad: Half the final swing.
        frequency_Hz: f.
        phase_rad: Phase at t = 0.
        ramp_s: r rises from 0 to 1 in this time, with two continuous derivatives.
    """

    center_rad: tuple[float, ...]
    amplitude_rad: tuple[float, ...]
    frequency_Hz: tuple[float, ...]
    phase_rad: tuple[float, ...]
    ramp_s: float = 1.0


def kelly(period_s: float, duration_s: float, rate: float) -> Reference:
    """Return the exponential-sine trajectory of Kelly, Santibanez and Loria for two joints."""
    return exponential_sine(period_s, duration_s, rate, KELLY)


def exponential_sine(
    period_s: float, duration_s: float, rate: float, shape: ExponentialSine
) -> Reference:
    """Return q_d = b h + c h sin(w s) with its analytic derivatives.

    Args:
        period_s: Time between samples.
        duration_s: Length; rounded up to whole periods. It ends moving (see `brake`).
        rate: Time scale, > 0: s = rate * t.
        shape: Offsets, amplitudes and frequencies.
    """
    b, c, w = _table((shape.b_rad, shape.c_rad, shape.w_rad_s))
    _require(isfinite(rate) and rate > 0.0, f"the rate must be positive, not {rate:g}")
    _require_resolved(float(np.abs(w).max()) * rate, period_s)
    _require_resolved(2.0 * pi * rate, period_s)  # h rises within about one unit of s
    s = rate * _grid(period_s, duration_s)[:, None]
    decay = np.exp(-2.0 * s**3)
    h, h1, h2 = 1.0 - decay, 6.0 * s**2 * decay, (12.0 * s - 36.0 * s**4) * decay
    swing, swing1 = b + c * np.sin(w * s), c * w * np.cos(w * s)
    swing2 = -c * w**2 * np.sin(w * s)
    dq = rate * (h1 * swing + h * swing1)
    ddq = rate**2 * (h2 * swing + 2.0 * h1 * swing1 + h * swing2)
    return Reference(h * swing, dq, ddq, period_s)


def sinusoid(period_s: float, duration_s: float, shape: Sinusoid) -> Reference:
    """Return a sinusoid that starts at rest at its centre and ends moving (see `brake`)."""
    rows = shape.center_rad, shape.amplitude_rad, shape.frequency_Hz, shape.phase_rad
    center, amplitude, frequency, phase = _table(rows)
    _require(
        shape.ramp_s >= MIN_PERIODS * period_s,
        f"the ramp must take at least {MIN_PERIODS * period_s:g} s, not {shape.ramp_s:g} s",
    )
    w = 2.0 * pi * frequency
    _require_resolved(float(np.abs(w).max()), period_s)
    t = _grid(period_s, duration_s)[:, None]
    r, r1, r2 = _smooth_step(t, shape.ramp_s)
    wave, wave1 = amplitude * np.sin(w * t + phase), amplitude * w * np.cos(w * t + phase)
    dq = r1 * wave + r * wave1
    ddq = r2 * wave + 2.0 * r1 * wave1 - r * w**2 * wave
    return Reference(center + r * wave, dq, ddq, period_s)


def waypoints(
    period_s: float, times_s: Sequence[float], points_rad: Sequence[Sequence[float]]
) -> Reference:
    """Return the smoothest motion through timed points: least squared jerk, at rest at both ends.

    Between points it may swing beyond them, as every smooth curve does.

    Args:
        period_s: Time between samples.
        times_s: Starts at 0, steps of at least one period.
        points_rad: One row of joint angles per time, at least two.
    """
    points = _table(points_rad)
    times = np.asarray(times_s, dtype=np.float64)
    _require(len(times) == len(points), f"{len(times)} times for {len(points)} points")
    _require(len(times) >= 2, "at least two waypoints are needed")
    _require(times[0] == 0.0, f"the first waypoint's time must be 0, not {times[0]:g} s")
    steps = np.diff(times)
    late = int(np.argmin(steps >= period_s * (1.0 - 1e-6)))
    _require(
        steps[late] >= period_s * (1.0 - 1e-6),
        f"waypoint {late + 2} must come at least {period_s:g} s after the one before it, "
        f"not {steps[late]:g} s",
    )
    at = np.minimum(_grid(period_s, times[-1]), times[-1])
    q, dq, ddq = quintic.interpolate(times, quintic.minimum_jerk_knots(times, points), at)
    q[-1], dq[-1], ddq[-1] = points[-1], 0.0, 0.0
    return Reference(q, dq, ddq, period_s)


def samples(period_s: float, sample_period_s: float, q_rad: Sequence[Sequence[float]]) -> Reference:
    """Return equidistant samples resampled to the control period by a C2 curve through them.

    Velocity and acceleration at each sample are five-point differences; a quintic joins
    neighbours. Starts and ends moving if the samples do (see `brake`).

    Args:
        period_s: Time between samples of the result.
        sample_period_s: Time between the given samples, > 0.
        q_rad: One row of joint angles per sample, at least five.
    """
    rows = _table(q_rad)
    fewest = quintic.STENCIL_POINTS
    _require(len(rows) >= fewest, f"at least {fewest} samples are needed, not {len(rows)}")
    _require(
        isfinite(sample_period_s) and sample_period_s > 0.0,
        f"the samples' period must be positive, not {sample_period_s:g} s",
    )
    times = _instants(len(rows), sample_period_s)
    _require(times[-1] >= period_s, f"the samples span less than one period, {period_s:g} s")
    at = _instants(floor(times[-1] / period_s + 1e-6) + 1, period_s)
    knots = quintic.stencil_knots(sample_period_s, rows)
    return Reference(*quintic.interpolate(times, knots, np.minimum(at, times[-1])), period_s)


def blend(start: MotionState, end: MotionState, duration_s: float, period_s: float) -> Reference:
    """Return the quintic that leads from one motion state into another.

    Args:
        start: State at the first sample, met exactly.
        end: State at the last sample, met exactly.
        duration_s: Length; rounded up to whole periods.
        period_s: Time between samples.
    """
    t = _grid(period_s, duration_s)
    first = start.q_rad, start.dq_rad_s, start.ddq_rad_s2
    last = end.q_rad, end.dq_rad_s, end.ddq_rad_s2
    curve = quintic.coefficients(float(t[-1]), first, last)
    motion = quintic.evaluate(curve[:, None], (t / t[-1])[:, None], float(t[-1]))
    for values, at_start, at_end in zip(motion, first, last, strict=True):
        values[0], values[-1] = at_start, at_end
    return Reference(*motion, period_s)


def approach_duration(
    start: MotionState, end: MotionState, limits: MotionLimits, period_s: float
) -> float:
    """Return the shortest duration, in whole periods, for which `blend` keeps the limits.

    Position, velocity, acceleration and jerk.

    Raises:
        LimitError: If there is none: the states themselves, or the room to turn round.
    """
    return _shortest(partial(blend, start, end), limits, period_s).duration_s


def brake(start: MotionState, limits: MotionLimits, period_s: float) -> Reference:
    """Return the shortest smooth stop within the limits; where it ends follows from the motion.

    Position, velocity, acceleration and jerk.

    Raises:
        LimitError: If the joints cannot stop within the limits.
    """

    def stop(duration_s: float, step_s: float) -> Reference:
        # The velocity is the cubic that takes dq and ddq to zero; this is its integral.
        travel = duration_s * (start.dq_rad_s / 2.0 + duration_s * start.ddq_rad_s2 / 12.0)
        return blend(start, MotionState.at_rest(start.q_rad + travel), duration_s, step_s)

    return _shortest(stop, limits, period_s)


def _shortest(
    make: Callable[[float, float], Reference], limits: MotionLimits, period_s: float
) -> Reference:
    """Find the shortest duration whose motion keeps the limits, and return that motion."""

    def violation(periods: int) -> Violation | None:
        step_s = max(period_s, periods * period_s / _SCAN_SAMPLES)
        return make(periods * period_s, step_s).check(limits, with_jerk=True)

    most = max(MIN_PERIODS, floor(limits.max_duration_s / period_s + 1e-6))
    low, high = _bracket(violation, most)
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if violation(middle) is None else (middle, high)
    while True:
        motion = make(high * period_s, period_s)
        beyond = motion.check(limits, with_jerk=True)
        if beyond is None:
            return motion
        if high >= most:
            raise LimitError(beyond)
        high = min(most, high + 1 + high // 200)  # a peak between the scan's samples


def _bracket(violation: Callable[[int], Violation | None], most: int) -> tuple[int, int]:
    """Lengthen until the limits are kept; return the last failure and the first success."""
    failed, closest = MIN_PERIODS - 1, None
    periods = MIN_PERIODS
    while True:
        beyond = violation(periods)
        if beyond is None:
            return failed, periods
        if closest is None or _gravity(beyond) < _gravity(closest):
            closest = beyond
        if periods == most:
            raise LimitError(closest)
        failed, periods = periods, min(most, periods + 1 + periods // 5)


def _gravity(beyond: Violation) -> tuple[bool, float]:
    """Order violations: too little room says more than too little time, then the smaller counts."""
    excess = abs(beyond.value - beyond.limit) / (1e-3 + abs(beyond.limit))
    return beyond.quantity != "position", excess if isfinite(excess) else inf


def _smooth_step(t: FloatArray, rise_s: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    u = np.minimum(t / rise_s, 1.0)
    r = u**3 * (10.0 - 15.0 * u + 6.0 * u**2)
    r1 = 30.0 * u**2 * (1.0 - u) ** 2 / rise_s
    r2 = 60.0 * u * (1.0 - u) * (1.0 - 2.0 * u) / rise_s**2
    return r, r1, r2


def _grid(period_s: float, duration_s: float) -> FloatArray:
    _require(
        isfinite(period_s) and period_s > 0.0, f"the period must be positive, not {period_s:g} s"
    )
    _require(
        isfinite(duration_s) and duration_s > 0.0,
        f"the duration must be positive, not {duration_s:g} s",
    )
    return _instants(max(1, ceil(duration_s / period_s - 1e-6)) + 1, period_s)


def _instants(count: int, step_s: float) -> FloatArray:
    return np.arange(count, dtype=np.float64) * np.float64(step_s)


def _table(rows: Sequence[Sequence[float]]) -> FloatArray:
    try:
        table = np.asarray(rows, dtype=np.float64)
    except ValueError as error:
        raise TrajectoryError("every row must have one number per joint") from error
    _require(table.ndim == 2 and table.size > 0, "need rows with one number per joint")
    return table


def _require_resolved(w_rad_s: float, period_s: float) -> None:
    _require(
        _SAMPLES_PER_CYCLE * w_rad_s * period_s <= 2.0 * pi,
        f"{w_rad_s:g} rad/s is too fast for samples {period_s:g} s apart: "
        f"fewer than {_SAMPLES_PER_CYCLE} in a cycle",
    )


def _require(condition: object, message: str) -> None:
    if not condition:
        raise TrajectoryError(message)
