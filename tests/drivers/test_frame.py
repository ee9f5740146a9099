import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.buses.python_can import from_message, to_message
from drivers.frame import (
    EFF_FLAG,
    EFF_MASK,
    ERR_BIT,
    ERR_FLAG,
    FD_ESI,
    FD_FRAME_SIZE,
    FD_LENGTHS,
    FLAGS_INDEX,
    FRAME_SIZE,
    RTR_FLAG,
    SFF_MASK,
    fd_length,
    is_fd,
    pack_fd_frame,
    pack_frame,
    unpack_frame,
    unpack_header,
    worst_case_bits,
)

can_ids = st.integers(0, SFF_MASK) | st.integers(0, EFF_MASK).map(lambda i: i | EFF_FLAG)
payloads = st.binary(max_size=8)


@given(can_ids, payloads)
def test_frame__packed_and_unpacked__is_the_same(can_id, data):
    frame = pack_frame(can_id, data)
    assert len(frame) == FRAME_SIZE
    assert unpack_frame(frame) == (can_id, data)
    assert unpack_header(frame) == (can_id, len(data))
    assert not frame[FLAGS_INDEX] & ERR_BIT


@given(can_ids, st.sampled_from(FD_LENGTHS).flatmap(lambda n: st.binary(min_size=n, max_size=n)))
def test_fd_frame__packed_and_unpacked__is_the_same(can_id, data):
    frame = pack_fd_frame(can_id, data)
    assert len(frame) == FD_FRAME_SIZE
    assert is_fd(frame)
    assert not is_fd(pack_frame(can_id))
    assert unpack_frame(frame) == (can_id, data)
    assert unpack_header(frame) == (can_id, len(data))
    message = to_message(frame)
    assert message.is_fd
    assert message.bitrate_switch
    assert not message.error_state_indicator
    assert from_message(message) == frame


def test_fd_frame__layout__is_the_kernels():
    frame = pack_fd_frame(0x123, b"\x11\x22", flags=FD_ESI)
    can_id = (0x123).to_bytes(4, sys.byteorder)
    assert frame == can_id + b"\x02\x06\0\0\x11\x22" + bytes(62)


@pytest.mark.parametrize("length", [9, 13, 33, 63, 65])
def test_fd_frame__length_that_does_not_exist__is_refused(length):
    with pytest.raises(ValueError, match=f"12, 16 ... 64 bytes, not {length}"):
        pack_fd_frame(1, bytes(length))


@pytest.mark.parametrize(("length", "room"), [(0, 0), (8, 8), (9, 12), (25, 32), (64, 64)])
def test_fd_length__any_length__is_the_next_that_exists(length, room):
    assert fd_length(length) == room


def test_fd_length__too_long__is_refused():
    with pytest.raises(ValueError, match="at most 64 bytes, not 65"):
        fd_length(65)


@given(st.binary(min_size=FD_FRAME_SIZE, max_size=FD_FRAME_SIZE))
def test_fd_frame__any_record__unpacks_and_converts_without_raising(record):
    can_id, data = unpack_frame(record)
    assert (can_id, data) == (unpack_header(record)[0], record[8 : 8 + min(record[4], 64)])
    assert to_message(record).is_fd


def test_frame__layout__is_the_kernels():
    frame = pack_frame(0x123, b"\x11\x22")
    expected = (0x123).to_bytes(4, "little") + b"\x02\0\0\0\x11\x22\0\0\0\0\0\0"
    if FLAGS_INDEX == 0:  # big-endian host
        expected = (0x123).to_bytes(4, "big") + expected[4:]
    assert frame == expected


def test_frame__nine_bytes__is_refused():
    with pytest.raises(ValueError, match="at most 8 bytes, not 9"):
        pack_frame(1, bytes(9))


@given(st.binary(min_size=FRAME_SIZE, max_size=FRAME_SIZE))
def test_frame__any_record__unpacks_and_converts_without_raising(record):
    can_id, data = unpack_frame(record)
    assert can_id == unpack_header(record)[0]
    assert data == record[8 : 8 + min(record[4], 8)]
    message = to_message(record)
    assert message.dlc <= 8
    assert message.is_error_frame == bool(record[FLAGS_INDEX] & ERR_BIT)


@given(can_ids, payloads)
def test_message__data_frame__round_trip(can_id, data):
    message = to_message(pack_frame(can_id, data))
    assert message.is_extended_id == bool(can_id & EFF_FLAG)
    assert (message.arbitration_id, bytes(message.data)) == (can_id & EFF_MASK, data)
    assert from_message(message) == pack_frame(can_id, data)


@given(can_ids, st.integers(0, 8))
def test_message__remote_request__round_trip_keeps_the_length(can_id, length):
    frame = pack_frame(can_id | RTR_FLAG, bytes(length))
    message = to_message(frame)
    assert message.is_remote_frame
    assert message.dlc == length
    assert from_message(message) == frame


@given(st.integers(0, EFF_MASK), payloads)
def test_message__error_report__round_trip(error_class, data):
    frame = pack_frame(error_class | ERR_FLAG, data)
    assert from_message(to_message(frame)) == frame


@pytest.mark.parametrize(
    ("length", "standard", "extended"),
    [(0, 55, 80), (2, 75, 100), (4, 95, 120), (6, 115, 140), (8, 135, 160)],
)
def test_worst_case_bits__classic_frame__matches_the_table(length, standard, extended):
    assert worst_case_bits(length) == standard
    assert worst_case_bits(length, is_extended=True) == extended
