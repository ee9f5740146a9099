"""CANSimple: the vendor's frames both ways, round trips, and a DBC that is not ours."""

import json
import math
import re
import struct
from importlib.resources import files
from pathlib import Path

import cantools
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.errors import AmplifierError
from drivers.odrive import codec, endpoints
from drivers.odrive.codec import Address, Command, Heartbeat, Sdo, Version
from drivers.odrive.endpoints import EMULATED, Endpoint, EndpointTable, load_endpoints

GOLDEN = Path(__file__).parent / "golden" / "odrive_vendor.txt"
LINE = re.compile(r"([0-9A-F]{3})#(R|[0-9A-F]*) +; (.+?)  +\[")
DBC = cantools.database.load_file(
    str(files("odrive_can").joinpath("dbc", "odrive-cansimple-0.6.10.dbc"))
)
U8 = st.integers(0, 0xFF)
U32 = st.integers(0, 0xFFFF_FFFF)
F32 = st.floats(width=32, allow_nan=False)
BYTES = st.binary(max_size=8)


def golden():
    """(node, command, data, words) of every frame of the vendor's."""
    for line in GOLDEN.read_text(encoding="ascii").splitlines():
        if found := LINE.match(line):
            can_id, data = int(found[1], 16), found[2]
            payload = b"" if data == "R" else bytes.fromhex(data)
            yield pytest.param(can_id >> 5, can_id & 31, payload, found[3].split(), id=line[:28])


def versions(text):
    return tuple(int(part) for part in text.split("."))


def _floats(*words):
    return codec.F32_PAIR.pack(*map(float, words))


def _sdo(opcode, endpoint, value=None):
    data = b"" if value is None else codec.F32.pack(float(value))
    return codec.pack_sdo(Sdo(opcode, int(endpoint), data))


def _beat(errors, state, result, done):
    return codec.pack_heartbeat(Heartbeat(int(errors, 0), int(state), int(result), done == "1"))


def _version(protocol, hardware, firmware, unreleased):
    numbers = (int(protocol), versions(hardware), versions(firmware), unreleased == "1")
    return codec.pack_version(Version(*numbers))


TOLD = {  # what a golden frame says -> its command, and how our codec packs the words after it
    "axis_state": (Command.AXIS_STATE, lambda state: codec.U32.pack(int(state))),
    "mode": (Command.CONTROLLER_MODE, lambda a, b: codec.U32_PAIR.pack(int(a), int(b))),
    "torque": (Command.INPUT_TORQUE, lambda torque: codec.F32.pack(float(torque))),
    "position": (Command.INPUT_POS, lambda position: codec.F32.pack(float(position)) + bytes(4)),
    "velocity": (Command.INPUT_VEL, _floats),
    "clear": (Command.CLEAR_ERRORS, lambda: b"\0"),
    "who": (Command.ADDRESS, lambda: b""),
    "address": (
        Command.ADDRESS,
        lambda node, serial: codec.pack_address(Address(int(node), int(serial, 0))),
    ),
    "reboot": (Command.REBOOT, lambda action: bytes((int(action),))),
    "version?": (Command.VERSION, lambda: b""),
    "write": (Command.RX_SDO, lambda *words: _sdo(codec.OPCODE_WRITE, *words)),
    "read": (Command.RX_SDO, lambda *words: _sdo(codec.OPCODE_READ, *words)),
    "value": (Command.TX_SDO, lambda *words: _sdo(0, *words)),
    "heartbeat": (Command.HEARTBEAT, _beat),
    "encoder": (Command.ENCODER, _floats),
    "error": (Command.ERROR, lambda a, b: codec.U32_PAIR.pack(int(a, 0), int(b, 0))),
    "version": (Command.VERSION, _version),
    "iq": (Command.IQ, _floats),
    "bus": (Command.BUS, _floats),
    "torques": (Command.TORQUES, _floats),
}


@pytest.mark.parametrize(("node", "command", "data", "words"), list(golden()))
def test_codec__vendors_frame__the_bytes_we_pack(node, command, data, words):
    wanted, pack = TOLD[words[0]]
    packed = pack(*words[1:])
    assert command == wanted
    assert codec.can_id(node, wanted) == node << 5 | command
    assert data.ljust(len(packed), b"\0") == packed.ljust(len(data), b"\0")


def test_golden__file__whole():
    assert len(list(golden())) == 25


PARSERS = {
    Command.HEARTBEAT: codec.parse_heartbeat,
    Command.VERSION: codec.parse_version,
    Command.ADDRESS: codec.parse_address,
    Command.ERROR: codec.parse_u32_pair,
    Command.ENCODER: codec.parse_f32_pair,
    Command.INPUT_TORQUE: codec.parse_f32,
    Command.AXIS_STATE: codec.parse_u32,
    Command.TX_SDO: codec.parse_sdo,
}


@pytest.mark.parametrize(
    ("command", "data", "value"),
    [
        (Command.HEARTBEAT, "0000000101030000", Heartbeat(0x0100_0000, 1, 3, False)),
        (Command.HEARTBEAT, "00000000080001", Heartbeat(0, 8, 0, True)),
        (Command.VERSION, "0204043A00060A00", Version(2, (4, 4, 58), (0, 6, 10), False)),
        (Command.ADDRESS, "05785634129ABC", Address(5, 0xBC9A_1234_5678)),
        (Command.ADDRESS, "05785634129ABC01", Address(5, 0xBC9A_1234_5678)),
        (Command.ERROR, "2000000000000002", (0x20, 0x0200_0000)),
        (Command.ENCODER, "0000C03F000040C0", (1.5, -3.0)),
        (Command.INPUT_TORQUE, "0000803F", 1.0),
        (Command.INPUT_TORQUE, "0000803F00000000", 1.0),
        (Command.AXIS_STATE, "08000000", 8),
        (Command.AXIS_STATE, "0800000000000000", 8),
        (Command.TX_SDO, "002C0100B6F39D3F", Sdo(0, 300, b"\xb6\xf3\x9d\x3f")),
    ],
)
def test_parsers__vendors_frame__its_values(command, data, value):
    assert PARSERS[command](bytes.fromhex(data)) == value


@pytest.mark.parametrize("parse", PARSERS.values(), ids=PARSERS)
@given(data=BYTES)
def test_parsers__any_bytes__a_value_or_none(parse, data):
    parse(data)
    assert parse(b"") is None
    assert parse(data[:3]) is None


@given(U32, U8, U8, st.booleans())
def test_heartbeat__any__round_trip_and_as_the_dbc_says(errors, state, result, done):
    beat = Heartbeat(errors, state, result, done)
    data = codec.pack_heartbeat(beat)
    assert codec.parse_heartbeat(data) == beat
    fields = DBC.decode_message("Axis0_Heartbeat", data, decode_choices=False)
    assert fields == {
        "Axis_Error": errors,
        "Axis_State": state,
        "Procedure_Result": result,
        "Trajectory_Done_Flag": done,
    }


@given(st.tuples(*[U8] * 7), st.booleans())
def test_version__any__round_trip_and_as_the_dbc_says(numbers, is_unreleased):
    version = Version(numbers[0], numbers[1:4], numbers[4:7], is_unreleased)
    data = codec.pack_version(version)
    assert codec.parse_version(data) == version
    fields = DBC.decode_message("Axis0_Get_Version", data)
    assert (fields["Hw_Version_Major"], fields["Hw_Version_Minor"]) == numbers[1:3]
    assert (fields["Fw_Version_Minor"], fields["Fw_Version_Revision"]) == numbers[5:7]


@given(U8, st.integers(0, (1 << 48) - 1))
def test_address__any__round_trip_and_as_the_dbc_says(node, serial):
    data = codec.pack_address(Address(node, serial))
    assert codec.parse_address(data) == codec.parse_address(data[:7]) == Address(node, serial)
    fields = DBC.decode_message("Axis0_Address", data)
    assert (fields["Node_ID"], fields["Serial_Number"]) == (node, serial)


@pytest.mark.parametrize(
    ("message", "command", "first", "second"),
    [
        ("Get_Encoder_Estimates", Command.ENCODER, "Pos_Estimate", "Vel_Estimate"),
        ("Get_Iq", Command.IQ, "Iq_Setpoint", "Iq_Measured"),
        ("Get_Torques", Command.TORQUES, "Torque_Target", "Torque_Estimate"),
        ("Get_Bus_Voltage_Current", Command.BUS, "Bus_Voltage", "Bus_Current"),
        ("Set_Input_Vel", Command.INPUT_VEL, "Input_Vel", "Input_Torque_FF"),
        ("Set_Limits", Command.LIMITS, "Velocity_Limit", "Current_Limit"),
        ("Set_Vel_Gains", Command.VEL_GAINS, "Vel_Gain", "Vel_Integrator_Gain"),
        ("Get_Temperature", Command.TEMPERATURE, "FET_Temperature", "Motor_Temperature"),
        ("Get_Powers", Command.POWERS, "Electrical_Power", "Mechanical_Power"),
    ],
)
@given(F32, F32)
def test_pairs__any_floats__as_the_dbc_says(message, command, first, second, a, b):
    data = codec.F32_PAIR.pack(a, b)
    assert codec.parse_f32_pair(data) == (a, b)
    for node in (0, 3):
        described = DBC.get_message_by_name(f"Axis{node}_{message}")
        assert described.frame_id == codec.can_id(node, command)
        assert described.decode(data) == {first: a, second: b}


def test_commands__all__under_the_names_of_the_dbc():
    known = {message.frame_id for message in DBC.messages if message.name.startswith("Axis0_")}
    assert {int(command) for command in Command} <= known


def test_names__all__those_of_the_dbc():
    def choices(message, signal):
        found = DBC.get_message_by_name(message).get_signal_by_name(signal).choices
        return {value: str(name) for value, name in found.items()}

    errors = choices("Axis0_Heartbeat", "Axis_Error")
    del errors[0]
    assert {int(flag): flag.name for flag in codec.AxisError} == errors
    states = choices("Axis0_Heartbeat", "Axis_State")
    del states[5]  # SENSORLESS_CONTROL of firmware 0.5
    assert {int(state): state.name for state in codec.AxisState} == states
    results = choices("Axis0_Heartbeat", "Procedure_Result")
    assert {int(result): result.name for result in codec.ProcedureResult} == results


@given(U32)
def test_describe_errors__any_bits__every_bit_named_once(bits):
    words = codec.describe_errors(bits).split(", ")
    values = [
        int(word, 16) if word.startswith("0x") else codec.AxisError[word].value
        for word in words
        if word != "none"
    ]
    assert sum(values) == bits


@given(U8, st.integers(0, 0xFFFF), st.binary(max_size=4))
def test_sdo__any__round_trip(opcode, endpoint, value):
    sdo = Sdo(opcode, endpoint, value)
    assert codec.parse_sdo(codec.pack_sdo(sdo)) == sdo


@given(st.floats(min_value=1e-30, max_value=1e30))
def test_f32_below__any_positive__the_largest_not_above(value):
    below = codec.f32_below(value)
    assert struct.unpack("<f", struct.pack("<f", below))[0] == below <= value
    assert below + codec.f32_spacing(value) > value


def test_f32__beyond_its_range__infinite_or_the_largest():
    assert codec.pack_f32(-1e300) == struct.pack("<f", -math.inf)
    assert codec.f32_below(1e300) == pytest.approx(3.4028235e38)


@given(st.floats(min_value=1e-20, max_value=1e20))
def test_f32_spacing__any__to_the_next_number(value):
    single = struct.unpack("<f", struct.pack("<f", value))[0]
    bits = int.from_bytes(struct.pack("<f", single), "little")
    (following,) = struct.unpack("<f", struct.pack("<I", bits + 1))
    assert following - single == codec.f32_spacing(single)


# --- endpoints ----------------------------------------------------------------------------------


def vendor_file(path, **changes):
    """Write a file as the vendor publishes it: more endpoints than are used here, any numbers."""
    entries = {"vbus_voltage": {"id": 1, "type": "float", "access": "r"}}
    for number, endpoint in enumerate(Endpoint, start=200):
        layout = endpoints.LAYOUT[endpoint]
        kind = {"<?": "bool", "<I": "uint32", "<f": "float"}[layout.format]
        entries[endpoint.value] = {"id": number, "type": kind, "access": "rw"}
    content = {"fw_version": "0.6.10-1", "hw_version": "4.4.58", "endpoints": entries} | changes
    path.write_text(json.dumps(content), encoding="utf-8")
    return str(path)


def test_load_endpoints__vendors_file__versions_and_numbers(tmp_path):
    table = load_endpoints(vendor_file(tmp_path / "flat_endpoints.json"))
    assert (table.firmware, table.hardware) == ((0, 6, 10), (4, 4, 58))
    assert table.ids == {endpoint: 200 + n for n, endpoint in enumerate(Endpoint)}


@pytest.mark.parametrize(
    "changes",
    [
        {"fw_version": "new"},
        {"hw_version": 4},
        {"endpoints": {}},
        {"endpoints": []},
        {"endpoints": {endpoint.value: {"id": 1, "type": "uint8"} for endpoint in Endpoint}},
        {"endpoints": {endpoint.value: {"id": 70000, "type": "float"} for endpoint in Endpoint}},
    ],
)
def test_load_endpoints__not_the_vendors__one_line_with_the_path(tmp_path, changes):
    path = vendor_file(tmp_path / "file.json", **changes)
    with pytest.raises(AmplifierError, match=r"file\.json") as caught:
        load_endpoints(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("content", [None, "", "{", "[]", "\xff\xfe", "null"])
def test_load_endpoints__unreadable__one_line_with_the_path(tmp_path, content):
    path = tmp_path / "file.json"
    if content is not None:
        path.write_bytes(content.encode("latin-1"))
    with pytest.raises(AmplifierError, match=r"file\.json"):
        load_endpoints(str(path))


@given(F32)
def test_table__write__opcode_number_and_value(value):
    data = EMULATED.write(Endpoint.VEL_LIMIT, value)
    sdo = codec.parse_sdo(data)
    assert sdo == Sdo(1, EMULATED.ids[Endpoint.VEL_LIMIT], struct.pack("<f", value))
    assert codec.parse_sdo(EMULATED.read(Endpoint.VEL_LIMIT)) == sdo._replace(opcode=0, value=b"")


def test_emulated__numbers__beyond_those_of_a_real_drive():
    assert isinstance(EMULATED, EndpointTable)
    numbers = [*EMULATED.ids.values(), endpoints.TIME_BASE_ID, endpoints.INJECT_FAULT_ID]
    assert len(set(numbers)) == len(numbers)
    assert min(numbers) >= 0xFE00
