"""One CiA 402 axis, master side, against the emulated drive: power, torque, angle, faults, loss."""

import math
import random
import re
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.axis import AxisStatus
from drivers.cia402 import codec
from drivers.cia402.codec import Cia402State, NmtCommand
from drivers.cia402.master import RESET_CYCLES, Cia402Axis
from drivers.cia402.sdo import SdoKind, parse_sdo_request, sdo_download_response
from drivers.cia402.settings import Cia402Settings
from drivers.errors import AmplifierError
from drivers.frame import pack_frame, unpack_frame
from sim_backend.cia402.dictionary import key_of
from tests.drivers.cia402_rig import SETTINGS, T_NS, Rig, T, ask_for, drive_for, without

ONE = SETTINGS[0]
LABEL = r"joint 1 \(cia402 node 1\)"
COUNT_RAD = math.tau / 4096
TPDO, RPDO, SDO_IN, HEARTBEAT = 0x181, 0x201, 0x601, 0x701
SUPPORTED_MODES = key_of(0x6502, 0)


def rig_of(axis=ONE, drive=None):
    """One axis on a wire; the drive fits it unless given."""
    return Rig([axis], [drive or drive_for(ONE)])


def refused(rig, message):
    """Start-up ends with one line, and no torque was commanded."""
    with pytest.raises(AmplifierError, match=message) as caught:
        rig.configure()
    assert "\n" not in str(caught.value)
    assert not rig.commands(1)
    assert not rig.servos[0].is_energised


# --- start-up that must not succeed -----------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rated_torque_Nm": 4.0, "torque_max_Nm": 12.0},
         f"{LABEL}: rated torque 6076 .* is 5000, .* says 4000; correct rated_torque_Nm"),
        ({"counts_per_turn": 8192},
         f"{LABEL}: encoder resolution 608F .* is 4096, .* says 8192; correct counts_per_turn"),
    ],
    ids=["rated torque", "encoder resolution"],
)  # fmt: skip
def test_configure__scale_contradicts_the_drive__both_values_and_the_setting_named(change, message):
    refused(rig_of(ask_for(ONE, **change)), message)


@pytest.mark.parametrize("peak_Nm", [163.9, 400.0, 1e6, 0.002])
def test_configure__torque_limit_no_drive_can_hold__refused_with_the_range(peak_Nm):
    """6071 is a signed 16-bit per mille of the rated torque: 32.767 times it at the most."""
    rig = rig_of(ask_for(ONE, torque_max_Nm=peak_Nm))
    refused(rig, f"{LABEL}: torque_max_Nm {re.escape(f'{peak_Nm:g}')} is outside 0.005 to 163.8")


def test_configure__smallest_torque_limit_that_fits__accepted():
    rig = rig_of(ask_for(ONE, torque_max_Nm=0.005)).enable()
    rig.cycles(2, 1e9)
    assert rig.commands(1)[-1] == (codec.CONTROL_ENABLE_OPERATION, 1)


def test_configure__largest_torque_limit_that_fits__accepted_and_clipped_to():
    rig = rig_of(ask_for(ONE, torque_max_Nm=5.0 * 32.767)).enable()
    rig.cycles(2, 1e9)
    assert rig.commands(1)[-1] == (codec.CONTROL_ENABLE_OPERATION, 32767)


@pytest.mark.parametrize(
    ("rated_Nm", "limit_Nm", "per_mille"),
    [(2.667, 8.0, 2999), (2.5, 8.0, 3200), (5.0, 15.0, 3000), (0.1, 0.3, 3000),
     (2.6666, 8.0, 2999), (2.5, 8.0024999, 3200)],
)  # fmt: skip
def test_torque_limit__between_two_per_mille__the_lower_one(rated_Nm, limit_Nm, per_mille):
    """6072 and the largest target stay within torque_max_Nm: 3000 of 2.667 Nm are 8.001 Nm."""
    axis = ask_for(ONE, rated_torque_Nm=rated_Nm, torque_max_Nm=limit_Nm)
    rig = rig_of(axis, drive_for(axis)).enable()
    rig.cycles(3, 1e9)
    assert rig.read(rig.nodes[0], 0x6072) == per_mille
    assert rig.commands(1)[-1] == (codec.CONTROL_ENABLE_OPERATION, per_mille)
    assert rig.servos[0].torque_target_Nm <= limit_Nm * (1 + 1e-9)
    rig.cycles(3, -1e9)
    assert rig.commands(1)[-1] == (codec.CONTROL_ENABLE_OPERATION, -per_mille)
    assert rig.servos[0].torque_target_Nm >= -limit_Nm * (1 + 1e-9)


def test_configure__drive_clips_the_torque_limit__refused():
    rig = rig_of()
    rig.to_drives = replacing(0x6072, codec.U16.pack(2000))
    refused(rig, "torque limit 6072 .* is 2000, .* says 3000")


def replacing(index, value):
    """A way on which writes to one object arrive with another value."""

    def changed(frame):
        can_id, data = unpack_frame(frame)
        request = parse_sdo_request(data) if can_id == SDO_IN else None
        if request is None or (request.kind, request.index) != (SdoKind.DOWNLOAD, index):
            return [frame]
        return [pack_frame(can_id, data[:4] + value.ljust(4, b"\0"))]

    return changed


def test_configure__drive_without_torque_mode__refused():
    rig = rig_of()
    rig.nodes[0].dictionary.values[SUPPORTED_MODES] = 1 << 7  # position only
    refused(rig, f"{LABEL}: does not offer cyclic synchronous torque")


def test_configure__drive_stays_in_another_mode__refused():
    """A drive that acknowledges 6060 without following it must never be enabled."""
    rig = rig_of()

    def swallow(frame):
        can_id, data = unpack_frame(frame)
        if can_id == SDO_IN and data[:3] == b"\x2f\x60\x60":
            rig.loopback.deliver(pack_frame(0x581, sdo_download_response(0x6060, 0)))
            return []
        return [frame]

    rig.to_drives = swallow
    refused(rig, f"{LABEL}: mode of operation 6061 is 0, .* 10")


def test_configure__nobody_there__refused_with_the_remedy():
    rig = rig_of()
    rig.to_drives = lambda _: []
    refused(rig, f"{LABEL}: no SDO answer .* 0.5 s; check power, node-ID and bit rate")
    assert rig.clock_ns == pytest.approx(520_000_000)


def test_configure__no_boot_up_after_the_reset__refused():
    rig = rig_of()
    rig.to_drives = without(codec.COB_NMT)
    refused(rig, f"{LABEL}: no boot-up message")


def test_configure__heartbeat_instead_of_boot_up__is_not_taken_for_it():
    """A drive that ignores the reset goes on sending its heartbeat: it has not restarted."""
    rig = rig_of()
    rig.to_drives = without(codec.COB_NMT)
    rig.on_wait = lambda: rig.loopback.deliver(pack_frame(HEARTBEAT, b"\x7f"))
    refused(rig, f"{LABEL}: no boot-up message")


def test_configure__heartbeat_just_before_boot_up__waits_for_the_boot_up():
    rig = rig_of()

    def heartbeat_first(frame):
        is_boot_up = unpack_frame(frame) == (HEARTBEAT, b"\0")
        return [pack_frame(HEARTBEAT, b"\x05"), frame] if is_boot_up else [frame]

    rig.to_master = heartbeat_first
    assert rig.configure()[0].name == "hil emulated drive"


def test_configure__enabled_by_another_master__refused_before_anything_is_changed():
    rig = rig_of(ask_for(ONE, rpdo_timeout_ms=500)).enable()
    rig.log.clear()
    rig.bus = rig.new_master()
    with pytest.raises(AmplifierError, match=f"{LABEL}: is already enabled .*1237.*disable it"):
        rig.configure()
    sent = [entry for entry in rig.log if entry[0] == 1]
    assert [(can_id, data[:4]) for _, can_id, data in sent] == [(SDO_IN, b"\x40\x41\x60\0")]
    assert rig.servos[0].is_energised  # as it was found


def test_configure__a_drive_in_fault__starts_up_and_shows_it():
    rig = rig_of()
    rig.nodes[0].drive.fail(0x5001)
    rig.configure()
    rig.cycles(2)
    assert rig.all_are("FAULT")
    rig.axes[0].reset_fault()
    rig.until(lambda: rig.all_are("DISABLED"))
    rig.enable()


@pytest.mark.parametrize("index", [0x6060, 0x60C2, 0x6072, 0x1016, 0x1400, 0x1600, 0x1A00, 0x1801])
def test_configure__a_setting_refused_by_the_drive__object_and_reason_named(index):
    rig = rig_of()

    def three_bytes(frame):
        """No object has 3 bytes: the drive aborts with 0607 00xx, wrong length."""
        can_id, data = unpack_frame(frame)
        is_write = can_id == SDO_IN and data[0] >> 5 == 1 and data[1:3] == struct.pack("<H", index)
        return [pack_frame(can_id, b"\x27" + data[1:])] if is_write else [frame]

    rig.to_drives = three_bytes
    refused(rig, f"{LABEL}: object {index:04X}:0. refused: 060700")


@pytest.mark.parametrize("missing", [0x1008, 0x1018, 0x607B])
def test_configure__optional_object_missing__goes_on_without(missing):
    rig = rig_of()

    def elsewhere(frame):
        can_id, data = unpack_frame(frame)
        is_asked = can_id == SDO_IN and data[:3] == b"\x40" + missing.to_bytes(2, "little")
        return [pack_frame(can_id, b"\x40\x00\x20\x00" + data[4:])] if is_asked else [frame]

    def named(frame):
        can_id, data = unpack_frame(frame)
        if can_id == 0x581 and data[0] == 0x80:  # the abort is for the object that was asked for
            return [pack_frame(can_id, data[:1] + missing.to_bytes(2, "little") + data[3:])]
        return [frame]

    rig.to_drives, rig.to_master = elsewhere, named
    (info,) = rig.configure()
    assert info.name == ("unnamed" if missing == 0x1008 else "hil emulated drive")
    assert info.is_lockstep == (missing != 0x1018)


def test_configure__somebody_elses_drive__is_not_asked_for_the_time_base():
    rig = rig_of()
    rig.to_master = lambda frame: (
        [pack_frame(0x581, b"\x43\x18\x10\x02\x34\x12\0\0")]
        if unpack_frame(frame)[1][:4] == b"\x43\x18\x10\x02"
        else [frame]
    )
    assert not rig.configure()[0].is_lockstep
    assert not any(data[1:3] == b"\x00\x2f" for data in rig.sent(SDO_IN))


# --- power ------------------------------------------------------------------------------------


def test_enable__step_by_step__06_07_0f_each_after_the_state_it_needs():
    rig = rig_of()
    rig.configure()
    rig.cycles(2)
    rig.axes[0].enable()
    rig.cycles(5)
    words = [word for word, _ in rig.commands(1)]
    assert words == [0x00, 0x00, 0x06, 0x07, 0x0F, 0x0F, 0x0F]
    states = [codec.TPDO1.unpack(data)[0] & 0x6F for data in rig.received(TPDO)]
    assert states == [0x40, 0x40, 0x40, 0x21, 0x23, 0x27, 0x27]
    assert rig.servos[0].is_energised


def test_enable__until_power_is_reported__no_torque_is_commanded():
    rig = rig_of()
    rig.configure()
    rig.axes[0].enable()
    rig.until(lambda: rig.cycle(3.0) and rig.bus.is_enabled)
    assert [torque for _, torque in rig.commands(1)][:-1] == [0] * (len(rig.commands(1)) - 1)
    assert rig.commands(1)[-1] == (0x0F, 600)


def test_disable__while_enabled__torque_off_with_the_next_frame():
    rig = rig_of().enable()
    rig.cycles(3, 2.0)
    rig.axes[0].disable()
    rig.cycle(2.0)
    assert rig.commands(1)[-1] == (codec.CONTROL_DISABLE_VOLTAGE, 0)
    assert rig.servos[0].is_energised  # until the next SYNC
    rig.cycle(2.0)
    assert not rig.servos[0].is_energised
    assert rig.all_are("DISABLED")


def test_disable__while_enabling__no_power():
    rig = rig_of()
    rig.configure()
    rig.cycles(2)
    rig.axes[0].enable()
    rig.cycles(2)
    rig.axes[0].disable()
    rig.cycles(20)
    assert 0x0F not in [word for word, _ in rig.commands(1)]
    assert rig.nodes[0].drive.machine.state is Cia402State.SWITCH_ON_DISABLED


def test_disable__sync_lost_while_commands_arrive__stopped_by_network_management():
    """Without SYNC no RPDO takes effect, and none is missing: only NMT reaches the drive."""
    drive = drive_for(ONE)
    rig = Rig([ONE], [drive], are_lockstep=(False,)).enable()
    rig.cycles(5, 2.0)
    rig.to_drives = without(0x080)

    def cycles(count):
        for _ in range(count):
            rig.cycle(2.0, between=lambda: rig.emulator.advance(T_NS))

    cycles(100)
    assert rig.servos[0].torque_target_Nm == pytest.approx(2.0)  # its own deadline sees nothing
    rig.axes[0].disable()
    cycles(2)
    assert rig.sent(codec.COB_NMT)[-1] == codec.pack_nmt(NmtCommand.START, 1)
    cycles(2)
    assert rig.sent(codec.COB_NMT)[-1] == codec.pack_nmt(NmtCommand.ENTER_PRE_OPERATIONAL, 1)
    assert not rig.servos[0].is_energised
    assert rig.servos[0].torque_target_Nm == 0.0
    rig.to_drives = lambda frame: [frame]
    cycles(5)
    assert not rig.servos[0].is_energised
    rig.axes[0].reset_fault()
    cycles(RESET_CYCLES + 5)
    assert rig.sent(codec.COB_NMT)[-1] == codec.pack_nmt(NmtCommand.START, 1)
    assert rig.all_are("DISABLED")
    rig.axes[0].enable()
    cycles(10)
    assert rig.all_are("ENABLED")
    assert rig.servos[0].torque_target_Nm == pytest.approx(2.0)


def test_disable__no_feedback_at_all__stops_come_now_and_then_only():
    rig = rig_of().enable()
    rig.to_master = lambda _: []
    rig.axes[0].disable()
    before = len(rig.sent(codec.COB_NMT))
    rig.cycles(200)
    assert len(rig.sent(codec.COB_NMT)) - before == 4


def test_disable__heard__nothing_but_rpdos():
    rig = rig_of().enable()
    before = len(rig.sent(codec.COB_NMT))
    rig.axes[0].disable()
    rig.cycles(200)
    assert len(rig.sent(codec.COB_NMT)) == before


def test_enable__after_disable__has_power_again():
    rig = rig_of().enable()
    rig.axes[0].disable()
    rig.cycles(5)
    rig.enable()
    assert rig.all_are("ENABLED")


@pytest.mark.parametrize("drop", ["disable_voltage", "quick_stop"])
def test_drive_drops_out_by_itself__never_enabled_again_without_being_asked(drop):
    rig = rig_of().enable()
    rig.log.clear()
    getattr(rig.nodes[0].drive, drop)()
    rig.cycles(50, 1.0)
    assert rig.all_are("DISABLED")
    assert {word for word, _ in rig.commands(1)[1:]} == {codec.CONTROL_DISABLE_VOLTAGE}
    assert {torque for _, torque in rig.commands(1)[1:]} == {0}
    rig.enable()


def test_fault_reset_by_somebody_else__not_enabled_again_without_being_asked():
    rig = rig_of().enable()
    rig.bus.inject_fault(0)
    rig.until(lambda: rig.all_are("FAULT"))
    rig.nodes[0].drive.control(codec.CONTROL_FAULT_RESET)
    rig.log.clear()
    rig.cycles(50, 1.0)
    assert set(rig.commands(1)) == {(codec.CONTROL_DISABLE_VOLTAGE, 0)}
    assert rig.all_are("DISABLED")


# --- torque -----------------------------------------------------------------------------------


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize(
    ("torque_Nm", "per_mille"),
    [(0.0, 0), (1.0, 200), (-1.0, -200), (0.0024, 0), (0.0026, 1), (15.0, 3000), (15.1, 3000),
     (-99.0, -3000), (1e300, 3000)],
)  # fmt: skip
def test_command__torque__per_mille_of_the_rated_clipped_and_turned(
    torque_Nm, per_mille, direction
):
    rig = rig_of(ask_for(ONE, direction=direction)).enable()
    rig.cycle(torque_Nm)
    rig.cycle(torque_Nm)
    assert rig.commands(1)[-1][1] == direction * per_mille
    assert rig.servos[0].torque_target_Nm == pytest.approx(direction * per_mille * 5e-3)


@pytest.mark.parametrize("direction", [1, -1])
def test_feedback__torque__in_joint_terms(direction):
    rig = rig_of(ask_for(ONE, direction=direction)).enable()
    rig.cycles(40, 2.0)
    assert rig.axes[0].tau_meas_Nm == pytest.approx(2.0, abs=0.1)


def test_command__frame__is_rpdo1_with_four_bytes():
    rig = rig_of()
    rig.configure()
    axis = rig.axes[0]
    can_id, data = unpack_frame(axis.command(0.0))
    assert (can_id, data) == (RPDO, bytes(4))


# --- angle ------------------------------------------------------------------------------------


def turned(rig, angles_rad):
    """Hold the encoder at each angle for one SYNC; return what the axis made of it."""
    found = []
    for angle in angles_rad:
        rig.servos[0].sense(angle, 0.0)
        assert rig.cycle()
        found.append(rig.axes[0].q_rad)
    return found


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("way", [1, -1])
@pytest.mark.parametrize("offset_rad", [0.0, 0.7, -2.9])
def test_angle__several_turns__followed_across_the_wrap(way, direction, offset_rad):
    rig = rig_of(ask_for(ONE, direction=direction, offset_rad=offset_rad))
    rig.configure()
    angles = [way * 0.37 * k for k in range(80)]  # almost five turns
    found = turned(rig, angles)
    wanted = [direction * angle + offset_rad for angle in angles]
    assert found == pytest.approx(wanted, abs=0.51 * COUNT_RAD)
    there_and_back = turned(rig, reversed(angles))
    assert there_and_back == pytest.approx(wanted[::-1], abs=0.51 * COUNT_RAD)


@pytest.mark.parametrize("step", [2047, -2047])
def test_angle__step_of_almost_half_a_turn__taken_the_short_way(step):
    rig = rig_of()
    rig.configure()
    found = turned(rig, [0.0, step * COUNT_RAD])
    assert found[1] == pytest.approx(step * COUNT_RAD)


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("offset_rad", [0.0, 1.0, 3.0, -3.0, 9.0])
@pytest.mark.parametrize("start_rad", [0.0, 0.01, -0.01, 2.0, -2.0, 3.1, -3.1, 6.2])
def test_angle__at_start_up__within_half_a_turn_of_zero_on_the_right_spoke(
    start_rad, offset_rad, direction
):
    rig = rig_of(ask_for(ONE, direction=direction, offset_rad=offset_rad))
    rig.configure()
    (found,) = turned(rig, [start_rad])
    turns = (found - (direction * start_rad + offset_rad)) / math.tau
    assert turns == pytest.approx(round(turns), abs=0.51 / 4096)
    assert abs(found) <= math.pi + COUNT_RAD


@settings(max_examples=30, deadline=None)
@given(
    steps=st.lists(st.floats(-3.1, 3.1), min_size=1, max_size=20),
    direction=st.sampled_from([1, -1]),
    offset_counts=st.integers(0, 4095),
)
def test_angle__any_walk__equals_the_true_angle(steps, direction, offset_counts):
    rig = rig_of(ask_for(ONE, direction=direction))
    servo = rig.servos[0]
    servo.settings = servo.settings.model_copy(update={"encoder_offset_counts": offset_counts})
    rig.configure()
    (start,) = turned(rig, [0.0])
    angle = 0.0
    for step in steps:
        angle += step
        (found,) = turned(rig, [angle])
        assert found - start == pytest.approx(direction * angle, abs=1.01 * COUNT_RAD)


def test_angle__drive_that_counts_on_over_turns__followed_past_32_bits():
    """607B absent: the position is a 32-bit count; it wraps at 2**31 counts, not at a turn."""
    axis = Cia402Axis(ONE, joint=1, period_s=T)
    axis.configure(AnsweringPort(without_range=True))
    take = axis.handlers()[TPDO]
    base = 2**31 - 3000
    take(tpdo(position=base))
    start = axis.q_rad
    for k in range(1, 12):
        position = (base + 1500 * k + 2**31) % 2**32 - 2**31
        take(tpdo(position=position))
        assert axis.q_rad - start == pytest.approx(1500 * k * COUNT_RAD)


class AnsweringPort:
    """A drive of another make, as frames: answers each SDO as CiA 301 says, and boots on reset."""

    def __init__(self, *, without_range):
        self.values = {
            (0x6041, 0): b"\x50\x02",
            (0x6061, 0): b"\x0a",
            (0x6502, 0): codec.U32.pack(1 << 9),
            (0x6076, 0): codec.U32.pack(5000),
            (0x608F, 1): codec.U32.pack(8192),
            (0x608F, 2): codec.U32.pack(2),
            (0x6072, 0): codec.U16.pack(3000),
        }
        if not without_range:
            self.values |= {(0x607B, 1): codec.I32.pack(-4096), (0x607B, 2): codec.I32.pack(4095)}
        self.answers = []

    def send(self, can_id, data):
        if can_id == codec.COB_NMT:
            self.answers.append((HEARTBEAT, b"\0"))
            return
        index, sub = struct.unpack_from("<HB", data, 1)
        if data[0] >> 5 == 1:
            answer = b"\x60" + data[1:4] + bytes(4)
        elif (value := self.values.get((index, sub))) is None:
            answer = b"\x80" + data[1:4] + codec.U32.pack(0x0602_0000)
        else:
            command = 0x43 | 4 - len(value) << 2
            answer = bytes((command,)) + data[1:4] + value.ljust(4, b"\0")
        self.answers.append((0x581, answer))

    def wait(self, can_id, timeout_s):
        del timeout_s
        while self.answers:
            answered_id, data = self.answers.pop(0)
            if answered_id == can_id:
                return data
        return None


def tpdo(statusword=0x0250, position=0, torque=0):
    return pack_frame(TPDO, codec.TPDO1.pack(statusword, position, torque))


def test_angle__position_range_of_two_turns__wraps_there():
    axis = Cia402Axis(ONE, joint=1, period_s=T)
    axis.configure(AnsweringPort(without_range=False))
    take = axis.handlers()[TPDO]
    take(tpdo(position=4000))
    start = axis.q_rad
    take(tpdo(position=-4000))
    assert axis.q_rad - start == pytest.approx(192 * COUNT_RAD)


# --- faults -----------------------------------------------------------------------------------


def test_fault__reported__status_note_and_no_more_torque():
    rig = rig_of().enable()
    rig.bus.inject_fault(0)
    rig.until(lambda: rig.all_are("FAULT"))
    assert rig.axes[0].note == "joint 1 (cia402 node 1): EMCY 5001, error register 81"
    rig.log.clear()
    rig.cycles(5, 3.0)
    assert {torque for _, torque in rig.commands(1)} == {0}
    assert codec.CONTROL_ENABLE_OPERATION not in {word for word, _ in rig.commands(1)}


def test_fault__without_emergency_message__note_says_drive_fault():
    rig = rig_of().enable()
    rig.to_master = without(0x081)
    rig.bus.inject_fault(0)
    rig.until(lambda: rig.all_are("FAULT"))
    assert "drive fault (statusword" in rig.axes[0].note


def test_fault__enabled_without_reset__stays_in_fault():
    rig = rig_of().enable()
    rig.bus.inject_fault(0)
    rig.until(lambda: rig.all_are("FAULT"))
    rig.axes[0].enable()
    rig.cycles(30)
    assert rig.all_are("FAULT")
    assert not rig.servos[0].is_energised


def test_reset_fault__drive_in_fault__disabled_then_enabled_only_when_asked():
    rig = rig_of().enable()
    rig.bus.inject_fault(0)
    rig.until(lambda: rig.all_are("FAULT"))
    rig.log.clear()
    rig.axes[0].reset_fault()
    rig.cycles(3 * RESET_CYCLES, 1.0)
    words = [word for word, _ in rig.commands(1)]
    assert words[0] == codec.CONTROL_DISABLE_VOLTAGE
    assert words[1] == codec.CONTROL_FAULT_RESET  # the rising edge of bit 7
    assert words[-1] == codec.CONTROL_DISABLE_VOLTAGE
    assert rig.all_are("DISABLED")
    assert rig.axes[0].note == ""
    assert rig.nodes[0].drive.machine.state is Cia402State.SWITCH_ON_DISABLED
    assert not rig.servos[0].is_energised
    rig.enable()
    assert rig.all_are("ENABLED")


def test_reset_fault__again_after_another_fault__works_every_time():
    rig = rig_of().enable()
    for _ in range(3):
        rig.bus.inject_fault(0)
        rig.until(lambda: rig.all_are("FAULT"))
        rig.axes[0].reset_fault()
        rig.cycles(2 * RESET_CYCLES)
        rig.enable()


def test_reset_fault__cause_persists__fault_again_once_the_attempt_is_over():
    rig = rig_of().enable()
    rig.bus.inject_fault(0)
    rig.until(lambda: rig.all_are("FAULT"))
    rig.to_drives = without(RPDO)
    rig.axes[0].reset_fault()
    rig.cycles(RESET_CYCLES + 3)
    assert rig.all_are("FAULT")


def test_reset_fault__while_enabling_was_asked_for__does_not_enable():
    rig = rig_of().enable()
    rig.bus.inject_fault(0)
    rig.until(lambda: rig.all_are("FAULT"))
    rig.axes[0].enable()
    rig.axes[0].reset_fault()
    rig.cycles(5 * RESET_CYCLES)
    assert rig.all_are("DISABLED")


def test_emergency__warning_only__noted_without_a_change_of_status():
    rig = rig_of().enable()
    rig.loopback.deliver(pack_frame(0x081, codec.pack_emcy(0x4210, 0x09)))
    rig.cycle()
    assert rig.axes[0].note == "joint 1 (cia402 node 1): EMCY 4210, error register 09"
    assert rig.all_are("ENABLED")


def test_emergency__error_reset_or_malformed__noted_not():
    rig = rig_of().enable()
    for data in (bytes(8), b"\x10\x42\x09", b""):
        rig.loopback.deliver(pack_frame(0x081, data))
    rig.cycle()
    assert rig.axes[0].note == ""


# --- loss -------------------------------------------------------------------------------------


def test_heartbeat__missing_for_three_periods__lost():
    rig = rig_of().enable()
    rig.until(lambda: rig.received(HEARTBEAT)[-1:] == [b"\x05"])
    rig.to_master = without(HEARTBEAT)
    heard = len(rig.received(HEARTBEAT))
    taken = rig.until(lambda: rig.all_are("LOST"))
    assert 200 <= taken <= 301
    assert len(rig.received(HEARTBEAT)) == heard
    assert "no heartbeat for 301 cycles" in rig.axes[0].note
    rig.cycles(3, 2.0)
    assert rig.commands(1)[-1] == (codec.CONTROL_DISABLE_VOLTAGE, 0)


def test_heartbeat__regular__never_lost():
    rig = rig_of().enable()
    rig.cycles(1000)
    assert rig.all_are("ENABLED")


def test_heartbeat__back_after_loss__disabled_until_asked():
    rig = rig_of().enable()
    rig.to_master = without(HEARTBEAT)
    rig.until(lambda: rig.all_are("LOST"))
    rig.to_master = lambda frame: [frame]
    rig.cycles(300, 1.0)
    assert rig.all_are("DISABLED")
    assert not rig.servos[0].is_energised
    rig.enable()


def test_reset_fault__heartbeat_lost__a_new_chance_then_lost_again():
    rig = rig_of().enable()
    rig.to_master = without(HEARTBEAT)
    rig.until(lambda: rig.all_are("LOST"))
    rig.axes[0].reset_fault()
    rig.cycles(250)
    assert rig.all_are("DISABLED")
    rig.cycles(60)
    assert rig.all_are("LOST")


def test_heartbeat__back_the_very_next_cycle__still_not_powered_on():
    """The loss may go by unseen by the loop; the axis itself must not carry on with power."""
    rig = rig_of().enable()
    rig.to_master = without(HEARTBEAT)
    rig.until(lambda: rig.all_are("LOST"))
    rig.to_master = lambda frame: [frame]
    rig.loopback.deliver(pack_frame(HEARTBEAT, b"\x05"))
    rig.cycles(5, 1.0)
    assert not rig.servos[0].is_energised
    assert not rig.all_are("ENABLED")


@pytest.mark.parametrize("state", [b"\x7f", b"\x04"])
def test_heartbeat__of_a_drive_no_longer_operational__lost_in_time(state):
    rig = rig_of().enable()
    rig.to_master = lambda frame: (
        [pack_frame(HEARTBEAT, state)] if unpack_frame(frame)[0] == HEARTBEAT else [frame]
    )
    assert rig.until(lambda: rig.all_are("LOST")) <= 301


@pytest.mark.parametrize("data", [b"", b"\x05\x05", b"\x06", bytes(8)])
def test_heartbeat__malformed__does_not_count(data):
    rig = rig_of().enable()
    rig.to_master = lambda frame: (
        [pack_frame(HEARTBEAT, data)] if unpack_frame(frame)[0] == HEARTBEAT else [frame]
    )
    assert rig.until(lambda: rig.all_are("LOST")) <= 301


def test_drive_restarts__lost_at_once_and_stays_so():
    """It came up with factory settings: only a new start-up may use it again."""
    rig = rig_of().enable()
    rig.nodes[0].power_on()
    rig.cycle(1.0)
    assert rig.all_are("LOST")
    assert "restarted by itself" in rig.axes[0].note
    rig.cycles(600, 1.0)
    assert rig.all_are("LOST")
    rig.axes[0].reset_fault()
    rig.axes[0].enable()
    rig.cycles(600, 1.0)
    assert rig.all_are("LOST")
    assert not rig.servos[0].is_energised


def test_drive_restarts__after_a_new_start_up__enabled_again():
    rig = rig_of().enable()
    rig.nodes[0].power_on()
    rig.cycle()
    rig.bus = rig.new_master()
    rig.configure()
    rig.enable()


@pytest.mark.parametrize("command", [NmtCommand.STOP, NmtCommand.ENTER_PRE_OPERATIONAL])
def test_drive_stopped_by_network_management__no_feedback_then_lost(command):
    rig = rig_of().enable()
    rig.nmt(command, 1)
    assert not rig.cycle()
    assert rig.until(lambda: rig.all_are("LOST")) <= 301
    assert not rig.servos[0].is_energised


def test_master_falls_silent__the_drive_removes_torque_by_its_own_deadline():
    rig = rig_of().enable()
    rig.cycles(5, 2.0)
    rig.emulator.advance(19_000_000)
    assert rig.servos[0].is_energised
    rig.emulator.advance(2_000_000)
    assert not rig.servos[0].is_energised
    rig.cycle()
    assert rig.all_are("FAULT")
    assert "EMCY 8250" in rig.axes[0].note


# --- what the wire may hold -------------------------------------------------------------------


@pytest.mark.parametrize("length", [0, 1, 2, 3, 4, 5, 6, 7])
def test_tpdo__too_short__dropped(length):
    rig = rig_of()
    rig.configure()
    rig.cycle()
    before = rig.axes[0].q_rad
    data = codec.TPDO1.pack(0x27, 3000, 5)[:length]
    rig.to_master = lambda frame: (
        [pack_frame(TPDO, data)] if unpack_frame(frame)[0] == TPDO else [frame]
    )
    assert not rig.cycle()
    assert (rig.axes[0].q_rad, rig.axes[0].tau_meas_Nm) == (before, 0.0)
    assert rig.all_are("DISABLED")


def test_handlers__identifiers__those_of_the_node():
    axis = Cia402Axis(ask_for(ONE, node_id=0x2A), joint=1, period_s=T)
    assert set(axis.handlers()) == {0x1AA, 0x72A, 0x0AA}


@pytest.mark.parametrize("can_id", [TPDO, HEARTBEAT, 0x081])
def test_handlers__twenty_thousand_random_records__never_raise_never_ask_for_power(can_id):
    source = random.Random(can_id)
    axis = Cia402Axis(ONE, joint=1, period_s=T)
    axis.configure(AnsweringPort(without_range=True))
    handler = axis.handlers()[can_id]
    for _ in range(20_000):
        record = bytearray(pack_frame(can_id, source.randbytes(8)))
        record[4] = source.choice((8, 8, 8, 1, 1, source.randrange(256)))
        assert handler(bytes(record)) in (True, False)
        can_sent, data = unpack_frame(axis.command(5.0))
        assert (can_sent, data) == (RPDO, bytes(4))
        axis.end_cycle()
        assert math.isfinite(axis.q_rad)
        assert axis.status in AxisStatus


@settings(max_examples=200, deadline=None)
@given(
    events=st.lists(
        st.tuples(st.sampled_from(["tpdo", "heartbeat", "emcy"]), st.binary(max_size=8))
        | st.sampled_from([("enable", b""), ("disable", b""), ("reset", b"")]),
        max_size=40,
    )
)
def test_axis__any_history__torque_only_when_wanted_and_reported(events):
    axis = Cia402Axis(ONE, joint=1, period_s=T)
    axis.configure(AnsweringPort(without_range=False))
    handlers = axis.handlers()
    can_ids = {"tpdo": TPDO, "heartbeat": HEARTBEAT, "emcy": 0x081}
    requests = {"enable": axis.enable, "disable": axis.disable, "reset": axis.reset_fault}
    is_wanted = False
    for kind, data in events:
        if kind in requests:
            requests[kind]()
            is_wanted = kind == "enable"
        else:
            handlers[can_ids[kind]](pack_frame(can_ids[kind], data))
        word, torque = codec.RPDO1.unpack(unpack_frame(axis.command(5.0))[1])
        axis.end_cycle()
        if torque:
            assert is_wanted
            assert axis.status is AxisStatus.ENABLED
            assert word == codec.CONTROL_ENABLE_OPERATION
        if word not in (codec.CONTROL_DISABLE_VOLTAGE, codec.CONTROL_FAULT_RESET):
            assert is_wanted


def test_settings__impossible__refused_by_the_model():
    for wrong in ({"node_id": 0}, {"node_id": 127}, {"direction": 2}, {"rated_torque_Nm": 0.0}):
        with pytest.raises(ValueError, match="validation error"):
            Cia402Settings(**{**ONE.model_dump(), **wrong})
