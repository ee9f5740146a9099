"""What all emulated MIT-mode motors share: encoder, control law, watchdog, fault, power."""

import math
from abc import abstractmethod
from importlib import import_module

from drivers.frame import pack_frame
from drivers.mit.codec import INJECT_FAULT_DATA, INJECT_FAULT_ID, Setpoint
from sim_backend.mit.settings import MitNodeSettings
from sim_backend.node import AmplifierNode, Transmit
from sim_backend.servo import Servo

TEMPERATURE_C = 30
"""Of everything, always."""
_AT_REST = Setpoint(0.0, 0.0, 0.0, 0.0, 0.0)

_NODES = {  # variant -> "module:class"
    "damiao": "sim_backend.mit.damiao:DamiaoNode",
    "tmotor": "sim_backend.mit.mini_cheetah:MiniCheetahNode",
    "cubemars": "sim_backend.mit.mini_cheetah:MiniCheetahNode",
    "cybergear": "sim_backend.mit.robstride:RobStrideNode",
    "robstride": "sim_backend.mit.robstride:RobStrideNode",
}


def make_node(settings: MitNodeSettings, servo: Servo, transmit: Transmit) -> "MitNode":
    """Build an emulated motor, silent until it is asked.

    Args:
        settings: Its `variant` selects the code.
        servo: The axis behind it.
        transmit: Puts a frame record on the wire.
    """
    module, _, name = _NODES[settings.variant].partition(":")
    node: MitNode = getattr(import_module(module), name)(settings, servo, transmit)
    return node


class MitNode(AmplifierNode):
    """A motor that follows tau = kp (p - q) + kd (v - dq) + t while it is enabled.

    The law runs when a set-point arrives and once per millisecond after that.

    Attributes:
        settings: As given; `ranges` may have been changed over the bus.
        node_id: What it listens to now.
        is_enabled: Power is on.
        fault: The variant's own number of the fault that keeps power off, 0 if there is none.
        setpoint: The last one received.
    """

    def __init__(self, settings: MitNodeSettings, servo: Servo, transmit: Transmit) -> None:
        super().__init__(servo, transmit)
        self.settings = settings
        self.ranges = settings.ranges
        self.node_id = settings.node_id
        self.is_enabled = False
        self.fault = 0
        self.setpoint = _AT_REST
        self.watchdog_s = 0.0
        self.torque_limit_Nm = min(servo.torque_max_Nm, settings.ranges.torque_Nm)
        self._rad_per_count = math.tau / servo.counts_per_turn
        self._zero_counts = 0
        self._silence_s = 0.0

    # --- AmplifierNode ------------------------------------------------------------------------

    def power_on(self) -> None:
        """Start disabled, with the angle that an absolute single-turn encoder gives."""
        self.disable()
        self.fault = 0
        self.setpoint = _AT_REST
        self.node_id = self.settings.node_id
        self.ranges = self.settings.ranges
        self.watchdog_s = 1e-3 * self.settings.watchdog_ms
        self._zero_counts = 0
        turns = round(self._counts() / self.servo.counts_per_turn)
        self._zero_counts = turns * self.servo.counts_per_turn

    def tick(self, dt_s: float) -> None:
        """See `AmplifierNode.tick`: the command watchdog, and the law with the new angle."""
        if not self.is_enabled:
            return
        self._silence_s += dt_s
        if self.watchdog_s and self._silence_s >= self.watchdog_s:
            self.lose_master()
        else:
            self._drive()

    # --- the motor ----------------------------------------------------------------------------

    @property
    def position_rad(self) -> float:
        """Angle of the output shaft as the encoder counts it, over many turns."""
        return self._counts() * self._rad_per_count

    @property
    def velocity_rad_s(self) -> float:
        """Rate of the output shaft."""
        return self.servo.dq_rad_s

    def _counts(self) -> int:
        servo = self.servo
        raw = math.floor(servo.q_rad / self._rad_per_count + 0.5)
        return raw + servo.settings.encoder_offset_counts - self._zero_counts

    def set_zero(self) -> None:
        """Let the present angle be zero."""
        self._zero_counts += self._counts()

    def enable(self) -> None:
        """Switch power on, unless there is a fault."""
        if self.fault or self.is_enabled:
            return
        self.is_enabled = True
        self._silence_s = 0.0
        self.servo.is_energised = True
        self._drive()

    def disable(self) -> None:
        """Switch power off."""
        self.is_enabled = False
        self.servo.is_energised = False
        self.servo.torque_target_Nm = 0.0

    def fail(self, fault: int) -> None:
        """Switch power off until the fault is cleared."""
        self.fault = fault
        self.disable()

    @abstractmethod
    def fail_power_stage(self) -> None:
        """See `AmplifierNode.fail_power_stage`, with a fault number of the variant."""

    @abstractmethod
    def lose_master(self) -> None:
        """React to the command watchdog."""

    def follow(self, setpoint: Setpoint) -> None:
        """Take a set-point; it feeds the watchdog."""
        self.setpoint = setpoint
        self._silence_s = 0.0
        if self.is_enabled:
            self._drive()

    def feed_watchdog(self) -> None:
        """Start the watchdog's time anew."""
        self._silence_s = 0.0

    def _drive(self) -> None:
        target = self.setpoint
        tau_Nm = target.torque_Nm
        if target.kp_Nm_rad:
            tau_Nm += target.kp_Nm_rad * (target.position_rad - self.position_rad)
        if target.kd_Nms_rad:
            tau_Nm += target.kd_Nms_rad * (target.velocity_rad_s - self.velocity_rad_s)
        limit = self.torque_limit_Nm
        self.servo.torque_target_Nm = max(-limit, min(limit, tau_Nm))

    def _is_injection(self, can_id: int, data: bytes) -> bool:
        return can_id == INJECT_FAULT_ID | self.node_id and data == INJECT_FAULT_DATA

    def _send(self, can_id: int, data: bytes) -> None:
        self._transmit(pack_frame(can_id, data))
