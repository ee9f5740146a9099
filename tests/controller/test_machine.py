"""The arm's state machine, exhaustively against a table of its own."""

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.errors import CommandError
from controller.faults import REACTIONS, FaultCode, Reaction
from controller.machine import Machine, State, Trigger

TABLE = """
.         BUS_READY POWERED TRAJECTORY FINISHED DISABLE  AT_REST SOFT_TRIP TRIP  ESTOP RESET
INIT      IDLE      -       -          -        -        -       FAULT     FAULT ESTOP -
IDLE      -         READY   -          -        -        -       FAULT     FAULT ESTOP -
READY     -         -       ACTIVE     -        STOPPING -       STOPPING  FAULT ESTOP -
ACTIVE    -         -       ACTIVE     HOLD     STOPPING -       STOPPING  FAULT ESTOP -
HOLD      -         -       ACTIVE     -        STOPPING -       STOPPING  FAULT ESTOP -
STOPPING  -         -       -          -        -        IDLE    -         FAULT ESTOP -
FAULT     -         -       -          -        -        -       -         -     ESTOP IDLE
ESTOP     -         -       -          -        -        -       -         -     -     IDLE
"""
HEADER, *ROWS = (line.split() for line in TABLE.strip().splitlines())
EXPECTED = {
    (row[0], trigger): None if after == "-" else after
    for row in ROWS
    for trigger, after in zip(HEADER[1:], row[1:], strict=True)
}
WAYS = {  # how each state is reached from the start
    State.INIT: "",
    State.IDLE: "BUS_READY",
    State.READY: "BUS_READY POWERED",
    State.ACTIVE: "BUS_READY POWERED TRAJECTORY",
    State.HOLD: "BUS_READY POWERED TRAJECTORY FINISHED",
    State.STOPPING: "BUS_READY POWERED DISABLE",
    State.FAULT: "TRIP",
    State.ESTOP: "ESTOP",
}
SOFT, OFF = FaultCode.FOLLOWING_ERROR, FaultCode.AMPLIFIER_FAULT


def machine_in(state):
    machine = Machine()
    for name in WAYS[state].split():
        machine.fire(Trigger[name])
    assert machine.state is state
    return machine


def test_table__complete():
    assert set(EXPECTED) == {(s.name, t.name) for s, t in itertools.product(State, Trigger)}


@pytest.mark.parametrize("trigger", list(Trigger), ids=lambda trigger: trigger.name)
@pytest.mark.parametrize("state", list(State), ids=lambda state: state.name)
def test_machine__every_state_and_trigger__as_the_table_says(state, trigger):
    machine = machine_in(state)
    after = EXPECTED[state.name, trigger.name]
    assert machine.can(trigger) == (after is not None)
    if after is None:
        with pytest.raises(CommandError, match=f"{trigger.name.lower()}.*{state.name}"):
            machine.fire(trigger)
        assert machine.state is state
    else:
        assert machine.fire(trigger) is State[after]
        assert machine.state is State[after]
    assert machine.fault is FaultCode.NONE


def test_state__numbers__are_those_of_recordings_and_telemetry():
    names = ["INIT", "IDLE", "READY", "ACTIVE", "HOLD", "STOPPING", "FAULT", "ESTOP"]
    assert [(state.value, state.name) for state in State] == list(enumerate(names))


def test_machine__new__init_without_fault():
    assert (Machine().state, Machine().fault) == (State.INIT, FaultCode.NONE)


@pytest.mark.parametrize("state", list(State), ids=lambda state: state.name)
def test_state__is_powered__only_where_torque_may_be_applied(state):
    assert state.is_powered == (state.name in {"READY", "ACTIVE", "HOLD", "STOPPING"})


@pytest.mark.parametrize("state", list(State), ids=lambda state: state.name)
@pytest.mark.parametrize("code", list(FaultCode), ids=lambda code: code.name)
def test_trip__every_state_and_code__state_and_latch_follow_the_reaction(state, code):
    machine = machine_in(state)
    reaction = machine.trip(code)
    assert reaction is REACTIONS[code]
    if reaction in (Reaction.WARN, Reaction.HOLD):
        assert (machine.state, machine.fault) == (state, FaultCode.NONE)
        return
    trigger = "SOFT_TRIP" if reaction is Reaction.SOFT_STOP else "TRIP"
    after = EXPECTED[state.name, trigger] or state.name
    assert (machine.state.name, machine.fault) == (after, code)


@pytest.mark.parametrize("state", list(State), ids=lambda state: state.name)
@pytest.mark.parametrize(("first", "then"), [(SOFT, OFF), (OFF, SOFT)])
def test_trip__a_second_fault__the_first_stays_latched(state, first, then):
    machine = machine_in(state)
    machine.trip(first)
    machine.trip(then)
    assert machine.fault is first


@pytest.mark.parametrize("state", [State.READY, State.ACTIVE, State.HOLD, State.STOPPING])
def test_trip__soft_fault__ends_in_fault_when_the_arm_is_at_rest(state):
    machine = machine_in(state)
    machine.trip(SOFT)
    assert machine.state is State.STOPPING
    assert machine.fire(Trigger.AT_REST) is State.FAULT
    assert machine.fault is SOFT


def test_trip__grave_fault_during_a_damped_stop__torque_off_with_the_first_fault_latched():
    machine = machine_in(State.ACTIVE)
    machine.trip(SOFT)
    machine.trip(OFF)
    assert (machine.state, machine.fault) == (State.FAULT, SOFT)


def test_stopping__without_fault__ends_in_idle():
    machine = machine_in(State.STOPPING)
    assert machine.fire(Trigger.AT_REST) is State.IDLE


@pytest.mark.parametrize("state", [s for s in State if s is not State.ESTOP])
@pytest.mark.parametrize("fault", [None, SOFT, OFF])
def test_estop__from_everywhere__at_once_and_a_fault_stays_latched(state, fault):
    machine = machine_in(state)
    if fault is not None:
        machine.trip(fault)
    assert machine.fire(Trigger.ESTOP) is State.ESTOP
    assert machine.fault is (fault or FaultCode.NONE)


@pytest.mark.parametrize("state", [State.FAULT, State.ESTOP])
def test_reset__latched__idle_without_power_and_without_fault(state):
    machine = machine_in(state)
    machine.trip(OFF)
    assert machine.fire(Trigger.RESET) is State.IDLE
    assert machine.fault is FaultCode.NONE
    assert not machine.state.is_powered


@pytest.mark.parametrize("state", [s for s in State if s not in (State.FAULT, State.ESTOP)])
def test_reset__nothing_to_reset__refused_and_the_fault_stays(state):
    machine = machine_in(state)
    if state is State.STOPPING:
        machine.trip(SOFT)
    before = machine.fault
    with pytest.raises(CommandError):
        machine.fire(Trigger.RESET)
    assert (machine.state, machine.fault) == (state, before)


@given(st.lists(st.sampled_from(list(Trigger)) | st.sampled_from(list(FaultCode)), max_size=40))
def test_machine__any_history__power_only_by_powered_and_never_past_a_latched_fault(history):
    machine = Machine()
    for event in history:
        before, latched = machine.state, machine.fault
        if isinstance(event, FaultCode):
            machine.trip(event)
        elif machine.can(event):
            machine.fire(event)
        after = machine.state
        if after.is_powered and not before.is_powered:
            assert event is Trigger.POWERED
            assert before is State.IDLE
            assert latched is FaultCode.NONE
        if before in (State.FAULT, State.ESTOP) and after is not before:
            assert event in (Trigger.RESET, Trigger.ESTOP)
        if latched is not FaultCode.NONE and event is not Trigger.RESET:
            assert machine.fault is latched
        if machine.fault is not FaultCode.NONE:
            assert after in (State.STOPPING, State.FAULT, State.ESTOP)
