"""Replays a recording: its frames and commands once more through drivers and controller.

What was received is received again in the same cycle, what came from outside of the bus (commands,
emergency stop, lost processes) is carried out in the same cycle, and every frame that the drivers
send is compared with the recorded one, byte for byte; so is every sample, timing and plant aside.
Nothing else decides what the controller does, so that any difference comes from the program or the
configuration.
"""

import json
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np

from controller.machine import Trigger
from drivers.arm_bus import MARK, RECEIVED, SENT
from drivers.arm_group import configure_arm, make_arm, split_bus
from drivers.bus import Bus
from drivers.errors import DriverError
from hil.config import Config
from hil.control import Control
from hil.errors import HilError
from hil.executor import Executor
from hil.fixed_protobuf import Records
from hil.recording import RecordedEvent, Recording
from hil.sampler import Sampler, Stamps
from hil.telemetry import LoggedFrame, SampleLayout

TIMING: Final = frozenset(
    {"seq", "t_ns", "overruns", "wake_late_ns", "feedback_ns", "law_ns", "sent_ns", "busy_ns"}
)
"""Columns of a sample that say when, not what."""


class ReplayError(HilError):
    """A recording lacks what a replay needs."""


class Difference(NamedTuple):
    """Where a replay first departs from the recording."""

    cycle: int
    what: str
    recorded: str
    replayed: str

    def text(self) -> str:
        """Return it in one line."""
        when = "at start-up" if self.cycle < 0 else f"in cycle {self.cycle}"
        return f"{when}: {self.what}: {self.recorded} against {self.replayed}"


@dataclass(frozen=True, slots=True)
class Replay:
    """Outcome of a replay.

    Attributes:
        cycles: Replayed.
        frames_sent: Recorded as sent, as far as the replay went.
        frames_equal: Of these, sent again byte for byte.
        difference: The first one, in a frame or a sample; None if there is none.
    """

    cycles: int
    frames_sent: int
    frames_equal: int
    difference: Difference | None


class _FramesOverError(Exception):
    """The recording has no more frames: it ends here."""


class _DivergedError(Exception):
    """The replay sends where the recording receives: nothing can be compared any more."""


class _Course:
    """How far a replay has come, on all buses together.

    Attributes:
        until_ns: Recorded instant up to which received frames belong to the present cycle; None
            during start-up, when the time-outs decide.
        clock_ns: Recorded time.
        cycle: The present one.
        sent: Frames sent.
        equal: Of these, as recorded.
        difference: The first one in a frame.
    """

    def __init__(self) -> None:
        self.until_ns: int | None = None
        self.clock_ns = 0
        self.cycle = -1
        self.sent = self.equal = 0
        self.difference: Difference | None = None

    def note(self, what: str, recorded: str, replayed: str) -> None:
        """Keep a difference if it is the first."""
        if self.difference is None:
            self.difference = Difference(self.cycle, what, recorded, replayed)


class _RecordedBus(Bus):
    """A bus on which a recording happens again.

    Args:
        frames: What was logged on this bus, `direction` being `RECEIVED`, `SENT` or `MARK`.
        course: Shared by all buses of the arm.
    """

    carries_fd = True

    def __init__(self, frames: Iterable[LoggedFrame], course: _Course) -> None:
        super().__init__()
        self._frames = iter(frames)
        self._course = course
        self._next = next(self._frames, None)

    def send(self, frame: bytes) -> bool:
        course = self._course
        if course.until_ns is None:
            self._pass_overdue()
        recorded = self._next
        if recorded is None:
            raise _FramesOverError
        if recorded.direction != SENT:
            course.note("a frame sent", "none", frame.hex())
            raise _DivergedError
        self._advance(recorded)
        course.sent += 1
        if recorded.frame == frame:
            course.equal += 1
        else:
            course.note(f"frame {course.sent}", recorded.frame.hex(), frame.hex())
        return True

    def recv(self, timeout_s: float) -> bytes | None:
        course = self._course
        until_ns = course.until_ns
        if until_ns is None:
            until_ns = course.clock_ns + round(timeout_s * 1e9)
        frame = self._next
        if frame is None or frame.direction != RECEIVED or frame.t_ns > until_ns:
            if course.until_ns is None:
                course.clock_ns = until_ns
            return None
        self._advance(frame)
        return frame.frame

    def _pass_overdue(self) -> None:
        """Start-up: pass what a wait took after its time was up, because it woke too late.

        Nobody waited for it, or the wait would have ended with it.
        """
        while self._next is not None and self._next.direction == RECEIVED:
            self._advance(self._next)

    def pass_mark(self) -> None:
        """Be told that the replayed cycle has begun, as the recorded one has."""
        if self._next is not None and self._next.direction == MARK:
            self._advance(self._next)

    def end_cycle(self, next_ns: int) -> None:
        """Note a frame that the recording sent before the next cycle, and the replay did not."""
        recorded = self._next
        if recorded is not None and recorded.direction == SENT and recorded.t_ns < next_ns:
            self._course.note("a frame sent", recorded.frame.hex(), "none")
            raise _DivergedError

    def _advance(self, frame: LoggedFrame) -> None:
        self._course.clock_ns = max(self._course.clock_ns, frame.t_ns)
        self._next = next(self._frames, None)

    def fileno(self) -> int:
        return -1

    def close(self) -> None:
        """Nothing is open."""


class Replayer:
    """Replays one recording.

    Args:
        recording: With frames; a run of the ideal arm (scenario A0) has none.
        config: The configuration of the run; another one shows what it would have changed.

    Raises:
        ReplayError: If the recording has no frames or no samples, or begins in the midst of a run.
    """

    def __init__(self, recording: Recording, config: Config) -> None:
        part = recording.part
        if part is not None and part.number > 1:
            raise ReplayError(
                f"{recording.path} is part {part.number} of a run, and a replay needs its start: "
                f"replay {part.first(recording.path)}, it goes on through the parts that follow"
            )
        if not len(recording.samples) or next(iter(recording.frames()), None) is None:
            raise ReplayError(f"{recording.path} holds no cycles with bus frames to replay")
        _refuse_black_box(recording)
        self._recording = recording
        self._config = config
        self._trajectories = recording.trajectories()
        self._slots: dict[int, memoryview[float]] = {}
        self._course = _Course()
        self._buses = _recorded_buses(recording, len(config.bus.addresses), self._course)
        self._inputs = _inputs_by_cycle(recording.events)
        self._layout = SampleLayout(config.joints, with_truth=False)
        self._replayed: list[bytes] = []

    def run(self) -> Replay:
        """Replay the whole recording, or up to where nothing can be compared any more.

        Raises:
            ReplayError: If a reference that was played is not in the recording.
        """
        try:
            self._start()
            self._run_cycles()
        except DriverError as error:
            self._course.note("start-up", "amplifiers configured", str(error))
        except (_FramesOverError, _DivergedError):
            pass
        course = self._course
        found = [d for d in (course.difference, self._sample_difference()) if d is not None]
        first = min(found, key=lambda difference: difference.cycle, default=None)
        return Replay(len(self._replayed), course.sent, course.equal, first)

    def _start(self) -> None:
        config, course = self._config, self._course
        period_s = config.loop.period_s

        def now_ns() -> int:
            return course.clock_ns

        self._arm = make_arm(self._buses, config.axes, period_s=period_s, now_ns=now_ns)
        infos = configure_arm(self._arm, config.axes, period_s=period_s)
        self._is_lockstep = infos[0].is_lockstep
        self._control = Control(config, self._arm, now_ns=now_ns, events=lambda *_: None)
        self._executor = Executor(self._control, self._slots.__getitem__, lambda *_: None)
        self._sampler = Sampler(self._layout, self._control, self._arm)
        self._arm.log_frames(self._pass_mark)
        self._control.fire(Trigger.BUS_READY)

    def _run_cycles(self) -> None:
        course, columns = self._course, self._recording.samples
        before = -1
        starts_ns = columns["t_ns"].tolist()
        rows = zip(
            columns["cycle"].tolist(),
            starts_ns,
            columns["feedback_ns"].tolist(),
            [*starts_ns[1:], 0],
            strict=True,
        )
        for cycle, start_ns, feedback_ns, next_ns in rows:
            course.cycle = cycle
            course.until_ns = until_ns = start_ns + feedback_ns
            self._take_inputs(cycle, is_after_step=False)
            periods = 1 if self._is_lockstep else cycle - before
            self._executor.begin_cycle(periods)
            self._control.step(until_ns, periods)
            buffer = bytearray(self._layout.size)
            self._sampler.write(buffer, 0, (cycle, start_ns, 0), Stamps())
            self._replayed.append(bytes(buffer))
            self._take_inputs(cycle, is_after_step=True)
            for bus in self._buses:
                bus.end_cycle(next_ns)
            before = cycle

    def _pass_mark(self, direction: int, _frame: bytes) -> None:
        """Frame log of the replayed arm."""
        number, way = split_bus(direction)
        if way == MARK:
            self._buses[number - 1].pass_mark()

    def _take_inputs(self, cycle: int, *, is_after_step: bool) -> None:
        for command in self._inputs.get((cycle, is_after_step), ()):
            if command["verb"] == "trajectory":
                rows = self._trajectories.get(command["crc32"])
                if rows is None:
                    raise ReplayError(
                        f"{self._recording.path} lacks the reference that began in cycle {cycle}"
                    )
                self._slots[command["slot"]] = memoryview(rows).cast("d")
            self._executor.execute(command)

    def _sample_difference(self) -> Difference | None:
        if not self._replayed:
            return None
        replayed = self._layout.decode(self._replayed)
        return first_difference(self._recording.samples[: len(replayed)], replayed)


def _recorded_buses(recording: Recording, count: int, course: _Course) -> list[_RecordedBus]:
    """Return the buses of a recording, each with what was logged on it.

    Frames are read as they are needed: the buses of a cycle are never far apart in the file.
    """
    source = recording.frames(with_marks=True)
    waiting: list[deque[LoggedFrame]] = [deque() for _ in range(count)]

    def of_bus(place: int) -> Iterator[LoggedFrame]:
        mine = waiting[place]
        while True:
            while not mine:
                logged = next(source, None)
                if logged is None:
                    return
                number, way = split_bus(logged.direction)
                if number > count:
                    raise _foreign(recording, number, count)
                waiting[number - 1].append(logged._replace(direction=way))
            yield mine.popleft()

    course.clock_ns = next(recording.frames(with_marks=True)).t_ns
    return [_RecordedBus(of_bus(place), course) for place in range(count)]


def _foreign(recording: Recording, number: int, count: int) -> ReplayError:
    return ReplayError(
        f"{recording.path} has frames of bus {number}, the configuration has {count}; replay it "
        "with its own buses"
    )


def _refuse_black_box(recording: Recording) -> None:
    box = next((event for event in recording.events if event.kind == "black_box"), None)
    if box is not None:
        raise ReplayError(
            f"{recording.path} is a black box that begins in cycle {recording.samples['cycle'][0]}:"
            f" state and references before it are not in it; replay {box.detail['recording']}"
        )


def _inputs_by_cycle(
    events: Sequence[RecordedEvent],
) -> dict[tuple[int, bool], list[Mapping[str, Any]]]:
    inputs: dict[tuple[int, bool], list[Mapping[str, Any]]] = {}
    for event in events:
        if event.kind == "input":
            place = (event.cycle, bool(event.detail["is_after_step"]))
            inputs.setdefault(place, []).append(event.detail["command"])
    return inputs


def first_difference(
    a: Records, b: Records, *, ignored: frozenset[str] = TIMING
) -> Difference | None:
    """Return the first cycle in which two runs' samples differ, and the first field there.

    Args:
        a: One run's samples, called recorded.
        b: The other's, as many.
        ignored: Columns that are not looked at; nor are those that only one of them has.
    """
    first: tuple[int, str] | None = None
    for name in a.dtype.names or ():
        if name in ignored or name not in (b.dtype.names or ()):
            continue
        unequal = (a[name] != b[name]) & ((a[name] == a[name]) | (b[name] == b[name]))  # not NaN
        if unequal.ndim > 1:
            unequal = unequal.any(axis=1)
        rows = np.flatnonzero(unequal)
        if len(rows) and (first is None or rows[0] < first[0]):
            first = int(rows[0]), name
    if first is None:
        return None
    row, name = first
    pair = (json.dumps(columns[name][row].tolist()) for columns in (a, b))
    return Difference(int(a["cycle"][row]), name, *pair)
