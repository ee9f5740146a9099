"""`hil compare`: laws side by side."""

import argparse
import os
import shlex
import sys
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Final

from tqdm import tqdm

from hil.compare import (
    ALL_LAWS,
    CLIPPED,
    LAWS,
    PERTURBATIONS,
    QUICK,
    REFERENCE,
    SCENARIOS,
    Case,
    Row,
    cases,
    compare,
    full,
    select,
)
from hil.compare_page import CSV_NAME, PAGE_NAME, TABLES_NAME, cover_page
from hil.compare_plots import draw_comparison
from hil.compare_progress import Progress
from hil.compare_tables import to_csv, to_markdown

_CHOICES: Final = ("law", "scenario", "perturbation")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the verb's options."""
    parser.add_argument("--quick", action="store_true", help="a few laws on one arm: a minute")
    for name, known in zip(_CHOICES, (ALL_LAWS, SCENARIOS, PERTURBATIONS), strict=True):
        parser.add_argument(
            f"--{name}",
            action="append",
            metavar="NAME",
            help="may be given again; " + ", ".join(known).replace("%", "%%"),
        )
    parser.add_argument(
        "--out",
        metavar="DIR",
        help=f"write {PAGE_NAME}, {TABLES_NAME}, {CSV_NAME} and plots there; interrupted, the same "
        "command goes on where it was",
    )
    parser.add_argument(
        "--processes", type=int, default=os.cpu_count() or 1, help="default: %(default)s"
    )


def run(options: argparse.Namespace) -> int:
    """Run the comparison and print it as Markdown."""
    wanted = _wanted(options)
    directory = Path(options.out) if options.out else None
    if directory is not None:
        directory.mkdir(parents=True, exist_ok=True)
    with Progress(directory) if directory else nullcontext() as progress:
        rows = _compare(wanted, max(1, options.processes), progress)
        if directory is not None:
            _write(rows, directory, _command(options))
    print(to_markdown(rows))
    return _status(rows)


def _status(rows: Sequence[Row]) -> int:
    """Return the exit status: that a law trips is a result, that all do is not."""
    tripped = sum(bool(row.failed) for row in rows)
    if tripped:
        print(f"hil: {tripped} of {len(rows)} runs tripped; the tables say why", file=sys.stderr)
    return 1 if tripped == len(rows) else 0


def _wanted(options: argparse.Namespace) -> list[Case]:
    if not (options.quick or options.law or options.scenario or options.perturbation):
        return full()
    laws, scenarios, perturbations = QUICK if options.quick else (LAWS, SCENARIOS, PERTURBATIONS)
    return cases(
        select(options.law, ALL_LAWS, "law") if options.law else laws,
        select(options.scenario, SCENARIOS, "scenario") if options.scenario else scenarios,
        select(options.perturbation, PERTURBATIONS, "perturbation")
        if options.perturbation
        else perturbations,
    )


def _compare(wanted: Sequence[Case], processes: int, progress: Progress | None) -> list[Row]:
    known = progress.rows if progress else {}
    extra = 0 if any(c.law == REFERENCE for c in wanted) else sum(c.law == CLIPPED for c in wanted)
    with tqdm(total=len(wanted) + extra, initial=len(known), unit="run", disable=None) as bar:

        def keep(row: Row) -> None:
            bar.update()
            if progress is not None:
                progress.add(row)

        return compare(wanted, processes, keep, known)


def _write(rows: Sequence[Row], directory: Path, command: str) -> None:
    (directory / CSV_NAME).write_text(to_csv(rows), encoding="utf-8")
    (directory / TABLES_NAME).write_text(to_markdown(rows), encoding="utf-8")
    pictures = [path.name for path in draw_comparison(rows, directory)]
    (directory / PAGE_NAME).write_text(cover_page(rows, command, pictures), encoding="utf-8")


def _command(options: argparse.Namespace) -> str:
    """Return what was typed, without what changes nothing in the result."""
    words = ["hil", "compare", *(["--quick"] if options.quick else [])]
    for name in _CHOICES:
        for value in getattr(options, name) or ():
            words += [f"--{name}", value]
    return shlex.join([*words, "--out", options.out])
