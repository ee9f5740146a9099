"""The emulated CyberGear and RobStride motors: 29-bit identifiers, parameters, fault reports."""

import math

from drivers.mit import codec as mit_codec
from drivers.mit import robstride_codec as codec
from drivers.mit.robstride_codec import Identifier, Mode, Parameter, Status, Type
from sim_backend.mit.node import TEMPERATURE_C, MitNode
from sim_backend.mit.settings import MitNodeSettings
from sim_backend.node import Transmit
from sim_backend.servo import Servo

INJECTED_FAULT = 1 << 1
"""Over current, as the reply's identifier says it."""
INJECTED_REPORT = 1 << 16
"""Phase A over current, as the fault report says it."""
UNKNOWN_PARAMETER = 1
"""Upper byte of the middle of a read's identifier: there is no such parameter."""
_WATCHDOG_UNIT_S = 1e-3 / codec.TIMEOUT_UNITS_PER_MS
_VOLTAGE_V = 24.0

_FLOATS = {
    0x7006: 0.0, 0x700A: 0.0, 0x700B: 0.0, 0x7010: 0.125, 0x7011: 0.0158, 0x7014: 0.1, 0x7016: 0.0,
    0x7017: 2.0, 0x7018: 23.0, 0x7019: 0.0, 0x701A: 0.0, 0x701B: 0.0, 0x701C: _VOLTAGE_V,
    0x701E: 30.0, 0x701F: 1.0, 0x7020: 0.002,
}  # fmt: skip
_ROBSTRIDE_FLOATS = {0x7021: 0.1, 0x7022: 20.0, 0x7024: 10.0, 0x7025: 10.0, 0x702B: 0.0}
_ROTATION = 0x701D  # CyberGear only
_NUMBERS = {0x7005: codec.OPERATION_MODE, _ROTATION: 0}
_ROBSTRIDE_NUMBERS = {0x7005: codec.OPERATION_MODE, 0x7026: 1, 0x7028: 0, 0x7029: 0, 0x702A: 0}
_READ_ONLY = frozenset((0x7019, 0x701A, 0x701B, 0x701C))


class RobStrideNode(MitNode):
    """A CyberGear or RobStride motor in operation mode; its other modes are not followed.

    Every frame is answered with the feedback frame (type 2) unless its type has an answer of its
    own. The watchdog (RobStride: 0x7028, off at power-on) puts the motor into reset mode without a
    fault. Faults refuse power until a stop frame with byte 0 = 1, and are reported once (type 21).
    """

    def __init__(self, settings: MitNodeSettings, servo: Servo, transmit: Transmit) -> None:
        super().__init__(settings, servo, transmit)
        self.parameters: dict[int, float] = {}
        self._host_id = settings.reply_id
        self._restore_parameters()

    def power_on(self) -> None:
        """See `MitNode.power_on`."""
        super().power_on()
        self._restore_parameters()

    def _restore_parameters(self) -> None:
        self.parameters = {**_FLOATS, Parameter.TORQUE_LIMIT: self.ranges.torque_Nm}
        self._limit_torque(self.ranges.torque_Nm)
        if self.settings.variant == "robstride":
            self.parameters |= {**_ROBSTRIDE_FLOATS, **_ROBSTRIDE_NUMBERS}
            self.watchdog_s = 0.0
        else:
            self.parameters |= _NUMBERS
            self.watchdog_s = 1e-3 * self.settings.watchdog_ms

    @property
    def unique(self) -> bytes:
        """MCU identifier, 8 bytes."""
        is_lockstep = self.settings.is_lockstep
        return codec.HIL_UNIQUE_LOCKSTEP if is_lockstep else codec.HIL_UNIQUE_WALL

    def fail_power_stage(self) -> None:
        """See `AmplifierNode.fail_power_stage`."""
        self.fail(INJECTED_FAULT)

    def lose_master(self) -> None:
        """Go to reset mode."""
        self.disable()

    def receive(self, can_id: int, data: bytes) -> None:
        """See `AmplifierNode.receive`."""
        identifier = codec.parse_id(can_id)
        if identifier is None:
            return
        if self._is_injection(can_id, data):
            self.fail(INJECTED_FAULT)
            self._report_fault(INJECTED_REPORT)
        elif identifier.target == self.node_id:
            self._take(identifier, data)

    def _take(self, identifier: Identifier, data: bytes) -> None:
        self.feed_watchdog()
        kind = identifier.type
        if kind == Type.CONTROL:
            self._control(identifier, data)
            return
        self._host_id = identifier.data & 0xFF
        if kind == Type.IDENTITY:
            self._identify()
        elif kind == Type.READ:
            self._read(data)
        elif kind == Type.SET_NODE_ID:
            self.node_id = identifier.data >> 8 or self.node_id
            self._identify()
        elif self._obey(kind, data):
            self._reply()

    def _obey(self, kind: int, data: bytes) -> bool:
        """Carry out what is answered with a feedback frame; False if it is nothing known."""
        if kind == Type.ENABLE:
            self.enable()
        elif kind == Type.STOP:
            self.disable()
            if data[:1] == b"\x01":
                self.fault = 0
        elif kind == Type.SET_ZERO:
            if data[:1] == b"\x01":
                self.set_zero()
        elif kind == Type.WRITE:
            parsed = codec.parse_parameter(data)
            if parsed is not None:
                self._write(*parsed)
        else:
            return kind == Type.SAVE
        return True

    def _control(self, identifier: Identifier, data: bytes) -> None:
        codes = codec.parse_control(identifier, data)
        if codes is None:
            return
        if self.parameters[Parameter.RUN_MODE] == codec.OPERATION_MODE:
            self.follow(mit_codec.to_setpoint(codes, self.ranges, wide=True))
        self._reply()

    def _reply(self) -> None:
        r = self.ranges
        data = codec.FEEDBACK.pack(
            mit_codec.to_code(self.position_rad, r.position_rad, codec.CODES),
            mit_codec.to_code(self.velocity_rad_s, r.velocity_rad_s, codec.CODES),
            mit_codec.to_code(self.servo.torque_Nm, r.torque_Nm, codec.CODES),
            10 * TEMPERATURE_C,
        )
        mode = Mode.RUN if self.is_enabled else Mode.RESET
        status = Status(self.node_id, mode, self.fault)
        self._send(codec.feedback_id(status, self._host_id), data)

    def _identify(self) -> None:
        self._send(codec.pack_id(Type.IDENTITY, self.node_id, codec.ALL_HOSTS), self.unique)

    def _report_fault(self, faults: int) -> None:
        can_id = codec.pack_id(Type.FAULT_REPORT, self.node_id, self._host_id)
        self._send(can_id, codec.FAULT_REPORT.pack(faults, 0))

    # --- parameters ---------------------------------------------------------------------------

    def _read(self, data: bytes) -> None:
        parsed = codec.parse_parameter(data)
        if parsed is None:
            return
        index = parsed[0]
        is_known = index in self.parameters
        high = 0 if is_known else UNKNOWN_PARAMETER
        can_id = codec.pack_id(Type.READ, high << 8 | self.node_id, self._host_id)
        self._send(can_id, codec.pack_parameter(index, self._raw(index) if is_known else bytes(4)))

    def _raw(self, index: int) -> bytes:
        if index in _NUMBERS or index in _ROBSTRIDE_NUMBERS:
            return codec.U32.pack(int(self.parameters[index]))
        live = {
            Parameter.POSITION: self.position_rad,
            Parameter.VELOCITY: self.velocity_rad_s,
            0x701A: self.servo.current_A,
        }
        return codec.F32.pack(live.get(index, self.parameters[index]))

    def _write(self, index: int, raw: bytes) -> None:
        """Take a value if there is such a parameter to write, and the value can be meant."""
        if index not in self.parameters or index in _READ_ONLY:
            return
        if index in _NUMBERS or index in _ROBSTRIDE_NUMBERS:
            self._write_number(index, codec.U32.unpack(raw)[0])
            return
        value = codec.F32.unpack(raw)[0]
        if not math.isfinite(value):
            return
        if index == Parameter.TORQUE_LIMIT:
            value = max(0.0, min(value, self.ranges.torque_Nm))
            self._limit_torque(value)
        self.parameters[index] = value

    def _write_number(self, index: int, value: int) -> None:
        if index == Parameter.RUN_MODE:
            value &= 0xFF
            self.follow(self.setpoint._replace(kp_Nm_rad=0.0, kd_Nms_rad=0.0, torque_Nm=0.0))
        self.parameters[index] = value
        if index == Parameter.CAN_TIMEOUT:
            self.watchdog_s = value * _WATCHDOG_UNIT_S

    def _limit_torque(self, limit_Nm: float) -> None:
        self.torque_limit_Nm = min(self.servo.torque_max_Nm, limit_Nm)
