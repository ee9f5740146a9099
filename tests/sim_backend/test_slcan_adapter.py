"""What an emulated LAWICEL adapter answers, command by command and state by state."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.buses.slcan_codec import StatusFlags, encode_frame
from drivers.frame import EFF_FLAG, ERR_FLAG, FRAME_SIZE, pack_frame
from sim_backend.slcan_adapter import OK, REFUSED, SlcanAdapter

FRAME = pack_frame(0x181, b"\x01\x02")
LINE = b"t18120102"
WIDE_LINE = b"T0000018120102"


def take(adapter, *lines):
    return [adapter.take(line)[0] for line in lines]


def opened(command=b"O", **options):
    adapter = SlcanAdapter(**options)
    assert take(adapter, b"S8", command) == [OK, OK]
    return adapter


@pytest.mark.parametrize(
    ("line", "closed", "open_"),
    [
        (b"", OK, OK),
        (b"C", REFUSED, OK),
        (b"O", REFUSED, REFUSED),  # closed: no bit rate yet
        (b"L", REFUSED, REFUSED),
        (b"S0", OK, REFUSED),
        (b"S8", OK, REFUSED),
        (b"S9", REFUSED, REFUSED),
        (b"S", REFUSED, REFUSED),
        (b"s031C", OK, REFUSED),
        (b"s03", REFUSED, REFUSED),
        (b"Z1", OK, REFUSED),
        (b"Z2", REFUSED, REFUSED),
        (b"X1", OK, REFUSED),
        (b"X0", REFUSED, REFUSED),
        (b"F", REFUSED, b"F00\r"),
        (b"V", b"V1013\r", b"V1013\r"),
        (b"N", b"NHIL1\r", b"NHIL1\r"),
        (LINE, REFUSED, b""),
        (b"t181", REFUSED, REFUSED),
        (b"\xff\x00", REFUSED, REFUSED),
        (b"C\a", REFUSED, REFUSED),
    ],
)
def test_take__each_command__is_answered_by_the_channels_state(line, closed, open_):
    assert take(SlcanAdapter(), line) == [closed]
    assert take(opened(), line) == [open_]


def test_take__frame__reaches_the_wire_only_through_the_open_channel():
    adapter = opened()
    assert adapter.take(LINE) == (b"", FRAME)
    assert take(adapter, b"C") == [OK]
    assert adapter.take(LINE) == (REFUSED, None)
    assert take(adapter, b"O") == [OK], "the bit rate is remembered"
    assert adapter.take(LINE) == (b"", FRAME)
    assert adapter.refusals == 1


def test_take__frame_with_acknowledgements__is_answered_by_its_kind():
    adapter = opened(has_acks=True)
    assert adapter.take(LINE) == (b"z\r", FRAME)
    assert adapter.take(WIDE_LINE) == (b"Z\r", pack_frame(0x181 | EFF_FLAG, b"\x01\x02"))
    assert adapter.take(LINE + b"0") == (REFUSED, None)


def test_take__frame_while_listening__is_refused():
    adapter = opened(b"L")
    assert adapter.is_open
    assert adapter.take(LINE) == (REFUSED, None)


def test_hang_up__channel_and_settings_are_gone():
    adapter = opened()
    take(adapter, b"C", b"Z1", b"O")
    assert adapter.has_timestamps
    adapter.hang_up()
    assert not adapter.is_open
    assert not adapter.has_timestamps
    assert take(adapter, b"O") == [REFUSED]


@pytest.mark.parametrize(
    ("can_id", "control", "flags"),
    [
        (0x40, 0, StatusFlags.ERROR_PASSIVE),
        (0x04, 0x20, StatusFlags.ERROR_PASSIVE),
        (0x04, 0x08, StatusFlags.ERROR_WARNING),
        (0x04, 0x01, StatusFlags.DATA_OVERRUN),
        (0x08, 0xFF, StatusFlags.BUS_ERROR),
        (0x80, 0, StatusFlags.BUS_ERROR),
        (0x100, 0xFF, StatusFlags(0)),
    ],
)
def test_flags__after_an_error_report__are_read_once(can_id, control, flags):
    adapter = opened()
    adapter.note_report(pack_frame(ERR_FLAG | can_id, bytes((0, control, 0, 0, 0, 0, 0, 0))))
    assert take(adapter, b"F", b"F") == [b"F%02X\r" % flags, b"F00\r"]


commands = st.sampled_from(
    [b"", b"C", b"O", b"L", b"S8", b"s031C", b"Z0", b"Z1", b"F", b"V", b"N", LINE, WIDE_LINE]
)
anything = commands | st.binary(max_size=31)


@given(st.lists(anything, max_size=30), st.booleans())
def test_take__any_commands_in_any_order__channel_stays_legal(lines, has_acks):
    adapter = SlcanAdapter(has_acks=has_acks)
    is_set = False
    for line in lines:
        was_open = adapter.is_open
        answer, frame = adapter.take(line)
        is_set |= line in (b"S8", b"s031C") and answer == OK
        assert answer.endswith((OK, REFUSED)) or (frame is not None and not has_acks)
        assert not (adapter.is_open and not is_set)
        assert adapter.is_open == was_open or line in (b"O", b"L", b"C")
        if frame is not None:
            assert was_open
            assert len(frame) == FRAME_SIZE
            assert encode_frame(frame)[:-1] == line[:1] + line[1:].upper()
