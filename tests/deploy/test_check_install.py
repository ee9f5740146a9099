"""The check that follows docs/install.md: its parts, and at night the whole of it."""

import importlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SCRIPT = ROOT / "deploy" / "check_install.py"
DEB822 = """\
Types: deb
# a comment that names bookworm
URIs: http://one.invalid/debian
Suites: bookworm bookworm-updates
Components: main

Types: deb
URIs: http://two.invalid/other
Suites: other-bookworm
Components: main
"""
LINES = """\
# deb http://old.invalid/debian bookworm main
deb http://three.invalid/debian bookworm main
deb [signed-by=/a/key.gpg] http://four.invalid/security bookworm-security main
deb http://five.invalid/sdk cloud-bookworm main
"""


@pytest.fixture
def check(monkeypatch):
    """The script as a module."""
    monkeypatch.syspath_prepend(str(SCRIPT.parent))
    return importlib.import_module("check_install")


@pytest.fixture
def at(monkeypatch):
    """The module of its steps."""
    monkeypatch.syspath_prepend(str(SCRIPT.parent))
    return importlib.import_module("check_install_steps")


@pytest.fixture
def fresh(monkeypatch):
    """The module of the root that it builds."""
    monkeypatch.syspath_prepend(str(SCRIPT.parent))
    return importlib.import_module("check_install_root")


def test_blocks__page__every_one_is_a_step(at):
    page = (ROOT / "docs" / "install.md").read_text()
    steps = at.steps(at.Installation(None))
    assert {name.removeprefix("block ") for name in steps if name.startswith("block ")} == set(
        at.blocks(page)
    )


def test_image_steps__containerfile__all_that_it_runs(at):
    run, entry = at.image_steps(at.CONTAINERFILE.read_text())
    assert "pip install" in run
    assert "useradd" in run
    assert "\\" not in run
    assert entry == "/opt/hil/.venv/bin/hil"


def test_run_steps__needed_one_fails__the_rest_is_not_reached(check):
    def fail():
        raise check.InstallError("it is broken")

    def be_elsewhere():
        raise check.NotHereError("there is none")

    said = []
    planned = {
        "a": (lambda: "done", True), "b": (fail, False), "c": (be_elsewhere, True),
        "d": (fail, True), "e": (lambda: "never", True),
    }  # fmt: skip
    results = check.run_steps(planned, said.append)
    assert [(r.step, r.verdict) for r in results] == [
        ("a", "pass"), ("b", "FAIL"), ("c", "not here"), ("d", "FAIL"),
    ]  # fmt: skip
    assert "it is broken" in said[1]


def test_debian_sources__mixed_files__only_the_release_itself(fresh, tmp_path):
    folder = tmp_path / "sources.list.d"
    folder.mkdir()
    (folder / "debian.sources").write_text(DEB822)
    (folder / "more.list").write_text(LINES)
    found = fresh.debian_sources("bookworm", tmp_path)
    hosts = [name for name in ("one", "two", "three", "four", "five", "old") if name in found]
    assert hosts == ["one", "three", "four"]


def test_debian_sources__none__says_so(fresh, tmp_path):
    with pytest.raises(fresh.MissingError, match="no apt source of Debian trixie"):
        fresh.debian_sources("trixie", tmp_path)


def test_source_files__everything_tracked__nothing_generated(fresh):
    names = fresh.source_files()
    assert "docs/install.md" in names
    assert not [name for name in names if name.startswith((".git/", ".venv/"))]


@pytest.mark.nightly
@pytest.mark.skipif("HIL_NIGHTLY" not in os.environ, reason="takes minutes: HIL_NIGHTLY=1")
@pytest.mark.timeout(3000)
def test_install__on_a_fresh_debian_that_boots__every_block_works():
    done = subprocess.run(
        [sys.executable, SCRIPT], capture_output=True, text=True, timeout=2900, check=False
    )
    if done.returncode == 125:
        pytest.skip(done.stdout.strip())
    assert done.returncode == 0, done.stdout
    assert "0 failed" in done.stdout
