"""Cost of one exchange per bus and family, as a ratio to a bare socket echo of the same frames.

An exchange is what a control cycle of two axes puts on the bus: SYNC or two requests, two answers
received and decoded, two torque commands. The peer is the same for both sides, answers with
prepared frames and knows nothing (`benchmarks.peer`). The echo sends the same frames, ready made,
through the same descriptor and throws the answers away (`benchmarks.echo`); python-can's virtual
bus has no descriptor, its echo is that of the unix bus. Blocks of either alternate.

Total is wall time, the peer's work and the kernel's waking included; CPU is that of the measuring
thread, waiting left out. With the peer on the same processor system calls are cheapest and the
ratio of CPU times hardest; on its own, as in operation, waking across processors is in both. On a
kernel without SocketCAN vcan is measured by `make lab-bench`.
"""

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from functools import partial
from pathlib import Path
from threading import Thread
from time import perf_counter_ns, thread_time_ns

from benchmarks.echo import Echo, LineEcho, Script, SocketEcho
from benchmarks.measure import (
    Target,
    at_most,
    median,
    row,
    times,
    title,
    us,
    without_garbage_collection,
)
from benchmarks.peer import REPLAY, MessageMedium, configuration, serve
from drivers.arm_bus import MARK, RECEIVED, ArmBus
from drivers.axis import AxisStatus
from drivers.bus import Bus, open_bus
from drivers.registry import heartbeat_cycles, make_axes
from hil.config import Config
from hil.realtime import Sleeper, now_ns

FAMILIES = {"cia402": "cia402", "odrive": "odrive", "mit": "damiao", "moteus": "moteus"}
"""Family -> as the table calls it."""
CAN_INTERFACE = "vcan0"
TURNS = 20
EXCHANGES = 250
START_CYCLES = 3000
RETRY_CYCLES = 100
TORQUE_NM = (0.02, -0.01)
TIMEOUT_NS = 1_000_000_000
PERIOD_NS = 1_000_000
BOUND = 2.5
TARGETED = ("unix", "vcan")
TOTAL, CPU = 0, 1
PROCESSORS = os.sched_getaffinity(0)
"""The master keeps to the first, its peer to the same or to the last: the scheduler has no say."""

Samples = list[tuple[float, float]]
"""Of each turn the medians of total and CPU time of an exchange, in us."""


class Master:
    """Two axes of a family on a bus, enabled, their peer replaying."""

    def __init__(self, bus: Bus, config: Config) -> None:
        self.bus = bus
        self.arm = ArmBus(bus, make_axes(config.axes, period_s=config.loop.period_s), now_ns=now_ns)
        beat = heartbeat_cycles(config.axes, period_s=config.loop.period_s)
        self.arm.configure(heartbeat_cycles=beat)
        self._torque = list(TORQUE_NM)
        self._enable()
        self.script = self._note_script()
        self.bus.send(REPLAY)

    def exchange(self) -> None:
        arm = self.arm
        arm.request_feedback()
        if not arm.collect(now_ns() + TIMEOUT_NS):
            raise RuntimeError("feedback is missing")
        arm.send_torques(self._torque)

    def _enable(self) -> None:
        sleeper, next_ns = Sleeper(), now_ns()
        for cycle in range(START_CYCLES):
            self.exchange()
            if cycle % RETRY_CYCLES == 0 and not self.arm.is_enabled:
                for axis in self.arm.axes:
                    if axis.status is AxisStatus.DISABLED:
                        axis.enable()
                    elif axis.status is not AxisStatus.ENABLED:
                        axis.reset_fault()
            if self.arm.is_enabled and cycle > 200:
                return
            next_ns = max(next_ns + PERIOD_NS, now_ns())
            sleeper.until(next_ns)
        notes = [axis.note or axis.status.name for axis in self.arm.axes]
        raise RuntimeError(f"the axes are not enabled: {notes}")

    def _frames_of_exchange(self) -> list[tuple[int, bytes]]:
        log: list[tuple[int, bytes]] = []

        def note(way: int, record: bytes) -> None:
            if way != MARK:
                log.append((way, record))

        self.arm.log_frames(note)
        self.exchange()
        self.arm.log_frames(None)
        return log

    def _note_script(self) -> Script:
        """Take down the frames of an exchange in which nothing else was on the bus."""
        while True:
            frames = self._frames_of_exchange()
            taken = [k for k, (way, _) in enumerate(frames) if way == RECEIVED]
            if len(taken) == len(self.arm.axes) and taken[-1] - taken[0] == len(taken) - 1:
                first, last = frames[: taken[0]], frames[taken[-1] + 1 :]
                if len(first) <= 2 and len(last) <= 2:
                    answers = [frames[k][1] for k in taken]
                    return Script([f for _, f in first], answers, [f for _, f in last])


@contextmanager
def _peer_process(kind: str, name: str, family: str, processor: int) -> Iterator[str]:
    process = subprocess.Popen(
        [sys.executable, "-m", "benchmarks.peer", kind, name, family, str(processor)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        address = process.stdout.readline().strip()
        if not address:
            raise RuntimeError(f"the peer on {kind} did not start")
        yield address
    finally:
        process.stdin.close()
        process.wait(10)
        process.stdout.close()


Pair = tuple[Master, Echo]


@contextmanager
def _pair(kind: str, name: str, family: str, processor: int) -> Iterator[Pair]:
    with ExitStack() as stack:
        address = stack.enter_context(_peer_process(kind, name, family, processor))
        bus = stack.enter_context(open_bus(address))
        master = Master(bus, configuration(family))
        device = address.partition(":")[2]
        is_line = kind == "slcan"
        echo = LineEcho(device, master.script) if is_line else SocketEcho(bus, master.script)
        stack.callback(echo.close)
        yield master, echo


@contextmanager
def _unix(family: str, processor: int) -> Iterator[Pair]:
    with ExitStack() as stack:
        scratch = stack.enter_context(tempfile.TemporaryDirectory(prefix="hil-bench-"))
        yield stack.enter_context(_pair("unix", str(Path(scratch, "bus")), family, processor))


@contextmanager
def _virtual(family: str, processor: int) -> Iterator[Pair]:
    """The peer is a thread: python-can's virtual bus does not leave the process."""
    config = configuration(family)
    with ExitStack() as stack:
        _, echo = stack.enter_context(_unix(family, processor))
        medium = MessageMedium("virtual", f"hil-bench-{family}")
        thread = Thread(target=serve, args=(medium, config))
        thread.start()
        stack.callback(thread.join)
        stack.callback(medium.is_over.set)
        bus = stack.enter_context(open_bus(medium.address))
        yield Master(bus, config), echo


BUSES: dict[str, Callable[[str, int], AbstractContextManager[Pair]]] = {
    "unix": _unix,
    "vcan": partial(_pair, "vcan", CAN_INTERFACE),
    "slcan pty": partial(_pair, "slcan", ""),
    "python-can virtual": _virtual,
}


def run(scale: float) -> list[Target]:
    title("buses", "one exchange of two axes, against an echo of the same frames")
    row("", "ours", "echo", "ratio", "ours CPU", "echo CPU", "ratio CPU")
    turns = max(4, round(TURNS * scale))
    os.sched_setaffinity(0, {min(PROCESSORS)})
    try:
        return _run(turns)
    finally:
        os.sched_setaffinity(0, PROCESSORS)


def _run(turns: int) -> list[Target]:
    targets = []
    for bus, make in BUSES.items():
        if bus == "vcan" and not Path("/sys/class/net", CAN_INTERFACE).exists():
            print(f"  vcan: not measured, no interface {CAN_INTERFACE} here; `make lab-bench` does")
            continue
        for family, name in FAMILIES.items():
            if bus == "slcan pty" and family == "moteus":
                print("  slcan pty, moteus: slcan carries no CAN FD")
                continue
            for place, processor in _places(bus).items():
                with make(family, processor) as (master, echo):
                    ours, bare = _take_turns(master, echo, turns)
                ratios = _print(f"{bus}, {name}, {place}", ours, bare)
                if bus not in TARGETED:
                    continue
                for way, ratio in zip(("total", "CPU"), ratios, strict=False):
                    what = f"{bus}, {name}, {place}: over echo, {way}"
                    targets.append(at_most(what, ratio, BOUND, "x"))
    return targets


def _places(bus: str) -> dict[str, int]:
    """Return where the peer runs: with the master, and on its own processor if there is one."""
    places = {"one CPU": min(PROCESSORS)}
    if bus in TARGETED and len(PROCESSORS) > 1:
        places["two CPUs"] = max(PROCESSORS)
    return places


def _take_turns(master: Master, echo: Echo, turns: int) -> tuple[Samples, Samples]:
    ours: Samples = []
    bare: Samples = []
    with without_garbage_collection():
        for turn in range(turns + 1):
            master.exchange()
            mine = _measure(master.exchange)
            _empty(master.bus)
            with echo.active():
                echo.exchange()
                theirs = _measure(echo.exchange)
            _empty(master.bus)
            if turn:
                ours.append(mine)
                bare.append(theirs)
    if not master.arm.is_enabled:
        notes = [axis.note or axis.status.name for axis in master.arm.axes]
        raise RuntimeError(f"the axes did not stay enabled: {notes}")
    return ours, bare


def _empty(bus: Bus) -> None:
    """Leave nothing behind for the next block."""
    while bus.recv(0.005) is not None:
        pass


def _measure(exchange: Callable[[], None]) -> tuple[float, float]:
    totals, cpus = [], []
    for _ in range(EXCHANGES):
        cpu_ns, wall_ns = thread_time_ns(), perf_counter_ns()
        exchange()
        totals.append((perf_counter_ns() - wall_ns) * 1e-3)
        cpus.append((thread_time_ns() - cpu_ns) * 1e-3)
    return median(totals), median(cpus)


def _print(label: str, ours: Samples, bare: Samples) -> list[float]:
    """Print one line; return the ratios of total and CPU, the latter only if the clock is fine."""
    ratios, cells = [], []
    for way in (TOTAL, CPU):
        mine, theirs = ([pair[way] for pair in side] for side in (ours, bare))
        if min(theirs) == 0.0:  # a kernel that counts CPU time in ticks
            cells += ["-", "-", "-"]
            continue
        ratios.append(median([a / b for a, b in zip(mine, theirs, strict=True)]))
        cells += [us(median(mine)), us(median(theirs)), times(ratios[-1])]
    row(f"  {label}", *cells)
    return ratios
