"""The law against the paper's equations (6) to (8), (11), (16), written out again with numpy."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.law import MANIFOLDS, PassivityLaw
from controller.player import Setpoint
from controller.settings import LawSettings

T = 1e-3
AMPLE_NM = (1e9, 1e9)
PAPER = {
    "alpha": (5.0, 7.5),
    "lambda_": (10.0, 4.0),
    "Ki": (0.2, 0.7),
    "Kd": (2.5, 3.5),
    "adaptation": "off",
}
F = {
    "tanh": np.tanh,
    "sine": lambda x: np.sin(np.clip(x, -np.pi / 2.0, np.pi / 2.0)),
    "saturation": lambda x: np.clip(x, -1.0, 1.0),
}


def motion(cycles=600, seed=5):
    """Random but smooth q, dq, q_des, dq_des, each of shape (cycles, 2)."""
    random = np.random.default_rng(seed)
    t = np.arange(cycles)[:, None] * T

    def wave():
        size, rate, phase = (
            random.uniform(0.1, 1.5, 2),
            random.uniform(1, 9, 2),
            random.uniform(0, 6, 2),
        )
        return size * np.sin(rate * t + phase), size * rate * np.cos(rate * t + phase)

    (q, dq), (q_des, dq_des) = wave(), wave()
    return q, dq, q_des, dq_des


def stepped(law, q, dq, q_des=(0.0, 0.0), dq_des=(0.0, 0.0), *, dt_s=T):
    """One cycle of a law; a desired acceleration, of which this law knows nothing, is present."""
    return law.step(q, dq, Setpoint(list(q_des), list(dq_des), [3.0, -4.0]), dt_s)


def played(law, q, dq, q_des, dq_des, dt_s=T):
    """Run a law; return S, sigma, Kd and tau, one row a cycle."""
    rows = []
    for row in zip(q.tolist(), dq.tolist(), q_des.tolist(), dq_des.tolist(), strict=True):
        tau = stepped(law, *row, dt_s=dt_s)
        rows.append((list(law.S), list(law.sigma), list(law.Kd), tau))
    return tuple(np.array(column) for column in zip(*rows, strict=True))


def gain_surface(S):
    """Kd_hat of (17) for beta = (1, 2, 4), memberships as in the settled reading."""
    a = 1.0 / (1.0 + np.exp(-(np.abs(S) - 0.20) / 0.04))
    b = 1.0 / (1.0 + np.exp(-(np.abs(S) - 0.60) / 0.12))
    return 1.0 * b + 2.0 * np.maximum(a - b, 0.0) + 4.0 * (1.0 - a)


def by_the_paper(settings, q, dq, q_des, dq_des, dt_s=T):
    """S, sigma, Kd and tau by the paper; sigma by forward Euler, from zero."""
    Ki = np.array(settings.Ki) if settings.name.endswith("pid") else np.zeros(2)
    S_q = (dq - dq_des) + np.array(settings.alpha) * (q - q_des)
    slope = F[settings.manifold](np.array(settings.lambda_) * S_q)
    sigma = np.vstack([np.zeros((1, 2)), np.cumsum(dt_s * slope, axis=0)[:-1]])
    if not Ki.any():
        sigma = np.zeros_like(S_q)
    S = S_q + Ki * sigma
    is_tuned = settings.name.startswith("self_tuning")
    Kd = gain_surface(S) if is_tuned else np.broadcast_to(settings.Kd, S.shape)
    return S, sigma, Kd, -Kd * S


@pytest.mark.parametrize("name", ["self_tuning_pid", "self_tuning_pd", "pid", "pd"])
@pytest.mark.parametrize("manifold", ["tanh", "sine", "saturation"])
def test_law__random_motion__follows_the_paper(name, manifold):
    settings = LawSettings(name=name, manifold=manifold, **PAPER)
    signals = motion()
    found = played(PassivityLaw(settings, AMPLE_NM), *signals)
    for ours, paper in zip(found, by_the_paper(settings, *signals), strict=True):
        np.testing.assert_allclose(ours, paper, rtol=0.0, atol=1e-11)


def test_law__before_the_first_step__zero_error_and_the_largest_gain():
    law = PassivityLaw(LawSettings(Kd_max=(4.0, 3.0)), AMPLE_NM)
    for values in (law.S, law.sigma):
        np.testing.assert_array_equal(values, [0.0, 0.0])
    np.testing.assert_array_equal(law.Kd, [4.0, 3.0])


@pytest.mark.parametrize("name", ["pid", "self_tuning_pid"])
def test_law__positive_error__torque_pulls_back(name):
    """Sign of the whole loop: the joint is ahead of its reference, the torque is negative."""
    law = PassivityLaw(LawSettings(name=name, **PAPER), AMPLE_NM)
    tau = stepped(law, [0.3, -0.3], [0.0, 0.0])
    assert tau[0] < 0.0 < tau[1]
    np.testing.assert_allclose(law.S, [5.0 * 0.3, -7.5 * 0.3])


@pytest.mark.parametrize("name", ["pd", "self_tuning_pd"])
def test_law__pd__has_no_integral(name):
    signals = motion()
    settings = LawSettings(name=name, **PAPER)
    S, sigma, _, _ = played(PassivityLaw(settings, AMPLE_NM), *signals)
    assert not sigma.any()
    q, dq, q_des, dq_des = signals
    np.testing.assert_allclose(S, dq - dq_des + np.array(PAPER["alpha"]) * (q - q_des), atol=1e-12)


def test_law__pid__sigma_is_integrated_after_use_with_the_time_that_passed():
    settings = LawSettings(name="pid", **PAPER)
    law = PassivityLaw(settings, AMPLE_NM)
    f = math.tanh(10.0 * 5.0 * 0.02)
    for dt_s, sigma in ((T, 0.0), (3 * T, f * T), (T, f * 4 * T)):
        stepped(law, [0.02, 0.0], [0.0, 0.0], dt_s=dt_s)
        assert law.sigma[0] == pytest.approx(sigma, abs=1e-15)
        assert law.S[0] == pytest.approx(5.0 * 0.02 + 0.2 * sigma, abs=1e-15)


def test_law__reset__integral_starts_anew():
    signals = motion()
    law = PassivityLaw(LawSettings(name="pid", **PAPER), AMPLE_NM)
    first = played(law, *signals)
    law.reset()
    for before, after in zip(first, played(law, *signals), strict=True):
        np.testing.assert_array_equal(before, after)
    assert np.abs(first[1]).max() > 1e-2


def test_law__reset__keeps_what_the_gain_has_learnt():
    settings = LawSettings(**{**PAPER, "adaptation": "absolute", "learning_rate": 1e-3})
    law = PassivityLaw(settings, AMPLE_NM)
    played(law, *motion())
    learnt = list(law.gains[0].beta)
    law.reset()
    assert law.gains[0].beta == learnt
    assert learnt != [1.0, 2.0, 4.0]


# --- anti-windup ------------------------------------------------------------------------------


def constant_error(law, S_q, cycles):
    """Hold an error of S_q (by velocity alone) at joint 1; return its sigma of the last cycle."""
    for _ in range(cycles):
        stepped(law, [0.0, 0.0], [S_q, 0.0])
    return law.sigma[0]


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_law__torque_saturated_and_pushed_further__sigma_waits(sign):
    law = PassivityLaw(LawSettings(name="pid", **PAPER), (1.0, 1.0))
    assert constant_error(law, sign * 0.5, 100) == 0.0  # 2.5 Nms/rad * 0.5 rad/s > 1 Nm


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_law__torque_not_saturated__sigma_moves(sign):
    law = PassivityLaw(LawSettings(name="pid", **PAPER), (1.0, 1.0))
    assert sign * constant_error(law, sign * 0.3, 2) == pytest.approx(T * math.tanh(3.0))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_law__torque_saturated_but_pulled_back__sigma_unwinds(sign):
    settings = LawSettings(name="pid", **{**PAPER, "Ki": (5.0, 5.0)})
    law = PassivityLaw(settings, (1.0, 1.0))
    wound = 0.0
    for _ in range(400):  # just below saturation: 2.5 (0.05 + 5 sigma) grows to 1 Nm, then waits
        wound = constant_error(law, sign * 0.05, 1)
    assert abs(2.5 * law.S[0]) > 1.0
    assert constant_error(law, sign * 0.05, 50) == wound
    unwinding = constant_error(law, -sign * 0.001, 2)
    assert abs(unwinding) == pytest.approx(abs(wound) - T * math.tanh(0.01), abs=1e-12)


def test_law__one_joint_saturated__the_other_integrates_on():
    law = PassivityLaw(LawSettings(name="pid", **PAPER), (0.1, 1e9))
    for _ in range(3):
        stepped(law, [0.0, 0.0], [0.5, 0.5])
    assert law.sigma[0] == 0.0
    assert law.sigma[1] == pytest.approx(2 * T * math.tanh(2.0))


def test_law__own_torque_clip__clips_and_holds_sigma_where_the_limit_would_not():
    """For comparisons at equal peak torque: joint 1 is clipped, joint 2 is below its clip."""
    settings = LawSettings(name="pid", **PAPER, tau_clip_Nm=(1.0, 2.0))
    law = PassivityLaw(settings, AMPLE_NM)
    for _ in range(3):
        tau = stepped(law, [0.0, 0.0], [0.5, 0.5])
    assert tau[0] == -1.0
    assert tau[1] == pytest.approx(-3.5 * (0.5 + 0.7 * law.sigma[1]))
    assert law.sigma[0] == 0.0 < law.sigma[1]
    assert stepped(law, [0.0, 0.0], [-0.5, 0.0])[0] == 1.0


def test_law__torque_limit_without_own_clip__is_left_to_the_limiter():
    law = PassivityLaw(LawSettings(name="pd", **PAPER), (1.0, 1.0))
    assert stepped(law, [0.0, 0.0], [2.0, 0.0])[0] == pytest.approx(-5.0)


# --- symmetry ---------------------------------------------------------------------------------


@pytest.mark.parametrize("adaptation", ["off", "absolute", "true_sign", "literal"])
@pytest.mark.parametrize("manifold", list(MANIFOLDS))
def test_law__mirrored_motion__exactly_mirrored_torque_except_when_literal(manifold, adaptation):
    settings = LawSettings(
        **{**PAPER, "adaptation": adaptation, "manifold": manifold, "learning_rate": 1e-3}
    )
    signals = motion()
    _, _, Kd, tau = played(PassivityLaw(settings, (2.0, 2.0)), *signals)
    mirrored = played(PassivityLaw(settings, (2.0, 2.0)), *(-signal for signal in signals))
    is_mirrored = np.array_equal(tau, -mirrored[3]) and np.array_equal(Kd, mirrored[2])
    assert is_mirrored == (adaptation != "literal")


def test_law__one_joint__knows_nothing_of_the_other():
    settings = LawSettings(**PAPER)
    q, dq, q_des, dq_des = motion()
    tau = played(PassivityLaw(settings, AMPLE_NM), q, dq, q_des, dq_des)[3]
    q[:, 1] += 1.0
    assert np.array_equal(
        tau[:, 0], played(PassivityLaw(settings, AMPLE_NM), q, dq, q_des, dq_des)[3][:, 0]
    )


def test_law__gain_bounds_moved__torque_follows_the_new_gain():
    law = PassivityLaw(LawSettings(**PAPER), AMPLE_NM)
    for gain in law.gains:
        gain.set_bounds(1.0, 2.0)
    for _ in range(300):
        tau = stepped(law, [0.0, 0.0], [0.01, 0.0])
    assert law.Kd[0] == pytest.approx(1.0 + (gain_surface(law.S[0]) - 1.0) / 3.0, abs=1e-9)
    assert tau[0] == -law.Kd[0] * law.S[0]


# --- the family of section 6.5 ----------------------------------------------------------------
# Definition 1 asks of f, for some 1 >= mu > 0 and rho > 0: |x| >= |f| >= mu |x| inside rho,
# rho >= |f| >= mu rho outside, a slope in [0, 1], f increasing. With rho = 1 all three keep the
# inequalities. What they do not meet to the letter: saturation has no derivative at +-1 ("almost
# everywhere" allows that), and sine and saturation rest at +-1 from pi/2 and 1 on, where they do
# not increase any more. tanh violates nothing over the reals; in doubles it, too, rests at +-1,
# from |x| = 19.07 on.
MU = {"tanh": math.tanh(1.0), "sine": math.sin(1.0), "saturation": 1.0}
ARGUMENTS = st.floats(allow_nan=False, allow_infinity=False) | st.floats(-3.0, 3.0)


@pytest.mark.parametrize("name", list(MANIFOLDS))
@given(x=ARGUMENTS)
def test_manifold__any_argument__keeps_the_inequalities_of_the_family(name, x):
    size, mu, rounding = abs(MANIFOLDS[name](x)), MU[name], 1e-15
    if abs(x) < 1.0:
        assert (1.0 + rounding) * abs(x) >= size >= (mu - rounding) * abs(x)
    else:
        assert 1.0 >= size >= mu - rounding


@pytest.mark.parametrize("name", list(MANIFOLDS))
@given(x=ARGUMENTS)
def test_manifold__any_argument__odd_and_of_its_argument_sign(name, x):
    f = MANIFOLDS[name]
    assert f(-x) == -f(x)
    assert f(x) * x >= 0.0


@pytest.mark.parametrize("name", list(MANIFOLDS))
def test_manifold__over_a_grid__slope_between_zero_and_one(name):
    x = np.linspace(-25.0, 25.0, 200_001)
    values = np.array([MANIFOLDS[name](each) for each in x.tolist()])
    slope = np.diff(values) / np.diff(x)
    assert slope.min() >= 0.0
    assert slope.max() <= 1.0 + 1e-9
    np.testing.assert_allclose(values, F[name](x), rtol=0.0, atol=1e-15)


@pytest.mark.parametrize(("name", "end"), [("tanh", 7.0), ("sine", math.pi / 2), ("saturation", 1)])
def test_manifold__inside_its_range__strictly_increasing(name, end):
    x = np.linspace(-0.999 * end, 0.999 * end, 301)
    values = [MANIFOLDS[name](each) for each in x.tolist()]
    assert np.all(np.diff(values) > 0.0)


def test_manifold__names__are_those_of_the_settings():
    assert set(MANIFOLDS) == set(F)
    for name in MANIFOLDS:
        assert LawSettings(manifold=name).manifold == name
