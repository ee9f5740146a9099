"""Limits of every cycle: what is sent never passes them, what is measured is judged in order."""

import itertools
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.errors import CommandError
from controller.faults import FaultCode
from controller.limits import MotionGuard, TorqueLimiter, limit_torque
from controller.settings import LimitSettings

T = 1e-3
NOT_FINITE = [math.nan, math.inf, -math.inf]
TORQUES = st.floats(-1e6, 1e6) | st.floats(allow_nan=False, allow_infinity=False)


def settings(**changes):
    values = {
        "q_min_rad": (-1.0, -1.0),
        "q_max_rad": (2.0, 2.0),
        "hard_margin_rad": 0.1,
        "dq_max_rad_s": (3.0, 3.0),
        "dq_trip_rad_s": (5.0, 5.0),
        "ddq_max_rad_s2": (60.0, 60.0),
        "dddq_max_rad_s3": (2000.0, 2000.0),
        "tau_max_Nm": (15.0, 8.0),
        "tau_slew_Nm_s": (1000.0, 500.0),
        "following_error_rad": (0.5, 0.5),
        "damping_Nms_rad": (1.0, 1.0),
    }
    return LimitSettings(**{**values, **changes})


# --- what is sent -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("wanted", "sent"), [(0.0, 0.0), (7.9, 7.9), (8.1, 8.0), (-8.1, -8.0), (1e300, 8.0)]
)
def test_limit_torque__any_finite__clipped(wanted, sent):
    assert limit_torque(wanted, tau_max_Nm=8.0) == sent


@pytest.mark.parametrize("torque", NOT_FINITE)
def test_limit_torque__not_finite__refused(torque):
    with pytest.raises(CommandError):
        limit_torque(torque, tau_max_Nm=8.0)


def test_torque_limiter__step_command__slews_then_rests_at_the_limit():
    limiter = TorqueLimiter(settings())
    sent = [limiter.step([100.0, -100.0], T) for _ in range(20)]
    assert [s[0] for s in sent] == pytest.approx([min(15.0, 1.0 * k) for k in range(1, 21)])
    assert [s[1] for s in sent] == pytest.approx([max(-8.0, -0.5 * k) for k in range(1, 21)])


def test_torque_limiter__beyond_the_limit_then_back__slews_from_the_limit_not_from_the_request():
    limiter = TorqueLimiter(settings())
    for _ in range(30):
        limiter.step([1000.0, 0.0], T)
    assert limiter.step([0.0, 0.0], T)[0] == pytest.approx(15.0 - 1.0)


def test_torque_limiter__skipped_period__slews_twice_as_far():
    assert TorqueLimiter(settings()).step([10.0, -10.0], 2 * T) == pytest.approx([2.0, -1.0])


def test_torque_limiter__within_all_limits__passed_on_unchanged():
    limiter = TorqueLimiter(settings())
    assert limiter.step([0.7, -0.3], T) == [0.7, -0.3]
    assert limiter.tau_sent_Nm == [0.7, -0.3]


def test_torque_limiter__reset__slews_from_zero():
    limiter = TorqueLimiter(settings())
    for _ in range(20):
        limiter.step([15.0, 8.0], T)
    limiter.reset()
    assert limiter.tau_sent_Nm == [0.0, 0.0]
    assert limiter.step([15.0, 8.0], T) == pytest.approx([1.0, 0.5])


@pytest.mark.parametrize("joint", [0, 1])
@pytest.mark.parametrize("torque", NOT_FINITE)
def test_torque_limiter__not_finite__refused_and_nothing_changes(torque, joint):
    limiter = TorqueLimiter(settings())
    limiter.step([0.9, 0.4], T)
    command = [1.5, 0.8]
    command[joint] = torque
    with pytest.raises(CommandError):
        limiter.step(command, T)
    assert limiter.tau_sent_Nm == [0.9, 0.4]
    assert limiter.step([1.5, 0.8], T) == pytest.approx([1.5, 0.8])


@given(st.lists(st.tuples(TORQUES, TORQUES, st.integers(1, 5)), min_size=1, max_size=30))
def test_torque_limiter__any_commands__never_beyond_torque_or_slew(commands):
    limiter = TorqueLimiter(settings())
    before = [0.0, 0.0]
    for first, second, periods in commands:
        sent = limiter.step([first, second], periods * T)
        for j, (tau_max, slew) in enumerate(((15.0, 1000.0), (8.0, 500.0))):
            assert abs(sent[j]) <= tau_max
            assert abs(sent[j] - before[j]) <= slew * periods * T * (1.0 + 1e-12)
            wanted = max(-tau_max, min(tau_max, (first, second)[j]))
            reached = abs(sent[j] - wanted) < 1e-9
            assert reached or (sent[j] - before[j]) * (wanted - before[j]) > 0.0  # on the way
        before = sent


# --- what is measured -------------------------------------------------------------------------

INSIDE = (0.3, 1.0, 0.2)  # q, dq, q_des
CASES = [  # what a joint does, the verdict, the value and the limit it is reported with
    (INSIDE, FaultCode.NONE, None, None),
    ((2.0, 5.0, 1.5), FaultCode.NONE, None, None),
    ((-1.0, -5.0, -0.5), FaultCode.NONE, None, None),
    ((2.2, 0.0, 2.2), FaultCode.POSITION_HARD, 2.2, 2.1),
    ((2.1, 0.0, 2.1), FaultCode.POSITION_SOFT, 2.1, 2.0),
    ((-1.1, 0.0, -1.1), FaultCode.POSITION_SOFT, -1.1, -1.0),
    ((-1.2, 0.0, -1.2), FaultCode.POSITION_HARD, -1.2, -1.1),
    ((-1.2, 9.0, 3.0), FaultCode.POSITION_HARD, -1.2, -1.1),
    ((0.3, 5.1, 0.2), FaultCode.VELOCITY, 5.1, 5.0),
    ((0.3, -5.1, 0.2), FaultCode.VELOCITY, -5.1, 5.0),
    ((2.05, 5.1, 0.2), FaultCode.VELOCITY, 5.1, 5.0),
    ((2.05, 0.0, 2.0), FaultCode.POSITION_SOFT, 2.05, 2.0),
    ((-1.05, 0.0, -1.0), FaultCode.POSITION_SOFT, -1.05, -1.0),
    ((2.05, 0.0, 0.0), FaultCode.POSITION_SOFT, 2.05, 2.0),
    ((0.9, 0.0, 0.3), FaultCode.FOLLOWING_ERROR, 0.6, 0.5),
    ((0.3, 0.0, 0.9), FaultCode.FOLLOWING_ERROR, -0.6, 0.5),
]


def judged(guard, *joints):
    """Check one (q, dq, q_des) per joint."""
    return guard.check(*(list(column) for column in zip(*joints, strict=True)))


def test_motion_guard__new_or_nothing_wrong__names_no_joint():
    guard = MotionGuard(settings())
    assert judged(guard, INSIDE, INSIDE) is FaultCode.NONE
    assert (guard.joint, guard.value, guard.limit) == (0, 0.0, 0.0)


@pytest.mark.parametrize("joint", [1, 2])
@pytest.mark.parametrize(("motion", "code", "value", "limit"), CASES)
def test_motion_guard__one_joint__gravest_first_with_joint_value_and_limit(
    motion, code, value, limit, joint
):
    guard = MotionGuard(settings())
    joints = [INSIDE, INSIDE]
    joints[joint - 1] = motion
    assert judged(guard, *joints) is code
    if code is not FaultCode.NONE:
        assert guard.joint == joint
        assert (guard.value, guard.limit) == pytest.approx((value, limit))


@pytest.mark.parametrize(("first", "second"), list(itertools.product(CASES, CASES)))
def test_motion_guard__both_joints__the_graver_and_of_equals_the_first(first, second):
    guard = MotionGuard(settings())
    codes = [first[1], second[1]]
    present = [code for code in codes if code is not FaultCode.NONE]
    verdict = judged(guard, first[0], second[0])
    assert verdict == min(present, default=FaultCode.NONE)
    if present:
        at = codes.index(verdict)
        assert guard.joint == at + 1
        assert guard.value == pytest.approx((first, second)[at][2])


@pytest.mark.parametrize("bad", NOT_FINITE)
@pytest.mark.parametrize("joint", [1, 2])
@pytest.mark.parametrize("place", [0, 1, 2])
@pytest.mark.parametrize("other", CASES)
def test_motion_guard__not_finite_anywhere__is_the_gravest(bad, joint, place, other):
    guard = MotionGuard(settings())
    joints = [other[0], other[0]]
    wrong = [2.2, 9.0, 0.0]  # beyond every other limit besides
    wrong[place] = bad
    joints[joint - 1] = tuple(wrong)
    assert judged(guard, *joints) is FaultCode.NOT_FINITE
    assert guard.joint == joint
    assert not math.isfinite(guard.value)


@pytest.mark.parametrize(
    ("q", "code", "limit"),
    [
        (0.3, FaultCode.POSITION_HARD, 0.4),
        (0.45, FaultCode.POSITION_SOFT, 0.5),
        (1.05, FaultCode.POSITION_SOFT, 1.0),
        (1.3, FaultCode.POSITION_HARD, 1.1),
    ],
)
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_motion_guard__range_on_one_side_of_zero__the_limit_that_was_passed(q, code, limit, side):
    low, high = sorted((side * 0.5, side * 1.0))
    guard = MotionGuard(settings(q_min_rad=(low, -1.0), q_max_rad=(high, 1.0)))
    assert judged(guard, (side * q, 0.0, side * q), (0.0, 0.0, 0.0)) is code
    assert guard.limit == pytest.approx(side * limit)


@given(
    st.lists(
        st.tuples(st.floats(-3.0, 3.0), st.floats(-8.0, 8.0), st.floats(-3.0, 3.0)),
        min_size=2,
        max_size=2,
    )
)
def test_motion_guard__any_motion__as_the_definition_says(joints):
    def code(q, dq, q_des):
        if not -1.1 <= q <= 2.1:
            return FaultCode.POSITION_HARD
        if abs(dq) > 5.0:
            return FaultCode.VELOCITY
        if not -1.0 <= q <= 2.0:
            return FaultCode.POSITION_SOFT
        return FaultCode.FOLLOWING_ERROR if abs(q - q_des) > 0.5 else FaultCode.NONE

    found = [each for each in (code(*joint) for joint in joints) if each is not FaultCode.NONE]
    assert judged(MotionGuard(settings()), *joints) == min(found, default=FaultCode.NONE)
