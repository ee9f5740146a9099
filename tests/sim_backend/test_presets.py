"""The arms that come with the product."""

from itertools import pairwise

import pytest

from sim_backend.arm import Arm
from sim_backend.errors import SimError
from sim_backend.presets import (
    CHAIN_JOINTS_MAX,
    CHAIN_TAPER,
    PRESETS,
    plant_preset,
    servo_preset,
)


@pytest.mark.parametrize("name", PRESETS)
def test_preset__every_name__builds_an_arm_with_its_servos(name):
    settings = plant_preset(name, q0_rad=(0.4, -0.5))
    arm = Arm(settings)
    arm.step([0.0] * len(servo_preset(name)), 1e-3)
    assert settings.gravity_m_s2 == (9.81 if name.endswith("_v") else 0.0)
    assert settings.q0_rad == (0.4, -0.5)


def test_presets__names__are_the_three_arms_in_both_planes():
    arms = ("bench", "pelican", "light")
    assert set(PRESETS) == {arm + plane for arm in arms for plane in ("", "_h", "_v")}


@pytest.mark.parametrize("arm", ["bench", "pelican", "light"])
def test_preset__without_suffix__is_the_horizontal_arm(arm):
    assert plant_preset(arm) == plant_preset(arm + "_h")
    assert servo_preset(arm) == servo_preset(arm + "_h")


def test_preset__pelican__has_the_figures_of_its_source():
    first, second = plant_preset("pelican_v").links
    assert (first.length_m, first.com_m) == (0.26, 0.0983)
    assert (first.mass_kg, first.inertia_kg_m2) == (6.5225, 0.1213)
    assert (second.length_m, second.com_m) == (0.26, 0.0229)
    assert (second.mass_kg, second.inertia_kg_m2) == (2.0458, 0.0116)
    assert (first.viscous_Nms_rad, first.coulomb_Nm) == (0.10, 0.20)
    assert (second.viscous_Nms_rad, second.coulomb_Nm) == (0.01, 0.02)


@pytest.mark.parametrize(
    ("name", "peaks_Nm"), [("bench", (15, 8)), ("pelican", (25, 5)), ("light", (8, 4))]
)
def test_preset__servos__reach_the_torque_limit_at_the_peak_current(name, peaks_Nm):
    servos = servo_preset(name)
    assert all(servo.current_max_A == 10.0 for servo in servos)
    peaks = [servo.torque_constant_Nm_A * servo.current_max_A for servo in servos]
    assert peaks == pytest.approx(peaks_Nm)


@pytest.mark.parametrize("name", ["", "puma", "bench_", "bench_x", "bench_h_v", "Bench", "_h"])
@pytest.mark.parametrize("preset", [plant_preset, servo_preset])
def test_preset__unknown_name__error_lists_the_names(name, preset):
    with pytest.raises(SimError, match=r"bench_h, bench_v, .*pelican_v.*light_v"):
        preset(name)


@pytest.mark.parametrize("joints", [1, 2, 7, CHAIN_JOINTS_MAX])
def test_chain__any_number__builds_an_arm_that_tapers(joints):
    settings = plant_preset(f"chain_h:{joints}")
    arm = Arm(settings)
    arm.step([0.0] * joints, 1e-3)
    assert len(settings.links) == len(settings.q0_rad) == len(servo_preset(f"chain_h:{joints}"))
    for before, after in pairwise(settings.links):
        assert after.mass_kg == pytest.approx(CHAIN_TAPER * before.mass_kg)
        assert after.inertia_kg_m2 == pytest.approx(CHAIN_TAPER * before.inertia_kg_m2)


@pytest.mark.parametrize("number", ["0", "13", "", "-1", "x", "1.5", "\u0662"])
@pytest.mark.parametrize("preset", [plant_preset, servo_preset])
def test_chain__no_such_number__refused(preset, number):
    with pytest.raises(SimError, match="a chain has 1 to 12 joints"):
        preset(f"chain_h:{number}")
