"""The self-tuning law written plainly in numpy, as one would for any number of joints."""

import numpy as np
from numpy.typing import NDArray

from controller.settings import LawSettings

Vector = NDArray[np.float64]


class PlainLaw:
    """tau = -Kd_hat S with `literal` adaptation, tanh manifold and anti-windup."""

    def __init__(self, settings: LawSettings, tau_max_Nm: Vector) -> None:
        joints = len(tau_max_Nm)
        self.alpha = np.array(settings.alpha)
        self.Ki = np.array(settings.Ki)
        self.lambda_ = np.array(settings.lambda_)
        self.low = np.array(settings.Kd_min)
        self.high = np.array(settings.Kd_max)
        self.tau_max_Nm = tau_max_Nm
        self.rate = settings.learning_rate * self.alpha / 1e-3
        beta = np.tile(np.array(settings.beta), (joints, 1))
        self.beta = np.clip(beta, self.low[:, None], self.high[:, None])
        self.mu = np.zeros((joints, 3))
        self.sigma = np.zeros(joints)

    def step(self, q: Vector, dq: Vector, q_des: Vector, dq_des: Vector, dt_s: float) -> Vector:
        S_q = dq - dq_des + self.alpha * (q - q_des)
        S = S_q + self.Ki * self.sigma
        step = (self.rate * dt_s * S)[:, None] * self.mu
        self.beta = np.clip(self.beta - step, self.low[:, None], self.high[:, None])
        self.mu = memberships(np.abs(S))
        Kd = np.clip((self.beta * self.mu).sum(axis=1), self.low, self.high)
        tau: Vector = -Kd * S
        is_pushed_further = (np.abs(tau) > self.tau_max_Nm) & (S_q * tau < 0.0)
        self.sigma = self.sigma + np.where(
            is_pushed_further, 0.0, dt_s * np.tanh(self.lambda_ * S_q)
        )
        return tau


def memberships(S_abs: Vector) -> NDArray[np.float64]:
    """Return (big, medium, small) per joint, rows over joints."""
    a = 1.0 / (1.0 + np.exp((0.20 - S_abs) / 0.04))
    b = 1.0 / (1.0 + np.exp((0.60 - S_abs) / 0.12))
    return np.stack((b, np.maximum(a - b, 0.0), 1.0 - a), axis=1)
