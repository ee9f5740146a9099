"""Loss of the master: RPDO deadline, consumer heartbeat, NMT, and what 6007 makes of it."""

import pytest

from drivers.cia402 import codec
from drivers.cia402.codec import Cia402State, EmcyCode, Index, NmtCommand
from tests.sim_backend.cia402_bench import Bench

S = Cia402State


@pytest.fixture
def bench():
    return Bench()


MASTER = 0x7F
REACTIONS = [  # 6007, state after the loss
    (0, S.OPERATION_ENABLED),
    (1, S.FAULT),
    (2, S.SWITCH_ON_DISABLED),
    (3, S.QUICK_STOP_ACTIVE),
]


def lose_rpdos(bench, timeout_ms):
    bench.must_write(Index.RPDO1_PARAMETER, 5, codec.U16, timeout_ms)
    bench.enable(500)


def lose_heartbeat(bench, timeout_ms):
    setting = codec.consumer_heartbeat(MASTER, timeout_ms)
    bench.must_write(Index.CONSUMER_HEARTBEAT, 1, codec.U32, setting)
    bench.enable(500)
    bench.node.receive(codec.COB_HEARTBEAT + MASTER, b"\x05")


WATCHDOGS = [(lose_rpdos, EmcyCode.RPDO_TIMEOUT), (lose_heartbeat, EmcyCode.HEARTBEAT_LOST)]


@pytest.mark.parametrize(("lose", "code"), WATCHDOGS)
@pytest.mark.parametrize(("option", "state"), REACTIONS)
def test_node__master_gone__reacts_as_6007_says_within_the_time(bench, lose, code, option, state):
    bench.must_write(Index.ABORT_CONNECTION_OPTION, 0, codec.I16, option)
    bench.must_write(Index.QUICK_STOP_OPTION, 0, codec.I16, 6)
    lose(bench, timeout_ms=20)
    bench.tick(0.018)
    assert bench.state is S.OPERATION_ENABLED
    assert bench.take_emcy() == []
    bench.tick(0.002)
    assert (bench.servo.torque_target_Nm == 0.0) is (option != 0)
    bench.tick()
    assert bench.state is state
    assert bench.take_emcy() == [(code, 0x11)]


@pytest.mark.parametrize("lose", [lose_rpdos, lose_heartbeat])
def test_node__master_silent_since_before_enabling__is_watched_from_first_reception(bench, lose):
    lose(bench, timeout_ms=20)
    bench.nmt(NmtCommand.RESET_NODE)
    bench.sent.clear()
    bench.must_write(Index.RPDO1_PARAMETER, 5, codec.U16, 20)
    setting = codec.consumer_heartbeat(MASTER, 20)
    bench.must_write(Index.CONSUMER_HEARTBEAT, 1, codec.U32, setting)
    bench.nmt(NmtCommand.START)
    bench.rpdo(0x06)
    bench.tick(1.0)
    assert bench.take_emcy() == []


def test_node__rpdos_in_time__keep_it_enabled(bench):
    lose_rpdos(bench, timeout_ms=10)
    for _ in range(100):
        bench.tick(0.008)
        bench.cycle(0x0F, 100)
    assert bench.state is S.OPERATION_ENABLED


def test_node__enabling_rpdo_alone__arms_the_deadline(bench):
    bench.must_write(Index.RPDO1_PARAMETER, 5, codec.U16, 10)
    bench.enable(500)
    bench.tick(0.011)
    assert bench.state is S.FAULT


def test_node__enabled_again_by_sdo__waits_for_a_new_first_rpdo(bench):
    lose_rpdos(bench, timeout_ms=10)
    for controlword in (0x00, 0x06, 0x07, 0x0F):
        bench.must_write(Index.CONTROLWORD, 0, codec.U16, controlword)
        bench.tick(0.005)
    bench.tick(1.0)
    assert bench.state is S.OPERATION_ENABLED
    bench.rpdo(0x0F, 100)
    bench.tick(0.02)
    assert bench.state is S.FAULT


def test_node__heartbeat_back_in_fault__leaves_the_error_until_the_reset(bench):
    lose_heartbeat(bench, timeout_ms=20)
    bench.tick(0.1)
    bench.take_emcy()
    bench.node.receive(codec.COB_HEARTBEAT + MASTER, b"\x05")
    assert bench.take_emcy() == []
    assert bench.read(Index.ERROR_REGISTER, 0, codec.U8) == 0x11
    bench.cycle(0x80)
    assert bench.take_emcy() == [(0, 0)]
    assert bench.state is S.SWITCH_ON_DISABLED


def test_node__heartbeat_lost_while_disabled__reports_without_fault_and_recovers(bench):
    setting = codec.consumer_heartbeat(MASTER, 20)
    bench.must_write(Index.CONSUMER_HEARTBEAT, 1, codec.U32, setting)
    bench.node.receive(codec.COB_HEARTBEAT + MASTER, b"\x05")
    bench.tick(0.1)
    assert bench.state is S.SWITCH_ON_DISABLED
    assert bench.read(Index.ERROR_REGISTER, 0, codec.U8) == 0x11
    bench.node.receive(codec.COB_HEARTBEAT + MASTER, b"\x05")
    assert bench.take_emcy() == [(EmcyCode.HEARTBEAT_LOST, 0x11), (0, 0)]
    assert bench.read(Index.ERROR_REGISTER, 0, codec.U8) == 0


def test_node__rpdos_back_after_ignored_loss__takes_the_error_back(bench):
    bench.must_write(Index.ABORT_CONNECTION_OPTION, 0, codec.I16, 0)
    lose_rpdos(bench, timeout_ms=5)
    bench.tick(0.05)
    assert bench.take_emcy() == [(EmcyCode.RPDO_TIMEOUT, 0x11)]
    bench.rpdo(0x0F, 100)
    assert bench.take_emcy() == [(0, 0)]
    bench.tick(0.05)
    assert bench.take_emcy() == [(EmcyCode.RPDO_TIMEOUT, 0x11)]


@pytest.mark.parametrize("option", [1, 2, 3])
def test_node__rpdos_back_after_loss__do_not_enable_it_again(bench, option):
    bench.must_write(Index.ABORT_CONNECTION_OPTION, 0, codec.I16, option)
    bench.must_write(Index.QUICK_STOP_OPTION, 0, codec.I16, 6)
    lose_rpdos(bench, timeout_ms=5)
    bench.tick(0.05)
    for _ in range(20):
        bench.cycle(0x0F, 500)
    assert bench.state is not S.OPERATION_ENABLED
    assert bench.servo.torque_target_Nm == 0.0


@pytest.mark.parametrize(
    "command", [NmtCommand.STOP, NmtCommand.ENTER_PRE_OPERATIONAL, NmtCommand.RESET_COMMUNICATION]
)
def test_node__taken_out_of_operational_while_enabled__fails(bench, command):
    bench.enable(500)
    bench.nmt(command)
    assert not bench.servo.is_energised
    assert bench.take_emcy() == [(EmcyCode.COMMUNICATION, 0x11)]


def test_node__reset_node_while_enabled__is_disabled_without_fault(bench):
    bench.enable(500)
    bench.nmt(NmtCommand.RESET_NODE)
    assert bench.state is S.SWITCH_ON_DISABLED
    assert not bench.servo.is_energised
    assert bench.read(Index.ERROR_REGISTER, 0, codec.U8) == 0
