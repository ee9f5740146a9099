"""Sampled references: what the loop indexes, and their check against the limits."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from controller.errors import TrajectoryError
from controller.settings import LimitSettings

FloatArray: TypeAlias = npt.NDArray[np.float64]
Quantity: TypeAlias = Literal["position", "velocity", "acceleration", "jerk"]

_UNITS: dict[Quantity, str] = {
    "position": "rad",
    "velocity": "rad/s",
    "acceleration": "rad/s^2",
    "jerk": "rad/s^3",
}
_TOLERANCE = 1e-9  # of 1 + |limit|: rounding in a reference that runs along its limit
_AT_REST = 1e-9  # rad/s, rad/s^2


@dataclass(frozen=True, slots=True, eq=False)
class MotionState:
    """Position, velocity and acceleration of every joint at one instant; arrays of one length."""

    q_rad: FloatArray
    dq_rad_s: FloatArray
    ddq_rad_s2: FloatArray

    def __post_init__(self) -> None:
        for name in self.__slots__:
            object.__setattr__(self, name, _frozen(getattr(self, name), 1))
        if not self.q_rad.shape == self.dq_rad_s.shape == self.ddq_rad_s2.shape:
            raise TrajectoryError("a motion state has one q, dq and ddq per joint")

    @classmethod
    def at_rest(cls, q_rad: Sequence[float] | FloatArray) -> "MotionState":
        """Return the state of standing still at `q_rad`."""
        q = np.asarray(q_rad, dtype=np.float64)
        return cls(q, np.zeros_like(q), np.zeros_like(q))

    @property
    def is_at_rest(self) -> bool:
        """No velocity and no acceleration, rounding aside."""
        speed = max(np.abs(self.dq_rad_s).max(), np.abs(self.ddq_rad_s2).max())
        return bool(speed <= _AT_REST)


@dataclass(frozen=True, slots=True)
class MotionLimits:
    """What a reference must keep to. Tuples have one entry per joint, shoulder first.

    Attributes:
        q_min_rad: Soft lower limit of the joint angle.
        q_max_rad: Soft upper limit of the joint angle.
        dq_max_rad_s: Largest speed, > 0.
        ddq_max_rad_s2: Largest acceleration, > 0.
        dddq_max_rad_s3: Largest jerk of moves, approaches and braking, > 0; trajectories may
            exceed it.
        following_error_rad: Largest distance between reference and joint.
        max_duration_s: Longest reference, approach and final braking included.
    """

    q_min_rad: tuple[float, ...]
    q_max_rad: tuple[float, ...]
    dq_max_rad_s: tuple[float, ...]
    ddq_max_rad_s2: tuple[float, ...]
    dddq_max_rad_s3: tuple[float, ...]
    following_error_rad: tuple[float, ...]
    max_duration_s: float

    @classmethod
    def of(cls, settings: LimitSettings, max_duration_s: float) -> "MotionLimits":
        """Take the limits of a reference from the arm's settings."""
        return cls(
            settings.q_min_rad,
            settings.q_max_rad,
            settings.dq_max_rad_s,
            settings.ddq_max_rad_s2,
            settings.dddq_max_rad_s3,
            settings.following_error_rad,
            max_duration_s,
        )

    @property
    def joints(self) -> int:
        """Number of joints."""
        return len(self.q_min_rad)

    def admitting(self, q_rad: FloatArray) -> "MotionLimits":
        """Return these limits with the soft position range widened to contain `q_rad`.

        An arm that stands outside its soft range may so move back into it, but no further out.
        """
        low = np.minimum(self.q_min_rad, q_rad).tolist()
        high = np.maximum(self.q_max_rad, q_rad).tolist()
        return replace(self, q_min_rad=tuple(low), q_max_rad=tuple(high))


@dataclass(frozen=True, slots=True)
class Violation:
    """The first sample of a reference that goes beyond a limit.

    Attributes:
        quantity: What is beyond its limit.
        joint: 1 is the shoulder.
        value: In the unit of the quantity; NaN or infinite if the reference is not finite.
        limit: The limit on the side of the value, with its sign.
        time_s: From the start of the reference.
    """

    quantity: Quantity
    joint: int
    value: float
    limit: float
    time_s: float

    def __str__(self) -> str:
        head = f"joint {self.joint}: {self.quantity}"
        if not np.isfinite(self.value):
            return f"{head} at t = {self.time_s:.2f} s is not a finite number"
        unit = _UNITS[self.quantity]
        value, limit = distinct(self.value, self.limit)
        kind = "soft limit" if self.quantity == "position" else "limit"
        return (
            f"{head} {value} {unit} at t = {self.time_s:.2f} s is beyond the {kind} {limit} {unit}"
        )


@dataclass(frozen=True, slots=True, eq=False)
class Reference:
    """A motion sampled once per control period; sample k is the motion at t = k * period_s.

    Attributes:
        q_rad: Joint angles, shape (samples, joints), read-only.
        dq_rad_s: Their rates, same shape.
        ddq_rad_s2: Their accelerations in rad/s^2, same shape.
        period_s: Time between samples.

    Raises:
        TrajectoryError: If the arrays do not have one shape, or the period is not positive.
    """

    q_rad: FloatArray
    dq_rad_s: FloatArray
    ddq_rad_s2: FloatArray
    period_s: float

    def __post_init__(self) -> None:
        for name in ("q_rad", "dq_rad_s", "ddq_rad_s2"):
            object.__setattr__(self, name, _frozen(getattr(self, name), 2))
        if not self.q_rad.shape == self.dq_rad_s.shape == self.ddq_rad_s2.shape:
            raise TrajectoryError("q, dq and ddq of a reference must have one shape")
        if not self.period_s > 0.0:
            raise TrajectoryError(f"the period must be positive, not {self.period_s} s")

    @property
    def samples(self) -> int:
        """Number of samples."""
        return int(self.q_rad.shape[0])

    @property
    def joints(self) -> int:
        """Number of joints."""
        return int(self.q_rad.shape[1])

    @property
    def duration_s(self) -> float:
        """Time from the first to the last sample."""
        return (self.samples - 1) * self.period_s

    @property
    def start(self) -> MotionState:
        """Motion at the first sample."""
        return self.state(0)

    @property
    def end(self) -> MotionState:
        """Motion at the last sample."""
        return self.state(-1)

    def rows(self) -> FloatArray:
        """Return one row per sample: q, dq, ddq of all joints; shape (samples, 3 * joints)."""
        return np.hstack((self.q_rad, self.dq_rad_s, self.ddq_rad_s2))

    def state(self, sample: int) -> MotionState:
        """Return the motion at a sample; negative numbers count from the end."""
        return MotionState(self.q_rad[sample], self.dq_rad_s[sample], self.ddq_rad_s2[sample])

    def check(self, limits: MotionLimits, *, with_jerk: bool = False) -> Violation | None:
        """Return the first violation of the position, velocity and acceleration limits, or None.

        Besides the samples, the mean velocity and mean acceleration over every period are
        checked, so that nothing can hide between two samples. A NaN is a violation.

        Args:
            limits: For the same number of joints.
            with_jerk: Check the mean jerk over every period, too.

        Raises:
            TrajectoryError: If the limits are for another number of joints.
        """
        if limits.joints != self.joints:
            raise TrajectoryError(f"limits of {limits.joints} joints, {self.joints} in reference")
        low, high = np.asarray(limits.q_min_rad), np.asarray(limits.q_max_rad)
        found = [self._first("position", self.q_rad, low, high)]
        checks: list[tuple[Quantity, FloatArray, tuple[float, ...]]] = [
            ("velocity", self.dq_rad_s, limits.dq_max_rad_s),
            ("velocity", self._slope(self.q_rad), limits.dq_max_rad_s),
            ("acceleration", self.ddq_rad_s2, limits.ddq_max_rad_s2),
            ("acceleration", self._slope(self.dq_rad_s), limits.ddq_max_rad_s2),
        ]
        if with_jerk:
            checks.append(("jerk", self._slope(self.ddq_rad_s2), limits.dddq_max_rad_s3))
        for quantity, values, most in checks:
            bound = np.asarray(most)
            found.append(self._first(quantity, values, -bound, bound))
        return min((v for v in found if v is not None), key=lambda v: v.time_s, default=None)

    def _slope(self, values: FloatArray) -> FloatArray:
        return np.diff(values, axis=0) / np.float64(self.period_s)

    def _first(
        self, quantity: Quantity, values: FloatArray, low: FloatArray, high: FloatArray
    ) -> Violation | None:
        is_inside = values >= low - _TOLERANCE * (1.0 + np.abs(low))  # False for NaN
        is_inside &= values <= high + _TOLERANCE * (1.0 + np.abs(high))
        if is_inside.all():
            return None
        sample = int(np.argmin(is_inside.all(axis=1)))
        joint = int(np.argmin(is_inside[sample]))
        value = float(values[sample, joint])
        limit = float(low[joint] if value < low[joint] else high[joint])
        return Violation(quantity, joint + 1, value, limit, sample * self.period_s)


def concatenate(references: Sequence[Reference]) -> Reference:
    """Join references end to start.

    Each begins with the sample the one before it ends with; that instant is kept once.

    Raises:
        TrajectoryError: If there is none, if periods or joints differ, or if one does not begin
            in the state (position, velocity, acceleration) in which the one before it ends.
    """
    if not references:
        raise TrajectoryError("there is no reference to join")
    for before, after in pairwise(references):
        _check_join(before, after)
    first, *rest = references
    return Reference(
        np.concatenate([first.q_rad, *(r.q_rad[1:] for r in rest)]),
        np.concatenate([first.dq_rad_s, *(r.dq_rad_s[1:] for r in rest)]),
        np.concatenate([first.ddq_rad_s2, *(r.ddq_rad_s2[1:] for r in rest)]),
        first.period_s,
    )


def distinct(value: float, limit: float) -> tuple[str, str]:
    """Format two numbers with two decimals, or with as many as it takes to tell them apart."""
    for digits in range(2, 10):
        shown = f"{value:.{digits}f}", f"{limit:.{digits}f}"
        if shown[0] != shown[1] and len(shown[0]) < 24:
            return shown
    return f"{value:.12g}", f"{limit:.12g}"


def _check_join(before: Reference, after: Reference) -> None:
    if before.period_s != after.period_s or before.joints != after.joints:
        raise TrajectoryError("references to be joined must have one period and the same joints")
    end, start = before.end, after.start
    for name in ("q_rad", "dq_rad_s", "ddq_rad_s2"):
        if not np.allclose(getattr(end, name), getattr(start, name), rtol=1e-9, atol=1e-9):
            raise TrajectoryError(f"references do not meet: {name} jumps where they join")


def _frozen(values: FloatArray, dimensions: int) -> FloatArray:
    array = np.ascontiguousarray(values, dtype=np.float64).view()
    if array.ndim != dimensions or array.size == 0:
        raise TrajectoryError(f"need a non-empty array of {dimensions} dimensions")
    array.flags.writeable = False
    return array
