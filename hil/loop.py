"""The real-time process: owns the bus, runs the cycle at absolute deadlines, and nothing else."""

import json
import os
import platform
import signal
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from time import thread_time_ns
from typing import Any

from controller.machine import Trigger
from drivers.arm_group import ArmGroup, ArmLike, configure_arm, make_arm, open_buses
from drivers.axis import AxisInfo
from drivers.errors import BusError, DriverError
from hil.config import Config
from hil.control import Control
from hil.errors import HilError
from hil.executor import Executor
from hil.realtime import (
    Granted,
    Usage,
    die_with_parent,
    freeze_garbage,
    make_realtime,
    make_sleeper,
    now_ns,
)
from hil.sampler import Sampler, Stamps
from hil.shared import STATUS_EVERY_S, SharedMemory
from hil.spin import SpinningBus
from hil.telemetry import LoggedFrame

GATEWAY_TIMEOUT_NS = 2_000_000_000
FAREWELL_CYCLES = 5
"""Cycles run after power went off, so that every amplifier has the last word."""
FAREWELL_TIMEOUT_NS = 100_000_000
"""Longest wait for feedback in these: a drive that is silent holds up nobody's end."""


class Loop:
    """The control loop on its shared memory."""

    def __init__(
        self,
        shared: SharedMemory,
        bus: ArmLike,
        infos: list[AxisInfo],
        start_up: Sequence[LoggedFrame] = (),
    ) -> None:
        """Make the loop ready to run.

        Args:
            shared: The daemon's shared memory.
            bus: The configured amplifiers.
            infos: What they said of themselves.
            start_up: Every frame of their configuration.
        """
        config = shared.config
        self._shared = shared
        self._config = config
        self._bus = bus
        self._infos = infos
        self._period_ns = round(config.loop.period_s * 1e9)
        self._is_lockstep = infos[0].is_lockstep
        timing = config.loop
        timeout_s = timing.lockstep_timeout_s if self._is_lockstep else timing.feedback_timeout_s
        self._timeout_ns = round(timeout_s * 1e9)
        self._control = Control(config, bus, now_ns=now_ns, events=self._emit)
        self._executor = Executor(self._control, shared.rows, self._report_outcome)
        self._sampler = Sampler(shared.layout, self._control, bus)
        self._commands = shared.reader("commands", "loop")
        self._timing = shared.timing
        self._usage = Usage()
        self._parent = os.getppid()
        self._cycle = 0
        self._overruns = 0
        self._estops_seen = shared.estop_requests
        self._has_gateway = False
        self._must_end = False
        self._granted = Granted("SCHED_OTHER", memory_locked=False, missing=())
        self._entry = shared.frame_layout.entry
        self._frames: list[bytes] = []
        self._record_bytes = self._room = shared.frames.payload_size
        for t_ns, direction, frame in start_up:
            self._log_frame(direction, frame, t_ns)

    def run(self, granted: Granted) -> None:
        """Run cycles until a signal ends the loop and torque is off.

        Raises:
            BusError: If the bus is gone. The amplifiers' own watchdogs remove torque.
        """
        self._granted = granted
        self._bus.log_frames(self._log_frame)
        self._emit(
            "start",
            {
                "amplifiers": [info.name for info in self._infos],
                "is_lockstep": self._is_lockstep,
                "scheduler": granted.scheduler,
                "kernel": platform.release(),
                "machine": f"{platform.machine()}, {os.cpu_count()} cores",
            },
        )
        for warning in self._config.controller.warnings():
            self._emit("warning", {"detail": warning})
        self._control.fire(Trigger.BUS_READY)
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._end)
        sleep_until = make_sleeper(is_spinning=self._config.loop.spin)
        self._usage = Usage()
        status_every = round(STATUS_EVERY_S / self._config.loop.period_s)
        look_after_at = 0
        farewell = FAREWELL_CYCLES
        start_ns = now_ns() + self._period_ns
        while farewell:
            sleep_until(start_ns)
            woke_ns = now_ns()
            skipped = max(0, (woke_ns - start_ns) // self._period_ns)
            start_ns += skipped * self._period_ns  # skipped, never made up by a burst
            self._overruns += skipped
            self._cycle += skipped
            self._run_cycle(start_ns, woke_ns, skipped)
            if self._cycle >= look_after_at:
                look_after_at = self._cycle + status_every
                self._look_after()
            self._cycle += 1
            start_ns += self._period_ns
            if self._executor.is_ending and not self._control.machine.state.is_powered:
                farewell -= 1
                self._timeout_ns = min(self._timeout_ns, FAREWELL_TIMEOUT_NS)
        self._look_after()
        self._emit("timing", self._account())

    def _run_cycle(self, start_ns: int, woke_ns: int, skipped: int) -> None:
        cpu_ns = thread_time_ns()
        periods = 1 if self._is_lockstep else 1 + skipped
        if self._shared.estop_requests != self._estops_seen:
            self._estops_seen = self._shared.estop_requests
            self._take({"verb": "estop"})
        if self._must_end and not self._executor.is_ending:
            self._take({"verb": "end"})
        for record in self._commands.read(1):
            self._take(json.loads(record))
        self._executor.begin_cycle(periods)
        self._control.step(start_ns + self._timeout_ns, periods)
        sent_ns = now_ns()
        stamps = Stamps(
            woke_ns - start_ns,
            self._control.feedback_ns - start_ns,
            self._control.law_ns - start_ns,
            sent_ns - start_ns,
            thread_time_ns() - cpu_ns,
        )
        self._timing.note(stamps, is_fresh=self._control.is_fresh, skipped=skipped)
        ring = self._shared.samples
        offset = ring.begin(self._shared.layout.size)
        self._sampler.write(ring.memory, offset, (self._cycle, start_ns, self._overruns), stamps)
        ring.commit()
        self._flush_frames()
        self._shared.beat("loop", sent_ns)

    def _take(self, command: Mapping[str, Any], *, is_after_step: bool = False) -> None:
        """Carry out what came from outside of the bus, and record it first."""
        self._emit("input", {"is_after_step": is_after_step, "command": command})
        self._executor.execute(command)

    # --- every 100 ms ------------------------------------------------------------------------

    def _look_after(self) -> None:
        self._watch_supervisor()
        self._watch_gateway()
        bus, machine = self._bus, self._control.machine
        self._shared.post_status(
            {
                "state": machine.state.name,
                "fault": machine.fault.name,
                "cycle": self._cycle,
                "samples": self._sampler.seq,
                "overruns": self._overruns,
                "active_slot": self._executor.active_slot,
                "active_samples": self._executor.active_samples,
                "frames_sent": bus.stats.frames_sent,
                "frames_received": bus.stats.frames_received,
                "send_failures": bus.stats.send_failures,
                "late_frames": bus.late_frames,
                "unknown_frames": bus.unknown_frames,
                "error_frames": bus.error_frames,
                **({"buses": bus.counts()} if isinstance(bus, ArmGroup) else {}),
                "scheduler": self._granted.scheduler,
                "memory_locked": self._granted.memory_locked,
                "realtime_missing": list(self._granted.missing),
                "is_lockstep": self._is_lockstep,
                "amplifiers": [info.name for info in self._infos],
                **self._account(),
            }
        )

    def _account(self) -> dict[str, Any]:
        """What the run has cost so far, and what was late in it."""
        ladder, misses = self._control.ladder.counts(), self._timing.misses()
        return {**self._usage.since_start(), "ladder": ladder, "misses": misses}

    def _watch_supervisor(self) -> None:
        if os.getppid() != self._parent and not self._executor.is_ending:
            self._take({"verb": "supervisor_lost"}, is_after_step=True)

    def _watch_gateway(self) -> None:
        beat_ns = self._shared.last_beat("gateway")
        is_there = beat_ns > 0 and now_ns() - beat_ns < GATEWAY_TIMEOUT_NS
        if self._has_gateway and not is_there:
            policy = self._config.loop.on_gateway_loss
            self._take({"verb": "gateway_lost", "policy": policy}, is_after_step=True)
        self._has_gateway = is_there

    # --- reporting ---------------------------------------------------------------------------

    def _emit(self, kind: str, detail: Mapping[str, Any]) -> None:
        event = {"t_ns": now_ns(), "cycle": self._cycle, "kind": kind, **detail}
        self._shared.events.append(json.dumps(event).encode())

    def _report_outcome(self, command: Mapping[str, Any], reason: str) -> None:
        self._emit(
            "command",
            {"id": command["id"], "verb": command["verb"], "ok": not reason, "reason": reason},
        )

    def _log_frame(self, direction: int, frame: bytes, t_ns: int = 0) -> None:
        """Keep a frame for the ring; without an instant of its own it was seen just now."""
        entry = self._entry(t_ns or now_ns(), direction, frame)
        self._room -= len(entry)
        if self._room < 0:
            self._flush_frames()
            self._room -= len(entry)
        self._frames.append(entry)

    def _flush_frames(self) -> None:
        self._shared.frames.append(b"".join(self._frames))
        self._frames.clear()
        self._room = self._record_bytes

    def _end(self, *_: object) -> None:
        """Signal handler: from the next cycle on, come to a damped stop, then end."""
        self._must_end = True


def open_arm(
    config: Config, start_up: list[LoggedFrame] | None = None
) -> tuple[ArmLike, list[AxisInfo]]:
    """Join the bus, or all buses, and set up every amplifier, disabled.

    Args:
        config: Bus and axes.
        start_up: Takes every frame of the set-up, if given.

    Raises:
        DriverError: If the bus or an amplifier is not there or not as configured.
    """
    period_s = config.loop.period_s
    wires = open_buses(config.bus.addresses)
    if config.loop.spin:
        wires = [SpinningBus(wire) for wire in wires]
    bus = make_arm(wires, config.axes, period_s=period_s, now_ns=now_ns)
    if start_up is not None:
        bus.log_frames(lambda way, frame: start_up.append(LoggedFrame(now_ns(), way, frame)))
    try:
        return bus, configure_arm(bus, config.axes, period_s=period_s)
    except BaseException:
        bus.close()
        raise


def main(shared_fd: int, parent_pid: int) -> int:
    """Entry of the loop process.

    Returns:
        0 after an orderly end, 1 with one line on stderr otherwise.
    """
    die_with_parent(parent_pid)
    shared = SharedMemory(shared_fd)
    start_up: list[LoggedFrame] = []
    try:
        bus, infos = open_arm(shared.config, start_up)
    except DriverError as error:
        print(f"hil: {error}", file=sys.stderr)  # noqa: T201 - the line the user is promised
        return 1
    try:
        granted = make_realtime(shared.config.loop)
        freeze_garbage()
        Loop(shared, bus, infos, start_up).run(granted)
    except (HilError, BusError) as error:
        print(f"hil: {error}", file=sys.stderr)  # noqa: T201 - the line the user is promised
        return 1
    finally:
        _last_word(bus)
    return 0


def _last_word(bus: ArmLike) -> None:
    """Whatever ended the loop: tell every amplifier to take torque off, then leave the bus."""
    for axis in bus.axes:
        axis.disable()
    with suppress(BusError):  # the amplifiers' watchdogs act
        bus.request_feedback()
        with suppress(BusError):  # one bus of several; the others have got theirs
            bus.send_torques([0.0] * len(bus.axes))
        bus.request_feedback()
    bus.close()
