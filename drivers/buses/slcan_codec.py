"""The LAWICEL text protocol (slcan): frames, reports and answers as lines, and back. Pure.

A line ends with CR; BEL is the answer to a command that was refused and ends a line, too.
Sources: LAWICEL AB, CANUSB Manual, section "CANUSB ASCII commands" (C, O, L, S, s, t, T, r, R,
F, V, N, Z); Linux `drivers/net/can/slcan/slcan-core.c` for the reports `s` (state of the
controller) and `e` (errors on the wire), which LAWICEL's own adapters do not send.
"""

import struct
from binascii import hexlify, unhexlify
from enum import IntFlag
from functools import lru_cache

from drivers.frame import (
    EFF_FLAG,
    EFF_MASK,
    ERR_FLAG,
    FRAME_SIZE,
    RTR_FLAG,
    SFF_MASK,
    unpack_header,
)

BIT_RATES_Hz = {
    10_000: b"S0",
    20_000: b"S1",
    50_000: b"S2",
    100_000: b"S3",
    125_000: b"S4",
    250_000: b"S5",
    500_000: b"S6",
    800_000: b"S7",
    1_000_000: b"S8",
}
"""Bit rates that have a command of their own."""

LINE_LIMIT = 30
"""Characters of the longest line without its CR: extended frame, 8 bytes, time stamp."""
TIMESTAMP_DIGITS = 4
TIMESTAMP_WRAP_ms = 60_000

_WIDTHS = {ord("t"): 5, ord("r"): 5, ord("T"): 10, ord("R"): 10}  # command, identifier, length
_PREFIX = struct.Struct("=IB3x")
_HEADERS_KEPT = 4096  # bounded: garbage makes many

# linux/can/error.h
_ERR_CRTL, _ERR_PROT, _ERR_ACK, _ERR_BUSOFF = 0x04, 0x08, 0x20, 0x40
_ERR_BUSERROR, _ERR_RESTARTED, _ERR_CNT = 0x80, 0x100, 0x200
_CRTL_ACTIVE, _CRTL_RX_OVERFLOW, _CRTL_TX_OVERFLOW = 0x40, 0x01, 0x02
_CRTL_WARNING, _CRTL_PASSIVE = (0x04, 0x08), (0x10, 0x20)  # receiving, transmitting
_LOC_CRC, _LOC_ACK = 0x08, 0x19
_CRTL_LETTERS = {ord("o"): _CRTL_RX_OVERFLOW, ord("O"): _CRTL_TX_OVERFLOW}
_PROT_LETTERS = {ord("f"): 0x02, ord("s"): 0x04, ord("b"): 0x08, ord("B"): 0x10}
_LOC_LETTERS = {ord("c"): _LOC_CRC, ord("a"): _LOC_ACK}


class StatusFlags(IntFlag):
    """What an adapter answers to `F` (LAWICEL, command F)."""

    RECEIVE_FULL = 0x01
    TRANSMIT_FULL = 0x02
    ERROR_WARNING = 0x04
    DATA_OVERRUN = 0x08
    ERROR_PASSIVE = 0x20
    ARBITRATION_LOST = 0x40
    BUS_ERROR = 0x80


class LineSplitter:
    """Cuts what a serial port delivers into lines, however the pieces fall.

    A line that outgrows `LINE_LIMIT` is dropped up to its CR and counted once; no input makes
    the splitter keep more than one line.

    Attributes:
        overlong: Lines dropped for their length.
    """

    __slots__ = ("_is_skipping", "_rest", "overlong")

    def __init__(self) -> None:
        self.overlong = 0
        self._rest = b""
        self._is_skipping = False

    def feed(self, chunk: bytes) -> list[bytes]:
        """Return the lines that `chunk` completes, without CR; a refusal's line ends with BEL."""
        if b"\a" in chunk:
            chunk = chunk.replace(b"\a", b"\a\r")
        lines = (self._rest + chunk).split(b"\r")
        rest = lines.pop()
        if self._is_skipping and lines:
            del lines[0]
            self._is_skipping = False
        if len(rest) > LINE_LIMIT or self._is_skipping:
            self.overlong += not self._is_skipping
            self._is_skipping = True
            rest = b""
        self._rest = rest
        return lines

    def reset(self) -> None:
        """Forget the line begun."""
        self._rest = b""
        self._is_skipping = False


def encode_frame(frame: bytes) -> bytes:
    """Return the line of a 16-byte record, CR included: `t181200FF`.

    Returns:
        Nothing if there is no line for it: error reports, and records that are no classic frame.
    """
    head, end = _format_header(frame[:5])
    if not head or len(frame) != FRAME_SIZE:
        return b""
    return b"%b%b\r" % (head, hexlify(frame[8:end]).upper())


@lru_cache(_HEADERS_KEPT)
def _format_header(header: bytes) -> tuple[bytes, int]:
    """Return the line's characters before the data, and where the data end in the record."""
    if len(header) < 5:
        return b"", 0
    can_id, length = unpack_header(header)
    if can_id & ERR_FLAG:
        return b"", 0
    length = min(length, 8)
    is_remote = bool(can_id & RTR_FLAG)
    if can_id & EFF_FLAG:
        text = f"{'R' if is_remote else 'T'}{can_id & EFF_MASK:08X}{length}"
    else:
        text = f"{'r' if is_remote else 't'}{can_id & SFF_MASK:03X}{length}"
    return text.encode(), 8 if is_remote else 8 + length


def decode_frame(line: bytes) -> bytes | None:
    """Return the 16-byte record of a line `t`, `T`, `r` or `R` without its CR.

    Returns:
        None if the line is none of these, or not exactly as long as it says.
    """
    width = _WIDTHS.get(line[0], 0) if line else 0
    if not 0 < width <= len(line):
        return None
    header = _parse_header(line[:width])
    if header is None:
        return None
    prefix, length, padding = header
    if len(line) != length:
        return None
    try:
        return prefix + unhexlify(line[width:]) + padding
    except ValueError:
        return None


@lru_cache(_HEADERS_KEPT)
def _parse_header(head: bytes) -> tuple[bytes, int, bytes] | None:
    """Return the record's first 8 bytes, the whole line's length, and zeros after the data."""
    digits, length = head[1:-1], head[-1] - ord("0")
    try:
        can_id = int.from_bytes(unhexlify(b"0" * (len(digits) % 2) + digits), "big")
    except ValueError:
        return None
    is_wide, is_remote = head[0] in b"TR", head[0] in b"rR"
    if not 0 <= length <= 8 or can_id > (EFF_MASK if is_wide else SFF_MASK):
        return None
    can_id |= (EFF_FLAG if is_wide else 0) | (RTR_FLAG if is_remote else 0)
    data = 0 if is_remote else length
    return _PREFIX.pack(can_id, length), len(head) + 2 * data, bytes(8 - data)


def split_timestamp(line: bytes) -> tuple[bytes, int | None]:
    """Split a stamped line (`Z1`) into the frame's own line and its time.

    Returns:
        The line and its time in ms, 0 to 59999; the line unchanged and None if it ends with no
        such time.
    """
    digits = line[-TIMESTAMP_DIGITS:]
    try:
        stamp_ms = int.from_bytes(unhexlify(digits), "big")
    except ValueError:
        return line, None
    if len(digits) < TIMESTAMP_DIGITS or stamp_ms >= TIMESTAMP_WRAP_ms:
        return line, None
    return line[:-TIMESTAMP_DIGITS], stamp_ms


def encode_report(frame: bytes) -> bytes:
    """Return the line of an error report (`ERR_FLAG`), CR included: `sb000248`, `e1a`.

    Controller states become `s` with the receive and transmit error counters, everything else
    `e` with one letter for each error that has one.
    """
    can_id, _ = unpack_header(frame)
    data = frame[8:]
    state = _state_letter(can_id, data[1])
    if state:
        return f"s{state}{data[7]:03d}{data[6]:03d}\r".encode()
    letters = [letter for letter, bit in _CRTL_LETTERS.items() if data[1] & bit]
    letters += [letter for letter, bit in _PROT_LETTERS.items() if data[2] & bit]
    letters += [letter for letter, place in _LOC_LETTERS.items() if data[3] == place]
    return b"e%d%b\r" % (len(letters), bytes(letters))


def _state_letter(can_id: int, control: int) -> str:
    if can_id & _ERR_BUSOFF:
        return "b"
    if can_id & _ERR_RESTARTED:
        return "a"
    if can_id & _ERR_CRTL:
        for letter, bits in (("p", sum(_CRTL_PASSIVE)), ("w", sum(_CRTL_WARNING))):
            if control & bits:
                return letter
        return "a" if control & _CRTL_ACTIVE else ""
    return ""


def decode_report(line: bytes) -> bytes | None:
    """Return the error report (`ERR_FLAG`) that a line `s` or `e` stands for, None if neither."""
    if line[:1] == b"s":
        return _decode_state(line)
    if line[:1] == b"e":
        return _decode_errors(line)
    return None


def _decode_state(line: bytes) -> bytes | None:
    counters = line[2:]
    if len(counters) != 6 or not counters.isdigit():
        return None
    receive, transmit = min(int(counters[:3]), 255), min(int(counters[3:]), 255)
    if line[1] == ord("b"):
        return _report(_ERR_BUSOFF, bytes(8))
    control = _control_bits(line[1], receive, transmit)
    if not control:
        return None
    return _report(_ERR_CRTL | _ERR_CNT, bytes((0, control, 0, 0, 0, 0, transmit, receive)))


def _control_bits(letter: int, receive: int, transmit: int) -> int:
    if letter == ord("a"):
        return _CRTL_ACTIVE
    for state, (receiving, transmitting) in ((b"w", _CRTL_WARNING), (b"p", _CRTL_PASSIVE)):
        if letter == state[0]:  # whoever counts more has got there
            return (receiving if receive >= transmit else 0) | (
                transmitting if transmit >= receive else 0
            )
    return 0


def _decode_errors(line: bytes) -> bytes | None:
    letters = line[2:]
    if len(line) < 2 or line[1] - ord("0") != len(letters) or len(letters) > 8:
        return None
    can_id, data = _ERR_PROT | _ERR_BUSERROR, bytearray(8)
    for letter in letters:
        if letter in _CRTL_LETTERS:
            can_id |= _ERR_CRTL
            data[1] |= _CRTL_LETTERS[letter]
        elif letter in _PROT_LETTERS:
            data[2] |= _PROT_LETTERS[letter]
        elif letter in _LOC_LETTERS:
            can_id |= _ERR_ACK if letter == ord("a") else 0
            data[3] = _LOC_LETTERS[letter]
        else:
            return None
    return _report(can_id, bytes(data))


def _report(can_id: int, data: bytes) -> bytes:
    return _PREFIX.pack(ERR_FLAG | can_id, 8) + data


def decode_status(line: bytes) -> StatusFlags | None:
    """Return the flags of an answer `Fxx`, None if it is none."""
    try:
        (flags,) = unhexlify(line[1:]) if line[:1] == b"F" else b""
    except ValueError:
        return None
    return StatusFlags(flags)
