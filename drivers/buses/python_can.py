"""Every other adapter: python-can's interfaces, and the conversion to and from its messages."""

import errno
import struct
from contextlib import suppress
from time import monotonic
from typing import Any, NoReturn

import can

from drivers.bus import Bus
from drivers.errors import BusAddressError, BusError
from drivers.frame import (
    EFF_FLAG,
    EFF_MASK,
    ERR_FLAG,
    FD_BRS,
    FD_ESI,
    FD_FLAGS_INDEX,
    FD_LENGTHS,
    RTR_FLAG,
    SFF_MASK,
    is_fd,
    pack_fd_frame,
    unpack_frame,
)

_LAYOUT = struct.Struct("=IB3x8s")
_FAILURES = (can.CanError, OSError, ValueError, TypeError, ImportError, NotImplementedError)
_FULL = frozenset({errno.ENOBUFS, errno.EAGAIN})


def to_message(
    frame: bytes, *, timestamp_s: float = 0.0, channel: str | None = None
) -> can.Message:
    """Convert a record into a python-can message.

    Args:
        frame: The record; a length byte above 8, or above 64 of CAN FD, is read as that.
        timestamp_s: Seconds since the epoch, as python-can has it.
        channel: Name of the bus, for python-can's printers and loggers.
    """
    if is_fd(frame):
        return _to_fd_message(frame, timestamp_s, channel)
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


def _to_fd_message(frame: bytes, timestamp_s: float, channel: str | None) -> can.Message:
    can_id, data = unpack_frame(frame)
    flags = frame[FD_FLAGS_INDEX]
    return can.Message(
        timestamp=timestamp_s,
        arbitration_id=can_id & (EFF_MASK if can_id & EFF_FLAG else SFF_MASK),
        is_extended_id=bool(can_id & EFF_FLAG),
        channel=channel,
        dlc=len(data),
        data=data,
        is_fd=True,
        bitrate_switch=bool(flags & FD_BRS),
        error_state_indicator=bool(flags & FD_ESI),
    )


def from_message(message: can.Message) -> bytes | None:
    """Convert a python-can message into a record, of 72 bytes if it is CAN FD.

    Returns:
        None if it is no frame: too many bytes, a length that does not exist, identifier out of
        range.
    """
    if message.is_fd:
        return _from_fd_message(message)
    is_wide = message.is_extended_id or message.is_error_frame
    can_id = message.arbitration_id
    if not 0 <= message.dlc <= 8 or len(message.data) > 8:
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


def _from_fd_message(message: can.Message) -> bytes | None:
    can_id = message.arbitration_id
    if message.is_remote_frame or message.is_error_frame or len(message.data) not in FD_LENGTHS:
        return None
    if not 0 <= can_id <= (EFF_MASK if message.is_extended_id else SFF_MASK):
        return None
    if message.is_extended_id:
        can_id |= EFF_FLAG
    flags = FD_BRS if message.bitrate_switch else 0
    if message.error_state_indicator:
        flags |= FD_ESI
    return pack_fd_frame(can_id, bytes(message.data), flags=flags)


class PythonCanBus(Bus):
    """A bus reached through `can.Bus`.

    Args:
        address: `INTERFACE:CHANNEL[@BITRATE[/DATA_BITRATE]]`, for example
            `kvaser:0@1000000/5000000`; a data bit rate opens the adapter for CAN FD. What the
            address does not name, python-can takes from its own configuration (`~/.canrc`,
            `CAN_BITRATE`), or the adapter's default.

    Raises:
        BusAddressError: If there is no interface or no channel in the address.
        BusError: If python-can does not know the interface, or cannot open the channel.
    """

    def __init__(self, address: str) -> None:
        super().__init__()
        self.address = address
        interface, channel, options = _split(address)
        try:
            self._bus = can.Bus(interface=interface, channel=channel, **options)
        except _FAILURES as error:
            raise BusError(f"no bus python-can:{address}: {_in_one_line(error)}") from error
        self._is_open = True

    def send(self, frame: bytes) -> bool:
        """Queue one frame for transmission; see `Bus.send`.

        python-can has no common way to say that a queue is full: time-outs, the error codes of
        a full queue, and messages that speak of one count as such.
        """
        self._check_open()
        try:
            self._bus.send(to_message(frame), timeout=0.0)
        except _FAILURES as error:
            if not _is_full(error):
                self._raise_gone(error)
            self.stats.send_failures += 1
            return False
        self.stats.frames_sent += 1
        return True

    def recv(self, timeout_s: float) -> bytes | None:
        """Return the next frame or error report; see `Bus.recv`."""
        self._check_open()
        deadline_s = monotonic() + timeout_s
        while True:
            message = self._recv_message(max(0.0, timeout_s))
            if message is None:
                return None
            frame = from_message(message)
            if frame is not None:
                break
            self.stats.malformed_records += 1
            timeout_s = deadline_s - monotonic()
        self.stats.frames_received += 1
        if message.is_error_frame:
            self._count_error_report()
        return frame

    def _recv_message(self, timeout_s: float) -> can.Message | None:
        try:
            return self._bus.recv(timeout_s)
        except _FAILURES as error:
            self._raise_gone(error)

    def _check_open(self) -> None:
        if not self._is_open:
            raise BusError(f"the bus python-can:{self.address} is closed")

    def _raise_gone(self, error: Exception) -> NoReturn:
        cause = _in_one_line(error)
        raise BusError(f"the bus python-can:{self.address} is gone: {cause}") from error

    def fileno(self) -> int:
        """Descriptor of the adapter, or -1: many have none."""
        if not self._is_open:
            return -1
        try:
            return int(self._bus.fileno())
        except _FAILURES:
            return -1

    def close(self) -> None:
        """Shut the adapter down."""
        if self._is_open:
            self._is_open = False
            with suppress(*_FAILURES):  # nothing to be done about an adapter that will not go
                self._bus.shutdown()


def _split(address: str) -> tuple[str, str, dict[str, Any]]:
    interface, _, rest = address.partition(":")
    channel, at, rates = rest.rpartition("@")
    bitrate, slash, data_bitrate = rates.partition("/")
    if not at or not bitrate.isdecimal() or (slash and not data_bitrate.isdecimal()):
        channel, bitrate, data_bitrate = rest, "", ""
    if not interface or not channel:
        raise BusAddressError(
            f"bus address 'python-can:{address}' is not "
            "python-can:INTERFACE:CHANNEL[@BITRATE[/DATA_BITRATE]]"
        )
    options: dict[str, Any] = {"bitrate": int(bitrate)} if bitrate else {}
    if data_bitrate:
        options |= {"data_bitrate": int(data_bitrate), "fd": True}
    return interface, channel, options


def _is_full(error: Exception) -> bool:
    if isinstance(error, TimeoutError) or getattr(error, "error_code", None) in _FULL:
        return True
    text = str(error).lower()
    return "full" in text or "overflow" in text


def _in_one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
