"""The paper's control law: an error manifold with integral action, and one gain per joint."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence

from controller.gain import ConstantGain, Gain, SelfTuningGain
from controller.player import Setpoint
from controller.settings import LawSettings
from controller.tuner import LoadMemoryGain

HALF_PI = math.pi / 2.0


def _sine(x: float) -> float:
    return math.sin(x) if -HALF_PI < x < HALF_PI else math.copysign(1.0, x)


def _saturation(x: float) -> float:
    return max(-1.0, min(1.0, x))


MANIFOLDS: dict[str, Callable[[float], float]] = {
    "tanh": math.tanh,
    "sine": _sine,
    "saturation": _saturation,
}
"""f of sigma' = f(lambda S_q), paper (8) and section 6.5: bounded by one, increasing, odd."""


class Law(ABC):
    """A control law of one arm, stepped once a cycle.

    Attributes:
        S: Error manifold of the last step, rad/s, per joint.
        sigma: Its integral term, per joint; zeros where the law has none.
        Kd: Gain of the last step, Nm s/rad, per joint.
        gains: The gain of each joint; its bounds can be moved.
    """

    S: list[float]
    sigma: list[float]
    Kd: list[float]
    gains: list[Gain]

    @abstractmethod
    def reset(self) -> None:
        """Forget what was integrated (power comes on: nothing of an earlier run acts)."""

    @abstractmethod
    def step(
        self,
        q_rad: Sequence[float],
        dq_rad_s: Sequence[float],
        setpoint: Setpoint,
        dt_s: float,
    ) -> list[float]:
        """Compute the requested joint torques of one cycle.

        Args:
            q_rad: Measured joint angles.
            dq_rad_s: Estimated joint rates.
            setpoint: Desired angles, rates and accelerations.
            dt_s: Time since the last step: one period, or more after skipped ones.

        Returns:
            Torques in Nm, positive about each joint's axis, not yet limited.
        """


def saturation_limits(settings: LawSettings, tau_max_Nm: Sequence[float]) -> list[float]:
    """Return the torque beyond which each joint is saturated: its own limit or the law's clip."""
    if settings.tau_clip_Nm is None:
        return list(tau_max_Nm)
    return [min(pair) for pair in zip(tau_max_Nm, settings.tau_clip_Nm, strict=True)]


class PassivityLaw(Law):
    """tau = -Kd S with S = S_q + Ki sigma, S_q = dq_err + alpha q_err, sigma' = f(lambda S_q).

    Paper (6), (7), (8), (11) with a constant gain, (16) with a self-tuning one; without the
    integral term it is the PD of section 6.4. sigma is integrated by forward Euler after use, and
    waits while the torque is saturated and S_q would push it further (anti-windup). The torque is
    saturated beyond the joint's limit, or beyond `tau_clip_Nm`, to which it is then clipped.
    """

    __slots__ = (
        "Kd",
        "S",
        "_alpha",
        "_f",
        "_is_clipped",
        "_lambda",
        "_next_sigma",
        "_tau_max_Nm",
        "gains",
        "sigma",
    )

    def __init__(self, settings: LawSettings, tau_max_Nm: Sequence[float]) -> None:
        joints = range(len(tau_max_Nm))
        is_pid = settings.name.endswith("pid")
        self._alpha = [(settings.alpha[j], settings.Ki[j] if is_pid else 0.0) for j in joints]
        self._lambda = list(settings.lambda_)
        self._f = MANIFOLDS[settings.manifold]
        self._tau_max_Nm = saturation_limits(settings, tau_max_Nm)
        self._is_clipped = settings.tau_clip_Nm is not None
        self.gains = [_make_gain(settings, j) for j in joints]
        self.S = [0.0 for _ in joints]
        self.sigma = [0.0 for _ in joints]
        self._next_sigma = [0.0 for _ in joints]
        self.Kd = [gain.Kd_max for gain in self.gains]

    def reset(self) -> None:
        """Set the integral term to zero and let the gains forget the motion."""
        self._next_sigma = [0.0] * len(self._next_sigma)
        for gain in self.gains:
            gain.reset()

    def step(
        self,
        q_rad: Sequence[float],
        dq_rad_s: Sequence[float],
        setpoint: Setpoint,
        dt_s: float,
    ) -> list[float]:
        """See `Law.step`; the desired acceleration is not used."""
        q_des_rad, dq_des_rad_s, _ = setpoint
        S, sigma, Kd, tau = [], [], [], []
        f = self._f
        for j, (alpha, Ki) in enumerate(self._alpha):
            S_q = dq_rad_s[j] - dq_des_rad_s[j] + alpha * (q_rad[j] - q_des_rad[j])
            sigma_j = self._next_sigma[j]
            S_j = S_q + Ki * sigma_j
            Kd_j = self.gains[j].step(S_j, dt_s)
            tau_j = -Kd_j * S_j
            is_saturated = abs(tau_j) > self._tau_max_Nm[j]
            if Ki != 0.0 and not (is_saturated and S_q * tau_j < 0.0):
                self._next_sigma[j] = sigma_j + dt_s * f(self._lambda[j] * S_q)
            if is_saturated and self._is_clipped:
                tau_j = math.copysign(self._tau_max_Nm[j], tau_j)
            S.append(S_j)
            sigma.append(sigma_j)
            Kd.append(Kd_j)
            tau.append(tau_j)
        self.S, self.sigma, self.Kd = S, sigma, Kd
        return tau


def _make_gain(settings: LawSettings, joint: int) -> Gain:
    if settings.name.startswith("self_tuning"):
        if settings.tuner == "load_memory":
            return LoadMemoryGain(settings, joint)
        return SelfTuningGain(settings, joint)
    bounds = (settings.Kd_min[joint], settings.Kd_max[joint])
    return ConstantGain(settings.Kd[joint], bounds, settings.Kd_ramp_per_s)
