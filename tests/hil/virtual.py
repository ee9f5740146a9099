"""The controller on its drivers and the emulated robot in virtual time, with hands on the wire."""

import json

import numpy as np

from controller.machine import State, Trigger
from controller.reference import MotionLimits, MotionState
from drivers.arm_bus import ArmBus
from drivers.buses.loopback import LoopbackBus
from drivers.frame import pack_frame, unpack_frame
from drivers.registry import make_axes
from hil.config import load_config, merge, parse_assignment
from hil.control import Control
from hil.emulation import build_emulator
from hil.executor import Executor
from hil.messages import parse_trajectory
from hil.planner import plan

PERIOD_NS = 1_000_000


def configured(*assignments):
    """Configuration with settings as on the command line."""
    over = {}
    for assignment in assignments:
        over = merge(over, parse_assignment(assignment))
    return load_config(None, over)


class Rig:
    """One arm, cycle by cycle.

    Attributes:
        lose_from_drives: Says of (identifier, data) whether a frame from a drive is lost.
        lose_to_drives: The same for frames to the drives.
        history: What each cycle measured and sent, oldest first.
    """

    def __init__(self, *assignments):
        self.config = configured(*assignments)
        self.lose_from_drives = self.lose_to_drives = lambda can_id, data: False
        self.history = []
        self.events = []
        self.outcomes = []
        self.slots = {}
        self.clock_ns = 0
        self._is_starting = True
        self.loopback = LoopbackBus()
        self.emulator = build_emulator(self.config, self._from_drives, is_lockstep=True)
        self.loopback.connect(self._to_drives, self._wait)
        axes = make_axes(self.config.axes, period_s=1e-3)
        self.bus = ArmBus(self.loopback, axes, now_ns=lambda: self.clock_ns)
        self.emulator.power_on()
        self.bus.configure(heartbeat_cycles=100)
        self.control = Control(
            self.config, self.bus, now_ns=lambda: self.clock_ns, events=self._note
        )
        self.executor = Executor(
            self.control,
            self.slots.__getitem__,
            lambda command, reason: self.outcomes.append((command["id"], reason)),
        )
        self.control.fire(Trigger.BUS_READY)
        self._is_starting = False

    def _from_drives(self, frame):
        if not self.lose_from_drives(*unpack_frame(frame)):
            self.loopback.deliver(frame)

    def _to_drives(self, frame):
        if not self.lose_to_drives(*unpack_frame(frame)):
            self.emulator.receive(frame)

    def _wait(self, timeout_s):
        self.clock_ns += round(timeout_s * 1e9)
        if self._is_starting:
            self.emulator.advance(round(timeout_s * 1e9))

    def _note(self, kind, detail):
        self.events.append((kind, dict(detail)))

    @property
    def state(self):
        return self.control.machine.state

    @property
    def fault(self):
        return self.control.machine.fault

    def inject(self, can_id, data):
        """Put a frame of a third party on the wire."""
        self.emulator.receive(pack_frame(can_id, data))

    def step(self, cycles=1):
        control = self.control
        for _ in range(cycles):
            self.executor.begin_cycle(1)
            deadline_ns = self.clock_ns + 600_000
            control.step(deadline_ns, 1)
            self.clock_ns = max(self.clock_ns, deadline_ns - 600_000 + PERIOD_NS)
            row = (control.q_rad, control.dq_rad_s, *control.player.setpoint[:2])
            row += (control.tau_sent_Nm, self.emulator.tau_applied_Nm)
            self.history.append([list(values) for values in row])

    def column(self, name, last=None):
        """One column of the history: cycles x joints."""
        names = ("q", "dq", "q_des", "dq_des", "sent", "applied")
        rows = self.history if last is None else self.history[-last:]
        return np.array([row[names.index(name)] for row in rows])

    def run_until(self, state, most=1000):
        for _ in range(most):
            if self.state is state:
                return
            self.step()
        raise AssertionError(f"{self.state.name} ({self.fault.name}) instead of {state.name}")

    def enable(self):
        self.control.enable()
        self.run_until(State.READY)

    def reference(self, kind, start=None, **fields):
        """Plan a trajectory from the present reference, or from a motion."""
        request = parse_trajectory(json.dumps({"kind": kind, **fields}))
        start = start or MotionState.at_rest(self.control.player.setpoint.q_rad)
        limits = MotionLimits.of(self.config.controller.limits, 120.0)
        return plan(request, start, limits, 1e-3)

    def command(self, number, verb, **arguments):
        self.executor.execute({"id": number, "verb": verb, **arguments})

    def play(self, reference, *, slot=0, number=0, at_index=None):
        """Hand a reference over as the gateway does."""
        self.slots[slot] = memoryview(reference.rows().tobytes()).cast("d")
        samples = reference.samples
        self.command(number, "trajectory", slot=slot, samples=samples, at_index=at_index)

    def swing(self, cycles=400):
        """Enable and swing about the present pose; return in the middle of the motion."""
        self.enable()
        center = self.control.player.setpoint.q_rad
        self.play(
            self.reference(
                "sinusoid",
                duration_s=20.0,
                center_rad=list(center),
                amplitude_rad=[0.5, 0.4],
                frequency_Hz=[0.5, 0.5],
                ramp_s=0.5,
            )
        )
        self.step(max(1, cycles))
        assert self.state is State.ACTIVE
