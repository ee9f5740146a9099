"""Telemetry through a router to subscribers of every kind; the router is a process of its own."""

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from controller.machine import State
from hil.client import Arm as RemoteArm
from hil.client import Client
from hil.messages import PROTOCOL_VERSION
from tests.hil.lab import Arm, free_port, wait_until

ROUTER = """
import sys, time
from hil.config import ZenohSettings
from hil.session import open_session
with open_session(ZenohSettings(mode="router", listen=(sys.argv[1],))):
    print("ready", flush=True)
    time.sleep(600)
"""
SLOW = """
import sys, time
from hil.client import Client
def take(rows):
    time.sleep(0.5)
with Client(sys.argv[1], [sys.argv[2]]) as client:
    client.on_telemetry(take)
    print("ready", flush=True)
    time.sleep(600)
"""
"""A subscriber that needs half a second for each hundredth of one."""
UNREAD = """
import sys, time, zenoh
from hil.session import client_settings, open_session
session = open_session(client_settings([sys.argv[2]]))
def take(sample):
    time.sleep(0.5)
handler = zenoh.handlers.Callback(take, indirect=False)
session.declare_subscriber(f"hil/{sys.argv[1]}/telemetry", handler)
print("ready", flush=True)
time.sleep(600)
"""
"""One that blocks Zenoh's own thread: nothing is read from its socket meanwhile."""
DISTURBED_S = 8.0


class Child:
    """A Python program that prints `ready`."""

    def __init__(self, lab, code, *arguments):
        self._process = subprocess.Popen(
            [sys.executable, "-c", code, *arguments], stdout=subprocess.PIPE, text=True
        )
        self.pid = self._process.pid
        lab._stack.callback(self.kill)
        assert self._process.stdout.readline() == "ready\n"

    def kill(self):
        if self._process.poll() is None:
            self._process.kill()
        self._process.wait()
        self._process.stdout.close()


@pytest.fixture(scope="module")
def router(shared_lab):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    Child(shared_lab, ROUTER, endpoint)
    return endpoint


@pytest.fixture(scope="module")
def arm(shared_lab, router):
    """A daemon that is reached through the router alone."""
    shared_lab.emulate()
    options, record = shared_lab.run_options(f'zenoh.connect=["{router}"]')
    options += ["--set", 'zenoh.mode="client"', "--set", "zenoh.listen=[]"]
    daemon = shared_lab.start(*options)
    daemon.wait_for_line()
    client = Client(shared_lab.arm, [router])
    shared_lab._stack.callback(client.close)
    return Arm(daemon, client, record)


def count(lab, endpoint):
    counter = lab.start("watch", "--count", "--arm", lab.arm, "--connect", endpoint)
    counter.wait_for_line()
    return counter


def test_router__between__commands_authority_and_every_sample_pass(arm, router, shared_lab):
    first = arm.seq
    with RemoteArm(shared_lab.arm, [router], operator="ann") as ann:
        ann.enable()
        ann.move([0.3, -0.2])
        log = ann.record(10.0)
        wait_until(lambda: log.received > 300, what="telemetry")
        assert log.lost == 0
    rows = arm.since(first)
    assert np.all(np.diff(rows["seq"].astype(int)) == 1)
    assert State.ACTIVE in rows["state"]


def test_late_joiner__at_once__status_schema_and_layout(arm, router, shared_lab):
    with Client(shared_lab.arm, [router]) as late:
        status = wait_until(late.status, what="the status")
        assert status["samples"] > 0
        assert status["state"] in State.__members__
        assert late.schema()["version"] == PROTOCOL_VERSION
        batches = []
        late.on_telemetry(batches.append)
        wait_until(lambda: batches, what="telemetry")
        assert batches[0]["q_meas_rad"].shape[1] == 2


@pytest.mark.parametrize("way", ["direct", "router"])
def test_subscribers__slow_blocked_stopped_and_killed__others_get_every_sample(lab, way):
    lab.emulate()
    settings, endpoint = [], lab.endpoint
    if way == "router":
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        Child(lab, ROUTER, endpoint)
        settings = [f'zenoh.connect=["{endpoint}"]']
    arm = lab.run(*settings)
    arm.make_ready()
    arm.swing()
    healthy = count(lab, endpoint)
    Child(lab, SLOW, lab.arm, endpoint)
    Child(lab, UNREAD, lab.arm, endpoint)
    stopped, killed = count(lab, endpoint), count(lab, endpoint)
    first = arm.seq
    os.kill(stopped.pid, signal.SIGSTOP)
    os.kill(killed.pid, signal.SIGKILL)
    killed.wait()
    end_s = time.monotonic() + DISTURBED_S
    wait_until(lambda: time.monotonic() > end_s, what="the time")
    again = count(lab, endpoint)
    arm.wait_cycles(500)
    rows = arm.since(first)
    assert np.all(np.diff(rows["seq"].astype(int)) == 1)
    assert arm.state is State.ACTIVE
    assert arm.statuses[-1]["telemetry_lost"] == 0
    os.kill(stopped.pid, signal.SIGCONT)
    for counter in (healthy, again):
        counter.end()
        counted = json.loads(counter.stdout.splitlines()[-1])
        assert counted["lost"] == 0
        assert counted["received"] > 0
    arm.client.command("disable")
