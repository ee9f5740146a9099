"""The product's own CiA 402 master in front of emulated drives, on one wire in virtual time."""

from drivers.arm_bus import RECEIVED, SENT, ArmBus
from drivers.axis import AxisStatus
from drivers.buses.loopback import LoopbackBus
from drivers.cia402 import codec
from drivers.cia402.sdo import SdoKind, parse_sdo_request
from drivers.cia402.settings import Cia402Settings
from drivers.frame import pack_frame, unpack_frame
from drivers.registry import make_axes
from sim_backend.arm import Arm
from sim_backend.cia402 import node as emulated
from sim_backend.emulator import Emulator
from sim_backend.presets import plant_preset, servo_preset
from sim_backend.servo import Servo

T = 1e-3
T_NS = 1_000_000
PLENTY = 2000
"""Cycles within which everything the tests wait for has happened."""
SETTINGS = (
    Cia402Settings(node_id=1, rated_torque_Nm=5.0, torque_max_Nm=15.0),
    Cia402Settings(node_id=2, rated_torque_Nm=2.5, torque_max_Nm=8.0),
)


def ask_for(settings, **changes):
    """Settings with some changed."""
    return settings.model_copy(update=changes)


def drive_for(settings, **changes):
    """What an emulated drive is built with so that it fits a master's settings."""
    fitting = {"rated_torque_Nm": settings.rated_torque_Nm, "heartbeat_ms": settings.heartbeat_ms}
    return emulated.Cia402Settings(**{**fitting, **changes})


class Rig:
    """An arm of emulated drives and its master; see `cycle`.

    Attributes:
        bus: The master, not yet configured.
        nodes: The emulated drives.
        servos: What they drive.
        log: (RECEIVED or SENT, identifier, data) of every frame the master saw.
        to_master, to_drives: What becomes of each frame on its way: a list of frames.
    """

    def __init__(self, settings=SETTINGS, drives=None, *, are_lockstep=(True, True)):
        self.clock_ns = 0
        self.settings = settings
        self.log = []
        self.to_master = self.to_drives = lambda frame: [frame]
        self.on_wait = lambda: None
        self.loopback = LoopbackBus()
        joints = len(settings)
        plant = plant_preset("bench_h", (0.4, -0.5))
        changes = {"links": plant.links[:joints], "q0_rad": plant.q0_rad[:joints]}
        self.servos = [Servo(each) for each in servo_preset("bench")[:joints]]
        drives = drives or [drive_for(each) for each in settings]
        self.nodes = [
            emulated.Cia402Node(axis.node_id, servo, self._from_drive, drive, is_lockstep=lockstep)
            for axis, servo, drive, lockstep in zip(
                settings, self.servos, drives, are_lockstep, strict=False
            )
        ]
        arm = Arm(plant.model_copy(update=changes))
        self.emulator = Emulator(arm, self.servos, self.nodes, is_lockstep=all(are_lockstep))
        self.loopback.connect(self._from_master, self._wait)
        self.emulator.power_on()
        self.bus = self.new_master()

    def new_master(self):
        """Put another `ArmBus` on the wire."""
        axes = make_axes(self.settings, period_s=T)
        bus = ArmBus(self.loopback, axes, now_ns=lambda: self.clock_ns)
        bus.log_frames(self._note)
        return bus

    def _note(self, direction, frame):
        self.log.append((direction, *unpack_frame(frame)))

    def _from_master(self, frame):
        for passed in self.to_drives(frame):
            self.emulator.receive(passed)

    def _from_drive(self, frame):
        for passed in self.to_master(frame):
            self.loopback.deliver(passed)

    def _wait(self, timeout_s):
        """Nothing on the wire: time passes, and with it the drives' timers."""
        passed_ns = round(timeout_s * 1e9)
        self.clock_ns += passed_ns
        self.emulator.advance(passed_ns)
        self.on_wait()

    # --- the master's day ---------------------------------------------------------------------

    def configure(self):
        """Start up; return what the axes told."""
        return self.bus.configure(heartbeat_cycles=100)

    def cycle(self, *tau_Nm, between=None):
        """One cycle with these torques (default: none); True if all feedback was fresh.

        Args:
            tau_Nm: One per axis.
            between: Called after feedback was collected, before commands are sent.
        """
        self.bus.request_feedback()
        is_fresh = self.bus.collect(self.clock_ns)
        if between is not None:
            between()
        self.bus.send_torques(tau_Nm or [0.0] * len(self.nodes))
        self.clock_ns += T_NS
        return is_fresh

    def cycles(self, count, *tau_Nm):
        for _ in range(count):
            self.cycle(*tau_Nm)

    def until(self, condition):
        """Run cycles until a condition holds; return how many it took."""
        for count in range(PLENTY):
            if condition():
                return count
            self.cycle()
        raise AssertionError("it did not happen")

    def enable(self):
        """Configure if need be, and bring all axes to ENABLED."""
        if not self.log:
            self.configure()
        self.cycles(2)
        for axis in self.axes:
            axis.enable()
        self.until(lambda: self.bus.is_enabled)
        return self

    @property
    def axes(self):
        return self.bus.axes

    def all_are(self, status):
        return all(axis.status is AxisStatus[status] for axis in self.axes)

    # --- what was on the wire -----------------------------------------------------------------

    def sent(self, can_id):
        """Data of the frames the master sent under an identifier."""
        return [data for direction, sent, data in self.log if direction == SENT and sent == can_id]

    def received(self, can_id):
        """Data of the frames the master received under an identifier."""
        return [data for way, taken, data in self.log if way == RECEIVED and taken == can_id]

    def commands(self, node_id):
        """(controlword, torque) of every RPDO1 sent to a node."""
        return [codec.RPDO1.unpack(data) for data in self.sent(codec.COB_RPDO1 + node_id)]

    def writes(self, node_id):
        """(index, subindex, value) of every SDO download, in order; the value little-endian."""
        frames = [parse_sdo_request(data) for data in self.sent(codec.COB_SDO_RX + node_id)]
        return [
            (frame.index, frame.subindex, int.from_bytes(frame.data, "little"))
            for frame in frames
            if frame.kind is SdoKind.DOWNLOAD
        ]

    def read(self, node, index, subindex=0):
        """An object of a drive, as the drive itself would serve it; unsigned."""
        value = node.dictionary.upload(index, subindex)
        assert isinstance(value, bytes), f"{index:04X}:{subindex:02X}: {value!r}"
        return int.from_bytes(value, "little")

    def nmt(self, command, node_id=0):
        """Another participant's network management message."""
        self.emulator.receive(pack_frame(codec.COB_NMT, codec.pack_nmt(command, node_id)))


def without(*can_ids):
    """A way on which frames with these identifiers are lost."""
    return lambda frame: [] if unpack_frame(frame)[0] in can_ids else [frame]
