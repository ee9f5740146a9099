"""How the loop keeps its period: histograms of every cycle's stamps, and deadline misses by cause.

A cycle misses its deadline if feedback is not complete in time, if its torques leave after the end
of its period, or if periods before it were skipped. Every such cycle has one cause, the first that
applies of `Cause`. The loop counts them as they happen; `misses_of` finds the same in a recording.
"""

from collections.abc import Mapping
from enum import IntEnum
from typing import Any, Final

import numpy as np

from hil.fixed_protobuf import Records
from hil.histogram import QUANTILE_NAMES, QUANTILES, WORDS, Histogram
from hil.sampler import Stamps

TIMES: Final = {
    "wake_late": "wake-up after the scheduled start",
    "feedback": "feedback complete after the scheduled start",
    "law": "law and limits done after the scheduled start",
    "sent": "commands sent after the scheduled start",
    "busy": "busy time",
}
"""What is measured of every cycle, and how it is called; `_ns` after it names the stamp."""


class Cause(IntEnum):
    """Why a cycle missed its deadline; the first that applies counts."""

    LATE_WAKE_UP = 0
    """It began with periods skipped after a cycle that ended in time, or with more than half of the
    time for feedback gone: the host was late, or the loop's own work between two cycles."""
    LATE_FEEDBACK = 1
    """It began in time, and feedback was not complete at its deadline."""
    LONG_LAW = 2
    """Law and limits took longer than a period has left after the deadline of feedback."""
    LATE_COMMANDS = 3
    """Everything was in time until the commands had to be sent: the bus took them late."""


CAUSE_TEXTS: Final = {
    Cause.LATE_WAKE_UP: "late wake-up",
    Cause.LATE_FEEDBACK: "late feedback",
    Cause.LONG_LAW: "long law",
    Cause.LATE_COMMANDS: "late commands",
}
_CYCLES, _SKIPPED, _CAUSES = 0, 1, 2
_COUNTERS: Final = _CAUSES + len(Cause)
TIMING_BYTES: Final = 8 * (_COUNTERS + len(TIMES) * WORDS)
"""Memory that the timing of one loop needs."""


class Timing:
    """Histograms and counters of one loop, on memory that is zero before the first cycle.

    Args:
        memory: `TIMING_BYTES` of it; the loop writes, others read.
        period_s: Length of a cycle.
        timeout_s: Deadline of feedback after a cycle's start.
    """

    __slots__ = (
        "_counters", "_half_ns", "_is_overdue", "_law_ns", "_period_ns", "_words", "histograms",
    )  # fmt: skip

    def __init__(self, memory: memoryview, *, period_s: float, timeout_s: float) -> None:
        self._counters = memory[: 8 * _COUNTERS].cast("Q")
        start = 8 * _COUNTERS
        self.histograms: dict[str, Histogram] = {}
        for name in TIMES:
            self.histograms[name] = Histogram(memory[start : start + 8 * WORDS])
            start += 8 * WORDS
        self._words = memory[8 * _COUNTERS :].cast("Q")
        self._period_ns, self._half_ns, self._law_ns = _limits_ns(period_s, timeout_s)
        self._is_overdue = False

    def note(self, stamps: Stamps, *, is_fresh: bool, skipped: int) -> None:
        """Count one cycle.

        Args:
            stamps: Its instants.
            is_fresh: All feedback was there in time.
            skipped: Periods left out just before it.
        """
        Histogram.add_each(self._words, stamps)
        counters = self._counters
        counters[_CYCLES] += 1
        is_overdue = stamps.sent_ns > self._period_ns
        was_overdue, self._is_overdue = self._is_overdue, is_overdue
        if skipped:
            counters[_SKIPPED] += skipped
            if not was_overdue:
                counters[_CAUSES + Cause.LATE_WAKE_UP] += 1
                return
        if is_overdue or not is_fresh:
            counters[_CAUSES + self._cause(stamps, is_fresh)] += 1

    def _cause(self, stamps: Stamps, is_fresh: bool) -> Cause:
        if stamps.wake_late_ns > self._half_ns:
            return Cause.LATE_WAKE_UP
        if not is_fresh:
            return Cause.LATE_FEEDBACK
        is_long = stamps.law_ns - stamps.feedback_ns > self._law_ns
        return Cause.LONG_LAW if is_long else Cause.LATE_COMMANDS

    def misses(self) -> dict[str, int]:
        """Return the cycles that missed their deadline, by cause, and the periods skipped."""
        counters = self._counters
        found = {cause.name.lower(): counters[_CAUSES + cause] for cause in Cause}
        return {**found, "skipped_periods": counters[_SKIPPED]}

    def summary(self) -> dict[str, Any]:
        """Return what the status tells: cycles, quantiles of every time in us, misses by cause."""
        spreads = {name: histogram.summary_us() for name, histogram in self.histograms.items()}
        return {"cycles": self._counters[_CYCLES], "us": spreads, "misses": self.misses()}


def _limits_ns(period_s: float, timeout_s: float) -> tuple[int, int, int]:
    """Return the period, half of the time for feedback, and what the law has left."""
    period_ns, timeout_ns = round(period_s * 1e9), round(timeout_s * 1e9)
    return period_ns, timeout_ns // 2, period_ns - timeout_ns


def misses_of(samples: Records, *, period_s: float, timeout_s: float) -> dict[str, int]:
    """Return what `Timing.misses` counts over the cycles of a recording; the first one skips none.

    Args:
        samples: At least one, in order.
        period_s: Length of a cycle.
        timeout_s: Deadline of feedback after a cycle's start.
    """
    period_ns, half_ns, law_limit_ns = _limits_ns(period_s, timeout_s)
    late_ns, feedback_ns = samples["wake_late_ns"], samples["feedback_ns"]
    is_fresh = samples["feedback_age_cycles"] == 0
    is_overdue = samples["sent_ns"] > period_ns
    skipped = np.diff(samples["overruns"].astype(np.int64), prepend=samples["overruns"][0])
    was_overdue = np.concatenate(([False], is_overdue[:-1]))
    is_missed = ~is_fresh | is_overdue
    is_cut = (skipped > 0) & ~was_overdue
    is_late = is_cut | (is_missed & (late_ns > half_ns))
    is_silent = is_missed & ~is_late & ~is_fresh
    rest = is_missed & ~is_late & ~is_silent
    is_long = rest & (samples["law_ns"] - feedback_ns > law_limit_ns)
    kinds = (is_late, is_silent, is_long, rest & ~is_long)
    found = {cause.name.lower(): int(kind.sum()) for cause, kind in zip(Cause, kinds, strict=True)}
    return {**found, "skipped_periods": int(skipped.sum())}


def spreads_us(samples: Records) -> dict[str, tuple[float, ...]]:
    """Return p50, p99, p99.9 and the maximum of every time of a recording, in microseconds."""
    shares = (*QUANTILES, 1.0)
    return {name: tuple(np.quantile(samples[f"{name}_ns"], shares) / 1e3) for name in TIMES}


def timing_lines(summary: Mapping[str, Any]) -> list[str]:
    """Return the timing part of a status as lines for people."""
    lines = [f"{'[us]':44}" + "".join(f"{name:>9}" for name in QUANTILE_NAMES)]
    for name, title in TIMES.items():
        values = summary.get("us", {}).get(name, {})
        if values:
            shown = "".join(f"{values[quantile]:9.1f}" for quantile in QUANTILE_NAMES)
            lines.append(f"{title:44}{shown}")
    return [*lines, f"deadline misses (cycles): {missed_text(summary.get('misses', {}))}"]


def missed_text(misses: Mapping[str, int]) -> str:
    """Return deadline misses by cause as one line."""
    parts = [
        f"{misses[cause.name.lower()]} {text}"
        for cause, text in CAUSE_TEXTS.items()
        if misses.get(cause.name.lower())
    ]
    if misses.get("skipped_periods"):
        parts.append(f"{misses['skipped_periods']} periods skipped")
    return ", ".join(parts) or "none"
