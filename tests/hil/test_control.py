"""The control cycle in virtual time: missing feedback, limits, power, latched faults."""

import numpy as np
import pytest

from controller.errors import CommandError
from controller.faults import REACTIONS, FaultCode, Reaction
from controller.machine import State
from controller.reference import Reference
from drivers.axis import AxisStatus
from drivers.cia402 import codec
from drivers.cia402.codec import Cia402State, NmtCommand
from drivers.errors import BusError
from hil.config import ConfigError, load_config
from hil.control import AT_REST_RAD_S
from hil.simulation import Simulation
from tests.hil.virtual import Rig

N_HOLD, N_DAMP = 5, 20
TPDO = {joint: codec.COB_TPDO1 + joint for joint in (1, 2)}
DAMPING = 1.0


def silence(rig, *joints):
    """Lose the cyclic feedback of some joints from now on."""
    lost = {TPDO[joint] for joint in joints}
    rig.lose_from_drives = lambda can_id, data: can_id in lost


def hear(rig):
    rig.lose_from_drives = lambda can_id, data: False


def drive_states(rig):
    return [codec.decode_state(node.drive.statusword()) for node in rig.emulator._nodes]


def torque_off(rig):
    """No torque is sent, and two cycles later none is applied."""
    assert rig.control.tau_sent_Nm == [0.0, 0.0]
    rig.step(2)
    assert rig.emulator.tau_applied_Nm == [0.0, 0.0]
    assert Cia402State.OPERATION_ENABLED not in drive_states(rig)


# --- missing feedback -------------------------------------------------------------------------


@pytest.mark.parametrize("joints", [(1,), (2,), (1, 2)])
def test_feedback__missing_for_good__held_then_damped_then_off_and_latched(joints):
    rig = Rig()
    rig.swing()
    before = rig.control.tau_sent_Nm
    rates = rig.control.dq_rad_s
    assert min(map(abs, rates)) > 0.1
    silence(rig, *joints)
    for age in range(1, N_HOLD + 1):
        rig.step()
        assert rig.bus.age_cycles == age
        assert rig.control.tau_sent_Nm == before
        assert rig.state is State.ACTIVE
    for _ in range(N_DAMP):
        rig.step()
        assert rig.state is State.ACTIVE
        damped = [0.0 if j in joints else -DAMPING * rates[j - 1] for j in (1, 2)]
        assert rig.control.tau_sent_Nm == pytest.approx(damped)
    rig.step()
    assert rig.state is State.FAULT
    assert rig.fault is FaultCode.FEEDBACK_LOST
    kind, detail = rig.events[-2]
    assert (kind, detail["code"], detail["reaction"]) == ("fault", "FEEDBACK_LOST", "TORQUE_OFF")
    assert f"joint {joints[0]} (cia402 node {joints[0]}): silent for 26" in detail["detail"]
    assert rig.control.tau_sent_Nm == [0.0, 0.0]
    torque_off(rig)
    hear(rig)
    rig.step(200)
    assert rig.state is State.FAULT  # its return changes nothing


@pytest.mark.parametrize("gap", [1, N_HOLD, N_HOLD + 1, N_HOLD + N_DAMP])
def test_feedback__missing_for_a_while__motion_goes_on(gap):
    rig = Rig()
    rig.swing()
    silence(rig, 1, 2)
    rig.step(gap)
    hear(rig)
    for _ in range(100):
        rig.step()
        assert rig.state is State.ACTIVE
    assert np.abs(rig.column("q", 1) - rig.column("q_des", 1)).max() < 0.1
    limits = rig.config.controller.limits
    steps = np.abs(np.diff(rig.column("sent", 100), axis=0))
    assert np.all(steps <= np.array(limits.tau_slew_Nm_s) * 1e-3 + 1e-9)


def test_feedback__one_frame_lost_now_and_then__age_tells_and_no_value_poses_as_fresh():
    rig = Rig()
    rig.swing()
    counts = []
    for cycle in range(60):
        drop = cycle % 3 == 0
        silence(rig, *([2] if drop else []))
        before = rig.bus.axes[1].q_rad
        rig.step()
        counts.append(rig.bus.age_cycles)
        if drop:
            assert rig.bus.axes[1].q_rad == before
    assert counts[:3] == [1, 0, 1]  # the first gap is followed by a probe, in which nobody is asked
    assert counts[6:48] == [1, 0, 0] * 14  # and others only after a while
    assert rig.state is State.ACTIVE


def test_feedback__missing_without_power__state_stays_and_enable_waits_for_it():
    rig = Rig("loop.enable_timeout_s=0.05")
    rig.step(10)
    silence(rig, 1)
    rig.step(100)
    assert rig.state is State.IDLE
    rig.control.enable()
    rig.step(100)
    assert rig.state is not State.READY
    assert rig.control.tau_sent_Nm == [0.0, 0.0]


# --- limits -----------------------------------------------------------------------------------


def trip_by(rig, code, cycles=2000):
    """Run until something trips; check code, reaction, latch and torque."""
    for _ in range(cycles):
        rig.step()
        if rig.fault is not FaultCode.NONE:
            break
    assert rig.fault is code
    (fault,) = [detail for kind, detail in rig.events if kind == "fault"]
    assert fault["code"] == code.name
    assert fault["reaction"] == REACTIONS[code].name
    if REACTIONS[code] is Reaction.SOFT_STOP:  # at rest it is over in the same cycle
        assert any(detail.get("to") == "STOPPING" for _, detail in rig.events)
        rig.run_until(State.FAULT, 3000)
    assert rig.state is State.FAULT
    torque_off(rig)
    with pytest.raises(CommandError, match="reset first"):
        rig.control.enable()
    return fault


def lead_to(rig, joint, q_rad, speed_rad_s=0.3):
    """Play a reference that nobody has checked: one joint goes to an angle at a constant rate."""
    start = list(rig.control.player.setpoint.q_rad)
    samples = 2 + round(abs(q_rad - start[joint]) / speed_rad_s / 1e-3)
    q = np.tile(np.array(start), (samples, 1))
    q[:, joint] = np.linspace(start[joint], q_rad, samples)
    rig.play(Reference(q, np.zeros_like(q), np.zeros_like(q), 1e-3))


def test_position__enabled_outside_soft_limit__may_come_back_and_no_further_out():
    rig = Rig("plant.q0_rad=[0.35, 0.0]", "controller.limits.q_max_rad=[0.3, 2.8]")
    rig.enable()
    lead_to(rig, 0, 0.2)
    for _ in range(3000):
        rig.step()
        assert rig.fault is FaultCode.NONE
    assert rig.control.q_rad[0] < 0.25
    lead_to(rig, 0, 0.36)
    assert trip_by(rig, FaultCode.POSITION_SOFT)["limit"] == 0.3


def test_position__enabled_outside_soft_limit__pushed_out__damped_stop():
    rig = Rig("plant.q0_rad=[0.35, 0.0]", "controller.limits.q_max_rad=[0.3, 2.8]")
    rig.enable()
    lead_to(rig, 0, 0.5, speed_rad_s=0.1)
    trip_by(rig, FaultCode.POSITION_SOFT)
    assert rig.control.q_rad[0] < 0.4  # within the hard limit


def test_position__beyond_hard_limit__torque_off_with_joint_value_limit():
    rig = Rig("plant.q0_rad=[0.0, -0.5]", "controller.limits.q_min_rad=[-2.8, -0.3]")
    rig.control.enable()
    fault = trip_by(rig, FaultCode.POSITION_HARD)
    assert fault["joint"] == 2
    assert fault["value"] == pytest.approx(-0.5, abs=2e-3)
    assert fault["limit"] == pytest.approx(-0.4)


def test_position__beyond_soft_limit__damped_stop():
    rig = Rig("plant.q0_rad=[0.25, 0.0]", "controller.limits.q_max_rad=[0.3, 2.8]")
    rig.enable()
    lead_to(rig, 0, 0.39)
    fault = trip_by(rig, FaultCode.POSITION_SOFT)
    assert (fault["joint"], fault["limit"]) == (1, 0.3)


def test_position__soft_and_hard_of_two_joints__the_graver_one_counts():
    rig = Rig(
        "plant.q0_rad=[0.35, 0.9]",
        "controller.limits.q_max_rad=[0.3, 0.3]",
    )
    rig.control.enable()
    assert trip_by(rig, FaultCode.POSITION_HARD)["joint"] == 2


def test_velocity__beyond_trip_speed__torque_off():
    rig = Rig("controller.limits.dq_trip_rad_s=[9.0, 0.8]")
    rig.swing(1)
    fault = trip_by(rig, FaultCode.VELOCITY)
    assert fault["joint"] == 2
    assert abs(fault["value"]) > fault["limit"] == 0.8


def test_following_error__too_large__damped_stop():
    rig = Rig("controller.limits.following_error_rad=[0.8, 0.02]", "controller.law.Ki=[0.0, 0.0]")
    rig.swing(1)
    fault = trip_by(rig, FaultCode.FOLLOWING_ERROR)
    assert fault["joint"] == 2
    assert abs(fault["value"]) > fault["limit"] == 0.02


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_reference__not_finite__torque_off_in_the_same_cycle(bad):
    rig = Rig()
    rig.enable()
    start = np.array(rig.control.player.setpoint.q_rad)
    q = np.tile(start, (50, 1))
    q[20, 1] = bad
    rig.play(Reference(q, np.zeros_like(q), np.zeros_like(q), 1e-3))
    rig.step(20)
    assert rig.state is State.ACTIVE
    rig.step()
    assert rig.fault is FaultCode.NOT_FINITE
    assert rig.state is State.FAULT
    assert np.all(np.isfinite(rig.column("sent")))
    torque_off(rig)


def test_estimator__lock_lost__torque_off():
    rig = Rig(
        "controller.velocity.estimator=levant",
        "controller.velocity.C_rad_s2=[0.5, 0.5]",
        "controller.velocity.lock_tolerance_rad=0.02",
    )
    rig.swing(1)
    assert "lost the encoder" in trip_by(rig, FaultCode.ESTIMATOR_LOST)["detail"]


def test_torque__any_motion__within_limit_and_slew():
    rig = Rig("controller.limits.tau_max_Nm=[1.0, 0.6]", "controller.limits.tau_slew_Nm_s=[90, 40]")
    rig.swing(1)
    rig.step(3000)
    sent = rig.column("sent")
    assert np.all(np.abs(sent) <= [1.0, 0.6])
    assert np.all(np.abs(np.diff(sent, axis=0)) <= np.array([0.09, 0.04]) + 1e-12)
    assert np.abs(sent).max(axis=0).tolist() == [1.0, 0.6]  # both were reached


# --- amplifiers -------------------------------------------------------------------------------


def test_amplifier__fault_injected__latched_with_its_emergency_message():
    rig = Rig()
    rig.swing()
    rig.control.inject_fault(2)
    fault = trip_by(rig, FaultCode.AMPLIFIER_FAULT, 5)
    assert fault["detail"].startswith("joint 2 (cia402 node 2): EMCY 5001")
    assert drive_states(rig)[0] is Cia402State.SWITCH_ON_DISABLED  # the healthy one, too


def test_amplifier__disabled_by_somebody_else__torque_off():
    rig = Rig()
    rig.swing()
    rig.lose_to_drives = lambda can_id, data: can_id == codec.COB_RPDO1 + 1
    rig.inject(codec.COB_RPDO1 + 1, codec.RPDO1.pack(codec.CONTROL_DISABLE_VOLTAGE, 0))
    rig.step(2)
    assert rig.fault is FaultCode.AMPLIFIER_FAULT
    assert any("joint 1" in str(detail) and "by itself" in str(detail) for _, detail in rig.events)
    assert rig.control.tau_sent_Nm == [0.0, 0.0]


def test_amplifier__heartbeat_lost__torque_off_after_three_periods():
    rig = Rig()
    rig.swing(1)
    start = len(rig.history)
    rig.lose_from_drives = lambda can_id, data: can_id == codec.COB_HEARTBEAT + 1
    fault = trip_by(rig, FaultCode.AMPLIFIER_LOST, 500)
    assert "joint 1 (cia402 node 1): no heartbeat" in fault["detail"]
    assert 200 <= len(rig.history) - start <= 305  # three heartbeats of 100 ms, two for the check


def test_amplifier__restarted_by_itself__torque_off():
    rig = Rig()
    rig.swing()
    rig.inject(codec.COB_NMT, codec.pack_nmt(NmtCommand.RESET_NODE, 2))
    fault = trip_by(rig, FaultCode.AMPLIFIER_LOST, 50)
    assert "restarted by itself" in fault["detail"]


def test_enable__amplifier_does_not_follow__fault_names_it_after_the_time_allowed():
    rig = Rig("loop.enable_timeout_s=0.1")
    rig.step(10)
    rig.lose_to_drives = lambda can_id, data: can_id == codec.COB_RPDO1 + 2
    rig.control.enable()
    start = len(rig.history)
    fault = trip_by(rig, FaultCode.ENABLE_TIMEOUT)
    assert len(rig.history) - start - 2 == 100
    assert "joint 2 (cia402 node 2) is not enabled in time" in fault["detail"]


def test_bus__gone__raises_with_the_fault_latched():
    rig = Rig()
    rig.swing()
    rig.loopback.close()
    with pytest.raises(BusError):
        rig.step()
    assert rig.fault is FaultCode.BUS_FAILED


# --- power ------------------------------------------------------------------------------------


@pytest.mark.parametrize("q0", [(0.0, 0.0), (1.1, -0.7), (-2.5, 2.5)])
def test_enable__at_rest_anywhere__starts_at_the_measured_pose_without_a_bump(q0):
    rig = Rig(f"plant.q0_rad=[{q0[0]}, {q0[1]}]")
    rig.step(50)
    rig.enable()
    powered = len(rig.history)
    assert rig.control.player.setpoint.q_rad == rig.control.q_rad
    assert np.abs(rig.control.tau_sent_Nm).max() < 0.01
    rig.step(300)
    assert np.abs(rig.column("q", 300) - q0).max() < 0.01
    assert np.abs(rig.column("sent")[powered:]).max() < 0.3  # a count of noise, no more


def test_enable__without_power_before__drives_walk_through_their_states():
    rig = Rig()
    rig.step(5)
    assert rig.state is State.IDLE
    assert drive_states(rig) == [Cia402State.SWITCH_ON_DISABLED] * 2
    rig.control.enable()
    seen = []
    while rig.state is not State.READY:
        rig.step()
        seen.append(drive_states(rig)[0])
        assert rig.control.tau_sent_Nm == [0.0, 0.0] or rig.state is State.READY
    order = [Cia402State.READY_TO_SWITCH_ON, Cia402State.SWITCHED_ON, Cia402State.OPERATION_ENABLED]
    assert [state for state in dict.fromkeys(seen) if state in order] == order


def test_disable__in_motion__damped_until_rest_then_off():
    rig = Rig()
    rig.swing()
    rig.control.disable()
    start = len(rig.history)
    assert rig.state is State.STOPPING
    rig.run_until(State.IDLE, 2500)
    part = slice(start, len(rig.history) - 1)
    rates, torques = rig.column("dq")[part], rig.column("sent")[part]
    assert torques[5:] == pytest.approx(-DAMPING * rates[5:], abs=1e-9)
    assert np.abs(rig.control.dq_rad_s).max() < AT_REST_RAD_S
    torque_off(rig)


def test_disable__arm_that_does_not_come_to_rest__off_after_the_time_allowed():
    rig = Rig("controller.limits.stop_timeout_s=0.2", "controller.limits.damping_Nms_rad=[0, 0]")
    rig.swing()
    rig.control.disable()
    start = len(rig.history)
    rig.run_until(State.IDLE, 1000)
    assert len(rig.history) - start == 200
    torque_off(rig)


def test_estop__in_motion__torque_zero_in_the_same_cycle_and_latched():
    rig = Rig()
    rig.swing()
    assert all(rig.control.tau_sent_Nm)
    rig.control.estop()
    rig.step()
    assert rig.state is State.ESTOP
    torque_off(rig)
    for command in (rig.control.enable, rig.control.stop):
        with pytest.raises(CommandError, match="ESTOP"):
            command()
    rig.control.estop()  # again: nothing new
    rig.control.reset()
    assert rig.state is State.IDLE
    rig.enable()


@pytest.mark.parametrize("wait", [0, 1, 5, 12, 40])
def test_reset__after_amplifier_fault__enable_works_however_soon_it_comes(wait):
    rig = Rig()
    rig.swing()
    rig.control.inject_fault(1)
    rig.run_until(State.FAULT, 10)
    rig.step(20)
    rig.control.reset()
    assert rig.state is State.IDLE
    rig.step(wait)
    rig.enable()
    rig.step(100)
    assert rig.state is State.READY
    assert rig.fault is FaultCode.NONE
    assert drive_states(rig) == [Cia402State.OPERATION_ENABLED] * 2


def test_reset__fault_that_stays__latches_again():
    rig = Rig("controller.velocity.cutoff_Hz=30.0")
    rig.swing()
    rig.control.inject_fault(2)
    rig.run_until(State.FAULT, 10)
    rig.lose_to_drives = lambda can_id, data: can_id == codec.COB_RPDO1 + 2  # no reset reaches it
    rig.control.reset()
    rig.step(100)
    assert rig.state is State.FAULT
    assert rig.fault is FaultCode.AMPLIFIER_FAULT
    assert rig.bus.axes[1].status is AxisStatus.FAULT


@pytest.mark.parametrize("state", ["IDLE", "READY"])
def test_reset__nothing_to_reset__refused(state):
    rig = Rig()
    rig.step(5)
    if state == "READY":
        rig.enable()
    with pytest.raises(CommandError, match=f"nothing to reset in state {state}"):
        rig.control.reset()


def test_fault__a_second_one__does_not_replace_the_first():
    rig = Rig("controller.limits.following_error_rad=[0.8, 0.02]", "controller.law.Ki=[0.0, 0.0]")
    rig.swing(1)
    while rig.fault is FaultCode.NONE:
        rig.step()
    assert rig.state is State.STOPPING
    rig.control.inject_fault(1)
    rig.run_until(State.FAULT, 10)
    assert rig.fault is FaultCode.FOLLOWING_ERROR


def test_nothing__enables_again_by_itself():
    rig = Rig()
    rig.swing()
    rig.control.estop()
    rig.step(5)
    rig.control.reset()
    rig.step(500)
    assert rig.state is State.IDLE
    assert not rig.column("sent", 500).any()
    assert drive_states(rig) == [Cia402State.SWITCH_ON_DISABLED] * 2


def test_estimator__amplifier_that_reports_no_rate__refused_at_start():
    with pytest.raises(ConfigError, match=r"joint 1 .* reports no velocity"):
        Rig("controller.velocity.estimator=amplifier")


def test_step__damping_with_a_rate_that_is_no_number__torque_off():
    simulation = Simulation(load_config())
    simulation.execute("enable")
    simulation.run_until(State.READY, 100)
    control = simulation.control
    control.disable()
    control._estimator.step = lambda *_: [np.nan, 0.0]
    simulation.run(2)
    assert control.machine.state is State.FAULT
    assert control.machine.fault is FaultCode.NOT_FINITE
    assert control.tau_sent_Nm == [0.0, 0.0]
