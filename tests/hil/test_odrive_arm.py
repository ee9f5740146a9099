"""ODrive axes behind the whole product: `hil sim`, mixed with CiA 402, and the daemon on a bus."""

import json
import os
import signal

import numpy as np
import pytest

from controller.machine import State
from drivers.odrive import codec
from drivers.odrive.codec import AxisState, Command
from hil.config import ConfigError
from hil.simulation import Simulation
from tests.hil.lab import HilProcess, one_line, wait_until, whole
from tests.hil.virtual import Rig, configured

BOTH = ("axes.1.family=odrive", "axes.2.family=odrive")
SECOND = ("axes.2.family=odrive",)
WALL = (  # a slow cycle, a soft law and patient watchdogs: a busy host is late by the clock
    *SECOND,
    "loop.period_s=0.005",
    "loop.feedback_timeout_s=0.0045",
    "controller.limits.n_damp=60",
    "controller.law.Kd_min=[0.5, 0.5]",
    "controller.law.Kd_max=[1.0, 1.0]",
    "controller.law.beta=[0.5, 0.7, 1.0]",
    "axes.1.rpdo_timeout_ms=200",
    "axes.1.heartbeat_ms=500",
    "axes.2.watchdog_ms=200",
    "axes.2.heartbeat_ms=300",
)
NOTHING_LOST = ("send_failures", "late_frames", "unknown_frames", "error_frames")


@pytest.fixture
def hil(tmp_path):
    """Start `hil` commands, each in a directory of its own."""
    started = []

    def start(*arguments, **environment):
        directory = tmp_path / str(len(started))
        directory.mkdir()
        started.append(HilProcess(directory, *arguments, **environment))
        return started[-1]

    yield start
    for process in started:
        process.close()


def assignments(*settings):
    return [word for setting in settings for word in ("--set", setting)]


def test_sim__scenario_a_on_odrive__all_bounds_met(hil):
    run = hil("sim", "--scenario", "A", *assignments(*BOTH))
    assert run.wait(100) == 0, run.stdout + run.stderr
    assert "all bounds PASS" in run.stdout
    kept = whole(run.directory / "runs" / "sim.mcap")
    assert [axis["family"] for axis in kept.config["axes"]] == ["odrive", "odrive"]


def test_sim__same_move_twice__the_same_bytes(hil, tmp_path):
    move = tmp_path / "move.json"
    move.write_text('{"kind": "move", "target_rad": [0.5, -0.4]}')
    runs = [
        hil("sim", "--trajectory", str(move), *assignments(*BOTH), PYTHONHASHSEED=seed)
        for seed in ("0", "4242")
    ]
    assert [run.wait(60) for run in runs] == [0, 0]
    first, second = (run.directory / "runs" / "sim.mcap" for run in runs)
    assert first.read_bytes() == second.read_bytes()


@pytest.mark.parametrize(
    "settings",
    [
        BOTH,
        (*BOTH, "axes.1.feedback=cyclic", "axes.2.feedback=cyclic"),
        (*BOTH, "axes.1.gear_ratio=9", "axes.2.gear_ratio=0.5"),
        (*BOTH, "axes.1.node_id=4", "axes.2.node_id=0"),
        SECOND,
        (*SECOND, "axes.2.feedback=cyclic", "axes.2.gear_ratio=3"),
    ],
    ids=["poll", "cyclic", "geared", "node-4", "mixed", "mixed-cyclic"],
)
def test_virtual__any_way_of_use__follows_as_closely_as_cia402(settings):
    def worst_error_rad(*chosen):
        rig = Rig(*chosen)
        rig.swing(cycles=1500)
        assert rig.fault.name == "NONE"
        return np.abs(rig.column("q", 1000) - rig.column("q_des", 1000)).max(axis=0)

    reference = worst_error_rad()
    assert (worst_error_rad(*settings) < 1.5 * reference + 2e-3).all()


def test_virtual__same_run_twice__the_same_torques():
    def torques():
        rig = Rig(*BOTH)
        rig.swing(cycles=600)
        return rig.column("sent").tobytes(), rig.column("q").tobytes()

    assert torques() == torques()


@pytest.mark.parametrize("feedback", ["poll", "cyclic"])
def test_wired__two_axes_at_1_Mbit_s__feedback_in_time_in_every_cycle(feedback):
    chosen = [f"axes.{joint}.feedback={feedback}" for joint in (1, 2)]
    simulation = Simulation(configured(*BOTH, *chosen, "emulator.wire.is_on=true"))
    simulation.execute("enable")  # in the first cycle: the watchdog has expired by then
    simulation.run_until(State.READY, 300)
    for _ in range(500):
        simulation.step()
        assert simulation.control._age == 0
    assert simulation.control.machine.state is State.READY


def test_virtual__fault_of_the_odrive_axis__arm_off_reset_and_on_again():
    rig = Rig(*SECOND)
    rig.swing()
    rig.command(1, "fault", joint=2)
    rig.run_until(State.FAULT, 60)
    assert rig.fault.name == "AMPLIFIER_FAULT"
    (detail,) = [event[1] for event in rig.events if event[0] == "fault"]
    assert "joint 2 (odrive node 2): DRV_FAULT" in json.dumps(detail)
    rig.step(5)
    assert not any(servo.is_energised for servo in rig.emulator._servos)
    rig.step(60)
    rig.control.reset()
    rig.run_until(State.IDLE)
    rig.step(100)
    rig.enable()


def test_virtual__odrive_silent_under_power__tripped_and_torque_off():
    rig = Rig(*SECOND)
    rig.swing()
    encoder = codec.can_id(2, Command.ENCODER)
    rig.lose_from_drives = lambda can_id, data: can_id == encoder
    rig.run_until(State.FAULT, 100)
    assert rig.fault.name == "FEEDBACK_LOST"
    rig.step(3)
    assert not any(servo.is_energised for servo in rig.emulator._servos)


def test_virtual__commands_to_the_odrive_lost__its_watchdog_ends_it_and_the_arm_trips():
    rig = Rig(*SECOND)
    rig.swing()
    rig.lose_to_drives = lambda can_id, data: can_id >> 5 == 2
    rig.run_until(State.FAULT, 100)
    rig.step(30)
    assert not any(servo.is_energised for servo in rig.emulator._servos)


def test_config__node_4_beside_canopen__refused_in_one_line(hil):
    with pytest.raises(ConfigError, match=r"0x080 is .*SYNC"):
        configured(*SECOND, "axes.2.node_id=4")
    run = hil("sim", *assignments(*SECOND, "axes.2.node_id=4"))
    assert run.wait(30) == 1
    assert "identifier 0x080" in one_line(run)


# --- the daemon -----------------------------------------------------------------------------------


def require_whole_run(arm, least_rad):
    wait_until(lambda: arm.statuses, what="status")
    assert arm.daemon.end() == 0
    assert arm.daemon.stderr == ""
    status = arm.statuses[-1]
    assert [status[name] for name in NOTHING_LOST] == [0] * len(NOTHING_LOST)
    samples = whole(arm.recording).samples
    assert not samples["fault"].any()
    moved = samples["q_meas_rad"].max(axis=0) - samples["q_meas_rad"].min(axis=0)
    assert (moved > least_rad).all()


@pytest.mark.parametrize("families", [SECOND, BOTH], ids=["mixed", "odrive"])
def test_run__lockstep_over_the_unix_bus__enables_moves_and_loses_nothing(lab, families):
    lab.emulate(*families)
    watcher = lab.watch_bus()
    arm = lab.run(*families)
    arm.make_ready()
    arm.swing(duration_s=2.0)
    arm.wait_for(State.HOLD)
    arm.client.command("disable")
    arm.wait_for(State.IDLE)
    require_whole_run(arm, 0.3)
    requests = [
        codec.parse_u32(frame.data)
        for frame in watcher.with_id(codec.can_id(2, Command.AXIS_STATE))
    ]
    assert AxisState.CLOSED_LOOP_CONTROL in requests
    assert requests[-1] == AxisState.IDLE


def test_run__cyclic_by_the_clock__enables_moves_and_stops(lab):
    """Without lockstep the encoder's frames come at any instant of the cycle."""
    settings = (*WALL, "axes.2.feedback=cyclic")
    lab.emulate(*settings, time="wall")
    arm = lab.run(*settings)
    arm.make_ready()
    arm.swing(duration_s=1.5)
    arm.wait_for(State.HOLD)
    arm.client.command("disable")
    arm.wait_for(State.IDLE)
    assert arm.daemon.end() == 0
    samples = whole(arm.recording).samples
    moved = samples["q_meas_rad"].max(axis=0) - samples["q_meas_rad"].min(axis=0)
    assert (moved > 0.2).all()


def test_run__loop_killed_under_power__watchdog_off_and_the_next_daemon_enables(lab):
    lab.emulate(*SECOND)
    watcher = lab.watch_bus()
    arm = lab.run(*SECOND)
    arm.make_ready()
    os.kill(arm.daemon.children()["loop"], signal.SIGKILL)
    heartbeat_id = codec.can_id(2, Command.HEARTBEAT)

    def last_beat():
        return codec.parse_heartbeat(watcher.with_id(heartbeat_id)[-1].data)

    wait_until(lambda: last_beat().state == AxisState.IDLE, what="torque off")
    assert codec.describe_errors(last_beat().errors) == "WATCHDOG_TIMER_EXPIRED"
    arm.daemon.end()
    arm.client.close()
    again = lab.run(*SECOND)
    again.wait_cycles(100)
    if again.state is State.FAULT:  # what the CiA 402 drive still tells of
        again.client.command("reset")
    again.make_ready()
    wait_until(lambda: last_beat().state == AxisState.CLOSED_LOOP_CONTROL)
    assert last_beat().errors == 0
