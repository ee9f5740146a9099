"""MIT-mode bytes: the vendors' frames both ways, round trips, and whatever else comes."""

import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.frame import EFF_FLAG, EFF_MASK
from drivers.mit import codec, robstride_codec
from drivers.mit.codec import Codes, Feedback, Ranges, RegisterCommand, Setpoint
from drivers.mit.robstride_codec import Status, Type

GOLDEN = Path(__file__).parent / "golden" / "mit_vendor.txt"
SPECIAL = {
    "enable": codec.ENABLE,
    "disable": codec.DISABLE,
    "zero": codec.SET_ZERO,
    "clear": codec.CLEAR_FAULT,
}
COMMANDS = {command.name.lower(): command for command in RegisterCommand}


def golden(*kinds):
    """(value, identifier, data) of each line of these kinds; every line names its source."""
    found = []
    for line in GOLDEN.read_text().splitlines():
        if not line.strip() or line.startswith(";"):
            continue
        kind, value, frame, source = (part.strip() for part in line.split("|", 3))
        assert source, line
        if kind in kinds:
            can_id, _, data = frame.partition("#")
            flag = EFF_FLAG if len(can_id) == 8 else 0
            found.append(pytest.param(value, int(can_id, 16) | flag, bytes.fromhex(data), id=line))
    assert found
    return found


def numbers(text, base=16):
    return [int(word, base) for word in text.split()]


def setpoint_of(text):
    values, _, ranges = text.partition("/")
    return Setpoint(*map(float, values.split())), Ranges(*map(float, ranges.split()))


# --- the vendors' frames --------------------------------------------------------------------------


@pytest.mark.parametrize("kind", SPECIAL)
def test_special__golden__known(kind):
    ((_, _, data),) = [param.values for param in golden(kind)]
    assert data == SPECIAL[kind]
    assert codec.parse_command(data) is None


@pytest.mark.parametrize(("value", "can_id", "data"), golden("setpoint"))
def test_setpoint__golden__both_ways(value, can_id, data):
    setpoint, ranges = setpoint_of(value)
    assert codec.pack_setpoint(setpoint, ranges) == data
    if data[:7] != codec.SPECIAL_HEAD:
        parsed = codec.to_setpoint(codec.parse_command(data), ranges)
        assert tuple(parsed) == pytest.approx(tuple(setpoint), abs=0.02)


@pytest.mark.parametrize(("value", "can_id", "data"), golden("truncated"))
def test_setpoint__vendors_sample_that_truncates__within_one_code_both_ways(value, can_id, data):
    setpoint, ranges = setpoint_of(value)
    vendors = codec.parse_command(data)
    ours = codec.parse_command(codec.pack_setpoint(setpoint, ranges))
    assert all(0 <= mine - theirs <= 1 for mine, theirs in zip(ours, vendors, strict=True))
    read = codec.to_setpoint(vendors, ranges)
    spans = (*ranges[:2], ranges.kp_Nm_rad / 2, ranges.kd_Nms_rad / 2, ranges.torque_Nm)
    steps = [2.0 * span / (0xFFFF if k == 0 else 0xFFF) for k, span in enumerate(spans)]
    assert all(0 <= want - got <= step * 1.001
               for want, got, step in zip(setpoint, read, steps, strict=True))  # fmt: skip


@pytest.mark.parametrize(("value", "can_id", "data"), golden("feedback6", "feedback8"))
def test_feedback__golden__both_ways(value, can_id, data):
    head, p, v, t, *tail = numbers(value)
    feedback = Feedback(head, p, v, t, tuple(tail) or (0, 0))
    assert codec.pack_feedback(feedback, len(data)) == data
    assert codec.parse_feedback(data) == feedback


@pytest.mark.parametrize(("value", "can_id", "data"), golden("register"))
def test_register__golden__both_ways(value, can_id, data):
    node, command, register, content = value.split()
    raw = codec.U32.pack(int(content, 16))
    assert can_id == codec.REGISTER_ID
    assert codec.pack_register(int(node), COMMANDS[command], int(register), raw) == data
    assert codec.parse_register(data) == (int(node), COMMANDS[command], int(register), raw)


@pytest.mark.parametrize(("value", "can_id", "data"), golden("wide"))
def test_wide_identifier__golden__both_ways(value, can_id, data):
    kind, content, target = numbers(value)
    assert robstride_codec.pack_id(kind, content, target) == can_id
    assert robstride_codec.parse_id(can_id) == (kind, content, target)


@pytest.mark.parametrize(("value", "can_id", "data"), golden("control"))
def test_wide_control__golden__both_ways(value, can_id, data):
    setpoint, r = setpoint_of(value)
    codes = Codes(
        codec.to_code(setpoint.position_rad, r.position_rad, 0xFFFF),
        codec.to_code(setpoint.velocity_rad_s, r.velocity_rad_s, 0xFFFF),
        codec.gain_to_code(setpoint.kp_Nm_rad, r.kp_Nm_rad, 0xFFFF),
        codec.gain_to_code(setpoint.kd_Nms_rad, r.kd_Nms_rad, 0xFFFF),
        codec.to_code(setpoint.torque_Nm, r.torque_Nm, 0xFFFF),
    )
    assert robstride_codec.pack_control(can_id & 0xFF, codes) == (can_id, data)
    identifier = robstride_codec.parse_id(can_id)
    assert robstride_codec.parse_control(identifier, data) == codes
    found = codec.to_setpoint(codes, r, wide=True)
    assert tuple(found) == pytest.approx(tuple(setpoint), abs=0.001)


@pytest.mark.parametrize(("value", "can_id", "data"), golden("status"))
def test_wide_status__golden__both_ways(value, can_id, data):
    status = Status(*numbers(value))
    assert robstride_codec.feedback_id(status, can_id & 0xFF) == can_id
    assert robstride_codec.parse_status(robstride_codec.parse_id(can_id).data) == status
    assert robstride_codec.FEEDBACK.unpack(data) == (0x7FFF, 0x7FFF, 0x7FFF, 300)


@pytest.mark.parametrize(("value", "can_id", "data"), golden("parameter"))
def test_parameter__golden__both_ways(value, can_id, data):
    index, content = numbers(value)
    raw = robstride_codec.U32.pack(content)
    assert robstride_codec.parse_id(can_id).type in (Type.READ, Type.WRITE)
    assert robstride_codec.pack_parameter(index, raw) == data
    assert robstride_codec.parse_parameter(data) == (index, raw)


# --- properties -----------------------------------------------------------------------------------

U16, U12 = st.integers(0, 0xFFFF), st.integers(0, 0xFFF)
SPANS = st.floats(1e-3, 1e4)


@given(st.builds(Codes, U16, U12, U12, U12, U12))
def test_command__any_codes__round_trip_unless_they_spell_a_special_frame(codes):
    data = codec.pack_codes(codes)
    assert len(data) == 8
    expected = None if data.startswith(codec.SPECIAL_HEAD) else codes
    assert codec.parse_command(data) == expected


@given(st.builds(Codes, st.just(0x7FFF), st.just(0x7FF), st.just(0), st.just(0), U12))
def test_command__torque_alone__never_spells_a_special_frame(codes):
    data = codec.pack_codes(codes)
    assert not data.startswith(codec.SPECIAL_HEAD)
    assert data[6:] == codes.torque.to_bytes(2, "big")


@given(
    st.builds(Feedback, st.integers(0, 255), U16, U12, U12, st.tuples(*[st.integers(0, 255)] * 2))
)
def test_feedback__any__round_trip(feedback):
    assert codec.parse_feedback(codec.pack_feedback(feedback)) == feedback
    short = codec.parse_feedback(codec.pack_feedback(feedback, 6))
    assert short == feedback._replace(tail=(0, 0))


@given(st.floats(), SPANS, st.sampled_from([0xFFF, 0xFFFF]))
def test_to_code__any_number__nearest_code_or_the_ranges_end(value, span, codes):
    code = codec.to_code(value, span, codes)
    assert 0 <= code <= codes
    back = codec.to_value(code, span, codes)
    if math.isnan(value):
        assert code == codes // 2
    elif value >= span:
        assert code == codes
    elif value <= -span:
        assert code == 0
    else:
        assert abs(back - value) <= span / codes * (1 + 1e-9)


@given(SPANS, st.sampled_from([0xFFF, 0xFFFF]))
def test_to_code__zero__half_a_step_below_it(span, codes):
    code = codec.to_code(0.0, span, codes)
    assert code == codes // 2
    assert codec.to_value(code, span, codes) == pytest.approx(-span / codes, rel=1e-6)


@given(st.floats(1e-2, 1.0), SPANS, st.sampled_from([0xFFF, 0xFFFF]))
def test_torque_codes_within__any_maximum__the_last_ones_below_it(share, span, codes):
    maximum = share * span
    low, high = codec.torque_codes_within(maximum, span, codes)
    assert low == codes - high
    assert codec.to_value(high, span, codes) <= maximum * (1 + 1e-9)
    assert high == codes or codec.to_value(high + 1, span, codes) > maximum * (1 - 1e-9)


@given(st.binary(max_size=64))
def test_parsers__any_bytes__a_value_or_none(data):
    for parse in (
        codec.parse_command,
        codec.parse_feedback,
        codec.parse_register,
        robstride_codec.parse_parameter,
    ):
        parse(data)
    identifier = robstride_codec.Identifier(1, 2, 3)
    assert (robstride_codec.parse_control(identifier, data) is None) == (len(data) != 8)


@given(st.integers(0, 0x1F), U16, st.integers(0, 255))
def test_wide_identifier__any__round_trip(kind, data, target):
    can_id = robstride_codec.pack_id(kind, data, target)
    assert can_id == EFF_FLAG | can_id & EFF_MASK
    assert robstride_codec.parse_id(can_id) == (kind, data, target)
    assert robstride_codec.parse_id(can_id & EFF_MASK) is None


@given(st.integers(0, 0xFF), st.integers(0, 3), st.integers(0, 63), st.integers(0, 255))
def test_wide_status__any__round_trip(node, mode, faults, host):
    status = Status(node, mode, faults)
    identifier = robstride_codec.parse_id(robstride_codec.feedback_id(status, host))
    assert robstride_codec.parse_status(identifier.data) == status


def test_fault_names__some_bits__named_and_the_others_numbered():
    assert robstride_codec.fault_names(0b100010, robstride_codec.FAULTS) == (
        "over current, not calibrated"
    )
    assert robstride_codec.fault_names(1 << 30, robstride_codec.REPORTED_FAULTS) == "bit 30"
