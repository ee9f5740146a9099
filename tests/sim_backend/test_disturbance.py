"""Disturbance torques: their exact mean, their schedule, and what they do to the arm."""

from math import inf, pi, sin, tau

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_backend.arm import Arm
from sim_backend.disturbance import Disturbances
from sim_backend.errors import PlantError, SimError
from sim_backend.perturbation import with_backlash, with_load_step
from sim_backend.presets import plant_preset
from sim_backend.settings import DisturbanceSettings, PlantSettings
from tests.sim_backend.closed_form import TwoLink, solve, whole_ms

REST = (0.0, 0.0)


def sine(joint: int, torque_Nm: float, pulsation: float, **more: float) -> DisturbanceSettings:
    return DisturbanceSettings(
        joint=joint, kind="sine", torque_Nm=torque_Nm, frequency_Hz=pulsation / tau, **more
    )


def pelican(*disturbances: DisturbanceSettings, **changes: object) -> PlantSettings:
    base = plant_preset("pelican_v").model_dump()
    return PlantSettings.model_validate({**base, "disturbances": disturbances, **changes})


def value_Nm(each: DisturbanceSettings, t_s: np.ndarray) -> np.ndarray:
    is_on = (t_s >= each.start_s) & (t_s < (inf if each.end_s is None else each.end_s))
    shape = 1.0
    if each.kind == "sine":
        shape = np.sin(tau * each.frequency_Hz * (t_s - each.start_s))
    return np.where(is_on, each.torque_Nm * shape, 0.0)


spans = st.tuples(st.floats(0.0, 2.0), st.none() | st.floats(0.01, 1.0))
schedules = st.lists(
    st.builds(
        lambda joint, torque, frequency, span: DisturbanceSettings(
            joint=joint,
            kind="sine" if frequency else "constant",
            torque_Nm=torque,
            frequency_Hz=frequency,
            start_s=span[0],
            end_s=None if span[1] is None else span[0] + span[1],
        ),
        st.integers(1, 2),
        st.floats(-5.0, 5.0),
        st.none() | st.floats(0.1, 20.0),
        spans,
    ),
    max_size=4,
)


@given(schedule=schedules, from_ms=st.integers(0, 3000), length_ms=st.integers(1, 200))
def test_mean__any_schedule__is_the_integral_over_the_interval(schedule, from_ms, length_ms):
    mean_Nm = Disturbances(schedule, 2).mean_Nm(
        from_ms * 1_000_000, (from_ms + length_ms) * 1_000_000
    )
    middles_s = 1e-3 * (from_ms + length_ms * (np.arange(4000) + 0.5) / 4000)
    for joint in (1, 2):
        torques = [value_Nm(each, middles_s) for each in schedule if each.joint == joint]
        expected = float(np.mean(sum(torques))) if torques else 0.0
        assert mean_Nm[joint - 1] == pytest.approx(expected, abs=4 * 5.0 / 4000 * 2)


@given(schedule=schedules, now_ms=st.integers(0, 3000), share=st.floats(0.0, 1.0))
def test_steady_until__anywhere_before__same_torques(schedule, now_ms, share):
    disturbances, now_ns = Disturbances(schedule, 2), now_ms * 1_000_000
    until_ns = min(disturbances.steady_until_ns(now_ns), now_ns + 10**10)
    length_ns = until_ns - now_ns
    if length_ns >= 10:
        first = disturbances.mean_Nm(now_ns, now_ns + length_ns // 10)
        start_ns = now_ns + int(share * 0.9 * length_ns)
        assert disturbances.mean_Nm(start_ns, start_ns + length_ns // 10) == pytest.approx(first)


@pytest.mark.parametrize(("substep_s", "bound"), [(100e-6, 5e-5), (250e-6, 3.5e-4)])
def test_arm__sines_on_both_joints__moves_as_the_equations(substep_s, bound):
    settings = pelican(sine(1, 4.0, 3.0), sine(2, 1.0, 5.0), substep_s=substep_s)
    arm = Arm(settings)
    torque = lambda t, _y: (4.0 * sin(3.0 * t), sin(5.0 * t))  # noqa: E731
    for y in solve(TwoLink(settings), (0.0,) * 4, whole_ms(5.0, 10), torque):
        arm.step(REST, 10e-3)
        assert [*arm.q_rad] == pytest.approx(y[:2], abs=bound)


def test_arm__load_step_and_its_end_off_the_substeps__moves_as_the_equations():
    start_s, end_s = 0.100123, 0.900071
    settings = with_load_step(pelican(substep_s=100e-6), 1, 2.0, start_s, end_s)
    plant = TwoLink(settings)
    arm = Arm(settings)
    at_end = solve(plant, (0.0,) * 4, [end_s - start_s], lambda _t, _y: (2.0, 0.0))[-1]
    (after,) = solve(plant, at_end, [1.2 - end_s], lambda _t, _y: REST)
    arm.step(REST, 0.1)
    assert arm.dq_rad_s == pytest.approx([0.0, 0.0], abs=1e-12)
    arm.step(REST, 1.1)
    assert [*arm.q_rad, *arm.dq_rad_s] == pytest.approx(after, abs=2e-5)


def test_arm__disturbance_on_the_elbow__reacts_on_the_upper_arm():
    base = plant_preset("bench_h")
    slick = {"viscous_Nms_rad": 0.0, "coulomb_Nm": 0.0}
    links = tuple(link.model_copy(update=slick) for link in base.links)
    settings = base.model_copy(
        update={"links": links, "disturbances": (sine(2, 0.3, 4.0), sine(2, 0.1, 9.0))}
    )
    arm, plant = Arm(settings), TwoLink(settings)
    for _ in range(100):
        arm.step(REST, 5e-3)
        assert plant.momentum_Nms((*arm.q_rad, *arm.dq_rad_s)) == pytest.approx(0.0, abs=1e-6)
    assert arm.dq_rad_s[0] < -0.1


def state(arm: Arm) -> tuple[list[float], list[float], int]:
    return arm.q_rad, arm.dq_rad_s, arm.time_ns


def test_arm__one_long_step_or_many_short__same_bits():
    settings = pelican(
        sine(1, 1.0, 7.0, start_s=0.05, end_s=0.21), DisturbanceSettings(joint=2, torque_Nm=0.2)
    )
    long, short = Arm(settings), Arm(settings)
    long.step((0.5, 0.1), 0.4)
    for _ in range(800):
        short.step((0.5, 0.1), 500e-6)
    assert state(long) == state(short)
    long.reset(settings.q0_rad)
    long.step((0.5, 0.1), 0.4)
    assert state(long) == state(short)


def test_arm__disturbed_by_call__as_by_schedule():
    scheduled = Arm(with_load_step(pelican(), 2, 0.4, 0.1, 0.3))
    called = Arm(pelican())
    scheduled.step((0.5, 0.0), 0.5)
    called.step((0.5, 0.0), 0.1)
    called.disturb((0.0, 0.4))
    called.step((0.5, 0.0), 0.2)
    called.disturb((0.0, 0.0))
    called.step((0.5, 0.0), 0.2)
    assert called.q_rad == pytest.approx(scheduled.q_rad, abs=1e-12)
    assert called.q_rad != pytest.approx(run_undisturbed(0.5).q_rad, abs=1e-3)


def run_undisturbed(duration_s: float) -> Arm:
    arm = Arm(pelican())
    arm.step((0.5, 0.0), duration_s)
    return arm


def test_arm__reset__forgets_the_torque_applied_by_call():
    arm = Arm(pelican())
    arm.disturb((3.0, 0.0))
    arm.step(REST, 0.1)
    arm.reset(REST)
    arm.step((0.5, 0.0), 0.5)
    assert state(arm) == state(run_undisturbed(0.5))


def test_arm__held__schedule_waits():
    settings = with_load_step(pelican(), 1, 1.0, 0.1)
    held, free = Arm(settings), Arm(settings)
    held.step(REST, 0.05)
    held.hold()
    held.step(REST, 0.7)
    held.release()
    held.step(REST, 0.25)
    free.step(REST, 0.3)
    assert held.time_ns == 1_000_000_000
    assert held.q_rad == pytest.approx(free.q_rad, abs=1e-9)
    assert held.q_rad[0] > 1e-3


def test_arm__drivetrain__disturbance_acts_on_the_link_not_on_the_rotor():
    settings = with_load_step(with_backlash(plant_preset("bench_h"), 0.2), 1, 0.5, 0.0)
    arm = Arm(settings)
    arm.step(REST, 0.02)
    assert arm.q_motor_rad == [0.0, 0.0]
    assert arm.q_rad[0] > 1e-4


@pytest.mark.parametrize(
    ("torques", "error", "message"),
    [((0.0,), SimError, "takes 2 torques"), ((inf, 0.0), PlantError, "not finite")],
)
def test_disturb__not_fitting__refused_and_unchanged(torques, error, message):
    arm = Arm(pelican())
    with pytest.raises(error, match=message):
        arm.disturb(torques)
    arm.step((0.5, 0.0), 0.5)
    assert state(arm) == state(run_undisturbed(0.5))


def test_sine__whole_periods__leaves_no_mean():
    disturbances = Disturbances([sine(1, 3.0, 2.0 * pi)], 1)
    assert disturbances.mean_Nm(0, 3_000_000_000) == pytest.approx([0.0], abs=1e-12)
    assert disturbances.mean_Nm(0, 500_000_000) == pytest.approx([3.0 * 2.0 / pi])
