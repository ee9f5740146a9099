"""Fixed-size Protobuf: samples and bus frames written and read as plain structs.

`hil/proto/telemetry.proto` gives every field a fixed wire size, so that for a given number of
joints all samples have the same bytes except for their values. What is written here is ordinary
Protobuf that any reader understands, and what any other Protobuf writer sends is understood
here; only the cost differs: one struct call per sample, one array view per batch.
"""

import struct
from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from google.protobuf.message import DecodeError

from drivers.frame import FD_FRAME_SIZE, FRAME_SIZE
from hil.errors import HilError
from hil.fixed_protobuf import FixedMessages, Records, delimited, fields_of, run_field, scalar_field
from hil.proto import telemetry_pb2

Buffer = bytearray | memoryview
SampleWriter = Callable[[Buffer, int, Sequence[float], Sequence[Sequence[float]]], None]
"""`write(buffer, offset, scalars, joint_lists)`; see `SampleLayout.writer`."""
FrameEntry = Callable[[int, int, bytes], bytes]
"""`entry(t_ns, direction, frame)`; see `BusFrameLayout.entry`."""

RECEIVED: Final = 0
SENT: Final = 1
_FIELDS: Final = fields_of(telemetry_pb2.Sample)
_FIRST_TRUTH_FIELD: Final = 40  # fields from here on exist in simulation only
_FIRST_MONITOR_FIELD: Final = 32  # of the per-joint ones
_TRUTH_NAMES: Final = frozenset(f.name for f in _FIELDS if f.number >= _FIRST_TRUTH_FIELD)
_OPTIONAL_NAMES: Final = frozenset(f.name for f in _FIELDS if f.number >= _FIRST_MONITOR_FIELD)


class TelemetryError(HilError):
    """Received telemetry is not what its layout says."""


class LoggedFrame(NamedTuple):
    """One frame the loop saw: when, `RECEIVED` or `SENT`, and its record (`drivers.frame`)."""

    t_ns: int
    direction: int
    frame: bytes


class SampleLayout:
    """Where each value of a `hil.v1.Sample` stands, for one number of joints.

    Args:
        joints: Entries of every per-joint list, at least 1.
        with_truth: The plant's truth is part of the sample (simulation).

    Attributes:
        size: Bytes of one serialised sample.
        dtype: Structured dtype whose columns are the fields, at their places in the bytes.
        scalar_names: Fields with one value, in the order the writer takes them.
        list_names: Per-joint fields, in the order the writer takes them.

    Raises:
        ValueError: If `joints` is below 1.
    """

    def __init__(self, joints: int, with_truth: bool) -> None:
        if joints < 1:
            raise ValueError(f"an arm has at least one joint, not {joints}")
        fields = [
            run_field(f, "d", joints, 8) if f.is_repeated else scalar_field(f)
            for f in _FIELDS
            if with_truth or f.name not in _TRUTH_NAMES
        ]
        self.joints: Final = joints
        self.with_truth: Final = with_truth
        self._messages = FixedMessages(fields)
        self.size: Final = self._messages.size
        self.dtype: Final = self._messages.dtype
        self.scalar_names: Final = tuple(f.name for f in fields if f.count is None)
        self.list_names: Final = tuple(f.name for f in fields if f.count is not None)

    @classmethod
    def of(cls, payload: bytes) -> "SampleLayout":
        """Find the layout of a serialised sample or batch from its first sample.

        Raises:
            TelemetryError: If the bytes are not Protobuf, or hold no sample with joints.
        """
        batch = _parse_batch(payload)
        sample = batch.samples[0] if batch.samples else telemetry_pb2.Sample()
        if not sample.q_meas_rad:
            raise TelemetryError(
                f"no sample with joint values in {len(payload)} bytes of telemetry"
            )
        return cls(len(sample.q_meas_rad), with_truth=bool(sample.q_true_rad))

    def writer(self) -> SampleWriter:
        """Return a function that writes one valid sample into a buffer, for one thread.

        It takes (buffer, offset, scalars, joint_lists): the scalars in the order of
        `scalar_names`, then one list per name in `list_names`. Integers beyond their field's
        range are written as the nearest they can be: telemetry never stops a cycle.

        The function raises ValueError if a list is missing or of another length; the buffer is
        then untouched.
        """
        pack, values = self._messages.struct.pack_into, self._template()
        runs = slice(1, 2 * len(self.scalar_names), 2)
        first, step = 2 * len(self.scalar_names) + 1, self.joints + 1
        columns = tuple(slice(first + joint, None, step) for joint in range(self.joints))

        def write(
            buffer: Buffer, offset: int, scalars: Sequence[float], lists: Sequence[Sequence[float]]
        ) -> None:
            values[runs] = scalars
            for column, entries in zip(columns, zip(*lists, strict=True), strict=True):
                values[column] = entries
            try:
                pack(buffer, offset, *values)
            except struct.error:
                values[runs] = self._saturated(scalars)
                pack(buffer, offset, *values)

        return write

    def _template(self) -> list[Any]:
        values: list[Any] = []
        for field in self._messages.fields:
            values += [field.constant, *(0,) * (field.count or 1)]
        return values

    def _saturated(self, scalars: Sequence[float]) -> list[float]:
        fields = (f for f in self._messages.fields if f.count is None)
        return [f.saturate(value) for f, value in zip(fields, scalars, strict=True)]

    def batch(self, samples: Sequence[bytes | memoryview]) -> bytes:
        """Concatenate serialised samples into a serialised `hil.v1.SampleBatch`.

        Raises:
            ValueError: If a sample is not of this layout's size.
        """
        return self._messages.join(samples)

    def decode_batch(self, payload: bytes) -> Records:
        """Read a serialised `hil.v1.SampleBatch`, whoever wrote it.

        Args:
            payload: From the network or a file; batches of one layout are viewed, all others
                are parsed.

        Returns:
            One row per sample, columns as in `dtype`. Truth, and per-joint monitors, that the
            layout has and the sample has not are NaN.

        Raises:
            TelemetryError: If the bytes are not a batch, or have another number of joints.
        """
        rows = self._messages.split(payload)
        return self._parse_rows(payload) if rows is None else rows

    def decode(self, samples: Sequence[bytes]) -> Records:
        """Read serialised samples, whoever wrote them; otherwise as `decode_batch`.

        Raises:
            TelemetryError: If one is not a sample, or has another number of joints.
        """
        sizes = set(map(len, samples))
        if sizes <= {self.size}:
            return self.decode_batch(self.batch(samples))
        return self.decode_batch(b"".join(delimited(sample) for sample in samples))

    def _parse_rows(self, payload: bytes) -> Records:
        batch = _parse_batch(payload)
        rows = np.zeros(len(batch.samples), dtype=self.dtype)
        for name in self.scalar_names:
            rows[name] = [getattr(sample, name) for sample in batch.samples]
        for name in self.list_names:
            rows[name] = [self._entries(sample, name) for sample in batch.samples] or rows[name]
        return rows

    def _entries(self, sample: telemetry_pb2.Sample, name: str) -> Sequence[float]:
        entries: Sequence[float] = getattr(sample, name)
        if len(entries) == self.joints:
            return entries
        if not entries and name in _OPTIONAL_NAMES:
            return [np.nan] * self.joints
        raise TelemetryError(
            f"sample {sample.seq}: {name} has {len(entries)} values, expected {self.joints}"
        )


def _parse_batch(payload: bytes) -> telemetry_pb2.SampleBatch:
    batch = telemetry_pb2.SampleBatch()
    try:
        batch.ParseFromString(payload)
    except DecodeError as error:
        raise TelemetryError(f"{len(payload)} bytes are not a batch of samples: {error}") from error
    return batch


class BusFrameLayout:
    """Where each value of a `hil.v1.BusFrame` stands, for either size of frame record.

    Attributes:
        size: Bytes of the entry of a classic frame in a log.
        fd_size: Bytes of the entry of a CAN FD frame.
        entry: Serialises one frame as an entry of a `hil.v1.BusLog`: joined entries are a log. It
            takes (t_ns, direction, frame), the frame being exactly one record.
    """

    def __init__(self) -> None:
        self._classic, self._fd = _frame_messages(FRAME_SIZE), _frame_messages(FD_FRAME_SIZE)
        self.size: Final = len(self._classic.prefix) + self._classic.size
        self.fd_size: Final = len(self._fd.prefix) + self._fd.size
        self.entry: Final[FrameEntry] = self._entry()
        before_time = len(self._classic.prefix) + len(self._classic.fields[0].constant)
        self._first_time = struct.Struct(f"<{before_time}xq").unpack_from

    def _entry(self) -> FrameEntry:
        pack, head, way, data = _frame_packer(self._classic)
        pack_fd, head_fd, way_fd, data_fd = _frame_packer(self._fd)

        def entry(t_ns: int, direction: int, frame: bytes) -> bytes:
            if len(frame) == FRAME_SIZE:
                return pack(head, t_ns, way, direction, data, frame)
            return pack_fd(head_fd, t_ns, way_fd, direction, data_fd, frame)

        return entry

    def first_t_ns(self, log: bytes) -> int:
        """Return the instant of the first frame of a log that `entry` wrote; it is not empty."""
        t_ns: int = self._first_time(log)[0]
        return t_ns

    def decode_log(self, payload: bytes) -> list[LoggedFrame]:
        """Read a serialised `hil.v1.BusLog`, whoever wrote it, in the order of the log.

        Raises:
            TelemetryError: If the bytes are not a bus log.
        """
        for messages in (self._classic, self._fd):
            rows = messages.split(payload)
            if rows is not None:
                return [LoggedFrame(t_ns, way, bytes(frame)) for t_ns, way, frame in rows.tolist()]
        log = telemetry_pb2.BusLog()
        try:
            log.ParseFromString(payload)
        except DecodeError as error:
            raise TelemetryError(f"{len(payload)} bytes are not a bus log: {error}") from error
        return [LoggedFrame(f.t_ns, f.direction, f.frame) for f in log.frames]


def _frame_messages(frame_size: int) -> FixedMessages:
    t_ns, direction, frame = fields_of(telemetry_pb2.BusFrame)
    return FixedMessages(
        (scalar_field(t_ns), scalar_field(direction), run_field(frame, "s", frame_size, 1))
    )


def _frame_packer(messages: FixedMessages) -> tuple[Callable[..., bytes], bytes, bytes, bytes]:
    """Return what packs (head, t_ns, way, direction, data, frame), and its three constants."""
    at, way, data = (field.constant for field in messages.fields)
    head = messages.prefix + at
    frame_size = messages.fields[2].count
    layout = struct.Struct(f"<{len(head)}sq{len(way)}sI{len(data)}s{frame_size}s")
    return layout.pack, head, way, data
