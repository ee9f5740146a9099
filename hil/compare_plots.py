"""Plots of a comparison: one PNG per scenario, error over torque variation for every law."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from hil.compare import Row

MARKERS: Final = "osD^vP*X<>"


def draw_comparison(rows: Sequence[Row], directory: Path) -> list[Path]:
    """Draw rms error against torque variation, one panel per joint, and return the files."""
    paths = []
    for scenario in dict.fromkeys(row.case.scenario for row in rows):
        some = [row for row in rows if row.case.scenario == scenario and not row.failed]
        if some:
            path = directory / f"compare_{scenario.replace(' ', '_')}.png"
            _draw(scenario, some, path)
            paths.append(path)
    return paths


def _draw(scenario: str, rows: Sequence[Row], path: Path) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    joints = len(rows[0].rms_counts)
    figure = Figure(figsize=(5.5 * joints + 2.0, 4.8), layout="constrained")
    FigureCanvasAgg(figure)
    laws = list(dict.fromkeys(row.case.law for row in rows))
    perturbations = list(dict.fromkeys(row.case.perturbation for row in rows))
    for joint in range(joints):
        axes = figure.add_subplot(1, joints, joint + 1)
        _scatter(axes, rows, joint, (laws, perturbations))
        axes.set_title(f"{scenario}, joint {joint + 1}")
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right upper", fontsize="small")
    figure.savefig(path, dpi=110)


def _scatter(
    axes: Any,  # noqa: ANN401 - matplotlib is untyped here
    rows: Sequence[Row],
    joint: int,
    names: tuple[list[str], list[str]],
) -> None:
    from matplotlib import colormaps

    laws, perturbations = names
    colours = colormaps["tab10" if len(laws) <= 10 else "tab20"]
    for row in rows:
        law, perturbation = laws.index(row.case.law), perturbations.index(row.case.perturbation)
        axes.plot(
            row.tv_Nm_s[joint],
            row.rms_counts[joint],
            linestyle="",
            marker=MARKERS[perturbation % len(MARKERS)],
            color=colours(law),
        )
    for number, law_name in enumerate(laws):
        axes.plot([], [], color=colours(number), linewidth=4, label=law_name)
    for number, name in enumerate(perturbations):
        axes.plot([], [], "k", linestyle="", marker=MARKERS[number % len(MARKERS)], label=name)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel("torque variation [Nm/s]")
    axes.set_ylabel("rms error [12-bit counts]")
    axes.grid(visible=True, which="both", alpha=0.25)
