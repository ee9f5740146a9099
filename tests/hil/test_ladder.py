"""The overrun ladder, rung by rung: what delays reach it, which torque is sent, what is counted."""

import pytest

from controller.faults import FaultCode
from controller.machine import State
from drivers.cia402 import codec
from tests.hil.virtual import Rig

N_HOLD, N_DAMP = 5, 20
FEEDBACK_IDS = {codec.COB_TPDO1 + joint for joint in (1, 2)}
NONE = {"late": 0, "held": 0, "damped": 0, "given_up": 0}


class LateRig(Rig):
    """A rig on whose wire cyclic feedback takes its time.

    Attributes:
        delay_ns: From the request to the arrival of feedback.
    """

    delay_ns = 0

    def __init__(self, *assignments):
        self._on_the_way = []
        super().__init__(*assignments)

    def _from_drives(self, frame):
        can_id = codec_id(frame)
        if self.delay_ns and can_id in FEEDBACK_IDS:
            self._on_the_way.append((self.clock_ns + self.delay_ns, frame))
        else:
            super()._from_drives(frame)

    def _wait(self, timeout_s):
        """Time passes until the next frame that is on its way arrives, or to the end."""
        until_ns = self.clock_ns + round(timeout_s * 1e9)
        due = [at_ns for at_ns, _ in self._on_the_way if at_ns <= until_ns]
        if due:
            self.clock_ns = max(self.clock_ns, min(due))
            self.arrive()
        else:
            super()._wait(timeout_s)

    def arrive(self):
        """Deliver what has arrived by now."""
        here = [frame for at_ns, frame in self._on_the_way if at_ns <= self.clock_ns]
        self._on_the_way = [entry for entry in self._on_the_way if entry[0] > self.clock_ns]
        for frame in here:
            self.loopback.deliver(frame)

    def step(self, cycles=1):
        for _ in range(cycles):
            self.arrive()
            super().step()


def codec_id(frame):
    return int.from_bytes(frame[:4], "little") & 0x7FF


def moving():
    rig = LateRig()
    rig.swing()
    assert rig.control.ladder.counts() == NONE
    return rig


def counts(rig):
    return rig.control.ladder.counts()


def test_ladder__late_inside_the_cycle__data_used_and_counted():
    rig = moving()
    twin = Rig()
    twin.swing()
    rig.delay_ns = 450_000
    rig.step(50)
    twin.step(50)
    assert counts(rig) == {**NONE, "late": 50}
    assert rig.bus.age_cycles == 0
    assert rig.bus.late_frames == 0
    # the data are used as if they had come at once: the same torques to the bit
    assert rig.column("sent", 50).tolist() == twin.column("sent", 50).tolist()


def test_ladder__in_time__not_counted():
    rig = moving()
    rig.delay_ns = 250_000
    rig.step(50)
    assert counts(rig) == NONE


@pytest.mark.parametrize("delay_ns", [700_000, 900_000])
def test_ladder__feedback_after_its_deadline__never_poses_as_fresh(delay_ns):
    rig = moving()
    before = rig.control.tau_sent_Nm
    rig.delay_ns = delay_ns
    for _ in range(2):
        rig.step()
        assert rig.bus.age_cycles >= 1
        assert rig.control.tau_sent_Nm == before
    assert counts(rig)["held"] == 2
    assert rig.bus.late_frames > 0
    assert counts(rig)["late"] == 0


def test_ladder__delay_that_stays__held_then_damped_then_off_each_counted():
    rig = moving()
    before = rig.control.tau_sent_Nm
    rig.delay_ns = 700_000
    for cycle in range(1, N_HOLD + 1):
        rig.step()
        assert rig.control.tau_sent_Nm == before
        assert counts(rig) == {**NONE, "held": cycle}
    for cycle in range(1, N_DAMP + 1):
        rig.step()
        assert rig.control.tau_sent_Nm == pytest.approx([0.0, 0.0])  # both joints are silent
        assert rig.state is State.ACTIVE
        assert counts(rig) == {**NONE, "held": N_HOLD, "damped": cycle}
    rig.step()
    assert (rig.state, rig.fault) == (State.FAULT, FaultCode.FEEDBACK_LOST)
    assert rig.control.tau_sent_Nm == [0.0, 0.0]
    assert counts(rig) == {"late": 0, "held": N_HOLD, "damped": N_DAMP, "given_up": 1}
    rig.step(100)
    assert counts(rig) == {"late": 0, "held": N_HOLD, "damped": N_DAMP, "given_up": 1}


@pytest.mark.parametrize(("gap", "held", "damped"), [(1, 1, 0), (5, 5, 0), (6, 5, 1), (25, 5, 20)])
def test_ladder__delay_that_ends__back_on_the_first_rung(gap, held, damped):
    rig = moving()
    rig.delay_ns = 700_000
    rig.step(gap)
    rig.delay_ns = 0
    rig.step(60)
    assert rig.state is State.ACTIVE
    assert rig.bus.age_cycles == 0
    found = counts(rig)
    assert found["given_up"] == 0
    # the cycles in which the driver makes sure whose answer it hears come on top
    assert held <= found["held"] <= held + 3
    assert damped <= found["damped"] <= damped + 3


def test_ladder__without_power__nothing_counted():
    rig = LateRig()
    rig.step(10)
    rig.delay_ns = 700_000
    rig.step(60)
    assert rig.state is State.IDLE
    assert counts(rig) == NONE


@pytest.mark.parametrize("kind", ["slow", "delayed"])
def test_host_fault__of_the_emulator__torque_only_as_the_ladder_allows(kind):
    rig = Rig()
    rig.swing()
    start = len(rig.history)
    rig.control.inject_fault(0, "host", kind, 2.0)
    for _ in range(400):
        before = rig.control.tau_sent_Nm
        rung = counts(rig)
        rig.step()
        after = counts(rig)
        if after["held"] > rung["held"]:
            assert rig.control.tau_sent_Nm == before
        if after["given_up"] > rung["given_up"]:
            assert rig.fault is FaultCode.FEEDBACK_LOST
            assert rig.control.tau_sent_Nm == [0.0, 0.0]
    assert counts(rig)["held"] > 0
    if not rig.state.is_powered:
        assert rig.fault is not FaultCode.NONE
        assert not rig.column("sent")[-1].any()
    assert len(rig.history) == start + 400
