"""`hil bus`: follow a bus with decoded fields, log it, play a log; write its DBC and EDS."""

import argparse
import signal
import sys
from collections.abc import Callable
from itertools import chain
from math import inf
from pathlib import Path
from time import monotonic

from drivers.bus import open_bus
from drivers.database import arm_database
from drivers.decoder import FrameDecoder
from drivers.frame_log import FrameLogError, FrameLogWriter, read_log, require_suffix
from hil.bus_tools import BusToolError, Monitor, frames_of, is_virtual, play
from hil.cli.options import add_configuration, configuration
from hil.config import Config
from hil.errors import HilError
from sim_backend.cia402.eds import render_eds

TABLE_EVERY_S = 0.5
LINE_EVERY_S = 0.2
_CLEAR = "\x1b[H\x1b[2J"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the verb's actions and their options."""
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    monitor = actions.add_parser("monitor", help="show frames with decoded fields")
    monitor.add_argument("--raw", action="store_true", help="every frame as a line, not decoded")
    monitor.add_argument(
        "--lines", action="store_true", help="lines instead of a table, as when not on a terminal"
    )
    monitor.add_argument(
        "--every",
        type=float,
        metavar="S",
        default=LINE_EVERY_S,
        help="shortest time between two lines of one identifier, 0: none (default: %(default)s)",
    )
    log = actions.add_parser("log", help="write frames to a file")
    log.add_argument("file", type=Path, help="*.log (candump), *.asc (Vector ASC) or *.blf")
    for following in (monitor, log):
        following.add_argument("--for", type=float, dest="duration_s", metavar="S",
                               help="end after this")  # fmt: skip
    player = actions.add_parser("play", help="send the frames of a log")
    player.add_argument("file", type=Path, help="*.log (candump), *.asc (Vector ASC) or *.blf")
    player.add_argument("--fast", action="store_true", help="do not keep the log's timing")
    player.add_argument("--yes", action="store_true", help="also on a bus with real amplifiers")
    dbc = actions.add_parser("dbc", help="write the DBC of the configured axes")
    eds = actions.add_parser("eds", help="write the EDS of the emulated CiA 402 drive")
    for action in (monitor, log, player, dbc):
        add_configuration(action)
        action.add_argument(
            "--number", type=int, default=1, metavar="N", help="of an arm on several buses, bus N"
        )
    for writer in (dbc, eds):
        writer.add_argument("--out", metavar="FILE", default="-", help="default: stdout")


def run(options: argparse.Namespace) -> int:
    """Carry out the action."""
    return _ACTIONS[options.action](options)


def _end_by_signal(duration_s: float | None) -> Callable[[], bool]:
    """Return what tells whether SIGINT or SIGTERM came, or the time is up."""
    signals: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda signum, _: signals.append(signum))
    deadline_s = monotonic() + (inf if duration_s is None else duration_s)
    return lambda: bool(signals) or monotonic() >= deadline_s


def _address(config: Config, options: argparse.Namespace) -> str:
    """Return the address of the bus asked for.

    Raises:
        BusToolError: If the arm has no such bus.
    """
    addresses = config.bus.addresses
    if not 1 <= options.number <= len(addresses):
        raise BusToolError(
            f"--number {options.number}: buses are numbered 1 to {len(addresses)} (bus.more)"
        )
    number: int = options.number
    return addresses[number - 1]


def _monitor(options: argparse.Namespace) -> int:
    config = configuration(options)
    address = _address(config, options)
    decoder = None if options.raw else FrameDecoder(config.axes, options.number)
    has_table = sys.stdout.isatty() and not (options.raw or options.lines)
    monitor = Monitor(decoder, 0.0 if options.raw else options.every)
    shown_s = -inf
    with open_bus(address) as bus:
        for item in frames_of(bus, _end_by_signal(options.duration_s)):
            line = monitor.take(*item) if item is not None else None
            if has_table and monotonic() - shown_s > TABLE_EVERY_S:
                shown_s = monotonic()
                print(_CLEAR + monitor.table(), flush=True)
            elif line is not None and not has_table:
                print(line, flush=True)
    if has_table:
        print(f"{monitor.frames} frames")
    return 0


def _log(options: argparse.Namespace) -> int:
    config = configuration(options)
    require_suffix(options.file)
    address = _address(config, options)
    channel = address.rpartition(":")[2].rpartition("/")[2].replace(" ", "_") or "can0"
    with open_bus(address) as bus, FrameLogWriter(options.file, channel) as writer:
        print(f"logging {address} to {options.file}", flush=True)
        for item in frames_of(bus, _end_by_signal(options.duration_s)):
            if item is not None:
                writer.write(item[1], item[0])
    print(f"{writer.frames} frames in {options.file}")
    return 0


def _play(options: argparse.Namespace) -> int:
    config = configuration(options)
    address = _address(config, options)
    if not (is_virtual(address) or options.yes):
        raise BusToolError(
            f"{address} may have real amplifiers on it, and a log may command torque; "
            "if that is meant, add --yes"
        )
    log = read_log(options.file)
    first = next(log, None)
    if first is None:
        raise FrameLogError(f"{options.file}: there are no frames in it")
    with open_bus(address) as bus:
        done = play(bus, chain([first], log), is_fast=options.fast,
                    is_ended=_end_by_signal(None))  # fmt: skip
    timing = "" if options.fast else f", at the latest {1e3 * done.late_s:.1f} ms late"
    skipped = f"; {done.skipped} error reports left out" if done.skipped else ""
    print(f"{done.frames} frames sent in {done.duration_s:.3f} s{timing}{skipped}")
    return 0


def _dbc(options: argparse.Namespace) -> int:
    config = configuration(options)
    _address(config, options)
    return _write(options.out, arm_database(config.axes, options.number).as_dbc_string())


def _eds(options: argparse.Namespace) -> int:
    return _write(options.out, render_eds())


def _write(out: str, text: str) -> int:
    if out == "-":
        sys.stdout.write(text)
        return 0
    try:
        Path(out).write_text(text, encoding="utf-8")
    except OSError as error:
        raise HilError(f"{out}: {error.strerror or error}") from error
    return 0


_ACTIONS: dict[str, Callable[[argparse.Namespace], int]] = {
    "monitor": _monitor,
    "log": _log,
    "play": _play,
    "dbc": _dbc,
    "eds": _eds,
}
