"""Laws side by side: every law through every scenario under every perturbation.

Each case is a whole simulated run through frames and amplifiers (`hil.simulation`). The constant
gain that is clipped to the self-tuned law's peak torque needs that peak first, so those cases run
in a second round.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from time import process_time
from types import MappingProxyType
from typing import Any, Final

from hil.batch import FAILURES, FIGURES, BatchError, Workers, simulate
from hil.config import Config, load_config, merge
from hil.errors import HilError
from hil.messages import KellyRequest
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
    REFERENCE: {"law": {"name": "self_tuning_pid"}},
    "load memory": {"law": {"name": "self_tuning_pid", "tuner": "load_memory"}},
    "self-tuning pd": {"law": {"name": "self_tuning_pd"}},
    "pid Kd=1": {"law": {"name": "pid", "Kd": [1.0, 1.0]}},
    "pid Kd=4": {"law": {"name": "pid", "Kd": [4.0, 4.0]}},
    CLIPPED: {"law": {"name": "pid", "Kd": [4.0, 4.0]}},
    "pd Kd=4": {"law": {"name": "pd", "Kd": [4.0, 4.0]}},
    "computed torque": {"law": {"name": "computed_torque"}},
    "slotine-li": {"law": {"name": "slotine_li"}},
}
"""Settings of `controller` by the name a law has in the tables."""

VARIANTS: Final[Mapping[str, Table]] = {
    "manifold sine": {"law": {"manifold": "sine"}},
    "manifold saturation": {"law": {"manifold": "saturation"}},
    "membership gaussian_normalised": {"law": {"membership": "gaussian_normalised"}},
    "membership gaussian_clipped": {"law": {"membership": "gaussian_clipped"}},
    "membership triangular": {"law": {"membership": "triangular"}},
    "adaptation off": {"law": {"adaptation": "off"}},
    "adaptation absolute": {"law": {"adaptation": "absolute"}},
    "adaptation true_sign": {"law": {"adaptation": "true_sign"}},
    "velocity levant": {"velocity": {"estimator": "levant"}},
}
"""What else can be chosen about the reference law, one thing each, by its name in the settings."""

ALL_LAWS: Final[Mapping[str, Table]] = {**LAWS, **VARIANTS}
"""Everything that can be put side by side."""

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


def full() -> list["Case"]:
    """Return the cases of the whole table: every law everywhere, every variant nominally."""
    return cases(LAWS, SCENARIOS, PERTURBATIONS) + cases(VARIANTS, SCENARIOS, ["nominal"])


@dataclass(frozen=True, slots=True)
class Case:
    """One run; `tau_clip_Nm` bounds the law's torque where it is clipped."""

    law: str
    scenario: str
    perturbation: str
    tau_clip_Nm: tuple[float, ...] | None = None


@dataclass(frozen=True, slots=True)
class Row:
    """Figures of one run; tuples have one entry per joint, empty if the run `failed`.

    `cpu_s` is the processor time that the run took, the only one that differs from run to run.
    """

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
    cpu_s: float = field(default=0.0, compare=False)


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
    controller = merge(ALL_LAWS[case.law], {"limits": {"following_error_rad": [3.0, 3.0]}})
    if case.tau_clip_Nm is not None:
        controller = merge(controller, {"law": {"tau_clip_Nm": case.tau_clip_Nm}})
    base = {
        "arm": {"preset": preset},
        "plant": {"q0_rad": START_ERROR_RAD},
        "controller": controller,
    }
    return load_config(None, merge(base, PERTURBATIONS[case.perturbation](load_config(None, base))))


def run_case(case: Case) -> Row:
    """Simulate one case and take its figures; a run that trips is a row that says so."""
    began_s = process_time()
    _, rate = SCENARIOS[case.scenario]
    request = KellyRequest(duration_s=DURATION_S, rate=rate, approach="none")
    try:
        figures = simulate(configure(case), request, stat_start_s=STAT_START_S, end_s=DURATION_S)
    except FAILURES as error:
        return Row(case, failed=str(error), cpu_s=process_time() - began_s)
    values = {name: getattr(figures, name) for name in FIGURES}
    return Row(case, **values, cpu_s=process_time() - began_s)


def compare(
    wanted: Sequence[Case],
    processes: int,
    on_row: Callable[[Row], object],
    known: Mapping[Case, Row] = MappingProxyType({}),
) -> list[Row]:
    """Run all cases on several cores and return their rows in the order of the cases.

    Args:
        wanted: Cases; those of the clipped law are completed from the reference law's peak torque,
            which is simulated even where it was not asked for.
        processes: How many run at once.
        on_row: Called with the row of each run, as it ends.
        known: Rows of cases that need not be run again.

    Raises:
        CompareError: If a process was killed from outside.
    """
    clipped = [case for case in wanted if case.law == CLIPPED]
    first = list(
        dict.fromkeys([*(c for c in wanted if c.law != CLIPPED), *map(_unclipped, clipped)])
    )
    try:
        with Workers(processes) as workers:
            rows = _run_all(workers, first, on_row, known)
            second = {
                case: replace(case, tau_clip_Nm=rows[_unclipped(case)].peak_tau_Nm or None)
                for case in clipped
            }
            late = _run_all(workers, list(second.values()), on_row, known)
    except BatchError as error:
        raise CompareError(str(error)) from error
    return [late[second[case]] if case in second else rows[case] for case in wanted]


def _unclipped(case: Case) -> Case:
    return replace(case, law=REFERENCE)


def _run_all(
    workers: Workers,
    some: Sequence[Case],
    on_row: Callable[[Row], object],
    known: Mapping[Case, Row],
) -> dict[Case, Row]:
    rows = {case: known[case] for case in some if case in known}
    return rows | workers.run(run_case, [case for case in some if case not in known], on_row)
