"""The figures of a report, as PNG files: the paper's figs 6 to 12 and the loop's timing."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from controller.membership import MEMBERSHIPS
from hil.decay import has_truth, noise_free_manifold
from hil.fixed_protobuf import Records
from hil.scenarios import COUNT_RAD

Array = NDArray[np.float64]
_STYLE: Final[Any] = {
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
COLOURS: Final = (
    *("#1b6ca8", "#d1495b", "#2e933c", "#8f5aa8", "#b7791f", "#2a9d8f"),
    *("#6c757d", "#c2577f", "#5f7a1f", "#3f51b5", "#8d5524", "#111111"),
)
_DPI: Final = 110
_MARGINS_IN: Final = (1.1, 0.7, 0.5, 0.35)  # left, right, bottom, top
_BUCKETS: Final = 2000  # a line is drawn through the extremes of so many intervals
TRANSIENT_S: Final = 1.0
_S_SHOWN_rad_s: Final = 1.0
MOST_LEGEND_ENTRIES: Final = 4
_HISTOGRAM_BINS: Final = 60
_TRUTH_NOTE: Final = "Strong: the simulated plant itself. Pale: as measured, what the law works on."


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


@contextmanager
def canvas(size_in: tuple[float, float], path: Path) -> Iterator[Any]:
    """Give an empty figure and write it to `path`, the same bytes for the same drawing.

    Margins are fixed: matplotlib's own layout search takes longer than the drawing.
    """
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as Canvas

    with mpl.rc_context(_STYLE):
        figure = Canvas(figsize=size_in, dpi=_DPI)
        FigureCanvasAgg(figure)
        left, right, bottom, top = (
            margin / size for margin, size in zip(_MARGINS_IN, np.repeat(size_in, 2), strict=True)
        )
        figure.subplots_adjust(left, bottom, 1.0 - right, 1.0 - top, wspace=0.28, hspace=0.22)
        yield figure
        figure.savefig(path, metadata={"Software": None})


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
    """Draw one row per joint: the whole run, its first second, its steady window."""
    joints = curves.values.shape[1]
    start_s, end_s = float(span.t_s[0]), float(span.t_s[-1])
    windows_s = ((start_s, end_s), (start_s, start_s + TRANSIENT_S), (span.steady_s, end_s))
    with canvas((11.0, 0.7 + 1.9 * joints), path) as figure:
        grid = figure.subplots(joints, len(windows_s), squeeze=False, width_ratios=(1.5, 1.0, 1.2))
        for axes, title in zip(grid[0], ("whole run", "start", "steady state"), strict=True):
            axes.set_title(title)
        for axes in grid[-1]:
            axes.set_xlabel("t [s]")
        for joint, row in enumerate(grid):
            row[0].set_ylabel(f"joint {joint + 1}\n{curves.label}")
            for axes, (from_s, to_s) in zip(row, windows_s, strict=True):
                inside = slice(*np.searchsorted(span.t_s, (from_s, np.nextafter(to_s, np.inf))))
                _draw_panel(axes, span.t_s[inside], curves, (inside, joint))
            if curves.other_scale is not None:
                _add_scale(row[-1], *curves.other_scale)


def _draw_panel(axes: Any, t_s: Array, curves: _Curves, part: tuple[slice, int]) -> None:  # noqa: ANN401
    colour = COLOURS[part[1] % len(COLOURS)]
    axes.margins(x=0.01)
    axes.locator_params(axis="y", nbins=5)
    if curves.pale is not None:
        axes.plot(*thinned(t_s, curves.pale[part]), color=colour, alpha=0.35, linewidth=0.6)
    for limit in curves.limits:
        axes.plot(*thinned(t_s, limit[part]), color="#6c757d", linestyle="--", linewidth=0.9)
    axes.plot(*thinned(t_s, curves.values[part]), color=colour, linewidth=0.9)


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


def draw_gain_surface(
    beta: Sequence[float], rows: Records, folder: Path, membership: str = "sigmoid"
) -> Figure:
    """Draw memberships, linear consequences and Kd over |S| (figs 6, 7).

    Args:
        beta: Consequences of the rules big, medium, small, as configured.
        rows: Samples, whose (|S|, Kd) are drawn as dots on the curve.
        folder: Where the PNG file goes; it exists.
        membership: A key of `controller.membership.MEMBERSHIPS`.
    """
    path = folder / "fig06_07_gain.png"
    s = np.linspace(0.0, _S_SHOWN_rad_s, 401)
    degrees = np.array([MEMBERSHIPS[membership](float(value)) for value in s])
    rules = ("big", "medium", "small")
    with canvas((9.0, 3.6), path) as figure:
        left, right = figure.subplots(1, 2)
        for axes, scale in ((left, np.ones(3)), (right, np.asarray(beta))):
            for rule, column, colour in zip(rules, (degrees * scale).T, COLOURS[2:], strict=False):
                axes.plot(s, column, color=colour, label=rule)
            axes.set(xlabel="|S| [rad/s]", xlim=(0.0, _S_SHOWN_rad_s))
        left.set(title="memberships", ylabel="degree")
        right.set(title="linear consequences and their sum", ylabel="Kd [Nms/rad]")
        right.plot(s, degrees @ np.asarray(beta), color="#c9ced4", linewidth=5.0, label="Kd, sum")
        _draw_visited_gains(right, rows)
        left.legend(loc="center right")
        right.legend(loc="upper right", markerscale=3.0)
    note = "Dots: gains of the run; they lie off the curve where beta has adapted or bounds moved."
    return Figure(path, "Gain over |S| (figs 6, 7)", note)


def _draw_visited_gains(axes: Any, rows: Records) -> None:  # noqa: ANN401
    step = max(1, len(rows) // _BUCKETS)
    S, Kd = np.abs(rows["S_rad_s"][::step]), rows["Kd"][::step]
    for joint in range(S.shape[1]):
        colour = COLOURS[joint % len(COLOURS)]
        shown = S[:, joint] <= _S_SHOWN_rad_s
        label = f"joint {joint + 1}, run" if S.shape[1] <= MOST_LEGEND_ENTRIES else None
        axes.plot(S[shown, joint], Kd[shown, joint], ".", color=colour, markersize=2.5, label=label)


def draw_timing(samples: Records, period_us: float, folder: Path) -> Figure:
    """Draw histograms of wake-up, feedback, commands and busy time, with p50, p99 and maximum.

    Args:
        samples: All samples; at least one.
        period_us: Length of a cycle, drawn for scale.
        folder: Where the PNG file goes; it exists.
    """
    path = folder / "timing.png"
    figures = (
        ("wake_late_ns", "wake-up after the scheduled start"),
        ("feedback_ns", "feedback complete after the scheduled start"),
        ("sent_ns", "commands sent after the scheduled start"),
        ("busy_ns", "busy time"),
    )
    with canvas((9.0, 6.4), path) as figure:
        figure.subplots_adjust(hspace=0.55)
        for axes, (field, title) in zip(figure.subplots(2, 2).flat, figures, strict=True):
            axes.set(xlabel=f"{title} [us]", ylabel="cycles")
            _draw_histogram(axes, np.maximum(samples[field] / 1e3, 1.0), period_us)
    return Figure(path, "Timing of the loop", "Shorter than 1 us counts as 1 us.")


def _draw_histogram(axes: Any, values_us: Array, period_us: float) -> None:  # noqa: ANN401
    top = max(float(values_us.max()) * 1.2, period_us * 1.3)
    axes.hist(values_us, bins=np.geomspace(1.0, top, _HISTOGRAM_BINS), color="#9db8cc", log=True)
    axes.set(xscale="log", xlim=(1.0, top), ylim=(0.6, None))
    axes.xaxis.set_major_formatter("{x:g}")
    marks = [("period", period_us, "#6c757d")]
    percentiles = np.percentile(values_us, (50, 99, 100))
    colours = ("#2e933c", "#b7791f", "#d1495b")
    marks += zip(("p50", "p99", "max"), map(float, percentiles), colours, strict=True)
    for name, value, colour in marks:
        style = ":" if name == "period" else "-"
        axes.axvline(value, color=colour, linewidth=1.3, ls=style, label=f"{name} {value:.0f}")
    axes.legend(
        loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=4, columnspacing=1.0, handlelength=1.2
    )
