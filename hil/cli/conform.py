"""`hil conform`: one amplifier through its paces, emulated or real, pass or fail per step."""

import argparse
import json
import signal
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from time import monotonic_ns, time_ns
from typing import NoReturn, TypeVar

from drivers.arm_bus import SENT, ArmBus
from drivers.bus import open_bus
from drivers.database import DatabaseError
from drivers.decoder import FrameDecoder, frame_label
from drivers.frame_log import FrameLogWriter
from drivers.registry import SETTINGS, heartbeat_cycles, make_axes
from drivers.settings import AxisSettings
from hil.bus_tools import is_virtual
from hil.cli.options import add_configuration, configuration
from hil.config import Config
from hil.conform import Outcome, StepResult, run_steps
from hil.conform_bench import Bench, ConformError, Limits, LoggedFrame, Timing
from hil.conform_steps import STEPS

TORQUE_SHARE = 0.05
"""Torque of the steps if none is given, as a share of the axis's own limit."""
LIMIT_FACTOR = 2.0
"""Torque limit of the run if none is given, times the torque of the steps."""
WATCHDOG_S = 0.1
AnyAxis = TypeVar("AnyAxis", bound=AxisSettings)
_STATE_REPORTS = ("heartbeat_ms",)
_TORQUE_REPORTS = ("torque_report_ms",)
"""Families that do not answer SYNC may report state and torque this rarely."""
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
FRAMES_SHOWN = 40
FRAMES_SHOWN_OF_FAILURE = 8


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the verb's options."""
    parser.add_argument("family", metavar="FAMILY", help=", ".join(SETTINGS))
    add_configuration(parser)
    _add_limits(parser.add_argument_group("what may be done to the joint"))
    parser.add_argument("--yes", action="store_true", help="also on a bus with real amplifiers")
    parser.add_argument(
        "--inject",
        action="store_true",
        help="the drive is emulated although the bus is real: ask it to fail, too",
    )
    parser.add_argument("--frames", action="store_true", help="show the frames of every step")
    parser.add_argument("--json", action="store_true", help="machine-readable")
    parser.add_argument(
        "--log", type=Path, metavar="FILE", help="write every frame to *.log (candump), .asc, .blf"
    )


def _add_limits(group: argparse._ArgumentGroup) -> None:
    group.add_argument("--joint", type=int, metavar="N", help="default: the family's first")
    group.add_argument(
        "--torque",
        type=float,
        metavar="NM",
        dest="torque_Nm",
        help=f"default: {100 * TORQUE_SHARE:.0f} %% of the axis's limit",
    )
    group.add_argument(
        "--limit",
        type=float,
        metavar="NM",
        dest="limit_Nm",
        help=f"torque limit of the run (default: {LIMIT_FACTOR:g} x --torque)",
    )
    group.add_argument(
        "--travel",
        type=float,
        metavar="RAD",
        default=0.3,
        dest="travel_rad",
        help="torque off beyond this from the start (default: %(default)s)",
    )
    group.add_argument("--clamped", action="store_true", help="the joint cannot move")
    group.add_argument(
        "--watchdog",
        type=float,
        metavar="S",
        dest="watchdog_s",
        help="the drive removes torque after this long without commands (default: as configured)",
    )
    group.add_argument(
        "--tolerance",
        type=float,
        metavar="SHARE",
        default=0.15,
        help="of the reported torque (default: %(default)s)",
    )


def run(options: argparse.Namespace) -> int:
    """Run the steps; 0 if none failed. Torque is off at the end, however it comes."""
    config, joint = _axis_of_family(options)
    settings = config.axes[joint - 1]
    limits = _limits(options, settings, config)
    _confirm(options, config, joint, limits)
    limited = _limited(settings, limits)
    axes = list(config.axes)
    axes[joint - 1] = limited
    axis = make_axes(axes, period_s=config.loop.period_s)[joint - 1]
    timing = Timing(
        config.loop.period_s,
        config.loop.lockstep_timeout_s,
        config.emulator.stall_timeout_s,
        heartbeat_cycles([limited], period_s=config.loop.period_s),
    )
    printer = _Printer(options, _decoder(config, settings.bus))
    with ExitStack() as stack:
        for number in _SIGNALS:
            stack.callback(signal.signal, number, signal.signal(number, _interrupt))
        writer = stack.enter_context(FrameLogWriter(options.log)) if options.log else None
        bus = ArmBus(open_bus(config.bus.addresses[settings.bus - 1]), [axis], now_ns=monotonic_ns)
        stack.callback(bus.close)
        bench = Bench(bus, limits, timing)
        results = run_steps(bench, STEPS, lambda result: printer.show(result, writer))
    return printer.end(results)


def _interrupt(number: int, frame: object) -> NoReturn:
    """End the run; nothing interrupts taking torque off."""
    del number, frame
    for each in _SIGNALS:
        signal.signal(each, signal.SIG_IGN)
    raise KeyboardInterrupt


# --- what is asked for --------------------------------------------------------------------------


def _axis_of_family(options: argparse.Namespace) -> tuple[Config, int]:
    """Return the configuration and the joint to test.

    Without a file every axis is of the family asked for; a file says itself what its axes are.
    """
    family = options.family
    if family not in SETTINGS:
        raise ConformError(f"family {family!r} is not one of: {', '.join(SETTINGS)}")
    if options.config is None and family != "cia402":
        joint = options.joint or 1
        options.assignments.insert(0, f"axes.{joint}.family={family}")
    config = configuration(options)
    fitting = [
        number
        for number, axis in enumerate(config.axes, start=1)
        if axis.family == family and options.joint in (None, number)
    ]
    if not fitting:
        found = ", ".join(axis.family for axis in config.axes)
        which = "no joint" if options.joint is None else f"joint {options.joint}"
        raise ConformError(f"{which} of the configuration is {family}: its axes are {found}")
    return config, fitting[0]


def _limits(options: argparse.Namespace, settings: AxisSettings, config: Config) -> Limits:
    """Return what the run may do.

    Raises:
        ConformError: If the options contradict each other or the configuration.
    """
    most_Nm = float(getattr(settings, "torque_max_Nm", options.limit_Nm or 0.0))
    torque_Nm = options.torque_Nm or TORQUE_SHARE * most_Nm
    limit_Nm = options.limit_Nm or LIMIT_FACTOR * torque_Nm
    for name, value in (("--torque", torque_Nm), ("--travel", options.travel_rad),
                        ("--tolerance", options.tolerance)):  # fmt: skip
        if not value > 0.0:
            raise ConformError(f"{name} {value:g} must be more than 0")
    if not torque_Nm <= limit_Nm <= most_Nm:
        raise ConformError(
            f"--torque {torque_Nm:g} <= --limit {limit_Nm:g} <= {most_Nm:g} Nm (torque_max_Nm of "
            "the axis) is not so; correct one of them"
        )
    return Limits(
        torque_Nm=torque_Nm,
        torque_max_Nm=limit_Nm,
        travel_rad=options.travel_rad,
        tolerance=options.tolerance,
        watchdog_s=options.watchdog_s or settings.watchdog_s or WATCHDOG_S,
        has_watchdog=options.watchdog_s is not None or settings.watchdog_s is not None,
        state_report_s=0.0 if options.family == "cia402" else _longest_s(settings, _STATE_REPORTS),
        torque_report_s=_longest_s(settings, _TORQUE_REPORTS),
        enable_s=config.loop.enable_timeout_s,
        is_clamped=options.clamped,
        may_inject=options.inject or is_virtual(config.bus.addresses[settings.bus - 1]),
    )


def _longest_s(settings: AxisSettings, names: tuple[str, ...]) -> float:
    """Return the longest of the settings with these names, given in milliseconds; 0 if none."""
    return max(float(getattr(settings, name, None) or 0.0) * 1e-3 for name in names)


def _limited(settings: AnyAxis, limits: Limits) -> AnyAxis:
    """Return the axis's settings with the torque limit of the run."""
    return settings.model_copy(update={"torque_max_Nm": limits.torque_max_Nm})


def _confirm(options: argparse.Namespace, config: Config, joint: int, limits: Limits) -> None:
    """Ask before a joint that may be real is moved.

    Raises:
        ConformError: If it was not confirmed. Nothing was sent.
    """
    address = config.bus.addresses[config.axes[joint - 1].bus - 1]
    if options.yes or is_virtual(address):
        return
    warning = (
        f"joint {joint} on {address} will be driven with up to {limits.torque_max_Nm:g} Nm and may "
        f"move {limits.travel_rad:g} rad; nobody in its reach, an emergency stop in hand"
    )
    if not sys.stdin.isatty():
        raise ConformError(f"{warning}; if that is so, add --yes")
    print(f"{warning}.\nGo on? Type yes: ", end="", flush=True)
    if sys.stdin.readline().strip() != "yes":
        raise ConformError("not confirmed; nothing was sent")


def _decoder(config: Config, bus: int) -> FrameDecoder | None:
    try:
        return FrameDecoder(config.axes, bus)
    except DatabaseError:
        return None


# --- what is shown ------------------------------------------------------------------------------


class _Printer:
    """Shows results as they come, and the frames that were asked for."""

    def __init__(self, options: argparse.Namespace, decoder: FrameDecoder | None) -> None:
        self._with_frames: bool = options.frames
        self._as_json: bool = options.json
        self._decoder = decoder
        self._epoch_ns = time_ns() - monotonic_ns()

    def show(self, result: StepResult, writer: FrameLogWriter | None) -> None:
        """Print one step, and write its frames to the log."""
        if not self._as_json:
            print(f"{result.outcome.value:11}  {result.name:30}  {result.detail}", flush=True)
            for line in self._frames(result):
                print(line)
        if writer is not None:
            for t_ns, direction, frame in result.frames:
                t_s = (t_ns + self._epoch_ns) * 1e-9
                writer.write(frame, t_s, is_sent=direction == SENT)

    def _frames(self, result: StepResult) -> Iterator[str]:
        changes = list(_changes(result.frames))
        if self._with_frames:
            shown, rest = changes[:FRAMES_SHOWN], changes[FRAMES_SHOWN:]
            yield from map(self._line, shown)
            if rest:
                yield f"      ... {len(rest)} more that differ from the last of their identifier"
            if result.dropped:
                yield f"      ... {result.dropped} more not kept"
        elif result.outcome is Outcome.FAIL:
            yield from map(self._line, changes[-FRAMES_SHOWN_OF_FAILURE:])

    def _line(self, logged: LoggedFrame) -> str:
        t_ns, direction, frame = logged
        way = "->" if direction == SENT else "<-"
        text = self._decoder.describe(frame) if self._decoder is not None else ""
        t_s = (t_ns + self._epoch_ns) * 1e-9
        return f"      {t_s % 1000:10.6f} {way} {frame_label(frame):24}  {text}".rstrip()

    def end(self, results: list[StepResult]) -> int:
        """Print the verdict and return the exit status."""
        counts = dict.fromkeys(Outcome, 0)
        for result in results:
            counts[result.outcome] += 1
        is_good = not counts[Outcome.FAIL] and not counts[Outcome.NOT_REACHED]
        if self._as_json:
            rows = [{"step": r.name, "outcome": r.outcome.value.lower(), "detail": r.detail}
                    for r in results]  # fmt: skip
            print(json.dumps({"ok": is_good, "steps": rows}, indent=2))
        else:
            shown = ", ".join(f"{number} {o.value.lower()}" for o, number in counts.items())
            print(f"\n{shown}")
        return 0 if is_good else 1


def _changes(frames: list[LoggedFrame]) -> Iterator[LoggedFrame]:
    """Yield the frames whose content differs from the last one of their identifier."""
    last: dict[bytes, bytes] = {}
    for logged in frames:
        frame = logged[2]
        head = frame[:4]
        if last.get(head) != frame:
            last[head] = frame
            yield logged
