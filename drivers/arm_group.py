"""Several buses of one arm in one cycle: the axes of each behind an `ArmBus` of its own.

Everything that begins a cycle is sent on all buses before anything is waited for, so that the
amplifiers of all buses work at the same time; the waiting has one deadline for all.
"""

from collections.abc import Callable, Sequence
from typing import Any

from drivers.arm_bus import MARK, RECEIVED, SENT, ArmAxes, ArmBus, FrameLog
from drivers.axis import Axis, AxisInfo
from drivers.bus import Bus, BusStats, open_bus
from drivers.errors import AmplifierError, BusDownError, BusError
from drivers.registry import axes_by_bus, heartbeat_cycles, make_axes
from drivers.settings import MOST_BUSES, AxisSettings

_FIRST_MARK = MARK - MOST_BUSES + 1


def join_bus(bus: int, way: int) -> int:
    """Return what a frame log calls a direction on a bus; on bus 1 it is `way` itself.

    Args:
        bus: Number of the bus, from 1.
        way: `RECEIVED`, `SENT` or `MARK`.
    """
    return way - (bus - 1) if way == MARK else 2 * (bus - 1) + way


def split_bus(direction: int) -> tuple[int, int]:
    """Return (number of the bus, `RECEIVED`, `SENT` or `MARK`) of a frame log's direction."""
    if direction >= _FIRST_MARK:
        return MARK - direction + 1, MARK
    return direction // 2 + 1, SENT if direction % 2 else RECEIVED


class ArmGroup(ArmAxes):
    """The axes of one arm on several buses; it stands where one `ArmBus` does.

    A bus that fails keeps no other from its frames: the first error of a cycle is raised by
    `send_torques`, when all buses that work have got their commands, and with it torque-off.

    Attributes:
        axes: Shoulder first, whatever bus they are on.
        buses: In the order of their numbers.
    """

    def __init__(
        self,
        buses: Sequence[Bus],
        axes: Sequence[Axis],
        places: Sequence[int],
        *,
        now_ns: Callable[[], int],
    ) -> None:
        """Put every axis on its bus.

        Args:
            buses: Open buses, each with at least one axis.
            axes: Shoulder first.
            places: Number of each axis's bus, from 1.
            now_ns: Clock of the deadlines.
        """
        self.axes = list(axes)
        numbers = range(1, len(buses) + 1)
        self._joints = [[j for j, place in enumerate(places) if place == n] for n in numbers]
        self.buses = [
            ArmBus(bus, [self.axes[j] for j in joints], now_ns=now_ns)
            for bus, joints in zip(buses, self._joints, strict=True)
        ]
        self._is_emulated = False
        self._error: BusError | None = None

    def log_frames(self, log: FrameLog | None) -> None:
        """Have every frame reported from now on, or none; `split_bus` tells the buses apart."""
        for number, bus in enumerate(self.buses, start=1):
            bus.log_frames(log if log is None or number == 1 else _log_of(number, log))

    def configure(self, *, heartbeat_cycles: Sequence[int]) -> list[AxisInfo]:
        """Set up every axis for cyclic torque, bus by bus; all end disabled.

        Args:
            heartbeat_cycles: See `ArmBus.configure`; one entry per bus.

        Raises:
            AmplifierError: See `ArmBus.configure`, or if the buses disagree about time.
            BusError: If a bus is gone.
        """
        infos: dict[int, AxisInfo] = {}
        for bus, joints, cycles in zip(self.buses, self._joints, heartbeat_cycles, strict=True):
            infos |= zip(joints, bus.configure(heartbeat_cycles=cycles), strict=True)
        ordered = [infos[joint] for joint in range(len(self.axes))]
        if len({info.is_lockstep for info in ordered}) > 1:
            raise AmplifierError("some buses run in lockstep and some by the clock; choose one")
        self._is_emulated = all(info.is_emulated for info in ordered)
        return ordered

    def request_feedback(self) -> None:
        """Begin a cycle on every bus (`ArmBus.request_feedback`)."""
        self._error = None
        for bus in self.buses:
            try:
                bus.request_feedback()
            except BusError as error:
                self._note(error)

    def collect(self, deadline_ns: int) -> bool:
        """Receive on one bus after the other, all until the same deadline.

        What has come on a bus in the meantime waits in its queue and counts, even if the deadline
        has passed by the time it is looked at.

        Returns:
            True if all feedback of all buses is fresh.
        """
        is_fresh = self._error is None
        for bus in self.buses:
            try:
                if not bus.collect(deadline_ns):
                    is_fresh = False
            except BusError as error:
                self._note(error)
                is_fresh = False
        return is_fresh

    def send_torques(self, tau_Nm: Sequence[float]) -> None:
        """End a cycle on every bus (`ArmBus.send_torques`).

        Raises:
            BusError: The first error of the cycle, whatever part of it failed. All other buses
                have got their frames.
        """
        for bus, joints in zip(self.buses, self._joints, strict=True):
            try:
                bus.send_torques([tau_Nm[joint] for joint in joints])
            except BusError as error:
                self._note(error)
        if self._error is not None:
            raise self._error

    def _note(self, error: BusError) -> None:
        """Keep the first error, but one that is for good before one that may pass."""
        if self._error is None or (
            isinstance(self._error, BusDownError) and not isinstance(error, BusDownError)
        ):
            self._error = error

    def inject_fault(self, joint: int) -> bool:
        """See `ArmBus.inject_fault`."""
        for bus, joints in zip(self.buses, self._joints, strict=True):
            if joint in joints:
                return bus.inject_fault(joints.index(joint))
        return False

    def send_fault(self, frame: bytes) -> bool:
        """See `ArmBus.send_fault`; the emulator behind all buses hears it on the first."""
        return self._is_emulated and self.buses[0].send_fault(frame)

    # --- what is asked ten times a second ------------------------------------------------------

    @property
    def stats(self) -> BusStats:
        """The counters of all buses together."""
        names = BusStats.__slots__
        return BusStats(*(sum(getattr(bus.stats, name) for bus in self.buses) for name in names))

    @property
    def late_frames(self) -> int:
        """See `ArmBus`; of all buses."""
        return sum(bus.late_frames for bus in self.buses)

    @property
    def unknown_frames(self) -> int:
        """See `ArmBus`; of all buses."""
        return sum(bus.unknown_frames for bus in self.buses)

    @property
    def error_frames(self) -> int:
        """See `ArmBus`; of all buses."""
        return sum(bus.error_frames for bus in self.buses)

    def counts(self) -> list[dict[str, Any]]:
        """Return the counters of each bus, for the status."""
        return [
            {
                "frames_sent": bus.stats.frames_sent,
                "frames_received": bus.stats.frames_received,
                "send_failures": bus.stats.send_failures,
                "late_frames": bus.late_frames,
                "unknown_frames": bus.unknown_frames,
                "error_frames": bus.error_frames,
                "age_cycles": bus.age_cycles,
            }
            for bus in self.buses
        ]

    def close(self) -> None:
        """Leave every bus."""
        for bus in self.buses:
            bus.close()


def _log_of(number: int, log: FrameLog) -> FrameLog:
    ways = {way: join_bus(number, way) for way in (RECEIVED, SENT, MARK)}
    return lambda way, frame: log(ways[way], frame)


ArmLike = ArmBus | ArmGroup
"""One bus, or several in its place."""


def open_buses(addresses: Sequence[str]) -> list[Bus]:
    """Join every bus.

    Raises:
        BusError: If one is not there; none is open then.
    """
    buses: list[Bus] = []
    try:
        for address in addresses:
            buses.append(open_bus(address))  # noqa: PERF401 - those that are open are closed then
    except BaseException:
        for bus in buses:
            bus.close()
        raise
    return buses


def make_arm(
    buses: Sequence[Bus],
    settings: Sequence[AxisSettings],
    *,
    period_s: float,
    now_ns: Callable[[], int],
) -> ArmLike:
    """Return the arm behind its buses; with one bus that is an `ArmBus`, and nothing in front.

    Args:
        buses: Open buses, each with at least one axis.
        settings: One settings object a joint, shoulder first.
        period_s: The control period.
        now_ns: Clock of the deadlines.
    """
    axes = make_axes(settings, period_s=period_s)
    if len(buses) == 1:
        return ArmBus(buses[0], axes, now_ns=now_ns)
    return ArmGroup(buses, axes, [axis.bus for axis in settings], now_ns=now_ns)


def configure_arm(
    arm: ArmLike, settings: Sequence[AxisSettings], *, period_s: float
) -> list[AxisInfo]:
    """Set up every axis, disabled; each bus has the heartbeat that its own axes listen for.

    Args:
        arm: From `make_arm`.
        settings: As given to it.
        period_s: The control period.

    Raises:
        DriverError: See `ArmGroup.configure`.
    """
    cycles = [heartbeat_cycles(on_it, period_s=period_s) for on_it in axes_by_bus(settings)]
    if isinstance(arm, ArmGroup):
        return arm.configure(heartbeat_cycles=cycles)
    return arm.configure(heartbeat_cycles=cycles[0])
