"""Faults of the emulator: orders, schedule, and what each kind does to frames and readings."""

from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.fault_frame import (
    FAULT_ID,
    FaultKind,
    FaultOrder,
    FaultTarget,
    pack_fault,
    parse_fault,
)
from drivers.frame import pack_fd_frame, pack_frame, unpack_frame
from hil.config import load_config
from hil.emulation import build_emulator
from sim_backend.faults import QUEUE_FRAMES, Line
from tests.hil.virtual import configured

FRAMES = [pack_frame(0x100 + n, bytes([n])) for n in range(5)]


@given(
    st.builds(
        FaultOrder,
        st.sampled_from(FaultTarget),
        st.sampled_from(FaultKind),
        st.integers(0, 255),
        st.integers(0, 0xFFFF_FFFF),
    )
)
def test_order__any__comes_back_from_its_frame(order):
    can_id, data = unpack_frame(pack_fault(order))
    assert can_id == FAULT_ID
    assert parse_fault(data) == order


@given(st.binary(max_size=8))
def test_order__any_bytes__never_raises(data):
    order = parse_fault(data)
    assert order is None or unpack_frame(pack_fault(order))[1][:3] == data[:3]


@pytest.mark.parametrize(("joint", "duration_ms"), [(256, 0), (-1, 0), (1, 1 << 32)])
def test_order__does_not_fit__refused(joint, duration_ms):
    with pytest.raises(ValueError, match="do not fit"):
        pack_fault(FaultOrder(FaultTarget.BUS, FaultKind.OFF, joint, duration_ms))


def line(kind, **keywords):
    out = []
    made = Line(lambda source, frame: out.append((source, frame)), Random(1), **keywords)
    made.set(kind)
    return made, out


def carried(kind, periods=4):
    """What comes out in each period, one frame going in per period, two in the first."""
    made, out = line(kind)
    seen = []
    for period in range(periods):
        made.begin_period(period)
        for frame in FRAMES[:2] if period == 0 else FRAMES[period + 1 : period + 2]:
            made.carry(0, frame, period)
        seen.append([FRAMES.index(frame) for _, frame in out])
        out.clear()
    made.set(FaultKind.OK)
    seen.append([FRAMES.index(frame) for _, frame in out])
    return seen


@pytest.mark.parametrize(
    ("kind", "seen"),
    [
        (FaultKind.OK, [[0, 1], [2], [3], [4], []]),
        (FaultKind.OFF, [[], [], [], [], []]),
        (FaultKind.STUCK, [[], [], [], [], [0, 1, 2, 3, 4]]),
        (FaultKind.SLOW, [[0], [1], [2], [3], [4]]),
        (FaultKind.DELAYED, [[], [0, 1], [2], [3], [4]]),
        (FaultKind.WRONG, [[0, 1], [0, 1, 2], [2, 3], [3, 4], [4]]),
    ],
)
def test_line__kind__frames_come_when_they_should(kind, seen):
    assert carried(kind) == seen


def test_line__slow__lowest_identifier_first():
    made, out = line(FaultKind.SLOW)
    for frame in (FRAMES[4], FRAMES[3], FRAMES[0], FRAMES[2]):
        made.carry(0, frame, 0)
    for period in range(1, 4):
        made.begin_period(period)
    assert [FRAMES.index(frame) for _, frame in out] == [4, 0, 2, 3]


@pytest.mark.parametrize("make", [pack_frame, pack_fd_frame])
@pytest.mark.parametrize("keeps_id", [True, False])
def test_line__garbage__same_size_other_content(make, keeps_id):
    made, out = line(FaultKind.GARBAGE, keeps_id=keeps_id)
    frame = make(0x181, bytes(8))
    for _ in range(20):
        made.carry(3, frame, 0)
    parsed = [unpack_frame(record) for _, record in out]
    assert {source for source, _ in out} == {3}
    assert {len(record) for _, record in out} == {len(frame)}
    assert len({data for _, data in parsed}) == 20
    assert ({can_id for can_id, _ in parsed} == {0x181}) is keeps_id


def test_line__intermittent__passes_only_between_interruptions():
    made, out = line(FaultKind.INTERMITTENT)
    for is_interrupted in (True, False, True):
        made.is_interrupted = is_interrupted
        made.carry(0, FRAMES[0], 0)
    assert len(out) == 1


def test_line__stuck_for_long__keeps_the_newest_frames_only():
    made, out = line(FaultKind.STUCK)
    for n in range(QUEUE_FRAMES + 10):
        made.carry(n, FRAMES[0], n)
    made.set(FaultKind.OK)
    assert [source for source, _ in out] == list(range(10, QUEUE_FRAMES + 10))


# --- through the emulator -----------------------------------------------------------------------


def emulator(*assignments, kind=None):
    sent = []
    config = configured("plant.is_held_until_enabled=false", *assignments)
    made = build_emulator(config, sent.append, is_lockstep=True)
    made.power_on()
    sent.clear()
    return made, sent


def ask(made, target, kind, joint=0, duration_ms=0):
    made.receive(pack_fault(FaultOrder(target, kind, joint, duration_ms)))


def test_encoder__stuck_then_ok__holds_then_tells_the_truth():
    made, _ = emulator("plant.q0_rad=[0.5, 0.0]", "plant.gravity_m_s2=9.81")
    servo = made._servos[0]
    ask(made, FaultTarget.ENCODER, FaultKind.STUCK, joint=1)
    held = servo.q_rad
    for _ in range(100):
        made.advance_period()
    assert servo.q_rad == held
    assert abs(made.arm.q_rad[0] - held) > 0.01
    ask(made, FaultTarget.ENCODER, FaultKind.OK, joint=1)
    made.advance_period()
    assert servo.q_rad == made.arm.q_rad[0]


def test_duration__over__fault_ends_by_itself():
    made, _ = emulator("plant.q0_rad=[0.5, 0.0]", "plant.gravity_m_s2=9.81")
    ask(made, FaultTarget.ENCODER, FaultKind.WRONG, joint=2, duration_ms=20)
    shifts = []
    for _ in range(30):
        made.advance_period()
        shifts.append(round(made._servos[1].q_rad - made.arm.q_rad[1], 6))
    assert shifts[:19] == [0.25] * 19
    assert shifts[21:] == [0.0] * 9


def test_schedule__two_faults__come_and_go_at_their_times():
    schedule = (
        'emulator.faults.schedule=[{target="encoder", kind="wrong", joint=1, start_s=0.005,'
        ' duration_s=0.01}, {target="encoder", kind="off", joint=1, start_s=0.02}]'
    )
    made, _ = emulator(schedule, "plant.q0_rad=[0.5, 0.0]")
    readings = []
    for _ in range(40):
        made.advance_period()
        readings.append(round(made._servos[0].q_rad, 3))
    assert readings[:4] == [0.5] * 4
    assert readings[6:13] == [0.75] * 7
    assert readings[16:19] == [0.5] * 3
    assert readings[21:] == [0.0] * 19


def test_schedule__joint_of_the_bus__refused_by_name():
    entry = '{target="bus", kind="off", joint=1, start_s=0}'
    with pytest.raises(Exception, match="the bus belongs to no joint"):
        configured(f"emulator.faults.schedule=[{entry}]")


def test_joint_that_is_not_there__nothing_happens():
    made, _ = emulator()
    ask(made, FaultTarget.AMPLIFIER, FaultKind.STUCK, joint=9)
    assert made._faults.is_quiet


def test_no_fault__frames_go_past_it():
    made, _ = emulator()
    assert made._faults.is_quiet
    assert made._faults.is_idle
    ask(made, FaultTarget.BUS, FaultKind.OFF)
    assert not made._faults.is_quiet
    ask(made, FaultTarget.BUS, FaultKind.OK)
    assert made._faults.is_quiet
    assert made._faults.is_idle
    assert load_config(None).emulator.faults.schedule == ()
