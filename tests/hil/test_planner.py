import copy
import json
import time
from dataclasses import replace
from itertools import accumulate

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.errors import LimitError
from controller.trajectory import MotionLimits, MotionState, approach_duration, kelly
from hil.messages import (
    ExponentialSineRequest,
    KellyRequest,
    MoveRequest,
    RequestError,
    SamplesRequest,
    SinusoidRequest,
    WaypointsRequest,
    parse,
)
from hil.planner import Refusal, plan

T = 1e-3
LIMITS = MotionLimits(
    q_min_rad=(-2.8, -2.8),
    q_max_rad=(2.8, 2.8),
    dq_max_rad_s=(6.0, 8.0),
    ddq_max_rad_s2=(60.0, 90.0),
    dddq_max_rad_s3=(2000.0, 3000.0),
    following_error_rad=(0.6, 0.6),
    max_duration_s=130.0,
)
REST = MotionState.at_rest([0.4, -0.5])
MOVING = MotionState(np.array([0.3, -0.2]), np.array([1.5, -2.0]), np.array([10.0, -5.0]))
ROWS = kelly(0.01, 3.0, 0.5).q_rad.tolist()
REQUESTS = {
    "waypoints": WaypointsRequest(
        times_s=[0, 1, 2.5], points_rad=[[0.1, 0.1], [0.5, -0.5], [0.0, 0.2]]
    ),
    "exponential_sine": ExponentialSineRequest(
        duration_s=4, rate=0.7, b_rad=[0.5, 0.1], c_rad=[0.2, 0.2], w_rad_s=[3, 4]
    ),
    "kelly": KellyRequest(duration_s=5, rate=0.5),
    "sinusoid": SinusoidRequest(
        duration_s=4, center_rad=[0.2, 0], amplitude_rad=[0.3, 0.5], frequency_Hz=[0.5, 0.8]
    ),
    "samples": SamplesRequest(period_s=0.01, q_rad=ROWS),
    "move": MoveRequest(target_rad=[1.0, -1.5]),
}


def assert_state(actual, expected):
    for name in ("q_rad", "dq_rad_s", "ddq_rad_s2"):
        np.testing.assert_allclose(getattr(actual, name), getattr(expected, name), atol=1e-12)


def largest_steps(reference):
    arrays = reference.q_rad, reference.dq_rad_s, reference.ddq_rad_s2
    return [float(np.abs(np.diff(a, axis=0)).max()) for a in arrays]


def refusal(request, state=REST, limits=LIMITS):
    with pytest.raises(Refusal) as e:
        plan(request, state, limits, T)
    assert str(e.value).isprintable()
    return e.value


# --- accepted plans -------------------------------------------------------------------------------


@pytest.mark.parametrize("state", [REST, MOVING], ids=["at rest", "moving"])
@pytest.mark.parametrize("kind", REQUESTS)
def test_plan__every_kind__leads_from_the_present_state_to_rest_within_limits(kind, state):
    reference = plan(REQUESTS[kind], state, LIMITS, T)
    assert_state(reference.start, state)
    assert reference.end.is_at_rest
    assert reference.check(LIMITS) is None
    assert reference.period_s == T


@pytest.mark.parametrize("state", [REST, MOVING], ids=["at rest", "moving"])
@pytest.mark.parametrize("kind", REQUESTS)
def test_plan__every_kind__has_no_jump_in_position_velocity_or_acceleration(kind, state):
    q_step, dq_step, ddq_step = largest_steps(plan(REQUESTS[kind], state, LIMITS, T))
    assert q_step <= 8.0 * T * 1.001
    assert dq_step <= 90.0 * T * 1.001
    assert ddq_step <= 3000.0 * T * 1.01  # the jerk limit; none of these curves exceeds it


@pytest.mark.parametrize("kind", sorted(set(REQUESTS) - {"move"}))
def test_plan__approach_none__starts_with_the_trajectory_itself(kind):
    request = REQUESTS[kind].model_copy(update={"approach": "none"})
    near = MotionState.at_rest([0.0, 0.0])
    whole = plan(REQUESTS[kind], near, LIMITS, T)
    direct = plan(request, near, LIMITS, T)
    assert direct.samples <= whole.samples
    np.testing.assert_array_equal(direct.q_rad, whole.q_rad[-direct.samples :])


def test_plan__kelly_without_approach__is_the_formula_then_a_short_braking():
    reference = plan(KellyRequest(duration_s=20, rate=0.25, approach="none"), REST, LIMITS, T)
    exact = kelly(T, 20.0, 0.25)
    np.testing.assert_array_equal(reference.q_rad[: exact.samples], exact.q_rad)
    assert 0 < reference.samples - exact.samples < 200


def test_plan__present_state_is_the_start__needs_no_approach():
    reference = plan(REQUESTS["kelly"], MotionState.at_rest([0.0, 0.0]), LIMITS, T)
    np.testing.assert_array_equal(reference.q_rad[:5001], kelly(T, 5.0, 0.5).q_rad)


def test_plan__blend__is_not_longer_than_the_limits_ask_for():
    blended = plan(REQUESTS["kelly"], REST, LIMITS, T)
    direct = plan(REQUESTS["kelly"].model_copy(update={"approach": "none"}), REST, LIMITS, T)
    approach_s = blended.duration_s - direct.duration_s
    fastest = plan(MoveRequest(target_rad=[0.0, 0.0]), REST, LIMITS, T).duration_s
    assert fastest - T <= approach_s <= 1.5 * fastest


def test_plan__moving_fast_towards_a_limit__approach_stops_first():
    # One quintic to the start would swing past the limit; braking first has room enough.
    state = MotionState(np.array([2.4, 0.0]), np.array([5.0, 0.0]), np.array([0.0, 0.0]))
    with pytest.raises(LimitError):
        approach_duration(state, kelly(T, 1.0, 0.5).start, LIMITS, T)
    reference = plan(REQUESTS["kelly"], state, LIMITS, T)
    assert reference.check(LIMITS) is None
    assert_state(reference.start, state)
    still = np.abs(reference.dq_rad_s[1:2000]).max(axis=1) < 1e-9
    assert still.any()


def test_plan__outside_the_soft_range__may_come_back_but_not_go_further_out():
    outside = MotionState.at_rest([2.95, 0.0])
    for request in (REQUESTS["kelly"], REQUESTS["move"]):
        reference = plan(request, outside, LIMITS, T)
        assert reference.q_rad[:, 0].max() <= 2.95 + 1e-9
        assert reference.end.q_rad[0] < 2.8
    assert refusal(MoveRequest(target_rad=[2.9, 0.0]), outside).joint == 1


def test_plan__move__arrives_exactly_keeps_every_limit_and_is_synchronised():
    reference = plan(REQUESTS["move"], MOVING, LIMITS, T)
    assert reference.end.q_rad.tolist() == [1.0, -1.5]
    assert reference.check(LIMITS, with_jerk=True) is None
    moving = np.abs(reference.dq_rad_s[-20:-1])
    assert (moving.max(axis=0) > 0).all()


def test_plan__move_at_half_speed__takes_twice_the_time():
    whole = plan(REQUESTS["move"], REST, LIMITS, T)
    slow = plan(REQUESTS["move"].model_copy(update={"speed_scale": 0.5}), REST, LIMITS, T)
    assert slow.duration_s == pytest.approx(2.0 * whole.duration_s, abs=2.5 * T)


def test_plan__slow_move_while_moving__brakes_at_full_limits_first():
    request = MoveRequest(target_rad=[1.0, -1.5], speed_scale=0.1)
    reference = plan(request, MOVING, LIMITS, T)
    assert_state(reference.start, MOVING)
    assert reference.check(LIMITS, with_jerk=True) is None
    at_rest_s = T * np.argmax(np.abs(reference.dq_rad_s).max(axis=1) < 1e-9)
    assert 0.0 < at_rest_s < 0.3
    assert np.abs(reference.dq_rad_s[round(at_rest_s / T) :]).max() <= 0.8


def test_plan__move_to_where_it_stands__is_a_hold():
    reference = plan(MoveRequest(target_rad=[0.4, -0.5]), REST, LIMITS, T)
    assert reference.samples <= 3
    assert np.ptp(reference.q_rad, axis=0).max() < 1e-12


@pytest.mark.parametrize("kind", REQUESTS)
def test_plan__twice__gives_the_same_bytes(kind):
    first, second = (plan(REQUESTS[kind], MOVING, LIMITS, T).rows() for _ in range(2))
    assert first.tobytes() == second.tobytes()


def test_plan__two_minutes_of_two_joints__is_compiled_well_under_a_second():
    rows = kelly(T, 120.0, 0.25).q_rad.tolist()
    times = np.linspace(0.0, 120.0, 2000)
    requests = [
        KellyRequest(duration_s=120, rate=0.25),
        SinusoidRequest(
            duration_s=120, center_rad=[0, 0], amplitude_rad=[1, 1], frequency_Hz=[0.2, 0.3]
        ),
        SamplesRequest(period_s=T, q_rad=rows),
        WaypointsRequest(times_s=times.tolist(), points_rad=np.sin([times, times / 2]).T.tolist()),
    ]
    for request in requests:
        start = time.process_time()
        assert plan(request, REST, LIMITS, T).duration_s > 119.9
        assert time.process_time() - start < 1.0


# --- refusals -------------------------------------------------------------------------------------


def test_plan__waypoint_beyond_the_soft_limit__names_joint_value_limit_and_time():
    request = WaypointsRequest(
        times_s=[0, 1.2, 2.4], points_rad=[[0, 0], [0, 3.4], [0, 0]], request_id="r7"
    )
    refused = refusal(request)
    assert (refused.quantity, refused.joint, refused.limit) == ("position", 2, 2.8)
    assert refused.value == pytest.approx(2.8, abs=0.01)
    assert "joint 2: position 2.80" in str(refused)
    assert "is beyond the soft limit 2.80" in str(refused)
    reply = refused.reply("r7")
    assert (reply.ok, reply.reason, reply.request_id) == (False, str(refused), "r7")
    assert (reply.quantity, reply.joint, reply.limit) == ("position", 2, 2.8)


@pytest.mark.parametrize(
    ("request_", "quantity", "joint", "limit"),
    [
        (KellyRequest(duration_s=10, rate=5), "acceleration", 1, 60.0),
        (
            SinusoidRequest(
                duration_s=5, center_rad=[0, 0], amplitude_rad=[0, 1.4], frequency_Hz=[1, 1]
            ),
            "velocity",
            2,
            8.0,
        ),
        (MoveRequest(target_rad=[-3.0, 0.0]), "position", 1, -2.8),
        (KellyRequest(duration_s=131), "duration", None, 130.0),
        (KellyRequest(duration_s=130), "duration", None, 130.0),
        (MoveRequest(target_rad=[1.0, 1.0], speed_scale=1e-3), "duration", None, 130.0),
        (
            WaypointsRequest(times_s=[0, 1e300], points_rad=[[0, 0], [1, 1]]),
            "duration",
            None,
            130.0,
        ),
        (SamplesRequest(period_s=5.0, q_rad=ROWS), "duration", None, 130.0),
        (MoveRequest(target_rad=[0.1, 0.1, 0.1]), "joints", None, 2),
        (
            WaypointsRequest(times_s=[0, 1], points_rad=[[0], [1]]),
            "joints",
            None,
            2,
        ),
    ],
)
def test_plan__beyond_a_limit__is_refused_with_its_figures(request_, quantity, joint, limit):
    refused = refusal(request_)
    assert (refused.quantity, refused.joint, abs(refused.limit)) == (quantity, joint, abs(limit))
    assert refused.value is not None


def test_plan__approach_none_too_far_away__names_the_distance_and_the_remedy():
    request = KellyRequest(duration_s=5, approach="none")
    refused = refusal(request, MotionState.at_rest([0.0, -0.7]))
    assert (refused.quantity, refused.joint, refused.limit) == ("start", 2, 0.6)
    assert refused.value == pytest.approx(0.7)
    assert 'use approach "blend"' in str(refused)


def test_plan__no_room_for_the_approach__says_so():
    state = MotionState(np.array([2.79, 0.0]), np.array([5.9, 0.0]), np.array([50.0, 0.0]))
    refused = refusal(REQUESTS["kelly"], state)
    assert str(refused).startswith("approach: joint 1: position")


def test_plan__no_room_to_brake_after_the_end__says_so():
    limits = replace(LIMITS, dddq_max_rad_s3=(50.0, 50.0))
    line = np.linspace(0.0, 2.79, 200)
    request = SamplesRequest(period_s=0.01, q_rad=np.stack((line, 0 * line), axis=1).tolist())
    refused = refusal(request, MotionState.at_rest([0.0, 0.0]), limits)
    assert str(refused).startswith("braking at the end: joint 1: position")


@pytest.mark.parametrize(
    "request_",
    [
        WaypointsRequest(times_s=[0, 1], points_rad=[[0, 0], [1]]),
        WaypointsRequest(times_s=[0, 1, 1], points_rad=[[0, 0], [1, 1], [2, 2]]),
        WaypointsRequest(times_s=[1, 2], points_rad=[[0, 0], [1, 1]]),
        WaypointsRequest(times_s=[0, 1, 2], points_rad=[[0, 0], [1, 1]]),
        WaypointsRequest(times_s=[0, 1], points_rad=[[0, 0], [1e308, -1e308]]),
        WaypointsRequest(times_s=[0, 0.5, 1], points_rad=[[0, 0], [1e308, 0], [-1e308, 0]]),
        SamplesRequest(period_s=1e-4, q_rad=[[1e308, -1e308], [-1e308, 0]] * 40),
        ExponentialSineRequest(duration_s=1, b_rad=[1], c_rad=[1, 1], w_rad_s=[1, 1]),
        ExponentialSineRequest(duration_s=1, b_rad=[1, 1], c_rad=[1, 1], w_rad_s=[1e308, 1]),
        SinusoidRequest(
            duration_s=1, center_rad=[0, 0], amplitude_rad=[1e308, 0], frequency_Hz=[9, 9]
        ),
        SinusoidRequest(
            duration_s=1, center_rad=[0, 0], amplitude_rad=[0, 0], frequency_Hz=[500, 1]
        ),
        SinusoidRequest(
            duration_s=1, center_rad=[0, 0], amplitude_rad=[0, 0], frequency_Hz=[1, 1], ramp_s=1e-9
        ),
    ],
)
def test_plan__nothing_that_can_be_followed__is_refused(request_):
    refusal(request_)


@pytest.mark.parametrize("scale", [0.05, 0.01, 0.001])
def test_plan__move_whose_braking_takes_hours__is_refused(scale):
    slow = replace(
        LIMITS,
        dq_max_rad_s=(6.0 * scale, 8.0 * scale),
        ddq_max_rad_s2=(60.0 * scale**2, 90.0 * scale**2),
        dddq_max_rad_s3=(2000.0 * scale**3, 3000.0 * scale**3),
    )
    state = MotionState(np.zeros(2), np.zeros(2), np.array([0.0, 6.0]))
    assert "stop first" in str(refusal(MoveRequest(target_rad=[1.0, 1.0]), state, slow))


@pytest.mark.parametrize("kind", REQUESTS)
def test_plan__present_state_not_finite__is_refused(kind):
    broken = MotionState(np.array([0.0, np.nan]), np.zeros(2), np.zeros(2))
    refusal(REQUESTS[kind], broken)


def test_plan__state_of_another_arm__is_refused():
    assert refusal(REQUESTS["kelly"], MotionState.at_rest([0.0] * 3)).quantity == "joints"
    assert refusal(REQUESTS["move"], MotionState.at_rest([0.0] * 3)).quantity == "joints"


def test_plan__refused__leaves_its_arguments_as_they_were():
    state, request = copy.deepcopy(MOVING), MoveRequest(target_rad=[9.0, 0.0])
    refusal(request, state)
    assert_state(state, MOVING)
    assert request == MoveRequest(target_rad=[9.0, 0.0])


# --- whatever is asked ----------------------------------------------------------------------------


@st.composite
def waypoint_fields(draw, joints, seconds):
    count = draw(st.integers(1, 6))
    gaps = draw(st.lists(seconds, min_size=count - 1, max_size=count))
    times = list(accumulate(gaps, initial=0.0))
    points = draw(st.lists(joints, min_size=len(times), max_size=len(times)))
    return {"kind": "waypoints", "times_s": times, "points_rad": points}


def trajectory_fields(joints, seconds, factor):
    """Fields of a request of any kind, from strategies for a joint list, a time and a number."""
    forms = {
        "kelly": {"duration_s": seconds, "rate": factor},
        "exponential_sine": {
            "duration_s": seconds,
            "rate": factor,
            "b_rad": joints,
            "c_rad": joints,
            "w_rad_s": joints,
        },
        "sinusoid": {
            "duration_s": seconds,
            "center_rad": joints,
            "amplitude_rad": joints,
            "frequency_Hz": joints,
            "phase_rad": joints,
            "ramp_s": seconds,
        },
        "samples": {"period_s": seconds, "q_rad": st.lists(joints, min_size=7, max_size=7)},
        "move": {"target_rad": joints, "speed_scale": factor},
    }
    fixed = [st.fixed_dictionaries({"kind": st.just(k)} | form) for k, form in forms.items()]
    return st.one_of(waypoint_fields(joints, seconds), *fixed)


extreme = st.one_of(
    st.floats(-4.0, 4.0),
    st.floats(allow_nan=False, allow_infinity=False),
    st.sampled_from([0, 1, -0.0, 1e-308, 1e308, -1e308]),
)
wild_joints = st.lists(extreme, min_size=2, max_size=2) | st.lists(extreme, max_size=4)
wild = trajectory_fields(wild_joints, st.floats(0.001, 3.0) | extreme, st.floats(0.1, 1) | extreme)
swing = st.lists(st.floats(-1.7, 1.7), min_size=2, max_size=2)
plausible = trajectory_fields(swing, st.floats(0.2, 3.0), st.floats(0.05, 1.0))
inside = st.lists(st.floats(-2.5, 2.5), min_size=2, max_size=2)
present = st.builds(
    lambda q, dq, ddq: MotionState(np.array(q), np.array(dq), np.array(ddq)),
    inside,
    st.lists(st.floats(-5.0, 5.0), min_size=2, max_size=2),
    st.lists(st.floats(-50.0, 50.0), min_size=2, max_size=2),
)


def assert_kept_or_refused(fields, state):
    try:
        request = parse("trajectory", json.dumps(fields))
        reference = plan(request, state, LIMITS, T)
    except (Refusal, RequestError) as refused:
        assert str(refused).isprintable()  # noqa: PT017 - both outcomes are right
        return
    assert reference.check(LIMITS) is None
    assert reference.end.is_at_rest
    assert reference.duration_s <= LIMITS.max_duration_s
    if fields.get("approach", "blend") == "blend":
        assert_state(reference.start, state)


@settings(max_examples=150, deadline=None)
@given(fields=plausible, approach=st.sampled_from(["blend", "none"]), state=present)
def test_plan__any_plausible_request__keeps_the_limits_or_is_refused(fields, approach, state):
    extra = {} if fields["kind"] == "move" else {"approach": approach}
    assert_kept_or_refused(fields | extra, state)


@settings(max_examples=250, deadline=None)
@given(fields=wild, state=present)
def test_plan__any_wild_request__keeps_the_limits_or_is_refused(fields, state):
    assert_kept_or_refused(fields, state)


@settings(max_examples=80, deadline=None)
@given(target=inside, state=present)
def test_plan__any_move_with_room__keeps_every_limit(target, state):
    try:
        reference = plan(MoveRequest(target_rad=target), state, LIMITS, T)
    except Refusal as refused:
        assert refused.quantity == "position"  # noqa: PT017 - moving too fast to stop in time
        assert np.abs(state.dq_rad_s).max() > 1.0
        return
    assert reference.check(LIMITS, with_jerk=True) is None
    assert reference.end.q_rad.tolist() == target


@settings(max_examples=60, deadline=None)
@given(target=inside, start=inside)
def test_plan__any_rest_to_rest_blend__is_accepted(target, start):
    request = WaypointsRequest(times_s=[0, 3], points_rad=[target, target])
    reference = plan(request, MotionState.at_rest(start), LIMITS, T)
    assert reference.check(LIMITS, with_jerk=True) is None
    assert reference.end.q_rad.tolist() == target
