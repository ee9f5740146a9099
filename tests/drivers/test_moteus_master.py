"""Master side of moteus: what only this family has. What all share is in the axis contract."""

import math
import random
from dataclasses import dataclass

import pytest

from drivers.arm_bus import SENT
from drivers.axis import AxisStatus
from drivers.bus import Bus
from drivers.errors import AmplifierError, BusError
from drivers.frame import EFF_FLAG, is_fd, pack_fd_frame, pack_frame, unpack_frame
from drivers.moteus import codec
from drivers.moteus.codec import READ_ERROR, REPLY
from drivers.moteus.master import JUMP_REV, MoteusAxis
from drivers.moteus.registers import FAULTS, Mode, Register, Resolution
from drivers.moteus.settings import MoteusSettings
from tests.drivers.axis_rig import AxisRig, keep, lose
from tests.moteus_fuzz import FUZZ_FRAMES, babble, fuzz_seed, say  # noqa: F401 - a fixture

ONE = codec.reply_id(1)
INT8, INT16, INT32, FLOAT = Resolution


def rig_of(**changes):
    return AxisRig("moteus", (changes, changes))


@pytest.fixture
def rig():
    return rig_of().configure()


def state(mode=10, position=0.1, velocity=0.2, torque=0.3, fault=None):
    """Data of a controller's reply."""
    data = codec.pack_values(REPLY, Register.MODE, INT8, mode)
    data += codec.pack_values(REPLY, Register.POSITION, FLOAT, position, velocity, torque)
    if fault is not None:
        data += codec.pack_values(REPLY, Register.FAULT, INT8, fault)
    return codec.pad(data)


@dataclass
class Alone:
    """An axis without a bus: replies in, requests out."""

    axis: MoteusAxis

    def reply(self, can_id=ONE, **values):
        self.axis.age_cycles = 1
        return self.axis.handlers()[can_id](pack_fd_frame(can_id, state(**values)))

    def cycle(self, tau_Nm=0.0, **values):
        """One cycle with a reply; return the request and the command, as data."""
        request = self.axis.request()
        self.reply(**values)
        command = self.axis.command(tau_Nm)
        self.axis.end_cycle()
        return unpack_frame(request)[1], command and unpack_frame(command)[1]


@pytest.fixture
def alone():
    return Alone(MoteusAxis(MoteusSettings(node_id=1, torque_max_Nm=9.0), joint=1, period_s=1e-3))


# --- start-up -------------------------------------------------------------------------------


def test_configure__emulated__named_with_resolutions_and_watchdog_set(rig):
    info = rig.infos[0]
    assert "48494C31" in info.name
    assert info.is_lockstep
    assert info.angle_resolution_rad == pytest.approx(math.tau / 4096)
    assert info.torque_resolution_Nm == 2.0**-20  # of a float32 between 8 and 16
    for node in rig.nodes:
        assert node.controller.configuration["servo.timeout_mode"] == Mode.STOPPED
        assert node.controller.configuration["servo.default_timeout_s"] == pytest.approx(0.02)


@pytest.mark.parametrize(("choice", "mode"), [("stop", 0), ("brake", 15), ("damp", 12)])
def test_configure__on_timeout__the_controllers_timeout_mode(choice, mode):
    rig = rig_of(on_timeout=choice).configure()
    assert rig.nodes[1].controller.configuration["servo.timeout_mode"] == mode


def test_configure__everything__goes_as_can_fd():
    rig = rig_of()
    sent = []
    rig.bus.log_frames(lambda way, frame: sent.append(frame) if way == SENT else None)
    rig.configure()
    assert all(is_fd(frame) for frame in sent if unpack_frame(frame)[0] != 0x1FFF_FFF0 | EFF_FLAG)


@pytest.mark.parametrize(
    ("changes", "configuration", "message"),
    [
        ({"counts_per_turn": 16384}, {}, "cpr is 4096, .* says 16384; correct counts_per_turn"),
        ({}, {"motor.Kv": 50.0}, "torque_max_Nm 15 is more than the motor gives, 1.65 Nm"),
        ({}, {"motor.Kv": 0.0}, "more than the motor gives"),
        ({}, {"motor_position.rotor_to_output_ratio": 10.0}, "more than the motor gives"),
    ],
)
def test_configure__scale_disagrees__refused_in_one_line(changes, configuration, message):
    rig = rig_of(**changes)
    for node in rig.nodes:
        node.controller.configuration |= configuration
    with pytest.raises(AmplifierError, match=message) as caught:
        rig.configure()
    assert "joint 1 (moteus id 1)" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_configure__geared__the_encoders_count_is_finer_at_the_output():
    rig = rig_of()
    for node in rig.nodes:
        node.controller.configuration["motor_position.rotor_to_output_ratio"] = 0.1
    rig.configure()
    assert rig.infos[0].angle_resolution_rad == pytest.approx(math.tau / 40960)


def test_configure__left_in_mode_11_by_a_dead_master__stopped_and_taken(rig):
    rig.enable()
    rig.to_drives = lose
    rig.cycles(30)
    assert all(node.controller.mode == Mode.TIMEOUT for node in rig.nodes)
    rig.to_drives = keep
    rig.infos = []
    rig.new_master().configure(heartbeat_cycles=0)
    assert all(node.controller.mode == Mode.STOPPED for node in rig.nodes)


def test_configure__in_fault__taken_and_told_as_a_fault(rig):
    rig.nodes[0].controller.fail(34)
    rig.bus = rig.new_master()
    rig.infos = []
    rig.configure().cycles(2)
    assert rig.axes[0].status is AxisStatus.FAULT
    assert rig.axes[0].note == "joint 1 (moteus id 1): fault 34 (over voltage)"


def test_configure__firmware_without_the_registers__refused():
    rig = rig_of()
    rig.nodes[0]._accepted.pop(Register.COMMAND_ILIMIT_SCALE)
    with pytest.raises(AmplifierError, match=r"knows no register 0x02B .* update its firmware"):
        rig.configure()


def test_configure__console_without_the_value__refused():
    rig = rig_of()
    del rig.nodes[0].controller.configuration["servo.timeout_mode"]
    with pytest.raises(AmplifierError, match=r"`conf set servo.timeout_mode` answers 'ERR"):
        rig.configure()


def test_configure__value_does_not_stick__refused():
    rig = rig_of()

    class Stubborn(dict):
        def __setitem__(self, name, value):
            pass

    controller = rig.nodes[0].controller
    controller.configuration = Stubborn(controller.configuration)
    with pytest.raises(AmplifierError, match=r"servo.timeout_mode is 12 although it was set to 0"):
        rig.configure()


def test_configure__console_busy_with_output_of_another__is_silenced_first():
    rig = rig_of()
    rig.nodes[0]._console._out = b"emit servo_stats\r\n" * 40
    rig.configure()


def test_configure__console_dead__refused():
    rig = rig_of()

    def deaf(frame):
        data = unpack_frame(frame)[1]
        return [] if data[:1] in (b"\x40", b"\x42") else [frame]

    rig.to_drives = deaf
    with pytest.raises(AmplifierError, match="console does not answer"):
        rig.configure()


def test_configure__bus_without_can_fd__refused_in_one_line():
    rig = rig_of()
    rig.loopback.carries_fd = False
    assert Bus.carries_fd
    with pytest.raises(BusError, match="carries no CAN FD frames"):
        rig.configure()


# --- the cycle ------------------------------------------------------------------------------


def test_request__disabled__asks_and_commands_nothing(alone):
    assert alone.cycle(1.0, mode=0, fault=0) == (codec.POLL, None)


def test_request__enabled__torque_of_the_last_command_and_zero_before_mode_10(alone):
    alone.cycle(mode=0)
    alone.axis.enable()
    before, after = codec.torque_frame_parts(9.0, 0.02)

    def torque(tau_Nm):
        return before + codec.VALUE[FLOAT].pack(tau_Nm) + after

    assert alone.cycle(2.0, mode=0) == (torque(0.0), None)
    assert alone.cycle(2.0, mode=3) == (torque(0.0), None)
    assert alone.cycle(3.0, mode=10) == (torque(0.0), None)
    assert alone.cycle(4.0, mode=10) == (torque(3.0), None)
    assert alone.cycle(5.0, mode=10) == (torque(4.0), None)


def test_command__not_a_number__no_torque(alone):
    alone.cycle(mode=0)
    alone.axis.enable()
    alone.cycle(mode=10)
    alone.cycle(math.nan, mode=10)
    request = unpack_frame(alone.axis.request())[1]
    assert codec.VALUE[FLOAT].unpack_from(request, 9) == (0.0,)


def test_disable__stop_goes_out_at_once_and_until_the_controller_has_stopped(alone):
    alone.cycle(mode=0)
    alone.axis.enable()
    alone.cycle(mode=10)
    alone.axis.disable()
    assert alone.cycle(1.0, mode=10)[1] == codec.STOP
    assert alone.cycle(1.0, mode=10) == (codec.POLL, codec.STOP)
    assert alone.cycle(1.0, mode=0) == (codec.POLL, None)
    assert alone.axis.status is AxisStatus.DISABLED


def test_disable__already_stopped_or_faulted__sends_no_stop_that_would_clear_a_fault(alone):
    for mode in (0, 1):
        alone.cycle(mode=mode, fault=33)
        alone.axis.disable()
        assert alone.cycle(mode=mode, fault=33) == (codec.POLL, None)


def test_enable__command_lost_and_disabled__mode_10_seen_later_is_stopped(alone):
    alone.cycle(mode=0)
    alone.axis.enable()
    alone.cycle(mode=0)
    alone.axis.disable()
    alone.cycle(mode=0)
    assert alone.cycle(mode=10)[1] == codec.STOP


def test_stop__by_another__power_is_not_asked_for_again(alone):
    alone.cycle(mode=0)
    alone.axis.enable()
    alone.cycle(mode=10)
    alone.cycle(mode=0)
    assert alone.axis.status is AxisStatus.DISABLED
    assert alone.cycle(1.0, mode=0) == (codec.POLL, None)


# --- what the controller says -----------------------------------------------------------------


@pytest.mark.parametrize("direction", [1, -1])
def test_reply__state__joint_units_and_direction(direction):
    settings = MoteusSettings(node_id=1, torque_max_Nm=9.0, direction=direction, offset_rad=0.5)
    alone = Alone(MoteusAxis(settings, joint=1, period_s=1e-3))
    assert alone.reply(position=0.125, velocity=-0.5, torque=1.5) is True
    axis = alone.axis
    assert axis.q_rad == pytest.approx(direction * math.tau / 8 + 0.5)
    assert axis.dq_rad_s == pytest.approx(-direction * math.pi)
    assert axis.tau_meas_Nm == pytest.approx(direction * 1.5)


@pytest.mark.parametrize("offset_rad", [0.0, 3.0, -3.0])
@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("position", [0.0, 0.4, 3.49, -2.3, 1000.25])
def test_reply__first_position__joint_within_half_a_turn_then_counts_on(
    position, direction, offset_rad
):
    settings = MoteusSettings(
        node_id=1, torque_max_Nm=9.0, direction=direction, offset_rad=offset_rad
    )
    alone = Alone(MoteusAxis(settings, joint=1, period_s=1e-3))
    alone.reply(position=position)
    start_rad = alone.axis.q_rad
    assert abs(start_rad) <= math.pi + 1e-3
    expected = direction * position * math.tau + offset_rad
    assert math.remainder(start_rad - expected, math.tau) == pytest.approx(0.0, abs=1e-3)
    for step in range(1, 11):
        alone.reply(position=position + 0.2 * step)
    assert alone.axis.q_rad - start_rad == pytest.approx(direction * 2 * math.tau, abs=1e-3)


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("what", ["position", "velocity", "torque"])
def test_reply__not_finite__is_no_feedback(alone, what, number):
    alone.reply(mode=0, position=0.1)
    assert alone.reply(mode=10, **{what: number}) is False
    assert alone.axis.age_cycles == 1
    assert alone.axis.status is AxisStatus.DISABLED
    assert alone.axis.q_rad == pytest.approx(0.1 * math.tau)


def test_reply__29_bits_for_a_small_identifier__is_taken_too(alone):
    assert alone.reply(ONE | EFF_FLAG) is True


def test_reply__laid_out_otherwise__is_taken_too(alone):
    data = bytes((codec.WRITE_ERROR, 0x2B, 1))
    data += codec.pack_values(REPLY, Register.MODE, INT16, 10)
    data += codec.pack_values(REPLY, Register.POSITION, INT32, 12500, 0, 500)
    assert alone.axis.handlers()[ONE](pack_fd_frame(ONE, codec.pad(data))) is True
    assert alone.axis.q_rad == pytest.approx(math.tau / 8)
    assert alone.axis.tau_meas_Nm == pytest.approx(0.5)
    assert alone.axis.status is AxisStatus.ENABLED


@pytest.mark.parametrize(
    "data",
    [
        b"",
        state()[:8],
        codec.pad(bytes((READ_ERROR, 0, 1)) + state()[3:]),
        codec.pad(codec.pack_values(REPLY, Register.MODE, FLOAT, math.nan) + state()[3:]),
        codec.pad(codec.pack_values(REPLY, Register.POSITION, FLOAT, 0.1, 0.1, 0.1)),
        codec.pack_stream(codec.SERVER_DATA, 1, b"OK\r\n").ljust(20, b"\x50"),
    ],
)
def test_reply__no_state__is_no_feedback(alone, data):
    alone.reply(mode=0)
    alone.axis.age_cycles = 1
    assert alone.axis.handlers()[ONE](pack_fd_frame(ONE, codec.pad(data))) is False
    assert alone.axis.age_cycles == 1


def test_reply__classic_frame__is_no_feedback_and_no_exception(alone):
    assert alone.axis.handlers()[ONE](pack_frame(ONE, bytes((0x21, 0, 10, 0, 0, 0, 0, 0)))) is False


def test_reply__twice_in_a_cycle__fresh_once(alone):
    assert alone.reply(mode=0) is True
    assert alone.axis.handlers()[ONE](pack_fd_frame(ONE, state(mode=0))) is False


@pytest.mark.parametrize("code", [*FAULTS, 99])
def test_fault__code__named_in_one_line(alone, code):
    alone.cycle(mode=0)
    alone.cycle(mode=1)
    assert alone.axis.note == "joint 1 (moteus id 1): fault"
    alone.cycle(mode=1, fault=code)
    assert alone.axis.status is AxisStatus.FAULT
    assert alone.axis.note == f"joint 1 (moteus id 1): fault {code} ({FAULTS.get(code, 'unknown')})"


@pytest.mark.parametrize(
    ("mode", "told", "is_stopped"),
    [(11, "no command for 20 ms", False), (12, "is in mode 12", True), (9, "is in mode 9", True)],
)
def test_mode__not_ours__fault_with_its_reason_and_stopped_if_it_has_power(
    alone, mode, told, is_stopped
):
    alone.cycle(mode=0)
    command = alone.cycle(mode=mode)[1]
    assert alone.axis.status is AxisStatus.FAULT
    assert told in alone.axis.note
    assert (command == codec.STOP) == is_stopped


def test_fault__cleared_by_a_stop_in_flight__stays_until_it_is_reset(alone):
    alone.cycle(mode=0)
    alone.axis.enable()
    alone.cycle(mode=10)
    alone.axis.disable()
    alone.cycle(mode=1, fault=33)
    alone.cycle(mode=0, fault=0)
    assert alone.axis.status is AxisStatus.FAULT
    alone.axis.reset_fault()
    assert alone.cycle(mode=0)[1] is None, "nothing left to clear"
    assert alone.axis.status is AxisStatus.DISABLED


def test_reset__fault_persists__reported_again(alone):
    alone.cycle(mode=1, fault=33)
    alone.axis.reset_fault()
    commands = [alone.cycle(mode=1, fault=33)[1] for _ in range(12)]
    assert commands[0] == codec.STOP
    assert commands[-1] is None
    assert alone.axis.status is AxisStatus.FAULT
    assert "fault 33" in alone.axis.note


@pytest.mark.parametrize("mode", [0, 10])
def test_position__jumps__lost_for_some_cycles_and_back_within_half_a_turn(alone, mode):
    alone.cycle(mode=mode, position=2.3)
    alone.cycle(mode=mode, position=2.3 - JUMP_REV - 0.05)
    assert alone.axis.status is AxisStatus.LOST
    assert "position jumped by -0.3 rev" in alone.axis.note
    assert abs(alone.axis.q_rad) <= math.pi
    alone.cycle(mode=0, position=2.0)
    assert alone.axis.status is AxisStatus.LOST, "long enough for the loop to see it"
    for _ in range(3):
        alone.cycle(mode=0, position=2.0)
    assert alone.axis.status is AxisStatus.DISABLED


def test_lost__silent__stops_are_sent_until_it_answers(alone):
    alone.cycle(mode=0)
    alone.axis.enable()
    alone.cycle(mode=10)
    for _ in range(51):
        alone.axis.command(1.0)
        alone.axis.end_cycle()
    assert alone.axis.status is AxisStatus.LOST
    assert "no reply for" in alone.axis.note
    assert unpack_frame(alone.axis.command(1.0))[1] == codec.STOP
    assert unpack_frame(alone.axis.request())[1] == codec.POLL


# --- junk -----------------------------------------------------------------------------------


def test_handlers__random_and_mutated_frames__no_exception_and_legal(alone, say):  # noqa: F811
    seed = fuzz_seed()
    say(f"moteus master: HIL_TEST_SEED={seed} HIL_TEST_MOTEUS_FUZZ_FRAMES={FUZZ_FRAMES}")
    chance = random.Random(seed)
    axis = alone.axis
    good = [state(), state(mode=0, fault=0), state(mode=1, fault=33), state(torque=math.nan),
            codec.pack_values(REPLY, 0, INT32, 10, 1, 2, 3)]  # fmt: skip
    take = axis.handlers()[ONE]
    alone.cycle(mode=0)
    for _ in range(FUZZ_FRAMES):
        data = babble(chance, good)
        fits = len(data) <= 8 and chance.random() < 0.5
        take(pack_frame(ONE, data) if fits else pack_fd_frame(ONE, data))
        chance.choice((axis.enable, axis.disable, axis.reset_fault, axis.end_cycle))()
        axis.command(chance.uniform(-1e3, 1e3))
        request = unpack_frame(axis.request())[1]
        if len(request) == codec.TORQUE_LENGTH:
            assert abs(codec.VALUE[FLOAT].unpack_from(request, 9)[0]) <= 9.0
        else:
            assert request == codec.POLL
        assert isinstance(axis.status, AxisStatus)
        assert math.isfinite(axis.q_rad + axis.dq_rad_s + axis.tau_meas_Nm)
        assert "\n" not in axis.note
        axis.age_cycles = chance.randrange(3)
