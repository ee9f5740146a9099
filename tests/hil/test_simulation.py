"""Experiments in virtual time: the same bytes every time, and figures within their bounds."""

import json
from contextlib import closing

import numpy as np
import pytest

from controller.machine import State
from hil.experiment import SETTLE_CYCLES
from hil.recording import Recording
from hil.scenarios import SCENARIOS
from tests.hil.lab import HilProcess, one_line, whole

MOVE = {"kind": "move", "target_rad": [0.5, -0.4]}


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


def rows_of(text):
    """The verdict table: figures with PASS or FAIL, one per bound."""
    return [line for line in text.splitlines() if line.rstrip().endswith(("PASS", "FAIL"))]


def test_sim__same_command_in_other_process_place_and_hash_seed__same_bytes(hil):
    runs = [
        hil("sim", "--scenario", "A", "--record", "a.mcap", PYTHONHASHSEED=seed, TZ=zone, LC_ALL=c)
        for seed, zone, c in (("0", "UTC", "C"), ("4242", "Asia/Tokyo", "C.UTF-8"))
    ]
    assert [run.wait(60) for run in runs] == [0, 0]
    first, second = (run.directory / "a.mcap" for run in runs)
    assert first.read_bytes() == second.read_bytes()
    exports = [
        hil("export", str(path), "--csv", "-", PYTHONHASHSEED=seed)
        for path, seed in ((first, "1"), (second, "77"))
    ]
    assert [export.wait(60) for export in exports] == [0, 0]
    texts = [export.stdout_path.read_bytes() for export in exports]
    assert texts[0] == texts[1]
    lines = texts[0].decode().splitlines()
    assert lines[0].startswith("t_s,cycle,state,q_meas_1_rad,dq_meas_1_rad_s,q_des_1_rad,")
    samples = whole(first).samples
    assert len(lines) == len(samples) + 1 > 20_000
    row = dict(zip(lines[0].split(","), lines[9000].split(","), strict=True))
    assert float(row["q_meas_2_rad"]) == samples["q_meas_rad"][8999, 1]
    assert float(row["tau_applied_1_Nm"]) == samples["tau_applied_Nm"][8999, 0]
    verdict = rows_of(runs[0].stdout)
    assert len(verdict) >= len(SCENARIOS["A"].bounds)
    assert all(line.endswith("PASS") for line in verdict)


def test_sim__every_other_scenario__meets_all_its_bounds(hil):
    runs = {name: hil("sim", "--scenario", name) for name in ("A0", "B", "E")}
    for name, run in runs.items():
        assert run.wait(90) == 0, run.stdout + run.stderr
        verdict = rows_of(run.stdout)
        assert len(verdict) >= len(SCENARIOS[name].bounds)
        assert all(line.endswith("PASS") for line in verdict)
        recording = whole(run.directory / "runs" / "sim.mcap")
        assert recording.config["scenario"] == name
        has_frames = next(iter(recording.frames()), None) is not None
        assert has_frames is not recording.config["emulator"]["is_ideal"]
    assert recording.config["emulator"]["is_ideal"] is False


def test_sim__trajectory_from_file__runs_it_from_the_pose_and_settings_given(hil, tmp_path):
    (tmp_path / "move.json").write_text(json.dumps(MOVE))
    run = hil(
        "sim", "--trajectory", str(tmp_path / "move.json"), "--set", "plant.q0_rad=[0.1, 0.2]",
        "--set", "controller.law.name=pd", "--record", "deep/er/move.mcap",
    )  # fmt: skip
    assert run.wait(60) == 0
    recording = whole(run.directory / "deep" / "er" / "move.mcap")
    samples = recording.samples
    active = samples[samples["state"] == State.ACTIVE]
    assert active["q_des_rad"][0] == pytest.approx([0.1, 0.2], abs=2e-3)
    hold = samples[samples["state"] == State.HOLD]
    assert SETTLE_CYCLES <= len(hold) <= SETTLE_CYCLES + 1
    assert hold["q_des_rad"][-1] == pytest.approx(MOVE["target_rad"])
    assert np.abs(hold["q_meas_rad"][-1] - MOVE["target_rad"]).max() < 0.05
    assert not samples["sigma"].any()  # a PD law has no integral term
    assert samples["state"][-1] == State.IDLE
    states = [e.detail["to"] for e in recording.events if e.kind == "state"]
    assert states == ["IDLE", "READY", "ACTIVE", "HOLD", "STOPPING", "IDLE"]
    assert np.abs(samples["q_meas_rad"] - samples["q_true_rad"]).max() <= np.pi / 4096 + 1e-9


@pytest.mark.parametrize(
    ("request_", "words"),
    [
        ({"kind": "move", "target_rad": [0.0, 3.0]}, "joint 2: target 3"),
        ({"kind": "move", "target_rad": [0.0]}, "the arm has 2"),
        ({"kind": "kelly", "duration_s": 20, "rate": 4.0}, "beyond the limit"),
        ({"kind": "dance"}, "dance"),
    ],
)
def test_sim__impossible_trajectory__refused_in_one_line(hil, tmp_path, request_, words):
    (tmp_path / "bad.json").write_text(json.dumps(request_))
    run = hil("sim", "--trajectory", str(tmp_path / "bad.json"))
    assert run.wait(60) == 1
    assert words in one_line(run)


def test_sim__arm_trips__one_line_says_state_fault_and_recording(hil):
    run = hil("sim", "--scenario", "A", "--set", "controller.limits.dq_trip_rad_s=[0.5, 0.5]")
    assert run.wait(60) == 1
    line = one_line(run)
    assert "FAULT (VELOCITY)" in line
    assert "runs/sim.mcap" in line
    recording = Recording.open(run.directory / "runs" / "sim.mcap")
    (fault,) = [e.detail for e in recording.events if e.kind == "fault"]
    assert fault["code"] == "VELOCITY"
    with closing(recording.frames()) as frames:
        assert next(frames).frame
