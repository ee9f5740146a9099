"""The gain of tau = -Kd S: constant, or tuned by the paper's neuro-fuzzy network (section 4)."""

from abc import ABC, abstractmethod
from collections.abc import Sequence

from controller.membership import BIG, MEDIUM, MEMBERSHIPS, SMALL
from controller.membership import sigmoid as memberships
from controller.settings import LawSettings

__all__ = ["ConstantGain", "Gain", "SelfTuningGain", "memberships"]


class Gain(ABC):
    """Gain of one joint, between bounds that ramp when they are changed."""

    __slots__ = ("Kd_max", "Kd_min", "_goal", "_ramp_per_s")

    def __init__(self, Kd_min: float, Kd_max: float, ramp_per_s: float) -> None:
        self.Kd_min = Kd_min
        self.Kd_max = Kd_max
        self._ramp_per_s = ramp_per_s
        self._goal: tuple[float, float] | None = None

    def set_bounds(self, Kd_min: float, Kd_max: float) -> None:
        """Let the bounds move to new values at the configured rate, from the next step on."""
        self._goal = (Kd_min, Kd_max)

    def reset(self) -> None:  # noqa: B027 - most gains hold nothing that a run leaves behind
        """Forget the motion of an earlier run; what was learnt stays."""

    @abstractmethod
    def step(self, S: float, dt_s: float) -> float:
        """Return the gain for this cycle, in Nm s/rad, and adapt.

        Args:
            S: Extended error manifold of the joint, rad/s, finite.
            dt_s: Time since the last step.
        """

    def _ramp_bounds(self, dt_s: float) -> None:
        assert self._goal is not None  # noqa: S101 - callers check; keeps the hot path short
        goal_min, goal_max = self._goal
        reach = self._ramp_per_s * dt_s
        self.Kd_min += max(-reach, min(reach, goal_min - self.Kd_min))
        self.Kd_max += max(-reach, min(reach, goal_max - self.Kd_max))
        if self.Kd_min == goal_min and self.Kd_max == goal_max:
            self._goal = None


class ConstantGain(Gain):
    """A constant Kd (11), clipped to the bounds."""

    __slots__ = ("Kd",)

    def __init__(self, Kd: float, bounds: tuple[float, float], ramp_per_s: float) -> None:
        super().__init__(*bounds, ramp_per_s)
        self.Kd = Kd

    def step(self, S: float, dt_s: float) -> float:
        """Return the constant, clipped to the bounds in force."""
        if self._goal is not None:
            self._ramp_bounds(dt_s)
        return max(self.Kd_min, min(self.Kd_max, self.Kd))


class SelfTuningGain(Gain):
    """Kd_hat = sum_i beta_i mu_i(|S|) (17), beta adapted by a reading of (28).

    mu are the memberships named in the settings (`controller.membership`).
    Adaptations, per 1 ms, with mu of the previous cycle and S of this one:
    `literal`: beta -= rate S alpha mu, as printed (not mirror-symmetric);
    `absolute`: beta -= rate |S| alpha mu; `true_sign`: beta += rate |S| alpha mu, with the sign
    that d(q_err)/dKd really has; `off`. Every beta is boxed to [Kd_min, Kd_max] and the sum is
    clipped to it. When the bounds move, each beta keeps its place between them; bounds configured
    without room between them give it the place that it has among the configured ones.
    """

    __slots__ = ("_is_absolute", "_memberships", "_mu", "_place", "_rate_per_s", "beta")

    def __init__(self, settings: LawSettings, joint: int) -> None:
        super().__init__(settings.Kd_min[joint], settings.Kd_max[joint], settings.Kd_ramp_per_s)
        sign = {"off": 0.0, "literal": -1.0, "absolute": -1.0, "true_sign": 1.0}
        rate = sign[settings.adaptation] * settings.learning_rate * settings.alpha[joint]
        self._rate_per_s = rate / 1e-3
        self._is_absolute = settings.adaptation != "literal"
        self._memberships = MEMBERSHIPS[settings.membership]
        self._mu = (0.0, 0.0, 0.0)
        self.beta = [self._box(beta) for beta in settings.beta]
        self._place = _places(settings.beta)

    def step(self, S: float, dt_s: float) -> float:
        """Return Kd_hat for this cycle; see the class."""
        if self._goal is not None:
            self._ramp_bounds(dt_s)
            span = self.Kd_max - self.Kd_min
            self.beta = [self.Kd_min + place * span for place in self._place]
        elif self._rate_per_s != 0.0:
            self._adapt(S, dt_s)
        big, medium, small = self._mu = self._memberships(S if S >= 0.0 else -S)
        beta = self.beta
        Kd = beta[BIG] * big + beta[MEDIUM] * medium + beta[SMALL] * small
        if Kd < self.Kd_min:
            return self.Kd_min
        return Kd if Kd < self.Kd_max else self.Kd_max

    def set_bounds(self, Kd_min: float, Kd_max: float) -> None:
        """Let the bounds move; every beta keeps its place between them."""
        span = self.Kd_max - self.Kd_min
        if span > 0.0:
            self._place = [(beta - self.Kd_min) / span for beta in self.beta]
        super().set_bounds(Kd_min, Kd_max)

    def _adapt(self, S: float, dt_s: float) -> None:
        step = self._rate_per_s * dt_s * (abs(S) if self._is_absolute else S)
        big, medium, small = self._mu
        beta = self.beta
        low, high = self.Kd_min, self.Kd_max
        for place, degree in ((BIG, big), (MEDIUM, medium), (SMALL, small)):
            moved = beta[place] + step * degree
            beta[place] = low if moved < low else moved if moved < high else high

    def _box(self, beta: float) -> float:
        if beta < self.Kd_min:
            return self.Kd_min
        return beta if beta < self.Kd_max else self.Kd_max


def _places(beta: Sequence[float]) -> list[float]:
    """Return the place of each consequence between the smallest, 0, and the largest, 1."""
    low = min(beta)
    span = max(beta) - low
    return [(each - low) / span if span > 0.0 else 0.0 for each in beta]
