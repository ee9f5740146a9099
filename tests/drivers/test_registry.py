"""Amplifier families by name: axes in order, code loaded only when it is used."""

import subprocess
import sys
from importlib import import_module

import pytest
from pydantic import BaseModel, TypeAdapter, ValidationError

from drivers import registry
from drivers.axis import Axis
from drivers.cia402.master import Cia402Axis
from drivers.cia402.settings import Cia402Settings
from drivers.frame import unpack_frame
from drivers.registry import AnyAxisSettings, make_axes
from tests.drivers.cia402_rig import SETTINGS, Rig

T = 1e-3


def test_make_axes__one_settings_object_a_joint__in_order_and_labelled():
    axes = make_axes(SETTINGS, period_s=T)
    assert [type(axis) for axis in axes] == [Cia402Axis, Cia402Axis]
    assert [axis.label for axis in axes] == ["joint 1 (cia402 node 1)", "joint 2 (cia402 node 2)"]
    assert [unpack_frame(axis.command(0.0))[0] for axis in axes] == [0x201, 0x202]


def test_make_axes__nobody__nothing():
    assert make_axes([], period_s=T) == []


@pytest.mark.parametrize("period_s", [1e-3, 2e-3, 10e-3])
def test_make_axes__period__told_to_the_drive(period_s):
    rig = Rig(SETTINGS[:1])
    (axis,) = make_axes(SETTINGS[:1], period_s=period_s)
    rig.bus.axes[0] = axis
    rig.configure()
    assert rig.nodes[0].cycle_time_s == pytest.approx(period_s)


@pytest.mark.parametrize("family", list(registry.SETTINGS))
def test_families__every_line__leads_to_an_axis_and_its_settings(family):
    module, _, name = registry._MASTERS[family].partition(":")
    assert issubclass(getattr(import_module(module), name), Axis)
    settings = registry.SETTINGS[family].model_validate(registry.SETTINGS[family].defaults(2, 15.0))
    assert settings.node == 2
    assert settings.family == family
    (axis,) = make_axes([settings], period_s=T)
    assert axis.label.startswith("joint 1 (")


def test_settings__by_family__the_familys_own():
    adapter: TypeAdapter[BaseModel] = TypeAdapter(AnyAxisSettings)
    found = adapter.validate_python(SETTINGS[0].model_dump())
    assert found == SETTINGS[0]
    assert isinstance(found, Cia402Settings)
    with pytest.raises(ValidationError):
        adapter.validate_python({**SETTINGS[0].model_dump(), "family": "none such"})


def test_import__registry_alone__no_familys_code_and_no_can_library():
    """Somebody with one family must not need the libraries of another."""
    code = (
        "import sys, drivers.registry\n"
        "loaded = [m for m in sys.modules if m.endswith('.master') or m.split('.')[0] == 'can']\n"
        "sys.exit(repr(loaded) if loaded else 0)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
