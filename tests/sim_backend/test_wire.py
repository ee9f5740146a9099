"""The wire model: times, arbitration, load, errors and their counters, bus-off and recovery."""

from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.frame import EFF_FLAG, ERR_FLAG, pack_frame, unpack_frame, worst_case_bits
from sim_backend.can_controller import (
    ACTIVE_AGAIN,
    BIT_ERROR,
    CLASS_BUS_ERROR,
    CLASS_BUS_OFF,
    CLASS_CONTROLLER,
    CLASS_COUNTERS,
    CLASS_PROTOCOL,
    CLASS_RESTARTED,
    RX_PASSIVE,
    RX_WARNING,
    STUFF_ERROR,
    TX_PASSIVE,
    TX_WARNING,
    WHILE_SENDING,
)
from sim_backend.settings import WireSettings
from sim_backend.wire import WireModel
from sim_backend.wire_bits import arbitration_key, frame_bits

US = 1000
SECOND = 1_000_000_000
SYNC, LOW, HIGH = pack_frame(0x80), pack_frame(0x701, b"\x05"), pack_frame(0x181, bytes(8))


class Bench:
    """A wire at 1 Mbit/s with some nodes that note what they are told.

    Attributes:
        arrived: (microseconds, sender, record) of every frame.
        reports: Error reports by node.
    """

    def __init__(self, *names, bit_rate=1_000_000, **setting):
        self.arrived = []
        self.reports = {name: [] for name in names}
        self.wire = WireModel(
            WireSettings(is_on=True, **setting),
            lambda frame, node: self.arrived.append((self.wire.now_ns / US, node.name, frame)),
            bit_rate=bit_rate,
            data_bit_rate=5 * bit_rate,
        )
        self.nodes = {
            name: self.wire.join(name, lambda report, name=name: self.note(name, report))
            for name in names
        }

    def note(self, name, report):
        can_id, data = unpack_frame(report)
        assert can_id & ERR_FLAG
        assert can_id & CLASS_COUNTERS
        self.reports[name].append((can_id & 0x1FF, data))

    def classes(self, name):
        return [kind for kind, _ in self.reports[name]]

    def states(self, name):
        return [data[1] for kind, data in self.reports[name] if kind == CLASS_CONTROLLER]

    def send(self, name, frame):
        self.wire.send(self.nodes[name], frame)

    def run(self, us):
        until_ns = self.wire.now_ns + round(us * US)
        while self.wire.step(until_ns):
            pass
        return self.arrived


# --- time and arbitration ---------------------------------------------------------------------


def test_wire__one_frame__arrives_after_its_bits_and_frees_the_bus_three_later():
    bench = Bench("a", "b")
    bits = frame_bits(SYNC)
    bench.send("a", SYNC)
    bench.send("a", HIGH)
    bench.run(1000)
    assert bench.arrived[0] == (bits - 3, "a", SYNC)
    assert bench.arrived[1] == (bits + frame_bits(HIGH) - 3, "a", HIGH)


@pytest.mark.parametrize("bit_rate", [1_000_000, 500_000, 125_000])
def test_wire__bit_rate__scales_times(bit_rate):
    bench = Bench("a", "b", bit_rate=bit_rate)
    bench.send("a", HIGH)
    bench.run(10_000)
    assert bench.arrived[0][0] == pytest.approx((frame_bits(HIGH) - 3) * 1e6 / bit_rate)


def test_wire__fd_frame__two_rates():
    bench = Bench("a", "b")
    frame = pack_frame(0x8001 | EFF_FLAG)[:4] + b"\x18\x01\x00\x00" + b"\x55" * 24 + bytes(40)
    bench.send("a", frame)
    ((arrival_us, _, received),) = bench.run(1000)
    assert received == frame
    assert 48 + 0.2 * 230 - 3 <= arrival_us <= 56 + 0.2 * 280 - 3


def test_wire__sent_while_busy__lowest_identifier_first_whoever_came_first():
    bench = Bench("a", "b")
    bench.send("a", HIGH)
    bench.run(10)
    for frame in (LOW, HIGH, SYNC, pack_frame(0x80 << 18 | EFF_FLAG)):
        bench.send("b", frame)
        bench.run(1)
    order = [frame for _, _, frame in bench.run(2000)]
    assert order == [HIGH, SYNC, pack_frame(0x80 << 18 | EFF_FLAG), HIGH, LOW]


def test_wire__sent_at_the_same_instant_on_a_free_bus__compete():
    bench = Bench("a", "b")
    bench.send("a", LOW)
    bench.wire.step(0)  # time may be looked at without anything having begun
    bench.send("b", SYNC)
    assert [frame for _, _, frame in bench.run(1000)] == [SYNC, LOW]


def test_wire__equal_identifiers_of_a_node__in_order():
    bench = Bench("a", "b")
    frames = [pack_frame(0x201, bytes([n])) for n in range(5)]
    for frame in frames:
        bench.send("a", frame)
    assert [frame for _, _, frame in bench.run(2000)] == frames


def test_wire__low_priority_frame_under_way__blocks_until_it_is_done():
    bench = Bench("a", "b")
    bench.send("a", LOW)
    bench.run(1)
    bench.send("b", SYNC)
    bench.run(1000)
    assert bench.arrived[1][0] == frame_bits(LOW) + frame_bits(SYNC) - 3
    assert bench.wire.total.wait_max_ns == (frame_bits(LOW) - 1) * US


sends = st.lists(
    st.tuples(
        st.integers(0, 3000), st.integers(0, 2), st.integers(0, 0x7FF), st.binary(max_size=8)
    ),
    max_size=30,
)


@given(sends)
@settings(max_examples=60)
def test_wire__any_traffic__complete_disjoint_and_by_priority(plan):
    bench = Bench("0", "1", "2")
    plan = sorted(plan, key=lambda entry: entry[0])
    sent = []
    for at_us, sender, can_id, data in plan:
        bench.run(at_us - bench.wire.now_ns / US)
        frame = pack_frame(can_id, data)
        bench.send(str(sender), frame)
        sent.append((at_us, str(sender), frame))
    bench.run(30 * 200)
    assert sorted(f for _, _, f in bench.arrived) == sorted(f for _, _, f in sent)
    free_us = 0.0
    waiting = list(sent)
    for end_us, sender, frame in bench.arrived:
        start_us = end_us + 3 - frame_bits(frame)
        assert start_us >= free_us
        free_us = end_us + 3
        ready = [entry for entry in waiting if entry[0] <= start_us]
        assert min(arbitration_key(entry[2]) for entry in ready) == arbitration_key(frame)
        first = next(e for e in ready if e[1:] == (sender, frame))
        waiting.remove(first)
    assert bench.wire.total.busy_ns == sum(frame_bits(f) for _, _, f in sent) * US


@given(sends, st.lists(st.integers(1, 500), min_size=1, max_size=20))
@settings(max_examples=30)
def test_wire__time_in_other_portions__the_same_arrivals(plan, portions):
    def arrivals(chop):
        bench = Bench("0", "1", "2", bit_error_rate=2e-3, seed=5)
        for at_us, sender, can_id, data in sorted(plan, key=lambda entry: entry[0]):
            chop(bench, at_us - bench.wire.now_ns / US)
            bench.send(str(sender), pack_frame(can_id, data))
        chop(bench, 20_000)
        return bench.arrived

    def in_portions(bench, us):
        for portion in portions:
            step_us = min(us, portion)
            bench.run(step_us)
            us -= step_us
        bench.run(us)

    assert arrivals(lambda bench, us: bench.run(us)) == arrivals(in_portions)


# --- load -------------------------------------------------------------------------------------


def test_wire__load__share_of_a_window_that_was_busy():
    bench = Bench("a", "b", window_s=1e-3)
    windows = []
    bench.wire.on_window = windows.append
    for _ in range(3):
        bench.send("a", HIGH)
    bench.run(2500)
    assert len(windows) == 2
    assert [load.frames for load in windows] == [3, 0]
    assert bench.wire.peak_share == pytest.approx(3 * frame_bits(HIGH) / 1000)
    assert bench.wire.share(windows[1]) == 0.0
    assert bench.wire.last is windows[1]


def test_wire__worst_cycle_of_two_lean_axes__never_takes_longer_than_the_budget():
    random = Random(3)
    for _ in range(200):
        frames = [SYNC]
        frames += [pack_frame(0x180 + n, random.randbytes(8)) for n in (1, 2)]
        frames += [pack_frame(0x200 + n, random.randbytes(4)) for n in (1, 2)]
        bench = Bench("a", "b")
        for frame in frames:
            bench.send("a", frame)
        end_us = bench.run(1000)[-1][0]
        budget = worst_case_bits(0) + 2 * worst_case_bits(8) + 2 * worst_case_bits(4)
        assert budget == 515
        assert 47 + 2 * 111 + 2 * 79 <= end_us + 3 <= budget


# --- errors -----------------------------------------------------------------------------------


def test_wire__failed_transmission__error_frame_then_the_frame_again():
    bench = Bench("a", "b")
    bench.wire.fail_next(bench.nodes["a"], 1)
    bench.send("a", HIGH)
    ((arrival_us, _, frame),) = bench.run(2000)
    bits = frame_bits(HIGH)
    assert frame == HIGH
    assert arrival_us == pytest.approx(bits / 2 + 12 + 8 + 3 + bits - 3, abs=1)
    assert bench.wire.total.errors == 1
    (kind, data), *_ = bench.reports["a"]
    assert kind == CLASS_PROTOCOL | CLASS_BUS_ERROR
    assert data[2] == BIT_ERROR | WHILE_SENDING
    assert data[6] == 8  # the transmit error counter, after the failure
    (kind, data), *_ = bench.reports["b"]
    assert (kind, data[2], data[7]) == (CLASS_PROTOCOL | CLASS_BUS_ERROR, STUFF_ERROR, 1)
    assert (bench.nodes["a"].tec, bench.nodes["b"].rec) == (7, 0)


def test_wire__higher_priority_frame_after_a_failure__goes_first():
    bench = Bench("a", "b")
    bench.wire.fail_next(bench.nodes["a"], 1)
    bench.send("a", HIGH)
    bench.run(20)
    bench.send("b", SYNC)
    assert [frame for _, _, frame in bench.run(2000)] == [SYNC, HIGH]


def test_wire__failures_in_a_row__warning_passive_bus_off_at_the_standards_counts():
    bench = Bench("a", "b", is_recovering=False)
    node = bench.nodes["a"]
    bench.wire.fail_next(node, 1000)
    bench.send("a", HIGH)
    bench.run(20_000)
    assert bench.wire.total.errors == 32
    assert node.is_bus_off
    assert bench.states("a") == [TX_WARNING, TX_PASSIVE]
    assert bench.classes("a").index(CLASS_CONTROLLER) == 12  # after the 12th error: 96
    assert bench.classes("a")[-1] == CLASS_BUS_OFF
    assert bench.arrived == []
    assert bench.nodes["b"].rec == 32
    assert node.frames_dropped == 1
    bench.send("a", HIGH)
    bench.run(1_000_000)
    assert bench.arrived == []
    assert node.frames_dropped == 2


def test_wire__receiver_of_many_errors__warning_passive_and_active_again():
    bench = Bench("a", "b", "c", is_recovering=True)
    for _ in range(3):  # senders go off the bus in turn; c only listens
        for name in ("a", "b"):
            bench.wire.fail_next(bench.nodes[name], 32)
            bench.send(name, HIGH)
            bench.run(5000)
    assert bench.nodes["c"].is_passive
    assert bench.states("c") == [RX_WARNING, RX_PASSIVE]
    for _ in range(30):
        bench.send("b", SYNC)
        bench.run(200)
    assert bench.states("c") == [RX_WARNING, RX_PASSIVE, RX_WARNING, ACTIVE_AGAIN]
    assert bench.nodes["c"].rec < 96


def test_wire__passive_sender__lets_others_go_first():
    bench = Bench("a", "b")
    bench.nodes["a"].tec = 130
    bench.send("a", SYNC)
    bench.run(10)
    bench.send("a", SYNC)
    bench.send("b", LOW)
    order = [name for _, name, _ in bench.run(1000)]
    assert order == ["a", "a", "b"]  # nothing was ever counted: no suspension yet
    bench.wire.fail_next(bench.nodes["a"], 1)
    bench.send("a", SYNC)
    bench.run(10)
    bench.send("b", LOW)
    order = [name for _, name, _ in bench.run(1000)][3:]
    assert order == ["b", "a"]


@pytest.mark.parametrize("bit_rate", [1_000_000, 250_000])
def test_wire__silence_after_bus_off__recovers_after_128_times_11_bits(bit_rate):
    bench = Bench("a", "b", bit_rate=bit_rate)
    bench.wire.force_bus_off(bench.nodes["a"])
    assert bench.classes("a") == [CLASS_BUS_OFF]
    recovery_us = 128 * 11 * 1e6 / bit_rate
    bench.run(recovery_us - 1)
    assert bench.nodes["a"].is_bus_off
    bench.run(2)
    assert not bench.nodes["a"].is_bus_off
    assert bench.classes("a") == [CLASS_BUS_OFF, CLASS_RESTARTED]
    assert bench.nodes["a"].tec == bench.nodes["a"].rec == 0
    bench.send("a", HIGH)
    assert len(bench.run(1000)) == 1


def test_wire__traffic_after_bus_off__each_frame_ends_with_eleven_recessive_bits():
    bench = Bench("a", "b")
    bench.wire.force_bus_off(bench.nodes["a"])
    for _ in range(200):
        bench.send("b", HIGH)
    seen = 0
    while bench.nodes["a"].is_bus_off:
        assert bench.wire.step(bench.wire.now_ns + SECOND)
        seen = len(bench.arrived)
    assert 127 <= seen <= 129


def test_wire__node_off_the_bus__counts_nothing():
    bench = Bench("a", "b", "c", is_recovering=False)
    bench.wire.force_bus_off(bench.nodes["c"])
    bench.wire.fail_next(bench.nodes["a"], 3)
    bench.send("a", HIGH)
    bench.run(5000)
    assert bench.classes("c") == [CLASS_BUS_OFF]
    assert bench.nodes["b"].rec == 2  # three errors, and one frame that came through


def test_wire__bit_errors__as_many_as_the_rate_says_and_every_frame_arrives():
    rate, frames = 3e-4, 3000
    bench = Bench("a", "b", bit_error_rate=rate)
    bits = frame_bits(HIGH) - 3
    for _ in range(frames):
        bench.send("a", HIGH)
        bench.run(1000)
    bench.run(5000)
    assert len(bench.arrived) == frames
    hit = 1.0 - (1.0 - rate) ** bits
    expected = frames * hit / (1.0 - hit)
    assert bench.wire.total.errors == pytest.approx(expected, rel=0.25)


def test_wire__same_seed__same_errors_and_other_seed__others():
    def arrivals(seed):
        bench = Bench("a", "b", bit_error_rate=5e-3, seed=seed)
        for _ in range(100):
            bench.send("a", HIGH)
            bench.run(500)
        return bench.arrived

    assert arrivals(1) == arrivals(1)
    assert arrivals(1) != arrivals(2)


def test_wire__rate_switched_off__no_more_errors():
    bench = Bench("a", "b", bit_error_rate=1e-2)
    for _ in range(50):
        bench.send("a", HIGH)
        bench.run(1000)
    before = bench.wire.total.errors
    assert before > 0
    bench.wire.set_bit_error_rate(0.0)
    for _ in range(200):
        bench.send("a", HIGH)
        bench.run(1000)
    assert bench.wire.total.errors == before


def test_wire__node_that_leaves__has_its_last_words_heard():
    bench = Bench("a", "b")
    bench.send("b", HIGH)
    bench.run(10)
    bench.send("a", SYNC)
    bench.wire.leave(bench.nodes["a"])
    assert [frame for _, _, frame in bench.run(1000)] == [HIGH, SYNC]


def test_wire__next_ns__stepping_from_one_to_the_next_misses_nothing():
    bench = Bench("a", "b", bit_error_rate=5e-3)
    assert bench.wire.next_ns is None
    for frame in (HIGH, LOW, SYNC) * 10:
        bench.send("a", frame)
    bench.wire.fail_next(bench.nodes["b"], 32)
    bench.send("b", HIGH)
    while (next_ns := bench.wire.next_ns) is not None:
        bench.wire.step(next_ns)
    assert len([name for _, name, _ in bench.arrived if name == "a"]) == 30
    assert bench.classes("b")[-1] in (CLASS_RESTARTED, CLASS_PROTOCOL | CLASS_BUS_ERROR)
    assert not bench.nodes["b"].is_bus_off
