"""Deliberate errors in law, plant and estimator, each one line of the source changed."""

import inspect
import types
from dataclasses import dataclass
from importlib import import_module

from hil.config import load_config
from hil.experiment import Memory, play_in_simulation, scenario_request, scenario_settings
from hil.metrics import MetricsError, check, measure_scenario
from hil.scenarios import find_scenario
from hil.simulation import SimulationError
from sim_backend.errors import PlantError


@dataclass(frozen=True)
class Mutant:
    name: str
    where: str  # "module:Class.method"
    old: str
    new: str
    scenario: str = "A"


LAW = "controller.law:PassivityLaw.step"
GAIN = "controller.gain:SelfTuningGain.step"
PLANT = "sim_backend.chain:Chain._advance_two"
FILTER = "controller.velocity:FilteredDifference.step"
LEVANT = "controller.velocity:Levant.step"

MUTANTS = (
    Mutant(
        "velocity error reversed",
        LAW,
        "dq_rad_s[j] - dq_des_rad_s[j]",
        "dq_des_rad_s[j] - dq_rad_s[j]",
    ),
    Mutant("desired velocity forgotten", LAW, "dq_rad_s[j] - dq_des_rad_s[j]", "dq_rad_s[j]"),
    Mutant(
        "alpha of the other joint", LAW, "alpha * (q_rad[j]", "self._alpha[1 - j][0] * (q_rad[j]"
    ),
    Mutant("integral term left out", LAW, "S_q + Ki * sigma_j", "S_q"),
    Mutant("integral term reversed", LAW, "S_q + Ki * sigma_j", "S_q - Ki * sigma_j"),
    Mutant("lambda forgotten", LAW, "f(self._lambda[j] * S_q)", "f(S_q)"),
    Mutant(
        "integral of S instead of S_q",
        LAW,
        "f(self._lambda[j] * S_q)",
        "f(self._lambda[j] * S_j * 20.0)",
    ),
    Mutant(
        "rules big and small swapped",
        GAIN,
        "beta[BIG] * big + beta[MEDIUM] * medium + beta[SMALL] * small",
        "beta[SMALL] * big + beta[MEDIUM] * medium + beta[BIG] * small",
    ),
    Mutant("rule medium left out", GAIN, "+ beta[MEDIUM] * medium ", "", "B"),
    Mutant(
        "gain constant at its maximum",
        GAIN,
        "return Kd if Kd < self.Kd_max else self.Kd_max",
        "return self.Kd_max",
    ),
    Mutant("signed S into the memberships", GAIN, "S if S >= 0.0 else -S", "max(S, 0.0)"),
    Mutant(
        "adaptation a thousand times too fast",
        "controller.gain:SelfTuningGain._adapt",
        "self._rate_per_s * dt_s",
        "1e3 * self._rate_per_s * dt_s",
    ),
    Mutant("rate halved", FILTER, "(q - before) / dt_s", "0.5 * (q - before) / dt_s"),
    Mutant(
        "filter ten times too slow",
        FILTER,
        "self._rate_per_s * dt_s",
        "0.1 * self._rate_per_s * dt_s",
    ),
    Mutant("no filter", FILTER, "1.0 - math.exp(-self._rate_per_s * dt_s)", "1.0"),
    Mutant("Levant without the root", LEVANT, "math.sqrt(C * abs(error))", "C * abs(error)", "B"),
    Mutant("Levant's second gain tripled", LEVANT, "1.1 * C * sign", "3.3 * C * sign", "B"),
    Mutant("no Coulomb friction", PLANT, "- coulomb_1 * tanh(slope * rate)", ""),
    Mutant("no reaction on the first link", PLANT, "tau_1 - tau_2", "tau_1"),
    Mutant(
        "torque of the joints swapped",
        PLANT,
        "demand_1, demand_2 = tau_Nm",
        "demand_2, demand_1 = tau_Nm",
    ),
    Mutant(
        "torque constant half",
        "sim_backend.servo:Servo.drive",
        "return mean_A * torque_constant_Nm_A",
        "return 0.5 * mean_A * torque_constant_Nm_A",
    ),
    Mutant(
        "encoder of the plant scaled",
        "sim_backend.servo:Servo.sense",
        "self.q_rad = q_rad",
        "self.q_rad = 0.99 * q_rad",
    ),
    Mutant(
        "gravity missing",
        "sim_backend.chain:Chain._build",
        "(self.settings.gravity_m_s2, 0.0)",
        "(0.0, 0.0)",
        "E",
    ),
)


def apply(mutant: Mutant) -> None:
    """Put the changed method in place of the original, in this process."""
    module_name, _, path = mutant.where.partition(":")
    class_name, _, method = path.partition(".")
    module = import_module(module_name)
    original = getattr(module, class_name)
    body = inspect.getsource(getattr(original, method))
    assert body.count(mutant.old) == 1, f"{mutant.name}: the source has changed, adapt the mutant"
    source = inspect.getsource(module).replace(body, body.replace(mutant.old, mutant.new))
    changed = types.ModuleType(module_name)
    changed.__dict__.update(__file__=module.__file__, __package__=module.__package__)
    exec(compile(source, module.__file__, "exec"), changed.__dict__)
    setattr(original, method, getattr(changed.__dict__[class_name], method))


def broken_bounds(scenario_name: str) -> list[str]:
    """Run a scenario and return the names of the bounds that are not met, or why it tripped."""
    scenario = find_scenario(scenario_name)
    config = load_config(overrides=scenario_settings(scenario))
    memory = Memory(config.joints)
    try:
        play_in_simulation(config, scenario_request(scenario), memory)
        metrics = measure_scenario(memory.samples(), scenario)
    except (SimulationError, MetricsError, PlantError) as error:
        return [str(error)]
    return [f"{r.name} {r.joint}: {r.value:g}" for r in check(metrics, scenario) if not r.passed]


def hunt(mutant: Mutant | None, scenario: str) -> list[str]:
    """Return what shows the mutant; run this in a process of its own."""
    if mutant is not None:
        apply(mutant)
    return broken_bounds(scenario)
