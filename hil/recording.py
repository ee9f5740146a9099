"""Recordings read back, as much of them as there is: a killed writer leaves a readable file."""

import json
import struct
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Final, Self
from zlib import crc32

import numpy as np
from google.protobuf.message import DecodeError
from mcap.exceptions import McapError
from mcap.records import Attachment, Channel, Metadata
from mcap.records import Message as McapMessage
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC
from zstandard import ZstdError

from drivers.arm_bus import MARK
from drivers.arm_group import split_bus
from hil.fixed_protobuf import Records
from hil.proto import telemetry_pb2
from hil.recording_writer import CONFIG_NAME, Part, RecordingError, RecordingWriter
from hil.telemetry import BusFrameLayout, LoggedFrame, SampleLayout, TelemetryError

__all__ = ["Part", "RecordedEvent", "Recording", "RecordingError", "RecordingWriter"]

_MOST_JOINTS: Final = 255  # more is a damaged file
_BLOCK: Final = 4096  # samples decoded at a time
_DAMAGE: Final = (McapError, ZstdError, struct.error, ValueError, RuntimeError, MemoryError)
"""What mcap's reader and its decompressors raise on a cut or damaged file."""


@dataclass(frozen=True, slots=True)
class RecordedEvent:
    """One event; `detail` is its JSON object, or `{"text": ...}` if it was none."""

    t_ns: int
    cycle: int
    kind: str
    detail: dict[str, Any]


@dataclass(frozen=True, slots=True)
class Recording:
    """A recording read back.

    Attributes:
        path: The file; of several parts, the first.
        config: The configuration of the run.
        joints: Of the arm.
        samples: One row per sample; columns are the fields of `hil.v1.Sample`, per-joint ones
            two-dimensional: `samples["q_meas_rad"][:, j]`.
        events: In the order of the file.
        is_truncated: The file ends early (the writer was killed) or is damaged from some point
            on; what stands before that point is here. Of several parts: samples are missing.
        part: Which part of which run the file is; of several, the first. None if the run has
            no parts.
        parts: The files that were read; none if it was made in memory.
    """

    path: Path
    config: dict[str, Any]
    joints: int
    samples: Records
    events: tuple[RecordedEvent, ...]
    is_truncated: bool
    part: Part | None = None
    parts: tuple[Path, ...] = ()

    @property
    def has_truth(self) -> bool:
        """The samples carry the plant's truth (simulation)."""
        return "q_true_rad" in (self.samples.dtype.names or ())

    @classmethod
    def open(cls, path: Path) -> Self:
        """Read one file, as much of it as there is.

        Raises:
            RecordingError: If the file cannot be read, is not MCAP, or is not of this program.
        """
        with _open_mcap(path) as file:
            reader = _Reader(path, file)
            payloads: list[bytes] = []
            events: list[RecordedEvent] = []
            for topic, payload in reader:
                if topic == "telemetry":
                    payloads.append(payload)
                elif topic == "event":
                    events.append(_decode_event(path, payload))
        layout = reader.layout()
        return cls(
            path=path,
            config=_decode_config(path, reader.metadata.get("json", "")),
            joints=layout.joints,
            samples=_decode_samples(path, layout, payloads),
            events=tuple(events),
            is_truncated=reader.is_truncated,
            part=reader.part(),
            parts=(path,),
        )

    @classmethod
    def open_run(cls, path: Path) -> Self:
        """Read a file and the parts of the run that continue it, as one recording.

        A recorder that was killed leaves a part without end, and its successor's part may begin
        before that end: what stands in both is here once.

        Raises:
            RecordingError: As for `open`.
        """
        files = [cls.open(part) for part in _continued(path)]
        return files[0] if len(files) == 1 else cls._joined(files)

    @classmethod
    def _joined(cls, files: Sequence["Recording"]) -> Self:
        first, last = files[0], files[-1]
        samples = _without_repeats([file.samples for file in files])
        gaps = int((np.diff(samples["seq"].astype(np.int64)) != 1).sum())
        return cls(
            path=first.path,
            config=first.config,
            joints=first.joints,
            samples=samples,
            events=tuple(_once(file.events for file in files)),
            is_truncated=last.is_truncated or gaps > 0,
            part=first.part,
            parts=tuple(file.path for file in files),
        )

    def frames(self, *, with_marks: bool = False) -> Iterator[LoggedFrame]:
        """Read the bus frames from the file, in the order in which the loop saw them.

        Args:
            with_marks: Also where cycles begin on a bus without SYNC (`drivers.arm_bus.MARK`).

        Raises:
            RecordingError: If the file is gone, or a bus log in it cannot be read.
        """
        seen_ns: int | None = None  # the last instant of the parts before
        for path in self.parts:
            last_ns = seen_ns
            for frame in _frames(path):
                if seen_ns is not None and frame.t_ns <= seen_ns:
                    continue
                last_ns = frame.t_ns
                if with_marks or split_bus(frame.direction)[1] != MARK:
                    yield frame
            seen_ns = last_ns

    def trajectories(self) -> dict[int, bytes]:
        """Read the references that were played: CRC-32 -> rows (`RecordingWriter.add_trajectory`).

        Raises:
            RecordingError: If the file is gone.
        """
        found: dict[int, bytes] = {}
        for path in self.parts:
            with _open_mcap(path) as file:
                reader = _Reader(path, file)
                for _ in reader:
                    pass
                found |= reader.trajectories
        return found


def part_of(path: Path) -> Part | None:
    """Return which part of which run a file is, from its first records; None if it has no parts.

    Raises:
        RecordingError: If the file cannot be read, is not MCAP, or is not of this program.
    """
    with _open_mcap(path) as file:
        reader = _Reader(path, file)
        reader.read_metadata()
    reader.layout()
    return reader.part()


def is_part(path: Path, part: Part) -> bool:
    """Tell whether a file is there, readable, and this part of this run."""
    try:
        return part_of(path) == part
    except RecordingError:  # an older run's, or one whose writer was killed at its first byte
        return False


def _continued(path: Path) -> Iterator[Path]:
    """Return a file and those that continue it, in order."""
    yield path
    part = part_of(path)
    while part is not None:
        first, part = part.first(path), Part(part.series, part.number + 1)
        path = part.path(first)
        if not is_part(path, part):
            return
        yield path


def _without_repeats(files: Sequence[Records]) -> Records:
    kept, seen = [], -1
    for samples in files:
        new = samples[samples["seq"].astype(np.int64) > seen]
        if len(new):
            seen = int(new["seq"][-1])
            kept.append(new)
    return np.concatenate(kept) if kept else files[0]


def _once(files: Iterable[Sequence[RecordedEvent]]) -> Iterator[RecordedEvent]:
    before: Sequence[RecordedEvent] = ()
    for events in files:
        last_ns = max((event.t_ns for event in before), default=-1)
        yield from (event for event in events if event.t_ns > last_ns or event not in before)
        before = events


def _frames(path: Path) -> Iterator[LoggedFrame]:
    layout = BusFrameLayout()
    with _open_mcap(path) as file:
        for topic, payload in _Reader(path, file):
            if topic == "bus":
                try:
                    yield from layout.decode_log(payload)
                except TelemetryError as error:
                    raise RecordingError(f"recording {path}: {error}") from error


def _open_mcap(path: Path) -> BinaryIO:
    try:
        file = path.open("rb")
        magic = file.read(len(MCAP0_MAGIC))
    except OSError as error:
        raise RecordingError(f"cannot open recording {path}: {error.strerror}") from error
    if magic != MCAP0_MAGIC:
        file.close()
        raise RecordingError(f"{path} is not an MCAP recording")
    file.seek(0)
    return file


class _Reader:
    """Iterates over (topic, payload) up to the end of the file or its first damage."""

    def __init__(self, path: Path, file: BinaryIO) -> None:
        self.path = path
        self.is_truncated = False
        self.metadata: dict[str, str] = {}
        self.trajectories: dict[int, bytes] = {}
        size = path.stat().st_size
        self._stream = StreamReader(file, validate_crcs=True, record_size_limit=size)

    def __iter__(self) -> Iterator[tuple[str, bytes]]:
        topics: dict[int, str] = {}
        try:
            for record in self._stream.records:
                if isinstance(record, McapMessage):
                    yield topics.get(record.channel_id, ""), record.data
                elif isinstance(record, Channel):
                    topics[record.id] = record.topic
                elif isinstance(record, Metadata) and record.name == CONFIG_NAME:
                    self.metadata = record.metadata
                elif isinstance(record, Attachment):
                    self.trajectories[crc32(record.data)] = record.data
        except _DAMAGE:
            self.is_truncated = True

    def read_metadata(self) -> None:
        """Read no further than the metadata of this program."""
        for _ in self:
            if self.metadata:
                return

    def part(self) -> Part | None:
        """Return which part of a run this is, known once the metadata has passed."""
        try:
            return Part(self.metadata["series"], int(self.metadata["part"]))
        except (KeyError, ValueError):
            return None

    def layout(self) -> SampleLayout:
        """Return the samples' layout, known once the metadata has passed."""
        try:
            joints = int(self.metadata["joints"])
            if joints > _MOST_JOINTS:
                raise ValueError(f"{joints} joints")
            return SampleLayout(joints, json.loads(self.metadata["with_truth"]) is True)
        except (KeyError, ValueError) as error:
            raise RecordingError(
                f"{self.path} is MCAP but not a recording of this program"
                f" (no {CONFIG_NAME} metadata)"
            ) from error


def _decode_config(path: Path, text: str) -> dict[str, Any]:
    try:
        config = json.loads(text)
    except ValueError as error:
        raise RecordingError(f"recording {path}: its configuration is not JSON") from error
    return config if isinstance(config, dict) else {"config": config}


def _decode_event(path: Path, payload: bytes) -> RecordedEvent:
    event = telemetry_pb2.Event()
    try:
        event.ParseFromString(payload)
    except DecodeError as error:
        raise RecordingError(f"recording {path}: an event cannot be read: {error}") from error
    try:
        detail = json.loads(event.detail)
    except ValueError:
        detail = event.detail
    if not isinstance(detail, dict):
        detail = {"text": detail}
    return RecordedEvent(event.t_ns, event.cycle, event.kind, detail)


def _decode_samples(path: Path, layout: SampleLayout, payloads: list[bytes]) -> Records:
    rows = np.zeros(len(payloads), dtype=layout.dtype)
    try:
        for start in range(0, len(payloads), _BLOCK):
            block = payloads[start : start + _BLOCK]
            rows[start : start + len(block)] = layout.decode(block)
    except TelemetryError as error:
        raise RecordingError(f"recording {path}: {error}") from error
    return rows
