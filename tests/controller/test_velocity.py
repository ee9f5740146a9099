"""Velocity estimators: exact on ramps, of the right bandwidth, honest about lost lock."""

import cmath
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.errors import ControllerError
from controller.settings import VelocitySettings
from controller.velocity import FilteredDifference, Levant, make_estimator

T = 1e-3
COUNT_RAD = math.tau / 4096


def levant(**changes):
    return Levant(VelocitySettings(estimator="levant", **changes), 2)


def fed(estimator, q_of_t, cycles, dt_s=T, *, start=0):
    """Feed q(t) to both joints (the second mirrored); return the rates, one row a cycle."""
    estimator.reset([q_of_t(start * dt_s), -q_of_t(start * dt_s)])
    rows = []
    for k in range(start + 1, start + cycles + 1):
        q = q_of_t(k * dt_s)
        rows.append(list(estimator.step([q, -q], dt_s)))
    return np.array(rows)


# --- filtered difference ----------------------------------------------------------------------


@pytest.mark.parametrize("dt_s", [1e-3, 2e-3, 5e-3])
def test_filtered_difference__ramp__exact_after_settling(dt_s):
    rates = fed(FilteredDifference(2, 30.0), lambda t: 0.3 + 1.7 * t, round(0.3 / dt_s), dt_s)
    assert rates[-1] == pytest.approx([1.7, -1.7], abs=1e-9)
    assert rates[0, 0] < 1.7


def test_filtered_difference__ramp__approaches_with_the_filters_time_constant():
    rates = fed(FilteredDifference(2, 30.0), lambda t: 2.0 * t, 60)[:, 0]
    t = T * np.arange(1, 61)
    np.testing.assert_allclose(rates, 2.0 * (1.0 - np.exp(-math.tau * 30.0 * t)), atol=1e-9)


def test_filtered_difference__skipped_periods__estimate_as_if_none_was_skipped():
    steady, skipping = FilteredDifference(1, 30.0), FilteredDifference(1, 30.0)
    for estimator in (steady, skipping):
        estimator.reset([0.0])
    for k in range(1, 31):
        steady.step([1.5 * k * T], T)
    k = 0
    for periods in (1, 2, 5, 1, 1, 10, 4, 6):
        k += periods
        skipping.step([1.5 * k * T], periods * T)
    assert k == 30
    assert skipping.dq_rad_s == pytest.approx(steady.dq_rad_s, abs=1e-12)


def amplitude(rates, frequency_Hz):
    """Amplitude of the component at a frequency, over whole cycles."""
    t = T * np.arange(len(rates))
    return 2.0 * abs(np.mean(rates * np.exp(-1j * math.tau * frequency_Hz * t)))


@pytest.mark.parametrize("frequency_Hz", [1.0, 10.0, 30.0, 100.0])
def test_filtered_difference__sine__gain_of_a_first_order_filter(frequency_Hz):
    w = math.tau * frequency_Hz
    estimator = FilteredDifference(2, 30.0)
    rates = fed(estimator, lambda t: math.sin(w * t) / w, 3000, start=0)[1000:3000, 0]
    pole = math.exp(-math.tau * 30.0 * T)
    z = cmath.exp(1j * w * T)
    sampled = (1.0 - pole) / (1.0 - pole / z) * (1.0 - 1.0 / z) / T / (1j * w)
    ideal = 1.0 / math.hypot(1.0, frequency_Hz / 30.0)
    assert amplitude(rates, frequency_Hz) == pytest.approx(abs(sampled), rel=1e-6)
    assert amplitude(rates, frequency_Hz) == pytest.approx(ideal, rel=0.03)


def test_filtered_difference__sine_at_the_cutoff__three_decibels():
    w = math.tau * 30.0
    rates = fed(FilteredDifference(2, 30.0), lambda t: math.sin(w * t) / w, 3000)[1000:3000, 0]
    assert 20.0 * math.log10(amplitude(rates, 30.0)) == pytest.approx(-3.01, abs=0.05)


@pytest.mark.parametrize("make", [lambda: FilteredDifference(2, 30.0), levant])
def test_estimator__new__at_rest_at_zero(make):
    estimator = make()
    assert estimator.dq_rad_s == [0.0, 0.0]
    assert estimator.is_locked
    assert estimator.step([0.0, 0.0], T) == [0.0, 0.0]


@pytest.mark.parametrize("make", [lambda: FilteredDifference(2, 30.0), levant])
def test_estimator__reset__at_rest_and_nothing_of_the_past(make):
    used, fresh = make(), make()
    fed(used, lambda t: 3.0 * t, 50)
    assert used.dq_rad_s != [0.0, 0.0]
    used.reset([1.0, -1.0])
    fresh.reset([1.0, -1.0])
    assert used.dq_rad_s == [0.0, 0.0]
    assert used.is_locked
    for k in range(20):
        q = [1.0 + 1e-3 * k, -1.0 + 2e-3 * k]
        assert used.step(q, T) == fresh.step(q, T)


@pytest.mark.parametrize("make", [lambda: FilteredDifference(2, 30.0), levant])
def test_estimator__reset_far_from_zero__no_jump(make):
    estimator = make()
    estimator.reset([2.5, -1.5])
    for _ in range(10):
        assert estimator.step([2.5, -1.5], T) == [0.0, 0.0]


@pytest.mark.parametrize(
    "make", [lambda: FilteredDifference(2, 30.0), lambda: levant(C_rad_s2=(50.0, 50.0))]
)
def test_estimator__mirrored_joint__exactly_mirrored_rate(make):
    rates = fed(make(), lambda t: 0.3 * math.sin(7.0 * t), 500)
    np.testing.assert_array_equal(rates[:, 0], -rates[:, 1])


@pytest.mark.parametrize("make", [lambda: FilteredDifference(2, 30.0), levant])
@given(q=st.lists(st.floats(-100.0, 100.0), min_size=1, max_size=30))
def test_estimator__any_measurements__finite_rates(make, q):
    estimator = make()
    estimator.reset([0.0, 0.0])
    assert all(math.isfinite(dq) for each in q for dq in estimator.step([each, -each], T))


# --- Levant -----------------------------------------------------------------------------------


def sine(peak_rad_s2, frequency_Hz=1.0):
    """A sine with this peak acceleration."""
    w = math.tau * frequency_Hz
    return lambda t: peak_rad_s2 / w**2 * math.sin(w * t)


@pytest.mark.parametrize("C", [(50.0, 50.0), (120.0, 120.0)])
def test_levant__sine_slower_than_C__converges_to_the_derivative(C):
    estimator, w = levant(C_rad_s2=C), math.tau
    rates = fed(estimator, sine(0.5 * C[0]), 3000)[1000:, 0]
    t = T * np.arange(1001, 3001)
    worst = np.abs(rates - 0.5 * C[0] / w * np.cos(w * t)).max()
    assert worst < 4.0 * 1.1 * C[0] * T  # sliding: a few steps of x1, each 1.1 C T
    assert estimator.is_locked


def test_levant__from_rest_into_a_ramp__locks_on():
    estimator = levant(C_rad_s2=(50.0, 50.0))
    rates = fed(estimator, lambda t: 1.5 * t, 400)
    assert rates[-100:, 0] == pytest.approx(np.full(100, 1.5), abs=3.0 * 1.1 * 50.0 * T)
    assert estimator.is_locked


def test_levant__one_step__the_published_equations():
    estimator = levant(C_rad_s2=(50.0, 80.0))
    estimator.reset([0.0, 0.0])
    estimator.step([-0.01, 0.02], T)  # x0 - q = (0.01, -0.02)
    assert estimator.dq_rad_s == pytest.approx([-1.1 * 50.0 * T, 1.1 * 80.0 * T])
    x0 = [-1.5 * math.sqrt(50.0 * 0.01) * T, 1.5 * math.sqrt(80.0 * 0.02) * T]
    x1 = list(estimator.dq_rad_s)
    estimator.step(x0, T)  # the position estimate is met exactly: x1 stays
    assert estimator.dq_rad_s == pytest.approx(x1, abs=1e-15)
    estimator.step([x0[0] + T * x1[0] - 1e-6, x0[1] + T * x1[1] + 1e-6], T)
    assert estimator.dq_rad_s == pytest.approx([x1[0] - 55.0 * T, x1[1] + 88.0 * T])


@pytest.mark.parametrize("joint", [0, 1])
def test_levant__acceleration_far_above_C__loses_lock_and_says_so(joint):
    estimator = levant(C_rad_s2=(5.0, 5.0))
    estimator.reset([0.0, 0.0])
    q_of_t = sine(100.0)
    lost = []
    for k in range(1, 1000):
        q = [0.0, 0.0]
        q[joint] = q_of_t(k * T)
        estimator.step(q, T)
        lost.append(not estimator.is_locked)
    assert any(lost)


def test_levant__lock_lost_and_motion_over__locks_on_again():
    estimator = levant(C_rad_s2=(20.0, 20.0))
    estimator.reset([0.0, 0.0])
    estimator.step([0.2, 0.0], T)
    assert not estimator.is_locked
    for _ in range(1500):
        estimator.step([0.2, 0.0], T)
    assert estimator.is_locked
    assert estimator.dq_rad_s[0] == pytest.approx(0.0, abs=4.0 * 1.1 * 20.0 * T)


@pytest.mark.parametrize("step", [0.049, 0.051])
def test_levant__position_jump__lock_is_lost_beyond_the_tolerance(step):
    estimator = levant(lock_tolerance_rad=0.05)
    estimator.reset([0.0, 0.0])
    estimator.step([0.0, step], T)
    assert estimator.is_locked == (step < 0.05)


@pytest.mark.parametrize("q", [(math.nan, 0.0), (0.0, math.nan), (math.nan, math.nan)])
def test_levant__not_a_number__is_not_locked_from_then_on(q):
    estimator = levant()
    estimator.reset([0.0, 0.0])
    estimator.step(q, T)
    assert not estimator.is_locked
    estimator.step([0.0, 0.0], T)
    assert not estimator.is_locked
    estimator.reset([0.0, 0.0])
    assert estimator.is_locked


def test_levant__twelve_bit_encoder__stays_within_counts_of_the_true_rate():
    """The platform's case (7.1): C = 50, a sine of 2 rad/s at half that acceleration."""
    estimator, w = levant(C_rad_s2=(50.0, 50.0)), 12.5
    estimator.reset([0.0, 0.0])
    errors = []
    for k in range(1, 3000):
        q = COUNT_RAD * round(2.0 / w * math.sin(w * k * T) / COUNT_RAD)
        estimator.step([q, -q], T)
        errors.append(estimator.dq_rad_s[0] - 2.0 * math.cos(w * k * T))
    assert estimator.is_locked
    assert np.std(errors[500:]) < 0.3


# --- choice -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "kind"), [("filtered_difference", FilteredDifference), ("levant", Levant)]
)
def test_make_estimator__by_name__for_the_number_of_joints(name, kind):
    estimator = make_estimator(VelocitySettings(estimator=name), 2)
    assert type(estimator) is kind
    estimator.reset([0.0, 0.0])
    assert len(estimator.step([0.1, 0.2], T)) == 2


def test_make_estimator__filtered_difference__has_the_configured_cutoff():
    settings = VelocitySettings(cutoff_Hz=10.0)
    made, wanted = make_estimator(settings, 1), FilteredDifference(1, 10.0)
    for estimator in (made, wanted):
        estimator.reset([0.0])
    assert made.step([0.1], T) == wanted.step([0.1], T)


def test_make_estimator__amplifier__there_is_none():
    with pytest.raises(ControllerError, match="no estimator"):
        make_estimator(VelocitySettings(estimator="amplifier"), 2)
