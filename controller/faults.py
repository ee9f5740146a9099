"""What can go wrong, and what is done about it. Faults latch until an explicit reset."""

from enum import IntEnum


class Reaction(IntEnum):
    """What a fault leads to, mildest first."""

    WARN = 0
    """Reported and counted; motion goes on."""
    HOLD = 1
    """The running motion decelerates along its path, then its end is held under power."""
    SOFT_STOP = 2
    """Damped stop, then torque off; latched."""
    TORQUE_OFF = 3
    """Torque off in this cycle; latched."""


class FaultCode(IntEnum):
    """Fault codes, in the order in which they are evaluated."""

    NONE = 0
    NOT_FINITE = 1
    """A measurement, a reference or a torque is NaN or infinite."""
    BUS_FAILED = 2
    """The bus can no longer be used."""
    AMPLIFIER_FAULT = 3
    """An amplifier reports a fault or left the enabled state by itself."""
    AMPLIFIER_LOST = 4
    """An amplifier's heartbeat is missing."""
    FEEDBACK_LOST = 5
    """Feedback stayed away for longer than holding and damping may bridge."""
    ESTIMATOR_LOST = 6
    """The velocity estimate no longer follows the encoder."""
    POSITION_HARD = 7
    VELOCITY = 8
    POSITION_SOFT = 9
    FOLLOWING_ERROR = 10
    ENABLE_TIMEOUT = 11
    """The amplifiers did not reach the enabled state in time."""
    SUPERVISOR_LOST = 12
    """The supervising process is gone."""
    GATEWAY_LOST = 13
    """Nobody can send commands; the configured policy applies."""
    OVERRUN = 14
    """Periods were skipped."""
    INTERNAL = 15
    """An unexpected error in the loop itself."""


REACTIONS: dict[FaultCode, Reaction] = {
    FaultCode.NONE: Reaction.WARN,
    FaultCode.NOT_FINITE: Reaction.TORQUE_OFF,
    FaultCode.BUS_FAILED: Reaction.TORQUE_OFF,
    FaultCode.AMPLIFIER_FAULT: Reaction.TORQUE_OFF,
    FaultCode.AMPLIFIER_LOST: Reaction.TORQUE_OFF,
    FaultCode.FEEDBACK_LOST: Reaction.TORQUE_OFF,
    FaultCode.ESTIMATOR_LOST: Reaction.TORQUE_OFF,
    FaultCode.POSITION_HARD: Reaction.TORQUE_OFF,
    FaultCode.VELOCITY: Reaction.TORQUE_OFF,
    FaultCode.POSITION_SOFT: Reaction.SOFT_STOP,
    FaultCode.FOLLOWING_ERROR: Reaction.SOFT_STOP,
    FaultCode.ENABLE_TIMEOUT: Reaction.TORQUE_OFF,
    FaultCode.SUPERVISOR_LOST: Reaction.SOFT_STOP,
    FaultCode.GATEWAY_LOST: Reaction.WARN,
    FaultCode.OVERRUN: Reaction.WARN,
    FaultCode.INTERNAL: Reaction.TORQUE_OFF,
}
