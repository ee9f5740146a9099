"""`hil doctor`: host, bus and configuration, with verdicts."""

import argparse
import json
from dataclasses import asdict

from hil.cli.options import add_configuration, configuration
from hil.doctor import examine


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the verb's options."""
    add_configuration(parser)
    parser.add_argument("--json", action="store_true", help="machine-readable")


def run(options: argparse.Namespace) -> int:
    """Print every finding; 1 if one failed."""
    findings = examine(configuration(options))
    if options.json:
        print(json.dumps([asdict(finding) for finding in findings], indent=2))
    else:
        for finding in findings:
            remedy = f"  -> {finding.remedy}" if finding.remedy else ""
            print(f"{finding.level.upper():4}  {finding.name:12}  {finding.found}{remedy}")
    return 1 if any(finding.level == "fail" for finding in findings) else 0
