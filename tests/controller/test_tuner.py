"""The tuner with the load memory: its rules written out again, its bounds, its symmetry."""

import math
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from controller.gain import SelfTuningGain
from controller.law import PassivityLaw
from controller.player import Setpoint
from controller.settings import LawSettings
from controller.tuner import LoadMemoryGain

T = 1e-3
LOW, HIGH, KNEE, MEMORY_S, PLACE = 1.0, 4.0, 0.5, 0.02, 0.4
NEUTRAL, PLATEAU = LOW + PLACE * (HIGH - LOW), HIGH * KNEE
TINY = sys.float_info.min * sys.float_info.epsilon  # the smallest subnormal
HUGE = sys.float_info.max
ANY_S = st.floats(allow_nan=False, allow_infinity=False)
USUAL_S = st.floats(-5.0, 5.0)
RUNS_OF_S = st.lists(ANY_S | USUAL_S | st.sampled_from([0.0, -0.0, TINY, -TINY, HUGE, -HUGE]))
BOUNDS = st.tuples(st.floats(0.1, 8.0), st.floats(0.1, 8.0)).map(sorted)
LOADS = st.floats(-PLATEAU, PLATEAU)


def tuned(**changes):
    return LoadMemoryGain(LawSettings(**changes), 0)


def with_load(load_Nm, **changes):
    gain = tuned(**changes)
    gain.load_Nm = load_Nm
    return gain


def torque(S, load_Nm):
    """Kd S of one step with a given memory."""
    return with_load(load_Nm).step(S, T) * S


def ruled(S, load_Nm):
    """The gain by its rules: degrees of opposing, neutral and carrying, consequences, ceiling."""
    r = load_Nm / S
    opposing = min(1.0, max(0.0, -r / (NEUTRAL - LOW)))
    carrying = min(1.0, max(0.0, r / (HIGH - NEUTRAL)))
    degrees = np.array([opposing, 1.0 - opposing - carrying, carrying])
    assert degrees.min() >= 0.0
    ceiling = max(LOW, HIGH * min(1.0, KNEE / abs(S)))
    return min(float(degrees @ [LOW, NEUTRAL, HIGH]), ceiling)


# --- the rules ----------------------------------------------------------------------------------


@given(USUAL_S.filter(lambda S: abs(S) > 1e-9), LOADS)
def test_step__any_S_and_load__is_the_sum_of_the_rules(S, load_Nm):
    assert with_load(load_Nm).step(S, T) == pytest.approx(ruled(S, load_Nm), rel=1e-9)


@pytest.mark.parametrize(
    ("S", "load_Nm", "Kd"),
    [
        (0.1, 0.0, NEUTRAL),
        (0.1, 0.1, NEUTRAL + 1.0),
        (0.1, 1.0, HIGH),
        (0.1, -0.05, NEUTRAL - 0.5),
        (0.1, -1.0, LOW),
        (0.8, 2.0, PLATEAU / 0.8),
        (5.0, 2.0, LOW),
        (0.0, 2.0, NEUTRAL),
    ],
)
def test_step__one_rule_or_two_in_force__gives_its_gain(S, load_Nm, Kd):
    assert with_load(load_Nm).step(S, T) == pytest.approx(Kd, rel=1e-12)


@given(LOADS, USUAL_S, USUAL_S)
def test_torque__for_a_given_load__rises_with_S_and_never_faster_than_Kd_max(load_Nm, a, b):
    low, high = min(a, b), max(a, b)
    rise = torque(high, load_Nm) - torque(low, load_Nm)
    assert -1e-12 <= rise <= HIGH * (high - low) + 1e-12


@given(LOADS, ANY_S)
def test_torque__any_S__stays_below_the_plateau_or_the_least_gain(load_Nm, S):
    S /= 2.0 * LawSettings().Kd_ceiling  # so that the torque is a number
    assert abs(torque(S, load_Nm)) <= max(PLATEAU, LOW * abs(S)) * (1.0 + 1e-12)


# --- the memory ---------------------------------------------------------------------------------


@given(st.lists(USUAL_S, min_size=1, max_size=50), st.floats(1e-4, 0.019))
def test_load__any_run__is_the_filtered_torque(run, dt_s):
    gain, load = tuned(), 0.0
    for S in run:
        taken = gain.step(S, dt_s) * S
        load += dt_s / MEMORY_S * (max(-PLATEAU, min(PLATEAU, taken)) - load)
        assert gain.load_Nm == pytest.approx(load, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("dt_s", [MEMORY_S, 1.0])
def test_load__a_step_as_long_as_the_memory__holds_the_last_torque(dt_s):
    gain = with_load(-1.0)
    Kd = gain.step(0.3, dt_s)
    assert gain.load_Nm == Kd * 0.3


def test_gain__constant_S__rises_to_Kd_max():
    gain = tuned()
    gains = [gain.step(0.1, T) for _ in range(60)]
    assert gains[0] == pytest.approx(NEUTRAL)
    assert gains == sorted(gains)
    assert gains[-1] == HIGH
    assert gain.step(-0.01, T) == LOW  # against the load that it now remembers


def test_gain__S_gone__forgets_the_load_within_a_few_memories():
    gain = with_load(1.0)
    for _ in range(round(10 * MEMORY_S / T)):
        gain.step(0.0, T)
    assert abs(gain.load_Nm) < 1e-4


def test_reset__after_a_run__starts_like_new():
    gain, fresh = tuned(), tuned()
    for _ in range(50):
        gain.step(0.2, T)
    gain.reset()
    run = [0.3, -0.1, 0.7, -2.0]
    assert [gain.step(S, T) for S in run] == [fresh.step(S, T) for S in run]


# --- bounds and symmetry ------------------------------------------------------------------------


@given(RUNS_OF_S, BOUNDS, st.floats(1e-6, 10.0))
def test_step__any_run__keeps_Kd_and_load_within_bounds(run, bounds, dt_s):
    gain = tuned(Kd_min=bounds[:1], Kd_max=bounds[1:])
    for S in run:
        assert bounds[0] <= gain.step(S, dt_s) <= bounds[1]
        assert abs(gain.load_Nm) <= bounds[1] * KNEE


@pytest.mark.parametrize("S", [math.nan, math.inf, -math.inf])
def test_step__S_not_finite__bounded_and_not_remembered_as_such(S):
    gain = with_load(0.5)
    assert LOW <= gain.step(S, T) <= HIGH
    assert abs(gain.load_Nm) <= PLATEAU
    assert LOW <= gain.step(0.1, T) <= HIGH


@given(RUNS_OF_S)
def test_step__mirrored_run__same_gains_and_opposite_load_to_the_last_bit(run):
    gain, mirrored = tuned(), tuned()
    assert [gain.step(S, T) for S in run] == [mirrored.step(-S, T) for S in run]
    assert gain.load_Nm == -mirrored.load_Nm


@given(RUNS_OF_S, BOUNDS)
def test_set_bounds__any_run__bounds_ramp_and_hold(run, goal):
    gain = tuned()
    reach = LawSettings().Kd_ramp_per_s * T
    gain.set_bounds(*goal)
    low, high = LOW, HIGH
    for S in run:
        Kd = gain.step(S, T)
        assert abs(gain.Kd_min - low) <= reach * (1 + 1e-9)
        assert abs(gain.Kd_max - high) <= reach * (1 + 1e-9)
        low, high = gain.Kd_min, gain.Kd_max
        assert low <= Kd <= high
        assert abs(gain.load_Nm) <= high * KNEE


def test_set_bounds__reached__neutral_gain_keeps_its_place_and_load_its_limit():
    gain = with_load(PLATEAU)
    gain.set_bounds(0.5, 1.0)
    steps = math.ceil((HIGH - 1.0) / (LawSettings().Kd_ramp_per_s * T)) + 1
    for _ in range(steps):
        gain.step(4.0, T)
    assert (gain.Kd_min, gain.Kd_max) == (0.5, 1.0)
    assert gain.load_Nm == pytest.approx(1.0 * KNEE)
    gain.reset()
    assert gain.step(0.1, T) == pytest.approx(0.5 + PLACE * 0.5)


@pytest.mark.parametrize("place", [-0.1, 1.1])
def test_settings__neutral_gain_outside_its_bounds__refused(place):
    with pytest.raises(ValidationError, match="load_neutral"):
        LawSettings(load_neutral=place)


# --- in the loop --------------------------------------------------------------------------------


@given(st.lists(st.floats(-1.0, 1.0), max_size=200), st.floats(-3.0, 3.0))
def test_loop__any_bounded_load__S_stays_within_load_over_Kd_min(loads, S0):
    """Proposition 1, one joint: H dS = -Kd S + D with |D| <= 1 holds |S| <= max(|S0|, 1/Kd_min)."""
    gain, S, inertia = tuned(), S0, 0.1
    for load in loads:
        S += T / inertia * (load - gain.step(S, T) * S)
        assert abs(S) <= max(abs(S0), 1.0 / LOW) * (1.0 + 1e-12)


@given(st.lists(st.floats(-2.0, 2.0), min_size=1, max_size=300))
def test_sigma__any_S_below_a_bound__stays_below_that_bound_over_Ki(run):
    """S = S_q + Ki sigma: beyond |S| / Ki, S_q has the sign that brings sigma back."""
    settings = LawSettings(tuner="load_memory", Ki=(5.0, 5.0))
    law = PassivityLaw(settings, (1e9, 1e9))
    bound, sigma, at_rest = 2.0 / 5.0 + T, [0.0, 0.0], [0.0, 0.0]
    for S in run:
        S_q = [S - 5.0 * s for s in sigma]
        law.step(at_rest, S_q, Setpoint(at_rest, at_rest, at_rest), T)
        assert law.sigma == pytest.approx(sigma, abs=1e-12)
        sigma = [s + T * math.tanh(10.0 * x) for s, x in zip(sigma, S_q, strict=True)]
        assert max(map(abs, sigma)) <= bound


def mean_S(gain, load_Nm, noise):
    """Mean of S, without the noise, of H dS = -Kd (S + noise) + load, when it has settled."""
    S, inertia, settled = 0.0, 0.1, []
    for n in noise:
        S += T / inertia * (load_Nm - gain(S + n, T) * (S + n))
        settled.append(S)
    return float(np.mean(settled[len(settled) // 2 :]))


def test_loop__noise_without_mean_on_S__carries_the_load_in_place_of_the_error():
    noise = np.tile(np.repeat([0.12, -0.12], 3), 600)
    load_Nm = 0.08
    least = load_Nm / HIGH
    assert mean_S(lambda _S, _dt: HIGH, load_Nm, noise) == pytest.approx(least, rel=0.02)
    assert abs(mean_S(tuned().step, load_Nm, noise)) < 0.2 * least


def test_loop__no_noise__load_meets_the_greatest_gain():
    assert mean_S(tuned().step, 0.08, np.zeros(4000)) == pytest.approx(0.08 / HIGH, rel=1e-6)


def test_law__load_memory_chosen__torque_is_exactly_minus_Kd_S():
    law = PassivityLaw(LawSettings(tuner="load_memory"), (15.0, 8.0))
    random, still = np.random.default_rng(2), [0.0, 0.0]
    assert all(type(gain) is LoadMemoryGain for gain in law.gains)
    for dq in random.normal(0.0, 0.3, (200, 2)).tolist():
        tau = law.step(still, dq, Setpoint(still, still, still), T)
        assert tau == [-Kd * S for Kd, S in zip(law.Kd, law.S, strict=True)]
    law.reset()
    assert [gain.load_Nm for gain in law.gains] == [0.0, 0.0]


@pytest.mark.parametrize("name", ["self_tuning_pid", "self_tuning_pd"])
def test_law__by_default__is_tuned_as_in_the_paper(name):
    law = PassivityLaw(LawSettings(name=name), (15.0, 8.0))
    assert all(type(gain) is SelfTuningGain for gain in law.gains)
