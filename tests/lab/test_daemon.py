"""The daemon on a real kernel's CAN: the demonstration, lost interfaces, foreign tools, rivals.

The order matters for speed alone: each test takes the daemon that the one before it left.
"""

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


def is_told(arm, code):
    return [event for event in arm.events if event.get("code") == code.name]


def test_demo__on_vcan__every_bound_met_and_nothing_lost(can_lab):
    options = ["--bus", can_lab.interface, "--set", FAIR, "--out", "out"]
    demo = HilProcess(can_lab.directory, "demo", *options)
    assert demo.wait(200) == 0, demo.stdout + demo.stderr
    text = demo.stdout
    assert "all bounds PASS" in text
    assert " 0 not sent, 0 late" in text
    assert re.search(r"another process, 0 lost", text)
    assert f"on {can_lab.interface}, lockstep" in text
    samples = whole(can_lab.directory / "out" / "demo.mcap").samples
    assert 20.0 <= samples["t_ref_s"][samples["state"] == State.ACTIVE][-1] < 20.5
    assert not samples["fault"].any()


# --- foreign tools and rivals


def test_candump__daemon_runs__sees_sync_commands_feedback_and_heartbeats(bench):
    bench.moving_arm()
    with bench.lab.tool("candump", "-L", bench.interface) as dump:
        for words in ("080#", "201#", "202#", "181#", "182#", "701#05", "702#05", "77F#05"):
            dump.wait_for(words)
        line = re.search(r"^\(\d+\.\d+\) \w+ 181#([0-9A-F]+)$", dump.text, re.M)
    assert len(line[1]) == 16


def test_cansend__sdo_request__is_answered_beside_the_daemon(bench):
    arm = bench.moving_arm()
    request = ["cansend", bench.interface, "601#4018100200000000"]  # read 1018:02, product code
    with bench.lab.tool("candump", "-L", f"{bench.interface},581:7FF") as dump:

        def is_answered():
            subprocess.run(request, check=True)
            return "581#43181002314C4948" in dump.text  # "HIL1"

        wait_until(is_answered, what="the SDO answer")
    assert arm.state_now() is State.ACTIVE


def test_second_daemon__same_bus__refuses_and_leaves_the_first_alone(bench):
    arm = bench.moving_arm()
    rival = bench.lab.start(
        "run", *bench.lab.settings("arm.name=rival", "zenoh.listen=[]"), "--no-record"
    )
    assert rival.wait(120) == 1
    assert "another master" in one_line(rival)  # its SYNC is heard, or a drive is enabled already
    assert arm.state_now() is State.ACTIVE
    assert not any(event["kind"] == "fault" for event in arm.events)


def test_cangen__flood_of_foreign_frames__kernel_keeps_them_from_the_loop(bench):
    arm = bench.moving_arm()
    flood = ["cangen", bench.interface, "-g", "0", "-I", "555", "-L", "8", "-n", "20000", "-i"]
    subprocess.run(flood, check=True, timeout=60)
    last = len(arm.statuses)
    wait_until(lambda: len(arm.statuses) > last + 1, what="the status of this instant")
    assert arm.statuses[-1]["unknown_frames"] == 0
    assert arm.statuses[-1]["frames_received"] > 0
    assert arm.daemon.process.poll() is None


# --- the interface


def test_interface__down_and_up_in_motion__trips_with_one_line_and_comes_back(bench):
    arm, name = bench.moving_arm(), bench.interface
    ip("link", "set", name, "down")
    arm.wait_for(State.FAULT)
    assert arm.now["fault"] == FaultCode.BUS_FAILED
    arm.wait_cycles(1000)  # the emulator gives lockstep up, and the drives' watchdogs act
    (event,) = is_told(arm, FaultCode.BUS_FAILED)
    assert event["detail"] == (
        f"no bus socketcan:{name}: the interface is down; `ip link set {name} up`"
    )
    assert arm.daemon.process.poll() is None

    ip("link", "set", name, "up")
    with bench.watch() as watcher:
        for node in NODES:
            assert watcher.state(node) is Cia402State.FAULT
            assert watcher.torque(node) == 0
        assert arm.state_now() is State.FAULT  # nothing comes back by itself
        assert len(is_told(arm, FaultCode.BUS_FAILED)) == 1
        arm.make_ready()
        for node in NODES:
            assert watcher.state(node) is Cia402State.OPERATION_ENABLED
    rows = arm.rows()
    assert not rows["tau_sent_Nm"][rows["fault"] == FaultCode.BUS_FAILED].any()


def test_cansend__nmt_reset_of_a_drive__arm_trips_and_says_which(bench):
    arm = bench.moving_arm()
    subprocess.run(["cansend", bench.interface, "000#8101"], check=True)
    arm.wait_for(State.FAULT)
    (event,) = wait_until(lambda: is_told(arm, FaultCode.AMPLIFIER_LOST), what="the event")
    assert "joint 1 (cia402 node 1): restarted by itself" in event["detail"]
    unpowered = {Cia402State.SWITCH_ON_DISABLED, Cia402State.FAULT}
    with bench.watch() as watcher:
        for node in NODES:
            wait_until(lambda n=node: watcher.state(n) in unpowered, what="power off")
            assert watcher.torque(node) == 0
    assert arm.daemon.end() == 0, arm.daemon.stderr
    assert arm.daemon.stderr == ""


@pytest.mark.parametrize(
    "kind",
    [("-I", "r", "-L", "r", "-D", "r"), ("-m",)],
    ids=["standard", "of_every_kind"],
)
def test_cangen__flood_of_random_frames__no_exception_and_torque_in_bounds(bench, kind):
    """NMT, commands and feedback are among them: the arm may trip, and a new start mends it."""
    arm = bench.moving_arm()
    seq = arm.seq
    subprocess.run(
        ["cangen", bench.interface, "-g", "0", "-n", "20000", "-i", *kind], check=True, timeout=60
    )
    arm.wait_cycles(20)
    assert arm.daemon.process.poll() is None
    rows = arm.since(seq)
    assert np.all(np.abs(rows["tau_sent_Nm"]) <= TAU_MAX_Nm)
    for state in (State.FAULT, State.IDLE):
        assert not rows["tau_sent_Nm"][rows["state"] == state].any()
    assert arm.daemon.end() == 0
    assert arm.daemon.stderr == ""


def test_interface__deleted_in_motion__daemon_ends_with_one_line(bench):
    arm = bench.moving_arm()
    ip("link", "delete", bench.interface)
    assert arm.daemon.wait(120) == 1
    assert f"no bus socketcan:{bench.interface}: " in one_line(arm.daemon)
