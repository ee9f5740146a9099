"""`hil report`: plots and figures from a recording."""

import argparse
from pathlib import Path

from hil.report import write_report


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the verb's options."""
    parser.add_argument("recording", help="MCAP file")
    parser.add_argument("--out", metavar="DIR", help="default: beside the recording")


def run(options: argparse.Namespace) -> int:
    """Write the report and print where it is."""
    recording = Path(options.recording)
    out = Path(options.out) if options.out else recording.with_suffix("")
    print(write_report(recording, out))
    return 0
