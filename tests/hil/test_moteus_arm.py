"""moteus axes behind the whole product: CAN FD frames from `hil sim` to the recording."""

import json
import os

import numpy as np
import pytest

from controller.machine import State
from drivers.frame import EFF_FLAG, FD_FRAME_SIZE, FRAME_SIZE, LOCKSTEP_ID, is_fd, unpack_frame
from drivers.moteus import codec
from drivers.moteus.registers import Mode, Register
from hil.config import ConfigError
from hil.recording import Recording
from hil.shared import FRAMES_AT_ONCE, SharedMemory
from tests.hil.lab import HilProcess, wait_until, whole
from tests.hil.virtual import Rig, configured

BOTH = ("axes.1.family=moteus", "axes.2.family=moteus")
SECOND = ("axes.2.family=moteus",)
REQUEST_2, REPLY_2 = codec.request_id(2), codec.reply_id(2)
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


def frames_by_id(recording):
    found = {}
    for logged in recording.frames():
        found.setdefault(unpack_frame(logged.frame)[0], []).append(logged.frame)
    return found


def test_sim__scenario_a_on_moteus__all_bounds_met_and_the_same_bytes_twice(hil):
    runs = [
        hil("sim", "--scenario", "A", *assignments(*BOTH), PYTHONHASHSEED=seed)
        for seed in ("0", "4242")
    ]
    for run in runs:
        assert run.wait(100) == 0, run.stdout + run.stderr
        assert "FAIL" not in run.stdout
    first, second = (run.directory / "runs" / "sim.mcap" for run in runs)
    assert first.read_bytes() == second.read_bytes()
    frames = frames_by_id(Recording.open(first))
    assert {len(frame) for frame in frames.pop(LOCKSTEP_ID)} == {FRAME_SIZE}
    assert set(frames) == {
        codec.request_id(1), codec.reply_id(1), REQUEST_2, REPLY_2,
    }  # fmt: skip
    assert {len(frame) for each in frames.values() for frame in each} == {FD_FRAME_SIZE}
    lengths = {frame[4] for frame in frames[REQUEST_2]}
    assert codec.TORQUE_LENGTH in lengths, "recorded whole"


@pytest.mark.parametrize(
    "settings",
    [
        BOTH,
        SECOND,
        (*BOTH, "axes.1.node_id=9", "axes.2.node_id=126"),
        (*SECOND, "axes.2.can_prefix=5", "axes.2.node_id=1"),
        (*BOTH, "axes.1.source_id=3"),
    ],
    ids=["both", "mixed", "wide-ids", "mixed-prefix", "other-source"],
)
def test_virtual__any_way_of_use__follows_as_closely_as_cia402(settings):
    def worst_error_rad(*chosen):
        rig = Rig(*chosen)
        rig.swing(cycles=1500)
        assert rig.fault.name == "NONE"
        return np.abs(rig.column("q", 1000) - rig.column("q_des", 1000)).max(axis=0)

    reference = worst_error_rad()
    assert (worst_error_rad(*settings) < 1.5 * reference + 2e-3).all()


def test_virtual__fault_of_the_moteus_axis__arm_off_reset_and_on_again():
    rig = Rig(*SECOND)
    rig.enable()
    rig.step(50)
    rig.emulator._nodes[1].controller.fail(34)
    rig.run_until(State.FAULT, 60)
    assert rig.fault.name == "AMPLIFIER_FAULT"
    rig.step(5)
    assert not any(servo.is_energised for servo in rig.emulator._servos)
    assert "joint 2 (moteus id 2): fault" in json.dumps(rig.events)
    rig.step(50)
    rig.control.reset()
    rig.run_until(State.IDLE)
    rig.step(100)
    rig.enable()


def test_virtual__moteus_silent_under_power__tripped_and_torque_off():
    rig = Rig(*SECOND)
    rig.swing()
    rig.lose_from_drives = lambda can_id, data: can_id == REPLY_2
    rig.run_until(State.FAULT, 100)
    rig.step(3)
    assert not any(servo.is_energised for servo in rig.emulator._servos)


def test_virtual__requests_to_moteus_lost__its_watchdog_ends_it_and_the_arm_trips():
    rig = Rig(*SECOND)
    rig.swing()
    rig.lose_to_drives = lambda can_id, data: can_id == REQUEST_2
    rig.run_until(State.FAULT, 100)
    rig.step(30)
    assert rig.emulator._nodes[1].controller.mode == Mode.TIMEOUT
    assert not any(servo.is_energised for servo in rig.emulator._servos)


@pytest.mark.parametrize(
    ("settings", "clash"),
    [
        ((*SECOND, "axes.2.node_id=1"), "identifier 0x.01 is .*command to moteus id 1"),
        ((*BOTH, "axes.1.source_id=2"), "identifier 0x102 is .*moteus id 2"),
    ],
)
def test_config__a_frame_that_a_moteus_would_take_for_its_own__refused(settings, clash):
    with pytest.raises(ConfigError, match=clash) as caught:
        configured(*settings)
    assert "\n" not in str(caught.value)


# --- records ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("settings", "size"), [(BOTH, "fd_size"), ((), "size")])
def test_shared_memory__axes_with_can_fd__room_for_as_many_frames_of_theirs(settings, size):
    shared = SharedMemory.create(configured(*settings))
    entry = getattr(shared.frame_layout, size)
    assert shared.frames.payload_size == entry * FRAMES_AT_ONCE
    os.close(shared.fd)


# --- the daemon -----------------------------------------------------------------------------------


@pytest.mark.parametrize("families", [SECOND, BOTH], ids=["mixed", "moteus"])
def test_run__lockstep_over_the_unix_bus__enables_moves_and_loses_nothing(lab, families):
    lab.emulate(*families)
    arm = lab.run(*families)
    arm.make_ready()
    arm.swing(duration_s=2.0)
    arm.wait_for(State.HOLD)
    arm.client.command("disable")
    arm.wait_for(State.IDLE)
    wait_until(lambda: arm.statuses, what="status")
    assert arm.daemon.end() == 0
    assert arm.daemon.stderr == ""
    status = arm.statuses[-1]
    assert [status[name] for name in NOTHING_LOST] == [0] * len(NOTHING_LOST)
    recording = whole(arm.recording)
    samples = recording.samples
    assert not samples["fault"].any()
    followed = samples[samples["state"] == State.ACTIVE]
    assert np.abs(followed["q_meas_rad"] - followed["q_des_rad"]).max() < 0.3, (
        "0.284 with CiA 402 drives"
    )
    assert (np.ptp(samples["q_meas_rad"], axis=0) > 0.3).all()
    frames = frames_by_id(recording)
    assert all(is_fd(frame) for frame in frames[REQUEST_2] + frames[REPLY_2])
    assert len(frames[REPLY_2]) >= len(samples)
    last = codec.parse_replies(unpack_frame(frames[REPLY_2][-1])[1])
    assert last[Register.MODE] == Mode.STOPPED


def test_run__foreign_fd_frames_on_a_classic_arm__recorded_whole_and_counted(lab):
    """More of them in a cycle than one record of the log was made for."""
    import can

    lab.emulate()
    arm = lab.run()
    bus = can.Bus(interface="hil-unix", channel=str(lab.bus_path), fd=True)
    payload = bytes(range(64))
    for _ in range(200):
        bus.send(can.Message(arbitration_id=0x1234, is_fd=True, data=payload))
    bus.shutdown()
    arm.wait_cycles(200)
    assert arm.daemon.end() == 0
    foreign = frames_by_id(whole(arm.recording))[0x1234 | EFF_FLAG]
    assert [unpack_frame(frame)[1] for frame in foreign] == [payload] * 200
