"""LAWICEL lines <-> records. Examples of the CANUSB Manual, and round trips."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.buses.slcan_codec import (
    LINE_LIMIT,
    LineSplitter,
    StatusFlags,
    decode_frame,
    decode_report,
    decode_status,
    encode_frame,
    encode_report,
    split_timestamp,
)
from drivers.frame import EFF_FLAG, ERR_FLAG, FRAME_SIZE, RTR_FLAG, pack_frame, unpack_frame

GOLDEN = [  # commands t, T, r, R of the manual, and the ends of the ranges
    (b"t10021133", pack_frame(0x100, b"\x11\x33")),
    (b"t0000", pack_frame(0)),
    (b"t7FF80011223344556677", pack_frame(0x7FF, bytes.fromhex("0011223344556677"))),
    (b"T0000010021133", pack_frame(0x100 | EFF_FLAG, b"\x11\x33")),
    (b"T1FFFFFFF8FFFFFFFFFFFFFFFF", pack_frame(0x1FFF_FFFF | EFF_FLAG, b"\xff" * 8)),
    (b"r1002", pack_frame(0x100 | RTR_FLAG, bytes(2))),
    (b"R000001002", pack_frame(0x100 | EFF_FLAG | RTR_FLAG, bytes(2))),
]
NO_FRAMES = [
    b"", b"t", b"t0", b"t1", b"t123", b"t1231", b"t12310", b"t123100AB", b"t1239", b"t123:",
    b"t8000", b"tFFF0", b"T200000000", b"TFFFFFFFF0", b"T00000100", b"r100200", b"r1009",
    b"x1230", b"x" + b"0" * 30, b"t+120", b"t 120", b"t1_20", b"t12g0", b"t1231GG", b"t1231 1",
    b"t123\xb10", b"\x00" * 9, b"t10021133\n", b" t10021133",
]  # fmt: skip

can_ids = st.one_of(
    st.integers(0, 0x7FF), st.integers(0, 0x1FFF_FFFF).map(lambda can_id: can_id | EFF_FLAG)
)
data_frames = st.builds(pack_frame, can_ids, st.binary(max_size=8))
remote_frames = st.builds(
    lambda can_id, length: pack_frame(can_id | RTR_FLAG, bytes(length)),
    can_ids,
    st.integers(0, 8),
)
frames = data_frames | remote_frames


@pytest.mark.parametrize(("line", "frame"), GOLDEN)
def test_frame__examples_of_the_manual__both_ways(line, frame):
    assert encode_frame(frame) == line + b"\r"
    assert decode_frame(line) == frame
    assert decode_frame(line[:1] + line[1:].lower()) == frame


@pytest.mark.parametrize("line", NO_FRAMES)
def test_decode_frame__not_exactly_a_frame__is_none(line):
    assert decode_frame(line) is None


@given(frames)
def test_frame__any__survives_the_round_trip(frame):
    line = encode_frame(frame)
    assert line.endswith(b"\r")
    assert len(line) <= LINE_LIMIT + 1
    assert decode_frame(line[:-1]) == frame


@given(frames, st.integers(0, 59_999))
def test_split_timestamp__stamped_frame__gives_both_parts(frame, stamp_ms):
    line = encode_frame(frame)[:-1]
    assert decode_frame(b"%b%04X" % (line, stamp_ms)) is None
    assert split_timestamp(b"%b%04X" % (line, stamp_ms)) == (line, stamp_ms)


@pytest.mark.parametrize("line", [b"", b"t10", b"EA60", b"t1000EA60", b"t1000FFFF", b"t1000GGGG"])
def test_split_timestamp__no_time__leaves_the_line(line):
    assert split_timestamp(line) == (line, None)


def test_encode_frame__length_byte_above_8__is_read_as_8():
    frame = bytearray(pack_frame(0x123, bytes(range(8))))
    frame[4] = 15
    assert encode_frame(bytes(frame)) == b"t12380001020304050607\r"


@pytest.mark.parametrize(
    "record", [b"", b"\x01", bytes(15), bytes(17), bytes(72), pack_frame(ERR_FLAG | 0x40, bytes(8))]
)
def test_encode_frame__no_classic_frame__has_no_line(record):
    assert encode_frame(record) == b""


@given(st.binary(max_size=40))
def test_decode__any_bytes__frame_is_whole_or_none(line):
    for decoded in (decode_frame(line), decode_report(line)):
        assert decoded is None or len(decoded) == FRAME_SIZE
    flags = decode_status(line)
    assert flags is None or line.upper() == b"F%02X" % flags


@given(frames, st.data())
def test_decode_frame__one_character_changed__never_a_longer_or_shorter_frame(frame, data):
    line = bytearray(encode_frame(frame)[:-1])
    line[data.draw(st.integers(0, len(line) - 1))] = data.draw(st.integers(0, 255))
    decoded = decode_frame(bytes(line))
    if decoded is not None:
        assert encode_frame(decoded)[:-1] == bytes(line[:1]) + bytes(line[1:]).upper()


# --- reports

BUS_OFF = pack_frame(ERR_FLAG | 0x40, bytes(8))


def state(control, receive, transmit):
    return pack_frame(ERR_FLAG | 0x204, bytes((0, control, 0, 0, 0, 0, transmit, receive)))


@pytest.mark.parametrize(
    ("line", "frame"),
    [
        (b"sb000000", BUS_OFF),
        (b"sa057033", state(0x40, 57, 33)),
        (b"sw100005", state(0x04, 100, 5)),
        (b"sw005100", state(0x08, 5, 100)),
        (b"sp130130", state(0x30, 130, 130)),
        (b"e1a", pack_frame(ERR_FLAG | 0xA8, bytes((0, 0, 0, 0x19, 0, 0, 0, 0)))),
        (b"e3Obc", pack_frame(ERR_FLAG | 0x8C, bytes((0, 2, 8, 8, 0, 0, 0, 0)))),
        (b"e0", pack_frame(ERR_FLAG | 0x88, bytes(8))),
    ],
)
def test_report__lines_of_the_kernel_driver__both_ways(line, frame):
    assert decode_report(line) == frame
    assert encode_report(frame) == line + b"\r"


def test_decode_report__counters_above_a_byte__are_cut():
    assert decode_report(b"sb256256") == BUS_OFF
    assert decode_report(b"sp999001") == state(0x10, 255, 1)


@pytest.mark.parametrize(
    "line",
    [b"s", b"sa", b"sx000000", b"sa00000", b"sa0000000", b"sa+00 12", b"e", b"e1", b"e2a", b"e1x"],
)
def test_decode_report__malformed__is_none(line):
    assert decode_report(line) is None


def test_encode_report__controller_restarted__is_the_active_state():
    assert encode_report(pack_frame(ERR_FLAG | 0x100, bytes(8))) == b"sa000000\r"


@given(st.integers(0, 0x1FFF_FFFF), st.binary(min_size=8, max_size=8))
def test_encode_report__any_report__comes_back_as_one(can_id, data):
    line = encode_report(pack_frame(ERR_FLAG | can_id, data))
    decoded = decode_report(line[:-1])
    assert decoded is not None
    assert unpack_frame(decoded)[0] & ERR_FLAG


@pytest.mark.parametrize("line", [b"F", b"F0", b"F000", b"FGG", b"V00", b""])
def test_decode_status__no_answer_to_f__is_none(line):
    assert decode_status(line) is None


def test_decode_status__flags__are_named():
    assert decode_status(b"F84") == StatusFlags.BUS_ERROR | StatusFlags.ERROR_WARNING


# --- lines


@given(st.lists(frames, max_size=20), st.data())
def test_splitter__stream_cut_anywhere__gives_the_same_lines(sent, data):
    stream = b"".join(encode_frame(frame) for frame in sent)
    splitter, received = LineSplitter(), []
    while stream:
        size = data.draw(st.integers(1, len(stream)))
        received += [decode_frame(line) for line in splitter.feed(stream[:size])]
        stream = stream[size:]
    assert received == sent
    assert splitter.overlong == 0


def test_splitter__refusals_between_lines__end_them_too():
    splitter = LineSplitter()
    assert splitter.feed(b"\a\ad12\at1230\r\a") == [b"\a", b"\a", b"d12\a", b"t1230", b"\a"]


@pytest.mark.parametrize("pieces", [[1000], [20, 20, 960], [1] * 1000])
def test_splitter__line_without_end__is_dropped_once_then_goes_on(pieces):
    splitter, lines = LineSplitter(), []
    for size in pieces:
        lines += splitter.feed(b"x" * size)
    assert (lines, splitter.overlong) == ([], 1)
    assert splitter.feed(b"xx\rt1230\r") == [b"t1230"]
    assert splitter.feed(b"t4560\r") == [b"t4560"]
    assert splitter.overlong == 1


def test_splitter__reset__forgets_the_line_begun():
    splitter = LineSplitter()
    splitter.feed(b"t12")
    splitter.reset()
    assert splitter.feed(b"t1230\r") == [b"t1230"]
