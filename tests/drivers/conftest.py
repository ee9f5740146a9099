"""Wires to test buses on: each back-end's own, and nothing mocked."""

import socket
import subprocess
import tempfile
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import count

import pytest

from drivers.bus import Bus, open_bus
from drivers.buses.loopback import LoopbackBus
from drivers.buses.unix import enlarge_send_queue
from sim_backend.hub import UnixHub
from sim_backend.slcan_wire import SlcanPty

_numbers = count(1)


@dataclass
class Wiring:
    """One wire and how to take part in it."""

    join: Callable[[], Bus]
    """Open one more participant."""
    holds_frames: int
    """Unread frames that certainly fit between two participants."""
    cut: Callable[[], None] | None = None
    """Take the wire away under its participants, where that can happen."""
    report: Callable[[Bus, bytes], object] = lambda bus, frame: bus.send(frame)
    """Have an error report arrive at everybody but this participant, after what it has sent."""


class RunningHub:
    """A hub served by a thread, as the emulator's process would serve it."""

    def __init__(self, path: str) -> None:
        self.hub = UnixHub(path)
        self.address = f"unix:{path}"
        self.frames: list[bytes] = []
        self._is_stopped = threading.Event()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self) -> None:
        while not self._is_stopped.is_set():
            self.frames += self.hub.wait(0.01)

    def stop(self) -> None:
        self._is_stopped.set()
        self._thread.join()
        self.hub.close()


class RunningAdapters:
    """One emulated serial adapter for every participant, all on one wire, served by a thread."""

    def __init__(self) -> None:
        self._wires: list[SlcanPty] = []
        self._reports: list[bytes] = []
        self._is_stopped = threading.Event()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def join(self) -> Bus:
        """Plug in one more adapter, and open it."""
        self._wires.append(SlcanPty())
        return open_bus(self._wires[-1].address)

    def report(self, _: Bus, frame: bytes) -> None:
        """Have all adapters report an error before any frame sent from now on."""
        self._reports.append(frame)

    def _serve(self) -> None:
        while not self._is_stopped.is_set():
            for wire in tuple(self._wires):
                frames = wire.wait(0.001)
                while self._reports:
                    self._relay(self._reports.pop(0), None)
                for frame in frames:
                    self._relay(frame, wire)

    def _relay(self, frame: bytes, source: SlcanPty | None) -> None:
        for wire in tuple(self._wires):
            if wire is not source:
                wire.transmit(frame)

    def stop(self) -> None:
        self._is_stopped.set()
        self._thread.join()
        for wire in self._wires:
            wire.close()


@pytest.fixture
def socket_path() -> Iterator[str]:
    """A path short enough for a Unix socket (107 characters), which pytest's own is not always."""
    with tempfile.TemporaryDirectory(prefix="hil-") as folder:
        yield f"{folder}/bus"


@pytest.fixture
def running_hub(socket_path: str) -> Iterator[RunningHub]:
    running = RunningHub(socket_path)
    yield running
    running.stop()


@pytest.fixture(params=["unix", "loopback", "python-can", "slcan", "socketcan"])
def wiring(request: pytest.FixtureRequest) -> Iterator[Wiring]:
    opened: list[Bus] = []
    made: Wiring = request.getfixturevalue(f"_wiring_{request.param.replace('-', '_')}")
    join = made.join

    def join_and_remember() -> Bus:
        opened.append(join())
        return opened[-1]

    made.join = join_and_remember
    yield made
    for bus in opened:
        bus.close()


@pytest.fixture
def _wiring_unix(running_hub: RunningHub) -> Wiring:
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as probe:
        enlarge_send_queue(probe)
        allowed_bytes = probe.getsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF)
    return Wiring(
        join=lambda: open_bus(running_hub.address),
        holds_frames=allowed_bytes // 1024,
        cut=running_hub.stop,
    )


@pytest.fixture
def _wiring_loopback() -> Wiring:
    left, right = LoopbackBus(), LoopbackBus()
    left.connect(right.deliver)
    right.connect(left.deliver)
    ends = iter((left, right))
    return Wiring(lambda: next(ends), 1_000_000)


@pytest.fixture
def _wiring_python_can() -> Wiring:
    address = f"python-can:virtual:contract-{next(_numbers)}"
    return Wiring(lambda: open_bus(address), 1_000_000)


@pytest.fixture
def _wiring_slcan() -> Iterator[Wiring]:
    adapters = RunningAdapters()
    yield Wiring(adapters.join, 500, cut=adapters.stop, report=adapters.report)
    adapters.stop()


@pytest.fixture
def _wiring_socketcan(own_vcan: str | None, vcan: str) -> Wiring:
    def cut() -> None:
        subprocess.run(["ip", "link", "set", vcan, "down"], check=True)

    return Wiring(lambda: open_bus(f"socketcan:{vcan}"), 1000, cut=cut if own_vcan else None)
