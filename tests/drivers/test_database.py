"""DBC files: as shipped, read by cantools; for an arm; and true to our codecs."""

import math
import subprocess
import sys
from pathlib import Path

import cantools
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.cia402 import codec
from drivers.cia402.codec import Index
from drivers.cia402.sdo import SdoKind, parse_sdo_request, parse_sdo_response
from drivers.cia402.settings import Cia402Settings
from drivers.database import arm_database, dbc_path
from drivers.decoder import FrameDecoder, frame_label
from drivers.frame import (
    EFF_FLAG,
    ERR_FLAG,
    LOCKSTEP_ID,
    RTR_FLAG,
    pack_fd_frame,
    pack_frame,
    unpack_frame,
)
from drivers.mit import codec as mit
from drivers.mit.settings import MitSettings
from drivers.moteus.settings import MoteusSettings
from drivers.odrive import codec as odrive
from drivers.odrive.settings import OdriveSettings

GOLDEN = Path(__file__).parent / "golden" / "cia402_startup.txt"
AXES = (
    Cia402Settings(node_id=1, rated_torque_Nm=5.0, torque_max_Nm=15.0),
    Cia402Settings(node_id=7, rated_torque_Nm=2.5, torque_max_Nm=8.0, direction=-1, offset_rad=0.1),
)
ODRIVE = OdriveSettings(node_id=3, torque_max_Nm=10.0, gear_ratio=8.0, direction=-1, offset_rad=0.2)
DAMIAO = MitSettings(
    node_id=4, torque_range_Nm=10.0, torque_max_Nm=10.0, direction=-1, offset_rad=-0.3
)
DECODER = FrameDecoder(AXES)
MIXED = FrameDecoder([AXES[0], ODRIVE, DAMIAO])
FAMILIES = {"cia402": AXES[0], "odrive": ODRIVE, "damiao": DAMIAO}
i16 = st.integers(-(2**15), 2**15 - 1)
i32 = st.integers(-(2**31), 2**31 - 1)
u16 = st.integers(0, 2**16 - 1)


def golden_frames():
    for line in GOLDEN.read_text().splitlines():
        text = line.partition(";")[0].split()
        if text:
            can_id, _, data = text[1].partition("#")
            yield pack_frame(int(can_id, 16), bytes.fromhex(data))


@pytest.fixture(scope="module")
def shipped():
    return cantools.database.load_file(dbc_path(AXES[0]))


# --- the file as shipped --------------------------------------------------------------------------


def test_dbc__shipped_file__states_named_as_the_codec_decodes_them(shipped):
    choices = shipped.get_message_by_name("TPDO1").get_signal_by_name("State").choices
    assert {code: str(name) for code, name in choices.items()} == {
        code: codec.decode_state(code).name.replace("_", " ").lower() for code in range(0x80)
    }


@pytest.mark.parametrize("message", ["SdoRequest", "SdoAnswer"])
def test_dbc__shipped_file__objects_named_as_the_codec_has_them(shipped, message):
    choices = shipped.get_message_by_name(message).get_signal_by_name("Object").choices
    assert {code: str(name) for code, name in choices.items()} == {
        int(index): f"{index:04X} {index.name.replace('_', ' ').lower()}" for index in Index
    }


@given(status=u16, position=i32, torque=i16)
def test_dbc__tpdo1_by_cantools_alone__raw_values_of_the_codec(shipped, status, position, torque):
    values = shipped.decode_message("TPDO1", codec.TPDO1.pack(status, position, torque))
    assert values["Position"] == position
    assert values["Torque"] == torque
    assert values["InternalLimit"] == bool(status & codec.STATUS_INTERNAL_LIMIT)
    assert values["FollowsCommand"] == bool(status & codec.STATUS_FOLLOWS_COMMAND)


@pytest.mark.parametrize("name", FAMILIES)
def test_dbc__shipped_with_the_package__read_by_cantools_strictly(name):
    """A wheel has it: the pattern of the package data matches the file."""
    project = Path(__file__).parents[2]
    assert 'drivers = ["**/*.dbc"]' in (project / "pyproject.toml").read_text()
    path = dbc_path(FAMILIES[name])
    assert path.relative_to(project).parts[0] == "drivers"
    assert path.name == f"{name}.dbc"
    assert cantools.database.load_file(path, strict=True).messages


@pytest.mark.parametrize(
    "axis",
    [MoteusSettings.model_construct(family="moteus"),
     MitSettings(node_id=1, variant="robstride", torque_range_Nm=10.0, torque_max_Nm=10.0)],
    ids=["moteus", "robstride"],
)  # fmt: skip
def test_dbc__frames_that_no_dbc_can_describe__left_out(axis):
    assert dbc_path(axis) is None
    assert arm_database([axis]).messages == []


# --- an arm's own ---------------------------------------------------------------------------------


def test_arm_database__written_and_read_by_cantools__is_the_same():
    ours = arm_database(AXES)
    read = cantools.database.load_string(ours.as_dbc_string(), "dbc")
    assert {m.name: (m.frame_id, m.length) for m in read.messages} == {
        m.name: (m.frame_id, m.length) for m in ours.messages
    }
    data = codec.TPDO1.pack(0x1237, -1000, 123)
    assert read.decode_message("J2_TPDO1", data) == ours.decode_message("J2_TPDO1", data)
    request = bytes.fromhex("2B72600010270000")
    assert read.decode_message("J2_SdoRequest", request)["Object"] == "6072 max torque"


def test_arm_database__two_axes__messages_for_all_nodes_once():
    names = sorted(m.name for m in arm_database(AXES).messages)
    assert names.count("SYNC") == names.count("NMT") == names.count("MasterHeartbeat") == 1
    assert [name for name in names if name.endswith("RPDO1")] == ["J1_RPDO1", "J2_RPDO1"]


def test_arm_database__identifiers__are_those_of_the_nodes():
    by_name = {m.name: m.frame_id for m in arm_database(AXES).messages}
    for joint, node in ((1, 1), (2, 7)):
        assert by_name[f"J{joint}_TPDO1"] == codec.COB_TPDO1 + node
        assert by_name[f"J{joint}_RPDO1"] == codec.COB_RPDO1 + node
        assert by_name[f"J{joint}_TPDO2"] == codec.COB_TPDO2 + node
        assert by_name[f"J{joint}_EMCY"] == codec.COB_EMCY + node
        assert by_name[f"J{joint}_SdoRequest"] == codec.COB_SDO_RX + node
        assert by_name[f"J{joint}_SdoAnswer"] == codec.COB_SDO_TX + node
        assert by_name[f"J{joint}_Heartbeat"] == codec.COB_HEARTBEAT + node


# --- decoding -------------------------------------------------------------------------------------


@given(position=i32, torque=i16)
def test_decoder__feedback__si_units_of_the_joint(position, torque):
    data = codec.TPDO1.pack(0x1237, position, torque)
    values = DECODER.decode(pack_frame(0x187, data)).values
    assert values["State"] == "operation enabled"
    assert values["Position"] == pytest.approx(-position * math.tau / 4096 + 0.1)
    assert values["Torque"] == pytest.approx(-torque * 2.5e-3)


def test_decoder__golden_startup__every_frame_named_and_as_the_codec_reads_it():
    count = 0
    for frame in golden_frames():
        can_id, data = unpack_frame(frame)
        found = DECODER.decode(frame)
        assert found is not None, frame_label(frame)
        count += 1
        if can_id == 0x181:
            status, position, torque = codec.TPDO1.unpack(data)
            assert (
                found.values["State"] == codec.decode_state(status).name.replace("_", " ").lower()
            )
            assert found.values["Position"] == pytest.approx(position * math.tau / 4096)
            assert found.values["Torque"] == pytest.approx(torque * 5e-3)
        elif can_id == 0x201:
            _, torque = codec.RPDO1.unpack(data)
            assert found.values["TargetTorque"] == pytest.approx(torque * 5e-3)
        elif can_id in (0x601, 0x581):
            parse = parse_sdo_request if can_id == 0x601 else parse_sdo_response
            expect_sdo(found.values, parse(data))
    assert count > 50


def expect_sdo(values, parsed):
    assert values["Service"] == parsed.kind.value.removeprefix("initiate ")
    if parsed.kind in (SdoKind.UPLOAD_SEGMENT, SdoKind.DOWNLOAD_SEGMENT):
        assert "Object" not in values
        segment = values["Segment"].to_bytes(7, "little")
        assert segment.startswith(parsed.data)
        return
    assert values["Object"].startswith(f"{parsed.index:04X} ")
    assert values["Subindex"] == parsed.subindex
    if parsed.is_expedited:
        assert values["Value"] == int.from_bytes(parsed.data, "little")


@pytest.mark.parametrize(
    ("frame", "text"),
    [
        (pack_frame(0x080), "SYNC"),
        (pack_frame(0, b"\x82\x01"), "NMT Command='reset communication' Node=1"),
        (pack_frame(0x77F, b"\x05"), "MasterHeartbeat NmtState=operational"),
        (pack_frame(0x207, b"\x0f\x00\x0a\x00"),
         "J2_RPDO1 Controlword='enable operation' TargetTorque=-0.025 Nm"),
        (pack_frame(0x081, bytes.fromhex("5082110000000000")),
         "J1_EMCY ErrorCode='8250 RPDO timeout' ErrorRegister=17 VendorSpecific=0x0000000000"),
        (pack_frame(0x201, b"\x0f"), ""),  # too short for what it should be
        (pack_frame(0x333, b"\x01\x02"), ""),
        (pack_frame(EFF_FLAG | 0x181, bytes(8)), ""),  # 29 bits: another one
        (pack_frame(RTR_FLAG | 0x181), "J1_TPDO1 requested"),
        (pack_frame(ERR_FLAG | 4, bytes(8)), "error report of the CAN controller"),
        (pack_frame(LOCKSTEP_ID), "emulated time: one period"),
    ],
)  # fmt: skip
def test_describe__frames_of_every_kind__one_line(frame, text):
    assert DECODER.describe(frame) == text


@pytest.mark.parametrize(
    ("frame", "label"),
    [
        (pack_frame(0x81, b"\x0a"), "081#0A"),
        (pack_frame(EFF_FLAG | 0x81), "00000081#"),
        (pack_frame(RTR_FLAG | 0x81), "081#R"),
        (pack_frame(ERR_FLAG | 4, b"\0"), "20000004#00"),
        (pack_fd_frame(0x100, b"\x21\x00"), "100##52100"),
    ],
)
def test_frame_label__as_candump_writes_it(frame, label):
    assert frame_label(frame) == label


@given(can_id=st.integers(0, 2**32 - 1), data=st.binary(max_size=8))
def test_describe__whatever_is_on_the_bus__never_raises(can_id, data):
    assert "\n" not in MIXED.describe(pack_frame(can_id, data))


KNOWN_IDS = sorted(message.frame_id for message in arm_database([AXES[0], ODRIVE, DAMIAO]).messages)


@given(can_id=st.sampled_from(KNOWN_IDS), data=st.binary(max_size=8))
def test_describe__known_identifier_any_bytes__never_raises(can_id, data):
    assert "\n" not in MIXED.describe(pack_frame(can_id, data))


# --- other families -------------------------------------------------------------------------------


def of_odrive(command, data=b""):
    return pack_frame(odrive.can_id(3, command), data)


finite = st.floats(-1e6, 1e6, width=32)


@given(position=finite, velocity=finite)
def test_odrive__encoder__joint_units_of_the_codecs_values(position, velocity):
    data = odrive.F32_PAIR.pack(position, velocity)
    values = MIXED.decode(of_odrive(odrive.Command.ENCODER, data)).values
    found = odrive.parse_f32_pair(data)
    assert values["Position"] == pytest.approx(-found[0] * math.tau / 8.0 + 0.2)
    assert values["Velocity"] == pytest.approx(-found[1] * math.tau / 8.0)


@given(
    errors=st.lists(st.sampled_from(list(odrive.AxisError)), unique=True),
    state=st.sampled_from(list(odrive.AxisState)),
    result=st.sampled_from(list(odrive.ProcedureResult)),
)
def test_odrive__heartbeat__state_result_and_each_error_by_name(errors, state, result):
    bits = sum(errors)
    data = odrive.pack_heartbeat(odrive.Heartbeat(bits, state, result, True))
    values = MIXED.decode(of_odrive(odrive.Command.HEARTBEAT, data)).values
    assert values["State"] == state.name.replace("_", " ").lower()
    assert values["Result"] == result.name.replace("_", " ").lower()
    named = {key.lower() for key, value in values.items() if value == 1}
    assert named == {error.name.replace("_", "").lower() for error in errors} | {"trajectorydone"}


@pytest.mark.parametrize("padding", [b"", bytes(4)], ids=["4 bytes", "8 bytes"])
def test_odrive__torque__of_either_length_at_the_joint(padding):
    frame = of_odrive(odrive.Command.INPUT_TORQUE, odrive.F32.pack(0.25) + padding)
    assert MIXED.describe(frame) == "J2_InputTorque TorqueSetpoint=-2 Nm"


def test_odrive__empty_frame_of_the_encoder__is_a_poll():
    assert MIXED.describe(of_odrive(odrive.Command.ENCODER)) == "J2_Encoder requested"


codes16, codes12 = st.integers(0, 0xFFFF), st.integers(0, 0xFFF)


@given(position=codes16, velocity=codes12, torque=codes12,
       status=st.sampled_from(list(mit.DamiaoStatus)))  # fmt: skip
def test_damiao__reply__joint_units_of_the_codecs_values(position, velocity, torque, status):
    head = 4 | status << 4
    data = mit.pack_feedback(mit.Feedback(head, position, velocity, torque, (31, 42)))
    values = MIXED.decode(pack_frame(DAMIAO.reply_id, data)).values
    ranges = DAMIAO.ranges
    q_rad = mit.to_value(position, ranges.position_rad, mit.POSITION_CODES)
    assert values["Position"] == pytest.approx(-q_rad - 0.3)
    tau_Nm = mit.to_value(torque, ranges.torque_Nm, mit.SHORT_CODES)
    assert values["Torque"] == pytest.approx(-tau_Nm)
    assert values["Velocity"] == pytest.approx(
        -mit.to_value(velocity, ranges.velocity_rad_s, mit.SHORT_CODES)
    )
    assert values["Status"] == status.name.replace("_", " ").lower()
    assert (values["Node"], values["MosfetTemperature"], values["RotorTemperature"]) == (4, 31, 42)


@given(codes=st.builds(mit.Codes, codes16, codes12, codes12, codes12, codes12))
def test_damiao__command__joint_units_of_the_codecs_values(codes):
    values = MIXED.decode(pack_frame(4, mit.pack_codes(codes))).values
    if not values:  # seven bytes FF: no set-point for the codec either
        assert mit.parse_command(mit.pack_codes(codes)) is None
        return
    setpoint = mit.to_setpoint(codes, DAMIAO.ranges)
    assert values["Position"] == pytest.approx(-setpoint.position_rad - 0.3)
    assert values["TargetTorque"] == pytest.approx(-setpoint.torque_Nm)
    assert values["Kp"] == pytest.approx(setpoint.kp_Nm_rad)
    assert values["Kd"] == pytest.approx(setpoint.kd_Nms_rad)


def test_damiao__special_commands__by_name():
    found = [MIXED.describe(pack_frame(4, data))
             for data in (mit.ENABLE, mit.DISABLE, mit.SET_ZERO, mit.CLEAR_FAULT)]  # fmt: skip
    names = ("enable", "disable", "set zero", "clear fault")
    assert found == [f"J3_Command {name}" for name in names]


# --- cantools missing -----------------------------------------------------------------------------


def test_decoder__cantools_not_installed__one_line_with_the_remedy():
    """In a process of its own, in which cantools cannot be found."""
    program = (
        "import sys; sys.modules['cantools'] = None\n"
        "from drivers.database import DatabaseError\n"
        "from drivers.decoder import FrameDecoder\n"
        "try:\n    FrameDecoder([])\n"
        "except DatabaseError as error:\n    print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, check=True)
    assert b"pip install 'hil[bus]'" in done.stdout
