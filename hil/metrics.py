"""Figures of one run: tracking, decay, torque, gain and timing, and their verdict.

Errors are in counts of a 12-bit encoder (`hil.scenarios.COUNT_RAD`). Time is `t_ref_s`, the time
along the trajectory: rows in which none runs do not count.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from hil.errors import HilError
from hil.fixed_protobuf import Records
from hil.scenarios import COUNT_RAD, Scenario

Array = NDArray[np.float64]
PerJoint = tuple[float, ...]

UNITS: Final = {
    "rms_counts": "counts",
    "peak_counts": "counts",
    "ts20_s": "s",
    "rate10_1_s": "1/s",
    "tv_Nm_s": "Nm/s",
    "peak_tau_Nm": "Nm",
    "Kd_min": "Nms/rad",
    "Kd_max": "Nms/rad",
    "duration_s": "s",
}
"""Figures that can carry a bound, and their units."""
_SETTLED_RAD: Final = 0.020
_SETTLED_SHARE: Final = 0.1  # of |S(0)|
_SMALLEST_S0_rad_s: Final = 0.1  # below this there is no initial error whose decay means anything
_DEFAULT_STAT_SHARE: Final = 0.6  # of a run without a scenario, as 12 s of 20 s
_SMOOTHING_HALF_WIDTH_S: Final = 12e-3


class MetricsError(HilError):
    """The samples hold no run from which figures can be taken."""


@dataclass(frozen=True, slots=True)
class Tracking:
    """Tracking error q - q_des, one entry per joint.

    Attributes:
        rms_counts: Over the statistics window.
        peak_counts: Largest magnitude in the statistics window.
        ts20_s: Last time the error exceeds 20 mrad; 0 if it never does.
    """

    rms_counts: PerJoint
    peak_counts: PerJoint
    ts20_s: PerJoint


@dataclass(frozen=True, slots=True)
class Timing:
    """How the loop kept its period, over all samples of the recording.

    Attributes:
        cycles: Samples recorded.
        samples_lost: Sequence numbers missing between the first and the last sample.
        overruns: Periods skipped since the loop started.
        wake_late_us: (p50, p99, max) of the wake-up after the scheduled start.
        busy_us: (p50, p99, max) of the time not spent waiting for feedback.
    """

    cycles: int
    samples_lost: int
    overruns: int
    wake_late_us: tuple[float, float, float]
    busy_us: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Metrics:
    """Figures of one run; tuples have one entry per joint.

    Attributes:
        duration_s: Time along the trajectory at the last sample.
        stat_start_s: Steady-state figures are taken from here to the end.
        measured: Error of the encoder's position: what hardware can know.
        true: Error of the plant's own position, in simulation.
        rate10_1_s: ln 10 / (first time |S| < 10 % of |S(0)|); NaN if S starts at zero or stays.
        is_rate_from_truth: S of the rate is the plant's own, not smoothed from the encoder.
        tv_Nm_s: Total variation of the sent torque per second of the statistics window.
        peak_tau_Nm: Largest magnitude of the sent torque.
        Kd_min: Smallest gain in use, Nms/rad.
        Kd_max: Largest gain in use, Nms/rad.
        timing: See `Timing`.
    """

    duration_s: float
    stat_start_s: float
    measured: Tracking
    true: Tracking | None
    rate10_1_s: PerJoint
    is_rate_from_truth: bool
    tv_Nm_s: PerJoint
    peak_tau_Nm: PerJoint
    Kd_min: PerJoint
    Kd_max: PerJoint
    timing: Timing


def measure(samples: Records, *, stat_start_s: float | None = None) -> Metrics:
    """Take the figures of the longest trajectory in `samples`.

    Args:
        samples: Columns of `hil.v1.Sample`, as `Recording.samples`.
        stat_start_s: Start of the statistics window; None takes the last 40 % of the run.

    Raises:
        MetricsError: If no trajectory ran, or it ended before the statistics window begins.
    """
    run = trajectory_rows(samples)
    t_s = np.asarray(run["t_ref_s"], dtype=np.float64)
    start_s = float(_DEFAULT_STAT_SHARE * t_s[-1]) if stat_start_s is None else stat_start_s
    steady = t_s >= start_s
    if np.count_nonzero(steady) < 2:
        raise MetricsError(
            f"the trajectory ends at {t_s[-1]:.3f} s, its statistics start at {start_s:g} s:"
            " let it run to its end"
        )
    has_truth = _has_truth(run)
    torque = run["tau_sent_Nm"]
    variation = np.abs(np.diff(torque[steady], axis=0)).sum(axis=0)
    return Metrics(
        duration_s=float(t_s[-1]),
        stat_start_s=start_s,
        measured=_tracking(run, "q_meas_rad", steady),
        true=_tracking(run, "q_true_rad", steady) if has_truth else None,
        rate10_1_s=_per_joint(decay_rates(run)),
        is_rate_from_truth=has_truth,
        tv_Nm_s=_per_joint(variation / np.ptp(t_s[steady])),
        peak_tau_Nm=_per_joint(np.abs(torque).max(axis=0)),
        Kd_min=_per_joint(run["Kd"].min(axis=0)),
        Kd_max=_per_joint(run["Kd"].max(axis=0)),
        timing=timing(samples),
    )


def trajectory_rows(samples: Records) -> Records:
    """Return the rows of the longest trajectory, its instant zero included.

    Raises:
        MetricsError: If there are no samples, or no trajectory ran.
    """
    if len(samples) == 0:
        raise MetricsError("the recording holds no samples: the loop never ran a cycle")
    t_s = samples["t_ref_s"]
    breaks = np.flatnonzero((t_s[1:] <= 0.0) | (np.diff(t_s) <= 0.0)) + 1
    runs = np.split(np.arange(len(t_s)), breaks)
    longest = max(runs, key=lambda rows: float(t_s[rows[-1]] - t_s[rows[0]]))
    if t_s[longest[-1]] <= 0.0:
        raise MetricsError("no trajectory ran in this recording: there is no tracking to measure")
    rows: Records = samples[longest[0] : longest[-1] + 1]
    return rows if _starts_on_reference(rows) else rows[1:]


def _starts_on_reference(rows: Records) -> bool:
    """Tell whether a first row with t = 0 belongs to the trajectory, not to the hold before it."""
    if rows["t_ref_s"][0] > 0.0 or len(rows) < 3:
        return True
    steps = np.abs(np.diff(rows["q_des_rad"][:3], axis=0))
    return bool((steps[0] <= 10.0 * steps[1] + 1e-6).all())


def timing(samples: Records) -> Timing:
    """Take the loop's timing figures over all rows; `samples` must have at least one."""
    seq = samples["seq"]
    return Timing(
        cycles=len(samples),
        samples_lost=int(seq[-1]) - int(seq[0]) + 1 - len(samples),
        overruns=int(samples["overruns"][-1]),
        wake_late_us=_spread_us(samples["wake_late_ns"]),
        busy_us=_spread_us(samples["busy_ns"]),
    )


def _spread_us(values_ns: NDArray[np.int32]) -> tuple[float, float, float]:
    p50, p99, worst = np.percentile(values_ns, (50.0, 99.0, 100.0)) / 1e3
    return float(p50), float(p99), float(worst)


def _has_truth(rows: Records) -> bool:
    return "q_true_rad" in (rows.dtype.names or ()) and bool(np.isfinite(rows["q_true_rad"]).all())


def _per_joint(values: Array) -> PerJoint:
    return tuple(float(value) for value in values)


def _tracking(rows: Records, position: str, steady: NDArray[np.bool_]) -> Tracking:
    error_rad = np.abs(rows[position] - rows["q_des_rad"])
    last = [np.flatnonzero(column > _SETTLED_RAD) for column in error_rad.T]
    error_counts = error_rad[steady] / COUNT_RAD
    return Tracking(
        rms_counts=_per_joint(np.sqrt(np.mean(error_counts**2, axis=0))),
        peak_counts=_per_joint(error_counts.max(axis=0)),
        ts20_s=tuple(float(rows["t_ref_s"][at[-1]]) if len(at) else 0.0 for at in last),
    )


def decay_rates(rows: Records) -> Array:
    """Return ln 10 / (first time |S| < 10 % of |S(0)|) per joint, with S free of encoder noise.

    In simulation S is built from the plant's own position and rate; otherwise from the encoder's
    position smoothed without lag. Either way alpha and Ki are those the recorded S was made with.
    """
    S = np.abs(_noise_free_manifold(rows))
    t_s = rows["t_ref_s"]
    rates = np.full(S.shape[1], np.nan)
    for joint, column in enumerate(S.T):
        settled = np.flatnonzero(column < _SETTLED_SHARE * column[0])
        if len(settled) and column[0] > _SMALLEST_S0_rad_s and t_s[settled[0]] > 0.0:
            rates[joint] = math.log(10.0) / t_s[settled[0]]
    return rates


def _noise_free_manifold(rows: Records) -> Array:
    if _has_truth(rows):
        q, dq = rows["q_true_rad"], rows["dq_true_rad_s"]
    else:
        q, dq = smoothed_motion(rows["t_ref_s"], rows["q_meas_rad"])
    S = np.array(rows["S_rad_s"], dtype=np.float64)
    for joint in range(S.shape[1]):
        error = rows["q_meas_rad"][:, joint] - rows["q_des_rad"][:, joint]
        rate_error = rows["dq_meas_rad_s"][:, joint] - rows["dq_des_rad_s"][:, joint]
        # S = dq_err + alpha q_err + Ki sigma, paper (6), (7): exact, so two gains are found exactly
        terms = np.column_stack((error, rows["sigma"][:, joint]))
        alpha = np.linalg.lstsq(terms, S[:, joint] - rate_error)[0][0]
        S[:, joint] += dq[:, joint] - rows["dq_meas_rad_s"][:, joint]
        S[:, joint] += alpha * (q[:, joint] - rows["q_meas_rad"][:, joint])
    return S


def smoothed_motion(t_s: Array, q_rad: Array) -> tuple[Array, Array]:
    """Return position and rate from sampled positions, without lag.

    A quadratic is fitted around every sample (over 12 ms to each side; at the ends over the first
    and last 24 ms), after the samples have been brought to an even grid.

    Args:
        t_s: Rising instants; skipped cycles leave gaps.
        q_rad: One column per joint.
    """
    dt_s = float(np.median(np.diff(t_s)))
    grid_s = np.arange(t_s[0], t_s[-1] + dt_s / 2, dt_s)
    half = min(round(_SMOOTHING_HALF_WIDTH_S / dt_s), (len(grid_s) - 1) // 2)
    smooth, rate = np.empty_like(q_rad), np.empty_like(q_rad)
    for joint in range(q_rad.shape[1]):
        fits = _local_quadratics(np.interp(grid_s, t_s, q_rad[:, joint]), half)
        smooth[:, joint] = np.interp(t_s, grid_s, fits[0])
        rate[:, joint] = np.interp(t_s, grid_s, fits[1] / dt_s)
    return smooth, rate


def _local_quadratics(values: Array, half: int) -> tuple[Array, Array]:
    """Return value and slope per sample of the quadratic fitted around each sample."""
    offsets = np.arange(-half, half + 1, dtype=np.float64)
    solver = np.linalg.pinv(np.vander(offsets, 3, increasing=True))
    windows = np.lib.stride_tricks.sliding_window_view(values, 2 * half + 1)
    level, slope, bend = solver @ windows.T
    centre = np.clip(np.arange(len(values)), half, len(values) - 1 - half)
    x, at = np.arange(len(values)) - centre, centre - half
    return level[at] + slope[at] * x + bend[at] * x * x, slope[at] + 2.0 * bend[at] * x
