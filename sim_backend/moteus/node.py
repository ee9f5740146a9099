"""The emulated moteus controller on the wire: frames of subframes, registers, replies."""

import math
from collections.abc import Callable
from copy import copy
from struct import Struct

from pydantic import BaseModel, ConfigDict, Field

from drivers.frame import pack_fd_frame
from drivers.moteus import codec
from drivers.moteus.codec import (
    BROADCAST,
    CLIENT_DATA,
    CLIENT_POLL,
    CONSOLE_CHANNEL,
    READ,
    READ_ERROR,
    REPLY,
    SERVER_DATA,
    WRITE,
    WRITE_ERROR,
    Subframe,
)
from drivers.moteus.registers import (
    Mode,
    Register,
    Resolution,
    decode_value,
    encode_value,
    scale_of,
)
from sim_backend.moteus.console import ConsoleServer
from sim_backend.moteus.controller import COMMANDABLE, Command, Controller
from sim_backend.node import AmplifierNode, Transmit
from sim_backend.servo import Servo

HIL_MODEL_NUMBER = 0x48494C31
"""Register 0x100: "HIL1", which no real controller has."""
FIRMWARE_VERSION = 0x010100
REGISTER_MAP_VERSION = 5
BOARD_C = 25.0
UNKNOWN_REGISTER, NOT_WRITABLE, INVALID_VALUE = 1, 2, 3
"""Errors of the protocol."""

_REPLY_MAX = codec.FD_PAYLOAD
_STREAM_MAX = 48
_STREAM_HEAD = 3
_HEAD_MAX = 8  # kind, count, register number
_ERROR_MAX = 7  # kind, register number, error number
_NOP = bytes((codec.NOP,))
_NOPS = codec.NOP << 8 | codec.NOP
_WRITE_ERROR_BYTE = bytes((WRITE_ERROR,))
_FLOAT = Struct("<f").unpack_from
_TORQUE_HEAD = codec.torque_frame_parts(1.0, 1.0)[0]
_TORQUE_AT, _TORQUE_END = len(_TORQUE_HEAD), len(_TORQUE_HEAD) + 4
_KNOWN_TAILS_MAX = 8
_SOURCE_MASK = 0x7F
_FAULT_MAX = 127
DRIVER_FAULT = 33
"""Fault code of the motor driver chip."""
_INT32_ONLY = frozenset((*range(0x100, 0x103), *range(0x120, 0x123), *range(0x150, 0x154)))
_WRITE_ONLY = frozenset((Register.REQUIRE_REINDEX, Register.RECAPTURE, *range(0x154, 0x158)))
_FIELDS: dict[int, str] = {
    Register.COMMAND_Q_CURRENT: "q_current_A",
    Register.COMMAND_POSITION: "position_rev",
    Register.COMMAND_VELOCITY: "velocity_rev_s",
    Register.COMMAND_TORQUE: "torque_Nm",
    Register.COMMAND_KP_SCALE: "kp_scale",
    Register.COMMAND_KD_SCALE: "kd_scale",
    Register.COMMAND_MAX_TORQUE: "max_torque_Nm",
    Register.COMMAND_TIMEOUT: "timeout_s",
    Register.COMMAND_IGNORE_BOUNDS: "ignores_bounds",
}
_UNMODELLED: dict[int, float] = {
    Register.COMMAND_D_CURRENT: 0.0,
    Register.COMMAND_STOP_POSITION: math.nan,
    Register.COMMAND_VELOCITY_LIMIT: math.nan,
    Register.COMMAND_ACCELERATION_LIMIT: math.nan,
    Register.COMMAND_FIXED_VOLTAGE: math.nan,
    Register.COMMAND_ILIMIT_SCALE: 1.0,
    Register.COMMAND_FIXED_CURRENT: math.nan,
}
"""Registers of a command that are taken, kept and without effect, with their defaults."""


class MoteusNodeSettings(BaseModel):
    """What can be set of an emulated moteus controller."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    can_prefix: int = Field(0, ge=0, le=0x1FFF, description="can.prefix")
    serial: int = Field(0, ge=0, le=0x7FFF_FFFF, description="first word of the serial number")


class MoteusNode(AmplifierNode):
    """A moteus controller for torque, current and simple position control.

    It answers in the order of its input, from the state before the frame's own command, always
    with CAN FD frames and bit rate switching.

    Attributes:
        node_id: 1 to 126.
        controller: Modes, control and configuration.
        malformed_frames: Frames with a subframe that could not be read, dropped from there on.
    """

    takes_fd = True

    def __init__(
        self,
        node_id: int,
        servo: Servo,
        transmit: Transmit,
        settings: MoteusNodeSettings | None = None,
        *,
        is_lockstep: bool = False,
    ) -> None:
        """Build the controller, silent until it is asked.

        Args:
            node_id: 1 to 126.
            servo: The axis behind it.
            transmit: Puts a frame record on the wire.
            settings: Prefix and serial number.
            is_lockstep: What register 0x121 tells the master: plant time follows its frames.
        """
        super().__init__(servo, transmit)
        self._settings = settings or MoteusNodeSettings()
        self.node_id = node_id
        self.malformed_frames = 0
        self.controller = Controller(servo)
        self._console = ConsoleServer(self.controller)
        self._milliseconds = 0.0
        self._pending: Command = Command()
        self._is_commanded = False
        self._accepted: dict[int, float] = dict(_UNMODELLED)
        self._known_tails: dict[bytes, Command] = {}
        serial = (self._settings.serial, int(is_lockstep), HIL_MODEL_NUMBER)
        self._uuid = (HIL_MODEL_NUMBER, self._settings.serial, node_id, 0)
        self._constants: dict[int, float] = {
            Register.MODEL_NUMBER: HIL_MODEL_NUMBER,
            Register.FIRMWARE_VERSION: FIRMWARE_VERSION,
            Register.REGISTER_MAP_VERSION: REGISTER_MAP_VERSION,
            **dict(enumerate(serial, start=Register.SERIAL_NUMBER_1)),
            **dict(enumerate(self._uuid, start=Register.UUID_1)),
            Register.UUID_MASK_CAPABLE: 1,
            Register.TEMPERATURE: BOARD_C,
            Register.MOTOR_TEMPERATURE: 0.0,
            Register.VOLTAGE: servo.settings.supply_V,
            Register.D_CURRENT: 0.0,
            Register.ABS_POSITION: 0.0,
            Register.HOME_STATE: 1,
            Register.ENCODER_VALIDITY: 3,
        }
        self._readings = self._make_readings()

    def _make_readings(self) -> dict[int, Callable[[], float]]:
        drive, servo = self.controller, self.servo
        return {
            Register.MODE: lambda: drive.mode,
            Register.POSITION: drive.position_rev,
            Register.VELOCITY: drive.velocity_rev_s,
            Register.TORQUE: lambda: servo.torque_Nm,
            Register.Q_CURRENT: lambda: servo.current_A,
            Register.POWER: lambda: servo.torque_Nm * servo.dq_rad_s,
            Register.TRAJECTORY_COMPLETE: lambda: int(drive.mode == Mode.POSITION),
            Register.FAULT: lambda: drive.fault,
            Register.CONTROL_TORQUE: lambda: drive.control_torque_Nm,
            Register.POSITION_COMMAND: lambda: drive.control_torque_Nm,
            Register.POSITION_FEEDFORWARD: lambda: drive.command.torque_Nm,
            Register.ENCODER_0_POSITION: drive.position_rev,
            Register.ENCODER_0_VELOCITY: drive.velocity_rev_s,
            Register.MILLISECOND_COUNTER: lambda: int(self._milliseconds) % (1 << 23),
        }

    # --- AmplifierNode ------------------------------------------------------------------------

    def power_on(self) -> None:
        """Start as after power-up; a moteus says nothing by itself."""
        self.controller.power_on()
        self._console.reset()
        self._pending = Command()
        self._milliseconds = 0.0

    def receive(self, can_id: int, data: bytes) -> None:
        """See `AmplifierNode.receive`."""
        prefix, source, destination = codec.split_id(can_id)
        if destination not in (self.node_id, BROADCAST) or prefix != self._settings.can_prefix:
            return
        reply = self._answer_quickly(data)
        if reply is None:
            reply = self._answer(data)
            if reply is None:  # meant for another
                return
        if source & codec.WANTS_REPLY:
            self._send(source & _SOURCE_MASK, reply)

    def fail_power_stage(self) -> None:
        """See `AmplifierNode.fail_power_stage`: mode FAULT, motor driver fault."""
        self.controller.fail(DRIVER_FAULT)

    def tick(self, dt_s: float) -> None:
        """See `AmplifierNode.tick`."""
        self._milliseconds += dt_s * 1e3
        self.controller.tick(dt_s)

    def _send(self, to: int, data: bytes) -> None:
        can_id = codec.reply_id(self.node_id, to, prefix=self._settings.can_prefix)
        self._transmit(pack_fd_frame(can_id, data))

    # --- the frames of every cycle ------------------------------------------------------------

    def _answer_quickly(self, data: bytes) -> bytes | None:
        """Answer the frames that come in every cycle as `_answer` would, but several times faster.

        A torque command is known by all its bytes except the torque itself.
        """
        if data == codec.POLL:
            return self._state(codec.STATE_TAIL, self.controller.fault)
        known = self._known_tails.get(data[_TORQUE_END:])
        if known is None or data[:_TORQUE_AT] != _TORQUE_HEAD:
            return None
        reply = self._state(_NOPS, codec.NOP)
        (known.torque_Nm,) = _FLOAT(data, _TORQUE_AT)
        self._pending = known
        self.controller.obey(known)
        return reply

    def _state(self, tail: int, last: int) -> bytes:
        drive = self.controller
        return codec.STATE.pack(
            codec.STATE_HEAD,
            drive.mode,
            codec.STATE_BODY,
            drive.position_rev(),
            drive.velocity_rev_s(),
            self.servo.torque_Nm,
            tail,
            last,
        )

    def _learn(self, data: bytes, is_malformed: bool) -> None:
        """Remember a torque command, to answer those that differ in the torque alone quickly."""
        is_usual = len(data) == codec.TORQUE_LENGTH and data[:_TORQUE_AT] == _TORQUE_HEAD
        if is_malformed or not is_usual or not data.rstrip(_NOP).endswith(codec.QUERY_STATE):
            return
        if len(self._known_tails) >= _KNOWN_TAILS_MAX:
            self._known_tails.clear()
        self._known_tails[data[_TORQUE_END:]] = self._pending

    # --- any frame ----------------------------------------------------------------------------

    def _answer(self, data: bytes) -> bytes | None:
        """Obey a frame and return its reply; None if it is meant for another one's UUID."""
        parts, is_malformed = codec.parse_subframes(data)
        self.malformed_frames += is_malformed
        self._pending = copy(self._pending)
        self._is_commanded = False
        reply = bytearray()
        for part in parts:
            if part.kind == WRITE and not self._is_own_uuid(part):
                return None
            reply += self._obey(part, _REPLY_MAX - len(reply))
        if self._is_commanded:
            if not reply.startswith(_WRITE_ERROR_BYTE):
                self._learn(data, is_malformed)
            self.controller.obey(self._pending)
        return codec.pad(bytes(reply))

    def _is_own_uuid(self, part: Subframe) -> bool:
        for register, number in enumerate(part.values, start=part.number):
            word = register - Register.UUID_MASK_1
            if not 0 <= word < len(self._uuid):
                continue
            if not math.isfinite(number) or int(number) & 0xFFFF_FFFF != self._uuid[word]:
                return False
        return True

    def _obey(self, part: Subframe, room: int) -> bytes:
        if part.kind == WRITE:
            return self._write_all(part, room)
        if part.kind == READ:
            return self._read_all(part, room)
        if part.number != CONSOLE_CHANNEL or part.kind not in (CLIENT_DATA, CLIENT_POLL):
            return b""
        most = min(_STREAM_MAX, max(0, room - _STREAM_HEAD))
        if part.kind == CLIENT_POLL:
            waiting = self._console.give(min(most, part.wanted))
        else:
            waiting = self._console.give(most)
            self._console.take(part.data)
        return codec.pack_stream(SERVER_DATA, CONSOLE_CHANNEL, waiting) if room > 3 else b""

    # --- registers ----------------------------------------------------------------------------

    def _read_all(self, part: Subframe, room: int) -> bytes:
        """Reply to a read: runs of values, an error in the place of what cannot be read."""
        out, first = bytearray(), part.number
        run: list[float] = []
        size = codec.VALUE[part.resolution].size
        for register in range(part.number, part.number + min(part.wanted, _REPLY_MAX)):
            if len(out) + _HEAD_MAX + len(run) * size + _ERROR_MAX > room:
                break
            value = self._read(register, part.resolution)
            if value is None:
                out += _reply(first, part.resolution, run) + _error(READ_ERROR, register)
                run, first = [], register + 1
            else:
                run.append(encode_value(value, scale_of(register), part.resolution))
        return bytes(out + _reply(first, part.resolution, run))

    def _read(self, register: int, resolution: int) -> float | None:
        if register in _INT32_ONLY and resolution != Resolution.INT32:
            return None
        reading = self._readings.get(register)
        if reading is not None:
            return reading()
        if register in _FIELDS:
            value: float = getattr(self._pending, _FIELDS[register])
            return value
        return self._constants.get(register, self._accepted.get(register))

    def _write_all(self, part: Subframe, room: int) -> bytes:
        errors = bytearray()
        for register, number in enumerate(part.values, start=part.number):
            value = decode_value(number, scale_of(register), part.resolution)
            error = self._write(register, value)
            if error and len(errors) + _ERROR_MAX <= room:
                errors += _error(WRITE_ERROR, register, error)
        return bytes(errors)

    def _write(self, register: int, value: float) -> int:
        """Write one register; return the protocol's error number, 0 = none."""
        if register == Register.MODE:
            return self._write_mode(value)
        if register in _FIELDS:
            setattr(self._pending, _FIELDS[register], value)
        elif register in self._accepted:
            self._accepted[register] = value
        elif register in (Register.SET_OUTPUT_NEAREST, Register.SET_OUTPUT_EXACT):
            self.controller.set_position(value, is_exact=register == Register.SET_OUTPUT_EXACT)
        elif register == Register.INJECT_FAULT:
            return self._inject_fault(value)
        elif register not in _WRITE_ONLY:
            is_known = register in self._readings or register in self._constants
            return NOT_WRITABLE if is_known else UNKNOWN_REGISTER
        return 0

    def _inject_fault(self, code: float) -> int:
        if not 1.0 <= code <= _FAULT_MAX:
            return INVALID_VALUE
        self.controller.fail(int(code))
        return 0

    def _write_mode(self, value: float) -> int:
        if value not in COMMANDABLE:
            return INVALID_VALUE
        self._pending = Command(int(value))
        self._is_commanded = True
        return 0


def _reply(first: int, resolution: int, run: list[float]) -> bytes:
    return codec.pack_values(REPLY, first, resolution, *run) if run else b""


def _error(kind: int, register: int, number: int = UNKNOWN_REGISTER) -> bytes:
    return bytes((kind,)) + codec.varuint(register) + bytes((number,))
