"""`hil latency`: how late this host wakes the loop, beside cyclictest, with a verdict."""

import argparse
import json
import sys

from hil.cli.options import add_configuration, configuration
from hil.histogram import QUANTILE_NAMES
from hil.latency import OURS, THEIRS, VERDICT_SOURCES, Latency, measure
from hil.stress import KINDS


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the verb's options."""
    add_configuration(parser)
    parser.add_argument(
        "--seconds", type=_positive, default=60.0, metavar="S", help="in total (default: 60)"
    )
    parser.add_argument(
        "--rounds",
        type=_count,
        default=5,
        metavar="N",
        help="turns of the loop's sleep and of cyclictest, alternating (default: 5)",
    )
    parser.add_argument(
        "--load",
        type=_kinds,
        default=(),
        metavar="KINDS",
        help=f"load the host meanwhile, any of {','.join(KINDS)}, or all",
    )
    parser.add_argument("--json", action="store_true", help="machine-readable")


def _positive(text: str) -> float:
    value = float(text)
    if not 0.0 < value <= 86_400.0:
        raise argparse.ArgumentTypeError(f"{text} is not above 0 and at most 86400")
    return value


def _count(text: str) -> int:
    value = int(text)
    if not 1 <= value <= 1000:
        raise argparse.ArgumentTypeError(f"{text} is not from 1 to 1000")
    return value


def _kinds(text: str) -> tuple[str, ...]:
    kinds = tuple(KINDS) if text == "all" else tuple(dict.fromkeys(text.split(",")))
    if unknown := [kind for kind in kinds if kind not in KINDS]:
        raise argparse.ArgumentTypeError(
            f"{unknown[0]!r} is no load; choose from {','.join(KINDS)}, or all"
        )
    return kinds


def run(options: argparse.Namespace) -> int:
    """Measure and print; 1 if a verdict is `fail`."""
    latency = measure(
        configuration(options).loop,
        seconds=options.seconds,
        rounds=options.rounds,
        load=options.load,
        progress=_progress if sys.stderr.isatty() else None,
    )
    if options.json:
        print(json.dumps(latency.as_json(), indent=2))
    else:
        print("\n".join(_lines(latency)))
    return 1 if any(verdict.level == "fail" for verdict in latency.verdicts()) else 0


def _progress(number: int, side: str) -> None:
    print(f"\rround {number + 1}: {side:12}", end="", file=sys.stderr, flush=True)


def _lines(latency: Latency) -> list[str]:
    host = latency.host
    lines = [
        f"host      {host['kernel']}",
        f"machine   {host['machine']}, {host['cores']} cores, {host['kind']}",
        f"thread    {latency.granted.scheduler}; load: {', '.join(latency.load) or 'none'}",
        *(f"missing   {missing}" for missing in latency.granted.missing),
        "",
        f"{'wake-up lateness [us]':24}{'cycles':>9}"
        + "".join(f"{name:>9}" for name in QUANTILE_NAMES),
    ]
    lines += [_row(latency, side) for side in latency.turns]
    lines += [*_ratio_lines(latency), ""]
    for verdict in latency.verdicts():
        lines.append(f"{verdict.level.upper():4}  {verdict.source:8}  {verdict.text}")
        lines.append(f"                ({VERDICT_SOURCES[verdict.source]})")
    return lines


def _row(latency: Latency, side: str) -> str:
    total = latency.total(side)
    values = total.lateness.summary_us()
    shown = "".join(f"{values[name]:9.1f}" for name in QUANTILE_NAMES)
    return f"{side:24}{total.cycles:9}{shown}"


def _ratio_lines(latency: Latency) -> list[str]:
    ratios = latency.ratios()
    if not ratios:
        return ["cyclictest is not installed (Debian: rt-tests); no ratios"]
    title = f"{OURS} / {THEIRS}"
    lines = [f"{title:33}" + "".join(f"{value:9.2f}" for value in ratios.values())]
    for number, turn in enumerate(latency.turn_ratios(), start=1):
        name = f"  round {number}"
        lines.append(f"{name:33}" + "".join(f"{value:9.2f}" for value in turn.values()))
    return lines
