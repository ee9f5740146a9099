"""From a request to a reference the loop can index, checked over its whole length.

A plan leads without a jump in position, velocity or acceleration from the present reference
through the trajectory to rest: an approach, the trajectory, and a braking if it ends moving.
Only `approach = "none"` begins with a step, which the experimenter asked for.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from math import ceil, isfinite

import numpy as np
import ruckig

from controller import trajectory
from controller.errors import LimitError, TrajectoryError
from controller.reference import (
    MotionLimits,
    MotionState,
    Reference,
    Violation,
    concatenate,
    distinct,
)
from hil.errors import HilError
from hil.messages import (
    ExponentialSineRequest,
    KellyRequest,
    MoveRequest,
    Reply,
    SamplesRequest,
    SinusoidRequest,
    TrajectoryRequest,
    WaypointsRequest,
)

__all__ = ["MotionLimits", "MotionState", "Refusal", "plan"]

_CurveRequest = (
    WaypointsRequest | ExponentialSineRequest | KellyRequest | SinusoidRequest | SamplesRequest
)
_MARGIN = 1.0 - 1e-6  # ruckig runs along its limits, give or take its rounding

_NO_MOVE = "no move to this target can be computed from the present motion; stop first"


class Refusal(HilError):  # noqa: N818 - an answer rather than an error
    """A well-formed request that the arm cannot follow. Nothing has changed.

    Attributes:
        quantity: What is out of bounds, if it is a number: `position`, `velocity`,
            `acceleration`, `start`, `duration`, `joints`.
        joint: Whose; 1 is the shoulder.
        value: What it would be; None if it is not finite.
        limit: The limit it breaks.
    """

    def __init__(
        self,
        reason: str,
        quantity: str | None = None,
        joint: int | None = None,
        value: float | None = None,
        limit: float | None = None,
    ) -> None:
        super().__init__(reason)
        self.reason = reason
        self.quantity = quantity
        self.joint = joint
        self.value = value if value is not None and isfinite(value) else None
        self.limit = limit

    @classmethod
    def beyond(cls, violation: Violation, part: str = "") -> "Refusal":
        """Refuse because of a violation; `part` says of what, if not of the trajectory itself."""
        v = violation
        return cls(f"{part}{violation}", v.quantity, v.joint, v.value, v.limit)

    def reply(self, request_id: str | None = None) -> Reply:
        """Return the answer for the client."""
        return Reply(
            ok=False,
            reason=self.reason,
            request_id=request_id,
            quantity=self.quantity,
            joint=self.joint,
            value=self.value,
            limit=self.limit,
        )


def plan(
    request: TrajectoryRequest, state: MotionState, limits: MotionLimits, period_s: float
) -> Reference:
    """Compile a request.

    Args:
        request: What the client wants.
        state: The reference at the cycle in which the plan's first sample will be in force.
        limits: What the plan must keep to. An arm that stands outside its soft position range
            may move back into it, but no further out.
        period_s: The loop's period.

    Returns:
        A reference that begins in `state` (unless `approach` is "none") and ends at rest.

    Raises:
        Refusal: If the request does not fit the arm, or no plan keeps the limits.
    """
    _require_joints("the present reference", len(state.q_rad), limits)
    with np.errstate(all="ignore"):  # what overflows is not finite, and is refused for that
        if isinstance(request, MoveRequest):
            return _plan_move(request, state, limits, period_s)
        return _plan_curve(request, state, limits, period_s)


def _plan_curve(
    request: _CurveRequest, state: MotionState, limits: MotionLimits, period_s: float
) -> Reference:
    _require_duration("the trajectory", _requested_s(request), limits)
    with _refusing():
        curve = _compile(request, period_s)
        _require_joints("the trajectory", curve.joints, limits)
        _require_within(curve, limits)
    approach = _approach(request, state, curve.start, limits, period_s)
    with _refusing("braking at the end: "):
        braking = [] if curve.end.is_at_rest else [trajectory.brake(curve.end, limits, period_s)]
    whole = concatenate([*approach, curve, *braking])
    _require_duration("the motion with approach and braking", whole.duration_s, limits)
    return whole


def _requested_s(request: _CurveRequest) -> float:
    if isinstance(request, WaypointsRequest):
        return request.times_s[-1]
    if isinstance(request, SamplesRequest):
        return (len(request.q_rad) - 1) * request.period_s
    return request.duration_s


def _compile(request: _CurveRequest, period_s: float) -> Reference:
    match request:
        case WaypointsRequest():
            return trajectory.waypoints(period_s, request.times_s, request.points_rad)
        case SamplesRequest():
            return trajectory.samples(period_s, request.period_s, request.q_rad)
        case KellyRequest():
            return trajectory.kelly(period_s, request.duration_s, request.rate)
        case ExponentialSineRequest():
            return _exponential_sine(request, period_s)
        case SinusoidRequest():
            return _sinusoid(request, period_s)


def _exponential_sine(request: ExponentialSineRequest, period_s: float) -> Reference:
    shape = trajectory.ExponentialSine(
        tuple(request.b_rad), tuple(request.c_rad), tuple(request.w_rad_s)
    )
    return trajectory.exponential_sine(period_s, request.duration_s, request.rate, shape)


def _sinusoid(request: SinusoidRequest, period_s: float) -> Reference:
    phase_rad = request.phase_rad or [0.0] * len(request.center_rad)
    shape = trajectory.Sinusoid(
        tuple(request.center_rad),
        tuple(request.amplitude_rad),
        tuple(request.frequency_Hz),
        tuple(phase_rad),
        request.ramp_s,
    )
    return trajectory.sinusoid(period_s, request.duration_s, shape)


def _approach(
    request: _CurveRequest,
    state: MotionState,
    start: MotionState,
    limits: MotionLimits,
    period_s: float,
) -> list[Reference]:
    """Return the pieces that lead from the present reference to the start of the trajectory."""
    if request.approach == "none":
        _require_near(state, start, limits)
        return []
    if _is_same(state, start):
        return []
    room = limits.admitting(state.q_rad)
    with _refusing("approach: "):
        try:
            return [_shortest_blend(state, start, room, period_s)]
        except LimitError:
            if state.is_at_rest:
                raise
        stop = trajectory.brake(state, room, period_s)
        return [stop, _shortest_blend(stop.end, start, room, period_s)]


def _shortest_blend(
    state: MotionState, start: MotionState, limits: MotionLimits, period_s: float
) -> Reference:
    duration_s = trajectory.approach_duration(state, start, limits, period_s)
    return trajectory.blend(state, start, duration_s, period_s)


def _plan_move(
    request: MoveRequest, state: MotionState, limits: MotionLimits, period_s: float
) -> Reference:
    _require_joints("the target", len(request.target_rad), limits)
    _require_target(request.target_rad, limits)
    if request.speed_scale == 1.0 or state.is_at_rest:
        return _move(request, state, limits, period_s)
    with _refusing("braking before the move: "):  # slowed limits are none for a fast start
        stop = trajectory.brake(state, limits.admitting(state.q_rad), period_s)
    whole = concatenate([stop, _move(request, stop.end, limits, period_s)])
    _require_duration("the move with its braking", whole.duration_s, limits)
    return whole


def _move(
    request: MoveRequest, state: MotionState, limits: MotionLimits, period_s: float
) -> Reference:
    profile = _move_profile(request, state, limits)
    _require_duration("the move", profile.duration, limits)
    periods = max(1, ceil(profile.duration / period_s - 1e-6))
    instants = (min(k * period_s, profile.duration) for k in range(periods + 1))
    motion = np.array([profile.at_time(t) for t in instants])
    motion[0] = state.q_rad, state.dq_rad_s, state.ddq_rad_s2
    motion[-1] = request.target_rad, np.zeros(limits.joints), np.zeros(limits.joints)
    move = Reference(motion[:, 0], motion[:, 1], motion[:, 2], period_s)
    _require_within(move, limits.admitting(state.q_rad))
    return move


def _move_profile(
    request: MoveRequest, state: MotionState, limits: MotionLimits
) -> ruckig.Trajectory:
    scale = request.speed_scale
    wanted = ruckig.InputParameter(limits.joints)
    wanted.current_position = state.q_rad.tolist()
    wanted.current_velocity = state.dq_rad_s.tolist()
    wanted.current_acceleration = state.ddq_rad_s2.tolist()
    wanted.target_position = request.target_rad
    wanted.max_velocity = [_MARGIN * scale * v for v in limits.dq_max_rad_s]
    wanted.max_acceleration = [_MARGIN * scale**2 * a for a in limits.ddq_max_rad_s2]
    wanted.max_jerk = [scale**3 * j for j in limits.dddq_max_rad_s3]
    profile = ruckig.Trajectory(limits.joints)
    try:
        result = ruckig.Ruckig(limits.joints).calculate(wanted, profile)
    except (ruckig.RuckigError, ValueError) as error:  # ValueError: a result its enum does not know
        raise Refusal(_NO_MOVE) from error
    if result not in (ruckig.Result.Working, ruckig.Result.Finished):
        raise Refusal(_NO_MOVE)
    return profile


@contextmanager
def _refusing(part: str = "") -> Iterator[None]:
    """Turn the controller's errors into refusals."""
    try:
        yield
    except LimitError as error:
        raise Refusal.beyond(error.violation, part) from error
    except TrajectoryError as error:
        raise Refusal(f"{part}{error}") from error


def _require_within(motion: Reference, limits: MotionLimits) -> None:
    violation = motion.check(limits)
    if violation is not None:
        raise Refusal.beyond(violation)


def _require_joints(what: str, joints: int, limits: MotionLimits) -> None:
    if joints != limits.joints:
        raise Refusal(
            f"{what} has {joints} joints, the arm has {limits.joints}",
            "joints",
            value=joints,
            limit=limits.joints,
        )


def _require_duration(what: str, duration_s: float, limits: MotionLimits) -> None:
    if not duration_s <= limits.max_duration_s + 1e-9:
        value, limit = distinct(duration_s, limits.max_duration_s)
        raise Refusal(
            f"{what} takes {value} s, beyond the longest allowed, {limit} s",
            "duration",
            value=duration_s,
            limit=limits.max_duration_s,
        )


def _require_target(target_rad: list[float], limits: MotionLimits) -> None:
    bounds = zip(limits.q_min_rad, limits.q_max_rad, strict=True)
    for joint, (q, (low, high)) in enumerate(zip(target_rad, bounds, strict=True), start=1):
        if not low <= q <= high:
            limit = low if q < low else high
            shown, at = distinct(q, limit)
            reason = f"joint {joint}: target {shown} rad is beyond the soft limit {at} rad"
            raise Refusal(reason, "position", joint, q, limit)


def _require_near(state: MotionState, start: MotionState, limits: MotionLimits) -> None:
    gaps = np.abs(start.q_rad - state.q_rad).tolist()
    for joint, (gap, limit) in enumerate(
        zip(gaps, limits.following_error_rad, strict=True), start=1
    ):
        if not gap <= limit:
            shown, at = distinct(gap, limit)
            reason = (
                f"joint {joint}: the trajectory starts {shown} rad from the present reference, "
                f'beyond the following-error limit {at} rad; use approach "blend"'
            )
            raise Refusal(reason, "start", joint, gap, limit)


def _is_same(state: MotionState, start: MotionState) -> bool:
    pairs = (
        (state.q_rad, start.q_rad),
        (state.dq_rad_s, start.dq_rad_s),
        (state.ddq_rad_s2, start.ddq_rad_s2),
    )
    return all(np.allclose(a, b, rtol=0.0, atol=1e-9) for a, b in pairs)
