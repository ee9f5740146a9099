"""Conformance: the `canopen` library, which is not ours, drives the emulated arm over the hub.

Everything is real: the Unix socket, the python-can plugin, the emulator with its arm by the wall
clock, the shipped data sheet. Only processes are missing: the emulator runs in a thread.
"""

import queue
import tempfile
import threading

import can
import canopen
import pytest
from canopen.profiles.p402 import BaseNode402

from drivers.can_plugin import HilUnixBus
from drivers.cia402 import codec
from drivers.cia402.codec import EmcyCode, Index
from sim_backend.arm import Arm
from sim_backend.cia402.eds import EDS_PATH
from sim_backend.cia402.node import Cia402Node, Cia402Settings
from sim_backend.emulator import Emulator
from sim_backend.hub import UnixHub
from sim_backend.presets import plant_preset, servo_preset
from sim_backend.server import EmulatorServer
from sim_backend.servo import Servo
from sim_backend.settings import EmulatorSettings

NODE = 1
SYNC_PERIOD_S = 0.01
RPDO_TIMEOUT_MS = 300
WAIT_S = 5.0
CST = "CYCLIC SYNCHRONOUS TORQUE"


class EmulatedArm:
    """Two drives and their arm behind a hub, by the wall clock, in a thread."""

    def __init__(self, path):
        hub = UnixHub(path)
        self.servos = [Servo(settings) for settings in servo_preset("bench")]
        settings = Cia402Settings(heartbeat_ms=50)
        nodes = [
            Cia402Node(node_id, servo, hub.transmit, settings)
            for node_id, servo in enumerate(self.servos, start=NODE)
        ]
        emulator = Emulator(Arm(plant_preset("bench")), self.servos, nodes, is_lockstep=False)
        server = EmulatorServer(emulator, hub, EmulatorSettings(time="wall"))
        self._hub = hub
        self._is_ended = threading.Event()
        self._thread = threading.Thread(target=server.run, args=(self._is_ended.is_set,))
        self._thread.start()

    def close(self):
        self._is_ended.set()
        self._thread.join()
        self._hub.close()


@pytest.fixture
def arm():
    with tempfile.TemporaryDirectory(prefix="hil-") as folder:
        arm = EmulatedArm(f"{folder}/bus")
        arm.path = f"{folder}/bus"
        yield arm
        arm.close()


@pytest.fixture
def network(arm):
    network = canopen.Network()
    if "hil-unix" in can.interfaces.VALID_INTERFACES:  # the project is installed
        network.connect(interface="hil-unix", channel=arm.path)
    else:
        network.bus = HilUnixBus(arm.path)
        network.connect()
    yield network
    network.sync.stop()
    network.disconnect()


@pytest.fixture
def drive(network):
    """The first drive in PRE-OPERATIONAL, its PDOs mapped through canopen, RPDO deadline set."""
    drive = BaseNode402(NODE, str(EDS_PATH))
    for patience in ("RESET_FAULT", "SWITCH_STATE_FINAL", "SWITCH_STATE_SINGLE", "CHECK_TPDO"):
        setattr(drive, f"TIMEOUT_{patience}", WAIT_S)  # the library's tenths suit an idle host
    network.add_node(drive)
    drive.errors = queue.Queue()
    drive.emcy.add_callback(drive.errors.put)
    assert drive.nmt.wait_for_heartbeat(WAIT_S) == "PRE-OPERATIONAL"
    drive.pdo.read()
    remap(drive.rpdo[1], Index.CONTROLWORD, Index.TARGET_TORQUE)
    remap(drive.tpdo[1], Index.STATUSWORD, Index.POSITION_ACTUAL, Index.TORQUE_ACTUAL)
    drive.sdo[Index.RPDO1_PARAMETER][5].raw = RPDO_TIMEOUT_MS
    drive.setup_402_state_machine()
    yield drive
    drive.rpdo[1].stop()


def remap(pdo, *indices):
    pdo.clear()
    for index in indices:
        pdo.add_variable(int(index))
    pdo.trans_type = 1
    pdo.enabled = True
    pdo.save()


@pytest.fixture
def enabled(drive, network):
    drive.nmt.state = "OPERATIONAL"
    network.sync.start(SYNC_PERIOD_S)
    drive.rpdo[1].start(SYNC_PERIOD_S)
    drive.op_mode = CST
    drive.state = "OPERATION ENABLED"
    return drive


def await_feedback(drive, index, is_wanted):
    """Return the first value of a TPDO object that is wanted."""
    values = []
    for _ in range(round(WAIT_S / SYNC_PERIOD_S)):
        assert drive.tpdo[1].wait_for_reception(WAIT_S) is not None
        values.append(drive.tpdo[1][int(index)].raw)
        if is_wanted(values[-1]):
            return values[-1]
    pytest.fail(f"{index:04X} never as wanted, last {values[-5:]}")


def test_canopen__pdo_set_up__reads_back_what_it_wrote(drive):
    drive.pdo.read()
    assert [v.index for v in drive.rpdo[1]] == [Index.CONTROLWORD, Index.TARGET_TORQUE]
    assert [v.index for v in drive.tpdo[1]][2] == Index.TORQUE_ACTUAL
    assert drive.tpdo[1].trans_type == 1
    assert drive.sdo[Index.DEVICE_NAME].raw == "hil emulated drive"
    assert drive.sdo[Index.IDENTITY][2].raw == int.from_bytes(b"HIL1")
    assert drive.op_mode == "NO MODE"
    assert not drive.is_op_mode_supported("PROFILED TORQUE")


def test_canopen__enabled_in_cst__moves_torque_and_the_arm(enabled, arm):
    assert enabled.state == "OPERATION ENABLED"
    assert enabled.op_mode == CST
    start = enabled.tpdo[1][int(Index.POSITION_ACTUAL)].raw
    enabled.rpdo[1][int(Index.TARGET_TORQUE)].raw = 20
    await_feedback(enabled, Index.TORQUE_ACTUAL, lambda torque: torque == 20)
    assert arm.servos[0].torque_Nm == pytest.approx(0.3, rel=0.03)  # 2 % of 15 Nm
    assert arm.servos[1].torque_Nm == 0.0
    moved = await_feedback(
        enabled, Index.POSITION_ACTUAL, lambda counts: 20 < (counts - start) % 4096 < 2048
    )
    assert moved != start
    assert enabled.sdo[Index.TORQUE_ACTUAL].raw == pytest.approx(20, abs=1)
    enabled.state = "SWITCHED ON"
    await_feedback(enabled, Index.TORQUE_ACTUAL, lambda torque: torque == 0)
    assert not arm.servos[0].is_energised


def test_canopen__injected_fault__is_reported_and_can_be_reset(enabled, arm):
    enabled.sdo[Index.INJECT_FAULT].raw = 7
    error = enabled.errors.get(timeout=WAIT_S)
    assert (error.code, error.register) == (EmcyCode.HARDWARE + 7, 0x81)
    await_feedback(enabled, Index.STATUSWORD, lambda word: word & 0x4F == codec.Cia402State.FAULT)
    assert enabled.is_faulted()
    assert not arm.servos[0].is_energised
    enabled.reset_from_fault()
    assert enabled.state == "OPERATION ENABLED"
    assert enabled.errors.get(timeout=WAIT_S).code == EmcyCode.ERROR_RESET
    assert enabled.emcy.active == []
    assert arm.servos[0].is_energised


def test_canopen__rpdos_dropped__faults_the_drive(enabled, arm):
    enabled.rpdo[1][int(Index.TARGET_TORQUE)].raw = 10
    await_feedback(enabled, Index.TORQUE_ACTUAL, lambda torque: torque == 10)
    enabled.rpdo[1].stop()
    assert enabled.errors.get(timeout=WAIT_S).code == EmcyCode.RPDO_TIMEOUT
    await_feedback(enabled, Index.STATUSWORD, lambda word: word & 0x4F == codec.Cia402State.FAULT)
    await_feedback(enabled, Index.TORQUE_ACTUAL, lambda torque: torque == 0)
    assert enabled.is_faulted()
    assert not arm.servos[0].is_energised


def test_canopen__quick_stop__holds_and_resumes(enabled):
    enabled.sdo[Index.QUICK_STOP_OPTION].raw = 6
    enabled.state = "QUICK STOP ACTIVE"
    assert enabled.state == "QUICK STOP ACTIVE"
    enabled.state = "OPERATION ENABLED"
    assert enabled.state == "OPERATION ENABLED"


def test_canopen__sdo_errors__arrive_with_their_codes(drive):
    for write, code in (
        (lambda: setattr(drive.sdo[Index.MODE], "raw", 4), 0x06090030),
        (lambda: drive.sdo.download(Index.STATUSWORD, 0, b"\0\0"), 0x06010002),
        (lambda: drive.sdo.upload(0x2000, 0), 0x06020000),
        (lambda: drive.sdo.upload(Index.IDENTITY, 9), 0x06090011),
        (lambda: drive.sdo.download(Index.PRODUCER_HEARTBEAT, 0, b"\0" * 9), 0x06070012),
        (lambda: drive.sdo.download(Index.RPDO1_MAPPING, 0, b"\0"), 0x08000022),
    ):
        with pytest.raises(canopen.SdoAbortedError) as caught:
            write()
        assert caught.value.code == code
    drive.sdo.download(Index.PRODUCER_HEARTBEAT, 0, b"\x64\x00", force_segment=True)
    assert drive.sdo[Index.PRODUCER_HEARTBEAT].raw == 100
