"""Payloads: picked up moving and at rest, dropped, against the equations with a point mass."""

from math import cos

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_backend import arm as arm_module
from sim_backend.arm import Arm
from sim_backend.errors import SimError
from sim_backend.linkage import chain_energy_J, mass_matrix, outstretched_inertias_kg_m2
from sim_backend.payload import laden, rates_after_catch
from sim_backend.perturbation import with_backlash, with_payload
from sim_backend.presets import plant_preset
from sim_backend.settings import PayloadSettings, PlantSettings
from tests.sim_backend.closed_form import Chain, Motion, TwoLink, no_torque, solve, whole_ms
from tests.sim_backend.test_arm_accuracy import chain

REST = (0.0, 0.0)
OBJECT = PayloadSettings(mass_kg=0.8, inertia_kg_m2=0.003)
RESTING = OBJECT.model_copy(update={"is_at_rest": True})
PICK_S = 0.6


class LadenTwoLink(TwoLink):
    """Two links with an object fixed at the tip, its terms added to the written-out equations."""

    def __init__(self, settings: PlantSettings, payload: PayloadSettings) -> None:
        super().__init__(settings)
        a, b = (link.length_m for link in settings.links)
        mass, inertia, g = payload.mass_kg, payload.inertia_kg_m2, settings.gravity_m_s2
        self.h11 += inertia + mass * (a**2 + b**2)
        self.h22 += inertia + mass * b**2
        self.coupling += mass * a * b
        self.g1 += g * mass * a
        self.g2 += g * mass * b


def inertia_matrix(plant: TwoLink, y: Motion) -> np.ndarray:
    h12 = plant.h22 + plant.coupling * cos(y[1])
    return np.array([[plant.h11 + 2.0 * plant.coupling * cos(y[1]), h12], [h12, plant.h22]])


def swing(preset: str = "pelican_v", **changes: object) -> PlantSettings:
    return plant_preset(preset, (0.5, 0.3)).model_copy(update=changes)


def error_after(
    settings: PlantSettings, payload: PayloadSettings, *, is_drop: bool = False
) -> float:
    """Largest angle error in the second after a pick-up (or drop) at 0.6 s, against the equations.

    Before it the equations are solved as well, so that the error of the swing itself is in it.
    """
    empty, full = TwoLink(settings), LadenTwoLink(settings, payload)
    before, after = (full, empty) if is_drop else (empty, full)
    y = solve(before, (*settings.q0_rad, *REST), [PICK_S], no_torque)[-1]
    if payload.is_at_rest:
        y[2:] = np.linalg.solve(inertia_matrix(full, y), inertia_matrix(empty, y) @ y[2:])
    times = {"pick_s": 0.0, "drop_s": PICK_S} if is_drop else {"pick_s": PICK_S}
    arm = Arm(settings.model_copy(update={"payloads": (payload.model_copy(update=times),)}))
    arm.step(REST, PICK_S)
    error = 0.0
    for row in solve(after, y, whole_ms(1.0, 2), no_torque):
        arm.step(REST, 2e-3)
        error = max(error, *np.abs(np.subtract(arm.q_rad, row[:2])))
    return error


@pytest.mark.parametrize(("substep_s", "bound"), [(100e-6, 1.2e-6), (250e-6, 8e-6)])
@pytest.mark.parametrize("preset", ["pelican_v", "bench_v"])
@pytest.mark.parametrize("payload", [OBJECT, RESTING], ids=["moving", "resting"])
def test_payload__picked_up_in_mid_swing__stays_with_the_equations(
    preset, payload, substep_s, bound
):
    assert error_after(swing(preset, substep_s=substep_s), payload) < bound


@pytest.mark.parametrize(("substep_s", "bound"), [(100e-6, 1.2e-6), (250e-6, 8e-6)])
def test_payload__dropped_in_mid_swing__stays_with_the_equations(substep_s, bound):
    assert error_after(swing(substep_s=substep_s), OBJECT, is_drop=True) < bound


def keep_rates(_before, _after, _q_rad, dq_rad_s):
    return list(dq_rad_s)


def swap_matrices(before, after, q_rad, dq_rad_s):
    return rates_after_catch(after, before, q_rad, dq_rad_s)


def forget_inertia(link, payloads):
    return laden(link, [each.model_copy(update={"inertia_kg_m2": 0.0}) for each in payloads])


def keep_centre(link, payloads):
    return laden(link, payloads).model_copy(update={"com_m": link.com_m})


@pytest.mark.parametrize(
    ("name", "mistake", "payload"),
    [
        ("rates_after_catch", keep_rates, RESTING),
        ("rates_after_catch", swap_matrices, RESTING),
        ("laden", forget_inertia, OBJECT),
        ("laden", keep_centre, OBJECT),
    ],
)
def test_bounds__pick_up_with_a_mistake__are_broken(monkeypatch, name, mistake, payload):
    monkeypatch.setattr(arm_module, name, mistake)
    assert error_after(swing(), payload) > 1e-3


class RawPositions(Arm):
    """Puts the laden links down without stepping back by half a substep."""

    def _drift(self, dt_s):
        if not self.payloads:
            super()._drift(dt_s)


def test_bounds__payload_put_down_off_the_leapfrog__are_broken(monkeypatch):
    monkeypatch.setattr(f"{__name__}.Arm", RawPositions)
    assert error_after(swing(), OBJECT) > 5e-5


@pytest.mark.parametrize("count", [2, 4, 7])
def test_payload__resting_caught_by_a_longer_chain__keeps_every_generalised_momentum(count):
    settings = chain(count, 250e-6, 0.0)
    arm, equations = Arm(settings), Chain(settings)
    arm.reset(settings.q0_rad, [2.0 - 0.7 * i for i in range(count)])
    arm.step([0.0] * count, 0.05)
    q, before = arm.q_rad, np.array(arm.dq_rad_s)
    momentum = mass_matrix(settings.links, q) @ before
    arm.pick_up(RESTING)
    after = np.array(arm.dq_rad_s)
    laden_matrix = mass_matrix(arm._links, q)
    assert arm.q_rad == q
    assert laden_matrix @ after == pytest.approx(momentum, rel=1e-12)
    assert momentum[0] == pytest.approx(equations.momentum_Nms((*q, *before)), rel=1e-9)
    assert after @ laden_matrix @ after < before @ momentum - 1e-3  # a plastic catch loses energy


def test_payload__moving_with_the_hand__no_jump_and_its_energy_comes_on_top():
    settings = swing("bench_h")
    arm = Arm(settings)
    arm.reset((0.5, 0.3), (2.0, -1.0))
    arm.step(REST, 0.1)
    q, dq, energy_J = arm.q_rad, arm.dq_rad_s, arm.energy_J()
    arm.pick_up(OBJECT)
    assert (arm.q_rad, arm.dq_rad_s) == (q, dq)
    full = LadenTwoLink(settings, OBJECT)
    expected_J = energy_J + full.energy_J((*q, *dq)) - TwoLink(settings).energy_J((*q, *dq))
    assert arm.energy_J() == pytest.approx(expected_J, rel=1e-12)
    assert expected_J > energy_J + 1e-3
    arm.drop(OBJECT)
    assert arm.energy_J() == pytest.approx(energy_J, rel=1e-12)


def state(arm: Arm) -> tuple[object, ...]:
    return arm.q_rad, arm.dq_rad_s, arm.time_ns, arm.payloads


def test_payload__from_the_start__is_an_arm_with_that_link():
    settings = with_payload(swing(), 0.5, inertia_kg_m2=0.002)
    carried, (shoulder, last) = Arm(settings), settings.links
    links = (shoulder, laden(last, settings.payloads))
    heavy = Arm(settings.model_copy(update={"links": links, "payloads": ()}))
    for arm in (carried, heavy):
        arm.step((0.4, 0.1), 0.3)
    assert (carried.q_rad, carried.dq_rad_s) == (heavy.q_rad, heavy.dq_rad_s)
    assert carried.payloads[0].mass_kg == 0.5 * last.mass_kg


@pytest.mark.parametrize("payload", [OBJECT, RESTING])
def test_payload__by_schedule_or_by_call__same_bits(payload):
    timed = payload.model_copy(update={"pick_s": 0.2, "drop_s": 0.4})
    scheduled, called = Arm(swing(payloads=(timed,))), Arm(swing())
    scheduled.step(REST, 0.6)
    for act in (lambda: called.pick_up(payload), lambda: called.drop(payload), lambda: None):
        called.step(REST, 0.2)
        act()
    assert state(scheduled) == state(called)


def test_payload__one_long_step_or_many_short_or_reset__same_bits():
    settings = swing(payloads=(RESTING.model_copy(update={"pick_s": 0.1003, "drop_s": 0.25}),))
    long, short = Arm(settings), Arm(settings)
    long.step((0.4, 0.1), 0.4)
    for _ in range(800):
        short.step((0.4, 0.1), 500e-6)
    assert state(long) == state(short)
    long.reset(settings.q0_rad)
    long.step((0.4, 0.1), 0.4)
    assert state(long) == state(short)


def test_payload__schedule_over__arm_moves_on_the_short_way():
    timed = OBJECT.model_copy(update={"pick_s": 0.1, "drop_s": 0.2})
    arm = Arm(swing(payloads=(timed,)))
    assert arm._advance == arm._advance_by_schedule
    arm.step(REST, 0.3)
    assert arm._advance == arm._advance_two


def test_payload__time_between_substeps__at_the_nearest():
    for pick_s, steps in ((0.100124, 400), (0.100126, 401)):
        arm = Arm(swing(payloads=(OBJECT.model_copy(update={"pick_s": pick_s}),)))
        arm.step(REST, steps * 250e-6)
        assert arm.payloads == ()
        arm.step(REST, 250e-6)
        assert len(arm.payloads) == 1


def test_payload__several__add_up_and_go_one_by_one():
    settings = swing(payloads=(OBJECT, OBJECT, RESTING.model_copy(update={"pick_s": 0.1})))
    arm = Arm(settings)
    assert arm.payloads == (OBJECT, OBJECT)
    arm.step(REST, 0.2)
    assert sum(each.mass_kg for each in arm.payloads) == pytest.approx(2.4)
    arm.drop(OBJECT)
    assert sum(each.mass_kg for each in arm.payloads) == pytest.approx(1.6)
    arm.reset(settings.q0_rad)
    assert arm.payloads == (OBJECT, OBJECT)


def test_payload__held_arm__schedule_waits_and_object_stays():
    timed = OBJECT.model_copy(update={"pick_s": 0.1})
    arm = Arm(swing(payloads=(timed,)))
    arm.hold()
    arm.step(REST, 1.0)
    assert arm.payloads == ()
    arm.release()
    arm.step(REST, 0.2)
    assert arm.payloads == (timed,)
    arm.hold()
    arm.release()
    arm.step(REST, 0.2)
    assert arm.payloads == (timed,)


def test_payload__dropped_by_call_before_its_time__schedule_goes_on():
    timed = OBJECT.model_copy(update={"drop_s": 0.2})
    arm = Arm(swing(payloads=(timed,)))
    arm.step(REST, 0.1)
    arm.drop(timed)
    arm.step(REST, 0.2)
    assert arm.payloads == ()


def test_drop__not_carried__sim_error_and_unchanged():
    arm = Arm(swing(payloads=(OBJECT,)))
    with pytest.raises(SimError, match=r"cannot drop 0\.8 kg"):
        arm.drop(RESTING)
    assert arm.payloads == (OBJECT,)


def test_payload__with_drivetrains__rotors_feel_no_jolt():
    arm = Arm(with_backlash(swing("bench_v"), 0.01))
    arm.step((0.5, 0.1), 0.3)
    rotors, links = arm.dq_motor_rad_s, arm.dq_rad_s
    arm.pick_up(RESTING)
    assert arm.dq_motor_rad_s == rotors
    assert arm.dq_rad_s != links
    energy_J = arm.energy_J()
    arm.step((0.0, 0.0), 0.5)
    assert arm.energy_J() < energy_J


angles = st.lists(st.floats(-3.0, 3.0), min_size=4, max_size=4)


@given(q=angles, dq=angles)
def test_mass_matrix__any_motion__gives_the_kinetic_energy_of_the_bodies(q, dq):
    links = chain(4, 250e-6).links
    matrix = mass_matrix(links, q)
    assert matrix == pytest.approx(matrix.T, rel=1e-12)
    kinetic_J = 0.5 * np.array(dq) @ matrix @ np.array(dq)
    assert kinetic_J == pytest.approx(chain_energy_J(links, 0.0, q, dq), rel=1e-9, abs=1e-12)


@given(q=angles)
def test_outstretched_inertia__any_pose__is_the_largest(q):
    links = chain(4, 250e-6).links
    largest = outstretched_inertias_kg_m2(links)
    assert largest == pytest.approx(np.diag(mass_matrix(links, [0.7, 0.0, 0.0, 0.0])))
    assert (np.diag(mass_matrix(links, q)) <= np.array(largest) * (1.0 + 1e-12)).all()
