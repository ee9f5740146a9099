"""Frames in files: every format and back, foreign readers, broken files."""

import struct
import zlib

import can
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.frame import EFF_FLAG, ERR_FLAG, RTR_FLAG, pack_frame, unpack_frame
from drivers.frame_log import SUFFIXES, FrameLogError, FrameLogWriter, read_log

FRAMES = [
    (1000.0, pack_frame(0x181, b"12345678")),
    (1000.25, pack_frame(EFF_FLAG | 0x1ABCDE, b"\x01\x02")),
    (1000.5, pack_frame(0x080)),
    (1000.75, pack_frame(RTR_FLAG | 0x105)),
]
PLACE = st.floats(0.0, 1.0, exclude_max=True)
"""Part of the file before it: the length of an ASC file depends on the date."""
BYTE = st.integers(0, 255)
formats = pytest.mark.parametrize("suffix", SUFFIXES)


def written(path, frames):
    with FrameLogWriter(path, "hil0") as writer:
        for t_s, frame in frames:
            writer.write(frame, t_s)
    assert writer.frames == len(frames)
    return path


@formats
def test_log__written_and_read__same_frames_in_the_same_rhythm(tmp_path, suffix):
    read = list(read_log(written(tmp_path / f"x{suffix}", FRAMES)))
    assert [frame for _, frame in read] == [frame for _, frame in FRAMES]
    assert [t_s - read[0][0] for t_s, _ in read] == pytest.approx([0, 0.25, 0.5, 0.75], abs=1e-6)


@formats
def test_log__error_report__comes_back_as_one(tmp_path, suffix):
    path = written(tmp_path / f"x{suffix}", [(0.0, pack_frame(ERR_FLAG | 4, bytes(8)))])
    ((_, frame),) = read_log(path)
    assert unpack_frame(frame)[0] & ERR_FLAG


@formats
def test_log__read_by_python_can__messages_and_direction(tmp_path, suffix):
    path = tmp_path / f"x{suffix}"
    with FrameLogWriter(path, "hil0") as writer:
        writer.write(FRAMES[0][1], 1000.0, is_sent=True)
        writer.write(FRAMES[1][1], 1000.1)
    with can.LogReader(path) as reader:
        sent, received = reader
    assert (sent.arbitration_id, sent.is_extended_id) == (0x181, False)
    assert bytes(sent.data) == b"12345678"
    assert (received.arbitration_id, received.is_extended_id) == (0x1ABCDE, True)
    assert received.is_rx
    assert not sent.is_rx


@pytest.mark.parametrize("name", ["x", "x.txt", "x.csv", "x.log.gz"])
def test_log__another_suffix__refused_with_those_that_are(tmp_path, name):
    with pytest.raises(FrameLogError, match=r"\.log \(candump\), \.asc .* or \.blf"):
        FrameLogWriter(tmp_path / name)
    with pytest.raises(FrameLogError, match="suffix"):
        list(read_log(tmp_path / name))


@formats
def test_log__no_such_place__file_and_reason(tmp_path, suffix):
    path = tmp_path / "nowhere" / f"x{suffix}"
    for attempt in (lambda: FrameLogWriter(path), lambda: list(read_log(path))):
        with pytest.raises(FrameLogError, match=r"nowhere.*No such file or directory"):
            attempt()


@formats
@settings(max_examples=60, deadline=None)
@given(cut=st.floats(0.0, 1.0), changes=st.lists(st.tuples(PLACE, BYTE), max_size=3))
def test_log__damaged_file__frames_or_one_error(tmp_path_factory, suffix, cut, changes):
    """Cut short anywhere, or with bytes changed: what is left is read, or the file is refused."""
    path = written(tmp_path_factory.mktemp("log") / f"x{suffix}", FRAMES)
    content = bytearray(path.read_bytes())
    for place, value in changes:
        content[int(place * len(content))] = value
    path.write_bytes(content[: round(cut * len(content))])
    refusals = []
    try:
        assert all(len(frame) == 16 for _, frame in read_log(path))
    except FrameLogError as error:
        refusals.append(str(error))
    assert all(str(path) in text and "\n" not in text for text in refusals)


def test_log__blf_object_without_size__refused_instead_of_standing_still(tmp_path):
    """python-can's reader would look at the same object for ever."""
    path = written(tmp_path / "x.blf", FRAMES)
    content = path.read_bytes()
    start = content.index(b"LOBJ") + 32  # file header, then one container: its head and kind
    objects = bytearray(zlib.decompress(content[start:]))
    objects[6:12] = b"\x05\x00" + bytes(4)  # unknown version of the first object's head, no size
    container = zlib.compress(bytes(objects))
    head = bytearray(content[:start])
    struct.pack_into("<I", head, start - 24, 32 + len(container))
    path.write_bytes(bytes(head) + container + bytes(len(container) % 4))
    with pytest.raises(FrameLogError, match="an object of 0 bytes"):
        list(read_log(path))


def test_close__twice__nothing_happens(tmp_path):
    writer = FrameLogWriter(tmp_path / "x.asc")
    writer.close()
    writer.close()
