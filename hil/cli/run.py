"""`hil run`: the daemon."""

import argparse
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from controller.faults import FaultCode
from hil.budget import require_fit
from hil.cli.options import add_configuration, configuration
from hil.config import Config
from hil.recording import RecordingError
from hil.supervisor import Supervisor, sole_daemon
from hil.watchdogs import watchdog_warning


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the verb's options."""
    add_configuration(parser)
    parser.add_argument(
        "--record", metavar="FILE", help="recording to write (default: by name and time)"
    )
    parser.add_argument("--no-record", action="store_true", help="record nothing")


def run(options: argparse.Namespace) -> int:
    """Run the daemon until SIGINT or SIGTERM; torque is off at the end."""
    config = configuration(options)
    require_fit(config)
    warning = watchdog_warning(config)
    if warning:
        print(f"hil: warning: {warning}", file=sys.stderr, flush=True)
    recording = recording_path(config, options)
    with sole_daemon(config.arm.name):
        supervisor = Supervisor(config, recording)
        return supervisor.run(lambda status: _announce(config, recording, status))


def recording_path(config: Config, options: argparse.Namespace) -> Path | None:
    """Choose the recording's file and make its directory; None if nothing is to be recorded."""
    if options.no_record or not (config.recording.is_enabled or options.record):
        return None
    stamp = time.strftime("%Y%m%d-%H%M%S")
    named = Path(config.recording.directory) / f"{config.arm.name}-{stamp}.mcap"
    path = Path(options.record) if options.record else named
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecordingError(f"cannot create {path.parent}: {error.strerror}") from error
    return path


def _announce(config: Config, recording: Path | None, status: Mapping[str, Any]) -> None:
    listen = ", ".join(config.zenoh.listen) or "nowhere"
    remedy = "torque is off until it is enabled"
    if status["fault"] != FaultCode.NONE.name:
        remedy = f"in state {status['state']} ({status['fault']}): it needs a reset first"
    print(
        f"arm {config.arm.name} is ready on {config.bus.address}, Zenoh on {listen}, "
        f"recording to {recording or 'nothing'}; {remedy}",
        flush=True,
    )
