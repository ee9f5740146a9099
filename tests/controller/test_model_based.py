"""Model-based laws: the regressor against Newton's laws, the laws against their equations."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.model_based import ComputedTorqueLaw, PlanarChain, SlotineLiLaw, parameters
from controller.player import Setpoint
from controller.settings import (
    PER_JOINT,
    ControllerSettings,
    LimitSettings,
    LinkModel,
    ModelSettings,
)

T = 1e-3
AMPLE_NM = 1e9
J, B_MOMENT, VISCOUS, COULOMB, DISTURBANCE = range(PER_JOINT)
SIZES = [1, 2, 3, 4, 7]


def chain_of(n: int, seed: int = 1, gravity_m_s2: float = 9.81) -> ModelSettings:
    random = np.random.default_rng(seed)
    ranges = ((0.1, 0.4), (0.02, 0.3), (0.3, 6.0), (0.005, 0.12), (0.01, 0.1), (0.01, 0.2))
    names = list(LinkModel.model_fields)
    links = [
        LinkModel(**{k: random.uniform(*r) for k, r in zip(names, ranges, strict=True)})
        for _ in range(n)
    ]
    return ModelSettings(links=tuple(links), gravity_m_s2=gravity_m_s2, tanh_slope_s_rad=50.0)


def motion_of(n: int, seed: int = 2) -> np.ndarray:
    """q, dq, ddq and a second pair of rates and accelerations, each of n joints."""
    return np.random.default_rng(seed).normal(0.0, 2.0, (5, n))


def newton_euler(model: ModelSettings, q, dq, ddq) -> np.ndarray:
    """Joint torques of a motion, from the forces on every link; x points down, y to the right.

    Outwards the motion of every joint and centre of mass, inwards what each link needs.
    """
    angle = rate = change = 0.0
    joint = np.zeros(2)
    acceleration = np.array([-model.gravity_m_s2, 0.0])  # of the shoulder, in free fall upwards
    needs = []
    for link, *steps in zip(model.links, q, dq, ddq, strict=True):
        angle, rate, change = (a + b for a, b in zip((angle, rate, change), steps, strict=True))
        along = np.array([math.cos(angle), math.sin(angle)])
        across = np.array([-along[1], along[0]])
        bend = change * across - rate * rate * along
        force = link.mass_kg * (acceleration + link.com_m * bend)
        needs.append((joint, joint + link.com_m * along, force, link.inertia_kg_m2 * change))
        joint = joint + link.length_m * along
        acceleration = acceleration + link.length_m * bend
    torques = []
    for inner, (at, *_) in enumerate(needs):
        total = 0.0
        for _, com, force, moment in needs[inner:]:
            lever = com - at
            total += moment + lever[0] * force[1] - lever[1] * force[0]
        torques.append(total)
    return np.array(torques)


def friction(model: ModelSettings, dq) -> np.ndarray:
    slope = model.tanh_slope_s_rad
    pairs = zip(model.links, dq, strict=True)
    return np.array([a.viscous_Nms_rad * v + a.coulomb_Nm * math.tanh(slope * v) for a, v in pairs])


def torque_of(model: ModelSettings, q, dq, dq_r, ddq_r) -> np.ndarray:
    motion = (list(map(float, part)) for part in (q, dq, dq_r, ddq_r))
    return np.array(PlanarChain(model).regressor(*motion)) @ np.array(parameters(model))


def inertia_of(model: ModelSettings, q) -> np.ndarray:
    """H(q): torques of unit accelerations, without rates and gravity."""
    zeros = np.zeros(len(q))
    floating = model.model_copy(update={"gravity_m_s2": 0.0})
    units = np.eye(len(q))
    return np.column_stack([torque_of(floating, q, zeros, zeros, unit) for unit in units])


def coriolis_of(model: ModelSettings, q, dq) -> np.ndarray:
    """C(q, dq): torques of unit reference rates, without gravity and friction."""
    bare = [
        link.model_copy(update={"viscous_Nms_rad": 0.0, "coulomb_Nm": 0.0}) for link in model.links
    ]
    floating = model.model_copy(update={"gravity_m_s2": 0.0, "links": tuple(bare)})
    units, zeros = np.eye(len(q)), np.zeros(len(q))
    return np.column_stack([torque_of(floating, q, dq, unit, zeros) for unit in units])


# --- the regressor ------------------------------------------------------------------------------


@pytest.mark.parametrize("gravity_m_s2", [0.0, 9.81])
@pytest.mark.parametrize("n", SIZES)
def test_regressor__true_motion__torques_of_newton_and_euler(n, gravity_m_s2):
    model = chain_of(n, gravity_m_s2=gravity_m_s2)
    q, dq, ddq, _, _ = motion_of(n)
    expected = newton_euler(model, q, dq, ddq) + friction(model, dq)
    np.testing.assert_allclose(torque_of(model, q, dq, dq, ddq), expected, rtol=0.0, atol=1e-10)


@given(seed=st.integers(0, 2**32 - 1), n=st.sampled_from([2, 3, 4]))
def test_regressor__any_motion_and_arm__torques_of_newton_and_euler(seed, n):
    model = chain_of(n, seed)
    q, dq, ddq, _, _ = motion_of(n, seed)
    expected = newton_euler(model, q, dq, ddq) + friction(model, dq)
    np.testing.assert_allclose(torque_of(model, q, dq, dq, ddq), expected, rtol=0.0, atol=1e-10)


@pytest.mark.parametrize("n", SIZES)
def test_regressor__reference_motion__is_H_ddq_r_plus_C_dq_r_plus_g_plus_friction_of_2(n):
    model = chain_of(n)
    q, dq, _, dq_r, ddq_r = motion_of(n)
    zeros = np.zeros(n)
    gravity = newton_euler(model, q, zeros, zeros)
    expected = inertia_of(model, q) @ ddq_r + coriolis_of(model, q, dq) @ dq_r
    expected += gravity + friction(model, dq_r)
    np.testing.assert_allclose(torque_of(model, q, dq, dq_r, ddq_r), expected, atol=1e-10)


@pytest.mark.parametrize("n", SIZES)
def test_regressor__inertia__symmetric_and_positive_definite(n):
    H = inertia_of(chain_of(n), motion_of(n)[0])
    np.testing.assert_allclose(H, H.T, rtol=0.0, atol=1e-13)
    assert np.linalg.eigvalsh(H).min() > 0.0


@pytest.mark.parametrize("n", SIZES)
def test_regressor__coriolis__that_of_christoffel(n):
    """Symmetric in its two rates, which with the torques of a true motion leaves one matrix."""
    model = chain_of(n)
    q, dq, other, _, _ = motion_of(n)
    one, two = coriolis_of(model, q, dq) @ other, coriolis_of(model, q, other) @ dq
    np.testing.assert_allclose(one, two, rtol=0.0, atol=1e-11)


@pytest.mark.parametrize("n", SIZES)
def test_regressor__inertia_change_less_twice_coriolis__skew_symmetric(n):
    model = chain_of(n)
    q, dq, _, _, _ = motion_of(n)
    h = 1e-5
    change = (inertia_of(model, q + h * dq) - inertia_of(model, q - h * dq)) / (2.0 * h)
    skew = change - 2.0 * coriolis_of(model, q, dq)
    np.testing.assert_allclose(skew, -skew.T, rtol=0.0, atol=2e-7 * max(1.0, np.abs(skew).max()))
    assert n == 1 or np.abs(skew).max() > 0.1


def test_regressor__disturbance__enters_with_the_sign_of_2():
    model, zeros = chain_of(3), [0.0] * 3
    Y = np.array(PlanarChain(model).regressor(zeros, zeros, zeros, zeros))
    assert Y[:, DISTURBANCE::PER_JOINT].tolist() == (-np.eye(3)).tolist()


def test_regressor__friction__of_the_reference_rate_not_of_the_measured_one():
    model = chain_of(2)
    Y = np.array(PlanarChain(model).regressor([0.1, 0.2], [3.0, 4.0], [0.5, -0.01], [0.0, 0.0]))
    np.testing.assert_allclose(Y[:, VISCOUS::PER_JOINT], np.diag([0.5, -0.01]), atol=0.0)
    np.testing.assert_allclose(Y[:, COULOMB::PER_JOINT], np.diag(np.tanh([25.0, -0.5])), rtol=1e-15)


def test_parameters__two_links__those_written_out():
    a, b = chain_of(2).links
    inner = a.inertia_kg_m2 + a.mass_kg * a.com_m**2 + b.mass_kg * a.length_m**2
    outer = b.inertia_kg_m2 + b.mass_kg * b.com_m**2
    Theta = parameters(chain_of(2))
    assert Theta[J::PER_JOINT] == pytest.approx([inner, outer])
    moments = [a.mass_kg * a.com_m + b.mass_kg * a.length_m, b.mass_kg * b.com_m]
    assert Theta[B_MOMENT::PER_JOINT] == pytest.approx(moments)
    assert Theta[VISCOUS::PER_JOINT] == [a.viscous_Nms_rad, b.viscous_Nms_rad]
    assert Theta[COULOMB::PER_JOINT] == [a.coulomb_Nm, b.coulomb_Nm]
    assert Theta[DISTURBANCE::PER_JOINT] == [0.0, 0.0]


# --- the laws -----------------------------------------------------------------------------------


def settings(name: str, n: int = 2, tau_max_Nm: float = AMPLE_NM, **tables) -> ControllerSettings:
    limits = dict.fromkeys(LimitSettings.model_fields, (1.0,) * n)
    limits |= {"hard_margin_rad": 0.1, "n_hold": 5, "n_damp": 20, "stop_timeout_s": 2.0}
    limits |= {"lowering_rad_s": 0.5, "lowering_timeout_s": 8.0}
    limits |= {"q_min_rad": (-1.0,) * n, "tau_max_Nm": (tau_max_Nm,) * n}
    law = {
        "name": name,
        "alpha": tuple(5.0 + 2.5 * j for j in range(n)),
        "Kd": tuple(4.0 - 0.5 * j for j in range(n)),
        **{key: (value,) * n for key, value in {"lambda_": 10.0, "Ki": 0.2}.items()},
        **{key: (value,) * n for key, value in {"Kd_min": 1.0, "Kd_max": 4.0}.items()},
        **tables.pop("law", {}),
    }
    return ControllerSettings(law=law, limits=limits, model=chain_of(n), **tables)


def setpoint_of(n: int, seed: int = 3) -> Setpoint:
    return Setpoint(*np.random.default_rng(seed).normal(0.0, 0.5, (3, n)).tolist())


def by_3_2(controller: ControllerSettings, q, dq, setpoint: Setpoint):
    """S_q, the reference (5) without integral, and its derivative."""
    q_d, dq_d, ddq_d = (np.array(part) for part in setpoint)
    alpha = np.array(controller.law.alpha)
    S_q = dq - dq_d + alpha * (q - q_d)
    return S_q, dq_d - alpha * (q - q_d), ddq_d - alpha * (dq - dq_d)


@pytest.mark.parametrize("n", [1, 2, 4])
def test_computed_torque__any_state__minus_Kd_S_q_plus_Y_r_Theta(n):
    controller = settings("computed_torque", n)
    law, setpoint = ComputedTorqueLaw(controller), setpoint_of(n)
    q, dq, *_ = motion_of(n)
    tau = law.step(q.tolist(), dq.tolist(), setpoint, T)
    S_q, dq_r, ddq_r = by_3_2(controller, q, dq, setpoint)
    expected = torque_of(controller.model, q, dq, dq_r, ddq_r) - np.array(controller.law.Kd) * S_q
    np.testing.assert_allclose(tau, expected, rtol=0.0, atol=1e-10)
    np.testing.assert_allclose(law.S, S_q, rtol=0.0, atol=1e-12)
    assert law.Kd == list(controller.law.Kd)
    assert law.sigma == [0.0] * n


def test_computed_torque__closed_loop_without_friction__V1_falls_at_S_q_Kd_S_q():
    """(9), (10): d/dt (S_q' H S_q / 2) = -S_q' Kd S_q, with the exact model."""
    controller = settings("computed_torque", 3)
    bare = [
        link.model_copy(update={"viscous_Nms_rad": 0.0, "coulomb_Nm": 0.0})
        for link in controller.model.links
    ]
    model = controller.model.model_copy(update={"links": tuple(bare)})
    law = ComputedTorqueLaw(controller.model_copy(update={"model": model}))
    q, dq, *_ = 0.5 * motion_of(3)
    setpoint = setpoint_of(3)
    tau = np.array(law.step(q.tolist(), dq.tolist(), setpoint, T))
    bias = newton_euler(model, q, dq, np.zeros(3))
    ddq = np.linalg.solve(inertia_of(model, q), tau - bias)

    def storage(t: float) -> float:
        """Along the motion that this torque makes, and the reference it has."""
        here, rate = q + t * dq + 0.5 * t * t * ddq, dq + t * ddq
        q_d, dq_d, ddq_d = (np.array(part) for part in setpoint)
        moved = Setpoint(q_d + t * dq_d + 0.5 * t * t * ddq_d, dq_d + t * ddq_d, ddq_d)
        S_q, _, _ = by_3_2(controller, here, rate, moved)
        return 0.5 * S_q @ inertia_of(model, here) @ S_q

    h = 1e-5
    slope = (storage(h) - storage(-h)) / (2.0 * h)
    S_q = np.array(law.S)
    assert slope == pytest.approx(-S_q @ (np.array(controller.law.Kd) * S_q), rel=1e-6)


def test_slotine_li__run__follows_its_equations_cycle_by_cycle():
    Gamma = tuple(0.1 * (k + 1) for k in range(2 * PER_JOINT))
    controller = settings("slotine_li", slotine_li={"Gamma": Gamma})
    law, chain = SlotineLiLaw(controller), PlanarChain(controller.model)
    Theta = np.zeros(2 * PER_JOINT)
    random = np.random.default_rng(4)
    for dt_s in (T, T, 3 * T, T):
        setpoint = setpoint_of(2, random.integers(100))
        q, dq = random.normal(0.0, 0.5, (2, 2))
        tau = law.step(q.tolist(), dq.tolist(), setpoint, dt_s)
        S_q, dq_r, ddq_r = by_3_2(controller, q, dq, setpoint)
        Y = np.array(chain.regressor(*(part.tolist() for part in (q, dq, dq_r, ddq_r))))
        np.testing.assert_allclose(tau, Y @ Theta - np.array(controller.law.Kd) * S_q, atol=1e-11)
        Theta = Theta - dt_s * np.array(Gamma) * (Y.T @ S_q)
        np.testing.assert_allclose(law.Theta, Theta, rtol=0.0, atol=1e-13)
    assert np.abs(Theta).max() > 1e-3


def test_slotine_li__five_gains__the_same_for_every_joint():
    five = settings("slotine_li", 3, slotine_li={"Gamma": (1, 2, 3, 4, 5)})
    all_given = settings("slotine_li", 3, slotine_li={"Gamma": (1, 2, 3, 4, 5) * 3})
    q, dq, *_ = motion_of(3)
    laws = [SlotineLiLaw(five), SlotineLiLaw(all_given)]
    for law in laws:
        law.step(q.tolist(), dq.tolist(), setpoint_of(3), T)
    assert laws[0].Theta == laws[1].Theta
    assert all(theta != 0.0 for theta in laws[0].Theta)


@pytest.mark.parametrize(("start", "is_zero"), [("zero", True), ("model", False)])
def test_slotine_li__reset__parameters_start_anew(start, is_zero):
    controller = settings("slotine_li", slotine_li={"start": start})
    law = SlotineLiLaw(controller)
    first = list(law.Theta)
    assert first == ([0.0] * 10 if is_zero else parameters(controller.model))
    q, dq, *_ = motion_of(2)
    law.step(q.tolist(), dq.tolist(), setpoint_of(2), T)
    assert law.Theta != first
    law.reset()
    assert law.Theta == first


def test_slotine_li__no_gain__computed_torque():
    q, dq, *_ = motion_of(2)
    still = settings("slotine_li", slotine_li={"start": "model", "Gamma": (0.0,) * 5})
    laws = [SlotineLiLaw(still), ComputedTorqueLaw(settings("computed_torque"))]
    for _ in range(3):
        one, other = (law.step(q.tolist(), dq.tolist(), setpoint_of(2), T) for law in laws)
        assert one == other


@given(
    errors=st.lists(st.lists(st.floats(-50.0, 50.0), min_size=4, max_size=4), max_size=8),
    most=st.lists(st.floats(0.0, 2.0), min_size=5, max_size=5),
)
def test_slotine_li__any_motion__parameters_stay_in_their_box(errors, most):
    boxed = {"Theta_max": most, "Gamma": (50.0,) * 5}
    law = SlotineLiLaw(settings("slotine_li", slotine_li=boxed))
    for q1, q2, dq1, dq2 in errors:
        law.step([q1, q2], [dq1, dq2], setpoint_of(2), T)
        for k, theta in enumerate(law.Theta):
            limit = most[k % PER_JOINT]
            assert (-limit if k % PER_JOINT == DISTURBANCE else 0.0) <= theta <= limit


def test_slotine_li__one_torque_saturated__all_parameters_wait():
    law = SlotineLiLaw(settings("slotine_li", tau_max_Nm=1.0))
    at_rest = Setpoint([0.0, 0.0], [0.0, 0.0], [0.0, 0.0])
    law.step([0.0, 0.0], [0.3, 0.0], at_rest, T)  # 4 Nms/rad * 0.3 rad/s > 1 Nm
    assert law.Theta == [0.0] * 10
    law.step([0.0, 0.0], [0.2, 0.0], at_rest, T)
    assert any(law.Theta)


def test_slotine_li__constant_load__disturbance_takes_it_over():
    """A constant load on a still arm: tau_d with its gain is an integrator, and S_q vanishes."""
    controller = settings("slotine_li", slotine_li={"Gamma": (0.0, 0.0, 0.0, 0.0, 40.0)})
    law = SlotineLiLaw(controller)
    at_rest = Setpoint([0.0, 0.0], [0.0, 0.0], [0.0, 0.0])
    load, rate, Kd = -0.7, 0.0, controller.law.Kd[0]
    for _ in range(3000):  # a joint without inertia, whose torque balances the load
        tau = law.step([0.0, 0.0], [rate, 0.0], at_rest, T)
        rate += (tau[0] + load) / Kd
    assert tau[0] == pytest.approx(-load, abs=1e-6)
    assert law.S[0] == pytest.approx(0.0, abs=1e-6)
    assert law.Theta[DISTURBANCE] == pytest.approx(load, abs=1e-6)


@pytest.mark.parametrize("name", ["computed_torque", "slotine_li"])
def test_model_based__clip__bounds_the_torque_and_nothing_else(name):
    law_class = {"computed_torque": ComputedTorqueLaw, "slotine_li": SlotineLiLaw}[name]
    free = law_class(settings(name))
    clipped = law_class(settings(name, law={"tau_clip_Nm": (1.5, 100.0)}))
    q, dq, *_ = 0.1 * motion_of(2)
    wanted = free.step(q.tolist(), dq.tolist(), setpoint_of(2), T)
    assert abs(wanted[0]) > 1.5
    tau = clipped.step(q.tolist(), dq.tolist(), setpoint_of(2), T)
    assert tau == [math.copysign(1.5, wanted[0]), wanted[1]]


@pytest.mark.parametrize("name", ["computed_torque", "slotine_li"])
def test_model_based__mirrored_motion__exactly_mirrored_torque(name):
    law_class = {"computed_torque": ComputedTorqueLaw, "slotine_li": SlotineLiLaw}[name]
    laws = [law_class(settings(name)) for _ in range(2)]
    for seed in range(5):
        q, dq, *_ = motion_of(2, seed)
        there = setpoint_of(2, seed)
        back = Setpoint(*([-x for x in part] for part in there))
        tau = laws[0].step(q.tolist(), dq.tolist(), there, T)
        mirrored = laws[1].step((-q).tolist(), (-dq).tolist(), back, T)
        assert tau == [-torque for torque in mirrored]


def test_model_based__gain_bounds_moved__Kd_follows():
    law = ComputedTorqueLaw(settings("computed_torque"))
    law.gains[0].set_bounds(1.0, 2.0)
    still = Setpoint([0.0, 0.0], [0.0, 0.0], [0.0, 0.0])
    for _ in range(300):
        law.step([0.0, 0.0], [0.0, 0.0], still, T)
    assert law.Kd == [2.0, 3.5]


# --- settings -----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["computed_torque", "slotine_li"])
def test_settings__law_without_model__refused(name):
    bare = settings(name).model_copy(update={"model": None})
    with pytest.raises(ValueError, match=f"law {name} needs a model of the arm: controller.model"):
        bare.require_joints(2)
    with pytest.raises(ValueError, match="needs a model"):
        ComputedTorqueLaw(bare)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"model": chain_of(3)}, "model.links has 3 entries, the arm has 2 joints"),
        ({"slotine_li": {"Gamma": (1.0,) * 7}}, "Gamma has 7 entries; give 5, or 10 for 2 joints"),
        ({"slotine_li": {"Gamma": (1, 1, 1, 1, -1)}}, "must not be negative"),
        ({"slotine_li": {"Theta_max": (1, 1, -1, 1, 1)}}, "must not be negative"),
        ({"law": {"tau_clip_Nm": (1.0,)}}, "tau_clip_Nm has 1 entries, the arm has 2 joints"),
        ({"law": {"tau_clip_Nm": (1.0, 0.0)}}, "joint 2: tau_clip_Nm 0 must be above 0"),
    ],
)
def test_settings__model_or_gains_that_do_not_fit__refused(changes, message):
    given = settings("slotine_li").model_dump()
    given["law"] |= changes.get("law", {})
    given |= {key: value for key, value in changes.items() if key != "law"}
    with pytest.raises(ValueError, match=message):
        ControllerSettings.model_validate(given).require_joints(2)


def test_settings__other_laws__model_not_looked_at():
    settings("pid").model_copy(update={"model": chain_of(3)}).require_joints(2)
