"""Joint velocity from encoder angles."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence

from controller.errors import ControllerError
from controller.settings import VelocitySettings


class VelocityEstimator(ABC):
    """Estimates the rates of all joints, once per fresh measurement."""

    dq_rad_s: list[float]
    """The last estimate."""

    @abstractmethod
    def reset(self, q_rad: Sequence[float]) -> None:
        """Start at rest at `q_rad`."""

    @abstractmethod
    def step(self, q_rad: Sequence[float], dt_s: float) -> list[float]:
        """Take a measurement `dt_s` after the last one and return the rates in rad/s."""

    @property
    def is_locked(self) -> bool:
        """False when the estimate no longer follows the measurement."""
        return True


class FilteredDifference(VelocityEstimator):
    """Backward difference through a first-order low-pass filter."""

    def __init__(self, joints: int, cutoff_Hz: float) -> None:
        self._rate_per_s = 2.0 * math.pi * cutoff_Hz
        self._dt_s = self._share = 0.0
        self._q_rad = [0.0] * joints
        self.dq_rad_s = [0.0] * joints

    def reset(self, q_rad: Sequence[float]) -> None:
        """Start at rest at `q_rad`."""
        self._q_rad = list(q_rad)
        self.dq_rad_s = [0.0] * len(self._q_rad)

    def step(self, q_rad: Sequence[float], dt_s: float) -> list[float]:
        """Take a measurement; the filter is discretised exactly for a held input."""
        if dt_s != self._dt_s:
            self._dt_s, self._share = dt_s, 1.0 - math.exp(-self._rate_per_s * dt_s)
        share = self._share
        self.dq_rad_s = [
            dq + share * ((q - before) / dt_s - dq)
            for q, before, dq in zip(q_rad, self._q_rad, self.dq_rad_s, strict=True)
        ]
        self._q_rad = list(q_rad)
        return self.dq_rad_s


class Levant(VelocityEstimator):
    """Levant's first-order exact differentiator, gains 1.5 sqrt(C) and 1.1 C (paper 7.1).

    x0' = x1 - 1.5 sqrt(C |x0 - q|) sign(x0 - q), x1' = -1.1 C sign(x0 - q); forward Euler; the
    estimate is x1. It follows only while |ddq| stays below about C: `is_locked` tells.
    """

    def __init__(self, settings: VelocitySettings, joints: int) -> None:
        self._C = list(settings.C_rad_s2[:joints])
        self._tolerance_rad = settings.lock_tolerance_rad
        self._x0 = [0.0] * joints
        self._is_locked = True
        self.dq_rad_s = [0.0] * joints

    def reset(self, q_rad: Sequence[float]) -> None:
        """Start at rest at `q_rad`."""
        self._x0 = list(q_rad)
        self._is_locked = True
        self.dq_rad_s = [0.0] * len(self._x0)

    def step(self, q_rad: Sequence[float], dt_s: float) -> list[float]:
        """Take a measurement; see the class."""
        is_locked = True
        rates = []
        for j, q in enumerate(q_rad):
            error = self._x0[j] - q
            sign = (error > 0.0) - (error < 0.0)
            x1 = self.dq_rad_s[j]
            C = self._C[j]
            self._x0[j] += dt_s * (x1 - 1.5 * math.sqrt(C * abs(error)) * sign)
            rates.append(x1 - dt_s * 1.1 * C * sign)
            is_locked = is_locked and abs(error) <= self._tolerance_rad  # not so for NaN
        self._is_locked = is_locked
        self.dq_rad_s = rates
        return rates

    @property
    def is_locked(self) -> bool:
        """False when a position estimate is further from its measurement than the tolerance."""
        return self._is_locked


def make_estimator(settings: VelocitySettings, joints: int) -> VelocityEstimator:
    """Build the configured estimator for a number of joints.

    Raises:
        ControllerError: For `amplifier`, where nothing is to be estimated.
    """
    if settings.estimator == "amplifier":
        raise ControllerError("the amplifiers report the velocity; there is no estimator")
    if settings.estimator == "levant":
        return Levant(settings, joints)
    return FilteredDifference(joints, settings.cutoff_Hz)
