"""`hil diff`: are two recordings the same run?"""

import argparse
from pathlib import Path

from hil.diff import Digest, first_parting
from hil.recording import Recording


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the verb's options."""
    parser.add_argument("first", help="MCAP file")
    parser.add_argument("second", help="MCAP file")
    parser.add_argument(
        "--values",
        action="store_true",
        help="compare values only, not instants and durations: for runs in real time",
    )


def run(options: argparse.Namespace) -> int:
    """Print digests and the first differences; 1 if there are any."""
    a, b = (Recording.open(Path(path)) for path in (options.first, options.second))
    for recording in (a, b):
        digest = Digest.of(recording)
        print(
            f"{recording.path}\n  samples {digest.samples}\n  frames  {digest.frames}"
            f"\n  events  {digest.events}"
        )
    differences = first_parting(a, b, with_timing=not options.values)
    for difference in differences:
        print(f"differs {difference.text()}")
    if not differences:
        print("identical" + (" (values)" if options.values else ""))
    return 1 if differences else 0
