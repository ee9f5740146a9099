"""`hil sweep`: a grid of settings, every combination simulated."""

import argparse
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from time import monotonic
from typing import Final

from tqdm import tqdm

from hil.batch import exit_status
from hil.cli.options import add_assignments, assigned
from hil.sweep import Base, Outcome, Point, Run, parse_axis, plan_sweep, read_grid, sweep
from hil.sweep_output import CSV_NAME, JOURNAL_NAME, PARQUET_NAME, Journal, Table, require_parquet

WRITE_EVERY_S: Final = 10.0
"""A killed sweep's table is at most this old; its journal is not."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the verb's options."""
    parser.add_argument(
        "--vary",
        action="append",
        default=[],
        metavar="KEY=V1,V2,...",
        help="may be given again; values of any setting, as controller.law.alpha=[10,10],[15,15]; "
        "also scenario=A,B and trajectory=FILE,FILE; the first varies slowest",
    )
    parser.add_argument(
        "--grid", metavar="FILE", help="TOML like the configuration, a list of values per setting"
    )
    parser.add_argument("--config", metavar="FILE", help="TOML file (default: presets alone)")
    parser.add_argument(
        "--scenario", metavar="NAME", help="reference scenario of all runs (default: A)"
    )
    parser.add_argument("--trajectory", metavar="FILE", help="JSON of a trajectory request")
    add_assignments(parser)
    parser.add_argument(
        "--out",
        metavar="DIR",
        default="runs/sweep",
        help=f"writes {CSV_NAME} and {JOURNAL_NAME} there; runs that are in {JOURNAL_NAME} are not "
        "run again (default: %(default)s)",
    )
    parser.add_argument(
        "--parquet", action="store_true", help=f"write {PARQUET_NAME} too; needs hil[sweep]"
    )
    parser.add_argument(
        "--processes", type=int, default=os.cpu_count() or 1, help="default: %(default)s"
    )


def run(options: argparse.Namespace) -> int:
    """Run what is not known yet, and write the table."""
    axes = [*(read_grid(options.grid) if options.grid else ()), *map(parse_axis, options.vary)]
    base = Base(options.config, options.scenario, options.trajectory, assigned(options))
    if options.parquet:
        require_parquet()
    points = plan_sweep(axes, base)
    directory = Path(options.out)
    directory.mkdir(parents=True, exist_ok=True)
    table = Table(axes, points)
    with Journal(directory) as journal:
        outcomes = journal.known([point.run for point in points])
        writer = _Writer(table, directory, outcomes, with_parquet=options.parquet)
        known = len(outcomes)
        took_s = _simulate(points, outcomes, journal, writer, max(1, options.processes))
    _tell(points, outcomes, known, took_s)
    print(f"wrote    {directory / CSV_NAME}")
    return exit_status([outcome.failed for outcome in outcomes.values()])


class _Writer:
    """Writes the table now and then, and in the end."""

    def __init__(
        self,
        table: Table,
        directory: Path,
        outcomes: Mapping[Run, Outcome],
        *,
        with_parquet: bool,
    ) -> None:
        self._table = table
        self._directory = directory
        self._outcomes = outcomes
        self._with_parquet = with_parquet
        self._written_s = monotonic()

    def write_if_due(self) -> None:
        if monotonic() - self._written_s > WRITE_EVERY_S:
            self._table.write_csv(self._directory / CSV_NAME, self._outcomes)
            self._written_s = monotonic()

    def write(self) -> None:
        self._table.write_csv(self._directory / CSV_NAME, self._outcomes)
        if self._with_parquet:
            self._table.write_parquet(self._directory / PARQUET_NAME, self._outcomes)


def _simulate(
    points: list[Point],
    outcomes: dict[Run, Outcome],
    journal: Journal,
    writer: _Writer,
    processes: int,
) -> float:
    """Carry out the runs that are missing in `outcomes`; return how long it took in seconds."""
    missing = list(dict.fromkeys(p.run for p in points if p.run not in outcomes))
    known = len(outcomes)
    began_s = monotonic()
    with tqdm(total=known + len(missing), initial=known, unit="run", disable=None) as bar:

        def keep(outcome: Outcome) -> None:
            journal.add(outcome)
            outcomes[outcome.run] = outcome
            bar.update()
            writer.write_if_due()

        try:
            if missing:
                sweep(missing, min(processes, len(missing)), keep)
        finally:
            took_s = monotonic() - began_s
            writer.write()
    return took_s


def _tell(points: list[Point], outcomes: Mapping[Run, Outcome], known: int, took_s: float) -> None:
    fresh = len(outcomes) - known
    pace = f" in {took_s:.1f} s ({3600.0 * fresh / took_s:.0f} per hour)" if fresh else ""
    print(f"runs     {len(points)} in the grid, {known} known before, {fresh} run{pace}")
    tripped = sum(bool(outcomes[point.run].failed) for point in points)
    if tripped:
        print(f"hil: {tripped} of {len(points)} runs tripped; column `failed`", file=sys.stderr)
