"""Carries out commands inside the loop, at most a few a cycle, and says what became of them.

Commands come from the gateway already checked against the configuration; what is left to check
here is the state at the very cycle in which they take effect. Whatever else reaches the arm from
outside of the bus (the emergency-stop word, signals, lost processes) comes in as a command too, so
that a recording of commands and frames is all that a replay needs.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from controller.errors import CommandError
from controller.faults import FaultCode
from controller.machine import State
from hil.control import Control

Rows = Callable[[int], Sequence[float]]
"""Returns the flat doubles of a trajectory slot."""
Outcome = Callable[[Mapping[str, Any], str], None]
"""Told the command and the reason of its refusal, empty if it was carried out."""


class Executor:
    """Carries out commands on one `Control`.

    A trajectory that continues a running one waits here until the row at which they meet.

    Attributes:
        active_slot: Slot of the trajectory that was started last, -1 before the first.
        active_samples: Its number of rows.
        is_ending: The run is to end: every cycle asks for a damped stop.
    """

    def __init__(self, control: Control, rows: Rows, outcome: Outcome) -> None:
        self._control = control
        self._rows = rows
        self._outcome = outcome
        self._pending: Mapping[str, Any] | None = None
        self.active_slot = -1
        self.active_samples = 0
        self.is_ending = False
        self._verbs: dict[str, Callable[[Mapping[str, Any]], None]] = {
            "enable": lambda _: control.enable(),
            "disable": self._disable,
            "stop": self._stop,
            "estop": self._estop,
            "reset": lambda _: control.reset(),
            "gain_bounds": lambda c: control.set_gain_bounds(c["Kd_min"], c["Kd_max"]),
            "fault": self._inject,
            "end": self._end,
            "supervisor_lost": self._lose_supervisor,
            "gateway_lost": self._lose_gateway,
            "authority": lambda _: None,  # who has it, for the record
            "operator_lost": self._lose_operator,
        }

    def execute(self, command: Mapping[str, Any]) -> None:
        """Carry out one command now, or keep a trajectory for the row it is meant for.

        Args:
            command: `verb`, its arguments, and `id` if somebody waits for the outcome.
        """
        if command["verb"] == "trajectory":
            self._drop_pending("replaced by a later trajectory")
            self._pending = command
            return
        self._attempt(self._verbs[command["verb"]], command)

    def begin_cycle(self, periods: int) -> None:
        """Start the waiting trajectory if this is its cycle; call once a cycle, before the law."""
        if self.is_ending:
            self._control.disable()
        command = self._pending
        if command is None:
            return
        at_index, player = command["at_index"], self._control.player
        if at_index is None or not player.is_moving or player.index + periods >= at_index:
            self._pending = None
            self._attempt(self._start, command)

    def _start(self, command: Mapping[str, Any]) -> None:
        rows = self._rows(command["slot"])
        self._control.start(rows, command["samples"], at_index=command["at_index"])
        self.active_slot, self.active_samples = command["slot"], command["samples"]

    def _disable(self, _: Mapping[str, Any]) -> None:
        self._drop_pending("the arm was disabled")
        self._control.disable()

    def _stop(self, _: Mapping[str, Any]) -> None:
        self._drop_pending("the arm was stopped")
        self._control.stop()

    def _estop(self, _: Mapping[str, Any]) -> None:
        self._drop_pending("emergency stop")
        self._control.estop()

    def _inject(self, command: Mapping[str, Any]) -> None:
        self._control.inject_fault(
            command["joint"],
            command.get("target", "amplifier"),
            command.get("kind", "off"),
            command.get("duration_s"),
        )

    def _end(self, _: Mapping[str, Any]) -> None:
        self.is_ending = True

    def _lose_supervisor(self, _: Mapping[str, Any]) -> None:
        self._control.trip(FaultCode.SUPERVISOR_LOST)
        self.is_ending = True

    def _lose_gateway(self, command: Mapping[str, Any]) -> None:
        self._control.trip(FaultCode.GATEWAY_LOST)
        self._follow_policy(command["policy"])

    def _lose_operator(self, command: Mapping[str, Any]) -> None:
        policy = command["policy"]
        if policy != "finish":
            self._drop_pending("the operator was lost")
        if policy == "stop" and not self._control.machine.state.is_powered:
            self._control.disable()  # it may be about to be
        self._follow_policy(policy)

    def _follow_policy(self, policy: str) -> None:
        control = self._control
        state = control.machine.state
        if policy == "hold" and state is State.ACTIVE:
            control.stop()
        elif policy == "stop" and state.is_powered:
            control.disable()

    def _drop_pending(self, reason: str) -> None:
        command, self._pending = self._pending, None
        if command is not None:
            self._outcome(command, reason)

    def _attempt(
        self, action: Callable[[Mapping[str, Any]], None], command: Mapping[str, Any]
    ) -> None:
        try:
            action(command)
        except CommandError as error:
            reason = str(error)
        else:
            reason = ""
        if "id" in command:
            self._outcome(command, reason)
