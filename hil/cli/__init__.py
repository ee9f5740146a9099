"""The command line: one module per verb, each with `add_arguments` and `run`."""

import argparse
import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.metadata import version
from typing import Final

from controller.errors import ControllerError
from drivers.errors import DriverError
from hil.errors import HilError
from sim_backend.errors import SimError

VERBS: Final = {
    "demo": "emulator and daemon over real frames: enable, track, verdict, report",
    "run": "the daemon: control loop, Zenoh gateway, recorder",
    "emulate": "the emulated arm and amplifiers on a bus",
    "sim": "everything in one process, in virtual time",
    "compare": "laws side by side, in virtual time",
    "sweep": "a grid of settings, every combination simulated on all cores",
    "send": "command a running daemon",
    "watch": "follow a running daemon",
    "report": "plots and figures from a recording",
    "export": "a recording as CSV",
    "diff": "are two recordings the same run, and if not, where do they part",
    "replay": "a recording once more through drivers and controller, compared frame by frame",
    "doctor": "check host, bus and configuration",
    "latency": "how late this host wakes the loop, beside cyclictest",
    "faults": "every fault on every target of every amplifier family, in virtual time",
    "conform": "drive one amplifier through its paces, pass or fail per step",
    "keys": "certificates and access control for those who connect over the network",
    "bus": "monitor, log and play frames; DBC and EDS",
}
INTERRUPTED: Final = 130


def make_parser() -> argparse.ArgumentParser:
    """Build the parser of the whole command line."""
    parser = argparse.ArgumentParser(
        prog="hil",
        description="Deterministic 1 kHz torque control of robot arms, emulated or real.",
        epilog="Exit status: 0 done, 1 refused or failed (one line on stderr), 2 usage.",
    )
    parser.add_argument("--version", action="version", version=f"hil {version('hil')}")
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="VERB")
    for name, summary in VERBS.items():
        verb = verbs.add_parser(
            name, help=summary, description=f"{summary[0].upper()}{summary[1:]}."
        )
        import_module(f"hil.cli.{name}").add_arguments(verb)
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status. A user's mistake never shows a traceback."""
    options = make_parser().parse_args(arguments)
    try:
        status: int = import_module(f"hil.cli.{options.verb}").run(options)
    except (HilError, DriverError, SimError, ControllerError) as error:
        print(f"hil: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("hil: interrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:  # the reader of our output has gone, as with `| head`
        sys.stderr.close()
        return 1
    except OSError as error:
        print(f"hil: {error.filename or 'system'}: {error.strerror or error}", file=sys.stderr)
        return 1
    return status
