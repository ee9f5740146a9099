"""Figures of one run: tracking, decay, torque, gain and timing, and their verdict.

Errors are in counts of a 12-bit encoder (`hil.scenarios.COUNT_RAD`). Time is `t_ref_s`, the time
along the trajectory: rows in which none runs do not count.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.decay import decay_rates, has_truth
from hil.errors import HilError
from hil.fixed_protobuf import Records
from hil.scenarios import COUNT_RAD, Scenario

Array = NDArray[np.float64]
PerJoint = tuple[float, ...]

UNITS: Final[dict[str, str]] = {
    "rms_counts": "counts",
    "peak_counts": "counts",
    "ts20_s": "s",
    "rate10_1_s": "1/s",
    "tv_Nm_s": "Nm/s",
    "peak_tau_Nm": "Nm",
    "Kd_min": "Nms/rad",
    "Kd_max": "Nms/rad",
}
"""Figures that can carry a bound, and their units."""
_SETTLED_RAD: Final = 0.020
_LENGTH_TOLERANCE_S: Final = 0.005  # the last sample lies a cycle or a few before the end
_DEFAULT_STAT_SHARE: Final = 0.6  # of a run without a scenario, as 12 s of 20 s


class MetricsError(HilError):
    """The samples hold no run from which figures can be taken."""


@dataclass(frozen=True, slots=True)
class BoundResult:
    """One figure against its bound.

    Attributes:
        name: Key of `UNITS`, with ` (true)` where the plant's truth was judged; or `duration_s`.
        joint: From 1; 0 for the run as a whole.
        value: As measured.
        low: Smallest value that passes.
        high: Largest value that passes.
        passed: The value lies in the range; NaN never does.
    """

    name: str
    joint: int
    value: float
    low: float
    high: float
    passed: bool


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


def measure(
    samples: Records, *, stat_start_s: float | None = None, end_s: float = math.inf
) -> Metrics:
    """Take the figures of the longest trajectory in `samples`.

    Args:
        samples: Columns of `hil.v1.Sample`, as `Recording.samples`.
        stat_start_s: Start of the statistics window; None takes the last 40 % of the run.
        end_s: What follows this time along the trajectory (the braking) is left out.

    Raises:
        MetricsError: If no trajectory ran, or it ended before the statistics window begins.
    """
    run = trajectory_rows(samples)
    run = run[run["t_ref_s"] <= end_s]
    t_s = np.asarray(run["t_ref_s"], dtype=np.float64)
    start_s = float(_DEFAULT_STAT_SHARE * t_s[-1]) if stat_start_s is None else stat_start_s
    steady = t_s >= start_s
    if np.count_nonzero(steady) < 2:
        raise MetricsError(
            f"the trajectory ends at {t_s[-1]:.3f} s, its statistics start at {start_s:g} s:"
            " let it run to its end"
        )
    is_simulated = has_truth(run)
    torque = run["tau_sent_Nm"]
    variation = np.abs(np.diff(torque[steady], axis=0)).sum(axis=0)
    return Metrics(
        duration_s=float(t_s[-1]),
        stat_start_s=start_s,
        measured=_tracking(run, "q_meas_rad", steady),
        true=_tracking(run, "q_true_rad", steady) if is_simulated else None,
        rate10_1_s=_per_joint(decay_rates(run)),
        is_rate_from_truth=is_simulated,
        tv_Nm_s=_per_joint(variation / np.ptp(t_s[steady])),
        peak_tau_Nm=_per_joint(np.abs(torque).max(axis=0)),
        Kd_min=_per_joint(run["Kd"].min(axis=0)),
        Kd_max=_per_joint(run["Kd"].max(axis=0)),
        timing=timing(samples),
    )


def measure_scenario(samples: Records, scenario: Scenario) -> Metrics:
    """Take the figures of a scenario's run over its own length and statistics window.

    Raises:
        MetricsError: As for `measure`.
    """
    return measure(samples, stat_start_s=scenario.stat_start_s, end_s=scenario.duration_s)


def trajectory_rows(samples: Records) -> Records:
    """Return the rows of the longest trajectory, its instant zero included.

    Raises:
        MetricsError: If there are no samples, or no trajectory ran.
    """
    if len(samples) == 0:
        raise MetricsError("the recording holds no samples: the loop never ran a cycle")
    t_s = samples["t_ref_s"]
    # Where feedback is missing, the reference waits and its time is repeated: not the end of a run.
    breaks = np.flatnonzero((t_s[1:] <= 0.0) | (np.diff(t_s) < 0.0)) + 1
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


def check(metrics: Metrics, scenario: Scenario) -> list[BoundResult]:
    """Hold a run's figures against the bounds of its scenario.

    Position errors are judged as the encoder saw them and, in simulation, as they truly were: a
    wrongly scaled encoder shows in the second alone.

    Returns:
        One result per figure and joint, the length of the run first. A joint that the arm does
        not have fails.
    """
    shortest_s = scenario.duration_s - _LENGTH_TOLERANCE_S
    results = [_judge("duration_s", 0, metrics.duration_s, (shortest_s, math.inf))]
    for bound in scenario.bounds:
        for name, values in figures_named(metrics, bound.metric):
            value = values[bound.joint - 1] if bound.joint <= len(values) else math.nan
            results.append(_judge(name, bound.joint, value, (bound.low, bound.high)))
    return results


def _judge(name: str, joint: int, value: float, limits: tuple[float, float]) -> BoundResult:
    low, high = limits
    return BoundResult(name, joint, value, low, high, passed=low <= value <= high)


def figures_named(metrics: Metrics, name: str) -> Iterator[tuple[str, PerJoint]]:
    """Yield (label, values per joint) of a key of `UNITS`; position errors come twice."""
    if hasattr(metrics, name):
        yield name, getattr(metrics, name)
        return
    yield name, getattr(metrics.measured, name)
    if metrics.true is not None:
        yield f"{name} (true)", getattr(metrics.true, name)


def format_table(results: Sequence[BoundResult]) -> str:
    """Format a verdict as an aligned text table, one line per figure and a last line of count."""
    rows: list[tuple[str, ...]] = [("figure", "joint", "value", "bound", "unit", "verdict")]
    rows += [table_row(result) for result in results]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(_align(row, widths)).rstrip() for row in rows]
    lines.insert(1, "  ".join("-" * width for width in widths))
    failed = sum(not result.passed for result in results)
    verdict = f"{failed} of {len(results)} bounds FAIL" if failed else "all bounds PASS"
    return "\n".join((*lines, "", f"{verdict} ({len(results)} checked)" if not failed else verdict))


def table_row(result: BoundResult) -> tuple[str, ...]:
    """Format one result: figure, joint, value, bound, unit, verdict."""
    return (
        result.name,
        str(result.joint) if result.joint else "-",
        format_figure(result.value),
        format_range(result.low, result.high),
        UNITS.get(result.name.removesuffix(" (true)"), "s"),  # the length of the run is not in it
        "PASS" if result.passed else "FAIL",
    )


def _align(row: tuple[str, ...], widths: list[int]) -> Iterator[str]:
    for column, (cell, width) in enumerate(zip(row, widths, strict=True)):
        yield cell.rjust(width) if column == 2 else cell.ljust(width)


def format_figure(value: float) -> str:
    """Format with four significant digits, and never an exponent for what runs produce."""
    if not math.isfinite(value) or value == 0.0:
        return f"{value:g}"
    digits = max(0, 3 - math.floor(math.log10(abs(value))))
    return f"{value:.{min(digits, 6)}f}"


def format_range(low: float, high: float) -> str:
    """Format a bound as people write it."""
    if high == math.inf:
        return f">= {low:g}"
    return f"<= {high:g}" if low == 0.0 else f"{low:g} .. {high:g}"
