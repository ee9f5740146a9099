"""`hil export`: a recording as CSV."""

import argparse
import sys
from pathlib import Path

from hil.cli.options import add_recording
from hil.cli.options import recording as opened
from hil.errors import HilError
from hil.export import export_csv


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the verb's options."""
    add_recording(parser)
    parser.add_argument("--csv", metavar="FILE", required=True, help="- is standard output")


def run(options: argparse.Namespace) -> int:
    """Write one row per cycle."""
    recording = opened(options)
    if options.csv == "-":
        export_csv(recording, sys.stdout)
        return 0
    try:
        with Path(options.csv).open("w", encoding="ascii", newline="") as file:
            export_csv(recording, file)
    except OSError as error:
        raise HilError(f"{options.csv}: {error.strerror}") from error
    return 0
