"""Friction of joints: the curve, its steepness, and what a substep can carry."""

from math import exp, inf, nan, sqrt, tanh

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_backend.arm import Arm
from sim_backend.errors import SimError
from sim_backend.friction import make_friction, steepness_Nms_rad
from sim_backend.perturbation import with_stribeck
from sim_backend.presets import plant_preset
from sim_backend.settings import DrivetrainSettings, LinkSettings, PlantSettings

D = 50.0


def link(**changes: object) -> LinkSettings:
    base = {"length_m": 0.2, "com_m": 0.1, "mass_kg": 1.0, "inertia_kg_m2": 0.02}
    return LinkSettings.model_validate({**base, **changes})


links = st.builds(
    lambda viscous, coulomb, excess, vs: link(
        viscous_Nms_rad=viscous,
        coulomb_Nm=coulomb,
        static_Nm=coulomb + excess,
        stribeck_rad_s=vs,
    ),
    st.floats(0.0, 0.5),
    st.floats(0.0, 0.5),
    st.floats(1e-3, 0.5),
    st.floats(1e-3, 1.0),
)


@given(link=links, rate=st.floats(-20.0, 20.0))
def test_stribeck__any_rate__is_the_formula_odd_and_bounded(link, rate):
    friction = make_friction(link, D)
    dry = link.coulomb_Nm
    dry += (link.static_Nm - link.coulomb_Nm) * exp(-((rate / link.stribeck_rad_s) ** 2))
    expected = link.viscous_Nms_rad * rate + dry * tanh(D * rate)
    assert friction(rate) == pytest.approx(expected, rel=1e-12, abs=1e-15)
    assert friction(-rate) == -friction(rate)
    assert abs(friction(rate)) <= link.viscous_Nms_rad * abs(rate) + link.static_Nm
    assert friction(rate) * rate >= 0.0


@given(link=links, rate=st.floats(-3.0, 3.0))
def test_steepness__any_rate__is_never_exceeded(link, rate):
    friction, step = make_friction(link, D), 1e-6
    slope = (friction(rate + step) - friction(rate - step)) / (2.0 * step)
    assert abs(slope) <= steepness_Nms_rad(link, D) * (1.0 + 1e-6) + 1e-8


def test_steepness__falling_flank_steeper_than_the_rise__is_that_of_the_flank():
    falling = link(coulomb_Nm=0.0, static_Nm=0.1, stribeck_rad_s=1e-3)
    assert steepness_Nms_rad(falling, 1.0) == pytest.approx(sqrt(2.0) * exp(-0.5) * 0.1 / 1e-3)


@pytest.mark.parametrize("static_Nm", [None, 0.3])
def test_friction__no_static_excess__is_the_papers(static_Nm):
    friction = make_friction(link(viscous_Nms_rad=0.1, coulomb_Nm=0.3, static_Nm=static_Nm), D)
    for rate in (-2.0, -0.01, 0.0, 0.003, 5.0):
        assert friction(rate) == 0.1 * rate + 0.3 * tanh(D * rate)


def test_friction__rotor__is_the_papers():
    rotor = DrivetrainSettings(rotor_inertia_kg_m2=0.01, viscous_Nms_rad=0.1, coulomb_Nm=0.3)
    assert make_friction(rotor, D)(0.02) == 0.1 * 0.02 + 0.3 * tanh(D * 0.02)


@pytest.mark.parametrize("rate", [1e200, -1e200, inf, nan])
def test_stribeck__absurd_rate__raises_nothing(rate):
    assert make_friction(link(static_Nm=0.1), D)(rate) != 0.05


def bench(**changes: object) -> PlantSettings:
    settings = plant_preset("bench_h")
    first = settings.links[0].model_copy(update=changes)
    return settings.model_copy(update={"links": (first, settings.links[1])})


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"static_Nm": 3.0}, "joint 1"),
        ({"static_Nm": 0.2, "stribeck_rad_s": 1e-3}, "joint 1"),
        (
            {"drivetrain": DrivetrainSettings(rotor_inertia_kg_m2=1e-3, coulomb_Nm=0.5)},
            "the rotor of joint 1",
        ),
    ],
)
def test_arm__friction_too_steep_for_the_substep__sim_error_names_it(changes, what):
    Arm(bench())
    with pytest.raises(SimError, match=rf"friction of {what} is too steep .* limit 1"):
        Arm(bench(**changes))


def test_arm__torque_around_the_peak_of_the_stribeck_curve__creeps_below_and_slides_above():
    settings = with_stribeck(plant_preset("bench_h"), 4.0, 0.1)
    friction = make_friction(settings.links[0], settings.tanh_slope_s_rad)
    peak_Nm = max(friction(1e-3 * k) for k in range(200))
    assert peak_Nm > 3.0 * settings.links[0].coulomb_Nm
    rates = []
    for torque_Nm in (0.97 * peak_Nm, 1.03 * peak_Nm):
        arm = Arm(settings)
        arm.step((torque_Nm, 0.0), 4.0)
        rates.append(arm.dq_rad_s[0])
    assert 0.0 < rates[0] < 0.1
    assert rates[1] > 1.0
