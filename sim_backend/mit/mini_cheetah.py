"""The emulated mini-cheetah descendants: T-Motor (6-byte replies), CubeMars (8 bytes)."""

from drivers.mit import codec
from drivers.mit.codec import Feedback
from sim_backend.mit.node import TEMPERATURE_C, MitNode

INJECTED_FAULT = 4  # over current


class MiniCheetahNode(MitNode):
    """A motor with the mini-cheetah's firmware.

    While disabled, set-points are answered and not looked at, and the last one is remembered: it
    acts again the moment power is back. The watchdog takes the set-point to zero and leaves power
    on; the next set-point acts as if nothing had been. A fault ends with FD, whose answer still
    tells it.
    """

    @property
    def _is_short(self) -> bool:
        return self.settings.variant == "tmotor"

    def fail_power_stage(self) -> None:
        """See `AmplifierNode.fail_power_stage`."""
        self.fail(INJECTED_FAULT)

    def lose_master(self) -> None:
        """Zero torque, power stays on."""
        self.setpoint = self.setpoint._replace(kp_Nm_rad=0.0, kd_Nms_rad=0.0, torque_Nm=0.0)
        self._drive()

    def receive(self, can_id: int, data: bytes) -> None:
        """See `AmplifierNode.receive`."""
        if can_id != self.node_id:
            if self._is_injection(can_id, data):
                self.fail(INJECTED_FAULT)
            return
        if len(data) != codec.FEEDBACK_BYTES:
            return
        self.feed_watchdog()
        told = self.fault
        if data == codec.ENABLE:
            self.enable()
        elif data == codec.DISABLE:
            self.fault = 0
            self.disable()
        elif data == codec.SET_ZERO:
            self.set_zero()
        elif self.is_enabled:
            codes = codec.parse_command(data)
            if codes is not None:
                self.follow(codec.to_setpoint(codes, self.ranges))
        self._reply(told)

    def _reply(self, fault: int) -> None:
        r = self.ranges
        feedback = Feedback(
            self.node_id,
            codec.to_code(self.position_rad, r.position_rad, codec.POSITION_CODES),
            codec.to_code(self.velocity_rad_s, r.velocity_rad_s, codec.SHORT_CODES),
            codec.to_code(self.servo.torque_Nm, r.torque_Nm, codec.SHORT_CODES),
            (TEMPERATURE_C, fault),
        )
        length = codec.SHORT_FEEDBACK_BYTES if self._is_short else codec.FEEDBACK_BYTES
        self._send(self.settings.reply_id, codec.pack_feedback(feedback, length))
