"""The emulated moteus controller without its bus: modes, watchdog, position loop, encoder.

Source: moteus documentation, "Register Reference" (docs/protocol/registers.md), "Configuration"
(docs/reference/configuration.md), "moteus reports mode 11".
"""

import math

from drivers.moteus.registers import LIMIT_MAX_TORQUE, Mode
from sim_backend.servo import Servo

TAU = 2.0 * math.pi
ENABLE_S = 5e-3
"""From the first command to mode 10: driver on, current sensors calibrated."""
POSITION_MAX_REV = 1e6
OUTSIDE_LIMIT = 39
"""Fault: started outside servopos.position_min and position_max."""
TORQUE_CONSTANT_KV_Nm_A = 8.27
COMMANDABLE = frozenset(
    (Mode.STOPPED, Mode.CURRENT, Mode.POSITION, Mode.TIMEOUT, Mode.ZERO_VELOCITY, Mode.BRAKE)
)
"""Modes that can be written here; a real controller has more, none of them needed for torque."""
_WITHOUT_POWER = frozenset((Mode.STOPPED, Mode.FAULT))
_POWERED = frozenset((Mode.CURRENT, Mode.POSITION, Mode.ZERO_VELOCITY, Mode.BRAKE))
_TO_POWER = frozenset((Mode.ENABLING, Mode.CALIBRATING, Mode.CALIBRATION_COMPLETE))


class Command:
    """What a command frame says; every frame starts from these defaults."""

    __slots__ = (
        "ignores_bounds",
        "kd_scale",
        "kp_scale",
        "max_torque_Nm",
        "mode",
        "position_rev",
        "q_current_A",
        "timeout_s",
        "torque_Nm",
        "velocity_rev_s",
    )

    def __init__(self, mode: int = Mode.STOPPED) -> None:
        self.mode = mode
        self.position_rev = 0.0
        self.velocity_rev_s = 0.0
        self.torque_Nm = 0.0
        self.kp_scale = 1.0
        self.kd_scale = 1.0
        self.max_torque_Nm = math.nan
        self.timeout_s = 0.0
        self.q_current_A = 0.0
        self.ignores_bounds = 0.0


def default_configuration(servo: Servo) -> dict[str, float]:
    """Return the configuration values that can be read and written, for this motor."""
    settings = servo.settings
    return {
        "servo.default_timeout_s": 0.1,
        "servo.timeout_mode": 12.0,
        "servo.timeout_max_torque_Nm": 5.0,
        "servo.max_current_A": settings.current_max_A,
        "servo.max_voltage": settings.supply_V * 1.1,
        "servo.pid_position.kp": 4.0,
        "servo.pid_position.ki": 1.0,
        "servo.pid_position.kd": 0.05,
        "servo.pid_position.ilimit": 0.0,
        "servopos.position_min": math.nan,
        "servopos.position_max": math.nan,
        "motor.Kv": TORQUE_CONSTANT_KV_Nm_A / settings.torque_constant_Nm_A,
        "motor_position.rotor_to_output_ratio": 1.0,
        "motor_position.sources.0.cpr": float(servo.counts_per_turn),
    }


class Controller:
    """Modes and control of one controller in front of its servo.

    Attributes:
        mode: Register MODE.
        fault: Register FAULT.
        configuration: Values by name; changes act at once.
        command: The command in force.
        control_torque_Nm: What the loop asks of the motor.
    """

    def __init__(self, servo: Servo) -> None:
        self.servo = servo
        self.configuration = default_configuration(servo)
        self._per_turn = servo.counts_per_turn
        self.power_on()

    def power_on(self) -> None:
        """Start as after power-up: stopped, the position within half a turn."""
        self.mode: int = Mode.STOPPED
        self.fault = 0
        self.command = Command()
        self.control_torque_Nm = 0.0
        self._age_s = 0.0
        self._enabling_s = 0.0
        self._target_rev = math.nan
        half = self._per_turn // 2
        self._seen = self.servo.counts
        self._counts = (self._seen + half) % self._per_turn - half
        self._zero_rev = 0.0
        self._apply()

    # --- measurements -----------------------------------------------------------------------

    def position_rev(self) -> float:
        """Position in turns of the output, counting on over whole turns."""
        seen = self.servo.counts
        if seen != self._seen:
            half = self._per_turn // 2
            self._counts += (seen - self._seen + half) % self._per_turn - half
            self._seen = seen
        return self._counts / self._per_turn + self._zero_rev

    def velocity_rev_s(self) -> float:
        """Rate of the output, from the joint's own and so without encoder noise."""
        return self.servo.dq_rad_s / TAU

    def set_position(self, position_rev: float, *, is_exact: bool) -> None:
        """Call the present position this, or the nearest that whole turns of the rotor allow."""
        if abs(position_rev) < POSITION_MAX_REV:  # not NaN
            shift = position_rev - self.position_rev()
            self._zero_rev += shift if is_exact else round(shift)

    # --- commands ---------------------------------------------------------------------------

    def obey(self, command: Command) -> None:
        """Take a command: the newest one counts; fault and timeout are left by a stop alone."""
        self.command = command
        self._age_s = 0.0
        if command.mode == Mode.STOPPED:
            self.mode, self.fault = Mode.STOPPED, 0
        elif self.mode == Mode.STOPPED:
            self.mode = Mode.ENABLING
            self._enabling_s = 0.0
        elif self.mode in _POWERED and self.mode != command.mode:
            self.mode = command.mode
        self._take_target()
        self._apply()

    def fail(self, code: int) -> None:
        """Enter fault: driver off at once."""
        self.mode, self.fault = Mode.FAULT, code
        self._apply()

    def tick(self, dt_s: float) -> None:
        """Let time pass: enabling, the watchdog, the position loop."""
        self.position_rev()
        self._age_s += dt_s
        if self.mode in _WITHOUT_POWER:
            return
        if self.mode in _TO_POWER:
            self._step_enabling(dt_s)
        elif self.mode == Mode.POSITION:
            command = self.command
            if self._is_overdue():
                self.mode = Mode.TIMEOUT
            elif not (command.kp_scale or command.kd_scale):
                return  # torque alone: it does not change with time
            else:
                self._target_rev += _finite(command.velocity_rev_s) * dt_s
        self._apply()

    def _step_enabling(self, dt_s: float) -> None:
        self._enabling_s += dt_s
        if self._enabling_s < ENABLE_S - 1e-9:
            if self.mode == Mode.ENABLING:
                self.mode = Mode.CALIBRATING
            return
        self.mode = self.command.mode
        if self.mode == Mode.POSITION and self._is_outside_bounds():
            self.fail(OUTSIDE_LIMIT)
        self._take_target()

    def _is_outside_bounds(self) -> bool:
        low = self.configuration["servopos.position_min"]
        high = self.configuration["servopos.position_max"]
        here = self.position_rev()
        return not self.command.ignores_bounds and (here < low or here > high)

    def _is_overdue(self) -> bool:
        limit_s = self.command.timeout_s
        if limit_s == 0.0:
            limit_s = self.configuration["servo.default_timeout_s"]
        return self._age_s >= limit_s - 1e-9  # NaN: never

    def _take_target(self) -> None:
        wanted = self.command.position_rev
        if math.isfinite(wanted):
            self._target_rev = wanted
        elif self.command.mode != Mode.POSITION or not math.isfinite(self._target_rev):
            self._target_rev = self.position_rev()

    # --- control ----------------------------------------------------------------------------

    def _apply(self) -> None:
        servo, mode = self.servo, self.mode
        if mode != Mode.FAULT:
            self.fault = 0
        if mode == Mode.TIMEOUT:
            mode = self._timeout_behaviour()
        servo.is_energised = mode in _POWERED
        if mode == Mode.POSITION:
            self.control_torque_Nm = self._position_torque_Nm()
        elif mode == Mode.CURRENT:
            current_A = _finite(self.command.q_current_A)
            wanted_Nm = current_A * servo.settings.torque_constant_Nm_A
            self.control_torque_Nm = _clip(wanted_Nm, servo.torque_max_Nm)
        elif mode in (Mode.ZERO_VELOCITY, Mode.BRAKE):
            self.control_torque_Nm = self._damping_torque_Nm(mode)
        else:
            self.control_torque_Nm = 0.0
        servo.torque_target_Nm = self.control_torque_Nm

    def _timeout_behaviour(self) -> int:
        chosen = self.configuration["servo.timeout_mode"]
        if chosen == Mode.BRAKE:
            return Mode.BRAKE
        return Mode.STOPPED if chosen == Mode.STOPPED else Mode.ZERO_VELOCITY

    def _position_torque_Nm(self) -> float:
        command = self.command
        torque_Nm = command.torque_Nm
        if command.kp_scale or command.kd_scale:
            torque_Nm += self._gain_torque_Nm()
        if torque_Nm - torque_Nm != 0.0:  # NaN or infinite
            torque_Nm = 0.0
        limit_Nm = command.max_torque_Nm
        if not limit_Nm < self.servo.torque_max_Nm:  # NaN: as much as the motor may give
            limit_Nm = self.servo.torque_max_Nm
        if -limit_Nm <= torque_Nm <= limit_Nm:
            return torque_Nm
        self.fault = LIMIT_MAX_TORQUE
        return math.copysign(max(limit_Nm, 0.0), torque_Nm)

    def _gain_torque_Nm(self) -> float:
        command, values = self.command, self.configuration
        kp_scale = command.kp_scale
        kd_scale = min(command.kd_scale, kp_scale)  # registers.md, 0x024
        error_rev = self._target_rev - self.position_rev()
        error_rev_s = _finite(command.velocity_rev_s) - self.velocity_rev_s()
        return (
            values["servo.pid_position.kp"] * kp_scale * error_rev
            + values["servo.pid_position.kd"] * kd_scale * error_rev_s
        )

    def _damping_torque_Nm(self, mode: int) -> float:
        limit_Nm = self.servo.torque_max_Nm
        if mode == Mode.BRAKE:  # what the shorted windings' current makes
            settings = self.servo.settings
            gain = settings.torque_constant_Nm_A**2 / settings.resistance_ohm
            return _clip(-gain * self.servo.dq_rad_s, limit_Nm)
        wanted_Nm = _finite(-self.configuration["servo.pid_position.kd"] * self.velocity_rev_s())
        if self.mode == Mode.TIMEOUT:
            limit_Nm = min(limit_Nm, abs(self.configuration["servo.timeout_max_torque_Nm"]))
        return _clip(wanted_Nm, limit_Nm)


def _clip(value: float, limit: float) -> float:
    return max(-limit, min(limit, value))


def _finite(value: float) -> float:
    return value if math.isfinite(value) else 0.0
