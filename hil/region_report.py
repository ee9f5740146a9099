"""The report's section on regions and dissipation: what the paper says of S, and what S did."""

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from controller.settings import MODEL_BASED
from hil.document import Block, Image, Paragraph, Table
from hil.fixed_protobuf import Records
from hil.metrics import format_figure
from hil.plots import Span
from hil.region_plots import draw_manifold
from hil.regions import (
    Balance,
    ManifoldFigures,
    Regions,
    has_monitors,
    measure_manifold,
    plant_of,
)

_REGIONS: Final = (
    "The paper splits the state into Omega_alpha and, within |S_j| < 1 rad/s, Omega_Kd, and reports"
    " that Omega_Kd is never left again. "
)
_BALANCE: Final = (
    "Condition (36), S'Kd S > |S' Y_r Theta|, is what makes S'H S fall. The monitor has no model:"
    " its demand takes the low-passed sent torque for Y_r Theta, which is right only once the"
    " transient is over, and the noise of S counts as dissipation alone. As tau = -Kd S settles"
    " where both sides are equal, (36) can hold throughout only while S decays."
)
_NO_BALANCE: Final = (
    "This law adds Y_r Theta to the torque itself: (36) is not its condition, and S need not carry"
    " the load."
)


def manifold_section(
    rows: Records, stat_start_s: float, config: Mapping[str, Any], folder: Path
) -> Iterator[Block]:
    """Yield tables, remarks and a plot for one trajectory.

    Args:
        rows: As `hil.metrics.trajectory_rows` returns them.
        stat_start_s: Start of the steady state.
        config: The recorded configuration.
        folder: Where the plot goes; it exists.
    """
    if not has_monitors(rows):
        yield Paragraph("This recording is from a release without monitors.")
        return
    plant = plant_of(config)
    law = config.get("controller", {}).get("law", {}).get("name", "")
    is_model_based = law in MODEL_BASED
    figures = measure_manifold(rows, stat_start_s, plant)
    yield Paragraph(_REGIONS + _exits(figures.regions))
    titles = [f"joint {joint + 1}" for joint in range(len(figures.regions.exits))]
    table = list(_rows(figures))
    yield Table(("figure", "unit", *titles), table[:-1] if is_model_based else table)
    yield Paragraph(_decay(figures))
    if is_model_based:
        yield Paragraph(_NO_BALANCE)
    else:
        yield Paragraph(_BALANCE)
        yield Table(
            ("part", "S'Kd S [W]", "demand [W]", "(36) holds", "by"), list(_balances(figures))
        )
    figure = draw_manifold(Span(rows, np.asarray(rows["t_ref_s"]), stat_start_s), figures, folder)
    yield Image(figure.path, figure.title, figure.caption)


def _exits(regions: Regions) -> str:
    left = [
        f"joint {joint} leaves it {count:.0f} time{'s' if count > 1 else ''}"
        for joint, count in enumerate(regions.exits, start=1)
        if count
    ]
    found = f"Here {' and '.join(left)}" if left else "Here that holds for every joint"
    noise = sum(regions.counted_exits) - sum(regions.exits)
    more = f"; noise adds {noise:.0f} to the count on-line" if noise > 0 else ""
    return found + more + "."


def _rows(figures: ManifoldFigures) -> Iterator[tuple[str, ...]]:
    decay, regions = figures.decay, figures.regions
    for name, unit, values in (
        ("in Omega_Kd from", "s", regions.entered_s),
        ("entries into Omega_Kd (counted on-line)", "", regions.entries),
        ("exits from Omega_Kd (counted on-line)", "", regions.exits),
        ("decay to a tenth of |S(0)|", "s", decay.duration_s),
        ("fitted exponential rate", "1/s", decay.rate_1_s),
        ("its r2 of ln |S|", "", decay.r_squared),
        ("ultimate bound of |S| (as the law saw it)", "rad/s", regions.bound_rad_s),
        ("|tau_need / Kd|, where S must settle", "rad/s", regions.load_bound_rad_s),
    ):
        seen = _SEEN.get(name)
        others = getattr(regions, seen) if seen else (None,) * len(values)
        yield name, unit, *map(_pair, values, others)


_SEEN: Final = {
    "entries into Omega_Kd (counted on-line)": "counted_entries",
    "exits from Omega_Kd (counted on-line)": "counted_exits",
    "ultimate bound of |S| (as the law saw it)": "seen_bound_rad_s",
}


def _pair(value: float, seen: float | None) -> str:
    return _number(value) + ("" if seen is None else f" ({_number(seen)})")


def _number(value: float) -> str:
    if math.isnan(value):
        return "-"
    return f"{value:.0f}" if value == round(value) else format_figure(value)


def _decay(figures: ManifoldFigures) -> str:
    r_squared = [value for value in figures.decay.r_squared if math.isfinite(value)]
    if not r_squared:
        return "No joint starts with an error whose decay could be fitted."
    return (
        "An exponential is fitted to |S| until it is below a tenth of its start; r2 tells how much"
        f" of the fall it explains (least: {min(r_squared):.2f}). By (35), V falls at twice the"
        " rate of |S|. Beyond that S does not fall to zero but into the ultimate bound."
    )


def _balances(figures: ManifoldFigures) -> Iterator[tuple[str, ...]]:
    for part, balance in (("decay", figures.decaying), ("steady state", figures.steady)):
        if balance is not None:
            yield from _balance_rows(part, balance)


def _balance_rows(part: str, balance: Balance) -> Iterator[tuple[str, ...]]:
    seen = (balance.dissipation_W, balance.demand_W, balance.share)
    plant = (balance.model_dissipation_W, balance.model_demand_W, balance.model_share)
    for (dissipation, demand, share), by in ((seen, "monitor"), (plant, "plant's own parameters")):
        if math.isfinite(share):
            yield part, format_figure(dissipation), format_figure(demand), f"{share:.1%}", by
