"""What only one bus back-end has: its own failures, limits and remedies."""

import fcntl
import os
import pty
import socket
import struct
import subprocess
import sys
import termios
import threading
import time
import tty
from itertools import count
from pathlib import Path

import can
import pytest
from can.interfaces.virtual import VirtualBus

from drivers.bus import open_bus, split_address
from drivers.buses.loopback import LoopbackBus
from drivers.buses.python_can import PythonCanBus
from drivers.buses.socketcan import SocketCanBus
from drivers.buses.unix import UnixBus
from drivers.errors import BusAddressError, BusError
from drivers.frame import EFF_FLAG, RTR_FLAG, pack_fd_frame, pack_frame, unpack_frame

WAIT_S = 5.0
NETWORK = Path("/sys/class/net")
N_SLCAN = struct.pack("i", 17)  # linux/tty.h
_numbers = count(1)


@pytest.fixture
def channel():
    return f"backends-{next(_numbers)}"


@pytest.fixture
def peer_and_bus(socket_path):
    """A bare listening socket in the hub's place, and a bus connected to it."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
        listener.bind(socket_path)
        listener.listen()
        with UnixBus(socket_path) as bus:
            peer, _ = listener.accept()
            with peer:
                yield peer, bus


@pytest.fixture
def slcan_interface(own_vcan):
    """A CAN interface whose transmitter is stuck: an slcan line discipline nobody reads from."""
    if own_vcan is None:
        pytest.skip("not allowed to make a CAN interface")
    before = set(NETWORK.iterdir())
    master, slave = pty.openpty()
    tty.setraw(slave)
    try:
        fcntl.ioctl(slave, termios.TIOCSETD, N_SLCAN)
        (made,) = set(NETWORK.iterdir()) - before
        subprocess.run(["ip", "link", "set", made.name, "up"], check=True)
        yield made.name
    except OSError as error:
        pytest.skip(f"this kernel has no slcan line discipline: {error.strerror}")
    finally:
        os.close(slave)
        os.close(master)


# --- addresses


@pytest.mark.parametrize(
    ("address", "expected"),
    [
        ("unix:/run/hil/bus", ("unix", "/run/hil/bus")),
        ("vcan0", ("socketcan", "vcan0")),
        ("socketcan:can1", ("socketcan", "can1")),
        ("python-can:pcan:PCAN_USBBUS1@1000000", ("python-can", "pcan:PCAN_USBBUS1@1000000")),
    ],
)
def test_split_address__each_form__is_understood(address, expected):
    assert split_address(address) == expected


@pytest.mark.parametrize("address", ["", "unix:", "canopen:can0", "python-can:virtual"])
def test_open_bus__unusable_address__names_the_forms(address):
    with pytest.raises(BusAddressError, match=r"python-can:INTERFACE:CHANNEL"):
        open_bus(address)


# --- unix


def test_unix__no_socket_file__says_what_to_start(socket_path):
    with pytest.raises(BusError, match=rf"no bus at unix:{socket_path}: .*start `hil emulate`"):
        UnixBus(socket_path)


def test_unix__nobody_listens__says_what_to_start(socket_path):
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as dead:
        dead.bind(socket_path)
    with pytest.raises(BusError, match="refused; start `hil emulate` first"):
        UnixBus(socket_path)


def test_unix__path_too_long__is_a_bus_error():
    with pytest.raises(BusError, match="no bus at unix:"):
        UnixBus("/tmp/" + "x" * 200)


def test_unix__records_of_wrong_size__are_dropped_and_counted(peer_and_bus):
    peer, bus = peer_and_bus
    frame = pack_frame(0x181, b"\x01")
    for record in (b"", b"x", frame[:15], frame + b"x", bytes(71), bytes(73), frame):
        peer.send(record)
    assert bus.recv(WAIT_S) == frame
    assert bus.stats.malformed_records == 6
    assert bus.stats.frames_received == 1


def test_unix__only_wrong_records__time_out_still_holds(peer_and_bus):
    peer, bus = peer_and_bus
    peer.send(b"x")
    began_s = time.monotonic()
    assert bus.recv(0.02) is None
    assert time.monotonic() - began_s >= 0.02
    assert bus.stats.malformed_records == 1


def test_unix__queue_full__frame_is_lost_and_counted(peer_and_bus):
    peer, bus = peer_and_bus
    sent = 0
    while bus.send(pack_frame(sent & 0x7FF, sent.to_bytes(8, "little"))):
        sent += 1
    assert bus.send(pack_frame(1)) is False
    assert (bus.stats.frames_sent, bus.stats.send_failures) == (sent, 2)
    for expected in range(sent):
        assert unpack_frame(peer.recv(16))[1] == expected.to_bytes(8, "little")
    assert bus.send(pack_frame(1)) is True


def test_unix__peer_closed__queued_frames_come_before_the_error(peer_and_bus):
    peer, bus = peer_and_bus
    peer.send(pack_frame(1))
    peer.close()
    assert bus.recv(WAIT_S) == pack_frame(1)
    with pytest.raises(BusError, match="gone: the emulator has closed it"):
        bus.recv(0.0)


def test_unix__closed_while_a_thread_waits__thread_is_woken(peer_and_bus):
    _, bus = peer_and_bus
    errors: list[BusError] = []

    def wait() -> None:
        try:
            bus.recv(60.0)
        except BusError as error:
            errors.append(error)

    thread = threading.Thread(target=wait)
    thread.start()
    while sys._current_frames()[thread.ident].f_code.co_name != "_await":
        pass
    bus.close()
    thread.join(WAIT_S)
    assert not thread.is_alive()
    assert len(errors) == 1


# --- loopback


def test_loopback__nothing_queued__virtual_time_advances_once():
    bus = LoopbackBus()
    waits: list[float] = []

    def advance(timeout_s: float) -> None:
        waits.append(timeout_s)
        if len(waits) == 2:
            bus.deliver(pack_frame(7))

    bus.connect(bus.deliver, advance)
    assert bus.recv(0.001) is None
    assert bus.recv(0.002) == pack_frame(7)
    assert waits == [0.001, 0.002]


def test_loopback__answer_within_send__waits_in_order():
    bus = LoopbackBus()

    def echo_twice(frame: bytes) -> None:
        bus.deliver(frame)
        bus.deliver(pack_frame(2))

    bus.connect(echo_twice)
    bus.send(pack_frame(1))
    assert [bus.recv(0.0), bus.recv(0.0), bus.recv(0.0)] == [pack_frame(1), pack_frame(2), None]


def test_loopback__nobody_connected__frames_vanish():
    bus = LoopbackBus()
    assert bus.send(pack_frame(1)) is True
    assert bus.recv(1.0) is None


# --- python-can


@pytest.mark.parametrize("address", ["virtual", "virtual:", ":channel"])
def test_python_can__half_an_address__names_the_form(address):
    with pytest.raises(BusAddressError, match="python-can:INTERFACE:CHANNEL"):
        PythonCanBus(address)


def test_python_can__unknown_interface__is_a_bus_error():
    with pytest.raises(BusError, match=r"no bus python-can:nosuch:0: .*nosuch"):
        PythonCanBus("nosuch:0")


def test_python_can__adapter_missing__is_a_bus_error():
    with pytest.raises(BusError, match="no bus python-can:slcan:/dev/nosuch"):
        PythonCanBus("slcan:/dev/nosuch@1000000")


def test_python_can__half_a_data_bit_rate__is_part_of_the_channel(channel):
    with PythonCanBus(f"virtual:{channel}@1000000/") as bus, can.Bus(channel, "virtual") as raw:
        bus.send(pack_frame(1))
        assert raw.recv(0.0) is None


def test_python_can__data_bit_rate_in_the_address__opens_the_adapter_for_can_fd(monkeypatch):
    asked: list[dict[str, object]] = []

    class Adapter(VirtualBus):
        def __init__(self, channel: str, **options: object) -> None:
            asked.append(options)
            super().__init__(channel)

    monkeypatch.setattr("can.interface._get_class_for_interface", lambda _: Adapter)
    PythonCanBus("kvaser:0@1000000/5000000").close()
    PythonCanBus("kvaser:0@1000000").close()
    assert (asked[0]["bitrate"], asked[0]["data_bitrate"], asked[0]["fd"]) == (
        1_000_000,
        5_000_000,
        True,
    )
    assert "fd" not in asked[1]


def test_python_can__bit_rate_in_the_address__reaches_the_interface(channel):
    with PythonCanBus(f"virtual:{channel}@1000000") as bus, PythonCanBus(f"virtual:{channel}") as b:
        bus.send(pack_frame(1))
        assert b.recv(WAIT_S) == pack_frame(1)


@pytest.mark.parametrize(
    "message",
    [
        can.Message(arbitration_id=1, is_fd=True, data=bytes(13)),
        can.Message(arbitration_id=0x800, is_extended_id=False, is_fd=True),
        can.Message(arbitration_id=1, is_fd=True, is_remote_frame=True),
        can.Message(arbitration_id=1, is_fd=True, is_error_frame=True),
        can.Message(arbitration_id=1, is_extended_id=False, data=bytes(12)),
        can.Message(arbitration_id=0x800, is_extended_id=False),
        can.Message(arbitration_id=-1),
        can.Message(arbitration_id=1, dlc=9),
    ],
)
def test_python_can__no_frame_received__is_dropped_and_counted(channel, message):
    with PythonCanBus(f"virtual:{channel}") as bus, can.Bus(channel, "virtual") as raw:
        raw.send(message)
        raw.send(can.Message(arbitration_id=5, is_extended_id=False))
        assert bus.recv(WAIT_S) == pack_frame(5)
        assert (bus.stats.malformed_records, bus.stats.frames_received) == (1, 1)


def test_python_can__adapter_fails_in_use__is_a_bus_error(channel):
    with PythonCanBus(f"virtual:{channel}") as bus:
        bus._bus.shutdown()  # as an unplugged adapter does: every call fails from now on
        with pytest.raises(BusError, match="gone: Cannot operate on a closed bus"):
            bus.send(pack_frame(1))
        with pytest.raises(BusError, match="gone: Cannot operate on a closed bus"):
            bus.recv(0.0)


# --- socketcan


def test_socketcan__kernel_without_can__names_the_alternatives():
    try:
        socket.socket(29, socket.SOCK_RAW, 1).close()
    except OSError:
        with pytest.raises(BusError, match=r"kernel has no CAN \(AF_CAN\); use unix:PATH"):
            SocketCanBus("vcan0")
    else:
        pytest.skip("this kernel has CAN")


def test_socketcan__no_such_interface__says_how_to_make_one(vcan):
    with pytest.raises(BusError, match=r"no CAN interface nosuch0; .*ip link add dev vcan0"):
        SocketCanBus("nosuch0")


def test_socketcan__not_a_can_interface__is_refused(vcan):
    with pytest.raises(BusError, match="no CAN interface lo"):
        SocketCanBus("lo")


def test_socketcan__interface_down__says_how_to_raise_it(own_vcan):
    if own_vcan is None:
        pytest.skip("not allowed to make a vcan interface")
    subprocess.run(["ip", "link", "set", own_vcan, "down"], check=True)
    with pytest.raises(BusError, match=f"is down; `ip link set {own_vcan} up`"):
        SocketCanBus(own_vcan)


def test_socketcan__interface_for_classic_frames__tells_and_refuses_can_fd(own_vcan):
    if own_vcan is None:
        pytest.skip("not allowed to make a vcan interface")
    with SocketCanBus(own_vcan) as bus:
        assert bus.carries_fd
    for change in (["down"], ["mtu", "16"], ["up"]):
        subprocess.run(["ip", "link", "set", own_vcan, *change], check=True)
    with SocketCanBus(own_vcan) as bus:
        assert not bus.carries_fd
        with pytest.raises(BusError, match=f"{own_vcan} is not set up for CAN FD frames") as caught:
            bus.send(pack_fd_frame(1, bytes(12)))
        assert "\n" not in str(caught.value)
        assert bus.send(pack_frame(1)) is True


def test_socketcan__interface_removed_in_use__is_a_bus_error(own_vcan):
    if own_vcan is None:
        pytest.skip("not allowed to make a vcan interface")
    with SocketCanBus(own_vcan) as bus:
        subprocess.run(["ip", "link", "delete", own_vcan], check=True)
        for use in (lambda: bus.recv(WAIT_S), lambda: bus.send(pack_frame(1))):
            with pytest.raises(BusError, match=f"socketcan:{own_vcan}"):
                use()


FILTERED = [
    pack_frame(0x181),
    pack_frame(0x182),
    pack_frame(0x181 | RTR_FLAG),
    pack_frame(0x181 | EFF_FLAG),
]
LAST = pack_frame(0x7FF)


@pytest.mark.parametrize(
    ("can_ids", "passed"),
    [
        ([0x181, 0x7FF], [0]),
        ([0x181 | EFF_FLAG, 0x181 | RTR_FLAG, 0x7FF], [2, 3]),
        ([0x7FF], []),
        (None, [0, 1, 2, 3]),
    ],
)
def test_socketcan__filters__pass_exactly_the_named_identifiers(vcan, can_ids, passed):
    with SocketCanBus(vcan) as sender, SocketCanBus(vcan) as bus:
        bus.set_filters([0x123])
        bus.set_filters(can_ids)
        for frame in [*FILTERED, LAST]:
            sender.send(frame)
        received = list(iter(lambda: bus.recv(WAIT_S), LAST))
    assert received == [FILTERED[index] for index in passed]


def test_socketcan__too_many_filters__are_refused(vcan):
    with (
        SocketCanBus(vcan) as bus,
        pytest.raises(BusError, match="513 kernel filters asked for, at most 512"),
    ):
        bus.set_filters(range(513))


def test_socketcan__reader_too_slow__lost_frames_are_counted(vcan):
    with SocketCanBus(vcan) as sender, SocketCanBus(vcan) as bus:
        bus._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 200 * 1024)
        for i in range(5000):
            assert sender.send(pack_frame(i & 0x7FF))
        while bus.recv(0.0) is not None:
            pass
        assert bus.stats.receive_overflows > 0
        assert bus.stats.frames_received + bus.stats.receive_overflows == 5000


@pytest.mark.parametrize("scheme", ["socketcan", "python-can:socketcan"])
def test_socketcan__transmit_queue_full__frame_is_lost_and_counted(slcan_interface, scheme):
    with open_bus(f"{scheme}:{slcan_interface}") as bus:
        sent = 0
        while bus.send(pack_frame(1, bytes(8))):
            sent += 1
            assert sent < 100_000
        assert (bus.stats.frames_sent, bus.stats.send_failures) == (sent, 1)
