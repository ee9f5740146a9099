"""The simulated arm against the Lagrange equations, and wrong arms against its bounds."""

import random
from math import pi

import pytest

from sim_backend.arm import Arm
from sim_backend.presets import plant_preset
from sim_backend.settings import LinkSettings, PlantSettings
from tests.sim_backend import wrong_arms
from tests.sim_backend.arm_cases import CASES, measure
from tests.sim_backend.closed_form import Chain, TwoLink, solve, whole_ms


@pytest.mark.parametrize(("substep_s", "widening"), [(100e-6, 1.0), (250e-6, 7.0)])
@pytest.mark.parametrize("name", CASES)
def test_arm__every_case__errors_stay_within_the_bounds(name, substep_s, widening):
    errors = measure(name, substep_s)
    assert errors.is_within(CASES[name].bounds, widening), errors


@pytest.mark.parametrize(
    ("name", "mistake"),
    [
        ("small swing", wrong_arms.DefaultBias),
        ("small swing", wrong_arms.RawReadOut),
        ("small swing", wrong_arms.Damped),
        ("small swing", wrong_arms.HeavierLink),
        ("quarter turn", wrong_arms.TinyBias),
        ("fast start", wrong_arms.NoBackDrift),
        ("sine", wrong_arms.EulerFriction),
        ("sine", wrong_arms.FrozenFriction),
        ("sine", wrong_arms.NoReaction),
        ("sine", wrong_arms.TorqueOnce),
        ("pd", wrong_arms.LateTorque),
        ("pd", wrong_arms.DifferencedRate),
        ("light pd", wrong_arms.OneIteration),
    ],
)
def test_bounds__arm_with_a_mistake__are_broken(name, mistake):
    bounds = CASES[name].bounds
    assert not measure(name, 100e-6, mistake, stop_beyond=bounds).is_within(bounds)


@pytest.mark.parametrize("name", ["small swing", "fast start", "sine"])
def test_arm__substep_halved__error_falls_to_a_quarter(name):
    coarse, middle, fine = (measure(name, dt).q_rad for dt in (500e-6, 250e-6, 125e-6))
    assert 3.5 < coarse / middle < 4.5
    assert 3.5 < middle / fine < 4.5


def test_naive_arm__substep_halved__error_falls_by_half_only():
    coarse, fine = (measure("fast start", dt, wrong_arms.Naive).q_rad for dt in (250e-6, 125e-6))
    assert 1.7 < coarse / fine < 2.4


def chain(count: int, substep_s: float) -> PlantSettings:
    links = tuple(
        LinkSettings(
            length_m=0.2,
            com_m=0.1,
            mass_kg=1.5 - 0.1 * i,
            inertia_kg_m2=0.02 - 0.001 * i,
            viscous_Nms_rad=0.1,
            coulomb_Nm=0.05,
        )
        for i in range(count)
    )
    pose = tuple(0.4 - 0.15 * i for i in range(count))
    return PlantSettings(links=links, gravity_m_s2=9.81, substep_s=substep_s, q0_rad=pose)


def chain_error_rad(count: int, substep_s: float) -> float:
    """Largest angle error of a chain in its first second, loaded by gravity and torques."""
    settings = chain(count, substep_s)
    tau_Nm = [0.3 - 0.05 * i for i in range(count)]
    start = (*settings.q0_rad, *([0.0] * count))
    arm, error = Arm(settings), 0.0
    for y in solve(Chain(settings), start, whole_ms(1.0, 10), lambda _t, _y: tau_Nm):
        arm.step(tau_Nm, 10e-3)
        error = max(error, *(abs(q - truth) for q, truth in zip(arm.q_rad, y, strict=False)))
    return error


@pytest.mark.parametrize("count", [1, 4, 7])
def test_arm__other_numbers_of_links__second_order_too(count):
    coarse, fine = chain_error_rad(count, 250e-6), chain_error_rad(count, 125e-6)
    assert coarse < 1e-5
    assert 3.5 < coarse / fine < 4.5


@pytest.mark.parametrize("name", ["quarter turn", "fast start", "sine"])
def test_arm__fast_motion__joints_stay_together(name):
    case = CASES[name]
    arm = Arm(case.settings(100e-6))
    arm.reset(case.start[:2], case.start[2:])
    widest_m = 0.0
    for k in range(5000):
        arm.step(case.law(k * 1e-3, arm.q_rad), 1e-3)
        widest_m = max(widest_m, arm.joint_separation_m())
    assert widest_m < 1e-6


def test_closed_forms__random_states__agree():
    rng = random.Random(1)
    settings = plant_preset("pelican_v")
    two, chain_of_two = TwoLink(settings), Chain(settings)
    for _ in range(100):
        y = [rng.uniform(-pi, pi), rng.uniform(-pi, pi), rng.uniform(-9, 9), rng.uniform(-9, 9)]
        tau = [rng.uniform(-20, 20), rng.uniform(-5, 5)]
        assert two.acceleration(y, tau) == pytest.approx(chain_of_two.acceleration(y, tau), 1e-10)
        assert two.energy_J(y) == pytest.approx(chain_of_two.energy_J(y), 1e-12)


def test_closed_forms__constant_torque__runge_kutta_agrees_with_dop853():
    two = TwoLink(plant_preset("pelican_v"))
    y, tau = [0.1, 0.2, 0.0, 0.0], (3.0, 0.4)
    motion = solve(two, y, whole_ms(1.0, 100), lambda _t, _y: tau)
    for expected in motion:
        two.hold_torque(y, tau, 0.1, 800)
        assert y == pytest.approx(expected, abs=1e-7)
