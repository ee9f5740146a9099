"""Shared memory: rings between processes, cursors, words and slots."""

import json
import multiprocessing
import os
import struct
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from hil.config import load_config
from hil.process import outlast_loop
from hil.realtime import now_ns
from hil.shared import SLOTS, Ring, RingReader, SharedMemory

HAMMER_S = 0.8


@pytest.fixture(scope="module")
def config():
    """Small rings, so that they are lapped often."""
    return load_config(None, {"trajectory": {"max_duration_s": 2.0}, "loop": {"period_s": 0.01}})


@pytest.fixture
def shared(config):
    return SharedMemory.create(config)


def make_ring(payload_size, slots):
    return Ring(memoryview(bytearray(Ring.size(payload_size, slots))), payload_size, slots)


def make_reader(ring):
    return RingReader(ring, memoryview(bytearray(8)))


# --- ring -------------------------------------------------------------------------------------


class RingModel(RuleBasedStateMachine):
    """A ring against a list that never forgets."""

    def __init__(self):
        super().__init__()
        self.ring = make_ring(24, 5)
        self.cursor = memoryview(bytearray(8))
        self.reader = RingReader(self.ring, self.cursor)
        self.written = []
        self.place = self.committed = self.lost = 0

    @rule(payloads=st.lists(st.binary(max_size=40), min_size=1, max_size=12))
    def write(self, payloads):
        for payload in payloads:
            self.ring.append(payload)
            self.written.append(payload[:24])

    @rule(most=st.integers(1, 20))
    def read(self, most):
        oldest = max(0, len(self.written) - self.ring.slots)
        self.lost += max(0, oldest - self.place)
        start = max(self.place, oldest)
        self.place = min(len(self.written), start + most)
        assert self.reader.read(most) == self.written[start : self.place]

    @rule()
    def commit(self):
        self.reader.commit()
        self.committed = self.place

    @rule()
    def succeed(self):
        """The reader dies; its successor goes on where it committed."""
        self.reader = RingReader(self.ring, self.cursor)
        self.place, self.lost = self.committed, 0

    @rule()
    def attach_writer(self):
        """The writer dies; its successor goes on numbering."""
        self.ring = Ring(self.ring.memory, 24, 5)
        self.reader = RingReader(self.ring, self.cursor)
        self.place, self.lost = self.committed, 0

    @invariant()
    def counts_agree(self):
        assert self.reader.lost == self.lost
        assert self.reader.place == self.place
        assert self.ring.head == len(self.written)
        assert self.reader.backlog == len(self.written) - self.place
        assert self.ring.last() == (self.written[-1] if self.written else None)


RingModel.TestCase.settings = settings(max_examples=60, stateful_step_count=30)
TestRing = RingModel.TestCase


@given(sizes=st.lists(st.integers(1, 60), min_size=1, max_size=30), slots=st.integers(1, 7))
def test_ring__lapped__loses_the_oldest_and_counts_them_exactly(sizes, slots):
    ring = make_ring(64, slots)
    reader = make_reader(ring)
    for number, size in enumerate(sizes):
        ring.append(bytes([number]) * size)
    kept = min(slots, len(sizes))
    records = reader.read(1000)
    first = len(sizes) - kept
    assert records == [bytes([k]) * sizes[k] for k in range(first, len(sizes))]
    assert reader.lost == first


def test_ring__record_begun_but_not_committed__is_not_seen_and_costs_the_oldest():
    ring = make_ring(8, 3)
    reader = make_reader(ring)
    for number in range(3):
        ring.append(bytes([number]) * 8)
    offset = ring.begin(8)
    ring.memory[offset : offset + 4] = b"half"
    assert reader.read(10) == [bytes([1]) * 8, bytes([2]) * 8]
    assert reader.lost == 1
    assert ring.get(3) is None
    assert ring.last() == bytes([2]) * 8
    ring.commit()
    assert reader.read(10) == [b"half" + bytes([0]) * 4]


def test_ring_reader__no_json__lost_and_the_rest_read():
    ring = make_ring(32, 8)
    reader = make_reader(ring)
    for payload in (b'{"a": 1}', b"\xff", b'{"cut": "' + b"x" * 40, b'{"b": 2}'):
        ring.append(payload)
    assert reader.read_json(10) == [{"a": 1}, {"b": 2}]
    assert reader.lost == 2


def _hammer(fd):
    """Write as fast as possible: every word of a payload is its number."""
    shared = SharedMemory(fd)
    until_s = time.monotonic() + HAMMER_S
    size = shared.layout.size // 8 * 8
    words = size // 8
    number = 0
    while time.monotonic() < until_s:
        for _ in range(200):
            ring = shared.samples
            offset = ring.begin(size)
            struct.pack_into(f"<{words}Q", ring.memory, offset, *([number] * words))
            ring.commit()
            number += 1
            for part in range(10):
                shared.beat("loop", 10 * number + part)
        shared.post_status({"samples": number})


def _hammer_from_path(path):
    with Path(path).open("r+b") as file:
        _hammer(file.fileno())


def test_ring__hammered_by_another_process__no_torn_record_and_nothing_unaccounted(shared):
    context = multiprocessing.get_context("spawn")
    path = f"/proc/{os.getpid()}/fd/{shared.fd}"  # where another process can open this memory
    writer = context.Process(target=_hammer_from_path, args=(path,))
    writer.start()
    reader = shared.reader("samples", "gateway")
    taken, expected = 0, 0
    before = 0
    while writer.is_alive():
        records = reader.read(500)
        if not records:
            continue
        rows = np.frombuffer(b"".join(records), dtype="<u8").reshape(len(records), -1)
        assert np.all(rows == rows[:, :1])  # not torn
        numbers = rows[:, 0].astype(int)
        assert np.all(np.diff(numbers) >= 1)
        assert numbers[0] >= expected
        taken, expected = taken + len(records), int(numbers[-1]) + 1
        beats = [before, *(shared.last_beat("loop") for _ in range(2000))]
        assert beats == sorted(beats)  # a word is whole at every instant, never zero in between
        before = beats[-1]
        ring = shared.samples
        for _ in range(500):  # where the writer is at work
            record = ring.get(max(0, ring.head - ring.slots))
            assert record is None or len(set(np.frombuffer(record, "<u8").tolist())) == 1
        assert shared.status().get("samples", 0) <= shared.samples.head
    writer.join()
    assert writer.exitcode == 0
    rest = reader.read(10**6)
    assert taken > 100
    assert taken + len(rest) + reader.lost == shared.samples.head
    assert reader.backlog == 0


# --- the memory of a daemon -------------------------------------------------------------------


def test_shared__attached_again__has_the_same_configuration_and_parts(shared, config):
    other = SharedMemory(shared.fd)
    assert other.config == config
    shared.events.append(b'{"kind": "x"}')
    assert other.reader("events", "recorder").read_json(5) == [{"kind": "x"}]


def test_cursors__of_several_readers__are_their_own_and_outlive_them(shared):
    for number in range(10):
        shared.events.append(json.dumps({"n": number}).encode())
    gateway, recorder = shared.reader("events", "gateway"), shared.reader("events", "recorder")
    assert len(gateway.read(4)) == 4
    assert len(recorder.read(7)) == 7
    gateway.commit()  # the recorder is killed before it could
    other = SharedMemory(shared.fd)
    assert other.reader("events", "gateway").read_json(1) == [{"n": 4}]
    assert other.reader("events", "recorder").read_json(1) == [{"n": 0}]
    assert other.follower("events").read(10) == []
    follower = other.follower("events")
    shared.events.append(b'{"n": 10}')
    assert follower.read_json(10) == [{"n": 10}]


def test_commands__through_another_mapping__arrive_in_order(shared):
    loop = shared.reader("commands", "loop")
    gateway = SharedMemory(shared.fd)
    for number in range(5):
        gateway.commands.append(json.dumps({"id": number}).encode())
    assert [command["id"] for command in loop.read_json(2)] == [0, 1]
    successor = SharedMemory(shared.fd)  # of a gateway that was killed
    successor.commands.append(b'{"id": 5}')
    assert [command["id"] for command in loop.read_json(9)] == [2, 3, 4, 5]


def test_words__set_by_one__seen_by_all(shared):
    other = SharedMemory(shared.fd)
    assert other.estop_requests == 0
    shared.request_estop()
    shared.request_estop()
    assert other.estop_requests == 2
    assert not other.is_alive("loop", 1.0)
    shared.beat("loop", now_ns())
    assert other.is_alive("loop", 60.0)
    shared.beat("loop", now_ns() - 2_000_000_000)
    assert not other.is_alive("loop", 1.0)
    assert not other.is_alive("gateway", 60.0)


def test_status__last_one_counts(shared):
    assert shared.status() == {}
    for number in range(9):
        shared.post_status({"number": number, "text": "x" * 3000})
    assert SharedMemory(shared.fd).status()["number"] == 8


@given(values=st.lists(st.floats(allow_nan=False), min_size=6, max_size=6), slot=st.integers(0, 2))
def test_slots__written_by_one__read_as_doubles_and_disjoint(values, slot):
    shared = SharedMemory.create(load_config(None, {"trajectory": {"max_duration_s": 0.1}}))
    for other in range(SLOTS):
        shared.rows(other)[:6] = memoryview(struct.pack("6d", *([float(other)] * 6))).cast("d")
    reader = SharedMemory(shared.fd)
    np.frombuffer(shared.slot(slot), dtype=np.float64)[:6] = values
    assert reader.rows(slot)[:6].tolist() == values
    for other in {0, 1, 2} - {slot}:
        assert reader.rows(other)[:6].tolist() == [float(other)] * 6
    assert len(reader.rows(slot)) == 101 * 3 * 2


def test_outlast_loop__supervisor_lives__returns_at_once(shared):
    shared.beat("loop", now_ns())
    worked = []
    outlast_loop(shared, os.getppid(), lambda: worked.append(1))
    assert not worked


def test_outlast_loop__supervisor_gone__works_until_the_loop_falls_silent(shared):
    worked = []

    def work():
        worked.append(1)
        if len(worked) < 5:
            shared.beat("loop", now_ns())

    shared.beat("loop", now_ns())
    outlast_loop(shared, -1, work)
    assert len(worked) >= 5
    assert not shared.is_alive("loop", 0.3)
