"""Stops that are none, vertical arms that are let down, answers that come a period late."""

import math

import numpy as np
import pytest

from controller.faults import FaultCode
from controller.gravity import GravityLoad
from controller.machine import State
from controller.settings import ModelSettings
from tests.hil.virtual import Rig, configured

VERTICAL = (
    'arm.preset="pelican_v"',
    "plant.q0_rad=[1.2, 0.4]",
    'controller.law.name="computed_torque"',  # it holds the arm up; the model-free laws sag
)


def hold_up(*assignments):
    """A vertical arm under power, away from where it hangs."""
    rig = Rig(*VERTICAL, *assignments)
    rig.enable()
    rig.step(300)
    assert rig.state is State.READY
    assert rig.fault is FaultCode.NONE
    return rig


def test_gravity_load__random_poses__gradient_of_the_potential_energy():
    config = configured(*VERTICAL)
    model, limits = config.controller.model, config.controller.limits
    assert isinstance(model, ModelSettings)
    load = GravityLoad(model, limits)

    def energy_J(q):
        height, angle, total = 0.0, 0.0, 0.0
        for link, turn in zip(model.links, q, strict=True):
            angle += turn
            total += link.mass_kg * model.gravity_m_s2 * (height - link.com_m * math.cos(angle))
            height -= link.length_m * math.cos(angle)
        return total

    random = np.random.default_rng(1)
    for q in random.uniform(-3.0, 3.0, (50, 2)):
        for joint, torque in enumerate(load.torques_Nm(q)):
            step = np.zeros(2)
            step[joint] = 1e-6
            slope = (energy_J(q + step) - energy_J(q - step)) / 2e-6
            assert torque == pytest.approx(slope, abs=1e-6)


def test_disable__vertical_arm_held_up__let_down_slowly_then_off():
    rig = hold_up()
    top_rad = rig.control.q_rad[0]
    before = len(rig.history)
    rig.control.disable()
    rig.run_until(State.IDLE, 11_000)
    rates = np.abs([row[1] for row in rig.history[before:]])
    assert rates.max() < 1.2  # falling freely from there it would be several times as fast
    assert top_rad - rig.control.q_rad[0] > 0.5
    load = GravityLoad(rig.config.controller.model, rig.config.controller.limits)
    assert load.is_down(load.torques_Nm(rig.control.q_rad))
    rig.step(2000)
    rest = np.abs(rig.column("dq", 2000))
    assert rest.max() < 1.5  # what is left of the way is short


def test_estop__vertical_arm_held_up__falls():
    """The bound above means something: without a stop's torque the same arm drops."""
    rig = hold_up()
    rig.control.estop()
    rig.step(1500)
    assert np.abs(rig.column("dq", 1500)).max() > 2.0


def test_stop__torque_with_reversed_sign__ends_with_torque_off_not_with_a_runaway():
    rig = Rig()
    rig.swing(400)
    rig.control.inject_fault(1, "amplifier", "wrong")
    rig.run_until(State.STOPPING, 1000)
    speed_rad_s = np.abs(rig.control.dq_rad_s).max()
    rig.run_until(State.FAULT, 300)
    assert np.abs(rig.control.dq_rad_s).max() < 1.5 * speed_rad_s + 1.5
    assert rig.fault is FaultCode.FOLLOWING_ERROR  # the first one stays
    last = [detail for kind, detail in rig.events if kind == "fault"][-1]
    assert (last["code"], last["reaction"]) == ("VELOCITY", "TORQUE_OFF")
    assert "check the sign" in last["detail"]
    rig.step(2)
    assert rig.emulator.tau_applied_Nm == [0.0, 0.0]


@pytest.mark.parametrize("family", ["cia402", "mit", "moteus", "odrive"])
def test_feedback__always_a_period_late__counted_and_torque_off(family):
    rig = Rig(*(f"axes.{j}.family={family}" for j in (1, 2)))
    rig.swing(400)
    before = rig.bus.late_frames
    rig.control.inject_fault(2, "amplifier", "delayed")
    rig.step(60)
    assert rig.state is State.FAULT
    assert rig.fault is FaultCode.FEEDBACK_LOST
    assert rig.bus.late_frames > before + 5
    fault = next(detail for kind, detail in rig.events if kind == "fault")
    assert "joint 2" in fault["detail"]
    assert "a period late" in fault["detail"]


@pytest.mark.parametrize("gap", [1, 3])
def test_feedback__answer_late_once__believed_again_after_two_probes(gap):
    rig = Rig()
    rig.swing(400)
    rig.control.inject_fault(2, "amplifier", "delayed", gap * 1e-3)
    rig.step(60)
    assert rig.state is State.ACTIVE
    assert rig.bus.age_cycles == 0
    rig.step(200)
    assert rig.state is State.ACTIVE


def test_enable__late_drive__times_out_and_is_named():
    rig = Rig("loop.enable_timeout_s=0.1")
    rig.control.inject_fault(1, "amplifier", "delayed")
    rig.step(60)
    rig.control.enable()
    rig.step(200)
    assert rig.state is State.FAULT
    assert rig.fault is FaultCode.ENABLE_TIMEOUT


@pytest.mark.parametrize(("preset", "is_lowered"), [("pelican_v", True), ("pelican_h", False)])
def test_stop_time__preset__longer_only_where_gravity_pulls(preset, is_lowered):
    settings = configured(f'arm.preset="{preset}"').controller
    limits = settings.limits
    assert settings.is_lowered is is_lowered
    wanted_s = limits.lowering_timeout_s if is_lowered else limits.stop_timeout_s
    assert settings.stop_time_s == wanted_s
