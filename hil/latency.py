"""How late this host wakes a thread that sleeps as the control loop does, beside `cyclictest`.

Both are measured in turns at the same priority, interval and core, so that what else happens on the
host meets both alike. The verdicts are those of two published sources, which `VERDICT_SOURCES`
names; they judge the host alone, not the work that a cycle has to do.
"""

import gc
import os
import platform
import shutil
import subprocess
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from hil.config import LoopSettings
from hil.errors import HilError
from hil.histogram import LARGEST_NS, Histogram
from hil.realtime import Granted, Sleeper, make_realtime, now_ns
from hil.stress import loaded

OURS, THEIRS = "hil", "cyclictest"
_HISTOGRAM_US: Final = 50_000
_SETTLE_CYCLES: Final = 50
_FACTS: Final = {"p50": 0.5, "p99": 0.99, "p99.9": 0.999}
VERDICT_SOURCES: Final = {
    "LinuxCNC": "LinuxCNC documentation, chapter Latency Test (docs/src/install/latency-test.adoc)",
    "FCI": "Franka documentation, Minimum system and network requirements, and libfranka"
    " examples/communication_test.cpp",
}
_CNC_STEPS_US: Final = (
    (20.0, "pass", "very nice results with software stepping (limit: about 15-20 us)"),
    (50.0, "pass", "good results, a lower maximum step rate (30-50 us)"),
    (100.0, "warn", "above the 50 us of good software stepping, below the 100 us that rule it out"),
    (1000.0, "warn", "no candidate for software stepping (100 us or more), usable otherwise"),
    (float("inf"), "fail", "no candidate for LinuxCNC at all (more than 1 ms)"),
)
_FCI_LIMIT_S: Final = 1e-3
_FCI_IN_A_ROW: Final = 20
_FCI_RATES: Final = ((0.95, "pass"), (0.90, "warn"), (0.0, "fail"))


class LatencyError(HilError):
    """The host could not be measured as asked."""


@dataclass(slots=True)
class Wakeups:
    """Wake-ups of one thread.

    Attributes:
        lateness: After the instants they were due at; of cyclictest in whole microseconds.
        jitter_ns: The largest deviation of an interval between two wake-ups from the period; of
            cyclictest, which does not tell it, the latest wake-up.
        over_limit: Wake-ups a millisecond late or more.
        in_a_row: The most of them in a row; None of cyclictest, which does not tell.
    """

    lateness: Histogram = field(default_factory=Histogram)
    jitter_ns: int = 0
    over_limit: int = 0
    in_a_row: int | None = 0

    @property
    def cycles(self) -> int:
        """Number of wake-ups."""
        return int(self.lateness.counts().sum())

    def add(self, other: "Wakeups") -> None:
        """Count another turn's wake-ups as well."""
        self.lateness.merge(other.lateness)
        self.jitter_ns = max(self.jitter_ns, other.jitter_ns)
        self.over_limit += other.over_limit
        rows = (self.in_a_row, other.in_a_row)
        self.in_a_row = None if None in rows else max(row for row in rows if row is not None)


@dataclass(frozen=True, slots=True)
class Verdict:
    """What a published threshold says about the host."""

    source: str
    level: str
    text: str


@dataclass(frozen=True, slots=True)
class Latency:
    """One measurement.

    Attributes:
        host: Kernel, machine, cores, virtualisation.
        granted: What the system granted our thread.
        load: Kinds of load.
        turns: Of each side in order; ours and, if it is installed, cyclictest's.
    """

    host: dict[str, str]
    granted: Granted
    load: tuple[str, ...]
    turns: dict[str, list[Wakeups]]

    def total(self, side: str) -> Wakeups:
        """Return all turns of one side together; none of them in a row across turns."""
        total = Wakeups(in_a_row=None if side == THEIRS else 0)
        for turn in self.turns[side]:
            total.add(turn)
        return total

    def ratios(self) -> dict[str, float]:
        """Return our p50, p99 and p99.9 over cyclictest's; empty without cyclictest."""
        if not self.turns.get(THEIRS):
            return {}
        return _ratios(self.total(OURS), self.total(THEIRS))

    def turn_ratios(self) -> list[dict[str, float]]:
        """Return the ratios of every pair of turns."""
        pairs = zip(self.turns[OURS], self.turns.get(THEIRS, []), strict=False)
        return [_ratios(ours, theirs) for ours, theirs in pairs]

    def verdicts(self) -> list[Verdict]:
        """Judge our own wake-ups by the published thresholds."""
        total = self.total(OURS)
        return [judge_linuxcnc(total), judge_fci(total)]

    def as_json(self) -> dict[str, Any]:
        """Return everything as what JSON can hold."""
        sides = {
            side: {
                "cycles": self.total(side).cycles,
                "us": self.total(side).lateness.summary_us(),
                "turns_us": [turn.lateness.summary_us() for turn in turns],
            }
            for side, turns in self.turns.items()
        }
        return {
            "host": self.host,
            "scheduler": self.granted.scheduler,
            "missing": list(self.granted.missing),
            "load": list(self.load),
            "lateness": sides,
            "jitter_max_us": round(self.total(OURS).jitter_ns / 1e3, 1),
            "ratios": self.ratios(),
            "turn_ratios": self.turn_ratios(),
            "verdicts": [
                {"source": v.source, "level": v.level, "text": v.text} for v in self.verdicts()
            ],
        }


def _ratios(ours: Wakeups, theirs: Wakeups) -> dict[str, float]:
    shares = list(_FACTS.values())
    pairs = zip(
        ours.lateness.quantiles_ns(shares), theirs.lateness.quantiles_ns(shares), strict=True
    )
    return {name: round(a / max(b, 1), 3) for name, (a, b) in zip(_FACTS, pairs, strict=True)}


def judge_linuxcnc(wakeups: Wakeups) -> Verdict:
    """Judge the largest jitter by LinuxCNC's steps for its latency test."""
    jitter_us = wakeups.jitter_ns / 1e3
    level, text = next((lv, tx) for limit, lv, tx in _CNC_STEPS_US if jitter_us <= limit)
    return Verdict("LinuxCNC", level, f"max jitter {jitter_us:.1f} us: {text}")


def judge_fci(wakeups: Wakeups) -> Verdict:
    """Judge the share of wake-ups in time by what the Franka Control Interface asks for.

    A command that misses its millisecond is dropped; more than 20 in a row stop the robot; the
    communication test calls a success rate below 0.95 many losses and below 0.90 not sufficient.
    Waking up in time is necessary for that and not sufficient: the law and the network come on top.
    """
    cycles, in_a_row = wakeups.cycles, wakeups.in_a_row or 0
    rate = 1.0 - wakeups.over_limit / max(cycles, 1)
    level = next(level for limit, level in _FCI_RATES if rate >= limit)
    if in_a_row > _FCI_IN_A_ROW:
        level = "fail"
    text = (
        f"{wakeups.over_limit} of {cycles} wake-ups 1 ms late or more, {in_a_row} in a row at most:"
        f" success rate {rate:.4f} (limits 0.95 and 0.90; 20 in a row), before law and network"
    )
    return Verdict("FCI", level, text)


def measure_wakeups(period_s: float, seconds: float) -> Wakeups:
    """Sleep from deadline to deadline as the loop does, in the calling thread.

    Args:
        period_s: Between deadlines.
        seconds: How long; a few cycles before are not counted.
    """
    wakeups, period_ns = Wakeups(), round(period_s * 1e9)
    sleep_until, add = Sleeper().until, wakeups.lateness.add
    limit_ns, row, jitter_ns = round(_FCI_LIMIT_S * 1e9), 0, 0
    cycles = max(1, round(seconds / period_s))
    due_ns = now_ns() + period_ns
    woke_before_ns = 0
    for cycle in range(-_SETTLE_CYCLES, cycles):
        sleep_until(due_ns)
        woke_ns = now_ns()
        late_ns = woke_ns - due_ns
        if cycle >= 0:
            add(late_ns)
            jitter_ns = max(jitter_ns, abs(woke_ns - woke_before_ns - period_ns))
            if late_ns >= limit_ns:
                lost = late_ns // limit_ns
                row += lost
                wakeups.over_limit += 1
                wakeups.in_a_row = max(wakeups.in_a_row or 0, row)
            else:
                row = 0
        woke_before_ns = woke_ns
        due_ns += period_ns * (1 + max(0, now_ns() - due_ns) // period_ns)
    wakeups.jitter_ns = jitter_ns
    return wakeups


@contextmanager
def as_the_loop(settings: LoopSettings) -> Iterator[Granted]:
    """Give the calling thread the loop's scheduler and core, and take them away again."""
    policy, parameter = os.sched_getscheduler(0), os.sched_getparam(0)
    cores = os.sched_getaffinity(0)
    gc.disable()
    try:
        yield make_realtime(settings)
    finally:
        os.sched_setscheduler(0, policy, parameter)
        os.sched_setaffinity(0, cores)
        gc.enable()


def cyclictest_command(settings: LoopSettings, seconds: float) -> list[str] | None:
    """Return the command that measures the same with cyclictest; None if it is not installed."""
    program = shutil.which("cyclictest", path=f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin")
    if program is None:
        return None
    interval_us = round(settings.period_s * 1e6)
    cycles = max(1, round(seconds / settings.period_s))
    command = [program, "-m", "-q", "-t", "1", "-i", str(interval_us), "-l", str(cycles)]
    command += ["-h", str(_HISTOGRAM_US)]
    if settings.realtime != "off":
        command += ["-p", str(settings.priority)]
    if settings.cpu is not None:
        command += ["-a", str(settings.cpu)]
    return command


def parse_cyclictest(text: str) -> Wakeups:
    """Read the histogram that `cyclictest -h` prints.

    Raises:
        LatencyError: If there is none in it.
    """
    wakeups = Wakeups(in_a_row=None)
    counts = wakeups.lateness
    for line in text.splitlines():
        words = line.split()
        if len(words) == 2 and words[0].isdigit() and words[1].isdigit():
            late_us, count = int(words[0]), int(words[1])
            if count:
                counts.add(late_us * 1000, count)
            wakeups.over_limit += count if late_us >= _FCI_LIMIT_S * 1e6 else 0
        elif line.startswith("# Max Latencies:"):
            wakeups.jitter_ns = min(int(words[3]) * 1000, LARGEST_NS)
        elif line.startswith("# Histogram Overflows:"):
            if int(words[3]):
                counts.add((_HISTOGRAM_US + 1) * 1000, int(words[3]))
            wakeups.over_limit += int(words[3])
    if not wakeups.cycles:
        raise LatencyError(f"cyclictest printed no histogram: {text.strip()[:200] or 'nothing'}")
    return wakeups


def _run_cyclictest(command: Sequence[str], seconds: float) -> Wakeups:
    done = subprocess.run(  # noqa: S603 - found in PATH by its name
        command, capture_output=True, text=True, check=False, timeout=3 * seconds + 30
    )
    if done.returncode:
        reason = (done.stderr.strip() or done.stdout.strip() or "no reason given").splitlines()[0]
        raise LatencyError(f"cyclictest ended with status {done.returncode}: {reason}")
    return parse_cyclictest(done.stdout)


def describe_host() -> dict[str, str]:
    """Return kernel, processor, number of cores and kind of virtualisation."""
    model = virtual = ""
    for line in Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines():
        name, _, value = line.partition(":")
        if name.strip() == "model name" and not model:
            model = value.strip()
        elif name.strip() == "flags" and " hypervisor" in value:
            virtual = "virtual machine"
    return {
        "kernel": f"{platform.release()} {platform.version()}",
        "machine": f"{platform.machine()} {model}".strip(),
        "cores": str(os.cpu_count()),
        "kind": virtual or "no hypervisor reported",
    }


def measure(
    settings: LoopSettings,
    *,
    seconds: float = 60.0,
    rounds: int = 5,
    load: Sequence[str] = (),
    progress: Callable[[int, str], None] | None = None,
) -> Latency:
    """Measure our wake-ups and cyclictest's in turns, ours first in every other round.

    Args:
        settings: Period, priority, core, and whether real time is required.
        seconds: In total.
        rounds: Pairs of turns.
        load: Kinds of `hil.stress.KINDS`, made all the while.
        progress: Told the round, from 0, and whose turn begins.

    Raises:
        RealtimeError: If real time is required and not granted.
        LatencyError: If cyclictest is there and fails.
    """
    with as_the_loop(settings) as granted:
        pass  # refused before anything is loaded
    has_theirs = cyclictest_command(settings, 1.0) is not None
    sides = (OURS, THEIRS) if has_theirs else (OURS,)
    turn_s = seconds / (rounds * len(sides))
    turns: dict[str, list[Wakeups]] = {side: [] for side in sides}
    with loaded(load):
        for number in range(rounds):
            for side in sides if number % 2 == 0 else reversed(sides):
                if progress is not None:
                    progress(number, side)
                turns[side].append(_take_turn(side, settings, turn_s))
    return Latency(describe_host(), granted, tuple(load), turns)


def _take_turn(side: str, settings: LoopSettings, seconds: float) -> Wakeups:
    command = cyclictest_command(settings, seconds)
    if side == THEIRS and command is not None:
        return _run_cyclictest(command, seconds)
    with as_the_loop(settings):
        return measure_wakeups(settings.period_s, seconds)
