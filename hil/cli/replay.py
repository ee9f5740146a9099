"""`hil replay`: a recording once more through drivers and controller."""

import argparse
import json
from pathlib import Path

from hil.cli.options import add_assignments, assigned
from hil.config import config_from_json, merge
from hil.recording import Recording
from hil.replay import Replayer


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the verb's options."""
    parser.add_argument("recording", help="MCAP file; parts that continue it follow by themselves")
    add_assignments(parser)


def run(options: argparse.Namespace) -> int:
    """Replay, and say how much came out again; 1 if anything differs."""
    recording = Recording.open_run(Path(options.recording))
    table = merge(recording.config, assigned(options))
    result = Replayer(recording, config_from_json(json.dumps(table))).run()
    share = 100.0 * result.frames_equal / max(1, result.frames_sent)
    print(
        f"cycles   {result.cycles} replayed of {len(recording.samples)} recorded\n"
        f"frames   {result.frames_equal} of {result.frames_sent} sent again byte for byte"
        f" ({share:g} %)"
    )
    if result.difference is None:
        print("result   identical")
        return 0
    print(f"result   first difference {result.difference.text()}")
    return 1
