"""Amplifier families by name: one line in each table. Code is imported when it is used."""

from collections.abc import Sequence
from importlib import import_module
from typing import Annotated, Any, TypeVar

from pydantic import Field

from drivers.axis import Axis
from drivers.cia402.settings import Cia402Settings
from drivers.mit.settings import MitSettings
from drivers.moteus.settings import MoteusSettings
from drivers.odrive.settings import OdriveSettings
from drivers.settings import AxisSettings

_Settings = TypeVar("_Settings", bound=AxisSettings)
AnyAxisSettings = Annotated[
    Cia402Settings | MitSettings | MoteusSettings | OdriveSettings, Field(discriminator="family")
]
"""Settings of any family, told apart by `family`."""

SETTINGS: dict[str, type[AxisSettings]] = {
    "cia402": Cia402Settings,
    "mit": MitSettings,
    "moteus": MoteusSettings,
    "odrive": OdriveSettings,
}
"""Family -> its settings."""

_MASTERS = {  # family -> "module:class" of its master side
    "cia402": "drivers.cia402.master:Cia402Axis",
    "mit": "drivers.mit.master:MitAxis",
    "moteus": "drivers.moteus.master:MoteusAxis",
    "odrive": "drivers.odrive.master:OdriveAxis",
}


def make_axes(settings: Sequence[Any], *, period_s: float) -> list[Axis]:
    """Build the master side of every axis, shoulder first.

    Args:
        settings: One settings object a joint; its `family` selects the code.
        period_s: The control period, told to the amplifiers.
    """
    axes = []
    for joint, axis in enumerate(settings, start=1):
        module, _, name = _MASTERS[axis.family].partition(":")
        axes.append(getattr(import_module(module), name)(axis, joint=joint, period_s=period_s))
    return axes


def heartbeat_cycles(settings: Sequence[AxisSettings], *, period_s: float) -> int:
    """Return after how many cycles the master's heartbeat is due, 0 if no axis listens for one."""
    intervals_ms = [axis.master_heartbeat_ms for axis in settings if axis.master_heartbeat_ms]
    return max(1, round(min(intervals_ms) * 1e-3 / period_s)) if intervals_ms else 0


def axes_by_bus(settings: Sequence[_Settings]) -> list[list[_Settings]]:
    """Return the axes of each bus, in the order of the buses' numbers; some may have none."""
    count = max((axis.bus for axis in settings), default=1)
    return [[axis for axis in settings if axis.bus == number] for number in range(1, count + 1)]


def find_clash(settings: Sequence[Any]) -> str:
    """Say in one line which two axes of a bus use one identifier for two things; empty if none."""
    uses: dict[tuple[int, int], tuple[str, str]] = {}
    for joint, axis in enumerate(settings, start=1):
        who = f"joint {joint} ({axis.family} node {axis.node})"
        for can_id, use in axis.identifiers().items():
            other, other_use = uses.setdefault((axis.bus, can_id), (who, use))
            if use != other_use:
                return (
                    f"identifier 0x{can_id:03X} is {use} of {who} and {other_use} of {other}; "
                    "give one of them another node_id"
                )
    return ""
