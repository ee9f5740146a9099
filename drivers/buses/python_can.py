"""Every other adapter: python-can's interfaces, and the conversion to and from its messages."""

import errno
import struct
from contextlib import suppress
from time import monotonic
from typing import Any, NoReturn

import can

from drivers.bus import Bus
from drivers.errors import BusAddressError, BusError
from drivers.frame import EFF_FLAG, EFF_MASK, ERR_FLAG, RTR_FLAG, SFF_MASK

_LAYOUT = struct.Struct("=IB3x8s")
_FAILURES = (can.CanError, OSError, ValueError, TypeError, ImportError, NotImplementedError)
_FULL = frozenset({errno.ENOBUFS, errno.EAGAIN})


def to_message(
    frame: bytes, *, timestamp_s: float = 0.0, channel: str | None = None
) -> can.Message:
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


class PythonCanBus(Bus):
    """A bus reached through `can.Bus`.

    Args:
        address: `INTERFACE:CHANNEL[@BITRATE]`, for example `pcan:PCAN_USBBUS1@1000000`. What the
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
    channel, at, bitrate = rest.rpartition("@")
    if not at or not bitrate.isdecimal():
        channel, bitrate = rest, ""
    if not interface or not channel:
        raise BusAddressError(
            f"bus address 'python-can:{address}' is not python-can:INTERFACE:CHANNEL[@BITRATE]"
        )
    return interface, channel, {"bitrate": int(bitrate)} if bitrate else {}


def _is_full(error: Exception) -> bool:
    if isinstance(error, TimeoutError) or getattr(error, "error_code", None) in _FULL:
        return True
    text = str(error).lower()
    return "full" in text or "overflow" in text


def _in_one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
