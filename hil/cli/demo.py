"""`hil demo`: the whole product once: emulator, daemon, subscriber and client, over real frames."""

import argparse
import json
import shlex
import signal
import socket
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from time import monotonic, sleep
from typing import IO, Any, Self

from tqdm import tqdm

from controller.machine import State
from hil.cli.options import configuration
from hil.client import Client
from hil.errors import HilError
from hil.experiment import scenario_request
from hil.fixed_protobuf import Records
from hil.metrics import Timing, timing
from hil.recording import Recording
from hil.report import write_report
from hil.scenarios import find_scenario
from hil.verdict import judge

RECORDING = "demo.mcap"
END_TIMEOUT_S = 15.0
SETTLE_S = 0.3


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the verb's options."""
    parser.add_argument("--scenario", default="A", help="A, B or E (default: %(default)s)")
    parser.add_argument("--bus", metavar="ADDRESS", help="default: a unix bus of its own")
    parser.add_argument("--time", choices=("lockstep", "wall"), default="lockstep")
    parser.add_argument("--out", metavar="DIR", help="default: runs/demo-DATE-TIME")
    parser.add_argument("--set", action="append", default=[], dest="assignments",
                        metavar="TABLE.KEY=VALUE", help="change any setting")  # fmt: skip
    parser.set_defaults(config=None)


def run(options: argparse.Namespace) -> int:
    """Run the demonstration; 0 only if the run was whole and every bound is met."""
    configuration(options)  # a mistake is told before anything starts
    stamp = time.strftime("%Y%m%d-%H%M%S")
    directory = Path(options.out or f"runs/demo-{stamp}")
    directory.mkdir(parents=True, exist_ok=True)
    outcome = Demo(options, directory).run()
    recording = Recording.open(directory / RECORDING)
    text, has_passed = judge(recording)
    print(f"\n{outcome.text(timing(recording.samples))}\n\n{text}\n")
    print(f"recording  {recording.path}")
    print(f"report     {write_report(recording.path, directory)}")
    return 0 if has_passed and outcome.is_whole else 1


class DemoError(HilError):
    """The demonstration could not run to its end; the message says which part failed."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """What the processes of a demonstration counted."""

    status: dict[str, Any]
    received: int
    lost: int

    @property
    def is_whole(self) -> bool:
        """Nothing was lost between the loop and the subscriber in another process."""
        return self.lost == 0 and self.status["telemetry_lost"] == 0 and self.received > 0

    def text(self, timing: Timing) -> str:
        """Return the counts for a terminal, with the timing of the whole run."""
        s = self.status
        late, busy = timing.wake_late_us, timing.busy_us
        rights = "" if not s["realtime_missing"] else f" ({'; '.join(s['realtime_missing'])})"
        mode = "lockstep" if s["is_lockstep"] else "wall clock"
        return (
            f"cycles      {s['samples']} run, {s['overruns']} skipped, {mode}, "
            f"{s['scheduler']}{rights}\n"
            f"lateness    p50 {late[0]:.0f} us, p99 {late[1]:.0f} us, worst {late[2]:.0f} us\n"
            f"busy        p50 {busy[0]:.0f} us, p99 {busy[1]:.0f} us of each 1000 us\n"
            f"bus         {s['frames_sent']} frames sent, {s['frames_received']} received, "
            f"{s['send_failures']} not sent, {s['late_frames']} late\n"
            f"telemetry   {s['telemetry_published']} samples published; {self.received} "
            f"received by another process, {self.lost} lost"
        )


class Demo:
    """Runs one scenario through separate processes."""

    def __init__(self, options: argparse.Namespace, directory: Path) -> None:
        self._scenario = find_scenario(options.scenario)
        if self._scenario.velocity.kind == "true":
            raise DemoError(
                f"scenario {self._scenario.name} has ideal amplifiers without frames; "
                f"run it with: hil sim --scenario {self._scenario.name}"
            )
        self._directory = directory
        self._recording = directory / RECORDING
        self._port = _free_port()
        self._bus = options.bus
        self._time = options.time
        self._assignments: list[str] = options.assignments
        self._t_ref_s = 0.0
        self._state = State.INIT

    def run(self) -> Outcome:
        """Run it and return what was counted.

        Raises:
            DemoError: If a process does not start or the arm trips.
            RefusedError: If the daemon refuses a command.
        """
        with tempfile.TemporaryDirectory(prefix="hil-") as scratch:
            bus = self._bus or f"unix:{scratch}/bus.sock"
            with (
                _Child("emulate", *self._settings(bus), "--time", self._time) as emulator,
                _Child("run", *self._settings(bus), "--record", str(self._recording)) as daemon,
            ):
                del emulator
                return self._command(daemon)

    def _settings(self, bus: str) -> list[str]:
        arguments = ["--scenario", self._scenario.name, "--bus", bus]
        arguments += ["--set", "arm.name=demo", "--set", "loop.realtime=best_effort"]
        arguments += ["--set", f'zenoh.listen=["tcp/127.0.0.1:{self._port}"]']
        for assignment in self._assignments:
            arguments += ["--set", assignment]
        return arguments

    def _command(self, daemon: "_Child") -> Outcome:
        endpoint = f"tcp/127.0.0.1:{self._port}"
        connection = ["--arm", "demo", "--connect", endpoint]
        with (
            _Child("watch", "--count", *connection) as counter,
            Client("demo", [endpoint]) as client,
        ):
            statuses: list[dict[str, Any]] = []
            client.on_status(statuses.append)
            client.on_telemetry(self._follow)
            client.command("enable")
            request = scenario_request(self._scenario).model_dump(exclude_none=True)
            reply = client.command("trajectory", **request)
            self._show_progress(reply.duration_s or 0.0)
            client.command("disable")
            daemon.end()  # it publishes its last samples and status before it goes
            sleep(SETTLE_S)
            counted = json.loads(counter.end())
        return Outcome(statuses[-1], counted["received"], counted["lost"])

    def _follow(self, rows: Records) -> None:
        self._t_ref_s = float(rows["t_ref_s"][-1])
        self._state = State(int(rows["state"][-1]))

    def _show_progress(self, duration_s: float) -> None:
        """Follow the trajectory to its end.

        Raises:
            DemoError: If the arm leaves the powered states, or the motion does not end.
        """
        bar_format = "tracking {bar:30} {n:.1f} of {total:.1f} s"
        deadline_s = monotonic() + 2.0 * duration_s + 10.0
        with tqdm(total=duration_s, bar_format=bar_format, mininterval=0.5) as bar:
            sleep(SETTLE_S)
            while self._state is State.ACTIVE and monotonic() < deadline_s:
                bar.update(self._t_ref_s - bar.n)
                sleep(0.1)
            bar.update(duration_s - bar.n)
        if self._state is not State.HOLD:
            raise DemoError(f"the arm is in state {self._state.name} instead of HOLD")


class _Child:
    """One `hil` process: started with a line shown, ready when it prints its first line."""

    def __init__(self, *arguments: str) -> None:
        self._name = arguments[0]
        self._arguments = arguments
        self._output: IO[str]

    def __enter__(self) -> Self:
        print(f"$ hil {shlex.join(self._arguments)}")
        self._process = subprocess.Popen(  # noqa: S603 - our own command
            [sys.executable, "-m", "hil", *self._arguments], stdout=subprocess.PIPE, text=True
        )
        assert self._process.stdout is not None  # noqa: S101 - it is a pipe
        self._output = self._process.stdout
        line = self._output.readline()
        if not line:
            self._process.wait(END_TIMEOUT_S)
            raise DemoError(f"hil {self._name} did not start")
        if self._name != "watch":
            print(f"  {line.strip()}")
        return self

    def end(self) -> str:
        """Ask the process to end and return what else it printed."""
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGTERM)
        try:
            rest, _ = self._process.communicate(timeout=END_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            rest, _ = self._process.communicate()
        return rest

    def __exit__(self, *_: object) -> None:
        if self._process.returncode is None:
            self.end()


def _free_port() -> int:
    """Return a TCP port on loopback that nobody listens on now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port
