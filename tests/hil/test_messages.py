import json

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from hil.messages import (
    COMMANDS,
    MAX_COMMAND_BYTES,
    MAX_JOINTS,
    MAX_TRAJECTORY_BYTES,
    MAX_WAYPOINTS,
    PROTOCOL_VERSION,
    EnableRequest,
    FaultRequest,
    GainBoundsRequest,
    KellyRequest,
    MoveRequest,
    Reply,
    RequestError,
    SinusoidRequest,
    WaypointsRequest,
    contract,
    explain,
    parse,
    schemas,
)

EXAMPLES = {
    "waypoints": {"times_s": [0, 1.5], "points_rad": [[0, 0], [0.1, -0.2]]},
    "exponential_sine": {"duration_s": 5, "b_rad": [0.1], "c_rad": [0.1], "w_rad_s": [2]},
    "kelly": {"duration_s": 20.0, "rate": 0.25},
    "sinusoid": {
        "duration_s": 5,
        "center_rad": [0.0, 0.1],
        "amplitude_rad": [0.1, 0.2],
        "frequency_Hz": [0.5, 1.0],
    },
    "samples": {"period_s": 0.01, "q_rad": [[0.0], [0.1], [0.2], [0.1], [0.0]]},
    "move": {"target_rad": [0.5, -0.5], "speed_scale": 0.5},
}


def refused(command, payload):
    """Return the one line with which a payload is refused."""
    text = payload if isinstance(payload, str | bytes) else json.dumps(payload)
    with pytest.raises(RequestError) as e:
        parse(command, text)
    line = str(e.value)
    assert line.isprintable()
    assert len(line) < 400
    return line


@pytest.mark.parametrize("kind", EXAMPLES)
def test_parse__trajectory_of_each_kind__round_trips_through_json(kind):
    request = parse("trajectory", json.dumps({"kind": kind, "request_id": "r1"} | EXAMPLES[kind]))
    assert request.kind == kind
    assert request.request_id == "r1"
    assert parse("trajectory", request.model_dump_json()) == request


def test_parse__defaults__are_blend_and_whole_speed():
    kelly = parse("trajectory", '{"kind": "kelly", "duration_s": 1}')
    assert isinstance(kelly, KellyRequest)
    assert (kelly.approach, kelly.rate, kelly.request_id) == ("blend", 1.0, None)
    move = parse("trajectory", '{"kind": "move", "target_rad": [0]}')
    assert isinstance(move, MoveRequest)
    assert move.speed_scale == 1.0


@pytest.mark.parametrize("command", ["enable", "disable", "stop", "estop", "reset"])
def test_parse__plain_command__takes_an_empty_payload_and_a_request_id(command):
    assert parse(command, b"").request_id is None
    assert parse(command, '{"request_id": "abc"}').request_id == "abc"
    assert "extra" in refused(command, {"now": True}).lower()


def test_parse__unknown_command__names_those_that_exist():
    assert "enable, disable, stop" in refused("explode", {})


@pytest.mark.parametrize(
    ("payload", "expected"),
    [
        ({"kind": "kelly", "duration_s": 0}, "kelly.duration_s: "),
        ({"kind": "kelly", "duration_s": "5"}, "got '5'"),
        ({"kind": "kelly", "duration_s": True}, "kelly.duration_s: "),
        ({"kind": "kelly", "duration_s": float("nan")}, "finite"),
        ({"kind": "kelly", "duration_s": float("inf")}, "finite"),
        ({"kind": "kelly", "duration_s": 10**30}, "beyond 64 bits"),
        ({"kind": "kelly", "duration_s": 1, "approach": "jump"}, "'blend' or 'none'"),
        ({"kind": "move", "target_rad": [0.1], "approach": "none"}, "approach"),
        ({"kind": "move", "target_rad": []}, "target_rad"),
        ({"kind": "move", "target_rad": [0.0], "speed_scale": 1e-9}, "speed_scale"),
        ({"kind": "move", "target_rad": [0.0] * (MAX_JOINTS + 1)}, "target_rad"),
        ({"kind": "move", "target_rad": [0.0, [1.0]]}, "target_rad[1]"),
        ({"kind": "move", "target_rad": [0.0], "request_id": "x" * 65}, "64 characters"),
        ({"kind": "dance"}, "'waypoints'"),
        ({"kind": ["kelly"]}, "kind"),
        ({}, "kind"),
        ([], "object"),
        ("nonsense", "JSON"),
        (b"\xff\xfe\x00", "JSON"),
        ('{"kind":' + "[" * 100_000, "recursion"),
        ('{"kind": "kelly", "duration_s": ' + "9" * 4000 + "}", "duration_s"),
        ('{"kind": "kelly", "duration_s": ' + "9" * 6000 + "}", "out of range"),
        ('{"kind": "a\\nb\\u001b[2J"}', "kind"),
    ],
)
def test_parse__malformed_trajectory__is_refused_in_one_line(payload, expected):
    assert expected in refused("trajectory", payload)


def test_parse__two_kinds_of_fields__names_the_first_and_counts_the_rest():
    line = refused("trajectory", {"kind": "kelly", "rate": -1, "target_rad": [1]})
    assert line.startswith("trajectory: kelly.")
    assert "(and 2 more)" in line


@pytest.mark.parametrize("count", [MAX_WAYPOINTS, MAX_WAYPOINTS + 1])
def test_parse__many_waypoints__bound_is_kept(count):
    times, points = list(range(count)), [[0.0]] * count
    payload = json.dumps({"kind": "waypoints", "times_s": times, "points_rad": points})
    if count <= MAX_WAYPOINTS:
        request = parse("trajectory", payload)
        assert isinstance(request, WaypointsRequest)
        assert len(request.times_s) == count
    else:
        assert "10000" in refused("trajectory", payload)


def test_parse__every_sample_wrong__stops_at_the_first():
    payload = {"kind": "samples", "period_s": 0.01, "q_rad": [["x"]] * 50_000}
    assert "q_rad[0][0]" in refused("trajectory", payload)
    assert "more" not in refused("trajectory", payload)


def test_request__once_made__cannot_be_changed():
    request = EnableRequest(request_id="a")
    with pytest.raises(ValidationError, match="frozen"):
        request.request_id = "b"


def test_sinusoid_request__defaults__are_not_shared():
    fields = {"kind": "sinusoid"} | EXAMPLES["sinusoid"]
    first, second = (SinusoidRequest.model_validate(fields) for _ in range(2))
    first.phase_rad.append(1.0)
    assert second.phase_rad == []


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        ([1.0, 3.0], [4.0, 2.0], "joint 2: need 0 < Kd_min 3 <= Kd_max 2"),
        ([0.0, 1.0], [4.0, 4.0], "joint 1"),
        ([1.0], [4.0, 4.0], "1 values in Kd_min, 2 in Kd_max"),
        ([1.0, float("nan")], [4.0, 4.0], "Kd_min[1]"),
    ],
)
def test_gain_bounds__no_range__is_refused_with_joint_and_values(low, high, expected):
    assert expected in refused("gain_bounds", {"Kd_min": low, "Kd_max": high})


def test_gain_bounds__equal_bounds__fix_the_gain():
    request = parse("gain_bounds", '{"Kd_min": [2, 2], "Kd_max": [2, 4]}')
    assert request == GainBoundsRequest(Kd_min=[2.0, 2.0], Kd_max=[2.0, 4.0])


def test_fault__targets__joint_belongs_to_encoder_and_amplifier_only():
    request = parse("fault", '{"target": "encoder", "joint": 2, "kind": "stuck"}')
    assert request == FaultRequest(target="encoder", joint=2, kind="stuck")
    assert parse("fault", '{"target": "amplifier", "kind": "ok"}').joint is None
    assert "no joint" in refused("fault", {"target": "bus", "joint": 1, "kind": "off"})
    assert "joint" in refused("fault", {"target": "encoder", "joint": 0, "kind": "off"})
    assert "joint" in refused("fault", {"target": "encoder", "joint": 1.5, "kind": "off"})
    assert "kind" in refused("fault", {"target": "encoder", "joint": 1, "kind": "melt"})


def test_reply__fields__survive_json_and_nan_is_kept_out():
    reply = Reply(ok=False, reason="no", request_id="r", joint=2, value=3.4, limit=2.8)
    assert Reply.model_validate_json(reply.model_dump_json()) == reply
    with pytest.raises(ValidationError, match="finite"):
        Reply(ok=False, value=float("nan"))


def test_explain__one_error__says_where_what_and_what_stood_there():
    with pytest.raises(ValidationError) as e:
        WaypointsRequest.model_validate_json('{"times_s": [0, "1"], "points_rad": [[0], [1]]}')
    assert explain(e.value) == "times_s[1]: Input should be a valid number, got '1'"


def test_schemas__every_command_and_the_reply__serialise_and_forbid_extras():
    known = schemas()
    assert set(known) == {*COMMANDS, "reply"}
    json.dumps(known)
    assert known["gain_bounds"]["additionalProperties"] is False
    assert set(known["trajectory"]["discriminator"]["mapping"]) == set(EXAMPLES)


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=5) | st.dictionaries(st.text(max_size=8), inner),
    max_leaves=6,
)


@settings(max_examples=150, deadline=None)
@given(command=st.sampled_from(sorted(COMMANDS)), payload=st.binary(max_size=80))
def test_parse__any_bytes__gives_a_request_or_one_line(command, payload):
    try:
        parse(command, payload)
    except RequestError as error:
        assert str(error).isprintable()  # noqa: PT017 - both outcomes are right


@settings(max_examples=200, deadline=None)
@given(
    command=st.sampled_from(sorted(COMMANDS)),
    kind=st.sampled_from(sorted(EXAMPLES)),
    changes=st.dictionaries(
        st.sampled_from(sorted({key for fields in EXAMPLES.values() for key in fields})),
        json_values,
        max_size=3,
    ),
)
def test_parse__mutated_requests__give_a_request_or_one_line(command, kind, changes):
    payload = json.dumps({"kind": kind} | EXAMPLES[kind] | changes)
    try:
        parse(command, payload)
    except RequestError as error:
        assert str(error).isprintable()  # noqa: PT017 - both outcomes are right


@pytest.mark.parametrize("command", COMMANDS)
def test_parse__payload_beyond_its_limit__refused_unread(command):
    most = MAX_TRAJECTORY_BYTES if command == "trajectory" else MAX_COMMAND_BYTES
    assert f"beyond {most} bytes" in refused(command, b"{" * (most + 1))
    assert "beyond" not in refused(command, b"{" * most)


@pytest.mark.parametrize("command", [name for name in COMMANDS if name != "estop"])
@pytest.mark.parametrize("version", [0, 2, "1", None])
def test_parse__other_version__refused(command, version):
    fields = {"version": version, "kind": "kelly"} if command == "trajectory" else {}
    assert "version" in refused(command, {"version": version, **fields})


@pytest.mark.parametrize("version", [1, 2, 99])
def test_parse__emergency_stop_of_any_version__taken(version):
    assert parse("estop", json.dumps({"version": version})).version == version


@pytest.mark.parametrize("name", ["", "a/b", "*", "a b", "-a", ".a", "@a", "ä", "a" * 65, 5, None])
def test_parse__operator_that_is_no_chunk_of_a_key__refused(name):
    assert "operator" in refused("acquire", {"operator": name})
    if name is not None:
        assert "operator" in refused("estop", {"operator": name})


def test_contract__published__version_every_schema_and_the_proto():
    known = contract()
    assert known["version"] == PROTOCOL_VERSION
    assert set(known) == {"version", "proto", "reply", *COMMANDS}
    assert "message SampleBatch" in known["proto"]
    assert json.loads(json.dumps(known)) == known
    for name in set(COMMANDS) - {"acquire", "estop", "trajectory"}:
        assert {"lease", "request_id", "sent_ns", "version"} <= set(known[name]["properties"])
