"""Options that several verbs share, and the configuration they lead to."""

import argparse
import os
from pathlib import Path
from typing import Any

from hil.client import DEFAULT_ENDPOINT
from hil.config import Config, load_config, merge, parse_assignment
from hil.experiment import scenario_settings
from hil.recording import Recording
from hil.scenarios import find_scenario


def add_configuration(parser: argparse.ArgumentParser) -> argparse.Action:
    """Add the options that select and change the configuration; return `--bus`."""
    parser.add_argument("--config", metavar="FILE", help="TOML file (default: presets alone)")
    parser.add_argument("--scenario", metavar="NAME", help="reference scenario: A0, A, B or E")
    bus = parser.add_argument(
        "--bus",
        metavar="ADDRESS",
        help="unix:PATH, vcan0, socketcan:can0, slcan:DEVICE, python-can:KIND:CHANNEL",
    )
    add_assignments(parser)
    return bus


def add_assignments(parser: argparse.ArgumentParser) -> None:
    """Add the option that changes single settings."""
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="TABLE.KEY=VALUE",
        dest="assignments",
        help="change any setting; entries of a list by number: axes.1.node_id=5",
    )


def assigned(options: argparse.Namespace) -> dict[str, Any]:
    """Return the single settings asked for, as nested tables.

    Raises:
        ConfigError: If one is no assignment.
    """
    over: dict[str, Any] = {}
    for assignment in options.assignments:
        over = merge(over, parse_assignment(assignment))
    return over


def configuration(options: argparse.Namespace) -> Config:
    """Load the configuration the options ask for.

    Raises:
        ConfigError: With one line that names the setting.
        ScenarioError: If there is no such scenario.
    """
    over: dict[str, Any] = {}
    if options.scenario is not None:
        over = scenario_settings(find_scenario(options.scenario))
    if options.bus is not None:
        over = merge(over, {"bus": {"address": options.bus}})
    return load_config(options.config, merge(over, assigned(options)))


def add_recording(parser: argparse.ArgumentParser) -> None:
    """Add the options that say which recording is meant."""
    parser.add_argument("recording", help="MCAP file")
    parser.add_argument(
        "--whole-run", action="store_true", help="with the files that continue it (NAME-2.mcap ...)"
    )


def recording(options: argparse.Namespace) -> Recording:
    """Open the recording the options ask for.

    Raises:
        RecordingError: If it cannot be read.
    """
    path = Path(options.recording)
    return Recording.open_run(path) if options.whole_run else Recording.open(path)


def add_connection(parser: argparse.ArgumentParser) -> None:
    """Add the options that say which daemon is meant."""
    parser.add_argument("--arm", default="bench", help="name of the arm (default: %(default)s)")
    parser.add_argument(
        "--connect",
        action="append",
        metavar="ENDPOINT",
        help=f"Zenoh endpoint of the daemon or a router (default: $HIL_CONNECT, "
        f"or {DEFAULT_ENDPOINT})",
    )


def endpoints(options: argparse.Namespace) -> list[str]:
    """Return the endpoints to connect to."""
    return options.connect or [os.environ.get("HIL_CONNECT", DEFAULT_ENDPOINT)]
