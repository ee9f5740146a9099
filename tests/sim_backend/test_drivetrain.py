"""Drivetrains: contact, backlash against equations with events, energy, encoder side."""

import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_backend import chain
from sim_backend.arm import Arm
from sim_backend.drivetrain import Drivetrain
from sim_backend.errors import SimError
from sim_backend.perturbation import scaled, with_backlash
from sim_backend.presets import plant_preset
from sim_backend.settings import DrivetrainSettings, PlantSettings
from tests.sim_backend import wrong_drivetrains
from tests.sim_backend.closed_form import TwoLink
from tests.sim_backend.geared_form import GearedChain, solve_geared

EVERY_S = 500e-6
GEAR = DrivetrainSettings(
    rotor_inertia_kg_m2=0.005, gap_rad=0.01, viscous_Nms_rad=0.01, coulomb_Nm=0.02
)
SLICK = GEAR.model_copy(update={"viscous_Nms_rad": 0.0, "coulomb_Nm": 0.0})


def geared(preset: str, gear: DrivetrainSettings, joints: int, **changes: object) -> PlantSettings:
    """Return the first links of a preset, all hanging down, behind a drivetrain each."""
    plant = plant_preset(preset)
    links = [link.model_copy(update={"drivetrain": gear}) for link in plant.links[:joints]]
    return plant.model_copy(update={"links": tuple(links), "q0_rad": (0.0,) * joints, **changes})


@dataclass(frozen=True)
class Case:
    """A motion, and bounds on its errors at a substep of 100 us: link, rotor, energy."""

    plant: PlantSettings
    rotors_rad_s: Sequence[float]
    legs_Nm: Sequence[Sequence[float]]
    leg_s: float
    bounds: tuple[float, float, float]


def reversing(*torques_Nm: float, legs: int) -> list[list[float]]:
    """Torques that change sign every leg, every second leg, ..."""
    return [
        [torque * (-1) ** (leg // j) for j, torque in enumerate(torques_Nm, 1)]
        for leg in range(legs)
    ]


SOFT = DrivetrainSettings(
    rotor_inertia_kg_m2=0.005, gap_rad=0.0, stiffness_Nm_rad=500.0, damping_Nms_rad=0.2
)
CASES = {
    "bounce": Case(
        scaled(geared("bench_h", SLICK, 1), friction=0.0), [1.0], [[0.0]], 0.5, (5e-5, 5e-4, 5e-5)
    ),
    "one joint reversing": Case(
        geared("bench_v", GEAR, 1), [0.0], reversing(1.5, legs=8), 0.15, (1e-4, 2e-4, 3e-4)
    ),
    "two joints reversing": Case(
        geared("bench_v", GEAR, 2), [0.0] * 2, reversing(1.5, 0.4, legs=6), 0.15, (1e-4, 3e-4, 4e-4)
    ),
    "pelican reversing": Case(
        geared("pelican_v", GEAR, 2),
        [0.0] * 2,
        reversing(3.0, 0.4, legs=6),
        0.15,
        (2e-4, 3e-4, 6e-4),
    ),
    "no gap": Case(
        geared("bench_v", SOFT, 1), [0.0], reversing(1.5, legs=8), 0.15, (5e-6, 1e-5, 1e-5)
    ),
}


def start_of(case: Case) -> list[float]:
    joints = len(case.plant.links)
    return [*case.plant.q0_rad, *([0.0] * joints), *case.plant.q0_rad, *case.rotors_rad_s]


@cache
def truth(name: str) -> tuple[np.ndarray, int]:
    case = CASES[name]
    return solve_geared(GearedChain(case.plant), start_of(case), case.legs_Nm, case.leg_s, EVERY_S)


def measure(name: str, substep_s: float) -> tuple[float, float, float]:
    """Return the largest errors of link angles, rotor angles and energy."""
    case, equations = CASES[name], GearedChain(CASES[name].plant)
    n = equations.n
    arm = Arm(case.plant.model_copy(update={"substep_s": substep_s}))
    arm.reset(case.plant.q0_rad, dq_motor_rad_s=case.rotors_rad_s)
    per_leg = round(case.leg_s / EVERY_S)
    errors = np.zeros(3)
    for k, y in enumerate(truth(name)[0]):
        arm.step(case.legs_Nm[k // per_leg], EVERY_S)
        link = np.abs(np.subtract(arm.q_rad, y[:n])).max()
        rotor = np.abs(np.subtract(arm.q_motor_rad, y[2 * n : 3 * n])).max()
        energy = abs(arm.energy_J() - equations.energy_J(y))
        errors = np.maximum(errors, (link, rotor, energy))
    link, rotor, energy = errors.tolist()
    return link, rotor, energy


def is_within(errors: Sequence[float], bounds: Sequence[float], widening: float = 1.0) -> bool:
    return all(error < widening * bound for error, bound in zip(errors, bounds, strict=True))


@pytest.mark.parametrize(("substep_s", "widening"), [(100e-6, 1.0), (250e-6, 7.0)])
@pytest.mark.parametrize("name", CASES)
def test_drivetrain__every_case__stays_with_the_equations(name, substep_s, widening):
    errors = measure(name, substep_s)
    assert is_within(errors, CASES[name].bounds, widening), errors


@pytest.mark.parametrize(("name", "touches"), [("bounce", 9), ("two joints reversing", 50)])
def test_case__flanks_touch__often_enough_to_prove_something(name, touches):
    assert truth(name)[1] >= touches


@pytest.mark.parametrize("name", ["bounce", "one joint reversing", "no gap"])
def test_drivetrain__substep_halved__error_falls_to_a_quarter(name):
    coarse, fine = (measure(name, dt)[0] for dt in (125e-6, 62.5e-6))
    assert 3.2 < coarse / fine < 4.8


@pytest.mark.parametrize(
    ("name", "mistake"),
    [
        ("bounce", wrong_drivetrains.OneFlank),
        ("bounce", wrong_drivetrains.HalfTheGap),
        ("bounce", wrong_drivetrains.NoDamper),
        ("bounce", wrong_drivetrains.PullingDamper),
        ("bounce", wrong_drivetrains.LateTorque),
        ("one joint reversing", wrong_drivetrains.NoRotorFriction),
        ("one joint reversing", wrong_drivetrains.SampledContact),
    ],
)
def test_bounds__drivetrain_with_a_mistake__are_broken(monkeypatch, name, mistake):
    monkeypatch.setattr(chain, "Drivetrain", mistake)
    assert not is_within(measure(name, 100e-6), CASES[name].bounds)


def coast_rad() -> float:
    """Return where a rotor is that has coasted for 10 ms at 1 rad/s within a wide gap."""
    plant = scaled(geared("bench_h", SLICK.model_copy(update={"gap_rad": 0.1}), 1), friction=0.0)
    arm = Arm(plant)
    arm.reset((0.0,), None, (-0.02,), (1.0,))
    arm.step((0.0,), 10e-3)
    return arm.q_motor_rad[0]


def test_drivetrain__rotor_coasting_in_its_gap__is_where_it_must_be(monkeypatch):
    assert coast_rad() == pytest.approx(-0.01, abs=1e-12)
    monkeypatch.setattr(chain, "Drivetrain", wrong_drivetrains.ShiftedRotor)
    assert coast_rad() == pytest.approx(-0.01 + 125e-6, abs=1e-12)


# --- energy and momentum --------------------------------------------------------------------------


def most_energy(settings: PlantSettings, seed: int, duration_s: float) -> tuple[float, float]:
    """Let rotors and links clatter; return most and last energy over that of the start."""
    rng, joints = random.Random(seed), len(settings.links)
    arm = Arm(settings)
    arm.reset(
        [rng.uniform(-1, 1) for _ in range(joints)],
        [rng.uniform(-1, 1) for _ in range(joints)],
        None,
        [rng.uniform(-3, 3) for _ in range(joints)],
    )
    start_J = arm.energy_J()
    most_J = start_J
    for _ in range(round(duration_s / EVERY_S)):
        arm.step([0.0] * joints, EVERY_S)
        most_J = max(most_J, arm.energy_J())
    return most_J / start_J, arm.energy_J() / start_J


@pytest.mark.parametrize("damping_Nms_rad", [0.0, 0.02, 1.0])
@pytest.mark.parametrize(("preset", "joints"), [("bench_h", 1), ("bench_h", 2), ("light_h", 2)])
def test_drivetrain__clattering__energy_is_never_created(preset, joints, damping_Nms_rad):
    gear = SLICK.model_copy(update={"damping_Nms_rad": damping_Nms_rad})
    settings = scaled(geared(preset, gear, joints), friction=0.0)
    for seed in range(3):
        most, last = most_energy(settings, seed, 1.0)
        assert most < 1.0 + 1e-4
        if damping_Nms_rad == 0.0:
            assert last > 0.7  # what the method loses by itself, over hundreds of hits


def test_drivetrain__one_joint_without_damper__hundreds_of_hits_keep_the_energy():
    gear = SLICK.model_copy(update={"damping_Nms_rad": 0.0, "gap_rad": 0.005})
    settings = scaled(geared("bench_h", gear, 1), friction=0.0)
    assert most_energy(settings, 7, 2.0) == pytest.approx((1.0, 1.0), abs=1e-5)


@pytest.mark.parametrize("mistake", [wrong_drivetrains.SampledContact, wrong_drivetrains.LightLink])
def test_drivetrain__with_a_mistake__creates_energy(monkeypatch, mistake):
    gear = SLICK.model_copy(update={"damping_Nms_rad": 0.0, "gap_rad": 0.005})
    settings = scaled(geared("bench_h", gear, 1), friction=0.0)
    monkeypatch.setattr(chain, "Drivetrain", mistake)
    assert most_energy(settings, 7, 2.0)[0] > 1.0 + 1e-3


def test_drivetrain__elbow_clattering__momentum_about_the_shoulder_stays():
    base = scaled(plant_preset("bench_h"), friction=0.0)
    shoulder, elbow = base.links
    links = (shoulder, elbow.model_copy(update={"drivetrain": SLICK}))
    settings = base.model_copy(update={"links": links})
    arm, equations = Arm(settings), TwoLink(settings)
    arm.reset((0.3, 0.5), (1.0, -0.5), None, (0.0, 4.0))
    momentum = equations.momentum_Nms((*arm.q_rad, *arm.dq_rad_s))
    elbow_rad_s = arm.dq_rad_s[1]
    for _ in range(400):
        arm.step((0.0, 0.0), 1e-3)
        now = equations.momentum_Nms((*arm.q_rad, *arm.dq_rad_s))
        assert now == pytest.approx(momentum, abs=1e-6)
    assert abs(arm.dq_rad_s[1] - elbow_rad_s) > 0.1


flank_ends = st.floats(-0.02, 0.02)


@given(start=flank_ends, end=flank_ends)
def test_contact__any_line__is_passive(start, end):
    """The work done on the flanks is at least the change of what they store."""
    settings = SLICK.model_copy(update={"damping_Nms_rad": 2.0})
    drivetrain, substep_s = Drivetrain(settings, 50.0, 250e-6), 250e-6
    torque = drivetrain._contact_Nm(start, end, (end - start) / substep_s)

    def stored_J(twist: float) -> float:
        return 0.5 * settings.stiffness_Nm_rad * max(abs(twist) - 0.005, 0.0) ** 2

    assert torque * (end - start) >= stored_J(end) - stored_J(start) - 1e-9


@given(start=flank_ends, end=flank_ends)
def test_contact__any_line__is_the_mean_of_the_law_and_odd(start, end):
    drivetrain = Drivetrain(SLICK, 50.0, 250e-6)
    rate = (end - start) / 250e-6
    torque = drivetrain._contact_Nm(start, end, rate)
    assert drivetrain._contact_Nm(-start, -end, -rate) == -torque
    twists = start + (end - start) * (np.arange(4000) + 0.5) / 4000
    upper = np.where(twists > 0.005, np.maximum(1e4 * (twists - 0.005) + rate, 0.0), 0.0)
    lower = np.where(twists < -0.005, np.minimum(1e4 * (twists + 0.005) + rate, 0.0), 0.0)
    scale = abs(rate) + 300.0
    assert torque == pytest.approx(float(np.mean(upper + lower)), abs=scale / 1000)


# --- statics, read-out, settings ------------------------------------------------------------------


def test_drivetrain__load_held_against_gravity__sits_on_its_flank():
    arm = Arm(geared("bench_v", GEAR, 1, q0_rad=(0.5,)))
    for _ in range(6000):
        error, rate = 0.5 - arm.q_motor_rad[0], arm.dq_motor_rad_s[0]
        torque_Nm = 60.0 * error - 4.0 * rate
        arm.step((torque_Nm,), EVERY_S)
    twist = arm.q_motor_rad[0] - arm.q_rad[0]
    assert torque_Nm > 0.5
    assert twist == pytest.approx(0.005 + torque_Nm / GEAR.stiffness_Nm_rad, abs=1e-6)


def test_drivetrain__rotor_within_its_gap__link_knows_nothing():
    arm = Arm(geared("bench_h", GEAR.model_copy(update={"gap_rad": 0.4}), 2))
    arm.step((0.1, 0.0), 0.05)
    assert arm.q_motor_rad[0] > 0.01
    assert (arm.q_rad, arm.dq_rad_s) == ([0.0, 0.0], [0.0, 0.0])


def test_encoder__motor_or_link__reads_its_side():
    settings = geared("bench_h", GEAR, 2)
    shoulder, elbow = settings.links
    on_link = GEAR.model_copy(update={"encoder": "link"})
    links = (shoulder, elbow.model_copy(update={"drivetrain": on_link}))
    arm = Arm(settings.model_copy(update={"links": links}))
    arm.step((0.5, 0.5), 0.02)
    assert arm.encoder_motion() == (
        [arm.q_motor_rad[0], arm.q_rad[1]],
        [arm.dq_motor_rad_s[0], arm.dq_rad_s[1]],
    )
    assert arm.q_motor_rad[1] != arm.q_rad[1]


def test_direct_drive__motor_and_encoder__are_the_joint():
    arm = Arm(plant_preset("bench_h"))
    arm.step((0.5, 0.5), 0.02)
    assert not arm.has_drivetrain
    assert (arm.q_motor_rad, arm.dq_motor_rad_s) == (arm.q_rad, arm.dq_rad_s)
    assert arm.encoder_motion() == (arm.q_rad, arm.dq_rad_s)


def bits(arm: Arm) -> tuple[list[float], ...]:
    return arm.q_rad, arm.dq_rad_s, arm.q_motor_rad, arm.dq_motor_rad_s


def test_drivetrain__one_long_step_or_many_short_or_reset__same_bits():
    settings = geared("bench_v", GEAR, 2)
    long, short = Arm(settings), Arm(settings)
    long.step((0.8, 0.3), 0.2)
    for _ in range(400):
        short.step((0.8, 0.3), EVERY_S)
    assert bits(long) == bits(short)
    long.reset(settings.q0_rad)
    long.step((0.8, 0.3), 0.2)
    assert bits(long) == bits(short)


def test_drivetrain__held__keeps_its_place_in_the_gap():
    arm = Arm(geared("bench_v", GEAR, 2))
    arm.step((0.8, 0.3), 0.1)
    q_rad, q_motor_rad = arm.q_rad, arm.q_motor_rad
    arm.hold()
    arm.step((0.8, 0.3), 0.1)
    assert arm.q_rad == q_rad
    assert arm.q_motor_rad == pytest.approx(q_motor_rad, abs=1e-15)
    assert (arm.dq_rad_s, arm.dq_motor_rad_s) == ([0.0, 0.0], [0.0, 0.0])


@pytest.mark.parametrize(
    ("stiffness_Nm_rad", "parts"), [(1e3, 1), (1e4, 1), (1e5, 4), (1e6, 10), (1e7, 40)]
)
def test_arm__stiff_contact__is_followed_in_parts_of_a_substep(stiffness_Nm_rad, parts):
    gear = GEAR.model_copy(update={"stiffness_Nm_rad": stiffness_Nm_rad})
    arm = Arm(geared("bench_h", gear, 2))
    assert arm._substep_ns * parts == 250_000
    arm.step((0.5, 0.2), EVERY_S)
    assert arm.time_ns == 500_000


@pytest.mark.parametrize("change", [{"stiffness_Nm_rad": 1e9}, {"damping_Nms_rad": 1e4}])
def test_arm__contact_too_stiff__sim_error_with_figures(change):
    with pytest.raises(SimError, match=r"needs a substep of .* the limit is 6\.25 us"):
        Arm(geared("bench_h", GEAR.model_copy(update=change), 2))


@pytest.mark.parametrize("rotors", [(0.0,), (0.0, 0.0, 0.0)])
def test_reset__rotors_of_wrong_number__refused(rotors):
    arm = Arm(geared("bench_h", GEAR, 2))
    with pytest.raises(SimError, match="2 joints"):
        arm.reset((0.0, 0.0), None, rotors)


def run_limit_cycle(settings: PlantSettings, sense: Callable[[Arm], tuple[float, float]]) -> float:
    """Hold one joint by PD from its encoder; return how far the link still swings at the end."""
    arm = Arm(settings)
    swing = []
    for k in range(6000):
        q, dq = sense(arm)
        arm.step((20.0 * (0.3 - q) - 0.5 * dq,), EVERY_S)
        if k >= 4000:
            swing.append(arm.q_rad[0])
    return max(swing) - min(swing)


def test_backlash__loop_closed_over_the_link__swings_on_and_over_the_motor_does_not():
    plant = with_backlash(geared("bench_h", GEAR, 1), 0.02, "link")
    over_link = run_limit_cycle(plant, lambda arm: (arm.q_rad[0], arm.dq_rad_s[0]))
    over_motor = run_limit_cycle(plant, lambda arm: (arm.q_motor_rad[0], arm.dq_motor_rad_s[0]))
    assert over_link > 1e-3
    assert over_motor < 1e-6
