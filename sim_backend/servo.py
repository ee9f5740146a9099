"""One servo axis behind an amplifier's protocol: RL winding, 2 kHz current loop, encoder."""

import math

from sim_backend.settings import ServoSettings

CURRENT_LOOP_PERIOD_S = 500e-6
TAU = 2.0 * math.pi


class Servo:
    """Motor, current loop and encoder of one direct-drive axis.

    The amplifier's node sets `torque_target_Nm` and `is_energised`; the emulator calls `sense`
    with the plant's motion and `drive` once per current-loop period.

    Attributes:
        torque_target_Nm: Demanded joint torque, positive about the joint's axis.
        is_energised: Power stage on. When off the winding is open: no current, no torque.
        current_A: Winding current at the end of the last current-loop period.
        q_rad: Joint angle as last sensed (the plant's truth; nodes read `counts`).
        dq_rad_s: Joint rate as last sensed.
        is_saturated: The current demand was limited, or the voltage was, in the last period.
    """

    __slots__ = (
        "_decay",
        "_gain",
        "_integral_V",
        "_mean_weight",
        "_per_turn",
        "_per_turn_rad",
        "current_A",
        "dq_rad_s",
        "is_energised",
        "is_saturated",
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
        self.is_saturated = False
        self._integral_V = 0.0
        ratio = CURRENT_LOOP_PERIOD_S * settings.resistance_ohm / settings.inductance_H
        self._decay = math.exp(-ratio)  # of the winding current over one period, voltage held
        self._mean_weight = (1.0 - self._decay) / ratio
        # PI with its zero on the winding's pole: the closed loop is one pole at the bandwidth.
        pole = math.exp(-TAU * settings.bandwidth_Hz * CURRENT_LOOP_PERIOD_S)
        self._gain = (1.0 - pole) * settings.resistance_ohm / (1.0 - self._decay)
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

    def sense(self, q_rad: float, dq_rad_s: float) -> None:
        """Take over the plant's joint angle and rate."""
        self.q_rad = q_rad
        self.dq_rad_s = dq_rad_s

    def drive(self) -> float:
        """Run one period of the current loop and return the mean motor torque over it, in Nm."""
        if not self.is_energised:
            self.current_A = 0.0
            self._integral_V = 0.0
            self.is_saturated = False
            return 0.0
        s = self.settings
        demand_A = self.torque_target_Nm / s.torque_constant_Nm_A
        limited_A = max(-s.current_max_A, min(s.current_max_A, demand_A))
        error_A = limited_A - self.current_A
        wanted_V = self._gain * error_A + self._integral_V
        voltage_V = max(-s.supply_V, min(s.supply_V, wanted_V))
        is_clipped = voltage_V != wanted_V
        if not is_clipped:  # the integral waits while the supply limits
            self._integral_V += self._gain * (1.0 - self._decay) * error_A
        self.is_saturated = is_clipped or limited_A != demand_A
        settled_A = (voltage_V - s.torque_constant_Nm_A * self.dq_rad_s) / s.resistance_ohm
        before_A = self.current_A
        self.current_A = settled_A + (before_A - settled_A) * self._decay
        mean_A = settled_A + (before_A - settled_A) * self._mean_weight
        return mean_A * s.torque_constant_Nm_A
