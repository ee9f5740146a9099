"""Joint stops: how far a joint goes beyond, and that nothing rebounds or tears."""

import random

import pytest

from sim_backend import chain as chain_module
from sim_backend.arm import Arm
from sim_backend.bodies import make_stops
from sim_backend.perturbation import with_backlash
from sim_backend.presets import plant_preset
from sim_backend.settings import PlantSettings
from tests.sim_backend.test_arm_accuracy import chain

STOP_RAD = 1.0


def stopped(plant: PlantSettings, low: float | None = -STOP_RAD, high: float | None = STOP_RAD):
    stops = {"q_min_rad": low, "q_max_rad": high}
    links = tuple(link.model_copy(update=stops) for link in plant.links)
    return plant.model_copy(update={"links": links})


def batter(settings: PlantSettings, steps: int) -> tuple[float, float, float]:
    """Throw the arm against its stops; return overshoot, that allowed, and joint separation."""
    arm, rng, count = Arm(settings), random.Random(3), len(settings.links)
    overshoot = fastest = separation = 0.0
    tau_Nm = [0.0] * count
    for k in range(steps):
        if k % 200 == 0:
            tau_Nm = [rng.uniform(-3.0, 3.0) / (i + 1) for i in range(count)]
        arm.step(tau_Nm, 500e-6)
        overshoot = max(overshoot, *(abs(q) - STOP_RAD for q in arm.q_rad))
        fastest = max(fastest, *(abs(dq) for dq in arm.dq_rad_s))
        separation = max(separation, arm.joint_separation_m())
    return overshoot, fastest * settings.substep_s, separation


@pytest.mark.parametrize("substep_s", [250e-6, 100e-6])
@pytest.mark.parametrize("preset", ["bench_h", "bench_v", "pelican_v", "light_h"])
def test_stop__battered__overshoot_is_within_one_substep(preset, substep_s):
    plant = plant_preset(preset, (0.1, -0.2)).model_copy(update={"substep_s": substep_s})
    overshoot, allowed, separation = batter(stopped(plant), 3000)
    assert 1e-5 < overshoot <= allowed
    assert separation < 1e-5


@pytest.mark.parametrize("count", [4, 7])
def test_stop__longer_chain_battered__overshoot_is_within_one_substep(count):
    overshoot, allowed, separation = batter(stopped(chain(count, 250e-6, 0.1)), 1500)
    assert 1e-5 < overshoot <= allowed
    assert separation < 1e-5


def hit(arm: Arm) -> float:
    """Run into a stop at 3 rad/s; return the lowest rate after that."""
    arm.reset((0.9, 0.0), (3.0, 0.0))
    energy_J, slowest = arm.energy_J(), 3.0
    for _ in range(300):
        arm.step((0.0, 0.0), 500e-6)
        slowest = min(slowest, arm.dq_rad_s[0])
        assert arm.energy_J() <= energy_J * (1.0 + 1e-6)
    return slowest


def test_stop__hit__takes_the_rate_and_does_not_rebound():
    arm = Arm(stopped(plant_preset("bench_h")))
    assert -0.05 < hit(arm) < 0.05
    assert arm.q_rad[0] == pytest.approx(STOP_RAD, abs=3.0 * 250e-6)


def test_stop__without_bias__rebounds(monkeypatch):
    def make_unbiased_stops(*arguments):
        stops = make_stops(*arguments)
        for stop in stops:
            stop.error_bias = 0.0
        return stops

    monkeypatch.setattr(chain_module, "make_stops", make_unbiased_stops)
    assert hit(Arm(stopped(plant_preset("bench_h")))) < -1.0


def test_stop__pressed__holds_the_torque():
    arm = Arm(stopped(plant_preset("bench_h")))
    for _ in range(4000):
        arm.step((5.0, 2.0), 500e-6)
    assert arm.q_rad == pytest.approx([STOP_RAD, STOP_RAD], abs=2e-3)
    assert arm.dq_rad_s == pytest.approx([0.0, 0.0], abs=1e-3)


def test_stop__on_one_side_only__other_side_is_free():
    for low, high, torque_Nm in ((None, 0.2, -1.0), (-0.2, None, 1.0)):
        arm = Arm(stopped(plant_preset("bench_h"), low, high))
        arm.step((torque_Nm, 0.0), 0.5)
        assert abs(arm.q_rad[0]) > 0.5
        arm.reset((0.0, 0.0))
        arm.step((-torque_Nm, 0.0), 0.5)
        assert abs(arm.q_rad[0]) < 0.21


def test_stop__out_of_reach__same_motion_as_without():
    plant = plant_preset("pelican_v", (0.4, -0.5))
    free, fenced = Arm(plant), Arm(stopped(plant, -3.0, 3.0))
    for arm in (free, fenced):
        arm.step((0.5, 0.1), 1.0)
    assert fenced.q_rad == pytest.approx(free.q_rad, abs=1e-9)


def test_stop__with_drivetrain__stops_the_link():
    arm = Arm(stopped(with_backlash(plant_preset("bench_h"), 0.02)))
    for _ in range(4000):
        arm.step((2.0, 0.5), 500e-6)
    assert arm.q_rad == pytest.approx([STOP_RAD, STOP_RAD], abs=2e-3)
    assert arm.q_motor_rad[0] == pytest.approx(STOP_RAD + 0.01 + 2.0 / 1e4, abs=1e-3)
