"""The arm's state machine: one transition table, faults that latch."""

from enum import IntEnum

from controller.errors import CommandError
from controller.faults import REACTIONS, FaultCode, Reaction


class State(IntEnum):
    """States, defined by what has power."""

    INIT = 0
    """The bus is being set up; no torque."""
    IDLE = 1
    """Feedback flows; amplifiers are disabled."""
    READY = 2
    """Amplifiers are enabled; the law holds the pose at which power came on."""
    ACTIVE = 3
    """The law follows a trajectory."""
    HOLD = 4
    """The law holds the end of the last motion."""
    STOPPING = 5
    """Damped stop; torque goes off at rest."""
    FAULT = 6
    """Torque is off; a fault is latched."""
    ESTOP = 7
    """Torque is off by an emergency stop; latched."""

    @property
    def is_powered(self) -> bool:
        """True where the law or the damped stop may apply torque."""
        return self in _POWERED


_POWERED = frozenset({State.READY, State.ACTIVE, State.HOLD, State.STOPPING})


class Trigger(IntEnum):
    """What can make the state change."""

    BUS_READY = 0
    POWERED = 1
    """All amplifiers report that they are enabled."""
    TRAJECTORY = 2
    FINISHED = 3
    """The reference came to its end, or to rest after a stop."""
    DISABLE = 4
    AT_REST = 5
    """The damped stop is over."""
    SOFT_TRIP = 6
    TRIP = 7
    ESTOP = 8
    RESET = 9


TRANSITIONS: dict[tuple[State, Trigger], State] = {
    (State.INIT, Trigger.BUS_READY): State.IDLE,
    (State.IDLE, Trigger.POWERED): State.READY,
    (State.READY, Trigger.TRAJECTORY): State.ACTIVE,
    (State.READY, Trigger.DISABLE): State.STOPPING,
    (State.READY, Trigger.SOFT_TRIP): State.STOPPING,
    (State.ACTIVE, Trigger.TRAJECTORY): State.ACTIVE,
    (State.ACTIVE, Trigger.FINISHED): State.HOLD,
    (State.ACTIVE, Trigger.DISABLE): State.STOPPING,
    (State.ACTIVE, Trigger.SOFT_TRIP): State.STOPPING,
    (State.HOLD, Trigger.TRAJECTORY): State.ACTIVE,
    (State.HOLD, Trigger.DISABLE): State.STOPPING,
    (State.HOLD, Trigger.SOFT_TRIP): State.STOPPING,
    (State.STOPPING, Trigger.AT_REST): State.IDLE,
    (State.INIT, Trigger.SOFT_TRIP): State.FAULT,
    (State.IDLE, Trigger.SOFT_TRIP): State.FAULT,
    (State.FAULT, Trigger.RESET): State.IDLE,
    (State.ESTOP, Trigger.RESET): State.IDLE,
    **{(s, Trigger.TRIP): State.FAULT for s in State if s not in (State.FAULT, State.ESTOP)},
    **{(s, Trigger.ESTOP): State.ESTOP for s in State if s is not State.ESTOP},
}
"""Every allowed change. A fault latched while STOPPING ends in FAULT instead of IDLE."""


class Machine:
    """State and latched fault of one arm.

    Attributes:
        state: The present state.
        fault: The first fault since the last reset; `NONE` if there was none.
    """

    __slots__ = ("fault", "state")

    def __init__(self) -> None:
        self.state = State.INIT
        self.fault = FaultCode.NONE

    def can(self, trigger: Trigger) -> bool:
        """Tell whether `trigger` is allowed now."""
        return (self.state, trigger) in TRANSITIONS

    def fire(self, trigger: Trigger) -> State:
        """Change state.

        Raises:
            CommandError: If the table has no such change. Nothing has changed.
        """
        after = TRANSITIONS.get((self.state, trigger))
        if after is None:
            raise CommandError(f"{trigger.name.lower()} is not possible in state {self.state.name}")
        if trigger is Trigger.AT_REST and self.fault is not FaultCode.NONE:
            after = State.FAULT
        if trigger is Trigger.RESET:
            self.fault = FaultCode.NONE
        self.state = after
        return after

    def trip(self, code: FaultCode) -> Reaction:
        """Latch a fault and change state as the fault table says.

        Returns:
            The reaction; `WARN` and `HOLD` latch nothing and leave the state to the caller.
        """
        reaction = REACTIONS[code]
        if reaction < Reaction.SOFT_STOP:
            return reaction
        if self.fault is FaultCode.NONE:
            self.fault = code
        trigger = Trigger.SOFT_TRIP if reaction is Reaction.SOFT_STOP else Trigger.TRIP
        if self.can(trigger):
            self.fire(trigger)
        return reaction
