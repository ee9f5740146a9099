"""Master side of CyberGear and RobStride motors: 29-bit identifiers."""

import sys
from struct import Struct

from drivers.axis import AxisInfo, AxisStatus, FrameHandler, Port
from drivers.errors import AmplifierError
from drivers.frame import pack_frame
from drivers.mit import robstride_codec as codec
from drivers.mit.codec import Codes
from drivers.mit.master import LISTEN_S, MitAxis
from drivers.mit.robstride_codec import Mode, Parameter, Status, Type

_STATUS_INDEX = 2 if sys.byteorder == "little" else 1
"""Of the record's byte with mode and faults: bits 16 to 23 of the identifier."""
_RUNNING = Mode.RUN << 6
_pack_id = Struct("=I").pack


class RobStrideAxis(MitAxis):
    """One motor with status bits in its identifiers; RobStride's watchdog is set and verified."""

    def _build_frames(self) -> None:
        s = self._settings
        rest = Codes(codec.ZERO, codec.ZERO, 0, 0, 0)
        can_id, data = codec.pack_control(s.node_id, rest)
        self._control_id = can_id
        self._control_tail = pack_frame(can_id, data)[4:]
        self._zero_frame = self._torque_frame_of(codec.ZERO)
        host = s.reply_id
        stop_id = codec.pack_id(Type.STOP, host, s.node_id)
        self._stop_frame = self._poll_frame = pack_frame(stop_id, codec.STOP_DATA)
        self._clear_frame = pack_frame(stop_id, codec.CLEAR_DATA)
        enable_id = codec.pack_id(Type.ENABLE, host, s.node_id)
        self._enable_frame = pack_frame(enable_id, bytes(8))

    def _torque_frame_of(self, code: int) -> bytes:
        return _pack_id(self._control_id | code << 8) + self._control_tail

    # --- start-up ---------------------------------------------------------------------------

    def configure(self, port: Port) -> AxisInfo:
        """Identify the motor; set mode, torque limit and, if it has one, the watchdog."""
        s = self._settings
        request = codec.pack_id(Type.IDENTITY, s.reply_id, s.node_id)
        answer = codec.pack_id(Type.IDENTITY, s.node_id, codec.ALL_HOSTS)
        unique = self._ask(port, request, bytes(8), answer)
        self._is_emulated = unique in codec.HIL_UNIQUE
        self._limit_torque(port)
        self._set(port, Parameter.RUN_MODE, codec.U8, codec.OPERATION_MODE)
        if s.has_settable_watchdog:
            units = s.watchdog_ms * codec.TIMEOUT_UNITS_PER_MS
            self._set(port, Parameter.CAN_TIMEOUT, codec.U32, units)
        name = f"{'hil emulated ' if self._is_emulated else ''}{s.variant} {unique.hex()}"
        if not s.has_settable_watchdog:
            name += ", command watchdog not readable"
        return self._info(name, is_lockstep=unique == codec.HIL_UNIQUE_LOCKSTEP)

    def _limit_torque(self, port: Port) -> None:
        """Write the motor's own limit; its answer also tells whether it is running."""
        s = self._settings
        parameter, limit = Parameter.TORQUE_LIMIT, codec.F32.pack(s.torque_max_Nm)
        self._write(port, parameter, limit)
        running = codec.feedback_id(Status(s.node_id, Mode.RUN, 0), s.reply_id)
        if port.wait(running, LISTEN_S) is not None:
            raise self._already_enabled()
        found = float(codec.F32.unpack(self._read(port, parameter))[0])
        self._require("torque limit 0x700B [Nm]", found, s.torque_max_Nm, "torque_max_Nm")

    def _set(self, port: Port, parameter: Parameter, layout: Struct, value: int) -> None:
        self._write(port, parameter, layout.pack(value))
        found = int(layout.unpack(self._read(port, parameter))[0])
        if found != value:
            raise AmplifierError(
                f"{self.label}: {parameter.name.lower()} (0x{int(parameter):X}) is {found} "
                f"although it was set to {value}; set it with the vendor's tool"
            )

    def _write(self, port: Port, parameter: Parameter, raw: bytes) -> None:
        s = self._settings
        can_id = codec.pack_id(Type.WRITE, s.reply_id, s.node_id)
        port.send(can_id, codec.pack_parameter(parameter, raw))

    def _read(self, port: Port, parameter: Parameter) -> bytes:
        s = self._settings
        request = codec.pack_id(Type.READ, s.reply_id, s.node_id)
        answer = codec.pack_id(Type.READ, s.node_id, s.reply_id)
        data = self._ask(port, request, codec.pack_parameter(parameter), answer)
        parsed = codec.parse_parameter(data)
        if parsed is None or parsed[0] != parameter:
            raise AmplifierError(
                f"{self.label}: answered {data.hex(' ') or 'nothing'} about parameter "
                f"0x{int(parameter):X} ({parameter.name.lower()}); is the variant right?"
            )
        return parsed[1]

    # --- in operation -----------------------------------------------------------------------

    def handlers(self) -> dict[int, FrameHandler]:
        """Replies, whose identifiers carry the status, and fault reports."""
        node, host = self._settings.node_id, self._settings.reply_id
        handlers: dict[int, FrameHandler] = {
            codec.feedback_id(Status(node, mode, faults), host): self._on_reply
            for mode in Mode
            for faults in range(1 << len(codec.FAULTS))
        }
        handlers[codec.pack_id(Type.FAULT_REPORT, node, host)] = self._on_fault_report
        handlers[codec.pack_id(Type.FAULT_REPORT, host, node)] = self._on_fault_report
        return handlers

    def _on_reply(self, frame: bytes) -> bool:
        if frame[4] != codec.FEEDBACK.size:
            return False
        status = frame[_STATUS_INDEX]
        if status != self._status_code or self.status is AxisStatus.LOST:
            self._take_status(status)
        position, velocity, torque, _ = codec.FEEDBACK.unpack_from(frame, 8)
        return self._take_motion(position, velocity, torque)

    def _take_status(self, status: int) -> None:
        self._status_code = status
        faults = status & 0x3F
        if faults:
            names = codec.fault_names(faults, codec.FAULTS)
            self._take_fault(f"drive fault {faults:02X}, {names}")
        elif status in (Mode.RESET, _RUNNING):
            self._take_power(is_on=status == _RUNNING)
        else:
            self._take_fault("is being calibrated")

    def _on_fault_report(self, frame: bytes) -> bool:
        if frame[4] == codec.FAULT_REPORT.size:
            faults, _ = codec.FAULT_REPORT.unpack_from(frame, 8)
            if faults and not self._reset_cycles:
                names = codec.fault_names(faults, codec.REPORTED_FAULTS)
                self._take_fault(f"drive fault {faults:08X}, {names}")
        return False
