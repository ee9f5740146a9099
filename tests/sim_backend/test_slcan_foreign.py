"""Conformance: python-can's own slcan interface at the emulated adapter, and canopen over it.

Neither is ours. python-can opens with `C`, `S8`, an empty line, `O`, `O`, and takes no notice of
answers. It needs pyserial.
"""

import threading
from contextlib import contextmanager

import can
import canopen
import pytest
from canopen.profiles.p402 import BaseNode402

from drivers.cia402.codec import Index
from drivers.frame import EFF_FLAG, RTR_FLAG, pack_frame
from sim_backend.arm import Arm
from sim_backend.cia402.eds import EDS_PATH
from sim_backend.cia402.node import Cia402Node, Cia402Settings
from sim_backend.emulator import Emulator
from sim_backend.presets import plant_preset, servo_preset
from sim_backend.server import EmulatorServer
from sim_backend.servo import Servo
from sim_backend.settings import EmulatorSettings
from sim_backend.slcan_wire import SlcanPty

WAIT_S = 5.0
SYNC_PERIOD_S = 0.01
FRAMES = [
    pack_frame(0x080),
    pack_frame(0x181, bytes(range(8))),
    pack_frame(0x7FF, b"\xff"),
    pack_frame(0x1234_5678 | EFF_FLAG, b"\x01\x02"),
    pack_frame(0x701 | RTR_FLAG),
    pack_frame(0x1FFF_FFFF | EFF_FLAG | RTR_FLAG),
]

pytest.importorskip("serial", reason="python-can's slcan needs pyserial")


@contextmanager
def running(serve):
    """Have a thread call `serve` again and again."""
    is_over = threading.Event()

    def run():
        while not is_over.is_set():
            serve()

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        is_over.set()
        thread.join()


@pytest.fixture(params=["pty", "pty,ack"])
def echo(request):
    """An adapter whose wire sends back every frame; with acknowledgements and without."""
    with SlcanPty(request.param) as wire:
        seen = []

        def serve():
            for frame in wire.wait(0.01):
                seen.append(frame)
                wire.transmit(frame)

        wire.seen = seen
        with running(serve):
            yield wire


def open_foreign(wire, **options):
    return can.Bus(
        interface="slcan", channel=wire.name, bitrate=1_000_000, sleep_after_open=0.0, **options
    )


def as_message(frame):
    can_id = int.from_bytes(frame[:4], "little")
    is_remote = bool(can_id & RTR_FLAG)
    return can.Message(
        arbitration_id=can_id & 0x1FFF_FFFF,
        is_extended_id=bool(can_id & EFF_FLAG),
        is_remote_frame=is_remote,
        dlc=frame[4],
        data=None if is_remote else frame[8 : 8 + frame[4]],
    )


def receive(bus):
    """python-can takes an acknowledgement for a message that is none; look for a real one."""
    for _ in range(1000):
        message = bus.recv(0.05)
        if message is not None:
            return message
    pytest.fail("no message")


def test_python_can__frames_of_each_kind__are_sent_and_come_back(echo):
    bus = open_foreign(echo)
    try:
        for frame in FRAMES:
            bus.send(as_message(frame))
            assert receive(bus).equals(as_message(frame), timestamp_delta=None, check_channel=False)
        assert echo.seen == FRAMES
    finally:
        bus.shutdown()


def test_python_can__version_and_serial_number__are_understood(echo):
    bus = open_foreign(echo)
    try:
        assert bus.get_version(WAIT_S) == (10, 13)
        assert bus.get_serial_number(WAIT_S) == "HIL1"
    finally:
        bus.shutdown()


def test_python_can__listen_only__hears_and_is_not_heard(echo):
    bus = open_foreign(echo, listen_only=True)
    try:
        bus.send(as_message(FRAMES[0]))
        assert bus.get_version(WAIT_S) == (10, 13)  # the adapter has seen what was sent before
        assert echo.seen == []
    finally:
        bus.shutdown()


def test_python_can__shut_down_and_opened_again__works(echo):
    for number in range(3):
        bus = open_foreign(echo)
        bus.send(as_message(FRAMES[1]))
        assert receive(bus).arbitration_id == 0x181
        assert len(echo.seen) == number + 1
        bus.shutdown()


@pytest.fixture
def arm():
    """Two drives and their arm behind an adapter, by the wall clock, in a thread."""
    with SlcanPty() as wire:
        wire.servos = [Servo(settings) for settings in servo_preset("bench")]
        settings = Cia402Settings(heartbeat_ms=50)
        nodes = [
            Cia402Node(node_id, servo, wire.transmit, settings)
            for node_id, servo in enumerate(wire.servos, start=1)
        ]
        emulator = Emulator(Arm(plant_preset("bench")), wire.servos, nodes, is_lockstep=False)
        server = EmulatorServer(emulator, wire, EmulatorSettings(time="wall"))
        emulator.power_on()
        with running(lambda: server.serve(0.5e-3)):
            yield wire


def test_canopen__over_python_cans_slcan__brings_a_drive_to_operation_enabled(arm):
    network = canopen.Network()
    network.connect(interface="slcan", channel=arm.name, bitrate=1_000_000, sleep_after_open=0.0)
    drive = BaseNode402(1, str(EDS_PATH))
    try:
        network.add_node(drive)
        assert drive.nmt.wait_for_heartbeat(WAIT_S) == "PRE-OPERATIONAL"
        drive.pdo.read()
        remap(drive.rpdo[1], Index.CONTROLWORD, Index.TARGET_TORQUE)
        remap(drive.tpdo[1], Index.STATUSWORD, Index.POSITION_ACTUAL, Index.TORQUE_ACTUAL)
        drive.setup_402_state_machine()
        drive.nmt.state = "OPERATIONAL"
        network.sync.start(SYNC_PERIOD_S)
        drive.rpdo[1].start(SYNC_PERIOD_S)
        drive.op_mode = "CYCLIC SYNCHRONOUS TORQUE"
        drive.state = "OPERATION ENABLED"
        assert drive.state == "OPERATION ENABLED"
        assert arm.servos[0].is_energised
        drive.rpdo[1][int(Index.TARGET_TORQUE)].raw = 20
        assert 20 in torques(drive)
        assert arm.servos[0].torque_Nm == pytest.approx(0.3, rel=0.05)  # 2 % of 15 Nm
        drive.state = "SWITCHED ON"
        assert not arm.servos[0].is_energised
    finally:
        drive.rpdo[1].stop()
        network.sync.stop()
        network.disconnect()


def remap(pdo, *indices):
    pdo.clear()
    for index in indices:
        pdo.add_variable(int(index))
    pdo.trans_type = 1
    pdo.enabled = True
    pdo.save()


def torques(drive):
    """Torque actual values of the next half second."""
    for _ in range(50):
        assert drive.tpdo[1].wait_for_reception(WAIT_S) is not None
        yield drive.tpdo[1][int(Index.TORQUE_ACTUAL)].raw
