"""Daemons with several buses, and several daemons on one host, as processes."""

import json
import os
import signal
import threading
from collections import Counter
from contextlib import closing

import numpy as np
import pytest

from controller.machine import State
from drivers.arm_bus import RECEIVED, SENT, SYNC_ID
from drivers.arm_group import split_bus
from drivers.cia402 import codec
from hil.config import config_from_json, load_config, merge, parse_assignment
from hil.emulation import open_emulation
from hil.replay import Replayer
from sim_backend.server import EmulatorServer
from tests.hil.lab import Lab, one_line, wait_until, whole

PLACES = {3: 2, 4: 2, 5: 2, 6: 3, 7: 3}
SEVEN = ("arm.preset=chain_h:7", *(f"axes.{j}.bus={bus}" for j, bus in PLACES.items()))
TARGET = [0.5, 0.0, 0.5, 0.0, 0.5, 0.0, 0.5]


def buses(lab, *names):
    return "bus.more=[" + ", ".join(f'"unix:{lab.directory}/{name}"' for name in names) + "]"


def move(arm, target_rad):
    arm.client.command("trajectory", kind="move", target_rad=target_rad)
    arm.wait_for(State.ACTIVE)


def is_at(arm, target_rad):
    """The motion is over, and the arm, which follows softly, has come to rest at its end."""
    error_rad = np.abs(arm.now["q_meas_rad"] - target_rad).max()
    return error_rad < 0.05 and np.abs(arm.now["dq_meas_rad_s"]).max() < 0.5


def require_replay(recording):
    """Every frame and sample once more, from the recording alone."""
    result = Replayer(recording, config_from_json(json.dumps(recording.config))).run()
    assert result.difference is None, result.difference.text()
    assert result.frames_equal == result.frames_sent


@pytest.mark.parametrize("time", ["lockstep", "wall"])
def test_daemon__seven_joints_on_three_buses__moves_records_and_replays(lab, time):
    settings = (*SEVEN, buses(lab, "b2", "b3"))
    emulator = lab.emulate(*settings, time=time)
    assert f"unix:{lab.directory}/b3, {time}" in emulator.stdout
    patience = ("controller.limits.n_hold=200",) if time == "wall" else ()  # a shared machine
    arm = lab.run(*settings, *patience)
    arm.make_ready()
    move(arm, TARGET)
    arm.wait_for(State.HOLD)
    wait_until(lambda: is_at(arm, TARGET), what="the pose")
    status = wait_until(lambda: arm.statuses and arm.statuses[-1], what="status")
    counts = status["buses"]
    assert len(counts) == 3
    for key in ("frames_sent", "frames_received"):
        assert sum(bus[key] for bus in counts) == status[key]
        assert all(bus[key] > 100 for bus in counts)
    arm.client.command("disable")
    arm.wait_for(State.IDLE)
    assert arm.daemon.end() == 0
    recording = whole(arm.recording)
    seen = Counter(split_bus(frame.direction) for frame in recording.frames())
    assert set(seen) == {(bus, way) for bus in (1, 2, 3) for way in (RECEIVED, SENT)}
    require_replay(recording)


def test_daemon__one_joint_s_fault_on_the_second_bus__torque_off_on_all(lab):
    settings = (*SEVEN, buses(lab, "b2", "b3"))
    lab.emulate(*settings)
    arm = lab.run(*settings)
    arm.make_ready()
    arm.client.command("fault", target="amplifier", kind="off", joint=4)
    arm.wait_for(State.FAULT)
    told = [event for event in arm.events if event["kind"] == "fault"]
    assert told[-1]["code"] == "AMPLIFIER_FAULT"
    assert "joint 4" in told[-1]["detail"]
    watcher = lab.watch_bus()  # joints 1 and 2
    wait_until(lambda: watcher.state(1).name == "SWITCH_ON_DISABLED", what="torque off on bus 1")


def test_daemon__second_bus_does_not_exist__says_which(lab):
    lab.emulate()
    settings = ("axes.2.bus=2", buses(lab, "b2"))
    daemon = lab.start(*lab.run_options(*settings)[0])
    assert daemon.wait() == 1
    assert f"no bus at unix:{lab.directory}/b2" in one_line(daemon)


def test_two_arms__one_trips_and_one_is_killed__neither_disturbs_the_other(tmp_path):
    labs = []
    try:
        for name in ("left", "right"):
            place = tmp_path / name
            place.mkdir()
            labs.append(Lab(place))
            labs[-1].arm = name
        cores = [n for n, _ in zip(sorted(os.sched_getaffinity(0)), labs, strict=False)]
        chosen = [cores[0], cores[-1]]
        arms = []
        for lab, cpu in zip(labs, chosen, strict=True):
            # Two loops and two emulators at real-time priority would leave a small host no time.
            settings = ("axes.2.bus=2", buses(lab, "b2"), "loop.realtime=off")
            lab.emulate(*settings)
            arms.append(lab.run(*settings, f"loop.cpu={cpu}"))
        left, right = arms
        for arm, cpu in zip(arms, chosen, strict=True):
            arm.make_ready()
            assert os.sched_getaffinity(arm.daemon.children()["loop"]) == {cpu}
        move(left, [1.2, -0.8])
        first = left.seq
        right.client.command("estop")
        right.wait_for(State.ESTOP)
        left.wait_cycles(100)
        os.kill(right.daemon.children()["loop"], signal.SIGKILL)
        assert right.daemon.wait() == 1
        left.wait_for(State.HOLD)
        rows = left.since(first)
        assert np.all(np.diff(rows["seq"].astype(int)) == 1)
        assert set(rows["state"].tolist()) == {State.ACTIVE, State.HOLD}
        assert not rows["fault"].any()
        wait_until(lambda: is_at(left, [1.2, -0.8]), what="the pose")
        assert left.daemon.end() == 0
        require_replay(whole(left.recording))
    finally:
        for lab in labs:
            lab.close()


class SplitEmulator:
    """An emulator on two buses in a thread of the test, whose second bus can go away alone."""

    def __init__(self, config):
        self._wire, emulator = open_emulation(config, config.emulator)
        self._server = EmulatorServer(emulator, self._wire, config.emulator)
        emulator.power_on()
        self._is_ended = threading.Event()
        self._is_closing = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self):
        first, second = self._wire.wires
        while not self._is_ended.is_set():
            if self._is_closing.is_set() and len(self._wire.wires) == 2:
                second.close()
                self._wire.wires = (first,)
                self._wire._busy.clear()
            self._server.serve(1e-3)

    def close_second_bus(self):
        self._is_closing.set()

    def close(self):
        self._is_ended.set()
        self._thread.join()
        self._wire.close()


def test_daemon__one_of_two_buses_goes_away__amplifiers_on_the_other_are_told(lab):
    settings = ("axes.2.bus=2", buses(lab, "b2"))
    over = {"bus": {"address": lab.bus}}
    for assignment in settings:
        over = merge(over, parse_assignment(assignment))
    with closing(SplitEmulator(load_config(None, over))) as emulated:
        arm = lab.run(*settings)
        arm.make_ready()
        watcher = lab.watch_bus()
        wait_until(lambda: controlwords(watcher), what="commands to joint 1")
        assert controlwords(watcher)[-1] == codec.CONTROL_ENABLE_OPERATION
        emulated.close_second_bus()
        assert arm.daemon.wait() == 1
        assert f"the bus at unix:{lab.directory}/b2 is gone" in arm.daemon.stderr

        def is_told():
            """The last command takes power away, and a SYNC after it lets it take effect."""
            ids = [frame.can_id for frame in list(watcher.frames)]
            is_off = controlwords(watcher)[-1] == codec.CONTROL_DISABLE_VOLTAGE
            return is_off and SYNC_ID in ids[len(ids) - ids[::-1].index(codec.COB_RPDO1 + 1) :]

        wait_until(is_told, what="torque off on bus 1")


def controlwords(watcher):
    """Controlwords that joint 1 was sent."""
    frames = watcher.with_id(codec.COB_RPDO1 + 1)
    return [int.from_bytes(frame.data[:2], "little") for frame in frames]
