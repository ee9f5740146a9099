"""Everything in one process and in virtual time, through the same frames as on a bus.

Nothing here asks the real clock, so that the same run gives the same bytes.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol
from zlib import crc32

from controller.machine import State, Trigger
from controller.reference import Reference
from drivers.arm_group import ArmLike, configure_arm, make_arm
from drivers.buses.loopback import LoopbackBus
from hil.config import Config
from hil.control import ArmLink, Control
from hil.emulation import build_emulator, build_wired_emulator, require_one_bus
from hil.errors import HilError
from hil.executor import Executor
from hil.ideal import IdealArm
from hil.recording import RecordingWriter
from hil.sampler import Sampler, Stamps
from hil.telemetry import BusFrameLayout, SampleLayout
from sim_backend.arm import Arm
from sim_backend.emulator import Emulator
from sim_backend.wire import WireLoad
from sim_backend.wired import VirtualWire

FRAMES_EVERY = 50
"""Cycles whose frames are recorded together."""
NO_STAMPS = Stamps()
"""Without the wire model, virtual time stands still within a cycle."""
WIRED_START_NS = 1_000_000
"""With it, the first cycle begins at a multiple of this, as the plant's milliseconds do."""


class SimulationError(HilError):
    """A simulated run could not be carried out as asked."""


class Sink(Protocol):
    """Takes what a run produces; `hil.recording.RecordingWriter` is one."""

    def add_sample(self, t_ns: int, seq: int, payload: bytes) -> None:
        """Take one serialised sample."""

    def add_bus_log(self, t_ns: int, payload: bytes) -> None:
        """Take some serialised bus frames."""

    def add_trajectory(self, t_ns: int, crc: int, rows: bytes) -> None:
        """Take the reference that a trajectory command starts."""

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
        wire: The wire model, to look at or to disturb; None if it is off.
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
        self.wire: VirtualWire | None = None
        self._timeout_ns = 0
        link: ArmLink
        self._plant, link = self._build_ideal() if config.emulator.is_ideal else self._build()
        self.control = Control(config, link, now_ns=lambda: self._clock_ns, events=self._emit)
        self._rows: dict[int, Sequence[float]] = {}
        self._motion: tuple[Sequence[float], Sequence[float]] = (), ()
        self._executor = Executor(self.control, self._rows.__getitem__, self._report_outcome)
        layout = SampleLayout(config.joints, with_truth=True)
        self._sampler = Sampler(layout, self.control, link, self._truth)
        self._sample = bytearray(layout.size)
        for warning in config.controller.warnings():
            self._emit("warning", {"detail": warning})
        self.control.fire(Trigger.BUS_READY)
        self._is_starting = False

    def _build(self) -> tuple[Emulator, ArmLike]:
        """The emulated robot and the drivers in front of it, joined by in-process buses."""
        config = self.config
        buses = [LoopbackBus() for _ in config.bus.addresses]
        if config.emulator.wire.is_on:
            require_one_bus(config)
            emulator = self._build_wired(buses[0])
        else:
            transmits = [bus.deliver for bus in buses]
            emulator = self._emulator = build_emulator(config, transmits, is_lockstep=True)
            for number, loopback in enumerate(buses):
                loopback.connect(_receiver(emulator, number), self._wait)
        period_s = config.loop.period_s
        bus = make_arm(buses, config.axes, period_s=period_s, now_ns=lambda: self._clock_ns)
        if self._sink is not None:
            bus.log_frames(self._log_frame)
        emulator.power_on()
        configure_arm(bus, config.axes, period_s=period_s)
        if self.wire is not None:
            start_ns = -(-self._clock_ns // WIRED_START_NS) * WIRED_START_NS
            self._clock_ns = self.wire.advance(start_ns)
        return emulator, bus

    def _build_wired(self, loopback: LoopbackBus) -> Emulator:
        """The emulated robot behind the wire model; feedback may come too late."""
        config = self.config
        wire = self.wire = VirtualWire(
            config.emulator.wire,
            loopback.deliver,
            joints=config.joints,
            bit_rate=config.bus.bit_rate,
            data_bit_rate=config.bus.data_bit_rate,
        )
        emulator = self._emulator = build_wired_emulator(config, wire.ports)
        wire.connect(emulator)
        wire.model.on_window = self._report_load
        loopback.connect(wire.send, self._wait_wired)
        self._timeout_ns = round(config.loop.feedback_timeout_s * 1e9)
        return emulator

    def _build_ideal(self) -> tuple[IdealArm, IdealArm]:
        link = IdealArm(Arm(self.config.plant), self.config.loop.period_s)
        return link, link

    @property
    def plant(self) -> Emulator | IdealArm:
        """What stands behind the frames: the plant's truth, as of the last cycle's start."""
        return self._plant

    def step(self) -> None:
        """Run one cycle and record it."""
        start_ns = self._clock_ns
        if self.wire is not None and self._emulator is not None:  # it will have moved on by the end
            self._motion = self._emulator.arm.q_rad, self._emulator.arm.dq_rad_s
        self._executor.begin_cycle(1)
        self.control.step(start_ns + self._timeout_ns, 1)
        if self.wire is None:
            self._record(self._clock_ns, NO_STAMPS)
            self._clock_ns += self._period_ns
        else:
            stamps = self._stamps(start_ns)
            self._clock_ns = self.wire.advance(start_ns + self._period_ns)
            self._record(start_ns, stamps)
        self.cycle += 1

    def _record(self, t_ns: int, stamps: Stamps) -> None:
        if self._sink is None:
            return
        self._sampler.write(self._sample, 0, (self.cycle, t_ns, 0), stamps)
        self._sink.add_sample(t_ns, self._sampler.seq - 1, bytes(self._sample))
        if self.cycle % FRAMES_EVERY == 0:
            self._flush_frames()

    def _stamps(self, start_ns: int) -> Stamps:
        control = self.control
        done_ns = control.law_ns - start_ns
        return Stamps(0, control.feedback_ns - start_ns, done_ns, done_ns, 0)

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
        rows = reference.rows().tobytes()
        self._rows[0] = memoryview(rows).cast("d")
        crc = crc32(rows)
        if self._sink is not None:
            self._sink.add_trajectory(self._clock_ns, crc, rows)
        self.execute("trajectory", slot=0, samples=reference.samples, at_index=None, crc32=crc)

    def execute(self, verb: str, **arguments: object) -> None:
        """Carry out another command now (`Executor.execute`)."""
        command = {"id": 0, "verb": verb, **arguments}
        self._emit("input", {"is_after_step": False, "command": command})
        self._executor.execute(command)

    # --- time and records --------------------------------------------------------------------

    def _wait(self, timeout_s: float) -> None:
        """Nothing on the bus: virtual time passes, for the plant only before the first cycle."""
        passed_ns = round(timeout_s * 1e9)
        self._clock_ns += passed_ns
        if self._is_starting and self._emulator is not None:
            self._emulator.advance(passed_ns)

    def _wait_wired(self, timeout_s: float) -> None:
        """Nothing on hand: time passes until a frame arrives or the time is up."""
        if self.wire is not None:
            until_ns = self._clock_ns + round(timeout_s * 1e9)
            self._clock_ns = self.wire.advance(until_ns, stops_at_host=True)

    def _truth(self) -> tuple[Sequence[float], Sequence[float], Sequence[float]]:
        plant = self._plant
        if self.wire is not None:
            return *self._motion, plant.tau_applied_Nm
        return plant.q_true_rad, plant.dq_true_rad_s, plant.tau_applied_Nm

    def _report_load(self, load: WireLoad) -> None:
        if self.wire is not None:
            share = round(self.wire.model.share(load), 6)
            detail = {"share": share, "frames": load.frames, "error_frames": load.errors}
            self._emit("bus_load", {**detail, "wait_max_s": load.wait_max_ns * 1e-9})

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


def _receiver(emulator: Emulator, bus: int) -> Callable[[bytes], None]:
    """Return what takes the master's frames on a bus (from 0)."""
    return emulator.receive if bus == 0 else lambda frame: emulator.receive(frame, bus)


def open_recording(config: Config, path: Path) -> RecordingWriter:
    """Create the recording of a simulated run."""
    return RecordingWriter(path, config.model_dump_json(), config.joints, with_truth=True)
