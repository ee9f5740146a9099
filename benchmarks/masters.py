"""Masters that do the same CiA 402 exchange on the same bus: ours, a bare socket, `canopen`."""

import select
from abc import ABC, abstractmethod
from collections.abc import Callable
from threading import Event
from time import monotonic, sleep
from typing import Any

import can
import canopen
from canopen.profiles.p402 import BaseNode402

from drivers.arm_bus import ArmBus
from drivers.axis import AxisStatus
from drivers.bus import open_bus
from drivers.cia402 import codec
from drivers.cia402.codec import Index
from drivers.frame import pack_frame
from drivers.registry import make_axes
from hil.config import Config
from hil.realtime import now_ns
from sim_backend.cia402.eds import EDS_PATH

TIMEOUT_S = 1.0
TPDO1_HIGH_BYTE = codec.COB_TPDO1 >> 8  # in a record of a little-endian host
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


class BareSocket(Ours):
    """What the kernel alone costs: the same frames, prepared, through a socket and nothing else."""

    def __init__(self, config: Config) -> None:
        super().__init__(config)
        while not self.is_enabled():
            super().exchange()
        arm = self._arm
        self._socket = arm._bus._socket  # type: ignore[attr-defined]
        self._sync = pack_frame(codec.COB_SYNC)
        self._heartbeat = arm._heartbeat
        self._commands = [
            axis.command(tau) for axis, tau in zip(arm.axes, self._torque, strict=True)
        ]
        self._count = 0
        self._is_bare = True

    def exchange(self) -> None:
        if not self.__dict__.get("_is_bare"):
            super().exchange()
            return
        endpoint = self._socket
        endpoint.send(self._sync)
        missing = len(self._commands)
        while missing:
            select.select((endpoint,), (), (), TIMEOUT_S)
            missing -= endpoint.recv(17)[1] == TPDO1_HIGH_BYTE
        for frame in self._commands:
            endpoint.send(frame)
        self._count += 1
        if self._count % 50 == 0:
            endpoint.send(self._heartbeat)

    def close(self) -> None:
        self._is_bare = False
        super().close()


class Canopen(Client):
    """`canopen` as its manual shows it, through the python-can plugin."""

    def __init__(self, config: Config) -> None:
        self._missing: set[int] = set()
        self._has_all = Event()
        self._network: Any = canopen.Network()  # typed only in part
        self._network.connect(interface="hil-unix", channel=config.bus.address.partition(":")[2])
        make_node: Any = BaseNode402
        self._nodes = [make_node(axis.node_id, str(EDS_PATH)) for axis in config.axes]
        self._scale = [1000.0 / axis.rated_torque_Nm for axis in config.axes]
        for node in self._nodes:
            self._set_up(node)
        self._network.nmt.state = "OPERATIONAL"
        self._words = [codec.CONTROL_DISABLE_VOLTAGE] * len(self._nodes)
        self.position = [0] * len(self._nodes)

    def _set_up(self, node: Any) -> None:
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
