"""Our CANopen master against a slave that is not ours: the `durand` library, unmodified.

durand brings network management, SDO server, PDOs, SYNC consumer, heartbeat and EMCY; here it gets
the objects of a CiA 402 drive and a plain state machine behind them. It sits on a real hub through
python-can's plugin, in threads of its own; the master is `ArmBus` with a `Cia402Axis`.
"""

import math
import threading
import time

import can
import durand
import pytest
from durand.scheduler import SyncScheduler, get_scheduler, set_scheduler

from drivers.arm_bus import SENT, ArmBus
from drivers.axis import AxisStatus
from drivers.bus import open_bus
from drivers.cia402 import codec
from drivers.cia402.codec import Cia402State, Index, NmtCommand, NmtState
from drivers.cia402.master import Cia402Axis
from drivers.cia402.sdo import SdoAbort
from drivers.cia402.sdo_client import SdoClient, SdoRefusedError
from drivers.cia402.settings import Cia402Settings
from drivers.errors import AmplifierError
from drivers.frame import pack_frame, unpack_frame

DT = durand.DatatypeEnum
NODE = 5
SETTINGS = Cia402Settings(
    node_id=NODE, rated_torque_Nm=2.0, torque_max_Nm=4.0, heartbeat_ms=100, sdo_timeout_s=5.0
)
"""A long SDO timeout: the slave is Python threads on a machine that may stall."""
CYCLE_S = 5.0
"""Longest wait for feedback; it comes at once."""
PLENTY = 50
NAME = b"a drive made of durand"
TEXT = 0x2100
READ_ONLY = 0x2101
BOUNDED = 0x2102

_NEXT = {  # (state, controlword) -> state, as CiA 402-2 has it
    (Cia402State.SWITCH_ON_DISABLED, 0x06): Cia402State.READY_TO_SWITCH_ON,
    (Cia402State.READY_TO_SWITCH_ON, 0x07): Cia402State.SWITCHED_ON,
    (Cia402State.SWITCHED_ON, 0x0F): Cia402State.OPERATION_ENABLED,
    (Cia402State.FAULT, 0x80): Cia402State.SWITCH_ON_DISABLED,
}


class Slave:
    """A drive made of durand; `od` is its object dictionary."""

    def __init__(self, path):
        self._scheduler_before = get_scheduler()
        self._scheduler = SyncScheduler()
        set_scheduler(self._scheduler)
        self._address = f"unix:{path}"
        self._bus = can.Bus(interface="hil-unix", channel=path)
        self.network = durand.CANBusNetwork(self._bus)
        self.node = durand.MinimalNode(self.network, NODE)
        self.od = self.node.object_dictionary
        self.state = Cia402State.SWITCH_ON_DISABLED
        self._add_objects()
        self.od.update_callbacks[Index.CONTROLWORD, 0].add(self._obey)
        self.od.update_callbacks[Index.MODE, 0].add(lambda v: self._set(Index.MODE_DISPLAY, v))
        self._timers = threading.Thread(target=self._scheduler.run)
        self._timers.start()

    def _add_objects(self):
        def add(index, kind, value=0, access="rw", **limits):
            self.od[index] = durand.Variable(kind, access, value, **limits)

        self.od.write(Index.DEVICE_NAME, 0, NAME)
        add(Index.SUPPORTED_MODES, DT.UNSIGNED32, codec.CST_SUPPORTED, "ro")
        add(Index.RATED_TORQUE, DT.UNSIGNED32, 2000, "ro")
        add(Index.MODE, DT.INTEGER8)
        add(Index.MODE_DISPLAY, DT.INTEGER8, access="ro")
        add(Index.MAX_TORQUE, DT.UNSIGNED16)
        add(Index.ABORT_CONNECTION_OPTION, DT.INTEGER16)
        add(Index.CONTROLWORD, DT.UNSIGNED16)
        add(Index.STATUSWORD, DT.UNSIGNED16, 0x250, "ro")
        add(Index.TARGET_TORQUE, DT.INTEGER16)
        add(Index.TORQUE_ACTUAL, DT.INTEGER16, access="ro")
        add(Index.POSITION_ACTUAL, DT.INTEGER32, access="ro")
        add(TEXT, DT.OCTET_STRING)
        add(READ_ONLY, DT.UNSIGNED16, 7, "ro")
        add(BOUNDED, DT.UNSIGNED8, 5, minimum=3, maximum=9)
        self._add_record(Index.ENCODER_RESOLUTION, (DT.UNSIGNED32, 4096), (DT.UNSIGNED32, 1))
        self._add_record(Index.CYCLE_TIME, (DT.UNSIGNED8, 0), (DT.INTEGER8, 0))
        self._add_record(Index.CONSUMER_HEARTBEAT, (DT.UNSIGNED32, 0))
        self.od[Index.RPDO1_PARAMETER][5] = durand.Variable(DT.UNSIGNED16, "rw", 0)

    def _add_record(self, index, *entries):
        record = durand.Record()
        for subindex, (kind, value) in enumerate(entries, start=1):
            record[subindex] = durand.Variable(kind, "rw", value)
        self.od[index] = record

    def _set(self, index, value):
        self.od.write(index, 0, value)

    def _obey(self, controlword):
        if controlword == 0 and self.state is not Cia402State.FAULT:
            self.enter(Cia402State.SWITCH_ON_DISABLED)
        else:
            self.enter(_NEXT.get((self.state, controlword), self.state))

    def enter(self, state):
        """Show a drive state; torque follows its command while operation is enabled."""
        self.state = state
        self._set(Index.STATUSWORD, state | 0x210)
        is_on = state is Cia402State.OPERATION_ENABLED
        self._set(Index.TORQUE_ACTUAL, self.od.read(Index.TARGET_TORQUE, 0) if is_on else 0)

    def fail(self, code):
        """Go to fault and say why."""
        self.enter(Cia402State.FAULT)
        self.node.emcy.set(code, 0x01)

    def close(self):
        self.od.write(Index.PRODUCER_HEARTBEAT, 0, 0)  # the scheduler has nothing left to do
        self._scheduler.stop()
        self._timers.join()
        stopping = threading.Thread(target=self.network.stop)
        stopping.start()
        with open_bus(self._address) as waker:  # durand waits a second for a frame, otherwise
            while stopping.is_alive():
                waker.send(pack_frame(codec.COB_SYNC))
                stopping.join(0.005)
        self._bus.shutdown()
        set_scheduler(self._scheduler_before)


class Master:
    """Our side: one axis on the same hub."""

    def __init__(self, address, settings=SETTINGS):
        self.axis = Cia402Axis(settings, joint=1, period_s=1e-3)
        self.sent = []
        self._wire = open_bus(address)
        self.bus = ArmBus(self._wire, [self.axis], now_ns=time.monotonic_ns)
        self.bus.log_frames(self._note)

    def _note(self, direction, frame):
        if direction == SENT:
            self.sent.append(unpack_frame(frame))

    def configure(self):
        (info,) = self.bus.configure(heartbeat_cycles=10)
        return info

    def cycle(self, tau_Nm=0.0):
        self.bus.request_feedback()
        assert self.bus.collect(time.monotonic_ns() + round(CYCLE_S * 1e9)), "no TPDO after SYNC"
        self.bus.send_torques([tau_Nm])

    def until(self, status, tau_Nm=0.0):
        for _ in range(PLENTY):
            if self.axis.status is status:
                return
            self.cycle(tau_Nm)
        raise AssertionError(f"{self.axis.status.name} instead of {status.name}: {self.axis.note}")

    def enable(self):
        self.configure()
        self.cycle()
        self.axis.enable()
        self.until(AxisStatus.ENABLED)

    # `drivers.axis.Port`, for the SDO client alone

    def send(self, can_id, data):
        assert self._wire.send(pack_frame(can_id, data))

    def wait(self, can_id, timeout_s):
        deadline_s = time.monotonic() + timeout_s
        while (left_s := deadline_s - time.monotonic()) > 0.0:
            frame = self._wire.recv(left_s)
            if frame is not None:
                got_id, data = unpack_frame(frame)
                if got_id == can_id:
                    return data
        return None

    def sdo(self):
        return SdoClient(self, NODE, "durand", SETTINGS.sdo_timeout_s)

    def nmt(self, command):
        self.send(codec.COB_NMT, codec.pack_nmt(command, NODE))


@pytest.fixture
def slave(running_hub):
    slave = Slave(running_hub.hub.path)
    yield slave
    slave.close()


@pytest.fixture
def master(running_hub, slave):
    master = Master(running_hub.address)
    yield master
    master.bus.close()


# --- SDO ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [1, 3, 4, 5, 7, 8, 14, 15, 200])
def test_sdo__value_of_any_size__written_and_read_back(master, size):
    """Up to 4 bytes expedited, more in segments of 7 with alternating toggle bits."""
    value = bytes((7 * k + size) % 256 for k in range(size))
    sdo = master.sdo()
    sdo.write(TEXT, 0, value)
    assert sdo.read(TEXT) == value


def test_sdo__numbers__signed_and_unsigned_as_the_slave_holds_them(master, slave):
    sdo = master.sdo()
    sdo.write(Index.CYCLE_TIME, 2, codec.I8.pack(-3))
    assert slave.od.read(Index.CYCLE_TIME, 2) == -3
    assert sdo.read_number(codec.I8, Index.CYCLE_TIME, 2) == -3
    assert sdo.read_number(codec.U32, Index.RATED_TORQUE) == 2000


@pytest.mark.parametrize(
    ("index", "subindex", "value", "code"),
    [
        (0x5FFF, 0, b"\x01", SdoAbort.NO_OBJECT),
        (Index.CYCLE_TIME, 9, b"\x01", SdoAbort.NO_SUBINDEX),
        (READ_ONLY, 0, b"\x01\x00", SdoAbort.READ_ONLY),
        (BOUNDED, 0, b"\x0a", SdoAbort.VALUE_TOO_HIGH),
        (BOUNDED, 0, b"\x02", SdoAbort.VALUE_TOO_LOW),
    ],
    ids=["no object", "no subindex", "read only", "too high", "too low"],
)
def test_sdo__slave_aborts__its_code_is_told_and_the_next_transfer_works(
    master, index, subindex, value, code
):
    sdo = master.sdo()
    with pytest.raises(SdoRefusedError) as refusal:
        sdo.write(index, subindex, value)
    assert refusal.value.code == code
    assert sdo.read(READ_ONLY) == b"\x07\x00"


def test_sdo__longest_value__its_data_sheet_is_refused_as_too_long(master):
    """1021 holds the slave's own EDS: kilobytes. The client stops, and the slave knows."""
    sdo = master.sdo()
    with pytest.raises(AmplifierError, match="1021:00 is longer than 1024 bytes"):
        sdo.read(0x1021)
    assert sdo.read(READ_ONLY) == b"\x07\x00"


# --- network management -------------------------------------------------------------------------


def test_nmt__commands__change_the_slaves_state(master, slave):
    sdo = master.sdo()
    sdo.write(Index.PRODUCER_HEARTBEAT, 0, codec.U16.pack(10))
    for command, state in (
        (NmtCommand.START, NmtState.OPERATIONAL),
        (NmtCommand.STOP, NmtState.STOPPED),
        (NmtCommand.ENTER_PRE_OPERATIONAL, NmtState.PRE_OPERATIONAL),
    ):
        master.nmt(command)
        assert heartbeat_of(master, state)


def heartbeat_of(master, state):
    for _ in range(PLENTY):
        data = master.wait(codec.COB_HEARTBEAT + NODE, CYCLE_S)
        if data is not None and codec.parse_heartbeat(data) is state:
            return True
    return False


@pytest.mark.parametrize("command", [NmtCommand.RESET_NODE, NmtCommand.RESET_COMMUNICATION])
def test_nmt__reset__boot_up_message(master, command):
    master.nmt(command)
    assert heartbeat_of(master, NmtState.INITIALISING)


# --- start-up and cycles ------------------------------------------------------------------------


def test_configure__foreign_drive__set_up_as_the_settings_say(master, slave):
    info = master.configure()
    assert info.name == NAME.decode()
    assert info.torque_resolution_Nm == pytest.approx(2e-3)
    assert info.angle_resolution_rad == pytest.approx(math.tau / 4096)
    assert not info.is_lockstep
    read = slave.od.read
    assert read(Index.MODE_DISPLAY, 0) == codec.CST
    assert read(Index.MAX_TORQUE, 0) == 2000
    assert read(Index.PRODUCER_HEARTBEAT, 0) == 100
    assert read(Index.CONSUMER_HEARTBEAT, 1) == codec.consumer_heartbeat(127, 300)
    assert slave.node.rpdo[0].mapping == ((Index.CONTROLWORD, 0), (Index.TARGET_TORQUE, 0))
    assert slave.node.tpdo[0].mapping == (
        (Index.STATUSWORD, 0), (Index.POSITION_ACTUAL, 0), (Index.TORQUE_ACTUAL, 0))  # fmt: skip
    assert slave.node.rpdo[0].transmission_type == slave.node.tpdo[0].transmission_type == 1
    assert not slave.node.tpdo[1].enable


def test_configure__scales_differ__refused_before_any_torque(running_hub, slave):
    master = Master(running_hub.address, SETTINGS.model_copy(update={"rated_torque_Nm": 3.0}))
    with pytest.raises(AmplifierError, match=r"6076 .* is 2000, the configuration says 3000"):
        master.configure()
    master.bus.close()
    assert not [data for can_id, data in master.sent if can_id == codec.COB_RPDO1 + NODE]


def test_configure__optional_watchdog_missing__refused(running_hub, slave):
    """A drive without an RPDO deadline would keep its torque when the master dies."""
    del slave.od[Index.RPDO1_PARAMETER]._variables[5]
    master = Master(running_hub.address)
    with pytest.raises(SdoRefusedError, match=r"1400:05 refused: 06090011"):
        master.configure()
    master.bus.close()


def test_cycle__torque_and_position__exchanged_by_pdo(master, slave):
    master.enable()
    assert slave.state is Cia402State.OPERATION_ENABLED
    slave.od.write(Index.POSITION_ACTUAL, 0, 1024)
    for _ in range(4):
        master.cycle(-1.5)
    assert slave.od.read(Index.TARGET_TORQUE, 0) == -750
    assert master.axis.tau_meas_Nm == pytest.approx(-1.5)
    assert master.axis.q_rad == pytest.approx(math.tau / 4)


def test_cycle__torque_over_the_limit__clipped_on_the_wire(master, slave):
    master.enable()
    for _ in range(3):
        master.cycle(100.0)
    assert slave.od.read(Index.TARGET_TORQUE, 0) == 2000


def test_disable__while_torque_is_commanded__power_and_torque_off(master, slave):
    master.enable()
    master.cycle(1.0)
    master.axis.disable()
    master.until(AxisStatus.DISABLED, 1.0)
    master.cycle(1.0)
    assert slave.state is Cia402State.SWITCH_ON_DISABLED
    assert slave.od.read(Index.TARGET_TORQUE, 0) == 0


def test_fault__reported_with_its_emergency__and_left_by_reset_only(master, slave):
    master.enable()
    slave.fail(0x2310)
    master.until(AxisStatus.FAULT)
    assert "EMCY 2310" in master.axis.note
    master.axis.enable()
    master.cycle()
    master.cycle()
    assert slave.state is Cia402State.FAULT
    master.axis.reset_fault()
    for _ in range(PLENTY):
        master.cycle()
        if slave.state is Cia402State.SWITCH_ON_DISABLED:
            break
    master.until(AxisStatus.DISABLED)
    master.axis.enable()
    master.until(AxisStatus.ENABLED)


def test_slave__restarts_by_itself__lost_and_not_enabled_again(master, slave):
    master.enable()
    slave.node.nmt.reset()
    for _ in range(PLENTY):
        master.bus.request_feedback()
        master.bus.collect(time.monotonic_ns() + 10_000_000)
        master.bus.send_torques([1.0])
        if master.axis.status is AxisStatus.LOST:
            break
    assert master.axis.status is AxisStatus.LOST
    assert "boot-up" in master.axis.note
    command = [data for can_id, data in master.sent if can_id == codec.COB_RPDO1 + NODE][-1]
    assert codec.RPDO1.unpack(command) == (codec.CONTROL_DISABLE_VOLTAGE, 0)
