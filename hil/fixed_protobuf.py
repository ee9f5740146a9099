"""Protobuf messages whose fields all have a fixed wire size, written and read as plain structs.

Of such a message every byte but the values is known beforehand: tags and lengths are constants
of one `struct.Struct`, and a run of messages is one numpy view. Source: Protocol Buffers
encoding, "Message Structure" (tag = field number << 3 | wire type) and "Packed repeated fields".
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import Message
from numpy.typing import NDArray

Records = NDArray[np.void]
"""A structured array: one row per message, one named column per field."""

_WIRE: Final = {  # Protobuf type -> (struct code, wire type)
    FieldDescriptor.TYPE_FIXED64: ("Q", 1),
    FieldDescriptor.TYPE_SFIXED64: ("q", 1),
    FieldDescriptor.TYPE_DOUBLE: ("d", 1),
    FieldDescriptor.TYPE_FIXED32: ("I", 5),
    FieldDescriptor.TYPE_SFIXED32: ("i", 5),
}
_LENGTH_DELIMITED: Final = 2
_NUMPY: Final = {"Q": "<u8", "q": "<i8", "d": "<f8", "I": "<u4", "i": "<i4"}


@dataclass(frozen=True, slots=True)
class FixedField:
    """One field: the bytes that never change, then its values.

    Attributes:
        name: As in the `.proto`.
        constant: Tag, followed by the length where the wire has one.
        code: `struct` code of one value.
        count: Values in the run, or None for a plain scalar.
    """

    name: str
    constant: bytes
    code: str
    count: int | None

    @property
    def struct_format(self) -> str:
        """`struct` format of constant and values."""
        values = f"{self.count}{self.code}" if self.count is not None else self.code
        return f"{len(self.constant)}s{values}"

    @property
    def value_format(self) -> Any:  # noqa: ANN401 - numpy's own dtype specifications are untyped
        """Numpy format of the values alone."""
        if self.code == "s":
            return f"V{self.count}"
        return _NUMPY[self.code] if self.count is None else (_NUMPY[self.code], (self.count,))

    def saturate(self, value: float) -> float:
        """Return the nearest value the field can hold; floating-point fields hold all."""
        if self.code == "d":
            return value
        limits = np.iinfo(_NUMPY[self.code])
        return min(max(value, int(limits.min)), int(limits.max))


def _varint(value: int) -> bytes:
    encoded = bytearray()
    while value > 0x7F:
        encoded.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes((*encoded, value))


def delimited(message: bytes) -> bytes:
    """Prefix a serialised message so that it is field 1 of an enclosing message."""
    return b"\x0a" + _varint(len(message)) + message


def fields_of(message: type[Message]) -> list[FieldDescriptor]:
    """Return a message's fields by rising number."""
    fields: Any = message.DESCRIPTOR.fields  # typed differently by every release of the stubs
    return sorted(fields, key=lambda field: int(field.number))


def scalar_field(field: FieldDescriptor) -> FixedField:
    """Describe a fixed32, fixed64, sfixed or double field that is always written, zero included."""
    code, wire_type = _WIRE[field.type]
    return FixedField(field.name, _varint(field.number << 3 | wire_type), code, None)


def run_field(field: FieldDescriptor, code: str, count: int, size: int) -> FixedField:
    """Describe a run of `count` values of `size` bytes: packed repeated, or (code `s`) bytes."""
    constant = _varint(field.number << 3 | _LENGTH_DELIMITED) + _varint(count * size)
    return FixedField(field.name, constant, code, count)


class FixedMessages:
    """Messages of one type that have the same bytes except for their values.

    Args:
        fields: In the order in which they are written; field numbers should rise.

    Attributes:
        struct: Packs constant, value(s), constant, value(s) ... of one message.
        size: Bytes of one message.
        prefix: Tag and length before each message where it is field 1 of an enclosing message.
        dtype: Columns are the fields, at their places in the message's bytes.
    """

    def __init__(self, fields: Sequence[FixedField]) -> None:
        self.fields: Final = tuple(fields)
        self.struct: Final = struct.Struct("<" + "".join(f.struct_format for f in fields))
        self.size: Final = self.struct.size
        self.prefix: Final = delimited(bytes(self.size))[: -self.size]
        self.dtype: Final = self._value_dtype()
        framed = np.ones(self.size, dtype=np.bool_)
        for offset, length in self._value_spans():
            framed[offset : offset + length] = False
        constants = np.flatnonzero(framed)
        self._positions = np.concatenate(
            (np.arange(len(self.prefix)), constants + len(self.prefix))
        )
        self._expected = np.frombuffer(
            self.prefix + b"".join(f.constant for f in fields), dtype=np.uint8
        )

    def _value_spans(self) -> list[tuple[int, int]]:
        spans, offset = [], 0
        for field in self.fields:
            offset += len(field.constant)
            length = struct.calcsize("<" + field.struct_format) - len(field.constant)
            spans.append((offset, length))
            offset += length
        return spans

    def _value_dtype(self) -> np.dtype[np.void]:
        return np.dtype(
            {
                "names": [f.name for f in self.fields],
                "formats": [f.value_format for f in self.fields],
                "offsets": [offset for offset, _ in self._value_spans()],
                "itemsize": self.size,
            }
        )

    def join(self, messages: Sequence[bytes | memoryview]) -> bytes:
        """Concatenate messages of this layout into the serialised enclosing message.

        Raises:
            ValueError: If the sizes do not add up to messages of this layout.
        """
        joined = self.prefix.join((b"", *messages))
        if len(joined) != len(messages) * (self.size + len(self.prefix)):
            raise ValueError(f"every message of this layout has {self.size} bytes")
        return joined

    def split(self, joined: bytes) -> Records | None:
        """View what `join` wrote as one row per message; None if it is laid out otherwise."""
        stride = self.size + len(self.prefix)
        if len(joined) % stride:
            return None
        rows = np.frombuffer(joined, dtype=np.uint8).reshape(-1, stride)
        if not np.array_equal(
            rows[:, self._positions],
            np.broadcast_to(self._expected, (len(rows), len(self._expected))),
        ):
            return None
        return np.ascontiguousarray(rows[:, len(self.prefix) :]).view(self.dtype).reshape(-1)
