"""Several buses behind one emulated arm: whose frame it is, and when emulated time goes on."""

from collections import Counter

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.buses.loopback import LoopbackBus
from drivers.buses.unix import UnixBus
from drivers.frame import pack_frame
from hil.emulation import build_emulator, open_emulation
from sim_backend.emulator import TICKS_AHEAD_MAX
from sim_backend.errors import SimError
from sim_backend.hub import BusWire, UnixHub
from sim_backend.server import EmulatorServer
from sim_backend.settings import EmulatorSettings
from sim_backend.wire_group import WireGroup
from tests.drivers.group_rig import configuration

WAIT_S = 5.0
SYNC = pack_frame(0x080)
MS = 1_000_000


@pytest.fixture
def paths(tmp_path):
    return [str(tmp_path / name) for name in "ab"]


@pytest.fixture
def group(paths):
    with WireGroup([UnixHub(path) for path in paths], [f"unix:{path}" for path in paths]) as made:
        yield made


def test_wait__frames_on_either_wire__says_whose(group, paths):
    with UnixBus(paths[0]) as first, UnixBus(paths[1]) as second:
        second.send(pack_frame(2))
        assert (group.wait(WAIT_S), group.bus) == ([pack_frame(2)], 1)
        first.send(pack_frame(1))
        assert (group.wait(WAIT_S), group.bus) == ([pack_frame(1)], 0)


def test_wait__many_on_both__none_is_lost_and_each_wire_keeps_its_order(group, paths):
    with UnixBus(paths[0]) as first, UnixBus(paths[1]) as second:
        for number in range(50):
            first.send(pack_frame(number))
            second.send(pack_frame(number))
        seen = {0: [], 1: []}
        turns = []
        while len(turns) < 100:
            frames = group.wait(WAIT_S)
            assert frames, "time is up"
            seen[group.bus] += frames
            turns += [group.bus] * len(frames)
    assert seen[0] == seen[1] == [pack_frame(number) for number in range(50)]
    assert Counter(turns[:20]) == {0: 10, 1: 10}  # neither keeps the other waiting


def test_wait__nothing__comes_back_in_time(group):
    assert group.wait(0.0) == []
    assert group.wait(0.02) == []


def test_group__wire_without_descriptor__refused(paths):
    with UnixHub(paths[0]) as hub, pytest.raises(SimError, match="b cannot be emulated as one of"):
        WireGroup([hub, BusWire(LoopbackBus())], ["a", "b"])


def test_open_emulation__second_bus_impossible__first_is_closed(tmp_path):
    config = configuration((1, 2))
    bus = {"address": f"unix:{tmp_path}/a", "more": [f"unix:{tmp_path}/none/b"]}
    config = config.model_copy(update={"bus": config.bus.model_copy(update=bus)})
    with pytest.raises(SimError, match="no directory"):
        open_emulation(config, config.emulator)
    assert not (tmp_path / "a").exists()


def test_open_emulation__wire_model_on_several_buses__refused():
    config = configuration((1, 2), emulator={"wire": {"is_on": True}, "time": "wall"})
    with pytest.raises(SimError, match="the wire model is of one bus, this arm is on 2"):
        open_emulation(config, config.emulator)


# --- emulated time ----------------------------------------------------------------------------


def emulated(places):
    sent = [[] for _ in range(max(places))]
    emulator = build_emulator(
        configuration(places), [queue.append for queue in sent], is_lockstep=True
    )
    emulator.power_on()
    for queue in sent:
        queue.clear()
    return emulator, sent


def test_power_on__two_buses__each_node_announces_itself_on_its_own():
    sent = [[], []]
    emulator = build_emulator(
        configuration((2, 1, 2)), [queue.append for queue in sent], is_lockstep=True
    )
    emulator.power_on()
    assert sent == [
        [pack_frame(0x702, b"\x00")],
        [pack_frame(0x701, b"\x00"), pack_frame(0x703, b"\x00")],
    ]


def test_sync__first_of_two_buses__time_waits_for_the_second():
    emulator, _ = emulated((1, 2))
    emulator.receive(SYNC, 0)
    assert emulator.time_ns == 0
    emulator.receive(SYNC, 1)
    assert emulator.time_ns == MS


@pytest.fixture(scope="module")
def arm_on_three():
    return emulated((1, 2, 3))[0]


@settings(max_examples=50, deadline=None)
@given(order=st.permutations([bus for bus in range(3) for _ in range(TICKS_AHEAD_MAX)]))
def test_sync__buses_read_in_any_order__one_period_for_one_of_each(arm_on_three, order):
    start_ns = arm_on_three.time_ns
    counts = [0, 0, 0]
    for bus in order:
        arm_on_three.receive(SYNC, bus)
        counts[bus] += 1
        assert arm_on_three.time_ns - start_ns == MS * min(counts)


def test_sync__one_bus_stays_silent__time_goes_on_a_little_later_at_the_full_rate():
    emulator, _ = emulated((1, 2, 3))
    cycles = 100
    for _ in range(cycles):
        emulator.receive(SYNC, 0)
        emulator.receive(SYNC, 2)
    assert emulator.time_ns == MS * (cycles - TICKS_AHEAD_MAX)


def test_sync__lost_once_on_one_bus__costs_one_period_and_no_more():
    emulator, _ = emulated((1, 2))
    emulator.receive(SYNC, 0)
    for _ in range(50):
        emulator.receive(SYNC, 0)
        emulator.receive(SYNC, 1)
    assert emulator.time_ns == 50 * MS


def test_leave_lockstep__a_sync_was_waited_for__it_is_forgotten():
    emulator, _ = emulated((1, 2))
    emulator.receive(SYNC, 0)
    emulator.leave_lockstep()
    emulator.is_lockstep = True
    emulator.receive(SYNC, 1)
    assert emulator.time_ns == 0


def test_server__two_unix_buses__each_sync_is_counted_on_its_bus(group, paths):
    config = configuration((1, 2))
    transmits = [wire.transmit for wire in group.wires]
    emulator = build_emulator(config, transmits, is_lockstep=True)
    server = EmulatorServer(
        emulator, group, EmulatorSettings(stall_timeout_s=60.0), now_ns=lambda: 0
    )
    with UnixBus(paths[0]) as first, UnixBus(paths[1]) as second:
        for bus in (second, first, first, second):
            bus.send(SYNC)
            server.serve(WAIT_S)
        assert emulator.is_lockstep
        assert emulator.time_ns == 2 * MS
