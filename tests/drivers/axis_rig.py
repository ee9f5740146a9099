"""Any family's master in front of its emulated amplifiers, on one wire in virtual time."""

from drivers.arm_bus import ArmBus
from drivers.axis import AxisStatus
from drivers.buses.loopback import LoopbackBus
from drivers.frame import LOCKSTEP_ID, unpack_header
from drivers.registry import SETTINGS, heartbeat_cycles, make_axes
from hil.config import load_config
from hil.emulation import build_emulator

T = 1e-3
T_NS = 1_000_000
PLENTY = 2000
"""Cycles within which everything the tests wait for has happened."""
TICKS = {0x080, LOCKSTEP_ID}
"""Frames that advance emulated time: never lost."""
TAU_MAX_NM = (15.0, 8.0)
"""Of the emulated motors."""


def keep(frame):
    """Lose nothing."""
    return [frame]


def lose(frame):
    """Lose everything but what advances time."""
    return [frame] if unpack_header(frame)[0] in TICKS else []


class AxisRig:
    """Two amplifiers of one family with an arm, and their master.

    Attributes:
        bus, axes: The master.
        emulator, nodes, servos: What it commands.
        to_master, to_drives: What becomes of each frame on its way: a list of frames.
    """

    def __init__(self, family, joints=({}, {})):
        self.clock_ns = 0
        self.to_master = self.to_drives = keep
        tables = {
            str(joint): SETTINGS[family].defaults(joint, tau_Nm) | changes
            for joint, tau_Nm, changes in zip((1, 2), TAU_MAX_NM, joints, strict=True)
        }
        self.config = load_config(None, {"axes": tables, "plant": {"q0_rad": [0.4, -0.5]}})
        self.settings = self.config.axes
        self.loopback = LoopbackBus()
        self.emulator = build_emulator(self.config, self._from_drive, is_lockstep=True)
        self.nodes = self.emulator._nodes
        self.servos = self.emulator._servos
        self.loopback.connect(self._from_master, self._wait)
        self.emulator.power_on()
        self.bus = self.new_master()
        self.infos = []

    def new_master(self):
        """Put another `ArmBus` on the wire."""
        axes = make_axes(self.config.axes, period_s=T)
        return ArmBus(self.loopback, axes, now_ns=lambda: self.clock_ns)

    @property
    def axes(self):
        return self.bus.axes

    def _from_master(self, frame):
        for passed in self.to_drives(frame):
            self.emulator.receive(passed)

    def _from_drive(self, frame):
        for passed in self.to_master(frame):
            self.loopback.deliver(passed)

    def _wait(self, timeout_s):
        """Nothing on the wire: time passes, during start-up also the drives'."""
        passed_ns = round(timeout_s * 1e9)
        self.clock_ns += passed_ns
        if not self.infos:
            self.emulator.advance(passed_ns)

    def configure(self):
        """Start up, and let two cycles pass."""
        beat = heartbeat_cycles(self.settings, period_s=T)
        self.infos = self.bus.configure(heartbeat_cycles=beat)
        self.cycles(2)
        return self

    def cycle(self, *tau_Nm):
        """One cycle with these torques (default: none); True if all feedback was fresh."""
        self.bus.request_feedback()
        is_fresh = self.bus.collect(self.clock_ns)
        self.bus.send_torques(tau_Nm or (0.0, 0.0))
        self.clock_ns += T_NS
        return is_fresh

    def cycles(self, count, *tau_Nm):
        for _ in range(count):
            self.cycle(*tau_Nm)

    def until(self, condition, *tau_Nm):
        """Run cycles until a condition holds; return how many it took."""
        for count in range(PLENTY):
            if condition():
                return count
            self.cycle(*tau_Nm)
        raise AssertionError(f"it did not happen: {[(a.status.name, a.note) for a in self.axes]}")

    def enable(self):
        """Bring all axes to ENABLED."""
        for axis in self.axes:
            axis.enable()
        self.until(lambda: self.bus.is_enabled)
        return self

    def all_are(self, status):
        return all(axis.status is AxisStatus[status] for axis in self.axes)

    @property
    def targets_Nm(self):
        """What the servos are to apply."""
        return [s.torque_target_Nm if s.is_energised else 0.0 for s in self.servos]
