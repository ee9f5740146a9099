"""Every other adapter: python-can's interfaces, and the conversion to and from its messages."""

import errno
import struct
from typing import NoReturn

import can

from drivers.bus import Bus
from drivers.errors import BusAddressError, BusError
from drivers.frame import EFF_FLAG, EFF_MASK, ERR_FLAG, FRAME_SIZE, RTR_FLAG, SFF_MASK

_LAYOUT = struct.Struct("=IB3x8s")
_FAILURES = (can.CanError, OSError, ValueError, TypeError, ImportError, NotImplementedError)
_FULL = frozenset({errno.ENOBUFS, errno.EAGAIN})
_SKIPPED_MAX = 64  # messages that are no classic frame, in one call of `recv`


def to_message(frame: bytes, *, timestamp_s: float = 0.0, channel: str | None = None) -> can.Message:
    """Convert a 16-byte record into a python-can message.

    Args:
        frame: The record; a length byte above 8 is read as 8.
        timestamp_s: Seconds since the epoch, as python-can has it.
        channel: Name of the bus, for python-can's printers and loggers.
    """
    can_id, length, data = _LAYOUT.unpack(frame)
    length = min(length, 8)
    is_wide = bool(can_id & (EFF_FLAG | ERR_FLAG))
    is_remote = bool(can_id & RTR_FLAG)
    return can.Message(
        timestamp=timestamp_s,
        arbitration_id=can_id & (EFF_MASK if is_wide else SFF_MASK),
        is_extended_id=bool(can_id & EFF_FLAG),
        is_remote_frame=is_remote,
        is_error_frame=bool(can_id & ERR_FLAG),
        channel=channel,
        dlc=length,
        data=None if is_remote else data[:length],
    )


def from_message(message: can.Message) -> bytes | None:
    """Convert a python-can message into a 16-byte record.

    Returns:
        None if it is no classic frame: CAN FD, more than 8 bytes, identifier out of range.
    """
    is_wide = message.is_extended_id or message.is_error_frame
    can_id = message.arbitration_id
    if message.is_fd or not 0 <= message.dlc <= 8 or len(message.data) > 8:
        return None
    if not 0 <= can_id <= (EFF_MASK if is_wide else SFF_MASK):
        return None
    if message.is_extended_id:
        can_id |= EFF_FLAG
    if message.is_remote_frame:
        can_id |= RTR_FLAG
    if message.is_error_frame:
        can_id |= ERR_FLAG
    return _LAYOUT.pack(can_id, message.dlc, bytes(message.data))
