"""Two clients, a router and three subscribers of a daemon at 1 kHz; one is slow, one dies again.

    python -m benchmarks.remote_soak --seconds 3600 [--baseline 600] [--time wall]

Exit status 0: the healthy subscriber got every sample, no command failed, and the loop missed no
larger share of its deadlines than in the run without clients that comes first (give or take what
two equal runs differ by, which `--tolerance` says).
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path
from time import monotonic, sleep

from hil.client import Arm, NoAuthorityError
from hil.errors import HilError

ROUTER = """
import sys, time
from hil.config import ZenohSettings
from hil.session import open_session
with open_session(ZenohSettings(mode="router", listen=(sys.argv[1],))):
    print("ready", flush=True)
    time.sleep(10**6)
"""
SLOW = """
import sys, time
from hil.client import Client
with Client(sys.argv[1], [sys.argv[2]]) as client:
    client.on_telemetry(lambda rows: time.sleep(0.2))
    print("ready", flush=True)
    time.sleep(10**6)
"""
NAME = "soak"
DIES_EVERY_S = 20.0
MOVE_RAD = 0.5


class Processes:
    """Everything that runs, gone at the end."""

    def __init__(self, stack, directory, arguments):
        self._stack = stack
        self._bus = f"unix:{directory}/bus"
        self._directory = directory
        self.direct, self.router = (f"tcp/127.0.0.1:{free_port()}" for _ in range(2))
        self._time = arguments.time

    def start(self, *command):
        process = subprocess.Popen(
            [sys.executable, *command], stdout=subprocess.PIPE, text=True, cwd=self._directory
        )
        self._stack.callback(end, process)
        if not process.stdout.readline():
            raise SystemExit(f"did not start: {' '.join(command[:4])}")
        return process

    def emulate(self):
        return self.start("-m", "hil", "emulate", "--bus", self._bus, "--time", self._time)

    def run(self):
        own = [f"arm.name={NAME}", f'zenoh.listen=["{self.direct}"]', "loop.realtime=best_effort"]
        own += [f'zenoh.connect=["{self.router}"]', "recording.is_enabled=false"]
        options = [word for setting in own for word in ("--set", setting)]
        return self.start("-m", "hil", "run", "--bus", self._bus, *options)

    def subscribe(self):
        return self.start(
            "-m", "hil", "watch", "--count", "--arm", NAME, "--connect", self.router
        )  # fmt: skip


def free_port():
    import socket

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def end(process):
    if process.poll() is None:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(10)
        except subprocess.TimeoutExpired:
            process.kill()
    process.wait()
    process.stdout.close()


def counted(process):
    process.send_signal(signal.SIGTERM)
    text, _ = process.communicate(timeout=30)
    return json.loads(text.splitlines()[-1])


def work(arm, other, until_s, tick):
    """Two operators take turns: one moves, the other is refused meanwhile, then it sets gains."""
    moves = refusals = 0
    while monotonic() < until_s:
        with arm.client.authority():
            target = [MOVE_RAD if moves % 2 else -MOVE_RAD] * len(arm.state.q_rad)
            arm.move(target, wait=False)
            try:
                other.client.command("stop")
            except NoAuthorityError:
                refusals += 1
            arm.wait(60.0)
        bound = 2.0 + moves % 3
        other.set_gain_bounds([1.0] * len(target), [bound] * len(target))
        moves += 1
        tick()
    return moves, refusals


def misses(status, before):
    """Deadlines missed per million cycles since an earlier status."""
    cycles = status["samples"] - before["samples"]
    names = status["misses"]
    missed = sum(value - before["misses"].get(name, 0) for name, value in names.items())
    return 1e6 * (missed + status["overruns"] - before["overruns"]) / max(1, cycles)


def baseline(processes, seconds):
    """The same daemon alone: enabled, in motion, nobody listens."""
    with Arm(NAME, [processes.direct]) as arm:
        arm.enable()
        arm.client.acquire()
        center = arm.state.q_des_rad.tolist()
        n = len(center)
        arm.start({"kind": "sinusoid", "duration_s": min(seconds, 100.0), "center_rad": center,
                   "amplitude_rad": [0.3] * n, "frequency_Hz": [0.3] * n})  # fmt: skip
        before = arm.client.status()
    sleep(seconds)
    with Arm(NAME, [processes.direct], observe=True) as arm:
        return misses(arm.client.status(), before)


def soak(processes, seconds):
    """Everybody at once; return what was counted."""
    healthy = processes.subscribe()
    slow = processes.start("-c", SLOW, NAME, processes.router)
    dying, deaths, dies_s = processes.subscribe(), 0, monotonic() + DIES_EVERY_S

    def tick():
        nonlocal dying, deaths, dies_s
        if monotonic() < dies_s:
            return
        os.kill(dying.pid, signal.SIGKILL)
        dying.wait()
        dying, deaths, dies_s = processes.subscribe(), deaths + 1, monotonic() + DIES_EVERY_S

    with (
        Arm(NAME, [processes.router], operator="one", observe=True) as one,
        Arm(NAME, [processes.direct], operator="two", observe=True) as two,
    ):
        two.client.command("stop")
        before = two.client.status()
        moves, refusals = work(one, two, monotonic() + seconds, tick)
        sleep(0.3)
        status = two.client.status()
        rate = misses(status, before)
        lost = {"client one": one_lost(one), "client two": one_lost(two)}
        two.disable()
    lost |= {"healthy": counted(healthy)["lost"], "restarted": counted(dying)["lost"]}
    end(slow)
    return {"moves": moves, "refusals": refusals, "deaths": deaths, "lost": lost, "rate": rate,
            "samples": status["samples"] - before["samples"],
            "telemetry_lost": status["telemetry_lost"]}  # fmt: skip


def one_lost(arm):
    return arm._log.lost


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=3600.0)
    parser.add_argument("--baseline", type=float, metavar="S", help="default: a sixth of it")
    parser.add_argument("--time", choices=("lockstep", "wall"), default="lockstep")
    parser.add_argument("--tolerance", type=float, default=0.5, help="of the share of misses")
    options = parser.parse_args(arguments)
    with ExitStack() as stack:
        directory = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="hil-soak-")))
        processes = Processes(stack, directory, options)
        processes.start("-c", ROUTER, processes.router)
        processes.emulate()
        processes.run()
        try:
            alone = baseline(processes, options.baseline or max(5.0, options.seconds / 6))
            print(f"alone      {alone:.0f} misses per million cycles", flush=True)
            found = soak(processes, options.seconds)
        except HilError as error:
            print(f"FAILED     {error}")
            return 1
    print(f"together   {found['rate']:.0f} misses per million cycles")
    print(f"samples    {found['samples']}, lost by the gateway {found['telemetry_lost']}")
    print(f"lost       {', '.join(f'{who} {n}' for who, n in found['lost'].items())}")
    print(f"operators  {found['moves']} moves, {found['refusals']} refusals by name")
    print(f"killed     {found['deaths']} times")
    is_kept = found["rate"] <= alone * (1 + options.tolerance) + 100
    is_whole = not any(found["lost"].values()) and not found["telemetry_lost"]
    print(f"verdict    {'whole' if is_whole else 'LOST'}, {'kept' if is_kept else 'MISSES'}")
    return 0 if is_whole and is_kept and found["refusals"] == found["moves"] else 1


if __name__ == "__main__":
    sys.exit(main())
