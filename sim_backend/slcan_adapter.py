"""What a LAWICEL adapter does with the commands of its host. Pure: no port, no wire.

Source: LAWICEL AB, CANUSB Manual, section "CANUSB ASCII commands".
"""

import re

from drivers.buses.slcan_codec import BIT_RATES_Hz, StatusFlags, decode_frame
from drivers.frame import EFF_FLAG, unpack_header

VERSION = b"V1013\r"
SERIAL = b"NHIL1\r"
OK, REFUSED = b"\r", b"\a"

_BIT_RATES = frozenset(BIT_RATES_Hz.values())
_BIT_TIMING = re.compile(rb"s[0-9A-Fa-f]{4}")  # BTR0, BTR1
_BUS_OFF, _CONTROLLER, _ON_THE_WIRE = 0x40, 0x04, 0x88  # linux/can/error.h
_OVERFLOW, _WARNING, _PASSIVE = 0x03, 0x0C, 0x30  # data[1] of a controller's report


class SlcanAdapter:
    """The adapter's channel: closed, open, or listening.

    Frames from the wire go to the host by themselves (LAWICEL's auto poll). Polling (`X0`, `P`,
    `A`) and acceptance filters (`M`, `m`) are refused. `s` is taken, and changes nothing: this
    wire has one bit rate.

    Args:
        has_acks: Answer every frame taken with `z` or `Z`. Many adapters do not.

    Attributes:
        is_open: Frames from the wire go to the host.
        has_timestamps: They carry the adapter's time (`Z1`).
        flags: What `F` will answer; reading clears them.
        refusals: Commands answered with BEL.
    """

    def __init__(self, *, has_acks: bool = False) -> None:
        self.flags = StatusFlags(0)
        self.refusals = 0
        self._has_acks = has_acks
        self.hang_up()

    def hang_up(self) -> None:
        """The host has left its port: the channel closes, and its settings are forgotten."""
        self.is_open = False
        self.has_timestamps = False
        self._has_bit_rate = False
        self._is_listening = False

    def take(self, line: bytes) -> tuple[bytes, bytes | None]:
        """Carry out one command, given without its CR.

        Returns:
            The answer to write, and the 16-byte record to put on the wire if it is a frame.
        """
        frame = decode_frame(line)
        if frame is None:
            answer = self._execute(line)
        elif self.is_open and not self._is_listening:
            return self._acknowledge(frame), frame
        else:
            answer = None
        if answer is None:
            self.refusals += 1
            answer = REFUSED
        return answer, None

    def _acknowledge(self, frame: bytes) -> bytes:
        if not self._has_acks:
            return b""
        return b"Z\r" if unpack_header(frame)[0] & EFF_FLAG else b"z\r"

    def _execute(self, line: bytes) -> bytes | None:
        """Return the answer to a command that is no frame, None to refuse it."""
        if line == b"V":
            return VERSION
        if line == b"N":
            return SERIAL
        if self.is_open:
            return self._execute_open(line)
        return OK if not line or self._configure(line) else None

    def _execute_open(self, line: bytes) -> bytes | None:
        if line == b"C":
            self.is_open = False
        elif line == b"F":
            flags, self.flags = self.flags, StatusFlags(0)
            return b"F%02X\r" % flags
        elif line:
            return None
        return OK

    def _configure(self, line: bytes) -> bool:
        """Carry out a command for the closed channel; False if it is none, or cannot be."""
        if line in _BIT_RATES or _BIT_TIMING.fullmatch(line):
            self._has_bit_rate = True
        elif line in (b"O", b"L") and self._has_bit_rate:
            self.is_open, self._is_listening = True, line == b"L"
        elif line in (b"Z0", b"Z1"):
            self.has_timestamps = line == b"Z1"
        else:
            return line == b"X1"  # as it is anyway
        return True

    def note_report(self, frame: bytes) -> None:
        """Keep what an error report of the wire says for the next `F`."""
        can_id, control = unpack_header(frame)[0], frame[9]
        if not can_id & _CONTROLLER:
            control = 0
        if can_id & _BUS_OFF or control & _PASSIVE:
            self.flags |= StatusFlags.ERROR_PASSIVE
        if control & _WARNING:
            self.flags |= StatusFlags.ERROR_WARNING
        if control & _OVERFLOW:
            self.flags |= StatusFlags.DATA_OVERRUN
        if can_id & _ON_THE_WIRE:
            self.flags |= StatusFlags.BUS_ERROR
