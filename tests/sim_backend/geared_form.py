"""Arms with rotors behind gaps, from the equations, switched at the instants of contact.

The independent truth for drivetrains: between two contacts the equations are smooth and DOP853
solves them; each touch and each parting is an event at which it stops and starts anew. A motion is
(q_1 .. q_n, dq_1 .. dq_n, theta_1 .. theta_n, dtheta_1 .. dtheta_n).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import cos, sin, tanh

import numpy as np
from scipy.integrate import solve_ivp

from sim_backend.settings import PlantSettings
from tests.sim_backend.closed_form import Motion, TwoLink

FREE, UPPER, LOWER = 0, 1, -1


class Pendulum:
    """One link: (I + m lc^2) ddq + m g lc sin q + tau_f = tau."""

    def __init__(self, settings: PlantSettings) -> None:
        (link,) = settings.links
        self.inertia = link.inertia_kg_m2 + link.mass_kg * link.com_m**2
        self.weight = settings.gravity_m_s2 * link.mass_kg * link.com_m
        self.viscous, self.coulomb = link.viscous_Nms_rad, link.coulomb_Nm
        self.d = settings.tanh_slope_s_rad

    def acceleration(self, y: Motion, tau: Sequence[float]) -> tuple[float]:
        q, v = y
        friction = self.viscous * v + self.coulomb * tanh(self.d * v)
        return ((tau[0] - friction - self.weight * sin(q)) / self.inertia,)

    def energy_J(self, y: Motion) -> float:
        return 0.5 * self.inertia * y[1] ** 2 - self.weight * cos(y[0])


class GearedChain:
    """One or two links, each driven by a rotor: M ddq + ... = f, J ddtheta + friction = tau - f."""

    def __init__(self, settings: PlantSettings) -> None:
        self.n = len(settings.links)
        self.links = Pendulum(settings) if self.n == 1 else TwoLink(settings)
        self.gears = [link.drivetrain for link in settings.links]
        self.d = settings.tanh_slope_s_rad

    def push(self, j: int, y: Motion, side: int) -> float:
        """Torque of one flank of joint j on the link, were it in contact."""
        gear, n = self.gears[j], self.n
        twist, rate = y[2 * n + j] - y[j], y[3 * n + j] - y[n + j]
        depth = twist - side * 0.5 * gear.gap_rad
        return gear.stiffness_Nm_rad * depth + gear.damping_Nms_rad * rate

    def touch(self, j: int, y: Motion, side: int) -> float:
        """Positive exactly while this flank presses."""
        depth = side * (y[2 * self.n + j] - y[j]) - 0.5 * self.gears[j].gap_rad
        return min(depth, side * self.push(j, y, side))

    def slope(self, y: Motion, tau: Sequence[float], sides: Sequence[int]) -> list[float]:
        n = self.n
        f = [self.push(j, y, side) if side else 0.0 for j, side in enumerate(sides)]
        link = self.links.acceleration(y[: 2 * n], f)
        rotor = []
        for j, gear in enumerate(self.gears):
            rate = y[3 * n + j]
            loss = gear.viscous_Nms_rad * rate + gear.coulomb_Nm * tanh(self.d * rate)
            rotor.append((tau[j] - f[j] - loss) / gear.rotor_inertia_kg_m2)
        return [*y[n : 2 * n], *link, *y[3 * n :], *rotor]

    def energy_J(self, y: Motion) -> float:
        n = self.n
        energy = self.links.energy_J(y[: 2 * n])
        for j, gear in enumerate(self.gears):
            depth = max(abs(y[2 * n + j] - y[j]) - 0.5 * gear.gap_rad, 0.0)
            energy += 0.5 * gear.rotor_inertia_kg_m2 * y[3 * n + j] ** 2
            energy += 0.5 * gear.stiffness_Nm_rad * depth**2
        return energy


def solve_geared(
    plant: GearedChain, y0: Motion, legs: Sequence[Sequence[float]], leg_s: float, every_s: float
) -> tuple[np.ndarray, int]:
    """Solve under motor torques that stay for `leg_s` each.

    Returns:
        The motion at every multiple of `every_s`, shape (time, 4n), and how often flanks touched.
    """
    y, rows, touches = np.array(y0, float), [], 0
    times = every_s * np.arange(1, round(leg_s / every_s) + 1)
    for tau in legs:
        leg, count = _solve_leg(plant, y, tau, times)
        y = leg[-1]
        rows.append(leg)
        touches += count
    return np.concatenate(rows), touches


def _solve_leg(
    plant: GearedChain, y: np.ndarray, tau: Sequence[float], times_s: np.ndarray
) -> tuple[np.ndarray, int]:
    t, rows, touches, pending = 0.0, [], 0, times_s
    sides = [
        next((s for s in (UPPER, LOWER) if plant.touch(j, y, s) > 0.0), FREE)
        for j in range(plant.n)
    ]
    while len(pending):
        changes = _changes(plant, sides)
        answer = solve_ivp(
            lambda _t, y, sides=tuple(sides): plant.slope(y.tolist(), tau, sides),
            (t, pending[-1]),
            y,
            "DOP853",
            dense_output=True,
            events=[event for event, _, _ in changes],
            max_step=1e-3,  # in a longer one a light touch could come and go unseen
            rtol=1e-10,
            atol=1e-12,
        )
        assert answer.success, answer.message
        t, y = answer.t[-1], answer.y[:, -1]
        reached = pending <= t
        if reached.any():
            rows.append(answer.sol(pending[reached]).T)
        pending = pending[~reached]
        for (_, j, side), instants in zip(changes, answer.t_events, strict=True):
            if len(instants):
                sides[j] = side
                touches += side != FREE
    return np.concatenate(rows), touches


def _changes(
    plant: GearedChain, sides: Sequence[int]
) -> list[tuple[Callable[[float, np.ndarray], float], int, int]]:
    """List the events that end this phase, with the joint and what becomes of its contact."""
    changes = []
    for j, side in enumerate(sides):
        if side == FREE:
            changes.extend((_event(plant, j, s, rising=True), j, s) for s in (UPPER, LOWER))
        else:
            changes.append((_event(plant, j, side, rising=False), j, FREE))
    return changes


def _event(
    plant: GearedChain, j: int, side: int, *, rising: bool
) -> Callable[[float, np.ndarray], float]:
    # A phase begins where the one before ended, at zero but for rounding: on the right side of it.
    offset = 1e-10 if rising else -1e-10

    def event(_t: float, y: np.ndarray) -> float:
        return plant.touch(j, y, side) - offset

    event.terminal, event.direction = True, 1.0 if rising else -1.0
    return event
