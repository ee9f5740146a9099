"""The units, as far as they can be checked without a running systemd."""

import configparser
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from hil.notify import Watchdog, notify
from tests.hil.lab import START_TIMEOUT_S, HilProcess, Lab, wait_until

ROOT = Path(__file__).parents[2]
SYSTEMD = ROOT / "deploy" / "systemd"
SERVICES = sorted(path.name for path in SYSTEMD.glob("*.service"))
WORST = {"hil@.service": 25, "hil-emulator@.service": 20, "hil-router.service": 20}
"""Largest exposure by `systemd-analyze security`, in tenths; 100 is no sandbox at all."""


@pytest.fixture
def analyze():
    """The systemd-analyze of this host."""
    path = shutil.which("systemd-analyze")
    if path is None:
        pytest.skip("no systemd-analyze: apt-get install systemd")
    return path


@pytest.fixture
def units(tmp_path):
    """The units with programs that are there."""
    hil = Path(sys.executable).with_name("hil")
    for path in [*SYSTEMD.glob("*.service"), *SYSTEMD.glob("*.slice")]:
        text = path.read_text().replace("/opt/hil/.venv/bin/hil", str(hil))
        (tmp_path / path.name).write_text(text.replace("/usr/bin/zenohd", "/bin/true"))
    return tmp_path


def settings(path, section):
    """Last value of every setting of one section."""
    parser = configparser.ConfigParser(strict=False, interpolation=None, delimiters=("=",))
    parser.optionxform = str
    parser.read(path)
    return dict(parser[section])


def test_units__all__are_accepted(analyze, units):
    files = [str(path) for path in sorted(units.iterdir())]
    command = [analyze, "verify", *files]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    ours = [line for line in done.stderr.splitlines() if "hil" in line]
    assert (done.returncode, ours) == (0, [])


def test_units__with_a_mistake__are_not(analyze, units):
    path = units / "hil@.service"
    path.write_text(path.read_text().replace("KillMode=mixed", "KillMode=mixd"))
    command = [analyze, "verify", str(path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert "mixd" in done.stderr


@pytest.mark.parametrize("name", SERVICES)
def test_units__sandbox__is_as_tight_as_it_was(analyze, units, name):
    threshold = f"--threshold={WORST[name]}"
    command = [analyze, "security", "--offline=yes", "--no-pager", threshold, units / name]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stdout.splitlines()[-1:]


def test_daemon_unit__restart__leaves_it_to_the_operator_to_enable():
    service = settings(SYSTEMD / "hil@.service", "Service")
    assert service["Type"] == "notify"
    assert service["Restart"] == "on-failure"
    assert service["KillMode"] == "mixed"
    assert int(service["WatchdogSec"]) >= 2
    assert "send" not in (SYSTEMD / "hil@.service").read_text()  # no command of any kind


@pytest.mark.parametrize("name", ["hil@.service", "hil-emulator@.service"])
def test_units__real_time__is_granted(name):
    service = settings(SYSTEMD / name, "Service")
    assert int(service["LimitRTPRIO"]) >= 80
    assert service["LimitMEMLOCK"] == "infinity"
    assert service["CapabilityBoundingSet"] == ""
    assert "RestrictRealtime" not in service


@pytest.mark.parametrize("name", ["hil@.service", "hil-emulator@.service"])
def test_units__configuration__is_not_theirs_to_write(name):
    """A ConfigurationDirectory= would be the one writable place in /etc, keys included."""
    service = settings(SYSTEMD / name, "Service")
    assert service["ProtectSystem"] == "strict"
    assert "ConfigurationDirectory" not in service


def test_units__daemon__waits_for_an_emulator_that_says_when_its_bus_is_there():
    assert settings(SYSTEMD / "hil-emulator@.service", "Service")["Type"] == "notify"
    assert "hil-emulator@%i.service" in settings(SYSTEMD / "hil@.service", "Unit")["After"]


def test_udev_rules__every_line__is_an_assignment_or_a_match():
    word = re.compile(r'[A-Z]+(\{[\w/]+\})?(==|\+=|=)"[^"]*"')
    for line in (ROOT / "deploy" / "udev" / "60-hil.rules").read_text().splitlines():
        if line and not line.startswith("#"):
            assert all(word.fullmatch(part) for part in line.split(", ")), line


# --- what systemd is told -----------------------------------------------------------------------


@pytest.fixture
def service_manager(tmp_path):
    """The socket on which systemd listens, and its path."""
    path = tmp_path / "notify"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(path))
        listener.setblocking(False)
        yield listener, str(path)


def heard(listener):
    """All messages that have come."""
    found = []
    while True:
        try:
            found.append(listener.recv(4096).decode())
        except BlockingIOError:
            return found


@pytest.mark.parametrize("address", ["", "relative", "/nobody/here", "@nobody-here-either"])
def test_notify__nobody_listens__does_nothing(monkeypatch, address):
    monkeypatch.setenv("NOTIFY_SOCKET", address)
    notify("READY=1")


def test_watchdog__called_often__speaks_at_half_the_time(monkeypatch, service_manager):
    listener, path = service_manager
    monkeypatch.setenv("NOTIFY_SOCKET", path)
    monkeypatch.setenv("WATCHDOG_USEC", "60000000")
    monkeypatch.setenv("WATCHDOG_PID", str(os.getpid()))
    watchdog = Watchdog()
    for _ in range(100):
        watchdog.beat()
    assert watchdog.period_s == 30.0
    assert heard(listener) == ["WATCHDOG=1"]


@pytest.mark.parametrize(("usec", "pid"), [("", None), ("x", None), ("1000", "1")])
def test_watchdog__not_asked_for__is_silent(monkeypatch, service_manager, usec, pid):
    listener, path = service_manager
    monkeypatch.setenv("NOTIFY_SOCKET", path)
    monkeypatch.setenv("WATCHDOG_USEC", usec)
    monkeypatch.setenv("WATCHDOG_PID", pid or str(os.getpid()))
    Watchdog().beat()
    assert heard(listener) == []


def test_emulator__under_a_service_manager__is_ready_when_its_bus_can_be_joined(
    tmp_path, service_manager
):
    listener, path = service_manager
    bus = tmp_path / "bus.sock"
    emulator = HilProcess(tmp_path, "emulate", "--bus", f"unix:{bus}", NOTIFY_SOCKET=path)
    try:
        assert wait_for_message(listener, START_TIMEOUT_S) == b"READY=1"
        assert bus.is_socket()
    finally:
        emulator.close()


def test_daemon__under_a_service_manager__is_ready_alive_silent_when_stuck_and_stopping(
    tmp_path, service_manager
):
    listener, path = service_manager
    lab = Lab(tmp_path)
    try:
        lab.emulate()
        options, _ = lab.run_options()
        daemon = lab.start(*options, NOTIFY_SOCKET=path, WATCHDOG_USEC="200000")
        daemon.wait_for_line()
        told = []
        wait_until(lambda: told.extend(heard(listener)) or told.count("WATCHDOG=1") > 2)
        assert told[0] == "READY=1"
        loop = daemon.children()["loop"]
        os.kill(loop, signal.SIGSTOP)  # it does not cycle any more: systemd is to hear nothing

        def is_silent():
            heard(listener)
            return not wait_for_message(listener, 1.0)

        wait_until(is_silent, what="silence")
        os.kill(loop, signal.SIGCONT)
        daemon.end()
        assert "STOPPING=1" in heard(listener)
    finally:
        lab.close()


def wait_for_message(listener, timeout_s):
    """The next message, or nothing."""
    listener.settimeout(timeout_s)
    try:
        return listener.recv(4096)
    except TimeoutError:
        return b""
    finally:
        listener.setblocking(False)
