"""Golden frames of the vendor, round trips, and hostile bytes."""

import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.frame import EFF_FLAG, FD_LENGTHS
from drivers.moteus import codec
from drivers.moteus.codec import READ, REPLY, WRITE, Subframe
from drivers.moteus.registers import (
    INTEGER,
    POSITION,
    TORQUE,
    Mode,
    Register,
    Resolution,
    decode_value,
    encode_value,
)

GOLDEN = Path(__file__).parent / "golden" / "moteus_vendor.txt"
RESOLUTIONS = {"int8": 0, "int16": 1, "int32": 2, "float": 3}


def golden(direction):
    for line in GOLDEN.read_text().splitlines():
        if line and not line.startswith(";"):
            way, data, said, source = (part.strip() for part in line.split("|"))
            if way == direction:
                yield pytest.param(bytes.fromhex(data), said, id=source)


def told(said):
    """Subframes that a line of the golden file names, and their bytes by our codec."""
    for part in filter(None, said.split(", ")):
        verb, number, *rest = part.split(" ", 2)
        register = int(number)
        if verb == "w":
            name, *values = rest[0].split()
            numbers = tuple(float(value) for value in values)
            yield (
                Subframe(WRITE, register, RESOLUTIONS[name], numbers),
                codec.pack_values(WRITE, register, RESOLUTIONS[name], *numbers),
            )
        elif verb == "r":
            name, count = rest[0].split()
            yield (
                Subframe(READ, register, RESOLUTIONS[name], wanted=int(count)),
                codec.pack_head(READ, register, RESOLUTIONS[name], int(count)),
            )
        elif verb == "poll":
            poll = Subframe(codec.CLIENT_POLL, register, wanted=int(rest[0]))
            yield poll, bytes((codec.CLIENT_POLL, register, int(rest[0])))
        else:
            kind = codec.CLIENT_DATA if verb == "send" else codec.SERVER_DATA
            text = rest[0].encode()
            yield Subframe(kind, register, data=text), codec.pack_stream(kind, register, text)


def same(found, wanted):
    """Equal, NaN to NaN, floats as 32 bits hold them."""
    return found._replace(values=()) == wanted._replace(values=()) and found.values == (
        pytest.approx(wanted.values, rel=1e-6, nan_ok=True)
    )


@pytest.mark.parametrize(("data", "said"), list(golden("to")))
def test_golden__frame_to_the_controller__is_parsed_and_made(data, said):
    wanted = list(told(said))
    found, is_malformed = codec.parse_subframes(data)
    assert not is_malformed
    assert all(same(*pair) for pair in zip(found, [w for w, _ in wanted], strict=True))
    assert b"".join(made for _, made in wanted) == data


@pytest.mark.parametrize(("data", "said"), list(golden("from")))
def test_golden__frame_from_the_controller__has_these_values(data, said):
    if said.startswith("text"):
        ((wanted, made),) = told(said)
        assert codec.parse_subframes(data) == ([wanted], False)
        assert made == data
        return
    values = dict(pair.split("=") for pair in said.split())
    expected = {int(register): pytest.approx(float(v)) for register, v in values.items()}
    assert codec.parse_replies(data) == expected


def test_golden__file__whole():
    assert (len(list(golden("to"))), len(list(golden("from")))) == (18, 6)


@pytest.mark.parametrize(
    ("can_id", "made"),
    [
        (EFF_FLAG | 0x8001, codec.request_id(1)),  # can.md, "CAN ID"
        (0x100, codec.request_id(0, 1, wants_reply=False)),
        (0x100, codec.reply_id(1)),
        (0x700, codec.reply_id(7)),
        (EFF_FLAG | 0x800, codec.reply_id(8)),
        (EFF_FLAG | 0x0005_0203, codec.reply_id(2, 3, prefix=5)),
        (EFF_FLAG | 0x1FFF_FF7E, codec.request_id(126, 0x7F, prefix=0x1FFF)),
    ],
)
def test_identifier__each_kind__as_documented(can_id, made):
    assert made == can_id


@given(st.integers(0, 0x1FFF), st.integers(0, 0x7F), st.integers(0, 0x7F))
def test_identifier__split__is_the_same(prefix, source, node):
    can_id = codec.request_id(node, source, prefix=prefix)
    assert codec.split_id(can_id) == (prefix, source | 0x80, node)
    assert codec.split_id(codec.reply_id(node, source, prefix=prefix)) == (prefix, node, source)


REGISTERS = st.integers(0, 0x7FFF)
INTEGERS = [st.integers(-(1 << 8 * n - 1), (1 << 8 * n - 1) - 1) for n in (1, 2, 4)]
NUMBERS = st.one_of(
    *(
        st.tuples(st.just(r), st.lists(INTEGERS[r], min_size=1, max_size=8))
        for r in (Resolution.INT8, Resolution.INT16, Resolution.INT32)
    ),
    st.tuples(st.just(Resolution.FLOAT), st.lists(st.floats(width=32), min_size=1, max_size=8)),
)


@given(st.sampled_from([WRITE, REPLY]), REGISTERS, NUMBERS)
def test_values__packed_and_parsed__are_the_same(kind, register, numbers):
    resolution, values = numbers
    data = codec.pack_values(kind, register, resolution, *values)
    (found,), is_malformed = codec.parse_subframes(data + bytes((codec.NOP,)) * 3)
    assert not is_malformed
    assert same(found, Subframe(kind, register, resolution, tuple(values)))


@given(st.integers(0, 2**32 - 1))
def test_varuint__any_32_bits__round_trip(value):
    data = codec.varuint(value)
    assert codec.read_varuint(data, 0) == (value, len(data))
    assert codec.read_varuint(data[:-1], 0) is None


@given(st.binary(max_size=64))
def test_parse__any_bytes__subframes_and_no_exception(data):
    found, is_malformed = codec.parse_subframes(data)
    assert isinstance(is_malformed, bool)
    assert all(isinstance(part, Subframe) for part in found)
    codec.parse_replies(data)


CUT = ("0a", "01", "0100", "0c", "0c04", "1c", "30", "3002", "400105aa", "42", "808080808001", "99")


@pytest.mark.parametrize("data", CUT)
def test_parse__cut_or_unknown__what_stood_before_counts(data):
    parts, is_malformed = codec.parse_subframes(bytes.fromhex("1100" + data))
    assert is_malformed
    assert parts == [Subframe(READ, 0, 0, wanted=1)]


@pytest.mark.parametrize(
    ("value", "resolution", "number"),
    [
        (1.0, Resolution.INT8, 100),
        (-1.0, Resolution.INT16, -10000),
        (5.0, Resolution.INT8, 127),
        (-5.0, Resolution.INT8, -127),
        (math.nan, Resolution.INT8, -128),
        (math.inf, Resolution.INT32, -(2**31)),
        (0.25, Resolution.FLOAT, 0.25),
    ],
)
def test_encode_value__position__scaled_saturated_nan_as_the_lowest(value, resolution, number):
    assert encode_value(value, POSITION, resolution) == number
    back = decode_value(number, POSITION, resolution)
    if not math.isfinite(value):
        assert math.isnan(back)
    elif abs(value) <= 1.0:
        assert back == pytest.approx(value)


def test_decode_value__lowest_integer_of_no_quantity__is_itself():
    assert decode_value(-(2**31), INTEGER, Resolution.INT32) == -(2**31)


@given(st.integers(0, 64))
def test_pad__any_length__a_length_that_exists_filled_with_nops(length):
    padded = codec.pad(bytes(length))
    assert len(padded) in FD_LENGTHS
    assert codec.parse_subframes(padded[length:]) == ([], False)


@given(st.floats(-300.0, 300.0), st.floats(0.01, 327.0), st.integers(2, 1000))
def test_torque_frame__any_torque__says_torque_alone_and_its_watchdog(tau_Nm, max_Nm, timeout_ms):
    before, after = codec.torque_frame_parts(max_Nm, timeout_ms * 1e-3)
    data = before + codec.VALUE[Resolution.FLOAT].pack(tau_Nm) + after
    assert len(data) == codec.TORQUE_LENGTH
    parts, is_malformed = codec.parse_subframes(data)
    assert not is_malformed
    written = {}
    for part in parts:
        if part.kind == WRITE:
            written |= dict(enumerate(part.values, start=part.number))
    assert parts[0] == Subframe(WRITE, Register.MODE, Resolution.INT8, (Mode.POSITION,))
    assert written[Register.COMMAND_TORQUE] == pytest.approx(tau_Nm, rel=1e-6)
    assert written[Register.COMMAND_POSITION] == -128, "none"
    limit_Nm = written[Register.COMMAND_MAX_TORQUE] * TORQUE[Resolution.INT16]
    assert max_Nm - 1e-6 <= limit_Nm <= max_Nm + 0.01
    assert written[Register.COMMAND_TIMEOUT] == timeout_ms
    for register in ("VELOCITY", "KP_SCALE", "KD_SCALE", "ILIMIT_SCALE"):
        assert written[Register[f"COMMAND_{register}"]] == 0
    assert [part for part in parts if part.kind == READ] == [
        Subframe(READ, Register.MODE, Resolution.INT8, wanted=1),
        Subframe(READ, Register.POSITION, Resolution.FLOAT, wanted=3),
    ]


def test_stop__parsed__mode_0_and_the_query_of_a_poll():
    stop, poll = codec.parse_subframes(codec.STOP)[0], codec.parse_subframes(codec.POLL)[0]
    assert stop == [Subframe(WRITE, Register.MODE, Resolution.INT8, (Mode.STOPPED,)), *poll]
