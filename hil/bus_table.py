"""Prints the table of docs/bus-budget.md: how many axes one bus carries at 1 kHz, per family."""

from drivers.registry import SETTINGS
from drivers.settings import AxisSettings
from hil.budget import WARNING_SHARE, Budget, budget_of
from hil.config import BusSettings

PERIOD_S = 1e-3
TORQUE_MAX_NM = 15.0
HEAD = (
    "| family | one axis | two axes | axes under 80 % | axes at most |",
    "|---|---|---|---|---|",
)


def family_budget(family: str, axes: int, bus: BusSettings | None = None) -> Budget:
    """Return the budget of some like axes with their family's default settings."""
    settings: list[AxisSettings] = [
        SETTINGS[family].model_validate(SETTINGS[family].defaults(joint, TORQUE_MAX_NM))
        for joint in range(1, axes + 1)
    ]
    return budget_of(settings, bus or BusSettings(), PERIOD_S)


def most_axes(family: str, share: float) -> int:
    """Return how many axes need at most this share of the period, 0 if one is too many."""
    count = 0
    while family_budget(family, count + 1).share <= share:
        count += 1
    return count


def bus_table() -> str:
    """Return the table as Markdown, one row per family."""
    rows = list(HEAD)
    for family in SETTINGS:
        one, two = (100 * family_budget(family, axes).share for axes in (1, 2))
        counts = f"{most_axes(family, WARNING_SHARE)} | {most_axes(family, 1.0)}"
        rows.append(f"| {family} | {one:.1f} % | {two:.1f} % | {counts} |")
    return "\n".join(rows)


if __name__ == "__main__":
    print(bus_table())  # noqa: T201 - that is what it is for
