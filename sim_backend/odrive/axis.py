"""The emulated ODrive axis behind its protocol: states, errors, watchdog, torque."""

from drivers.odrive.codec import AxisError, AxisState, Heartbeat, ProcedureResult
from sim_backend.odrive.motor import Controller, EncoderEstimate, clamp
from sim_backend.servo import Servo

BOOT_S = 0.02
PROCEDURE_S = 0.1
_PROCEDURES = frozenset(
    (
        AxisState.STARTUP_SEQUENCE,
        AxisState.FULL_CALIBRATION_SEQUENCE,
        AxisState.MOTOR_CALIBRATION,
        AxisState.ENCODER_OFFSET_CALIBRATION,
    )
)


class OdriveAxisModel:
    """One axis: IDLE, calibration, closed loop control, and what takes it out of them.

    Args:
        servo: Motor and encoder, seen at the joint.
        gear_ratio: Motor turns per joint turn.
        is_calibrated: It may enter closed loop control.

    Attributes:
        errors: Active errors; any of them disarms.
        disarm_reason: Errors that disarmed it last.
        is_watchdog_on: See `feed_watchdog`.
        watchdog_timeout_s: Silence that disarms.
        torque_constant_Nm_A: Of the motor.
        current_soft_max_A: Limit of the motor's current, and by that of its torque.
    """

    def __init__(self, servo: Servo, gear_ratio: float, *, is_calibrated: bool) -> None:
        self._servo = servo
        self._ratio = gear_ratio
        self._was_calibrated = is_calibrated
        self.encoder = EncoderEstimate(servo, gear_ratio)
        self.is_watchdog_on = False
        self.watchdog_timeout_s = 0.0
        self.torque_constant_Nm_A = servo.settings.torque_constant_Nm_A / gear_ratio
        self._current_hard_max_A = servo.settings.current_max_A
        self.current_soft_max_A = servo.settings.current_max_A
        self.power_on()

    def power_on(self) -> None:
        """Begin as after a restart: disarmed, initialising; settings are the caller's business."""
        self.controller = Controller()
        self.state = AxisState.IDLE
        self.errors = int(AxisError.INITIALIZING)
        self.disarm_reason = 0
        self.result = ProcedureResult.SUCCESS
        self.is_calibrated = self._was_calibrated
        self._boot_left_s = BOOT_S
        self._procedure_left_s = 0.0
        self._silence_s = 0.0
        self._take_torque_off()
        self.encoder.restart()

    def heartbeat(self) -> Heartbeat:
        """Return what 0x01 tells."""
        return Heartbeat(self.errors, self.state, self.result, is_trajectory_done=True)

    def feed_watchdog(self) -> None:
        """Any frame for this axis does: a read too, and one that makes no sense."""
        self._silence_s = 0.0

    def request(self, state: int) -> None:
        """Enter a state (0x07), or stay and tell why not by the procedure result."""
        if state == AxisState.IDLE:
            self._rest(ProcedureResult.SUCCESS)
        elif state == AxisState.CLOSED_LOOP_CONTROL:
            self._arm()
        elif state in _PROCEDURES and self.state == AxisState.IDLE and not self.errors:
            self.state = AxisState(state)
            self.result = ProcedureResult.BUSY
            self._procedure_left_s = PROCEDURE_S
        elif state != AxisState.UNDEFINED:
            self.result = ProcedureResult.INVALID_STATE

    def _arm(self) -> None:
        if self.state == AxisState.CLOSED_LOOP_CONTROL:
            return
        if self.errors:
            self._rest(ProcedureResult.DISARMED)
        elif not self.is_calibrated:
            self._rest(ProcedureResult.NOT_CALIBRATED)
        else:
            self.controller.restart(self.encoder.position_rev())
            self.state = AxisState.CLOSED_LOOP_CONTROL
            self.result = ProcedureResult.BUSY
            self._silence_s = 0.0
            self._servo.is_energised = True
            self.apply_input(0.0)

    def fail(self, error: AxisError) -> None:
        """Latch an error; an armed axis is disarmed by it."""
        if self.state != AxisState.IDLE:
            self.disarm_reason = int(error)
            self._rest(ProcedureResult.DISARMED)
        self.errors |= error

    def clear_errors(self) -> None:
        """0x18. The boot's own error ends by itself."""
        self.errors &= AxisError.INITIALIZING
        self.disarm_reason = 0
        self._silence_s = 0.0

    def apply_input(self, dt_s: float) -> None:
        """Bring the controller's torque to the motor; nothing if the axis is not armed."""
        if self.state != AxisState.CLOSED_LOOP_CONTROL:
            return
        torque_Nm = self.controller.torque_Nm(self.encoder, dt_s)
        current_A = min(self.current_soft_max_A, self._current_hard_max_A)
        reach_Nm = current_A * self.torque_constant_Nm_A
        self._servo.torque_target_Nm = clamp(torque_Nm, -reach_Nm, reach_Nm) * self._ratio

    def tick(self, dt_s: float) -> None:
        """Advance by one millisecond."""
        self.encoder.tick(dt_s)
        if self._boot_left_s > 0.0:
            self._boot_left_s -= dt_s
            if self._boot_left_s <= 0.0:
                self.errors &= ~AxisError.INITIALIZING
        self._watch(dt_s)
        if self.state == AxisState.CLOSED_LOOP_CONTROL:
            if self.controller.is_overspeed(self.encoder.velocity_rev_s):
                self.fail(AxisError.VELOCITY_LIMIT_VIOLATION)
            self.apply_input(dt_s)
        elif self.state != AxisState.IDLE:
            self._procedure_left_s -= dt_s
            if self._procedure_left_s <= 0.0:
                self.is_calibrated = True
                self._rest(ProcedureResult.SUCCESS)

    def _watch(self, dt_s: float) -> None:
        """Count the silence, in IDLE too, as the published firmware does."""
        if not self.is_watchdog_on:
            return
        self._silence_s += dt_s
        if self._silence_s > self.watchdog_timeout_s + 1e-9:
            self.fail(AxisError.WATCHDOG_TIMER_EXPIRED)

    @property
    def torque_target_Nm(self) -> float:
        """Torque asked of the motor."""
        return self._servo.torque_target_Nm / self._ratio

    @property
    def torque_estimate_Nm(self) -> float:
        """Torque of the motor, from its current."""
        return self._servo.torque_Nm / self._ratio

    def _rest(self, result: ProcedureResult) -> None:
        self.state = AxisState.IDLE
        self.result = result
        self._take_torque_off()

    def _take_torque_off(self) -> None:
        self._servo.is_energised = False
        self._servo.torque_target_Nm = 0.0
