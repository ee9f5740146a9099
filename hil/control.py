"""One control cycle: feedback -> estimate -> law -> limits -> torque commands.

The same code runs in the real-time process and in the virtual-time simulation; time and the bus
are given to it. Nothing in here waits except for feedback, and that until a deadline.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

from controller.errors import CommandError
from controller.faults import REACTIONS, FaultCode, Reaction
from controller.gravity import GravityLoad
from controller.limits import MotionGuard, TorqueLimiter
from controller.machine import Machine, State, Trigger
from controller.monitor import Monitor
from controller.player import ReferencePlayer, Setpoint
from controller.registry import make_law
from controller.velocity import VelocityEstimator, make_estimator
from drivers.axis import Axis, AxisStatus
from drivers.errors import BusDownError, BusError
from drivers.fault_frame import FaultKind, FaultOrder, FaultTarget, pack_fault
from hil.config import Config, ConfigError
from hil.ladder import Ladder

AT_REST_RAD_S = 0.05
"""A damped stop ends when every joint is slower than this."""
STOP_SPEED_RATIO, STOP_SPEED_MARGIN_RAD_S = 1.5, 1.0
"""A stop that makes the arm this much faster than it was does not damp: torque goes off."""

EventSink = Callable[[str, Mapping[str, Any]], None]
"""Takes an event's kind and its details."""


class ArmLink(Protocol):
    """The amplifiers of one arm as the cycle sees them; `drivers.arm_bus.ArmBus` says more."""

    @property
    def axes(self) -> Sequence[Axis]:
        """Shoulder first."""

    @property
    def is_enabled(self) -> bool:
        """Every axis applies torque."""

    @property
    def age_cycles(self) -> int:
        """Age of the oldest feedback, 0 = all fresh."""

    def request_feedback(self) -> None:
        """Begin a cycle."""

    def collect(self, deadline_ns: int) -> bool:
        """Wait for feedback; True if all of it is fresh."""

    def send_torques(self, tau_Nm: Sequence[float]) -> None:
        """End a cycle."""

    def send_fault(self, frame: bytes) -> bool:
        """Ask the emulator for a fault; False if the amplifiers are real."""

    def first_in(self, status: AxisStatus) -> Axis | None:
        """Return the first axis with this status."""


class Control:
    """The controller of one arm, cycle by cycle.

    Attributes:
        machine: State and latched fault.
        player: The reference in force.
        law: The control law; its gains' bounds can be moved.
        monitor: What the paper says of S, as of the last cycle in which the law ran.
        q_rad: Joint angles used in the last cycle.
        dq_rad_s: Joint rates used in the last cycle.
        tau_cmd_Nm: Torques the law requested in the last cycle.
        tau_sent_Nm: Torques sent in the last cycle.
        feedback_ns: When the last feedback frame of the cycle had been taken.
        law_ns: When law and limits were done.
        is_fresh: All feedback was there in time in the last cycle.
        ladder: Cycles in which feedback was late or missing, by what was done about it.
    """

    def __init__(
        self, config: Config, bus: ArmLink, *, now_ns: Callable[[], int], events: EventSink
    ) -> None:
        settings, n = config.controller, config.joints
        self.machine = Machine()
        self.player = ReferencePlayer(n, config.loop.period_s)
        self.law = make_law(settings)
        self.monitor = Monitor(settings.monitor, n)
        self.q_rad = [0.0] * n
        self.dq_rad_s = [0.0] * n
        self.tau_cmd_Nm = [0.0] * n
        self.tau_sent_Nm = [0.0] * n
        self.feedback_ns = 0
        self.law_ns = 0
        self.is_fresh = False
        self.ladder = Ladder(config.loop.feedback_timeout_s)
        self._bus = bus
        self._now_ns = now_ns
        self._events = events
        self._period_s = config.loop.period_s
        self._limits = settings.limits
        self._limiter = TorqueLimiter(settings.limits)
        self._guard = MotionGuard(settings.limits)
        self._estimator = _make_estimator(config, bus)
        self._zeros = [0.0] * n
        self._enable_cycles = round(config.loop.enable_timeout_s / self._period_s)
        self._stop_cycles = round(settings.stop_time_s / self._period_s)
        self._stop_speed_rad_s = 0.0
        model = settings.model
        is_lowered = model is not None and settings.is_lowered
        self._gravity = GravityLoad(model, settings.limits) if model and is_lowered else None
        self._enabling_left = 0
        self._stopping_left = 0
        self._has_feedback = False
        self._dt_s = 0.0
        self._age = 0

    # --- the cycle --------------------------------------------------------------------------

    def step(self, deadline_ns: int, periods: int) -> None:
        """Run one cycle.

        Args:
            deadline_ns: Feedback that is not there by then is missing in this cycle.
            periods: Periods of the plant's time since the last cycle, 1 unless some were skipped.

        Raises:
            BusError: If the bus is gone for good. The fault is latched; torque cannot be commanded.
        """
        try:
            self._exchange(deadline_ns, periods)
        except BusDownError as error:
            self._rest_without_bus(error)
        except BusError:
            self._trip(FaultCode.BUS_FAILED)
            raise

    def _rest_without_bus(self, error: BusDownError) -> None:
        """The bus is away for a while: latch that, once; the drives' watchdogs remove torque."""
        self.feedback_ns = self.law_ns = self._now_ns()
        self.is_fresh = False
        self._age += 1
        if self.machine.fault is FaultCode.NONE:
            self._trip(FaultCode.BUS_FAILED, detail=str(error))
        self.tau_sent_Nm = self._rest()

    def _exchange(self, deadline_ns: int, periods: int) -> None:
        began_ns = self._now_ns()
        self._bus.request_feedback()
        self.is_fresh = is_fresh = self._bus.collect(deadline_ns)
        self.feedback_ns = self._now_ns()
        if is_fresh and self.feedback_ns - began_ns > self.ladder.late_after_ns:
            self.ladder.late += 1
        self._take_feedback(is_fresh, periods)
        self._check_amplifiers()
        try:
            torques = self._torques(periods)
        except CommandError as error:  # a torque that is not finite
            self._trip(FaultCode.NOT_FINITE, detail=str(error))
            torques = self._rest()
        self.law_ns = self._now_ns()
        self.tau_sent_Nm = torques
        self._bus.send_torques(torques)

    def _take_feedback(self, is_fresh: bool, periods: int) -> None:
        self._dt_s += periods * self._period_s
        if not is_fresh:
            self._age += 1
            return
        self._age = 0
        q = [axis.q_rad for axis in self._bus.axes]
        if self._estimator is None:
            self.dq_rad_s = [axis.dq_rad_s or 0.0 for axis in self._bus.axes]
        elif self._has_feedback:
            self.dq_rad_s = self._estimator.step(q, self._dt_s)
        else:
            self._estimator.reset(q)
            self._has_feedback = True
        self.q_rad = q

    def _torques(self, periods: int) -> list[float]:
        state = self.machine.state
        if state.is_powered:
            if self._age:
                return self._bridge_gap()
            if state is State.STOPPING:
                return self._damp()
            return self._control(periods)
        if self._enabling_left:
            if not self._age and self._power_on():
                return self._control(periods)
            self._await_power()
        elif not self._age:
            self.player.hold(self.q_rad)
        self._dt_s = 0.0
        return self._rest()

    def _rest(self) -> list[float]:
        self.tau_cmd_Nm = self._zeros
        self._limiter.reset()
        return self._zeros

    def _control(self, periods: int) -> list[float]:
        """Reference, law, limits, in a state in which the law has power."""
        dt_s, self._dt_s = self._dt_s, 0.0
        was_moving = self.player.is_moving
        setpoint = self.player.step(periods)
        if was_moving and not self.player.is_moving and self.machine.state is State.ACTIVE:
            self.fire(Trigger.FINISHED)
        code = self._violation(setpoint)
        if code is not FaultCode.NONE:
            self._trip(code, **self._explain(code))
            return self._damp() if self.machine.state is State.STOPPING else self._rest()
        self.tau_cmd_Nm = self.law.step(self.q_rad, self.dq_rad_s, setpoint, dt_s)
        torques = self._limiter.step(self.tau_cmd_Nm, dt_s)
        self.monitor.step(self.law.S, self.law.Kd, torques, dt_s)
        return torques

    def _violation(self, setpoint: Setpoint) -> FaultCode:
        if self._estimator is not None and not self._estimator.is_locked:
            return FaultCode.ESTIMATOR_LOST
        return self._guard.check(self.q_rad, self.dq_rad_s, setpoint.q_rad)

    def _explain(self, code: FaultCode) -> dict[str, Any]:
        if code is FaultCode.ESTIMATOR_LOST:
            return {"detail": "the velocity estimate lost the encoder; raise C or slow down"}
        guard = self._guard
        if code is FaultCode.NOT_FINITE:  # what JSON has no number for is told in words
            told = f"joint {guard.joint}: a measurement or the reference is {guard.value}"
            return {"joint": guard.joint, "value": None, "limit": None, "detail": told}
        return {"joint": guard.joint, "value": guard.value, "limit": guard.limit}

    def _damp(self) -> list[float]:
        """Torque against the motion; power goes off at rest or after the time allowed."""
        self._stopping_left -= 1
        self.player.hold(self.q_rad)
        if self._has_stop_failed():
            return self._rest()
        gravity = self._gravity
        load_Nm = self._zeros if gravity is None else gravity.torques_Nm(self.q_rad)
        is_at_rest = all(abs(dq) < AT_REST_RAD_S for dq in self.dq_rad_s)
        is_over = is_at_rest and (gravity is None or gravity.is_down(load_Nm))
        if is_over or self._stopping_left <= 0:
            self.fire(Trigger.AT_REST)
            return self._rest()
        dt_s, self._dt_s = self._dt_s, 0.0
        damping = self._limits.damping_Nms_rad
        if gravity is None:
            self.tau_cmd_Nm = [-d * dq for d, dq in zip(damping, self.dq_rad_s, strict=True)]
        else:
            rates = gravity.lowering_rad_s(load_Nm)
            terms = zip(load_Nm, damping, self.dq_rad_s, rates, strict=True)
            self.tau_cmd_Nm = [load - d * (dq - rate) for load, d, dq, rate in terms]
        return self._limiter.step(self.tau_cmd_Nm, dt_s)

    def _has_stop_failed(self) -> bool:
        """Trip if the stop is none: a hard limit, a trip speed, or an arm that gets faster."""
        if self._estimator is not None and not self._estimator.is_locked:
            code = FaultCode.ESTIMATOR_LOST
        else:
            code = self._guard.check(self.q_rad, self.dq_rad_s, self.q_rad)
        if REACTIONS[code] is Reaction.TORQUE_OFF:
            self._trip(code, **self._explain(code))
            return True
        speed_rad_s = max(abs(dq) for dq in self.dq_rad_s)
        if speed_rad_s <= self._stop_speed_rad_s:
            return False
        told = "the damped stop makes the arm faster; check the sign of the torque"
        self._trip(FaultCode.VELOCITY, value=speed_rad_s, limit=self._stop_speed_rad_s, detail=told)
        return True

    def _bridge_gap(self) -> list[float]:
        """Feedback is missing: hold the last torque, then damp, then give up."""
        if self._age <= self._limits.n_hold:
            self.ladder.held += 1
            return self.tau_sent_Nm
        if self._age <= self._limits.n_hold + self._limits.n_damp:
            self.ladder.damped += 1
            damped = [
                0.0 if axis.age_cycles else -d * dq
                for axis, d, dq in zip(
                    self._bus.axes, self._limits.damping_Nms_rad, self.dq_rad_s, strict=True
                )
            ]
            return self._limiter.step(damped, self._period_s)
        self.ladder.given_up += 1
        silent = next(axis for axis in self._bus.axes if axis.age_cycles)
        why = silent.note or f"{silent.label}: silent"
        self._trip(FaultCode.FEEDBACK_LOST, detail=f"{why} for {self._age} cycles")
        return self._rest()

    # --- power and faults -------------------------------------------------------------------

    def _power_on(self) -> bool:
        self.player.hold(self.q_rad)
        if self._bus.is_enabled:
            self._enabling_left = 0
            self._guard.admit(self.q_rad)
            self.law.reset()
            self.monitor.reset()
            self.fire(Trigger.POWERED)
            return True
        return False

    def _await_power(self) -> None:
        """Count the cycles since `enable`, with or without feedback."""
        self._enabling_left -= 1
        if self._enabling_left == 0:
            axes = self._bus.axes
            waiting = next((a for a in axes if a.status is not AxisStatus.ENABLED), None)
            silent = next((a for a in axes if a.age_cycles), None)
            if waiting is not None:
                detail = f"{waiting.label} is not enabled in time"
            else:
                detail = f"{silent.label if silent else 'an axis'}: no feedback in time"
            self._trip(FaultCode.ENABLE_TIMEOUT, detail=detail)

    def _check_amplifiers(self) -> None:
        if self._bus.is_enabled:
            return
        if self.machine.fault is not FaultCode.NONE and not self.machine.state.is_powered:
            return  # latched, and torque is off
        broken = self._bus.first_in(AxisStatus.FAULT)
        lost = self._bus.first_in(AxisStatus.LOST)
        dropped = self._bus.first_in(AxisStatus.DISABLED)
        if broken is not None:
            self._trip(FaultCode.AMPLIFIER_FAULT, detail=broken.note)
        elif lost is not None:
            self._trip(FaultCode.AMPLIFIER_LOST, detail=lost.note)
        elif dropped is not None and self.machine.state.is_powered:
            self._trip(FaultCode.AMPLIFIER_FAULT, detail=f"{dropped.label}: disabled by itself")

    def trip(self, code: FaultCode, **detail: object) -> None:
        """Latch a fault found outside the cycle (lost supervisor, internal error)."""
        self._trip(code, **detail)

    def _trip(self, code: FaultCode, **detail: object) -> None:
        before = self.machine.state
        reaction = self.machine.trip(code)
        self._events("fault", {"code": code.name, "reaction": reaction.name, **detail})
        if reaction is Reaction.HOLD:
            self.player.stop(self._limits.ddq_max_rad_s2)
        self._entered(before)

    def fire(self, trigger: Trigger) -> None:
        """Change state by the transition table.

        Raises:
            CommandError: If the table has no such change. Nothing has changed.
        """
        before = self.machine.state
        self.machine.fire(trigger)
        self._entered(before)

    def _entered(self, before: State) -> None:
        state = self.machine.state
        if state is before:
            return
        self._events("state", {"from": before.name, "to": state.name})
        if state is State.STOPPING:
            self._stopping_left = self._stop_cycles
            speed_rad_s = max(abs(dq) for dq in self.dq_rad_s)
            if self._gravity is not None:
                speed_rad_s = max(speed_rad_s, self._limits.lowering_rad_s)
            self._stop_speed_rad_s = STOP_SPEED_RATIO * speed_rad_s + STOP_SPEED_MARGIN_RAD_S
        if not state.is_powered:
            self._enabling_left = 0
            self.player.hold(self.q_rad)
            for axis in self._bus.axes:
                axis.disable()

    # --- commands; each raises CommandError with the reason if refused, and then changes nothing

    def enable(self) -> None:
        """Ask the amplifiers for power; READY follows when all have it."""
        state = self.machine.state
        if state is not State.IDLE:
            remedy = "; reset first" if state in (State.FAULT, State.ESTOP) else ""
            raise CommandError(f"enable is not possible in state {state.name}{remedy}")
        self._enabling_left = self._enable_cycles
        for axis in self._bus.axes:
            axis.enable()

    def disable(self) -> None:
        """Damped stop, then torque off; without power, only what `enable` began is ended."""
        if not self.machine.state.is_powered:
            self._enabling_left = 0
            for axis in self._bus.axes:
                axis.disable()
        elif self.machine.state is not State.STOPPING:
            self.fire(Trigger.DISABLE)

    def start(self, rows: Sequence[float], samples: int, *, at_index: int | None) -> None:
        """Play a compiled reference from now on.

        Args:
            rows: See `ReferencePlayer.start`.
            samples: Number of rows.
            at_index: Row of the running motion at which this one continues it; None if the
                reference must be at rest.
        """
        player = self.player
        if not self.machine.can(Trigger.TRAJECTORY):
            remedy = "; enable first" if self.machine.state is State.IDLE else ""
            raise CommandError(
                f"a trajectory is not possible in state {self.machine.state.name}{remedy}"
            )
        if player.is_stopping:
            raise CommandError("the arm is being stopped; send the trajectory when it is at rest")
        if player.is_moving != (at_index is not None):
            raise CommandError("the reference has changed since this trajectory was planned")
        if at_index is not None and at_index <= player.index:
            raise CommandError("the trajectory came too late to continue the running one")
        player.start(rows, samples, 1 if at_index is None else at_index - player.index)
        self.fire(Trigger.TRAJECTORY)

    def stop(self) -> None:
        """Slow the running motion down along its path and hold; power stays on."""
        if self.machine.state not in (State.READY, State.ACTIVE, State.HOLD):
            raise CommandError(f"stop is not possible in state {self.machine.state.name}")
        self.player.stop(self._limits.ddq_max_rad_s2)

    def estop(self) -> None:
        """Torque off in this cycle; latched until reset."""
        if self.machine.state is not State.ESTOP:
            self.fire(Trigger.ESTOP)

    def reset(self) -> None:
        """Clear a latched fault or emergency stop; the amplifiers stay disabled."""
        if not self.machine.can(Trigger.RESET):
            raise CommandError(f"there is nothing to reset in state {self.machine.state.name}")
        for axis in self._bus.axes:
            if axis.status in (AxisStatus.FAULT, AxisStatus.LOST):
                axis.reset_fault()
        for axis in self._bus.axes:
            axis.recount()
        self._has_feedback = False  # whatever spoilt the estimate is forgotten
        self.fire(Trigger.RESET)

    def set_gain_bounds(self, Kd_min: Sequence[float], Kd_max: Sequence[float]) -> None:
        """Let the gain bounds of every joint ramp to new values, checked beforehand."""
        for gain, low, high in zip(self.law.gains, Kd_min, Kd_max, strict=True):
            gain.set_bounds(low, high)

    def inject_fault(
        self,
        joint: int = 0,
        target: str = "amplifier",
        kind: str = "off",
        duration_s: float | None = None,
    ) -> None:
        """Ask the emulator for a fault (`sim_backend.faults` says what each does).

        Args:
            joint: From 1; 0 is all.
            target: `encoder`, `amplifier`, `bus` or `host`.
            kind: `ok` ends the target's fault.
            duration_s: None: until it is ended; `off` of an amplifier then happens once.
        """
        order = FaultOrder(
            FaultTarget[target.upper()],
            FaultKind[kind.upper()],
            joint,
            max(1, round(duration_s * 1e3)) if duration_s else 0,
        )
        if not self._bus.send_fault(pack_fault(order)):
            raise CommandError("faults are for emulated amplifiers; these are real")


def _make_estimator(config: Config, bus: ArmLink) -> VelocityEstimator | None:
    """Build the configured estimator; None where the amplifiers report the velocity.

    Raises:
        ConfigError: If they are to and one of them does not.
    """
    settings = config.controller.velocity
    if settings.estimator != "amplifier":
        return make_estimator(settings, config.joints)
    silent = next((axis for axis in bus.axes if axis.dq_rad_s is None), None)
    if silent is not None:
        raise ConfigError(
            f"controller.velocity.estimator 'amplifier': {silent.label} reports no velocity; use "
            "filtered_difference"
        )
    return None
