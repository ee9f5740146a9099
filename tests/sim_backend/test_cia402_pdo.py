"""PDO settings, transmission types, remapping."""

import math

import pytest

from drivers.cia402 import codec
from drivers.cia402.codec import Cia402State, EmcyCode, Index, NmtCommand
from drivers.cia402.sdo import SdoAbort
from tests.sim_backend.cia402_bench import NODE, Bench

S = Cia402State


@pytest.fixture
def bench():
    return Bench()


TPDO1, TPDO1_MAPPING = Index.TPDO1_PARAMETER, Index.TPDO1_MAPPING
RPDO2, RPDO2_MAPPING = Index.RPDO2_PARAMETER, Index.RPDO2_MAPPING


def remap(bench, parameter, mapping, words, *, cob_id, kind=1):
    bench.must_write(parameter, 1, codec.U32, cob_id | codec.PDO_OFF)
    bench.must_write(parameter, 2, codec.U8, kind)
    bench.must_write(mapping, 0, codec.U8, 0)
    for subindex, word in enumerate(words, start=1):
        bench.must_write(mapping, subindex, codec.U32, word)
    bench.must_write(mapping, 0, codec.U8, len(words))
    bench.must_write(parameter, 1, codec.U32, cob_id)


def test_pdo__remapped__carries_the_new_objects(bench):
    words = [
        codec.mapping_word(Index.MODE_DISPLAY, 0, 8),
        codec.mapping_word(Index.VELOCITY_ACTUAL, 0, 32),
        codec.mapping_word(Index.STATUSWORD, 0, 16),
    ]
    remap(bench, TPDO1, TPDO1_MAPPING, words, cob_id=0x1C0)
    bench.servo.sense(0.0, -math.pi)
    bench.nmt(NmtCommand.START)
    bench.node.receive(codec.COB_SYNC, b"\x07")  # with a counter
    assert bench.take(0x1C0) == [b"\x00" + codec.I32.pack(-2048) + codec.U16.pack(0x0250)]
    assert bench.take(codec.COB_TPDO1 + NODE) == []


def test_pdo__overlong_sync__is_none(bench):
    bench.nmt(NmtCommand.START)
    bench.sent.clear()
    bench.node.receive(codec.COB_SYNC, b"\0\0")
    assert bench.sent == []


def test_pdo__second_rpdo__writes_its_objects_at_once_if_event_driven(bench):
    words = [codec.mapping_word(Index.MODE, 0, 8), codec.mapping_word(Index.MAX_TORQUE, 0, 16)]
    remap(bench, RPDO2, RPDO2_MAPPING, words, cob_id=codec.COB_RPDO2 + NODE, kind=255)
    bench.nmt(NmtCommand.START)
    bench.node.receive(codec.COB_RPDO2 + NODE, b"\x0a\x2c\x01")
    assert bench.read(Index.MODE_DISPLAY, 0, codec.I8) == 10
    assert bench.read(Index.MAX_TORQUE, 0, codec.U16) == 300
    bench.node.receive(codec.COB_RPDO2 + NODE, b"\x01\x2c\x01")  # a mode it does not have
    assert bench.read(Index.MODE_DISPLAY, 0, codec.I8) == 10


PDO_REFUSED = [
    ("mapping while on", TPDO1_MAPPING, 0, codec.U8, 0, SdoAbort.DEVICE_STATE),
    ("object while on", TPDO1_MAPPING, 1, codec.U32, 0, SdoAbort.DEVICE_STATE),
    ("other identifier while on", TPDO1, 1, codec.U32, 0x1C0, SdoAbort.DEVICE_STATE),
    ("inhibit time while on", TPDO1, 3, codec.U16, 10, SdoAbort.DEVICE_STATE),
    ("restricted identifier", RPDO2, 1, codec.U32, 0x605, SdoAbort.VALUE_RANGE),
    ("extended identifier", RPDO2, 1, codec.U32, 0x2000_0300, SdoAbort.VALUE_RANGE),
    ("reserved type", RPDO2, 2, codec.U8, 241, SdoAbort.VALUE_RANGE),
    ("remote request type", TPDO1, 2, codec.U8, 253, SdoAbort.VALUE_RANGE),
    ("missing object", RPDO2_MAPPING, 1, codec.U32, 0x20000010, SdoAbort.NO_OBJECT),
    ("missing subindex", RPDO2_MAPPING, 1, codec.U32, 0x60400110, SdoAbort.NO_SUBINDEX),
    ("wrong direction", RPDO2_MAPPING, 1, codec.U32, 0x60410010, SdoAbort.NOT_MAPPABLE),
    ("not mappable", RPDO2_MAPPING, 1, codec.U32, 0x10170010, SdoAbort.NOT_MAPPABLE),
    ("wrong length", RPDO2_MAPPING, 1, codec.U32, 0x60400008, SdoAbort.NOT_MAPPABLE),
    ("count without objects", RPDO2_MAPPING, 0, codec.U8, 1, SdoAbort.NOT_MAPPABLE),
    ("too many", RPDO2_MAPPING, 0, codec.U8, 9, SdoAbort.PDO_LENGTH),
]  # fmt: skip


@pytest.mark.parametrize("case", PDO_REFUSED, ids=lambda case: case[0])
def test_pdo__setting_against_the_rules__is_refused_and_changes_nothing(bench, case):
    _, index, subindex, layout, value, code = case
    before = bench.read(index, subindex, layout)
    assert bench.write(index, subindex, layout, value) == code
    assert bench.read(index, subindex, layout) == before


def test_pdo__nine_bytes__exceed_it(bench):
    bench.must_write(TPDO1, 1, codec.U32, codec.PDO_OFF | codec.COB_TPDO1 + NODE)
    bench.must_write(TPDO1_MAPPING, 0, codec.U8, 0)
    bench.must_write(TPDO1_MAPPING, 4, codec.U32, codec.mapping_word(Index.MODE_DISPLAY, 0, 8))
    assert bench.write(TPDO1_MAPPING, 0, codec.U8, 4) == SdoAbort.PDO_LENGTH
    assert bench.write(TPDO1_MAPPING, 1, codec.U32, 0) is None
    bench.must_write(TPDO1_MAPPING, 1, codec.U32, codec.TPDO1_MAP[0])
    bench.must_write(TPDO1_MAPPING, 0, codec.U8, 3)
    assert bench.write(TPDO1_MAPPING, 2, codec.U32, 0) == SdoAbort.DEVICE_STATE


def sync_times(bench, number):
    """Return at which of `number` SYNCs the drive sent TPDO1."""
    times = []
    for time in range(number):
        bench.node.receive(codec.COB_SYNC, b"")
        times += [time] * len(bench.take(codec.COB_TPDO1 + NODE))
    return times


def test_pdo__type_n__is_sent_at_every_nth_sync(bench):
    bench.must_write(TPDO1, 2, codec.U8, 3)
    bench.nmt(NmtCommand.START)
    assert sync_times(bench, 9) == [2, 5, 8]


def test_pdo__type_0__is_sent_at_the_sync_after_a_change(bench):
    bench.must_write(TPDO1, 2, codec.U8, 0)
    bench.nmt(NmtCommand.START)
    assert sync_times(bench, 3) == [0]
    bench.servo.sense(1.0, 0.0)
    assert sync_times(bench, 3) == [0]


def test_pdo__event_driven__follows_change_inhibit_time_and_event_timer(bench):
    bench.must_write(TPDO1, 1, codec.U32, codec.PDO_OFF | codec.COB_TPDO1 + NODE)
    bench.must_write(TPDO1, 2, codec.U8, 255)
    bench.must_write(TPDO1, 3, codec.U16, 50)  # 5 ms
    bench.must_write(TPDO1, 5, codec.U16, 20)
    bench.must_write(TPDO1, 1, codec.U32, codec.COB_TPDO1 + NODE)
    bench.nmt(NmtCommand.START)
    times = []
    for time_ms in range(1, 61):
        if time_ms in (3, 4):
            bench.servo.sense(0.1 * time_ms, 0.0)
        bench.tick()
        times += [time_ms] * len(bench.take(codec.COB_TPDO1 + NODE))
    assert times == [1, 6, 26, 46]
    assert sync_times(bench, 3) == []


def test_pdo__too_short__is_reported_once_and_ignored(bench):
    bench.enable()
    for _ in range(3):
        bench.node.receive(codec.COB_RPDO1 + NODE, b"\x0f\0\1")
    bench.sync()
    assert bench.servo.torque_target_Nm == 0.0
    assert bench.take_emcy() == [(EmcyCode.PDO_LENGTH, 0x11)]
    bench.rpdo(0x0F)
    assert bench.take_emcy() == [(0, 0)]


def test_pdo__waiting_data__dies_with_operational(bench):
    bench.must_write(Index.MODE, 0, codec.I8, codec.CST)
    bench.nmt(NmtCommand.START)
    bench.rpdo(0x06)
    bench.nmt(NmtCommand.ENTER_PRE_OPERATIONAL)
    bench.nmt(NmtCommand.START)
    assert codec.decode_state(bench.sync()[0]) is S.SWITCH_ON_DISABLED
