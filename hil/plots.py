"""The figures of a report, as PNG files: the paper's figs 6 to 12 and the loop's timing."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from controller.gain import memberships
from hil.decay import has_truth, noise_free_manifold
from hil.fixed_protobuf import Records
from hil.scenarios import COUNT_RAD

Array = NDArray[np.float64]
_STYLE: Final = {
    "font.size": 9.0,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "legend.frameon": False,
    "legend.fontsize": 8.5,
}
_COLOURS: Final = (
    *("#1b6ca8", "#d1495b", "#2e933c", "#8f5aa8", "#b7791f", "#2a9d8f"),
    *("#6c757d", "#c2577f", "#5f7a1f", "#3f51b5", "#8d5524", "#111111"),
)
_DPI: Final = 110
_BUCKETS: Final = 2000  # a line is drawn through the extremes of so many intervals
_TRANSIENT_S: Final = 1.0
_S_SHOWN_rad_s: Final = 1.0
_HISTOGRAM_BINS: Final = 60


@dataclass(frozen=True, slots=True)
class Figure:
    """One figure on disk."""

    path: Path
    title: str
    caption: str


@dataclass(frozen=True, slots=True)
class Span:
    """What is drawn over time.

    Attributes:
        rows: Samples.
        t_s: Time of each, along the trajectory if one ran.
        steady_s: Start of the steady window.
    """

    rows: Records
    t_s: Array
    steady_s: float


@dataclass(frozen=True, slots=True)
class _Curves:
    """Columns over time: `pale` behind (as the encoder sees it), `limits` dashed."""

    label: str
    values: Array
    pale: Array | None = None
    limits: tuple[Array, ...] = ()
    other_scale: tuple[float, str] | None = None  # factor and label of a scale to the right


def draw_run(span: Span, folder: Path) -> list[Figure]:
    """Draw S, position and velocity errors, torques and gains over time (figs 8 to 12).

    Args:
        span: At least two rows.
        folder: Where the PNG files go; it exists.
    """
    drawings: tuple[tuple[str, str, str, Callable[[Records], _Curves]], ...] = (
        ("fig08_S", "Error manifold S (fig. 8)", _TRUTH_NOTE, _manifold),
        ("fig09_position_error", "Position errors (fig. 9)", _TRUTH_NOTE, _position_error),
        ("fig10_velocity_error", "Velocity errors (fig. 10)", _TRUTH_NOTE, _velocity_error),
        ("fig11_torque", "Torques (fig. 11)", "As sent, after all limits.", _torque),
        ("fig12_Kd", "Gain Kd (fig. 12)", "Dashed: the bounds in force.", _gain),
    )
    figures = []
    for name, title, note, curves in drawings:
        path = folder / f"{name}.png"
        shown = curves(span.rows)
        is_noted = note is not _TRUTH_NOTE or shown.pale is not None
        _draw_over_time(span, shown, path)
        figures.append(Figure(path, title, note if is_noted else ""))
    return figures


_TRUTH_NOTE: Final = "Strong: the simulated plant itself. Pale: as measured, what the law works on."


def _manifold(rows: Records) -> _Curves:
    S = rows["S_rad_s"]
    if not has_truth(rows):
        return _Curves("S [rad/s]", S)
    return _Curves("S [rad/s]", noise_free_manifold(rows), pale=S)


def _position_error(rows: Records) -> _Curves:
    measured, scale = rows["q_meas_rad"] - rows["q_des_rad"], (1.0 / COUNT_RAD, "12-bit counts")
    if not has_truth(rows):
        return _Curves("q - q_des [rad]", measured, other_scale=scale)
    true = rows["q_true_rad"] - rows["q_des_rad"]
    return _Curves("q - q_des [rad]", true, pale=measured, other_scale=scale)


def _velocity_error(rows: Records) -> _Curves:
    measured = rows["dq_meas_rad_s"] - rows["dq_des_rad_s"]
    if not has_truth(rows):
        return _Curves("dq - dq_des [rad/s]", measured)
    return _Curves("dq - dq_des [rad/s]", rows["dq_true_rad_s"] - rows["dq_des_rad_s"], measured)


def _torque(rows: Records) -> _Curves:
    return _Curves("torque [Nm]", rows["tau_sent_Nm"])


def _gain(rows: Records) -> _Curves:
    return _Curves("Kd [Nms/rad]", rows["Kd"], limits=(rows["Kd_min"], rows["Kd_max"]))


def _draw_over_time(span: Span, curves: _Curves, path: Path) -> None:
    """Draw the whole run above, its first second and its steady window below."""
    with _canvas((9.0, 5.6), path) as figure:
        grid = figure.add_gridspec(2, 2, height_ratios=(1.1, 1.0))
        end_s = float(span.t_s[-1])
        panels = (
            (grid[0, :], "whole run", (float(span.t_s[0]), end_s)),
            (grid[1, 0], "start", (float(span.t_s[0]), float(span.t_s[0]) + _TRANSIENT_S)),
            (grid[1, 1], "steady state", (span.steady_s, end_s)),
        )
        for place, title, window_s in panels:
            axes = figure.add_subplot(place, title=title, xlabel="t [s]", ylabel=curves.label)
            inside = (span.t_s >= window_s[0]) & (span.t_s <= window_s[1])
            _draw_panel(axes, span.t_s[inside], curves, inside)
            axes.margins(x=0.0)
            if curves.other_scale is not None:
                _add_scale(axes, *curves.other_scale)
        handles, labels = figure.axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper right", ncols=min(len(labels), 6))


def _draw_panel(axes: Any, t_s: Array, curves: _Curves, inside: NDArray[np.bool_]) -> None:  # noqa: ANN401
    for joint in range(curves.values.shape[1]):
        colour = _COLOURS[joint % len(_COLOURS)]
        if curves.pale is not None:
            axes.plot(
                *thinned(t_s, curves.pale[inside, joint]), color=colour, alpha=0.3, linewidth=0.6
            )
        for limit in curves.limits:
            axes.plot(*thinned(t_s, limit[inside, joint]), color=colour, ls="--", lw=0.8, alpha=0.7)
        line = thinned(t_s, curves.values[inside, joint])
        axes.plot(*line, color=colour, linewidth=1.0, label=f"joint {joint + 1}")


def _add_scale(axes: Any, factor: float, label: str) -> None:  # noqa: ANN401
    scale = axes.secondary_yaxis("right", functions=(lambda y: y * factor, lambda y: y / factor))
    scale.set_ylabel(label)


def thinned(t_s: Array, values: Array) -> tuple[Array, Array]:
    """Reduce a long line to the extremes of even intervals: it looks the same and draws fast."""
    width = len(t_s) // _BUCKETS
    if width < 4:
        return t_s, values
    count = len(t_s) // width
    buckets = values[: count * width].reshape(count, width)
    offsets = np.arange(count) * width
    at = np.stack((offsets + buckets.argmin(axis=1), offsets + buckets.argmax(axis=1)), axis=1)
    at.sort(axis=1)
    chosen = np.concatenate((at.ravel(), np.arange(count * width, len(t_s))))
    return t_s[chosen], values[chosen]


def draw_gain_surface(beta: Sequence[float], rows: Records, folder: Path) -> Figure:
    """Draw memberships, linear consequences and Kd over |S| (figs 6, 7).

    Args:
        beta: Consequences of the rules big, medium, small, as configured.
        rows: Samples, whose (|S|, Kd) are drawn as dots on the curve.
        folder: Where the PNG file goes; it exists.
    """
    path = folder / "fig06_07_gain.png"
    s = np.linspace(0.0, _S_SHOWN_rad_s, 401)
    degrees = np.array([memberships(float(value)) for value in s])
    rules = ("big", "medium", "small")
    with _canvas((9.0, 3.6), path) as figure:
        left, right = figure.subplots(1, 2)
        for axes, scale in ((left, np.ones(3)), (right, np.asarray(beta))):
            for rule, column, colour in zip(rules, (degrees * scale).T, _COLOURS[2:], strict=False):
                axes.plot(s, column, color=colour, label=rule)
            axes.set(xlabel="|S| [rad/s]", xlim=(0.0, _S_SHOWN_rad_s))
        left.set(title="memberships", ylabel="degree")
        right.set(title="linear consequences and their sum", ylabel="Kd [Nms/rad]")
        _draw_visited_gains(right, rows)
        right.plot(s, degrees @ np.asarray(beta), color="black", linewidth=1.6, label="Kd")
        left.legend(loc="center right")
        right.legend(loc="upper right")
    note = "Dots: gains of the run; they lie off the curve where beta has adapted or bounds moved."
    return Figure(path, "Gain over |S| (figs 6, 7)", note)


def _draw_visited_gains(axes: Any, rows: Records) -> None:  # noqa: ANN401
    step = max(1, len(rows) // _BUCKETS)
    S, Kd = np.abs(rows["S_rad_s"][::step]), rows["Kd"][::step]
    for joint in range(S.shape[1]):
        colour = _COLOURS[joint % len(_COLOURS)]
        shown = S[:, joint] <= _S_SHOWN_rad_s
        axes.plot(S[shown, joint], Kd[shown, joint], ".", color=colour, markersize=3, alpha=0.5)


def draw_timing(samples: Records, period_us: float, folder: Path) -> Figure:
    """Draw histograms of wake-up lateness and busy time, with p50, p99 and maximum.

    Args:
        samples: All samples; at least one.
        period_us: Length of a cycle, drawn for scale.
        folder: Where the PNG file goes; it exists.
    """
    path = folder / "timing.png"
    figures = (("wake_late_ns", "wake-up after the scheduled start"), ("busy_ns", "busy time"))
    with _canvas((9.0, 3.4), path) as figure:
        for axes, (field, title) in zip(figure.subplots(1, 2), figures, strict=True):
            axes.set(title=title, xlabel="[us]", ylabel="cycles")
            _draw_histogram(axes, np.maximum(samples[field] / 1e3, 1.0), period_us)
    return Figure(path, "Timing of the loop", "Shorter than 1 us counts as 1 us.")


def _draw_histogram(axes: Any, values_us: Array, period_us: float) -> None:  # noqa: ANN401
    top = max(float(values_us.max()) * 1.2, period_us * 1.3)
    axes.hist(values_us, bins=np.geomspace(1.0, top, _HISTOGRAM_BINS), color="#9db8cc", log=True)
    axes.set(xscale="log", xlim=(1.0, top))
    axes.set_ylim(0.6, axes.get_ylim()[1] * 4.0)
    axes.axvline(
        period_us, color="#6c757d", linewidth=1.0, ls=":", label=f"period {period_us:g} us"
    )
    marks = zip(("p50", "p99", "max"), np.percentile(values_us, (50, 99, 100)), strict=True)
    for (name, value), colour in zip(marks, ("#2e933c", "#b7791f", "#d1495b"), strict=True):
        axes.axvline(value, color=colour, linewidth=1.2, label=f"{name} {value:.0f} us")
    axes.legend(loc="upper left", ncols=2)
