"""The client library against a gateway of this test's own: what comes once, and what is counted."""

import json
import threading
import time

import numpy as np
import pytest
import zenoh

from hil.cli.watch import Counter
from hil.client import Client, NoAuthorityError, NoDaemonError, RefusedError
from hil.config import ZenohSettings
from hil.connection import operator_name
from hil.messages import AcquireRequest
from hil.session import SessionError, open_session
from hil.telemetry import SampleLayout
from tests.hil.lab import free_port, wait_until

LAYOUT = SampleLayout(2, with_truth=False)
AHEAD_NS = 10**15
"""The daemon's clock counts from another start than ours."""


def samples(first, last, t0_ns=10**12):
    """Serialised samples with these sequence numbers, a millisecond apart."""
    write, out = LAYOUT.writer(), []
    for seq in range(first, last):
        buffer = bytearray(LAYOUT.size)
        scalars = dict.fromkeys(LAYOUT.scalar_names, 0) | {"seq": seq, "t_ns": t0_ns + seq * 10**6}
        write(buffer, 0, list(scalars.values()), [[0.0, 0.0]] * len(LAYOUT.list_names))
        out.append(bytes(buffer))
    return out


class Daemon:
    """The Zenoh side of a daemon called `other`."""

    def __init__(self, endpoint):
        self.session = open_session(ZenohSettings(listen=(endpoint,)))
        self.asked = []
        self.telemetry = self.session.declare_publisher("hil/other/telemetry")
        self.matched = threading.Event()
        self._listener = self.telemetry.declare_matching_listener(lambda status: self.matched.set())

    def publish(self, batch):
        self.telemetry.put(LAYOUT.batch(batch))

    def answer(self, verb, reply):
        """Give authority to everyone, and answer one command."""

        def answer_any(query):
            asked = str(query.key_expr).rpartition("/")[2]
            self.asked.append((asked, json.loads(bytes(query.payload))))
            given = {"ok": True}
            if asked == "acquire":
                given |= {"lease": "l1", "t_ns": time.monotonic_ns() + AHEAD_NS}
            elif asked == verb:
                given = reply(query)
            query.reply(query.key_expr, json.dumps(given))

        return self.session.declare_queryable("hil/other/cmd/*", answer_any)


@pytest.fixture
def endpoint():
    return f"tcp/127.0.0.1:{free_port()}"


@pytest.fixture
def daemon(endpoint):
    it = Daemon(endpoint)
    yield it
    it.session.close()


@pytest.fixture
def client(daemon, endpoint):
    with Client("other", [endpoint]) as it:
        yield it


def received(client, daemon):
    """Subscribe; return the list that gets the sequence numbers, and the counter."""
    seqs, counter = [], Counter()

    def take(rows):
        seqs.extend(rows["seq"].tolist())
        counter.take(rows)

    client.on_telemetry(take)
    assert daemon.matched.wait(10)
    return seqs, counter


def test_telemetry__published_again_by_a_restarted_gateway__comes_once(client, daemon):
    seqs, counter = received(client, daemon)
    for first, last in ((0, 50), (50, 80), (60, 90), (10, 40), (85, 120)):
        daemon.publish(samples(first, last))
    wait_until(lambda: seqs and seqs[-1] == 119, what="the last sample")
    assert seqs == list(range(120))
    assert (counter.received, counter.lost, counter.first, counter.last) == (120, 0, 0, 119)


def test_telemetry__gap__counted_as_lost(client, daemon):
    seqs, counter = received(client, daemon)
    for first, last in ((5, 10), (13, 20), (21, 22)):
        daemon.publish(samples(first, last))
    wait_until(lambda: seqs and seqs[-1] == 21, what="the last sample")
    assert (counter.received, counter.lost) == (13, 4)


@pytest.mark.parametrize("t0_ns", [2 * 10**12, 10**9], ids=["same host", "host restarted"])
def test_telemetry__of_a_new_daemon__comes_although_it_counts_anew(client, daemon, t0_ns):
    seqs, counter = received(client, daemon)
    daemon.publish(samples(100_000, 100_010))
    daemon.publish(samples(0, 10, t0_ns))
    wait_until(lambda: seqs and seqs[-1] == 9, what="the last sample")
    assert seqs == [*range(100_000, 100_010), *range(10)]
    assert counter.lost == 0


def test_command__without_authority__takes_it_passes_arguments_and_gives_it_back(client, daemon):
    with daemon.answer("trajectory", lambda _: {"ok": True, "duration_s": 2.5}):
        answer = client.command("trajectory", kind="move", target_rad=[0.1, 0.2])
    assert answer.duration_s == 2.5
    acquire, trajectory, release = daemon.asked
    assert [verb for verb, _ in daemon.asked] == ["acquire", "trajectory", "release"]
    assert acquire[1]["operator"] == client.operator
    asked = trajectory[1]
    now_ns = time.monotonic_ns() + AHEAD_NS
    assert 0 <= now_ns - asked.pop("sent_ns") < 5e9
    assert asked.pop("request_id") != release[1]["request_id"]
    assert asked == {"lease": "l1", "kind": "move", "target_rad": [0.1, 0.2]}


def test_estop__always__goes_alone(client, daemon):
    with daemon.answer("estop", lambda _: {"ok": True}):
        client.command("estop")
    assert daemon.asked == [("estop", {"operator": client.operator})]


def test_authority__held__one_lease_for_all_and_given_back_in_the_end(client, daemon):
    with daemon.answer("stop", lambda _: {"ok": True}):
        with client.authority():
            client.acquire()
            assert client.has_authority
            client.command("stop")
            client.command("stop")
        assert not client.has_authority
        client.release()
    assert [verb for verb, _ in daemon.asked] == ["acquire", "stop", "stop", "release"]
    assert {fields["lease"] for _, fields in daemon.asked[1:]} == {"l1"}


def test_command__nobody_there_for_a_moment__sent_again_until_it_is_answered(client, daemon):
    sent = []

    def reply(query):
        sent.append(bytes(query.payload))
        return {"ok": True}

    with daemon.answer("stop", reply):
        client.acquire()
    held = []
    timer = threading.Timer(0.5, lambda: held.append(daemon.answer("stop", reply)))
    timer.start()
    assert client.command("stop").ok  # nobody is there for half a second
    timer.join()
    held[0].undeclare()
    assert len(sent) == 1


@pytest.mark.parametrize("code", ["held", "no_authority"])
def test_acquire__held_by_another__raises_with_the_name(client, daemon, code):
    refusal = {"ok": False, "reason": "bob has it", "code": code, "holder": "bob"}
    with daemon.answer("stop", lambda _: refusal), pytest.raises(NoAuthorityError) as caught:
        client.command("stop")
    assert caught.value.holder == "bob"


def test_command__refused__raises_with_the_reply(client, daemon):
    reason = "joint 2: no"
    refusal = {"ok": False, "reason": reason, "joint": 2, "value": 3.0, "limit": 2.0}
    with daemon.answer("enable", lambda _: refusal), pytest.raises(RefusedError) as caught:
        client.command("enable")
    assert str(caught.value) == reason
    assert (caught.value.reply.joint, caught.value.reply.value) == (2, 3.0)
    assert daemon.asked[-1][0] == "release"


@pytest.mark.parametrize("given", ["ann", "Änne Müller", "-@.", "", "x" * 200, "a/b*c#?$", None])
def test_operator_name__any_text__is_one_chunk_of_a_key_and_unique(given):
    names = {operator_name(given) for _ in range(3)}
    assert len(names) == 3
    for name in names:
        AcquireRequest(operator=name)
        assert str(zenoh.KeyExpr(f"hil/arm/operator/{name}")).count("/") == 3


def test_command__nobody_answers__says_so(client):
    with pytest.raises(NoDaemonError, match="no daemon answers for arm 'other'"):
        client.command("enable")


def test_session__lost_and_back__subscription_goes_on(client, daemon, endpoint):
    seqs, _ = received(client, daemon)
    daemon.publish(samples(0, 10))
    wait_until(lambda: seqs, what="samples")
    daemon.session.close()
    again = Daemon(endpoint)
    try:
        assert again.matched.wait(20)
        again.publish(samples(8, 30))
        wait_until(lambda: seqs[-1] == 29, what="samples after the return")
        assert np.array_equal(seqs, np.arange(30))
    finally:
        again.session.close()


def test_client__endpoint_malformed__one_line():
    with pytest.raises(SessionError, match="Endpoints must be of the form") as caught:
        Client("other", ["nonsense"])
    assert "\n" not in str(caught.value)


def test_open_session__endpoint_in_use__says_which(daemon, endpoint):
    with pytest.raises(SessionError, match=f"{endpoint}: address in use; set zenoh.listen"):
        open_session(ZenohSettings(listen=(endpoint,)))
    assert isinstance(daemon.session, zenoh.Session)
