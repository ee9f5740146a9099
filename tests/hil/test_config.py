"""Where a setting comes from, what is refused, and that a configuration survives its way."""

import json
import os

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hil.config import (
    Config,
    ConfigError,
    config_from_json,
    load_config,
    merge,
    parse_assignment,
    preset_defaults,
)
from sim_backend.presets import PRESETS


@pytest.fixture(autouse=True)
def _no_settings_from_outside(monkeypatch):
    for name in [name for name in os.environ if name.startswith("HIL_")]:
        monkeypatch.delenv(name)


@pytest.fixture
def toml(tmp_path):
    """Write a configuration file and return its path."""

    def write(text):
        path = tmp_path / "arm.toml"
        path.write_text(text)
        return str(path)

    return write


def refusal(path=None, over=None):
    with pytest.raises(ConfigError) as caught:
        load_config(path, over)
    text = str(caught.value)
    assert "\n" not in text
    return text


# --- precedence -------------------------------------------------------------------------------


def test_setting__in_all_places__command_line_wins_over_environment_over_file(toml, monkeypatch):
    path = toml("[loop]\npriority = 11\n")
    assert load_config().loop.priority == 80
    assert load_config(path).loop.priority == 11
    monkeypatch.setenv("HIL_LOOP__PRIORITY", "22")
    assert load_config(path).loop.priority == 22
    assert load_config(path, parse_assignment("loop.priority=33")).loop.priority == 33


def test_setting__elsewhere_in_the_same_table__is_kept(toml, monkeypatch):
    path = toml('[loop]\npriority = 11\nrealtime = "off"\n[arm]\nname = "left"\n')
    monkeypatch.setenv("HIL_LOOP__CPU", "1")
    config = load_config(path, parse_assignment("loop.period_s=0.002"))
    assert config.loop.priority == 11
    assert config.loop.realtime == "off"
    assert config.loop.cpu == 1
    assert config.loop.period_s == 0.002
    assert config.arm.name == "left"


def test_environment__list__is_json(monkeypatch):
    monkeypatch.setenv("HIL_ZENOH__LISTEN", '["tcp/[::1]:7", "tcp/127.0.0.1:8"]')
    assert load_config().zenoh.listen == ("tcp/[::1]:7", "tcp/127.0.0.1:8")


def test_list_entry__by_number__changes_one_entry_of_preset_file_or_environment(toml):
    over = merge(
        parse_assignment("axes.2.node_id=9"),
        parse_assignment("controller.limits.tau_max_Nm.1=3.5"),
    )
    config = load_config(None, over)
    assert [axis.node_id for axis in config.axes] == [1, 9]
    assert config.controller.limits.tau_max_Nm == (3.5, 8.0)
    path = toml("[controller.limits]\ntau_max_Nm = [5.0, 6.0]\n")
    assert load_config(path, over).controller.limits.tau_max_Nm == (3.5, 6.0)


def test_list_entry__number_out_of_range__refused():
    text = refusal(over=parse_assignment("axes.3.node_id=9"))
    assert "axes.3: entries are numbered 1 to 2" in text


def test_preset__named_anywhere__fills_what_is_left_out(toml, monkeypatch):
    path = toml('[arm]\npreset = "light"\n[plant]\ngravity_m_s2 = 1.0\n')
    light = load_config(path)
    assert light.plant.gravity_m_s2 == 1.0
    assert light.plant.links[0].mass_kg == 0.8
    monkeypatch.setenv("HIL_ARM__PRESET", "pelican_v")
    assert load_config(path).plant.links[0].mass_kg == 6.5225
    assert load_config(path).plant.gravity_m_s2 == 1.0


@pytest.mark.parametrize("name", PRESETS)
def test_preset__each__is_a_whole_configuration(name):
    config = load_config(None, {"arm": {"preset": name}})
    assert config.joints == 2
    assert config.controller.limits.tau_max_Nm == tuple(axis.torque_max_Nm for axis in config.axes)


# --- refusals ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[loop\n", "not valid TOML"),
        ("[loop]\nspeed = 1\n", "loop.speed: Extra inputs are not permitted (got 1)"),
        ("colour = 1\n", "colour: Extra inputs"),
        ('[loop]\npriority = "high"\n', "loop.priority: Input should be a valid integer, unable"),
        ("[loop]\npriority = 99\n", "loop.priority: Input should be less than or equal to 98 (g"),
        ("[loop]\nperiod_s = 0.0001\n", "loop.period_s"),
        ("[loop]\nperiod_s = nan\n", "loop.period_s"),
        ("[loop]\nfeedback_timeout_s = 0.001\n", "must be shorter than loop.period_s"),
        ('[arm]\npreset = "bench_x"\n', "no arm preset 'bench_x'; there are: bench"),
        ('[arm]\nname = "a/b"\n', "arm.name"),
        ('arm = "bench"\n', "arm: Input should be"),
        ('[bus]\naddress = "token-ring:0"\n', "bus address 'token-ring:0' is not one of"),
        ("[controller.law]\nKd_max = [4.0, 9.0]\n", "joint 2: gain bounds (1, 9)"),
        ("[controller.law]\nalpha = [1.0]\n", "alpha has 1 entries, the arm has 2 joints"),
        ("[controller.limits]\nq_min_rad = [1.0]\n", "q_min_rad has 1 entries"),
        ('axes = [{family = "cia402", node_id = 1}]\n', "axes.0"),
        ('axes = [{family = "telepathy"}]\n', "axes.0"),
        ("axes = []\n", "axes"),
        ("[axes.2]\nnode_id = 1\n", "node ids (cia402 1, cia402 1) are not all different"),
        ("servos = []\n", "servos has 0 entries, axes has 2"),
        ("[plant]\nq0_rad = [0.0]\n", "plant.q0_rad has 1 entries, axes has 2"),
    ],
)
def test_file__mistaken__refused_naming_file_setting_and_value(toml, text, words):
    path = toml(text)
    answer = refusal(path)
    assert answer.startswith(f"{path}: ")
    assert words in answer


def test_file__missing_or_no_file_or_no_text__refused(tmp_path):
    assert refusal(str(tmp_path / "none.toml")).endswith("none.toml: No such file or directory")
    assert refusal(str(tmp_path)).endswith("Is a directory")
    (tmp_path / "bytes.toml").write_bytes(b"\xff\xfe\x00")
    assert "not valid TOML" in refusal(str(tmp_path / "bytes.toml"))


def test_environment__not_what_it_should_be__refused(monkeypatch):
    monkeypatch.setenv("HIL_LOOP", "{")
    assert "loop" in refusal()
    monkeypatch.setenv("HIL_LOOP", "{}")
    monkeypatch.setenv("HIL_LOOP__PRIORITY", "soon")
    assert "loop.priority" in refusal()


@pytest.mark.parametrize("text", ["loop.cpu", "=1", ".cpu=1", "loop..cpu=1", "loop.=1"])
def test_assignment__without_key_or_value__refused(text):
    with pytest.raises(ConfigError, match=r"write table\.key=value"):
        parse_assignment(text)


@pytest.mark.parametrize(
    ("text", "value"),
    [("a.b=1", 1), ("a.b=1.5", 1.5), ("a.b=true", True), ("a.b=[1, 2]", [1, 2]),
     ('a.b="x"', "x"), ("a.b=vcan0", "vcan0"), ("a.b=x=y", "x=y"), ("a.b=", "")],
)  # fmt: skip
def test_assignment__value__is_toml_or_else_text(text, value):
    assert parse_assignment(text) == {"a": {"b": value}}


# --- round trips ------------------------------------------------------------------------------

TABLES = st.fixed_dictionaries(
    {},
    optional={
        "arm": st.fixed_dictionaries(
            {}, optional={"name": st.text("aZ09_-", min_size=1, max_size=32),
                          "preset": st.sampled_from(PRESETS)},
        ),
        "loop": st.fixed_dictionaries(
            {}, optional={"period_s": st.floats(1e-3, 10e-3), "cpu": st.none() | st.integers(0, 63),
                          "priority": st.integers(1, 98),
                          "on_gateway_loss": st.sampled_from(["finish", "hold", "stop"])},
        ),
        "zenoh": st.fixed_dictionaries(
            {"allow_open": st.just(True)},
            optional={"listen": st.lists(st.text(max_size=20), max_size=3),
                      "mode": st.sampled_from(["peer", "client", "router"])},
        ),
        "axes": st.dictionaries(
            st.sampled_from(["1", "2"]),
            st.fixed_dictionaries(
                {}, optional={"rpdo_timeout_ms": st.integers(2, 1000),
                              "rated_torque_Nm": st.floats(1e-3, 1e3)},
            ),
        ),
    },
)  # fmt: skip
"""Settings from a command line: tables of valid values."""


@given(over=TABLES)
def test_config__to_json_and_back__is_the_same(over):
    config = load_config(None, over)
    text = config.model_dump_json()
    assert config_from_json(text) == config
    assert config_from_json(text).model_dump_json() == text
    for table, values in over.items():
        if table == "axes":
            for number, entry in values.items():
                axis = config.axes[int(number) - 1]
                assert {key: getattr(axis, key) for key in entry} == entry
        else:
            given_json = json.loads(json.dumps(values))
            assert given_json.items() <= json.loads(text)[table].items()


def test_config_from_json__other_environment__is_not_asked(monkeypatch):
    text = load_config().model_dump_json()
    monkeypatch.setenv("HIL_LOOP__PRIORITY", "22")
    assert config_from_json(text).loop.priority == 80
    assert load_config().loop.priority == 22


@given(base=TABLES, over=TABLES)
def test_merge__any_tables__over_wins_and_nothing_else_changes(base, over):
    merged = merge(base, over)
    assert merge(merged, over) == merged
    assert merge(base, {}) == base
    for table in base.keys() | over.keys():
        expected = {**base.get(table, {}), **over.get(table, {})}
        assert merged[table].keys() == expected.keys()


def test_config__made_directly__fills_from_the_preset_too():
    config = Config(arm={"preset": "light"})
    assert config.model_dump(mode="json")["plant"] == json.loads(
        json.dumps(preset_defaults("light")["plant"])
    )
