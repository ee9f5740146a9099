"""The lease of an arm and the answers given, on rings of their own and a clock of their own."""

import threading

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hil import authority as authority_module
from hil.answers import UNKNOWN, Answers
from hil.authority import Authority, AuthorityError
from hil.config import RemoteSettings
from hil.messages import AcquireRequest, Reply
from hil.shared import Ring

S = 1_000_000_000


def ring(payload=1024, slots=8):
    return Ring(memoryview(bytearray(Ring.size(payload, slots))), payload, slots)


class Desk:
    """An authority with everything around it; `restart` is a gateway that succeeds another."""

    def __init__(self, **settings):
        self.settings = RemoteSettings(**settings)
        self.ring = ring(512, 4)
        self.told = []
        self.is_moving = False
        self.now_ns = 1000 * S
        self.restart()

    def restart(self):
        self.it = Authority(
            self.settings, self.ring, self.told.append, lambda: self.is_moving, lambda: self.now_ns
        )

    def take(self, name, request_id="r1"):
        self.it.note_present(name)
        return self.it.acquire(AcquireRequest(operator=name, request_id=request_id)).lease

    def refused(self, code, act, *arguments):
        with pytest.raises(AuthorityError) as caught:
            act(*arguments)
        assert caught.value.code == code
        return caught.value


@pytest.fixture
def desk():
    return Desk()


@pytest.fixture(autouse=True)
def _no_patience(monkeypatch):
    monkeypatch.setattr(authority_module, "TOKEN_WAIT_S", 0.01)


def test_acquire__free__lease_and_clock_and_told_to_the_loop(desk):
    desk.it.note_present("ann")
    reply = desk.it.acquire(AcquireRequest(operator="ann", request_id="7"))
    assert (reply.ok, reply.t_ns, reply.request_id) == (True, desk.now_ns, "7")
    assert desk.it.holder == "ann"
    assert desk.told == [{"verb": "authority", "operator": "ann", "action": "taken"}]
    assert desk.it.check(reply.lease, desk.now_ns) == "ann"


def test_acquire__held__refused_by_name(desk):
    desk.take("ann")
    desk.now_ns += 12 * S
    error = desk.refused("held", desk.take, "bob")
    assert error.holder == "ann"
    assert "ann has had authority for 12 s" in str(error)
    assert desk.it.holder == "ann"


def test_acquire__same_request_again__same_lease_and_told_once(desk):
    assert desk.take("ann") == desk.take("ann")
    assert len(desk.told) == 1


def test_acquire__same_name_from_another_program__refused(desk):
    desk.take("ann")
    desk.refused("held", desk.take, "ann", "r2")


def test_acquire__without_token__refused(desk):
    request = AcquireRequest(operator="ghost")
    assert "no liveliness token" in str(desk.refused("no_authority", desk.it.acquire, request))
    assert desk.it.holder is None


def test_acquire__token_late__waits_for_it(desk, monkeypatch):
    monkeypatch.setattr(authority_module, "TOKEN_WAIT_S", 10.0)
    timer = threading.Timer(0.05, desk.it.note_present, ["ann"])
    timer.start()
    assert desk.it.acquire(AcquireRequest(operator="ann")).ok
    timer.join()


def test_release__by_the_holder__free_for_others(desk):
    lease = desk.take("ann")
    desk.it.release(lease)
    assert desk.it.holder is None
    assert desk.told[-1] == {"verb": "authority", "operator": "ann", "action": "released"}
    assert desk.take("bob") != lease
    desk.refused("no_authority", desk.it.release, lease)
    desk.refused("no_authority", desk.it.check, lease, desk.now_ns)


@pytest.mark.parametrize("lease", [None, "", "0123456789abcdef"])
def test_check__without_the_lease__refused_whoever_holds_it(desk, lease):
    desk.refused("no_authority", desk.it.check, lease, desk.now_ns)
    desk.take("ann")
    assert desk.refused("no_authority", desk.it.check, lease, desk.now_ns).holder == "ann"
    desk.refused("no_authority", desk.it.release, lease)
    assert desk.it.holder == "ann"


@pytest.mark.parametrize(("age_s", "is_fresh"), [(9.9, True), (10.1, False), (-10.1, False)])
def test_check__age__within_the_limit(desk, age_s, is_fresh):
    lease, sent_ns = desk.take("ann"), desk.now_ns - round(age_s * S)
    if is_fresh:
        assert desk.it.check(lease, sent_ns) == "ann"
    else:
        error = desk.refused("stale", desk.it.check, lease, sent_ns)
        assert "remote.max_age_s is 10" in str(error)


def test_check__without_time__refused(desk):
    desk.refused("stale", desk.it.check, desk.take("ann"), None)


@pytest.mark.parametrize("policy", ["finish", "hold", "stop"])
def test_token__gone__lease_over_and_the_loop_is_told_the_policy(policy):
    desk = Desk(on_operator_loss=policy)
    lease = desk.take("ann")
    desk.it.note_gone("bob")
    assert desk.it.holder == "ann"
    desk.it.note_gone("ann")
    assert desk.it.holder is None
    told = desk.told[-1]
    assert (told["verb"], told["operator"], told["policy"]) == ("operator_lost", "ann", policy)
    desk.it.note_present("ann")  # its link is back: it has to ask again
    desk.refused("no_authority", desk.it.check, lease, desk.now_ns)
    assert desk.take("bob")


def test_lease__idle__goes_to_who_asks_next_unless_the_arm_moves(desk):
    lease = desk.take("ann")
    desk.now_ns += 899 * S
    desk.it.check(lease, desk.now_ns)
    desk.now_ns += 899 * S
    desk.refused("held", desk.take, "bob")
    desk.now_ns += 2 * S
    desk.is_moving = True
    desk.refused("held", desk.take, "bob")
    desk.is_moving = False
    assert desk.it.check(lease, desk.now_ns) == "ann"  # nobody asked: still hers
    desk.now_ns += 901 * S
    assert desk.take("bob")
    assert [told["action"] for told in desk.told] == ["taken", "expired", "taken"]
    desk.refused("no_authority", desk.it.check, lease, desk.now_ns)


def test_lease__idle_never_expires__if_so_configured():
    desk = Desk(idle_s=None)
    desk.take("ann")
    desk.now_ns += 10**6 * S
    desk.refused("held", desk.take, "bob")


def test_restart__holder_comes_back__keeps_the_lease(desk):
    lease = desk.take("ann")
    desk.restart()
    assert desk.it.holder == "ann"
    desk.refused("held", desk.take, "bob")
    desk.now_ns += 5 * S
    desk.it.note_present("ann")
    desk.now_ns += 100 * S
    desk.it.look_after()
    assert desk.it.check(lease, desk.now_ns) == "ann"


def test_restart__holder_does_not_come_back__lost_after_the_time_given(desk):
    desk.take("ann")
    desk.restart()
    desk.now_ns += 9 * S
    desk.it.look_after()
    assert desk.it.holder == "ann"
    desk.now_ns += 2 * S
    desk.it.look_after()
    assert desk.it.holder is None
    assert desk.told[-1]["verb"] == "operator_lost"
    assert desk.take("bob")


def test_restart__nobody_had_it__free(desk):
    desk.it.release(desk.take("ann"))
    desk.restart()
    assert desk.it.holder is None


NAMES = st.sampled_from(["ann", "bob", "eve"])
STEPS = st.one_of(
    st.tuples(st.just("take"), NAMES),
    st.tuples(st.just("release"), NAMES),
    st.tuples(st.just("check"), NAMES),
    st.tuples(st.just("gone"), NAMES),
    st.tuples(st.just("restart"), NAMES),
    st.tuples(st.just("wait"), st.integers(0, 1000)),
)


@given(st.lists(STEPS, max_size=40))
def test_authority__any_history__one_holder_and_every_change_is_told(steps):
    """The loop's record alone says who has authority at any time."""
    desk, leases = Desk(), {}
    for number, (act, who) in enumerate(steps):
        refusal = None
        try:
            if act == "take":
                leases[who] = desk.take(who, str(number))
            elif act == "release":
                desk.it.release(leases.get(who))
            elif act == "check":
                assert desk.it.check(leases.get(who), desk.now_ns) == who == desk.it.holder
            elif act == "gone":
                desk.it.note_gone(who)
            elif act == "restart":
                desk.restart()
            else:
                desk.now_ns += who * S
                desk.it.look_after()
        except AuthorityError as error:
            refusal = error
        if refusal is not None:
            assert act in ("take", "release", "check")
            assert refusal.holder in (None, desk.it.holder)
        holder = None
        for told in desk.told:
            if told["verb"] == "authority" and told["action"] == "taken":
                assert holder is None
                holder = told["operator"]
            else:
                assert told["operator"] == holder
                holder = None
        assert holder == desk.it.holder


# --- answers ------------------------------------------------------------------------------------


class Memory:
    """Answers on a ring, with a clock of their own."""

    def __init__(self, slots=16):
        self.ring = ring(1024, slots)
        self.now_ns = 0
        self.restart()

    def restart(self):
        self.it = Answers(self.ring, 10.0, lambda: self.now_ns)

    def do(self, request_id, payload=b"{}", reason=""):
        """Answer a request unless it was answered before."""
        key, content = Answers.key("lease", request_id), Answers.content("stop", payload)
        found = self.it.find(key, content)
        if found is None:
            self.it.begin(key, content)
            found = Reply(ok=not reason, reason=reason)
            self.it.end(key, found)
            return True, found
        return False, found


@pytest.fixture
def memory():
    return Memory()


@pytest.mark.parametrize("reason", ["", "no", "ä" * 300], ids=len)
def test_answers__id_again__first_answer_and_not_done_again(memory, reason):
    is_new, first = memory.do("a", reason=reason)
    assert is_new
    for _ in range(3):
        assert memory.do("a", reason="another") == (False, first)
    assert memory.do("b")[0]


def test_answers__id_again_after_a_restart__first_answer(memory):
    _, first = memory.do("a", reason="no")
    memory.restart()
    assert memory.do("a") == (False, first)


def test_answers__gateway_gone_in_between__not_done_again(memory):
    key, content = Answers.key("lease", "a"), Answers.content("stop", b"{}")
    memory.it.begin(key, content)
    memory.restart()
    is_new, reply = memory.do("a")
    assert (is_new, reply.ok, reply.reason) == (False, False, UNKNOWN)


@pytest.mark.parametrize("other", [(b'{"x":1}', "a", "stop"), (b"{}", "a", "enable")])
def test_answers__id_for_another_request__refused(memory, other):
    memory.do("a")
    payload, request_id, verb = other
    with pytest.raises(AuthorityError) as caught:
        memory.it.find(Answers.key("lease", request_id), Answers.content(verb, payload))
    assert caught.value.code == "repeated_id"


def test_answers__more_than_fit__refused_until_the_old_ones_are_forgotten(memory):
    for number in range(8):
        memory.do(str(number))
    with pytest.raises(AuthorityError) as caught:
        memory.do("8")
    assert caught.value.code == "busy"
    assert not memory.do("0")[0]  # what is remembered is still answered
    memory.now_ns = 19 * S
    with pytest.raises(AuthorityError):
        memory.do("8")
    memory.now_ns = 21 * S
    assert memory.do("8")[0]


@given(st.lists(st.tuples(st.integers(0, 5), st.booleans(), st.integers(0, 3)), max_size=60))
def test_answers__any_history__nothing_twice_within_the_age(steps):
    """With restarts in between; an id may be used anew only when its requests are stale."""
    memory, done = Memory(slots=256), {}
    for request, restarts, wait_s in steps:
        if restarts:
            memory.restart()
        memory.now_ns += wait_s * S
        is_new, _ = memory.do(str(request))
        before_ns = done.get(request)
        assert is_new or before_ns is not None
        if is_new:
            assert before_ns is None or memory.now_ns - before_ns > 10 * S
            done[request] = memory.now_ns
