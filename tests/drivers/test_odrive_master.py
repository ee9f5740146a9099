"""The ODrive master in front of emulated axes; what all families promise is in the contract."""

import math
from itertools import pairwise
from pathlib import Path

import pytest

from drivers.axis import AxisStatus
from drivers.errors import AmplifierError
from drivers.frame import RTR_FLAG, pack_frame, unpack_frame
from drivers.odrive import codec
from drivers.odrive.codec import AxisError, AxisState, Command
from drivers.odrive.endpoints import Endpoint
from drivers.odrive.master import OdriveAxis
from drivers.odrive.settings import OdriveSettings
from drivers.registry import SETTINGS, find_clash, make_axes
from drivers.settings import AxisSettings
from tests.drivers.axis_rig import AxisRig, keep
from tests.drivers.test_odrive_codec import vendor_file
from tests.odrive_fuzz import FUZZ_FRAMES, babble, random_source

GOLDEN = Path(__file__).parent / "golden" / "odrive_startup.txt"
FAULT_CYCLES = 51
"""A heartbeat comes within these."""


def rig_of(first=None, second=None):
    return AxisRig("odrive", (first or {}, second or {}))


@pytest.fixture
def rig():
    return rig_of().configure()


class Tap:
    """Notes what passes on the wire of a rig."""

    def __init__(self, rig):
        self.sent, self.log = [], []
        rig.to_drives, rig.to_master = self._sent, self._received

    def _sent(self, frame):
        self.sent.append(unpack_frame(frame))
        self.log.append(("TX", *unpack_frame(frame)))
        return [frame]

    def _received(self, frame):
        self.log.append(("RX", *unpack_frame(frame)))
        return [frame]

    def take(self, node, command):
        """Payloads sent so far to a node's command; they are forgotten."""
        wanted = codec.can_id(node, command)
        taken = [data for can_id, data in self.sent if can_id == wanted]
        self.sent = [item for item in self.sent if item[0] != wanted]
        return taken


def heartbeat(errors=0, state=AxisState.IDLE, result=0, node=1):
    beat = codec.Heartbeat(errors, state, result, is_trajectory_done=True)
    return pack_frame(codec.can_id(node, Command.HEARTBEAT), codec.pack_heartbeat(beat))


def lone_axis(**changes):
    """A master that is in operation and has heard a heartbeat, with nobody at the other end."""
    settings = OdriveSettings(**(OdriveSettings.defaults(1, 15.0) | changes))
    axis = OdriveAxis(settings, joint=1, period_s=1e-3)
    for _ in range(2):
        axis.end_cycle()
    tell(axis, heartbeat())
    return axis


def tell(axis, frame):
    return axis.handlers()[unpack_frame(frame)[0]](frame)


# --- start-up -----------------------------------------------------------------------------------


def _is_in_golden(place, can_id, config_ends):
    if can_id in (0x021, 0x03C):
        return place == 0
    return can_id != 0x029 or place <= config_ends


def test_startup__one_axis__frame_by_frame():
    rig = rig_of()
    tap = Tap(rig)
    rig.configure().cycles(60)
    rig.axes[0].enable()
    rig.until(lambda: rig.axes[0].status is AxisStatus.ENABLED)
    rig.cycle(1.5, 0.0)
    rig.cycle(-0.25, 0.0)
    rig.axes[0].disable()
    rig.cycles(2)
    log = [line for line in tap.log if line[1] >> 5 == 1][1:]  # the first heartbeat is from boot
    first_torque = next(i for i, line in enumerate(log) if line[1] == 0x02E)
    polled = [i for i, line in enumerate(log) if line[1] == 0x029 and line[0] == "TX"]
    config_ends = polled[0] + 1
    assert config_ends < first_torque
    lines = [
        f"{line[0]} {line[1]:03X}#{line[2].hex().upper()}"
        for place, line in enumerate(log)
        if _is_in_golden(place, line[1], config_ends)
    ]
    lines = [now for before, now in pairwise(["", *lines]) if now != before]
    golden = [line.split(";")[0].strip() for line in GOLDEN.read_text("ascii").splitlines()]
    assert lines == [line for line in golden if line]


def test_configure__emulated__told_by_serial_and_endpoint(rig):
    assert [info.is_lockstep for info in rig.infos] == [True, True]
    assert rig.infos[0].name == "ODrive 0.0.0, firmware 0.6.10, serial 0000014C4948"


def test_configure__foreign_serial__not_asked_for_the_emulators_endpoint():
    rig = rig_of()
    for node in rig.nodes:
        node.serial = 0x3856_3478_3133
    tap = Tap(rig)
    assert not rig.configure().infos[0].is_lockstep
    asked = [codec.parse_sdo(data).endpoint for data in tap.take(1, Command.RX_SDO)]
    assert 0xFFF1 not in asked


def test_configure__emulators_serial_but_no_answer__the_clock():
    rig = rig_of()
    rig.to_drives = lambda frame: [] if unpack_frame(frame)[1][1:3] == b"\xf1\xff" else [frame]
    rig.infos = []
    assert not rig.configure().infos[0].is_lockstep


def test_configure__old_firmware__refused_and_its_node_id_left_alone():
    """0x06 without data sets the node id of firmware 0.5, which does not know 0x00."""
    rig = rig_of()
    tap = Tap(rig)
    passed = rig.to_drives
    rig.to_drives = lambda frame: [] if unpack_frame(frame)[0] == 0x020 else passed(frame)
    with pytest.raises(AmplifierError, match=r"firmware 0\.6 or newer"):
        rig.configure()
    assert not tap.take(1, Command.ADDRESS)


def test_configure__firmware_5_that_answers__refused():
    rig = rig_of()
    rig.nodes[0]._version = codec.Version(2, (3, 6, 56), (0, 5, 6), is_unreleased=False)
    with pytest.raises(AmplifierError, match=r"joint 1 .*firmware 0\.5\.6"):
        rig.configure()


def test_configure__calibrating__refused_with_its_state():
    rig = rig_of()
    rig.emulator.advance(100_000_000)
    rig.nodes[0].axis.request(AxisState.MOTOR_CALIBRATION)
    rig.nodes[0].axis._procedure_left_s = 10.0
    with pytest.raises(AmplifierError, match=r"joint 1 .*MOTOR_CALIBRATION"):
        rig.configure()


def test_configure__torque_of_another_master__refused():
    rig = rig_of()
    foreign = pack_frame(codec.can_id(1, Command.INPUT_TORQUE), bytes(4))
    rig.to_master = lambda frame: [frame, foreign]
    with pytest.raises(AmplifierError, match="another master sends it torque"):
        rig.configure()


def test_configure__current_limit_too_low__refused_with_both_torques():
    rig = rig_of({"gear_ratio": 2.0})
    rig.nodes[0].axis.current_soft_max_A = 9.0
    rig.nodes[0].parameters.save()
    with pytest.raises(AmplifierError, match=r"9 A gives 13.5 Nm .* torque_max_Nm is 15"):
        rig.configure()


def test_configure__parameter_not_kept__refused_by_its_name():
    rig = rig_of()
    rig.nodes[0].parameters._set = lambda endpoint, value: None
    with pytest.raises(AmplifierError, match=r"heartbeat_msg_rate_ms reads back as 100 after 50"):
        rig.configure()


def test_configure__position_beyond_single_precision__refused():
    rig = rig_of()
    rig.nodes[0].axis.encoder.set_position(40_000.0)
    rig.nodes[0].axis.encoder.restart = lambda: None
    with pytest.raises(AmplifierError, match=r"at 40000.* turns its position has steps"):
        rig.configure()


def test_configure__no_position__refused():
    rig = rig_of()
    reply = pack_frame(codec.can_id(1, Command.ENCODER), codec.F32_PAIR.pack(math.nan, 0.0))
    rig.to_master = lambda frame: [reply if unpack_frame(frame)[0] == 0x029 else frame]
    with pytest.raises(AmplifierError, match="no position estimate"):
        rig.configure()


def test_configure__still_initialising__waited_for():
    rig = rig_of()
    rig.to_master = keep
    for node in rig.nodes:
        node.axis._boot_left_s = 0.15
    rig.configure()
    assert rig.all_are("DISABLED")


def test_configure__error_of_before__fault_until_reset():
    rig = rig_of()
    rig.emulator.advance(50_000_000)
    rig.nodes[0].axis.fail(AxisError.DRV_FAULT)
    rig.configure().cycles(FAULT_CYCLES)
    assert rig.axes[0].status is AxisStatus.FAULT
    assert "DRV_FAULT" in rig.axes[0].note
    assert rig.axes[1].status is AxisStatus.DISABLED


def test_configure__watchdog_expired_before__no_fault():
    """A daemon that ended left it so; nothing was commanded since."""
    rig = rig_of().configure().enable()
    rig.infos = []
    rig.emulator.advance(100_000_000)
    assert rig.nodes[0].axis.errors == AxisError.WATCHDOG_TIMER_EXPIRED
    rig.bus = rig.new_master()
    rig.configure().cycles(2 * FAULT_CYCLES)
    assert rig.all_are("DISABLED")
    assert not rig.nodes[0].axis.errors
    rig.enable()


# --- endpoint numbers ---------------------------------------------------------------------------


def test_endpoints_file__fitting__its_numbers_used(tmp_path):
    path = vendor_file(tmp_path / "flat_endpoints.json")
    rig = rig_of({"endpoints_file": path}, {"endpoints_file": path})
    tap = Tap(rig)
    rig.configure().enable()
    assert rig.infos[0].name.startswith("ODrive 4.4.58, firmware 0.6.10")
    assert rig.infos[0].is_lockstep
    used = {codec.parse_sdo(data).endpoint for data in tap.take(1, Command.RX_SDO)} - {0xFFF1}
    assert used == {200 + number for number in range(len(Endpoint))}


def test_endpoints_file__of_other_firmware__refused_with_both(tmp_path):
    path = vendor_file(tmp_path / "flat_endpoints.json", fw_version="0.6.9")
    rig = rig_of({"endpoints_file": path})
    rig.nodes[0]._version = codec.Version(2, (4, 4, 58), (0, 6, 10), is_unreleased=False)
    with pytest.raises(AmplifierError, match=r"for firmware 0\.6\.9 .* has firmware 0\.6\.10"):
        rig.configure()


def test_endpoints_file__none_for_a_real_drive__refused_with_the_ways_out():
    rig = rig_of()
    rig.nodes[0]._version = codec.Version(2, (4, 4, 58), (0, 6, 10), is_unreleased=False)
    with pytest.raises(AmplifierError, match=r"flat_endpoints\.json .*parameters = 'preset'"):
        rig.configure()


def test_preset__rates_as_told__nothing_written_and_torque_follows():
    rig = rig_of(*[{"parameters": "preset", "heartbeat_ms": 100}] * 2)
    tap = Tap(rig)
    rig.configure().enable().cycles(3, 1.0, 0.5)
    assert rig.targets_Nm == [1.0, 0.5]
    written = [codec.parse_sdo(data) for data in tap.take(1, Command.RX_SDO)]
    assert not [sdo for sdo in written if sdo.opcode == codec.OPCODE_WRITE]


def test_preset__torque_mode_velocity_limit_left_on__torque_falls_short():
    """The trap that `parameters = "set"` removes: 10 turns/s times vel_gain at standstill."""
    rig = rig_of(*[{"parameters": "preset", "heartbeat_ms": 100}] * 2)
    rig.configure().enable().cycles(2, 5.0, 0.0)
    assert rig.targets_Nm[0] == pytest.approx(10.0 / 6.0, abs=0.1)


def test_preset__other_heartbeat_rate__refused():
    rig = rig_of({"parameters": "preset", "heartbeat_ms": 20})
    with pytest.raises(AmplifierError, match="sends no 0x01 every 20 ms; correct heartbeat_ms"):
        rig.configure()


# --- torque and position ------------------------------------------------------------------------


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("ratio", [1.0, 7.3, 100.0])
def test_gear__any__motor_side_on_the_wire_and_joint_side_here(ratio, direction):
    rig = rig_of(*[{"gear_ratio": ratio, "direction": direction, "torque_report_ms": 10}] * 2)
    tap = Tap(rig)
    rig.configure().enable()
    tap.sent.clear()
    rig.cycles(40, 0.5, -0.25)
    torque = codec.parse_f32(tap.take(1, Command.INPUT_TORQUE)[-1])
    assert torque == pytest.approx(0.5 * direction / ratio, rel=1e-6)
    for axis, servo in zip(rig.axes, rig.servos, strict=True):
        assert axis.q_rad == pytest.approx(direction * servo.q_rad, abs=0.01)
        assert axis.dq_rad_s == pytest.approx(direction * servo.dq_rad_s, abs=0.25)
        assert axis.tau_meas_Nm == pytest.approx(direction * servo.torque_Nm, abs=0.05)


@pytest.mark.parametrize("tau_Nm", [3.1, 1e9, -1e9, math.inf, -math.inf])
@pytest.mark.parametrize("ratio", [1.0, 3.0, 7.7])
def test_command__beyond_the_maximum__not_a_bit_more(tau_Nm, ratio):
    axis = lone_axis(torque_max_Nm=3.0, gear_ratio=ratio)
    axis.status, axis._wants_power = AxisStatus.ENABLED, True
    sent = codec.parse_f32(unpack_frame(axis.command(tau_Nm))[1])
    assert abs(sent) <= 3.0 / ratio
    assert sent == pytest.approx(math.copysign(3.0 / ratio, tau_Nm), rel=1e-6)


def test_command__not_a_number__none():
    axis = lone_axis()
    axis.status, axis._wants_power = AxisStatus.ENABLED, True
    assert unpack_frame(axis.command(math.nan)) == (0x02E, bytes(4))


def test_command__not_enabled__zero_torque_whatever_is_asked():
    assert unpack_frame(lone_axis().command(5.0)) == (0x02E, bytes(4))


@pytest.mark.parametrize("start_rev", [0.4, 0.6, -3.2, 17.9])
@pytest.mark.parametrize("ratio", [1.0, 5.0])
def test_encoder__first_position__within_half_a_turn_and_then_counted_on(start_rev, ratio):
    axis = lone_axis(gear_ratio=ratio, offset_rad=0.5)

    def at(position_rev):
        frame = pack_frame(0x029, codec.F32_PAIR.pack(position_rev, 0.0))
        axis.age_cycles += 1
        assert tell(axis, frame)
        return axis.q_rad

    start_rad = at(start_rev)
    assert abs(start_rad) <= math.pi + 1e-6
    exact = math.remainder(start_rev * math.tau / ratio + 0.5, math.tau)
    assert start_rad == pytest.approx(exact, abs=1e-5)
    assert at(start_rev + 2 * ratio) - start_rad == pytest.approx(2 * math.tau, abs=1e-4)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        bytes(4),
        bytes(7),
        codec.F32_PAIR.pack(math.nan, 0.0),
        codec.F32_PAIR.pack(0.0, math.nan),
        codec.F32_PAIR.pack(math.inf, 0.0),
        codec.F32_PAIR.pack(0.0, -math.inf),
        codec.F32_PAIR.pack(3e38, 0.0),
    ],
)
def test_encoder__no_position__no_feedback(data):
    axis = lone_axis()
    axis.age_cycles = 3
    assert not tell(axis, pack_frame(0x029, data))
    assert (axis.age_cycles, axis.q_rad) == (3, 0.0)


def test_encoder__second_in_a_cycle__fresher_but_not_counted_twice():
    axis = lone_axis()
    assert tell(axis, pack_frame(0x029, codec.F32_PAIR.pack(0.1, 0.0)))
    assert not tell(axis, pack_frame(0x029, codec.F32_PAIR.pack(0.2, 0.0)))
    assert axis.q_rad == pytest.approx(0.2 * math.tau)


def test_feedback__polled__asked_for_and_answered_in_each_cycle(rig):
    tap = Tap(rig)
    assert all(rig.cycle() for _ in range(10))
    assert tap.take(1, Command.ENCODER) == [b""] * 10


def test_feedback__polled_and_answer_late__counted_late_and_not_used(rig):
    held = []
    rig.to_master = lambda frame: held.append(frame) or []
    assert not rig.cycle()
    late = [frame for frame in held if unpack_frame(frame)[0] in (0x029, 0x049)]
    rig.to_master = lambda frame: []
    for frame in late:
        rig.loopback.deliver(frame)
    assert not rig.cycle()
    assert rig.bus.late_frames == 2
    assert rig.bus.age_cycles == 1


def cyclic_rig():
    return rig_of(*[{"feedback": "cyclic"}] * 2).configure()


def test_feedback__cyclic_in_lockstep__in_each_cycle_without_asking():
    rig = cyclic_rig()
    tap = Tap(rig)
    assert all(rig.cycle() for _ in range(20))
    assert not tap.take(1, Command.ENCODER)


def test_feedback__cyclic_between_two_cycles__counts_for_the_next():
    """By the drive's clock it may always come after the deadline of one cycle."""
    rig = cyclic_rig()
    held = []

    def delay(frame):
        if unpack_frame(frame)[0] not in (0x029, 0x049):
            return [frame]
        held.append(frame)
        return []

    rig.to_master = delay
    assert not rig.cycle()
    for _ in range(5):
        for frame in held:
            rig.loopback.deliver(frame)  # after the deadline of the last cycle
        held.clear()
        assert rig.cycle()
        assert rig.bus.age_cycles == 0
    assert rig.bus.late_frames == 0
    held.clear()
    assert not rig.cycle()
    assert rig.bus.age_cycles == 1


def test_feedback__cyclic_and_a_cycle_without_requests__each_frame_counts_once():
    """The bus leaves requests out when it looks for late answers of others."""
    axis = lone_axis(feedback="cyclic")
    frame = pack_frame(0x029, codec.F32_PAIR.pack(0.1, 0.0))
    axis.end_cycle()
    ages = []
    for comes in (True, True, False, False, True):
        axis.age_cycles += 1
        if comes:
            tell(axis, frame)
        ages.append(axis.age_cycles)
        axis.end_cycle()
    assert ages == [0, 0, 1, 2, 0]
    tell(axis, frame)
    tell(axis, frame)
    axis.age_cycles += 1
    assert axis.age_cycles == 0
    assert not tell(axis, frame)
    axis.end_cycle()
    axis.age_cycles += 1
    assert axis.age_cycles == 1, "a frame is not fresh twice"


# --- state --------------------------------------------------------------------------------------


def test_enable__watchdog_not_kept__no_power_and_a_note(rig):
    rig.nodes[0].parameters._set = lambda endpoint, value: None
    rig.nodes[0].axis.watchdog_timeout_s = 1.0
    rig.axes[0].enable()
    rig.cycles(100)
    assert not rig.servos[0].is_energised
    assert "watchdog" in rig.axes[0].note


def test_enable__in_the_first_cycle__waits_until_the_expired_watchdog_is_cleared():
    """The last heartbeat before cyclic operation says nothing about the watchdog since."""
    rig = rig_of()
    rig.infos = rig.bus.configure(heartbeat_cycles=0)
    for node in rig.nodes:
        node.axis.fail(AxisError.WATCHDOG_TIMER_EXPIRED)
    for can_id in (1, 2):
        rig.loopback.deliver(heartbeat(node=can_id))
    rig.enable()
    assert all(servo.is_energised for servo in rig.servos)


@pytest.mark.parametrize("error", [AxisError.DRV_FAULT, AxisError.WATCHDOG_TIMER_EXPIRED])
def test_enable__fault_not_reset__no_power(rig, error):
    rig.enable()
    rig.nodes[0].axis.fail(error)
    rig.until(lambda: rig.axes[0].status is AxisStatus.FAULT)
    tap = Tap(rig)
    rig.axes[0].enable()
    rig.cycles(100)
    assert rig.axes[0].status is AxisStatus.FAULT
    assert not tap.take(1, Command.AXIS_STATE)
    assert not tap.take(1, Command.CLEAR_ERRORS)


def test_enable__answers_lost__no_power():
    rig = rig_of().configure()
    rig.to_master = lambda frame: [] if unpack_frame(frame)[0] == 0x025 else [frame]
    rig.axes[0].enable()
    rig.cycles(100)
    assert not rig.servos[0].is_energised
    assert rig.axes[0].status is AxisStatus.DISABLED


def test_enable__confirmations_of_writes__no_proof_of_the_watchdog():
    """Firmware 0.6.11 confirms writes with a frame like the answer to a read."""
    rig = rig_of().configure()
    axis = rig.axes[0]
    number = next(iter(axis._checks))
    axis.enable()
    axis.command(0.0)
    confirm = codec.pack_sdo(codec.Sdo(0, number, axis._checks[number]))
    tell(axis, pack_frame(0x025, confirm))
    assert number in axis._unverified


def test_enable__not_calibrated__note_with_the_result(rig):
    rig.nodes[0].axis.is_calibrated = False
    rig.axes[0].enable()
    rig.cycles(200)
    assert rig.axes[0].status is AxisStatus.DISABLED
    assert "NOT_CALIBRATED" in rig.axes[0].note


def test_enable__heartbeat_from_before_the_request__not_believed():
    axis = lone_axis(parameters="preset")
    axis.enable()
    tell(axis, heartbeat(state=AxisState.CLOSED_LOOP_CONTROL))
    assert axis.status is AxisStatus.DISABLED
    for _ in range(3):
        axis.command(0.0)
    tell(axis, heartbeat(state=AxisState.CLOSED_LOOP_CONTROL))
    assert axis.status is AxisStatus.DISABLED
    for _ in range(2):
        axis.end_cycle()
    tell(axis, heartbeat(state=AxisState.CLOSED_LOOP_CONTROL))
    assert axis.status is AxisStatus.ENABLED


def test_enable__again_at_once__not_ready_before_the_drive_is(rig):
    """Between two heartbeats the drive's last known state is the old one."""
    rig.enable().cycles(3, 1.0, 1.0)
    for axis in rig.axes:
        axis.disable()
    rig.cycle()
    for axis in rig.axes:
        axis.enable()
    assert not rig.bus.is_enabled
    rig.until(lambda: rig.bus.is_enabled)
    assert all(servo.is_energised for servo in rig.servos)


def test_disable__request_lost__asked_again_with_the_next_heartbeat(rig):
    rig.enable()
    rig.to_drives = lambda frame: [] if unpack_frame(frame)[0] == 0x027 else [frame]
    rig.axes[0].disable()
    rig.cycle(1.0, 1.0)
    assert rig.servos[0].is_energised
    rig.to_drives = keep
    rig.cycles(FAULT_CYCLES + 1, 1.0, 1.0)
    assert not rig.servos[0].is_energised
    assert rig.servos[1].is_energised


def test_disable__requests_pending__goes_first():
    axis = lone_axis(parameters="preset")
    axis.enable()
    axis.disable()
    assert unpack_frame(axis.command(1.0)) == (0x027, b"\x01\0\0\0")
    assert unpack_frame(axis.command(1.0)) == (0x02E, bytes(4))


def test_heartbeat__left_closed_loop_without_an_error__disabled_and_the_reason_asked_for(rig):
    """A motor can be unplugged with error 0 in the heartbeat."""
    rig.enable()
    tap = Tap(rig)
    model = rig.nodes[0].axis
    model.disarm_reason = int(AxisError.MISSING_ESTIMATE)
    model.request(AxisState.IDLE)
    rig.cycles(FAULT_CYCLES + 2, 1.0, 1.0)
    assert rig.axes[0].status is AxisStatus.DISABLED
    assert tap.take(1, Command.ERROR) == [b""]
    assert rig.axes[0].note.endswith("disarmed by MISSING_ESTIMATE")
    rig.cycles(50, 1.0, 1.0)
    assert not rig.servos[0].is_energised, "only `enable` asks for power again"


@pytest.mark.parametrize("error", list(AxisError)[1:])
def test_heartbeat__each_error_under_power__fault_with_the_vendors_name(error):
    axis = lone_axis(parameters="preset")
    axis.enable()
    for _ in range(3):
        axis.command(0.0)
        axis.end_cycle()
    tell(axis, heartbeat(state=AxisState.CLOSED_LOOP_CONTROL))
    tell(axis, heartbeat(errors=error))
    assert axis.status is AxisStatus.FAULT
    assert error.name in axis.note
    assert unpack_frame(axis.command(5.0)) == (0x02E, bytes(4))


def test_heartbeat__initialising__restarted_by_itself():
    axis = lone_axis()
    tell(axis, heartbeat(errors=AxisError.INITIALIZING))
    assert axis.status is AxisStatus.LOST
    assert "restarted by itself" in axis.note
    tell(axis, heartbeat())
    assert axis.status is AxisStatus.DISABLED


def test_reboot__under_power__lost_then_enabled_with_the_watchdog_set_again(rig):
    rig.enable()
    rig.nodes[0].receive(codec.can_id(1, Command.REBOOT), b"\0")
    assert not rig.nodes[0].axis.is_watchdog_on
    rig.until(lambda: rig.axes[0].status is AxisStatus.LOST, 1.0, 1.0)
    rig.until(lambda: rig.axes[0].status is AxisStatus.DISABLED)
    rig.axes[0].reset_fault()
    rig.axes[0].enable()
    rig.until(lambda: rig.bus.is_enabled)
    assert rig.nodes[0].axis.is_watchdog_on
    assert rig.nodes[0].axis.watchdog_timeout_s == pytest.approx(0.02)


def test_watchdog__read_by_a_third_party__the_last_torque_stays(rig):
    """The trap: any frame feeds it, so a reader keeps a drive energised whose master is dead."""
    rig.enable().cycles(3, 1.0, 1.0)
    poll = pack_frame(codec.can_id(1, Command.BUS) | RTR_FLAG)
    for _ in range(40):
        rig.emulator.receive(poll)
        rig.emulator.advance_period()
    assert rig.targets_Nm == [1.0, 0.0]


def test_reset__old_error_still_in_a_heartbeat__forgiven():
    axis = lone_axis()
    tell(axis, heartbeat(errors=AxisError.DRV_FAULT))
    axis.reset_fault()
    sent = [unpack_frame(axis.command(1.0)) for _ in range(3)]
    assert [can_id for can_id, _ in sent] == [0x027, 0x038, 0x02E]
    tell(axis, heartbeat(errors=AxisError.DRV_FAULT))
    assert axis.status is AxisStatus.DISABLED
    for _ in range(20):
        axis.end_cycle()
    tell(axis, heartbeat(errors=AxisError.DRV_FAULT))
    assert axis.status is AxisStatus.FAULT


def test_reset__disabled_before_it_was_sent__still_sent():
    axis = lone_axis()
    tell(axis, heartbeat(errors=AxisError.DRV_FAULT))
    axis.reset_fault()
    axis.disable()
    sent = [unpack_frame(axis.command(1.0))[0] for _ in range(3)]
    assert sent == [0x027, 0x038, 0x02E]


@pytest.mark.parametrize("command", [Command.HEARTBEAT, Command.ERROR, Command.TX_SDO,
                                     Command.TORQUES, Command.ENCODER])  # fmt: skip
@pytest.mark.parametrize("length", range(9))
def test_handlers__any_length__nothing_raised_and_nothing_finite_lost(command, length):
    axis = lone_axis()
    axis.enable()
    for fill in (0x00, 0x7F, 0xFF):
        tell(axis, pack_frame(codec.can_id(1, command), bytes([fill] * length)))
        assert math.isfinite(axis.q_rad + axis.dq_rad_s + axis.tau_meas_Nm)


SENSIBLE = (
    (Command.ENCODER, codec.F32_PAIR.pack(0.25, -1.0)),
    (Command.HEARTBEAT, unpack_frame(heartbeat())[1]),
    *[(Command.HEARTBEAT, unpack_frame(heartbeat(state=AxisState.CLOSED_LOOP_CONTROL))[1])] * 3,
    (Command.HEARTBEAT, unpack_frame(heartbeat(errors=AxisError.DRV_FAULT))[1]),
    (Command.ERROR, codec.U32_PAIR.pack(0, AxisError.MISSING_ESTIMATE)),
    (Command.TORQUES, codec.F32_PAIR.pack(1.0, 0.9)),
    (Command.TX_SDO, codec.pack_sdo(codec.Sdo(0, 0xFE01, b"\1"))),
)


def test_fuzz__random_and_mutated_frames__no_exception_torque_limited_states_legal(capsys):
    chance = random_source(capsys, "odrive master")
    axis, powered = lone_axis(parameters="preset"), 0
    handlers = axis.handlers()
    for count in range(FUZZ_FRAMES):
        if count % 50 == 0:
            chance.choice((axis.enable,) * 5 + (axis.disable, axis.reset_fault))()
        command, data = babble(chance, SENSIBLE)
        handler = handlers.get(codec.can_id(1, command))
        if handler is not None:
            handler(pack_frame(codec.can_id(1, command), data))
        axis.request()
        can_id, sent = unpack_frame(axis.command(chance.uniform(-40.0, 40.0)))
        axis.end_cycle()
        assert isinstance(axis.status, AxisStatus)
        assert math.isfinite(axis.q_rad + axis.dq_rad_s + axis.tau_meas_Nm)
        assert can_id in handlers or can_id >> 5 == 1
        if can_id == 0x02E:
            torque_Nm = codec.parse_f32(sent)
            assert abs(torque_Nm) <= 15.0
            assert torque_Nm == 0.0 or axis.status is AxisStatus.ENABLED
            powered += torque_Nm != 0.0
    assert powered > FUZZ_FRAMES / 200, "it was hardly ever under power"


# --- identifiers --------------------------------------------------------------------------------


def axes_of(*joints):
    return [
        SETTINGS[family].model_validate(SETTINGS[family].defaults(number, 5.0) | changes)
        for number, (family, changes) in enumerate(joints, start=1)
    ]


@pytest.mark.parametrize(
    ("node", "identifier", "use"),
    [(0, "0x000", "NMT"), (4, "0x080", "SYNC"), (16, "0x202", "RPDO1"), (44, "0x582", "SDO")],
)
def test_clash__node_id_in_a_block_of_canopen__one_line(node, identifier, use):
    line = find_clash(axes_of(("odrive", {"node_id": node}), ("cia402", {})))
    assert identifier in line
    assert use in line
    assert f"odrive node {node}" in line
    assert "\n" not in line


@pytest.mark.parametrize("node", [1, 2, 3, 62])
def test_clash__other_node_ids_beside_canopen__none(node):
    assert not find_clash(axes_of(("odrive", {"node_id": node}), ("cia402", {})))


def test_clash__odrive_alone_as_node_4__none_and_it_runs():
    assert not find_clash(axes_of(("odrive", {"node_id": 4}), ("odrive", {})))
    rig_of({"node_id": 4}).configure().enable()


def test_identifiers__family_that_does_not_say__empty():
    assert AxisSettings.identifiers(make_settings()) == {}


def make_settings():
    return OdriveSettings(node_id=1, torque_max_Nm=1.0)


def test_make_axes__odrive__labelled():
    (axis,) = make_axes([make_settings()], period_s=1e-3)
    assert axis.label == "joint 1 (odrive node 1)"
