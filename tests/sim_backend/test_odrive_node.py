"""The emulated ODrive: states, errors, watchdog, parameters, addresses, the firmware's quirks."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.frame import EFF_FLAG, RTR_FLAG, unpack_frame
from drivers.odrive import codec
from drivers.odrive.codec import Address, AxisError, AxisState, Command, ProcedureResult
from drivers.odrive.endpoints import EMULATED, INJECT_FAULT_ID, TIME_BASE_ID, Endpoint
from sim_backend.odrive.node import OdriveNode, OdriveNodeSettings
from sim_backend.servo import Servo
from sim_backend.settings import ServoSettings
from tests.odrive_fuzz import FUZZ_FRAMES, babble, random_source

NODE = 3
TICK_S = 1e-3
MOTOR_NM = 15.0


class Bench:
    """One drive; its motor stands still unless it is moved. A master's hands, and a clock."""

    def __init__(self, *, is_lockstep=False, **changes):
        self.sent = []
        self.servo = Servo(ServoSettings(torque_constant_Nm_A=1.5))
        self.servo.sense(0.0, 0.0)
        self.node = OdriveNode(
            NODE,
            self.servo,
            lambda frame: self.sent.append(unpack_frame(frame)),
            OdriveNodeSettings(**changes),
            is_lockstep=is_lockstep,
        )
        self.node.power_on()
        self.pass_time(0.03)
        self.sent.clear()

    def send(self, command, data=b"", *, node=NODE, flags=0):
        self.node.receive(codec.can_id(node, command) | flags, data)

    def ask(self, command, *, flags=RTR_FLAG):
        self.send(command, flags=flags)
        ((can_id, data),) = self.sent[-1:]
        assert can_id == codec.can_id(self.node.node_id, command)
        return data

    def take(self, command, node=NODE):
        wanted = codec.can_id(node, command)
        taken = [data for can_id, data in self.sent if can_id == wanted]
        self.sent = [item for item in self.sent if item[0] != wanted]
        return taken

    def set(self, endpoint, value):
        self.send(Command.RX_SDO, EMULATED.write(endpoint, value))

    def read(self, endpoint):
        self.send(Command.RX_SDO, EMULATED.read(endpoint))
        (data,) = self.take(Command.TX_SDO)
        return codec.parse_sdo(data)

    def pass_time(self, duration_s, feed=None):
        for _ in range(round(duration_s / TICK_S)):
            if feed is not None:
                feed()
            self.servo.drive()
            self.servo.drive()
            self.node.tick(TICK_S)
            self.node.begin_period()

    def arm(self, mode=codec.ControlMode.TORQUE):
        self.set(Endpoint.TORQUE_MODE_VEL_LIMIT, value=False)
        self.send(Command.CONTROLLER_MODE, codec.U32_PAIR.pack(mode, 1))
        self.request(AxisState.CLOSED_LOOP_CONTROL)
        assert self.state == AxisState.CLOSED_LOOP_CONTROL
        self.sent.clear()
        return self

    def request(self, state):
        self.send(Command.AXIS_STATE, codec.U32.pack(state))

    def torque(self, torque_Nm):
        self.send(Command.INPUT_TORQUE, codec.F32.pack(torque_Nm))

    @property
    def state(self):
        return self.node.axis.state

    @property
    def errors(self):
        return self.node.axis.errors


@pytest.fixture
def bench():
    return Bench()


# --- what it tells ------------------------------------------------------------------------------


def test_power_on__address_then_heartbeat_that_it_initialises():
    sent = []
    servo = Servo(ServoSettings(torque_constant_Nm_A=1.5))
    node = OdriveNode(NODE, servo, lambda frame: sent.append(unpack_frame(frame)))
    node.receive(codec.can_id(NODE, Command.VERSION), b"")
    assert not sent, "it is not switched on"
    node.power_on()
    assert [can_id for can_id, _ in sent] == [0x066, 0x061]
    assert codec.parse_heartbeat(sent[1][1]).errors == AxisError.INITIALIZING
    for _ in range(100):
        node.tick(TICK_S)
    assert codec.parse_heartbeat(sent[-1][1]) == codec.Heartbeat(0, AxisState.IDLE, 0, True)


def test_cyclic__defaults__heartbeat_every_100_ms_and_encoder_every_10(bench):
    bench.pass_time(1.0)
    assert len(bench.take(Command.HEARTBEAT)) == 10
    assert len(bench.take(Command.ENCODER)) == 100
    assert not bench.sent


def test_cyclic__rates_written__as_written(bench):
    bench.set(Endpoint.ENCODER_RATE, 1)
    bench.set(Endpoint.HEARTBEAT_RATE, 20)
    bench.set(Endpoint.TORQUES_RATE, 5)
    bench.pass_time(1.0)
    counts = [len(bench.take(c)) for c in (Command.ENCODER, Command.HEARTBEAT, Command.TORQUES)]
    assert counts == [1000, 50, 200]
    bench.set(Endpoint.HEARTBEAT_RATE, 0)
    bench.pass_time(0.5)
    assert not bench.take(Command.HEARTBEAT)


@pytest.mark.parametrize("flags", [0, RTR_FLAG])
@pytest.mark.parametrize(
    "command",
    [Command.VERSION, Command.ERROR, Command.ADDRESS, Command.ENCODER, Command.IQ,
     Command.TEMPERATURE, Command.BUS, Command.TORQUES, Command.POWERS],
)  # fmt: skip
def test_poll__remote_request_or_empty_frame__answered_once_with_8_bytes(bench, command, flags):
    assert len(bench.ask(command, flags=flags)) == 8
    assert len(bench.sent) == 1


def test_poll__remote_request_with_a_length__answered(bench):
    bench.send(Command.IQ, bytes(8), flags=RTR_FLAG)
    assert len(bench.take(Command.IQ)) == 1


def test_poll__extended_identifier_or_other_node__silent(bench):
    bench.send(Command.ENCODER, flags=EFF_FLAG)
    bench.send(Command.ENCODER, node=NODE + 1)
    bench.send(Command.ENCODER, node=codec.BROADCAST_NODE)
    assert not bench.sent


def test_encoder__turning__quantised_turns_that_count_on():
    bench = Bench(gear_ratio=5.0)
    step = 5.0 / bench.servo.counts_per_turn
    for k in range(2000):
        q_rad = 0.01 * k
        bench.servo.sense(q_rad, 10.0)
        bench.pass_time(TICK_S)
        position_rev, velocity_rev_s = codec.parse_f32_pair(bench.ask(Command.ENCODER))
        assert position_rev == pytest.approx(5.0 * q_rad / math.tau, abs=0.51 * step + 1e-5)
        assert position_rev / step == pytest.approx(round(position_rev / step), abs=1e-2)
    assert velocity_rev_s == pytest.approx(5.0 * 10.0 / math.tau, rel=0.02)


def test_encoder__standing__velocity_exactly_zero(bench):
    bench.servo.sense(0.3, 0.0)
    bench.pass_time(0.5)
    assert codec.parse_f32_pair(bench.ask(Command.ENCODER))[1] == 0.0


def test_absolute_position__set__counted_from_there(bench):
    bench.servo.sense(1.0, 0.0)
    bench.send(Command.ABSOLUTE_POSITION, codec.F32.pack(7.25))
    assert codec.parse_f32_pair(bench.ask(Command.ENCODER))[0] == pytest.approx(7.25)
    bench.servo.sense(1.0 + math.tau / 4, 0.0)
    assert codec.parse_f32_pair(bench.ask(Command.ENCODER))[0] == pytest.approx(7.5, abs=1e-3)
    bench.send(Command.ABSOLUTE_POSITION, codec.F32.pack(math.nan))
    assert codec.parse_f32_pair(bench.ask(Command.ENCODER))[0] == pytest.approx(7.5, abs=1e-3)


def test_iq_torques_bus__under_torque__those_of_the_motor():
    bench = Bench(gear_ratio=2.0).arm()
    bench.torque(1.5)
    bench.pass_time(0.02)
    setpoint_A, measured_A = codec.parse_f32_pair(bench.ask(Command.IQ))
    assert setpoint_A == pytest.approx(2.0)
    assert measured_A == pytest.approx(2.0, abs=0.01)
    target_Nm, estimate_Nm = codec.parse_f32_pair(bench.ask(Command.TORQUES))
    assert (target_Nm, estimate_Nm) == (pytest.approx(1.5), pytest.approx(1.5, abs=0.01))
    voltage_V, current_A = codec.parse_f32_pair(bench.ask(Command.BUS))
    assert voltage_V == 48.0
    assert current_A == pytest.approx(2.0**2 * 2.0 / 48.0, abs=0.01)
    electrical_W, mechanical_W = codec.parse_f32_pair(bench.ask(Command.POWERS))
    assert (electrical_W, mechanical_W) == (pytest.approx(8.0, abs=0.1), 0.0)


# --- states -------------------------------------------------------------------------------------


def test_closed_loop__asked_for__energised_and_told_by_the_heartbeat(bench):
    bench.request(AxisState.CLOSED_LOOP_CONTROL)
    assert bench.servo.is_energised
    bench.pass_time(0.1)
    assert codec.parse_heartbeat(bench.take(Command.HEARTBEAT)[0])[:2] == (0, 8)
    bench.request(AxisState.IDLE)
    assert not bench.servo.is_energised
    assert bench.servo.torque_target_Nm == 0.0


def test_closed_loop__not_calibrated__refused_without_an_error():
    bench = Bench(is_calibrated=False)
    bench.request(AxisState.CLOSED_LOOP_CONTROL)
    assert not bench.servo.is_energised
    assert bench.node.axis.heartbeat()[:3] == (0, AxisState.IDLE, ProcedureResult.NOT_CALIBRATED)
    bench.request(AxisState.FULL_CALIBRATION_SEQUENCE)
    assert bench.node.axis.heartbeat().result == ProcedureResult.BUSY
    bench.pass_time(0.2)
    assert bench.node.axis.heartbeat()[:3] == (0, AxisState.IDLE, ProcedureResult.SUCCESS)
    bench.request(AxisState.CLOSED_LOOP_CONTROL)
    assert bench.servo.is_energised


def test_closed_loop__with_an_active_error__refused(bench):
    bench.send(Command.ESTOP)
    bench.request(AxisState.CLOSED_LOOP_CONTROL)
    assert not bench.servo.is_energised
    bench.send(Command.CLEAR_ERRORS, b"\0")
    bench.request(AxisState.CLOSED_LOOP_CONTROL)
    assert bench.servo.is_energised


@pytest.mark.parametrize("state", [5, 9, 11, 14, 99, 0xFFFF_FFFF])
def test_axis_state__not_offered__invalid_and_nothing_changes(bench, state):
    bench.request(state)
    assert (bench.state, bench.node.axis.result) == (1, ProcedureResult.INVALID_STATE)


def test_estop__armed__disarmed_with_its_reason(bench):
    bench.arm().torque(2.0)
    bench.send(Command.ESTOP)
    assert not bench.servo.is_energised
    errors, reason = codec.parse_u32_pair(bench.ask(Command.ERROR))
    assert errors == reason == AxisError.ESTOP_REQUESTED
    assert bench.node.axis.result == ProcedureResult.DISARMED


def test_error__while_idle__active_but_no_disarm_reason(bench):
    bench.send(Command.ESTOP)
    assert codec.parse_u32_pair(bench.ask(Command.ERROR)) == (AxisError.ESTOP_REQUESTED, 0)


def test_overspeed__beyond_limit_and_tolerance__disarmed(bench):
    bench.arm()
    bench.set(Endpoint.VEL_LIMIT, 1.0)
    q_rad = 0.0
    for rate_rad_s in (1.1 * math.tau, 1.4 * math.tau):
        assert not bench.errors
        for _ in range(100):
            q_rad += rate_rad_s * TICK_S
            bench.servo.sense(q_rad, rate_rad_s)
            bench.pass_time(TICK_S)
    assert bench.errors == AxisError.VELOCITY_LIMIT_VIOLATION


def test_fault__emulators_own_endpoint__drv_fault(bench):
    bench.arm()
    bench.send(Command.RX_SDO, codec.pack_sdo(codec.Sdo(1, INJECT_FAULT_ID, b"\1")))
    assert bench.errors == AxisError.DRV_FAULT


@pytest.mark.parametrize("is_lockstep", [False, True])
def test_time_base__read__what_it_was_built_with(is_lockstep):
    bench = Bench(is_lockstep=is_lockstep)
    bench.send(Command.RX_SDO, codec.pack_sdo(codec.Sdo(0, TIME_BASE_ID, b"")))
    assert codec.parse_sdo(bench.take(Command.TX_SDO)[0]).value == bytes((is_lockstep,))


# --- torque -------------------------------------------------------------------------------------


@pytest.mark.parametrize("padding", [0, 4])
def test_input_torque__4_or_8_bytes__applied_at_once(bench, padding):
    bench.arm().send(Command.INPUT_TORQUE, codec.F32.pack(-2.5) + bytes(padding))
    assert bench.servo.torque_target_Nm == -2.5


@pytest.mark.parametrize("length", [1, 2, 3])
def test_input_torque__too_short__the_last_one_stays(bench, length):
    bench.arm().torque(1.0)
    bench.send(Command.INPUT_TORQUE, bytes(length))
    assert bench.servo.torque_target_Nm == 1.0


def test_input_torque__not_a_number__none(bench):
    bench.arm().torque(math.nan)
    assert bench.servo.torque_target_Nm == 0.0


def test_input_torque__geared__times_the_ratio_at_the_joint():
    bench = Bench(gear_ratio=4.0).arm()
    bench.torque(1.0)
    assert bench.servo.torque_target_Nm == 4.0


def test_input_torque__while_idle__kept_for_later_and_not_applied(bench):
    bench.torque(1.0)
    assert bench.servo.torque_target_Nm == 0.0
    bench.arm()
    assert bench.servo.torque_target_Nm == 1.0


@pytest.mark.parametrize(("limit_A", "reach_Nm"), [(4.0, 6.0), (100.0, MOTOR_NM), (-1.0, 0.0)])
def test_limits__current__torque_within(bench, limit_A, reach_Nm):
    bench.arm().send(Command.LIMITS, codec.F32_PAIR.pack(50.0, limit_A))
    bench.torque(1e6)
    assert bench.servo.torque_target_Nm == reach_Nm
    assert codec.F32.unpack(bench.read(Endpoint.CURRENT_SOFT_MAX).value)[0] == limit_A


def test_limits__soft_torque__within(bench):
    bench.arm()
    bench.set(Endpoint.TORQUE_SOFT_MAX, 2.0)
    bench.set(Endpoint.TORQUE_SOFT_MIN, -1.0)
    for asked, applied in ((5.0, 2.0), (-5.0, -1.0), (math.inf, 2.0)):
        bench.torque(asked)
        assert bench.servo.torque_target_Nm == applied


def test_torque_mode_velocity_limit__default__torque_falls_short_at_standstill(bench):
    bench.arm()
    bench.set(Endpoint.TORQUE_MODE_VEL_LIMIT, value=True)
    bench.torque(8.0)
    assert bench.servo.torque_target_Nm == pytest.approx(10.0 / 6.0)


def test_velocity_mode__set_input_vel__pushes_towards_it(bench):
    bench.arm(codec.ControlMode.VELOCITY)
    bench.send(Command.INPUT_VEL, codec.F32_PAIR.pack(2.0, 0.0))
    bench.pass_time(TICK_S)
    first = bench.servo.torque_target_Nm
    assert first == pytest.approx(2.0 / 6.0, rel=0.01)
    bench.pass_time(0.5)
    assert bench.servo.torque_target_Nm == pytest.approx(first + 0.5 * 2.0 / 3.0, rel=0.02)


def test_position_mode__set_input_pos__pushes_towards_it(bench):
    bench.arm(codec.ControlMode.POSITION)
    bench.send(Command.VEL_GAINS, codec.F32_PAIR.pack(0.5, 0.0))
    bench.send(Command.POS_GAIN, codec.F32.pack(10.0))
    bench.send(Command.INPUT_POS, codec.F32.pack(0.1) + bytes(4))
    bench.pass_time(TICK_S)
    assert bench.servo.torque_target_Nm == pytest.approx(0.5, rel=1e-3)


def test_mode__unknown__no_torque(bench):
    bench.arm(77).torque(3.0)
    assert bench.servo.torque_target_Nm == 0.0


# --- watchdog -----------------------------------------------------------------------------------


def watched(bench, timeout_s=0.02):
    bench.arm()
    bench.set(Endpoint.WATCHDOG_TIMEOUT, timeout_s)
    bench.set(Endpoint.ENABLE_WATCHDOG, value=True)
    bench.torque(2.0)
    return bench


def test_watchdog__silence__torque_off_after_the_time_and_no_sooner(bench):
    watched(bench)
    bench.pass_time(0.02)
    assert bench.servo.torque_target_Nm == 2.0
    bench.pass_time(TICK_S)
    assert not bench.servo.is_energised
    assert bench.errors == bench.node.axis.disarm_reason == AxisError.WATCHDOG_TIMER_EXPIRED


@pytest.mark.parametrize(
    ("command", "data", "flags"),
    [
        (Command.INPUT_TORQUE, codec.F32.pack(2.0), 0),
        (Command.ENCODER, b"", 0),
        (Command.IQ, b"", RTR_FLAG),
        (Command.HEARTBEAT, bytes(8), 0),
        (Command.INPUT_TORQUE, b"\0", 0),
        (0x1F, b"", 0),
    ],
)
def test_watchdog__any_frame_for_the_axis__feeds_it(bench, command, data, flags):
    watched(bench).pass_time(0.1, feed=lambda: bench.send(command, data, flags=flags))
    assert bench.servo.torque_target_Nm == 2.0


@pytest.mark.parametrize("node", [NODE + 1, codec.BROADCAST_NODE])
def test_watchdog__frames_for_others__do_not(bench, node):
    watched(bench).pass_time(0.1, feed=lambda: bench.send(Command.ENCODER, node=node))
    assert not bench.servo.is_energised


def test_watchdog__in_idle__error_without_disarm(bench):
    bench.set(Endpoint.WATCHDOG_TIMEOUT, 0.02)
    bench.set(Endpoint.ENABLE_WATCHDOG, value=True)
    bench.pass_time(0.05)
    assert (bench.errors, bench.node.axis.disarm_reason) == (AxisError.WATCHDOG_TIMER_EXPIRED, 0)
    bench.send(Command.CLEAR_ERRORS, b"\0")
    assert bench.errors == 0


def test_watchdog__off__the_last_torque_for_ever(bench):
    bench.arm().torque(2.0)
    bench.pass_time(5.0)
    assert bench.servo.torque_target_Nm == 2.0


# --- parameters and restart ---------------------------------------------------------------------


@pytest.mark.parametrize("endpoint", list(Endpoint))
def test_parameters__written__read_back_unless_fixed(bench, endpoint):
    before = bench.read(endpoint).value
    value = False if endpoint is Endpoint.TORQUE_MODE_VEL_LIMIT else 1
    bench.set(endpoint, value)
    found = bench.read(endpoint).value
    if endpoint is Endpoint.TORQUE_CONSTANT:
        assert found == before == codec.F32.pack(1.5)
    else:
        assert codec.Sdo(0, 0, found) == codec.parse_sdo(
            bytes(4) + codec.parse_sdo(EMULATED.write(endpoint, value)).value
        )


@pytest.mark.parametrize("number", [0, 300, 0xFDFF, 0xFFFF])
def test_parameters__unknown_number__silent(bench, number):
    bench.send(Command.RX_SDO, codec.pack_sdo(codec.Sdo(0, number, b"")))
    bench.send(Command.RX_SDO, codec.pack_sdo(codec.Sdo(1, number, bytes(4))))
    bench.send(Command.RX_SDO, codec.pack_sdo(codec.Sdo(7, EMULATED.ids[Endpoint.VEL_LIMIT], b"")))
    assert not bench.sent


def test_parameters__too_few_bytes__unchanged(bench):
    before = bench.read(Endpoint.VEL_LIMIT)
    bench.send(Command.RX_SDO, EMULATED.write(Endpoint.VEL_LIMIT, 1.0)[:-1])
    assert bench.read(Endpoint.VEL_LIMIT) == before


@pytest.mark.parametrize(("action", "kept"), [(0, 10.0), (1, 4.0), (2, 10.0)])
def test_reboot__saved_or_not__parameters_and_torque(bench, action, kept):
    bench.arm().set(Endpoint.VEL_LIMIT, 4.0)
    bench.set(Endpoint.ENABLE_WATCHDOG, value=True)
    bench.send(Command.REBOOT, bytes((action,)))
    assert bench.servo.is_energised == (action == 1)
    bench.send(Command.REBOOT, b"\0")
    assert not bench.servo.is_energised
    assert codec.F32.unpack(bench.read(Endpoint.VEL_LIMIT).value)[0] == kept
    assert bench.read(Endpoint.ENABLE_WATCHDOG).value == bytes((action == 1,))
    assert bench.node.axis.controller.mode == codec.ControlMode.POSITION


# --- addresses ----------------------------------------------------------------------------------


def assign(bench, node, serial, connection=None):
    address = codec.pack_address(Address(node, serial), connection)
    bench.send(Command.ADDRESS, address, node=codec.BROADCAST_NODE)


def test_address__asked_by_broadcast__node_and_serial(bench):
    bench.send(Command.ADDRESS, node=codec.BROADCAST_NODE, flags=RTR_FLAG)
    (data,) = bench.take(Command.ADDRESS)
    assert codec.parse_address(data) == Address(NODE, 0x03_4C49_48)


@pytest.mark.parametrize("connection", [None, 0, 7])
def test_address__assigned_by_serial__answers_there_and_no_more_here(bench, connection):
    assign(bench, 9, bench.node.serial, connection)
    assert bench.take(Command.ADDRESS, 9)
    bench.send(Command.ENCODER)
    assert not bench.sent
    bench.send(Command.ENCODER, node=9)
    assert bench.take(Command.ENCODER, 9)


def test_address__given_to_another__unaddressed_and_silent_until_it_has_one(bench):
    assign(bench, NODE, 0x1234)
    assert codec.parse_address(bench.take(Command.ADDRESS, 0x3F)[0]).node == 0x3F
    bench.pass_time(0.5)
    bench.send(Command.ENCODER)
    bench.send(Command.AXIS_STATE, codec.U32.pack(8), node=codec.BROADCAST_NODE)
    assert not bench.sent
    assert not bench.servo.is_energised
    bench.send(Command.ADDRESS, node=codec.BROADCAST_NODE, flags=RTR_FLAG)
    assert bench.take(Command.ADDRESS, 0x3F)
    assign(bench, NODE, bench.node.serial)
    bench.pass_time(0.2)
    assert bench.take(Command.HEARTBEAT)


def test_address__of_others__ignored(bench):
    assign(bench, 9, 0x1234)
    assign(bench, 200, bench.node.serial)
    assert bench.node.node_id == NODE
    assert not bench.sent


def test_broadcast__estop_clear_reboot__for_all(bench):
    bench.arm().send(Command.ESTOP, node=codec.BROADCAST_NODE)
    assert not bench.servo.is_energised
    bench.send(Command.CLEAR_ERRORS, b"\0", node=codec.BROADCAST_NODE)
    assert not bench.errors
    bench.send(Command.REBOOT, b"\0", node=codec.BROADCAST_NODE)
    assert bench.errors == AxisError.INITIALIZING


# --- junk ---------------------------------------------------------------------------------------


def require_legal(bench):
    assert abs(bench.servo.torque_target_Nm) <= MOTOR_NM * (1 + 1e-9)
    assert bench.state in set(AxisState)
    assert bench.servo.is_energised == (bench.state == AxisState.CLOSED_LOOP_CONTROL)
    assert not (bench.errors and bench.servo.is_energised)


@settings(max_examples=200)
@given(
    st.lists(
        st.tuples(
            st.integers(0, 31), st.binary(max_size=8), st.sampled_from((0, RTR_FLAG, EFF_FLAG))
        ),
        max_size=30,
    )
)
def test_receive__any_frames__never_raises_and_stays_legal(frames):
    bench = Bench().arm()
    for command, data, flags in frames:
        bench.send(command, data, node=bench.node.node_id, flags=flags)
        bench.pass_time(TICK_S)
        require_legal(bench)


SENSIBLE = (
    (Command.AXIS_STATE, codec.U32.pack(8)),
    (Command.AXIS_STATE, codec.U32.pack(1)),
    (Command.CONTROLLER_MODE, codec.U32_PAIR.pack(1, 1)),
    (Command.INPUT_TORQUE, codec.F32.pack(3.0)),
    (Command.LIMITS, codec.F32_PAIR.pack(20.0, 8.0)),
    (Command.CLEAR_ERRORS, b"\0"),
    (Command.RX_SDO, EMULATED.write(Endpoint.WATCHDOG_TIMEOUT, 0.05)),
    (Command.RX_SDO, EMULATED.write(Endpoint.ENABLE_WATCHDOG, 1)),
    (Command.RX_SDO, EMULATED.write(Endpoint.TORQUE_SOFT_MAX, 5.0)),
    (Command.INPUT_VEL, codec.F32_PAIR.pack(1.0, 0.5)),
    (Command.ABSOLUTE_POSITION, codec.F32.pack(1.0)),
)


def test_fuzz__random_and_mutated_frames__no_exception_torque_limited_states_legal(capsys):
    chance = random_source(capsys, "odrive node")
    bench, armed, ticks = Bench().arm(), 0, 0
    for count in range(FUZZ_FRAMES):
        command, data = babble(chance, SENSIBLE)
        flags = RTR_FLAG if chance.random() < 0.05 else 0
        bench.send(command, data, node=bench.node.node_id, flags=flags)
        if count % 8 == 0:
            ticks += 1
            bench.servo.sense(0.5 * math.sin(0.01 * ticks), 5.0 * math.cos(0.01 * ticks))
            bench.pass_time(TICK_S)
            armed += bench.servo.is_energised
        require_legal(bench)
        if count % 500 == 0:
            assign(bench, NODE, bench.node.serial)
            bench.send(Command.REBOOT, b"\2")
            bench.pass_time(0.03)
            bench.arm()
            bench.sent.clear()
    assert armed > ticks / 20, "it was hardly ever under power"
