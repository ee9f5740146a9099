"""An arm on several buses in virtual time: real masters, real nodes, one plant."""

from drivers.arm_group import configure_arm, make_arm
from drivers.buses.loopback import LoopbackBus
from hil.config import load_config
from hil.emulation import build_emulator

T = 1e-3
T_NS = 1_000_000


def configuration(places, families=(), **over):
    """Configuration of a chain whose joints are on the buses `places`, from 1."""
    axes = {str(joint): {"bus": place} for joint, place in enumerate(places, start=1)}
    for joint, family in enumerate(families, start=1):
        axes[str(joint)]["family"] = family
    more = [f"unix:/tmp/none-{number}" for number in range(2, max(places) + 1)]
    table = {"arm": {"preset": f"chain_h:{len(places)}"}, "bus": {"more": more}, "axes": axes}
    return load_config(None, table | over)


class GroupRig:
    """All buses of one arm.

    Attributes:
        arm: The master, configured.
        sent: Frames of the master, (bus from 1, record).
        is_cut: Numbers of the buses that carry nothing at present.
    """

    def __init__(self, places, families=()):
        self.config = configuration(places, families)
        self.clock_ns = 0
        self.sent = []
        self.is_cut = set()
        self._is_starting = True
        count = max(places)
        self.loopbacks = [LoopbackBus() for _ in range(count)]
        self.emulator = build_emulator(
            self.config, [self._to_master(n) for n in range(1, count + 1)], is_lockstep=True
        )
        for number, loopback in enumerate(self.loopbacks, start=1):
            loopback.connect(self._to_drives(number), self._wait)
        self.emulator.power_on()
        self.arm = make_arm(
            self.loopbacks, self.config.axes, period_s=T, now_ns=lambda: self.clock_ns
        )
        self.infos = configure_arm(self.arm, self.config.axes, period_s=T)
        self._is_starting = False
        self.sent.clear()

    def _to_master(self, number):
        def deliver(frame):
            if number not in self.is_cut:
                self.loopbacks[number - 1].deliver(frame)

        return deliver

    def _to_drives(self, number):
        def take(frame):
            self.sent.append((number, frame))
            if number not in self.is_cut:
                self.emulator.receive(frame, number - 1)

        return take

    def _wait(self, timeout_s):
        self.clock_ns += round(timeout_s * 1e9)
        if self._is_starting:
            self.emulator.advance(round(timeout_s * 1e9))

    def cycle(self, tau_Nm=None, cycles=1):
        """Run cycles; return whether all feedback of the last was fresh."""
        n = len(self.arm.axes)
        for _ in range(cycles):
            self.clock_ns += T_NS
            self.arm.request_feedback()
            is_fresh = self.arm.collect(self.clock_ns)
            self.arm.send_torques([0.0] * n if tau_Nm is None else tau_Nm)
        return is_fresh

    def enable(self):
        for axis in self.arm.axes:
            axis.enable()
        for _ in range(500):
            self.cycle()
            if self.arm.is_enabled:
                return
        raise AssertionError([axis.note for axis in self.arm.axes])
