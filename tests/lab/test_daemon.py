"""The daemon on a real kernel's CAN: the demonstration, lost interfaces, foreign tools, rivals."""

import re
import subprocess

import numpy as np
import pytest

from controller.faults import FaultCode
from controller.machine import State
from drivers.cia402.codec import Cia402State
from tests.hil.lab import HilProcess, one_line, wait_until, whole
from tests.lab.conftest import FAIR, ip

pytestmark = pytest.mark.timeout(240)
NODES = (1, 2)
TAU_MAX_Nm = (15.0, 8.0)


@pytest.fixture
def moving(can_lab):
    """A daemon whose arm swings, on a bus that is listened to."""
    can_lab.emulate()
    arm, watcher = can_lab.run(), can_lab.watch_bus()
    arm.client.command("enable")
    arm.swing()
    return arm, watcher


def is_told(arm, code):
    return [event for event in arm.events if event.get("code") == code.name]


# --- the demonstration


def test_demo__on_vcan__every_bound_met_and_nothing_lost(can_lab):
    options = ["--bus", can_lab.interface, "--set", FAIR, "--out", "out"]
    demo = HilProcess(can_lab.directory, "demo", *options)
    assert demo.wait(200) == 0, demo.stdout + demo.stderr
    text = demo.stdout
    assert re.search(r"all bounds PASS", text), text
    assert re.search(r" 0 not sent, 0 late", text), text
    assert re.search(r"another process, 0 lost", text), text
    assert f"on {can_lab.interface}, lockstep" in text
    samples = whole(can_lab.directory / "out" / "demo.mcap").samples
    assert 20.0 <= samples["t_ref_s"][samples["state"] == State.ACTIVE][-1] < 20.5
    assert not samples["fault"].any()


# --- the interface


def test_interface__down_and_up_in_motion__trips_with_one_line_and_comes_back(moving, can_lab):
    arm, watcher = moving
    ip("link", "set", can_lab.interface, "down")
    arm.wait_for(State.FAULT)
    assert arm.now["fault"] == FaultCode.BUS_FAILED
    (event,) = wait_until(lambda: is_told(arm, FaultCode.BUS_FAILED), what="the event")
    name = can_lab.interface
    assert event["detail"] == (
        f"no bus socketcan:{name}: the interface is down; `ip link set {name} up`"
    )
    arm.wait_cycles(200)  # the drives' watchdogs act meanwhile
    assert arm.daemon.process.poll() is None
    watcher.close()

    ip("link", "set", name, "up")
    again = can_lab.watch_bus()
    for node in NODES:
        assert again.state(node) is Cia402State.FAULT
        assert again.torque(node) == 0
    arm.catch_up()
    assert arm.state is State.FAULT  # nothing comes back by itself
    assert len(is_told(arm, FaultCode.BUS_FAILED)) == 1

    arm.make_ready()
    for node in NODES:
        assert again.state(node) is Cia402State.OPERATION_ENABLED
    assert arm.daemon.end() == 0
    assert arm.daemon.stderr == ""
    samples = whole(arm.recording).samples
    down = samples[samples["fault"] == FaultCode.BUS_FAILED]
    assert not down["tau_sent_Nm"].any()


def test_interface__deleted_in_motion__daemon_ends_with_one_line(moving, can_lab):
    arm, _ = moving
    ip("link", "delete", can_lab.interface)
    assert arm.daemon.wait() == 1
    assert f"no bus socketcan:{can_lab.interface}: " in one_line(arm.daemon)


# --- others on the bus


def test_second_daemon__same_bus__refuses_and_leaves_the_first_alone(moving, can_lab):
    arm, _ = moving
    options, _ = can_lab.run_options()
    options[options.index(f"arm.name={can_lab.arm}")] = "arm.name=rival"
    endpoint = next(i for i, word in enumerate(options) if word.startswith("zenoh.listen"))
    options[endpoint] = "zenoh.listen=[]"
    rival = can_lab.start(*options)
    assert rival.wait() == 1
    assert "another master sends SYNC on this bus; stop the other daemon first" in one_line(rival)
    arm.catch_up()
    assert arm.state is State.ACTIVE
    assert not arm.now["fault"]


def test_candump__daemon_runs__sees_sync_commands_feedback_and_heartbeats(moving, can_lab):
    dump = can_lab.tool("candump", "-L", can_lab.interface)
    for words in ("080#", "201#", "202#", "181#", "182#", "701#05", "702#05", "77F#05"):
        dump.wait_for(words)
    line = re.search(r"^\(\d+\.\d+\) \w+ 181#([0-9A-F]+)$", dump.text, re.M)
    assert len(line[1]) == 16


def test_cansend__sdo_request__is_answered_beside_the_daemon(moving, can_lab):
    arm, _ = moving
    dump = can_lab.tool("candump", "-L", f"{can_lab.interface},581:7FF")
    sent = ["cansend", can_lab.interface, "601#4018100200000000"]  # read 1018:02, product code

    def is_answered():
        subprocess.run(sent, check=True)
        return "581#43181002314C4948" in dump.text  # "HIL1"

    wait_until(is_answered, what="the SDO answer")
    assert arm.state_now() is State.ACTIVE


def test_cansend__nmt_reset_of_a_drive__arm_trips_and_says_which(moving, can_lab):
    arm, watcher = moving
    subprocess.run(["cansend", can_lab.interface, "000#8101"], check=True)
    arm.wait_for(State.FAULT)
    (event,) = wait_until(lambda: is_told(arm, FaultCode.AMPLIFIER_LOST), what="the event")
    assert "joint 1 (cia402 node 1): restarted by itself" in event["detail"]
    wait_until(lambda: watcher.state(2) is Cia402State.SWITCH_ON_DISABLED, what="torque off")
    assert watcher.torque(1) == watcher.torque(2) == 0


def test_cangen__flood_of_foreign_frames__kernel_keeps_them_from_the_loop(moving, can_lab):
    arm, _ = moving
    flood = ["cangen", can_lab.interface, "-g", "0", "-I", "555", "-L", "8", "-n", "20000", "-i"]
    subprocess.run(flood, check=True, timeout=60)
    arm.catch_up()
    last = len(arm.statuses)
    wait_until(lambda: len(arm.statuses) > last + 1, what="the status of this instant")
    assert arm.statuses[-1]["unknown_frames"] == 0
    assert arm.statuses[-1]["frames_received"] > 0
    arm.make_ready()
    arm.swing()
    assert arm.daemon.end() == 0


FORGED = {  # any identifier, length and data: NMT, commands and feedback among them
    "standard": ("-I", "r", "-L", "r", "-D", "r"),
    "of_every_kind": ("-m",),
}


@pytest.mark.parametrize("kind", FORGED)
def test_cangen__flood_of_random_frames__no_exception_and_torque_in_bounds(moving, can_lab, kind):
    arm, _ = moving
    seq = arm.seq
    flood = ["cangen", can_lab.interface, "-g", "0", "-n", "20000", "-i", *FORGED[kind]]
    subprocess.run(flood, check=True, timeout=60)
    arm.wait_cycles(100)
    assert arm.daemon.process.poll() is None
    rows = arm.since(seq)
    assert np.all(np.abs(rows["tau_sent_Nm"]) <= TAU_MAX_Nm)
    for state in (State.FAULT, State.IDLE):
        assert not rows["tau_sent_Nm"][rows["state"] == state].any()
    assert arm.daemon.end() == 0
    assert arm.daemon.stderr == ""
    arm.client.close()

    again = can_lab.run()  # whatever the frames have done to the drives, a new start mends
    again.make_ready()
    again.swing()
    assert again.daemon.end() == 0
