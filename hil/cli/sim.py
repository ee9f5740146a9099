"""`hil sim`: one experiment in virtual time."""

import argparse
from pathlib import Path
from time import perf_counter

from tqdm import tqdm

from hil.cli.options import add_configuration, configuration
from hil.errors import HilError
from hil.experiment import run_in_simulation, scenario_request
from hil.messages import TrajectoryRequest, parse_trajectory
from hil.recording import Recording
from hil.scenarios import find_scenario
from hil.verdict import judge


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the verb's options."""
    add_configuration(parser)
    parser.add_argument(
        "--trajectory", metavar="FILE", help="JSON of a trajectory request (default: scenario A)"
    )
    parser.add_argument(
        "--record", metavar="FILE", default="runs/sim.mcap", help="default: %(default)s"
    )


def run(options: argparse.Namespace) -> int:
    """Simulate, record, print figures and, for a scenario, the verdict."""
    if options.scenario is None and options.trajectory is None:
        options.scenario = "A"
    config = configuration(options)
    request = _request(options)
    path = Path(options.record)
    path.parent.mkdir(parents=True, exist_ok=True)
    started_s = perf_counter()
    with tqdm(leave=False, disable=None, bar_format="simulated {n:.0f} s") as bar:
        simulated_s = run_in_simulation(config, request, path, progress=bar.update)
    took_s = perf_counter() - started_s
    text, has_passed = judge(Recording.open(path))
    print(text)
    print(
        f"simulated {simulated_s:.1f} s in {took_s:.1f} s ({simulated_s / took_s:.1f} x real time)"
        f", recording {path}"
    )
    return 0 if has_passed else 1


def _request(options: argparse.Namespace) -> TrajectoryRequest:
    if options.trajectory is None:
        return scenario_request(find_scenario(options.scenario))
    try:
        return parse_trajectory(Path(options.trajectory).read_bytes())
    except OSError as error:
        raise HilError(f"{options.trajectory}: {error.strerror}") from error
