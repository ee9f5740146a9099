"""One servo axis behind an amplifier's protocol: RL winding, 2 kHz current loop, encoder."""

import math
from collections import deque

from sim_backend.settings import ServoSettings

CURRENT_LOOP_PERIOD_S = 500e-6
TAU = 2.0 * math.pi


class Servo:
    """Motor, current loop and encoder of one axis.

    The amplifier's node sets `torque_target_Nm` and `is_energised`; the emulator calls `sense`
    with the plant's motion and `drive` once per current-loop period.

    Attributes:
        torque_target_Nm: Demanded joint torque, positive about the joint's axis. NaN, which some
            protocols can carry, demands none.
        is_energised: Power stage on. When off the winding is open: no current, no torque.
        current_A: Winding current at the end of the last current-loop period.
        q_rad: Angle at the encoder as last sensed (the plant's truth; nodes read `counts`): of the
            joint, or of the rotor where the encoder is on the motor's side of a drivetrain.
        dq_rad_s: Rate at the encoder as last sensed.
        motor_rad_s: Rate of the rotor as last sensed, which makes the back-EMF.
        is_saturated: The current demand was limited, or the voltage was, in the last period.
    """

    __slots__ = (
        "_current_max_A",
        "_decay",
        "_delayed_Nm",
        "_gain",
        "_integral_V",
        "_integral_gain",
        "_mean_weight",
        "_per_turn",
        "_per_turn_rad",
        "_resistance_ohm",
        "_supply_V",
        "_torque_constant_Nm_A",
        "current_A",
        "dq_rad_s",
        "is_energised",
        "is_saturated",
        "motor_rad_s",
        "q_rad",
        "settings",
        "torque_target_Nm",
    )

    def __init__(self, settings: ServoSettings) -> None:
        self.settings = settings
        self.torque_target_Nm = 0.0
        self.is_energised = False
        self.current_A = 0.0
        self.q_rad = 0.0
        self.dq_rad_s = 0.0
        self.motor_rad_s = 0.0
        self.is_saturated = False
        self._integral_V = 0.0
        periods = round(settings.command_delay_s / CURRENT_LOOP_PERIOD_S)
        self._delayed_Nm = deque([0.0] * periods, maxlen=periods) if periods else None
        ratio = CURRENT_LOOP_PERIOD_S * settings.resistance_ohm / settings.inductance_H
        self._decay = math.exp(-ratio)  # of the winding current over one period, voltage held
        self._mean_weight = (1.0 - self._decay) / ratio
        # PI with its zero on the winding's pole: the closed loop is one pole at the bandwidth.
        pole = math.exp(-TAU * settings.bandwidth_Hz * CURRENT_LOOP_PERIOD_S)
        self._gain = (1.0 - pole) * settings.resistance_ohm / (1.0 - self._decay)
        self._integral_gain = self._gain * (1.0 - self._decay)
        self._torque_constant_Nm_A = settings.torque_constant_Nm_A
        self._resistance_ohm = settings.resistance_ohm
        self._current_max_A = settings.current_max_A
        self._supply_V = settings.supply_V
        self._per_turn = 1 << settings.encoder_bits
        self._per_turn_rad = self._per_turn / TAU

    @property
    def counts(self) -> int:
        """Single-turn encoder reading, 0 .. 2**bits - 1, rounded to the nearest count."""
        raw = math.floor(self.q_rad * self._per_turn_rad + 0.5)
        return (raw + self.settings.encoder_offset_counts) % self._per_turn

    @property
    def counts_per_turn(self) -> int:
        """Encoder counts in one turn."""
        return self._per_turn

    @property
    def torque_Nm(self) -> float:
        """Motor torque at this instant, from the winding current."""
        return self.current_A * self.settings.torque_constant_Nm_A

    @property
    def torque_max_Nm(self) -> float:
        """Torque at the peak current."""
        return self.settings.current_max_A * self.settings.torque_constant_Nm_A

    def sense(self, q_rad: float, dq_rad_s: float, motor_rad_s: float | None = None) -> None:
        """Take over the plant's motion.

        Args:
            q_rad: Angle at the encoder.
            dq_rad_s: Rate at the encoder.
            motor_rad_s: Rate of the rotor; None if it is that at the encoder.
        """
        self.q_rad = q_rad
        self.dq_rad_s = dq_rad_s
        self.motor_rad_s = dq_rad_s if motor_rad_s is None else motor_rad_s

    def drive(self) -> float:
        """Run one period of the current loop and return the mean motor torque over it, in Nm."""
        if not self.is_energised:
            self.current_A = 0.0
            self._integral_V = 0.0
            self.is_saturated = False
            if self._delayed_Nm is not None:
                self._delayed_Nm.extend([0.0] * len(self._delayed_Nm))
            return 0.0
        target_Nm = self.torque_target_Nm
        if self._delayed_Nm is not None:
            target_Nm, newest_Nm = self._delayed_Nm[0], target_Nm
            self._delayed_Nm.append(newest_Nm)  # pushes the oldest out
        demand_A = target_Nm / self._torque_constant_Nm_A
        limit_A, limit_V = self._current_max_A, self._supply_V
        limited_A = demand_A if -limit_A <= demand_A <= limit_A else _clip(demand_A, limit_A)
        before_A = self.current_A
        error_A = limited_A - before_A
        wanted_V = self._gain * error_A + self._integral_V
        voltage_V = wanted_V if -limit_V <= wanted_V <= limit_V else _clip(wanted_V, limit_V)
        if voltage_V == wanted_V:  # the integral waits while the supply limits
            self._integral_V += self._integral_gain * error_A
        self.is_saturated = voltage_V != wanted_V or limited_A != demand_A
        torque_constant_Nm_A = self._torque_constant_Nm_A
        settled_A = (voltage_V - torque_constant_Nm_A * self.motor_rad_s) / self._resistance_ohm
        self.current_A = settled_A + (before_A - settled_A) * self._decay
        mean_A = settled_A + (before_A - settled_A) * self._mean_weight
        return mean_A * torque_constant_Nm_A


def _clip(value: float, limit: float) -> float:
    """Limit a value that is not within +-`limit`; NaN becomes 0."""
    if value > limit:
        return limit
    return -limit if value < -limit else 0.0
