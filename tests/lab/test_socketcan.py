"""SocketCAN as the kernel has it: filters, overflow, time stamps, an interface that comes back."""

import socket
import subprocess
import time

import can
import pytest

from drivers.arm_bus import ArmBus
from drivers.buses.socketcan import SocketCanBus
from drivers.errors import BusDownError, BusError
from drivers.frame import EFF_FLAG, ERR_FLAG, pack_frame, unpack_frame
from drivers.registry import make_axes
from hil.config import load_config
from hil.emulation import build_emulator
from sim_backend.hub import BusWire
from sim_backend.server import EmulatorServer
from tests.lab.conftest import ip

WAIT_S = 5.0
MARK = pack_frame(0x081)  # EMCY of node 1: an arm's bus takes it


def everything(bus):
    """Frames at hand, once nothing more comes for a moment."""
    return list(iter(lambda: bus.recv(0.05), None))


@pytest.fixture
def pair(own_vcan):
    with SocketCanBus(own_vcan) as near, SocketCanBus(own_vcan) as far:
        yield near, far


@pytest.fixture
def arm(own_vcan):
    """An arm's bus and the server of its emulated drives, one thread serving both."""
    config = load_config(None)
    wire = BusWire(SocketCanBus(own_vcan))
    emulator = build_emulator(config, wire.transmit, is_lockstep=True)
    server = EmulatorServer(emulator, wire, config.emulator)
    emulator.power_on()

    class Served(SocketCanBus):
        """Its wait lets the drives work: no second thread, no second process."""

        def recv(self, timeout_s):
            server.serve(0.0)
            return super().recv(timeout_s)

    axes = make_axes(config.axes, period_s=config.loop.period_s)
    arm = ArmBus(Served(own_vcan), axes, now_ns=time.monotonic_ns)
    arm.configure(heartbeat_cycles=0)
    yield arm
    arm.close()
    wire.close()


def cycle(arm, torques=(0.0, 0.0)):
    arm.request_feedback()
    is_fresh = arm.collect(time.monotonic_ns() + 1_000_000_000)
    arm.send_torques(torques)
    return is_fresh


# --- filters


def test_arm__configured__kernel_passes_only_what_the_arm_needs(arm, own_vcan):
    foreign = [0x000, 0x123, 0x182 | EFF_FLAG, 0x581, 0x601, 0x7FF]
    ours = [0x081, 0x082, 0x080]  # EMCY of both drives; another master's SYNC
    assert cycle(arm)
    with SocketCanBus(own_vcan) as other:
        arm._drain()
        before = arm.stats.frames_received
        for can_id in (*foreign, *ours):
            other.send(pack_frame(can_id, bytes(8)))
        other.send(pack_frame(ERR_FLAG | 0x40, bytes(8)))
        frames = everything(arm._bus)
    can_ids = [unpack_frame(frame)[0] for frame in frames]
    assert [i for i in can_ids if i not in (0x181, 0x182)] == [*ours, ERR_FLAG | 0x40]
    assert arm.stats.frames_received - before == len(frames) - 1
    assert arm.stats.error_frames == 1


def test_arm__cycles_on_the_kernel_bus__feedback_is_fresh_every_time(arm):
    assert all(cycle(arm) for _ in range(200))
    assert arm.unknown_frames == arm.late_frames == arm.stats.receive_overflows == 0
    assert arm.stats.frames_received >= 400


def test_accept__more_identifiers_than_the_kernel_takes__all_frames_come(pair):
    near, far = pair
    near.accept([0x100])
    near.accept(range(513))
    far.send(pack_frame(0x700))
    assert near.recv(WAIT_S) == pack_frame(0x700)


def test_accept__none__lifts_the_filters(pair):
    near, far = pair
    near.accept([0x100])
    far.send(pack_frame(0x200))
    far.send(pack_frame(0x100))
    assert near.recv(WAIT_S) == pack_frame(0x100)
    near.accept(None)
    far.send(pack_frame(0x200))
    assert near.recv(WAIT_S) == pack_frame(0x200)


# --- error reports, overflow, time stamps


@pytest.mark.parametrize("bit", range(10))
def test_error_reports__of_every_class__are_subscribed(pair, bit):
    near, far = pair
    near.accept([])
    far.send(pack_frame(ERR_FLAG | 1 << bit, bytes(8)))  # CAN_ERR_TX_TIMEOUT .. CAN_ERR_CNT
    assert unpack_frame(near.recv(WAIT_S))[0] == ERR_FLAG | 1 << bit
    assert (near.stats.error_frames, near.stats.frames_received) == (1, 0)


def test_overflows__counted__as_many_as_the_kernel_attaches_to_a_frame(pair):
    near, far = pair
    near._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 100 * 1024)
    near._socket.setsockopt(socket.SOL_SOCKET, 40, 1)  # SO_RXQ_OVFL
    for i in range(3000):
        assert far.send(pack_frame(i & 0x7FF))
    kept = len(everything(near))
    far.send(MARK)
    record, notes, _, _ = near._socket.recvmsg(16, 64)
    drops = next(int.from_bytes(data, "little") for _, kind, data in notes if kind == 40)
    near._count_overflows()
    assert record == MARK
    assert near.stats.receive_overflows == drops == 3000 - kept > 0


def test_arrival_ns__frames_received__between_sending_and_reading(pair):
    near, far = pair
    assert near.arrival_ns() is None  # and from now on the kernel takes notes
    last_ns = 0
    for _ in range(3):
        before_ns = time.time_ns()
        far.send(MARK)
        sent_ns = time.time_ns()
        time.sleep(0.005)
        assert near.recv(WAIT_S) == MARK
        assert before_ns - 100_000 <= near.arrival_ns() <= sent_ns + 1_000_000
        assert near.arrival_ns() > last_ns
        last_ns = near.arrival_ns()
    near.close()
    assert near.arrival_ns() is None


# --- an interface that goes and comes


def test_interface__down_and_up__the_same_bus_works_again(pair, own_vcan):
    near, far = pair
    ip("link", "set", own_vcan, "down")
    with pytest.raises(BusDownError, match=rf"is down; `ip link set {own_vcan} up`"):
        near.recv(WAIT_S)
    assert near.recv(0.01) is None  # the kernel says it once
    for _ in range(2):
        with pytest.raises(BusDownError, match="is down"):
            near.send(MARK)
    ip("link", "set", own_vcan, "up")
    with pytest.raises(BusDownError):
        far.recv(0.0)  # has not been told yet
    assert near.send(MARK)
    assert far.recv(WAIT_S) == MARK


def test_interface__deleted__is_gone_for_good(pair, own_vcan):
    near, _ = pair
    ip("link", "delete", own_vcan)
    errors = []
    for _ in range(2):  # down first, as the kernel takes it apart
        with pytest.raises(BusError) as caught:
            near.send(MARK)
        errors.append(caught.value)
    assert not isinstance(errors[-1], BusDownError)


def test_emulator__interface_down_and_up__goes_on(own_vcan):
    with BusWire(SocketCanBus(own_vcan)) as wire, SocketCanBus(own_vcan) as other:
        ip("link", "set", own_vcan, "down")
        assert wire.wait(0.01) == []
        wire.transmit(MARK)
        ip("link", "set", own_vcan, "up")
        with pytest.raises(BusDownError):
            other.recv(0.0)
        other.send(MARK)
        assert wire.wait(WAIT_S) == [MARK]
        wire.transmit(MARK)
        assert other.recv(WAIT_S) == MARK


# --- the other interfaces of the lab


def test_vxcan__two_interfaces__are_one_wire(own_vcan):
    a, b = f"{own_vcan}a", f"{own_vcan}b"
    ip("link", "add", "dev", a, "type", "vxcan", "peer", "name", b)
    try:
        ip("link", "set", a, "up")
        ip("link", "set", b, "up")
        with SocketCanBus(a) as left, SocketCanBus(b) as right:
            left.send(pack_frame(1, b"\x01"))
            assert right.recv(WAIT_S) == pack_frame(1, b"\x01")
            right.send(pack_frame(2))
            assert left.recv(WAIT_S) == pack_frame(2)
    finally:
        ip("link", "delete", a)


def test_vcan__two_interfaces__are_two_wires(own_vcan):
    other = f"{own_vcan}x"
    ip("link", "add", "dev", other, "type", "vcan")
    try:
        ip("link", "set", other, "up")
        with SocketCanBus(own_vcan) as here, SocketCanBus(other) as there:
            here.send(MARK)
            assert there.recv(0.05) is None
    finally:
        ip("link", "delete", other)


# --- others on the bus


def test_python_can__its_own_socketcan_interface__exchanges_frames_with_ours(own_vcan):
    with SocketCanBus(own_vcan) as ours, can.Bus(own_vcan, "socketcan") as theirs:
        ours.send(pack_frame(0x1234_5678 | EFF_FLAG, b"\x01\x02"))
        message = theirs.recv(WAIT_S)
        assert (message.arbitration_id, message.is_extended_id) == (0x1234_5678, True)
        assert bytes(message.data) == b"\x01\x02"
        theirs.send(can.Message(arbitration_id=0x181, is_extended_id=False, data=b"\x07"))
        frame = ours.recv(WAIT_S)  # python-can writes the length into a padding byte too
        assert unpack_frame(frame) == (0x181, b"\x07")


def test_candump_and_cansend__frames_of_each_kind__agree_on_every_byte(can_lab):
    with (
        SocketCanBus(can_lab.interface) as ours,
        can_lab.tool("candump", "-L", can_lab.interface) as dump,
    ):
        lines = ["080#", "181#0102030405060708", "12345678#FF", "701#R", "7FF#00"]

        def is_listening():
            ours.send(pack_frame(0x555))
            return "555#" in dump.text

        deadline_s = time.monotonic() + WAIT_S
        while not is_listening():
            assert time.monotonic() < deadline_s
            time.sleep(0.05)
        for line in lines:
            subprocess.run(["cansend", can_lab.interface, line], check=True)
        frames = [ours.recv(WAIT_S) for _ in lines]
        for frame in frames:  # back to candump, byte by byte the same
            ours.send(frame)
        dump.wait_for("7FF#00", WAIT_S)
        ours.send(pack_frame(0x556))
        dump.wait_for("556#", WAIT_S)
        seen = [line.split()[-1] for line in dump.text.splitlines() if "55" not in line.split()[-1]]
    assert seen == lines + lines
