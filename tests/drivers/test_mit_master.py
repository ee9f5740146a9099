"""The MIT-mode master in front of the emulated motors: start-up frame by frame, and refusals."""

from pathlib import Path

import pytest
from pydantic import ValidationError

from drivers.arm_bus import RECEIVED, SENT
from drivers.axis import AxisStatus
from drivers.errors import AmplifierError
from drivers.frame import EFF_FLAG, pack_frame, unpack_frame
from drivers.mit import codec
from drivers.mit.codec import Feedback, Register, RegisterCommand
from drivers.mit.settings import MitSettings
from drivers.settings import AxisSettings
from tests.drivers.axis_rig import AxisRig, keep
from tests.mit_fuzz import FUZZ_FRAMES, babble, random_source

GOLDEN = Path(__file__).parent / "golden"
VARIANTS = ("damiao", "tmotor", "cubemars", "cybergear", "robstride")
MINI_CHEETAHS = ("tmotor", "cubemars")


def settings_of(variant, **changes):
    """Settings of a joint of the emulated bench."""
    fitting = {"variant": variant}
    if variant in MINI_CHEETAHS:
        fitting["is_lockstep"] = True
    return fitting | changes


def rig_of(variant, **changes):
    return AxisRig("mit", (settings_of(variant, **changes),) * 2)


# --- start-up -------------------------------------------------------------------------------------

GOLDEN_RANGES = {
    "damiao": {"torque_range_Nm": 10.0, "torque_max_Nm": 8.0},
    "robstride": {
        "torque_range_Nm": 17.0,
        "torque_max_Nm": 14.0,
        "position_range_rad": 12.57,
        "velocity_range_rad_s": 44.0,
    },
    "tmotor": {"torque_range_Nm": 18.0, "torque_max_Nm": 12.0, "velocity_range_rad_s": 25.64},
    "cubemars": {"torque_range_Nm": 18.0, "torque_max_Nm": 12.0, "velocity_range_rad_s": 25.64},
}


def golden_frames(variant):
    """(direction, identifier, data) of each line of a golden file; every line says what it is."""
    frames = []
    for line in (GOLDEN / f"mit_{variant}.txt").read_text().splitlines():
        notation, _, comment = line.partition(";")
        if not notation.strip():
            continue
        assert comment.strip(), line
        way, frame = notation.split()
        can_id, _, data = frame.partition("#")
        flag = EFF_FLAG if len(can_id) == 8 else 0
        direction = {"TX": SENT, "RX": RECEIVED}[way]
        frames.append((direction, int(can_id, 16) | flag, bytes.fromhex(data)))
    return frames


@pytest.mark.parametrize("variant", GOLDEN_RANGES)
def test_start_up__first_axis__exactly_the_golden_frames(variant):
    ranges = GOLDEN_RANGES[variant]
    rig = AxisRig("mit", (settings_of(variant, **ranges), settings_of(variant)))
    log = []
    rig.bus.log_frames(lambda way, frame: log.append((way, *unpack_frame(frame))))
    rig.configure()
    rig.axes[0].enable()
    rig.cycles(4 if variant in MINI_CHEETAHS else 3, 1.0, 0.0)
    expected = golden_frames(variant)
    own = [entry for entry in log if not is_of_second_motor(*entry)]
    for number, (found, wanted) in enumerate(zip(own, expected, strict=False), start=1):
        assert found == wanted, f"frame {number}"
    assert len(own) == len(expected)


def is_of_second_motor(_way, can_id, data):
    if can_id & EFF_FLAG:
        return 2 in (can_id & 0xFF, can_id >> 8 & 0xFF)
    return can_id in (0x002, 0x012) or (can_id in (0x000, codec.REGISTER_ID) and data[0] == 2)


@pytest.mark.parametrize(
    ("register", "value", "setting"),
    [
        (Register.POSITION_RANGE, 12.566, "position_range_rad"),
        (Register.VELOCITY_RANGE, 45.0, "velocity_range_rad_s"),
        (Register.TORQUE_RANGE, 28.0, "torque_range_Nm"),
    ],
)
def test_configure__damiao_range_differs__refused_with_both_values(register, value, setting):
    rig = rig_of("damiao")
    rig.nodes[1].registers[register] = value
    with pytest.raises(AmplifierError) as caught:
        rig.configure()
    message = str(caught.value)
    assert message.startswith("joint 2 (damiao 2): ")
    assert f"register {int(register)}" in message
    assert f"{value:g}" in message
    assert message.endswith(f"correct {setting}")


@pytest.mark.parametrize("units", [0, 20, 1_000_000])
def test_configure__damiao_watchdog_elsewhere__set_and_verified(units):
    rig = rig_of("damiao", watchdog_ms=35)
    rig.nodes[0].registers[Register.TIMEOUT] = units
    rig.configure()
    assert rig.nodes[0].registers[Register.TIMEOUT] == 35 * 20
    assert rig.nodes[0].watchdog_s == pytest.approx(0.035)


def test_configure__robstride_watchdog_off__set_and_verified():
    rig = rig_of("robstride", watchdog_ms=35)
    assert rig.nodes[0].watchdog_s == 0.0
    rig.configure()
    assert rig.nodes[0].watchdog_s == pytest.approx(0.035)
    assert rig.nodes[0].torque_limit_Nm == rig.settings[0].torque_max_Nm


@pytest.mark.parametrize("variant", ["damiao", "robstride"])
def test_configure__watchdog_cannot_be_set__refused(variant):
    rig = rig_of(variant)
    write = b"\x55\x09" if variant == "damiao" else b"\x28\x70"

    def lose_write(frame):
        _, data = unpack_frame(frame)
        is_write = data[2:4] == write if variant == "damiao" else (
            data[:2] == write and frame[3] & 0x1F == 18
        )  # fmt: skip
        return [] if is_write else [frame]

    rig.to_drives = lose_write
    with pytest.raises(AmplifierError, match=r"joint 1 .*(timeout|no answer)"):
        rig.configure()


def test_configure__damiao_in_another_control_mode__put_into_mit_mode():
    rig = rig_of("damiao")
    rig.nodes[0].registers[Register.CONTROL_MODE] = 3
    rig.configure()
    assert rig.nodes[0].registers[Register.CONTROL_MODE] == codec.MIT_MODE


@pytest.mark.parametrize("variant", MINI_CHEETAHS)
def test_configure__another_master_sends_to_the_motor__refused(variant):
    rig = rig_of(variant)
    other = pack_frame(0x001, codec.ENABLE)

    def wait(timeout_s):
        rig._wait(timeout_s)
        rig.loopback.deliver(other)

    rig.loopback.connect(rig._from_master, wait)
    with pytest.raises(AmplifierError, match="another master sends to identifier 0x1"):
        rig.configure()


@pytest.mark.parametrize(("variant", "other"), [("tmotor", "cubemars"), ("cubemars", "tmotor")])
def test_configure__replies_of_the_other_length__refused_with_what_came(variant, other):
    rig = rig_of(variant, master_id=0x20)
    for node in rig.nodes:
        node.settings = node.settings.model_copy(update={"variant": other})
    with pytest.raises(AmplifierError, match=r"answered 01 .*correct variant"):
        rig.configure()


def test_configure__two_motors_on_one_reply_identifier__told_apart_by_their_first_byte():
    rig = rig_of("tmotor")
    assert [axis.reply_id for axis in rig.settings] == [0, 0]
    rig.configure()
    assert rig.cycle()
    first, second = (axis.q_rad for axis in rig.axes)
    assert first == pytest.approx(0.4, abs=0.002)
    assert second == pytest.approx(-0.5, abs=0.002)


def test_configure__emulated_by_the_clock__no_lockstep():
    rig = rig_of("damiao")
    for node in rig.nodes:
        node.registers[Register.HARDWARE_VERSION] = codec.HIL_WALL
    infos = rig.bus.configure(heartbeat_cycles=0)
    assert not any(info.is_lockstep for info in infos)
    assert rig.axes[0].inject_fault() is not None


@pytest.mark.parametrize("register", [Register.SERIAL, Register.HARDWARE_VERSION])
def test_configure__other_serial_or_version__taken_for_a_real_motor(register):
    rig = rig_of("damiao")
    for node in rig.nodes:
        node.registers[register] = 4711
    infos = rig.bus.configure(heartbeat_cycles=0)
    assert not any(info.is_lockstep for info in infos)
    assert rig.axes[0].inject_fault() is None


# --- in operation ---------------------------------------------------------------------------------


@pytest.mark.parametrize("variant", VARIANTS)
def test_frames__whole_life_of_an_axis__one_request_a_cycle_and_commands_only_around_power(variant):
    rig = rig_of(variant).configure()
    log = []
    rig.bus.log_frames(lambda way, frame: log.append((way, *unpack_frame(frame))))
    rig.cycles(3)
    quiet = len([entry for entry in log if entry[0] == SENT])
    assert quiet == 3 * 3  # two requests and the lockstep frame
    rig.enable()
    log.clear()
    rig.cycles(5, 1.0, 1.0)
    assert len([entry for entry in log if entry[0] == SENT]) == 5 * 3


def test_disable__before_or_after_the_request__no_torque_first_and_off_in_the_next_frame():
    for is_before in (True, False):
        rig = rig_of("damiao").configure().enable()
        rig.cycles(3, 1.0, 1.0)
        sent = []
        axis = rig.axes[0]
        if not is_before:
            axis.request()
        axis.disable()
        if is_before:
            sent.append(axis.request())
        sent.append(axis.command(1.0))
        if not is_before:
            sent.append(axis.request())
        assert [unpack_frame(frame)[1] for frame in sent] == [
            bytes.fromhex("7FFF7FF0000007FF"),
            codec.DISABLE,
        ]


def test_feedback__angle_at_the_end_of_its_range__is_no_feedback():
    rig = rig_of("damiao").configure()
    before_rad = rig.axes[0].q_rad
    for code in (0, 0xFFFF):
        data = codec.pack_feedback(Feedback(0x01, code, 0x7FF, 0x7FF, (0, 0)))
        rig.to_master = lambda frame, data=data: [
            pack_frame(0x11, data) if unpack_frame(frame)[0] == 0x11 else frame
        ]
        assert not rig.cycle()
        assert rig.axes[0].q_rad == before_rad
        assert rig.axes[0].age_cycles > 0


def test_feedback__somebody_reads_a_register_meanwhile__not_taken_for_state():
    rig = rig_of("damiao").configure().enable()
    for command in (RegisterCommand.READ, RegisterCommand.WRITE, RegisterCommand.SAVE):
        data = codec.pack_register(1, command, 9, codec.U32.pack(400))
        rig.loopback.deliver(pack_frame(0x11, data))
        assert rig.cycle()
        assert rig.all_are("ENABLED")


def test_feedback__motor_counted_turns_before__joint_starts_within_half_a_turn():
    rig = rig_of("damiao")
    rig.nodes[0]._zero_counts -= 4096
    rig.configure()
    assert rig.nodes[0].position_rad == pytest.approx(0.4 + 6.2832, abs=0.01)
    assert rig.axes[0].q_rad == pytest.approx(0.4, abs=0.002)


@pytest.mark.parametrize("variant", VARIANTS)
def test_fault__every_one_the_vendor_names__told_in_one_line(variant):
    rig = rig_of(variant).configure()
    named = {
        "damiao": {0x8: "over voltage", 0xD: "lost communication", 0x5: "undocumented status"},
        "tmotor": {},
        "cubemars": {1: "over voltage", 99: "undocumented"},
        "cybergear": {0x01: "under voltage", 0x30: "overload or Hall encoder, not calibrated"},
        "robstride": {0x04: "over temperature", 0x08: "magnetic encoder"},
    }[variant]
    for fault, name in named.items():
        rig.nodes[0].fail(fault)
        rig.cycles(2)
        assert rig.axes[0].status is AxisStatus.FAULT
        assert rig.axes[0].note.startswith(f"joint 1 ({variant} 1): drive fault ")
        assert rig.axes[0].note.endswith(name)
        rig.axes[0].reset_fault()
        rig.cycles(20)
        assert rig.axes[0].status is AxisStatus.DISABLED
        assert rig.nodes[0].fault == 0


def test_restart__motor_forgets_that_it_was_enabled__disabled_and_stays_so():
    rig = rig_of("damiao").configure().enable()
    rig.nodes[0].power_on()
    rig.cycles(10, 1.0, 1.0)
    assert rig.axes[0].status is AxisStatus.DISABLED
    assert not rig.servos[0].is_energised


def test_silence__one_way_only__stop_is_sent_until_the_motor_answers_again():
    rig = rig_of("damiao", silence_ms=5, watchdog_ms=1000).configure().enable()
    rig.to_master = lambda frame: []
    rig.cycles(8, 1.0, 1.0)
    assert rig.all_are("LOST")
    assert not any(servo.is_energised for servo in rig.servos)
    rig.to_master = keep
    rig.cycles(2)
    assert rig.all_are("DISABLED")


@pytest.mark.parametrize("variant", VARIANTS)
def test_handlers__random_and_mutated_frames__no_exception_and_torque_within_limits(
    variant, capsys
):
    rig = rig_of(variant, torque_max_Nm=5.0).configure().enable()
    chance = random_source(capsys, f"mit master {variant}")
    axis = rig.axes[0]
    handlers = list(axis.handlers().items())
    low, high = codec.torque_codes_within(5.0, 15.0, rig.settings[0].torque_codes)
    good = bytes((1, 0x84, 0x19, 0x7F, 0xF7, 0xFF, 0x1E, 0))
    for number in range(FUZZ_FRAMES):
        can_id, handler = chance.choice(handlers)
        handler(pack_frame(can_id, babble(chance, good)))
        if number % 16 == 0:
            axis.enable()
            chance.choice([axis.disable, axis.reset_fault, axis.enable, axis.end_cycle])()
        for frame in (axis.request(), axis.command(chance.uniform(-1e3, 1e3))):
            assert torque_code_of(frame, axis) in range(low, high + 1)
        assert axis.status in AxisStatus
        assert abs(axis.q_rad) < 100.0


def torque_code_of(frame, axis):
    """The torque a frame asks for; the middle if it asks for none."""
    middle = axis._torque_top // 2
    if frame is None:
        return middle
    can_id, data = unpack_frame(frame)
    if can_id & EFF_FLAG:
        return can_id >> 8 & 0xFFFF if can_id >> 24 & 0x1F == 1 else middle
    codes = codec.parse_command(data) if can_id == 1 else None
    return codes.torque if codes else middle


# --- settings -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"torque_max_Nm": 11.0}, "torque_max_Nm = 11 is above torque_range_Nm = 10"),
        ({"torque_max_Nm": 0.001}, "is below 0.00488, the step"),
        ({"node_id": 16}, "above 15"),
        ({"master_id": 1}, "the motor's own node_id"),
        ({"variant": "robstride", "master_id": 0x100}, "above 255"),
    ],
)
def test_settings__contradictory__refused_with_value_and_limit(changes, words):
    fine = {"node_id": 1, "torque_range_Nm": 10.0, "torque_max_Nm": 10.0}
    with pytest.raises(ValidationError, match=words):
        MitSettings(**fine | changes)


@pytest.mark.parametrize("variant", VARIANTS)
def test_settings__any_variant__frames_and_identifiers_are_stated(variant):
    settings = MitSettings(node_id=3, torque_range_Nm=10, torque_max_Nm=10, variant=variant)
    assert isinstance(settings, AxisSettings)
    each = [frame for frame in settings.cycle_frames(1e-3) if frame.every == 1]
    assert [frame.length for frame in each] == [8, 6 if variant == "tmotor" else 8]
    assert all(frame.is_extended == settings.is_wide for frame in each)
    assert (3 in settings.identifiers()) != settings.is_wide
