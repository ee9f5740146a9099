"""Every script of examples/ runs to its end, those that need a daemon against an emulated arm."""

import runpy
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples"
REMOTE = {
    "remote_tuning.py": (["--duration", "2"], "best: Kd"),
    "plot_motion.py": (["--out", "motion.png"], "written: motion.png"),
    "async_session.py": ([], "error up to"),
}
OWN = {"learn_in_simulation.py": (["--episodes", "3", "--duration", "1"], "hil send gain-bounds")}


@pytest.fixture(scope="module")
def arm(shared_lab):
    shared_lab.emulate()
    return shared_lab.run()


def run(name, directory, *arguments):
    return subprocess.run(
        [sys.executable, "-W", "error", str(EXAMPLES / name), *arguments],
        capture_output=True,
        text=True,
        cwd=directory,
        timeout=100,
        check=False,
    )


def test_examples__all_there_are__are_run_here():
    assert {path.name for path in EXAMPLES.glob("*.py")} == set(REMOTE) | set(OWN)


@pytest.mark.parametrize("name", REMOTE)
def test_example__against_a_daemon__does_what_it_says(arm, shared_lab, tmp_path, name):
    arguments, told = REMOTE[name]
    connection = ["--arm", shared_lab.arm, "--connect", shared_lab.endpoint]
    done = run(name, tmp_path, *connection, *arguments)
    assert (done.returncode, done.stderr) == (0, "")
    assert told in done.stdout
    assert ", 0 lost" in done.stdout or "samples" not in done.stdout
    if "--out" in arguments:
        assert (tmp_path / "motion.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("name", ["remote_tuning.py", "async_session.py"])
def test_example__no_daemon__one_line(tmp_path, name):
    done = run(name, tmp_path, "--connect", "tcp/127.0.0.1:1")
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert "nobody answers" in done.stderr


@pytest.mark.parametrize("name", OWN)
def test_example__on_its_own__does_what_it_says(tmp_path, name):
    arguments, told = OWN[name]
    done = run(name, tmp_path, *arguments)
    assert (done.returncode, done.stderr) == (0, "")
    assert told in done.stdout


def test_arm_env__same_actions__same_rewards_to_the_bit():
    made = runpy.run_path(str(EXAMPLES / "learn_in_simulation.py"))
    env = made["ArmEnv"](duration_s=0.5)
    action = [[1.0, 1.0], [3.0, 2.0]]
    first = made["play"](env, action)
    assert made["play"](env, action) == first
    assert made["play"](env, [[0.5, 0.5], [1.0, 1.0]]) != first
