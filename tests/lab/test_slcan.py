"""Our slcan against the kernel's and can-utils': slcand on our adapter, our master on slcanpty."""

import threading
import time
from contextlib import ExitStack
from itertools import count
from pathlib import Path

import pytest

from drivers.bus import open_bus
from drivers.buses.socketcan import SocketCanBus
from drivers.frame import EFF_FLAG, RTR_FLAG, pack_frame
from sim_backend.slcan_wire import SlcanPty
from tests.hil.lab import wait_until
from tests.lab.conftest import Tool, ip

pytestmark = [pytest.mark.kernel_can, pytest.mark.kernel_slcan]
WAIT_S = 5.0
TERMINALS = Path("/dev/pts")
FRAMES = [
    pack_frame(0x080),
    pack_frame(0x181, bytes(range(8))),
    pack_frame(0x7FF, b"\xff"),
    pack_frame(0x1234_5678 | EFF_FLAG, b"\x01\x02"),
    pack_frame(0x701 | RTR_FLAG),
]
_numbers = count(1)


class Adapter:
    """Our emulated serial adapter, served by a thread; `heard` is what the host has sent."""

    def __init__(self):
        self.wire = SlcanPty()
        self.heard = []
        self._is_ended = threading.Event()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self):
        while not self._is_ended.is_set():
            self.heard += self.wire.wait(0.005)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._is_ended.set()
        self._thread.join()
        self.wire.close()


@pytest.fixture
def stack(own_vcan):
    """What a test has opened, closed in the opposite order."""
    if own_vcan is None:
        pytest.skip("not allowed to make a CAN interface")
    with ExitStack() as stack:
        yield stack


def test_slcand__on_our_adapter__kernel_interface_exchanges_frames(stack, tmp_path):
    adapter = stack.enter_context(Adapter())
    name = f"slhil{next(_numbers)}"
    command = ["slcand", "-F", "-o", "-c", "-s8", adapter.wire.name, name]
    slcand = stack.enter_context(Tool(tmp_path / "slcand", command))
    flags = Path(f"/sys/class/net/{name}/flags")
    wait_until(flags.exists, what=f"the interface; slcand says {slcand.text!r}")
    ip("link", "set", name, "up")
    kernel = stack.enter_context(SocketCanBus(name))

    for frame in FRAMES:
        assert kernel.send(frame)
        time.sleep(0.01)  # the kernel's slcan takes one frame at a time
    wait_until(lambda: len(adapter.heard) >= len(FRAMES), what="frames at the adapter")
    assert adapter.heard == FRAMES

    for frame in FRAMES:
        adapter.wire.transmit(frame)
    assert [kernel.recv(WAIT_S) for _ in FRAMES] == FRAMES
    assert kernel.stats.error_frames == 0


def test_slcanpty__as_our_adapter__our_bus_exchanges_frames_with_the_kernel(
    stack, own_vcan, tmp_path
):
    before = set(TERMINALS.iterdir())
    tool = stack.enter_context(Tool(tmp_path / "slcanpty", ["slcanpty", "/dev/ptmx", own_vcan]))
    made = wait_until(lambda: set(TERMINALS.iterdir()) - before, what=f"the pty; {tool.text!r}")
    ours = stack.enter_context(open_bus(f"slcan:{made.pop()}@1000000"))
    kernel = stack.enter_context(SocketCanBus(own_vcan))
    for frame in FRAMES:
        assert ours.send(frame)
        assert kernel.recv(WAIT_S) == frame
    for frame in FRAMES:
        assert kernel.send(frame)
        assert ours.recv(WAIT_S) == frame
    assert ours.stats.malformed_records == 0
