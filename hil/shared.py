"""Shared memory between the loop and the processes around it: lock-free, one writer per part.

One memory file (memfd) holds the configuration, four rings, the trajectory slots and a few
counters. Nobody ever waits for anybody: a writer that laps a reader is noticed by the reader as
lost records. The file has no name, so that nothing is left behind however the processes end.

Ordering: every record carries its sequence number before and after its payload, written in that
order by single aligned stores. That suffices where stores are not reordered with older stores
(x86-64); elsewhere a torn record shows up as a payload that its reader refuses.
"""

import json
import mmap
import os
import struct
from collections.abc import Mapping
from typing import Any, Final, Self

from hil.config import Config, config_from_json
from hil.telemetry import BusFrameLayout, SampleLayout

_U64 = struct.Struct("<Q")
_HEAD = struct.Struct("<QQ")  # sequence number + 1, payload length
_TAIL_SIZE = 8
_CONFIG_SIZE = 64 << 10
_EVENT_BYTES = 2048
STATUS_EVERY_S: Final = 0.1
"""Period of the loop's status."""
FRAMES_AT_ONCE: Final = 32
"""Bus frames in one record at the most; a cycle with more writes several records."""
SLOTS: Final = 3
"""Trajectory slots: one being played, one waiting, one being written."""


class Ring:
    """Fixed-size records from one writer to any number of readers.

    Readers keep their place in a cursor of their own (`RingReader`), in the same memory, so that
    a restarted reader goes on where its predecessor ended.
    """

    def __init__(self, memory: memoryview, payload_size: int, slots: int) -> None:
        self.memory = memory
        self.slots = slots
        self.slot_size = _HEAD.size + (payload_size + 7) // 8 * 8 + _TAIL_SIZE
        self._payload_size = payload_size
        self._next: int = _U64.unpack_from(memory, 0)[0]
        self._offset = 0

    @staticmethod
    def size(payload_size: int, slots: int) -> int:
        """Bytes of memory a ring needs."""
        return 8 + slots * (_HEAD.size + (payload_size + 7) // 8 * 8 + _TAIL_SIZE)

    @property
    def head(self) -> int:
        """Number of records written so far."""
        count: int = _U64.unpack_from(self.memory, 0)[0]
        return count

    def begin(self, length: int) -> int:
        """Start a record of `length` bytes and return the offset at which to write it."""
        self._offset = 8 + self._next % self.slots * self.slot_size
        _HEAD.pack_into(self.memory, self._offset, self._next + 1, length)
        return self._offset + _HEAD.size

    def commit(self) -> None:
        """Publish the record begun last."""
        self._next += 1
        memory = self.memory
        _U64.pack_into(memory, self._offset + self.slot_size - _TAIL_SIZE, self._next)
        _U64.pack_into(memory, 0, self._next)

    def append(self, payload: bytes) -> None:
        """Publish one record; longer ones than the ring was made for are cut."""
        payload = payload[: self._payload_size]
        at = self.begin(len(payload))
        self.memory[at : at + len(payload)] = payload
        self.commit()

    def get(self, number: int) -> bytes | None:
        """Return record `number`, None if it has been overwritten (or is not written yet)."""
        offset = 8 + number % self.slots * self.slot_size
        tail_at = offset + self.slot_size - _TAIL_SIZE
        if _U64.unpack_from(self.memory, tail_at)[0] != number + 1:
            return None
        length = min(_HEAD.unpack_from(self.memory, offset)[1], self._payload_size)
        at = offset + _HEAD.size
        payload = bytes(self.memory[at : at + length])
        if _U64.unpack_from(self.memory, offset)[0] != number + 1:
            return None
        return payload


class RingReader:
    """One reader's place in a ring. `lost` counts records that were overwritten unread."""

    def __init__(self, ring: Ring, cursor: memoryview) -> None:
        self._ring = ring
        self._cursor = cursor
        self.lost = 0

    def read(self, most: int) -> list[bytes]:
        """Return up to `most` new records, oldest first, and move on."""
        place: int = _U64.unpack_from(self._cursor, 0)[0]
        head = self._ring.head
        if head - place > self._ring.slots:
            self.lost += head - self._ring.slots - place
            place = head - self._ring.slots
        records = []
        end = min(head, place + most)
        while place < end:
            record = self._ring.get(place)
            place += 1
            if record is None:
                self.lost += 1
            else:
                records.append(record)
        _U64.pack_into(self._cursor, 0, place)
        return records


class SharedMemory:
    """All shared parts of one daemon. The supervisor creates it, its children attach by fd.

    Attributes:
        config: The running configuration.
        samples: Ring of serialised `Sample`, written by the loop.
        frames: Ring of serialised `BusLog`, one or more a cycle, written by the loop.
        events: Ring of JSON events, written by the loop.
        commands: Ring of JSON commands, written by the gateway.
        layout: Layout of a sample.
        frame_layout: Layout of a bus frame.
    """

    def __init__(self, fd: int) -> None:
        self.fd = fd
        self._map = mmap.mmap(fd, 0)
        self._memory = memoryview(self._map)
        (length,) = _U64.unpack_from(self._memory, 0)
        self.config: Config = config_from_json(bytes(self._memory[8 : 8 + length]))
        self.layout = SampleLayout(self.config.joints, with_truth=False)
        self.frame_layout = BusFrameLayout()
        self._plan = _plan(self.config, self.layout.size, self.frame_layout.size)
        self.samples = self._ring("samples")
        self.frames = self._ring("frames")
        self.events = self._ring("events")
        self.commands = self._ring("commands")
        self._status = self._ring("status")
        self._estop = self._view("estop")
        self._beats = {who: self._view(f"{who}.beat") for who in ("gateway", "loop")}

    @classmethod
    def create(cls, config: Config) -> Self:
        """Make the memory file for a configuration and write it there."""
        layout = SampleLayout(config.joints, with_truth=False)
        plan = _plan(config, layout.size, BusFrameLayout().size)
        fd = os.memfd_create("hil", 0)
        os.ftruncate(fd, plan["end"][0])
        text = config.model_dump_json().encode()
        os.pwrite(fd, _U64.pack(len(text)) + text, 0)
        return cls(fd)

    def reader(self, part: str, who: str) -> RingReader:
        """Return the reader of ring `part` for `who`: `loop`, `gateway` or `recorder`."""
        return RingReader(getattr(self, part), self._view(f"{who}.{part}"))

    def rows(self, slot: int) -> "memoryview[float]":
        """Return the flat doubles of a trajectory slot."""
        return self.slot(slot).cast("d")

    def slot(self, slot: int) -> memoryview:
        """Return the bytes of a trajectory slot."""
        return self._view(f"slot{slot}")

    # Counters, each with one writer.

    def beat(self, who: str, t_ns: int) -> None:
        """Note that `who` (`gateway`, `loop`) is alive at `t_ns` (CLOCK_MONOTONIC)."""
        _U64.pack_into(self._beats[who], 0, t_ns)

    def last_beat(self, who: str) -> int:
        """Return when `who` was last alive, 0 if never."""
        t_ns: int = _U64.unpack_from(self._beats[who], 0)[0]
        return t_ns

    def request_estop(self) -> None:
        """Ask for an emergency stop, past every queue."""
        _U64.pack_into(self._estop, 0, self.estop_requests + 1)

    @property
    def estop_requests(self) -> int:
        """Number of emergency stops asked for so far."""
        count: int = _U64.unpack_from(self._estop, 0)[0]
        return count

    def post_status(self, status: Mapping[str, Any]) -> None:
        """Publish the loop's status; the last one counts."""
        self._status.append(json.dumps(status).encode())

    def status(self) -> dict[str, Any]:
        """Return the last status, empty before the first."""
        head = self._status.head
        record = self._status.get(head - 1) if head else None
        status: dict[str, Any] = json.loads(record) if record else {}
        return status

    def _ring(self, name: str) -> Ring:
        start, size, payload, slots = self._plan[name]
        return Ring(self._memory[start : start + size], payload, slots)

    def _view(self, name: str) -> memoryview:
        start, size = self._plan[name][:2]
        return self._memory[start : start + size]


def _plan(config: Config, sample_size: int, frame_size: int) -> dict[str, tuple[int, ...]]:
    """Place every part: name -> (start, size[, payload size, slots]); `end` is the total."""
    n, period_s = config.joints, config.loop.period_s
    rows = round(config.trajectory.max_duration_s / period_s) + 1
    ring_s = 8.0
    cycles = round(ring_s / period_s)
    rings = {
        "samples": (sample_size, cycles),
        "frames": (frame_size * FRAMES_AT_ONCE, cycles),
        "events": (_EVENT_BYTES, 512),
        "commands": (_EVENT_BYTES, 64),
        "status": (_EVENT_BYTES, 2),
    }
    words = ["estop", "gateway.beat", "loop.beat", "loop.commands"]
    words += [f"{who}.{part}" for who in ("gateway", "recorder") for part in ("samples", "events")]
    words += ["recorder.frames"]
    plan: dict[str, tuple[int, ...]] = {}
    at = _CONFIG_SIZE
    for word in words:
        plan[word] = (at, 8)
        at += 64  # a cache line each: no writer disturbs another
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
