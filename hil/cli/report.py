"""`hil report`: plots and figures from a recording."""

import argparse
from pathlib import Path

from hil.cli.options import add_recording, recording
from hil.report import write_report_of


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the verb's options."""
    add_recording(parser)
    parser.add_argument("--out", metavar="DIR", help="default: beside the recording")


def run(options: argparse.Namespace) -> int:
    """Write the report and print where it is."""
    path = Path(options.recording)
    out = Path(options.out) if options.out else path.with_suffix("")
    print(write_report_of(recording(options), out))
    return 0
