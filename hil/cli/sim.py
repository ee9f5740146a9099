"""`hil sim`: one experiment in virtual time."""

import argparse
from pathlib import Path
from time import perf_counter

from tqdm import tqdm

from hil.cli.options import add_configuration, configuration
from hil.config import Config
from hil.errors import HilError
from hil.experiment import SCENARIO_JOINTS, run_in_simulation, scenario_request, swing
from hil.messages import TrajectoryRequest, parse_trajectory
from hil.recording import Recording
from hil.scenarios import find_scenario
from hil.verdict import judge


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the verb's options."""
    add_configuration(parser)
    parser.add_argument(
        "--trajectory",
        metavar="FILE",
        help="JSON of a trajectory request (default: scenario A; a swing of other arms than its)",
    )
    parser.add_argument(
        "--record", metavar="FILE", default="runs/sim.mcap", help="default: %(default)s"
    )


def run(options: argparse.Namespace) -> int:
    """Simulate, record, print figures and, for a scenario, the verdict."""
    is_unasked = options.scenario is None and options.trajectory is None
    if is_unasked and configuration(options).joints == SCENARIO_JOINTS:
        options.scenario = "A"
    config = configuration(options)
    request = _request(options, config)
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


def _request(options: argparse.Namespace, config: Config) -> TrajectoryRequest:
    if options.trajectory is None and options.scenario is None:
        return swing(config)
    if options.trajectory is None:
        return scenario_request(find_scenario(options.scenario))
    try:
        return parse_trajectory(Path(options.trajectory).read_bytes())
    except OSError as error:
        raise HilError(f"{options.trajectory}: {error.strerror}") from error
