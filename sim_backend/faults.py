"""Faults on purpose: what each kind means on each target, and when it acts.

| kind | encoder | amplifier | bus | host |
|---|---|---|---|---|
| `off` | reads count zero | power stage fails, and says so | carries nothing | sends nothing |
| `stuck` | reads what it last read | hangs: hears and says nothing | bridge hangs | process hangs |
| `garbage` | reads any angle | any data in its frames | any frame instead | any frame instead |
| `wrong` | reads `shift_rad` too much | torque with reversed sign | echo | echo |
| `slow` | new one every `hold_ms` | new torque every `hold_ms` | one frame a period | the same |
| `delayed` | reads what was `hold_ms` ago | answers a period late | a period late | the same |
| `intermittent` | `off` at times | hears and says nothing at times | nothing at times | the same |

Garbage on the bus has 29-bit identifiers, which hardly anybody listens to: the checksum of CAN lets
no frame pass that is merely disturbed. A power stage keeps its last torque while its amplifier
hangs, until the amplifier's own watchdog acts. A bridge, or a process, that hangs keeps frames back
and lets them go in one burst at the end. An echo is the same frame a second time, one period later.
`bus` acts in both directions, and on all buses alike if there are several; `host` on what the
host sends. Faults of one target replace each
other; those of different targets add up.

Time is emulated time in periods of 1 ms, random values come from a seeded generator: the same run
has the same faults, to the bit.
"""

import math
from collections import deque
from collections.abc import Callable, Sequence
from random import Random

from drivers.fault_frame import FaultKind, FaultOrder, FaultTarget
from drivers.frame import EFF_FLAG, is_fd, pack_fd_frame, pack_frame, unpack_frame, unpack_header
from sim_backend.node import AmplifierNode, Transmit
from sim_backend.servo import Servo
from sim_backend.settings import FaultSettings

QUEUE_FRAMES = 32
"""So many frames wait at most where a fault keeps them back; the oldest are lost."""
GARBAGE_RAD_S = 100.0
_FAILED = (FaultTarget.AMPLIFIER, FaultKind.OFF)
_TORQUE = (FaultKind.WRONG, FaultKind.SLOW)
_ON_LINE = {
    FaultKind.STUCK: FaultKind.OFF,
    FaultKind.GARBAGE: FaultKind.GARBAGE,
    FaultKind.DELAYED: FaultKind.DELAYED,
    FaultKind.INTERMITTENT: FaultKind.INTERMITTENT,
}
"""Fault of an amplifier -> that of the line on which its frames leave it."""
Carry = Callable[[int, bytes], None]
"""Takes a frame and the amplifier (from 0) that sent it; of the host's frames, the bus (from 0)."""


class Line:
    """A stretch of the way that frames take, with a fault on it.

    Attributes:
        is_interrupted: The fault `intermittent` is in a part of the time in which nothing passes.
    """

    __slots__ = ("_keeps_id", "_kind", "_let_go", "_queue", "_random", "_room", "is_interrupted")

    def __init__(self, let_go: Carry, random: Random, *, keeps_id: bool = False) -> None:
        """Build a line without a fault.

        Args:
            let_go: Takes what has come through.
            random: Source of garbage.
            keeps_id: Garbage is in the data alone.
        """
        self._let_go = let_go
        self._random = random
        self._keeps_id = keeps_id
        self._kind = FaultKind.OK
        self._queue: deque[tuple[int, int, bytes]] = deque(maxlen=QUEUE_FRAMES)
        self._room = 1
        self.is_interrupted = False

    def set(self, kind: FaultKind) -> None:
        """Begin a fault, or end it (`OK`): what was kept back goes on its way, in order."""
        self._kind = kind
        self._room = 1
        queue = list(self._queue)
        self._queue.clear()
        for _, source, frame in queue:
            self._let_go(source, frame)

    def carry(self, source: int, frame: bytes, period: int) -> None:
        """Take one frame that comes along in a period."""
        kind = self._kind
        if kind is FaultKind.OK or (kind is FaultKind.SLOW and self._room):
            self._room = 0
            self._let_go(source, frame)
        elif kind is FaultKind.GARBAGE:
            self._let_go(source, self._any_frame(frame))
        elif kind is FaultKind.INTERMITTENT:
            if not self.is_interrupted:
                self._let_go(source, frame)
        elif kind is not FaultKind.OFF:
            if kind is FaultKind.WRONG:
                self._let_go(source, frame)
            self._queue.append((period, source, frame))

    def begin_period(self, before: int) -> None:
        """Let go what is due: frames that came along before period `before`."""
        queue = self._queue
        if self._kind is FaultKind.SLOW:
            self._room = 0 if queue else 1
            if queue:
                self._let_go(*self._take_strongest()[1:])
        elif self._kind in (FaultKind.DELAYED, FaultKind.WRONG):
            while queue and queue[0][0] < before:
                self._let_go(*queue.popleft()[1:])

    def _take_strongest(self) -> tuple[int, int, bytes]:
        """Take the frame that wins arbitration: of the lowest identifier, the oldest."""
        first = min(self._queue, key=lambda entry: unpack_header(entry[2])[0])
        self._queue.remove(first)
        return first

    def _any_frame(self, frame: bytes) -> bytes:
        can_id, data = unpack_frame(frame)
        data = self._random.randbytes(len(data))
        if not self._keeps_id:
            can_id = EFF_FLAG | self._random.getrandbits(29)
        return pack_fd_frame(can_id, data) if is_fd(frame) else pack_frame(can_id, data)


class _Encoder:
    """What a faulty encoder makes of the true angle and rate."""

    __slots__ = ("_age", "_held", "_kind", "_random", "_settings", "_trail", "is_interrupted")

    def __init__(self, settings: FaultSettings, random: Random) -> None:
        self._settings = settings
        self._random = random
        self._kind = FaultKind.OK
        self._held = (0.0, 0.0)
        self._trail: deque[tuple[float, float]] = deque()
        self._age = 0
        self.is_interrupted = False

    def set(self, kind: FaultKind, servo: Servo) -> None:
        self._kind = kind
        self._held = (servo.q_rad, servo.dq_rad_s)
        self._age = 0
        self._trail.clear()

    def distort(self, servo: Servo) -> None:
        """Change what the servo has just sensed; called once per current-loop period."""
        kind, settings = self._kind, self._settings
        if kind is FaultKind.OFF or (kind is FaultKind.INTERMITTENT and self.is_interrupted):
            offset = servo.settings.encoder_offset_counts
            servo.q_rad, servo.dq_rad_s = -offset * math.tau / servo.counts_per_turn, 0.0
        elif kind is FaultKind.STUCK:
            servo.q_rad, servo.dq_rad_s = self._held[0], 0.0
        elif kind is FaultKind.GARBAGE:
            servo.q_rad = self._random.uniform(-math.pi, math.pi)
            servo.dq_rad_s = self._random.uniform(-GARBAGE_RAD_S, GARBAGE_RAD_S)
        elif kind is FaultKind.WRONG:
            servo.q_rad += settings.shift_rad
        elif kind is FaultKind.SLOW:
            if self._age % (2 * settings.hold_ms) == 0:
                self._held = (servo.q_rad, servo.dq_rad_s)
            self._age += 1
            servo.q_rad, servo.dq_rad_s = self._held
        elif kind is FaultKind.DELAYED:
            self._trail.append((servo.q_rad, servo.dq_rad_s))
            servo.q_rad, servo.dq_rad_s = self._trail[0]
            if len(self._trail) > 2 * settings.hold_ms:
                self._trail.popleft()


class _PowerStage:
    """What a faulty amplifier makes of the torque it is to apply."""

    __slots__ = ("_age", "_held_Nm", "_hold", "_kind")

    def __init__(self, settings: FaultSettings) -> None:
        self._hold = 2 * settings.hold_ms
        self._kind = FaultKind.OK
        self._held_Nm = 0.0
        self._age = 0

    def set(self, kind: FaultKind) -> None:
        self._kind = kind
        self._age = 0

    def drive(self, servo: Servo) -> float:
        """Run one period of the current loop; without power there is no torque in any case."""
        if self._kind not in _TORQUE:
            return servo.drive()
        wanted_Nm = servo.torque_target_Nm
        if self._kind is FaultKind.WRONG:
            servo.torque_target_Nm = -wanted_Nm
        else:
            if self._age % self._hold == 0:
                self._held_Nm = wanted_Nm
            self._age += 1
            servo.torque_target_Nm = self._held_Nm
        tau_Nm = servo.drive()
        servo.torque_target_Nm = wanted_Nm
        return tau_Nm


class _Active:
    """A fault that acts, and for how long."""

    __slots__ = ("end", "kind", "start")

    def __init__(self, kind: FaultKind, start: int, duration: int) -> None:
        self.kind = kind
        self.start = start
        self.end = start + duration if duration else None


class Faults:
    """All faults of one emulated robot: frames and torques go through here while any acts.

    Args:
        settings: Sizes, seed and schedule.
        servos: One per joint, shoulder first.
        transmits: How frames of each joint's amplifier get onto the wire.
        places: Bus (from 0) of each joint's amplifier; left out, all are on one.

    Attributes:
        is_quiet: Nothing acts: frames, torques and encoders need not come by here.
        is_idle: Nor is anything scheduled: nor need time.
    """

    def __init__(
        self,
        settings: FaultSettings,
        servos: Sequence[Servo],
        transmits: Sequence[Transmit],
        places: Sequence[int] = (),
    ) -> None:
        self.is_quiet = True
        self.is_idle = True
        self._settings = settings
        self._servos = tuple(servos)
        self._transmits = tuple(transmits)
        self._nodes: tuple[AmplifierNode, ...] = ()
        self._deliver: Carry = _nowhere
        random = Random(settings.seed)  # noqa: S311 - to disturb, not to hide
        joints = range(len(servos))
        self._places = tuple(places) or (0,) * len(servos)
        buses = range(max(self._places) + 1)
        self._encoders = [_Encoder(settings, random) for _ in joints]
        self._stages = [_PowerStage(settings) for _ in joints]
        self._deaf = [False] * len(servos)
        self._from_buses = [Line(self._reach_host, random) for _ in buses]
        self._from_amplifiers = [Line(self._enter_bus, random, keeps_id=True) for _ in joints]
        self._to_buses = [Line(self._reach_amplifiers, random) for _ in buses]
        self._from_host = Line(
            lambda bus, frame: self._to_buses[bus].carry(bus, frame, self._period), random
        )
        self._lines = (
            *self._from_buses, *self._from_amplifiers, *self._to_buses, self._from_host
        )  # fmt: skip
        self._active: dict[tuple[FaultTarget, int], _Active] = {}
        self._schedule = sorted(settings.schedule, key=lambda entry: entry.start_s)
        self._is_timed = False
        self._period = 0
        self._start = 0

    def connect(self, nodes: Sequence[AmplifierNode], deliver: Carry) -> None:
        """Join the amplifiers, one per joint in the servos' order.

        Args:
            nodes: The amplifiers themselves.
            deliver: Hands a frame that has come through to those on its bus who hear (`is_deaf`).
        """
        self._nodes = tuple(nodes)
        self._deliver = deliver

    def output(self, joint: int) -> Transmit:
        """Return what the amplifier of a joint (from 0) sends its frames with."""
        transmit, line = self._transmits[joint], self._from_amplifiers[joint]

        def send(frame: bytes) -> None:
            if self.is_quiet:
                transmit(frame)
            else:
                line.carry(joint, frame, self._period)

        return send

    # --- what faults are there ----------------------------------------------------------------

    def start_schedule(self, period: int) -> None:
        """Let the schedule's time begin: the arm was let go in this period."""
        self._is_timed = True
        self._start = period
        self.is_idle = self.is_quiet and not self._schedule
        self._begin_scheduled(period)

    def take(self, order: FaultOrder, period: int) -> None:
        """Begin or end a fault now. An order for a joint that is not there does nothing."""
        target = order.target
        self._period = period
        if not target.has_joints:
            places = [0]
        elif order.joint:
            places = [order.joint - 1] if order.joint <= len(self._servos) else []
        else:
            places = list(range(len(self._servos)))
        for place in places:
            self._set(target, place, order.kind, order.duration_ms)

    def _set(self, target: FaultTarget, place: int, kind: FaultKind, duration: int) -> None:
        key = (target, place)
        self.is_quiet = self.is_idle = False  # until what was kept back is on its way
        is_once = target is FaultTarget.AMPLIFIER and kind is FaultKind.OFF and not duration
        if kind is FaultKind.OK or is_once:
            self._active.pop(key, None)
        else:
            self._active[key] = _Active(kind, self._period, duration)
        self._apply(target, place, kind)
        self._judge()

    def _apply(self, target: FaultTarget, place: int, kind: FaultKind) -> None:
        if target is FaultTarget.ENCODER:
            self._encoders[place].set(kind, self._servos[place])
        elif target is FaultTarget.AMPLIFIER:
            self._stages[place].set(kind)
            self._from_amplifiers[place].set(_ON_LINE.get(kind, FaultKind.OK))
            self._deaf[place] = kind is FaultKind.STUCK
            if kind is FaultKind.OFF:
                self._nodes[place].fail_power_stage()
        elif target is FaultTarget.BUS:
            for line in (*self._to_buses, *self._from_buses):
                line.set(kind)
        else:
            self._from_host.set(kind)

    def _judge(self) -> None:
        self._interrupt()
        self.is_quiet = not self._active
        self.is_idle = self.is_quiet and not (self._is_timed and self._schedule)

    def _interrupt(self) -> None:
        """Tell whom `intermittent` concerns whether this period is one without."""
        settings = self._settings
        for (target, place), fault in self._active.items():
            if fault.kind is not FaultKind.INTERMITTENT:
                continue
            age_ms = self._period - fault.start
            is_off = age_ms % settings.interrupt_every_ms < settings.interrupt_ms
            if target is FaultTarget.ENCODER:
                self._encoders[place].is_interrupted = is_off
            elif target is FaultTarget.AMPLIFIER:
                self._deaf[place] = self._from_amplifiers[place].is_interrupted = is_off
            elif target is FaultTarget.BUS:
                for line in (*self._to_buses, *self._from_buses):
                    line.is_interrupted = is_off
            else:
                self._from_host.is_interrupted = is_off

    # --- time ---------------------------------------------------------------------------------

    def begin_period(self, *, is_lockstep: bool) -> None:
        """Let go what is due. By the clock, a frame is kept one period at least."""
        before = self._period if is_lockstep else self._period - 1
        for line in self._lines:
            line.begin_period(before)

    def end_period(self, period: int) -> None:
        """Take the time: the number of the period that begins now."""
        self._period = period
        for (target, place), fault in list(self._active.items()):
            if fault.end is not None and period >= fault.end:
                self._set(target, place, FaultKind.OK, 0)
            elif (target, fault.kind) == _FAILED and self._servos[place].is_energised:
                self._nodes[place].fail_power_stage()
        self._begin_scheduled(period)
        self._interrupt()

    def _begin_scheduled(self, period: int) -> None:
        while self._schedule and period - self._start >= round(self._schedule[0].start_s * 1e3):
            entry = self._schedule.pop(0)
            self.take(entry.order(), period)

    # --- what goes through here while a fault acts ----------------------------------------------

    def send_from_host(self, frame: bytes, bus: int = 0) -> None:
        """Put a frame of the host on its way to the amplifiers on a bus (from 0)."""
        self._from_host.carry(bus, frame, self._period)

    def is_deaf(self, joint: int) -> bool:
        """Tell whether an amplifier (from 0) hears nothing."""
        return self._deaf[joint]

    def drive(self) -> list[float]:
        """Run one period of every current loop and return the mean torques, in Nm."""
        return [stage.drive(servo) for stage, servo in zip(self._stages, self._servos, strict=True)]

    def distort(self) -> None:
        """Change what the encoders have just read."""
        for encoder, servo in zip(self._encoders, self._servos, strict=True):
            encoder.distort(servo)

    def _enter_bus(self, joint: int, frame: bytes) -> None:
        self._from_buses[self._places[joint]].carry(joint, frame, self._period)

    def _reach_amplifiers(self, bus: int, frame: bytes) -> None:
        self._deliver(bus, frame)

    def _reach_host(self, joint: int, frame: bytes) -> None:
        self._transmits[joint](frame)


def _nowhere(_bus: int, _frame: bytes) -> None:
    """Take frames of a robot whose amplifiers are not there yet."""
