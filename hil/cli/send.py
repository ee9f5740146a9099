"""`hil send`: one command to a running daemon."""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from hil.cli.options import add_connection, endpoints
from hil.client import Client
from hil.errors import HilError
from hil.experiment import scenario_request
from hil.scenarios import find_scenario

PLAIN = {
    "enable": "power on; the arm holds its pose",
    "disable": "damped stop, then power off",
    "stop": "slow down along the path and hold",
    "estop": "torque off at once; latched",
    "reset": "clear a latched fault or emergency stop",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the verb's options."""
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, summary in PLAIN.items():
        add_connection(commands.add_parser(name, help=summary))
    trajectory = commands.add_parser("trajectory", help="play a trajectory")
    what = trajectory.add_mutually_exclusive_group(required=True)
    what.add_argument("file", nargs="?", help="JSON of the request; - reads standard input")
    what.add_argument("--json", help="the request itself")
    what.add_argument("--scenario", help="the trajectory of a reference scenario")
    what.add_argument("--move", nargs="+", type=float, metavar="RAD", help="go to this pose")
    add_connection(trajectory)
    bounds = commands.add_parser("gain-bounds", help="move the bounds of the self-tuned gain")
    bounds.add_argument("--min", nargs="+", type=float, required=True, metavar="KD")
    bounds.add_argument("--max", nargs="+", type=float, required=True, metavar="KD")
    add_connection(bounds)
    fault = commands.add_parser("fault", help="ask the emulator for a fault, or to end it")
    fault.add_argument("--target", default="amplifier")
    fault.add_argument("--kind", default="off")
    fault.add_argument("--joint", type=int)
    fault.add_argument("--duration", type=float, metavar="S", help="default: until `--kind ok`")
    add_connection(fault)


def run(options: argparse.Namespace) -> int:
    """Send the command and print its reply as JSON."""
    verb, arguments = request(options)
    with Client(options.arm, endpoints(options)) as client:
        reply = client.command(verb, **arguments)
    print(reply.model_dump_json(exclude_none=True, exclude={"request_id", "cycle"}))
    return 0


def request(options: argparse.Namespace) -> tuple[str, dict[str, Any]]:
    """Return the command and its fields.

    Raises:
        HilError: If a file cannot be read or is not a JSON object.
    """
    match options.command:
        case "trajectory":
            return "trajectory", _trajectory(options)
        case "gain-bounds":
            return "gain_bounds", {"Kd_min": options.min, "Kd_max": options.max}
        case "fault":
            return "fault", {
                "target": options.target,
                "kind": options.kind,
                "joint": options.joint,
                "duration_s": options.duration,
            }
        case plain:
            return plain, {}


def _trajectory(options: argparse.Namespace) -> dict[str, Any]:
    if options.scenario is not None:
        trajectory = scenario_request(find_scenario(options.scenario))
        return trajectory.model_dump(exclude_none=True, exclude={"version"})
    if options.move is not None:
        return {"kind": "move", "target_rad": options.move}
    try:
        text = options.json or _read(options.file)
        fields = json.loads(text)
    except OSError as error:
        raise HilError(f"{options.file}: {error.strerror}") from error
    except ValueError as error:
        raise HilError(f"the trajectory is not JSON: {error}") from error
    if not isinstance(fields, dict):
        raise HilError("the trajectory is not a JSON object")
    return fields


def _read(file: str) -> str:
    return sys.stdin.read() if file == "-" else Path(file).read_text(encoding="utf-8")
