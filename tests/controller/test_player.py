"""The reference player: exact indexing, and stops that keep to the path and its limits."""

from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.player import ReferencePlayer
from controller.reference import MotionLimits, Reference
from controller.trajectory import Sinusoid, brake, concatenate, kelly, sinusoid

T = 1e-3
AT_REST_PERIODS = 10
"""A stop takes at least so long: 10 periods."""
LIMITS = MotionLimits(
    q_min_rad=(-9.0, -9.0),
    q_max_rad=(9.0, 9.0),
    dq_max_rad_s=(50.0, 50.0),
    ddq_max_rad_s2=(60.0, 60.0),
    dddq_max_rad_s3=(2000.0, 2000.0),
    following_error_rad=(1.0, 1.0),
    max_duration_s=60.0,
)
FAST_SINE = Sinusoid((0.0, 0.0), (1.0, 0.8), (1.0, 1.2), (0.0, 1.0))
MOTIONS = {
    "kelly": (lambda: kelly(T, 6.0, 1.0), (60.0, 60.0)),
    "kelly_4": (lambda: kelly(T, 6.0, 0.25), (60.0, 60.0)),
    "fast_sine": (lambda: sinusoid(T, 4.0, FAST_SINE), (60.0, 60.0)),
    "fast_sine_gently": (lambda: sinusoid(T, 4.0, FAST_SINE), (20.0, 20.0)),
}


@cache
def motion(name):
    """A named motion that ends at rest, as every accepted trajectory does, and its stop limits."""
    make, ddq_max = MOTIONS[name]
    moving = make()
    return concatenate([moving, brake(moving.end, LIMITS, T)]), ddq_max


def flat(reference):
    """The rows as the loop gets them: a flat view of doubles."""
    return memoryview(reference.rows().tobytes()).cast("d")


def playing(reference, *, at=None):
    """A player whose last step returned row `at`."""
    player = ReferencePlayer(reference.joints, reference.period_s)
    player.hold(reference.q_rad[0].tolist())
    player.start(flat(reference), reference.samples)
    for _ in range(-1 if at is None else at + 1):
        player.step(1)
    return player


def collected(player, periods=1):
    """Step to the end; return the reference's times and q, dq, ddq, beginning with the last row."""
    times, setpoints = [player.t_ref_s], [player.setpoint]
    while player.is_moving:
        setpoints.append(player.step(periods))
        times.append(player.t_ref_s)
        assert len(times) < 100_000
    q, dq, ddq = (np.array(column) for column in zip(*setpoints, strict=True))
    return np.array(times), q, dq, ddq


def same(setpoint, reference, row):
    state = reference.state(row)
    return (
        list(setpoint.q_rad) == state.q_rad.tolist()
        and list(setpoint.dq_rad_s) == state.dq_rad_s.tolist()
        and list(setpoint.ddq_rad_s2) == state.ddq_rad_s2.tolist()
    )


# --- indexing ---------------------------------------------------------------------------------


def test_player__new__rests_at_zero():
    player = ReferencePlayer(2, T)
    assert player.step(1) == ([0.0, 0.0], [0.0, 0.0], [0.0, 0.0])
    assert player.t_ref_s == 0.0
    assert not player.is_moving


def test_player__new_or_holding__rests_at_the_pose():
    player = ReferencePlayer(2, T)
    player.hold([0.3, -0.2])
    for periods in (1, 1, 7):
        assert player.step(periods) == ([0.3, -0.2], [0.0, 0.0], [0.0, 0.0])
    assert not player.is_moving
    assert not player.is_stopping


def test_player__motion__every_row_exactly_once_then_holds_the_last():
    reference, _ = motion("kelly")
    player = playing(reference)
    for row in range(reference.samples - 1):
        assert same(player.step(1), reference, row)
        assert player.index == row
        assert player.t_ref_s == row * T
        assert player.is_moving
    end = reference.q_rad[-1].tolist()
    for _ in range(3):
        assert player.step(1) == (end, [0.0, 0.0], [0.0, 0.0])
        assert not player.is_moving
        assert player.t_ref_s == 0.0


@given(st.lists(st.integers(1, 40), min_size=1, max_size=60))
def test_player__skipped_periods__rows_of_the_time_that_passed(steps):
    reference, _ = motion("kelly_4")
    player = playing(reference, at=0)
    for row, periods in zip(np.cumsum(steps).tolist(), steps, strict=True):
        assert same(player.step(periods), reference, row)


def test_player__skipped_past_the_end__holds_the_last_row():
    reference, _ = motion("kelly")
    player = playing(reference, at=reference.samples - 5)
    assert player.step(100).q_rad == reference.q_rad[-1].tolist()
    assert player.setpoint.dq_rad_s == [0.0, 0.0]
    assert not player.is_moving


def test_player__one_row__is_held_at_once():
    pose = Reference(np.array([[0.4, 0.1]]), np.zeros((1, 2)), np.zeros((1, 2)), T)
    player = playing(pose)
    assert player.step(1).q_rad == [0.4, 0.1]
    assert not player.is_moving


def test_player__started_again_mid_motion__plays_the_new_one_from_its_first_row():
    first, second = motion("kelly")[0], motion("fast_sine")[0]
    player = playing(first, at=500)
    player.start(flat(second), second.samples)
    for row in range(5):
        assert same(player.step(1), second, row)


def test_player__held_mid_motion__drops_it():
    player = playing(motion("kelly")[0], at=500)
    player.hold([1.0, 2.0])
    assert not player.is_moving
    assert player.step(1) == ([1.0, 2.0], [0.0, 0.0], [0.0, 0.0])


def test_player__setpoints_kept_by_the_caller__are_not_changed_later():
    player = playing(motion("kelly")[0], at=100)
    kept = player.setpoint
    copied = [list(values) for values in kept]
    player.step(1)
    player.hold([9.0, 9.0])
    assert [list(values) for values in kept] == copied


# --- stops ------------------------------------------------------------------------------------


def stop_rows(name):
    """Rows spread over the whole motion at which to ask for a stop."""
    return range(1, motion(name)[0].samples - 2, 97)


@cache
def stopped(name, row, periods=1):
    reference, ddq_max = motion(name)
    player = playing(reference, at=row)
    player.stop(ddq_max)
    assert player.is_stopping
    return collected(player, periods)


@pytest.mark.parametrize("name", MOTIONS)
def test_stop__anywhere__stays_on_the_path_and_ends_at_rest(name):
    reference, _ = motion(name)
    at = T * np.arange(reference.samples)
    for row in stop_rows(name):
        times, q, dq, ddq = stopped(name, row)
        for joint in range(2):
            on_path = np.interp(times[:-1], at, reference.q_rad[:, joint])
            np.testing.assert_allclose(q[:-1, joint], on_path, atol=1e-5)
        assert np.all(np.diff(times[:-1]) >= 0.0)
        assert np.all(np.diff(times[:-1]) <= T * (1 + 1e-9))
        assert not dq[-1].any()
        assert not ddq[-1].any()


@pytest.mark.parametrize("name", MOTIONS)
def test_stop__anywhere__position_velocity_and_acceleration_belong_together(name):
    """No jump: over each period the mean rate is what the ends' rates say, likewise above it."""
    for row in stop_rows(name):
        _, q, dq, ddq = stopped(name, row)
        slope = np.diff(q, axis=0) / T
        np.testing.assert_allclose(slope, 0.5 * (dq[1:] + dq[:-1]), atol=2e-3)
        steps = np.abs(np.diff(dq, axis=0))
        allowed = T * np.maximum(np.abs(ddq[1:]), np.abs(ddq[:-1])) + 0.02
        assert np.all(steps <= allowed)


@pytest.mark.parametrize("name", MOTIONS)
def test_stop__anywhere__braking_alone_stays_within_the_accelerations_given(name):
    """Braking is what the slowing of the path adds: dq/ds * d2s/dt2, with s the path's time.

    The stop is chosen by looking at seven instants of it, hence the 8 %.
    """
    reference, ddq_max = motion(name)
    at = T * np.arange(reference.samples)
    for row in stop_rows(name):
        times, _, _, _ = stopped(name, row)
        speed = [1.0]
        for advance in np.diff(times[:-1]) / T:
            speed.append(2.0 * advance - speed[-1])  # the phase advances by the mean speed
        slowing = np.diff(speed) / T
        for joint in range(2):
            rate = np.interp(times[1:-1], at, reference.dq_rad_s[:, joint])
            assert np.abs(rate * slowing).max(initial=0.0) <= 1.08 * ddq_max[joint]


@pytest.mark.parametrize("name", MOTIONS)
def test_stop__anywhere__whole_acceleration_near_the_limit(name):
    """The path's own acceleration adds to the braking; measured, by less than a quarter."""
    reference, ddq_max = motion(name)
    most = 1.25 * np.maximum(ddq_max, np.abs(reference.ddq_rad_s2).max(axis=0))
    for row in stop_rows(name):
        _, _, _, ddq = stopped(name, row)
        assert np.all(np.abs(ddq).max(axis=0) <= most)


def test_stop__at_constant_speed__as_hard_as_allowed_and_no_harder():
    t = T * np.arange(3000)[:, None]
    rates = np.array([2.0, -1.0])
    steady = Reference(rates * t, np.tile(rates, (3000, 1)), np.zeros((3000, 2)), T)
    player = playing(steady, at=100)
    player.stop((20.0, 40.0))
    times, _, dq, ddq = collected(player)
    assert np.abs(ddq[:, 0]).max() == pytest.approx(20.0, rel=0.01)
    assert np.abs(ddq[:, 1]).max() == pytest.approx(10.0, rel=0.01)
    assert (len(times) - 1) * T == pytest.approx(1.875 * 2.0 / 20.0, abs=2 * T)
    np.testing.assert_allclose(dq[:, 1], -0.5 * dq[:, 0], atol=1e-12)
    assert np.all(np.diff(dq[:, 0]) <= 1e-12)


def test_stop__at_rest__over_within_the_shortest_time():
    still = Reference(np.full((500, 2), 0.3), np.zeros((500, 2)), np.zeros((500, 2)), T)
    player = playing(still, at=50)
    player.stop((20.0, 40.0))
    times, q, _, _ = collected(player)
    assert len(times) - 1 == pytest.approx(AT_REST_PERIODS, abs=1)
    assert np.all(q == 0.3)


@pytest.mark.parametrize("from_end", [1, 2, 5, 20])
def test_stop__near_the_end__ends_on_the_path_without_a_jump(from_end):
    reference, ddq_max = motion("fast_sine")
    player = playing(reference, at=reference.samples - 1 - from_end)
    player.stop(ddq_max)
    _, q, dq, _ = collected(player)
    assert not dq[-1].any()
    np.testing.assert_allclose(q[-1], reference.q_rad[-1], atol=1e-3)
    assert np.abs(np.diff(dq, axis=0)).max() < 60.0 * T


@pytest.mark.parametrize("periods", [2, 5])
def test_stop__with_skipped_periods__same_path_and_as_long(periods):
    reference, _ = motion("fast_sine")
    each, _, _, _ = stopped("fast_sine", 1500)
    skipping, q, _, _ = stopped("fast_sine", 1500, periods)
    assert (len(skipping) - 1) * periods == pytest.approx(len(each) - 1, abs=periods)
    at = T * np.arange(reference.samples)
    on_path = np.interp(skipping[:-1], at, reference.q_rad[:, 0])
    np.testing.assert_allclose(q[:-1, 0], on_path, atol=1e-4)
    assert skipping[-2] == pytest.approx(each[-2], abs=2e-3)


def test_stop__before_the_first_row__stays_at_its_beginning():
    reference, ddq_max = motion("kelly")
    player = playing(reference)
    player.stop(ddq_max)
    _, q, dq, _ = collected(player)
    np.testing.assert_allclose(q, np.tile(reference.q_rad[0], (len(q), 1)), atol=1e-5)
    assert not dq[-1].any()


def test_stop__asked_for_twice__goes_on_as_it_was():
    reference, ddq_max = motion("fast_sine")
    once, twice = playing(reference, at=1500), playing(reference, at=1500)
    once.stop(ddq_max)
    twice.stop(ddq_max)
    for _ in range(20):
        once.step(1)
        twice.step(1)
    twice.stop((1.0, 1.0))
    np.testing.assert_array_equal(collected(once)[1], collected(twice)[1])


def test_stop__holding__nothing_happens():
    player = ReferencePlayer(2, T)
    player.hold([0.1, 0.2])
    player.stop((1.0, 1.0))
    assert not player.is_stopping
    assert player.step(1).q_rad == [0.1, 0.2]


def test_stop__over__a_new_motion_runs_at_full_speed():
    reference, ddq_max = motion("kelly")
    player = playing(reference, at=700)
    player.stop(ddq_max)
    collected(player)
    player.start(flat(reference), reference.samples)
    for row in range(30):
        assert same(player.step(1), reference, row)
    assert not player.is_stopping


def test_start__while_a_stop_is_under_way__replaces_it_at_full_speed():
    reference, ddq_max = motion("fast_sine")
    player = playing(reference, at=1500)
    player.stop(ddq_max)
    for _ in range(20):
        player.step(1)
    player.start(flat(reference), reference.samples)
    assert not player.is_stopping
    for row in range(30):
        assert same(player.step(1), reference, row)
