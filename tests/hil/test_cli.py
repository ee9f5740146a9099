"""The command line: usage, mistakes in one line with the right status, and files it cannot use."""

import json

import pytest

from hil.cli import VERBS, main, make_parser
from hil.cli.send import request
from tests.hil.lab import HilProcess, one_line


def failure(capsys, *arguments):
    """Run a command that must fail with status 1; return its one line on stderr."""
    assert main(arguments) == 1
    output = capsys.readouterr()
    (line,) = output.err.splitlines()
    assert line.startswith("hil: ")
    return line


@pytest.mark.parametrize("verb", VERBS)
def test_verb__help__says_what_it_does(capsys, verb):
    with pytest.raises(SystemExit) as ended:
        main([verb, "--help"])
    assert ended.value.code == 0
    text = capsys.readouterr().out
    assert text.startswith(f"usage: hil {verb}")


@pytest.mark.parametrize(
    "arguments",
    [[], ["dance"], ["send"], ["send", "dance"], ["run", "--speed", "2"], ["export", "a.mcap"],
     ["send", "trajectory"], ["send", "trajectory", "a.json", "--json", "{}"],
     ["emulate", "--time", "slow"], ["watch", "--for", "ever"]],
    ids=" ".join,
)  # fmt: skip
def test_usage__wrong__status_2_and_a_usage_line(capsys, arguments):
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 2
    assert "usage: hil" in capsys.readouterr().err


def test_unknown_verb__as_a_process__status_2(tmp_path):
    process = HilProcess(tmp_path, "dance")
    assert process.wait() == 2
    assert "invalid choice: 'dance'" in process.stderr
    assert "Traceback" not in process.stderr


def test_version__is_printed(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["--version"])
    assert ended.value.code == 0
    assert capsys.readouterr().out.startswith("hil ")


@pytest.mark.parametrize("verb", ["run", "emulate", "sim", "doctor"])
@pytest.mark.parametrize(
    ("text", "words"),
    [("[loop\n", "not valid TOML"), ("[loop]\nspeed = 1\n", "loop.speed: Extra inputs"),
     ('[loop]\npriority = "x"\n', "loop.priority: Input should be a valid integer")],
    ids=["bad TOML", "unknown key", "wrong type"],
)  # fmt: skip
def test_configuration__mistaken__one_line_in_every_verb(capsys, tmp_path, verb, text, words):
    path = tmp_path / "arm.toml"
    path.write_text(text)
    line = failure(capsys, verb, "--config", str(path))
    assert f"{path}: {words}" in line


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["run", "--config", "/no/such.toml"], "/no/such.toml: No such file or directory"),
        (["run", "--set", "loop.cpu"], "write table.key=value"),
        (["run", "--set", "loop.cpu=many"], "loop.cpu"),
        (["run", "--set", "axes.7.node_id=1"], "axes.7: entries are numbered 1 to 2"),
        (["run", "--scenario", "Z"], "scenario 'Z' is not one of: A0, A, B, E"),
        (["sim", "--scenario", "Z"], "scenario 'Z' is not one of"),
        (["demo", "--scenario", "Z"], "scenario 'Z' is not one of"),
        (["demo", "--scenario", "A0"], "run it with: hil sim --scenario A0"),
        (["emulate", "--bus", "carrier-pigeon:1"], "bus address 'carrier-pigeon:1'"),
        (["emulate", "--bus", "python-can:nothing:0"], "nothing"),
        (["sim", "--trajectory", "/no/such.json"], "/no/such.json: No such file or directory"),
        (["sim", "--trajectory", "/dev/null"], "hil: trajectory: "),
        (["sim", "--record", "/proc/none/a.mcap"], "/proc/none: No such file or directory"),
        (["report", "/no/such.mcap"], "/no/such.mcap: No such file or directory"),
        (["report", "/dev/null"], "not an MCAP recording"),
        (["export", "/dev/null", "--csv", "-"], "not an MCAP recording"),
        (["send", "enable", "--connect", "nonsense"], "Endpoints must be of the form"),
        (["watch", "--connect", "nonsense"], "Endpoints must be of the form"),
        (["send", "trajectory", "/no/such.json"], "/no/such.json: No such file or directory"),
        (["send", "trajectory", "--json", "{"], "the trajectory is not JSON"),
        (["send", "trajectory", "--json", "[]"], "the trajectory is not a JSON object"),
        (["send", "trajectory", "--scenario", "Z"], "scenario 'Z' is not one of"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else None,
)
def test_mistake__any__one_line_and_status_1(capsys, tmp_path, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    assert words in failure(capsys, *arguments)


def test_mistake__as_a_process__one_line_and_status_1(tmp_path):
    (tmp_path / "arm.toml").write_text("[bus]\naddress = 5\n")
    process = HilProcess(tmp_path, "run", "--config", "arm.toml")
    assert process.wait() == 1
    assert "arm.toml: bus.address: Input should be a valid string (got 5)" in one_line(process)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["enable"], ("enable", {})),
        (["estop"], ("estop", {})),
        (["gain-bounds", "--min", "1", "1.5", "--max", "2", "4"],
         ("gain_bounds", {"Kd_min": [1.0, 1.5], "Kd_max": [2.0, 4.0]})),
        (["fault", "--joint", "2"],
         ("fault",
          {"target": "amplifier", "kind": "off", "joint": 2, "duration_s": None})),
        (["trajectory", "--move", "0.5", "-0.3"],
         ("trajectory", {"kind": "move", "target_rad": [0.5, -0.3]})),
        (["trajectory", "--scenario", "A"],
         ("trajectory", {"kind": "kelly", "approach": "none", "duration_s": 20.0, "rate": 0.25})),
        (["trajectory", "--json", '{"kind": "x"}'], ("trajectory", {"kind": "x"})),
    ],
)  # fmt: skip
def test_send__arguments__become_the_request(arguments, expected):
    assert request(make_parser().parse_args(["send", *arguments])) == expected


def test_send__trajectory_from_a_file_or_standard_input__is_read(tmp_path, monkeypatch):
    fields = {"kind": "move", "target_rad": [1.0, 2.0]}
    path = tmp_path / "move.json"
    path.write_text(json.dumps(fields))
    assert request(make_parser().parse_args(["send", "trajectory", str(path)]))[1] == fields
    with path.open() as stream:
        monkeypatch.setattr("sys.stdin", stream)
        assert request(make_parser().parse_args(["send", "trajectory", "-"]))[1] == fields
