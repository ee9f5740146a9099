"""An arm seen from a program: its state, its telemetry as numpy arrays, motions and gain bounds.

Everything here waits; `hil.aclient` is the same for programs that use asyncio.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from controller.faults import FaultCode
from controller.machine import State
from hil.connection import (
    DEFAULT_ENDPOINT,
    Client,
    NoAuthorityError,
    NoDaemonError,
    RefusedError,
)
from hil.errors import HilError
from hil.fixed_protobuf import Records
from hil.messages import Reply
from hil.telemetry_log import NoTelemetryError, TelemetryLog

__all__ = [
    "DEFAULT_ENDPOINT",
    "Arm",
    "ArmState",
    "Client",
    "MotionError",
    "NoAuthorityError",
    "NoDaemonError",
    "NoTelemetryError",
    "RefusedError",
    "TelemetryLog",
]

FIRST_SAMPLE_S = 10.0
KEEP_S = 60.0
SETTLE_S = 5.0
"""A motion may end this much later than announced: a busy host runs slower than its arm's clock."""

Floats = NDArray[np.float64]


class MotionError(HilError):
    """A motion did not come to its end: the arm tripped, was stopped, or takes too long."""


@dataclass(frozen=True, slots=True)
class ArmState:
    """One cycle of the arm; arrays have one entry per joint, shoulder first.

    Attributes:
        cycle: Of the loop, from its start.
        t_ns: Start of the cycle, by the clock of the daemon's host.
        state: Of the machine.
        fault: Latched, or NONE.
        q_rad: Measured joint angles.
        dq_rad_s: Estimated joint rates.
        q_des_rad: Reference.
        dq_des_rad_s: Its rate.
        tau_Nm: Torques sent.
        Kd: Self-tuned gain in force.
        Kd_min: Its lower bound.
        Kd_max: Its upper bound.
    """

    cycle: int
    t_ns: int
    state: State
    fault: FaultCode
    q_rad: Floats
    dq_rad_s: Floats
    q_des_rad: Floats
    dq_des_rad_s: Floats
    tau_Nm: Floats
    Kd: Floats
    Kd_min: Floats
    Kd_max: Floats

    @classmethod
    def of(cls, row: Any) -> Self:  # noqa: ANN401 - numpy.void, whose fields no stub knows
        """Make it from a row of telemetry."""
        return cls(
            int(row["cycle"]),
            int(row["t_ns"]),
            State(int(row["state"])),
            FaultCode(int(row["fault"])),
            *(
                row[name].copy()
                for name in ("q_meas_rad", "dq_meas_rad_s", "q_des_rad", "dq_des_rad_s",
                             "tau_sent_Nm", "Kd", "Kd_min", "Kd_max")
            ),
        )  # fmt: skip


class Arm:
    """One arm, under this program's authority while the `with` block lasts.

    An exception in the block stops the arm (it holds, under power) before authority is given back;
    an orderly end lets a running motion go on. If the program dies, `remote.on_operator_loss` of
    the daemon's configuration applies.

    Args:
        name: Of the arm.
        endpoints: Zenoh endpoints of the daemon or of a router.
        operator: Who this is, for the record; none: user and host.
        observe: Only look: no authority is taken, and every command but `estop` is refused.

    Raises:
        SessionError: If none of the endpoints can be reached.
        NoAuthorityError: On entering, if another operator has authority.

    Example:
        >>> with Arm("bench") as arm:                                       # doctest: +SKIP
        ...     arm.enable()
        ...     arm.move([0.5, -0.3])
        ...     print(arm.state.q_rad)
    """

    def __init__(
        self,
        name: str = "bench",
        endpoints: Sequence[str] = (DEFAULT_ENDPOINT,),
        *,
        operator: str | None = None,
        observe: bool = False,
    ) -> None:
        self.client = Client(name, endpoints, operator)
        self._observe = observe
        self._log = TelemetryLog(KEEP_S)
        self._since_cycle = -1
        self.client.on_telemetry(self._log.take)

    def __enter__(self) -> Self:
        try:
            if not self._observe:
                self.client.acquire()
        except BaseException:
            self.client.close()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            if kind is not None and self.client.has_authority:
                self._stop_for_error()
        finally:
            self.client.close()

    def _stop_for_error(self) -> None:
        try:
            self.client.command("stop")
        except (RefusedError, NoDaemonError):
            return  # nothing to stop, or nobody to tell

    # --- what is ------------------------------------------------------------------------------

    @property
    def state(self) -> ArmState:
        """The newest cycle known here, at least that in which the last command took effect.

        Raises:
            NoTelemetryError: If no telemetry comes.
        """
        return ArmState.of(self._log.wait(self._is_since, FIRST_SAMPLE_S))

    def _is_since(self, row: Any) -> bool:  # noqa: ANN401 - numpy.void
        return bool(row["cycle"] >= self._since_cycle)

    def telemetry(self) -> Records:
        """Every sample of the last minute: `telemetry()["q_meas_rad"]` is cycles x joints."""
        return self._log.rows()

    def record(self, keep_s: float = KEEP_S) -> TelemetryLog:
        """Return a log of what comes from now on, of so many seconds at most."""
        log = TelemetryLog(keep_s)
        self.on_telemetry(log.take)
        return log

    def on_telemetry(self, take: Callable[[Records], None]) -> Callable[[], None]:
        """Have every batch from now on passed to `take`; return what ends that."""
        self._log.pass_on(take)
        return lambda: self._log.pass_on_no_more(take)

    # --- what to do ---------------------------------------------------------------------------

    def enable(self) -> None:
        """Power on; the arm holds its pose. Each of these raises RefusedError with the reason."""
        self._command("enable")

    def disable(self) -> None:
        """Damped stop, then power off."""
        self._command("disable")

    def stop(self) -> None:
        """Slow down along the path and hold, under power."""
        self._command("stop")

    def estop(self) -> None:
        """Torque off at once; latched. Needs no authority."""
        self._command("estop")

    def reset(self) -> None:
        """Clear a latched fault or emergency stop; it does not enable."""
        self._command("reset")

    def set_gain_bounds(self, Kd_min: Sequence[float], Kd_max: Sequence[float]) -> None:
        """Let the bounds of the self-tuned gain ramp to these, Nm s/rad."""
        self._command("gain_bounds", Kd_min=list(Kd_min), Kd_max=list(Kd_max))

    def inject_fault(self, target: str, kind: str, **more: object) -> None:
        """Ask the emulator for a fault (`joint`, `duration_s`); `kind="ok"` ends it."""
        self._command("fault", target=target, kind=kind, **more)

    def start(self, request: Mapping[str, Any]) -> float:
        """Start a trajectory of any kind (`hil.messages`); return its duration in s."""
        return self._command("trajectory", **request).duration_s or 0.0

    def _command(self, verb: str, **arguments: object) -> Reply:
        reply = self.client.command(verb, **arguments)
        if reply.cycle is not None:
            self._since_cycle = reply.cycle
        return reply

    def move(
        self, target_rad: Sequence[float], *, speed_scale: float = 1.0, wait: bool = True
    ) -> float:
        """Move to a pose as fast as the limits allow; return the duration in s.

        Raises:
            RefusedError: If it is beyond a limit; nothing has moved.
            MotionError: If it is to be waited for and does not come to its end.
        """
        request = {"kind": "move", "target_rad": list(target_rad), "speed_scale": speed_scale}
        return self._go(request, wait=wait)

    def follow(
        self, times_s: Sequence[float], points_rad: ArrayLike, *, wait: bool = True
    ) -> float:
        """Pass through timed points, from 0 s, at rest at both ends; errors as for `move`."""
        points = np.asarray(points_rad, dtype=float).tolist()
        times = [float(t_s) for t_s in times_s]
        return self._go({"kind": "waypoints", "times_s": times, "points_rad": points}, wait=wait)

    def play(self, q_rad: ArrayLike, period_s: float, *, wait: bool = True) -> float:
        """Play an array, samples x joints, so many seconds apart; errors as for `move`."""
        rows = np.asarray(q_rad, dtype=float).tolist()
        return self._go({"kind": "samples", "period_s": period_s, "q_rad": rows}, wait=wait)

    def _go(self, request: Mapping[str, Any], *, wait: bool) -> float:
        duration_s = self.start(request)
        if wait:
            self.wait(2.0 * duration_s + SETTLE_S)
        return duration_s

    def wait(self, timeout_s: float) -> ArmState:
        """Wait for the end of the running motion.

        Raises:
            MotionError: If the arm leaves the powered states or is still moving after this time.
        """
        row = self._log.wait(
            lambda row: self._is_since(row) and row["state"] != State.ACTIVE, timeout_s
        )
        state = ArmState.of(row)
        if state.state is State.ACTIVE:
            raise MotionError(f"still moving after {timeout_s:.1f} s")
        if state.state not in (State.HOLD, State.READY):
            raise MotionError(f"the arm is in state {state.state.name} (fault {state.fault.name})")
        return state

    def on_event(self, take: Callable[[dict[str, Any]], None]) -> None:
        """Have every event passed to `take`, in a thread of its own."""
        self.client.on_event(take)
