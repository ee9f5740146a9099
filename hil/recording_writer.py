"""Writing recordings: one MCAP file per run or part of a run, Protobuf inside.

Channels `telemetry` (`hil.v1.Sample`, one message per sample), `bus` (`hil.v1.BusLog`, one
message per drained batch) and `event` (`hil.v1.Event`); the references that were played are
attachments, and the running configuration is the metadata record `config`. The file holds nothing
but what was recorded (no wall-clock time, no host, no version), so that the same run written twice
gives the same bytes.

A long run is recorded in parts: `run.mcap`, `run-2.mcap` and so on. Each has configuration and
schemas of its own, and says which part of which run it is (`Part`).
"""

import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

from google.protobuf.descriptor_pb2 import FileDescriptorSet

from hil.errors import HilError
from hil.mcap_writer import McapWriter
from hil.proto import telemetry_pb2

FLUSH_PERIOD_NS: Final = 100_000_000
"""Recorded time after which a chunk is closed and handed to the kernel: what a kill can cost."""
CONFIG_NAME: Final = "config"
_ROWS_NAME: Final = "trajectory-{:08x}.f64"
_ROWS_TYPE: Final = "application/octet-stream"


class RecordingError(HilError):
    """A recording could not be written, or a file is not a recording."""


@dataclass(frozen=True, slots=True)
class Part:
    """Which part of which run a file is.

    Attributes:
        series: The same text in all parts of one run, and in no other run's.
        number: From 1; part 1 has the name that was asked for.
    """

    series: str
    number: int

    def path(self, first: Path) -> Path:
        """Return the name of this part of the run whose first part is `first`."""
        return first if self.number == 1 else first.with_stem(f"{first.stem}-{self.number}")

    def first(self, path: Path) -> Path:
        """Return the name of part 1, this one's being `path`."""
        return path.with_stem(path.stem.removesuffix(f"-{self.number}"))


class RecordingWriter:
    """Writes one recording. Not for the loop's process: a write can wait for the disk.

    Args:
        path: File to create; an existing one is replaced.
        config: The running configuration as JSON text, or as what `json.dumps` takes.
        joints: Of the arm.
        with_truth: Samples carry the plant's truth.
        part: Of which run this is a part, if the run may need several.

    Attributes:
        path: The file.
        is_empty: No message has been added.

    Raises:
        RecordingError: If the file cannot be created.
    """

    def __init__(
        self,
        path: Path,
        config: Mapping[str, Any] | str,
        joints: int,
        with_truth: bool,
        part: Part | None = None,
    ) -> None:
        text = config if isinstance(config, str) else json.dumps(config, sort_keys=True)
        self.path: Final = path
        self.is_empty = True
        self._due_ns = 0
        self._is_closed = False
        try:
            self._file = path.open("wb")
        except OSError as error:
            raise RecordingError(f"cannot create recording {path}: {error.strerror}") from error
        self._writer = McapWriter(self._file)
        self._writer.start(library="hil")
        layout = {"json": text, "joints": str(joints), "with_truth": json.dumps(with_truth)}
        if part is not None:
            layout |= {"series": part.series, "part": str(part.number)}
        self._writer.add_metadata(CONFIG_NAME, layout)
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
        return self._writer.register_channel(topic, "protobuf", schema)

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
            self._writer.add_attachment(t_ns, _ROWS_NAME.format(crc), _ROWS_TYPE, rows)
        except OSError as error:
            raise self._write_error(error) from error

    def _add(self, channel: int, t_ns: int, payload: bytes, seq: int) -> None:
        self.is_empty = False
        try:
            self._writer.add_message(channel, t_ns, payload, seq & 0xFFFF_FFFF)
            if t_ns >= self._due_ns:
                self._due_ns = t_ns + FLUSH_PERIOD_NS
                self._writer.flush()
        except OSError as error:
            raise self._write_error(error) from error

    def _write_error(self, error: OSError) -> RecordingError:
        return RecordingError(f"cannot write recording {self.path}: {error.strerror}")

    @property
    def size_bytes(self) -> int:
        """Bytes of the file so far, without what has not been flushed."""
        return self._file.tell()

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
