"""Commands to one running daemon over Zenoh: what they do, and what is refused."""

import json

import numpy as np
import pytest
import zenoh

from controller.faults import FaultCode
from controller.machine import State
from drivers.cia402.codec import Cia402State
from hil.client import Client, NoDaemonError, RefusedError
from hil.messages import COMMANDS, PROTOCOL_VERSION
from hil.session import client_settings, open_session
from tests.hil.lab import largest_jump, one_line, wait_until, whole

DT_S = 1e-3
RAMP_PER_S = 10.0


@pytest.fixture(scope="module")
def arm(shared_lab):
    shared_lab.emulate()
    return shared_lab.run()


@pytest.fixture(scope="module")
def watcher(arm, shared_lab):
    return shared_lab.watch_bus()


@pytest.fixture
def ready(arm):
    arm.make_ready()
    return arm


@pytest.fixture
def moving(arm):
    arm.make_ready()
    arm.swing()
    return arm


def standing(arm):
    """What a refusal may not change: state, gain bounds, reference."""
    arm.catch_up()
    row = arm.now
    names = ("Kd_min", "Kd_max", "q_des_rad", "dq_des_rad_s")
    return int(row["state"]), *(row[name].tolist() for name in names)


def refused(arm, verb, **arguments):
    """Send a command that must be refused, and check that nothing changes."""
    before = standing(arm)
    with pytest.raises(RefusedError) as caught:
        arm.client.command(verb, **arguments)
    arm.wait_cycles(20)
    assert standing(arm) == before
    return caught.value.reply


# --- the main job, from the command line ------------------------------------------------------


def test_shells__enable_move_narrow_stop_disable__each_takes_effect(arm, shared_lab, watcher):
    assert arm.state_now() is State.IDLE
    assert watcher.state(1) is Cia402State.SWITCH_ON_DISABLED
    assert json.loads(shared_lab.send("enable").stdout) == {"ok": True, "reason": ""}
    assert arm.state_now() is State.READY
    assert watcher.state(2) is Cia402State.OPERATION_ENABLED

    start = arm.now["q_des_rad"].tolist()
    points = [start, [0.6, -0.4], [-0.3, 0.5], [0.0, 0.0]]
    request = {"kind": "waypoints", "times_s": [0.0, 3.0, 6.0, 9.0], "points_rad": points}
    reply = json.loads(shared_lab.send("trajectory", "--json", json.dumps(request)).stdout)
    assert reply["ok"]
    assert reply["duration_s"] == pytest.approx(9.0, abs=0.01)
    assert arm.state_now() is State.ACTIVE

    seq = arm.seq
    narrow = shared_lab.send("gain-bounds", "--min", "1.5", "1.2", "--max", "2.0", "1.8")
    assert narrow.wait() == 0
    wait_for_bounds(arm, [1.5, 1.2], [2.0, 1.8])
    follow_ramp(arm.since(seq), [1.0, 1.0], [4.0, 4.0], [1.5, 1.2], [2.0, 1.8])

    arm.client.command("gain_bounds", Kd_min=[1.0, 1.0], Kd_max=[4.0, 4.0])
    assert shared_lab.send("stop").wait() == 0
    arm.wait_for(State.HOLD)
    wait_for_bounds(arm, [1.0, 1.0], [4.0, 4.0])
    assert watcher.state(1) is Cia402State.OPERATION_ENABLED
    assert shared_lab.send("disable").wait() == 0
    assert arm.state_now() is State.IDLE
    assert watcher.state(1) is watcher.state(2) is Cia402State.SWITCH_ON_DISABLED
    rows = arm.rows()
    assert largest_jump(rows[np.isin(rows["state"], (State.ACTIVE, State.HOLD))]) <= 1.0


def wait_for_bounds(arm, Kd_min, Kd_max):
    wait_until(
        lambda: (arm.now["Kd_min"].tolist(), arm.now["Kd_max"].tolist()) == (Kd_min, Kd_max),
        what="the gain bounds",
    )


def follow_ramp(rows, min_from, max_from, min_to, max_to):
    """Bounds move in a straight line at the configured rate, and Kd stays between them."""
    rows = rows[rows["state"] == State.ACTIVE]
    for j in (0, 1):
        low, high, Kd = rows["Kd_min"][:, j], rows["Kd_max"][:, j], rows["Kd"][:, j]
        assert (low[0], high[0]) == (min_from[j], max_from[j])
        assert (low[-1], high[-1]) == (min_to[j], max_to[j])
        # One sample may stand for several periods when the loop had to skip some.
        periods = np.diff(rows["cycle"].astype(int))
        for bound in (low, high):
            steps = np.abs(np.diff(bound))
            assert np.all(steps <= RAMP_PER_S * DT_S * periods + 1e-12)
            moved = steps > 0
            assert np.abs(np.median(steps[moved]) - RAMP_PER_S * DT_S) < 1e-9
        assert np.all(Kd >= low - 1e-12)
        assert np.all(Kd <= high + 1e-12)
        assert np.all(np.diff(high) <= 0.0)
        assert np.all(np.diff(low) >= 0.0)


# --- refusals ---------------------------------------------------------------------------------


def test_trajectory__beyond_joint_limits__refused_with_joint_value_and_limit(ready):
    start = ready.now["q_des_rad"].tolist()
    points = [start, [0.0, 3.1]]
    reply = refused(ready, "trajectory", kind="waypoints", times_s=[0.0, 6.0], points_rad=points)
    assert (reply.quantity, reply.joint, reply.limit) == ("position", 2, 2.8)
    assert reply.value > 2.8
    assert "joint 2" in reply.reason
    assert "beyond the soft limit 2.8" in reply.reason


@pytest.mark.parametrize("state", ["at rest", "in motion"])
def test_gain_bounds__above_ceiling__refused_with_joint_value_and_limit(arm, state):
    arm.make_ready()
    if state == "in motion":
        arm.swing()
    bounds = arm.now["Kd_min"].tolist(), arm.now["Kd_max"].tolist()
    with pytest.raises(RefusedError, match="joint 2: Kd_max 9 is above the ceiling 8") as caught:
        arm.client.command("gain_bounds", Kd_min=[1.0, 1.0], Kd_max=[4.0, 9.0])
    reply = caught.value.reply
    assert (reply.quantity, reply.joint, reply.value, reply.limit) == ("Kd_max", 2, 9.0, 8.0)
    arm.wait_cycles(20)
    assert (arm.now["Kd_min"].tolist(), arm.now["Kd_max"].tolist()) == bounds
    assert (arm.state is State.ACTIVE) is (state == "in motion")


@pytest.mark.parametrize(
    ("verb", "arguments", "words"),
    [
        ("gain_bounds", {"Kd_min": [0.05, 1], "Kd_max": [4, 4]}, "below the floor 0.1"),
        ("gain_bounds", {"Kd_min": [1], "Kd_max": [4]}, "bounds for 1 joints, the arm has 2"),
        ("gain_bounds", {"Kd_min": [3, 1], "Kd_max": [2, 4]}, "joint 1: need 0 < Kd_min 3"),
        ("trajectory", {"kind": "move", "target_rad": [0.1]}, "the arm has 2"),
        ("trajectory", {"kind": "move", "target_rad": [0.1, 9.0]}, "joint 2: target 9"),
        ("trajectory", {"kind": "kelly", "duration_s": 500.0}, "beyond the longest allowed"),
        ("trajectory", {"kind": "spline"}, "spline"),
        ("fault", {"target": "bus", "kind": "garbage", "duration_s": 0}, "duration_s"),
        ("fault", {"target": "amplifier", "kind": "off", "joint": 3}, "the arm has 2 joints"),
        ("enable", {}, "enable is not possible in state"),
        ("reset", {}, "nothing to reset"),
        ("enable", {"force": True}, "force"),
        ("dance", {}, "'dance' is unknown"),
    ],
)
def test_request__impossible__refused_in_one_line(ready, verb, arguments, words):
    reply = refused(ready, verb, **arguments)
    assert words in reply.reason
    assert "\n" not in reply.reason


@pytest.mark.parametrize("payload", [b"", b"\xff\xfe", b"[]", b"null", b'{"kind"', b"9" * 5000])
def test_payload__no_request__refused_and_service_goes_on(ready, payload, shared_lab):
    with open_session(client_settings([shared_lab.endpoint])) as session:
        (reply,) = session.get(f"hil/{shared_lab.arm}/cmd/trajectory", payload=payload)
        answer = json.loads(bytes(reply.ok.payload))
    assert answer["ok"] is False
    assert answer["reason"]
    ready.client.command("stop")


def test_client__gone_before_its_reply__others_are_served(ready, shared_lab):
    session = open_session(client_settings([shared_lab.endpoint]))
    for _ in range(20):
        session.get(f"hil/{shared_lab.arm}/cmd/stop", zenoh.handlers.FifoChannel(1))
    session.close()
    for _ in range(3):
        ready.client.command("stop")


# --- motion -----------------------------------------------------------------------------------


def test_trajectory__while_another_runs__continues_it_without_a_jump(moving):
    first = moving.seq
    start = moving.now["q_des_rad"].tolist()
    moving.client.command("trajectory", kind="move", target_rad=[0.7, 0.6], speed_scale=0.5)
    moving.wait_cycles(30)
    moving.client.command("trajectory", kind="move", target_rad=[-0.2, 0.1])
    moving.wait_for(State.HOLD)
    rows = moving.since(first)
    assert np.all(rows["state"][:-1] != State.READY)
    assert np.abs(rows["dq_des_rad_s"]).max() > 0.5  # it was moving all along
    assert rows["q_des_rad"][-1].tolist() == pytest.approx([-0.2, 0.1], abs=1e-9)
    assert largest_jump(rows) <= 1.0
    assert start != rows["q_des_rad"][-1].tolist()


def test_stop__in_motion__slows_down_along_the_path(moving):
    first = moving.seq
    moving.client.command("stop")
    moving.wait_for(State.HOLD)
    assert largest_jump(moving.since(first)) <= 1.0
    moving.wait_cycles(50)
    assert not moving.now["dq_des_rad_s"].any()


def test_disable__in_motion__answers_when_torque_is_off(moving, watcher):
    moving.client.command("disable")
    assert moving.state_now() is State.IDLE
    assert watcher.state(1) is watcher.state(2) is Cia402State.SWITCH_ON_DISABLED


def test_estop__in_motion__torque_is_zero_within_two_cycles_and_latched(moving, watcher):
    first = moving.seq
    moving.client.command("estop")
    moving.wait_cycles(5)
    assert moving.state_now() is State.ESTOP
    assert watcher.state(1) is Cia402State.SWITCH_ON_DISABLED
    with pytest.raises(RefusedError, match="ESTOP; reset first"):
        moving.client.command("enable")
    rows = moving.since(first)
    after = rows["state"] == State.ESTOP
    k = int(after.argmax())
    assert rows["tau_sent_Nm"][k - 1].any()
    assert not rows["tau_sent_Nm"][k:].any()
    assert not rows["tau_meas_Nm"][k + 2 :].any()  # the drives' own word, two cycles later
    moving.client.command("reset")
    assert moving.state_now() is State.IDLE
    moving.client.command("enable")


def test_fault__injected_by_command__latches_with_its_detail_until_reset(moving, shared_lab):
    seen = len(moving.events)
    assert shared_lab.send("fault", "--joint", "2").wait() == 0
    moving.wait_for(State.FAULT)
    moving.wait_cycles(5)
    assert moving.now["fault"] == FaultCode.AMPLIFIER_FAULT
    assert not moving.now["tau_sent_Nm"].any()
    faults = wait_until(
        lambda: [e for e in list(moving.events)[seen:] if e["kind"] == "fault"], what="the event"
    )
    assert faults[0]["code"] == "AMPLIFIER_FAULT"
    assert "joint 2 (cia402 node 2)" in faults[0]["detail"]
    assert "EMCY" in faults[0]["detail"]
    with pytest.raises(RefusedError, match="FAULT; reset first"):
        moving.client.command("enable")
    moving.client.command("reset")
    moving.client.command("enable")  # at once: the drive needs some cycles to leave its fault
    moving.wait_cycles(50)
    assert moving.state is State.READY


def test_enable__away_from_zero__torque_only_against_the_residual_motion(ready):
    ready.client.command("trajectory", kind="move", target_rad=[0.8, -0.6])
    ready.wait_for(State.HOLD)
    ready.client.command("disable")
    first = ready.seq
    ready.client.command("enable")
    ready.wait_cycles(50)
    rows = ready.since(first)
    start = rows[rows["state"] == State.READY][0]
    assert start["q_des_rad"].tolist() == start["q_meas_rad"].tolist()
    assert start["sigma"].tolist() == [0.0, 0.0]
    damping = -start["Kd"] * start["dq_meas_rad_s"]
    assert start["tau_sent_Nm"].tolist() == pytest.approx(damping.tolist())
    assert np.abs(rows["q_des_rad"][-1] - rows["q_meas_rad"][-1]).max() < 0.01


# --- service ----------------------------------------------------------------------------------


def test_queryables__schema_and_config__say_what_runs(arm, shared_lab):
    schema = arm.client.schema()
    assert set(schema) == {*COMMANDS, "reply", "version", "proto"}
    assert schema["version"] == PROTOCOL_VERSION
    assert "message SampleBatch" in schema["proto"]
    config = arm.client.config()
    assert config["arm"]["name"] == shared_lab.arm
    assert config["bus"]["address"] == f"unix:{shared_lab.bus_path}"
    with open_session(client_settings([shared_lab.endpoint])) as session:
        tokens = [reply.ok.key_expr for reply in session.liveliness().get("hil/*/alive")]
    assert [str(token) for token in tokens] == [f"hil/{shared_lab.arm}/alive"]


def test_status__ten_times_a_second__counts_and_names(arm):
    seen = len(arm.statuses)
    wait_until(lambda: len(arm.statuses) > seen + 5, what="statuses")
    status = arm.statuses[-1]
    assert status["is_lockstep"] is True
    assert status["telemetry_lost"] == 0
    assert status["send_failures"] == 0
    assert len(status["amplifiers"]) == 2
    assert {"p50", "p99", "p99.9", "max"} == set(status["busy_us"])


def test_client__other_arm__nobody_answers(arm, shared_lab):
    with Client("nobody", [shared_lab.endpoint]) as client, pytest.raises(NoDaemonError):
        client.command("stop")


def test_second_daemon__same_arm__one_line_and_the_first_goes_on(moving, shared_lab):
    options, record = shared_lab.run_options()
    second = shared_lab.start(*options)
    assert second.wait() == 1
    assert f"already has a daemon on this host (pid {moving.daemon.pid})" in one_line(second)
    assert not record.exists()
    assert moving.state_now() is State.ACTIVE


def test_second_daemon__same_bus_other_arm__refused_by_the_sync_it_hears(moving, shared_lab):
    options, _ = shared_lab.run_options("arm.name=other", "zenoh.listen=[]")
    second = shared_lab.start(*options)
    assert second.wait() == 1
    assert "another master sends SYNC" in one_line(second)
    assert moving.state_now() is State.ACTIVE


def test_second_daemon__same_port__one_line(arm, shared_lab):
    options, _ = shared_lab.run_options("arm.name=other")
    path = shared_lab.directory / "bus2"
    options[options.index("--bus") + 1] = f"unix:{path}"
    emulator = shared_lab.start("emulate", "--bus", f"unix:{path}")
    emulator.wait_for_line()
    second = shared_lab.start(*options)
    assert second.wait() == 1
    line = one_line(second)
    assert f"tcp/127.0.0.1:{shared_lab.port}: address in use; set zenoh.listen" in line
    assert emulator.end() == 0


def test_recording__of_all_this__complete_with_events_and_frames(arm, shared_lab):
    """Last in this file: it ends the daemon."""
    received = arm.rows()
    assert np.all(np.diff(received["seq"].astype(int)) == 1)
    assert len(received) > 10_000
    assert arm.daemon.end() == 0
    recording = whole(arm.recording)
    common = recording.samples[np.isin(recording.samples["seq"], received["seq"])]
    for name in received.dtype.names:
        assert np.array_equal(common[name], received[name])
    verbs = {e.detail["verb"] for e in recording.events if e.kind == "command"}
    assert verbs >= {"enable", "disable", "trajectory", "gain_bounds", "stop", "estop", "reset"}
    assert recording.config["arm"]["name"] == shared_lab.arm
    frames = sum(1 for _ in recording.frames())
    assert frames >= 5 * len(recording.samples)
