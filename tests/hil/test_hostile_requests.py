"""Malformed, oversized and out-of-order requests to a moving arm; `HIL_TEST_SEED` repeats a run.

Here come some of them; `tests/nightly/test_hostile_requests.py` sends 100 000.
"""

import json
import os
import queue
import random
import sys
import time

import numpy as np

from controller.machine import State
from hil.client import Arm as RemoteArm
from hil.client import RefusedError
from hil.config import load_config
from hil.messages import COMMANDS, MAX_COMMAND_BYTES, MAX_TRAJECTORY_BYTES
from hil.recording import Recording
from hil.session import client_settings, open_session

REQUESTS = 1500
AT_ONCE = 32
"""Requests on their way at a time; the gateway lets 64 wait."""
ANSWER_S = 30.0

NUMBERS = (0, -1, 1, 1e308, -1e308, 1e-320, 2**63, 2**200, 0.1, True, "0.1", None, [], {}, 1e999)
TEXTS = ("", "\0", "a" * 65, "ä" * 64, "../../etc", "hil/**", "'; DROP TABLE", "\ud83d\ude00", "{}")
VALID = (
    ("enable", {}),
    ("disable", {}),
    ("stop", {}),
    ("estop", {}),
    ("reset", {}),
    ("release", {}),
    ("acquire", {"operator": "mallory"}),
    ("gain_bounds", {"Kd_min": [1.0, 1.0], "Kd_max": [4.0, 4.0]}),
    ("fault", {"target": "encoder", "kind": "ok"}),
    ("trajectory", {"kind": "move", "target_rad": [0.5, -0.3]}),
    ("trajectory", {"kind": "waypoints", "times_s": [0, 2], "points_rad": [[0, 0], [0.4, 0.3]]}),
    ("trajectory", {"kind": "samples", "period_s": 0.01, "q_rad": [[0.0, 0.0]] * 6}),
    ("trajectory", {"kind": "sinusoid", "duration_s": 3, "center_rad": [0, 0],
                    "amplitude_rad": [0.3, 0.3], "frequency_Hz": [0.5, 0.5]}),
    ("trajectory", {"kind": "exponential_sine", "duration_s": 3, "b_rad": [0.1, 0.1],
                    "c_rad": [0.1, 0.1], "w_rad_s": [1, 1], "approach": "none"}),
)  # fmt: skip


class Attacker:
    """Makes requests that no sound program sends, most of them under a lease in force."""

    def __init__(self, seed, lease):
        self.chance = random.Random(seed)
        self.lease = lease
        self._used = []

    def request(self):
        """Return verb and payload of the next one."""
        make = self.chance.choices(
            (self._noise, self._mutated, self._distorted, self._replayed, self._large),
            (2, 3, 5, 1, 0.02),
        )[0]
        verb, payload = make()
        if self.chance.random() < 0.05:
            verb = self.chance.choice(("dance", "a" * 200, "ENABLE", "cmd", *COMMANDS))
        self._used = [*self._used[-20:], (verb, payload)]
        return verb, payload

    def _stamped(self, fields):
        age_ns = self.chance.choice((0, 0, 0, 0, 0, 10**12, -(10**12)))
        now_ns = time.monotonic_ns() + self.lease.clock_ns
        stamp = {"lease": self.lease.id, "sent_ns": max(0, now_ns - age_ns)}
        return stamp | {"request_id": str(self.chance.randrange(10**6))} | fields

    def _valid(self):
        verb, fields = self.chance.choice(VALID)
        if verb in ("release", "estop") and self.chance.random() < 0.9:
            verb, fields = "enable", {}
        return verb, self._stamped(fields) if verb not in ("acquire", "estop") else dict(fields)

    def _noise(self):
        return self.chance.choice(tuple(COMMANDS)), self.chance.randbytes(
            self.chance.choice((0, 1, 7, 100, 3000))
        )

    def _mutated(self):
        verb, fields = self._valid()
        data = bytearray(json.dumps(fields).encode())
        for _ in range(self.chance.randint(1, 4)):
            data[self.chance.randrange(len(data))] = self.chance.randrange(256)
        return verb, bytes(
            data[: self.chance.choice((len(data), self.chance.randrange(len(data))))]
        )

    def _distorted(self):
        """Well-formed JSON, impossible values."""
        verb, fields = self._valid()
        name = self.chance.choice((*fields, "surprise"))
        fields[name] = self._anything(fields.get(name), 0)
        return verb, json.dumps(fields).encode()

    def _anything(self, value, depth):
        if isinstance(value, list) and value and self.chance.random() < 0.7:
            changed = list(value)
            place = self.chance.randrange(len(changed))
            changed[place] = self._anything(changed[place], depth + 1)
            return changed
        nested = "[" * self.chance.choice((1, 50, 3000))
        return self.chance.choice((*NUMBERS, *TEXTS, nested, [0.0] * 17, [[0.0]] * 40, {"a": {}}))

    def _replayed(self):
        return self.chance.choice(self._used) if self._used else self._noise()

    def _large(self):
        verb = self.chance.choice(("trajectory", "trajectory", *COMMANDS))
        limit = MAX_TRAJECTORY_BYTES if verb == "trajectory" else MAX_COMMAND_BYTES
        filler = self.chance.choice((b"[", b" ", b'{"a":', b"9"))
        return verb, (filler * (limit + 1))[: limit + self.chance.choice((-1, 1))]


class Sender:
    """Sends requests, some dozens at a time, and takes their answers."""

    def __init__(self, session, arm):
        self._session = session
        self._prefix = f"hil/{arm}/cmd"
        self._answers = queue.SimpleQueue()
        self.answered = 0
        self.accepted = 0
        self.codes = set()

    def send(self, requests):
        for verb, payload in requests:
            self._session.get(
                f"{self._prefix}/{verb}",
                self._answers.put,
                payload=payload,
                timeout=ANSWER_S,
            )
        for _ in requests:
            reply = self._answers.get(timeout=ANSWER_S)
            answer = json.loads(bytes(reply.ok.payload))
            self.answered += 1
            self.accepted += answer["ok"]
            self.codes.add(answer.get("code"))
            assert answer["ok"] or answer["reason"]
            assert "\n" not in answer["reason"]
            assert "internal error" not in answer["reason"], answer["reason"]


def recover(remote, arm, attacker):
    """Whatever the requests have done: bring the arm back into motion."""
    remote.client.release()
    remote.client.acquire()
    attacker.lease = remote.client._lease
    for verb, fields in (("reset", {}), ("enable", {}), VALID[-2]):
        try:
            remote.client.command(verb, **fields)
        except RefusedError:  # it was not needed, or the arm is far out
            continue
    arm.catch_up()


def attack(lab, requests, say):
    """Send so many requests to a daemon of this lab, and judge what it has done."""
    seed = int(os.environ.get("HIL_TEST_SEED", time.time_ns() & 0xFFFF_FFFF))
    say(f"\nHIL_TEST_SEED={seed} HIL_HOSTILE_REQUESTS={requests}\n")
    lab.emulate()
    arm = lab.run()
    before = arm.daemon.children()
    tau_max_Nm = np.array(load_config().controller.limits.tau_max_Nm)
    states, extremes, samples = set(), np.zeros(2), 0
    with (
        open_session(client_settings([lab.endpoint])) as session,
        RemoteArm(lab.arm, [lab.endpoint]) as remote,
    ):
        attacker, sender = Attacker(seed, remote.client._lease), Sender(session, lab.arm)
        while sender.answered < requests:
            if sender.answered % (4 * AT_ONCE) == 0:
                recover(remote, arm, attacker)
            sender.send([attacker.request() for _ in range(AT_ONCE)])
            rows = arm.rows()
            del arm._batches[:-1]
            extremes = np.maximum(extremes, np.abs(rows["tau_sent_Nm"]).max(axis=0))
            states |= set(rows["state"].tolist())
            samples += len(rows)
    assert arm.daemon.children() == before
    assert np.all(extremes <= tau_max_Nm * (1 + 1e-9))
    assert extremes.any()
    assert State.ACTIVE in states
    assert {None, "no_authority", "stale", "repeated_id"} <= sender.codes
    assert 0 < sender.accepted < sender.answered
    arm.make_ready()
    arm.client.command("disable")
    assert arm.daemon.end() == 0
    assert "Traceback" not in arm.daemon.stderr
    recorded = Recording.open(arm.recording).samples
    assert np.all(np.diff(recorded["seq"].astype(int)) == 1)
    assert np.all(np.abs(recorded["tau_sent_Nm"]).max(axis=0) <= tau_max_Nm * (1 + 1e-9))
    assert arm.statuses[-1]["telemetry_lost"] == 0


def test_requests__hostile__answered_and_no_torque_beyond_its_limit(lab, capsys):
    with capsys.disabled():
        attack(lab, REQUESTS, sys.stdout.write)
