"""Our CiA 402 exchange against the `canopen` library's, with the same emulator process.

An exchange is: SYNC, two TPDO1 read (statusword, position, torque), two RPDO1 sent (controlword,
target torque), both drives enabled in cyclic synchronous torque. The clients take turns on the
bus, one connected at a time, so that neither pays for frames relayed to the other. Begun every
2 ms, an exchange finds the emulator idle, as in a control loop; back to back, caches are warm.

`canopen` is measured as it is meant to be used (`Network.connect`, a notifier thread that feeds
`BaseNode402`), and once more without its thread, the frames being fed to it in the caller's.
"""

import logging
from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import partial
from threading import Event
from time import monotonic, perf_counter_ns, process_time_ns, sleep

import can
import canopen
from canopen.profiles.p402 import BaseNode402

from benchmarks import rig
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
from drivers.arm_bus import ArmBus
from drivers.axis import AxisStatus
from drivers.bus import open_bus
from drivers.cia402 import codec
from drivers.cia402.codec import Index
from drivers.registry import make_axes
from hil.config import Config
from hil.realtime import Sleeper, now_ns
from sim_backend.cia402.eds import EDS_PATH

PERIOD_NS = 2_000_000
TURNS = 8
EXCHANGES = 500
WARM_UP = 300
TIMEOUT_S = 1.0
TORQUE_NM = (0.02, -0.01)


class Client(ABC):
    """A master that has set up both drives."""

    @abstractmethod
    def exchange(self) -> None:
        """Run one exchange."""

    @abstractmethod
    def is_enabled(self) -> bool:
        """Both drives are in OPERATION ENABLED."""

    @abstractmethod
    def close(self) -> None:
        """Take power off and leave the bus."""


class Ours(Client):
    """`ArmBus` on the unix bus."""

    def __init__(self, config: Config) -> None:
        self._arm = ArmBus(
            open_bus(config.bus.address),
            make_axes(config.axes, period_s=config.loop.period_s),
            now_ns=now_ns,
        )
        self._arm.configure(heartbeat_cycles=50)
        self._torque = list(TORQUE_NM)
        for axis in self._arm.axes:
            axis.reset_fault()
        for _ in range(20):
            self.exchange()
        for axis in self._arm.axes:
            axis.enable()

    def exchange(self) -> None:
        arm = self._arm
        arm.request_feedback()
        if not arm.collect(now_ns() + 1_000_000_000):
            raise RuntimeError("feedback is missing")
        arm.send_torques(self._torque)

    def is_enabled(self) -> bool:
        return all(axis.status is AxisStatus.ENABLED for axis in self._arm.axes)

    def close(self) -> None:
        for axis in self._arm.axes:
            axis.disable()
        self.exchange()
        self.exchange()
        self._arm.close()


class Canopen(Client):
    """`canopen` as its manual shows it, through the python-can plugin."""

    def __init__(self, config: Config) -> None:
        self._missing: set[int] = set()
        self._has_all = Event()
        self._network = canopen.Network()
        self._network.connect(interface="hil-unix", channel=config.bus.address.partition(":")[2])
        self._nodes = [BaseNode402(axis.node_id, str(EDS_PATH)) for axis in config.axes]
        self._scale = [1000.0 / axis.rated_torque_Nm for axis in config.axes]
        for node in self._nodes:
            self._set_up(node)
        self._network.nmt.state = "OPERATIONAL"
        self._words = [codec.CONTROL_DISABLE_VOLTAGE] * len(self._nodes)
        self.position = [0] * len(self._nodes)

    def _set_up(self, node: BaseNode402) -> None:
        self._network.add_node(node)
        node.nmt.state = "RESET COMMUNICATION"
        _await(lambda: node.nmt.state == "PRE-OPERATIONAL")  # what a boot-up message leads to
        node.nmt.state = "PRE-OPERATIONAL"
        node.sdo[Index.MODE].raw = codec.CST
        node.sdo[Index.PRODUCER_HEARTBEAT].raw = 0
        node.tpdo[2].read()
        node.tpdo[2].enabled = False
        node.tpdo[2].save()
        _map(node.rpdo[1], Index.CONTROLWORD, Index.TARGET_TORQUE)
        _map(node.tpdo[1], Index.STATUSWORD, Index.POSITION_ACTUAL, Index.TORQUE_ACTUAL)
        node.setup_402_state_machine(read_pdos=False)
        node.tpdo[1].add_callback(self._on_tpdo)

    def _on_tpdo(self, pdo: "canopen.pdo.PdoMap") -> None:
        self._missing.discard(pdo.cob_id)
        if not self._missing:
            self._has_all.set()

    def exchange(self) -> None:
        self._missing.update(node.tpdo[1].cob_id for node in self._nodes)
        self._has_all.clear()
        self._network.sync.transmit()
        self._receive()
        for j, node in enumerate(self._nodes):
            values = node.tpdo_values
            self.position[j] = values[Index.POSITION_ACTUAL]
            self._choose_word(j, values[Index.STATUSWORD])
            pointers = node.rpdo_pointers
            pointers[Index.CONTROLWORD].raw = self._words[j]
            pointers[Index.TARGET_TORQUE].raw = round(TORQUE_NM[j] * self._scale[j])
            node.rpdo[1].transmit()

    def _receive(self) -> None:
        if not self._has_all.wait(TIMEOUT_S):
            raise RuntimeError("canopen: feedback is missing")

    def _choose_word(self, j: int, statusword: int) -> None:
        low = statusword & 0x6F
        if low == codec.Cia402State.OPERATION_ENABLED:
            return
        if statusword & 0x08:
            is_edge = self._words[j] == codec.CONTROL_FAULT_RESET
            self._words[j] = 0 if is_edge else codec.CONTROL_FAULT_RESET
        elif low in _POWER_UP:
            self._words[j] = _POWER_UP[low]
        else:
            self._words[j] = codec.CONTROL_SHUTDOWN

    def is_enabled(self) -> bool:
        enabled = codec.Cia402State.OPERATION_ENABLED
        return all(node.tpdo_values[Index.STATUSWORD] & 0x6F == enabled for node in self._nodes)

    def close(self) -> None:
        for node in self._nodes:
            node.rpdo_pointers[Index.CONTROLWORD].raw = codec.CONTROL_DISABLE_VOLTAGE
            node.rpdo[1].transmit()
        self._network.sync.transmit()
        self._network.disconnect()


class CanopenWithoutThread(Canopen):
    """`canopen` with its notifier stopped: the caller reads the bus and passes frames on."""

    def __init__(self, config: Config) -> None:
        super().__init__(config)
        network = self._network
        network.notifier.stop()
        network.notifier = None
        self._read: Callable[[float], can.Message | None] = network.bus.recv

    def _receive(self) -> None:
        notify = self._network.notify
        while self._missing:
            message = self._read(TIMEOUT_S)
            if message is None:
                raise RuntimeError("canopen: feedback is missing")
            notify(message.arbitration_id, message.data, message.timestamp)


_POWER_UP = {
    codec.Cia402State.READY_TO_SWITCH_ON & 0x6F: codec.CONTROL_SWITCH_ON,
    codec.Cia402State.SWITCHED_ON & 0x6F: codec.CONTROL_ENABLE_OPERATION,
}


def _await(is_done: Callable[[], bool]) -> None:
    deadline_s = monotonic() + TIMEOUT_S
    while not is_done():
        if monotonic() > deadline_s:
            raise RuntimeError("canopen: no boot-up message")
        sleep(1e-3)


def _map(pdo: "canopen.pdo.PdoMap", *indices: Index) -> None:
    pdo.read()
    pdo.clear()
    for index in indices:
        pdo.add_variable(int(index))
    pdo.trans_type = 1
    pdo.enabled = True
    pdo.save()


CLIENTS: dict[str, Callable[[Config], Client]] = {
    "ours": Ours,
    "canopen": Canopen,
    "canopen without its thread": CanopenWithoutThread,
}


def run(scale: float) -> list[Target]:
    title("exchange", "SYNC, 2 TPDO read, 2 RPDO sent over the unix bus, drives enabled")
    logging.getLogger("canopen").setLevel(logging.ERROR)
    turns, exchanges = max(3, round(TURNS * scale)), max(100, round(EXCHANGES * scale**0.5))
    targets = []
    with rig.emulator_process() as address:
        config = rig.configuration(address)
        for label, pace in (("every 2 ms", _begin_on_time), ("back to back", now_ns)):
            row(label, "total p50", "total p99", "cpu p50", "cpu p99", "cpu vs ours")
            spent = _take_turns(config, turns, partial(_measure, exchanges=exchanges, begin=pace))
            for name, blocks in spent.items():
                cells = [blocks.over_all(way, p) for way in (TOTAL, CPU) for p in (0.5, 0.99)]
                row(f"  {name}", *map(us, cells), times(_ratio(spent, name, CPU)))
            total = _ratio(spent, "canopen", TOTAL)
            row("  total (emulator's part included), vs ours", times(total))
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
    return spent
