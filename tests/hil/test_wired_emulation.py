"""`hil emulate` on the wire model: where it can be, and what it says of the bus's load."""

import re
import signal

import pytest

from tests.hil.lab import one_line

WIRE = "emulator.wire.is_on=true"
UNHURRIED = ("loop.period_s=5e-3", "loop.feedback_timeout_s=4e-3")
"""A shared machine may be late: nothing here measures it."""


@pytest.mark.parametrize(
    ("bus", "time", "words"),
    [
        ("unix:{0}/bus", "lockstep", ("--time wall", "hil sim")),
        ("python-can:virtual:wired", "wall", ("a wire of its own", "unix:PATH")),
    ],
)
def test_emulate_wired__where_it_cannot_be__refused_in_one_line(lab, bus, time, words):
    address = bus.format(lab.directory)
    emulate = lab.start("emulate", "--bus", address, "--time", time, "--set", WIRE)
    assert emulate.wait() == 1
    line = one_line(emulate)
    assert line.startswith("hil: emulator.wire.is_on")
    assert all(word in line for word in words)


def test_emulate_wired__daemon_on_it__runs_and_the_load_is_told_at_the_end(lab):
    emulate = lab.emulate(WIRE, *UNHURRIED, time="wall")
    options, _ = lab.run_options(*UNHURRIED)
    daemon = lab.start(*options)
    assert "is ready" in daemon.wait_for_line()
    assert daemon.end(signal.SIGINT) == 0, daemon.stderr
    assert emulate.end(signal.SIGINT) == 0, emulate.stderr
    told = re.search(r"bus load ([\d.]+) % on average.* (\d+) frames, 0 error", emulate.stdout)
    assert told is not None, emulate.stdout
    assert 0.0 < float(told[1]) < 40.0
    assert int(told[2]) > 50  # the start-up alone
