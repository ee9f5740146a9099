"""The simulated arm: conservation, determinism, holding, and loud failure."""

import os
import subprocess
import sys
from collections.abc import Sequence
from math import cos, inf, nan, pi
from pathlib import Path

import pytest

from sim_backend.arm import Arm
from sim_backend.errors import PlantError, SimError
from sim_backend.presets import plant_preset
from sim_backend.settings import LinkSettings, PlantSettings

ROOT = Path(__file__).parents[2]


def bench(**changes: object) -> PlantSettings:
    return plant_preset("bench_v", (0.4, -0.5)).model_copy(update=changes)


def slick(preset: str) -> PlantSettings:
    settings = plant_preset(preset, (0.3, 0.8))
    free = {"viscous_Nms_rad": 0.0, "coulomb_Nm": 0.0}
    links = tuple(link.model_copy(update=free) for link in settings.links)
    return settings.model_copy(update={"links": links})


def push(arm: Arm, steps: int = 400) -> list[str]:
    """Drive the arm about and return every bit of every state."""
    bits = []
    for k in range(steps):
        arm.step((1.5 - 0.01 * k, 0.7 * (-1) ** k), 500e-6)
        bits.extend(value.hex() for value in (*arm.q_rad, *arm.dq_rad_s))
    return bits


def run(arm: Arm, tau_Nm: Sequence[float]) -> None:
    """Advance by one second in periods of 1 ms."""
    for _ in range(1000):
        arm.step(tau_Nm, 1e-3)


def test_arm__no_gravity_no_friction__conserves_energy_and_momentum():
    arm = Arm(slick("bench_h"))
    arm.reset((0.3, 0.8), (5.0, -3.0))
    energy_J = arm.energy_J()
    momentum = momentum_Nms(arm)
    assert energy_J > 0.5
    for _ in range(2000):
        arm.step((0.0, 0.0), 1e-3)
        assert arm.energy_J() == pytest.approx(energy_J, rel=1e-5)
        assert momentum_Nms(arm) == pytest.approx(momentum, rel=1e-5)


def momentum_Nms(arm: Arm) -> float:
    """Angular momentum about the shoulder, from the manipulator's inertia matrix."""
    a, b = arm.settings.links
    c = a.length_m * b.com_m * cos(arm.q_rad[1])
    h11 = a.inertia_kg_m2 + a.mass_kg * a.com_m**2 + b.inertia_kg_m2
    h11 += b.mass_kg * (a.length_m**2 + b.com_m**2 + 2.0 * c)
    h12 = b.inertia_kg_m2 + b.mass_kg * (b.com_m**2 + c)
    return h11 * arm.dq_rad_s[0] + h12 * arm.dq_rad_s[1]


def test_arm__torque_without_gravity__turns_the_positive_way():
    arm = Arm(plant_preset("bench_h"))
    arm.step((1.0, 0.0), 10e-3)
    assert arm.dq_rad_s[0] > 0.0
    arm.reset((0.0, 0.0))
    arm.step((0.0, 1.0), 10e-3)
    assert arm.dq_rad_s[1] > 0.0
    assert arm.dq_rad_s[0] < 0.0  # the reaction


def test_arm__vertical_and_displaced__falls_towards_the_downward_vertical():
    arm = Arm(bench(q0_rad=(0.3, 0.0)))
    arm.step((0.0, 0.0), 10e-3)
    assert arm.q_rad[0] < 0.3


def test_arm__friction_alone__brings_it_to_rest():
    arm = Arm(plant_preset("bench_h"))
    arm.reset((0.0, 0.0), (2.0, -1.0))
    arm.step((0.0, 0.0), 20.0)
    assert max(abs(rate) for rate in arm.dq_rad_s) < 1e-3


@pytest.mark.parametrize("turns", [0, 3, -2])
def test_arm__whole_turns_added_to_the_pose__same_motion(turns):
    arm, turned = Arm(bench()), Arm(bench())
    turned.reset((0.4 + 2.0 * pi * turns, -0.5))
    arm.step((0.3, 0.1), 0.2)
    turned.step((0.3, 0.1), 0.2)
    assert turned.q_rad[0] - 2.0 * pi * turns == pytest.approx(arm.q_rad[0], abs=1e-12)
    assert turned.q_rad[1] == pytest.approx(arm.q_rad[1], abs=1e-12)


def test_arm__two_alike__same_bits():
    first, second = Arm(bench()), Arm(bench())
    assert push(first) == push(second)
    first.reset((0.4, -0.5))
    assert push(first) == push(Arm(bench()))


def test_arm__another_process_and_hash_seed__same_bits():
    program = "from tests.sim_backend.test_arm import *; print(*push(Arm(bench())), sep='\\n')"
    environment = {**os.environ, "PYTHONHASHSEED": "4711", "PYTHONPATH": str(ROOT)}
    answer = subprocess.run(
        [sys.executable, "-c", program],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    assert answer.stdout.split() == push(Arm(bench()))


def test_arm__two_links_by_the_general_path__same_bits():
    arm = Arm(bench())
    arm._advance, arm._read_out = arm._advance_chain, arm._read_chain
    assert push(arm) == push(Arm(bench()))


@pytest.mark.parametrize("preset", ["bench_v", "pelican_h", "light_v"])
def test_arm__all_options_off_by_the_way_that_has_them__same_motion(preset):
    plain, optional = (Arm(plant_preset(preset, (0.4, -0.5))) for _ in range(2))
    optional._advance = optional._advance_optional
    for k in range(400):
        for arm in (plain, optional):
            arm.step((1.5 - 0.01 * k, 0.7 * (-1) ** k), 500e-6)
    assert optional.q_rad == pytest.approx(plain.q_rad, abs=1e-10)
    assert optional.dq_rad_s == pytest.approx(plain.dq_rad_s, abs=1e-9)


def test_arm__one_long_step_or_many_short__same_bits():
    long, short = Arm(bench()), Arm(bench())
    long.step((0.5, 0.2), 0.1)
    for _ in range(200):
        short.step((0.5, 0.2), 500e-6)
    assert (long.q_rad, long.dq_rad_s, long.time_ns) == (short.q_rad, short.dq_rad_s, short.time_ns)
    assert long.time_ns == 100_000_000


def test_arm__step__leaves_the_lists_read_before_alone():
    arm = Arm(bench())
    q, dq = arm.q_rad, arm.dq_rad_s
    arm.step((1.0, 0.0), 1e-3)
    assert (q, dq) == ([0.4, -0.5], [0.0, 0.0])
    assert (arm.q_rad, arm.dq_rad_s) != (q, dq)


def test_arm__reset__reads_back_exactly():
    arm = Arm(bench())
    arm.step((1.0, 0.0), 0.1)
    arm.reset((1.0, -2.0), (3.0, 4.0))
    assert (arm.q_rad, arm.dq_rad_s, arm.time_ns) == ([1.0, -2.0], [3.0, 4.0], 0)


def test_arm__held__stands_still_while_time_goes_on():
    arm = Arm(bench())
    arm.step((0.0, 0.0), 50e-3)
    arm.hold()
    pose = arm.q_rad
    arm.step((10.0, 5.0), 50e-3)
    assert arm.is_held
    assert (arm.q_rad, arm.dq_rad_s, arm.time_ns) == (pose, [0.0, 0.0], 100_000_000)
    arm.release()
    arm.step((0.0, 0.0), 50e-3)
    assert arm.q_rad != pose
    assert arm.time_ns == 150_000_000


@pytest.mark.parametrize("torque", [(nan, 0.0), (0.0, nan), (inf, 0.0), (inf, -inf)])
def test_arm__torque_not_finite__plant_error_and_nothing_moved(torque):
    arm = Arm(bench())
    arm.step((0.1, 0.1), 1e-3)
    before = (arm.q_rad, arm.dq_rad_s, arm.time_ns)
    with pytest.raises(PlantError, match=r"torque is not finite at t = 0\.001000 s"):
        arm.step(torque, 1e-3)
    assert (arm.q_rad, arm.dq_rad_s, arm.time_ns) == before
    arm.step((0.1, 0.1), 1e-3)


@pytest.mark.parametrize("torque_Nm", [1e4, 1e12, 1e100, 1e300, 1.7e308])
def test_arm__torn_apart__plant_error_with_figures_and_reset_heals(torque_Nm):
    arm = Arm(bench())
    with pytest.raises(PlantError, match=r"came apart at t = .* \(limit 0\.001 m\).* q_rad="):
        run(arm, (torque_Nm, -torque_Nm))
    arm.reset((0.4, -0.5))
    assert push(arm) == push(Arm(bench()))


def test_arm__too_few_iterations_for_a_long_chain__plant_error():
    link = LinkSettings(length_m=0.2, com_m=0.1, mass_kg=1.0, inertia_kg_m2=0.01)
    pose = tuple(0.4 - 0.15 * i for i in range(12))
    arm = Arm(PlantSettings(links=(link,) * 12, gravity_m_s2=9.81, q0_rad=pose))
    arm._space.iterations = 10
    with pytest.raises(PlantError, match="came apart"):
        run(arm, [0.3 - 0.05 * i for i in range(12)])


@pytest.mark.parametrize("duration_s", [0.0, -1e-3, 300e-6, 1e-9, nan, inf])
def test_arm__duration_not_whole_substeps__sim_error(duration_s):
    with pytest.raises(SimError, match="whole number of substeps"):
        Arm(bench()).step((0.0, 0.0), duration_s)


@pytest.mark.parametrize("torques", [(), (0.0,), (0.0, 0.0, 0.0)])
def test_arm__wrong_number_of_torques__sim_error(torques):
    with pytest.raises(SimError, match="takes 2 torques"):
        Arm(bench()).step(torques, 1e-3)


def test_arm__pose_of_wrong_length_or_not_finite__refused_and_unchanged():
    arm = Arm(bench())
    with pytest.raises(SimError, match="2 joints"):
        arm.reset((0.0,))
    with pytest.raises(PlantError, match="not finite"):
        arm.reset((0.0, nan))
    with pytest.raises(PlantError, match="not finite"):
        arm.reset((0.0, 0.0), (inf, 0.0))
    assert push(arm) == push(Arm(bench()))
    with pytest.raises(SimError, match="2 joints"):
        Arm(bench(q0_rad=(0.0, 0.0, 0.0)))


@pytest.mark.parametrize("substep_s", [300e-6, 1e-3, 1e-12, 33.3333e-6])
def test_arm__substep_does_not_divide_the_current_loop__sim_error(substep_s):
    with pytest.raises(SimError, match="does not divide"):
        Arm(bench(substep_s=substep_s))


def test_arm__friction_too_steep_for_the_substep__sim_error_names_the_joint():
    with pytest.raises(SimError, match=r"friction of joint 1 .* limit 1"):
        Arm(bench(tanh_slope_s_rad=5000.0))
