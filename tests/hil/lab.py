"""The product as its users run it: processes on a unix bus, a client, and a watcher on the bus.

Everything is waited for by polling a condition; deadlines are long, because a shared machine can
stall for tenths of a second, and never what a test measures.
"""

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import can
import numpy as np

from controller.machine import State
from drivers.cia402 import codec, sdo
from hil.client import Client
from hil.recording import Recording

START_TIMEOUT_S = 40.0
POLL_S = 0.005


def wait_until(condition, timeout_s=20.0, what="the condition"):
    """Poll until `condition()` is true; return what it returned."""
    deadline_s = time.monotonic() + timeout_s
    while True:
        value = condition()
        if value:
            return value
        assert time.monotonic() < deadline_s, f"{what} did not come true within {timeout_s:g} s"
        time.sleep(POLL_S)


def free_port():
    """A TCP port on loopback that nobody listens on now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def is_running(pid):
    """The process exists and is not a zombie."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return False
    return stat.rpartition(")")[2].split()[0] != "Z"


class HilProcess:
    """One `hil` command as a process of its own; its output goes to files."""

    def __init__(self, directory, *arguments, launcher=(), cwd=None, **environment):
        self.directory = Path(directory)
        number = len(list(self.directory.glob("*.stderr")))
        self.stdout_path = self.directory / f"{number}-{arguments[0]}.stdout"
        self.stderr_path = self.stdout_path.with_suffix(".stderr")
        clean = {k: v for k, v in os.environ.items() if not k.startswith("HIL_")}
        with self.stdout_path.open("w") as out, self.stderr_path.open("w") as err:
            self.process = subprocess.Popen(
                [*launcher, sys.executable, "-m", "hil", *arguments],
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=err,
                cwd=cwd or self.directory,
                env=clean | {"TMPDIR": str(self.directory), **environment},
            )
        self.pid = self.process.pid
        self._known = set()

    @property
    def stdout(self):
        return self.stdout_path.read_text()

    @property
    def stderr(self):
        return self.stderr_path.read_text()

    def wait_for_line(self):
        """Wait for the first whole line on stdout: the process is ready."""

        def is_ready():
            assert self.process.poll() is None or "\n" in self.stdout, self.stderr
            return "\n" in self.stdout

        wait_until(is_ready, START_TIMEOUT_S, f"{self.process.args[3]}: first line")
        return self.stdout.partition("\n")[0]

    def children(self):
        """Pids of the daemon's own processes by name."""
        found = {}
        for entry in Path("/proc").iterdir():
            if not entry.name.isdigit():
                continue
            try:
                parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
                words = (entry / "cmdline").read_bytes().split(b"\0")
            except (FileNotFoundError, ProcessLookupError):
                continue
            if parent == self.pid and b"hil.process" in words:
                found[words[words.index(b"hil.process") + 1].decode()] = int(entry.name)
        self._known.update(found.values())
        return found

    def wait(self, timeout_s=30.0):
        """Wait for the end; return the exit status."""
        return self.process.wait(timeout_s)

    def end(self, number=signal.SIGTERM):
        """Send a signal and wait for the end; return the exit status."""
        if self.process.poll() is None:
            self.process.send_signal(number)
        return self.wait()

    def close(self):
        """Leave nothing behind, whatever state the process is in."""
        if self.process.poll() is None:
            self.children()
        if self.process.poll() is None:
            self.process.terminate()
            try:
                self.process.wait(10)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait()
        for pid in self._known:
            if is_running(pid):
                os.kill(pid, signal.SIGKILL)


@dataclass(frozen=True)
class SeenFrame:
    t_s: float
    can_id: int
    data: bytes


class BusWatcher:
    """A node of its own on the bus, through python-can: hears all, reads a drive's objects."""

    def __init__(self, bus):
        self._bus = bus
        self.frames = deque(maxlen=200_000)
        self._is_ended = False
        self._thread = threading.Thread(target=self._listen)
        self._thread.start()

    def _listen(self):
        while not self._is_ended:
            try:
                message = self._bus.recv(0.05)
            except can.CanError:  # the emulator has gone
                return
            if message is not None:
                seen = SeenFrame(time.monotonic(), message.arbitration_id, bytes(message.data))
                self.frames.append(seen)

    def with_id(self, can_id):
        return [frame for frame in list(self.frames) if frame.can_id == can_id]

    def emergencies(self, node):
        """Codes of the emergency messages of a node so far."""
        frames = self.with_id(codec.COB_EMCY + node)
        return [codec.parse_emcy(frame.data).code for frame in frames]

    def state(self, node):
        """The drive's state, from its statusword by SDO."""
        return codec.decode_state(int.from_bytes(self.read(node, codec.Index.STATUSWORD), "little"))

    def torque(self, node):
        """The drive's torque actual value by SDO, per mille of rated."""
        raw = self.read(node, codec.Index.TORQUE_ACTUAL)
        return int.from_bytes(raw, "little", signed=True)

    def read(self, node, index):
        """Read an object by SDO."""
        request = sdo.sdo_upload_request(index, 0)
        start_s = time.monotonic()
        self._bus.send(
            can.Message(arbitration_id=codec.COB_SDO_RX + node, data=request, is_extended_id=False)
        )

        def answer():
            for frame in reversed(list(self.frames)):
                if frame.t_s < start_s:
                    return None
                if frame.can_id == codec.COB_SDO_TX + node:
                    return sdo.parse_sdo_response(frame.data)
            return None

        return wait_until(answer, 5.0, f"SDO answer of node {node}").data

    def close(self):
        self._is_ended = True
        self._thread.join()
        self._bus.shutdown()


class Arm:
    """A running daemon seen by a client: its telemetry so far, and waiting for its states."""

    def __init__(self, daemon, client, recording):
        self.daemon = daemon
        self.client = client
        self.recording = recording
        self.statuses = deque(maxlen=1000)
        self.events = deque(maxlen=10_000)
        self._batches = []
        client.on_telemetry(self._batches.append)
        client.on_status(self.statuses.append)
        client.on_event(self.events.append)
        wait_until(lambda: self._batches, what="telemetry")

    def rows(self):
        """All samples received so far."""
        return np.concatenate(list(self._batches))

    @property
    def now(self):
        """The newest sample."""
        return self._batches[-1][-1]

    @property
    def state(self):
        return State(int(self.now["state"]))

    @property
    def seq(self):
        return int(self.now["seq"])

    def since(self, seq):
        rows = self.rows()
        return rows[rows["seq"] > seq]

    def wait_for(self, state, timeout_s=30.0):
        wait_until(lambda: self.state is state, timeout_s, f"state {state.name}")

    def wait_until_at(self, t_ref_s, timeout_s=30.0):
        """Wait until the running motion is so far along."""

        def is_there():
            assert self.state is not State.FAULT, list(self.events)
            return self.state is State.ACTIVE and self.now["t_ref_s"] >= t_ref_s

        wait_until(is_there, timeout_s, f"t_ref {t_ref_s} s")

    def catch_up(self):
        """Wait for the sample of a cycle that began after this call: telemetry takes its time."""
        now_ns = time.monotonic_ns()
        wait_until(lambda: self.now["t_ns"] >= now_ns, what="telemetry of this instant")

    def state_now(self):
        """The state after this call."""
        self.catch_up()
        return self.state

    def wait_cycles(self, cycles):
        """Wait until so many cycles have been run from now on."""
        self.catch_up()
        goal = self.seq + cycles
        wait_until(lambda: self.seq >= goal, what=f"{cycles} cycles")

    def make_ready(self):
        """Bring the arm to rest under power, whatever it is doing."""
        self.catch_up()
        if self.state in (State.ESTOP, State.FAULT):
            self.client.command("reset")
            self.wait_for(State.IDLE)
        if self.state is State.ACTIVE:
            self.client.command("stop")
            self.wait_for(State.HOLD)
        if self.state is State.IDLE:
            self.client.command("enable")
            self.wait_for(State.READY)
        assert self.state in (State.READY, State.HOLD)

    def swing(self, duration_s=60.0, amplitude_rad=(0.5, 0.4), approach="blend"):
        """Start a long sinusoid about the present reference; return once it really moves.

        An arm that coasted towards a limit (emergency stop: nothing brakes it) comes back first.
        """
        room_rad = 1.2 if approach == "blend" else 2.8
        center_rad = [max(-room_rad, min(room_rad, q)) for q in self.now["q_des_rad"].tolist()]
        self.client.command(
            "trajectory",
            kind="sinusoid",
            duration_s=duration_s,
            center_rad=center_rad,
            amplitude_rad=list(amplitude_rad),
            frequency_Hz=[0.5, 0.5],
            ramp_s=0.5,
            approach=approach,
        )
        self.wait_until_at(0.5)


class Lab:
    """One place for an emulator and the daemons that run on it, gone when the test is over."""

    def __init__(self, directory):
        self.directory = Path(directory)
        self.bus_path = self.directory / "bus"
        self.bus = f"unix:{self.bus_path}"
        self.arm = "lab"
        self.port = free_port()
        self.endpoint = f"tcp/127.0.0.1:{self.port}"
        self._stack = ExitStack()
        self._recordings = 0

    def start(self, *arguments, **keywords):
        """Start a `hil` command; nothing is waited for."""
        process = HilProcess(self.directory, *arguments, **keywords)
        self._stack.callback(process.close)
        return process

    def settings(self, *assignments):
        """Options of both emulator and daemon: this bus, and rights where the host gives them."""
        options = ["--bus", self.bus]
        for assignment in ("loop.realtime=best_effort", *assignments):
            options += ["--set", assignment]
        return options

    def emulate(self, *assignments, time="lockstep"):
        process = self.start("emulate", *self.settings(*assignments), "--time", time)
        process.wait_for_line()
        return process

    def run_options(self, *assignments):
        self._recordings += 1
        own = (f"arm.name={self.arm}", f'zenoh.listen=["{self.endpoint}"]')
        record = self.directory / f"run{self._recordings}.mcap"
        return ["run", *self.settings(*own, *assignments), "--record", str(record)], record

    def run(self, *assignments):
        """Start a daemon and connect a client to it."""
        options, record = self.run_options(*assignments)
        daemon = self.start(*options)
        daemon.wait_for_line()
        return Arm(daemon, self.connect(), record)

    def connect(self):
        client = Client(self.arm, [self.endpoint])
        self._stack.callback(client.close)
        return client

    def join_bus(self):
        """A python-can participant of its own."""
        return can.Bus(interface="hil-unix", channel=str(self.bus_path))

    def watch_bus(self):
        watcher = BusWatcher(self.join_bus())
        self._stack.callback(watcher.close)
        return watcher

    def send(self, *arguments):
        """Run `hil send` to its end."""
        process = self.start("send", *arguments, "--arm", self.arm, "--connect", self.endpoint)
        process.wait()
        return process

    def close(self):
        self._stack.close()


def one_line(process):
    """The one line a failing command is allowed on stderr."""
    lines = process.stderr.splitlines()
    assert len(lines) == 1, process.stderr
    assert lines[0].startswith("hil: ")
    assert "Traceback" not in process.stderr
    return lines[0]


def whole(path):
    """Open a recording that must be closed and complete, and check that no sample is missing."""
    recording = Recording.open(path)
    assert not recording.is_truncated
    assert np.array_equal(recording.samples["seq"], np.arange(len(recording.samples)))
    return recording


def largest_jump(samples):
    """Largest step of q_des and dq_des between neighbouring samples, over what a smooth one makes.

    In a period of 1 ms a joint moves by dq * T + ddq * T^2 / 2 and gains ddq * T; the preset
    allows 20 rad/s^2. Both quotients are 1 at most, with a tenth for rounding.
    """
    ddq_max, period_s = 22.0, 1e-3
    q, dq = samples["q_des_rad"], samples["dq_des_rad_s"]
    step_rad = np.abs(np.diff(q, axis=0) - dq[:-1] * period_s) / (ddq_max * period_s**2)
    step_rad_s = np.abs(np.diff(dq, axis=0)) / (ddq_max * period_s)
    return float(max(step_rad.max(), step_rad_s.max()))
