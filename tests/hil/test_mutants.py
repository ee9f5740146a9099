"""The scenarios' bounds tell a right implementation from wrong ones."""

from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import pytest

from tests.hil.mutants import MUTANTS, hunt

RIGHT = [(None, name) for name in ("A0", "A", "B", "E")]


@pytest.fixture(scope="module")
def findings():
    wanted = [*RIGHT, *((mutant, mutant.scenario) for mutant in MUTANTS)]
    pool = ProcessPoolExecutor(2, mp_context=get_context("spawn"), max_tasks_per_child=1)
    with pool:
        runs = {case: pool.submit(hunt, *case) for case in wanted}
        return {case: run.result() for case, run in runs.items()}


@pytest.mark.timeout(400)  # the first test waits for all runs
@pytest.mark.parametrize("name", [name for _, name in RIGHT])
def test_bounds__right_implementation__all_met(findings, name):
    assert findings[None, name] == []


@pytest.mark.timeout(400)
@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.name)
def test_bounds__mutant__at_least_one_broken(findings, mutant):
    assert findings[mutant, mutant.scenario], f"{mutant.name} went unnoticed"
