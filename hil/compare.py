"""Laws side by side: every law through every scenario under every perturbation.

Each case is a whole simulated run through frames and amplifiers (`hil.simulation`). The constant
gain that is clipped to the self-tuned law's peak torque needs that peak first, so those cases run
in a second round.
"""

import csv
import io
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from itertools import product
from multiprocessing import get_context
from typing import Any, Final

import numpy as np

from hil.config import Config, load_config, merge
from hil.errors import HilError
from hil.experiment import Memory, play_in_simulation
from hil.messages import KellyRequest
from hil.metrics import MetricsError, measure
from hil.planner import Refusal
from hil.simulation import SimulationError
from sim_backend.perturbation import (
    scaled,
    with_backlash,
    with_load_step,
    with_payload,
    with_stribeck,
)
from sim_backend.settings import PlantSettings

Table = Mapping[str, Any]
DURATION_S: Final = 20.0
STAT_START_S: Final = 12.0
START_ERROR_RAD: Final = (0.4, -0.5)
LOAD_STEP_Nm: Final = (0.3, 0.15)
LOAD_STEP_S: Final = 14.0
CLIPPED: Final = "pid Kd=4 clipped"
REFERENCE: Final = "self-tuning pid"


class CompareError(HilError):
    """A comparison was asked for that does not exist."""


LAWS: Final[Mapping[str, Table]] = {
    REFERENCE: {"name": "self_tuning_pid"},
    "load memory": {"name": "self_tuning_pid", "tuner": "load_memory"},
    "self-tuning pd": {"name": "self_tuning_pd"},
    "pid Kd=1": {"name": "pid", "Kd": [1.0, 1.0]},
    "pid Kd=4": {"name": "pid", "Kd": [4.0, 4.0]},
    CLIPPED: {"name": "pid", "Kd": [4.0, 4.0]},
    "pd Kd=4": {"name": "pd", "Kd": [4.0, 4.0]},
    "computed torque": {"name": "computed_torque"},
    "slotine-li": {"name": "slotine_li"},
}
"""Settings of `controller.law` by the name a law has in the tables."""

SCENARIOS: Final[Mapping[str, tuple[str, float]]] = {
    "bench_h kelly_4": ("bench_h", 0.25),
    "bench_h kelly_2": ("bench_h", 0.5),
    "pelican_h kelly_4": ("pelican_h", 0.25),
    "pelican_h kelly_2": ("pelican_h", 0.5),
    "pelican_v kelly_4": ("pelican_v", 0.25),
}
"""Arm preset and rate of the trajectory by name; 20 s, statistics from 12 s."""

Perturbation = Callable[[Config], Table]


def _plant(change: Callable[[PlantSettings], PlantSettings]) -> Perturbation:
    return lambda config: {"plant": change(config.plant).model_dump()}


def _load_step(plant: PlantSettings) -> PlantSettings:
    for joint, torque_Nm in enumerate(LOAD_STEP_Nm, start=1):
        plant = with_load_step(plant, joint, torque_Nm, LOAD_STEP_S)
    return plant


def _encoder(bits: int) -> Perturbation:
    def change(config: Config) -> Table:
        joints = range(1, config.joints + 1)
        return {
            "servos": {str(j): {"encoder_bits": bits} for j in joints},
            "axes": {str(j): {"counts_per_turn": 1 << bits} for j in joints},
        }

    return change


def _delay(config: Config) -> Table:
    joints = range(1, config.joints + 1)
    return {"servos": {str(j): {"command_delay_s": 1e-3} for j in joints}}


PERTURBATIONS: Final[Mapping[str, Perturbation]] = {
    "nominal": lambda _: {},
    "friction x3": _plant(lambda plant: scaled(plant, friction=3.0)),
    "payload +50 %": _plant(lambda plant: with_payload(plant, 0.5)),
    "load step": _plant(_load_step),
    "Stribeck": _plant(lambda plant: with_stribeck(plant, 1.5)),
    "backlash": _plant(lambda plant: with_backlash(plant, 0.002, "link", 0.01)),
    "encoder 10 bit": _encoder(10),
    "encoder 14 bit": _encoder(14),
    "encoder 16 bit": _encoder(16),
    "delay +1 ms": _delay,
}
"""What is changed about the plant or the platform; the controller is not told.

friction x3: viscous and Coulomb. payload: a point mass of half the last link's mass at the tip.
load step: 0.3 and 0.15 Nm from 14 s on. Stribeck: static torque 1.5 times Coulomb, 0.1 rad/s.
backlash: a gap of 2 mrad behind a rotor of 0.01 kg m2, encoder on the link.
"""

QUICK: Final = (
    (REFERENCE, "load memory", "pid Kd=1", "pid Kd=4", CLIPPED, "computed torque", "slotine-li"),
    ("bench_h kelly_4",),
    ("nominal", "friction x3", "load step"),
)
"""Laws, scenarios and perturbations of `--quick`."""


@dataclass(frozen=True, slots=True)
class Case:
    """One run; `tau_clip_Nm` bounds the law's torque where it is clipped."""

    law: str
    scenario: str
    perturbation: str
    tau_clip_Nm: tuple[float, ...] | None = None


@dataclass(frozen=True, slots=True)
class Row:
    """Figures of one run; tuples have one entry per joint, empty if the run `failed`."""

    case: Case
    failed: str = ""
    rms_counts: tuple[float, ...] = ()
    peak_counts: tuple[float, ...] = ()
    ts20_s: tuple[float, ...] = ()
    rate10_1_s: tuple[float, ...] = ()
    peak_tau_Nm: tuple[float, ...] = ()
    effort_Nm: tuple[float, ...] = ()
    tv_Nm_s: tuple[float, ...] = ()
    Kd_min: tuple[float, ...] = ()
    Kd_max: tuple[float, ...] = ()


FIGURES: Final = tuple(name for name in Row.__slots__ if name not in ("case", "failed"))


def select(names: Sequence[str] | None, known: Mapping[str, Any], what: str) -> list[str]:
    """Return the chosen names, all of them if none is chosen.

    Raises:
        CompareError: If one is unknown; the message lists those there are.
    """
    unknown = [name for name in names or () if name not in known]
    if unknown:
        raise CompareError(f"{what} {unknown[0]!r} is not one of: {', '.join(known)}")
    return list(names or known)


def cases(
    laws: Iterable[str], scenarios: Iterable[str], perturbations: Iterable[str]
) -> list[Case]:
    """Return every combination."""
    return [Case(*names) for names in product(laws, scenarios, perturbations)]


def configure(case: Case) -> Config:
    """Return the configuration of a case."""
    preset, _ = SCENARIOS[case.scenario]
    law = dict(LAWS[case.law])
    if case.tau_clip_Nm is not None:
        law["tau_clip_Nm"] = case.tau_clip_Nm
    base = {
        "arm": {"preset": preset},
        "plant": {"q0_rad": START_ERROR_RAD},
        "controller": {"law": law, "limits": {"following_error_rad": [3.0, 3.0]}},
    }
    return load_config(None, merge(base, PERTURBATIONS[case.perturbation](load_config(None, base))))


def run_case(case: Case) -> Row:
    """Simulate one case and take its figures; a run that trips is a row that says so."""
    _, rate = SCENARIOS[case.scenario]
    request = KellyRequest(duration_s=DURATION_S, rate=rate, approach="none")
    config = configure(case)
    memory = Memory(config.joints)
    try:
        play_in_simulation(config, request, memory)
        metrics = measure(memory.samples(), stat_start_s=STAT_START_S, end_s=DURATION_S)
    except (SimulationError, Refusal, MetricsError) as error:
        return Row(case, failed=str(error))
    samples = memory.samples()
    effort = np.sqrt(np.mean(samples["tau_sent_Nm"] ** 2, axis=0))
    tracking = metrics.true or metrics.measured
    return Row(
        case,
        rms_counts=tracking.rms_counts,
        peak_counts=tracking.peak_counts,
        ts20_s=tracking.ts20_s,
        rate10_1_s=metrics.rate10_1_s,
        peak_tau_Nm=metrics.peak_tau_Nm,
        effort_Nm=tuple(effort.tolist()),
        tv_Nm_s=metrics.tv_Nm_s,
        Kd_min=metrics.Kd_min,
        Kd_max=metrics.Kd_max,
    )


def compare(wanted: Sequence[Case], processes: int, on_row: Callable[[], object]) -> list[Row]:
    """Run all cases on several cores and return their rows in the order of the cases.

    Args:
        wanted: Cases; those of the clipped law are completed from the reference law's peak torque,
            which is simulated even where it was not asked for.
        processes: How many run at once.
        on_row: Called after each run.
    """
    clipped = [case for case in wanted if case.law == CLIPPED]
    first = list(
        dict.fromkeys([*(c for c in wanted if c.law != CLIPPED), *map(_unclipped, clipped)])
    )
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        rows = dict(_run_all(pool, first, on_row))
        second = {
            case: replace(case, tau_clip_Nm=rows[_unclipped(case)].peak_tau_Nm or None)
            for case in clipped
        }
        late = dict(_run_all(pool, list(second.values()), on_row))
    return [late[second[case]] if case in second else rows[case] for case in wanted]


def _unclipped(case: Case) -> Case:
    return replace(case, law=REFERENCE)


def _run_all(
    pool: ProcessPoolExecutor, some: Sequence[Case], on_row: Callable[[], object]
) -> Iterator[tuple[Case, Row]]:
    for done in as_completed([pool.submit(run_case, case) for case in some]):
        row = done.result()
        on_row()
        yield row.case, row


# --- output --------------------------------------------------------------------------------------


def to_csv(rows: Sequence[Row]) -> str:
    """Return every figure of every run, one line per run."""
    joints = max((len(row.rms_counts) for row in rows), default=0)
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    names = [f"{_split_unit(name, j)}" for name in FIGURES for j in range(1, joints + 1)]
    writer.writerow(["law", "scenario", "perturbation", "failed", *names])
    for row in rows:
        values = [v for name in FIGURES for v in _padded(getattr(row, name), joints)]
        case = row.case
        writer.writerow([case.law, case.scenario, case.perturbation, row.failed, *values])
    return stream.getvalue()


def _split_unit(name: str, joint: int) -> str:
    """`rms_counts` -> `rms_1_counts`, as in exported recordings; names without unit get it last."""
    stem, _, unit = name.partition("_")
    if name in ("Kd_min", "Kd_max"):
        return f"{name}_{joint}"
    if stem == "peak" and unit.startswith("tau"):
        return f"peak_tau_{joint}_Nm"
    return f"{stem}_{joint}_{unit}"


def _padded(values: tuple[float, ...], joints: int) -> list[float | str]:
    return [*values, *[""] * (joints - len(values))]


COLUMNS: Final = (
    ("rms [counts]", "rms_counts", "{:.2f}"),
    ("peak [counts]", "peak_counts", "{:.2f}"),
    ("settled [s]", "ts20_s", "{:.2f}"),
    ("rate [1/s]", "rate10_1_s", "{:.0f}"),
    ("peak torque [Nm]", "peak_tau_Nm", "{:.2f}"),
    ("effort [Nm rms]", "effort_Nm", "{:.3f}"),
    ("variation [Nm/s]", "tv_Nm_s", "{:.0f}"),
    ("Kd", "", ""),
)


def to_markdown(rows: Sequence[Row]) -> str:
    """Return one table per scenario and perturbation, joint 1 / joint 2."""
    lines: list[str] = []
    groups = dict.fromkeys((row.case.scenario, row.case.perturbation) for row in rows)
    for scenario, perturbation in groups:
        lines += [f"### {scenario}, {perturbation}", ""]
        lines += ["| law | " + " | ".join(title for title, *_ in COLUMNS) + " |"]
        lines += ["|---" * (len(COLUMNS) + 1) + "|"]
        for row in rows:
            if (row.case.scenario, row.case.perturbation) == (scenario, perturbation):
                lines.append(f"| {row.case.law} | " + " | ".join(_cells(row)) + " |")
        lines.append("")
    return "\n".join(lines)


def _cells(row: Row) -> Iterator[str]:
    if row.failed:
        yield f"tripped: {row.failed}"
        yield from [""] * (len(COLUMNS) - 1)
        return
    for _, name, layout in COLUMNS:
        if name:
            yield " / ".join(layout.format(value) for value in getattr(row, name))
        else:
            pairs = zip(row.Kd_min, row.Kd_max, strict=True)
            yield " / ".join(f"{low:.2f}..{high:.2f}" for low, high in pairs)
