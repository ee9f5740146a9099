"""Arm dynamics from the Lagrange equations: the independent truth for the simulated arm.

Nothing here knows pymunk. `TwoLink` has the equations of two links written out (Kelly,
Santibanez and Loria, section 5.3.2); `Chain` has n links by the mass matrix in absolute angles;
each checks the other. Angles count from the downward vertical, every angle relative to the link
before. A motion `y` is (q_1 .. q_n, dq_1 .. dq_n).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from math import cos, exp, sin, tanh

import numpy as np
from scipy.integrate import solve_ivp

from sim_backend.settings import LinkSettings, PlantSettings

Motion = Sequence[float]
Torque = Callable[[float, Motion], Sequence[float]]


class TwoLink:
    """Two links, H ddq + C dq + g + tau_f = tau, written out, with tau_f the Stribeck curve."""

    def __init__(self, settings: PlantSettings) -> None:
        a, b = settings.links
        g = settings.gravity_m_s2
        self.h11 = (
            a.inertia_kg_m2
            + b.inertia_kg_m2
            + a.mass_kg * a.com_m**2
            + b.mass_kg * (a.length_m**2 + b.com_m**2)
        )
        self.h22 = b.inertia_kg_m2 + b.mass_kg * b.com_m**2
        self.coupling = b.mass_kg * a.length_m * b.com_m
        self.g1 = g * (a.mass_kg * a.com_m + b.mass_kg * a.length_m)
        self.g2 = g * b.mass_kg * b.com_m
        self.b1, self.b2 = a.viscous_Nms_rad, b.viscous_Nms_rad
        self.c1, self.c2 = a.coulomb_Nm, b.coulomb_Nm
        self.s1, self.s2 = static_excess(a), static_excess(b)
        self.vs1, self.vs2 = a.stribeck_rad_s, b.stribeck_rad_s
        self.d = settings.tanh_slope_s_rad

    def acceleration(self, y: Motion, tau: Sequence[float]) -> tuple[float, float]:
        q1, q2, v1, v2 = y
        h11 = self.h11 + 2.0 * self.coupling * cos(q2)
        h12 = self.h22 + self.coupling * cos(q2)
        k = self.coupling * sin(q2)
        gravity_2 = self.g2 * sin(q1 + q2)
        e1 = tau[0] + k * (2.0 * v1 + v2) * v2 - self.g1 * sin(q1) - gravity_2
        e2 = tau[1] - k * v1 * v1 - gravity_2
        dry1 = self.c1 + self.s1 * exp(-((v1 / self.vs1) ** 2))
        dry2 = self.c2 + self.s2 * exp(-((v2 / self.vs2) ** 2))
        e1 -= self.b1 * v1 + dry1 * tanh(self.d * v1)
        e2 -= self.b2 * v2 + dry2 * tanh(self.d * v2)
        det = h11 * self.h22 - h12 * h12
        return (self.h22 * e1 - h12 * e2) / det, (h11 * e2 - h12 * e1) / det

    def energy_J(self, y: Motion) -> float:
        q1, q2, v1, v2 = y
        h11 = self.h11 + 2.0 * self.coupling * cos(q2)
        h12 = self.h22 + self.coupling * cos(q2)
        kinetic = 0.5 * h11 * v1 * v1 + h12 * v1 * v2 + 0.5 * self.h22 * v2 * v2
        return kinetic - self.g1 * cos(q1) - self.g2 * cos(q1 + q2)

    def momentum_Nms(self, y: Motion) -> float:
        """Angular momentum about the shoulder, conserved without gravity and friction."""
        _, q2, v1, v2 = y
        h11 = self.h11 + 2.0 * self.coupling * cos(q2)
        return h11 * v1 + (self.h22 + self.coupling * cos(q2)) * v2

    def hold_torque(self, y: list[float], tau: Sequence[float], span_s: float, steps: int) -> None:
        """Advance `y` in place by RK4 under a constant torque."""
        q1, q2, v1, v2 = y
        h = span_s / steps
        f = self.acceleration
        for _ in range(steps):
            a1, a2 = f((q1, q2, v1, v2), tau)
            u1, u2 = v1 + 0.5 * h * a1, v2 + 0.5 * h * a2
            b1, b2 = f((q1 + 0.5 * h * v1, q2 + 0.5 * h * v2, u1, u2), tau)
            w1, w2 = v1 + 0.5 * h * b1, v2 + 0.5 * h * b2
            c1, c2 = f((q1 + 0.5 * h * u1, q2 + 0.5 * h * u2, w1, w2), tau)
            x1, x2 = v1 + h * c1, v2 + h * c2
            d1, d2 = f((q1 + h * w1, q2 + h * w2, x1, x2), tau)
            q1 += h / 6.0 * (v1 + 2.0 * (u1 + w1) + x1)
            q2 += h / 6.0 * (v2 + 2.0 * (u2 + w2) + x2)
            v1 += h / 6.0 * (a1 + 2.0 * (b1 + c1) + d1)
            v2 += h / 6.0 * (a2 + 2.0 * (b2 + c2) + d2)
        y[:] = q1, q2, v1, v2


class Chain:
    """n links: sum_j A_ij cos(th_i - th_j) ddth_j = Q_i in absolute angles th."""

    def __init__(self, settings: PlantSettings) -> None:
        links = settings.links
        n = len(links)
        arm = np.zeros((n, n))  # arm[k, j]: lever of link j's direction in the position of com k
        for k, link in enumerate(links):
            arm[k, :k] = [inner.length_m for inner in links[:k]]
            arm[k, k] = link.com_m
        mass = np.array([link.mass_kg for link in links])
        self.n = n
        self.a = arm.T @ (mass[:, None] * arm)
        self.inertia = np.diag([link.inertia_kg_m2 for link in links])
        self.g = settings.gravity_m_s2 * (mass @ arm)
        self.viscous = np.array([link.viscous_Nms_rad for link in links])
        self.coulomb = np.array([link.coulomb_Nm for link in links])
        self.excess = np.array([static_excess(link) for link in links])
        self.vs = np.array([link.stribeck_rad_s for link in links])
        self.d = settings.tanh_slope_s_rad

    def acceleration(self, y: Motion, tau: Sequence[float]) -> np.ndarray:
        q, v = np.asarray(y[: self.n]), np.asarray(y[self.n :])
        angle, rate = np.cumsum(q), np.cumsum(v)
        between = angle[:, None] - angle[None, :]
        dry = self.coulomb + self.excess * np.exp(-((v / self.vs) ** 2))
        joint = np.asarray(tau) - self.viscous * v - dry * np.tanh(self.d * v)
        load = joint - np.append(joint[1:], 0.0)  # on the link, less the reaction of the next
        load -= (self.a * np.sin(between)) @ rate**2 + self.g * np.sin(angle)
        absolute = np.linalg.solve(self.a * np.cos(between) + self.inertia, load)
        return np.diff(absolute, prepend=0.0)

    def energy_J(self, y: Motion) -> float:
        angle, rate = np.cumsum(y[: self.n]), np.cumsum(y[self.n :])
        inertia = self.a * np.cos(angle[:, None] - angle[None, :]) + self.inertia
        return float(0.5 * rate @ inertia @ rate - self.g @ np.cos(angle))

    def hold_torque(
        self, y: np.ndarray, tau: Sequence[float], span_s: float, steps: int
    ) -> np.ndarray:
        """Return the motion after `span_s` under a constant torque, by RK4."""
        h = span_s / steps

        def slope(y: np.ndarray) -> np.ndarray:
            return np.concatenate((y[self.n :], self.acceleration(y, tau)))

        for _ in range(steps):
            a = slope(y)
            b = slope(y + 0.5 * h * a)
            c = slope(y + 0.5 * h * b)
            y = y + h / 6.0 * (a + 2.0 * (b + c) + slope(y + h * c))
        return y

    def momentum_Nms(self, y: Motion) -> float:
        """Angular momentum about the shoulder: all absolute angles turn alike."""
        angle, rate = np.cumsum(y[: self.n]), np.cumsum(y[self.n :])
        inertia = self.a * np.cos(angle[:, None] - angle[None, :]) + self.inertia
        return float(np.ones(self.n) @ inertia @ rate)


def static_excess(link: LinkSettings) -> float:
    """By how much static friction exceeds Coulomb friction."""
    return 0.0 if link.static_Nm is None else link.static_Nm - link.coulomb_Nm


def solve(
    plant: TwoLink | Chain, y0: Motion, times_s: Sequence[float], torque: Torque
) -> np.ndarray:
    """Return the motion at each of `times_s` under a smooth torque, by DOP853; shape (time, 2n)."""
    n = len(y0) // 2

    def slope(t: float, y: np.ndarray) -> list[float]:
        motion = y.tolist()
        return [*motion[n:], *plant.acceleration(motion, torque(t, motion))]

    answer = solve_ivp(
        slope, (0.0, times_s[-1]), list(y0), "DOP853", list(times_s), rtol=1e-10, atol=1e-12
    )
    assert answer.success, answer.message
    return np.asarray(answer.y.T)


def no_torque(_t: float, y: Motion) -> list[float]:
    """Let the arm swing freely."""
    return [0.0] * (len(y) // 2)


def whole_ms(seconds: float, every_ms: int = 1) -> list[float]:
    """Instants every so many milliseconds, from the first to `seconds`."""
    return [1e-3 * k for k in range(every_ms, math.floor(seconds * 1e3) + 1, every_ms)]
