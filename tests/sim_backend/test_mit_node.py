"""The emulated MIT-mode motors: state machines, registers, watchdogs, quirks, and junk."""

import struct

import pytest

from drivers.frame import EFF_FLAG, RTR_FLAG, unpack_frame
from drivers.mit import codec
from drivers.mit import robstride_codec as wide
from drivers.mit.codec import Ranges, Register, RegisterCommand, Setpoint
from drivers.mit.robstride_codec import Parameter, Status, Type
from sim_backend.mit.node import make_node
from sim_backend.mit.settings import MitNodeSettings
from sim_backend.presets import servo_preset
from sim_backend.servo import Servo
from tests.mit_fuzz import FUZZ_FRAMES, babble, random_source

RANGES = Ranges(12.5, 30.0, 15.0)
STEP_NM = 30.0 / 4095
NODE, REPLY, HOST = 1, 0x11, 0xFD
ELEVEN_BITS = ("damiao", "tmotor", "cubemars")
WIDE = ("cybergear", "robstride")


class Bench:
    """One emulated motor on a shaft that the test turns."""

    def __init__(self, variant, **changes):
        reply = HOST if variant in WIDE else REPLY
        settings = MitNodeSettings(
            variant=variant, node_id=NODE, reply_id=reply, ranges=RANGES, **changes
        )
        self.frames = []
        self.servo = Servo(servo_preset("bench")[0])
        self.node = make_node(settings, self.servo, self._note)
        self.node.power_on()

    def _note(self, frame):
        self.frames.append(unpack_frame(frame))

    def send(self, data, can_id=NODE):
        """Give the motor a frame; return what it answered."""
        before = len(self.frames)
        self.node.receive(can_id, data)
        return self.frames[before:]

    def status(self, data, can_id=NODE):
        """Status in the answer of a Damiao motor."""
        ((reply_id, reply),) = self.send(data, can_id)
        assert reply_id == REPLY
        assert reply[0] & 0xF == NODE
        return reply[0] >> 4

    def wide(self, kind, data=bytes(8), middle=HOST):
        return self.send(data, wide.pack_id(kind, middle, NODE))

    def setpoint(self, **values):
        values = {"position_rad": 0.0, "velocity_rad_s": 0.0, "kp_Nm_rad": 0.0, "kd_Nms_rad": 0.0,
                  "torque_Nm": 0.0} | values  # fmt: skip
        return Setpoint(**values)

    def follow(self, **values):
        """Send a set-point as the variant takes it; return the answers."""
        setpoint = self.setpoint(**values)
        if self.node.settings.variant in ELEVEN_BITS:
            return self.send(codec.pack_setpoint(setpoint, RANGES))
        r = RANGES
        data = wide.COMMAND.pack(
            codec.to_code(setpoint.position_rad, r.position_rad, 0xFFFF),
            codec.to_code(setpoint.velocity_rad_s, r.velocity_rad_s, 0xFFFF),
            codec.gain_to_code(setpoint.kp_Nm_rad, r.kp_Nm_rad, 0xFFFF),
            codec.gain_to_code(setpoint.kd_Nms_rad, r.kd_Nms_rad, 0xFFFF),
        )
        torque = codec.to_code(setpoint.torque_Nm, r.torque_Nm, 0xFFFF)
        return self.wide(Type.CONTROL, data, torque)

    def enable(self):
        if self.node.settings.variant in ELEVEN_BITS:
            return self.send(codec.ENABLE)
        return self.wide(Type.ENABLE)

    def ticks(self, count):
        for _ in range(count):
            self.node.tick(1e-3)

    def register(self, register, command=RegisterCommand.READ, raw=bytes(4)):
        """Value of a Damiao register as answered."""
        data = codec.pack_register(NODE, command, register, raw)
        ((reply_id, reply),) = self.send(data, codec.REGISTER_ID)
        assert reply_id == self.node.registers[Register.MASTER_ID]
        answer = codec.parse_register(reply)
        assert answer[:3] == (NODE, command, register)
        return answer.raw

    def parameter(self, index):
        ((can_id, data),) = self.wide(Type.READ, wide.pack_parameter(index))
        assert can_id == wide.pack_id(Type.READ, NODE, HOST)
        found, raw = wide.parse_parameter(data)
        assert found == index
        return raw

    def write(self, index, raw):
        ((can_id, _),) = self.wide(Type.WRITE, wide.pack_parameter(index, raw))
        return wide.parse_status(wide.parse_id(can_id).data)


@pytest.fixture(params=(*ELEVEN_BITS, *WIDE))
def bench(request):
    return Bench(request.param)


# --- all variants ---------------------------------------------------------------------------------


def test_power_on__nobody_asks__silent_and_without_power(bench):
    bench.ticks(200)
    assert bench.frames == []
    assert not bench.servo.is_energised


def test_setpoint__disabled__no_power_and_answered(bench):
    assert len(bench.follow(torque_Nm=5.0)) == 1
    bench.ticks(3)
    assert not bench.servo.is_energised
    assert bench.servo.torque_target_Nm == 0.0


def test_setpoint__enabled__law_with_gains_and_the_present_motion(bench):
    bench.enable()
    bench.servo.sense(0.2, 0.5)
    bench.follow(
        position_rad=0.3, velocity_rad_s=0.0, kp_Nm_rad=20.0, kd_Nms_rad=1.0, torque_Nm=1.0
    )
    expected_Nm = 20.0 * (0.3 - 0.2) - 1.0 * 0.5 + 1.0
    assert bench.servo.torque_target_Nm == pytest.approx(expected_Nm, abs=0.1)
    bench.servo.sense(0.3, 0.0)
    bench.ticks(1)
    assert bench.servo.torque_target_Nm == pytest.approx(1.0, abs=0.1)


def test_setpoint__gains_at_their_ends__limited_to_the_motors_torque(bench):
    bench.enable()
    bench.follow(position_rad=12.0, kp_Nm_rad=500.0, torque_Nm=15.0)
    assert bench.servo.torque_target_Nm == bench.servo.torque_max_Nm == 15.0


def test_zero__anywhere__the_present_angle_is_zero(bench):
    bench.servo.sense(1.0, 0.0)
    if bench.node.settings.variant in ELEVEN_BITS:
        bench.send(codec.SET_ZERO)
    else:
        bench.wide(Type.SET_ZERO, b"\x01" + bytes(7))
    assert bench.node.position_rad == 0.0
    bench.servo.sense(1.5, 0.0)
    assert bench.node.position_rad == pytest.approx(0.5, abs=2e-3)


def test_power_on__shaft_turned_many_times__angle_within_half_a_turn(bench):
    bench.servo.sense(20.0, 0.0)
    bench.node.power_on()
    assert bench.node.position_rad == pytest.approx(20.0 - 3 * 2 * 3.14159265, abs=2e-3)
    bench.servo.sense(26.0, 0.0)
    assert bench.node.position_rad == pytest.approx(26.0 - 3 * 2 * 3.14159265, abs=2e-3)


def test_reply__any_motion__codes_of_the_encoders_angle(bench):
    bench.servo.sense(0.777, -3.0)
    ((_, data),) = bench.follow()
    code = struct.unpack(">H", data[:2] if bench.node.settings.variant in WIDE else data[1:3])[0]
    counts = round(0.777 / (2 * 3.14159265) * 4096)
    assert code == codec.to_code(counts * 2 * 3.14159265 / 4096, 12.5, 0xFFFF)


def test_receive__other_motors_and_other_kinds_of_frame__nothing(bench):
    bench.enable()
    bench.frames.clear()
    target = bench.servo.torque_target_Nm
    own = EFF_FLAG | NODE if bench.node.settings.variant in ELEVEN_BITS else NODE
    for can_id in (own, NODE + 1, 0x080, EFF_FLAG | 2, wide.pack_id(1, 0xFFFF, 2), RTR_FLAG | NODE):
        assert bench.send(codec.DISABLE, can_id) == []
    for length in range(8):
        assert bench.send(codec.DISABLE[:length]) == []
    assert bench.servo.is_energised
    assert bench.servo.torque_target_Nm == target


@pytest.mark.parametrize("variant", [*ELEVEN_BITS, *WIDE])
def test_receive__random_and_mutated_frames__no_exception_and_torque_within_limits(variant, capsys):
    chance = random_source(capsys, f"mit node {variant}")
    bench = Bench(variant)
    good = [codec.pack_setpoint(bench.setpoint(torque_Nm=9.0), RANGES), codec.ENABLE, codec.DISABLE,
            codec.CLEAR_FAULT, codec.pack_register(1, RegisterCommand.WRITE, 9, b"\1\0\0\0"),
            wide.pack_parameter(Parameter.TORQUE_LIMIT, wide.F32.pack(9.0))]  # fmt: skip
    ids = (NODE, NODE, codec.REGISTER_ID, codec.INJECT_FAULT_ID | NODE)
    for _ in range(FUZZ_FRAMES):
        can_id = chance.choice(ids)
        if variant in WIDE or chance.random() < 0.1:
            kind = chance.choice((*Type, chance.randrange(32)))
            can_id = wide.pack_id(kind, chance.getrandbits(16), bench.node.node_id & 0xFF)
        bench.servo.sense(chance.uniform(-9.0, 9.0), chance.uniform(-30.0, 30.0))
        bench.node.receive(can_id, babble(chance, chance.choice(good)))
        bench.node.tick(1e-3)
        assert abs(bench.servo.torque_target_Nm) <= bench.servo.torque_max_Nm
        assert bench.servo.is_energised == bench.node.is_enabled
        assert not (bench.node.is_enabled and bench.node.fault)
        assert bench.servo.is_energised or bench.servo.torque_target_Nm == 0.0
        if chance.random() < 0.01:
            bench.node.power_on()
    assert all(len(data) <= 8 for _, data in bench.frames)


# --- Damiao ---------------------------------------------------------------------------------------


@pytest.fixture
def damiao():
    return Bench("damiao")


def test_damiao__power_states__as_the_reply_says(damiao):
    assert damiao.status(codec.DISABLE) == 0
    assert damiao.status(codec.ENABLE) == 1
    assert damiao.servo.is_energised
    assert damiao.status(codec.CLEAR_FAULT) == 1
    assert damiao.status(codec.DISABLE) == 0
    assert not damiao.servo.is_energised


def test_damiao__refresh__state_without_any_change(damiao):
    refresh = codec.pack_register(NODE, RegisterCommand.REFRESH, 0)
    assert damiao.status(refresh, codec.REGISTER_ID) == 0
    damiao.enable()
    assert damiao.status(refresh, codec.REGISTER_ID) == 1


@pytest.mark.parametrize("units", [20, 400, 20_000])
def test_damiao__register_9__lost_communication_after_so_many_50_us(damiao, units):
    damiao.register(Register.TIMEOUT, RegisterCommand.WRITE, codec.U32.pack(units))
    damiao.enable()
    damiao.follow(torque_Nm=2.0)
    limit = units // 20
    damiao.ticks(limit - 1)
    assert damiao.servo.torque_target_Nm == pytest.approx(2.0, abs=STEP_NM)
    damiao.ticks(1)
    assert not damiao.servo.is_energised
    assert damiao.status(codec.ENABLE) == 0xD, "needs FB first"
    assert damiao.status(codec.DISABLE) == 0xD
    assert damiao.status(codec.CLEAR_FAULT) == 0
    assert damiao.status(codec.ENABLE) == 1


def test_damiao__register_9_zero__never(damiao):
    damiao.enable()
    damiao.follow(torque_Nm=2.0)
    damiao.ticks(5000)
    assert damiao.servo.is_energised


def test_damiao__register_traffic__does_not_feed_the_watchdog(damiao):
    damiao.register(Register.TIMEOUT, RegisterCommand.WRITE, codec.U32.pack(100))
    damiao.enable()
    for _ in range(6):
        damiao.register(Register.TIMEOUT)
        damiao.ticks(1)
    assert not damiao.servo.is_energised


def test_damiao__registers__ranges_mode_and_identifiers_act(damiao):
    damiao.register(Register.TORQUE_RANGE, RegisterCommand.WRITE, codec.F32.pack(5.0))
    damiao.enable()
    damiao.send(codec.pack_setpoint(damiao.setpoint(torque_Nm=15.0), RANGES))
    assert damiao.servo.torque_target_Nm == 5.0
    damiao.register(Register.CONTROL_MODE, RegisterCommand.WRITE, codec.U32.pack(2))
    assert damiao.send(codec.pack_setpoint(damiao.setpoint(torque_Nm=-15.0), RANGES)) == []
    assert damiao.servo.torque_target_Nm == 5.0
    damiao.register(Register.MASTER_ID, RegisterCommand.WRITE, codec.U32.pack(0x55))
    assert damiao.send(codec.DISABLE)[0][0] == 0x55
    damiao.register(Register.NODE_ID, RegisterCommand.WRITE, codec.U32.pack(9))
    assert damiao.send(codec.DISABLE) == []
    assert damiao.send(codec.DISABLE, 9)[0][1][0] == 9


@pytest.mark.parametrize(
    ("register", "raw"),
    [
        (Register.TORQUE_RANGE, codec.F32.pack(float("nan"))),
        (Register.TORQUE_RANGE, codec.F32.pack(0.0)),
        (Register.POSITION_RANGE, codec.F32.pack(float("inf"))),
        (Register.CONTROL_MODE, codec.U32.pack(0)),
        (Register.NODE_ID, codec.U32.pack(0x800)),
        (Register.GEAR_RATIO, codec.F32.pack(3.0)),
        (Register.SERIAL, codec.U32.pack(3)),
    ],
)
def test_damiao__value_that_cannot_be_meant__register_stays(damiao, register, raw):
    before = damiao.register(register)
    assert damiao.register(register, RegisterCommand.WRITE, raw) == before
    assert damiao.register(register) == before


def test_damiao__injected_fault__reported_until_cleared(damiao):
    damiao.enable()
    damiao.send(codec.INJECT_FAULT_DATA, codec.INJECT_FAULT_ID | NODE)
    assert not damiao.servo.is_energised
    assert damiao.status(codec.ENABLE) == 0xA
    assert damiao.status(codec.CLEAR_FAULT) == 0


# --- mini-cheetah ---------------------------------------------------------------------------------


@pytest.mark.parametrize(("variant", "length"), [("tmotor", 6), ("cubemars", 8)])
def test_mini_cheetah__every_frame__answered_with_its_length(variant, length):
    bench = Bench(variant)
    for data in (codec.ENABLE, codec.DISABLE, codec.SET_ZERO, codec.CLEAR_FAULT, bytes(8)):
        ((reply_id, reply),) = bench.send(data)
        assert (reply_id, len(reply), reply[0]) == (REPLY, length, NODE)


def test_mini_cheetah__enabled_again__old_set_point_acts_at_once():
    bench = Bench("tmotor")
    bench.enable()
    bench.follow(torque_Nm=4.0)
    bench.send(codec.DISABLE)
    bench.follow(torque_Nm=0.0)  # not looked at
    bench.enable()
    assert bench.servo.torque_target_Nm == pytest.approx(4.0, abs=STEP_NM)


def test_mini_cheetah__watchdog__no_torque_but_power_and_back_with_the_next_set_point():
    bench = Bench("cubemars", watchdog_ms=10)
    bench.enable()
    bench.follow(torque_Nm=4.0)
    bench.ticks(10)
    assert bench.servo.torque_target_Nm == 0.0
    assert bench.servo.is_energised
    bench.follow(torque_Nm=4.0)
    assert bench.servo.torque_target_Nm == pytest.approx(4.0, abs=STEP_NM)


def test_cubemars__fault__in_the_last_byte_until_switched_off():
    bench = Bench("cubemars")
    bench.enable()
    bench.node.fail(5)
    ((_, reply),) = bench.follow(torque_Nm=4.0)
    assert reply[7] == 5
    bench.enable()
    assert not bench.servo.is_energised
    assert [bench.send(codec.DISABLE)[0][1][7] for _ in range(2)] == [5, 0]


# --- CyberGear, RobStride -------------------------------------------------------------------------


@pytest.mark.parametrize("variant", WIDE)
def test_wide__identity__unique_number_to_all_hosts(variant):
    bench = Bench(variant, is_lockstep=True)
    answer = (wide.pack_id(Type.IDENTITY, NODE, wide.ALL_HOSTS), b"HIL-LOCK")
    assert bench.wide(Type.IDENTITY) == [answer]
    assert Bench(variant).wide(Type.IDENTITY)[0][1] == b"HIL-WALL"


@pytest.mark.parametrize("variant", WIDE)
def test_wide__power_states__in_the_replies_identifier(variant):
    bench = Bench(variant)
    for kind, mode in ((Type.STOP, 0), (Type.ENABLE, 2), (Type.CONTROL, 2), (Type.STOP, 0)):
        ((can_id, _),) = bench.wide(kind)
        assert can_id == wide.feedback_id(Status(NODE, mode, 0), HOST)


@pytest.mark.parametrize("variant", WIDE)
def test_wide__fault__reported_once_and_in_every_reply_until_cleared(variant):
    bench = Bench(variant)
    bench.enable()
    ((can_id, data),) = bench.send(codec.INJECT_FAULT_DATA, codec.INJECT_FAULT_ID | NODE)
    assert can_id == wide.pack_id(Type.FAULT_REPORT, NODE, HOST)
    assert wide.FAULT_REPORT.unpack(data)[0]
    for kind in (Type.CONTROL, Type.ENABLE, Type.STOP):
        ((can_id, _),) = bench.wide(kind)
        assert can_id == wide.feedback_id(Status(NODE, 0, 2), HOST)
    ((can_id, _),) = bench.wide(Type.STOP, wide.CLEAR_DATA)
    assert can_id == wide.feedback_id(Status(NODE, 0, 0), HOST)


def test_robstride__can_timeout__off_at_power_on_then_reset_mode():
    bench = Bench("robstride")
    bench.enable()
    bench.ticks(5000)
    assert bench.servo.is_energised
    bench.write(Parameter.CAN_TIMEOUT, wide.U32.pack(200))
    bench.follow(torque_Nm=3.0)
    bench.ticks(9)
    assert bench.servo.torque_target_Nm == pytest.approx(3.0, abs=STEP_NM)
    bench.ticks(1)
    assert not bench.servo.is_energised
    ((can_id, _),) = bench.wide(Type.CONTROL)
    assert can_id == wide.feedback_id(Status(NODE, 0, 0), HOST)


def test_cybergear__can_timeout__no_such_parameter():
    bench = Bench("cybergear", watchdog_ms=10)
    ((can_id, data),) = bench.wide(Type.READ, wide.pack_parameter(Parameter.CAN_TIMEOUT))
    assert can_id == wide.pack_id(Type.READ, 1 << 8 | NODE, HOST)
    assert data[4:] == bytes(4)
    bench.enable()
    bench.ticks(10)
    assert not bench.servo.is_energised


@pytest.mark.parametrize("variant", WIDE)
def test_wide__parameters__written_read_and_acting(variant):
    bench = Bench(variant)
    bench.servo.sense(0.5, 1.0)
    assert wide.F32.unpack(bench.parameter(Parameter.POSITION))[0] == pytest.approx(0.5, abs=2e-3)
    bench.write(Parameter.TORQUE_LIMIT, wide.F32.pack(2.0))
    assert wide.F32.unpack(bench.parameter(Parameter.TORQUE_LIMIT))[0] == 2.0
    bench.enable()
    bench.follow(torque_Nm=9.0)
    assert bench.servo.torque_target_Nm == 2.0
    bench.write(Parameter.RUN_MODE, wide.U8.pack(2))
    assert bench.servo.torque_target_Nm == 0.0
    bench.follow(torque_Nm=9.0)
    assert bench.servo.torque_target_Nm == 0.0, "not followed in another mode"
    for raw in (wide.F32.pack(float("nan")), wide.F32.pack(-1.0), wide.F32.pack(1e9)):
        bench.write(Parameter.TORQUE_LIMIT, raw)
        assert 0.0 <= bench.node.torque_limit_Nm <= 15.0


def test_wide__node_id_changed__answers_to_the_new_one():
    bench = Bench("robstride")
    bench.wide(Type.SET_NODE_ID, middle=9 << 8 | HOST)
    assert bench.wide(Type.STOP) == []
    assert len(bench.send(bytes(8), wide.pack_id(Type.STOP, HOST, 9))) == 1
