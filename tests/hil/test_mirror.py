"""The mirrored experiment: start, reference and load negated, and everything with them.

Arm, friction, gravity (q1 from the downward vertical), encoder and amplifiers have no preferred
direction, and neither has the law as long as its adaptation has none. Then the run through frames
and amplifiers is the negative of the other to the last bit.
"""

from dataclasses import replace

import numpy as np
import pytest

from controller.machine import State
from controller.reference import MotionLimits, MotionState, Reference
from hil.config import load_config, merge
from hil.experiment import Memory, scenario_request, scenario_settings
from hil.planner import plan
from hil.scenarios import find_scenario
from hil.simulation import Simulation

NEGATED = (
    "q_meas_rad",
    "dq_meas_rad_s",
    "q_des_rad",
    "dq_des_rad_s",
    "S_rad_s",
    "sigma",
    "tau_cmd_Nm",
    "tau_sent_Nm",
    "q_true_rad",
    "dq_true_rad_s",
    "tau_applied_Nm",
)
LOAD_NM = (0.3, 0.0)
FAST = 1e-4
"""A learning rate at which 30 s show what takes most of an hour at the default, 1e-6."""


def settings(scenario, sign, law):
    loads = [
        {"joint": joint, "torque_Nm": sign * torque_Nm}
        for joint, torque_Nm in enumerate(LOAD_NM, start=1)
    ]
    plant = {"q0_rad": [sign * q for q in scenario.q0_rad], "disturbances": loads}
    over = {"plant": plant, "controller": {"law": {"learning_rate": FAST} | law}}
    return load_config(None, merge(scenario_settings(scenario), over))


def play(name, sign, law, duration_s=2.0):
    """Samples and last beta of joint 1 of a scenario with a constant load, or of its mirror."""
    scenario = replace(find_scenario(name), duration_s=duration_s)
    config = settings(scenario, sign, law)
    memory = Memory(config.joints)
    simulation = Simulation(config, memory)
    simulation.execute("enable")
    simulation.run_until(State.READY, 1000)
    start = [sign * q for q in simulation.control.player.setpoint.q_rad]
    limits = MotionLimits.of(config.controller.limits, config.trajectory.max_duration_s)
    planned = plan(scenario_request(scenario), MotionState.at_rest(start), limits, 1e-3)
    motion = [sign * rows for rows in (planned.q_rad, planned.dq_rad_s, planned.ddq_rad_s2)]
    simulation.play(Reference(*motion, 1e-3))
    simulation.run(planned.samples)
    assert simulation.control.machine.state.is_powered
    simulation.close()
    beta = getattr(simulation.control.law.gains[0], "beta", [])
    return memory.samples(), list(beta)


def differing(samples, mirrored):
    """Names of what is not the exact negative; of Kd, what is not the same."""
    names = [name for name in NEGATED if not np.array_equal(samples[name], -mirrored[name])]
    return names + ["Kd"] * (not np.array_equal(samples["Kd"], mirrored["Kd"]))


OFF, ABSOLUTE, TRUE_SIGN = ({"adaptation": name} for name in ("off", "absolute", "true_sign"))


@pytest.mark.parametrize(
    ("name", "law"),
    [
        ("A0", ABSOLUTE),
        ("A", OFF),
        ("A", ABSOLUTE),
        ("A", TRUE_SIGN),
        ("A", {"tuner": "load_memory"}),
        ("A", {"name": "slotine_li"}),
        ("B", ABSOLUTE),
        ("E", OFF),
        ("E", ABSOLUTE),
    ],
    ids=str,
)
def test_run__mirrored__is_the_negative_to_the_last_bit(name, law):
    (samples, beta), (mirrored, mirrored_beta) = (play(name, sign, law) for sign in (1.0, -1.0))
    assert len(samples) > 2000
    assert np.ptp(samples["S_rad_s"], axis=0).min() > 0.5
    assert differing(samples, mirrored) == []
    assert beta == mirrored_beta
    if law in (ABSOLUTE, TRUE_SIGN):
        assert max(abs(now - before) for now, before in zip(beta, (1, 2, 4), strict=True)) > 0.01


def test_run__mirrored_with_literal_adaptation__another_error_and_another_gain():
    """A0, learning rate 1e-4, 0.3 Nm on joint 1, 30 s: beta_3, of the rule "S is small".

    An independent closed-form simulation of this case gives 2.77, and 4.00 mirrored.
    """
    literal = {"adaptation": "literal"}
    samples, beta = play("A0", 1.0, literal, duration_s=30.0)
    mirrored, mirrored_beta = play("A0", -1.0, literal, duration_s=30.0)
    assert beta[2] == pytest.approx(2.77, abs=0.03)
    assert mirrored_beta[2] == pytest.approx(4.00, abs=0.005)
    assert set(NEGATED) - set(differing(samples, mirrored)) == {"q_des_rad", "dq_des_rad_s"}
    late = slice(-8000, None)
    error, mirrored_error = (
        np.sqrt(np.mean((rows["q_true_rad"] - rows["q_des_rad"])[late, 0] ** 2))
        for rows in (samples, mirrored)
    )
    assert error > 1.1 * mirrored_error
