"""What a fault event says is JSON that every reader takes, whatever was measured."""

import json

import numpy as np
import pytest

from controller.faults import FaultCode
from controller.machine import State
from controller.reference import Reference
from hil.recording import Recording
from hil.simulation import Simulation, open_recording
from tests.hil.virtual import Rig, configured


def strict(text):
    """Parse JSON as RFC 8259 has it: NaN and Infinity are no numbers."""

    def refuse(name):
        raise AssertionError(f"{name} in {text}")

    return json.loads(text, parse_constant=refuse)


def broken_reference(start, bad):
    """A reference that stands still and is not a number for one cycle."""
    q = np.tile(np.array(start), (50, 1))
    q[20, 1] = bad
    return Reference(q, np.zeros_like(q), np.zeros_like(q), 1e-3)


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_fault_event__not_a_number__null_in_valid_json_and_a_word_for_it(bad):
    rig = Rig()
    rig.enable()
    rig.play(broken_reference(rig.control.player.setpoint.q_rad, bad))
    rig.step(21)
    assert rig.fault is FaultCode.NOT_FINITE
    fault = next(detail for kind, detail in rig.events if kind == "fault")
    assert strict(json.dumps(fault, allow_nan=False)) == fault
    assert (fault["joint"], fault["value"]) == (2, None)
    shown = "nan" if np.isnan(bad) else "inf"
    assert fault["detail"].startswith("joint 2: ")
    assert shown in fault["detail"]


def test_fault_event__limit_exceeded__value_and_limit_are_numbers():
    rig = Rig("controller.limits.following_error_rad=[0.5, 0.02]")
    rig.swing(1)
    rig.control.set_gain_bounds((0.1, 0.1), (0.1, 0.1))
    rig.run_until(State.FAULT, 3000)
    fault = next(detail for kind, detail in rig.events if kind == "fault")
    assert fault["code"] == "FOLLOWING_ERROR"
    assert abs(fault["value"]) > fault["limit"] == 0.02
    assert strict(json.dumps(fault, allow_nan=False)) == fault


def test_recording__fault_by_a_value_that_is_no_number__reads_back_strictly(tmp_path):
    path = tmp_path / "run.mcap"
    config = configured()
    with open_recording(config, path) as recording:
        simulation = Simulation(config, recording)
        simulation.execute("enable")
        simulation.run_until(State.READY, 100)
        start = simulation.control.player.setpoint.q_rad
        simulation.play(broken_reference(start, float("nan")))
        simulation.run(30)
        simulation.close()
    faults = [event.detail for event in Recording.open(path).events if event.kind == "fault"]
    assert len(faults) == 1
    assert faults[0]["value"] is None
    strict(json.dumps(faults[0], allow_nan=False))
