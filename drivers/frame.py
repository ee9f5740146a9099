"""CAN frames as the kernel lays them out: 16-byte `struct can_frame` records.

The hot path never builds a frame object: a frame *is* its 16 bytes, on every bus. Layout
(linux/can.h): u32 identifier with flags, u8 length, 3 bytes padding, 8 bytes data.
"""

import struct
import sys

FRAME_SIZE = 16
EFF_FLAG = 0x8000_0000  # 29-bit identifier
RTR_FLAG = 0x4000_0000  # remote request
ERR_FLAG = 0x2000_0000  # error report of the controller, not a frame from the wire
SFF_MASK = 0x0000_07FF
EFF_MASK = 0x1FFF_FFFF
LOCKSTEP_ID = EFF_FLAG | 0x1FFF_FFF0
"""Identifier of the empty frame that ends a master's requests to emulated amplifiers in lockstep
when no axis uses CANopen's SYNC: it advances emulated time. Never sent to real amplifiers."""
FLAGS_INDEX = 3 if sys.byteorder == "little" else 0
"""Index of the record's byte that holds the flags: records are in the host's byte order."""
ERR_BIT = ERR_FLAG >> 24
"""`frame[FLAGS_INDEX] & ERR_BIT`: is it an error report, at the cost of one index."""

_LAYOUT = struct.Struct("=IB3x8s")
unpack_header = struct.Struct("=IB").unpack_from
"""`unpack_header(frame)` -> (identifier with flags, data length)."""


def pack_frame(can_id: int, data: bytes = b"") -> bytes:
    """Build the 16-byte record of a classic data frame.

    Args:
        can_id: Identifier; add `EFF_FLAG` for 29 bits, `RTR_FLAG` for a remote request.
        data: 0 to 8 bytes.

    Raises:
        ValueError: If `data` is longer than 8 bytes.
    """
    if len(data) > 8:
        raise ValueError(f"a classic CAN frame carries at most 8 bytes, not {len(data)}")
    return _LAYOUT.pack(can_id, len(data), data)


def unpack_frame(frame: bytes) -> tuple[int, bytes]:
    """Split a 16-byte record into (identifier with flags, data).

    A length byte above 8 (seen from broken adapters) is read as 8, as CAN itself defines.
    """
    can_id, length, data = _LAYOUT.unpack(frame)
    return can_id, data[:length]


def worst_case_bits(length: int, *, is_extended: bool = False) -> int:
    """Return the bits a classic data frame can occupy on the wire, worst-case stuffing included.

    The 3-bit interframe space is included too. Source: CAN 2.0, one stuff bit after four bits of
    the stuffed part of the frame; at 1 Mbit/s one bit is one microsecond.

    Args:
        length: Data bytes, 0 to 8.
        is_extended: 29-bit identifier.
    """
    fixed, stuffable = (67, 53) if is_extended else (47, 33)
    return 8 * length + fixed + (stuffable + 8 * length) // 4
