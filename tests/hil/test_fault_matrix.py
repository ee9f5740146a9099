"""Every fault on every target of every amplifier family: bounds, recovery, and the same to the bit.

The default run takes every fault of the CANopen family, and what differs most between families;
HIL_NIGHTLY=1 takes all cells. `hil faults --out docs/faults.md` publishes the same runs.
"""

import hashlib
import os
from pathlib import Path

import pytest

from hil.fault_matrix import (
    FAMILIES,
    KINDS,
    TARGETS,
    Cell,
    Run,
    bound_of,
    broken_bounds,
    cells,
    matrix_config,
    run_cell,
)
from hil.fault_page import COMMAND, render
from hil.simulation import Simulation

IS_NIGHTLY = bool(os.environ.get("HIL_NIGHTLY"))
EVERYWHERE = {("amplifier", "off"), ("amplifier", "stuck"), ("amplifier", "delayed")}
PAGE = Path(__file__).parents[2] / "docs" / "faults.md"


def chosen():
    for cell in cells():
        is_quick = cell.family == "cia402" or (cell.target, cell.kind) in EVERYWHERE
        marks = () if is_quick or IS_NIGHTLY else pytest.mark.skip(reason="make nightly")
        yield pytest.param(cell, marks=marks, id=f"{cell.target}-{cell.kind}-{cell.family}")


@pytest.mark.parametrize("cell", list(chosen()))
def test_fault__any_target_kind_family__within_bounds_and_back(cell):
    outcome = run_cell(cell)
    tau_max_Nm = max(matrix_config(cell.family).controller.limits.tau_max_Nm)
    assert broken_bounds(outcome, tau_max_Nm) == []
    is_tolerated = bound_of(cell).reaction_cycles is None
    assert (outcome.reaction_cycles is None) == is_tolerated, outcome


class Digest:
    """Takes a run's samples and frames into one sum."""

    def __init__(self):
        self.sum = hashlib.sha256()

    def add_sample(self, _t_ns, _seq, payload):
        self.sum.update(payload)

    def add_bus_log(self, _t_ns, payload):
        self.sum.update(payload)

    def add_trajectory(self, *_):
        pass

    def add_event(self, *_):
        pass


def digest(cell):
    sink = Digest()
    simulation = Simulation(matrix_config(cell.family), sink)
    run = Run(simulation)
    run.swing()
    run.disturb(cell.target, cell.kind)
    simulation.close()
    return sink.sum.hexdigest()


@pytest.mark.parametrize("cell", [Cell("cia402", "encoder", "garbage"), Cell("mit", "bus", "slow")])
def test_fault__same_run_twice__same_bytes(cell):
    assert digest(cell) == digest(cell)


def test_page__in_docs__has_every_cell_and_no_broken_bound():
    page = PAGE.read_text(encoding="utf-8")
    assert COMMAND in page
    assert "Every cell keeps its bounds" in page
    rows = [line for line in page.splitlines() if line.startswith("| `")]
    assert len(rows) == len(TARGETS) * len(KINDS) * len(FAMILIES)


def test_page__one_outcome__row_says_what_the_docs_say():
    """The page in docs is that of this program: one cell is run again and compared."""
    cell = Cell("moteus", "encoder", "off")
    row = next(line for line in render([run_cell(cell)]).splitlines() if line.startswith("| `off`"))
    assert row in PAGE.read_text(encoding="utf-8")
