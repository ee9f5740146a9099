"""Shared memory between the loop and the processes around it: lock-free, one writer per part.

One memory file (memfd) holds the configuration, the rings, the trajectory slots, the histograms of
the loop's timing and a few counters. Nobody ever waits for anybody: a writer that laps a reader is
noticed by the reader as lost records. The file has no name, so that nothing is left behind however
the processes end.

Ordering: every record carries its sequence number before and after its payload, written in that
order by single aligned stores (a typed memoryview; `struct.pack_into` would let readers see the
zeros it writes first). That suffices where stores are not reordered with older stores (x86-64);
elsewhere a torn record shows up as a payload that its reader refuses.
"""

import json
import mmap
import os
import struct
from collections.abc import Mapping
from time import clock_gettime_ns
from typing import Any, Final, Self

from hil.config import Config, config_from_json
from hil.telemetry import BusFrameLayout, SampleLayout
from hil.timing import TIMING_BYTES, Timing

_U64 = struct.Struct("<Q")
_HEAD_WORDS = 2  # sequence number + 1, payload length
_TAIL_WORDS = 1  # sequence number + 1
_CONFIG_SIZE = 64 << 10
_EVENT_BYTES = 2048
_STATUS_BYTES = 8192
_LEASE_BYTES = 512
_ANSWER_BYTES = 1024
_CLOCK_MONOTONIC = 1
_CHILDREN = ("loop", "gateway", "recorder")
STATUS_EVERY_S: Final = 0.1
"""Period of the loop's status."""
RING_S: Final = 13.0
"""How far back the samples and bus frames reach: the black box's 12 s, and time to take them."""
FRAMES_AT_ONCE: Final = 16
"""Bus frames in one record, at least; fewer if they are CAN FD frames that nobody announced."""
SLOTS: Final = 3
"""Trajectory slots: one being played, one waiting, one being written."""


class Ring:
    """Fixed-size records from one writer to any number of readers.

    Readers keep their place in a cursor of their own (`RingReader`), in the same memory, so that
    a restarted reader goes on where its predecessor ended.
    """

    __slots__ = ("_at", "_next", "_payload_size", "_slot_words", "_words", "memory", "slots")

    def __init__(self, memory: memoryview, payload_size: int, slots: int) -> None:
        self.memory = memory
        self.slots = slots
        self._words = memory.cast("Q")
        self._slot_words = _slot_words(payload_size)
        self._payload_size = payload_size
        self._next: int = self._words[0]
        self._at = 0

    @property
    def payload_size(self) -> int:
        """Bytes of the longest record."""
        return self._payload_size

    @staticmethod
    def size(payload_size: int, slots: int) -> int:
        """Bytes of memory a ring needs."""
        return 8 * (1 + slots * _slot_words(payload_size))

    @property
    def head(self) -> int:
        """Number of records written so far."""
        return self._words[0]

    def begin(self, length: int) -> int:
        """Start a record of `length` bytes and return the offset at which to write it."""
        number, words = self._next, self._words
        at = self._at = 1 + number % self.slots * self._slot_words
        words[at] = number + 1
        words[at + 1] = length
        return 8 * (at + _HEAD_WORDS)

    def commit(self) -> None:
        """Publish the record begun last."""
        self._next = number = self._next + 1
        words = self._words
        words[self._at + self._slot_words - _TAIL_WORDS] = number
        words[0] = number

    def append(self, payload: bytes) -> None:
        """Publish one record; longer ones than the ring was made for are cut."""
        payload = payload[: self._payload_size]
        at = self.begin(len(payload))
        self.memory[at : at + len(payload)] = payload
        self.commit()

    def get(self, number: int) -> bytes | None:
        """Return record `number`, None if it has been overwritten (or is not written yet)."""
        words, at = self._words, 1 + number % self.slots * self._slot_words
        if words[at + self._slot_words - _TAIL_WORDS] != number + 1:
            return None
        length = min(words[at + 1], self._payload_size)
        start = 8 * (at + _HEAD_WORDS)
        payload = bytes(self.memory[start : start + length])
        return payload if words[at] == number + 1 else None

    def last(self) -> bytes | None:
        """Return the newest record, None before the first."""
        head = self.head
        record = None
        while head and record is None:  # a writer that is faster than this: look again
            record = self.get(head - 1)
            head = self.head
        return record


def _slot_words(payload_size: int) -> int:
    return _HEAD_WORDS + (payload_size + 7) // 8 + _TAIL_WORDS


class RingReader:
    """One reader's place in a ring.

    The place is remembered for a successor only when `commit` says that what was read is dealt
    with: after a kill, records are read twice rather than never.

    Attributes:
        place: Number of the next record.
        lost: Records that were overwritten unread.
    """

    __slots__ = ("_cursor", "_ring", "lost", "place")

    def __init__(self, ring: Ring, cursor: memoryview) -> None:
        self._ring = ring
        self._cursor = cursor.cast("Q")
        self.place: int = self._cursor[0]
        self.lost = 0

    @property
    def backlog(self) -> int:
        """Records written and not read."""
        return self._ring.head - self.place

    def read(self, most: int) -> list[bytes]:
        """Return up to `most` new records, oldest first, and move on."""
        ring, place = self._ring, self.place
        head = ring.head
        if head == place:
            return []
        if head - place > ring.slots:
            self.lost += head - ring.slots - place
            place = head - ring.slots
        records = []
        end = min(head, place + most)
        while place < end:
            record = ring.get(place)
            place += 1
            if record is None:
                self.lost += 1
            else:
                records.append(record)
        self.place = place
        return records

    def read_json(self, most: int) -> list[dict[str, Any]]:
        """Return up to `most` new JSON objects; a record that is none (cut, torn) is lost."""
        objects = []
        for record in self.read(most):
            try:
                objects.append(json.loads(record))
            except ValueError:
                self.lost += 1
        return objects

    def skip(self) -> None:
        """Pass over everything written so far; it does not count as lost."""
        self.place = self._ring.head

    def commit(self) -> None:
        """Note that everything read so far is dealt with."""
        self._cursor[0] = self.place


class SharedMemory:
    """All shared parts of one daemon. The supervisor creates it, its children attach by fd.

    Attributes:
        config: The running configuration.
        samples: Ring of serialised `Sample`, written by the loop.
        frames: Ring of serialised `BusLog`, one or more a cycle, written by the loop.
        events: Ring of JSON events, written by the loop.
        commands: Ring of JSON commands, written by the gateway.
        notes: Ring of JSON events about the recording, written by the recorder.
        lease: Ring of who has authority, as JSON, written by the gateway for its successor.
        answers: Ring of the answers given, written by the gateway for its successor.
        timing: Histograms of the loop's stamps and its deadline misses, written by the loop.
        layout: Layout of a sample.
        frame_layout: Layout of a bus frame.
    """

    def __init__(self, fd: int) -> None:
        self.fd = fd
        self._map = mmap.mmap(fd, 0)
        self._memory = memoryview(self._map)
        length = self._memory[:8].cast("Q")[0]
        self.config: Config = config_from_json(bytes(self._memory[8 : 8 + length]))
        self.layout = SampleLayout(self.config.joints, with_truth=False)
        self.frame_layout = BusFrameLayout()
        self._plan = _plan(self.config, self.layout.size, self.frame_layout)
        self.samples = self._ring("samples")
        self.frames = self._ring("frames")
        self.events = self._ring("events")
        self.commands = self._ring("commands")
        self.notes = self._ring("notes")
        self.lease = self._ring("lease")
        self.answers = self._ring("answers")
        self._status = self._ring("status")
        self.timing = Timing(
            self._view("timing"),
            period_s=self.config.loop.period_s,
            timeout_s=self.config.loop.feedback_timeout_s,
        )
        self._estop = self._view("estop").cast("Q")
        self._part = self._view("recorder.part").cast("Q")
        self._beats = {who: self._view(f"{who}.beat").cast("Q") for who in _CHILDREN}

    @classmethod
    def create(cls, config: Config) -> Self:
        """Make the memory file for a configuration and write it there."""
        layout = SampleLayout(config.joints, with_truth=False)
        plan = _plan(config, layout.size, BusFrameLayout())
        fd = os.memfd_create("hil", 0)
        os.ftruncate(fd, plan["end"][0])
        text = config.model_dump_json().encode()
        os.pwrite(fd, _U64.pack(len(text)) + text, 0)
        return cls(fd)

    def reader(self, part: str, who: str) -> RingReader:
        """Return the reader of ring `part` for `who`: `loop`, `gateway` or `recorder`."""
        return RingReader(getattr(self, part), self._view(f"{who}.{part}"))

    def follower(self, part: str) -> RingReader:
        """Return a reader of what ring `part` gets from now on; its place is its own."""
        ring: Ring = getattr(self, part)
        cursor = bytearray(8)
        reader = RingReader(ring, memoryview(cursor))
        reader.place = ring.head
        return reader

    def rows(self, slot: int) -> "memoryview[float]":
        """Return the flat doubles of a trajectory slot."""
        return self.slot(slot).cast("d")

    def slot(self, slot: int) -> memoryview:
        """Return the bytes of a trajectory slot."""
        return self._view(f"slot{slot}")

    # Counters, each with one writer.

    def beat(self, who: str, t_ns: int) -> None:
        """Note that `who` (`loop`, `gateway`, `recorder`) is alive at `t_ns` (CLOCK_MONOTONIC)."""
        self._beats[who][0] = t_ns

    def last_beat(self, who: str) -> int:
        """Return when `who` was last alive, 0 if never."""
        return self._beats[who][0]

    def is_alive(self, who: str, within_s: float) -> bool:
        """Tell whether `who` was alive within the last so many seconds."""
        beat_ns = self._beats[who][0]
        return beat_ns > 0 and clock_gettime_ns(_CLOCK_MONOTONIC) - beat_ns < within_s * 1e9

    def request_estop(self) -> None:
        """Ask for an emergency stop, past every queue."""
        self._estop[0] = (self._estop[0] + 1) & 0xFFFF_FFFF

    @property
    def estop_requests(self) -> int:
        """Number of emergency stops asked for so far."""
        return self._estop[0]

    @property
    def recording_part(self) -> int:
        """Number of the recording's part that was begun last, 0 before the first."""
        return self._part[0]

    @recording_part.setter
    def recording_part(self, number: int) -> None:
        self._part[0] = number

    def post_status(self, status: Mapping[str, Any]) -> None:
        """Publish the loop's status; the last one counts."""
        self._status.append(json.dumps(status).encode())

    def status(self) -> dict[str, Any]:
        """Return the last status, empty before the first."""
        record = self._status.last()
        status: dict[str, Any] = json.loads(record) if record else {}
        return status

    def _ring(self, name: str) -> Ring:
        start, size, payload, slots = self._plan[name]
        return Ring(self._memory[start : start + size], payload, slots)

    def _view(self, name: str) -> memoryview:
        start, size = self._plan[name][:2]
        return self._memory[start : start + size]


def frames_at_once(config: Config) -> int:
    """Return how many bus frames fit in one record: more than an arm's cycle has, of any size.

    On top of what comes in every cycle there is room for one frame per axis that comes now and
    then, and two per bus (SYNC or mark, the master's heartbeat).
    """
    period_s = config.loop.period_s
    cyclic = sum(
        frame.every == 1 and not frame.is_shared
        for axis in config.axes
        for frame in axis.cycle_frames(period_s)
    )
    return max(FRAMES_AT_ONCE, cyclic + config.joints + 2 * len(config.bus.addresses))


def _plan(
    config: Config, sample_size: int, frame_layout: BusFrameLayout
) -> dict[str, tuple[int, ...]]:
    """Place every part: name -> (start, size[, payload size, slots]); `end` is the total."""
    has_fd = any(f.is_fd for a in config.axes for f in a.cycle_frames(config.loop.period_s))
    frame_size = frame_layout.fd_size if has_fd else frame_layout.size
    n, period_s = config.joints, config.loop.period_s
    rows = round(config.trajectory.max_duration_s / period_s) + 1
    cycles = round(RING_S / period_s)
    rings = {
        "samples": (sample_size, cycles),
        "frames": (frame_size * frames_at_once(config), cycles),
        "events": (_EVENT_BYTES, 512),
        "commands": (_EVENT_BYTES, 64),
        "notes": (_EVENT_BYTES, 64),
        "status": (_STATUS_BYTES, 4),
        "lease": (_LEASE_BYTES, 4),
        "answers": (_ANSWER_BYTES, 2048),
    }
    words = ["estop", "loop.commands", *(f"{who}.beat" for who in _CHILDREN)]
    words += [f"{who}.{part}" for who in ("gateway", "recorder") for part in ("samples", "events")]
    words += ["recorder.frames", "recorder.part", "gateway.notes"]
    plan: dict[str, tuple[int, ...]] = {}
    at = _CONFIG_SIZE
    for word in words:
        plan[word] = (at, 8)
        at += 64  # a cache line each: no writer disturbs another
    plan["timing"] = (at, TIMING_BYTES)
    at += (TIMING_BYTES + 63) // 64 * 64
    for name, (payload, slots) in rings.items():
        size = Ring.size(payload, slots)
        plan[name] = (at, size, payload, slots)
        at += (size + 63) // 64 * 64
    for slot in range(SLOTS):
        size = rows * 3 * n * 8
        plan[f"slot{slot}"] = (at, size)
        at += (size + 63) // 64 * 64
    plan["end"] = (at,)
    return plan
