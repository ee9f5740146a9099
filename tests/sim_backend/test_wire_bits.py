"""Frame lengths to the bit, against a plain bit-by-bit model, worked examples and the bounds."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.frame import (
    EFF_FLAG,
    FD_BRS,
    FD_ESI,
    RTR_FLAG,
    pack_frame,
    worst_case_bits,
    worst_case_fd_bits,
)
from sim_backend.wire_bits import (
    INTERFRAME_BITS,
    arbitration_key,
    crc_15,
    fd_frame_bits,
    frame_bits,
)

FD_LENGTHS = [*range(9), 12, 16, 20, 24, 32, 48, 64]
identifiers = st.one_of(
    st.integers(0, 0x7FF), st.integers(0, 0x1FFF_FFFF).map(lambda number: number | EFF_FLAG)
)
payloads = st.binary(max_size=8) | st.builds(
    lambda byte, n: bytes([byte]) * n, st.sampled_from([0x00, 0xFF, 0x0F, 0x1E, 0x87]),
    st.integers(0, 8),
)  # fmt: skip


def arbitration_field(can_id, *, is_fd=False):
    """The bits from start of frame to the last one before the data length code, as text."""
    rtr = "1" if can_id & RTR_FLAG else "0"
    if can_id & EFF_FLAG:
        number = f"{can_id & 0x1FFF_FFFF:029b}"
        return "0" + number[:11] + "11" + number[11:] + rtr + ("10" if is_fd else "00")
    return "0" + f"{can_id & 0x7FF:011b}" + rtr + "0" + ("10" if is_fd else "0")


def remainder(bits, polynomial=0b1100010110011001, width=15):
    """CRC by long division of the bits with as many zeros behind them."""
    value = int(bits, 2) << width
    for place in range(len(bits) - 1, -1, -1):
        if value >> (place + width) & 1:
            value ^= polynomial << place
    return f"{value:0{width}b}"


def stuffed(bits):
    """The bits on the wire: after five alike, one of the other kind, which counts as well."""
    wire = ""
    for bit in bits:
        wire += bit
        if wire[-5:] in ("00000", "11111"):
            wire += "1" if bit == "0" else "0"
    return wire


def plain_bits(can_id, data):
    is_remote = bool(can_id & RTR_FLAG)
    bits = arbitration_field(can_id) + f"{len(data):04b}"
    bits += "" if is_remote else "".join(f"{byte:08b}" for byte in data)
    return stuffed(bits + remainder(bits))


def plain_length(can_id, data):
    """CRC delimiter 1, acknowledgement 2, end of frame 7, interframe space 3."""
    return len(plain_bits(can_id, data)) + 1 + 2 + 7 + 3


def fd_frame(can_id, data, flags=FD_BRS):
    return struct.pack("=IBB2x64s", can_id, len(data), flags, data)


def plain_fd_length(can_id, data, flags=FD_BRS):
    head = arbitration_field(can_id, is_fd=True) + ("1" if flags & FD_BRS else "0")
    bits = head + ("1" if flags & FD_ESI else "0") + f"{FD_LENGTHS.index(len(data)):04b}"
    bits += "".join(f"{byte:08b}" for byte in data)
    first = len(stuffed(head))
    rest = stuffed(bits)[first:]
    # A fixed stuff bit follows the data in any case; one that is due there is the same one.
    is_due_at_end = stuffed(bits)[-1] != bits[-1]
    crc_field = 4 + 17 + 6 if len(data) <= 16 else 4 + 21 + 7
    return first + 2 + 7 + 3, len(rest) - is_due_at_end + crc_field + 1


def test_crc_15__catalogue_check_string__its_check_value():
    assert crc_15(b"123456789") == 0x059E  # CRC-15/CAN in the catalogue of parametrised CRCs


def test_frame_bits__sync__as_counted_by_hand():
    # 0 000.1000.0000 0 0 0 0000 is 0000 1 and fourteen 0: after five and after five more of the
    # latter a 1. The CRC of x**14 is x**29 mod the polynomial.
    bits = "0" + "00010000000" + "000" + "0000"
    assert bits == "00001" + "0" * 14
    crc = remainder(bits)
    assert stuffed(bits) == "00001" + "00000" + "1" + "00000" + "1" + "0000"
    assert frame_bits(pack_frame(0x080)) == len(stuffed(bits + crc)) + 13
    assert 47 <= frame_bits(pack_frame(0x080)) <= 55


def test_frame_bits__no_run_of_five__bare_length():
    can_id, data = next(
        (can_id, data)
        for can_id in range(0x555, 0x7FF)
        for data in (b"\x55" * 4, b"\xaa" * 4, b"\x5a" * 4)
        if len(plain_bits(can_id, data)) == 34 + 32
    )
    assert frame_bits(pack_frame(can_id, data)) == 47 + 32


@pytest.mark.parametrize(
    ("can_id", "data"),  # frames with dense stuff bits, as conformance tests send them
    [(0x78, b"\x01" + b"\xe1" * 7), (0x41F, b"\x00"), (0x47F, b"\x1f"), (0x758, b""),
     (0x777, b"\x1f"), (0x7EF, b"\x42")],
)  # fmt: skip
def test_frame_bits__dense_stuffing__as_the_plain_model(can_id, data):
    length = frame_bits(pack_frame(can_id, data))
    assert length == plain_length(can_id, data)
    assert length > 47 + 8 * len(data)


def test_frame_bits__densest_frame__comes_close_to_the_bound():
    assert frame_bits(pack_frame(0x78, b"\x01" + b"\xe1" * 7)) >= worst_case_bits(8) - 8


@given(identifiers, payloads)
def test_frame_bits__any_data_frame__as_the_plain_model_and_within_bounds(can_id, data):
    length = frame_bits(pack_frame(can_id, data))
    is_extended = bool(can_id & EFF_FLAG)
    assert length == plain_length(can_id, data)
    assert (67 if is_extended else 47) + 8 * len(data) <= length
    assert length <= worst_case_bits(len(data), is_extended=is_extended)


@given(identifiers, st.integers(0, 8))
def test_frame_bits__remote_request__has_no_data(can_id, length):
    frame = pack_frame(can_id | RTR_FLAG, bytes(length))
    assert frame_bits(frame) == plain_length(can_id | RTR_FLAG, bytes(length))


@given(st.binary(min_size=16, max_size=16))
def test_frame_bits__garbage__is_a_length(record):
    assert 47 <= frame_bits(record) <= 160


@given(
    identifiers, st.sampled_from(FD_LENGTHS).flatmap(lambda n: st.binary(min_size=n, max_size=n))
)
def test_fd_frame_bits__any_frame__as_the_plain_model_and_within_bounds(can_id, data):
    first, second = fd_frame_bits(fd_frame(can_id, data))
    assert (first, second) == plain_fd_length(can_id, data)
    most = worst_case_fd_bits(len(data), is_extended=bool(can_id & EFF_FLAG))
    head = 36 if can_id & EFF_FLAG else 17
    assert head + 12 <= first <= most[0]
    assert 5 + 8 * len(data) + (27 if len(data) <= 16 else 32) + 1 <= second
    assert first + second <= sum(most)
    assert second <= most[1] + most[0] - first  # what is not stuffed early may be later


@given(identifiers, st.binary(max_size=64), st.integers(0, 255))
def test_fd_frame_bits__length_that_does_not_exist__counts_as_the_next(can_id, data, flags):
    padded = data + bytes(next(n for n in FD_LENGTHS if n >= len(data)) - len(data))
    frame, whole = fd_frame(can_id, data, flags), fd_frame(can_id, padded, flags)
    assert fd_frame_bits(frame) == fd_frame_bits(whole)


@given(identifiers, st.sampled_from([0, FD_BRS, FD_ESI, FD_BRS | FD_ESI]))
def test_fd_frame_bits__flags__count_as_bits_and_choose_the_rate(can_id, flags):
    data = bytes(range(24))
    first, second = plain_fd_length(can_id, data, flags)
    expected = (first, second) if flags & FD_BRS else (first + second, 0)
    assert fd_frame_bits(fd_frame(can_id, data, flags)) == expected


def test_worst_case_fd_bits__torque_to_a_moteus__112_us_at_1_and_5_mbit():
    first, second = worst_case_fd_bits(24, is_extended=True)
    assert (first, second) == (56, 280)
    assert first * 1.0 + second * 0.2 == 112.0


@given(identifiers, identifiers, st.booleans(), st.booleans(), st.booleans(), st.booleans())
def test_arbitration_key__two_frames__order_of_their_bits_on_the_wire(
    left_id, right_id, left_rtr, right_rtr, left_fd, right_fd
):
    def make(can_id, is_remote, is_fd):
        if is_fd:
            return fd_frame(can_id, b""), arbitration_field(can_id, is_fd=True)
        can_id |= RTR_FLAG if is_remote else 0
        return pack_frame(can_id), arbitration_field(can_id)

    (left, left_bits), (right, right_bits) = (
        make(left_id, left_rtr, left_fd),
        make(right_id, right_rtr, right_fd),
    )
    if left_bits == right_bits:
        assert arbitration_key(left) == arbitration_key(right)
    else:
        assert (arbitration_key(left) < arbitration_key(right)) == (left_bits < right_bits)


def test_arbitration_key__same_base__standard_before_remote_before_extended():
    base = 0x123
    frames = [
        pack_frame(base),
        pack_frame(base | RTR_FLAG),
        pack_frame(base << 18 | EFF_FLAG),
        pack_frame(base << 18 | EFF_FLAG | RTR_FLAG),
    ]
    keys = [arbitration_key(frame) for frame in frames]
    assert keys == sorted(set(keys))


def test_interframe_bits__are_three():
    assert INTERFRAME_BITS == 3
