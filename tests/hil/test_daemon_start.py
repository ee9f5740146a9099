"""Daemons that cannot start, and the conditions they start under: one line, the right status."""

import signal
import sys
from pathlib import Path

import pytest

from hil.recording import Recording
from tests.hil.lab import HilProcess, free_port, one_line

LAUNCHER = """
import ctypes, os, resource, sys
libc = ctypes.CDLL(None)
for capability in (14, 23):  # CAP_IPC_LOCK, CAP_SYS_NICE
    libc.prctl(24, capability, 0, 0, 0)  # PR_CAPBSET_DROP: gone with the next exec, root or not
resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
resource.setrlimit(resource.RLIMIT_MEMLOCK, (65536, 65536))
os.execv(sys.argv[1], sys.argv[1:])
"""
WITHOUT_RIGHTS = (sys.executable, "-c", LAUNCHER)
"""Runs a command that will not be given real time, whoever runs the tests."""


@pytest.fixture(scope="module")
def emulated(shared_lab):
    shared_lab.emulate()
    return shared_lab


def start(lab, *assignments, **keywords):
    options, _ = lab.run_options(*assignments)
    return lab.start(*options, **keywords)


def test_run__no_emulator__says_where_and_what_to_start(lab):
    options, record = lab.run_options()
    daemon = lab.start(*options)
    assert daemon.wait() == 1
    line = one_line(daemon)
    assert f"no bus at unix:{lab.bus_path}" in line
    assert "start `hil emulate` first" in line
    assert not record.exists()
    assert daemon.stdout == ""


def test_run__amplifier_silent__says_which(emulated):
    daemon = start(emulated, "axes.2.node_id=9", "axes.2.sdo_timeout_s=0.1")
    assert daemon.wait() == 1
    assert "joint 2 (cia402 node 9): no SDO answer" in one_line(daemon)


@pytest.mark.parametrize("place", ["file in the way", "not writable", "directory itself"])
def test_run__recording_impossible__says_where(emulated, tmp_path, place):
    (tmp_path / "file").touch()
    record = {
        "file in the way": tmp_path / "file" / "a.mcap",
        "not writable": Path("/proc/self/a.mcap"),  # for root, too
        "directory itself": tmp_path,
    }[place]
    options, _ = emulated.run_options()
    options[options.index("--record") + 1] = str(record)
    daemon = emulated.start(*options)
    assert daemon.wait() == 1
    assert str(record.parent) in one_line(daemon)


def test_run__realtime_required_and_not_granted__says_what_is_missing(emulated):
    daemon = start(emulated, "loop.realtime=required", launcher=WITHOUT_RIGHTS)
    assert daemon.wait() == 1
    line = one_line(daemon)
    assert "real time is required but not granted" in line
    assert "SCHED_FIFO priority 80" in line
    assert "locked memory" in line
    assert 'loop.realtime = "best_effort"' in line


def test_run__realtime_best_effort_and_not_granted__runs_and_status_says_so(emulated):
    options, record = emulated.run_options()
    daemon = emulated.start(*options, launcher=WITHOUT_RIGHTS)
    daemon.wait_for_line()
    client = emulated.connect()
    statuses = []
    client.on_status(statuses.append)
    watch = emulated.start(
        "watch", "--for", "1", "--arm", emulated.arm, "--connect", emulated.endpoint
    )
    assert watch.wait() == 0
    assert "IDLE" in watch.stdout
    assert " 0 lost" in watch.stdout.splitlines()[-1]
    assert statuses[-1]["scheduler"] == "SCHED_OTHER"
    assert len(statuses[-1]["realtime_missing"]) == 2
    assert daemon.end(signal.SIGINT) == 0
    assert daemon.stderr == ""
    (started,) = [e for e in Recording.open(record).events if e.kind == "start"]
    assert started.detail["scheduler"] == "SCHED_OTHER"


def test_run__interrupted_while_starting__ends_in_order(emulated):
    daemon = start(emulated)
    while not daemon.children():
        assert daemon.process.poll() is None
    assert daemon.end(signal.SIGINT) == 0
    assert daemon.stderr == ""


def test_run__configuration_cannot_fit_on_the_bus__shows_the_arithmetic(emulated):
    daemon = start(emulated, "bus.bit_rate=250000")
    assert daemon.wait() == 1
    line = one_line(daemon)
    assert "does not fit on the bus" in line
    assert "SYNC" in line


def test_emulate__twice_on_one_bus__second_refused(emulated):
    second = emulated.start("emulate", "--bus", f"unix:{emulated.bus_path}")
    assert second.wait() == 1
    assert "another emulator already listens" in one_line(second)


def test_emulate__directory_missing__says_so(tmp_path):
    emulator = HilProcess(tmp_path, "emulate", "--bus", f"unix:{tmp_path}/no/where")
    assert emulator.wait() == 1
    assert f"no directory {tmp_path}/no" in one_line(emulator)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=lambda n: n.name)
def test_emulate__signal__ends_with_0_and_leaves_no_socket(tmp_path, number):
    emulator = HilProcess(tmp_path, "emulate", "--bus", f"unix:{tmp_path}/bus", "--time", "wall")
    assert f"unix:{tmp_path}/bus, wall" in emulator.wait_for_line()
    assert emulator.end(number) == 0
    assert emulator.stderr == ""
    assert not (tmp_path / "bus").exists()


def test_send__no_daemon__one_line(tmp_path):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    send = HilProcess(tmp_path, "send", "enable", "--connect", endpoint)
    assert send.wait() == 1
    assert f"nobody answers at {endpoint}" in one_line(send)
