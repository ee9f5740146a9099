"""Commands inside the loop: in which cycle they take effect, and what is said about them."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.machine import State
from controller.reference import MotionState
from tests.hil.lab import largest_jump
from tests.hil.virtual import Rig


class _Samples(dict):
    """Columns as `largest_jump` takes them."""


def jump(rig, first):
    columns = _Samples(
        q_des_rad=rig.column("q_des")[first:], dq_des_rad_s=rig.column("dq_des")[first:]
    )
    return largest_jump(columns)


def continuation(rig, at_index, target):
    """A move from row `at_index` of the running motion in slot 0."""
    n = rig.config.joints
    rows = np.array(rig.slots[0]).reshape(-1, 3 * n)
    q, dq, ddq = rows[at_index, :n], rows[at_index, n : 2 * n], rows[at_index, 2 * n :]
    return rig.reference("move", MotionState(q, dq, ddq), target_rad=list(target))


@pytest.mark.parametrize("ahead", [1, 2, 50, 300])
def test_trajectory__for_a_row_ahead__starts_in_that_cycle_without_a_jump(ahead):
    rig = Rig()
    rig.swing(300)
    at_index = rig.control.player.index + ahead
    reference = continuation(rig, at_index, (0.3, -0.4))
    first = len(rig.history) - 2
    rig.play(reference, slot=1, number=7, at_index=at_index)
    rig.step(ahead - 1)
    assert rig.outcomes == [(0, "")]
    assert rig.executor.active_slot == 0
    rig.step()
    assert rig.outcomes == [(0, ""), (7, "")]
    assert (rig.executor.active_slot, rig.executor.active_samples) == (1, reference.samples)
    assert rig.control.player.index == 0
    rig.run_until(State.HOLD, 3000)
    assert jump(rig, first) <= 1.0
    assert rig.control.player.setpoint.q_rad == pytest.approx([0.3, -0.4])


@given(
    ahead=st.integers(1, 120),
    offset=st.integers(0, 400),
    target=st.tuples(st.floats(-1, 1), st.floats(-1, 1)),
)
@settings(max_examples=15)
def test_trajectory__at_any_row__never_jumps(ahead, offset, target):
    rig = Rig()
    rig.swing(100 + offset)
    at_index = rig.control.player.index + ahead
    first = len(rig.history) - 2
    rig.play(continuation(rig, at_index, target), slot=2, number=1, at_index=at_index)
    rig.step(ahead + 200)
    assert rig.outcomes[-1] == (1, "")
    assert jump(rig, first) <= 1.0


@pytest.mark.parametrize("skipped", [1, 2, 3, 7])
def test_trajectory__periods_skipped_where_it_begins__time_does_not_jump_back(skipped):
    rig = Rig()
    rig.swing(300)
    index = rig.control.player.index
    at_index = index + 3
    reference = continuation(rig, at_index, (0.3, -0.4))
    rig.play(reference, slot=1, number=7, at_index=at_index)
    periods = 1 + skipped
    rig.executor.begin_cycle(periods)
    rig.control.step(rig.clock_ns + 600_000, periods)
    position = rig.control.player.index
    if index + periods < at_index:
        assert position == index + periods
    else:  # as far into the new motion as the skipped periods have led
        assert position == index + periods - at_index


def test_trajectory__too_late__refused_and_the_running_one_goes_on():
    rig = Rig()
    rig.swing(300)
    at_index = rig.control.player.index
    rig.play(continuation(rig, at_index, (0.3, -0.4)), slot=1, number=7, at_index=at_index)
    rig.step()
    assert rig.outcomes[-1] == (7, "the trajectory came too late to continue the running one")
    rig.step(100)
    assert rig.executor.active_slot == 0
    assert rig.control.player.index == at_index + 101


@pytest.mark.parametrize(
    ("verb", "reason"),
    [("stop", "the arm was stopped"), ("disable", "the arm was disabled"),
     ("estop", "emergency stop")],
)  # fmt: skip
def test_trajectory__waiting_when_the_motion_is_ended__is_dropped_and_told(verb, reason):
    rig = Rig()
    rig.swing(300)
    at_index = rig.control.player.index + 50
    rig.play(continuation(rig, at_index, (0.3, -0.4)), slot=1, number=7, at_index=at_index)
    rig.step(10)
    rig.command(8, verb)
    assert rig.outcomes[-2:] == [(7, reason), (8, "")]
    rig.step(1500)
    assert rig.executor.active_slot == 0
    assert rig.state in (State.HOLD, State.IDLE, State.ESTOP)
    assert len(rig.outcomes) == 3


def test_trajectory__while_another_waits__replaces_it():
    rig = Rig()
    rig.swing(300)
    at_index = rig.control.player.index + 50
    rig.play(continuation(rig, at_index, (0.3, -0.4)), slot=1, number=7, at_index=at_index)
    rig.play(continuation(rig, at_index, (-0.3, 0.4)), slot=2, number=8, at_index=at_index)
    assert rig.outcomes[-1] == (7, "replaced by a later trajectory")
    rig.step(60)
    assert rig.outcomes[-1] == (8, "")
    assert rig.executor.active_slot == 2


def test_trajectory__planned_from_rest_but_moving__refused():
    rig = Rig()
    rig.swing(300)
    rig.play(rig.reference("move", target_rad=[0.1, 0.1]), slot=1, number=7)
    rig.step()
    assert rig.outcomes[-1][0] == 7
    assert "reference has changed" in rig.outcomes[-1][1]
    assert rig.executor.active_slot == 0


def test_trajectory__while_slowing_down__refused():
    rig = Rig()
    rig.swing(300)
    rig.command(1, "stop")
    rig.step(3)
    at_index = rig.control.player.index + 1
    rig.play(continuation(rig, at_index, (0.3, 0.3)), slot=1, number=7, at_index=at_index)
    rig.step(3)
    assert "is being stopped" in rig.outcomes[-1][1]
    rig.run_until(State.HOLD)


@pytest.mark.parametrize(
    ("verb", "arguments", "reason"),
    [("enable", {}, ""), ("disable", {}, ""), ("estop", {}, ""),
     ("stop", {}, "stop is not possible in state IDLE"),
     ("reset", {}, "there is nothing to reset in state IDLE"),
     ("gain_bounds", {"Kd_min": [1.0, 1.0], "Kd_max": [2.0, 2.0]}, ""),
     ("fault", {"joint": 1}, "")],
)  # fmt: skip
def test_command__in_idle__carried_out_or_refused_with_a_reason(verb, arguments, reason):
    rig = Rig()
    rig.step(5)
    rig.command(3, verb, **arguments)
    assert rig.outcomes == [(3, reason)]


def test_gain_bounds__in_motion__ramp_at_the_configured_rate_and_Kd_follows():
    rig = Rig("controller.law.Kd_ramp_per_s=20.0")
    rig.swing(300)
    rig.command(1, "gain_bounds", Kd_min=[1.5, 1.0], Kd_max=[2.0, 3.0])
    rows = []
    for _ in range(150):
        rig.step()
        law = rig.control.law
        rows.append([(g.Kd_min, g.Kd_max, Kd) for g, Kd in zip(law.gains, law.Kd, strict=True)])
    rows = np.array(rows)
    assert rows[-1, :, :2].tolist() == [[1.5, 2.0], [1.0, 3.0]]
    assert np.abs(np.diff(rows[:, :, :2], axis=0)).max() == pytest.approx(0.02)
    assert rows[24, 0, 0] == pytest.approx(1.5)  # 0.5 at 20 per second
    assert rows[99, 0, 1] == pytest.approx(2.0)
    assert np.all(rows[:, :, 2] >= rows[:, :, 0] - 1e-12)
    assert np.all(rows[:, :, 2] <= rows[:, :, 1] + 1e-12)


@pytest.mark.parametrize(
    ("policy", "reason", "end"),
    [("finish", "", State.ACTIVE), ("hold", "the operator was lost", State.HOLD),
     ("stop", "the operator was lost", State.IDLE)],
)  # fmt: skip
def test_operator_lost__in_motion_with_a_trajectory_waiting__policy_and_no_jump(
    policy, reason, end
):
    rig = Rig()
    rig.swing(300)
    at_index = rig.control.player.index + 50
    rig.play(continuation(rig, at_index, (0.3, -0.4)), slot=1, number=7, at_index=at_index)
    first = len(rig.history) - 2
    rig.executor.execute({"verb": "operator_lost", "operator": "ann", "policy": policy})
    rig.step(60)
    assert rig.outcomes[-1] == (7, reason)
    if end is not State.ACTIVE:
        rig.run_until(end, 3000)
    assert rig.executor.active_slot == (1 if policy == "finish" else 0)
    assert rig.control.machine.fault == 0
    if end is not State.IDLE:  # a damped stop follows no reference
        assert jump(rig, first) <= 1.0


def test_operator_lost__while_power_comes_on__policy_stop_takes_it_back():
    rig = Rig()
    rig.executor.execute({"verb": "enable"})
    rig.executor.execute({"verb": "operator_lost", "operator": "ann", "policy": "stop"})
    rig.step(500)
    assert rig.state is State.IDLE


@pytest.mark.parametrize("action", ["taken", "released", "expired"])
def test_authority__changes_hands__nothing_else_does(action):
    rig = Rig()
    rig.swing(300)
    outcomes = list(rig.outcomes)
    rig.executor.execute({"verb": "authority", "operator": "ann", "action": action})
    rig.step(10)
    assert rig.state is State.ACTIVE
    assert rig.outcomes == outcomes
