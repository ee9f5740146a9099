"""`hil doctor`: checks with verdicts, on hosts as they are and as they should not be."""

import json
import os
import socket

import pytest

from hil.doctor import Finding, examine
from tests.hil.lab import free_port
from tests.hil.virtual import configured

NAMES = {
    "python", "kernel", "scheduler", "memlock", "cores", "governor", "clock source", "bus",
    "bus load", "zenoh",
}  # fmt: skip


@pytest.fixture
def emulated(lab):
    lab.emulate()
    return lab


def findings(*assignments):
    return {finding.name: finding for finding in examine(configured(*assignments))}


def test_doctor__bus_there__every_check_has_a_verdict(emulated):
    found = findings(
        f"bus.address=unix:{emulated.bus_path}",
        f'zenoh.listen=["{emulated.endpoint}"]',
        "loop.realtime=best_effort",
    )
    assert set(found) >= NAMES
    assert all(isinstance(finding, Finding) for finding in found.values())
    assert found["bus"].level == "pass"
    assert found["zenoh"].level == "pass"
    assert found["bus load"].level == "pass"
    assert not [f for f in found.values() if f.level == "fail"]
    assert all(f.remedy for f in found.values() if f.level != "pass")


def test_doctor__while_a_daemon_runs__disturbs_nothing(emulated):
    arm = emulated.run()
    arm.client.command("enable")
    arm.swing()
    doctor = emulated.start(
        "doctor", *emulated.settings(f'zenoh.listen=["{emulated.endpoint}"]'), "--json"
    )
    assert doctor.wait() == 0
    found = {finding["name"]: finding for finding in json.loads(doctor.stdout)}
    assert found["bus"]["level"] == "pass"
    assert found["zenoh"]["level"] == "warn"
    assert "Address already in use" in found["zenoh"]["found"]
    arm.wait_cycles(50)
    assert arm.now["fault"] == 0
    assert arm.statuses[-1]["unknown_frames"] == 0


def test_doctor__bus_missing__fails_with_a_remedy(lab):
    doctor = lab.start("doctor", *lab.settings())
    assert doctor.wait() == 1
    (line,) = [line for line in doctor.stdout.splitlines() if line.startswith("FAIL")]
    assert f"no bus at unix:{lab.bus_path}" in line
    assert "hil emulate" in line
    assert doctor.stderr == ""


def test_doctor__bus_overloaded__fails_with_the_share():
    assert findings("bus.bit_rate=500000")["bus load"].level == "fail"
    assert "130.0 %" in findings("bus.bit_rate=500000")["bus load"].found


def test_doctor__core_not_there__fails():
    absent = max(os.sched_getaffinity(0)) + 1
    found = findings(f"loop.cpu={absent}")["cores"]
    assert found.level == "fail"
    assert str(absent) in found.found


def test_doctor__zenoh_open_to_the_network__warns():
    port = free_port()
    found = findings(f'zenoh.listen=["tcp/0.0.0.0:{port}"]')["zenoh"]
    assert found.level == "warn"
    assert "command" in found.remedy
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        assert findings(f'zenoh.listen=["{endpoint}"]')["zenoh"].level == "warn"
