"""`hil sim` on the wire model: the same motion while all is in time, and what happens when not."""

import json

import numpy as np
import pytest

from controller.machine import State
from controller.reference import MotionLimits, MotionState
from drivers.frame import ERR_FLAG, unpack_frame
from hil.budget import bus_budget
from hil.experiment import Memory
from hil.messages import parse_trajectory
from hil.planner import plan
from hil.simulation import Simulation
from sim_backend.wire_bits import frame_bits
from tests.hil.virtual import configured

WIRE = "emulator.wire.is_on=true"
IN_TIME = {"t_ns", "feedback_ns", "law_ns", "sent_ns"}
"""Columns that tell the time; all others are the same with the wire model."""


class Notes(Memory):
    """Keeps frames and events too."""

    def __init__(self, joints):
        super().__init__(joints)
        self.frames = []
        self.events = []

    def add_event(self, t_ns, cycle, kind, detail="{}"):
        self.events.append((t_ns, cycle, kind, detail))

    def add_bus_log(self, t_ns, payload):
        self.frames.append((t_ns, payload))

    def of_kind(self, kind):
        return [detail for _, _, each, detail in self.events if each == kind]


def swing(*assignments, cycles=1200, disturb=None):
    """Enable, swing, and go on for some cycles, whatever happens; return simulation and notes."""
    config = configured(*assignments)
    notes = Notes(config.joints)
    simulation = Simulation(config, notes)
    simulation.execute("enable")
    simulation.run_until(State.READY, 1000)
    start = MotionState.at_rest(simulation.control.player.setpoint.q_rad)
    swing = {"kind": "sinusoid", "duration_s": 20.0, "ramp_s": 0.5, "frequency_Hz": [0.5, 0.5]}
    swing |= {"center_rad": list(start.q_rad), "amplitude_rad": [0.5, 0.4]}
    limits = MotionLimits.of(config.controller.limits, 120.0)
    simulation.play(plan(parse_trajectory(json.dumps(swing)), start, limits, 1e-3))
    for cycle in range(cycles):
        if disturb is not None:
            disturb(cycle, simulation)
        simulation.step()
    simulation.close()
    return simulation, notes


@pytest.fixture(scope="module")
def plain():
    return swing()


@pytest.fixture(scope="module")
def wired():
    return swing(WIRE)


def test_wired__everything_in_time__every_sample_as_without_the_wire(plain, wired):
    (_, without), (_, with_wire) = plain, wired
    before, after = without.samples(), with_wire.samples()
    assert len(before) == len(after)
    different = {n for n in before.dtype.names if not np.array_equal(before[n], after[n])}
    assert different == IN_TIME
    assert before["state"][-1] == State.ACTIVE


def test_wired__fd_frames_without_sync__every_sample_as_without_the_wire():
    families = ("axes.1.family=moteus", "axes.2.family=moteus")
    (_, without), (_, with_wire) = swing(*families, cycles=300), swing(*families, WIRE, cycles=300)
    before, after = without.samples(), with_wire.samples()
    different = {n for n in before.dtype.names if not np.array_equal(before[n], after[n])}
    assert different == IN_TIME
    assert before["state"][-1] == State.ACTIVE
    assert 0 < after["feedback_ns"].min() < after["feedback_ns"].max() < 500_000


def test_wired__same_run_again__same_bytes(wired):
    _, again = swing(WIRE)
    _, first = wired
    assert again._payloads == first._payloads
    assert again.frames == first.frames
    assert again.events == first.events


def test_wired__stamps__feedback_when_its_frames_have_arrived(wired):
    _, notes = wired
    feedback_us = notes.samples()["feedback_ns"] / 1000
    most_us = 55 + 2 * 135  # SYNC and both TPDOs at worst
    assert (feedback_us >= 47 + 2 * 111 - 3).all()
    assert (feedback_us <= most_us + 65).all()  # a heartbeat may be in the way


def test_wired__load__within_the_budget_and_above_the_bare_frames(wired):
    simulation, notes = wired
    budget = bus_budget(simulation.config)
    (load,) = notes.of_kind("bus_load")[-1:]
    assert 1e6 * budget.cyclic_s == pytest.approx(515)
    bare = (47 + 2 * (47 + 64) + 2 * (47 + 32)) / 1000
    assert bare < load["share"] < budget.mean_share
    assert load["share"] < budget.cyclic_s / budget.period_s  # stuffing is never all at its worst
    assert load["error_frames"] == 0
    assert load["wait_max_s"] < budget.peak_share * budget.period_s


def test_wired__off__no_word_of_it(plain):
    simulation, notes = plain
    assert simulation.wire is None
    assert notes.of_kind("bus_load") == []
    assert not notes.samples()["feedback_ns"].any()


def test_wired__feedback_later_than_its_deadline__is_late_in_every_cycle():
    settings = ("bus.bit_rate=500000", "loop.feedback_timeout_s=0.4e-3", WIRE)
    config = configured(*settings)
    notes = Notes(config.joints)
    simulation = Simulation(config, notes)
    for _ in range(50):
        simulation.step()
    samples = notes.samples()
    assert (samples["feedback_ns"] >= 400_000).all()
    assert (samples["feedback_age_cycles"] >= 1).all()
    late_frames = simulation.control._bus.late_frames
    assert 49 <= late_frames <= 100  # the second axis's always, the first one's hardly ever


def test_wired__slower_bus_with_a_later_deadline__feedback_is_there():
    settings = ("bus.bit_rate=500000", "loop.feedback_timeout_s=0.9e-3", WIRE)
    _, notes = swing(*settings, cycles=200)
    samples = notes.samples()
    assert samples["state"][-1] == State.ACTIVE
    assert samples["feedback_age_cycles"].max() == 0
    assert 490_000 < np.median(samples["feedback_ns"]) < 650_000


def test_wired__bit_errors__counted_reported_repeated_and_the_arm_goes_on():
    _, notes = swing(WIRE, "emulator.wire.bit_error_rate=1e-4", cycles=1500)
    samples = notes.samples()
    assert samples["state"][-1] == State.ACTIVE
    (load,) = notes.of_kind("bus_load")[-1:]
    assert load["error_frames"] > 10
    assert samples["fault"][-1] == 0


def test_wired__amplifier_goes_bus_off__trips_and_after_recovery_answers_again():
    def disturb(cycle, simulation):
        if cycle == 100:
            port = simulation.wire.ports[1]
            simulation.wire.model.force_bus_off(port.controller)

    simulation, notes = swing(WIRE, cycles=400, disturb=disturb)
    ages = notes.samples()["feedback_age_cycles"]
    assert ages[:100].max() == 0
    assert ages.max() >= 1
    assert ages[-1] == 0  # 1.4 ms later it is back
    assert not simulation.wire.ports[1].controller.is_bus_off


def test_wired__amplifier_stays_bus_off__feedback_lost():
    def disturb(cycle, simulation):
        if cycle == 100:
            port = simulation.wire.ports[1]
            simulation.wire.model.force_bus_off(port.controller)

    settings = (WIRE, "emulator.wire.is_recovering=false")
    _, notes = swing(*settings, cycles=400, disturb=disturb)
    (fault,) = notes.of_kind("fault")[:1]
    assert fault["code"] == "FEEDBACK_LOST"
    assert "joint 2" in fault["detail"]
    assert notes.samples()["state"][-1] in (State.FAULT, State.STOPPING)


def test_wired__host_bus_off__reported_as_error_frames_in_the_log():
    seen = []

    def disturb(cycle, simulation):
        if cycle == 0:
            log = simulation._log_frame
            simulation.control._bus.log_frames(lambda d, f: (seen.append(f), log(d, f)))
        if cycle == 100:
            simulation.wire.model.force_bus_off(simulation.wire.host)

    _, notes = swing(WIRE, cycles=300, disturb=disturb)
    reports = [unpack_frame(frame)[0] for frame in seen if unpack_frame(frame)[0] & ERR_FLAG]
    assert len(reports) == 2  # off, and on again
    assert notes.samples()["feedback_age_cycles"].max() >= 1
    assert all(frame_bits(frame) >= 47 for frame in seen)
