"""Processes of a running daemon are killed in mid-motion: torque goes off, or nothing is missed."""

import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from controller.machine import State
from drivers.cia402.codec import COB_RPDO1, COB_SYNC, COB_TPDO1, TPDO1, Cia402State, EmcyCode
from drivers.cia402.codec import decode_state as decode
from hil.client import RefusedError
from hil.recording import Recording
from tests.hil.lab import is_running, largest_jump, one_line, wait_until, whole

WALL = (
    # By the clock, lateness has consequences, and a busy host is late: a slow cycle with a law
    # that is soft enough for it, and watchdogs that a stall of a tenth of a second does not trip.
    "loop.period_s=0.005",
    "loop.feedback_timeout_s=0.0045",
    "controller.limits.n_damp=60",
    "controller.law.Kd_min=[0.5, 0.5]",
    "controller.law.Kd_max=[1.0, 1.0]",
    "controller.law.beta=[0.5, 0.7, 1.0]",
    *(f"axes.{j}.{key}" for j in (1, 2) for key in ("rpdo_timeout_ms=200", "heartbeat_ms=500")),
)
STALL_S = 0.5  # emulator.stall_timeout_s
SPAN = 1500
"""Samples after a kill in which its traces are looked for: the restart takes about a second."""


def kill(arm, name):
    os.kill(arm.daemon.children()[name], signal.SIGKILL)


def torques_before(frames):
    """Torque actual values of the last tenth of a second of cyclic operation."""
    return [TPDO1.unpack(frame.data)[2] for frame in frames[-50:]]


@pytest.mark.parametrize("time_base", ["lockstep", "wall"])
def test_loop__killed_in_motion__drives_remove_torque_and_nothing_comes_back(lab, time_base):
    settings = WALL if time_base == "wall" else ()
    lab.emulate(*settings, time=time_base)
    arm, watcher = lab.run(*settings), lab.watch_bus()
    arm.client.command("enable")
    arm.swing()
    assert watcher.state(1) is watcher.state(2) is Cia402State.OPERATION_ENABLED

    kill(arm, "loop")
    assert arm.daemon.wait() == 1
    assert "control loop was killed (SIGKILL)" in one_line(arm.daemon)

    def is_off(node):  # asked all the time: also a bus that is not silent shows the loss
        is_reported = EmcyCode.RPDO_TIMEOUT in watcher.emergencies(node)
        return watcher.torque(node) == 0 and is_reported

    wait_until(lambda: is_off(1) and is_off(2), what="torque 0 and EMCY 8250 of both drives")
    for node in (1, 2):
        assert any(torques_before(watcher.with_id(COB_TPDO1 + node)))  # it was driving
        last_s = watcher.with_id(COB_RPDO1 + node)[-1].t_s
        emergency = next(f for f in watcher.with_id(0x80 + node) if f.data[:2] == b"\x50\x82")
        waited_s = emergency.t_s - last_s
        # The drive's own watchdog, on the host's clock: give or take a stall of the host.
        low_s, high_s = (0.19, 0.2) if time_base == "wall" else (0.02, STALL_S + 0.02)
        assert low_s <= waited_s <= high_s + 0.3
        assert watcher.state(node) is Cia402State.FAULT
        assert watcher.torque(node) == 0

    syncs = len(watcher.with_id(COB_SYNC))
    time.sleep(0.3)  # nothing enables again by itself: nobody even sends
    assert len(watcher.with_id(COB_SYNC)) == syncs
    assert Recording.open(arm.recording).samples["state"][-1] == State.ACTIVE
    arm.client.close()

    again = lab.run(*settings)
    ready = again.daemon.stdout
    assert "FAULT (AMPLIFIER_FAULT)" in ready
    assert "reset" in ready
    assert again.state_now() is State.FAULT
    with pytest.raises(RefusedError, match="FAULT; reset first"):
        again.client.command("enable")
    again.client.command("reset")
    again.client.command("enable")
    assert watcher.state(1) is watcher.state(2) is Cia402State.OPERATION_ENABLED
    assert again.daemon.end() == 0
    assert watcher.state(1) is Cia402State.SWITCH_ON_DISABLED


def skips_within(samples, first, last):
    """Periods skipped between two sample numbers."""
    part = samples[(samples["seq"] >= first) & (samples["seq"] < last)]
    return int(part["cycle"][-1] - part["cycle"][0]) - (len(part) - 1)


def test_gateway_and_recorder__killed_in_motion__loop_and_records_go_on_without_a_gap(lab):
    lab.emulate()
    arm = lab.run()
    other = lab.connect()
    seen = []
    other.on_telemetry(seen.append)
    arm.client.command("enable")
    arm.swing()
    before = arm.daemon.children()

    kills = []
    for name in ("gateway", "recorder"):
        kills.append(arm.seq)
        kill(arm, name)
        wait_until(lambda n=name: arm.daemon.children().get(n, before[n]) != before[n], what=name)
        wait_until(lambda: arm.seq > kills[-1] + SPAN, what="telemetry after the kill")
    assert arm.daemon.children()["loop"] == before["loop"]
    for batches in (arm.rows(), np.concatenate(seen)):  # each sample once, across both gateways
        assert np.all(np.diff(batches["seq"].astype(int)) == 1)

    arm.client.command("stop")  # commands work again, and continue where the motion is
    arm.wait_for(State.HOLD)
    assert arm.statuses[-1]["telemetry_lost"] == 0
    assert arm.daemon.end() == 0

    first = Recording.open(arm.recording)
    second = whole_from(arm.recording.with_stem(arm.recording.stem + "-2"))
    assert first.is_truncated
    assert first.samples["seq"][0] == 0
    assert second.samples["seq"][0] <= first.samples["seq"][-1] + 1  # no gap between the files
    new = second.samples["seq"] > first.samples["seq"][-1]
    samples = np.concatenate([first.samples, second.samples[new]])
    assert np.array_equal(samples["seq"], np.arange(len(samples)))
    # The loop skips periods when the host is busy; not more of them while the others restart.
    near = [skips_within(samples, k, k + SPAN) for k in kills]
    others = skips_within(samples, 0, len(samples)) - sum(near)
    rate = others / (len(samples) - SPAN * len(kills))
    assert max(near) <= SPAN * (2 * rate + 0.25)
    powered = samples[np.isin(samples["state"], (State.READY, State.ACTIVE, State.HOLD))]
    assert largest_jump(powered) <= 1.0


def whole_from(path):
    recording = Recording.open(path)
    assert not recording.is_truncated
    assert np.all(np.diff(recording.samples["seq"].astype(int)) == 1)
    return recording


def test_supervisor__killed_in_motion__loop_stops_by_itself_and_no_process_is_left(lab):
    lab.emulate()
    arm, watcher = lab.run(), lab.watch_bus()
    arm.client.command("enable")
    arm.swing()
    children = arm.daemon.children()
    assert set(children) == {"loop", "gateway", "recorder"}

    os.kill(arm.daemon.pid, signal.SIGKILL)
    arm.daemon.process.wait()
    wait_until(lambda: not any(map(is_running, children.values())), what="the end of all children")
    for node in (1, 2):
        assert watcher.state(node) is Cia402State.SWITCH_ON_DISABLED
        assert watcher.torque(node) == 0
    samples = whole(arm.recording).samples  # it saw the loop to its end
    assert State.STOPPING in samples["state"]
    assert not samples["tau_sent_Nm"][-1].any()
    assert samples["state"][-1] not in {State.ACTIVE, State.STOPPING}


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=lambda n: n.name)
def test_daemon__signal_in_motion__damped_stop_and_complete_recording(lab, number):
    lab.emulate()
    arm, watcher = lab.run(), lab.watch_bus()
    arm.client.command("enable")
    arm.swing()
    assert arm.daemon.end(number) == 0
    assert arm.daemon.stderr == ""

    recording = whole(arm.recording)
    samples = recording.samples
    stop = samples[samples["state"] == State.STOPPING]
    assert len(stop) > 5
    power = stop["tau_sent_Nm"] * stop["dq_meas_rad_s"]
    assert np.all(power[5:].sum(axis=1) <= 1e-6)  # damped: torque takes energy out
    assert samples["state"][-1] == State.IDLE
    assert np.abs(samples["dq_meas_rad_s"][-1]).max() < 1.0
    assert not samples["tau_sent_Nm"][-1].any()
    assert [e.detail["to"] for e in recording.events if e.kind == "state"][-2:] == [
        "STOPPING",
        "IDLE",
    ]
    for node in (1, 2):
        status, _, _ = TPDO1.unpack(watcher.with_id(COB_TPDO1 + node)[-1].data)
        assert decode(status) is Cia402State.SWITCH_ON_DISABLED
        assert watcher.state(node) is Cia402State.SWITCH_ON_DISABLED


def test_emulator__killed_in_motion__daemon_says_the_bus_is_gone(lab):
    emulator = lab.emulate()
    arm = lab.run()
    arm.client.command("enable")
    arm.swing()
    os.kill(emulator.pid, signal.SIGKILL)
    assert arm.daemon.wait() == 1
    assert "is gone" in one_line(arm.daemon)
    assert not whole(arm.recording).samples["fault"][0]
    assert Path(arm.recording).stat().st_size > 0


def test_gateway__silent_for_seconds__policy_hold_slows_down_and_holds(lab):
    lab.emulate()
    arm = lab.run('loop.on_gateway_loss="hold"')
    arm.client.command("enable")
    arm.swing()
    gateway = arm.daemon.children()["gateway"]
    os.kill(gateway, signal.SIGSTOP)
    time.sleep(3.0)  # the loop gives it up after 2 s
    os.kill(gateway, signal.SIGCONT)
    arm.wait_for(State.HOLD)
    wait_until(lambda: "GATEWAY_LOST" in str(arm.events), what="the event")
    assert arm.now["fault"] == 0
    arm.client.command("trajectory", kind="move", target_rad=[0.1, 0.1])
    arm.wait_for(State.ACTIVE)
