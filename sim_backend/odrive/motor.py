"""The emulated ODrive's inner loops: encoder estimates, and from an input to a motor torque."""

import math

from drivers.odrive.codec import INPUT_PASSTHROUGH, ControlMode
from sim_backend.servo import Servo

ESTIMATOR_BANDWIDTH_RAD_S = 250.0
"""Of the velocity's phase-locked loop; slower than a real one's 1000 because it runs at 1 kHz."""


class EncoderEstimate:
    """Position and velocity of the motor, in turns, from the servo's single-turn encoder.

    The position is the encoder's, quantised; a real drive smooths it. Velocity comes from a
    critically damped phase-locked loop.

    Args:
        servo: Whose encoder; it reads the joint.
        gear_ratio: Motor turns per joint turn.
    """

    def __init__(self, servo: Servo, gear_ratio: float) -> None:
        self._servo = servo
        self._rev_per_count = gear_ratio / servo.counts_per_turn
        self._half = servo.counts_per_turn // 2
        self.restart()

    def restart(self) -> None:
        """Begin anew at the encoder's absolute reading."""
        self._raw = self._counts = self._servo.counts
        self._offset_rev = 0.0
        self._estimate = float(self._counts)
        self._rate = 0.0

    def position_rev(self) -> float:
        """Return the position at this instant, many turns long."""
        raw = self._servo.counts
        if raw != self._raw:
            half = self._half
            self._counts += (raw - self._raw + half) % (2 * half) - half
            self._raw = raw
        return self._counts * self._rev_per_count + self._offset_rev

    @property
    def velocity_rev_s(self) -> float:
        """Velocity as of the last tick."""
        return self._rate * self._rev_per_count

    def set_position(self, position_rev: float) -> None:
        """Call the present position by another number (0x19)."""
        self._offset_rev += position_rev - self.position_rev()

    def tick(self, dt_s: float) -> None:
        """Advance the phase-locked loop."""
        self.position_rev()
        self._estimate += self._rate * dt_s
        error = self._counts - self._estimate
        step = ESTIMATOR_BANDWIDTH_RAD_S**2 * dt_s
        self._estimate += 2.0 * ESTIMATOR_BANDWIDTH_RAD_S * error * dt_s
        self._rate += step * error
        if abs(self._rate) < 0.5 * step:  # as the firmware snaps to zero
            self._rate = 0.0


class Controller:
    """Position, velocity and torque control of the motor side (firmware: Controller::update).

    Attributes:
        mode: `ControlMode`; others than position, velocity and torque give no torque.
        input_mode: Only pass-through moves the set-points.
        input_pos_rev, input_vel_rev_s, input_torque_Nm: What the master asked for.
        torque_min_Nm, torque_max_Nm: Soft limits.
        vel_limit_rev_s: Of the velocity set-point, and of the motor.
        is_torque_mode_limited: In torque control, torque falls off towards `vel_limit_rev_s`, by
            `vel_gain`: at the defaults 1.67 Nm at standstill, whatever is asked for.
    """

    def __init__(self) -> None:
        self.mode: int = ControlMode.POSITION
        self.input_mode: int = INPUT_PASSTHROUGH
        self.input_pos_rev = 0.0
        self.input_vel_rev_s = 0.0
        self.input_torque_Nm = 0.0
        self.torque_min_Nm = -math.inf
        self.torque_max_Nm = math.inf
        self.vel_limit_rev_s = 10.0
        self.vel_limit_tolerance = 1.2
        self.is_torque_mode_limited = True
        self.pos_gain = 20.0
        self.vel_gain = 1.0 / 6.0
        self.vel_integrator_gain = 1.0 / 3.0
        self._integral_Nm = 0.0

    def restart(self, position_rev: float) -> None:
        """Enter closed loop control where the motor is; velocity and torque inputs stay."""
        self._integral_Nm = 0.0
        self.input_pos_rev = position_rev

    def is_overspeed(self, velocity_rev_s: float) -> bool:
        """Tell whether the velocity is beyond its limit and tolerance."""
        return abs(velocity_rev_s) > self.vel_limit_rev_s * self.vel_limit_tolerance

    def torque_Nm(self, encoder: EncoderEstimate, dt_s: float) -> float:
        """Return the motor torque to apply; never NaN.

        Args:
            encoder: Where the motor is, and how fast.
            dt_s: Time since the last call, for the integrator; 0 if only the input is new.
        """
        if self.mode == ControlMode.TORQUE:
            torque_Nm = self.input_torque_Nm
            if self.is_torque_mode_limited:
                limit, velocity_rev_s = self.vel_limit_rev_s, encoder.velocity_rev_s
                torque_Nm = clamp(
                    torque_Nm,
                    (-limit - velocity_rev_s) * self.vel_gain,
                    (limit - velocity_rev_s) * self.vel_gain,
                )
        elif self.mode in (ControlMode.VELOCITY, ControlMode.POSITION):
            torque_Nm = self._velocity_loop(encoder, dt_s)
        else:
            return 0.0
        return clamp(torque_Nm, self.torque_min_Nm, self.torque_max_Nm)

    def _velocity_loop(self, encoder: EncoderEstimate, dt_s: float) -> float:
        wanted_rev_s = self.input_vel_rev_s
        if self.mode == ControlMode.POSITION:
            wanted_rev_s += self.pos_gain * (self.input_pos_rev - encoder.position_rev())
        wanted_rev_s = clamp(wanted_rev_s, -self.vel_limit_rev_s, self.vel_limit_rev_s)
        error_rev_s = wanted_rev_s - encoder.velocity_rev_s
        torque_Nm = self.input_torque_Nm + self.vel_gain * error_rev_s + self._integral_Nm
        if self.torque_min_Nm <= torque_Nm <= self.torque_max_Nm:
            self._integral_Nm += self.vel_integrator_gain * error_rev_s * dt_s
        return torque_Nm


def clamp(value: float, low: float, high: float) -> float:
    """Limit to the range; NaN, in the value or in a limit, gives 0."""
    if low <= value <= high:
        return value
    if value > high >= low:
        return high
    return low if value < low <= high else 0.0
