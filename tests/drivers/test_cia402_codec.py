"""Golden frames, vendors' and by hand from CiA 301 and 402; round trips, and hostile bytes."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.cia402 import codec, sdo
from drivers.cia402.codec import Cia402State, Index, NmtCommand, NmtState
from drivers.cia402.sdo import SdoAbort, SdoFrame, SdoKind
from drivers.frame import pack_frame, unpack_frame

VENDORS = Path(__file__).parent / "golden" / "cia402_vendor.txt"
NODE = 1
SDO_RX, SDO_TX = codec.COB_SDO_RX + NODE, codec.COB_SDO_TX + NODE
WIRE_BYTES = st.binary(max_size=8)
INDICES = st.integers(0, 0xFFFF)
SUBINDICES = st.integers(0, 0xFF)
TOGGLES = st.integers(0, 1)

# candump notation, identifier#data; byte by byte from the command specifiers in 7.2.4.3.
GOLDEN_FRAMES = [
    ("000#0101", codec.COB_NMT, codec.pack_nmt(NmtCommand.START, NODE)),
    ("000#8000", codec.COB_NMT, codec.pack_nmt(NmtCommand.ENTER_PRE_OPERATIONAL, 0)),
    ("000#8105", codec.COB_NMT, codec.pack_nmt(NmtCommand.RESET_NODE, 5)),
    ("701#00", codec.COB_HEARTBEAT + NODE, codec.pack_heartbeat(NmtState.INITIALISING)),
    ("701#7F", codec.COB_HEARTBEAT + NODE, codec.pack_heartbeat(NmtState.PRE_OPERATIONAL)),
    ("701#05", codec.COB_HEARTBEAT + NODE, codec.pack_heartbeat(NmtState.OPERATIONAL)),
    ("080#", codec.COB_SYNC, b""),
    ("081#5082110000000000", codec.COB_EMCY + NODE, codec.pack_emcy(0x8250, 0x11)),
    ("081#0000000000000000", codec.COB_EMCY + NODE, codec.pack_emcy(0, 0)),
    ("201#0F00E803", codec.COB_RPDO1 + NODE, codec.RPDO1.pack(0x0F, 1000)),
    ("201#06009CFF", codec.COB_RPDO1 + NODE, codec.RPDO1.pack(0x06, -100)),
    ("181#3712FF0F00000CFE", codec.COB_TPDO1 + NODE, codec.TPDO1.pack(0x1237, 4095, -500)),
    ("281#FEFFFFFF6400", codec.COB_TPDO2 + NODE, codec.TPDO2.pack(-2, 100)),
    # write 6060 = 10, one byte: 2F = download, expedited, size given, 3 bytes unused
    ("601#2F6060000A000000", SDO_RX, sdo.sdo_download_request(0x6060, 0, b"\x0a")),
    ("601#2B171000F4010000", SDO_RX, sdo.sdo_download_request(0x1017, 0, codec.U16.pack(500))),
    (
        "601#2300140101020080",
        SDO_RX,
        sdo.sdo_download_request(0x1400, 1, codec.U32.pack(0x80000201)),
    ),
    (
        "601#2300160110004060",
        SDO_RX,
        sdo.sdo_download_request(0x1600, 1, codec.U32.pack(codec.RPDO1_MAP[0])),
    ),
    ("581#6060600000000000", SDO_TX, sdo.sdo_download_response(0x6060, 0)),
    ("601#4041600000000000", SDO_RX, sdo.sdo_upload_request(0x6041, 0)),
    ("581#4B41600037120000", SDO_TX, sdo.sdo_upload_response(0x6041, 0, b"\x37\x12")),
    ("581#4F6160000A000000", SDO_TX, sdo.sdo_upload_response(0x6061, 0, b"\x0a")),
    ("581#4300100092010200", SDO_TX, sdo.sdo_upload_response(0x1000, 0, codec.U32.pack(0x20192))),
    # segmented upload of "hil emulated drive": 18 bytes announced, 7 + 7 + 4
    ("581#4108100012000000", SDO_TX, sdo.sdo_upload_response(0x1008, 0, b"hil emulated drive")),
    ("601#6000000000000000", SDO_RX, sdo.sdo_upload_segment_request(0)),
    ("581#0068696C20656D75", SDO_TX, sdo.sdo_upload_segment_response(0, b"hil emu", is_last=False)),
    ("601#7000000000000000", SDO_RX, sdo.sdo_upload_segment_request(1)),
    ("581#106C617465642064", SDO_TX, sdo.sdo_upload_segment_response(1, b"lated d", is_last=False)),
    ("581#0772697665000000", SDO_TX, sdo.sdo_upload_segment_response(0, b"rive", is_last=True)),
    # segmented download of 9 bytes, 7 + 2
    ("601#2101200009000000", SDO_RX, sdo.sdo_download_request(0x2001, 0, b"123456789")),
    (
        "601#0031323334353637",
        SDO_RX,
        sdo.sdo_download_segment_request(0, b"1234567", is_last=False),
    ),
    ("581#2000000000000000", SDO_TX, sdo.sdo_download_segment_response(0)),
    ("601#1B38390000000000", SDO_RX, sdo.sdo_download_segment_request(1, b"89", is_last=True)),
    ("581#3000000000000000", SDO_TX, sdo.sdo_download_segment_response(1)),
    ("581#8060600030000906", SDO_TX, sdo.sdo_abort(0x6060, 0, SdoAbort.VALUE_RANGE)),
]


@pytest.mark.parametrize(("notation", "can_id", "data"), GOLDEN_FRAMES, ids=str)
def test_codec__packed__equals_golden_frame(notation, can_id, data):
    identifier, _, payload = notation.partition("#")
    assert pack_frame(can_id, data) == pack_frame(int(identifier, 16), bytes.fromhex(payload))


def vendor_frames():
    """(identifier, data, kind, numbers) of each line of the vendors' file."""
    for line in VENDORS.read_text("ascii").splitlines():
        if line and not line.startswith(";"):
            frame, said, source = (part.strip() for part in line.split("|"))
            assert source.startswith("["), line
            identifier, _, payload = frame.partition("#")
            kind, *numbers = said.split()
            yield pytest.param(
                int(identifier, 16), bytes.fromhex(payload), kind,
                [int(number, 16) for number in numbers], id=line,
            )  # fmt: skip


SDO_MADE = {
    "read": sdo.sdo_upload_request,
    "done": sdo.sdo_download_response,
    "write": lambda i, s, size, v: sdo.sdo_download_request(i, s, v.to_bytes(size, "little")),
    "value": lambda i, s, size, v: sdo.sdo_upload_response(i, s, v.to_bytes(size, "little")),
}
SDO_KINDS = {"read": SdoKind.UPLOAD, "done": SdoKind.DOWNLOAD,
             "write": SdoKind.DOWNLOAD, "value": SdoKind.UPLOAD}  # fmt: skip


@pytest.mark.parametrize(("can_id", "data", "kind", "numbers"), list(vendor_frames()))
def test_codec__frames_that_vendors_print__both_ways(can_id, data, kind, numbers):
    if kind in SDO_MADE:
        assert SDO_MADE[kind](*numbers) == data
        is_request = kind in ("read", "write")
        assert can_id & ~0x7F == (codec.COB_SDO_RX if is_request else codec.COB_SDO_TX)
        frame = (sdo.parse_sdo_request if is_request else sdo.parse_sdo_response)(data)
        assert (frame.kind, frame.index, frame.subindex) == (SDO_KINDS[kind], *numbers[:2])
        if len(numbers) > 2:
            assert frame.data == numbers[3].to_bytes(numbers[2], "little")
    elif kind == "nmt":
        assert (can_id, codec.parse_nmt(data)) == (codec.COB_NMT, tuple(numbers))
        assert codec.pack_nmt(NmtCommand(numbers[0]), numbers[1]) == data
    elif kind == "heartbeat":
        assert (can_id, codec.parse_heartbeat(data)) == (codec.COB_HEARTBEAT + NODE, numbers[0])
        assert codec.pack_heartbeat(NmtState(numbers[0])) == data
    else:
        code, register, vendor = *numbers[:2], bytes([numbers[2], 0, 0, 0, 0])
        assert (can_id, codec.parse_emcy(data)) == (codec.COB_EMCY + NODE, (code, register, vendor))
        assert codec.pack_emcy(code, register, vendor) == data


def test_codec__status_words_that_vendors_print__the_states_they_name():
    assert codec.decode_state(0x0240) is Cia402State.SWITCH_ON_DISABLED
    assert codec.decode_state(0x0233) is Cia402State.SWITCHED_ON


def test_mapping_words__as_written__equal_the_standard_layout():
    assert codec.RPDO1_MAP == (0x60400010, 0x60710010)
    assert codec.TPDO1_MAP == (0x60410010, 0x60640020, 0x60770010)
    assert codec.TPDO2_MAP == (0x606C0020, 0x60780010)
    assert codec.split_mapping_word(0x60640020) == (Index.POSITION_ACTUAL, 0, 32)
    assert codec.consumer_heartbeat(0x7F, 500) == 0x007F01F4


# --- statusword -------------------------------------------------------------------------------

# Patterns as CiA 402 prints them, x = don't care, bits 6..0 without bit 4.
STATUS_PATTERNS = {
    Cia402State.NOT_READY_TO_SWITCH_ON: "0xx0000",
    Cia402State.SWITCH_ON_DISABLED: "1xx0000",
    Cia402State.READY_TO_SWITCH_ON: "01x0001",
    Cia402State.SWITCHED_ON: "01x0011",
    Cia402State.OPERATION_ENABLED: "01x0111",
    Cia402State.QUICK_STOP_ACTIVE: "00x0111",
    Cia402State.FAULT_REACTION_ACTIVE: "0xx1111",
    Cia402State.FAULT: "0xx1000",
}


def state_by_pattern(statusword):
    bits = f"{statusword & 0x7F:07b}"
    fitting = [
        state
        for state, pattern in STATUS_PATTERNS.items()
        if all(p in ("x", b) for p, b in zip(pattern, bits, strict=True))
    ]
    assert len(fitting) <= 1
    return fitting[0] if fitting else None


def test_decode_state__every_statusword__follows_the_patterns():
    for statusword in range(0x10000):
        expected = state_by_pattern(statusword)
        decoded = codec.decode_state(statusword)
        if expected is None:  # undefined: never read as powered
            expected = Cia402State.FAULT if statusword & 8 else Cia402State.NOT_READY_TO_SWITCH_ON
        assert decoded is expected, f"{statusword:04X}"


@pytest.mark.parametrize("state", Cia402State)
def test_decode_state__state_value_with_other_bits__gives_the_state(state):
    assert codec.decode_state(state | 0x1A90) is state


# --- SDO --------------------------------------------------------------------------------------


@given(INDICES, SUBINDICES, st.binary(min_size=1, max_size=4))
def test_sdo__expedited__round_trips(index, subindex, data):
    expected = {"index": index, "subindex": subindex, "data": data, "is_expedited": True}
    request = sdo.parse_sdo_request(sdo.sdo_download_request(index, subindex, data))
    answer = sdo.parse_sdo_response(sdo.sdo_upload_response(index, subindex, data))
    assert request == SdoFrame(SdoKind.DOWNLOAD, size=len(data), **expected)
    assert answer == SdoFrame(SdoKind.UPLOAD, size=len(data), **expected)


@given(INDICES, SUBINDICES, st.binary(min_size=5, max_size=64))
def test_sdo__segmented_start__round_trips(index, subindex, data):
    request = sdo.parse_sdo_request(sdo.sdo_download_request(index, subindex, data))
    answer = sdo.parse_sdo_response(sdo.sdo_upload_response(index, subindex, data))
    assert request == SdoFrame(SdoKind.DOWNLOAD, index, subindex, size=len(data))
    assert answer == SdoFrame(SdoKind.UPLOAD, index, subindex, size=len(data))


@given(TOGGLES, st.binary(max_size=7), st.booleans())
def test_sdo__segment__round_trips(toggle, data, is_last):
    expected = {"data": data, "toggle": toggle, "is_last": is_last}
    request = sdo.sdo_download_segment_request(toggle, data, is_last=is_last)
    answer = sdo.sdo_upload_segment_response(toggle, data, is_last=is_last)
    assert sdo.parse_sdo_request(request) == SdoFrame(SdoKind.DOWNLOAD_SEGMENT, **expected)
    assert sdo.parse_sdo_response(answer) == SdoFrame(SdoKind.UPLOAD_SEGMENT, **expected)


@given(TOGGLES)
def test_sdo__segment_handshake__round_trips(toggle):
    request = sdo.parse_sdo_request(sdo.sdo_upload_segment_request(toggle))
    answer = sdo.parse_sdo_response(sdo.sdo_download_segment_response(toggle))
    assert request == SdoFrame(SdoKind.UPLOAD_SEGMENT, toggle=toggle)
    assert answer == SdoFrame(SdoKind.DOWNLOAD_SEGMENT, toggle=toggle)


@given(INDICES, SUBINDICES, st.integers(0, 0xFFFF_FFFF))
def test_sdo__abort__round_trips_both_ways(index, subindex, code):
    frame = sdo.sdo_abort(index, subindex, code)
    expected = SdoFrame(SdoKind.ABORT, index, subindex, abort_code=code)
    assert sdo.parse_sdo_request(frame) == expected
    assert sdo.parse_sdo_response(frame) == expected


def test_sdo__expedited_without_size__gives_four_bytes():
    frame = sdo.parse_sdo_request(bytes.fromhex("2E6060000A000000"))
    assert frame is not None
    assert frame.size is None
    assert frame.data == b"\x0a\0\0\0"


@pytest.mark.parametrize("code", SdoAbort)
def test_describe_abort__known_code__gives_number_and_text(code):
    assert sdo.describe_abort(code) == f"{int(code):08X} {code.text}"


def test_describe_abort__unknown_code__gives_number():
    assert sdo.describe_abort(0x12345678) == "12345678 unknown abort code"


# --- hostile bytes ----------------------------------------------------------------------------


@given(WIRE_BYTES)
def test_parsers__any_bytes__never_raise(data):
    for parse in (
        sdo.parse_sdo_request,
        sdo.parse_sdo_response,
        codec.parse_emcy,
        codec.parse_heartbeat,
        codec.parse_nmt,
    ):
        parse(data)


@given(st.binary(max_size=64).filter(lambda data: len(data) != 8))
def test_parse_sdo__not_eight_bytes__is_none(data):
    assert sdo.parse_sdo_request(data) is None
    assert sdo.parse_sdo_response(data) is None


@given(st.integers(0, 0xFFFF), st.integers(0, 0xFF), st.binary(max_size=5))
def test_emcy__round_trips_with_padded_vendor_bytes(code, register, vendor):
    parsed = codec.parse_emcy(codec.pack_emcy(code, register, vendor))
    assert parsed == (code, register, vendor.ljust(5, b"\0"))


@given(st.sampled_from(NmtCommand), st.integers(0, 127))
def test_nmt__round_trips(command, node_id):
    assert codec.parse_nmt(codec.pack_nmt(command, node_id)) == (command, node_id)


@given(st.integers(0, 0xFF))
def test_heartbeat__any_byte__is_a_known_state_or_none(byte):
    state = codec.parse_heartbeat(bytes((byte,)))
    assert state == (byte & 0x7F if byte & 0x7F in (0, 4, 5, 127) else None)


@given(st.integers(0, 0xFFFF), st.integers(-(2**31), 2**31 - 1), st.integers(-(2**15), 2**15 - 1))
def test_tpdo1__in_a_frame__round_trips(statusword, position, torque):
    frame = pack_frame(codec.COB_TPDO1 + NODE, codec.TPDO1.pack(statusword, position, torque))
    assert codec.TPDO1.unpack(unpack_frame(frame)[1]) == (statusword, position, torque)
