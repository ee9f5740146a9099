"""Master side of a Damiao motor."""

from drivers.axis import AxisInfo, AxisStatus, FrameHandler, Port
from drivers.errors import AmplifierError
from drivers.frame import pack_frame
from drivers.mit import codec
from drivers.mit.codec import DamiaoStatus, Register, RegisterCommand
from drivers.mit.master import MitAxis

REPLIES_LOOKED_AT = 16
"""Frames on the reply's identifier among which an answer is looked for."""
_STATUS_NAMES = {
    int(status): status.name.lower().replace("_", " ")
    for status in DamiaoStatus
    if status > DamiaoStatus.ENABLED
}
_REGISTER_MARKS = frozenset((RegisterCommand.READ, RegisterCommand.WRITE, RegisterCommand.SAVE))


class DamiaoAxis(MitAxis):
    """One Damiao motor: checked by its registers, watched by its register 9."""

    def _build_frames(self) -> None:
        node = self._settings.node_id
        self._torque_head = pack_frame(node, _rest(codec.ZERO_SHORT))[:14]
        self._zero_frame = pack_frame(node, _rest(codec.ZERO_SHORT))
        self._stop_frame = pack_frame(node, codec.DISABLE)
        self._enable_frame = pack_frame(node, codec.ENABLE)
        self._clear_frame = pack_frame(node, codec.CLEAR_FAULT)
        refresh = codec.pack_register(node, RegisterCommand.REFRESH, 0)
        self._poll_frame = pack_frame(codec.REGISTER_ID, refresh)

    def _torque_frame_of(self, code: int) -> bytes:
        return self._torque_head + code.to_bytes(2, "big")  # kd = 0 above the torque's 12 bits

    # --- start-up ---------------------------------------------------------------------------

    def configure(self, port: Port) -> AxisInfo:
        """Check state and ranges, set mode and watchdog; see `Axis.configure`."""
        self._refuse_if_enabled(port)
        s = self._settings
        for register, setting, wanted in (
            (Register.POSITION_RANGE, "position_range_rad", s.position_range_rad),
            (Register.VELOCITY_RANGE, "velocity_range_rad_s", s.velocity_range_rad_s),
            (Register.TORQUE_RANGE, "torque_range_Nm", s.torque_range_Nm),
        ):
            what = f"{register.name.lower().replace('_', ' ')} (register {int(register)})"
            self._require(what, self._read_float(port, register), wanted, setting)
        self._set(port, Register.CONTROL_MODE, codec.MIT_MODE)
        self._set(port, Register.TIMEOUT, s.watchdog_ms * codec.TIMEOUT_UNITS_PER_MS)
        hardware = self._read_number(port, Register.HARDWARE_VERSION)
        self._is_emulated = self._read_number(port, Register.SERIAL) == codec.HIL_SERIAL and (
            hardware in (codec.HIL_LOCKSTEP, codec.HIL_WALL)
        )
        version = self._read_number(port, Register.SOFTWARE_VERSION)
        name = f"{'hil emulated Damiao' if self._is_emulated else 'Damiao'} software {version}"
        is_lockstep = self._is_emulated and hardware == codec.HIL_LOCKSTEP
        return self._info(name, is_lockstep=is_lockstep)

    def _refuse_if_enabled(self, port: Port) -> None:
        s = self._settings
        refresh = codec.pack_register(s.node_id, RegisterCommand.REFRESH, 0)
        data = self._ask(port, codec.REGISTER_ID, refresh, s.reply_id)
        for _ in range(REPLIES_LOOKED_AT):
            feedback = codec.parse_feedback(data)
            if feedback is not None and feedback.head & 0xF == s.node_id:
                if feedback.head >> 4 == DamiaoStatus.ENABLED:
                    raise self._already_enabled()
                return
            later = port.wait(s.reply_id, s.reply_timeout_s)
            if later is None:
                break
            data = later
        raise self._silent(s.reply_id)

    def _set(self, port: Port, register: Register, value: int) -> None:
        """Write a register, unless it is so already, and read it back."""
        if self._read_number(port, register) == value:
            return
        self._exchange(port, RegisterCommand.WRITE, register, codec.U32.pack(value))
        found = self._read_number(port, register)
        if found != value:
            raise AmplifierError(
                f"{self.label}: {register.name.lower()} (register {int(register)}) is {found} "
                f"although it was set to {value}; set it with the vendor's tool"
            )

    def _read_float(self, port: Port, register: Register) -> float:
        return float(codec.F32.unpack(self._exchange(port, RegisterCommand.READ, register))[0])

    def _read_number(self, port: Port, register: Register) -> int:
        return int(codec.U32.unpack(self._exchange(port, RegisterCommand.READ, register))[0])

    def _exchange(
        self, port: Port, command: RegisterCommand, register: Register, raw: bytes = bytes(4)
    ) -> bytes:
        """Carry out one register command and return the 4 bytes of the answer."""
        s = self._settings
        request = codec.pack_register(s.node_id, command, register, raw)
        data = self._ask(port, codec.REGISTER_ID, request, s.reply_id)
        for _ in range(REPLIES_LOOKED_AT):
            reply = codec.parse_register(data)
            if reply is not None and reply[:3] == (s.node_id, command, register):
                return reply.raw
            later = port.wait(s.reply_id, s.reply_timeout_s)
            if later is None:
                break
            data = later
        raise AmplifierError(
            f"{self.label}: no answer about register {int(register)} "
            f"({register.name.lower()}) on identifier 0x{s.reply_id:X}; is it a Damiao motor?"
        )

    # --- in operation -----------------------------------------------------------------------

    def handlers(self) -> dict[int, FrameHandler]:
        """The motor's replies; others may share their identifier."""
        return {self._settings.reply_id: self._on_reply}

    def shared_ids(self) -> frozenset[int]:
        """Replies name their motor."""
        return frozenset((self._settings.reply_id,))

    def _on_reply(self, frame: bytes) -> bool:
        if frame[4] != codec.FEEDBACK_BYTES:
            return False
        head, position, mixed, torque_low = codec.FEEDBACK.unpack_from(frame, 8)
        if head & 0xF != self._settings.node_id:
            return False
        if position in _REGISTER_MARKS:  # somebody's register answer, or q at its range's end
            return False
        status = head >> 4
        if status != self._status_code or self.status is AxisStatus.LOST:
            self._take_status(status)
        return self._take_motion(position, mixed >> 4, (mixed & 0xF) << 8 | torque_low)

    def _take_status(self, status: int) -> None:
        self._status_code = status
        if status <= DamiaoStatus.ENABLED:
            self._take_power(is_on=status == DamiaoStatus.ENABLED)
        else:
            name = _STATUS_NAMES.get(status, "undocumented status")
            self._take_fault(f"drive fault {status:X}, {name}")


def _rest(torque: int) -> bytes:
    """Set-point with both gains zero; position and velocity then mean nothing."""
    return codec.pack_codes(codec.Codes(codec.ZERO_POSITION, codec.ZERO_SHORT, 0, 0, torque))
