"""One daemon and several operators: authority, identity of requests, and what becomes of a loss."""

import json
import os
import secrets
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from controller.machine import State
from hil.client import Arm as RemoteArm
from hil.client import NoAuthorityError, RefusedError
from hil.config import config_from_json
from hil.recording import Recording
from hil.replay import Replayer
from hil.session import client_settings, open_session
from tests.hil.lab import largest_jump, wait_until, whole

OPERATOR = """
import sys, time
from hil.client import Arm
name, endpoint, motion = sys.argv[1:]
arm = Arm(name, [endpoint], operator="doomed").__enter__()
arm.start({"kind": "sinusoid", "duration_s": float(motion), "center_rad": [0.0, 0.0],
           "amplitude_rad": [0.4, 0.3], "frequency_Hz": [0.5, 0.5]})
print(arm.client.operator, flush=True)
time.sleep(600)
"""
"""A program that is killed while it has authority and the arm moves."""


@pytest.fixture(scope="module")
def arm(shared_lab):
    shared_lab.emulate()
    return shared_lab.run()


@pytest.fixture
def ann(arm, shared_lab):
    with RemoteArm(shared_lab.arm, [shared_lab.endpoint], operator="ann") as it:
        yield it


class Program:
    """An operator's program with authority over a moving arm."""

    def __init__(self, lab, arm, duration_s=60.0):
        self._process = subprocess.Popen(
            [sys.executable, "-c", OPERATOR, lab.arm, lab.endpoint, str(duration_s)],
            stdout=subprocess.PIPE,
            text=True,
        )
        self.operator = self._process.stdout.readline().strip()
        assert self.operator.startswith("doomed.")
        arm.wait_until_at(0.5)

    def kill(self):
        self._process.kill()
        self._process.wait()
        self._process.stdout.close()


class Raw:
    """Requests as any other program would make them, with a lease."""

    def __init__(self, lab, client):
        self._key = f"hil/{lab.arm}/cmd"
        self._session = open_session(client_settings([lab.endpoint]))
        lab._stack.callback(self._session.close)
        client.acquire()
        self.lease = client._lease

    def fields(self, **more):
        sent_ns = self.lease.clock_ns + time.monotonic_ns()
        made = {"lease": self.lease.id, "request_id": secrets.token_hex(4), "sent_ns": sent_ns}
        return made | more

    def ask(self, verb, fields):
        (reply,) = self._session.get(f"{self._key}/{verb}", payload=json.dumps(fields))
        return json.loads(bytes(reply.ok.payload))


def commands(arm, seen=0):
    """What the loop took in, as the events tell it."""
    return [e["command"] for e in list(arm.events)[seen:] if e["kind"] == "input"]


# --- authority ----------------------------------------------------------------------------------


def test_arm__two_programs__second_refused_by_name_until_the_first_gives_back(arm, ann, shared_lab):
    ann.enable()
    assert ann.state.state is State.READY
    with pytest.raises(NoAuthorityError, match=r"ann\.\w+ has had authority") as caught:
        RemoteArm(shared_lab.arm, [shared_lab.endpoint], operator="bob").__enter__()
    assert caught.value.holder == ann.client.operator
    sent = shared_lab.send("stop")
    assert sent.wait() == 1
    assert ann.client.operator in sent.stderr
    wait_until(lambda: arm.statuses[-1]["operator"] == ann.client.operator, what="the status")
    ann.move([0.3, 0.2])
    assert ann.state.q_des_rad.tolist() == pytest.approx([0.3, 0.2])
    ann.disable()
    ann.client.release()
    assert shared_lab.send("enable").wait() == 0
    assert shared_lab.send("disable").wait() == 0


def test_estop__by_another__needs_no_authority_and_the_events_say_who(arm, ann, shared_lab):
    ann.enable()
    seen = len(arm.events)
    with RemoteArm(shared_lab.arm, [shared_lab.endpoint], operator="eve", observe=True) as eve:
        assert eve.state.state is State.READY
        with pytest.raises(NoAuthorityError):
            eve.enable()
        eve.estop()
        assert eve.state.state is State.ESTOP
        wait_until(
            lambda: (
                {"verb": "estop", "operator": eve.client.operator}.items()
                <= {k: v for c in commands(arm, seen) for k, v in c.items()}.items()
            ),
            what="the event",
        )
    ann.reset()


def test_observer__without_authority__reads_everything(arm, ann, shared_lab):
    with RemoteArm(shared_lab.arm, [shared_lab.endpoint], observe=True) as eve:
        wait_until(lambda: eve.client.status()["operator"] == ann.client.operator, what="status")
        assert eve.client.schema()["version"] == 1
        assert eve.client.config()["arm"]["name"] == shared_lab.arm
        assert eve.state.q_rad.shape == (2,)
        log = eve.record(5.0)
        wait_until(lambda: log.received > 100, what="telemetry")
        assert np.all(np.diff(log.rows()["seq"].astype(int)) == 1)
        assert log.lost == 0


def test_arm__exception_in_its_block__holds_and_gives_back(arm, shared_lab):
    def fail():
        with RemoteArm(shared_lab.arm, [shared_lab.endpoint]) as mine:
            mine.enable()
            mine.move([1.2, 0.8], speed_scale=0.2, wait=False)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    arm.wait_for(State.HOLD)
    assert np.abs(arm.now["q_des_rad"] - [1.2, 0.8]).max() > 0.05
    assert shared_lab.send("disable").wait() == 0


# --- identity of requests -----------------------------------------------------------------------


def test_request__sent_again__done_once_and_answered_the_same(arm, ann, shared_lab):
    raw, seen = Raw(shared_lab, ann.client), len(arm.events)
    fields = raw.fields(Kd_min=[1.0, 1.0], Kd_max=[4.0, 4.0])
    replies = [raw.ask("gain_bounds", fields) for _ in range(5)]
    assert replies[0]["ok"]
    assert all(reply == replies[0] for reply in replies)
    other = raw.ask("gain_bounds", {**fields, "Kd_max": [3.0, 3.0]})
    assert (other["ok"], other["code"]) == (False, "repeated_id")
    arm.wait_cycles(20)
    assert [c["verb"] for c in commands(arm, seen)].count("gain_bounds") == 1
    assert all(c["operator"] == ann.client.operator for c in commands(arm, seen))


@pytest.mark.parametrize(
    ("change", "code"),
    [({"sent_ns": 5}, "stale"), ({"sent_ns": None}, "stale"), ({"sent_ns": 2**62}, "stale"),
     ({"lease": "0" * 16}, "no_authority"), ({"lease": None}, "no_authority"),
     ({"request_id": None}, "repeated_id")],
)  # fmt: skip
def test_request__stale_or_not_under_the_lease__refused_and_nothing_changes(
    arm, ann, shared_lab, change, code
):
    raw, seen = Raw(shared_lab, ann.client), len(arm.events)
    reply = raw.ask("enable", raw.fields() | change)
    assert (reply["ok"], reply["code"]) == (False, code)
    arm.wait_cycles(20)
    assert "enable" not in [c["verb"] for c in commands(arm, seen)]
    assert arm.state is State.IDLE


def test_request__of_another_version__refused(arm, ann, shared_lab):
    raw = Raw(shared_lab, ann.client)
    reply = raw.ask("enable", raw.fields(version=2))
    assert not reply["ok"]
    assert "version" in reply["reason"]


def test_request__of_a_lease_given_back__refused(arm, ann, shared_lab):
    raw = Raw(shared_lab, ann.client)
    ann.client.release()
    reply = raw.ask("enable", raw.fields())
    assert (reply["ok"], reply["code"]) == (False, "no_authority")
    assert "acquire" in reply["reason"]


# --- losses -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("policy", "end"),
    [("finish", State.HOLD), ("hold", State.HOLD), ("stop", State.IDLE)],
)
def test_operator__killed_in_motion__policy_is_followed_and_replayed(lab, policy, end):
    lab.emulate()
    arm = lab.run(f'remote.on_operator_loss="{policy}"')
    arm.make_ready()
    program = Program(lab, arm, duration_s=4.0)
    with pytest.raises(NoAuthorityError, match=program.operator):
        arm.client.command("stop")
    program.kill()
    lost = wait_until(
        lambda: next((c for c in commands(arm) if c["verb"] == "operator_lost"), None), what="loss"
    )
    assert (lost["operator"], lost["policy"]) == (program.operator, policy)
    arm.wait_for(end)
    arm.client.command("reset" if arm.state is State.FAULT else "disable")  # free for others
    assert arm.daemon.end() == 0
    recording = whole(arm.recording)
    samples = recording.samples
    assert bool(samples["t_ref_s"].max() > 3.9) is (policy == "finish")
    powered = samples[np.isin(samples["state"], (State.READY, State.ACTIVE, State.HOLD))]
    assert largest_jump(powered) <= 1.0
    assert not samples["fault"].any()
    replay = Replayer(Recording.open(arm.recording), arm_config(recording)).run()
    assert replay.difference is None, replay.difference.text()


def arm_config(recording):
    return config_from_json(json.dumps(recording.config))


def test_gateway__killed_under_a_lease__holder_keeps_it_and_others_stay_refused(lab):
    lab.emulate()
    arm = lab.run()
    with RemoteArm(lab.arm, [lab.endpoint], operator="ann") as ann:
        ann.enable()
        kill_gateway(arm)
        ann.set_gain_bounds([1.2, 1.2], [3.0, 3.0])  # sent again until the new one answers
        with pytest.raises(NoAuthorityError, match=ann.client.operator):
            arm.client.command("stop")
        ann.move([0.2, 0.1])
    arm.client.command("stop")


def test_gateway_and_operator__both_killed_in_motion__lease_lost_after_the_time_given(lab):
    lab.emulate()
    arm = lab.run("remote.reconnect_s=2.0")
    arm.make_ready()
    program = Program(lab, arm)
    gateway = arm.daemon.children()["gateway"]
    os.kill(gateway, signal.SIGSTOP)  # it does not see the operator go
    program.kill()
    os.kill(gateway, signal.SIGKILL)
    arm.wait_for(State.HOLD)
    lost = next(c for c in commands(arm) if c["verb"] == "operator_lost")
    assert "restart" in lost["cause"]
    arm.client.command("disable")


def kill_gateway(arm):
    before = arm.daemon.children()["gateway"]
    os.kill(before, signal.SIGKILL)
    wait_until(
        lambda: arm.daemon.children().get("gateway", before) != before, what="the next gateway"
    )


def test_trajectory__lease_lost_while_it_is_planned__not_started(arm, ann, shared_lab):
    """The dispatcher asks once more when a command is handed to the loop."""
    ann.enable()
    seen = len(arm.events)
    q = 0.3 * np.sin(np.linspace(0.0, 6.0, 60_000))[:, None] * [1.0, 0.7]
    raw = Raw(shared_lab, ann.client)
    fields = raw.fields(kind="samples", period_s=1e-3, q_rad=q.tolist())
    replies = raw._session.get(f"{raw._key}/trajectory", payload=json.dumps(fields))
    ann.client._token.undeclare()
    (reply,) = replies
    answer = json.loads(bytes(reply.ok.payload))
    wait_until(lambda: "operator_lost" in [c["verb"] for c in commands(arm, seen)], what="loss")
    arm.wait_cycles(100)
    verbs = [c["verb"] for c in commands(arm, seen)]
    if answer["ok"]:  # it was faster: then the policy, hold, came after it
        assert verbs.index("trajectory") < verbs.index("operator_lost")
    assert arm.state in (State.READY, State.HOLD)
    with pytest.raises(RefusedError):
        ann.stop()
    ann.client._token = None
