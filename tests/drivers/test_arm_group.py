"""One arm on several buses: one cycle, one deadline, and no bus is another's hostage."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.arm_bus import MARK, RECEIVED, SENT, ArmBus
from drivers.arm_group import ArmGroup, join_bus, make_arm, open_buses, split_bus
from drivers.axis import AxisStatus
from drivers.bus import BusStats
from drivers.errors import AmplifierError, BusDownError, BusError
from drivers.fault_frame import FaultKind, FaultOrder, FaultTarget, pack_fault
from drivers.frame import LOCKSTEP_ID, unpack_header
from drivers.settings import MOST_BUSES
from hil.emulation import build_emulator
from sim_backend.hub import UnixHub
from tests.drivers.group_rig import GroupRig, configuration

LAYOUTS = {
    "two buses": (1, 1, 2, 2),
    "interleaved": (2, 1, 2, 1, 1),
    "four buses": (1, 2, 3, 4),
    "twelve on four": (1, 1, 1, 2, 2, 2, 3, 3, 3, 4, 4, 4),
}


# --- the direction in a frame log -------------------------------------------------------------


@pytest.mark.parametrize("way", [RECEIVED, SENT, MARK])
def test_join_bus__first_bus__is_what_one_bus_logs(way):
    assert join_bus(1, way) == way


@given(bus=st.integers(1, MOST_BUSES), way=st.sampled_from([RECEIVED, SENT, MARK]))
def test_split_bus__any_bus_and_way__undoes_join(bus, way):
    assert split_bus(join_bus(bus, way)) == (bus, way)


def test_join_bus__all__are_different_and_fit_a_byte():
    codes = [join_bus(b, w) for b in range(1, MOST_BUSES + 1) for w in (RECEIVED, SENT, MARK)]
    assert len(set(codes)) == len(codes)
    assert all(0 <= code <= 255 for code in codes)


# --- a cycle ----------------------------------------------------------------------------------


def test_make_arm__one_bus__is_an_arm_bus_and_nothing_in_front():
    assert type(GroupRig((1, 1)).arm) is ArmBus


@pytest.mark.parametrize("places", LAYOUTS.values(), ids=LAYOUTS)
def test_cycle__any_layout__fresh_feedback_in_joint_order(places):
    rig = GroupRig(places)
    assert isinstance(rig.arm, ArmGroup)
    assert rig.cycle()
    truth = rig.emulator.q_true_rad
    resolution_rad = rig.infos[0].angle_resolution_rad
    for axis, q_rad in zip(rig.arm.axes, truth, strict=True):
        assert axis.q_rad == pytest.approx(q_rad, abs=resolution_rad)
    assert len({round(q, 2) for q in truth}) > 1  # or any order would do
    assert rig.arm.age_cycles == 0


@pytest.mark.parametrize("places", LAYOUTS.values(), ids=LAYOUTS)
def test_cycle__any_layout__time_advances_one_period(places):
    rig = GroupRig(places)
    before_ns = rig.emulator.time_ns
    rig.cycle(cycles=7)
    assert rig.emulator.time_ns == before_ns + 7_000_000


@pytest.mark.parametrize("places", LAYOUTS.values(), ids=LAYOUTS)
def test_send_torques__any_layout__each_torque_acts_on_its_joint(places):
    rig = GroupRig(places)
    rig.enable()
    peaks_Nm = [servo.torque_max_Nm for servo in rig.emulator._servos]
    wanted = [0.05 * (joint + 1) / len(places) * peak for joint, peak in enumerate(peaks_Nm)]
    rig.cycle(wanted, cycles=30)
    for applied_Nm, wanted_Nm in zip(rig.emulator.tau_applied_Nm, wanted, strict=True):
        assert applied_Nm == pytest.approx(wanted_Nm, rel=0.1)


def test_request_feedback__several_buses__every_bus_is_asked_before_any_is_waited_for():
    rig = GroupRig((1, 2, 3))
    rig.arm.request_feedback()
    assert [number for number, frame in rig.sent if unpack_header(frame)[0] == 0x80] == [1, 2, 3]


def test_cycle__buses_of_different_families__run_together():
    rig = GroupRig((1, 2, 2, 3), ("cia402", "odrive", "odrive", "moteus"))
    assert rig.cycle()
    ticks = {number for number, frame in rig.sent if unpack_header(frame)[0] == LOCKSTEP_ID}
    assert ticks == {2, 3}
    rig.enable()
    assert rig.arm.is_enabled


def test_axes__same_node_id_on_two_buses__are_told_apart():
    rig = GroupRig((1, 2))
    same = configuration((1, 2), axes={"1": {"node_id": 5}, "2": {"node_id": 5, "bus": 2}})
    assert [axis.node_id for axis in same.axes] == [5, 5]
    for axis in rig.arm.axes[:1]:
        axis.enable()
    rig.cycle(cycles=200)
    assert [axis.status for axis in rig.arm.axes] == [AxisStatus.ENABLED, AxisStatus.DISABLED]


def test_collect__one_bus_silent__only_its_axes_age():
    rig = GroupRig((1, 2, 1, 2))
    rig.cycle()
    rig.is_cut = {2}
    assert not rig.cycle()
    assert [axis.age_cycles for axis in rig.arm.axes] == [0, 1, 0, 1]
    assert rig.arm.age_cycles == 1
    assert [counts["age_cycles"] for counts in rig.arm.counts()] == [0, 1]


def test_collect__deadline_spent_on_the_first_bus__what_waits_on_the_second_is_fresh():
    rig = GroupRig((1, 2))
    rig.cycle()
    rig.is_cut = {1}
    rig.clock_ns += 1_000_000
    rig.arm.request_feedback()
    assert not rig.arm.collect(rig.clock_ns + 500_000)
    assert [axis.age_cycles for axis in rig.arm.axes] == [1, 0]


def test_configure__one_bus_by_the_clock__refused():
    rig = GroupRig((1, 2))
    transmits = [bus.deliver for bus in rig.loopbacks]
    by_clock = build_emulator(rig.config, transmits, is_lockstep=False)
    by_clock.power_on()
    rig.loopbacks[1].connect(
        lambda frame: by_clock.receive(frame, 1),
        lambda timeout_s: by_clock.advance(round(timeout_s * 1e9)),
    )
    now = iter(range(0, 10**12, 100_000))
    arm = make_arm(rig.loopbacks, rig.config.axes, period_s=1e-3, now_ns=lambda: next(now))
    with pytest.raises(AmplifierError, match="some buses run in lockstep and some by the clock"):
        arm.configure(heartbeat_cycles=[0, 0])


# --- failing buses ----------------------------------------------------------------------------


class Breaking:
    """Makes one bus raise."""

    def __init__(self, bus, error):
        self.bus, self.error = bus, error
        bus.send = self.send

    def send(self, frame):
        raise self.error


@pytest.mark.parametrize("number", [1, 2, 3])
@pytest.mark.parametrize("error", [BusError("gone"), BusDownError("down")])
def test_cycle__one_bus_fails__the_others_get_their_commands_then_it_is_raised(number, error):
    rig = GroupRig((1, 2, 3))
    rig.enable()
    for axis in rig.arm.axes:
        axis.disable()
    Breaking(rig.loopbacks[number - 1], error)
    with pytest.raises(type(error), match=str(error)):
        rig.cycle()
    with pytest.raises(type(error)):  # the SYNC by which the command takes effect
        rig.cycle()
    powered = [servo.is_energised for servo in rig.emulator._servos]
    assert powered == [joint == number for joint in (1, 2, 3)]


def test_cycle__one_down_and_one_gone__gone_is_raised():
    rig = GroupRig((1, 2))
    Breaking(rig.loopbacks[0], BusDownError("down"))
    Breaking(rig.loopbacks[1], BusError("gone"))
    with pytest.raises(BusError, match="gone"):
        rig.cycle()


def test_cycle__bus_that_was_down_is_back__goes_on():
    rig = GroupRig((1, 2))
    broken = Breaking(rig.loopbacks[1], BusDownError("down"))
    with pytest.raises(BusDownError):
        rig.cycle()
    del broken.bus.send
    assert rig.cycle(cycles=3)


def test_open_buses__one_is_not_there__none_stays_open(tmp_path):
    with UnixHub(str(tmp_path / "a")) as hub:
        with pytest.raises(BusError, match="no bus at"):
            open_buses([f"unix:{tmp_path}/a", f"unix:{tmp_path}/b"])
        hub.wait(0.0)
        hub.wait(0.0)
        assert hub.clients == []


# --- counters and faults ----------------------------------------------------------------------


def test_stats__several_buses__are_the_sums():
    rig = GroupRig((1, 2, 2))
    rig.cycle(cycles=5)
    total = rig.arm.stats
    assert isinstance(total, BusStats)
    parts = [bus.stats for bus in rig.loopbacks]
    assert total.frames_sent == sum(part.frames_sent for part in parts) > 0
    assert total.frames_received == sum(part.frames_received for part in parts) > 0
    assert [c["frames_sent"] for c in rig.arm.counts()] == [part.frames_sent for part in parts]


def test_log_frames__several_buses__each_frame_says_its_bus():
    rig = GroupRig((1, 2, 3), ("cia402", "cia402", "odrive"))
    seen = []
    rig.arm.log_frames(lambda way, frame: seen.append((*split_bus(way), frame)))
    rig.cycle()
    sent = [(bus, frame) for bus, way, frame in seen if way == SENT]
    assert sent == rig.sent
    assert {bus for bus, way, _ in seen if way == RECEIVED} == {1, 2, 3}
    rig.arm.log_frames(None)
    seen.clear()
    rig.cycle()
    assert seen == []


def test_send_fault__joint_on_another_bus__hits_that_joint():
    rig = GroupRig((1, 2, 2))
    rig.enable()
    assert rig.arm.send_fault(pack_fault(FaultOrder(FaultTarget.AMPLIFIER, FaultKind.OFF, 3)))
    rig.cycle(cycles=5)
    broken = rig.arm.first_in(AxisStatus.FAULT)
    assert broken is rig.arm.axes[2]


@pytest.mark.parametrize("kind", [FaultKind.OFF, FaultKind.STUCK, FaultKind.DELAYED])
def test_bus_fault__several_buses__acts_on_all_and_time_goes_on(kind):
    rig = GroupRig((1, 2, 2))
    rig.enable()
    before_ns = rig.emulator.time_ns
    assert rig.arm.send_fault(pack_fault(FaultOrder(FaultTarget.BUS, kind, 0, 30)))
    assert not rig.cycle(cycles=10)
    assert all(axis.age_cycles for axis in rig.arm.axes)
    rig.cycle(cycles=300)
    assert rig.cycle()
    assert rig.emulator.time_ns == before_ns + 311_000_000


def test_inject_fault__joint__goes_out_on_its_bus():
    rig = GroupRig((1, 2), ("odrive", "odrive"))
    assert rig.arm.inject_fault(1)
    rig.cycle()
    before = len(rig.sent)
    plain = GroupRig((1, 2), ("odrive", "odrive"))
    plain.cycle()
    assert before == len(plain.sent) + 1
    assert [n for n, _ in rig.sent].count(2) == [n for n, _ in plain.sent].count(2) + 1


def test_configure__a_bus_without_its_amplifier__says_which_joint():
    rig = GroupRig((1, 2))
    rig.is_cut = {2}
    arm = make_arm(rig.loopbacks, rig.config.axes, period_s=1e-3, now_ns=lambda: rig.clock_ns)
    with pytest.raises(AmplifierError, match="joint 2"):
        arm.configure(heartbeat_cycles=[0, 0])
