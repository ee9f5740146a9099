"""The bench of a conformance run: one axis driven cycle by cycle, its limits guarded in each."""

from dataclasses import dataclass
from math import isfinite
from time import monotonic_ns, sleep

from drivers.arm_bus import RECEIVED, ArmBus
from drivers.axis import Axis, AxisInfo, AxisStatus
from drivers.errors import AmplifierError, DriverError
from hil.errors import HilError

FRAMES_KEPT = 20_000
"""Frames of one step that are kept; more are counted only."""
MISSING_LIMIT = 50
"""Cycles in a row without feedback after which a step gives up and takes torque off."""
POWER_DOWN_CYCLES = 100
REST_RAD = 2e-3
REST_CYCLES = 20
"""A joint is at rest that moves less than `REST_RAD` in so many cycles."""
REST_TIMEOUT_S = 3.0


class ConformError(HilError):
    """The run cannot begin as asked; nothing was sent."""


class StepError(HilError):
    """The amplifier did not do what the step asks for."""


class NotAskedError(HilError):
    """The step does not apply to this amplifier; the message says why."""


class NotOfferedError(HilError):
    """The family has nothing that the step could find; the message says what is to be done."""


@dataclass(frozen=True, slots=True)
class Limits:
    """What the run may do to the joint.

    Attributes:
        torque_Nm: Largest torque that the steps ask for on purpose.
        torque_max_Nm: The limit told to the driver and, where the family can, to the drive; nothing
            above it can be commanded.
        travel_rad: Torque goes off when the joint is this far from where it was at the start.
        tolerance: Allowed deviation of the reported torque from the commanded one, as a share.
        watchdog_s: The drive has to remove torque after this long without a command.
        has_watchdog: It has one that can be relied on; without, torque that stays on is a warning.
        state_report_s: The state may be reported this late, in families that do not report it with
            every feedback.
        torque_report_s: The same of torque.
        enable_s: Time for a change of the drive's state.
        is_clamped: The joint cannot move.
        may_inject: The drive is emulated and may be asked to fail.
    """

    torque_Nm: float
    torque_max_Nm: float
    travel_rad: float = 0.3
    tolerance: float = 0.15
    watchdog_s: float = 0.1
    state_report_s: float = 0.0
    torque_report_s: float = 0.0
    enable_s: float = 1.0
    is_clamped: bool = False
    may_inject: bool = False
    has_watchdog: bool = True


@dataclass(frozen=True, slots=True)
class Timing:
    """Times of the loop and of emulated time."""

    period_s: float = 1e-3
    lockstep_timeout_s: float = 1.0
    stall_timeout_s: float = 0.5
    """Emulators in lockstep: without SYNC for this long, their time runs by the clock."""
    heartbeat_cycles: int = 0


LoggedFrame = tuple[int, int, bytes]
"""(monotonic time in ns, RECEIVED or SENT, record)."""


class Bench:
    """One axis on its bus, cycle by cycle, with the limits guarded in every one.

    Attributes:
        axis: The axis under test.
        bus: Its bus; no other axis is commanded.
        limits: See there.
        timing: See there.
        info: What the drive told at start-up.
        start_error: Why start-up failed, if it did.
        frames: Frames since the step began.
        dropped: Frames of the step that were not kept.
        stall_s: Longest time between two cycles in this step that this host is to blame for.
    """

    def __init__(self, bus: ArmBus, limits: Limits, timing: Timing) -> None:
        self.bus = bus
        self.axis: Axis = bus.axes[0]
        self.limits = limits
        self.timing = timing
        self.info: AxisInfo | None = None
        self.start_error = ""
        self.frames: list[LoggedFrame] = []
        self.dropped = 0
        self.stall_s = 0.0
        self._period_ns = round(timing.period_s * 1e9)
        self._next_ns = 0
        self._origin_rad: float | None = None
        self._missing = 0
        bus.log_frames(self._take)

    def _take(self, direction: int, frame: bytes) -> None:
        if len(self.frames) < FRAMES_KEPT:
            self.frames.append((monotonic_ns(), direction, frame))
        else:
            self.dropped += 1

    # --- cycles -------------------------------------------------------------------------------

    @property
    def is_lockstep(self) -> bool:
        """The drive's time advances with our cycles."""
        return self.info is not None and self.info.is_lockstep

    def configure(self) -> None:
        """Set the axis up; the outcome is in `info` or `start_error`."""
        try:
            (self.info,) = self.bus.configure(heartbeat_cycles=self.timing.heartbeat_cycles)
        except AmplifierError as error:
            self.start_error = str(error)

    def cycle(self, tau_Nm: float = 0.0) -> bool:
        """Run one cycle and command a torque; True if the feedback was fresh.

        Raises:
            StepError: If a limit was broken. Torque off has been asked for by then.
            BusError: If the bus is gone.
        """
        is_fresh = self.listen()
        self.bus.send_torques([tau_Nm])
        return is_fresh

    def listen(self) -> bool:
        """Run one cycle without a command at its end; see `cycle`."""
        deadline_ns = self._begin_cycle()
        self.bus.request_feedback()
        is_fresh = self.bus.collect(deadline_ns)
        if self.is_lockstep:
            self._next_ns = monotonic_ns()
        try:
            self._guard(is_fresh)
        except StepError:
            self.axis.disable()
            self.bus.send_torques([0.0])
            raise
        return is_fresh

    def _begin_cycle(self) -> int:
        """Wait for the period to begin; return when feedback is due."""
        now_ns = monotonic_ns()
        if self.is_lockstep:
            idle_s = (now_ns - self._next_ns) * 1e-9 if self._next_ns else 0.0
            if idle_s > 0.5 * self.timing.stall_timeout_s:  # emulated time went on without us
                self.stall_s = max(self.stall_s, idle_s)
            return now_ns + round(self.timing.lockstep_timeout_s * 1e9)
        if now_ns < self._next_ns:
            sleep((self._next_ns - now_ns) * 1e-9)
            now_ns = monotonic_ns()
        elif self._next_ns:
            self.stall_s = max(self.stall_s, (now_ns - self._next_ns) * 1e-9)
        is_late = now_ns - self._next_ns > self._period_ns  # then no burst to make up for it
        self._next_ns = (now_ns if is_late else self._next_ns) + self._period_ns
        return now_ns + self._period_ns * 9 // 10

    def _guard(self, is_fresh: bool) -> None:
        self._missing = 0 if is_fresh else self._missing + 1
        if self._missing > MISSING_LIMIT:
            self._missing = 0
            raise StepError(f"no feedback for {MISSING_LIMIT} cycles")
        if not is_fresh:
            return
        q_rad = self.axis.q_rad
        if not (isfinite(q_rad) and isfinite(self.axis.tau_meas_Nm)):
            raise StepError(f"feedback is not finite: {q_rad} rad, {self.axis.tau_meas_Nm} Nm")
        if self._origin_rad is None:
            self._origin_rad = q_rad
        travel_rad = abs(q_rad - self._origin_rad)
        if travel_rad > self.limits.travel_rad:
            self._origin_rad = q_rad  # the next step begins from here
            raise StepError(
                f"the joint moved {travel_rad:.3f} rad, more than the {self.limits.travel_rad:g} "
                "rad allowed: torque off; hold it against gravity, or allow more with --travel"
            )

    def rest(self, silence_s: float) -> None:
        """Send nothing for a while. What arrives waits for the next cycle."""
        sleep(silence_s)
        self._next_ns = 0

    # --- states -------------------------------------------------------------------------------

    def cycles_of(self, time_s: float) -> int:
        """Return how many cycles a time takes, at least 1."""
        return max(1, round(time_s / self.timing.period_s))

    def wait_for(self, status: AxisStatus, tau_Nm: float = 0.0) -> int:
        """Run cycles until the axis has a status; return how many it took.

        Raises:
            StepError: If it has not after `limits.enable_s`.
        """
        for count in range(self.cycles_of(self.limits.enable_s)):
            if self.axis.status is status:
                return count
            self.cycle(tau_Nm)
        raise StepError(
            f"{status.name} not reached within {self.limits.enable_s:g} s: the axis is "
            f"{self.axis.status.name}{'; ' + self.axis.note if self.axis.note else ''}"
        )

    def bring_to(self, status: AxisStatus) -> None:
        """Bring the axis to DISABLED or ENABLED from wherever it is.

        Raises:
            StepError: If it cannot be brought there.
        """
        axis = self.axis
        if axis.status in (AxisStatus.FAULT, AxisStatus.LOST):
            axis.reset_fault()
            self.cycle()
            self.wait_for(AxisStatus.DISABLED)
        if status is AxisStatus.ENABLED and axis.status is not status:
            axis.enable()
        elif status is AxisStatus.DISABLED:
            axis.disable()
        self.wait_for(status)

    def come_to_rest(self) -> None:
        """Run cycles without torque until the joint stands still, and measure travel from there.

        Raises:
            StepError: If it does not stand still.
        """
        resolution_rad = self.info.angle_resolution_rad if self.info is not None else 0.0
        still_rad = max(REST_RAD, 3.0 * resolution_rad)
        for _ in range(self.cycles_of(REST_TIMEOUT_S) // REST_CYCLES):
            self.rebase()
            start_rad = self.axis.q_rad
            for _ in range(REST_CYCLES):
                self.cycle()
            if abs(self.axis.q_rad - start_rad) <= still_rad:
                self.rebase()
                return
        raise StepError(
            f"the joint does not come to rest within {REST_TIMEOUT_S:g} s without torque; "
            "hold it against gravity, or use less --torque"
        )

    def power_down(self) -> None:
        """Take torque off, whatever happened before; never raises.

        An axis that was not set up gets no frame: it may be somebody else's.
        """
        if self.info is None:
            return
        self.axis.disable()
        try:
            for _ in range(POWER_DOWN_CYCLES):
                self.bus.request_feedback()
                self.bus.send_torques([0.0])
                self.bus.collect(monotonic_ns() + 10 * self._period_ns)
                if self.axis.age_cycles == 0 and self.axis.status is not AxisStatus.ENABLED:
                    return
        except DriverError:
            return  # the bus is gone: the drive's watchdog has the last word

    def expect_status(self, *allowed: AxisStatus) -> None:
        """Refuse every other status than those allowed.

        Raises:
            StepError: With the axis's own note.
        """
        status = self.axis.status
        if status not in allowed:
            note = f": {self.axis.note}" if self.axis.note else ""
            raise StepError(f"the axis is {status.name}{note}")

    def begin_step(self) -> None:
        """Forget the frames of the last step."""
        self.frames, self.dropped, self.stall_s = [], 0, 0.0

    @property
    def report_cycles(self) -> int:
        """Cycles after which a report of torque is certainly about what holds now."""
        return round(self.limits.torque_report_s / self.timing.period_s)

    @property
    def has_heard(self) -> bool:
        """Anything was received in this step."""
        return any(direction == RECEIVED for _, direction, _ in self.frames)

    def rebase(self) -> None:
        """Measure travel from the present position on."""
        self._origin_rad = self.axis.q_rad
