"""The drive's state machine: every state, every command."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.cia402.codec import Cia402State
from sim_backend.cia402.drive_state import Command, DriveStateMachine, decode_command

S = Cia402State


CONTROLWORDS = {
    Command.DISABLE_VOLTAGE: 0x00,
    Command.QUICK_STOP: 0x02,
    Command.SHUTDOWN: 0x06,
    Command.SWITCH_ON: 0x07,
    Command.ENABLE_OPERATION: 0x0F,
}
STAY = None
# The standard's figure as a table, written out a second time.
OFF, READY, ON = S.SWITCH_ON_DISABLED, S.READY_TO_SWITCH_ON, S.SWITCHED_ON
ENABLED, STOPPING = S.OPERATION_ENABLED, S.QUICK_STOP_ACTIVE
EXPECTED = {  # columns: disable voltage, quick stop, shutdown, switch on, enable operation
    S.NOT_READY_TO_SWITCH_ON: (STAY, STAY, STAY, STAY, STAY),
    OFF: (STAY, STAY, READY, STAY, STAY),
    READY: (OFF, OFF, STAY, ON, ENABLED),
    ON: (OFF, OFF, READY, STAY, ENABLED),
    ENABLED: (OFF, STOPPING, READY, ON, STAY),
    STOPPING: (OFF, STAY, STAY, STAY, ENABLED),
    S.FAULT_REACTION_ACTIVE: (STAY, STAY, STAY, STAY, STAY),
    S.FAULT: (STAY, STAY, STAY, STAY, STAY),
}


def machine_in(state):
    machine = DriveStateMachine()
    machine.quick_stop_option = 6
    machine.state = state
    return machine


@pytest.mark.parametrize("state", S)
@pytest.mark.parametrize("command", Command)
def test_state_machine__every_state_and_command__follows_the_table(state, command):
    machine = machine_in(state)
    machine.command(CONTROLWORDS[command])
    assert machine.state is (EXPECTED[state][command] or state)


@pytest.mark.parametrize("state", S)
def test_state_machine__fault__powers_off_from_every_state(state):
    machine = machine_in(state)
    machine.fail()
    assert not machine.is_powered
    machine.settle()
    assert machine.state is S.FAULT
    machine.fail()
    assert machine.state is S.FAULT  # a second fault starts no second reaction


@pytest.mark.parametrize("low_bits", range(16))
def test_decode_command__unused_bits__do_not_matter(low_bits):
    assert decode_command(low_bits | 0xFF70) is decode_command(low_bits)


def test_state_machine__fault_reset__needs_a_rising_edge():
    machine = machine_in(S.FAULT_REACTION_ACTIVE)
    machine.command(0x80)
    machine.settle()
    machine.command(0x80)
    assert machine.state is S.FAULT  # bit 7 was set before the fault: no edge
    machine.command(0x00)
    assert machine.state is S.FAULT
    machine.command(0x80)
    assert machine.state is S.SWITCH_ON_DISABLED


def test_state_machine__bit_7_set__lets_only_power_off_commands_through():
    machine = machine_in(S.READY_TO_SWITCH_ON)
    machine.command(0x8F)
    assert machine.state is S.READY_TO_SWITCH_ON
    machine.state = S.OPERATION_ENABLED
    machine.command(0x82)
    assert machine.state is S.QUICK_STOP_ACTIVE
    machine.command(0x80)
    assert machine.state is S.SWITCH_ON_DISABLED


@pytest.mark.parametrize(
    ("option", "at_once", "settled"),
    [
        (0, S.SWITCH_ON_DISABLED, S.SWITCH_ON_DISABLED),
        (1, S.QUICK_STOP_ACTIVE, S.SWITCH_ON_DISABLED),
        (2, S.QUICK_STOP_ACTIVE, S.SWITCH_ON_DISABLED),
        (5, S.QUICK_STOP_ACTIVE, S.QUICK_STOP_ACTIVE),
        (6, S.QUICK_STOP_ACTIVE, S.QUICK_STOP_ACTIVE),
    ],
)
def test_state_machine__quick_stop__ends_as_605a_says(option, at_once, settled):
    machine = machine_in(S.OPERATION_ENABLED)
    machine.quick_stop_option = option
    machine.command(0x02)
    assert machine.state is at_once
    machine.settle()
    assert machine.state is settled


@given(st.lists(st.integers(0, 0xFFFF), max_size=60))
def test_state_machine__any_controlwords__never_power_up_without_passing_shutdown(words):
    machine = machine_in(S.SWITCH_ON_DISABLED)
    was_ready = False
    for word in words:
        machine.command(word)
        was_ready |= machine.state is S.READY_TO_SWITCH_ON
        assert machine.state in set(S)
        assert not machine.is_powered or was_ready
