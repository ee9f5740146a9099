"""The figure of the report's section on regions and dissipation."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from controller.monitor import OMEGA_KD_RAD_S
from hil.plots import COLOURS, MOST_LEGEND_ENTRIES, TRANSIENT_S, Figure, Span, canvas, thinned
from hil.regions import ManifoldFigures

Array = NDArray[np.float64]

_AVERAGE_CYCLES: Final = 100
_LEAST: Final = (1e-3, 1e-5, 1e-5)  # what the logarithmic scales show of |S|, V and powers
_SMALLEST: Final = 1e-12  # in place of zero
_LABELS: Final = ("|S| [rad/s]", "V [rad2/s2]", "power [W]")
_NOTE: Final = (
    f"Left every cycle of the start, right means over {_AVERAGE_CYCLES} cycles of the whole run."
    " Above: |S_j|, with the border of Omega_Kd and the fitted exponentials dashed. Middle: storage"
    " V = S'S/2. Below: dissipation S'Kd S and demand |S' Y_r Theta|. "
)
_WITH_PLANT: Final = "Strong: the simulated plant, free of noise; pale: as the monitors saw it."
_WITHOUT_PLANT: Final = "Strong: the encoder smoothed; pale, and powers: as the monitors saw it."


@dataclass(frozen=True, slots=True)
class _Line:
    """One quantity, never negative, and how the monitors saw it."""

    label: str | None
    colour: str
    values: Array
    seen: Array | None


def draw_manifold(span: Span, figures: ManifoldFigures, folder: Path) -> Figure:
    """Draw |S|, storage, dissipation and demand over time, on logarithmic scales.

    Args:
        span: Rows with monitors.
        figures: Of these rows.
        folder: Where the PNG file goes; it exists.
    """
    path = folder / "regions.png"
    start_s, end_s = float(span.t_s[0]), float(span.t_s[-1])
    panels = (_sizes(span, figures), _storage(span, figures), _powers(span, figures))
    with canvas((11.0, 7.4), path) as figure:
        grid = figure.subplots(3, 2, squeeze=False, width_ratios=(1.0, 1.2))
        for row, lines, least, label in zip(grid, panels, _LEAST, _LABELS, strict=True):
            row[0].set_ylabel(label)
            _draw(row[0], span.t_s, lines, (start_s, start_s + TRANSIENT_S))
            _draw(row[1], *_averaged(span.t_s, lines), (start_s, end_s))
            for axes in row:
                axes.set_yscale("log")
                axes.set_ylim(least, max(10.0 * least, axes.get_ylim()[1]))
            if lines[0].label is not None:
                row[1].legend(loc="lower right")
        for axes in grid[0]:
            axes.axhline(OMEGA_KD_RAD_S, color="#6c757d", linestyle="--", linewidth=0.9)
        _draw_fits(grid[0, 0], figures)
        for axes, title in zip(grid[0], ("start", "whole run, means"), strict=True):
            axes.set_title(title)
        for axes in grid[-1]:
            axes.set_xlabel("t [s]")
    note = _NOTE + (_WITHOUT_PLANT if figures.powers is None else _WITH_PLANT)
    return Figure(path, "Regions, storage and dissipation", note)


def _sizes(span: Span, figures: ManifoldFigures) -> list[_Line]:
    S, seen = np.abs(figures.S), np.abs(span.rows["S_rad_s"])
    joints = S.shape[1]
    return [
        _Line(
            f"joint {joint + 1}" if joints <= MOST_LEGEND_ENTRIES else None,
            COLOURS[joint % len(COLOURS)],
            S[:, joint],
            seen[:, joint],
        )
        for joint in range(joints)
    ]


def _storage(span: Span, figures: ManifoldFigures) -> list[_Line]:
    V = 0.5 * (figures.S**2).sum(axis=1)
    return [_Line("V", COLOURS[0], V, span.rows["V_rad2_s2"])]


def _powers(span: Span, figures: ManifoldFigures) -> list[_Line]:
    seen = (span.rows["dissipation_W"], span.rows["demand_W"])
    names = (("S'Kd S", COLOURS[2]), ("|S' Y_r Theta|", COLOURS[1]))
    if figures.powers is None:
        return [_Line(*name, values, None) for name, values in zip(names, seen, strict=True)]
    rows = zip(names, figures.powers, seen, strict=True)
    return [_Line(*name, values, pale) for name, values, pale in rows]


def _averaged(t_s: Array, lines: Sequence[_Line]) -> tuple[Array, list[_Line]]:
    """Return time and lines in means over blocks of cycles, without what the monitors saw."""
    width = min(_AVERAGE_CYCLES, len(t_s))
    count = len(t_s) // width * width

    def mean(values: Array) -> Array:
        return np.asarray(values[:count].reshape(-1, width).mean(axis=1))

    averaged = [_Line(line.label, line.colour, mean(line.values), None) for line in lines]
    return mean(t_s), averaged


def _draw(
    axes: Any,  # noqa: ANN401 - matplotlib is untyped here
    t_s: Array,
    lines: Sequence[_Line],
    window_s: tuple[float, float],
) -> None:
    part = slice(0, int(np.searchsorted(t_s, window_s[1], side="right")))
    for line in lines:
        if line.seen is not None:
            axes.plot(
                t_s[part], _positive(line.seen[part]), color=line.colour, alpha=0.3, linewidth=0.6
            )
    for line in lines:
        t, values = thinned(t_s[part], _positive(line.values[part]))
        axes.plot(t, values, color=line.colour, linewidth=0.9, label=line.label)
    axes.set_xlim(*window_s)


def _positive(values: Array) -> Array:
    return np.maximum(values, _SMALLEST)


def _draw_fits(axes: Any, figures: ManifoldFigures) -> None:  # noqa: ANN401
    decay = figures.decay
    rows = zip(decay.duration_s, decay.rate_1_s, decay.level_rad_s, strict=True)
    for joint, (duration_s, rate, level) in enumerate(rows):
        if np.isfinite(rate):
            t = np.array((0.0, duration_s))
            colour = COLOURS[joint % len(COLOURS)]
            axes.plot(t, level * np.exp(-rate * t), color=colour, linestyle="--", linewidth=1.4)
