"""Limits checked every cycle: on what is measured, and on what is sent."""

import math
from collections.abc import Sequence

from controller.errors import CommandError
from controller.faults import FaultCode
from controller.settings import LimitSettings


def limit_torque(tau_cmd_Nm: float, *, tau_max_Nm: float) -> float:
    """Clip a joint torque to +-tau_max_Nm.

    Raises:
        CommandError: If the torque is NaN or infinite. Nothing has been sent.
    """
    if not math.isfinite(tau_cmd_Nm):
        raise CommandError(f"torque is {tau_cmd_Nm}")
    return max(-tau_max_Nm, min(tau_max_Nm, tau_cmd_Nm))


class TorqueLimiter:
    """The last stage before the bus: finite check, torque limit, slew limit, in this order.

    Attributes:
        tau_sent_Nm: Torques of the last cycle, after limits.
    """

    __slots__ = ("_limits", "tau_sent_Nm")

    def __init__(self, settings: LimitSettings) -> None:
        self._limits = list(zip(settings.tau_max_Nm, settings.tau_slew_Nm_s, strict=True))
        self.tau_sent_Nm = [0.0] * len(self._limits)

    def reset(self) -> None:
        """Torque is off: the next slew starts from zero."""
        self.tau_sent_Nm = [0.0] * len(self._limits)

    def step(self, tau_cmd_Nm: Sequence[float], dt_s: float) -> list[float]:
        """Return the torques to send, in Nm.

        Args:
            tau_cmd_Nm: Requested torques.
            dt_s: Time since the torques of the last cycle.

        Raises:
            CommandError: If a torque is NaN or infinite. Nothing has been sent.
        """
        sent = []
        for (tau_max, slew), wanted, before in zip(
            self._limits, tau_cmd_Nm, self.tau_sent_Nm, strict=True
        ):
            if not -tau_max <= wanted <= tau_max:
                wanted = limit_torque(wanted, tau_max_Nm=tau_max)  # noqa: PLW2901 - rarely taken
            reach = slew * dt_s
            if wanted > before + reach:
                sent.append(before + reach)
            elif wanted < before - reach:
                sent.append(before - reach)
            else:
                sent.append(wanted)
        self.tau_sent_Nm = sent
        return sent


SOFT_SLACK_RAD = 0.02
"""An arm outside its soft limit may be so much further out than it was at its innermost."""


class MotionGuard:
    """Watches the measured motion of all joints.

    An arm that gets power outside its soft limit, and within the hard one, may be driven back: it
    trips when it moves further out, and the way back is shut behind it.

    Attributes:
        joint: Joint (from 1) of the last violation.
        value: What was measured then.
        limit: What it exceeded.
    """

    __slots__ = ("_admitted", "_joints", "_soft", "joint", "limit", "value")

    def __init__(self, settings: LimitSettings) -> None:
        margin = settings.hard_margin_rad
        self._joints = [
            (j, low, high, low - margin, high + margin, dq_max, following)
            for j, (low, high, dq_max, following) in enumerate(
                zip(
                    settings.q_min_rad,
                    settings.q_max_rad,
                    settings.dq_trip_rad_s,
                    settings.following_error_rad,
                    strict=True,
                )
            )
        ]
        self._soft = list(zip(settings.q_min_rad, settings.q_max_rad, strict=True))
        self._admitted = list(self._soft)
        self.joint, self.value, self.limit = 0, 0.0, 0.0

    def admit(self, q_rad: Sequence[float]) -> None:
        """Power comes on here: from outside the soft limits there is only the way back."""
        self._admitted = [
            (min(low, q - SOFT_SLACK_RAD), max(high, q + SOFT_SLACK_RAD))
            if not low <= q <= high
            else (low, high)
            for q, (low, high) in zip(q_rad, self._soft, strict=True)
        ]

    def _is_on_way_back(self, joint: int, q_rad: float) -> bool:
        """Tell whether a joint outside its soft limit is no further out; narrow what is left."""
        (low, high), (soft_low, soft_high) = self._admitted[joint], self._soft[joint]
        if not low <= q_rad <= high:
            return False
        if q_rad > soft_high:
            self._admitted[joint] = soft_low, min(high, q_rad + SOFT_SLACK_RAD)
        else:
            self._admitted[joint] = max(low, q_rad - SOFT_SLACK_RAD), soft_high
        return True

    def check(
        self, q_rad: Sequence[float], dq_rad_s: Sequence[float], q_des_rad: Sequence[float]
    ) -> FaultCode:
        """Return the gravest violation over all joints, `NONE` if there is none."""
        worst = FaultCode.NONE
        for j, low, high, hard_low, hard_high, dq_max, following in self._joints:
            q, dq = q_rad[j], dq_rad_s[j]
            error = q - q_des_rad[j]
            if low <= q <= high and -dq_max <= dq <= dq_max and -following <= error <= following:
                continue
            code, value, limit = FaultCode.FOLLOWING_ERROR, error, following
            if not math.isfinite(q + dq + error):
                code, value, limit = FaultCode.NOT_FINITE, q + dq + error, 0.0
            elif not hard_low <= q <= hard_high:
                code, value, limit = FaultCode.POSITION_HARD, q, hard_high if q > high else hard_low
            elif abs(dq) > dq_max:
                code, value, limit = FaultCode.VELOCITY, dq, dq_max
            elif not low <= q <= high:
                if -following <= error <= following and self._is_on_way_back(j, q):
                    continue
                code, value, limit = FaultCode.POSITION_SOFT, q, high if q > high else low
            if worst is FaultCode.NONE or code < worst:
                worst, self.joint, self.value, self.limit = code, j + 1, value, limit
        return worst
