"""The arm's bus in front of emulated CiA 402 drives: start-up, the cycle, what is late or foreign.

Sequences and object values: CiA 301 v4.2 and CiA 402-2; identifiers from the predefined
connection set.
"""

import random
import socket
from pathlib import Path

import pytest

from drivers.arm_bus import RECEIVED, SENT, ArmBus
from drivers.axis import Axis, AxisStatus
from drivers.buses.unix import UnixBus
from drivers.cia402 import codec
from drivers.cia402.codec import NmtCommand, NmtState
from drivers.cia402.master import Cia402Axis
from drivers.cia402.settings import Cia402Settings
from drivers.errors import AmplifierError, BusError
from drivers.frame import EFF_FLAG, ERR_FLAG, RTR_FLAG, pack_frame, unpack_frame
from drivers.registry import make_axes
from tests.drivers.cia402_rig import SETTINGS, T_NS, Rig, ask_for, drive_for, without

SYNC, TPDO_1, TPDO_2, RPDO_1, MASTER = 0x080, 0x181, 0x182, 0x201, 0x77F
GOLDEN = Path(__file__).parent / "golden" / "cia402_startup.txt"


# --- start-up ---------------------------------------------------------------------------------


def golden_frames():
    """(direction, identifier, data) of each line of the golden file; every line says what it is."""
    frames = []
    for number, line in enumerate(GOLDEN.read_text().splitlines(), start=1):
        notation, _, comment = line.partition(";")
        if not notation.strip():
            continue
        assert comment.strip(), f"line {number} has no comment"
        way, frame = notation.split()
        identifier, _, data = frame.partition("#")
        direction = {"TX": SENT, "RX": RECEIVED}[way]
        frames.append((direction, int(identifier, 16), bytes.fromhex(data)))
    return frames


def test_configure__one_axis__exactly_the_golden_frames():
    rig = Rig(SETTINGS[:1])
    rig.configure()
    rig.cycles(2)
    rig.axes[0].enable()
    rig.cycles(5, 1.0)
    expected = golden_frames()
    for number, (found, wanted) in enumerate(zip(rig.log, expected, strict=False), start=1):
        assert found == wanted, f"frame {number}"
    assert len(rig.log) == len(expected)
    assert rig.all_are("ENABLED")


@pytest.mark.parametrize("joint", [0, 1])
def test_configure__afterwards__the_drives_objects_are_as_documented(joint):
    rig = Rig()
    rig.configure()
    node = joint + 1
    rated_Nm, peak_Nm = ((5.0, 15.0), (2.5, 8.0))[joint]
    expected = {
        (0x6060, 0): 10,
        (0x6061, 0): 10,
        (0x60C2, 1): 1,
        (0x60C2, 2): 0x100 - 3,
        (0x6072, 0): round(1000 * peak_Nm / rated_Nm),
        (0x6007, 0): 1,
        (0x1016, 1): 127 << 16 | 300,
        (0x1017, 0): 100,
        (0x1400, 1): 0x200 + node,
        (0x1400, 2): 1,
        (0x1400, 5): 20,
        (0x1600, 0): 2,
        (0x1600, 1): 0x60400010,
        (0x1600, 2): 0x60710010,
        (0x1800, 1): 0x180 + node,
        (0x1800, 2): 1,
        (0x1A00, 0): 3,
        (0x1A00, 1): 0x60410010,
        (0x1A00, 2): 0x60640020,
        (0x1A00, 3): 0x60770010,
        (0x1801, 1): 0x8000_0280 + node,
    }
    found = {key: rig.read(rig.nodes[joint], *key) for key in expected}
    assert found == expected
    assert rig.nodes[joint].nmt_state is NmtState.OPERATIONAL
    assert rig.all_are("DISABLED")


def test_configure__other_timing__written_to_the_drive():
    settings = ask_for(SETTINGS[0], heartbeat_ms=50, rpdo_timeout_ms=7)
    rig = Rig([settings])
    rig.configure()
    node = rig.nodes[0]
    assert rig.read(node, 0x1017) == 50
    assert rig.read(node, 0x1016, 1) == 127 << 16 | 150
    assert rig.read(node, 0x1400, 5) == 7


@pytest.mark.parametrize("node", [1, 2])
@pytest.mark.parametrize(("parameter", "base", "objects"), [(0x1400, 0x200, 2), (0x1800, 0x180, 3)])
def test_configure__pdo_mapping__in_the_order_the_standard_asks_for(node, parameter, base, objects):
    rig = Rig()
    rig.configure()
    mapping = parameter + 0x200
    steps = [w for w in rig.writes(node) if w[0] in (parameter, mapping) and w[1:2] != (5,)]
    off, kind, emptied, *mapped, counted, on = steps
    assert off == (parameter, 1, 0x8000_0000 | base + node)
    assert kind == (parameter, 2, 1)
    assert emptied == (mapping, 0, 0)
    assert [(index, sub) for index, sub, _ in mapped] == [
        (mapping, sub) for sub in range(1, objects + 1)
    ]
    assert counted == (mapping, 0, objects)
    assert on == (parameter, 1, base + node)


def test_configure__a_drive_with_a_former_mapping__is_mapped_anew():
    """A drive that was left with the PDO on and other objects in it: remapped all the same."""
    rig = Rig()
    rig.configure()
    values = rig.nodes[0].dictionary.values
    values[0x1A00_00], values[0x1A00_01], values[0x1A00_02] = 1, 0x60780010, 0
    rig.new_master().configure(heartbeat_cycles=100)
    assert [rig.read(rig.nodes[0], 0x1A00, sub) for sub in (0, 1, 2)] == [3, 0x60410010, 0x60640020]


def test_configure__network_management__operational_only_when_all_axes_are_set_up():
    rig = Rig()
    rig.configure()
    commands = [codec.parse_nmt(data) for data in rig.sent(0x000)]
    assert commands == [
        (NmtCommand.RESET_COMMUNICATION, 1),
        (NmtCommand.ENTER_PRE_OPERATIONAL, 1),
        (NmtCommand.RESET_COMMUNICATION, 2),
        (NmtCommand.ENTER_PRE_OPERATIONAL, 2),
        (NmtCommand.START, 1),
        (NmtCommand.START, 2),
    ]
    last_two = [(SENT, 0, bytes((1, node))) for node in (1, 2)]
    assert rig.log[-2:] == last_two


def test_configure__start_up__no_torque_no_enabling_no_sync():
    rig = Rig()
    rig.configure()
    assert not rig.commands(1)
    assert not rig.sent(SYNC)
    assert {0x6040, 0x6071}.isdisjoint(index for index, _, _ in rig.writes(1))
    assert not any(servo.is_energised for servo in rig.servos)


def test_configure__drives__tell_about_themselves():
    first, second = Rig().configure()
    assert first.name == second.name == "hil emulated drive"
    assert (first.torque_resolution_Nm, second.torque_resolution_Nm) == (0.005, 0.0025)
    assert first.angle_resolution_rad == pytest.approx(1.534e-3, abs=1e-6)
    assert first.is_lockstep
    assert not Rig(are_lockstep=(False, False)).configure()[0].is_lockstep


@pytest.mark.parametrize("are_lockstep", [(True, False), (False, True)])
def test_configure__one_axis_by_the_clock_one_in_lockstep__refused(are_lockstep):
    with pytest.raises(AmplifierError, match="lockstep"):
        Rig(are_lockstep=are_lockstep).configure()


@pytest.mark.parametrize("counter", [b"", b"\x07"])
def test_configure__another_master_sends_sync__refused_and_nothing_sent(counter):
    rig = Rig()
    rig.on_wait = lambda: rig.loopback.deliver(pack_frame(SYNC, counter))
    with pytest.raises(AmplifierError, match="another master"):
        rig.configure()
    assert not [entry for entry in rig.log if entry[0] == SENT]


def test_configure__drive_missing__named_with_the_remedy():
    rig = Rig((*SETTINGS[:1], ask_for(SETTINGS[1], node_id=9)), [drive_for(s) for s in SETTINGS])
    rig.to_drives = without(0x609)
    with pytest.raises(AmplifierError, match=r"joint 2 \(cia402 node 9\): no SDO answer .* power"):
        rig.configure()


def test_configure__bus_that_takes_no_frames__says_so(socket_path):
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
        listener.bind(socket_path)
        listener.listen()
        with UnixBus(socket_path) as bus:
            while bus.send(pack_frame(0x123)):
                pass
            arm = ArmBus(bus, make_axes(SETTINGS, period_s=1e-3), now_ns=lambda: 0)
            with pytest.raises(BusError, match="takes no frames"):
                arm.configure(heartbeat_cycles=100)


# --- the cycle --------------------------------------------------------------------------------


def configured(**arguments):
    rig = Rig(**arguments)
    rig.configure()
    rig.log.clear()
    return rig


def test_cycle__all_drives_answer__sync_feedback_commands_in_this_order():
    rig = configured()
    assert rig.cycle()
    assert [(way, can_id) for way, can_id, _ in rig.log] == [
        (SENT, SYNC),
        (RECEIVED, TPDO_1),
        (RECEIVED, TPDO_2),
        (SENT, RPDO_1),
        (SENT, 0x202),
        (SENT, MASTER),
    ]
    assert rig.bus.age_cycles == 0
    assert rig.sent(MASTER) == [b"\x05"]


def test_cycle__master_heartbeat__first_cycle_then_at_its_period():
    rig = configured()
    at = []
    for k in range(301):
        before = len(rig.sent(MASTER))
        rig.cycle()
        at += [k] * (len(rig.sent(MASTER)) - before)
    assert at == [0, 100, 200, 300]


def test_cycle__feedback__is_what_the_encoders_say():
    rig = configured()
    rig.cycle()
    for axis, servo in zip(rig.axes, rig.servos, strict=True):
        assert axis.q_rad == pytest.approx(servo.q_rad, abs=0.51 * 1.534e-3)


def test_cycle__torque__takes_effect_at_the_next_sync():
    rig = Rig().enable()
    rig.cycle(2.0, -1.0)
    assert [servo.torque_target_Nm for servo in rig.servos] == [0.0, 0.0]
    rig.cycle(0.5, 0.5)
    assert [s.torque_target_Nm for s in rig.servos] == pytest.approx([2.0, -1.0])
    rig.cycle()
    assert [s.torque_target_Nm for s in rig.servos] == pytest.approx([0.5, 0.5])


@pytest.mark.parametrize("missing", [TPDO_1, TPDO_2])
def test_collect__one_drive_silent__not_fresh_its_age_grows_and_its_values_stay(missing):
    rig = configured()
    rig.cycle()
    silent, other = rig.axes if missing == TPDO_1 else reversed(rig.axes)
    before = silent.q_rad
    rig.to_master = without(missing)
    for age in (1, 2, 3):
        assert not rig.cycle()
        assert (silent.age_cycles, other.age_cycles) == (age, 0)
        assert rig.bus.age_cycles == age
    assert silent.q_rad == before
    rig.to_master = lambda frame: [frame]
    assert rig.cycle()
    assert rig.bus.age_cycles == 0


def test_collect__late_feedback__counted_and_not_taken_as_fresh():
    rig = configured()
    rig.cycle()
    held = []

    def hold_back(frame):
        is_held = unpack_frame(frame)[0] == TPDO_2
        held.extend([frame] * is_held)
        return [] if is_held else [frame]

    rig.to_master = hold_back
    assert not rig.cycle()
    for late in range(1, 4):
        rig.loopback.deliver(held.pop(0))  # of the last cycle, just before the next SYNC
        assert not rig.cycle()
        assert rig.bus.late_frames == late
        assert rig.axes[1].age_cycles > 0
    rig.to_master = lambda frame: [frame]
    rig.loopback.deliver(held.pop(0))
    assert rig.cycle()
    assert rig.bus.late_frames == 4


def test_collect__one_drive_twice_the_other_silent__not_fresh():
    rig = configured()
    rig.to_master = lambda frame: {TPDO_1: [frame] * 2, TPDO_2: []}.get(
        unpack_frame(frame)[0], [frame]
    )
    assert not rig.cycle()
    assert [axis.age_cycles for axis in rig.axes] == [0, 2]


def test_collect__nothing_comes__gives_up_at_the_deadline():
    rig = configured()
    rig.to_master = lambda _: []
    rig.bus.request_feedback()
    begin_ns = rig.clock_ns
    assert not rig.bus.collect(begin_ns + 600_000)
    assert rig.clock_ns == begin_ns + 600_000


def test_collect__deadline_passed_and_nothing_there__does_not_wait():
    rig = configured()
    rig.to_master = lambda _: []
    rig.bus.request_feedback()
    begin_ns = rig.clock_ns
    assert not rig.bus.collect(begin_ns - T_NS)
    assert rig.clock_ns == begin_ns


def test_collect__deadline_passed_already__takes_what_is_there():
    rig = configured()
    rig.bus.request_feedback()
    assert rig.bus.collect(rig.clock_ns - T_NS)


@pytest.mark.parametrize(
    ("can_id", "counter"),
    [
        (0x1FF, "unknown_frames"),
        (0x281, "unknown_frames"),
        (TPDO_1 | EFF_FLAG, "unknown_frames"),
        (TPDO_1 | RTR_FLAG, "unknown_frames"),
        (0x701 | RTR_FLAG, "unknown_frames"),
        (ERR_FLAG | 0x4, "error_frames"),
        (ERR_FLAG | TPDO_1, "error_frames"),
    ],
)
@pytest.mark.parametrize("when", ["before SYNC", "among the feedback"])
def test_cycle__frames_of_nobody__counted_and_never_feedback(can_id, counter, when):
    rig = configured()
    rig.cycle()
    data = codec.TPDO1.pack(0x27, 1234, 0)
    if when == "before SYNC":
        rig.loopback.deliver(pack_frame(can_id, data))
    else:
        rig.to_master = lambda frame: [pack_frame(can_id, data), frame]
    before = [axis.q_rad for axis in rig.axes]
    assert rig.cycle()
    assert getattr(rig.bus, counter) == (1 if when == "before SYNC" else 2)
    assert [axis.q_rad for axis in rig.axes] == before
    assert rig.all_are("DISABLED")


def test_cycle__bus_gone__bus_error_from_every_step():
    rig = configured()
    rig.bus.close()
    for step in (
        rig.bus.request_feedback,
        lambda: rig.bus.collect(T_NS),
        lambda: rig.bus.send_torques([0.0, 0.0]),
    ):
        with pytest.raises(BusError):
            step()


def test_log__off_again__nothing_more_is_reported():
    rig = configured()
    rig.bus.log_frames(None)
    rig.cycle()
    assert not rig.log


def test_log__frames_as_they_pass__records_of_sixteen_bytes():
    rig, seen = configured(), []
    rig.bus.log_frames(lambda direction, frame: seen.append((direction, bytes(frame))))
    rig.cycle()
    assert len(seen) == 6
    assert {len(frame) for _, frame in seen} == {16}


def test_stats__are_the_buses_own():
    rig = configured()
    assert rig.bus.stats is rig.loopback.stats


# --- several axes together --------------------------------------------------------------------


def test_is_enabled__one_axis_after_the_other__only_when_all_are():
    rig = configured()
    rig.cycles(2)
    rig.axes[0].enable()
    rig.cycles(10)
    assert rig.axes[0].status is AxisStatus.ENABLED
    assert not rig.bus.is_enabled
    rig.axes[1].enable()
    rig.cycles(10)
    assert rig.bus.is_enabled


def test_first_in__status__first_such_axis_or_none():
    rig = configured()
    rig.cycles(2)
    assert rig.bus.first_in(AxisStatus.DISABLED) is rig.axes[0]
    assert rig.bus.first_in(AxisStatus.FAULT) is None
    rig.bus.inject_fault(1)
    rig.until(lambda: rig.bus.first_in(AxisStatus.FAULT) is rig.axes[1])


@pytest.mark.parametrize("joint", [0, 1])
def test_inject_fault__emulated_drive__one_frame_in_the_next_cycle_and_the_drive_faults(joint):
    rig = Rig().enable()
    rig.log.clear()
    assert rig.bus.inject_fault(joint)
    assert not rig.sent(0x601 + joint)
    rig.cycles(3)
    assert len(rig.sent(0x601 + joint)) == 1
    assert not rig.servos[joint].is_energised
    assert rig.axes[joint].status is AxisStatus.FAULT
    assert rig.axes[1 - joint].status is AxisStatus.ENABLED


def test_inject_fault__family_without_it__says_no_and_sends_nothing():
    class Plain(Cia402Axis):
        inject_fault = Axis.inject_fault

    rig = configured()
    rig.bus.axes[0] = Plain(SETTINGS[0], joint=1, period_s=1e-3)
    assert not rig.bus.inject_fault(0)
    rig.cycle()
    assert not rig.sent(0x601)


def test_inject_fault__both_axes_at_once__one_sdo_frame_a_cycle():
    rig = Rig().enable()
    rig.log.clear()
    rig.bus.inject_fault(0)
    rig.bus.inject_fault(1)
    rig.cycle()
    assert (len(rig.sent(0x601)), len(rig.sent(0x602))) == (1, 0)
    rig.cycle()
    assert (len(rig.sent(0x601)), len(rig.sent(0x602))) == (1, 1)


# --- hostile wire -----------------------------------------------------------------------------


def random_frame(source, can_ids):
    """Any length byte up to 255 (as broken adapters write), any data, mostly identifiers in use."""
    frame = bytearray(pack_frame(source.choice(can_ids), source.randbytes(8)))
    frame[4] = source.choice((0, 1, 2, 4, 6, 7, 8, 8, 8, 9, 15, 255))
    return bytes(frame)


def test_cycle__twenty_thousand_random_frames__no_exception_and_no_power_asked_for():
    """Whatever comes, only `enable` may lead to a controlword with power in it, or to torque."""
    source = random.Random(402)
    rig = configured()
    rig.to_drives = lambda _: []
    used = [0x000, SYNC, 0x081, 0x082, TPDO_1, TPDO_2, 0x581, 0x701, 0x702, MASTER]
    can_ids = used * 4 + [source.getrandbits(32) for _ in range(40)]
    for _ in range(2000):
        for _ in range(10):
            rig.loopback.deliver(random_frame(source, can_ids))
        rig.cycle(3.0, -3.0)
    assert {*rig.commands(1), *rig.commands(2)} == {(codec.CONTROL_DISABLE_VOLTAGE, 0)}


def test_cycle__random_frames_while_enabled__torque_only_within_the_drives_limit():
    source = random.Random(6071)
    rig = Rig([Cia402Settings(node_id=1, rated_torque_Nm=5.0, torque_max_Nm=10.0)]).enable()
    rig.log.clear()
    rig.to_drives = lambda _: []
    for _ in range(500):
        for _ in range(4):
            rig.loopback.deliver(random_frame(source, [0x081, TPDO_1, 0x701]))
        rig.cycle(source.uniform(-1e6, 1e6))
    torques = [torque for _, torque in rig.commands(1)]
    assert max(map(abs, torques)) <= 2000
    powered = (codec.CONTROL_ENABLE_OPERATION,)
    assert not any(torque for word, torque in rig.commands(1) if word not in powered)
