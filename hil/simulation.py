"""Everything in one process and in virtual time, through the same frames as on a bus.

Nothing here asks the real clock, so that the same run gives the same bytes.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from controller.machine import State, Trigger
from controller.reference import Reference
from drivers.arm_bus import ArmBus
from drivers.buses.loopback import LoopbackBus
from drivers.registry import heartbeat_cycles, make_axes
from hil.config import Config
from hil.control import ArmLink, Control
from hil.emulation import build_emulator
from hil.errors import HilError
from hil.executor import Executor
from hil.ideal import IdealArm
from hil.recording import RecordingWriter
from hil.sampler import Sampler, Stamps
from hil.telemetry import BusFrameLayout, SampleLayout
from sim_backend.arm import Arm
from sim_backend.emulator import Emulator

FRAMES_EVERY = 50
"""Cycles whose frames are recorded together."""
NO_STAMPS = Stamps()
"""Virtual time stands still within a cycle."""


class SimulationError(HilError):
    """A simulated run could not be carried out as asked."""


class Sink(Protocol):
    """Takes what a run produces; `hil.recording.RecordingWriter` is one."""

    def add_sample(self, t_ns: int, seq: int, payload: bytes) -> None:
        """Take one serialised sample."""

    def add_bus_log(self, t_ns: int, payload: bytes) -> None:
        """Take some serialised bus frames."""

    def add_event(
        self, t_ns: int, cycle: int, kind: str, detail: Mapping[str, Any] | str = "{}"
    ) -> None:
        """Take an event."""


class Simulation:
    """Controller, drivers, frames, emulated amplifiers and arm, advanced cycle by cycle.

    Attributes:
        config: The running configuration.
        control: The controller; commands are its methods.
        cycle: Cycles run so far.
        frames: Bus frames so far, both directions.
    """

    def __init__(self, config: Config, sink: Sink | None = None) -> None:
        self.config = config
        self.cycle = 0
        self.frames = 0
        self._sink = sink
        self._period_ns = round(config.loop.period_s * 1e9)
        self._clock_ns = 0
        self._is_starting = True
        self._entry = BusFrameLayout().entry
        self._log: list[bytes] = []
        self._log_ns = 0
        self._emulator: Emulator | None = None
        self._plant: Emulator | IdealArm
        link: ArmLink
        self._plant, link = self._build_ideal() if config.emulator.is_ideal else self._build()
        self.control = Control(config, link, now_ns=lambda: self._clock_ns, events=self._emit)
        self._rows: dict[int, Sequence[float]] = {}
        self._executor = Executor(self.control, self._rows.__getitem__, self._report_outcome)
        layout = SampleLayout(config.joints, with_truth=True)
        self._sampler = Sampler(layout, self.control, link, self._truth)
        self._sample = bytearray(layout.size)
        for warning in config.controller.warnings():
            self._emit("warning", {"detail": warning})
        self.control.fire(Trigger.BUS_READY)
        self._is_starting = False

    def _build(self) -> tuple[Emulator, ArmBus]:
        """The emulated robot and the drivers in front of it, joined by an in-process bus."""
        config, loopback = self.config, LoopbackBus()
        emulator = self._emulator = build_emulator(config, loopback.deliver, is_lockstep=True)
        loopback.connect(emulator.receive, self._wait)
        axes = make_axes(config.axes, period_s=config.loop.period_s)
        bus = ArmBus(loopback, axes, now_ns=lambda: self._clock_ns)
        if self._sink is not None:
            bus.log_frames(self._log_frame)
        emulator.power_on()
        period_s = config.loop.period_s
        bus.configure(heartbeat_cycles=heartbeat_cycles(config.axes, period_s=period_s))
        return emulator, bus

    def _build_ideal(self) -> tuple[IdealArm, IdealArm]:
        link = IdealArm(Arm(self.config.plant), self.config.loop.period_s)
        return link, link

    def step(self) -> None:
        """Run one cycle and record it."""
        self._executor.begin_cycle(1)
        self.control.step(self._clock_ns, 1)
        stamp = (self.cycle, self._clock_ns, 0)
        if self._sink is not None:
            self._sampler.write(self._sample, 0, stamp, NO_STAMPS)
            self._sink.add_sample(self._clock_ns, self._sampler.seq - 1, bytes(self._sample))
            if self.cycle % FRAMES_EVERY == 0:
                self._flush_frames()
        self.cycle += 1
        self._clock_ns += self._period_ns

    def run(self, cycles: int, progress: Callable[[int], None] | None = None) -> None:
        """Run cycles, telling `progress` how many are done once per simulated second."""
        per_second = max(1, round(1.0 / self.config.loop.period_s))
        for done in range(cycles):
            if progress is not None and done % per_second == 0:
                progress(done)
            self.step()

    def run_until(self, state: State, most_cycles: int) -> None:
        """Run until the machine is in a state.

        Raises:
            SimulationError: If it is not after `most_cycles`; the message names state and fault.
        """
        for _ in range(most_cycles):
            if self.control.machine.state is state:
                return
            self.step()
        machine = self.control.machine
        raise SimulationError(
            f"the arm is in state {machine.state.name} (fault {machine.fault.name}) "
            f"instead of {state.name} after {most_cycles} cycles"
        )

    def play(self, reference: Reference) -> None:
        """Start a compiled reference at the next cycle, as the trajectory command does."""
        self._rows[0] = memoryview(reference.rows().tobytes()).cast("d")
        self._executor.execute(
            {
                "id": 0,
                "verb": "trajectory",
                "slot": 0,
                "samples": reference.samples,
                "at_index": None,
            }
        )

    def execute(self, verb: str, **arguments: object) -> None:
        """Carry out another command now (`Executor.execute`)."""
        self._executor.execute({"id": 0, "verb": verb, **arguments})

    # --- time and records --------------------------------------------------------------------

    def _wait(self, timeout_s: float) -> None:
        """Nothing on the bus: virtual time passes, for the plant only before the first cycle."""
        passed_ns = round(timeout_s * 1e9)
        self._clock_ns += passed_ns
        if self._is_starting and self._emulator is not None:
            self._emulator.advance(passed_ns)

    def _truth(self) -> tuple[Sequence[float], Sequence[float], Sequence[float]]:
        plant = self._plant
        return plant.q_true_rad, plant.dq_true_rad_s, plant.tau_applied_Nm

    def _emit(self, kind: str, detail: Mapping[str, Any]) -> None:
        if self._sink is not None:
            self._sink.add_event(self._clock_ns, self.cycle, kind, detail)

    def _report_outcome(self, command: Mapping[str, Any], reason: str) -> None:
        self._emit("command", {"verb": command["verb"], "ok": not reason, "reason": reason})
        if reason:
            raise SimulationError(f"{command['verb']}: {reason}")

    def _log_frame(self, direction: int, frame: bytes) -> None:
        self.frames += 1
        if not self._log:
            self._log_ns = self._clock_ns
        self._log.append(self._entry(self._clock_ns, direction, frame))

    def _flush_frames(self) -> None:
        if self._log and self._sink is not None:
            self._sink.add_bus_log(self._log_ns, b"".join(self._log))
        self._log = []

    def close(self) -> None:
        """Record what is left; the recording itself stays open."""
        self._flush_frames()


def open_recording(config: Config, path: Path) -> RecordingWriter:
    """Create the recording of a simulated run."""
    return RecordingWriter(path, config.model_dump_json(), config.joints, with_truth=True)
