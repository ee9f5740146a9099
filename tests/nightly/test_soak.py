"""Daemon and emulator at 1 kHz for ten minutes, and a minute in real time replayed: `make nightly`.

`HIL_SOAK_S` changes the length of the soak, `HIL_SOAK_TIME=wall` lets the emulator's time run by
the clock instead of in lockstep with the loop.
"""

import json
import os
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import theilslopes

from controller.machine import State
from hil.config import config_from_json
from hil.recording import Recording
from hil.replay import Replayer
from tests.hil.lab import Lab, wait_until

IS_NIGHTLY = bool(os.environ.get("HIL_NIGHTLY"))
SOAK_S = float(os.environ.get("HIL_SOAK_S", "600"))
SOAK_TIME = os.environ.get("HIL_SOAK_TIME", "lockstep")
WALL_S = 60.0
MARGIN_S = 600.0
WARM_UP_SHARE = 0.2
FILES = 10
"""Parts of the recording: a file's index is kept until the file is closed, some 750 kB a minute."""
GROWTH_MAX_kB_min = 64.0
"""Resident memory of a process may grow by so much a minute; a byte kept per cycle is 60."""

pytestmark = [
    pytest.mark.nightly,
    pytest.mark.skipif(not IS_NIGHTLY, reason="takes minutes: `make nightly` (HIL_NIGHTLY=1)"),
]


def resident_kB(pid):
    """Memory of its own; the rings that all share count as their pages are first touched."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("RssAnon"))


class Soak:
    """One long motion of a daemon, with its memory and its status watched from outside."""

    def __init__(self, lab, duration_s, emulated_time):
        settings = (
            f"trajectory.max_duration_s={duration_s + 10.0}",
            f"recording.max_age_s={duration_s / FILES}",
        )
        self.lab = lab
        self.emulator = lab.emulate(time=emulated_time)
        self.arm = lab.run(*settings)
        self.counter = lab.start("watch", "--count", "--arm", lab.arm, "--connect", lab.endpoint)
        self.counter.wait_for_line()
        children = self.arm.daemon.children()
        self.pids = {**children, "supervisor": self.arm.daemon.pid, "emulator": self.emulator.pid}
        self.memory = {name: [] for name in self.pids}

    def run(self, duration_s):
        """Move for so long; return the last status and what another process received."""
        self.arm.make_ready()
        self.arm.swing(duration_s)
        end_s = time.monotonic() + duration_s
        while time.monotonic() < end_s and self.arm.daemon.process.poll() is None:
            for name, pid in self.pids.items():
                self.memory[name].append((time.monotonic(), resident_kB(pid)))
            del self.arm._batches[:-1]  # all of a soak would fill the memory
            time.sleep(1.0)
        self.arm.wait_for(State.HOLD, 60.0)
        self.arm.client.command("disable")
        self.arm.wait_for(State.IDLE)
        assert self.arm.daemon.end() == 0
        wait_until(lambda: self.arm.statuses[-1]["samples"] > 0)
        self.counter.end()
        return self.arm.statuses[-1], json.loads(self.counter.stdout.splitlines()[-1])

    def growth_kB_min(self, name):
        """Median slope of the resident memory after the warm-up (Theil and Sen).

        What is kept per cycle is in the slope of every pair of points. What a process takes once
        and keeps, as after a stall has filled its queues, is in fewer than half of them.
        """
        points = np.array(self.memory[name], dtype=float)
        points = points[round(len(points) * WARM_UP_SHARE) :]
        return 60.0 * float(theilslopes(points[:, 1], points[:, 0]).slope)


def require_replayed(recording):
    """Every frame that was sent comes out again; return what the replay found."""
    result = Replayer(recording, config_from_json(json.dumps(recording.config))).run()
    assert result.difference is None, result.difference.text()
    assert result.cycles == len(recording.samples)
    assert result.frames_equal == result.frames_sent > 0
    return result


def require_complete(path):
    recording = Recording.open_run(path)
    assert not recording.is_truncated
    assert np.array_equal(recording.samples["seq"], np.arange(len(recording.samples)))
    return recording


@pytest.fixture
def place(tmp_path):
    lab = Lab(tmp_path)
    yield lab
    lab.close()


@pytest.fixture
def say(capsys):
    def tell(line):
        with capsys.disabled():
            sys.stdout.write(f"\n{line}")

    return tell


def tell_of(say, soak, status, counted, recording):
    say(f"cycles     {status['samples']} run, {status['overruns']} skipped, {status['scheduler']}")
    say(f"misses     {json.dumps(status['misses'])}; ladder {json.dumps(status['ladder'])}")
    say(f"telemetry  {counted['received']} received, {counted['lost']} lost on the way, "
        f"{status['telemetry_lost']} lost by the gateway")  # fmt: skip
    say(f"recording  {len(recording.samples)} samples in {len(recording.parts)} files")
    for name in soak.memory:
        last_kB = soak.memory[name][-1][1]
        say(f"memory     {name}: {last_kB} kB, {soak.growth_kB_min(name):+.1f} kB/min")


@pytest.mark.timeout(4 * SOAK_S + MARGIN_S)
def test_soak__minutes_at_1_kHz__nothing_lost_nothing_grows_and_all_replayed(place, say):
    soak = Soak(place, SOAK_S, SOAK_TIME)
    status, counted = soak.run(SOAK_S)
    recording = require_complete(soak.arm.recording)
    tell_of(say, soak, status, counted, recording)
    assert len(recording.samples) == status["samples"] >= 0.95 * 1000 * SOAK_S - status["overruns"]
    assert status["telemetry_lost"] == 0
    assert counted["lost"] == 0
    assert counted["received"] >= 1000 * SOAK_S - status["overruns"] - 2000
    assert not recording.samples["fault"].any()
    for name in soak.memory:
        assert soak.growth_kB_min(name) < GROWTH_MAX_kB_min, name
    result = require_replayed(recording)
    say(f"replay     {result.frames_equal} of {result.frames_sent} frames\n")


@pytest.mark.timeout(4 * WALL_S + MARGIN_S)
def test_replay__a_minute_in_real_time__every_frame_again(place, say):
    soak = Soak(place, WALL_S, "wall")
    status, _ = soak.run(WALL_S)
    recording = require_complete(soak.arm.recording)
    result = require_replayed(recording)
    say(f"real time  {status['samples']} cycles, {status['overruns']} skipped, "
        f"misses {json.dumps(status['misses'])}")  # fmt: skip
    say(f"replay     {result.frames_equal} of {result.frames_sent} frames\n")
