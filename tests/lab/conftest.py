"""Emulators and daemons on the CAN of a real kernel, beside foreign tools (can-utils)."""

import os
import subprocess
from contextlib import closing
from itertools import count
from pathlib import Path

import can
import pytest

from tests.conftest import make_vcan
from tests.hil.lab import BusWatcher, Lab, wait_until

_numbers = count(1)
FAIR = "loop.realtime=off"
"""The lab's kernel has one processor: two real-time processes would starve the others."""
BRAKED = tuple(f"plant.links.{j}.viscous_Nms_rad=1.0" for j in (1, 2))
"""An arm without torque comes to rest before it is at its limits."""


def ip(*words):
    subprocess.run(["ip", *words], check=True, capture_output=True, text=True)


class CanLab(Lab):
    """A lab whose bus is a CAN interface.

    Attributes:
        interface: The bus of emulator and daemons.
    """

    def __init__(self, directory, interface):
        super().__init__(directory)
        self.bus = self.interface = interface

    def settings(self, *assignments):
        return super().settings(FAIR, *BRAKED, *assignments)

    def join_bus(self):
        return can.Bus(interface="socketcan", channel=self.interface)

    def tool(self, *command):
        """Start a program of can-utils; its output goes to a file."""
        return Tool(self.directory / f"tool{next(_numbers)}", command)


class Tool:
    """A foreign program, its output read from a file while it runs."""

    def __init__(self, path, command):
        self._path = Path(path)
        with self._path.open("w") as output:
            self.process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                env=os.environ | {"LC_ALL": "C"},
            )

    @property
    def text(self):
        return self._path.read_text()

    def wait_for(self, words, timeout_s=20.0):
        def is_there():
            has_them = words in self.text
            assert has_them or self.process.poll() is None, f"ended with {self.text!r}"
            return has_them

        wait_until(is_there, timeout_s, f"{words!r} from {self.process.args[0]}")

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.terminate()
        try:
            self.process.wait(10)
        except subprocess.TimeoutExpired:  # slcand waits for its line to drain
            self.process.kill()
            self.process.wait()


class Bench:
    """An arm on a CAN interface: daemons are started when none runs, and kept for the next test."""

    def __init__(self, lab):
        self.lab = lab
        self.interface = lab.interface
        self._arm = None

    def moving_arm(self):
        """The running daemon's arm in the middle of a swing."""
        _be_up(self.interface)
        if self._arm is None or self._arm.daemon.process.poll() is not None:
            if self._arm is not None:
                self._arm.client.close()
            self._arm = self.lab.run()
        self._arm.make_ready()
        self._arm.events.clear()
        self._arm.swing()
        return self._arm

    def watch(self):
        """Listen to the bus for as long as the block lasts."""
        return closing(BusWatcher(self.lab.join_bus()))


def _be_up(interface):
    """Whatever an earlier test has left."""
    ip("link", "set", interface, "up")


@pytest.fixture(scope="module")
def shared_vcan():
    """A vcan interface for all tests of a module."""
    yield from make_vcan()


@pytest.fixture(scope="module")
def bench(shared_vcan, tmp_path_factory):
    if shared_vcan is None:
        pytest.skip("not allowed to make a vcan interface")
    lab = CanLab(tmp_path_factory.mktemp("bench"), shared_vcan)
    lab.emulate()
    yield Bench(lab)
    lab.close()


@pytest.fixture
def can_lab(own_vcan, tmp_path):
    """A lab on a vcan interface of its own."""
    if own_vcan is None:
        pytest.skip("not allowed to make a vcan interface")
    place = CanLab(tmp_path, own_vcan)
    yield place
    place.close()
