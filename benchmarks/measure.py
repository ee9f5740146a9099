"""How the benchmarks measure: alternating blocks, medians and 99th percentiles, targets.

Subject and reference take turns, a block of calls each, so that drift of the machine (frequency,
other load) meets both alike; a ratio is the median over the turns of the ratio within one turn.
"""

import gc
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from time import perf_counter_ns, thread_time_ns

Body = Callable[[], object]
Samples = dict[str, list[float]]
"""Of each body its time per call in us, one figure a turn."""


@dataclass(frozen=True, slots=True)
class Target:
    """One figure that is to stay on the right side of its bound."""

    name: str
    value: float
    bound: float
    is_upper: bool
    unit: str = ""

    @property
    def is_met(self) -> bool:
        return self.value <= self.bound if self.is_upper else self.value >= self.bound

    def text(self) -> str:
        sign = "<=" if self.is_upper else ">="
        verdict = "met" if self.is_met else "MISSED"
        figure = f"{self.value:.3g}{self.unit}"
        return f"{verdict:7} {self.name:52} {figure:>9}   target {sign} {self.bound:g}{self.unit}"


def at_most(name: str, value: float, bound: float, unit: str = "") -> Target:
    return Target(name, value, bound, is_upper=True, unit=unit)


def at_least(name: str, value: float, bound: float, unit: str = "x") -> Target:
    return Target(name, value, bound, is_upper=False, unit=unit)


def percentile(values: Sequence[float], share: float) -> float:
    """Return the smallest value that `share` of all do not exceed."""
    ordered = sorted(values)
    return ordered[max(0, math.ceil(share * len(ordered)) - 1)]


def median(values: Sequence[float]) -> float:
    return percentile(values, 0.5)


def ratio(samples: Samples, reference: str, subject: str) -> float:
    """Return how many times dearer the reference is than the subject, turn by turn."""
    pairs = zip(samples[reference], samples[subject], strict=True)
    return median([dear / cheap for dear, cheap in pairs])


@contextmanager
def without_garbage_collection() -> Iterator[None]:
    """Measure as the loop runs: what exists is frozen, the collector is off."""
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
        gc.unfreeze()


def alternate(bodies: Mapping[str, Body], *, turns: int, calls: int) -> Samples:
    """Run each body `calls` times, in turns; the first turn warms up and is not counted.

    Time is the thread's CPU time: these bodies wait for nothing, and what other processes do on
    the same core is not theirs.
    """
    samples: Samples = {name: [] for name in bodies}
    repeat = range(calls)
    with without_garbage_collection():
        for turn in range(turns + 1):
            for name, body in bodies.items():
                start_ns = thread_time_ns()
                for _ in repeat:
                    body()
                if turn:
                    samples[name].append((thread_time_ns() - start_ns) * 1e-3 / calls)
    return samples


def alternate_calls(bodies: Mapping[str, Body], *, turns: int, calls: int) -> Samples:
    """As `alternate`, but every single call is timed, for percentiles over calls (wall time)."""
    samples: Samples = {name: [] for name in bodies}
    with without_garbage_collection():
        for turn in range(turns + 1):
            for name, body in bodies.items():
                times = samples[name] if turn else []
                for _ in range(calls):
                    start_ns = perf_counter_ns()
                    body()
                    times.append((perf_counter_ns() - start_ns) * 1e-3)
    return samples


def title(name: str, text: str) -> None:
    print(f"\n== {name}: {text}")


def row(label: str, *cells: str) -> None:
    print(f"  {label:46}" + "".join(f"{cell:>13}" for cell in cells), flush=True)


def us(value: float) -> str:
    return f"{value:.2f} us" if value < 100.0 else f"{value:.1f} us"


def times(value: float) -> str:
    return f"{value:.2f}x" if value < 100.0 else f"{value:.0f}x"
