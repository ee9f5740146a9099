"""The gain of tau = -Kd S, against the paper's section 4 written out again here."""

import math
import sys
from typing import get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.gain import ConstantGain, SelfTuningGain, memberships
from controller.settings import LawSettings, MembershipName

T = 1e-3
ADAPTATIONS = ("off", "literal", "absolute", "true_sign")
GRID = np.linspace(0.0, 3.0, 30_001)
TINY = sys.float_info.min * sys.float_info.epsilon  # the smallest subnormal
EXTREMES = [0.0, -0.0, TINY, -TINY, 1e-300, 20.0, 1e3, -1e3, 1e300, -sys.float_info.max]
ANY_S = st.floats(allow_nan=False, allow_infinity=False)
MODERATE_S = st.floats(-3.0, 3.0)


def tuned(joint=0, **changes):
    return SelfTuningGain(LawSettings(**{"adaptation": "off", **changes}), joint)


def sigmoid(x):
    return 1.0 / (1.0 + np.exp(-x))


def expected_memberships(S):
    """(big, medium, small) of |S|, as the two sigmoids at 0.20 and 0.60 rad/s define them."""
    a, b = sigmoid((np.abs(S) - 0.20) / 0.04), sigmoid((np.abs(S) - 0.60) / 0.12)
    return np.stack((b, np.maximum(a - b, 0.0), 1.0 - a))


def adapted(settings, S_values, dt_s):
    """Betas and gains of (17) and (28) over a run of S, one row a cycle."""
    low, high = settings.Kd_min[0], settings.Kd_max[0]
    beta, mu = np.clip(settings.beta, low, high), np.zeros(3)
    betas, gains = [], []
    for S in S_values:
        per_cycle = settings.learning_rate * settings.alpha[0] * dt_s / 1e-3
        step = {
            "off": 0.0,
            "literal": -per_cycle * S,
            "absolute": -per_cycle * abs(S),
            "true_sign": per_cycle * abs(S),
        }[settings.adaptation]
        beta = np.clip(beta + step * mu, low, high)
        mu = expected_memberships(S)
        betas.append(beta)
        gains.append(np.clip(beta @ mu, low, high))
    return np.array(betas), np.array(gains)


# --- memberships ------------------------------------------------------------------------------


@pytest.mark.parametrize("S", EXTREMES)
def test_memberships__extreme_values__partition_of_unity(S):
    degrees = memberships(abs(S))
    assert all(0.0 <= degree <= 1.0 for degree in degrees)
    assert sum(degrees) == pytest.approx(1.0, abs=1e-15)


def test_memberships__over_a_grid__are_the_two_sigmoids_and_sum_to_one():
    degrees = np.array([memberships(float(S)) for S in GRID]).T
    np.testing.assert_allclose(degrees, expected_memberships(GRID), rtol=0.0, atol=1e-14)
    np.testing.assert_allclose(degrees.sum(axis=0), 1.0, rtol=0.0, atol=1e-15)


@given(ANY_S)
def test_memberships__any_value__partition_of_unity(S):
    degrees = memberships(abs(S))
    assert min(degrees) >= 0.0
    assert sum(degrees) == pytest.approx(1.0, abs=1e-15)


# --- the surface Kd(S) ------------------------------------------------------------------------


@pytest.mark.parametrize(("S", "Kd"), [(0.0, 3.980), (1.0, 1.034), (-1.0, 1.034)])
def test_self_tuning_gain__paper_consequences__known_gains(S, Kd):
    by_hand = (1.0, 2.0, 4.0) @ expected_memberships(S)
    assert tuned().step(S, T) == pytest.approx(by_hand, abs=1e-12)
    assert by_hand == pytest.approx(Kd, abs=5e-4)


def test_self_tuning_gain__over_a_grid__falls_with_S_while_torque_never_falls():
    gain = tuned()
    Kd = np.array([gain.step(float(S), T) for S in GRID])
    assert np.all(np.diff(Kd) <= 1e-15)
    assert np.all(np.diff(Kd * GRID) >= 0.0)
    assert Kd.min() >= 1.0
    assert Kd.max() <= 3.9801


@given(MODERATE_S, MODERATE_S)
def test_self_tuning_gain__larger_S__never_less_torque(first, second):
    gain = tuned()
    small, large = sorted((abs(first), abs(second)))
    assert gain.step(large, T) <= gain.step(small, T) + 1e-15
    assert large * gain.step(large, T) >= small * gain.step(small, T) - 1e-15


@pytest.mark.parametrize("S", EXTREMES)
@pytest.mark.parametrize("adaptation", ADAPTATIONS)
def test_self_tuning_gain__extreme_values__stays_in_bounds(adaptation, S):
    gain = tuned(adaptation=adaptation, learning_rate=1.0)
    for value in (S, -S, S):
        Kd = gain.step(value, T)
        assert 1.0 <= Kd <= 4.0
        assert all(1.0 <= beta <= 4.0 for beta in gain.beta)


@pytest.mark.parametrize("S", [TINY, -TINY, -0.0])
def test_self_tuning_gain__next_to_zero__gain_of_zero(S):
    assert tuned().step(S, T) == tuned().step(0.0, T)


@given(
    S_values=st.lists(ANY_S | MODERATE_S, min_size=1, max_size=8),
    adaptation=st.sampled_from(ADAPTATIONS),
    bounds=st.lists(st.floats(0.1, 8.0), min_size=2, max_size=2).map(sorted),
    beta=st.tuples(*[st.floats(-20.0, 20.0)] * 3),
    learning_rate=st.floats(0.0, 10.0),
    membership=st.sampled_from(get_args(MembershipName)),
)
def test_self_tuning_gain__any_adaptation__gain_and_betas_stay_in_bounds(
    S_values, adaptation, bounds, beta, learning_rate, membership
):
    low, high = bounds
    gain = tuned(
        adaptation=adaptation,
        Kd_min=(low, low),
        Kd_max=(high, high),
        beta=beta,
        learning_rate=learning_rate,
        membership=membership,
    )
    for S in S_values:
        assert low <= gain.step(S, T) <= high
        assert all(low <= each <= high for each in gain.beta)


# --- adaptation (28) --------------------------------------------------------------------------


@pytest.mark.parametrize("adaptation", ADAPTATIONS)
@pytest.mark.parametrize("dt_s", [1e-3, 2e-3])
def test_self_tuning_gain__adapting__follows_28_cycle_by_cycle(adaptation, dt_s):
    settings = LawSettings(
        adaptation=adaptation, learning_rate=2e-3, beta=(1.5, 2.0, 3.5), alpha=(5.0, 7.5)
    )
    S_values = np.random.default_rng(7).normal(0.0, 0.5, 400)
    gain = SelfTuningGain(settings, 0)
    betas, gains = adapted(settings, S_values, dt_s)
    for S, beta, Kd in zip(S_values, betas, gains, strict=True):
        assert gain.step(float(S), dt_s) == pytest.approx(Kd, abs=1e-12)
        assert gain.beta == pytest.approx(beta, abs=1e-12)
    has_moved = np.abs(betas[-1] - settings.beta).max() > 1e-3
    assert has_moved == (adaptation != "off")


def test_self_tuning_gain__default_settings__adapt_literally_at_1e_minus_6_alpha_per_ms():
    gain = SelfTuningGain(LawSettings(beta=(1.5, 2.0, 3.5)), 1)
    gain.step(0.4, T)
    gain.step(0.4, T)
    wanted = np.array((1.5, 2.0, 3.5)) - 1e-6 * 0.4 * 7.5 * expected_memberships(0.4)
    assert gain.beta == pytest.approx(wanted, abs=1e-15)


@pytest.mark.parametrize(("adaptation", "direction"), [("absolute", -1), ("true_sign", 1)])
@pytest.mark.parametrize("S", [0.4, -0.4])
def test_self_tuning_gain__by_magnitude__one_direction_for_either_sign(adaptation, direction, S):
    gain = tuned(adaptation=adaptation, learning_rate=1e-2, beta=(2.0, 2.0, 2.0))
    for _ in range(50):
        gain.step(S, T)
    assert direction * (gain.beta[1] - 2.0) > 0.1


@pytest.mark.parametrize(("S", "direction"), [(0.4, -1), (-0.4, 1)])
def test_self_tuning_gain__literal__direction_follows_the_sign_of_S(S, direction):
    gain = tuned(adaptation="literal", learning_rate=1e-2, beta=(2.0, 2.0, 2.0))
    for _ in range(50):
        gain.step(S, T)
    assert direction * (gain.beta[1] - 2.0) > 0.1


@pytest.mark.parametrize("adaptation", ADAPTATIONS)
def test_self_tuning_gain__mirrored_S__same_gains_except_when_literal(adaptation):
    S_values = np.random.default_rng(3).normal(0.1, 0.5, 500).tolist()
    changes = {"adaptation": adaptation, "learning_rate": 1e-3, "beta": (1.5, 2.0, 3.5)}
    gain, mirrored = tuned(**changes), tuned(**changes)
    is_equal = [gain.step(S, T) == mirrored.step(-S, T) for S in S_values]
    assert all(is_equal) == (adaptation != "literal")


@pytest.mark.parametrize(
    ("adaptation", "reached"),
    [("off", (2.0, 2.0)), ("literal", (1.0, 4.0)), ("absolute", (1.0, 2.0)),
     ("true_sign", (2.0, 4.0))],
)  # fmt: skip
def test_self_tuning_gain__ten_thousand_random_steps__betas_stop_at_their_box(adaptation, reached):
    gain = tuned(adaptation=adaptation, learning_rate=1e-2, beta=(2.0, 2.0, 2.0))
    random = np.random.default_rng(11)
    lowest = highest = 2.0
    for S in random.normal(0.0, 2.0, 10_000).tolist():
        assert 1.0 <= gain.step(S, T) <= 4.0
        lowest, highest = min(lowest, *gain.beta), max(highest, *gain.beta)
    assert (lowest, highest) == reached


@pytest.mark.parametrize("adaptation", ["literal", "absolute", "true_sign"])
def test_self_tuning_gain__twice_the_period__twice_the_step(adaptation):
    def moved(dt_s):
        gain = tuned(adaptation=adaptation, learning_rate=1e-4, beta=(2.0, 2.0, 2.0))
        gain.step(0.4, T)
        gain.step(0.4, dt_s)
        return np.array(gain.beta) - 2.0

    np.testing.assert_allclose(moved(2e-3), 2.0 * moved(1e-3), rtol=1e-9)
    assert np.abs(moved(1e-3)).min() > 0.0


# --- bounds that move -------------------------------------------------------------------------


def both_kinds(**changes):
    settings = LawSettings(adaptation="off", **changes)
    bounds = (settings.Kd_min[0], settings.Kd_max[0])
    constant = ConstantGain(settings.Kd[0], bounds, settings.Kd_ramp_per_s)
    return {"self_tuning": SelfTuningGain(settings, 0), "constant": constant}


@pytest.mark.parametrize("kind", ["self_tuning", "constant"])
def test_gain__new_bounds__ramp_at_the_configured_rate_and_arrive_exactly(kind):
    gain = both_kinds(Kd_ramp_per_s=10.0)[kind]
    gain.set_bounds(1.7, 2.9)
    for k in range(1, 200):
        Kd = gain.step(0.1, T)
        assert gain.Kd_min == pytest.approx(min(1.7, 1.0 + 0.01 * k), abs=1e-12)
        assert gain.Kd_max == pytest.approx(max(2.9, 4.0 - 0.01 * k), abs=1e-12)
        assert gain.Kd_min <= Kd <= gain.Kd_max
    assert (gain.Kd_min, gain.Kd_max) == (1.7, 2.9)


@pytest.mark.parametrize("kind", ["self_tuning", "constant"])
def test_gain__skipped_period__ramps_twice_as_far(kind):
    gain = both_kinds(Kd_ramp_per_s=10.0)[kind]
    gain.set_bounds(2.0, 3.0)
    gain.step(0.0, 2 * T)
    assert (gain.Kd_min, gain.Kd_max) == pytest.approx((1.02, 3.98), abs=1e-12)


@given(
    start=st.lists(st.floats(0.1, 8.0), min_size=2, max_size=2).map(sorted),
    goals=st.lists(
        st.lists(st.floats(0.1, 8.0), min_size=2, max_size=2).map(sorted), min_size=1, max_size=4
    ),
    cycles=st.integers(1, 120),
    kind=st.sampled_from(["self_tuning", "constant"]),
)
def test_gain__bounds_moved_again_and_again__never_jump_never_cross(start, goals, cycles, kind):
    gain = both_kinds(
        Kd_min=(start[0],) * 2, Kd_max=(start[1],) * 2, Kd=(2.0, 2.0), Kd_ramp_per_s=20.0
    )[kind]
    for low, high in goals:
        gain.set_bounds(low, high)
        for _ in range(cycles):
            before = (gain.Kd_min, gain.Kd_max)
            Kd = gain.step(0.3, T)
            assert gain.Kd_min <= Kd <= gain.Kd_max
            assert abs(gain.Kd_min - before[0]) <= 0.02 + 1e-12
            assert abs(gain.Kd_max - before[1]) <= 0.02 + 1e-12
    for _ in range(500):
        gain.step(0.3, T)
    assert [gain.Kd_min, gain.Kd_max] == goals[-1]


@pytest.mark.parametrize("narrow", [(2.0, 2.5), (2.2, 2.2), (0.5, 0.6), (6.0, 7.0)])
def test_self_tuning_gain__narrowed_and_widened__returns_to_the_same_surface(narrow):
    gain = tuned(beta=(1.0, 2.0, 4.0))
    before = [gain.step(S, T) for S in (0.0, 0.3, 0.5, 1.0)]
    for goal in (narrow, (1.0, 4.0)):
        gain.set_bounds(*goal)
        for _ in range(1000):
            gain.step(0.3, T)
    after = [gain.step(S, T) for S in (0.0, 0.3, 0.5, 1.0)]
    assert after == pytest.approx(before, abs=1e-9)


def test_self_tuning_gain__configured_without_room_then_widened__has_the_surface_of_its_rules():
    gain, wide = tuned(Kd_min=(2.0, 2.0), Kd_max=(2.0, 2.0)), tuned()
    assert [gain.step(S, T) for S in (0.0, 0.3, 1.0)] == [2.0, 2.0, 2.0]
    gain.set_bounds(1.0, 4.0)
    for _ in range(300):
        gain.step(0.3, T)
    for S in (0.0, 0.2, 0.4, 0.7, 2.0):
        assert gain.step(S, T) == pytest.approx(wide.step(S, T), abs=1e-12)


def test_self_tuning_gain__equal_consequences_without_room_then_widened__stays_at_the_lower_bound():
    gain = tuned(Kd_min=(2.0, 2.0), Kd_max=(2.0, 2.0), beta=(3.0, 3.0, 3.0))
    gain.set_bounds(1.5, 4.0)
    assert [gain.step(0.3, T) for _ in range(300)][-1] == pytest.approx(1.5, abs=1e-12)


def test_self_tuning_gain__narrowed__the_surface_is_scaled_into_the_bounds():
    gain, before = tuned(), tuned()
    gain.set_bounds(2.0, 3.5)
    for _ in range(300):
        gain.step(0.3, T)
    for S in (0.0, 0.2, 0.4, 0.7, 2.0):
        place = (before.step(S, T) - 1.0) / 3.0
        assert gain.step(S, T) == pytest.approx(2.0 + 1.5 * place, abs=1e-12)


def test_self_tuning_gain__turned_round_mid_ramp__returns_to_the_same_surface():
    gain = tuned()
    gain.set_bounds(2.0, 2.0)
    for _ in range(50):
        gain.step(0.3, T)
    assert 1.0 < gain.Kd_min < 2.0
    gain.set_bounds(1.0, 4.0)
    for _ in range(300):
        gain.step(0.3, T)
    assert gain.beta == pytest.approx([1.0, 2.0, 4.0], abs=1e-9)


def test_self_tuning_gain__bounds_moved__adapts_again_afterwards():
    gain = tuned(adaptation="absolute", learning_rate=1e-2)
    gain.set_bounds(1.0, 3.9)
    for _ in range(30):
        gain.step(0.4, T)
    assert gain.Kd_max == 3.9
    before = list(gain.beta)
    for _ in range(20):
        gain.step(0.4, T)
    assert gain.beta[1] < before[1] - 0.01


@pytest.mark.parametrize(("Kd", "used"), [(2.5, 2.5), (0.2, 1.0), (9.0, 4.0)])
def test_constant_gain__any_S__the_constant_within_the_bounds(Kd, used):
    gain = ConstantGain(Kd, (1.0, 4.0), 10.0)
    assert [gain.step(S, T) for S in EXTREMES] == [used] * len(EXTREMES)


def test_constant_gain__narrowed_and_widened__returns_to_the_constant():
    gain = ConstantGain(3.5, (1.0, 4.0), 100.0)
    gain.set_bounds(1.0, 2.0)
    assert [gain.step(0.0, T) for _ in range(40)][-1] == 2.0
    gain.set_bounds(1.0, 4.0)
    assert [gain.step(0.0, T) for _ in range(40)][-1] == 3.5


def test_gain__finite_S__is_always_a_finite_number():
    gain = tuned(adaptation="literal", learning_rate=1e3)
    assert all(math.isfinite(gain.step(S, T)) for S in EXTREMES * 3)
