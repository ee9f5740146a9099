"""Our CiA 402 exchange against the `canopen` library's, with the same emulator process.

An exchange is: SYNC, two TPDO1 read (statusword, position, torque), two RPDO1 sent (controlword,
target torque), both drives enabled in cyclic synchronous torque. The clients take turns on the
bus, one connected at a time, so that neither pays for frames relayed to the other. Begun every
2 ms, an exchange finds the emulator idle, as in a control loop; back to back, caches are warm.

`canopen` is measured as it is meant to be used (`Network.connect`, a notifier thread that feeds
`BaseNode402`), and once more without its thread, the frames being fed to it in the caller's.
"""

import logging
from collections.abc import Callable
from functools import partial
from time import perf_counter_ns, process_time_ns, sleep

from benchmarks import rig
from benchmarks.masters import BareSocket, Canopen, CanopenWithoutThread, Client, Ours
from benchmarks.measure import (
    Target,
    at_least,
    median,
    percentile,
    row,
    times,
    title,
    us,
    without_garbage_collection,
)
from hil.config import Config
from hil.realtime import Sleeper, now_ns

PERIOD_NS = 2_000_000
TURNS = 8
EXCHANGES = 500
WARM_UP = 300
SETTLE_S = 0.1
"""Until the hub has passed a client's last frames on: the next one is not to see them."""

FLOOR = "bare socket, no protocol"
CLIENTS: dict[str, Callable[[Config], Client]] = {
    "ours": Ours,
    FLOOR: BareSocket,
    "canopen": Canopen,
    "canopen without its thread": CanopenWithoutThread,
}


def run(scale: float) -> list[Target]:
    title("exchange", "SYNC, 2 TPDO read, 2 RPDO sent over the unix bus, drives enabled")
    logging.getLogger("canopen").setLevel(logging.ERROR)
    turns, exchanges = max(3, round(TURNS * scale)), max(100, round(EXCHANGES * scale**0.5))
    targets = []
    with rig.emulator_process(realtime="off") as address:
        config = rig.configuration(address)
        for label, pace in (("every 2 ms", _begin_on_time), ("back to back", now_ns)):
            row(label, "total p50", "total p99", "cpu p50", "cpu p99", "cpu vs ours")
            spent = _take_turns(config, turns, partial(_measure, exchanges=exchanges, begin=pace))
            for name, blocks in spent.items():
                cells = [blocks.over_all(way, p) for way in (TOTAL, CPU) for p in (0.5, 0.99)]
                row(f"  {name}", *map(us, cells), times(_ratio(spent, name, CPU)))
            total = _ratio(spent, "canopen", TOTAL)
            row("  total (emulator's part included), vs ours", times(total))
            above = _ratio(_above_floor(spent), "canopen", CPU)
            row("  cpu above the bare socket's, canopen vs ours", times(above))
            cpu = _ratio(spent, "canopen", CPU)
            targets.append(at_least(f"exchange {label}: canopen over ours, CPU", cpu, 5.0))
    return targets


TOTAL, CPU = 0, 1


class Blocks(list[list[tuple[float, float]]]):
    """Of each turn, (total, CPU) of every exchange in us."""

    def over_all(self, way: int, share: float) -> float:
        return percentile([pair[way] for block in self for pair in block], share)

    def medians(self, way: int) -> list[float]:
        return [median([pair[way] for pair in block]) for block in self]


def _take_turns(
    config: Config, turns: int, measure: Callable[[Client], list[tuple[float, float]]]
) -> dict[str, Blocks]:
    spent = {name: Blocks() for name in CLIENTS}
    for _ in range(turns):
        for name, make in CLIENTS.items():
            spent[name].append(measure(make(config)))
    return spent


def _ratio(spent: dict[str, Blocks], name: str, way: int) -> float:
    pairs = zip(spent[name].medians(way), spent["ours"].medians(way), strict=True)
    return median([theirs / ours for theirs, ours in pairs])


def _above_floor(spent: dict[str, Blocks]) -> dict[str, Blocks]:
    """Take away what the kernel alone costs in the same turn: what is left is the software's."""
    floors = spent[FLOOR].medians(CPU)
    return {
        name: Blocks(
            [(total, cpu - floor) for total, cpu in block]
            for block, floor in zip(blocks, floors, strict=True)
        )
        for name, blocks in spent.items()
    }


_sleeper = Sleeper()


def _begin_on_time() -> None:
    """Sleep until the next whole multiple of 2 ms."""
    _sleeper.until((now_ns() // PERIOD_NS + 1) * PERIOD_NS)


def _measure(
    client: Client, exchanges: int, begin: Callable[[], object]
) -> list[tuple[float, float]]:
    """Return (total, CPU) of every exchange in us; CPU is the whole process's, threads included."""
    spent = []
    try:
        for _ in range(WARM_UP):
            client.exchange()
        if not client.is_enabled():
            raise RuntimeError(f"{type(client).__name__}: the drives are not enabled")
        with without_garbage_collection():
            for _ in range(exchanges):
                begin()
                cpu_ns, wall_ns = process_time_ns(), perf_counter_ns()
                client.exchange()
                total_ns = perf_counter_ns() - wall_ns
                spent.append((total_ns * 1e-3, (process_time_ns() - cpu_ns) * 1e-3))
    finally:
        client.close()
        sleep(SETTLE_S)
    return spent
