"""Requests on their way to the loop and back; the loop is played by this test, cycle by cycle."""

import json
import threading
from itertools import count

import numpy as np
import pytest

from controller.faults import FaultCode
from controller.machine import State
from hil import dispatch
from hil.dispatch import URGENT, Dispatcher
from hil.shared import SLOTS, SharedMemory
from tests.hil.lab import wait_until
from tests.hil.virtual import configured


class ScriptedLoop:
    """The loop's side of the shared memory: reads commands, answers, and writes samples."""

    def __init__(self, shared):
        self.shared = shared
        self.state = State.IDLE
        self.fault = FaultCode.NONE
        self.t_ref_s = 0.0
        self.q_des = [0.0, 0.0]
        self.seen = []
        self._commands = shared.reader("commands", "loop")
        self._cycles = count()
        self._write = shared.layout.writer()
        self.cycle()

    def cycle(self):
        """Write the sample of one more cycle; return the commands that came before it."""
        number = next(self._cycles)
        self.number = number
        taken = self._commands.read_json(100)
        self.seen += taken
        layout = self.shared.layout
        values = dict.fromkeys(layout.scalar_names, 0)
        values |= {"seq": number, "cycle": number, "state": self.state, "fault": self.fault}
        values |= {"t_ns": number * 10**6, "t_ref_s": self.t_ref_s}
        lists = {name: [0.0, 0.0] for name in layout.list_names} | {"q_des_rad": self.q_des}
        ring = self.shared.samples
        self._write(
            ring.memory, ring.begin(layout.size), list(values.values()), list(lists.values())
        )
        ring.commit()
        return taken

    def report(self, command, reason=""):
        """Say what became of a command."""
        event = {"t_ns": 0, "cycle": self.number, "kind": "command", "id": command["id"]}
        event |= {"verb": command["verb"], "ok": not reason, "reason": reason}
        self.shared.events.append(json.dumps(event).encode())

    def await_command(self):
        """Wait for the next command, without a cycle in between."""
        return wait_until(lambda: self._commands.read_json(1), what="a command")[0]


class Asking(threading.Thread):
    """A request on its way, in a thread as the gateway has them."""

    def __init__(self, dispatcher, verb, **fields):
        super().__init__()
        self._ask = lambda: dispatcher.answer(verb, json.dumps(fields).encode())
        self._reply = None
        self.start()

    def run(self):
        self._reply = self._ask()

    def reply(self):
        self.join(20)
        assert not self.is_alive()
        return self._reply


@pytest.fixture(autouse=True)
def _patience(monkeypatch):
    """A stall of the host is no silence of the loop; tests of silence set their own."""
    monkeypatch.setattr(dispatch, "OUTCOME_TIMEOUT_S", 20.0)


@pytest.fixture
def shared():
    return SharedMemory.create(configured("trajectory.max_duration_s=20"))


@pytest.fixture
def loop(shared):
    return ScriptedLoop(shared)


@pytest.fixture
def dispatcher(shared, loop):
    return Dispatcher(shared)


def move(dispatcher, q1=0.5):
    return Asking(dispatcher, "trajectory", kind="move", target_rad=[q1, 0.0])


def test_plain_command__outcome_of_the_loop__is_the_reply(dispatcher, loop):
    for reason in ("", "stop is not possible in state IDLE"):
        asking = Asking(dispatcher, "stop", request_id="a7")
        loop.report(loop.await_command(), reason)
        reply = asking.reply()
        assert (reply.ok, reply.reason, reply.request_id) == (not reason, reason, "a7")


def test_enable__answered__only_when_a_sample_of_its_cycle_shows_ready(dispatcher, loop):
    loop.state = State.FAULT  # what the last sample before the reset still says
    loop.cycle()
    asking = Asking(dispatcher, "enable")
    command = loop.await_command()
    loop.number += 1
    loop.report(command)
    asking.join(0.1)
    assert asking.is_alive()
    loop.state = State.IDLE
    loop.cycle()
    asking.join(0.05)
    assert asking.is_alive()
    loop.state = State.READY
    loop.cycle()
    assert asking.reply().ok


def test_enable__arm_goes_into_fault__refused_with_the_fault(dispatcher, loop):
    asking = Asking(dispatcher, "enable")
    loop.report(loop.await_command())
    loop.state, loop.fault = State.FAULT, FaultCode.ENABLE_TIMEOUT
    loop.cycle()
    assert asking.reply().reason == "enable: the arm went into FAULT (ENABLE_TIMEOUT)"


def test_urgent_request__while_another_waits__is_answered_at_once(dispatcher, loop):
    waiting = Asking(dispatcher, "enable")
    loop.report(loop.await_command())  # carried out, but the amplifiers take their time
    for verb in sorted(URGENT - {"stop"}):
        asking = Asking(dispatcher, verb)
        command = loop.await_command()
        assert command["verb"] == verb
        loop.state = State.ESTOP if verb == "estop" else State.IDLE
        loop.report(command)
        loop.cycle()
        assert asking.reply().ok
        assert waiting.is_alive()
    loop.state = State.READY
    loop.cycle()
    assert waiting.reply().ok


@pytest.mark.parametrize(
    ("verb", "payload", "counts"),
    [("estop", b"", 1), ("estop", b"{}", 1), ("estop", b'{"when": "later"}', 0),
     ("estop", b"\xff", 0), ("stop", b"", 0), ("enable", b"", 0)],
)  # fmt: skip
def test_forestall__valid_emergency_stop__reaches_the_loop_before_its_turn(
    dispatcher, shared, loop, verb, payload, counts
):
    dispatcher.forestall(verb, payload)
    assert shared.estop_requests == counts
    assert loop.cycle() == []


def test_loop__silent__refused_and_a_late_outcome_is_not_taken_for_the_next_one(
    dispatcher, loop, monkeypatch
):
    monkeypatch.setattr(dispatch, "OUTCOME_TIMEOUT_S", 0.05)
    asking = Asking(dispatcher, "stop")
    assert asking.reply().reason == "the control loop does not answer"
    late = loop.await_command()
    asking = Asking(dispatcher, "stop")
    loop.report(late, "the late answer")
    loop.report(loop.await_command())
    assert asking.reply().ok


def test_ids__of_a_gateway_and_its_successor__differ(shared, loop, dispatcher):
    asking = Asking(dispatcher, "stop")
    first = loop.await_command()
    successor = Dispatcher(shared)
    loop.report(first, "meant for the gateway that is gone")
    also = Asking(successor, "stop")
    second = loop.await_command()
    assert first["id"] != second["id"]
    loop.report(second)
    assert also.reply().ok
    asking.reply()


def test_slots__any_history__never_the_one_played_nor_one_that_waits(dispatcher, loop, monkeypatch):
    monkeypatch.setattr(dispatch, "OUTCOME_TIMEOUT_S", 0.3)
    loop.state = State.READY
    loop.cycle()
    played = None
    for turn in range(6):
        asking = move(dispatcher, 0.5 if turn % 2 else -0.5)
        command = loop.await_command()
        assert command["slot"] != played
        loop.report(command)
        assert asking.reply().ok
        played = command["slot"]
    unanswered = [played]
    for _ in range(SLOTS - 1):  # the loop is stuck: none of these is known to be over
        asking = move(dispatcher)
        command = loop.await_command()
        assert command["slot"] not in unanswered
        unanswered.append(command["slot"])
        assert "does not answer" in asking.reply().reason
    assert "has not answered earlier trajectories" in move(dispatcher).reply().reason
    loop.report(command, "too late")
    asking = move(dispatcher)
    again = loop.await_command()
    assert again["slot"] == command["slot"]
    loop.report(again)
    assert asking.reply().ok


def test_slots__trajectory_started_after_its_request_gave_up__counts_as_played(
    dispatcher, loop, monkeypatch
):
    monkeypatch.setattr(dispatch, "OUTCOME_TIMEOUT_S", 0.2)
    loop.state = State.READY
    loop.cycle()
    asking = move(dispatcher)
    command = loop.await_command()
    assert not asking.reply().ok
    loop.report(command)
    asking = move(dispatcher, -0.5)
    assert loop.await_command()["slot"] != command["slot"]
    asking.reply()


def test_trajectory__running_one__is_continued_from_its_own_row(dispatcher, loop, shared):
    loop.state = State.READY
    loop.cycle()
    asking = move(dispatcher)
    first = loop.await_command()
    assert first["at_index"] is None
    loop.report(first)
    assert asking.reply().ok
    loop.state, loop.t_ref_s = State.ACTIVE, 0.100
    loop.cycle()
    asking = move(dispatcher, -0.5)
    second = loop.await_command()
    assert second["at_index"] == 200  # 0.1 s ahead
    row = np.array(shared.rows(first["slot"])).reshape(-1, 6)[200]
    start = np.array(shared.rows(second["slot"])).reshape(-1, 6)[0]
    assert start == pytest.approx(row)
    assert abs(row[2]) > 0.5  # in motion
    loop.report(second)
    assert asking.reply().ok


def test_trajectory__loop_says_it_came_too_late__planned_again_from_further_ahead(dispatcher, loop):
    loop.state = State.READY
    loop.cycle()
    asking = Asking(
        dispatcher, "trajectory", kind="sinusoid", duration_s=15.0, center_rad=[0.0, 0.0],
        amplitude_rad=[0.3, 0.3], frequency_Hz=[0.5, 0.5],
    )  # fmt: skip
    loop.report(loop.await_command())
    asking.reply()
    loop.state, loop.t_ref_s = State.ACTIVE, 1.0
    loop.cycle()
    asking = move(dispatcher)
    leads = []
    for _ in range(3):
        command = loop.await_command()
        leads.append(command["at_index"] - 1000)
        loop.report(command, "the trajectory came too late to continue the running one")
    assert leads == [100, 400, 1200]
    assert "too late" in asking.reply().reason


def test_answer__mistake_of_ours__is_a_reply_and_the_service_goes_on(
    dispatcher, loop, monkeypatch, capsys
):
    loop.state = State.READY
    loop.cycle()

    def broken(*_):
        raise ZeroDivisionError("made for this test")

    with monkeypatch.context() as patch:
        patch.setattr(dispatch, "plan", broken)
        reply = move(dispatcher).reply()
    assert reply.reason == "internal error in trajectory: ZeroDivisionError: made for this test"
    assert "Traceback" in capsys.readouterr().err
    asking = move(dispatcher)
    loop.report(loop.await_command())
    assert asking.reply().ok
