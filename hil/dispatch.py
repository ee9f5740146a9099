"""From a client's request to a command for the loop, and back to a reply.

Everything that can be refused without asking the loop is refused here: form, joints, limits.
"""

import json
import sys
import threading
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from time import monotonic, sleep
from typing import Any
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from controller.faults import FaultCode
from controller.machine import State
from controller.reference import MotionLimits, MotionState, Reference
from hil import messages
from hil.config import Config
from hil.errors import HilError
from hil.messages import (
    AcquireRequest,
    DisableRequest,
    EnableRequest,
    EstopRequest,
    FaultRequest,
    GainBoundsRequest,
    ReleaseRequest,
    Reply,
    Request,
    RequestError,
    ResetRequest,
    StopRequest,
)
from hil.planner import Refusal, plan
from hil.shared import SLOTS, STATUS_EVERY_S, SharedMemory

OUTCOME_TIMEOUT_S = 1.0
POLL_EVERY_S = 0.002
EVENTS_AT_ONCE = 100
LEAD_S = 0.1
"""A trajectory that continues a running one meets it this far ahead: time to plan it."""
LEADS_TRIED = (1, 4, 12)
URGENT = frozenset({"estop", "stop", "disable"})
"""Requests that wait for no other one: they are answered in a thread of their own."""

SETTLED = {
    "enable": {State.READY},
    "disable": {State.IDLE, State.FAULT, State.ESTOP},
    "estop": {State.ESTOP},
}
"""States in which a command has taken full effect and is answered."""


@dataclass(frozen=True, slots=True)
class Present:
    """The loop's last sample, as far as commands need it."""

    state: State = State.INIT
    fault: FaultCode = FaultCode.NONE
    cycle: int = -1
    t_ref_s: float = 0.0
    q_des_rad: list[float] = field(default_factory=list)


class _OutcomeTimeoutError(HilError):
    """The loop did not say in time what became of a command."""


def check_gain_bounds(request: GainBoundsRequest, config: Config) -> None:
    """Refuse gain bounds for the wrong number of joints, or outside floor and ceiling.

    Raises:
        Refusal: Naming joint, value and limit. Nothing has changed.
    """
    law = config.controller.law
    if len(request.Kd_min) != config.joints:
        given = len(request.Kd_min)
        reason = f"bounds for {given} joints, the arm has {config.joints}"
        raise Refusal(reason, "joints", value=given, limit=config.joints)
    for joint, (low, high) in enumerate(zip(request.Kd_min, request.Kd_max, strict=True), start=1):
        if low < law.Kd_floor:
            reason = f"joint {joint}: Kd_min {low:g} is below the floor {law.Kd_floor:g}"
            raise Refusal(reason, "Kd_min", joint, low, law.Kd_floor)
        if high > law.Kd_ceiling:
            reason = f"joint {joint}: Kd_max {high:g} is above the ceiling {law.Kd_ceiling:g}"
            raise Refusal(reason, "Kd_max", joint, high, law.Kd_ceiling)


class Dispatcher:
    """Answers requests: one thread for those in `URGENT`, one for all others.

    Attributes:
        permits: Whether an operator may still command when a command is handed to the loop; it may
            have taken seconds to plan.
    """

    def __init__(self, shared: SharedMemory) -> None:
        self.permits: Callable[[str], bool] = lambda _operator: True
        self._shared = shared
        self._config = shared.config
        self._limits = MotionLimits.of(
            shared.config.controller.limits, shared.config.trajectory.max_duration_s
        )
        self._patience_s = {
            "enable": shared.config.loop.enable_timeout_s + OUTCOME_TIMEOUT_S,
            "disable": shared.config.controller.stop_time_s + OUTCOME_TIMEOUT_S,
            "estop": OUTCOME_TIMEOUT_S,
        }
        self._lock = threading.Lock()
        self._events = shared.follower("events")
        self._awaited: dict[int, dict[str, Any]] = {}
        self._handed_over: dict[int, tuple[int, int]] = {}
        status = shared.status()  # of a loop that was there before this process
        self._slot: int = status.get("active_slot", -1)
        self._samples: int = status.get("active_samples", 0)

    @property
    def present(self) -> Present:
        """The loop's state as of its last cycle."""
        record = self._shared.samples.last()
        if record is None:
            return Present()
        row = self._shared.layout.decode([record])[0]
        return Present(
            State(int(row["state"])),
            FaultCode(int(row["fault"])),
            int(row["cycle"]),
            float(row["t_ref_s"]),
            row["q_des_rad"].tolist(),
        )

    def is_moving(self) -> bool:
        """The arm follows a trajectory, or comes to a stop."""
        return self.present.state in (State.ACTIVE, State.STOPPING)

    def inform(self, command: Mapping[str, Any]) -> None:
        """Pass a command on to the loop that nobody waits for."""
        with self._lock:
            self._shared.commands.append(json.dumps(command).encode())

    def forestall(self, verb: str, payload: bytes) -> None:
        """Pass an emergency stop on to the loop at once; its answer may wait for its turn."""
        if verb != "estop":
            return
        try:
            messages.parse(verb, payload)
        except RequestError:
            return  # refused when it is answered
        self._shared.request_estop()

    def answer(self, verb: str, payload: bytes) -> Reply:
        """Read and carry out one request. Never raises: its thread has others to answer."""
        try:
            request = messages.parse(verb, payload)
        except RequestError as error:
            return Reply(ok=False, reason=str(error))
        return self.carry_out(verb, request)

    def carry_out(self, verb: str, request: Request, operator: str | None = None) -> Reply:
        """Carry out one request for an operator. Never raises."""
        request_id = request.request_id
        try:
            reply = self._carry_out(verb, request, {"operator": operator} if operator else {})
            return reply.model_copy(update={"request_id": request_id})
        except Refusal as refusal:
            return refusal.reply(request_id)
        except HilError as error:
            return Reply(ok=False, reason=str(error), request_id=request_id)
        except Exception as error:  # noqa: BLE001 - a mistake of ours may not end the service
            traceback.print_exc(file=sys.stderr)
            reason = f"internal error in {verb}: {type(error).__name__}: {error}"
            return Reply(ok=False, reason=reason, request_id=request_id)

    def _carry_out(self, verb: str, request: Request, who: dict[str, str]) -> Reply:
        if isinstance(request, GainBoundsRequest):
            check_gain_bounds(request, self._config)
            return self._order(verb, {"Kd_min": request.Kd_min, "Kd_max": request.Kd_max, **who})
        if isinstance(request, FaultRequest):
            return self._inject(request, who)
        if isinstance(request, StopRequest | ResetRequest):
            return self._order(verb, who)
        if isinstance(request, EnableRequest | DisableRequest | EstopRequest):
            return self._until(verb, who)
        if isinstance(request, AcquireRequest | ReleaseRequest):
            raise Refusal(f"{verb} is not for the arm")
        return self._start(request, who)

    # --- plain commands ----------------------------------------------------------------------

    def _order(self, verb: str, arguments: Mapping[str, object]) -> Reply:
        """Send one command to the loop and return what became of it."""
        outcome = self._await_outcome(self._post(verb, arguments), OUTCOME_TIMEOUT_S)
        return Reply(ok=outcome["ok"], reason=outcome["reason"], cycle=outcome["cycle"])

    def _until(self, verb: str, who: Mapping[str, str]) -> Reply:
        """Send one command and wait until it has taken full effect, or the arm is in fault."""
        outcome = self._await_outcome(self._post(verb, who), OUTCOME_TIMEOUT_S)
        if not outcome["ok"]:
            return Reply(ok=False, reason=outcome["reason"])
        deadline_s = monotonic() + self._patience_s[verb]
        while monotonic() < deadline_s:
            present = self.present
            if present.cycle >= outcome["cycle"]:  # earlier ones know nothing of it
                if present.state in SETTLED[verb]:
                    return Reply(ok=True, cycle=present.cycle)
                if present.state is State.FAULT:
                    reason = f"{verb}: the arm went into FAULT ({present.fault.name})"
                    return Reply(ok=False, reason=reason)
            sleep(POLL_EVERY_S)
        return Reply(ok=False, reason=f"{verb}: still in state {self.present.state.name}")

    def _post(
        self, verb: str, arguments: Mapping[str, Any], slot: tuple[int, int] | None = None
    ) -> int:
        operator = arguments.get("operator")
        with self._lock:
            if verb != "estop" and operator is not None and not self.permits(operator):
                raise Refusal(f"{verb}: {operator} has lost authority in the meantime")
            number = self._shared.commands.head  # no other command, of no other gateway, has it
            self._awaited[number] = {}
            if slot is not None:
                self._handed_over[number] = slot
            command = {"id": number, "verb": verb, **arguments}
            self._shared.commands.append(json.dumps(command).encode())
        return number

    def _await_outcome(self, number: int, timeout_s: float) -> dict[str, Any]:
        deadline_s = monotonic() + timeout_s
        while True:
            with self._lock:
                self._take_outcomes()
                if self._awaited[number] or monotonic() > deadline_s:
                    outcome = self._awaited.pop(number)
                    break
            sleep(POLL_EVERY_S)
        if not outcome:
            raise _OutcomeTimeoutError("the control loop does not answer")
        return outcome

    def _take_outcomes(self) -> None:
        """Note what the loop says about commands, also about those nobody waits for any more."""
        for event in self._events.read_json(EVENTS_AT_ONCE):
            if event.get("kind") != "command":
                continue
            number = event["id"]
            if number in self._awaited:
                self._awaited[number] = event
            handed_over = self._handed_over.pop(number, None)
            if handed_over is not None and event["ok"]:
                self._slot, self._samples = handed_over

    def _inject(self, request: FaultRequest, who: Mapping[str, str]) -> Reply:
        joint, joints = request.joint or 0, self._config.joints
        if joint > joints:
            reason = f"joint {joint}: the arm has {joints} joints"
            raise Refusal(reason, "joints", value=joint, limit=joints)
        order = request.model_dump(include={"target", "kind", "duration_s"})
        return self._order("fault", {"joint": joint, **order, **who})

    # --- trajectories ------------------------------------------------------------------------

    def _start(self, request: messages.TrajectoryRequest, who: Mapping[str, str]) -> Reply:
        """Plan from the reference in force, write a free slot, hand it over."""
        state = self.present.state
        if state not in (State.READY, State.ACTIVE, State.HOLD):
            remedy = "; enable first" if state is State.IDLE else ""
            raise Refusal(f"a trajectory is not possible in state {state.name}{remedy}")
        outcome: dict[str, Any] = {}
        for lead in LEADS_TRIED:
            at_index, start = self._junction(lead * LEAD_S)
            reference = plan(request, start, self._limits, self._config.loop.period_s)
            number = self._hand_over(reference, at_index, who)
            outcome = self._await_outcome(number, lead * LEAD_S + OUTCOME_TIMEOUT_S)
            if outcome["ok"]:
                return Reply(ok=True, duration_s=reference.duration_s, cycle=outcome["cycle"])
            if "reference has changed" not in outcome["reason"] and "late" not in outcome["reason"]:
                break
        return Reply(ok=False, reason=outcome["reason"])

    def _hand_over(self, reference: Reference, at_index: int | None, who: Mapping[str, str]) -> int:
        slot = self._free_slot()
        rows = reference.rows()
        self._rows(slot, rows.size)[:] = rows.ravel()
        command = {
            "slot": slot,
            "samples": reference.samples,
            "at_index": at_index,
            "crc32": crc32(rows.tobytes()),
            **who,
        }
        return self._post("trajectory", command, (slot, reference.samples))

    def _junction(self, lead_s: float) -> tuple[int | None, MotionState]:
        """Return the row of the running motion to continue from, and the motion there."""
        present, samples = self.present, self._samples
        if present.state is not State.ACTIVE:
            return None, MotionState.at_rest(present.q_des_rad)
        period_s, n = self._config.loop.period_s, self._config.joints
        index = round((present.t_ref_s + lead_s) / period_s)
        if index >= samples - 1:  # it will be at rest by then: wait for that
            sleep(max(0.0, samples * period_s - present.t_ref_s) + 2 * STATUS_EVERY_S)
            return None, MotionState.at_rest(self.present.q_des_rad)
        rows = self._rows(self._slot, samples * 3 * n)
        row = rows[index * 3 * n : (index + 1) * 3 * n].copy()
        return index, MotionState(row[:n], row[n : 2 * n], row[2 * n :])

    def _free_slot(self) -> int:
        """Return a slot that is neither played nor waiting to be.

        Raises:
            Refusal: If the loop has not said what became of earlier trajectories.
        """
        with self._lock:
            self._take_outcomes()
            taken = {self._slot, *(slot for slot, _ in self._handed_over.values())}
        free = [slot for slot in range(SLOTS) if slot not in taken]
        if not free:
            raise Refusal("the control loop has not answered earlier trajectories")
        return free[0]

    def _rows(self, slot: int, doubles: int) -> NDArray[np.float64]:
        return np.frombuffer(self._shared.slot(slot), dtype=np.float64)[:doubles]
