"""The emulated moteus controller on the wire: frames of subframes, registers, replies."""

import math
from collections.abc import Callable

from pydantic import BaseModel, ConfigDict, Field

from drivers.frame import EFF_FLAG, pack_fd_frame
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
    MODE_COUNT,
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
_REPLY_MAX = codec.FD_PAYLOAD
_STREAM_MAX = 48
_TORQUE_HEAD = codec.torque_frame_parts(1.0, 1.0)[0]
_TORQUE_AT, _TORQUE_END = len(_TORQUE_HEAD), len(_TORQUE_HEAD) + 4
_KNOWN_TAILS_MAX = 8
_SOURCE_MASK = 0x7F
_INT32_ONLY = frozenset((*range(0x100, 0x103), *range(0x120, 0x123), *range(0x150, 0x154)))


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
        self._written: dict[int, float] = {}
        self._known_tails: dict[bytes, Command] = {}
        serial = (self._settings.serial, int(is_lockstep), HIL_MODEL_NUMBER)
        self._uuid = (HIL_MODEL_NUMBER, self._settings.serial, node_id, 0)
        self._constants = {
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
        self._written.clear()
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

    def tick(self, dt_s: float) -> None:
        """See `AmplifierNode.tick`."""
        self._milliseconds += dt_s * 1e3
        self.controller.tick(dt_s)

    def _send(self, to: int, data: bytes) -> None:
        can_id = codec.reply_id(self.node_id, to, prefix=self._settings.can_prefix)
        self._transmit(pack_fd_frame(can_id, data))

    # --- the frames of every cycle ------------------------------------------------------------

    def _answer_quickly(self, data: bytes) -> bytes | None:
        """Answer the frames that come in every cycle, as `_answer` would but ten times as fast.

        A torque command is known by all its bytes except the torque itself.
        """
        if data == codec.POLL:
            return self._state(codec.STATE_TAIL, self.controller.fault)
        if data[:_TORQUE_AT] != _TORQUE_HEAD:
            return None
        known = self._known_tails.get(data[_TORQUE_END:])
        if known is None:
            return None
        reply = self._state(_NOPS, codec.NOP)
        command = self.controller.command
        if command is not known:
            command = known
        (command.torque_Nm,) = _FLOAT(data, _TORQUE_AT)
        self._written[Register.COMMAND_TORQUE] = command.torque_Nm
        self.controller.obey(command)
        return reply

    def _state(self, tail: int, fault: int) -> bytes:
        drive = self.controller
        return codec.STATE.pack(
            codec.STATE_HEAD,
            drive.mode,
            codec.STATE_BODY,
            drive.position_rev(),
            drive.velocity_rev_s(),
            self.servo.torque_Nm,
            tail,
            fault,
        )

    # --- any frame ----------------------------------------------------------------------------

    def _answer(self, data: bytes) -> bytes | None:
        """Obey a frame and return its reply; None if it is meant for another one's UUID."""
        parts, is_malformed = codec.parse_subframes(data)
        self.malformed_frames += is_malformed
        self._is_commanded = False
        reply = bytearray()
        for part in parts:
            if part.kind == WRITE and not self._is_own_uuid(part):
                return None
            reply += self._obey(part, _REPLY_MAX - len(reply))
        if self._is_commanded:
            self._learn(data, is_malformed)
            self.controller.obey(self._pending)
        return codec.pad(bytes(reply))

    def _learn(self, data: bytes, is_malformed: bool) -> None:
        tail = data[_TORQUE_END:]
        if is_malformed or len(data) != codec.TORQUE_LENGTH or data[:_TORQUE_AT] != _TORQUE_HEAD:
            return
        if len(self._known_tails) >= _KNOWN_TAILS_MAX:
            self._known_tails.clear()
        self._known_tails[tail] = self._pending

    def _is_own_uuid(self, part: Subframe) -> bool:
        for register, number in enumerate(part.values, start=part.number):
            word = register - Register.UUID_MASK_1
            if 0 <= word < len(self._uuid) and int(number) & 0xFFFFFFFF != self._uuid[word]:
                return False
        return True

    def _obey(self, part: Subframe, room: int) -> bytes:
        if part.kind == WRITE:
            return self._write_all(part)[:room]
        if part.kind == READ:
            return self._read_all(part, room)
        if part.kind == CLIENT_DATA and part.number == CONSOLE_CHANNEL:
            waiting = self._console.give(min(_STREAM_MAX, max(0, room - 3)))
            self._console.take(part.data)
            return codec.pack_stream(SERVER_DATA, CONSOLE_CHANNEL, waiting)[:room]
        if part.kind == CLIENT_POLL and part.number == CONSOLE_CHANNEL:
            waiting = self._console.give(min(part.wanted, _STREAM_MAX, max(0, room - 3)))
            return codec.pack_stream(SERVER_DATA, CONSOLE_CHANNEL, waiting)[:room]
        return b""

    # --- registers ----------------------------------------------------------------------------

    def _read_all(self, part: Subframe, room: int) -> bytes:
        """Reply to a read: runs of values, an error in the place of what cannot be read."""
        out = bytearray()
        run: list[float] = []
        size = codec.VALUE[part.resolution].size
        last = part.number + min(part.wanted, _REPLY_MAX)
        for register in range(part.number, last):
            value = self._read(register, part.resolution)
            needed = len(out) + _HEAD_MAX + (len(run) + 1) * size
            if needed > room:
                break
            if value is not None:
                run.append(encode_value(value, scale_of(register), part.resolution))
                continue
            out += _reply(register, part.resolution, run)
            run = []
            out += bytes((READ_ERROR,)) + codec.varuint(register) + bytes((UNKNOWN_REGISTER,))
            last = register + 1
        else:
            last = max(last, part.number)
        stop = part.number + len(run) if not out else last
        return bytes(out + _reply(stop, part.resolution, run))

    def _read(self, register: int, resolution: int) -> float | None:
        if register in _INT32_ONLY and resolution != Resolution.INT32:
            return None
        if register in self._readings:
            return self._readings[register]()
        if register in self._constants:
            return self._constants[register]
        if register in _COMMAND_FIELDS or register in _ACCEPTED:
            default = _ACCEPTED.get(register, 0.0)
            return self._written.get(register, default)
        return None

    def _write_all(self, part: Subframe) -> bytes:
        errors = bytearray()
        for register, number in enumerate(part.values, start=part.number):
            error = self._write(
                register, decode_value(number, scale_of(register), part.resolution)
            )
            if error:
                errors += bytes((WRITE_ERROR,)) + codec.varuint(register) + bytes((error,))
        return bytes(errors)

    def _write(self, register: int, value: float) -> int:
        return 0


_ = (EFF_FLAG, MODE_COUNT, REPLY, COMMANDABLE, math)
