"""The simulated arm against the Lagrange equations, and deliberately wrong arms against its bounds.

Bounds hold at 100 us; at 250 us they are 7 times as wide. Each wrong arm must break the bound of
the case that is there to catch it.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from math import exp, pi, sin, tanh

import pymunk
import pytest

from sim_backend.arm import Arm
from sim_backend.presets import plant_preset
from sim_backend.settings import PlantSettings
from tests.sim_backend.closed_form import Motion, TwoLink, no_torque, solve, whole_ms

PERIOD_S = 1e-3
CONTROL_STEP_S = 500e-6
Law = Callable[[float, Motion], Sequence[float]]


def without_friction(settings: PlantSettings) -> PlantSettings:
    slick = {"viscous_Nms_rad": 0.0, "coulomb_Nm": 0.0}
    links = tuple(link.model_copy(update=slick) for link in settings.links)
    return settings.model_copy(update={"links": links})


def free(_t: float, _y: Motion) -> Sequence[float]:
    return 0.0, 0.0


def sine(t: float, _y: Motion) -> Sequence[float]:
    return 4.0 * sin(3.0 * t), 1.0 * sin(5.0 * t)


def pd(kp: Sequence[float], kd: Sequence[float]) -> Law:
    """PD about the exponential-sine trajectory, with plant-true angle and rate."""

    def law(t: float, y: Motion) -> Sequence[float]:
        h = 1.0 - exp(-2.0 * t**3)
        q1_des = pi / 4.0 * h + pi / 9.0 * h * sin(4.0 * t)
        q2_des = pi / 3.0 * h + pi / 6.0 * h * sin(3.0 * t)
        return kp[0] * (q1_des - y[0]) - kd[0] * y[2], kp[1] * (q2_des - y[1]) - kd[1] * y[3]

    return law


@dataclass(frozen=True)
class Case:
    plant: PlantSettings
    start: tuple[float, float, float, float]
    law: Law
    duration_s: float

    def settings(self, substep_s: float) -> PlantSettings:
        return self.plant.model_copy(update={"substep_s": substep_s, "q0_rad": self.start[:2]})


SWING = without_friction(plant_preset("pelican_v"))
SPIN = without_friction(plant_preset("light_h"))
CASES = {
    "small swing": Case(SWING, (0.5, 0.0, 0.0, 0.0), free, 10.0),
    "quarter-turn swing": Case(SWING, (pi / 2.0, 0.0, 0.0, 0.0), free, 10.0),
    "fast start": Case(SPIN, (0.0, 0.0, 12.0, -5.0), free, 1.0),
    "sine": Case(plant_preset("pelican_v"), (0.0, 0.0, 0.0, 0.0), sine, 10.0),
    "pd": Case(plant_preset("pelican_v"), (0.4, -0.5, 0.0, 0.0), pd((100, 15), (10, 1)), 10.0),
    "light pd": Case(plant_preset("light_h"), (0.4, -0.5, 0.0, 0.0), pd((20, 5), (1.5, 0.3)), 10.0),
}


@dataclass(frozen=True)
class Errors:
    """Largest deviations from the Lagrange equations; energy relative to that above rest."""

    q_rad: float
    q_first_second_rad: float
    dq_rad_s: float
    energy: float
    separation_m: float


@cache
def truth(name: str) -> list[list[float]]:
    """Return the motion after every period: DOP853 where torque is smooth, else RK4 at 125 us."""
    case = CASES[name]
    plant = TwoLink(case.plant)
    if case.law is free:
        return solve(plant, case.start, whole_ms(case.duration_s), no_torque).tolist()
    y, motion = list(case.start), []
    for k in range(round(case.duration_s / PERIOD_S)):
        plant.hold_torque(y, case.law(k * PERIOD_S, y), PERIOD_S, 8)
        motion.append(y[:])
    return motion


def measure(name: str, substep_s: float, build: Callable[[PlantSettings], Arm] = Arm) -> Errors:
    case = CASES[name]
    arm = build(case.settings(substep_s))
    arm.reset(case.start[:2], case.start[2:])
    start_J, rest_J = arm.energy_J(), TwoLink(case.plant).energy_J((0.0, 0.0, 0.0, 0.0))
    q = q_first = dq = energy = separation = 0.0
    for k, y in enumerate(truth(name)):
        tau = case.law(k * PERIOD_S, (*arm.q_rad, *arm.dq_rad_s))
        arm.step(tau, CONTROL_STEP_S)
        arm.step(tau, CONTROL_STEP_S)
        q = max(q, abs(arm.q_rad[0] - y[0]), abs(arm.q_rad[1] - y[1]))
        dq = max(dq, abs(arm.dq_rad_s[0] - y[2]), abs(arm.dq_rad_s[1] - y[3]))
        energy = max(energy, abs(arm.energy_J() - start_J))
        if k % 10 == 0:
            separation = max(separation, arm.joint_separation_m())
        if k == 999:
            q_first = q
    is_free = case.law is free
    return Errors(q, q_first, dq, energy / (start_J - rest_J) if is_free else 0.0, separation)


class DefaultBias(Arm):
    def _build(self):
        super()._build()
        for joint in self._joints:
            joint.error_bias = pymunk.PivotJoint(joint.a, joint.b, (0, 0), (0, 0)).error_bias


class TinyBias(Arm):
    def _build(self):
        super()._build()
        for joint in self._joints:
            joint.error_bias = 1e-300


class RawReadOut(Arm):
    def _read_out(self):
        super()._read_out()
        first, second = (body.angle for body in self._bodies)
        self.q_rad = [first, second - first]


class Damped(Arm):
    def _build(self):
        super()._build()
        self._space.damping = 0.9999


class HeavierLink(Arm):
    def __init__(self, settings):
        links = tuple(
            link.model_copy(update={"inertia_kg_m2": 1.01 * link.inertia_kg_m2})
            for link in settings.links
        )
        super().__init__(settings.model_copy(update={"links": links}))


class NoBackDrift(Arm):
    def _drift(self, dt_s):
        pass


class EulerFriction(Arm):
    def _advance_two(self, tau_Nm, substeps):
        for _ in range(substeps):
            self._rates_before = self.dq_rad_s
            super()._advance_two(tau_Nm, 1)


class FrozenFriction(Arm):
    def _advance_two(self, tau_Nm, substeps):
        loss = [
            link.viscous_Nms_rad * dq + link.coulomb_Nm * tanh(self.settings.tanh_slope_s_rad * dq)
            for link, dq in zip(self.settings.links, self.dq_rad_s, strict=True)
        ]
        self._friction = [(0.0, 0.0)] * 2
        super()._advance_two([t - f for t, f in zip(tau_Nm, loss, strict=True)], substeps)


class NoReaction(Arm):
    def _advance_two(self, tau_Nm, substeps):
        super()._advance_two((tau_Nm[0] + tau_Nm[1], tau_Nm[1]), substeps)


class TorqueOnce(Arm):
    def _advance_two(self, tau_Nm, substeps):
        super()._advance_two(tau_Nm, 1)
        super()._advance_two((0.0, 0.0), substeps - 1)


class LateTorque(Arm):
    late_Nm: Sequence[float] = (0.0, 0.0)

    def step(self, tau_Nm, duration_s):
        super().step(self.late_Nm, duration_s)
        self.late_Nm = tau_Nm


class DifferencedRate:
    """A sound arm whose rate is read as the difference of two angles."""

    def __init__(self, settings):
        self.arm = Arm(settings)

    def reset(self, q_rad, dq_rad_s):
        self.arm.reset(q_rad, dq_rad_s)
        self.q_rad, self.dq_rad_s = self.arm.q_rad, self.arm.dq_rad_s

    def step(self, tau_Nm, duration_s):
        self.arm.step(tau_Nm, duration_s)
        pairs = zip(self.arm.q_rad, self.q_rad, strict=True)
        self.dq_rad_s = [(now - before) / duration_s for now, before in pairs]
        self.q_rad = self.arm.q_rad

    def energy_J(self):
        return self.arm.energy_J()

    def joint_separation_m(self):
        return self.arm.joint_separation_m()


class OneIteration(Arm):
    def _build(self):
        super()._build()
        self._space.iterations = 1


class Naive(DefaultBias, RawReadOut, NoBackDrift, EulerFriction):
    pass
