"""Perturbed plants: what each changes, and that nothing else changes."""

import pytest
from pydantic import ValidationError

from sim_backend.arm import Arm
from sim_backend.perturbation import (
    scaled,
    with_backlash,
    with_load_step,
    with_payload,
    with_stribeck,
)
from sim_backend.presets import PRESETS, plant_preset

PLANT = plant_preset("pelican_v")


def test_scaled__friction__viscous_coulomb_static_and_rotors():
    plant = with_backlash(with_stribeck(PLANT, 2.0), 0.01)
    gear = plant.links[0].drivetrain.model_copy(update={"viscous_Nms_rad": 0.1, "coulomb_Nm": 0.2})
    links = tuple(link.model_copy(update={"drivetrain": gear}) for link in plant.links)
    plant = plant.model_copy(update={"links": links})
    changed = scaled(plant, friction=3.0)
    for before, after in zip(plant.links, changed.links, strict=True):
        assert after.viscous_Nms_rad == 3.0 * before.viscous_Nms_rad
        assert after.coulomb_Nm == 3.0 * before.coulomb_Nm
        assert after.static_Nm == 3.0 * before.static_Nm
        assert after.drivetrain.viscous_Nms_rad == pytest.approx(0.3)
        assert after.drivetrain.coulomb_Nm == pytest.approx(0.6)
        assert after.mass_kg == before.mass_kg
        assert after.drivetrain.rotor_inertia_kg_m2 == gear.rotor_inertia_kg_m2
        assert after.stribeck_rad_s == before.stribeck_rad_s
    assert scaled(changed, friction=1.0) == changed


def test_scaled__inertia_and_gravity__masses_moments_and_weight():
    changed = scaled(with_backlash(PLANT, 0.01), inertia=1.5, gravity=0.5)
    for before, after in zip(PLANT.links, changed.links, strict=True):
        assert after.mass_kg == 1.5 * before.mass_kg
        assert after.inertia_kg_m2 == 1.5 * before.inertia_kg_m2
        assert after.drivetrain.rotor_inertia_kg_m2 == pytest.approx(0.0075)
        assert (after.com_m, after.viscous_Nms_rad) == (before.com_m, before.viscous_Nms_rad)
    assert changed.gravity_m_s2 == 0.5 * PLANT.gravity_m_s2


def test_scaled__nothing__is_the_same_plant():
    assert scaled(PLANT) == PLANT


def test_payload__half_of_the_last_link__from_the_start_or_later():
    mass_kg = PLANT.links[-1].mass_kg
    always = with_payload(PLANT, 0.5)
    assert [each.mass_kg for each in always.payloads] == [0.5 * mass_kg]
    assert always.payloads[0].pick_s == 0.0
    both = with_payload(always, 0.1, pick_s=1.0, drop_s=2.0, is_at_rest=True)
    assert both.payloads[0] == always.payloads[0]
    assert (both.payloads[1].pick_s, both.payloads[1].is_at_rest) == (1.0, True)


def test_load_step__two__both_are_there():
    plant = with_load_step(with_load_step(PLANT, 1, 0.3, 5.0), 2, 0.1, 5.0, 6.0)
    first, second = plant.disturbances
    assert (first.joint, first.torque_Nm, first.start_s, first.end_s) == (1, 0.3, 5.0, None)
    assert (second.joint, second.torque_Nm, second.end_s) == (2, 0.1, 6.0)


def test_stribeck__joint_without_coulomb_friction__has_none():
    links = (PLANT.links[0].model_copy(update={"coulomb_Nm": 0.0}), PLANT.links[1])
    plant = with_stribeck(PLANT.model_copy(update={"links": links}), 1.5, 0.2)
    assert [link.static_Nm for link in plant.links] == [None, pytest.approx(0.03)]
    assert plant.links[1].stribeck_rad_s == 0.2


@pytest.mark.parametrize(
    "perturb",
    [
        lambda: scaled(PLANT, friction=-1.0),
        lambda: with_payload(PLANT, 0.0),
        lambda: with_payload(PLANT, 0.5, weight_kg=1.0),
        lambda: with_load_step(PLANT, 3, 0.1, 0.0),
        lambda: with_stribeck(PLANT, 0.5),
        lambda: with_backlash(PLANT, -0.01),
    ],
)
def test_perturbation__that_makes_no_sense__is_refused(perturb):
    with pytest.raises(ValidationError):
        perturb()


@pytest.mark.parametrize("name", PRESETS)
def test_perturbation__all_at_once_on_every_preset__runs(name):
    plant = with_backlash(with_stribeck(scaled(plant_preset(name), friction=3.0)), 0.005, "link")
    plant = with_load_step(with_payload(plant, 0.5), 1, 0.2, 0.01)
    arm = Arm(plant)
    arm.step((0.5, 0.1), 0.05)
    assert arm.q_rad != list(plant.q0_rad)
