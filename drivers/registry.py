"""Amplifier families by name: one line each. A family's code is imported when it is used."""

from collections.abc import Sequence
from importlib import import_module
from typing import Any

from drivers.axis import Axis
from drivers.cia402.settings import Cia402Settings

AnyAxisSettings = Cia402Settings
"""Settings of any family, told apart by `family`."""

_FAMILIES = {  # family -> "module:class" of its master side
    "cia402": "drivers.cia402.master:Cia402Axis",
}


def make_axes(settings: Sequence[Any], *, period_s: float) -> list[Axis]:
    """Build the master side of every axis, shoulder first.

    Args:
        settings: One settings object a joint; its `family` selects the code.
        period_s: The control period, told to the amplifiers.
    """
    axes = []
    for joint, axis in enumerate(settings, start=1):
        module, _, name = _FAMILIES[axis.family].partition(":")
        axes.append(getattr(import_module(module), name)(axis, joint=joint, period_s=period_s))
    return axes
