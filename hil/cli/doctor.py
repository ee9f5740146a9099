"""`hil doctor`: host, bus and configuration, with verdicts."""

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict

from hil.budget import budget_table, bus_budgets
from hil.cli.options import add_configuration, configuration
from hil.config import Config
from hil.doctor import check_bus_load, examine
from hil.finding import Finding

_BUDGET = ""
"""Value of `--bus` without an address."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the verb's options."""
    bus = add_configuration(parser)
    bus.nargs, bus.const = "?", _BUDGET
    bus.help = f"{bus.help}; without an address: only the bus budget, frame by frame"
    parser.add_argument("--json", action="store_true", help="machine-readable")


def run(options: argparse.Namespace) -> int:
    """Print every finding; 1 if one failed."""
    is_budget_only = options.bus == _BUDGET
    options.bus = options.bus or None
    config = configuration(options)
    if is_budget_only:
        return _show_budget(config, is_json=options.json)
    return _show(examine(config), is_json=options.json)


def _show_budget(config: Config, *, is_json: bool) -> int:
    budgets = bus_budgets(config)
    if is_json:
        told = [budget.as_json() for budget in budgets]
        print(json.dumps(told if config.bus.more else told[0], indent=2))
        return 0 if all(budget.is_fitting for budget in budgets) else 1
    for address, budget in zip(config.bus.addresses, budgets, strict=True):
        if config.bus.more:
            print(f"{address}:")
        print(budget_table(budget))
    return _show([check_bus_load(config)], is_json=False)


def _show(findings: Sequence[Finding], *, is_json: bool) -> int:
    if is_json:
        print(json.dumps([asdict(finding) for finding in findings], indent=2))
    else:
        for finding in findings:
            remedy = f"  -> {finding.remedy}" if finding.remedy else ""
            print(f"{finding.level.upper():4}  {finding.name:14}  {finding.found}{remedy}")
    return 1 if any(finding.level == "fail" for finding in findings) else 0
