"""How long a frame is on the wire, to the bit: stuffing of the bits it really consists of.

Sources: CAN 2.0 (Bosch, 1991) part A section 3 and part B section 3; ISO 11898-1:2015 section 10.4
for CAN FD. Lengths run from start-of-frame to the end of the interframe space.
"""

from functools import lru_cache
from struct import Struct

from drivers.frame import (
    EFF_FLAG,
    EFF_MASK,
    FD_BRS,
    FD_ESI,
    FD_LENGTHS,
    FRAME_SIZE,
    RTR_FLAG,
    SFF_MASK,
)

INTERFRAME_BITS = 3
"""Recessive bits between the end of a frame and the next one's start."""

_CRC_15 = 0x4599
_TAIL_BITS = 10  # CRC delimiter, acknowledgement and its delimiter, end of frame
_FD_TAIL_BITS = 9  # the same without the CRC delimiter, which belongs to the data phase
_FD_CRC_17_BITS = 4 + 17 + 6  # stuff count, CRC, fixed stuff bits
_FD_CRC_21_BITS = 4 + 21 + 7
_FD_CRC_17_LENGTH_MAX = 16
_unpack_header = Struct("=IBB").unpack_from
_RUNS = 5
_IDLE = 1 * _RUNS  # recessive, and no run has begun


def _stuff(state: int, bits: int, count: int) -> tuple[int, int]:
    """Send `count` bits of a number, highest first: (stuff bits inserted, state after them).

    The state is the last bit times 5 plus how often it has come in a row, stuff bits included.
    """
    stuffed = 0
    last, run = divmod(state, _RUNS)
    for place in range(count - 1, -1, -1):
        bit = bits >> place & 1
        run = run + 1 if bit == last else 1
        last = bit
        if run == _RUNS:
            stuffed += 1
            last, run = 1 - bit, 1
    return stuffed, last * _RUNS + run


def _crc_step(crc: int, bits: int, count: int) -> int:
    for place in range(count - 1, -1, -1):
        is_odd = (crc >> 14 ^ bits >> place) & 1
        crc = crc << 1 & 0x7FFF ^ (_CRC_15 if is_odd else 0)
    return crc


_STUFF_BYTE = [[_stuff(state, byte, 8) for byte in range(256)] for state in range(2 * _RUNS)]
_STUFF_CRC_END = [[_stuff(state, bits, 7)[0] for bits in range(128)] for state in range(2 * _RUNS)]
_CRC_BYTE = [_crc_step(byte << 7, 0, 8) for byte in range(256)]


def crc_15(data: bytes) -> int:
    """Return the CRC-15 of classic CAN over whole bytes."""
    crc = 0
    for byte in data:
        crc = crc << 8 & 0x7FFF ^ _CRC_BYTE[crc >> 7 ^ byte]
    return crc


@lru_cache(maxsize=4096)
def _classic_head(can_id: int, length: int) -> tuple[int, int, int, int]:
    """Return CRC, stuffing state and bits so far after the DLC field, and the data bytes."""
    rtr = 1 if can_id & RTR_FLAG else 0
    if can_id & EFF_FLAG:
        base, extension = (can_id & EFF_MASK) >> 18, can_id & 0x3FFFF
        bits = base << 27 | 0b11 << 25 | extension << 7 | rtr << 6 | length
        count = 39
    else:
        bits, count = (can_id & SFF_MASK) << 7 | rtr << 6 | length, 19
    stuffed, state = _stuff(_IDLE, bits, count)
    data_bytes = 0 if rtr else min(length, 8)
    return _crc_step(0, bits, count), state, count + stuffed, data_bytes


def frame_bits(frame: bytes) -> int:
    """Return how many bits a classic frame occupies, stuff bits and interframe space included.

    Args:
        frame: 16-byte record (`drivers.frame`). A length code above 8 counts as 8 bytes.
    """
    can_id, length, _ = _unpack_header(frame)
    crc, state, bits, data_bytes = _classic_head(can_id, length & 0xF)
    for byte in frame[8 : 8 + data_bytes]:
        crc = crc << 8 & 0x7FFF ^ _CRC_BYTE[crc >> 7 ^ byte]
        stuffed, state = _STUFF_BYTE[state][byte]
        bits += stuffed
    stuffed, state = _STUFF_BYTE[state][crc >> 7]
    bits += stuffed + _STUFF_CRC_END[state][crc & 0x7F]
    return bits + 8 * data_bytes + 15 + _TAIL_BITS + INTERFRAME_BITS


@lru_cache(maxsize=4096)
def _fd_head(can_id: int, length: int, brs: int) -> tuple[int, int, int]:
    """Return bits up to BRS and their stuffing state, at the first rate, and the data bytes."""
    if can_id & EFF_FLAG:
        base, extension = (can_id & EFF_MASK) >> 18, can_id & 0x3FFFF
        bits, count = base << 24 | 0b11 << 22 | extension << 4 | 0b0100 | brs, 36
    else:
        bits, count = (can_id & SFF_MASK) << 5 | 0b00100 | brs, 17
    stuffed, state = _stuff(_IDLE, bits, count)
    return count + stuffed, state, next((n for n in FD_LENGTHS if n >= length), 64)


def fd_frame_bits(frame: bytes) -> tuple[int, int]:
    """Return how many bits of an FD frame run at the first and at the second bit rate.

    The CRC itself does not matter: its stuff bits stand at fixed places. BRS counts as sent at
    the first rate and the CRC delimiter at the second; with equal sample points of both rates
    the sum of the times is exact. A stuff bit due right before the CRC field is the field's own
    first fixed stuff bit.

    Args:
        frame: 72-byte `struct canfd_frame` record. A length between two that exist counts as the
            next one.
    """
    can_id, length, flags = _unpack_header(frame)
    first, state, data_bytes = _fd_head(can_id, min(length, 64), flags & FD_BRS)
    last = (0x10 if flags & FD_ESI else 0) | FD_LENGTHS.index(data_bytes)
    stuffed, state = _stuff(state, last, 5)
    second = 5 + stuffed + 8 * data_bytes
    for last in frame[8 : 8 + data_bytes]:
        stuffed, state = _STUFF_BYTE[state][last]
        second += stuffed
    if state // _RUNS != last & 1:
        second -= 1
    is_short = data_bytes <= _FD_CRC_17_LENGTH_MAX
    second += (_FD_CRC_17_BITS if is_short else _FD_CRC_21_BITS) + 1
    first += _FD_TAIL_BITS + INTERFRAME_BITS
    return (first, second) if flags & FD_BRS else (first + second, 0)


def arbitration_key(frame: bytes) -> int:
    """Return a number that is smaller for the frame that wins arbitration.

    It is the arbitration field as sent, dominant = 0: of two frames with the same 11 first bits a
    standard one beats an extended one, a data frame a remote request, a classic one an FD one.
    """
    can_id: int = _unpack_header(frame)[0]
    is_fd = 1 if len(frame) > FRAME_SIZE else 0
    rtr = 1 if can_id & RTR_FLAG and not is_fd else 0
    if can_id & EFF_FLAG:
        base, extension = (can_id & EFF_MASK) >> 18, can_id & 0x3FFFF
        return base << 22 | 0b11 << 20 | extension << 2 | rtr << 1 | is_fd
    return (can_id & SFF_MASK) << 22 | rtr << 21 | is_fd << 19
