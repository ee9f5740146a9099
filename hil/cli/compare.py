"""`hil compare`: laws side by side."""

import argparse
import os
from pathlib import Path

from tqdm import tqdm

from hil.compare import (
    CLIPPED,
    LAWS,
    PERTURBATIONS,
    QUICK,
    REFERENCE,
    SCENARIOS,
    cases,
    compare,
    select,
    to_csv,
    to_markdown,
)
from hil.compare_plots import draw_comparison


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the verb's options."""
    parser.add_argument("--quick", action="store_true", help="a few laws on one arm: a minute")
    parser.add_argument("--law", action="append", metavar="NAME", help=", ".join(LAWS))
    parser.add_argument("--scenario", action="append", metavar="NAME", help=", ".join(SCENARIOS))
    parser.add_argument(
        "--perturbation",
        action="append",
        metavar="NAME",
        help=", ".join(PERTURBATIONS).replace("%", "%%"),
    )
    parser.add_argument(
        "--out", metavar="DIR", help="write compare.csv, compare.md and plots there"
    )
    parser.add_argument(
        "--processes", type=int, default=os.cpu_count() or 1, help="default: %(default)s"
    )


def run(options: argparse.Namespace) -> int:
    """Run the comparison and print it as Markdown."""
    quick_laws, quick_scenarios, quick_perturbations = QUICK if options.quick else (None,) * 3
    wanted = cases(
        select(options.law or quick_laws, LAWS, "law"),
        select(options.scenario or quick_scenarios, SCENARIOS, "scenario"),
        select(options.perturbation or quick_perturbations, PERTURBATIONS, "perturbation"),
    )
    extra = 0 if any(c.law == REFERENCE for c in wanted) else sum(c.law == CLIPPED for c in wanted)
    with tqdm(total=len(wanted) + extra, unit="run", disable=None) as bar:
        rows = compare(wanted, max(1, options.processes), bar.update)
    print(to_markdown(rows))
    if options.out:
        directory = Path(options.out)
        directory.mkdir(parents=True, exist_ok=True)
        (directory / "compare.csv").write_text(to_csv(rows), encoding="utf-8")
        (directory / "compare.md").write_text(to_markdown(rows), encoding="utf-8")
        draw_comparison(rows, directory)
    return 1 if any(row.failed for row in rows) else 0
