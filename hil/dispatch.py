"""From a client's request to a command for the loop, and back to a reply.

Everything that can be refused without asking the loop is refused here: form, joints, limits.
"""

import json
import threading
from dataclasses import dataclass, field
from itertools import count
from time import monotonic, sleep
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controller.machine import State
from controller.reference import MotionLimits, MotionState
from hil import messages
from hil.config import Config
from hil.errors import HilError
from hil.messages import (
    DisableRequest,
    EnableRequest,
    EstopRequest,
    FaultRequest,
    GainBoundsRequest,
    Reply,
    Request,
    ResetRequest,
    StopRequest,
)
from hil.planner import Refusal, plan
from hil.shared import SLOTS, STATUS_EVERY_S, SharedMemory

OUTCOME_TIMEOUT_S = 1.0
LEAD_S = 0.1
"""A trajectory that continues a running one meets it this far ahead: time to plan it."""
LEADS_TRIED = (1, 4, 12)


SETTLED = {
    "enable": {State.READY},
    "disable": {State.IDLE, State.FAULT, State.ESTOP},
    "estop": {State.ESTOP},
}
"""States in which a command has taken full effect and is answered."""


@dataclass(slots=True)
class Present:
    """The loop's last sample, as far as commands need it; replaced whole by the stream."""

    state: State = State.INIT
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
        raise Refusal(f"bounds for {len(request.Kd_min)} joints, the arm has {config.joints}")
    for joint, (low, high) in enumerate(zip(request.Kd_min, request.Kd_max, strict=True), start=1):
        if low < law.Kd_floor:
            reason = f"joint {joint}: Kd_min {low:g} is below the floor {law.Kd_floor:g}"
            raise Refusal(reason, "Kd_min", joint, low, law.Kd_floor)
        if high > law.Kd_ceiling:
            reason = f"joint {joint}: Kd_max {high:g} is above the ceiling {law.Kd_ceiling:g}"
            raise Refusal(reason, "Kd_max", joint, high, law.Kd_ceiling)


class Dispatcher:
    """Answers one request at a time, in a thread of its own.

    Attributes:
        present: The loop's last sample; set by the stream.
    """

    def __init__(self, shared: SharedMemory) -> None:
        self.present = Present()
        self._shared = shared
        self._config = shared.config
        self._limits = MotionLimits.of(
            shared.config.controller.limits, shared.config.trajectory.max_duration_s
        )
        self._patience_s = {
            "enable": shared.config.loop.enable_timeout_s + OUTCOME_TIMEOUT_S,
            "disable": shared.config.controller.limits.stop_timeout_s + OUTCOME_TIMEOUT_S,
            "estop": OUTCOME_TIMEOUT_S,
        }
        self._ids = count(1)
        self._outcomes: dict[int, dict[str, Any]] = {}
        self._arrived = threading.Condition()
        status = shared.status()  # of a loop that was there before this process
        self._slot: int = status.get("active_slot", -1)
        self._samples: int = status.get("active_samples", 0)

    def take_outcome(self, event: dict[str, Any]) -> None:
        """Note what the loop says about a command; called by the stream."""
        with self._arrived:
            self._outcomes[event["id"]] = event
            self._arrived.notify_all()

    def answer(self, verb: str, payload: bytes) -> Reply:
        """Carry out one request. Never raises for anything a client can send."""
        request_id = None
        try:
            request = messages.parse(verb, payload)
            request_id = request.request_id
            return self._carry_out(verb, request).model_copy(update={"request_id": request_id})
        except Refusal as refusal:
            return refusal.reply(request_id)
        except HilError as error:
            return Reply(ok=False, reason=str(error), request_id=request_id)

    def _carry_out(self, verb: str, request: Request) -> Reply:
        if isinstance(request, GainBoundsRequest):
            check_gain_bounds(request, self._config)
            return self._order(verb, Kd_min=request.Kd_min, Kd_max=request.Kd_max)
        if isinstance(request, FaultRequest):
            return self._inject(request)
        if isinstance(request, StopRequest | ResetRequest):
            return self._order(verb)
        if isinstance(request, EnableRequest | DisableRequest | EstopRequest):
            return self._until(verb)
        return self._start(request)

    # --- plain commands ----------------------------------------------------------------------

    def _order(self, verb: str, **arguments: object) -> Reply:
        """Send one command to the loop and return what became of it."""
        outcome = self._await_outcome(self._post(verb, arguments), OUTCOME_TIMEOUT_S)
        return Reply(ok=outcome["ok"], reason=outcome["reason"])

    def _until(self, verb: str) -> Reply:
        """Send one command and wait until it has taken full effect, or the arm is in fault."""
        if verb == "estop":
            self._shared.request_estop()
        reply = self._order(verb)
        deadline_s = monotonic() + self._patience_s[verb]
        while reply.ok and (state := self.present.state) not in SETTLED[verb]:
            if state is State.FAULT:
                fault = self._shared.status().get("fault", "unknown")
                return Reply(ok=False, reason=f"{verb}: the arm went into FAULT ({fault})")
            if monotonic() > deadline_s:
                return Reply(ok=False, reason=f"{verb}: still in state {state.name}")
            sleep(0.002)
        return reply

    def _post(self, verb: str, arguments: dict[str, Any]) -> int:
        number = next(self._ids)
        command = {"id": number, "verb": verb, **arguments}
        self._shared.commands.append(json.dumps(command).encode())
        return number

    def _await_outcome(self, number: int, timeout_s: float) -> dict[str, Any]:
        with self._arrived:
            if not self._arrived.wait_for(lambda: number in self._outcomes, timeout_s):
                raise _OutcomeTimeoutError("the control loop does not answer")
            return self._outcomes.pop(number)

    def _inject(self, request: FaultRequest) -> Reply:
        if not (request.target == "amplifier" and request.kind == "off"):
            raise Refusal(
                f"fault {request.kind!r} on {request.target!r} is not available; "
                "there is: kind 'off' on target 'amplifier'"
            )
        joints = [request.joint] if request.joint else list(range(1, self._config.joints + 1))
        if max(joints) > self._config.joints:
            raise Refusal(f"joint {request.joint}: the arm has {self._config.joints} joints")
        replies = [self._order("fault", joint=joint) for joint in joints]
        return next((reply for reply in replies if not reply.ok), replies[0])

    # --- trajectories ------------------------------------------------------------------------

    def _start(self, request: messages.TrajectoryRequest) -> Reply:
        """Plan from the reference in force, write a free slot, hand it over."""
        if self.present.state not in (State.READY, State.ACTIVE, State.HOLD):
            remedy = "; enable first" if self.present.state is State.IDLE else ""
            raise Refusal(
                f"a trajectory is not possible in state {self.present.state.name}{remedy}"
            )
        outcome: dict[str, Any] = {}
        for lead in LEADS_TRIED:
            at_index, state = self._junction(lead * LEAD_S)
            reference = plan(request, state, self._limits, self._config.loop.period_s)
            slot = self._free_slot()
            rows = reference.rows()
            self._rows(slot, rows.size)[:] = rows.ravel()
            number = self._post(
                "trajectory", {"slot": slot, "samples": reference.samples, "at_index": at_index}
            )
            outcome = self._await_outcome(number, lead * LEAD_S + OUTCOME_TIMEOUT_S)
            if outcome["ok"]:
                self._slot, self._samples = slot, reference.samples
                return Reply(ok=True, duration_s=reference.duration_s)
            if "reference has changed" not in outcome["reason"] and "late" not in outcome["reason"]:
                break
        return Reply(ok=False, reason=outcome["reason"])

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
        """Return a slot other than the one that is being played."""
        return (self._slot + 1) % SLOTS

    def _rows(self, slot: int, doubles: int) -> NDArray[np.float64]:
        return np.frombuffer(self._shared.slot(slot), dtype=np.float64)[:doubles]
