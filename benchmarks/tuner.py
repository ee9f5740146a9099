"""`python -m benchmarks.tuner`: the table of `docs/tuner.md`, a quarter of an hour.

The load-memory tuner against the paper's and against the best constant gain: of the gains `GAINS`,
each clipped to the tuner's own peak torque of the same case, for each joint the one with the
smallest error of that joint. The best of a joint is thus chosen knowing the result.
"""

import argparse
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import product
from multiprocessing import get_context
from typing import Any, Final

from hil.compare import (
    DURATION_S,
    PERTURBATIONS,
    REFERENCE,
    SCENARIOS,
    STAT_START_S,
    Case,
    configure,
    select,
)
from hil.config import Config
from hil.errors import HilError
from hil.experiment import Memory, play_in_simulation
from hil.messages import KellyRequest
from hil.metrics import measure

GAINS: Final = (1.5, 2.0, 2.5, 3.0, 3.5, 4.0)
"""Constant gains tried, Nms/rad, up to Kd_max. The error of 1.0 is never the smallest."""
ARMS: Final = ("bench_h kelly_4", "bench_h kelly_2", "pelican_h kelly_4", "pelican_h kelly_2")
HEAD: Final = (
    "changed | rms 1 [counts] | rms 2 [counts] | TV 1 [Nm/s] | TV 2 [Nm/s] | peak [Nm] | Kd"
)


@dataclass(frozen=True, slots=True)
class Run:
    """Figures of one run, one entry per joint; NaN where it tripped."""

    rms_counts: Sequence[float]
    tv_Nm_s: Sequence[float]
    peak_tau_Nm: Sequence[float]


@dataclass(frozen=True, slots=True)
class Group:
    """All runs of one case."""

    scenario: str
    perturbation: str
    ours: Run
    paper: Run
    constant: Sequence[Run]


TRIPPED: Final = Run((float("nan"),) * 2, (float("nan"),) * 2, (float("nan"),) * 2)


def run_group(names: tuple[str, str]) -> Group:
    """Simulate one case with every tuner and gain."""
    scenario, perturbation = names
    run = partial(_run, configure(Case(REFERENCE, scenario, perturbation)), SCENARIOS[scenario][1])
    ours, paper = run({"tuner": "load_memory"}), run({})
    constant = [
        run({"name": "pid", "Kd": (Kd, Kd), "tau_clip_Nm": tuple(ours.peak_tau_Nm)}) for Kd in GAINS
    ]
    return Group(scenario, perturbation, ours, paper, constant)


def _run(config: Config, rate: float, change: Mapping[str, Any]) -> Run:
    law = config.controller.law.model_copy(update=change)
    controller = config.controller.model_copy(update={"law": law})
    memory = Memory(config.joints)
    request = KellyRequest(duration_s=DURATION_S, rate=rate, approach="none")
    try:
        play_in_simulation(config.model_copy(update={"controller": controller}), request, memory)
        metrics = measure(memory.samples(), stat_start_s=STAT_START_S, end_s=DURATION_S)
    except HilError:
        return TRIPPED
    tracking = metrics.true or metrics.measured
    return Run(tracking.rms_counts, metrics.tv_Nm_s, metrics.peak_tau_Nm)


def best(group: Group, joint: int) -> int:
    """Return the place in `GAINS` of the constant gain with the joint's smallest error."""
    errors = [run.rms_counts[joint] for run in group.constant]
    return min(range(len(GAINS)), key=lambda k: errors[k] if errors[k] > 0.0 else float("inf"))


def to_markdown(groups: Sequence[Group]) -> str:
    """Return one table per scenario: ours / paper's / best constant."""
    lines: list[str] = []
    for scenario in dict.fromkeys(group.scenario for group in groups):
        lines += [f"### {scenario}", "", f"| {HEAD} |", "|---" * (HEAD.count("|") + 1) + "|"]
        rows = [group for group in groups if group.scenario == scenario]
        lines += [f"| {group.perturbation} | " + " | ".join(_cells(group)) + " |" for group in rows]
        lines.append("")
    return "\n".join(lines)


def _cells(group: Group) -> Iterator[str]:
    figures: tuple[tuple[Callable[[Run], Sequence[float]], str], ...] = (
        (lambda run: run.rms_counts, "{:.3f}"),
        (lambda run: run.tv_Nm_s, "{:.0f}"),
    )
    places = [best(group, joint) for joint in (0, 1)]
    for (figure, layout), joint in product(figures, (0, 1)):
        ours, paper = figure(group.ours)[joint], figure(group.paper)[joint]
        constant = figure(group.constant[places[joint]])[joint]
        mark = "**" if ours > constant else ""
        yield f"{mark}{layout.format(ours)}{mark} / " + " / ".join(
            layout.format(value) for value in (paper, constant)
        )
    yield ", ".join(f"{peak:.2f}" for peak in group.ours.peak_tau_Nm)
    yield ", ".join(f"{GAINS[place]:g}" for place in places)


def main() -> None:
    """Run all cases and print the tables."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.tuner", description=__doc__)
    parser.add_argument("--scenario", action="append", metavar="NAME")
    parser.add_argument("--perturbation", action="append", metavar="NAME")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    options = parser.parse_args()
    names = product(
        select(options.scenario or ARMS, SCENARIOS, "scenario"),
        select(options.perturbation, PERTURBATIONS, "perturbation"),
    )
    with ProcessPoolExecutor(options.processes, mp_context=get_context("spawn")) as pool:
        print(to_markdown(list(pool.map(run_group, names))))


if __name__ == "__main__":
    main()
