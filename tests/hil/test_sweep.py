"""`hil sweep`: the grid, the runs, the table, and going on after an interruption."""

import csv
import json
import math
import signal
from dataclasses import replace
from itertools import product

import pytest
from pyarrow import parquet

from hil.batch import FIGURES, BatchError, Figures, exit_status, simulate
from hil.compare import Case, configure
from hil.config import config_from_json
from hil.messages import KellyRequest
from hil.sweep import (
    Axis,
    Base,
    Outcome,
    SweepError,
    parse_axis,
    plan_sweep,
    read_grid,
    run_one,
    sweep,
)
from hil.sweep_output import CSV_NAME, JOURNAL_NAME, PARQUET_NAME, Journal, Table
from tests.hil.lab import HilProcess, one_line, wait_until

KI = "controller.law.Ki"
ALPHA = "controller.law.alpha"
VALUES = [[0.1, 0.1], [0.2, 0.2]]
NEAR_START = {"plant": {"q0_rad": [0.1, 0.1]}}
FIGURE = Figures(*((float(n), -float(n)) for n in range(len(FIGURES))))


@pytest.fixture
def kelly(tmp_path):
    """A short trajectory in a file."""
    path = tmp_path / "kelly.json"
    request = {"kind": "kelly", "duration_s": 1.2, "rate": 0.25, "approach": "none"}
    path.write_text(json.dumps(request))
    return str(path)


# --- the grid ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("a.b=1,2.5,3", (1, 2.5, 3)),
        ("a.b=[1, 2]", (1, 2)),
        ("a.b=[[10,10],[15,15]]", ([10, 10], [15, 15])),
        ("a.b=[10,10],[15,15]", ([10, 10], [15, 15])),
        ("a.b=[[10,10]]", ([10, 10],)),
        ("a.b=off, literal", ("off", "literal")),
        ('a.b="off","x,y"', ("off", "x,y")),
        ("a.b=true,false", (True, False)),
        ("a.b=A", ("A",)),
        ('a.b={ x = 1 },{ x = 2 }', ({"x": 1}, {"x": 2})),
    ],
)  # fmt: skip
def test_parse_axis__values__as_written(text, values):
    assert parse_axis(text) == Axis("a.b", values)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("loop.cpu", "write key=v1,v2"),
        ("=1,2", "write key=v1,v2"),
        ("a..b=1", "write key=v1,v2"),
        ("a=", "at least one value"),
        ("a=[]", "at least one value"),
        ("a=1,2,1", "value 1 comes twice"),
        ("a=[10, 10]", "[[1, 2], [3, 4]] for lists"),
    ],
)
def test_parse_axis__no_values__told(text, told):
    with pytest.raises(SweepError) as error:
        parse_axis(text)
    assert told in str(error.value)


def test_read_grid__file__every_list_is_an_axis_in_the_order_of_the_file(tmp_path):
    path = tmp_path / "grid.toml"
    path.write_text(
        'scenario = ["A", "B"]\n[controller.law]\nalpha = [[1, 1], [2, 2]]\nKi = [[1, 1]]'
    )
    assert read_grid(str(path)) == [
        Axis("scenario", ("A", "B")),
        Axis(ALPHA, ([1, 1], [2, 2])),
        Axis(KI, ([1, 1],)),
    ]


@pytest.mark.parametrize(
    ("text", "told"),
    [("x = 1", "x: needs a list"), ("x = [", "not valid TOML"), (None, "No such file")],
)
def test_read_grid__unusable__told(tmp_path, text, told):
    path = tmp_path / "grid.toml"
    if text is not None:
        path.write_text(text)
    with pytest.raises(SweepError, match=told):
        read_grid(str(path))


def test_plan_sweep__two_axes__every_combination_first_slowest():
    axes = [Axis("scenario", ("B", "A")), Axis(KI, tuple(VALUES))]
    points = plan_sweep(axes, Base())
    assert [point.number for point in points] == [1, 2, 3, 4]
    assert [point.values for point in points] == list(product(("B", "A"), VALUES))
    configs = [config_from_json(point.run.config) for point in points]
    assert [config.scenario for config in configs] == ["B", "B", "A", "A"]
    assert [list(config.controller.law.Ki) for config in configs] == VALUES * 2
    assert configs[0].controller.velocity.estimator == "levant"
    assert {(point.run.stat_start_s, point.run.end_s) for point in points} == {(12.0, 20.0)}


def test_plan_sweep__trajectories_vary__each_its_request(tmp_path, kelly):
    other = tmp_path / "move.json"
    other.write_text('{"kind": "move", "target_rad": [0.1, 0.1]}')
    points = plan_sweep([Axis("trajectory", (kelly, str(other)))], Base(settings=NEAR_START))
    assert [json.loads(point.run.request)["kind"] for point in points] == ["kelly", "move"]
    assert all(point.run.stat_start_s is None for point in points)
    assert config_from_json(points[0].run.config).scenario is None


def test_plan_sweep__setting_of_a_list__by_number():
    (point,) = plan_sweep([Axis("axes.2.node_id", (9,))], Base())
    assert [axis.node for axis in config_from_json(point.run.config).axes][1] == 9


@pytest.mark.parametrize(
    ("axes", "told"),
    [
        ([], "nothing varies"),
        ([Axis(KI, (1,)), Axis(KI, (2,))], "varies twice"),
        ([Axis("loop", (1,)), Axis("loop.cpu", (2,))], "is a part of loop"),
        ([Axis("loop.cpu", (0, "many"))], 'run 2 (loop.cpu="many"): configuration: loop.cpu'),
        ([Axis("loop.spu", (0,))], "loop.spu"),
        ([Axis("scenario", ("A", "Z"))], "run 2 (scenario=\"Z\"): scenario 'Z' is not one of"),
        ([Axis("trajectory", ("gone.json",))], "gone.json: No such file"),
        ([Axis(f"a.b{i}", tuple(range(100))) for i in range(4)], "100000000 runs, more than"),
    ],
)  # fmt: skip
def test_plan_sweep__impossible__told_before_anything_runs(axes, told):
    with pytest.raises(SweepError) as error:
        plan_sweep(axes, Base())
    assert told in str(error.value)


# --- the runs ---------------------------------------------------------------------------------


def test_run_one__figures__those_of_a_simulation(kelly):
    (point,) = plan_sweep([Axis(KI, ([0.2, 0.2],))], Base(None, None, kelly, NEAR_START))
    request = KellyRequest(duration_s=1.2, rate=0.25, approach="none")
    expected = simulate(config_from_json(point.run.config), request)
    assert run_one(point.run) == Outcome(point.run, "", expected)
    assert all(len(getattr(expected, name)) == 2 for name in FIGURES)


def test_plan_sweep__scenario_A__configuration_and_window_of_the_comparison():
    (point,) = plan_sweep([Axis("scenario", ("A",))], Base())
    config = config_from_json(point.run.config)
    compared = configure(Case("self-tuning pid", "bench_h kelly_4", "nominal"))
    assert config.controller.law == compared.controller.law
    assert (config.plant, config.servos) == (compared.plant, compared.servos)


def test_run_one__trajectory_that_cannot_be_followed__an_outcome(kelly):
    settings = {"controller": {"limits": {"dq_max_rad_s": [0.01, 0.01]}}}
    (point,) = plan_sweep([Axis(KI, (VALUES[0],))], Base(None, None, kelly, settings))
    outcome = run_one(point.run)
    assert outcome.figures is None
    assert "velocity" in outcome.failed


def killed(run):
    """A run whose process is killed from outside."""
    signal.raise_signal(signal.SIGKILL)


def test_sweep__worker_killed__told_in_one_line(kelly, monkeypatch):
    (point,) = plan_sweep([Axis(KI, (VALUES[0],))], Base(None, None, kelly, NEAR_START))
    monkeypatch.setattr("hil.sweep.run_one", killed)
    with pytest.raises(BatchError, match="is there memory"):
        sweep([point.run], 1, lambda outcome: None)


def test_exit_status__some_tripped__a_result():
    assert exit_status(["", "tripped"]) == 0
    assert exit_status(["tripped", "tripped"]) == 1


# --- what it leaves ---------------------------------------------------------------------------


def three_points():
    axes = [Axis(KI, ([0.1, 0.1], [0.2, 0.2], [0.3, 0.3]))]
    return axes, plan_sweep(axes, Base())


def test_journal__closed_and_opened__same_outcomes_bit_for_bit(tmp_path):
    _, (a, b, c) = three_points()
    nan = replace(FIGURE, rms_counts=(0.1 + 0.2, math.inf))
    outcomes = {a.run: Outcome(a.run, "", nan), b.run: Outcome(b.run, "tripped", None)}
    with Journal(tmp_path) as journal:
        for outcome in outcomes.values():
            journal.add(outcome)
    with Journal(tmp_path) as journal:
        assert journal.known([c.run, b.run, a.run]) == outcomes


@pytest.mark.parametrize("cut", [1, 30, 200])
def test_journal__cut_short_by_a_kill__whole_lines_count_and_new_ones_follow(tmp_path, cut):
    _, (a, b, c) = three_points()
    with Journal(tmp_path) as journal:
        journal.add(Outcome(a.run, "", FIGURE))
        journal.add(Outcome(b.run, "", FIGURE))
    path = tmp_path / JOURNAL_NAME
    path.write_bytes(path.read_bytes()[:-cut])
    with Journal(tmp_path) as journal:
        assert list(journal.known([a.run, b.run])) == [a.run]
        journal.add(Outcome(c.run, "", FIGURE))
    with Journal(tmp_path) as journal:
        assert set(journal.known([a.run, b.run, c.run])) == {a.run, c.run}
    assert all(json.loads(line) for line in path.read_text().splitlines())


@pytest.mark.parametrize(
    "line", [b"\xff\xfe", b"[]", b"{}", b'{"id": 1}', b'{"id": "ID", "figures": {"rms_counts": 1}}']
)
def test_journal__line_that_is_damaged__passed_over(tmp_path, line):
    _, (a, *_) = three_points()
    with Journal(tmp_path) as journal:
        identity = journal._identity.of(a.run)
    (tmp_path / JOURNAL_NAME).write_bytes(line.replace(b"ID", identity.encode()) + b"\n")
    with Journal(tmp_path) as journal:
        assert journal.known([a.run]) == {}


def test_journal__another_program__runs_again(tmp_path, monkeypatch):
    _, (a, *_) = three_points()
    with Journal(tmp_path) as journal:
        journal.add(Outcome(a.run, "", FIGURE))
    monkeypatch.setattr("hil.sweep.fingerprint", lambda: "another")
    with Journal(tmp_path) as journal:
        assert journal.known([a.run]) == {}


def test_journal__in_use__refused(tmp_path):
    with Journal(tmp_path), pytest.raises(SweepError, match="in use by another sweep"):
        Journal(tmp_path)


def test_table__some_outcomes__order_of_the_grid_and_gaps(tmp_path):
    axes, (a, b, c) = three_points()
    outcomes = {c.run: Outcome(c.run, "", FIGURE), a.run: Outcome(a.run, "why", None)}
    table = Table(axes, [a, b, c])
    table.write_csv(tmp_path / CSV_NAME, outcomes)
    rows = list(csv.DictReader((tmp_path / CSV_NAME).read_text().splitlines()))
    assert [(row["run"], row[KI], row["failed"]) for row in rows] == [
        ("1", "[0.1, 0.1]", "why"),
        ("3", "[0.3, 0.3]", ""),
    ]
    assert rows[0]["rms_1_counts"] == ""
    assert (rows[1]["peak_tau_1_Nm"], rows[1]["peak_tau_2_Nm"]) == ("4.0", "-4.0")
    table.write_parquet(tmp_path / PARQUET_NAME, outcomes)
    columns = parquet.read_table(tmp_path / PARQUET_NAME).to_pydict()
    assert columns == table.columns(outcomes)
    assert columns["Kd_max_2"] == [None, -8.0]


def test_table__values_of_mixed_types__text_in_parquet(tmp_path):
    axes = [Axis("loop.cpu", (1, "2"))]
    points = plan_sweep(axes, Base())
    outcomes = {point.run: Outcome(point.run, "", FIGURE) for point in points}
    Table(axes, points).write_parquet(tmp_path / PARQUET_NAME, outcomes)
    columns = parquet.read_table(tmp_path / PARQUET_NAME).to_pydict()
    assert columns["loop.cpu"] == ["1", '"2"']


# --- the command ------------------------------------------------------------------------------


def command(directory, kelly, *arguments):
    grid = ["--vary", f"{ALPHA}=[[10,10],[15,15]]", "--vary", f"{KI}=[0.1,0.1],[0.2,0.2]"]
    near = ["--set", "plant.q0_rad=[0.1,0.1]", "--trajectory", kelly]
    return HilProcess(directory, "sweep", *grid, *near, *arguments)


def test_command__one_process_or_two__same_table_and_nothing_run_twice(tmp_path, kelly):
    one = command(tmp_path, kelly, "--processes", "1", "--out", "one", "--parquet")
    assert one.wait(60) == 0, one.stderr
    two = command(tmp_path, kelly, "--processes", "2", "--out", "two")
    assert two.wait(60) == 0, two.stderr
    table = (tmp_path / "one" / CSV_NAME).read_bytes()
    assert table == (tmp_path / "two" / CSV_NAME).read_bytes()
    rows = list(csv.DictReader(table.decode().splitlines()))
    assert len({row["rms_1_counts"] for row in rows}) == len(rows) == 4
    assert parquet.read_table(tmp_path / "one" / PARQUET_NAME).num_rows == 4
    known = command(tmp_path, kelly, "--out", "two")
    assert known.wait(60) == 0
    assert "4 known before, 0 run" in known.stdout
    assert (tmp_path / "two" / CSV_NAME).read_bytes() == table


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_command__ended_from_outside__goes_on_where_it_was(tmp_path, number):
    arguments = ["sweep", "--vary", f"{KI}=[0.1,0.1],[0.2,0.2]", "--processes", "1", "--out", "o"]
    long = tmp_path / "long.json"
    long.write_text('{"kind": "kelly", "duration_s": 2.5, "rate": 0.25, "approach": "none"}')
    arguments += ["--set", "plant.q0_rad=[0.1,0.1]", "--trajectory", str(long)]
    journal = tmp_path / "o" / JOURNAL_NAME
    process = HilProcess(tmp_path, *arguments)
    wait_until(lambda: journal.exists() and b"\n" in journal.read_bytes(), 60.0, "the first run")
    process.end(number)
    kept = journal.read_bytes().splitlines()
    assert 1 <= len(kept) <= 2
    if number == signal.SIGINT:
        assert process.stderr.splitlines()[-1] == "hil: interrupted"
        rows = list(csv.DictReader((tmp_path / "o" / CSV_NAME).read_text().splitlines()))
        assert len(rows) == len(kept)
    again = HilProcess(tmp_path, *arguments)
    assert again.wait(60) == 0, again.stderr
    assert f"{len(kept)} known before, {2 - len(kept)} run" in again.stdout
    assert journal.read_bytes().splitlines()[: len(kept)] == kept


def test_command__every_run_refused__status_and_told(tmp_path, kelly):
    options = ["--set", "controller.limits.dq_max_rad_s=[0.01,0.01]", "--out", "o"]
    process = command(tmp_path, kelly, *options)
    assert process.wait(60) == 1
    assert "4 of 4 runs tripped" in one_line(process)


def test_command__no_pyarrow__told_before_anything_runs(tmp_path, kelly):
    block = tmp_path / "pyarrow.py"
    block.write_text("raise ImportError")
    process = HilProcess(
        tmp_path, "sweep", "--vary", "scenario=A", "--parquet", PYTHONPATH=str(tmp_path)
    )
    assert process.wait(60) == 1
    assert "pip install 'hil[sweep]'" in one_line(process)
    assert not (tmp_path / "runs").exists()
