"""`hil watch`: follow a running daemon; count its telemetry."""

import argparse
import json
import signal
from math import inf
from time import monotonic, sleep
from typing import Any

from hil.cli.options import add_connection, endpoints
from hil.client import Client
from hil.fixed_protobuf import Records
from hil.timing import missed_text, timing_lines


class Counter:
    """Counts samples by their sequence numbers."""

    def __init__(self) -> None:
        self.received = 0
        self.lost = 0
        self.first = -1
        self.last = -1

    def take(self, rows: Records) -> None:
        """Count one batch."""
        for seq in rows["seq"].tolist():
            if self.last < 0:
                self.first = seq
            elif seq > self.last:
                self.lost += seq - self.last - 1
            self.last = seq  # a lower one is the first we get of a new daemon
        self.received += len(rows)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the verb's options."""
    add_connection(parser)
    parser.add_argument(
        "--count", action="store_true", help="only count telemetry; JSON at the end"
    )
    parser.add_argument(
        "--timing", action="store_true", help="with every status: the loop's times, misses, usage"
    )
    parser.add_argument("--for", type=float, dest="duration_s", metavar="S", help="end after this")


def run(options: argparse.Namespace) -> int:
    """Follow until SIGINT, SIGTERM or the given time."""
    signals: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda signum, _: signals.append(signum))
    counter = Counter()
    with Client(options.arm, endpoints(options)) as client:
        client.on_telemetry(counter.take)
        if options.count:
            print("counting", flush=True)
        else:
            client.on_status(_print_timing if options.timing else _print_status)
            client.on_event(_print_event)
        deadline_s = monotonic() + (inf if options.duration_s is None else options.duration_s)
        while not signals and monotonic() < deadline_s:
            sleep(0.02)
    if options.count:
        print(json.dumps(vars(counter)))
    else:
        print(f"telemetry: {counter.received} samples received, {counter.lost} lost")
    return 0


def _print_status(status: dict[str, Any]) -> None:
    late, busy = status.get("wake_late_us", {}), status.get("busy_us", {})
    print(
        f"{status.get('state', '?'):8} cycle {status.get('cycle', 0):>9}  "
        f"skipped {status.get('overruns', 0)}  "
        f"late p99 {late.get('p99', 0):.0f} us max {late.get('max', 0):.0f} us  "
        f"busy p99 {busy.get('p99', 0):.0f} us  "
        f"missed: {missed_text(status.get('misses', {}))}  {status.get('scheduler', '')}",
        flush=True,
    )


def _print_timing(status: dict[str, Any]) -> None:
    _print_status(status)
    for line in timing_lines(status.get("timing", {})):
        print(f"    {line}")
    ladder = ", ".join(f"{count} {name}" for name, count in status.get("ladder", {}).items())
    names = ("minor_faults", "major_faults", "involuntary_switches", "resident_kB")
    used = ", ".join(f"{name} {status.get(name, 0)}" for name in names)
    print(f"    feedback ladder (cycles): {ladder}")
    print(f"    loop process: {used}", flush=True)


def _print_event(event: dict[str, Any]) -> None:
    detail = {k: v for k, v in event.items() if k not in ("t_ns", "cycle", "kind")}
    print(f"event    cycle {event['cycle']:>9}  {event['kind']}: {json.dumps(detail)}", flush=True)
