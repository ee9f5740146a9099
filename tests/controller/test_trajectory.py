import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import make_interp_spline

from controller.errors import LimitError, TrajectoryError
from controller.settings import LimitSettings
from controller.trajectory import (
    KELLY,
    KELLY_RATES,
    ExponentialSine,
    MotionLimits,
    MotionState,
    Reference,
    Sinusoid,
    approach_duration,
    blend,
    brake,
    concatenate,
    exponential_sine,
    kelly,
    samples,
    sinusoid,
    waypoints,
)

T = 1e-3
LIMITS = MotionLimits(
    q_min_rad=(-2.8, -2.6),
    q_max_rad=(2.8, 2.6),
    dq_max_rad_s=(6.0, 8.0),
    ddq_max_rad_s2=(60.0, 90.0),
    dddq_max_rad_s3=(2000.0, 3000.0),
    following_error_rad=(0.6, 0.6),
    max_duration_s=30.0,
)
SINE = Sinusoid((0.2, -0.3), (0.5, 0.4), (0.5, 1.5), (0.3, -1.0), ramp_s=1.0)
TIMES = [0.0, 0.7, 1.0, 2.5, 3.1]
POINTS = [[0.0, 0.1], [0.4, 0.0], [0.5, -0.2], [-0.3, 0.3], [0.1, 0.1]]


def state(q, dq, ddq):
    return MotionState(np.array(q, float), np.array(dq, float), np.array(ddq, float))


ROWS = kelly(5e-3, 6.0, 0.5).q_rad.tolist()
MOVING = state([0, 0], [1, -1], [3, 4])
KINDS = {  # name -> reference, given the period
    "kelly": lambda period: kelly(period, 8.0, 0.5),
    "sinusoid": lambda period: sinusoid(period, 6.0, SINE),
    "waypoints": lambda period: waypoints(period, TIMES, POINTS),
    "samples": lambda period: samples(period, 5e-3, ROWS),
    "blend": lambda period: blend(MOVING, state([1, 0], [0, 1], [-5, 2]), 0.8, period),
    "brake": lambda period: brake(state([0, 0], [2, -1], [5, 0]), LIMITS, period),
    "joined": lambda period: joined(kelly(period, 3.0, 0.5)),
}


def joined(curve):
    approach = blend(MotionState.at_rest([0.4, -0.5]), curve.start, 0.5, curve.period_s)
    return concatenate([approach, curve, brake(curve.end, LIMITS, curve.period_s)])


def assert_consistent(reference):
    """dq is the slope of q, and ddq that of dq, as far as the samples can tell."""
    for x, dx in (
        (reference.q_rad, reference.dq_rad_s),
        (reference.dq_rad_s, reference.ddq_rad_s2),
    ):
        gap = np.diff(x, axis=0) - 0.5 * reference.period_s * (dx[1:] + dx[:-1])
        bend = np.abs(np.diff(dx, axis=0)).max()
        assert np.abs(gap).max() <= 0.5 * reference.period_s * bend + 1e-12


def assert_c2(make):
    """Steps between samples halve with the period; across a jump they would stay."""
    coarse, fine = make(T), make(T / 2)
    for name in ("q_rad", "dq_rad_s", "ddq_rad_s2"):
        steps = [np.abs(np.diff(getattr(r, name), axis=0)).max(axis=0) for r in (coarse, fine)]
        assert (steps[1] <= 0.55 * steps[0]).all(), name


def assert_same(a, b, atol=1e-12):
    np.testing.assert_allclose(a.q_rad, b.q_rad, rtol=0, atol=atol)
    np.testing.assert_allclose(a.dq_rad_s, b.dq_rad_s, rtol=0, atol=atol)
    np.testing.assert_allclose(a.ddq_rad_s2, b.ddq_rad_s2, rtol=0, atol=atol)


# --- closed forms -----------------------------------------------------------------------------


def test_kelly__any_instant__is_the_written_formula():
    reference = kelly(T, 10.0, 0.25)
    t = 7.0
    s = 0.25 * t
    h = 1.0 - np.exp(-2.0 * s**3)
    expected = [
        np.pi / 4 * h + np.pi / 9 * h * np.sin(4.0 * s),
        np.pi / 3 * h + np.pi / 6 * h * np.sin(3.0 * s),
    ]
    np.testing.assert_allclose(reference.q_rad[7000], expected, rtol=1e-14)
    assert reference.samples == 10_001
    assert reference.duration_s == pytest.approx(10.0)


@pytest.mark.parametrize("rate", KELLY_RATES.values(), ids=KELLY_RATES)
def test_kelly__derivatives__match_differences_of_the_positions(rate):
    reference = kelly(T, 12.0, rate)
    q = reference.q_rad
    dq = (q[2:] - q[:-2]) / (2.0 * T)
    ddq = (q[2:] - 2.0 * q[1:-1] + q[:-2]) / T**2
    np.testing.assert_allclose(reference.dq_rad_s[1:-1], dq, rtol=0, atol=3e-5 * rate**3)
    np.testing.assert_allclose(reference.ddq_rad_s2[1:-1], ddq, rtol=0, atol=3e-4 * rate**2 + 2e-9)


def test_kelly__first_sample__is_zero_at_rest():
    assert_same(kelly(T, 1.0, 1.0).start, MotionState.at_rest([0.0, 0.0]))


def test_exponential_sine__three_joints__keeps_each_joint_apart():
    shape = ExponentialSine((0.1, 0.2, 0.3), (0.0, 0.1, 0.2), (1.0, 2.0, 3.0))
    reference = exponential_sine(T, 30.0, 1.0, shape)
    assert reference.joints == 3
    np.testing.assert_allclose(reference.q_rad[-1, 0], 0.1, atol=1e-12)
    swing = reference.q_rad[15_000:, 2]
    assert swing.max() == pytest.approx(0.5, abs=1e-5)
    assert swing.min() == pytest.approx(0.1, abs=1e-5)


def test_sinusoid__start__is_at_rest_at_the_centre_whatever_the_phase():
    assert_same(sinusoid(T, 2.0, SINE).start, MotionState.at_rest(SINE.center_rad))


def test_sinusoid__after_the_ramp__is_the_plain_sinusoid():
    reference = sinusoid(T, 3.0, SINE)
    t = 2.345
    w = 2.0 * np.pi * np.array(SINE.frequency_Hz)
    wave = np.array(SINE.amplitude_rad) * np.sin(w * t + np.array(SINE.phase_rad))
    np.testing.assert_allclose(reference.q_rad[2345], np.array(SINE.center_rad) + wave, atol=1e-12)
    np.testing.assert_allclose(reference.ddq_rad_s2[2345], -(w**2) * wave, atol=1e-10)


# --- curves through points ----------------------------------------------------------------------


def test_waypoints__points__are_met_at_their_times_and_rest_at_both_ends():
    reference = waypoints(T, TIMES, POINTS)
    at = [round(t / T) for t in TIMES]
    np.testing.assert_allclose(reference.q_rad[at], POINTS, atol=1e-12)
    assert_same(reference.start, MotionState.at_rest(POINTS[0]))
    assert_same(reference.end, MotionState.at_rest(POINTS[-1]))


def test_waypoints__compared_with_scipy__is_the_quintic_spline():
    reference = waypoints(T, TIMES, POINTS)
    rest = [(1, np.zeros(2)), (2, np.zeros(2))]
    spline = make_interp_spline(TIMES, POINTS, k=5, bc_type=(rest, rest))
    t = np.arange(reference.samples) * T
    np.testing.assert_allclose(reference.q_rad, spline(t), atol=1e-11)
    np.testing.assert_allclose(reference.ddq_rad_s2, spline(t, 2), atol=1e-8)


def test_waypoints__two_points__is_the_minimum_jerk_move():
    reference = waypoints(T, [0.0, 2.0], [[0.0], [1.0]])
    u = np.linspace(0.0, 1.0, 2001)
    np.testing.assert_allclose(reference.q_rad[:, 0], u**3 * (10 - 15 * u + 6 * u**2), atol=1e-12)


def test_waypoints__end_between_two_periods__last_sample_is_the_last_point():
    reference = waypoints(T, [0.0, 0.5004], [[0.0], [1.0]])
    assert reference.samples == 502
    assert_same(reference.end, MotionState.at_rest([1.0]))
    assert_consistent(reference)


@settings(max_examples=40, deadline=None)
@given(
    gaps=st.lists(st.floats(0.02, 5.0), min_size=1, max_size=12),
    seed=st.integers(0, 2**32 - 1),
)
def test_waypoints__any_times__is_c2_through_every_point(gaps, seed):
    times = np.concatenate(([0.0], np.cumsum(np.round(gaps, 3))))
    points = np.random.default_rng(seed).uniform(-1.0, 1.0, (len(times), 2))
    reference = waypoints(T, times.tolist(), points.tolist())
    at = np.minimum(np.round(times / T).astype(int), reference.samples - 1)
    scale = 1.0 + np.abs(reference.q_rad).max()
    np.testing.assert_allclose(reference.q_rad[at], points, atol=1e-9 * scale)
    assert_consistent(reference)
    assert_same(reference.start, MotionState.at_rest(points[0]))
    assert_same(reference.end, MotionState.at_rest(points[-1]))


def test_samples__a_quartic__is_reproduced_exactly():
    period = 0.02
    t = np.arange(40) * period
    powers = np.array([[0.3, -1.0], [0.5, 0.2], [-1.0, 0.4], [2.0, -0.7], [0.6, 1.1]])
    given_rows = np.vander(t, 5, increasing=True) @ powers
    reference = samples(T, period, given_rows.tolist())
    fine = np.vander(np.arange(reference.samples) * T, 5, increasing=True)
    k = np.arange(1, 5)
    np.testing.assert_allclose(reference.q_rad, fine @ powers, atol=1e-12)
    np.testing.assert_allclose(
        reference.dq_rad_s, fine[:, :4] @ (powers[1:] * k[:, None]), atol=1e-10
    )
    second = powers[2:] * (np.arange(2, 5) * np.arange(1, 4))[:, None]
    np.testing.assert_allclose(reference.ddq_rad_s2, fine[:, :3] @ second, atol=1e-7)


@pytest.mark.parametrize("sample_period_s", [0.5e-3, 1e-3, 3e-3, 10e-3])
def test_samples__of_a_known_motion__gives_its_derivatives(sample_period_s):
    coarse = kelly(sample_period_s, 6.0, 0.5)
    reference = samples(T, sample_period_s, coarse.q_rad.tolist())
    exact = kelly(T, 6.0, 0.5)
    np.testing.assert_allclose(reference.q_rad, exact.q_rad[: reference.samples], atol=1e-7)
    np.testing.assert_allclose(reference.dq_rad_s, exact.dq_rad_s[: reference.samples], atol=1e-5)
    np.testing.assert_allclose(
        reference.ddq_rad_s2, exact.ddq_rad_s2[: reference.samples], atol=3e-3
    )


# --- continuity ---------------------------------------------------------------------------------


@pytest.mark.parametrize("name", KINDS)
def test_reference__every_kind__is_c2_and_its_derivatives_are_its_slopes(name):
    assert_c2(KINDS[name])
    assert_consistent(KINDS[name](T))


def test_assert_c2__a_small_jump_of_acceleration__is_noticed():
    def broken(period_s):
        reference = kelly(period_s, 4.0, 0.5)
        ddq = reference.ddq_rad_s2.copy()
        ddq[len(ddq) // 2 :] += 0.05
        return Reference(reference.q_rad, reference.dq_rad_s, ddq, period_s)

    with pytest.raises(AssertionError, match="ddq_rad_s2"):
        assert_c2(broken)


# --- joining two motions ------------------------------------------------------------------------

angles = st.lists(st.floats(-2.0, 2.0), min_size=2, max_size=2)
speeds = st.lists(st.floats(-3.0, 3.0), min_size=2, max_size=2)
rates = st.lists(st.floats(-20.0, 20.0), min_size=2, max_size=2)
states = st.builds(state, angles, speeds, rates)


@settings(max_examples=60, deadline=None)
@given(start=states, end=states, duration_s=st.floats(0.01, 5.0))
def test_blend__any_states__meets_both_exactly_and_is_c2(start, end, duration_s):
    reference = blend(start, end, duration_s, T)
    assert_same(reference.start, start, atol=0.0)
    assert_same(reference.end, end, atol=0.0)
    assert_consistent(reference)


@settings(max_examples=60, deadline=None)
@given(start=states, end=states)
def test_approach_duration__any_states__is_within_limits_and_not_longer_than_needed(start, end):
    try:
        duration_s = approach_duration(start, end, LIMITS, T)
    except LimitError:
        fastest = max(np.abs(start.dq_rad_s).max(), np.abs(end.dq_rad_s).max())
        assert fastest > 0.5  # between states nearly at rest there is always a way
        return
    assert blend(start, end, duration_s, T).check(LIMITS, with_jerk=True) is None
    periods = round(duration_s / T)
    shorter = int(periods / 1.02) - 1
    if shorter > 10:
        assert blend(start, end, shorter * T, T).check(LIMITS, with_jerk=True) is not None


def test_approach_duration__from_rest_to_rest__follows_from_the_peak_of_the_quintic():
    # Peak velocity 15/8 d/D, acceleration 10/sqrt(3) d/D^2, jerk 60 d/D^3.
    start, end = MotionState.at_rest([0.0, 0.0]), MotionState.at_rest([2.0, 0.1])
    by_limit = 15 / 8 * 2 / 6.0, np.sqrt(10 / np.sqrt(3) * 2 / 60.0), np.cbrt(60 * 2 / 2000.0)
    assert approach_duration(start, end, LIMITS, T) == pytest.approx(max(by_limit), abs=2.1 * T)


def test_approach_duration__next_to_nothing__takes_a_few_periods():
    start, end = MotionState.at_rest([0.0, 0.0]), MotionState.at_rest([1e-6, 0.0])
    assert approach_duration(start, end, LIMITS, T) == pytest.approx(10 * T)


def test_approach_duration__end_beyond_the_soft_limit__names_joint_and_limit():
    start, end = MotionState.at_rest([0.0, 0.0]), MotionState.at_rest([0.0, 2.7])
    with pytest.raises(LimitError, match=r"^joint 2: position .* beyond the soft limit 2\.6") as e:
        approach_duration(start, end, LIMITS, T)
    assert (e.value.violation.joint, e.value.violation.limit) == (2, 2.6)


@settings(max_examples=60, deadline=None)
@given(start=states)
def test_brake__any_state__comes_to_rest_within_limits(start):
    try:
        reference = brake(start, LIMITS, T)
    except LimitError:
        room = 2.6 - np.abs(start.q_rad).max()
        assert room < 1.0  # enough to stop from 3 rad/s and 20 rad/s^2
        return
    assert_same(reference.start, start, atol=0.0)
    assert reference.end.is_at_rest
    assert reference.check(LIMITS, with_jerk=True) is None
    assert_consistent(reference)


def test_brake__velocity__falls_along_a_cubic():
    reference = brake(state([0, 0], [2, -1], [5, 0]), LIMITS, T)
    assert np.abs(np.diff(reference.dq_rad_s, n=4, axis=0)).max() < 1e-12


def test_brake__no_room__is_refused_with_the_position_limit():
    with pytest.raises(LimitError) as e:
        brake(state([2.75, 0.0], [5.0, 0.0], [0.0, 0.0]), LIMITS, T)
    assert e.value.violation.joint == 1


# --- joining references -------------------------------------------------------------------------


def test_concatenate__pieces_that_meet__keeps_the_common_sample_once():
    curve = kelly(T, 3.0, 0.5)
    whole = joined(curve)
    np.testing.assert_array_equal(whole.q_rad[500:3501], curve.q_rad)
    np.testing.assert_array_equal(whole.ddq_rad_s2[500:3501], curve.ddq_rad_s2)


@pytest.mark.parametrize("name", ["q_rad", "dq_rad_s", "ddq_rad_s2"])
def test_concatenate__a_jump_at_the_join__is_an_error_that_names_it(name):
    values = {"q_rad": [0.0, 0.0], "dq_rad_s": [0.0, 0.0], "ddq_rad_s2": [0.0, 0.0]}
    values[name] = [0.0, 1e-6]
    curve = kelly(T, 1.0, 0.5)
    approach = blend(MotionState.at_rest([0.1, 0.1]), state(*values.values()), 0.5, T)
    with pytest.raises(TrajectoryError, match=name):
        concatenate([approach, curve])


def test_concatenate__other_period_or_nothing__is_an_error():
    with pytest.raises(TrajectoryError, match="one period"):
        concatenate([kelly(T, 1.0, 0.5), kelly(2 * T, 1.0, 0.5)])
    with pytest.raises(TrajectoryError, match="no reference"):
        concatenate([])


# --- the check ----------------------------------------------------------------------------------


def line(q, dq=0.0, ddq=0.0, period_s=T):
    """Return ten samples of two joints, the second of which moves as given at sample 6."""
    values = [np.zeros((10, 2)) for _ in range(3)]
    for array, value in zip(values, (q, dq, ddq), strict=True):
        array[6:, 1] = value
    return Reference(*values, period_s)


@pytest.mark.parametrize(
    ("reference", "quantity", "value", "limit", "time_s"),
    [
        (line(3.4, period_s=1.0), "position", 3.4, 2.6, 6.0),
        (line(-3.4, period_s=1.0), "position", -3.4, -2.6, 6.0),
        (line(0.0, dq=-8.5, period_s=1.0), "velocity", -8.5, -8.0, 6.0),
        (line(0.0, ddq=91.0), "acceleration", 91.0, 90.0, 6e-3),
        (line(0.1), "velocity", 100.0, 8.0, 5e-3),
        (line(0.0, dq=1.0), "acceleration", 1000.0, 90.0, 5e-3),
    ],
    ids=["above", "below", "velocity", "acceleration", "q jumps", "dq jumps"],
)
def test_check__beyond_a_limit__says_which_where_and_when(
    reference, quantity, value, limit, time_s
):
    violation = reference.check(LIMITS)
    assert violation is not None
    assert (violation.quantity, violation.joint) == (quantity, 2)
    assert (violation.value, violation.limit) == (pytest.approx(value), limit)
    assert violation.time_s == pytest.approx(time_s)


def test_check__motion_between_two_samples__does_not_hide():
    step = waypoints(T, [0.0, T], [[0.0, 0.0], [0.5, 0.0]])  # at rest at both samples
    violation = step.check(LIMITS)
    assert violation is not None
    assert (violation.quantity, violation.value) == ("velocity", pytest.approx(500.0))


def test_check__jerk__is_checked_on_demand_only():
    reference = line(0.0, ddq=50.0)
    assert reference.check(LIMITS) is None
    violation = reference.check(LIMITS, with_jerk=True)
    assert violation is not None
    assert violation.quantity == "jerk"


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("name", ["q_rad", "dq_rad_s", "ddq_rad_s2"])
def test_check__not_finite__is_a_violation(name, value):
    arrays = {n: np.zeros((10, 2)) for n in ("q_rad", "dq_rad_s", "ddq_rad_s2")}
    arrays[name][4, 0] = value
    with np.errstate(invalid="ignore"):
        violation = Reference(**arrays, period_s=T).check(LIMITS)
    assert violation is not None
    assert violation.joint == 1
    assert not np.isfinite(violation.value)
    assert "not a finite number" in str(violation)


def test_check__two_violations__reports_the_first_in_time():
    q = np.zeros((3000, 2))
    q[2000:, 0] = 5.0
    q[1200:, 1] = 3.4
    violation = Reference(q, np.zeros_like(q), np.zeros_like(q), 1.0).check(LIMITS)
    assert violation is not None
    assert (violation.joint, violation.time_s) == (2, 1200.0)


def test_violation__as_text__reads_as_one_line():
    times = np.arange(3) * 1.2
    q = np.array([[0.0, 0.0], [0.0, 3.4], [0.0, 3.4]])
    reference = Reference(q, np.zeros_like(q), np.zeros_like(q), float(times[1]))
    expected = "joint 2: position 3.40 rad at t = 1.20 s is beyond the soft limit 2.60 rad"
    assert str(reference.check(LIMITS)) == expected


def test_violation__hardly_beyond__shows_enough_decimals_to_tell():
    q = np.array([[0.0, 2.60004]])
    violation = Reference(q, np.zeros_like(q), np.zeros_like(q), T).check(LIMITS)
    assert "position 2.60004 rad" in str(violation)
    assert "limit 2.60000 rad" in str(violation)


def test_check__along_the_limit__rounding_is_no_violation():
    q = np.full((3, 2), 2.6 * (1.0 + 1e-12))
    assert Reference(q, np.zeros_like(q), np.zeros_like(q), T).check(LIMITS) is None


def test_check__limits_of_another_arm__is_an_error():
    with pytest.raises(TrajectoryError, match="2 joints, 3 in reference"):
        Reference(*(np.zeros((2, 3)),) * 3, T).check(LIMITS)


def test_admitting__pose_outside__widens_that_side_only():
    room = LIMITS.admitting(np.array([3.0, 0.0]))
    assert room.q_max_rad == (3.0, 2.6)
    assert room.q_min_rad == LIMITS.q_min_rad


def test_motion_limits__from_settings__takes_every_field():
    fields = ("q_min_rad", "q_max_rad", "dq_max_rad_s", "ddq_max_rad_s2", "dddq_max_rad_s3")
    fields += ("following_error_rad",)
    given_values = {name: (float(i), i + 0.5) for i, name in enumerate(fields)}
    rest = dict.fromkeys(
        ("dq_trip_rad_s", "tau_max_Nm", "tau_slew_Nm_s", "damping_Nms_rad"), (1.0, 1.0)
    )
    limits = MotionLimits.of(LimitSettings(**given_values, **rest), 7.0)
    assert {name: getattr(limits, name) for name in fields} == given_values
    assert limits.max_duration_s == 7.0


# --- references as values -----------------------------------------------------------------------


def test_reference__arrays__cannot_be_changed_through_it():
    source = np.zeros((3, 2))
    reference = Reference(source, source, source, T)
    with pytest.raises(ValueError, match="read-only"):
        reference.q_rad[0, 0] = 1.0
    source[0, 0] = 1.0  # the caller's array is left as it was


def test_reference__rows__are_q_dq_ddq_side_by_side():
    reference = kelly(T, 1.0, 1.0)
    rows = reference.rows()
    assert rows.shape == (1001, 6)
    np.testing.assert_array_equal(rows[:, 2:4], reference.dq_rad_s)


@pytest.mark.parametrize(
    "make",
    [
        lambda: Reference(np.zeros((2, 2)), np.zeros((2, 2)), np.zeros((3, 2)), T),
        lambda: Reference(*(np.zeros((0, 2)),) * 3, T),
        lambda: Reference(*(np.zeros((2, 2)),) * 3, 0.0),
        lambda: MotionState(np.zeros(2), np.zeros(2), np.zeros(3)),
        lambda: kelly(T, 0.0, 1.0),
        lambda: kelly(0.0, 1.0, 1.0),
        lambda: kelly(T, float("inf"), 1.0),
        lambda: kelly(T, 1.0, -1.0),
        lambda: kelly(T, 1.0, 500.0),
        lambda: exponential_sine(T, 1.0, 1.0, ExponentialSine((1.0,), (1.0, 2.0), (1.0,))),
        lambda: exponential_sine(T, 1.0, 1.0, ExponentialSine((1.0,), (1.0,), (1000.0,))),
        lambda: sinusoid(T, 1.0, Sinusoid((0.0,), (0.1,), (1000.0,), (0.0,))),
        lambda: sinusoid(T, 1.0, Sinusoid((0.0,), (0.1,), (1.0,), (0.0,), ramp_s=1e-3)),
        lambda: waypoints(T, [0.0], [[0.0]]),
        lambda: waypoints(T, [0.0, 1.0], [[0.0]]),
        lambda: waypoints(T, [0.5, 1.0], [[0.0], [1.0]]),
        lambda: waypoints(T, [0.0, 1.0, 1.0], [[0.0], [1.0], [1.0]]),
        lambda: waypoints(T, [0.0, 1.0, 0.5], [[0.0], [1.0], [1.0]]),
        lambda: waypoints(T, [0.0, 1.0, float("nan")], [[0.0], [1.0], [1.0]]),
        lambda: waypoints(T, [0.0, 1.0], [[0.0], [1.0, 2.0]]),
        lambda: samples(T, T, [[0.0]] * 4),
        lambda: samples(T, 0.0, [[0.0]] * 5),
        lambda: samples(T, 1e-4, [[0.0]] * 5),
        lambda: samples(T, T, [[], [], [], [], []]),
    ],
)
def test_trajectory__arguments_that_define_no_motion__is_an_error(make):
    with pytest.raises(TrajectoryError):
        make()


@pytest.mark.parametrize("name", KINDS)
def test_trajectory__same_arguments__same_bytes(name):
    assert KINDS[name](T).rows().tobytes() == KINDS[name](T).rows().tobytes()


def test_kelly__shape__is_the_published_one():
    assert KELLY.b_rad == pytest.approx((0.785398, 1.047198), abs=1e-6)
    assert KELLY.c_rad == pytest.approx((0.349066, 0.523599), abs=1e-6)
    assert KELLY.w_rad_s == (4.0, 3.0)
    assert dict(KELLY_RATES) == {"kelly": 1.0, "kelly_2": 0.5, "kelly_4": 0.25}
