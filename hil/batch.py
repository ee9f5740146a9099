"""Many simulated runs: worker processes, what one run yields, and which program it was."""

import math
import os
import signal
from collections.abc import Callable, Hashable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from hashlib import sha256
from multiprocessing import get_context
from pathlib import Path
from types import TracebackType
from typing import Final, Self, TypeVar

import numpy as np

from hil.config import Config
from hil.errors import HilError
from hil.experiment import Memory, play_trajectory
from hil.fixed_protobuf import Records
from hil.messages import TrajectoryRequest
from hil.metrics import MetricsError, PerJoint, measure
from hil.planner import Refusal
from hil.realtime import die_with_parent
from hil.simulation import SimulationError

_Job = TypeVar("_Job", bound=Hashable)
_Result = TypeVar("_Result")
_ROOMS: Final = ("controller", "drivers", "hil", "sim_backend")

FAILURES: Final = (SimulationError, Refusal, MetricsError)
"""What a run may end with instead of figures: it is a row that says so."""


class BatchError(HilError):
    """A process that carried out a run was killed from outside."""


@dataclass(frozen=True, slots=True)
class Figures:
    """Figures of one run; tuples have one entry per joint. Meanings as in `hil.metrics`.

    Attributes:
        rms_counts: Tracking error of the plant's own position over the statistics window.
        peak_counts: Its largest magnitude there.
        ts20_s: Last time it exceeds 20 mrad.
        rate10_1_s: Decay rate of the manifold variable.
        peak_tau_Nm: Largest torque sent.
        effort_Nm: Root mean square of the torque sent, from power-on to the end of the trajectory.
        tv_Nm_s: Total variation of the torque sent, per second of the statistics window.
        Kd_min: Smallest gain in use.
        Kd_max: Largest gain in use.
    """

    rms_counts: PerJoint
    peak_counts: PerJoint
    ts20_s: PerJoint
    rate10_1_s: PerJoint
    peak_tau_Nm: PerJoint
    effort_Nm: PerJoint
    tv_Nm_s: PerJoint
    Kd_min: PerJoint
    Kd_max: PerJoint


FIGURES: Final = tuple(Figures.__slots__)


def simulate(
    config: Config,
    request: TrajectoryRequest,
    *,
    stat_start_s: float | None = None,
    end_s: float = math.inf,
) -> Figures:
    """Play one trajectory in virtual time, in memory, and take its figures; nothing is stopped.

    Args:
        config: The configuration.
        request: The trajectory.
        stat_start_s: Start of the statistics window; None takes the last 40 % of the run.
        end_s: What follows this time along the trajectory does not count.

    Raises:
        SimulationError: If the arm tripped.
        Refusal: If the trajectory does not fit the arm.
        MetricsError: If it is too short for its statistics.
    """
    memory = Memory(config.joints)
    play_trajectory(config, request, memory)
    return take_figures(memory.samples(), stat_start_s, end_s)


def take_figures(samples: Records, stat_start_s: float | None, end_s: float) -> Figures:
    """Take the figures of a run; see `simulate`."""
    metrics = measure(samples, stat_start_s=stat_start_s, end_s=end_s)
    effort_Nm = np.sqrt(np.mean(samples["tau_sent_Nm"] ** 2, axis=0))
    tracking = metrics.true or metrics.measured
    return Figures(
        rms_counts=tracking.rms_counts,
        peak_counts=tracking.peak_counts,
        ts20_s=tracking.ts20_s,
        rate10_1_s=metrics.rate10_1_s,
        peak_tau_Nm=metrics.peak_tau_Nm,
        effort_Nm=tuple(effort_Nm.tolist()),
        tv_Nm_s=metrics.tv_Nm_s,
        Kd_min=metrics.Kd_min,
        Kd_max=metrics.Kd_max,
    )


def figure_columns(joints: int) -> list[str]:
    """Name a column per figure and joint, as in exported recordings: `rms_1_counts`."""
    return [_column(name, joint) for name in FIGURES for joint in range(1, joints + 1)]


def _column(name: str, joint: int) -> str:
    stem, _, unit = name.partition("_")
    if name in ("Kd_min", "Kd_max"):
        return f"{name}_{joint}"
    if stem == "peak" and unit.startswith("tau"):
        return f"peak_tau_{joint}_Nm"
    return f"{stem}_{joint}_{unit}"


class Workers:
    """Processes that carry out runs, started afresh; a context manager.

    An interruption is left to the parent, and no worker outlives it.
    """

    def __init__(self, processes: int) -> None:
        spawn = get_context("spawn")
        self._pool = ProcessPoolExecutor(processes, spawn, _begin_worker, (os.getpid(),))

    def run(
        self,
        work: Callable[[_Job], _Result],
        jobs: Iterable[_Job],
        on_result: Callable[[_Result], object],
    ) -> dict[_Job, _Result]:
        """Carry out all jobs.

        Args:
            work: A function of a module; it is called in a worker.
            jobs: What it is called with.
            on_result: Called with each result, in the order in which they come.

        Returns:
            Results by job, in the order of the jobs.

        Raises:
            BatchError: If a worker was killed from outside. Results so far have been told.
        """
        futures = {self._pool.submit(work, job): job for job in jobs}
        results: dict[_Job, _Result] = {}
        try:
            for done in as_completed(futures):
                results[futures[done]] = result = done.result()
                on_result(result)
        except BrokenProcessPool as error:
            raise BatchError(
                "a run's process was killed; is there memory for all of them?"
            ) from error
        return {job: results[job] for job in futures.values()}

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Let the runs under way end, and start no more."""
        self._pool.shutdown(wait=True, cancel_futures=True)


def _begin_worker(parent_pid: int) -> None:
    """Leave an interruption to the parent, which ends the pool; go when the parent has gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    die_with_parent(parent_pid)


def fingerprint() -> str:
    """Return a digest of the program's own sources, whose results alone can be gone on with."""
    root = Path(__file__).parents[1]
    digest = sha256()
    for path in sorted(path for room in _ROOMS for path in (root / room).rglob("*.py")):
        digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


def exit_status(failures: Sequence[str]) -> int:
    """Return the exit status: that a run trips is a result, that all of them do is not."""
    return 1 if all(failures) else 0
