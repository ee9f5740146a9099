"""The emulated moteus controller, frame by frame: modes, watchdog, limits, registers, junk."""

import math
import random
from struct import unpack

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.frame import is_fd, unpack_frame
from drivers.moteus import codec
from drivers.moteus.codec import READ, WRITE
from drivers.moteus.registers import Mode, Register, Resolution
from sim_backend.moteus.node import FIRMWARE_VERSION, MoteusNode, MoteusNodeSettings
from sim_backend.presets import servo_preset
from sim_backend.servo import Servo
from tests.moteus_fuzz import FUZZ_FRAMES, babble, fuzz_seed, say  # noqa: F401 - a fixture

NODE = 3
INT8, INT16, INT32, FLOAT = Resolution
BEFORE, AFTER = codec.torque_frame_parts(9.0, 0.02)


def torque_frame(tau_Nm, parts=(BEFORE, AFTER)):
    return parts[0] + codec.VALUE[FLOAT].pack(tau_Nm) + parts[1]


def write(register, resolution, *numbers):
    return codec.pack_values(WRITE, register, resolution, *numbers)


def read(register, resolution=FLOAT, count=1):
    return codec.pack_head(READ, register, resolution, count)


class Bench:
    """One controller, its servo, and all that it sends."""

    def __init__(self, **settings):
        self.servo = Servo(servo_preset("bench")[0])
        self.sent = []
        self.node = MoteusNode(NODE, self.servo, self._take, MoteusNodeSettings(**settings))
        self.node.power_on()

    def _take(self, frame):
        assert is_fd(frame)
        self.sent.append(unpack_frame(frame))

    def send(self, data, can_id=None):
        """Send a frame that asks for a reply; return the registers replied, and note the data."""
        count = len(self.sent)
        self.node.receive(codec.request_id(NODE) if can_id is None else can_id, codec.pad(data))
        return codec.parse_replies(self.sent[-1][1]) if len(self.sent) > count else None

    @property
    def mode(self):
        return self.send(codec.POLL)[Register.MODE]

    @property
    def fault(self):
        return self.send(codec.POLL)[Register.FAULT]

    def ticks(self, count):
        for _ in range(count):
            self.node.tick(1e-3)

    def enable(self, tau_Nm=0.0):
        for _ in range(10):
            self.send(torque_frame(tau_Nm))
            self.ticks(1)
        assert self.mode == Mode.POSITION
        self.send(torque_frame(tau_Nm))
        return self


@pytest.fixture
def bench():
    return Bench()


# --- who is meant ---------------------------------------------------------------------------


def test_receive__frame_for_it__answers_the_sender(bench):
    bench.send(codec.POLL, codec.request_id(NODE, 9))
    assert [can_id for can_id, _ in bench.sent] == [codec.reply_id(NODE, 9)]


@pytest.mark.parametrize(
    "can_id",
    [
        codec.request_id(NODE + 1),
        codec.request_id(0),
        codec.request_id(NODE, prefix=1),
        codec.request_id(NODE | 0x80),
    ],
)
def test_receive__frame_for_another__is_ignored(bench, can_id):
    assert bench.send(torque_frame(1.0), can_id) is None
    assert bench.mode == Mode.STOPPED


def test_receive__no_reply_wanted__obeys_in_silence(bench):
    assert bench.send(torque_frame(1.0), codec.request_id(NODE, wants_reply=False)) is None
    assert bench.mode == Mode.ENABLING


def test_receive__broadcast__obeys_and_answers(bench):
    assert bench.send(codec.POLL, codec.request_id(codec.BROADCAST))[Register.MODE] == 0


def test_receive__prefix_configured__only_frames_with_it():
    bench = Bench(can_prefix=5)
    assert bench.send(codec.POLL) is None
    assert bench.send(codec.POLL, codec.request_id(NODE, prefix=5)) is not None
    assert bench.sent[-1][0] == codec.reply_id(NODE, prefix=5)


# --- modes ----------------------------------------------------------------------------------


def test_mode__torque_command__enables_within_some_ms_then_the_torque_acts(bench):
    modes = []
    for _ in range(10):
        modes.append(bench.send(torque_frame(1.5))[Register.MODE])
        assert bench.servo.is_energised == (bench.node.controller.mode == Mode.POSITION)
        bench.ticks(1)
    assert modes[0] == Mode.STOPPED, "the reply is from before the command"
    assert modes[-1] == Mode.POSITION
    assert set(modes) <= {0, 2, 3, 4, 10}
    assert bench.servo.torque_target_Nm == pytest.approx(1.5)


def test_mode__stop__power_off_at_once(bench):
    bench.enable(2.0)
    assert bench.servo.torque_target_Nm == pytest.approx(2.0)
    bench.send(codec.STOP)
    assert not bench.servo.is_energised
    assert bench.servo.torque_target_Nm == 0.0
    assert bench.mode == Mode.STOPPED


def test_watchdog__no_command__times_out_when_it_said_and_latches_until_stop(bench):
    bench.enable(2.0)
    bench.node.controller.configuration["servo.timeout_mode"] = 0.0
    bench.ticks(19)
    assert bench.servo.torque_target_Nm == pytest.approx(2.0)
    for _ in range(5):
        assert bench.send(codec.POLL)[Register.MODE] == Mode.POSITION, "a query is no command"
    bench.ticks(1)
    assert not bench.servo.is_energised
    assert bench.mode == Mode.TIMEOUT
    bench.send(torque_frame(2.0))
    bench.ticks(20)
    assert bench.mode == Mode.TIMEOUT
    bench.send(codec.STOP)
    assert bench.mode == Mode.STOPPED
    bench.enable()


@pytest.mark.parametrize(("timeout", "default_s", "lives_ms"), [(0, 0.05, 50), (0, math.nan, 0)])
def test_watchdog__zero_in_the_command__the_configured_default_counts(
    bench, timeout, default_s, lives_ms
):
    bench.node.controller.configuration["servo.default_timeout_s"] = default_s
    data = torque_frame(1.0, codec.torque_frame_parts(9.0, timeout * 1e-3))
    for _ in range(10):
        bench.send(data)
        bench.ticks(1)
    bench.send(data)
    bench.ticks((lives_ms or 5000) - 1)
    assert bench.mode == Mode.POSITION
    bench.ticks(1)
    assert bench.mode == (Mode.TIMEOUT if lives_ms else Mode.POSITION)


@pytest.mark.parametrize(("timeout_mode", "is_energised"), [(0, False), (12, True), (15, True)])
def test_watchdog__each_timeout_mode__off_or_against_the_motion(bench, timeout_mode, is_energised):
    bench.enable(2.0)
    bench.node.controller.configuration["servo.timeout_mode"] = timeout_mode
    bench.servo.sense(0.0, 3.0)
    bench.ticks(25)
    assert bench.servo.is_energised == is_energised
    assert bench.servo.torque_target_Nm <= 0.0
    assert (bench.servo.torque_target_Nm < 0.0) == is_energised


def test_fault__while_powered__off_latched_and_cleared_by_stop_alone(bench):
    bench.enable(2.0)
    bench.send(write(Register.INJECT_FAULT, INT8, 33))
    assert not bench.servo.is_energised
    assert (bench.mode, bench.fault) == (Mode.FAULT, 33)
    bench.send(torque_frame(2.0))
    bench.ticks(20)
    assert (bench.mode, bench.fault) == (Mode.FAULT, 33)
    bench.send(codec.STOP)
    assert (bench.mode, bench.fault) == (Mode.STOPPED, 0)


def test_start__outside_the_position_limits__fault_39(bench):
    bench.node.controller.configuration["servopos.position_min"] = 0.4
    bench.servo.sense(0.0, 0.0)
    for _ in range(10):
        bench.send(torque_frame(1.0))
        bench.ticks(1)
    assert (bench.mode, bench.fault) == (Mode.FAULT, 39)
    assert not bench.servo.is_energised


@pytest.mark.parametrize("mode", [1, 2, 3, 4, 5, 8, 14, 16, 127, -1])
def test_mode__not_to_be_commanded__write_error_3_and_no_change(bench, mode):
    bench.send(write(Register.MODE, INT8, mode) + read(Register.MODE, INT8))
    assert bench.sent[-1][1][:3] == bytes((codec.WRITE_ERROR, Register.MODE, 3))
    assert bench.mode == Mode.STOPPED


# --- torque ---------------------------------------------------------------------------------


@pytest.mark.parametrize("tau_Nm", [20.0, -20.0, math.inf, math.nan, 3e38])
def test_torque__out_of_range__within_the_commands_limit_and_said_so(bench, tau_Nm):
    bench.enable(0.0).send(torque_frame(tau_Nm))
    finite = math.isfinite(tau_Nm)
    wanted = math.copysign(9.0, tau_Nm) if finite else 0.0
    assert bench.servo.torque_target_Nm == pytest.approx(wanted)
    assert bench.fault == (102 if finite else 0)


def test_torque__beyond_the_motor__what_the_motor_gives(bench):
    parts = codec.torque_frame_parts(300.0, 0.02)
    bench.enable()
    bench.send(torque_frame(299.0, parts))
    assert bench.servo.torque_target_Nm == pytest.approx(bench.servo.torque_max_Nm)


def test_command__each_frame__starts_from_the_defaults(bench):
    bench.enable(2.0)
    bench.send(
        write(Register.MODE, INT8, Mode.POSITION) + write(Register.COMMAND_POSITION, INT8, -128)
    )
    assert bench.node.controller.command.torque_Nm == 0.0
    assert bench.node.controller.command.kp_scale == 1.0


def test_command__mode_written_last__what_stood_before_is_lost(bench):
    """registers.md, 0x000: the mode must be written before any other register of the command."""
    bench.enable()
    bench.send(write(Register.COMMAND_TORQUE, FLOAT, 2.0) + write(Register.MODE, INT8, 10))
    assert bench.node.controller.command.torque_Nm == 0.0


def test_command__no_mode__is_none_but_is_read_back(bench):
    bench.enable(2.0)
    reply = bench.send(write(Register.COMMAND_TIMEOUT, INT16, 77) + read(Register.COMMAND_TIMEOUT))
    assert reply == {Register.COMMAND_TIMEOUT: pytest.approx(0.077)}
    bench.ticks(20)
    assert bench.mode == Mode.TIMEOUT


@given(st.floats(width=32), st.floats(0.01, 300.0), st.integers(1, 1000))
def test_torque_frame__answered_quickly_or_slowly__the_same(tau_Nm, max_Nm, timeout_ms):
    parts = codec.torque_frame_parts(max_Nm, timeout_ms * 1e-3)
    quick, slow = Bench(), Bench()
    for bench in (quick, slow):
        bench.servo.sense(0.7, -0.3)
        for tau in (0.0, 0.5, -0.5, 0.25, 0.125, 0.0625, tau_Nm):
            if bench is slow:
                bench.node._known_tails.clear()
            bench.send(torque_frame(tau, parts))
            bench.ticks(1)
    assert quick.sent == slow.sent
    commands = [bench.node.controller.command for bench in (quick, slow)]
    for name in _COMMAND:
        first, second = (getattr(command, name) for command in commands)
        assert first == pytest.approx(second, nan_ok=True)
    assert quick.servo.torque_target_Nm == pytest.approx(slow.servo.torque_target_Nm, nan_ok=True)


_COMMAND = ("mode", "position_rev", "velocity_rev_s", "torque_Nm", "kp_scale", "kd_scale",
            "max_torque_Nm", "timeout_s")  # fmt: skip


def test_poll__answered_quickly__as_the_registers_say(bench):
    bench.enable(1.0)
    bench.servo.sense(0.7, -0.3)
    quick = bench.send(codec.POLL)
    slow = bench.send(codec.POLL + bytes((codec.NOP,)))
    assert quick == slow


# --- registers ------------------------------------------------------------------------------


def test_position__many_turns__counts_on_and_is_quantised_by_the_encoder(bench):
    per_turn = bench.servo.counts_per_turn
    for step in range(200):
        q_rad = step * 0.3
        bench.servo.sense(q_rad, 0.0)
        bench.ticks(1)
        position = bench.send(codec.POLL)[Register.POSITION]
        assert position * per_turn == pytest.approx(round(position * per_turn), abs=1e-2)
        assert abs(position - q_rad / math.tau) <= 0.5 / per_turn + 1e-6


def test_read__run_over_an_unknown_register__values_error_values(bench):
    bench.send(read(0x00D, INT8, 4))
    data = bench.sent[-1][1]
    assert data.startswith(bytes((codec.REPLY | 3, 0x0D)))
    assert bytes((codec.READ_ERROR, 0x10, 1)) in data
    assert bench.send(read(0x00D, INT8, 4)) == {0x00D: 48.0, 0x00E: 25.0, 0x00F: 0.0}


def test_read__identity__as_32_bits_only(bench):
    wanted = {Register.FIRMWARE_VERSION: FIRMWARE_VERSION}
    assert bench.send(read(Register.FIRMWARE_VERSION, INT32)) == wanted
    assert bench.send(read(Register.FIRMWARE_VERSION, INT16)) == {}


def test_read__more_than_fits__a_whole_frame_of_what_fits(bench):
    reply = bench.send(read(0x000, FLOAT, 5) * 4)
    assert set(reply) == {0, 1, 2, 3, 4}
    assert len(bench.sent[-1][1]) <= 64
    assert not codec.parse_subframes(bench.sent[-1][1])[1]


@pytest.mark.parametrize(("register", "error"), [(0x001, 2), (0x00F, 2), (0x100, 2), (0x3FF, 1)])
def test_write__not_writable_or_unknown__error_of_the_protocol(bench, register, error):
    bench.send(write(register, INT8, 1))
    expected = bytes((codec.WRITE_ERROR,)) + codec.varuint(register) + bytes((error,))
    assert bench.sent[-1][1].startswith(expected)


@pytest.mark.parametrize("value", [0.0, -3.0, 128.0, math.nan, math.inf])
def test_inject_fault__no_code__refused(bench, value):
    bench.send(write(Register.INJECT_FAULT, FLOAT, value))
    assert bench.sent[-1][1][0] == codec.WRITE_ERROR
    assert bench.mode == Mode.STOPPED


def test_uuid_mask__of_another__frame_discarded_from_there_on(bench):
    uuid = unpack("<4i", b"".join(codec.VALUE[INT32].pack(n) for n in bench.node._uuid))
    ours = write(Register.UUID_MASK_1, INT32, *uuid)
    other = write(Register.UUID_MASK_1, INT32, uuid[0] + 1)
    assert bench.send(other + codec.POLL, codec.request_id(codec.BROADCAST)) is None
    assert bench.send(ours + codec.POLL, codec.request_id(codec.BROADCAST)) is not None


def test_console__line_in_pieces__one_answer_in_pieces(bench):
    for piece in (b"conf get ", b"motor.Kv", b"\r\n"):
        bench.send(codec.pack_stream(codec.CLIENT_DATA, 1, piece))
    text = b""
    for _ in range(10):
        bench.send(bytes((codec.CLIENT_POLL, 1, 3)))
        (part,) = codec.parse_subframes(bench.sent[-1][1])[0]
        assert len(part.data) <= 3
        text += part.data
    assert float(text) == pytest.approx(8.27 / bench.servo.settings.torque_constant_Nm_A)


@pytest.mark.parametrize(
    "line",
    [
        "conf",
        "conf get",
        "conf set x",
        "conf set motor.Kv x",
        "conf zzz motor.Kv",
        "zzz",
        "d fly",
        "conf get \xff",
    ],
)
def test_console__nonsense__one_error_line(bench, line):
    bench.send(codec.pack_stream(codec.CLIENT_DATA, 1, line.encode("latin-1") + b"\n"))
    bench.send(bytes((codec.CLIENT_POLL, 1, 48)))
    (part,) = codec.parse_subframes(bench.sent[-1][1])[0]
    assert part.data.startswith(b"ERR")
    assert part.data.endswith(b"\r\n")


def test_power_on__after_anything__as_new(bench):
    bench.enable(2.0)
    bench.node.power_on()
    assert bench.mode == Mode.STOPPED
    assert not bench.servo.is_energised


# --- junk -----------------------------------------------------------------------------------


def test_receive__random_and_mutated_frames__no_exception_and_torque_within_limits(say):  # noqa: F811
    seed = fuzz_seed()
    say(f"moteus node: HIL_TEST_SEED={seed} HIL_TEST_MOTEUS_FUZZ_FRAMES={FUZZ_FRAMES}")
    chance = random.Random(seed)
    bench = Bench()
    good = [torque_frame(9.0), torque_frame(-1.0), codec.POLL, codec.STOP, read(0, INT32, 20),
            write(Register.MODE, INT8, 10), write(Register.COMMAND_POSITION, FLOAT, 1.0, 2.0, 3.0),
            write(Register.MODE, INT8, 9) + write(Register.COMMAND_Q_CURRENT, FLOAT, 99.0),
            write(Register.SET_OUTPUT_EXACT, FLOAT, 1.0), write(Register.INJECT_FAULT, INT8, 33),
            codec.pack_stream(codec.CLIENT_DATA, 1, b"conf set servo.timeout_mode 15\n"),
            bytes((codec.CLIENT_POLL, 1, 48))]  # fmt: skip
    drive, servo = bench.node.controller, bench.servo
    for _ in range(FUZZ_FRAMES):
        bench.sent.clear()
        servo.sense(chance.uniform(-9.0, 9.0), chance.uniform(-30.0, 30.0))
        bench.send(babble(chance, good))
        bench.ticks(chance.randrange(4))
        assert drive.mode in (0, 1, 2, 3, 9, 10, 11, 12, 15)
        assert not servo.is_energised or drive.mode in (9, 10, 11, 12, 15)
        assert abs(servo.torque_target_Nm) <= servo.torque_max_Nm
        assert servo.is_energised or servo.torque_target_Nm == 0.0
        assert all(len(data) <= 64 for _, data in bench.sent)
        if drive.mode == Mode.FAULT and chance.random() < 0.5:
            bench.send(codec.STOP)
