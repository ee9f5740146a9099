"""Conformance of one amplifier: the run through the steps.

Only what every family offers is used (`drivers.axis`, `drivers.arm_bus`), so the same steps judge
an emulated node and a real drive. The steps are in `hil.conform_steps`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import Enum

from drivers.axis import AxisStatus
from drivers.errors import DriverError
from hil.conform_bench import Bench, LoggedFrame, NotAskedError, NotOfferedError, StepError

STALL_PERIODS = 5
"""A host that is late by more than this cannot judge a drive."""
REPEATS = 2
"""How often a step is repeated that failed while this host itself stood still."""


class Outcome(Enum):
    """How a step ended."""

    PASS = "pass"  # noqa: S105 - no password
    WARN = "WARN"
    FAIL = "FAIL"
    NOT_ASKED = "not asked"
    NOT_REACHED = "not reached"


@dataclass(slots=True)
class StepResult:
    """One step: how it ended, what was measured, and the frames of it."""

    name: str
    outcome: Outcome
    detail: str
    frames: list[LoggedFrame] = field(default_factory=list)
    dropped: int = 0
    """Frames beyond `FRAMES_KEPT`, not kept."""


@dataclass(frozen=True, slots=True)
class Step:
    """One thing the amplifier has to do."""

    name: str
    run: Callable[[Bench], str]
    """Returns what was measured; raises `StepError`, `NotOfferedError` or `NotAskedError`."""
    begins: AxisStatus | None = None
    """Status to bring the axis to first."""
    is_vital: bool = False
    """Without it nothing of what follows can be asked."""


def run_steps(
    bench: Bench, steps: Sequence[Step], report: Callable[[StepResult], None]
) -> list[StepResult]:
    """Run the steps in order and report each; torque is off at the end, however it comes.

    Args:
        bench: On an open bus, not configured yet.
        steps: As `hil.conform_steps.STEPS`.
        report: Called with every result as it is known.
    """
    results: list[StepResult] = []
    is_over = False
    try:
        for step in steps:
            if is_over:
                result = StepResult(step.name, Outcome.NOT_REACHED, "")
            else:
                result = _run_step(bench, step)
                is_over = step.is_vital and result.outcome is Outcome.FAIL
            results.append(result)
            report(result)
    finally:
        bench.power_down()
    return results


def _run_step(bench: Bench, step: Step) -> StepResult:
    """Run one step, again if it failed while this host stood still for longer than is fair."""
    note, was_set_up = "", bench.info is not None
    for attempt in range(REPEATS + 1):
        bench.begin_step()
        outcome, detail = _attempt(bench, step)
        stalled = bench.stall_s > STALL_PERIODS * bench.timing.period_s
        if outcome is not Outcome.FAIL or not (stalled and was_set_up) or attempt == REPEATS:
            break
        note = f"; repeated, as this host stood still for {1e3 * bench.stall_s:.0f} ms"
    if outcome is Outcome.FAIL and stalled:
        note = f"; this host stood still for {1e3 * bench.stall_s:.0f} ms"
    return StepResult(step.name, outcome, detail + note, bench.frames, bench.dropped)


def _attempt(bench: Bench, step: Step) -> tuple[Outcome, str]:
    try:
        if step.begins is not None:
            bench.come_to_rest()
            bench.bring_to(step.begins)
            bench.rebase()
        return Outcome.PASS, step.run(bench)
    except NotAskedError as error:
        return Outcome.NOT_ASKED, str(error)
    except NotOfferedError as error:
        return Outcome.WARN, str(error)
    except (StepError, DriverError) as error:
        return Outcome.FAIL, str(error)
