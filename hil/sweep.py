"""A grid of settings: every combination as one simulated run, in the grid's order.

The first setting varies slowest. A run is known by what decides its outcome: the program's
sources, the whole configuration and the trajectory. A sweep that was interrupted, or a grid that
has grown, runs only what its output does not hold yet.
"""

import json
import math
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from hashlib import sha256
from itertools import product
from pathlib import Path
from typing import Any, Final

from hil.batch import FAILURES, Figures, Workers, fingerprint, simulate
from hil.config import ConfigError, config_from_json, load_config, merge
from hil.errors import HilError
from hil.experiment import scenario_request, scenario_settings
from hil.messages import TrajectoryRequest, parse_trajectory
from hil.scenarios import find_scenario

DEFAULT_SCENARIO: Final = "A"
SCENARIO, TRAJECTORY = "scenario", "trajectory"
"""Keys of a grid that are not settings: a reference scenario's name, a trajectory's file."""
RUNS_MAX: Final = 1_000_000


class SweepError(HilError):
    """A sweep was asked for that cannot be run. Nothing has been simulated."""


@dataclass(frozen=True, slots=True)
class Axis:
    """One setting and the values it takes."""

    key: str
    values: tuple[Any, ...]


@dataclass(frozen=True, slots=True)
class Base:
    """What all runs of a sweep share.

    Attributes:
        config: TOML file; None for presets alone.
        scenario: Name of a reference scenario; None for scenario A, unless there is a trajectory.
        trajectory: File of a trajectory request; None for the scenario's.
        settings: Laid over both, as nested tables.
    """

    config: str | None = None
    scenario: str | None = None
    trajectory: str | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Run:
    """One run of a sweep, complete; equal runs have equal outcomes.

    Attributes:
        config: JSON.
        request: JSON of the trajectory.
        stat_start_s: Start of the statistics window; None takes the last 40 % of the run.
        end_s: What follows this time along the trajectory does not count.
    """

    config: str
    request: str
    stat_start_s: float | None
    end_s: float


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a run ended: figures, or `failed` says why there are none."""

    run: Run
    failed: str
    figures: Figures | None


@dataclass(frozen=True, slots=True)
class Point:
    """A run and its place in the grid: number from 1, and the value of every axis."""

    number: int
    values: tuple[Any, ...]
    run: Run


# --- the grid ---------------------------------------------------------------------------------


def parse_axis(text: str) -> Axis:
    """Read `key=[v1, v2]` or `key=v1,v2`; values are TOML, else text.

    Raises:
        SweepError: If there is no key or no value, or a value comes twice.
    """
    key, equals, raw = text.partition("=")
    key = key.strip()
    if not equals or not all(key.split(".")):
        raise SweepError(f"--vary {text!r}: write key=v1,v2,... or key=[v1, v2, ...]")
    values = _parse_toml(raw)
    if not isinstance(values, list):
        values = _parse_toml(f"[{raw}]")
    if not isinstance(values, list):
        values = [part.strip() for part in raw.split(",") if part.strip()]
    return _axis(f"--vary {key}", key, values)


def _parse_toml(raw: str) -> Any:  # noqa: ANN401 - a setting may be of any type
    try:
        return tomllib.loads(f"v = {raw}")["v"]
    except (tomllib.TOMLDecodeError, RecursionError):
        return None


def read_grid(path: str) -> list[Axis]:
    """Read a grid: a TOML file of the configuration's form, with a list of values per setting.

    Raises:
        SweepError: If it cannot be read, or a setting has no list of values.
    """
    try:
        table = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise SweepError(f"{path}: {error.strerror or error}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise SweepError(f"{path}: not valid TOML: {error}") from error
    return [_axis(f"{path}: {key}", key, values) for key, values in _leaves(table)]


def _leaves(table: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in table.items():
        if isinstance(value, dict):
            yield from _leaves(value, f"{above}{key}.")
        else:
            yield f"{above}{key}", value


def _axis(where: str, key: str, values: object) -> Axis:
    if not isinstance(values, list) or not values:
        raise SweepError(f"{where}: needs a list of at least one value, got {values!r}")
    shown = [json.dumps(value, default=str) for value in values]
    twice = next((text for text in shown if shown.count(text) > 1), None)
    if twice is not None:
        raise SweepError(
            f"{where}: the value {twice} comes twice; write key=[[1, 2], [3, 4]] for lists"
        )
    return Axis(key, tuple(values))


def plan_sweep(axes: Sequence[Axis], base: Base) -> list[Point]:
    """Return every combination, with all configurations validated.

    Raises:
        SweepError: If a combination is no valid configuration, or there are too many.
    """
    _check_axes(axes)
    points = []
    for number, values in enumerate(product(*(axis.values for axis in axes)), start=1):
        try:
            run = _make_run(_varied(axes, values), base)
        except HilError as error:
            raise SweepError(f"run {number} ({describe(axes, values)}): {error}") from error
        points.append(Point(number, values, run))
    return points


def _check_axes(axes: Sequence[Axis]) -> None:
    if not axes:
        raise SweepError("nothing varies: give --vary KEY=V1,V2,... or --grid FILE")
    keys = [axis.key for axis in axes]
    for key in keys:
        if keys.count(key) > 1:
            raise SweepError(f"{key} varies twice; give all its values once")
        if inner := next((other for other in keys if other.startswith(f"{key}.")), None):
            raise SweepError(f"{inner} is a part of {key}, which varies too")
    runs = math.prod(len(axis.values) for axis in axes)
    if runs > RUNS_MAX:
        raise SweepError(f"the grid has {runs} runs, more than {RUNS_MAX}; take fewer values")


def describe(axes: Sequence[Axis], values: Sequence[Any]) -> str:
    """Return a point of the grid as one would type it."""
    pairs = zip(axes, values, strict=True)
    return ", ".join(f"{axis.key}={json.dumps(value, default=str)}" for axis, value in pairs)


def _varied(axes: Sequence[Axis], values: Sequence[Any]) -> dict[str, Any]:
    """Return one combination as nested tables."""
    varied: dict[str, Any] = {}
    for axis, value in zip(axes, values, strict=True):
        table = value
        for part in reversed(axis.key.split(".")):
            table = {part: table}
        varied = merge(varied, table)
    return varied


def _make_run(varied: dict[str, Any], base: Base) -> Run:
    named, path = varied.pop(SCENARIO, base.scenario), base.trajectory
    if isinstance(varied.get(TRAJECTORY), str):  # a table of that name is a setting
        path = varied.pop(TRAJECTORY)
    if named is None and path is None:
        named = DEFAULT_SCENARIO
    scenario = None if named is None else find_scenario(str(named))
    over = merge({} if scenario is None else scenario_settings(scenario), base.settings)
    config = load_config(base.config, merge(over, varied)).model_dump_json()
    if path is None and scenario is not None:
        request: TrajectoryRequest = scenario_request(scenario)
        return Run(config, request.model_dump_json(), scenario.stat_start_s, scenario.duration_s)
    return Run(config, _read_request(str(path)), None, math.inf)


def _read_request(path: str) -> str:
    try:
        return parse_trajectory(Path(path).read_bytes()).model_dump_json()
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror or error}") from error


# --- the runs ---------------------------------------------------------------------------------


class Identity:
    """Tells runs apart across starts of the program."""

    def __init__(self) -> None:
        self._program = fingerprint().encode()

    def of(self, run: Run) -> str:
        """Return the digest of everything that decides a run's outcome."""
        text = json.dumps([run.config, run.request, run.stat_start_s, run.end_s])
        return sha256(self._program + text.encode()).hexdigest()


def run_one(run: Run) -> Outcome:
    """Simulate one run; one that trips is an outcome that says so."""
    config, request = config_from_json(run.config), parse_trajectory(run.request)
    try:
        figures = simulate(config, request, stat_start_s=run.stat_start_s, end_s=run.end_s)
    except FAILURES as error:
        return Outcome(run, str(error), None)
    return Outcome(run, "", figures)


def sweep(runs: Sequence[Run], processes: int, on_outcome: Callable[[Outcome], object]) -> None:
    """Carry out runs on several cores, telling each outcome as it comes.

    Raises:
        BatchError: If a process was killed from outside. Outcomes so far have been told.
    """
    with Workers(processes) as workers:
        workers.run(run_one, dict.fromkeys(runs), on_outcome)
