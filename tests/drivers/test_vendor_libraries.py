"""Our codecs against the vendors' own libraries, both ways: what they send, what they read.

- `moteus` 1.1.1 by mjbots: byte for byte.
- `robstride-dynamics` 0.0.1 by RobStride Dynamics: numbers within one, as it truncates.
"""

import math
from itertools import count
from types import SimpleNamespace

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.frame import EFF_MASK
from drivers.mit import codec as mit
from drivers.mit import robstride_codec
from drivers.mit.codec import Codes, Ranges
from drivers.mit.robstride_codec import Mode, Status, Type
from drivers.moteus import codec
from drivers.moteus.registers import Mode as MoteusMode
from drivers.moteus.registers import Register

moteus = pytest.importorskip("moteus", reason="moteus is not installed (extra `dev`)")
robstride = pytest.importorskip(
    "robstride_dynamics", reason="robstride-dynamics is not installed (extra `dev`)"
)
mp = moteus.multiplex
F32 = st.floats(-1e3, 1e3, width=32)

# --- moteus ---------------------------------------------------------------------------------------


def controller(node=1):
    """The vendor's controller, told to use the resolutions that we use."""
    query = moteus.QueryResolution()
    for name in vars(moteus.QueryResolution):
        if isinstance(getattr(query, name), int):
            setattr(query, name, mp.IGNORE)
    query.mode = mp.INT8
    query.position = query.velocity = query.torque = mp.F32
    command = moteus.PositionResolution()
    command.position = command.velocity = command.ilimit_scale = mp.INT8
    command.kp_scale = command.kd_scale = command.maximum_torque = mp.INT16
    command.watchdog_timeout = mp.INT16
    return moteus.Controller(
        id=node, query_resolution=query, position_resolution=command, transport=object()
    )


@given(F32, st.integers(1, 32700), st.integers(2, 1000))
def test_moteus__torque_command__byte_for_byte_the_vendors(torque_Nm, limit_cNm, watchdog_ms):
    wanted = controller().make_position(
        position=math.nan,
        velocity=0.0,
        feedforward_torque=torque_Nm,
        kp_scale=0.0,
        kd_scale=0.0,
        maximum_torque=limit_cNm * 0.01 + 1e-9,
        watchdog_timeout=watchdog_ms * 1e-3 + 1e-9,
        ilimit_scale=0.0,
        query=True,
    )
    before, after = codec.torque_frame_parts(limit_cNm * 0.01, watchdog_ms * 1e-3)
    assert before + mit.F32.pack(torque_Nm) + after == wanted.data


def test_moteus__stop_and_query__begin_as_the_vendors():
    assert codec.STOP.startswith(controller().make_stop(query=True).data)
    assert codec.POLL.startswith(controller().make_query().data)
    assert controller().make_query().data == codec.QUERY_STATE


@given(st.sampled_from(MoteusMode), F32, F32, F32, st.integers(0, 127))
def test_moteus__state_as_our_controller_sends_it__read_by_the_vendors(mode, p, v, t, fault):
    data = codec.STATE.pack(
        codec.STATE_HEAD, mode, codec.STATE_BODY, p, v, t, codec.STATE_TAIL, fault
    )
    message = SimpleNamespace(data=data, arbitration_id=codec.reply_id(1), can_prefix=0, bus=None)
    values = moteus.moteus.parse_message(message).values
    ours = codec.parse_replies(data)
    for register in (Register.MODE, Register.POSITION, Register.VELOCITY, Register.TORQUE,
                     Register.FAULT):  # fmt: skip
        assert values[register] == ours[register]
    assert (values[Register.POSITION], values[Register.TORQUE]) == (p, t)


# --- RobStride ------------------------------------------------------------------------------------

RS02 = Ranges(4.0 * math.pi, 44.0, 17.0, 500.0, 5.0)
NODE, HOST = 0x7F, 0xFF
_numbers = count(1)
SHARES = st.floats(-1.0, 1.0)


class Pair:
    """The vendor's bus, and the other end of its wire."""

    def __enter__(self):
        channel = f"vendor-{next(_numbers)}"
        self.bus = robstride.RobstrideBus("virtual", {"m": robstride.Motor(NODE, "rs-02")})
        self.bus.channel_handler = can.Bus(interface="virtual", channel=channel)
        self.far = can.Bus(interface="virtual", channel=channel)
        return self

    def __exit__(self, *_):
        self.bus.channel_handler.shutdown()
        self.bus.channel_handler = None
        self.far.shutdown()

    def answer(self, can_id, data):
        """Have a frame wait for the vendor's bus."""
        self.far.send(can.Message(arbitration_id=can_id & EFF_MASK, data=data))

    def sent(self):
        message = self.far.recv(1.0)
        assert message.is_extended_id
        return robstride_codec.parse_id(message.arbitration_id | 1 << 31), bytes(message.data)


@pytest.fixture(scope="module")
def pair():
    with Pair() as made:
        yield made


@given(SHARES, SHARES, st.floats(0, 1), st.floats(0, 1), SHARES)
def test_robstride__command_of_the_vendors__read_within_one_code(pair, p, v, kp, kd, t):
    wanted = (p * RS02.position_rad, v * RS02.velocity_rad_s, kp * 500.0, kd * 5.0, t * 17.0)
    position, velocity, kp, kd, torque = wanted
    pair.bus.write_operation_frame("m", position, kp, kd, velocity, torque)
    identifier, data = pair.sent()
    theirs = robstride_codec.parse_control(identifier, data)
    ours = Codes(
        mit.to_code(position, RS02.position_rad, 0xFFFF),
        mit.to_code(velocity, RS02.velocity_rad_s, 0xFFFF),
        mit.gain_to_code(kp, 500.0, 0xFFFF),
        mit.gain_to_code(kd, 5.0, 0xFFFF),
        mit.to_code(torque, RS02.torque_Nm, 0xFFFF),
    )
    assert (identifier.type, identifier.target) == (Type.CONTROL, NODE)
    assert max(abs(a - b) for a, b in zip(ours, theirs, strict=True)) <= 2
    assert robstride_codec.pack_control(NODE, theirs)[1] == data


@given(*[st.integers(0, 0xFFFF)] * 3, st.integers(-200, 1200))
def test_robstride__status_as_our_motor_sends_it__read_by_the_vendors(pair, p, v, t, tenths):
    tenths &= 0xFFFF
    can_id = robstride_codec.feedback_id(Status(NODE, Mode.RUN, 0), HOST)
    pair.answer(can_id, robstride_codec.FEEDBACK.pack(p, v, t, tenths))
    position, velocity, torque, temperature = pair.bus.receive_status_frame("m")
    assert position == pytest.approx(mit.to_value(p, RS02.position_rad, 0xFFFF), abs=8e-4)
    assert velocity == pytest.approx(mit.to_value(v, RS02.velocity_rad_s, 0xFFFF), abs=3e-3)
    assert torque == pytest.approx(mit.to_value(t, RS02.torque_Nm, 0xFFFF), abs=1e-3)
    assert temperature == pytest.approx(0.1 * tenths)


@pytest.mark.parametrize(("verb", "kind"), [("enable", Type.ENABLE), ("disable", Type.STOP)])
def test_robstride__power_commands_of_the_vendors__as_ours(pair, verb, kind):
    status = robstride_codec.feedback_id(Status(NODE, Mode.RUN, 0), HOST)
    pair.answer(status, robstride_codec.FEEDBACK.pack(0x7FFF, 0x7FFF, 0x7FFF, 300))
    getattr(pair.bus, verb)("m")
    identifier, data = pair.sent()
    assert (identifier.type, identifier.target, data) == (kind, NODE, bytes(8))


def test_robstride__parameters_of_the_vendors__as_ours(pair):
    kinds = robstride.protocol.ParameterType
    index, value = 0x7028, 400
    answer = robstride_codec.pack_parameter(index, robstride_codec.U32.pack(value))
    pair.answer(robstride_codec.pack_id(Type.READ, NODE, HOST), answer)
    assert pair.bus.read("m", kinds.CAN_TIMEOUT) == value
    identifier, data = pair.sent()
    assert identifier.type == Type.READ
    assert robstride_codec.parse_parameter(data) == (index, bytes(4))
    status = robstride_codec.feedback_id(Status(NODE, Mode.RUN, 0), HOST)
    pair.answer(status, robstride_codec.FEEDBACK.pack(0x7FFF, 0x7FFF, 0x7FFF, 300))
    pair.bus.write("m", kinds.CAN_TIMEOUT, value)
    identifier, data = pair.sent()
    assert identifier.type == Type.WRITE
    assert data == answer
