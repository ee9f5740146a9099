"""The python-can plugin against a real hub: in this process, and as python-can's tools see it."""

import asyncio
import os
import re
import signal
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import islice
from pathlib import Path

import can
import pytest

from drivers.buses.unix import UnixBus
from drivers.can_plugin import HilUnixBus
from drivers.frame import EFF_FLAG, RTR_FLAG, pack_fd_frame, pack_frame
from sim_backend.hub import UnixHub

WAIT_S = 5.0
ROOT = Path(__file__).parents[2]


FD_FRAME = pack_fd_frame(0x8001 | EFF_FLAG, bytes(range(12)))
FD_MESSAGE = can.Message(
    arbitration_id=0x8001, is_fd=True, bitrate_switch=True, data=bytes(range(12))
)


@pytest.fixture
def hub(socket_path):
    with UnixHub(socket_path) as hub:
        yield hub


@pytest.fixture
def bus(hub, socket_path):
    with HilUnixBus(socket_path) as bus:
        hub.wait(0.0)
        yield bus


@pytest.fixture
def tool_environment(tmp_path):
    """An environment in which the project's entry points are installed, straight from pyproject."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    entries = project["entry-points"]["can.interface"].items()
    info = tmp_path / "hil_under_test-0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: hil-under-test\nVersion: 0\n")
    lines = [f"{name} = {target}\n" for name, target in entries]
    (info / "entry_points.txt").write_text("[can.interface]\n" + "".join(lines))
    return {**os.environ, "PYTHONPATH": f"{tmp_path}{os.pathsep}{ROOT}", "PYTHONUNBUFFERED": "1"}


# --- the bus


def test_plugin__data_message_sent__is_a_record_on_the_wire(hub, bus):
    bus.send(can.Message(arbitration_id=0x201, is_extended_id=False, data=b"\x0f\x00"))
    bus.send(can.Message(arbitration_id=0x201, data=b"\x0f\x00"))  # python-can's default: 29 bits
    bus.send(can.Message(arbitration_id=0x701, is_extended_id=False, is_remote_frame=True, dlc=1))
    frames = [hub.wait(WAIT_S)[0] for _ in range(3)]
    assert frames[0] == pack_frame(0x201, b"\x0f\x00")
    assert frames[1] == pack_frame(0x201 | EFF_FLAG, b"\x0f\x00")
    assert frames[2] == pack_frame(0x701 | RTR_FLAG, b"\x00")


def test_plugin__record_received__is_a_message_with_time_and_channel(hub, bus, socket_path):
    hub.transmit(pack_frame(0x181, b"\x37\x02"))
    message = bus.recv(WAIT_S)
    assert message.equals(
        can.Message(arbitration_id=0x181, is_extended_id=False, data=b"\x37\x02"),
        timestamp_delta=None,
        check_channel=False,
    )
    assert message.channel == socket_path
    assert message.timestamp > 1e9, "seconds since the epoch"
    assert bus.recv(0) is None


def test_plugin__recv_without_time_out__waits_for_a_frame(hub, bus):
    hub.transmit(pack_frame(1))
    assert bus.recv().arbitration_id == 1


def test_plugin__filters__apply(hub, bus):
    bus.set_filters([{"can_id": 0x181, "can_mask": 0x7FF, "extended": False}])
    for can_id in (0x182, 0x181 | EFF_FLAG, 0x181):
        hub.transmit(pack_frame(can_id))
    message = bus.recv(WAIT_S)
    assert (message.arbitration_id, message.is_extended_id) == (0x181, False)
    assert bus.recv(0) is None


@pytest.mark.parametrize(
    "message",
    [
        can.Message(arbitration_id=1, data=bytes(12)),
        can.Message(arbitration_id=0x800, is_extended_id=False),
    ],
)
def test_plugin__no_frame__is_refused_and_not_sent(hub, bus, message):
    with pytest.raises(can.CanOperationError, match="not a CAN frame"):
        bus.send(message)
    assert hub.wait(0.0) == []


def test_plugin__can_fd_without_fd__is_refused_and_does_not_come(hub, bus):
    assert bus.protocol is can.CanProtocol.CAN_20
    with pytest.raises(can.CanOperationError, match="opened without fd=True"):
        bus.send(FD_MESSAGE)
    assert hub.wait(0.0) == []
    hub.transmit(FD_FRAME)
    assert bus.recv(0.01) is None
    hub.transmit(FD_FRAME)
    hub.transmit(pack_frame(1))
    assert bus.recv(WAIT_S).arbitration_id == 1


def test_plugin__can_fd__passes_both_ways(hub, socket_path):
    with HilUnixBus(socket_path, fd=True) as bus:
        hub.wait(0.0)
        assert bus.protocol is can.CanProtocol.CAN_FD
        bus.send(FD_MESSAGE)
        assert hub.wait(WAIT_S) == [FD_FRAME]
        hub.transmit(FD_FRAME)
        assert bus.recv(WAIT_S).equals(FD_MESSAGE, timestamp_delta=None, check_channel=False)


def test_plugin__emulator_does_not_read__times_out_then_recovers(hub, bus):
    message = can.Message(arbitration_id=1, is_extended_id=False)
    with suppress(can.CanTimeoutError):
        while True:
            bus.send(message, timeout=0.0)
    with pytest.raises(can.CanTimeoutError, match="does not read: message not sent"):
        bus.send(message, timeout=0.01)
    while hub.wait(0.0):
        pass
    bus.send(message, timeout=0.0)
    assert hub.wait(WAIT_S) == [pack_frame(1)]


def test_plugin__emulator_gone__raises_python_cans_error_and_shows_the_state(hub, bus):
    assert bus.state is can.BusState.ACTIVE
    hub.close()
    with pytest.raises(can.CanOperationError, match="gone: the emulator has closed it"):
        bus.recv(WAIT_S)
    with pytest.raises(can.CanOperationError, match="gone"):
        bus.send(can.Message(arbitration_id=1))
    assert bus.state is can.BusState.ERROR


def test_plugin__no_emulator__raises_python_cans_error(socket_path):
    with pytest.raises(can.CanInitializationError, match="start `hil emulate` first"):
        HilUnixBus(socket_path)


def test_plugin__option_it_cannot_honour__is_refused(hub, socket_path):
    with pytest.raises(can.CanInitializationError, match="receive_own_messages"):
        HilUnixBus(socket_path, receive_own_messages=True)


def test_plugin__shut_down_twice__is_closed(hub, socket_path):
    bus = HilUnixBus(socket_path)
    bus.shutdown()
    bus.shutdown()
    assert bus.fileno() == -1
    with pytest.raises(can.CanOperationError, match="closed"):
        bus.recv(0)


# --- python-can's own machinery


def test_notifier__in_a_thread__hands_over_every_frame_in_order(hub, bus):
    reader = can.BufferedReader()
    with can.Notifier(bus, [reader], timeout=0.1):
        for i in range(200):
            hub.transmit(pack_frame(i))
        received = [reader.get_message(WAIT_S).arbitration_id for _ in range(200)]
    assert received == list(range(200))


def test_notifier__in_asyncio__descriptor_tells_of_every_frame(hub, bus):
    """A plugin that read ahead would leave frames behind that no descriptor tells of."""

    async def read(number: int) -> list[int]:
        reader = can.AsyncBufferedReader()
        with can.Notifier(bus, [reader], loop=asyncio.get_running_loop()):
            for i in range(number):
                hub.transmit(pack_frame(i))
            return [
                (await asyncio.wait_for(reader.get_message(), WAIT_S)).arbitration_id
                for _ in range(number)
            ]

    assert asyncio.run(read(50)) == list(range(50))


@contextmanager
def running(*command: str, env: dict[str, str]) -> Iterator[subprocess.Popen[str]]:
    with subprocess.Popen(
        [sys.executable, *command], env=env, stdout=subprocess.PIPE, text=True
    ) as child:
        try:
            yield child
        finally:
            child.kill()


def test_can_bus__by_interface_name_in_another_process__exchanges_frames(
    hub, socket_path, tool_environment
):
    script = (
        "import can, sys\n"
        "with can.Bus(interface='hil-unix', channel=sys.argv[1]) as bus:\n"
        "    bus.send(can.Message(arbitration_id=0x601, is_extended_id=False, data=b'ping'))\n"
        "    answer = bus.recv(20)\n"
        "    print(type(bus).__name__, hex(answer.arbitration_id), answer.data.decode())\n"
    )
    with running("-c", script, socket_path, env=tool_environment) as child:
        assert hub.wait(20.0) == [pack_frame(0x601, b"ping")]
        hub.transmit(pack_frame(0x581, b"pong"))
        assert child.communicate(timeout=20)[0] == "HilUnixBus 0x581 pong\n"
    assert child.returncode == 0


def test_python_can_bus__over_the_plugin__counts_a_full_queue(hub, socket_path, tool_environment):
    script = (
        "import sys\n"
        "from drivers.bus import open_bus\n"
        "with open_bus('python-can:hil-unix:' + sys.argv[1]) as bus:\n"
        "    while bus.send(bytes(16)):\n"
        "        pass\n"
        "    print(bus.stats.frames_sent > 100, bus.stats.send_failures, bus.fileno() > 0)\n"
    )
    with running("-c", script, socket_path, env=tool_environment) as child:
        assert child.communicate(timeout=20)[0] == "True 1 True\n"


def test_can_logger__attached_to_the_hub__prints_all_traffic(hub, socket_path, tool_environment):
    """The emulator's frames and another client's, each once and in order."""
    expected = []
    arguments = ("-m", "can.logger", "-i", "hil-unix", "-c", socket_path)
    with running(*arguments, env=tool_environment) as logger, UnixBus(socket_path) as master:
        while len(hub.clients) < 2:
            assert logger.poll() is None
            hub.wait(0.05)
        for i in range(100):
            master.send(pack_frame(0x200 + i, b"\xab"))
            assert hub.wait(WAIT_S) == [pack_frame(0x200 + i, b"\xab")]
            hub.transmit(pack_frame(0x300 + i))
            expected += [(f"{0x200 + i:03x}", "1"), (f"{0x300 + i:03x}", "0")]
        found = (re.search(r"ID: +(\w+) +S Rx +DL: +(\d)", line) for line in logger.stdout)
        seen = list(islice((match.groups() for match in found if match), 200))
        logger.send_signal(signal.SIGINT)
        logger.wait(20)
    assert seen == expected
