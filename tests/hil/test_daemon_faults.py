"""What happens around a running daemon: stopped processes, clock, disk, network, bus, memory.

One daemon goes through all of it, in the order of this file, and its loop must not notice; the
recording is judged at the end.
"""

import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from controller.faults import FaultCode
from controller.machine import State
from hil.black_box import is_trip
from hil.client import Client
from hil.recording import Recording
from tests.hil.lab import Arm, free_port, largest_jump, one_line, wait_until

HERE = Path(__file__).parent
STOPPED_S = 3.0
STOPS = [
    f"plant.links.{j}.q_{end}_rad={q}" for j in (1, 2) for end, q in (("min", -2.5), ("max", 2.5))
]
"""An arm without power coasts, and must not end up beyond its limits."""
MOVING = (State.ACTIVE, State.HOLD, State.READY)
ROUTER = """
import sys, time, zenoh
config = zenoh.Config()
config.insert_json5("mode", '"router"')
config.insert_json5("listen/endpoints", '["' + sys.argv[1] + '"]')
config.insert_json5("scouting/multicast/enabled", "false")
with zenoh.open(config):
    print("ready", flush=True)
    time.sleep(600)
"""


@pytest.fixture(scope="module")
def clock(tmp_path_factory):
    """Environment of a process whose wall clock this test can step, and the file that says how."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        pytest.skip("no C compiler: the stepped clock is preloaded from a library")
    folder = tmp_path_factory.mktemp("clock")
    library, offset = folder / "wall_clock.so", folder / "offset"
    source = HERE / "wall_clock.c"
    subprocess.run([compiler, "-shared", "-fPIC", "-o", library, source, "-ldl"], check=True)
    offset.write_text("0\n")
    return {"LD_PRELOAD": str(library), "HIL_TEST_CLOCK": str(offset)}, offset


class Router:
    """A Zenoh router that can be taken away and put back."""

    def __init__(self, lab):
        self.endpoint = f"tcp/127.0.0.1:{free_port()}"
        self._process = None
        lab._stack.callback(self.end)
        self.start()

    def start(self):
        self._process = subprocess.Popen(
            [sys.executable, "-c", ROUTER, self.endpoint], stdout=subprocess.PIPE, text=True
        )
        assert self._process.stdout.readline() == "ready\n"

    def end(self):
        if self._process.poll() is None:
            self._process.kill()
        self._process.wait()
        self._process.stdout.close()


@pytest.fixture(scope="module")
def router(shared_lab):
    return Router(shared_lab)


@pytest.fixture(scope="module")
def arm(shared_lab, clock, router):
    """A swinging arm: of its clients one comes directly, others through the router."""
    shared_lab.emulate(*STOPS)
    options, record = shared_lab.run_options(
        f'zenoh.connect=["{router.endpoint}"]', "loop.lockstep_timeout_s=0.05"
    )
    daemon = shared_lab.start(*options, **clock[0])
    daemon.wait_for_line()
    made = Arm(daemon, shared_lab.connect(), record)
    made.client.command("enable")
    made.swing()
    return made


def steps(arm, first):
    """Samples since a number: none is missing, and the arm was under power throughout."""
    rows = arm.since(first)
    assert np.all(np.diff(rows["seq"].astype(int)) == 1)
    assert set(rows["state"].tolist()) <= set(MOVING)
    fresh = rows[rows["feedback_age_cycles"] == 0]  # without feedback the reference waits
    assert largest_jump(fresh) <= 1.0
    return rows


def test_gateway_and_recorder__stopped_for_seconds__loop_goes_on_and_nothing_is_lost(arm):
    first = arm.seq
    pids = [arm.daemon.children()[name] for name in ("gateway", "recorder")]
    for pid in pids:
        os.kill(pid, signal.SIGSTOP)
    time.sleep(STOPPED_S)
    for pid in pids:
        os.kill(pid, signal.SIGCONT)
    arm.wait_cycles(200)
    assert len(steps(arm, first)) > 500  # a slow host runs fewer cycles than 1000 a second
    assert arm.statuses[-1]["telemetry_lost"] == 0


def test_wall_clock__stepped_both_ways__nothing_depends_on_it(arm, clock):
    first = arm.seq
    for offset_s in (86_400, -86_400, 0):
        clock[1].write_text(f"{offset_s}\n")
        arm.wait_cycles(200)
        assert arm.state in MOVING
    rows = steps(arm, first)
    assert np.all(np.diff(rows["t_ns"]) > 0)
    assert np.diff(rows["t_ns"]).max() < 5e9


def test_router__lost_and_back__loop_does_not_notice_and_the_same_client_hears_again(
    arm, router, shared_lab
):
    first = arm.seq
    with Client(shared_lab.arm, [router.endpoint]) as client:
        seen = []
        client.on_telemetry(seen.append)
        wait_until(lambda: seen, 30.0, "telemetry through the router")
        router.end()
        arm.wait_cycles(300)
        router.start()
        lost_at = int(seen[-1]["seq"][-1])
        wait_until(
            lambda: int(seen[-1]["seq"][-1]) > lost_at + 300, 60.0, "telemetry through the new one"
        )
    steps(arm, first)


def test_memory__under_pressure__loop_makes_no_page_faults(arm):
    first, before = arm.seq, arm.statuses[-1]
    if not before["memory_locked"]:
        pytest.skip("this host grants no locked memory")
    program = "import time; hog = bytearray(256 << 20); hog[::4096] = bytes(len(hog) // 4096)"
    subprocess.run([sys.executable, "-c", program], check=True)
    arm.wait_cycles(200)
    wait_until(lambda: arm.statuses[-1]["samples"] > before["samples"] + 200, what="status")
    assert arm.statuses[-1]["major_faults"] == before["major_faults"]
    steps(arm, first)


def test_bus__unplugged_in_motion__trips_is_kept_in_a_black_box_and_comes_back(arm, shared_lab):
    sent = shared_lab.send("fault", "--target", "bus", "--kind", "off", "--duration", "0.06")
    assert sent.wait() == 0, sent.stderr
    arm.wait_for(State.FAULT)
    assert arm.now["fault"] in (FaultCode.FEEDBACK_LOST, FaultCode.AMPLIFIER_LOST)
    boxes = wait_until(
        lambda: list(arm.recording.parent.glob(f"{arm.recording.stem}-trip-*.mcap")), what="the box"
    )
    box = Recording.open(boxes[0])
    assert not box.is_truncated
    faults = [event for event in box.events if is_trip({"kind": event.kind, **event.detail})]
    assert faults[0].detail["code"] == FaultCode(int(arm.now["fault"])).name
    assert "black_box" in [event.kind for event in box.events]
    t_ns, trip_ns = box.samples["t_ns"], faults[0].t_ns
    assert np.all(np.diff(box.samples["seq"].astype(int)) == 1)
    assert trip_ns - t_ns[0] > 2e9
    assert 1e9 < t_ns[-1] - trip_ns <= 2e9
    assert next(iter(box.frames()), None) is not None
    export = shared_lab.start("export", str(boxes[0]), "--csv", "box.csv")
    assert export.wait(60) == 0, export.stderr
    replay = shared_lab.start("replay", str(boxes[0]))
    assert replay.wait(60) == 1
    assert "black box" in one_line(replay)

    wait_until(lambda: arm.now["feedback_age_cycles"] == 0, 60.0, "feedback after the fault")
    arm.make_ready()
    assert arm.now["fault"] == 0


def test_disk__full_in_motion__recording_ends_with_a_word_and_the_arm_goes_on(arm):
    arm.swing()
    first = arm.seq
    recorder = arm.daemon.children()["recorder"]
    size = arm.recording.stat().st_size
    resource.prlimit(recorder, resource.RLIMIT_FSIZE, (size + 4096, size + 4096))
    wait_until(lambda: "recording has stopped" in arm.daemon.stderr, what="the word")
    arm.wait_cycles(300)
    steps(arm, first)
    assert len(Recording.open(arm.recording).samples) > 1000
    assert arm.daemon.end() == 0
