"""What `make nightly` does with its parts: all run, the worst one decides."""

import sys
from pathlib import Path

from tests.nightly.run import PARTS, run_all, summary

ROOT = Path(__file__).parents[2]


def ends(code):
    return [sys.executable, "-c", code]


def test_run_all__one_part_fails__the_others_run_and_the_worst_status_counts(capfd):
    said = []
    results = run_all(
        {
            "good": ends("print('ran 1')"),
            "bad": ends("raise SystemExit(3)"),
            "killed": ends("import os; os.kill(os.getpid(), 9)"),
            "last": ends("print('ran 4')"),
        },
        said.append,
    )
    assert [(r.name, r.status) for r in results] == [
        ("good", 0), ("bad", 3), ("killed", 137), ("last", 0),
    ]  # fmt: skip
    assert "ran 1" in (out := capfd.readouterr().out)
    assert "ran 4" in out
    assert [line.split()[-1] for line in said] == ["good", "bad", "killed", "last"]


def test_summary__parts__failed_ones_stand_out():
    results = run_all({"good": ends(""), "bad": ends("raise SystemExit(3)")}, lambda _: None)
    assert [line[:8] for line in summary(results)] == ["pass    ", "FAIL (3)"]


def test_parts__files__are_all_there_and_nothing_nightly_is_left_out():
    """Whatever asks for HIL_NIGHTLY is in a part."""
    named = {word for words in PARTS.values() for word in words if word.startswith("tests/")}
    assert all((ROOT / name).exists() for name in named)
    asking = [
        path.relative_to(ROOT).as_posix()
        for path in (ROOT / "tests").rglob("test_*.py")
        if "HIL_NIGHTLY" in path.read_text() and path.name != "test_run.py"
    ]
    assert asking
    assert [path for path in asking if not path.startswith(tuple(named))] == []
