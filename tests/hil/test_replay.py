"""Replay: recorded frames and commands give the recorded torques again, and a change shows."""

import json
from pathlib import Path

import numpy as np
import pytest

from controller.machine import State
from controller.reference import MotionLimits, MotionState
from hil.config import config_from_json, load_config, merge
from hil.diff import Digest, first_parting
from hil.experiment import scenario_settings
from hil.messages import parse_trajectory
from hil.planner import plan
from hil.recording import Recording
from hil.replay import Replayer, ReplayError
from hil.scenarios import find_scenario
from hil.simulation import Simulation, open_recording
from tests.hil.lab import HilProcess

GOLDEN = Path(__file__).parent / "golden"
SWING = {"kind": "move", "target_rad": [0.3, -0.2]}


def simulate(path, *, settings=None, middle=None):
    """Enable, move, perhaps do something in the middle, and disable."""
    config = load_config(None, settings or {})
    with open_recording(config, path) as recording:
        simulation = Simulation(config, recording)
        simulation.execute("enable")
        simulation.run_until(State.READY, 1000)
        start = MotionState.at_rest(simulation.control.player.setpoint.q_rad)
        limits = MotionLimits.of(config.controller.limits, 120.0)
        request = parse_trajectory(json.dumps(SWING))
        simulation.play(plan(request, start, limits, 1e-3))
        simulation.run(100)
        if middle is not None:
            middle(simulation)
        simulation.run(400)
        if simulation.control.machine.state.is_powered:
            simulation.execute("disable")
            simulation.run(50)
        simulation.close()
    return Recording.open(path)


def replay(recording, over=None):
    table = merge(recording.config, over or {})
    return Replayer(recording, config_from_json(json.dumps(table))).run()


def require_identical(recording):
    result = replay(recording)
    assert result.difference is None
    assert result.cycles == len(recording.samples)
    assert result.frames_equal == result.frames_sent > 2 * result.cycles


MIDDLES = {
    "nothing": None,
    "stop": lambda s: s.execute("stop"),
    "estop": lambda s: s.execute("estop"),
    "bounds": lambda s: s.execute("gain_bounds", Kd_min=[1.5, 1.5], Kd_max=[2.0, 2.5]),
    "fault": lambda s: s.execute("fault", joint=0),
    "end": lambda s: s.execute("end"),
    "gateway lost": lambda s: s.execute("gateway_lost", policy="hold"),
    "authority": lambda s: s.execute("authority", operator="ann", action="taken"),
    "operator lost": lambda s: s.execute("operator_lost", operator="ann", policy="hold"),
    "supervisor lost": lambda s: s.execute("supervisor_lost"),
}


@pytest.mark.parametrize("middle", MIDDLES.values(), ids=MIDDLES)
def test_replay__simulated_run__every_frame_and_sample_again(tmp_path, middle):
    require_identical(simulate(tmp_path / "run.mcap", middle=middle))


@pytest.mark.parametrize(
    "settings",
    [
        {"controller": {"velocity": {"estimator": "levant"}}},
        {"arm": {"preset": "pelican_h"}},
        {"controller": {"law": {"tuner": "load_memory"}}},
        {"controller": {"law": {"name": "slotine_li"}}},
        {"emulator": {"wire": {"is_on": True}}},
        {"axes": {"2": {"family": "odrive"}}},
        {"axes": {"1": {"family": "moteus"}, "2": {"family": "moteus"}}},
    ],
    ids=str,
)
def test_replay__other_laws_estimators_wires_amplifiers__the_same(tmp_path, settings):
    require_identical(simulate(tmp_path / "run.mcap", settings=settings))


@pytest.mark.parametrize(
    ("key", "value"),
    [("alpha", [15.0, 14.0]), ("Ki", [0.11, 0.1]), ("learning_rate", 0.011)],
)
def test_replay__changed_gain__first_difference_named(tmp_path, key, value):
    recording = simulate(tmp_path / "run.mcap")
    result = replay(recording, {"controller": {"law": {key: value}}})
    assert result.difference is not None
    assert 0 <= result.difference.cycle < len(recording.samples)
    assert result.difference.recorded != result.difference.replayed
    assert str(result.difference.cycle) in result.difference.text()


def test_replay__reference_not_recorded__says_so(tmp_path, monkeypatch):
    monkeypatch.setattr("hil.recording.RecordingWriter.add_trajectory", lambda *_: None)
    recording = simulate(tmp_path / "run.mcap")
    with pytest.raises(ReplayError, match="lacks the reference that began in cycle"):
        replay(recording)


def test_replay__ideal_arm__has_no_frames(tmp_path):
    settings = scenario_settings(find_scenario("A0"))
    path = tmp_path / "ideal.mcap"
    config = load_config(None, settings)
    with open_recording(config, path) as recording:
        simulation = Simulation(config, recording)
        simulation.run(10)
        simulation.close()
    with pytest.raises(ReplayError, match="no cycles with bus frames"):
        replay(Recording.open(path))


@pytest.mark.parametrize("path", sorted(GOLDEN.glob("*.mcap")), ids=lambda p: p.stem)
def test_replay__golden_recording__this_program_still_sends_the_same_frames(path):
    require_identical(Recording.open(path))


def test_golden__there_are_some():
    assert len(list(GOLDEN.glob("*.mcap"))) >= 2


def test_replay__file_cut_short__as_far_as_it_goes(tmp_path):
    whole = simulate(tmp_path / "whole.mcap")
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole.path.read_bytes()[: whole.path.stat().st_size * 2 // 3])
    recording = Recording.open(cut)
    assert recording.is_truncated
    result = replay(recording)
    assert result.difference is None
    assert 0 < result.cycles <= len(recording.samples) < len(whole.samples)


# --- two recordings side by side --------------------------------------------------------------


def test_diff__same_run_twice__identical(tmp_path):
    a, b = simulate(tmp_path / "a.mcap"), simulate(tmp_path / "b.mcap")
    assert Digest.of(a) == Digest.of(b)
    assert first_parting(a, b, with_timing=True) == []


def test_diff__other_gain__cycle_and_field(tmp_path):
    a = simulate(tmp_path / "a.mcap")
    b = simulate(tmp_path / "b.mcap", settings={"controller": {"law": {"Ki": [0.2, 0.1]}}})
    samples, frames, *_ = first_parting(a, b, with_timing=True)
    names = a.samples.dtype.names
    row = int(np.flatnonzero(a.samples["cycle"] == samples.cycle)[0])
    assert samples.what in names
    for name in names:  # nothing differs before
        assert np.array_equal(a.samples[name][:row], b.samples[name][:row], equal_nan=True)
    assert frames.cycle >= samples.cycle
    assert frames.recorded.startswith("sent ")


def test_diff__longer_run__says_where_the_other_ends(tmp_path):
    a = simulate(tmp_path / "a.mcap")
    b = simulate(tmp_path / "b.mcap", middle=lambda s: s.run(5))
    assert any(d.what in ("samples", "event") or "frame" in d.what
               for d in first_parting(a, b, with_timing=False))  # fmt: skip


def test_commands__replay_and_diff__print_and_exit_status(tmp_path):
    simulate(tmp_path / "a.mcap")
    simulate(tmp_path / "b.mcap", settings={"controller": {"law": {"Ki": [0.2, 0.1]}}})
    for arguments, status, text in (
        (("replay", "a.mcap"), 0, "(100 %)"),
        (("replay", "a.mcap", "--set", "controller.law.Ki=[0.2, 0.1]"), 1, "first difference"),
        (("diff", "a.mcap", "a.mcap"), 0, "identical"),
        (("diff", "a.mcap", "b.mcap"), 1, "differs in cycle"),
        (("replay", "none.mcap"), 1, ""),
    ):
        process = HilProcess(tmp_path, *arguments)
        assert process.wait(60) == status, process.stderr
        assert text in process.stdout
        assert "Traceback" not in process.stderr
