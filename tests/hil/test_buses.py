"""Arms of 2 to 12 joints on 1 to 4 buses in virtual time: configured, recorded, replayed."""

import json

import numpy as np
import pytest

from drivers.arm_bus import RECEIVED, SENT
from drivers.arm_group import split_bus
from hil.budget import bus_budget, bus_budgets, require_fit
from hil.config import ConfigError, config_from_json, load_config, merge
from hil.diff import first_parting
from hil.experiment import run_in_simulation, swing
from hil.messages import parse_trajectory
from hil.recording import Recording
from hil.replay import Replayer, ReplayError
from hil.shared import FRAMES_AT_ONCE, SharedMemory, frames_at_once
from sim_backend.errors import SimError
from sim_backend.presets import CHAIN_JOINTS_MAX
from tests.drivers.group_rig import configuration
from tests.hil.lab import HilProcess, one_line

LAYOUTS = {
    "4 on 2": (1, 2, 1, 2),
    "7 on 3": (1, 1, 1, 2, 2, 3, 3),
    "12 on 4": (1, 2, 3, 4) * 3,
}


def run(config, path, duration_s=0.5):
    request = swing(config).model_copy(update={"duration_s": duration_s, "ramp_s": 0.2})
    run_in_simulation(config, request, path)
    return Recording.open(path)


def replay(recording, over=None):
    table = merge(recording.config, over or {})
    return Replayer(recording, config_from_json(json.dumps(table))).run()


def refusal(over):
    with pytest.raises(ConfigError) as caught:
        load_config(None, over)
    return str(caught.value)


# --- configuration ----------------------------------------------------------------------------


@pytest.mark.parametrize("joints", range(1, CHAIN_JOINTS_MAX + 1))
def test_chain__any_number_of_joints__is_a_whole_configuration(joints):
    config = load_config(None, {"arm": {"preset": f"chain_h:{joints}"}})
    assert config.joints == joints
    law, limits = config.controller.law, config.controller.limits
    assert limits.tau_max_Nm == tuple(axis.torque_max_Nm for axis in config.axes)
    assert sorted(law.Kd_max, reverse=True) == list(law.Kd_max)
    assert config_from_json(config.model_dump_json()) == config


@pytest.mark.parametrize("number", ["0", "13", "", "x", "-1", "2.5", "\u0663"])
def test_chain__no_such_number__refused(number):
    text = refusal({"arm": {"preset": f"chain_h:{number}"}})
    assert "a chain has 1 to 12 joints, e.g. chain_h:7" in text


def test_config__one_bus__says_nothing_of_others():
    table = json.loads(load_config().model_dump_json())
    assert "more" not in table["bus"]
    assert not any("bus" in axis for axis in table["axes"])


def test_config__several_buses__survives_its_way():
    config = configuration((1, 2, 1))
    again = config_from_json(config.model_dump_json())
    assert again == config
    assert [axis.bus for axis in again.axes] == [1, 2, 1]
    assert again.bus.addresses == config.bus.addresses
    assert len(again.bus.addresses) == 2


@pytest.mark.parametrize(
    ("over", "words"),
    [
        ({"axes": {"2": {"bus": 2}}}, "axes.2.bus is 2, there is 1 bus; add addresses to bus.more"),
        ({"bus": {"more": ["unix:/b"]}}, "no axis is on bus 2 (unix:/b); set axes.N.bus = 2"),
        ({"axes": {"2": {"bus": 5}}}, "less than or equal to 4"),
        ({"axes": {"2": {"bus": 0}}}, "greater than or equal to 1"),
        (
            {"axes": {"1": {"bus": 2}}, "bus": {"address": "unix:/b", "more": ["unix:/b"]}},
            "bus.more: unix:/b, unix:/b are not all different",
        ),
        ({"axes": {"2": {"bus": 2}}, "bus": {"more": ["ring:0"]}}, "bus address 'ring:0'"),
        ({"bus": {"more": [f"unix:/{n}" for n in range(4)]}}, "bus.more"),
    ],
)  # fmt: skip
def test_config__buses_and_axes_do_not_match__refused(over, words):
    assert words in refusal(over)


def test_config__node_id_twice__only_on_one_bus_a_mistake():
    axes = {"1": {"node_id": 3}, "2": {"node_id": 3, "bus": 2}}
    assert load_config(None, {"axes": axes, "bus": {"more": ["unix:/b"]}}).joints == 2
    axes = {"1": {"bus": 2}, "2": {"node_id": 3, "bus": 2}, "3": {"node_id": 3, "bus": 2}}
    over = {"arm": {"preset": "chain_h:4"}, "axes": axes, "bus": {"more": ["unix:/b"]}}
    assert "node ids (cia402 1, cia402 3, cia402 3) on bus 2 are not all" in refusal(over)


# --- budget and shared memory -----------------------------------------------------------------


def test_budget__twelve_joints__fit_on_four_buses_and_not_on_one():
    with pytest.raises(ConfigError, match=r"does not fit on the bus: .*the period has 1000 us"):
        require_fit(configuration((1,) * 12))
    config = configuration((1, 2, 3, 4) * 3)
    require_fit(config)
    assert len(bus_budgets(config)) == 4


def test_budget__one_bus_too_full__is_named():
    config = configuration((1, *(2,) * 9))
    first, second = bus_budgets(config)
    assert first.is_fitting
    assert bus_budget(config) == second
    with pytest.raises(ConfigError, match="does not fit on bus 2"):
        require_fit(config)


@pytest.mark.parametrize("places", LAYOUTS.values(), ids=LAYOUTS)
def test_shared_memory__many_joints__a_cycle_s_frames_fit_in_one_record(places):
    config = configuration(places)
    shared = SharedMemory.create(config)
    room = shared.frames.payload_size // shared.frame_layout.size
    assert room == frames_at_once(config) >= 2 * len(places) + 2 * len(set(places))
    assert shared.config == config


def test_shared_memory__two_joints__as_large_as_before():
    assert frames_at_once(load_config()) == FRAMES_AT_ONCE


# --- runs -------------------------------------------------------------------------------------


@pytest.mark.parametrize("places", LAYOUTS.values(), ids=LAYOUTS)
def test_sim__several_buses__same_motion_as_on_one(tmp_path, places):
    several = run(configuration(places), tmp_path / "several.mcap")
    one = run(configuration((1,) * len(places)), tmp_path / "one.mcap")
    for name in ("q_meas_rad", "tau_sent_Nm", "q_true_rad", "tau_applied_Nm"):
        assert np.array_equal(several.samples[name], one.samples[name]), name
    assert not several.samples["fault"].any()
    assert np.ptp(several.samples["q_true_rad"], axis=0).min() > 0.02  # they all move


@pytest.mark.parametrize("places", LAYOUTS.values(), ids=LAYOUTS)
def test_replay__several_buses__every_frame_and_sample_again(tmp_path, places):
    recording = run(configuration(places), tmp_path / "run.mcap")
    seen = {split_bus(frame.direction) for frame in recording.frames()}
    assert seen == {(bus, way) for bus in places for way in (RECEIVED, SENT)}
    result = replay(recording)
    assert result.difference is None
    assert result.cycles == len(recording.samples)
    assert result.frames_equal == result.frames_sent > len(places) * result.cycles


def test_replay__several_families_and_buses__every_frame_and_sample_again(tmp_path):
    config = configuration((1, 2, 2, 3), ("cia402", "odrive", "odrive", "moteus"))
    recording = run(config, tmp_path / "run.mcap")
    result = replay(recording)
    assert result.difference is None
    assert result.frames_equal == result.frames_sent


def test_replay__gain_of_a_joint_on_another_bus__difference_found(tmp_path):
    recording = run(configuration((1, 2, 1, 2)), tmp_path / "run.mcap")
    alpha = list(recording.config["controller"]["law"]["alpha"])
    alpha[3] *= 1.5
    result = replay(recording, {"controller": {"law": {"alpha": alpha}}})
    assert result.difference is not None
    assert result.frames_equal < result.frames_sent


def test_replay__configuration_with_fewer_buses__says_so(tmp_path):
    recording = run(configuration((1, 2)), tmp_path / "run.mcap")
    table = json.loads(json.dumps(recording.config))
    table["bus"]["more"] = []
    table["axes"][1]["bus"] = 1
    config = config_from_json(json.dumps(table))
    with pytest.raises(ReplayError, match="has frames of bus 2, the configuration has 1"):
        Replayer(recording, config).run()


def test_diff__several_buses__same_run_twice_identical_and_a_difference_says_the_bus(tmp_path):
    config = configuration((1, 2))
    a, b = run(config, tmp_path / "a.mcap"), run(config, tmp_path / "b.mcap")
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()
    assert first_parting(a, b, with_timing=True) == []
    other = configuration((1, 2), axes={"2": {"bus": 2, "node_id": 9}})
    c = run(other, tmp_path / "c.mcap")
    told = [difference.text() for difference in first_parting(a, c, with_timing=False)]
    assert any("on bus 2" in text for text in told)


def test_sim__wire_model_on_several_buses__refused(tmp_path):
    config = configuration((1, 2), emulator={"wire": {"is_on": True}})
    with pytest.raises(SimError, match="the wire model is of one bus"):
        run(config, tmp_path / "run.mcap")


# --- commands ---------------------------------------------------------------------------------


def test_command_sim__seven_joints_without_a_trajectory__swings_them(tmp_path):
    process = HilProcess(tmp_path, "sim", "--set", "arm.preset=chain_h:7", "--record", "a.mcap")
    assert process.wait(90) == 0, process.stderr
    assert "joint 7" in process.stdout
    recording = Recording.open(tmp_path / "a.mcap")
    assert recording.joints == 7
    tracked = recording.samples[recording.samples["t_ref_s"] > 5.0]
    assert len(tracked) > 1000
    error_rad = np.abs(tracked["q_true_rad"] - tracked["q_des_rad"]).max()
    assert error_rad < 0.1


def test_command_doctor__budget_of_each_bus(tmp_path):
    options = ["--set", "axes.2.bus=2", "--set", 'bus.more=["unix:/b"]']
    process = HilProcess(tmp_path, "doctor", "--bus", *options)
    assert process.wait(30) == 0, process.stderr
    assert process.stdout.count("a cycle needs") == 3  # of each, and of the fullest
    assert "unix:/b:\n" in process.stdout


def test_command_bus__number_that_is_not_there__one_line(tmp_path):
    process = HilProcess(tmp_path, "bus", "monitor", "--number", "2", "--for", "0.1")
    assert process.wait(30) == 1
    assert "--number 2: buses are numbered 1 to 1" in one_line(process)


def test_command_bus_dbc__second_bus__only_its_joints_under_their_numbers(tmp_path):
    options = ["--set", "axes.2.bus=2", "--set", 'bus.more=["unix:/b"]', "--number", "2"]
    process = HilProcess(tmp_path, "bus", "dbc", *options)
    assert process.wait(30) == 0, process.stderr
    assert "J2_" in process.stdout
    assert "J1_" not in process.stdout


def test_swing__any_arm__is_a_valid_request():
    for joints in (1, 7, 12):
        request = swing(load_config(None, {"arm": {"preset": f"chain_h:{joints}"}}))
        assert parse_trajectory(request.model_dump_json()) == request
