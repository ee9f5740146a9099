"""MCAP files, byte for byte as the mcap library's own `Writer` makes them, at less cost.

The library's writer makes a dozen Python calls for every message, and two for every entry of an
index; here a message is one `struct` call, and so is an index. Everything that is written once
per file or chunk is made of the library's records. Source: MCAP format specification, "Message",
"Chunk", "Message Index", "Summary Section".
"""

import struct
from collections.abc import Sequence
from typing import Any, BinaryIO, Final
from zlib import crc32

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC
from zstandard import ZstdCompressor

CHUNK_SIZE: Final = 1 << 20
"""Bytes, uncompressed, beyond which a chunk is closed."""
_MESSAGE: Final = struct.Struct("<BQHIQQ")
_MESSAGE_FIELDS: Final = _MESSAGE.size - 9  # what counts as content besides the payload
_FOOTER: Final = struct.Struct("<BQQQ")
_FOOTER_SIZE: Final = 8 + 8 + 4


def _serialise(record: Any) -> bytes:  # noqa: ANN401 - the library's records
    builder: Any = RecordBuilder()  # untyped in part
    record.write(builder)
    content: bytes = builder.end()
    return content


class McapWriter:
    """Writes one file: chunks of messages compressed with zstd, all indexes, a summary.

    Args:
        file: Opened for writing; it stays open.

    All methods raise OSError if the file cannot be written.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._compress = ZstdCompressor().compress
        self._pack = _MESSAGE.pack
        self._parts: list[bytes] = []
        self._size = 0
        self._indexes: dict[int, list[int]] = {}  # channel -> time, offset, time, offset ...
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._chunks: list[ChunkIndex] = []
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._counts: dict[int, int] = {}
        self._start_ns = self._end_ns = 0

    def start(self, library: str) -> None:
        """Write what a file begins with."""
        self._file.write(MCAP0_MAGIC + _serialise(Header("", library)))

    def register_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Add a schema to the next chunk and return its number."""
        schema = Schema(id=len(self._schemas) + 1, data=data, encoding=encoding, name=name)
        self._schemas.append(schema)
        self._append(_serialise(schema))
        return schema.id

    def register_channel(self, topic: str, encoding: str, schema_id: int) -> int:
        """Add a channel to the next chunk and return its number."""
        channel = Channel(len(self._channels) + 1, topic, encoding, {}, schema_id)
        self._channels.append(channel)
        self._append(_serialise(channel))
        return channel.id

    def _append(self, record: bytes) -> None:
        self._parts.append(record)
        self._size += len(record)

    def add_message(self, channel_id: int, t_ns: int, data: bytes, sequence: int) -> None:
        """Add a message; `t_ns` (0 or above) is when it was logged and published."""
        length = _MESSAGE_FIELDS + len(data)
        offset, parts = self._size, self._parts
        parts.append(self._pack(Opcode.MESSAGE, length, channel_id, sequence, t_ns, t_ns))
        parts.append(data)
        try:
            self._indexes[channel_id] += t_ns, offset
        except KeyError:
            self._indexes[channel_id] = [t_ns, offset]
        self._size = offset + 9 + length
        if self._size > CHUNK_SIZE:
            self._close_chunk()

    def add_attachment(self, t_ns: int, name: str, media_type: str, data: bytes) -> None:
        """Write an attachment at once, before the chunk in progress."""
        record = _serialise(Attachment(t_ns, t_ns, name, media_type, data))
        index = AttachmentIndex(
            self._file.tell(), len(record), t_ns, t_ns, len(data), name, media_type
        )
        self._file.write(record)
        self._attachments.append(index)

    def add_metadata(self, name: str, metadata: dict[str, str]) -> None:
        """Write metadata at once, before the chunk in progress."""
        record = _serialise(Metadata(name=name, metadata=metadata))
        index = MetadataIndex(self._file.tell(), len(record), name)
        self._file.write(record)
        self._metadata.append(index)

    def flush(self) -> None:
        """Close the chunk in progress, unless it has no message, and hand all to the kernel."""
        self._close_chunk()
        self._file.flush()

    def _close_chunk(self) -> None:
        if not self._indexes:
            return
        data = b"".join(self._parts)
        compressed = self._compress(data)
        times = [index[::2] for index in self._indexes.values()]
        first_ns, last_ns = min(map(min, times)), max(map(max, times))
        chunk = _serialise(Chunk("zstd", compressed, last_ns, first_ns, crc32(data), len(data)))
        at = self._file.tell()
        indexes = [_message_index(*item) for item in self._indexes.items()]
        offsets, end = {}, at + len(chunk)
        for channel, index in zip(self._indexes, indexes, strict=True):
            offsets[channel] = end
            end += len(index)
        self._file.write(b"".join((chunk, *indexes)))
        sizes = (len(chunk), at, "zstd", len(compressed))
        index_length = end - at - len(chunk)
        self._chunks.append(ChunkIndex(*sizes, last_ns, index_length, offsets, first_ns, len(data)))
        self._count(first_ns, last_ns)
        self._parts, self._size, self._indexes = [], 0, {}

    def _count(self, first_ns: int, last_ns: int) -> None:
        """Enter a chunk's messages into the statistics."""
        self._start_ns = min(self._start_ns, first_ns) if self._counts else first_ns
        self._end_ns = max(self._end_ns, last_ns)
        for channel, index in self._indexes.items():
            self._counts[channel] = self._counts.get(channel, 0) + len(index) // 2

    def finish(self) -> None:
        """Write the last chunk and the summary; the file is complete then."""
        self._close_chunk()
        self._file.write(_serialise(DataEnd(0)))
        start = self._file.tell()
        summary, offsets = b"", []
        for opcode, records in self._groups():
            group = b"".join(map(_serialise, records))
            offsets.append(_serialise(SummaryOffset(opcode, start + len(summary), len(group))))
            summary += group
        offset_start = start + len(summary)
        summary += b"".join(offsets)
        covered = summary + _FOOTER.pack(Opcode.FOOTER, _FOOTER_SIZE, start, offset_start)
        footer = Footer(start, offset_start, crc32(covered))
        self._file.write(summary + _serialise(footer) + MCAP0_MAGIC)

    def _groups(self) -> tuple[tuple[Opcode, Sequence[Any]], ...]:
        return (
            (Opcode.SCHEMA, self._schemas),
            (Opcode.CHANNEL, self._channels),
            (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.CHUNK_INDEX, self._chunks),
            (Opcode.ATTACHMENT_INDEX, self._attachments),
            (Opcode.METADATA_INDEX, self._metadata),
        )

    def _statistics(self) -> Statistics:
        return Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=self._counts,
            chunk_count=len(self._chunks),
            message_count=sum(self._counts.values()),
            metadata_count=len(self._metadata),
            message_start_time=self._start_ns,
            message_end_time=self._end_ns,
            schema_count=len(self._schemas),
        )


def _message_index(channel: int, entries: list[int]) -> bytes:
    size = 8 * len(entries)
    return struct.pack(
        f"<BQHI{len(entries)}Q", Opcode.MESSAGE_INDEX, 6 + size, channel, size, *entries
    )
