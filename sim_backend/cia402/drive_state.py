"""State machine of the power drive system (CiA 402-2 / IEC 61800-7-201), pure: no I/O, no clock.

Transition numbers in the comments are the standard's.
"""

from enum import IntEnum

from drivers.cia402.codec import Cia402State

_S = Cia402State
FAULT_RESET_BIT = 0x80
QUICK_STOP_OPTIONS = (0, 1, 2, 5, 6)
"""605A: 3, 4, 7 and 8 (stops at the current or voltage limit) are not offered."""
STAYS_IN_QUICK_STOP = 5
"""Quick stop options (605A) from here on stay in QUICK STOP ACTIVE; lower ones leave it."""


class Command(IntEnum):
    """What bits 0 to 3 of a controlword ask for."""

    DISABLE_VOLTAGE = 0
    QUICK_STOP = 1
    SHUTDOWN = 2
    SWITCH_ON = 3
    """Disable operation, when operation is enabled."""
    ENABLE_OPERATION = 4


def decode_command(controlword: int) -> Command:
    """Return the command in a controlword (6040). Every pattern of bits 0 to 3 is one."""
    if not controlword & 0b0010:
        return Command.DISABLE_VOLTAGE
    if not controlword & 0b0100:
        return Command.QUICK_STOP
    if not controlword & 0b0001:
        return Command.SHUTDOWN
    return Command.ENABLE_OPERATION if controlword & 0b1000 else Command.SWITCH_ON


TRANSITIONS: dict[tuple[Cia402State, Command], Cia402State] = {
    (_S.SWITCH_ON_DISABLED, Command.SHUTDOWN): _S.READY_TO_SWITCH_ON,  # 2
    (_S.READY_TO_SWITCH_ON, Command.SWITCH_ON): _S.SWITCHED_ON,  # 3
    (_S.READY_TO_SWITCH_ON, Command.ENABLE_OPERATION): _S.OPERATION_ENABLED,  # 3 and 4
    (_S.READY_TO_SWITCH_ON, Command.QUICK_STOP): _S.SWITCH_ON_DISABLED,  # 7
    (_S.READY_TO_SWITCH_ON, Command.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 7
    (_S.SWITCHED_ON, Command.ENABLE_OPERATION): _S.OPERATION_ENABLED,  # 4
    (_S.SWITCHED_ON, Command.SHUTDOWN): _S.READY_TO_SWITCH_ON,  # 6
    (_S.SWITCHED_ON, Command.QUICK_STOP): _S.SWITCH_ON_DISABLED,  # 10
    (_S.SWITCHED_ON, Command.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 10
    (_S.OPERATION_ENABLED, Command.SWITCH_ON): _S.SWITCHED_ON,  # 5
    (_S.OPERATION_ENABLED, Command.SHUTDOWN): _S.READY_TO_SWITCH_ON,  # 8
    (_S.OPERATION_ENABLED, Command.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 9
    (_S.OPERATION_ENABLED, Command.QUICK_STOP): _S.QUICK_STOP_ACTIVE,  # 11
    (_S.QUICK_STOP_ACTIVE, Command.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 12
    (_S.QUICK_STOP_ACTIVE, Command.ENABLE_OPERATION): _S.OPERATION_ENABLED,  # 16
}

_POWERED = (_S.OPERATION_ENABLED, _S.QUICK_STOP_ACTIVE)
_FAULTED = (_S.FAULT_REACTION_ACTIVE, _S.FAULT)


class DriveStateMachine:
    """The drive's state, moved by controlwords, by faults and by itself.

    Attributes:
        state: Present state.
        controlword: Last controlword received.
        quick_stop_option: 605A; 0 skips QUICK STOP ACTIVE, 1 and 2 leave it by themselves, 5 and 6
            stay in it.
    """

    __slots__ = ("_is_resume_blocked", "controlword", "quick_stop_option", "state")

    def __init__(self) -> None:
        self.initialise()
        self.state = _S.NOT_READY_TO_SWITCH_ON

    @property
    def is_powered(self) -> bool:
        """Power stage on: the motor carries current."""
        return self.state in _POWERED

    @property
    def is_faulted(self) -> bool:
        """In FAULT REACTION ACTIVE or FAULT."""
        return self.state in _FAULTED

    def initialise(self) -> None:
        """Transitions 0 and 1: self-test passed, ready for the first command."""
        self.controlword = 0
        self.quick_stop_option = 2
        self._is_resume_blocked = False
        self.state = _S.SWITCH_ON_DISABLED

    def command(self, controlword: int) -> None:
        """Obey one controlword.

        Commands are levels, a fault reset is the rising edge of bit 7. While bit 7 is set only the
        commands that take power away are obeyed. After a quick stop that the drive began itself,
        a controlword that merely repeats the previous one does not resume operation.
        """
        previous, self.controlword = self.controlword, controlword
        if controlword != previous:
            self._is_resume_blocked = False
        if controlword & FAULT_RESET_BIT:
            if self.state is _S.FAULT and not previous & FAULT_RESET_BIT:
                self.state = _S.SWITCH_ON_DISABLED  # 15
                return
            if decode_command(controlword) > Command.QUICK_STOP:
                return
        self._obey(decode_command(controlword))

    def _obey(self, command: Command) -> None:
        if self._is_resume_blocked and command is Command.ENABLE_OPERATION:
            return
        self.state = TRANSITIONS.get((self.state, command), self.state)
        if self.state is _S.QUICK_STOP_ACTIVE and self.quick_stop_option == 0:
            self.state = _S.SWITCH_ON_DISABLED  # 12

    def quick_stop(self) -> None:
        """Stop as the quick stop command does, on the drive's own decision."""
        self._obey(Command.QUICK_STOP)
        self._is_resume_blocked = True

    def disable_voltage(self) -> None:
        """Remove power as the disable voltage command does, on the drive's own decision."""
        self._obey(Command.DISABLE_VOLTAGE)

    def fail(self) -> None:
        """Transition 13: a fault occurred. Power is off from here on."""
        if not self.is_faulted:
            self.state = _S.FAULT_REACTION_ACTIVE

    def settle(self) -> None:
        """Make the transitions the drive makes by itself: 14, and 12 after a quick stop."""
        if self.state is _S.FAULT_REACTION_ACTIVE:
            self.state = _S.FAULT
        elif self.state is _S.QUICK_STOP_ACTIVE and self.quick_stop_option < STAYS_IN_QUICK_STOP:
            self.state = _S.SWITCH_ON_DISABLED
