"""All axes of one arm on one bus: start-up, and the cyclic exchange of the 1 kHz loop."""

from collections.abc import Callable, Sequence

from drivers.axis import Axis, AxisInfo, AxisStatus, FrameHandler
from drivers.bus import Bus
from drivers.errors import AmplifierError, BusError
from drivers.frame import (
    EFF_MASK,
    ERR_FLAG,
    LOCKSTEP_ID,
    pack_fd_frame,
    pack_frame,
    unpack_frame,
    unpack_header,
)
from drivers.probe import Probe

SYNC_ID = 0x080
HEARTBEAT_ID = 0x700
RECEIVED, SENT = 0, 1
MARK = 255
"""In the frame log of a bus without SYNC: what follows was received in the cycle, not before it."""
NO_FRAME = bytes(16)
OVERDUE_FRAMES = 100
"""Queued frames still looked at when the time to wait for one is up."""
FLOOD_FRAMES = 4096
"""So many leftovers at the start of a cycle are more than a second's stall leaves behind: the bus
is flooded, and what is still queued is too old to be used."""

PROBE_LOCKSTEP_NS = 50_000_000
"""Emulated time waits, so that a probe in lockstep need not last longer than answers travel."""

FrameLog = Callable[[int, bytes], None]
"""Called with (RECEIVED or SENT, record) for every frame, in the order seen, and with MARK."""


class ArmAxes:
    """What is asked of all axes of an arm together, whatever buses they are on.

    Attributes:
        axes: Shoulder first.
    """

    axes: list[Axis]

    @property
    def is_enabled(self) -> bool:
        """True if every axis applies torque."""
        for axis in self.axes:  # noqa: SIM110 - asked every cycle: all() costs three times as much
            if axis.status is not AxisStatus.ENABLED:
                return False
        return True

    def first_in(self, status: AxisStatus) -> Axis | None:
        """Return the first axis with this status, None if there is none."""
        return next((axis for axis in self.axes if axis.status is status), None)

    @property
    def age_cycles(self) -> int:
        """Age of the oldest feedback, 0 = all fresh."""
        oldest = 0
        for axis in self.axes:
            if axis.age_cycles > oldest:  # noqa: PLR1730 - asked every cycle
                oldest = axis.age_cycles
        return oldest


class ArmBus(ArmAxes):
    """The axes of one arm and the bus they share.

    A cycle is `request_feedback`, `collect`, `send_torques`. Nothing in it waits except `collect`,
    and that never longer than its deadline.

    Attributes:
        axes: Shoulder first.
        stats: The bus's own counters.
        late_frames: Feedback that arrived after its cycle had ended; discarded. Whether it did is
            found out by a probe (`drivers.probe`) if it came a whole period late.
        unknown_frames: Frames that belong to no axis of this arm.
        error_frames: Error reports of the CAN controller.
    """

    def __init__(
        self, bus: Bus, axes: Sequence[Axis], *, now_ns: Callable[[], int], master_id: int = 127
    ) -> None:
        self.axes = list(axes)
        self.stats = bus.stats
        self.late_frames = 0
        self.unknown_frames = 0
        self.error_frames = 0
        self._bus = bus
        self._now_ns = now_ns
        self._log: FrameLog | None = None
        self._is_flooded = False
        self._is_emulated = False
        self._is_lockstep = False
        self._probe = Probe()
        self._handlers: dict[int, FrameHandler] = {}
        self._shared_ids: frozenset[int] = frozenset()
        self._sync = pack_frame(SYNC_ID) if any(a.uses_sync for a in axes) else None
        self._heartbeat = pack_frame(HEARTBEAT_ID + master_id, b"\x05")
        self._heartbeat_every = 0
        self._cycles_to_heartbeat = 0
        self._extra: list[bytes] = []
        self._requesting = [a for a in self.axes if type(a).request is not Axis.request]

    def log_frames(self, log: FrameLog | None) -> None:
        """Have every frame reported from now on, or none."""
        self._log = log

    def configure(self, *, heartbeat_cycles: int) -> list[AxisInfo]:
        """Set up every axis for cyclic torque; all end disabled.

        Args:
            heartbeat_cycles: The master's own heartbeat is sent every so many cycles; 0 = never.

        Raises:
            AmplifierError: See `Axis.configure`, or if another master is at work on the bus.
            BusError: If the bus is gone.
        """
        self._heartbeat_every = heartbeat_cycles
        self._bus.accept(None)
        port = _Port(self._bus, self._now_ns, self._log)
        if port.wait(SYNC_ID, 0.02) is not None:
            raise AmplifierError(
                "another master sends SYNC on this bus; stop the other daemon first"
            )
        infos = [axis.configure(port) for axis in self.axes]
        if len({info.is_lockstep for info in infos}) > 1:
            raise AmplifierError("some axes run in lockstep and some by the clock; choose one")
        self._is_emulated = all(info.is_emulated for info in infos)
        self._is_lockstep = infos[0].is_lockstep
        self._probe.watch(self.axes)
        if self._sync is None and infos[0].is_lockstep:
            self._sync = pack_frame(LOCKSTEP_ID)
        for axis in self.axes:
            axis.start(port)
            self._add_handlers(axis)
        self._bus.accept({SYNC_ID, LOCKSTEP_ID, *self._handlers})  # another master's SYNC too
        return infos

    def _add_handlers(self, axis: Axis) -> None:
        shared = axis.shared_ids()
        for can_id, handler in axis.handlers().items():
            other = self._handlers.get(can_id)
            if other is None:
                self._handlers[can_id] = handler
            elif can_id in shared and can_id in self._shared_ids:
                self._handlers[can_id] = _either(other, handler)
            else:
                raise AmplifierError(
                    f"{axis.label}: identifier 0x{can_id & EFF_MASK:X} belongs to another axis too;"
                    " give one of them another node id"
                )
        self._shared_ids |= shared

    def request_feedback(self) -> None:
        """Begin a cycle: discard what came too late for the last one, then ask, SYNC last."""
        self._drain()
        if self._probe.is_due:
            self._begin_probe()
            return
        for axis in self._requesting:
            request = axis.request()
            if request is not None:
                self._send(request)
        if self._sync is not None:
            self._send(self._sync)
        elif self._log is not None:
            self._log(MARK, NO_FRAME)

    def collect(self, deadline_ns: int) -> bool:
        """Receive until every axis has fresh feedback, or until the deadline.

        Returns:
            True if all feedback is fresh. Axes without it have `age_cycles` > 0 and keep their
            last values.

        Raises:
            BusError: If the bus is gone.
        """
        missing = 0
        for axis in self.axes:
            axis.age_cycles += 1
            if axis.age_cycles > 0:
                missing += 1
        if self._is_flooded:
            return False
        probe = self._probe
        if not probe.is_at_ease:
            if probe.is_due:
                return self._listen(deadline_ns)
            probe.note_ages()
        if self._receive(missing, deadline_ns):
            probe.note_gap()
            return False
        if probe.is_at_ease:
            return True
        late = probe.believe()
        self.late_frames += late
        return not late

    def _receive(self, missing: int, deadline_ns: int) -> int:
        """Receive until nobody is missing, or until the deadline; return who still is."""
        overdue = 0
        recv, handlers, log = self._bus.recv, self._handlers, self._log
        while missing:
            remaining_s = (deadline_ns - self._now_ns()) * 1e-9
            if remaining_s <= 0.0:
                overdue += 1
                remaining_s = 0.0
                if overdue > OVERDUE_FRAMES:
                    break
            frame = recv(remaining_s)
            if frame is None:
                break
            if log is not None:
                log(RECEIVED, frame)
            handler = handlers.get(unpack_header(frame)[0])
            if handler is None:
                self._count_foreign(frame)
            elif handler(frame):
                missing -= 1
        return missing

    def _begin_probe(self) -> None:
        """Begin a cycle without asking; emulated time goes on all the same."""
        if self._is_lockstep:
            self._send(pack_frame(LOCKSTEP_ID))
        if self._log is not None:
            self._log(MARK, NO_FRAME)

    def _listen(self, deadline_ns: int) -> bool:
        """Take what comes in a probe; fresh is only what axes send that nobody asks."""
        if self._is_lockstep:
            deadline_ns = min(deadline_ns, self._now_ns() + PROBE_LOCKSTEP_NS)
        self._probe.note_ages()
        self._receive(len(self.axes) + 1, deadline_ns)
        self.late_frames += self._probe.judge()
        return self.age_cycles == 0

    def send_torques(self, tau_Nm: Sequence[float]) -> None:
        """End a cycle: send every axis its command, and the heartbeat when it is due.

        Raises:
            BusError: If the bus is gone.
        """
        axes = self.axes
        # Back to back: the first wakes who sleeps at the other end, the others come for free.
        for frame in [axis.command(tau) for axis, tau in zip(axes, tau_Nm, strict=True)]:
            if frame is not None:
                self._send(frame)
        for axis in axes:
            axis.end_cycle()
        if self._extra:
            self._send(self._extra.pop(0))
        if self._heartbeat_every:
            self._cycles_to_heartbeat -= 1
            if self._cycles_to_heartbeat <= 0:
                self._cycles_to_heartbeat = self._heartbeat_every
                self._send(self._heartbeat)

    def inject_fault(self, joint: int) -> bool:
        """Queue the frame that faults an emulated amplifier; False if the family has none."""
        frame = self.axes[joint].inject_fault()
        if frame is None:
            return False
        self._extra.append(frame)
        return True

    def send_fault(self, frame: bytes) -> bool:
        """Queue a frame for the emulator (`drivers.fault_frame`); False if amplifiers are real."""
        if self._is_emulated:
            self._extra.append(frame)
        return self._is_emulated

    def close(self) -> None:
        """Leave the bus."""
        self._bus.close()

    def _send(self, frame: bytes) -> None:
        if self._bus.send(frame) and self._log is not None:
            self._log(SENT, frame)

    def _drain(self) -> None:
        """Take frames left over from the last cycle; feedback among them is late and not used."""
        left = FLOOD_FRAMES
        while left and (frame := self._bus.recv(0.0)) is not None:
            left -= 1
            if self._log is not None:
                self._log(RECEIVED, frame)
            handler = self._handlers.get(unpack_header(frame)[0])
            if handler is None:
                self._count_foreign(frame)
            elif handler(frame):
                self.late_frames += 1
        self._is_flooded = not left

    def _count_foreign(self, frame: bytes) -> None:
        if unpack_header(frame)[0] & ERR_FLAG:
            self.error_frames += 1
        else:
            self.unknown_frames += 1


def _either(first: FrameHandler, second: FrameHandler) -> FrameHandler:
    """Return the handler of an identifier that two axes are answered on."""
    return lambda frame: first(frame) or second(frame)


class _Port:
    """The bus during start-up: frames that nobody waits for are dropped."""

    def __init__(self, bus: Bus, now_ns: Callable[[], int], log: FrameLog | None) -> None:
        self._bus = bus
        self._now_ns = now_ns
        self._log = log

    def send(self, can_id: int, data: bytes, *, is_fd: bool = False) -> None:
        if is_fd and not self._bus.carries_fd:
            raise BusError(
                "this bus carries no CAN FD frames, which an amplifier here needs; use a bus that "
                "does (on Linux: `ip link set can0 ... fd on`)"
            )
        frame = pack_fd_frame(can_id, data) if is_fd else pack_frame(can_id, data)
        if not self._bus.send(frame):
            raise BusError("the bus takes no frames (send queue full); is any other node on it?")
        if self._log is not None:
            self._log(SENT, frame)

    def wait(self, can_id: int, timeout_s: float) -> bytes | None:
        deadline_ns = self._now_ns() + round(timeout_s * 1e9)
        overdue = 0
        while True:
            remaining_ns = deadline_ns - self._now_ns()
            frame = self._bus.recv(max(0, remaining_ns) * 1e-9)
            if frame is None:
                return None
            if self._log is not None:
                self._log(RECEIVED, frame)
            got_id, data = unpack_frame(frame)
            if got_id == can_id:
                return data
            if remaining_ns <= 0:
                overdue += 1
                if overdue > OVERDUE_FRAMES:
                    return None
