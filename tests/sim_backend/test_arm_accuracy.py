"""The simulated arm against the Lagrange equations, and wrong arms against its bounds."""

import random
from math import pi

import numpy as np
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
        ("stribeck", wrong_arms.EulerStribeck),
        ("stribeck", wrong_arms.CoulombOnly),
    ],
)
def test_bounds__arm_with_a_mistake__are_broken(name, mistake):
    bounds = CASES[name].bounds
    assert not measure(name, 100e-6, mistake, stop_beyond=bounds).is_within(bounds)


@pytest.mark.parametrize("name", ["small swing", "fast start", "sine", "stribeck"])
def test_arm__substep_halved__error_falls_to_a_quarter(name):
    coarse, middle, fine = (measure(name, dt).q_rad for dt in (500e-6, 250e-6, 125e-6))
    assert 3.5 < coarse / middle < 4.5
    assert 3.5 < middle / fine < 4.5


def test_naive_arm__substep_halved__error_falls_by_half_only():
    coarse, fine = (measure("fast start", dt, wrong_arms.Naive).q_rad for dt in (250e-6, 125e-6))
    assert 1.7 < coarse / fine < 2.4


def chain(count: int, substep_s: float, friction: float = 1.0) -> PlantSettings:
    links = tuple(
        LinkSettings(
            length_m=0.2,
            com_m=0.1,
            mass_kg=1.5 - 0.1 * i,
            inertia_kg_m2=0.02 - 0.001 * i,
            viscous_Nms_rad=0.1 * friction,
            coulomb_Nm=0.05 * friction,
        )
        for i in range(count)
    )
    pose = tuple(0.4 - 0.15 * i for i in range(count))
    return PlantSettings(links=links, gravity_m_s2=9.81, substep_s=substep_s, q0_rad=pose)


def chain_error_rad(settings: PlantSettings) -> float:
    """Largest angle error of a chain in its first second, loaded by gravity and torques."""
    count = len(settings.links)
    friction = settings.links[0].viscous_Nms_rad
    tau_Nm = [(0.3 - 0.05 * i) if friction else 0.0 for i in range(count)]
    start = (*settings.q0_rad, *([0.0] * count))
    arm, error = Arm(settings), 0.0
    for y in solve(Chain(settings), start, whole_ms(1.0, 10), lambda _t, _y: tau_Nm):
        arm.step(tau_Nm, 10e-3)
        error = max(error, *(abs(q - truth) for q, truth in zip(arm.q_rad, y, strict=False)))
    return error


@pytest.mark.parametrize("friction", [1.0, 0.0], ids=["driven", "free"])
@pytest.mark.parametrize("count", [1, 4, 7])
def test_arm__other_numbers_of_links__second_order_too(count, friction):
    coarse, fine = (chain_error_rad(chain(count, dt, friction)) for dt in (250e-6, 125e-6))
    assert coarse < 1e-5
    assert 3.5 < coarse / fine < 4.5


@pytest.mark.parametrize("count", [4, 7])
def test_arm__more_links_under_a_sampled_controller__stay_within_the_bounds(count):
    settings = chain(count, 250e-6)
    arm, equations = Arm(settings), Chain(settings)
    y = np.array([*settings.q0_rad, *([0.0] * count)])
    gain = np.array([1.0 / (i + 1) for i in range(count)])
    target = 0.5 * np.array(settings.q0_rad)
    q_error = dq_error = 0.0
    for _ in range(500):
        q, dq = np.array(arm.q_rad), np.array(arm.dq_rad_s)
        arm.step((gain * (20.0 * (target - q) - 2.0 * dq)).tolist(), 1e-3)
        tau = gain * (20.0 * (target - y[:count]) - 2.0 * y[count:])
        y = equations.hold_torque(y, tau, 1e-3, 4)
        q_error = max(q_error, np.abs(arm.q_rad - y[:count]).max())
        dq_error = max(dq_error, np.abs(arm.dq_rad_s - y[count:]).max())
    assert q_error < 7 * CASES["pd"].bounds.q_rad
    assert dq_error < 7 * CASES["pd"].bounds.dq_rad_s


@pytest.mark.parametrize("count", [2, 4, 7])
def test_arm__horizontal_without_friction__energy_and_momentum_stay(count):
    settings = chain(count, 250e-6, 0.0).model_copy(update={"gravity_m_s2": 0.0})
    arm, equations = Arm(settings), Chain(settings)
    arm.reset(settings.q0_rad, [2.0 - 0.7 * i for i in range(count)])
    energy_J = arm.energy_J()
    momentum = equations.momentum_Nms((*arm.q_rad, *arm.dq_rad_s))
    for _ in range(200):
        arm.step([0.0] * count, 5e-3)
        assert arm.energy_J() == pytest.approx(energy_J, rel=5e-6)
        now = equations.momentum_Nms((*arm.q_rad, *arm.dq_rad_s))
        assert now == pytest.approx(momentum, rel=5e-6)
        assert arm.joint_separation_m() < 1e-6


@pytest.mark.parametrize("count", [4, 7])
def test_arm__more_links_swinging_freely__energy_stays(count):
    settings = chain(count, 250e-6, 0.0)
    arm = Arm(settings)
    start_J = arm.energy_J()
    rest_J = Chain(settings).energy_J([0.0] * 2 * count)
    for _ in range(100):
        arm.step([0.0] * count, 50e-3)
        assert abs(arm.energy_J() - start_J) < 7 * 1e-6 * (start_J - rest_J)


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
