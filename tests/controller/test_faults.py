"""The fault table: every code has its reaction, in the order in which faults are evaluated."""

import pytest

from controller.faults import REACTIONS, FaultCode, Reaction

EXPECTED = {  # written from the design: what may take power off at once, and what may not
    "NONE": "WARN",
    "NOT_FINITE": "TORQUE_OFF",
    "BUS_FAILED": "TORQUE_OFF",
    "AMPLIFIER_FAULT": "TORQUE_OFF",
    "AMPLIFIER_LOST": "TORQUE_OFF",
    "FEEDBACK_LOST": "TORQUE_OFF",
    "ESTIMATOR_LOST": "TORQUE_OFF",
    "POSITION_HARD": "TORQUE_OFF",
    "VELOCITY": "TORQUE_OFF",
    "POSITION_SOFT": "SOFT_STOP",
    "FOLLOWING_ERROR": "SOFT_STOP",
    "ENABLE_TIMEOUT": "TORQUE_OFF",
    "SUPERVISOR_LOST": "SOFT_STOP",
    "GATEWAY_LOST": "WARN",
    "OVERRUN": "WARN",
    "INTERNAL": "TORQUE_OFF",
}


def test_fault_codes__all__have_a_reaction_and_are_known_here():
    assert set(REACTIONS) == set(FaultCode)
    assert {code.name for code in FaultCode} == set(EXPECTED)


def test_fault_codes__numbers__are_those_of_recordings_and_telemetry():
    assert [(code.value, code.name) for code in FaultCode] == list(enumerate(EXPECTED))


@pytest.mark.parametrize("code", list(FaultCode), ids=lambda code: code.name)
def test_reactions__every_code__as_designed(code):
    assert REACTIONS[code].name == EXPECTED[code.name]


def test_reactions__mildest_first__comparable():
    names = [reaction.name for reaction in sorted(Reaction)]
    assert names == ["WARN", "HOLD", "SOFT_STOP", "TORQUE_OFF"]


def test_fault_codes__evaluated_on_motion__graver_ones_come_first():
    order = ["NOT_FINITE", "POSITION_HARD", "VELOCITY", "POSITION_SOFT", "FOLLOWING_ERROR"]
    assert sorted(FaultCode[name] for name in order) == [FaultCode[name] for name in order]


def test_fault_codes__feedback_cannot_be_trusted__torque_goes_off():
    blind = ("NOT_FINITE", "FEEDBACK_LOST", "ESTIMATOR_LOST", "AMPLIFIER_LOST", "BUS_FAILED")
    assert {REACTIONS[FaultCode[name]] for name in blind} == {Reaction.TORQUE_OFF}
