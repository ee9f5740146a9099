"""`hil faults`: the fault matrix, in virtual time."""

import argparse
from pathlib import Path

from tqdm import tqdm

from hil.fault_matrix import FAMILIES, broken_bounds, cells, matrix_config, run_matrix
from hil.fault_page import render


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the verb's options."""
    parser.add_argument("--out", metavar="FILE", help="default: standard output")
    parser.add_argument(
        "--family", action="append", choices=FAMILIES, help="default: all; may be repeated"
    )


def run(options: argparse.Namespace) -> int:
    """Run every cell, write the page; 1 if a cell breaks its bounds."""
    families = tuple(options.family or FAMILIES)
    total = sum(1 for _ in cells(families))
    with tqdm(total=total, leave=False, disable=None) as bar:
        outcomes = run_matrix(families, bar.update)
    page = render(outcomes)
    if options.out is None:
        print(page, end="")
    else:
        Path(options.out).write_text(page, encoding="utf-8")
    broken = 0
    for outcome in outcomes:
        tau_max_Nm = max(matrix_config(outcome.cell.family).controller.limits.tau_max_Nm)
        broken += bool(broken_bounds(outcome, tau_max_Nm))
    print(f"{total} cells, {broken} beyond their bounds")
    return 1 if broken else 0
