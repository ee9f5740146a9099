"""Bytes <-> values of moteus' register protocol: constants and pure functions.

Shared by the master and the emulated controller. Nothing here does I/O, keeps state, or raises
for bytes that came from a wire. Sources: moteus documentation, "CAN Protocol"
(docs/protocol/can.md); mjlib, `multiplex/format.h`. The registers themselves are in
`drivers.moteus.registers`.
"""

import math
from struct import Struct
from typing import NamedTuple

from drivers.frame import EFF_FLAG, SFF_MASK, fd_length
from drivers.moteus.registers import (
    INT_MAX,
    TIME,
    TORQUE,
    Mode,
    Register,
    Resolution,
    decode_value,
    scale_of,
)

BROADCAST = 0x7F
"""Destination that every controller obeys."""
WANTS_REPLY = 0x80
"""Bit of the source: without it there is no reply, whatever is asked."""
NOP = 0x50
"""Subframe that means nothing: padding."""
FD_PAYLOAD = 64
_VARUINT_BYTES = 5

WRITE, READ, REPLY = 0x00, 0x10, 0x20
WRITE_ERROR, READ_ERROR = 0x30, 0x31
CLIENT_DATA, SERVER_DATA, CLIENT_POLL = 0x40, 0x41, 0x42
"""Subframes of a tunnelled byte stream: to the controller, from it, and the request for some."""
CONSOLE_CHANNEL = 1
"""Tunnel to the diagnostic console (docs/protocol/diagnostic.md)."""

VALUE = (Struct("<b"), Struct("<h"), Struct("<i"), Struct("<f"))
"""Layout of one value, by `Resolution`."""

# --- identifiers ----------------------------------------------------------------------------


def request_id(node: int, source: int = 0, *, prefix: int = 0, wants_reply: bool = True) -> int:
    """Identifier, with flags, of a frame to a controller.

    Args:
        node: 1 to 126, or `BROADCAST`.
        source: The sender, 0 to 127.
        prefix: `can.prefix`, 13 bits, above the 16 that say who talks to whom.
        wants_reply: Ask for a reply.
    """
    return _with_flag(prefix << 16 | (source | (WANTS_REPLY if wants_reply else 0)) << 8 | node)


def reply_id(node: int, source: int = 0, *, prefix: int = 0) -> int:
    """Identifier, with flags, of a controller's reply to `source`."""
    return _with_flag(prefix << 16 | node << 8 | source)


def _with_flag(can_id: int) -> int:
    return can_id | EFF_FLAG if can_id > SFF_MASK else can_id


def split_id(can_id: int) -> tuple[int, int, int]:
    """Return (prefix, source byte, destination) of an identifier, whatever its flags."""
    return can_id >> 16 & 0x1FFF, can_id >> 8 & 0xFF, can_id & 0xFF


# --- subframes ------------------------------------------------------------------------------


class Subframe(NamedTuple):
    """One part of a frame.

    `kind` is WRITE, READ, REPLY, WRITE_ERROR, READ_ERROR, CLIENT_DATA, SERVER_DATA or CLIENT_POLL.
    """

    kind: int
    number: int
    """First register; of a stream the channel."""
    resolution: int = 0
    values: tuple[float, ...] = ()
    """Of WRITE and REPLY, raw; the error number."""
    wanted: int = 0
    """Registers asked for; bytes asked for."""
    data: bytes = b""
    """Of a stream."""


def varuint(value: int) -> bytes:
    """Return a number in groups of seven bits, least significant first."""
    encoded = bytearray()
    while value > 0x7F:
        encoded.append(value & 0x7F | 0x80)
        value >>= 7
    encoded.append(value)
    return bytes(encoded)


def read_varuint(data: bytes, at: int) -> tuple[int, int] | None:
    """Return (number, offset after it), None if it is cut or longer than 32 bits need."""
    value = shift = 0
    for here in range(at, min(at + _VARUINT_BYTES, len(data))):
        byte = data[here]
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, here + 1
        shift += 7
    return None


def parse_subframes(data: bytes) -> tuple[list[Subframe], bool]:
    """Split a frame's data.

    Returns:
        The subframes up to the first that is malformed or unknown, and whether there was one:
        what stands behind it has no meaning.
    """
    found: list[Subframe] = []
    at = 0
    while at < len(data):
        if data[at] == NOP:
            at += 1
            continue
        parsed = _parse_one(data, at)
        if parsed is None:
            return found, True
        subframe, at = parsed
        if subframe is not None:
            found.append(subframe)
    return found, False


def _parse_one(data: bytes, at: int) -> tuple[Subframe | None, int] | None:
    kind = data[at]
    if kind < REPLY + 0x10:
        return _parse_registers(data, at)
    if kind in (WRITE_ERROR, READ_ERROR, CLIENT_POLL):
        return _parse_pair(data, at)
    if kind in (CLIENT_DATA, SERVER_DATA):
        return _parse_stream(data, at)
    return None


def _parse_registers(data: bytes, at: int) -> tuple[Subframe | None, int] | None:
    kind, resolution, count = data[at] & 0xF0, data[at] >> 2 & 3, data[at] & 3
    at += 1
    if count == 0:
        long_form = read_varuint(data, at)
        if long_form is None:
            return None
        count, at = long_form
        if count == 0:  # no registers, no register number
            return None, at
    start = read_varuint(data, at)
    if start is None:
        return None
    register, at = start
    if kind == READ:
        return Subframe(READ, register, resolution, wanted=count), at
    value = VALUE[resolution]
    end = at + count * value.size
    if end > len(data):
        return None
    values = tuple(number for (number,) in value.iter_unpack(data[at:end]))
    return Subframe(kind, register, resolution, values), end


def _parse_pair(data: bytes, at: int) -> tuple[Subframe, int] | None:
    kind = data[at]
    first = read_varuint(data, at + 1)
    second = read_varuint(data, first[1]) if first else None
    if first is None or second is None:
        return None
    if kind == CLIENT_POLL:
        return Subframe(kind, first[0], wanted=second[0]), second[1]
    return Subframe(kind, first[0], values=(second[0],)), second[1]


def _parse_stream(data: bytes, at: int) -> tuple[Subframe, int] | None:
    pair = _parse_pair(data, at)
    if pair is None:
        return None
    subframe, at = pair
    end = at + int(subframe.values[0])
    if end > len(data):
        return None
    return Subframe(subframe.kind, subframe.number, data=data[at:end]), end


def pack_head(kind: int, register: int, resolution: int, count: int) -> bytes:
    """Return the beginning of a WRITE, READ or REPLY of so many registers."""
    command = kind | resolution << 2
    if count <= 3:
        return bytes((command | count,)) + varuint(register)
    return bytes((command,)) + varuint(count) + varuint(register)


def pack_values(kind: int, register: int, resolution: int, *values: float) -> bytes:
    """Return a WRITE or REPLY of raw numbers that the resolution can hold."""
    pack = VALUE[resolution].pack
    whole = resolution != Resolution.FLOAT
    packed = b"".join(pack(int(value) if whole else value) for value in values)
    return pack_head(kind, register, resolution, len(values)) + packed


def pack_stream(kind: int, channel: int, data: bytes) -> bytes:
    """Return a CLIENT_DATA or SERVER_DATA."""
    return bytes((kind,)) + varuint(channel) + varuint(len(data)) + data


def pad(data: bytes) -> bytes:
    """Fill up with NOP to a length that a CAN FD frame can have."""
    return data.ljust(fd_length(len(data)), bytes((NOP,)))


def parse_replies(data: bytes) -> dict[int, float]:
    """Return the registers in a reply as physical values; errors leave theirs out."""
    values: dict[int, float] = {}
    for part in parse_subframes(data)[0]:
        if part.kind == REPLY:
            for register, number in enumerate(part.values, start=part.number):
                values[register] = decode_value(number, scale_of(register), part.resolution)
    return values


# --- the cycle's frames ---------------------------------------------------------------------

QUERY_STATE = pack_head(READ, Register.MODE, Resolution.INT8, 1) + pack_head(
    READ, Register.POSITION, Resolution.FLOAT, 3
)
"""Asks for mode, position, velocity and torque."""
QUERY_FAULT = pack_head(READ, Register.FAULT, Resolution.INT8, 1)
POLL = pad(QUERY_STATE + QUERY_FAULT)
STOP = pad(pack_values(WRITE, Register.MODE, Resolution.INT8, Mode.STOPPED) + POLL)
"""Torque off. It also clears a fault, so nobody sends it without meaning to."""

STATE_LENGTH = 20
"""Data bytes of the reply to `POLL`, `STOP` and torque commands."""
STATE = Struct("<HbH3fHb")
"""That reply: (`STATE_HEAD`, mode, `STATE_BODY`, position [rev], velocity [rev/s], torque [Nm],
`STATE_TAIL` if the fault code was asked for too, fault code)."""
STATE_HEAD, STATE_BODY, STATE_TAIL = 0x0021, 0x012F, 0x0F21
TORQUE_LENGTH = 32
"""Data bytes of a torque command."""


def torque_frame_parts(torque_max_Nm: float, timeout_s: float) -> tuple[bytes, bytes]:
    """Return what stands before and after the float32 torque of a torque command.

    Mode 10 with no position (NaN), no velocity, no gains (kp, kd and the integral's limit scaled
    to 0) and this feed-forward torque, valid for `timeout_s`, then the query. As every command
    resets what it does not set, nothing is left to what somebody wrote before.

    Args:
        torque_max_Nm: Written as the command's own limit, rounded up to 0.01 Nm.
        timeout_s: Watchdog of this command, in whole milliseconds.
    """
    int8, int16 = Resolution.INT8, Resolution.INT16
    before = (
        pack_values(WRITE, Register.MODE, int8, Mode.POSITION)
        + pack_values(WRITE, Register.COMMAND_POSITION, int8, -128, 0)
        + pack_head(WRITE, Register.COMMAND_TORQUE, Resolution.FLOAT, 1)
    )
    limit = min(INT_MAX[int16], math.ceil(torque_max_Nm / TORQUE[int16] - 1e-6))
    timeout = round(timeout_s / TIME[int16])
    after = (
        pack_values(WRITE, Register.COMMAND_KP_SCALE, int16, 0, 0, limit)
        + pack_values(WRITE, Register.COMMAND_TIMEOUT, int16, timeout)
        + pack_values(WRITE, Register.COMMAND_ILIMIT_SCALE, int8, 0)
        + QUERY_STATE
    )
    return before, after
