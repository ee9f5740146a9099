"""Simulates cases into a directory and prints their digests: `python -m tests.hil.determinism`.

Needs nothing but the program and its own dependencies, so that any interpreter can run it.
"""

import argparse
import json
import platform
import sys
from pathlib import Path

from hil.config import load_config, merge, parse_assignment
from hil.diff import Digest
from hil.experiment import run_in_simulation, scenario_request, scenario_settings
from hil.recording import Recording
from hil.scenarios import find_scenario


def of_family(family, *more):
    """Settings that make both joints of one amplifier family."""
    return [
        f"axes.{joint}.{setting}" for joint in (1, 2) for setting in (f"family={family}", *more)
    ]


LOCKSTEP = "is_lockstep=true"
CASES = {
    "A": ("A", []),
    "B": ("B", []),
    "odrive": ("A", of_family("odrive")),
    "moteus": ("A", of_family("moteus")),
    "mit damiao": ("A", of_family("mit", "variant=damiao")),
    "mit tmotor": ("A", of_family("mit", "variant=tmotor", LOCKSTEP)),
    "mit cubemars": ("A", of_family("mit", "variant=cubemars", LOCKSTEP)),
    "mit cybergear": ("A", of_family("mit", "variant=cybergear")),
    "mit robstride": ("A", of_family("mit", "variant=robstride")),
    "wire": ("A", ["emulator.wire.is_on=true"]),
    "two buses": ("A", ["axes.2.bus=2", 'bus.more=["unix:/tmp/hil-bench-2.sock"]']),
}
"""Scenario and settings by name; A and B are on CiA 402."""
SHORT_S = 0.6


def simulate(case, path, duration_s):
    """Record one case; None runs the scenario's whole length."""
    name, assignments = CASES[case]
    scenario = find_scenario(name)
    over = scenario_settings(scenario)
    for assignment in assignments:
        over = merge(over, parse_assignment(assignment))
    request = scenario_request(scenario)
    if duration_s is not None:
        request = request.model_copy(update={"duration_s": duration_s})
    run_in_simulation(load_config(None, over), request, path)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("directory", type=Path)
    parser.add_argument("cases", nargs="*")
    parser.add_argument("--whole", action="store_true", help="20 s instead of a moment")
    options = parser.parse_args()
    print_digests(options.directory, options.cases or list(CASES), options.whole)


def print_digests(directory, cases, is_whole):
    digests = {}
    for case in cases:
        path = directory / f"{case}.mcap"
        simulate(case, path, None if is_whole else SHORT_S)
        digest = Digest.of(Recording.open(path))
        digests[case] = {
            "samples": digest.samples,
            "frames": digest.frames,
            "events": digest.events,
        }
    python = f"{platform.python_implementation()} {platform.python_version()}"
    sys.stdout.write(json.dumps({"python": python, "digests": digests}) + "\n")


if __name__ == "__main__":
    main()
