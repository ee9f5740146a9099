"""The emulated CiA 402 drive, driven frame by frame in emulated time."""

import itertools
import math
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.cia402 import codec, sdo
from drivers.cia402.codec import Cia402State, EmcyCode, Index, NmtCommand, NmtState
from drivers.cia402.sdo import SdoAbort
from drivers.frame import RTR_FLAG
from sim_backend.cia402.heartbeat import HeartbeatProducer
from sim_backend.cia402.node import Cia402Node, Cia402Settings
from sim_backend.cia402.objects import ENTRIES
from sim_backend.servo import Servo
from sim_backend.settings import ServoSettings
from tests.sim_backend.cia402_bench import NODE, TICK_S, Bench, PEAK_Nm

S = Cia402State


@pytest.fixture
def bench():
    return Bench()


# --- torque, scaling, statusword ------------------------------------------------------------------


def test_node__enabled_in_cst__applies_torque_at_the_next_sync(bench):
    bench.enable()
    bench.rpdo(0x0F, 400)
    assert bench.servo.torque_target_Nm == 0.0
    bench.sync()
    assert bench.servo.torque_target_Nm == pytest.approx(0.4 * PEAK_Nm)


def test_node__torque_and_current_actual__are_per_mille_of_the_ratings():
    bench = Bench(Cia402Settings(rated_torque_Nm=5.0))
    assert bench.read(Index.RATED_TORQUE, 0, codec.U32) == 5000
    assert bench.read(Index.RATED_CURRENT, 0, codec.U32) == round(5.0 / 1.5 * 1000)
    bench.enable()
    for _ in range(50):
        values = bench.cycle(0x0F, -600)
    assert bench.servo.torque_Nm == pytest.approx(-3.0, rel=1e-3)
    assert values[2] == -600
    assert bench.read(Index.CURRENT_ACTUAL, 0, codec.I16) == -600
    assert bench.read(Index.TORQUE_ACTUAL, 0, codec.I16) == -600


@pytest.mark.parametrize(("current_A", "shown"), [(10.0, 32767), (-10.0, -32768)])
def test_node__actual_beyond_sixteen_bits__stays_at_the_end_of_the_range(current_A, shown):
    bench = Bench(Cia402Settings(rated_torque_Nm=0.1))
    bench.servo.current_A = current_A
    assert bench.read(Index.TORQUE_ACTUAL, 0, codec.I16) == shown
    assert bench.read(Index.MAX_TORQUE, 0, codec.U16) == 65535


def test_node__default_ratings__are_the_servo_at_peak_current(bench):
    assert bench.read(Index.RATED_TORQUE, 0, codec.U32) == 15_000
    assert bench.read(Index.RATED_CURRENT, 0, codec.U32) == 10_000
    assert bench.read(Index.MAX_TORQUE, 0, codec.U16) == 1000


def test_node__position_and_velocity__are_single_turn_counts(bench):
    bench.servo.sense(-math.tau / 4, math.pi)
    assert bench.read(Index.POSITION_ACTUAL, 0, codec.I32) == 3072
    assert bench.read(Index.VELOCITY_ACTUAL, 0, codec.I32) == 2048
    assert bench.read(Index.POSITION_RANGE, 1, codec.I32) == 0
    assert bench.read(Index.POSITION_RANGE, 2, codec.I32) == 4095
    assert bench.read(Index.ENCODER_RESOLUTION, 1, codec.U32) == 4096
    assert bench.read(Index.ENCODER_RESOLUTION, 2, codec.U32) == 1


@pytest.mark.parametrize("rated_Nm", [2.667, 5.0, 4.0, 0.7, 14.999])
def test_node__largest_target__never_beyond_what_the_servo_can_do(rated_Nm):
    """The limit is a whole number of per mille below the peak, whatever the master has set."""
    bench = Bench(Cia402Settings(rated_torque_Nm=rated_Nm))
    step_Nm = rated_Nm / 1000.0
    shown = bench.read(Index.MAX_TORQUE, 0, codec.U16)
    assert PEAK_Nm - step_Nm < shown * step_Nm <= PEAK_Nm * (1 + 1e-9)
    bench.must_write(Index.MAX_TORQUE, 0, codec.U16, 0xFFFF)
    bench.enable(32767)
    assert bench.servo.torque_target_Nm == pytest.approx(shown * step_Nm)
    assert bench.servo.torque_target_Nm <= PEAK_Nm * (1 + 1e-9)
    assert bench.sync()[0] & codec.STATUS_INTERNAL_LIMIT


@pytest.mark.parametrize("target", [700, -700])
def test_node__target_beyond_max_torque__is_clipped_and_says_so(bench, target):
    bench.must_write(Index.MAX_TORQUE, 0, codec.U16, 300)
    bench.enable()
    statusword, _, _ = bench.cycle(0x0F, target)
    assert bench.servo.torque_target_Nm == pytest.approx(math.copysign(0.3 * PEAK_Nm, target))
    assert statusword & codec.STATUS_INTERNAL_LIMIT
    statusword, _, _ = bench.cycle(0x0F, 300)
    assert not statusword & codec.STATUS_INTERNAL_LIMIT


def test_node__max_torque_lowered_in_motion__acts_at_once(bench):
    bench.enable(500)
    bench.must_write(Index.MAX_TORQUE, 0, codec.U16, 100)
    assert bench.servo.torque_target_Nm == pytest.approx(0.1 * PEAK_Nm)


def test_node__no_mode__energises_without_torque(bench):
    bench.nmt(NmtCommand.START)
    for controlword in (0x06, 0x07, 0x0F):
        statusword, _, _ = bench.cycle(controlword, 500)
    assert bench.servo.is_energised
    assert bench.servo.torque_target_Nm == 0.0
    assert not statusword & codec.STATUS_FOLLOWS_COMMAND
    bench.must_write(Index.MODE, 0, codec.I8, codec.CST)
    assert bench.servo.torque_target_Nm == pytest.approx(0.5 * PEAK_Nm)
    assert bench.sync()[0] & codec.STATUS_FOLLOWS_COMMAND


@pytest.mark.parametrize("controlword", [0x00, 0x02, 0x06, 0x07, 0x80])
def test_node__leaving_operation_enabled__removes_torque_at_that_sync(bench, controlword):
    bench.enable(500)
    bench.cycle(controlword, 500)
    assert bench.servo.torque_target_Nm == 0.0
    assert not bench.servo.is_energised


def test_node__statusword__carries_voltage_and_remote(bench):
    assert bench.read(Index.STATUSWORD, 0, codec.U16) == 0x0250
    bench.enable()
    assert bench.read(Index.STATUSWORD, 0, codec.U16) == 0x1237


def test_node__other_modes__are_refused(bench):
    for mode in (-1, 1, 3, 4, 8, 9, 11):
        assert bench.write(Index.MODE, 0, codec.I8, mode) == SdoAbort.VALUE_RANGE
    bench.must_write(Index.MODE, 0, codec.I8, 10)
    assert bench.read(Index.MODE_DISPLAY, 0, codec.I8) == 10
    bench.must_write(Index.MODE, 0, codec.I8, 0)
    assert bench.read(Index.MODE_DISPLAY, 0, codec.I8) == 0
    assert bench.read(Index.SUPPORTED_MODES, 0, codec.U32) == 0x200


def test_node__quick_stop_options__are_those_offered(bench):
    accepted = [
        option
        for option in range(-3, 10)
        if bench.write(Index.QUICK_STOP_OPTION, 0, codec.I16, option) is None
    ]
    assert accepted == [0, 1, 2, 5, 6]
    assert bench.read(Index.QUICK_STOP_OPTION, 0, codec.I16) == 6


# --- network management ---------------------------------------------------------------------------


def test_node__power_on__boots_up_into_pre_operational(bench):
    assert bench.sent == [(codec.COB_HEARTBEAT + NODE, b"\0")]
    assert bench.node.nmt_state is NmtState.PRE_OPERATIONAL


@pytest.mark.parametrize("command", [NmtCommand.RESET_NODE, NmtCommand.RESET_COMMUNICATION])
def test_node__reset__boots_up_again_with_defaults(bench, command):
    bench.must_write(Index.PRODUCER_HEARTBEAT, 0, codec.U16, 100)
    bench.must_write(Index.CYCLE_TIME, 1, codec.U8, 2)
    bench.nmt(NmtCommand.START)
    bench.sent.clear()
    bench.nmt(command)
    assert bench.sent == [(codec.COB_HEARTBEAT + NODE, b"\0")]
    assert bench.node.nmt_state is NmtState.PRE_OPERATIONAL
    assert bench.read(Index.PRODUCER_HEARTBEAT, 0, codec.U16) == 0
    kept = command is NmtCommand.RESET_COMMUNICATION
    assert bench.read(Index.CYCLE_TIME, 1, codec.U8) == (2 if kept else 1)


def test_node__pre_operational__answers_sdo_but_no_pdo(bench):
    bench.sent.clear()
    bench.rpdo(0x06)
    bench.node.receive(codec.COB_SYNC, b"")
    assert bench.sent == []
    assert bench.read(Index.CONTROLWORD, 0, codec.U16) == 0


def test_node__stopped__answers_neither_sdo_nor_pdo(bench):
    bench.must_write(Index.PRODUCER_HEARTBEAT, 0, codec.U16, 10)
    bench.nmt(NmtCommand.STOP)
    bench.sent.clear()
    bench.node.receive(codec.COB_SDO_RX + NODE, sdo.sdo_upload_request(0x1000, 0))
    bench.rpdo(0x06)
    bench.node.receive(codec.COB_SYNC, b"")
    bench.node.drive.fail(EmcyCode.HARDWARE)
    bench.tick(0.01)
    assert bench.sent == [(codec.COB_HEARTBEAT + NODE, bytes((NmtState.STOPPED,)))]


def test_node__nmt_for_somebody_else__is_ignored(bench):
    bench.node.receive(codec.COB_NMT, codec.pack_nmt(NmtCommand.START, NODE + 1))
    assert bench.node.nmt_state is NmtState.PRE_OPERATIONAL
    bench.node.receive(codec.COB_NMT, codec.pack_nmt(NmtCommand.START, 0))
    assert bench.node.nmt_state is NmtState.OPERATIONAL


def test_node__before_power_on__is_dead():
    servo = Servo(ServoSettings(torque_constant_Nm_A=1.5))
    sent = []
    node = Cia402Node(NODE, servo, sent.append, Cia402Settings(heartbeat_ms=1))
    node.receive(codec.COB_NMT, codec.pack_nmt(NmtCommand.START, NODE))
    node.tick(0.1)
    assert sent == []


def test_node__heartbeat__is_produced_at_its_period(bench):
    bench.must_write(Index.PRODUCER_HEARTBEAT, 0, codec.U16, 20)
    bench.nmt(NmtCommand.START)
    bench.sent.clear()
    bench.tick(0.1)
    assert bench.sent == [(codec.COB_HEARTBEAT + NODE, b"\x05")] * 5


def test_heartbeat_producer__period_no_multiple_of_the_tick__keeps_the_mean_rate():
    producer = HeartbeatProducer()
    producer.start(3)
    assert sum(producer.is_due(0.002) for _ in range(30)) == 20


def test_node__settings__reach_the_dictionary():
    bench = Bench(Cia402Settings(heartbeat_ms=50, serial=77), is_lockstep=True)
    assert bench.read(Index.PRODUCER_HEARTBEAT, 0, codec.U16) == 50
    assert bench.read(Index.IDENTITY, 4, codec.U32) == 77
    assert bench.read(Index.TIME_BASE, 0, codec.U8) == 1
    assert Bench().read(Index.TIME_BASE, 0, codec.U8) == 0
    bench.must_write(Index.CYCLE_TIME, 1, codec.U8, 25)
    bench.must_write(Index.CYCLE_TIME, 2, codec.I8, -4)
    assert bench.node.cycle_time_s == pytest.approx(2.5e-3)


def test_node__identity__claims_no_vendor(bench):
    identity = [bench.read(Index.IDENTITY, sub, codec.U32) for sub in (1, 2, 3, 4)]
    assert identity == [0, int.from_bytes(b"HIL1"), 0x0001_0000, 0]
    assert bench.read(Index.DEVICE_TYPE, 0, codec.U32) & 0xFFFF == 402


# --- faults and emergency messages ----------------------------------------------------------------


def test_node__injected_fault__goes_through_reaction_and_reset(bench):
    bench.enable(500)
    bench.must_write(Index.INJECT_FAULT, 0, codec.U8, 0x42)
    assert bench.state is S.FAULT_REACTION_ACTIVE
    assert not bench.servo.is_energised
    assert bench.take_emcy() == [(0x5042, 0x81)]
    bench.tick()
    assert bench.state is S.FAULT
    assert bench.read(Index.ERROR_CODE, 0, codec.U16) == 0x5042
    assert bench.read(Index.ERROR_REGISTER, 0, codec.U8) == 0x81
    bench.cycle(0x00)
    bench.cycle(0x80)
    assert bench.state is S.SWITCH_ON_DISABLED
    assert bench.take_emcy() == [(0, 0)]
    assert bench.read(Index.ERROR_CODE, 0, codec.U16) == 0
    for controlword in (0x06, 0x07, 0x0F):
        bench.cycle(controlword)
    assert bench.state is S.OPERATION_ENABLED


def test_node__two_faults__are_one_error_reset(bench):
    bench.must_write(Index.INJECT_FAULT, 0, codec.U8, 1)
    bench.must_write(Index.INJECT_FAULT, 0, codec.U8, 2)
    bench.must_write(Index.INJECT_FAULT, 0, codec.U8, 2)
    assert bench.take_emcy() == [(0x5001, 0x81), (0x5002, 0x81)]
    bench.tick()
    bench.must_write(Index.CONTROLWORD, 0, codec.U16, 0x80)
    assert bench.take_emcy() == [(0, 0)]


def test_node__error_history__keeps_the_newest_first_and_can_be_cleared(bench):
    abort = bench.request(sdo.sdo_upload_request(Index.ERROR_HISTORY, 1)).abort_code
    assert abort == SdoAbort.NO_DATA
    for number in range(1, 11):
        bench.must_write(Index.INJECT_FAULT, 0, codec.U8, number)
    assert bench.read(Index.ERROR_HISTORY, 0, codec.U8) == 8
    history = [bench.read(Index.ERROR_HISTORY, sub, codec.U32) for sub in range(1, 9)]
    assert history == [0x5000 + number for number in range(10, 2, -1)]
    assert bench.write(Index.ERROR_HISTORY, 0, codec.U8, 1) == SdoAbort.VALUE_RANGE
    bench.must_write(Index.ERROR_HISTORY, 0, codec.U8, 0)
    assert bench.read(Index.ERROR_HISTORY, 0, codec.U8) == 0


# --- hostile frames -------------------------------------------------------------------------------


SDO_COMMANDS = bytes.fromhex("2F 2B 23 22 21 40 60 70 00 10 01")


def random_frame(rng):
    """Frames that reach the handlers more often than pure noise would."""
    kind = rng.random()
    data = rng.randbytes(rng.choice((0, 1, 2, 4, 6, 8, 8, 8)))
    if kind < 0.2:
        return rng.choice((rng.getrandbits(11), rng.getrandbits(32))), data
    if kind < 0.35:
        return codec.COB_SYNC, b""
    if kind < 0.5:
        words = (0x00, 0x02, 0x06, 0x07, 0x0F, 0x80, rng.getrandbits(16))
        torque = rng.randrange(-0x8000, 0x8000)
        return codec.COB_RPDO1 + NODE, codec.RPDO1.pack(rng.choice(words), torque)
    if kind < 0.55:
        return codec.COB_NMT, bytes((rng.choice((1, 1, 1, 1, 2, 128, 129, 130)), NODE))
    if kind < 0.6:
        return codec.COB_HEARTBEAT + rng.getrandbits(7), data
    entry = rng.choice(ENTRIES)
    command = rng.choice((*SDO_COMMANDS, rng.getrandbits(8)))
    value = rng.choice((rng.randbytes(4), bytes((rng.choice((0, 1, 2, 6, 10)), 0, 0, 0))))
    head = bytes((command, entry.index & 0xFF, entry.index >> 8, entry.subindex))
    return codec.COB_SDO_RX + NODE, head + value


def check_invariants(bench):
    drive, state = bench.node.drive, bench.node.drive.machine.state
    limit_Nm = drive.max_torque * drive.rated_torque_mNm * 1e-6
    is_enabled = state is S.OPERATION_ENABLED
    assert state in set(S)
    assert abs(bench.servo.torque_target_Nm) <= limit_Nm * (1 + 1e-12)
    assert bench.servo.torque_target_Nm == 0.0 or (is_enabled and drive.mode == codec.CST)
    assert bench.servo.is_energised == (is_enabled or state is S.QUICK_STOP_ACTIVE)
    assert all(len(data) <= 8 for _, data in bench.sent)


def test_node__twenty_thousand_hostile_frames__never_raise_nor_exceed_the_limit(bench):
    rng = random.Random(402)
    seen = set()
    for step in range(20_000):
        if step % 200 == 0:  # whatever came before, a reset leads back to a working drive
            bench.nmt(NmtCommand.RESET_NODE)
            bench.enable()
        bench.node.receive(*random_frame(rng))
        if step % 4 == 0:
            bench.tick()
        check_invariants(bench)
        seen.add(bench.node.drive.machine.state)
        bench.sent.clear()
    assert seen == set(S) - {S.NOT_READY_TO_SWITCH_ON}


@given(st.integers(0, 0xFFFF_FFFF), st.binary(max_size=8))
def test_node__any_frame__never_raises(can_id, data):
    bench = Bench()
    bench.enable()
    bench.node.receive(can_id, data)
    bench.node.tick(TICK_S)


def test_node__remote_requests__are_ignored(bench):
    bench.enable()
    for can_id in itertools.chain(range(0x180, 0x800, 0x80), (0,)):
        bench.node.receive((can_id + NODE) | RTR_FLAG, b"")
    assert bench.sent == []
    assert bench.state is S.OPERATION_ENABLED
