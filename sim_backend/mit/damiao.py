"""The emulated Damiao motor: MIT mode, registers, command watchdog."""

import math

from drivers.mit import codec
from drivers.mit.codec import DamiaoStatus, Feedback, Register, RegisterCommand, RegisterFrame
from sim_backend.mit.node import TEMPERATURE_C, MitNode
from sim_backend.mit.settings import MitNodeSettings
from sim_backend.node import Transmit
from sim_backend.servo import Servo

SOFTWARE_VERSION = 5013
INJECTED_FAULT = DamiaoStatus.OVER_CURRENT
_WATCHDOG_UNIT_S = 1e-3 / codec.TIMEOUT_UNITS_PER_MS
_ALL_IDS_MASK = 0x7FF

_WRITABLE_FLOATS = {
    0: 15.0, 1: 0.0, 2: 100.0, 3: 0.98, 4: 2.0, 5: -2.0, 6: 100.0, 21: 0.0, 22: 0.0, 23: 0.0,
    24: 1000.0, 25: 3.7e-4, 26: 2e-3, 27: 50.0, 28: 1.0, 29: 32.0, 30: 1.0, 31: 4.0, 32: 25.0,
    33: 500.0, 34: 30.0,
}  # fmt: skip
_WRITABLE_NUMBERS = {7: 0, 8: 0, 9: 0, 10: codec.MIT_MODE, 35: 4}
_FIXED_FLOATS = {
    11: 0.0, 12: 1.8e-5, 17: 0.85, 18: 3.45e-4, 19: 4.5e-3, 20: 10.0, 50: 0.0, 51: 0.0, 52: 1.0,
    53: 1.0, 54: 0.0, 55: 1.0, 56: 0.0, 59: 10.26, 60: 24.0, 61: float(TEMPERATURE_C),
    62: float(TEMPERATURE_C), 63: 0.0, 64: 0.0, 65: 0.0, 80: 0.0, 81: 0.0,
}  # fmt: skip
_FIXED_NUMBERS = {13: 0, 14: SOFTWARE_VERSION, 15: codec.HIL_SERIAL, 16: 14, 36: 0}
_LIVE_ANGLES = (80, 81)
_NUMBERS = frozenset((*_WRITABLE_NUMBERS, *_FIXED_NUMBERS))
_WRITABLE = frozenset((*_WRITABLE_FLOATS, *_WRITABLE_NUMBERS))
_RANGES = (Register.POSITION_RANGE, Register.VELOCITY_RANGE, Register.TORQUE_RANGE)


class DamiaoNode(MitNode):
    """A Damiao motor in MIT mode; set-points in its other modes are not followed.

    Registers written are kept until power-off. Power, faults and the watchdog:

    - disabled -FC-> enabled -FD-> disabled;
    - any fault: power off, the reply says which, FC is refused until FB;
    - register 9 units of 50 us without a frame to its own identifier while enabled: fault D.
    """

    def __init__(self, settings: MitNodeSettings, servo: Servo, transmit: Transmit) -> None:
        super().__init__(settings, servo, transmit)
        self.registers: dict[int, float] = {}
        self._restore_registers()

    def power_on(self) -> None:
        """See `MitNode.power_on`."""
        super().power_on()
        self._restore_registers()

    def _restore_registers(self) -> None:
        s, r = self.settings, self.settings.ranges
        self.registers = {
            **_WRITABLE_FLOATS, **_WRITABLE_NUMBERS, **_FIXED_FLOATS, **_FIXED_NUMBERS
        }  # fmt: skip
        self.registers |= {
            Register.MASTER_ID: s.reply_id,
            Register.NODE_ID: s.node_id,
            Register.HARDWARE_VERSION: codec.HIL_LOCKSTEP if s.is_lockstep else codec.HIL_WALL,
            **dict(zip(_RANGES, r[:3], strict=True)),
        }
        self.watchdog_s = 0.0

    @property
    def status(self) -> int:
        """As the reply's first byte says it."""
        return self.fault or int(self.is_enabled)

    def fail_power_stage(self) -> None:
        """See `AmplifierNode.fail_power_stage`."""
        self.fail(INJECTED_FAULT)

    def lose_master(self) -> None:
        """Switch off with fault D; FB ends it, and then the motor is disabled."""
        self.fail(DamiaoStatus.LOST_COMMUNICATION)

    def receive(self, can_id: int, data: bytes) -> None:
        """See `AmplifierNode.receive`."""
        if can_id == self.node_id:
            self._take_frame(data)
        elif can_id == codec.REGISTER_ID:
            self._take_register_frame(data)
        elif self._is_injection(can_id, data):
            self.fail(INJECTED_FAULT)

    def _take_frame(self, data: bytes) -> None:
        if len(data) != codec.FEEDBACK_BYTES:
            return
        self.feed_watchdog()
        if data == codec.ENABLE:
            self.enable()
        elif data == codec.DISABLE:
            self.disable()
        elif data == codec.SET_ZERO:
            self.set_zero()
        elif data == codec.CLEAR_FAULT:
            self.fault = 0
        elif self.registers[Register.CONTROL_MODE] == codec.MIT_MODE:
            codes = codec.parse_command(data)
            if codes is None:
                return
            self.follow(codec.to_setpoint(codes, self.ranges))
        else:
            return
        self._reply()

    def _reply(self) -> None:
        r = self.ranges
        torque_Nm = self.servo.torque_Nm
        feedback = Feedback(
            self.status << 4 | self.node_id & 0xF,
            codec.to_code(self.position_rad, r.position_rad, codec.POSITION_CODES),
            codec.to_code(self.velocity_rad_s, r.velocity_rad_s, codec.SHORT_CODES),
            codec.to_code(torque_Nm, r.torque_Nm, codec.SHORT_CODES),
            (TEMPERATURE_C, TEMPERATURE_C),
        )
        self._send(int(self.registers[Register.MASTER_ID]), codec.pack_feedback(feedback))

    # --- registers ----------------------------------------------------------------------------

    def _take_register_frame(self, data: bytes) -> None:
        request = codec.parse_register(data)
        if request is None or request.node_id != self.node_id:
            return
        if request.command == RegisterCommand.REFRESH:
            self._reply()
            return
        if request.command == RegisterCommand.SAVE:
            self._answer(request, request.raw)
            return
        if request.register not in self.registers:
            return
        if request.command == RegisterCommand.WRITE:
            self._write(request.register, request.raw)
        self._answer(request, self._raw(request.register))

    def _answer(self, request: RegisterFrame, raw: bytes) -> None:
        command = RegisterCommand(request.command)
        data = codec.pack_register(request.node_id, command, request.register, raw)
        self._send(int(self.registers[Register.MASTER_ID]), data)

    def _raw(self, register: int) -> bytes:
        value = self.position_rad if register in _LIVE_ANGLES else self.registers[register]
        if register in _NUMBERS:
            return codec.U32.pack(int(value))
        return codec.F32.pack(value)

    def _write(self, register: int, raw: bytes) -> None:
        """Take a value if the register can be written, and the value can be meant."""
        if register not in _WRITABLE:
            return
        if register in _NUMBERS:
            self._write_number(register, codec.U32.unpack(raw)[0])
            return
        value = codec.F32.unpack(raw)[0]
        if not math.isfinite(value) or (register in _RANGES and not 0.0 < value < 1e6):
            return
        self.registers[register] = value
        if register in _RANGES:
            p, v, t = (self.registers[r] for r in _RANGES)
            self.ranges = self.ranges._replace(position_rad=p, velocity_rad_s=v, torque_Nm=t)
            self.torque_limit_Nm = min(self.servo.torque_max_Nm, t)

    def _write_number(self, register: int, value: int) -> None:
        if register in (Register.MASTER_ID, Register.NODE_ID) and value > _ALL_IDS_MASK:
            return
        if register == Register.CONTROL_MODE and not 1 <= value <= 4:
            return
        self.registers[register] = value
        if register == Register.NODE_ID:
            self.node_id = value
        elif register == Register.TIMEOUT:
            self.watchdog_s = value * _WATCHDOG_UNIT_S
