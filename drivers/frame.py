"""CAN frames as the kernel lays them out: records of 16 bytes, CAN FD frames of 72.

The hot path never builds a frame object: a frame *is* its record, on every bus. Layout
(linux/can.h): `struct can_frame`: u32 identifier with flags, u8 length, 3 bytes padding, 8 bytes
data; `struct canfd_frame`: u32 identifier with flags, u8 length, u8 FD flags, 2 bytes padding,
64 bytes data. The record's size alone tells which of the two it is.
"""

import struct
import sys

FRAME_SIZE = 16
FD_FRAME_SIZE = 72
RECORD_SIZES = (FRAME_SIZE, FD_FRAME_SIZE)
"""What a record may measure; anything else is no frame."""
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

FD_BRS = 0x01
"""FD flag: the data goes at the bus's second bit rate."""
FD_ESI = 0x02
"""FD flag: the sender is error passive."""
FD_FDF = 0x04
"""FD flag: this is an FD frame. Newer kernels set it on what they deliver, so we set it always."""
FD_FLAGS_INDEX = 5
"""Index of an FD record's byte that holds the FD flags."""
FD_LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
"""Data bytes that an FD frame can have."""

_LAYOUT = struct.Struct("=IB3x8s")
_FD_LAYOUT = struct.Struct("=IBBxx64s")
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


def pack_fd_frame(can_id: int, data: bytes = b"", *, flags: int = FD_BRS) -> bytes:
    """Build the 72-byte record of a CAN FD frame.

    Args:
        can_id: Identifier; add `EFF_FLAG` for 29 bits. There are no remote requests in CAN FD.
        data: As many bytes as one of `FD_LENGTHS`: protocols have their own padding.
        flags: `FD_BRS`, `FD_ESI`; `FD_FDF` is added.

    Raises:
        ValueError: If no FD frame has this length.
    """
    length = len(data)
    if length not in FD_LENGTHS:
        raise ValueError(f"a CAN FD frame carries 0 to 8, 12, 16 ... 64 bytes, not {length}")
    return _FD_LAYOUT.pack(can_id, length, flags | FD_FDF, data)


def fd_length(length: int) -> int:
    """Return the data bytes of the shortest FD frame with room for `length`.

    Raises:
        ValueError: If `length` is above 64.
    """
    for possible in FD_LENGTHS:
        if possible >= length:
            return possible
    raise ValueError(f"a CAN FD frame carries at most 64 bytes, not {length}")


def is_fd(frame: bytes) -> bool:
    """Tell whether a record is that of a CAN FD frame."""
    return len(frame) == FD_FRAME_SIZE


def unpack_frame(frame: bytes) -> tuple[int, bytes]:
    """Split a record of either size into (identifier with flags, data).

    A length byte beyond the record (seen from broken adapters) is read as 8, or as 64 of an FD
    frame.
    """
    can_id, length = unpack_header(frame)
    return can_id, frame[8 : 8 + length]


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


def worst_case_fd_bits(length: int, *, is_extended: bool = False) -> tuple[int, int]:
    """Return the most bits an FD frame can have at the first and at the second bit rate.

    Dynamic stuffing ends with the data field; the CRC field has stuff bits at fixed places. The
    3-bit interframe space is included. Source: ISO 11898-1:2015, section 10.4.

    Args:
        length: Data bytes: 0 to 8, 12, 16, 20, 24, 32, 48 or 64.
        is_extended: 29-bit identifier.
    """
    head = 36 if is_extended else 17  # start of frame to BRS
    stuffed_head = (head - 1) // 4
    stuffed = (head + 5 + 8 * length - 1) // 4 - stuffed_head
    crc_field = 27 if length <= 16 else 32  # stuff count, CRC-17 or CRC-21, fixed stuff bits
    return head + stuffed_head + 12, 5 + 8 * length + stuffed + crc_field + 1
