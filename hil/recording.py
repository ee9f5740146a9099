"""Recordings: one MCAP file per run, Protobuf inside, readable after a kill.

Channels `telemetry` (`hil.v1.Sample`, one message per sample), `bus` (`hil.v1.BusLog`, one
message per drained batch) and `event` (`hil.v1.Event`); the references that were played are
attachments, and the running configuration is the metadata record `config`. The file holds nothing
but what was recorded (no wall-clock time, no host, no version), so that the same run written twice
gives the same bytes.
"""

import json
import struct
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Final, Self
from zlib import crc32

import numpy as np
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message import DecodeError
from mcap.exceptions import McapError
from mcap.records import Attachment, Channel, Metadata
from mcap.records import Message as McapMessage
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC, Writer
from zstandard import ZstdError

from drivers.arm_bus import MARK
from hil.errors import HilError
from hil.fixed_protobuf import Records
from hil.proto import telemetry_pb2
from hil.telemetry import BusFrameLayout, LoggedFrame, SampleLayout, TelemetryError

FLUSH_PERIOD_NS: Final = 100_000_000
"""Recorded time after which a chunk is closed and handed to the kernel: what a kill can cost."""
_CONFIG: Final = "config"
_ROWS_NAME: Final = "trajectory-{:08x}.f64"
_ROWS_TYPE: Final = "application/octet-stream"
_MOST_JOINTS: Final = 255  # more is a damaged file
_BLOCK: Final = 4096  # samples decoded at a time
_DAMAGE: Final = (McapError, ZstdError, struct.error, ValueError, RuntimeError, MemoryError)
"""What mcap's reader and its decompressors raise on a cut or damaged file."""


class RecordingError(HilError):
    """A recording could not be written, or a file is not a recording."""


class RecordingWriter:
    """Writes one recording. Not for the loop's process: a write can wait for the disk.

    Args:
        path: File to create; an existing one is replaced.
        config: The running configuration as JSON text, or as what `json.dumps` takes.
        joints: Of the arm.
        with_truth: Samples carry the plant's truth.

    Raises:
        RecordingError: If the file cannot be created.
    """

    def __init__(
        self, path: Path, config: Mapping[str, Any] | str, joints: int, with_truth: bool
    ) -> None:
        text = config if isinstance(config, str) else json.dumps(config, sort_keys=True)
        self.path: Final = path
        self._due_ns = 0
        self._is_closed = False
        try:
            self._file = path.open("wb")
        except OSError as error:
            raise RecordingError(f"cannot create recording {path}: {error.strerror}") from error
        self._writer: Any = Writer(self._file)  # untyped in part
        self._writer.start(library="hil")
        layout = {"json": text, "joints": str(joints), "with_truth": json.dumps(with_truth)}
        self._writer.add_metadata(_CONFIG, layout)
        self._telemetry = self._channel("telemetry", telemetry_pb2.Sample)
        self._bus = self._channel("bus", telemetry_pb2.BusLog)
        self._event = self._channel("event", telemetry_pb2.Event)
        try:
            self.flush()
        except RecordingError:
            self._is_closed = True
            with suppress(OSError):  # closing tries to write once more
                self._file.close()
            raise

    def _channel(self, topic: str, message: Any) -> int:  # noqa: ANN401 - generated class
        files = FileDescriptorSet()
        message.DESCRIPTOR.file.CopyToProto(files.file.add())
        name = message.DESCRIPTOR.full_name
        schema = self._writer.register_schema(name, "protobuf", files.SerializeToString())
        return int(self._writer.register_channel(topic, "protobuf", schema))

    def add_sample(self, t_ns: int, seq: int, payload: bytes) -> None:
        """Add one serialised `hil.v1.Sample`.

        Args:
            t_ns: Its `t_ns`, the log time of the message.
            seq: Its `seq`.
            payload: The sample as the loop wrote it; not looked into.

        Raises:
            RecordingError: If the file cannot be written (disk full); what was written stays.
        """
        self._add(self._telemetry, t_ns, payload, seq)

    def add_bus_log(self, t_ns: int, payload: bytes) -> None:
        """Add one serialised `hil.v1.BusLog`; `t_ns` is the instant of its first frame.

        Raises:
            RecordingError: As for `add_sample`.
        """
        self._add(self._bus, t_ns, payload, 0)

    def add_event(
        self, t_ns: int, cycle: int, kind: str, detail: Mapping[str, Any] | str = "{}"
    ) -> None:
        """Add a state change, a fault, or a command and its outcome.

        Args:
            t_ns: Instant on the samples' clock.
            cycle: Period number.
            kind: What happened, one word.
            detail: JSON object, as text or as what `json.dumps` takes.

        Raises:
            RecordingError: As for `add_sample`.
        """
        text = detail if isinstance(detail, str) else json.dumps(detail, sort_keys=True)
        event = telemetry_pb2.Event(t_ns=t_ns, cycle=cycle, kind=kind, detail=text)
        self._add(self._event, t_ns, event.SerializeToString(), 0)

    def add_trajectory(self, t_ns: int, crc: int, rows: bytes) -> None:
        """Add the reference that a trajectory command started, as an attachment.

        Args:
            t_ns: Instant of the command on the samples' clock.
            crc: CRC-32 of `rows`; the command names its reference by it.
            rows: Doubles in host order, one row a period: q, dq, ddq of all joints.

        Raises:
            RecordingError: As for `add_sample`.
        """
        try:
            self._writer.add_attachment(t_ns, t_ns, _ROWS_NAME.format(crc), _ROWS_TYPE, rows)
        except OSError as error:
            raise self._write_error(error) from error

    def _add(self, channel: int, t_ns: int, payload: bytes, seq: int) -> None:
        try:
            self._writer.add_message(channel, t_ns, payload, t_ns, seq & 0xFFFF_FFFF)
            if t_ns >= self._due_ns:
                self._due_ns = t_ns + FLUSH_PERIOD_NS
                self._writer.flush()
        except OSError as error:
            raise self._write_error(error) from error

    def _write_error(self, error: OSError) -> RecordingError:
        return RecordingError(f"cannot write recording {self.path}: {error.strerror}")

    def flush(self) -> None:
        """Hand everything recorded so far to the kernel: a kill no longer loses it.

        Raises:
            RecordingError: As for `add_sample`.
        """
        try:
            self._writer.flush()
        except OSError as error:
            raise self._write_error(error) from error

    def close(self) -> None:
        """Write the index and close the file. Idempotent.

        Raises:
            RecordingError: As for `add_sample`; the file is closed without its index.
        """
        if self._is_closed:
            return
        self._is_closed = True
        try:
            with self._file:
                self._writer.finish()
        except OSError as error:
            raise self._write_error(error) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


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
        path: The file.
        config: The configuration of the run.
        joints: Of the arm.
        samples: One row per sample; columns are the fields of `hil.v1.Sample`, per-joint ones
            two-dimensional: `samples["q_meas_rad"][:, j]`.
        events: In the order of the file.
        is_truncated: The file ends early (the writer was killed) or is damaged from some point
            on; what stands before that point is here.
    """

    path: Path
    config: dict[str, Any]
    joints: int
    samples: Records
    events: tuple[RecordedEvent, ...]
    is_truncated: bool

    @property
    def has_truth(self) -> bool:
        """The samples carry the plant's truth (simulation)."""
        return "q_true_rad" in (self.samples.dtype.names or ())

    @classmethod
    def open(cls, path: Path) -> Self:
        """Read a recording, as much of it as there is.

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
        )

    def frames(self, *, with_marks: bool = False) -> Iterator[LoggedFrame]:
        """Read the bus frames from the file, in the order in which the loop saw them.

        Args:
            with_marks: Also where cycles begin on a bus without SYNC (`drivers.arm_bus.MARK`).

        Raises:
            RecordingError: If the file is gone, or a bus log in it cannot be read.
        """
        layout = BusFrameLayout()
        with _open_mcap(self.path) as file:
            for topic, payload in _Reader(self.path, file):
                if topic == "bus":
                    try:
                        for frame in layout.decode_log(payload):
                            if with_marks or frame.direction != MARK:
                                yield frame
                    except TelemetryError as error:
                        raise RecordingError(f"recording {self.path}: {error}") from error

    def trajectories(self) -> dict[int, bytes]:
        """Read the references that were played: CRC-32 -> rows (`RecordingWriter.add_trajectory`).

        Raises:
            RecordingError: If the file is gone.
        """
        with _open_mcap(self.path) as file:
            reader = _Reader(self.path, file)
            for _ in reader:
                pass
            return reader.trajectories


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
                elif isinstance(record, Metadata) and record.name == _CONFIG:
                    self.metadata = record.metadata
                elif isinstance(record, Attachment):
                    self.trajectories[crc32(record.data)] = record.data
        except _DAMAGE:
            self.is_truncated = True

    def layout(self) -> SampleLayout:
        """Return the samples' layout, known once the metadata has passed."""
        try:
            joints = int(self.metadata["joints"])
            if joints > _MOST_JOINTS:
                raise ValueError(f"{joints} joints")
            return SampleLayout(joints, json.loads(self.metadata["with_truth"]) is True)
        except (KeyError, ValueError) as error:
            raise RecordingError(
                f"{self.path} is MCAP but not a recording of this program (no {_CONFIG} metadata)"
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
