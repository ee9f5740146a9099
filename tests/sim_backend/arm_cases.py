"""Motions on which the simulated arm is compared with the Lagrange equations."""

from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass
from functools import cache
from math import exp, inf, pi, sin

from sim_backend.arm import Arm
from sim_backend.perturbation import with_stribeck
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
class Errors:
    """Largest deviations from the Lagrange equations; energy relative to that above rest."""

    q_rad: float = inf
    q_first_second_rad: float = inf
    dq_rad_s: float = inf
    energy: float = inf

    def is_within(self, bounds: "Errors", widening: float = 1.0) -> bool:
        pairs = zip(astuple(self), astuple(bounds), strict=True)
        return all(error < widening * bound for error, bound in pairs)


@dataclass(frozen=True)
class Case:
    """A motion, and the bounds on its errors at a substep of 100 us."""

    plant: PlantSettings
    start: tuple[float, float, float, float]
    law: Law
    bounds: Errors
    duration_s: float = 10.0

    def settings(self, substep_s: float) -> PlantSettings:
        return self.plant.model_copy(update={"substep_s": substep_s, "q0_rad": self.start[:2]})


SWING = without_friction(plant_preset("pelican_v"))
SPIN = without_friction(plant_preset("light_h"))
PELICAN, LIGHT = plant_preset("pelican_v"), plant_preset("light_h")
OFFSET = (0.4, -0.5, 0.0, 0.0)
CASES = {
    "small swing": Case(SWING, (0.5, 0.0, 0.0, 0.0), free, Errors(q_rad=3e-5, energy=1e-6)),
    # A large free swing is chaotic: angles are compared in its first second only.
    "quarter turn": Case(
        SWING, (pi / 2.0, 0.0, 0.0, 0.0), free, Errors(q_first_second_rad=1e-5, energy=5e-6)
    ),
    "fast start": Case(SPIN, (0.0, 0.0, 12.0, -5.0), free, Errors(q_rad=1e-4), 1.0),
    "sine": Case(PELICAN, (0.0, 0.0, 0.0, 0.0), sine, Errors(q_rad=1e-4)),
    "pd": Case(PELICAN, OFFSET, pd((100, 15), (10, 1)), Errors(q_rad=1e-5, dq_rad_s=5e-4)),
    "stribeck": Case(with_stribeck(PELICAN), (0.5, 0.0, 0.0, 0.0), free, Errors(q_rad=1e-5), 3.0),
    "light pd": Case(LIGHT, OFFSET, pd((60, 15), (1, 0.2)), Errors(dq_rad_s=1.5e-3)),
}


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


def measure(
    name: str,
    substep_s: float,
    build: Callable[[PlantSettings], Arm] = Arm,
    stop_beyond: Errors | None = None,
) -> Errors:
    """Run a case, torques updated every 1 ms, the arm advanced in steps of 500 us.

    Args:
        name: Key of `CASES`.
        substep_s: Of the arm.
        build: Makes the arm, or a wrong one.
        stop_beyond: Give up early once the errors are not within these bounds.
    """
    case = CASES[name]
    arm = build(case.settings(substep_s))
    arm.reset(case.start[:2], case.start[2:])
    start_J, rest_J = arm.energy_J(), TwoLink(case.plant).energy_J((0.0, 0.0, 0.0, 0.0))
    q = q_first = dq = energy = 0.0
    for k, y in enumerate(truth(name)):
        tau = case.law(k * PERIOD_S, (*arm.q_rad, *arm.dq_rad_s))
        arm.step(tau, CONTROL_STEP_S)
        arm.step(tau, CONTROL_STEP_S)
        q = max(q, abs(arm.q_rad[0] - y[0]), abs(arm.q_rad[1] - y[1]))
        dq = max(dq, abs(arm.dq_rad_s[0] - y[2]), abs(arm.dq_rad_s[1] - y[3]))
        if case.law is free:
            energy = max(energy, abs(arm.energy_J() - start_J) / (start_J - rest_J))
        q_first = q if k < 1000 else q_first
        errors = Errors(q, q_first, dq, energy)
        if stop_beyond and not errors.is_within(stop_beyond):
            break
    return errors
