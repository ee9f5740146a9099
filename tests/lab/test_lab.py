"""The lab itself, from the host: what goes in, what comes out, and what it says when it cannot."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

LAB = Path(__file__).parents[2] / "deploy" / "lab" / "lab.py"
KERNEL = Path("/usr/bin/linux.uml")
BOOT_TIMEOUT_S = 90.0


def lab(*arguments, **environment):
    return subprocess.run(
        [sys.executable, str(LAB), *arguments],
        capture_output=True,
        text=True,
        check=False,
        timeout=BOOT_TIMEOUT_S,
        env=os.environ | environment,
    )


@pytest.fixture
def guest():
    if not KERNEL.exists():
        pytest.skip("no user-mode kernel on this host; `make lab` installs it")
    return lambda *words: lab("--kernel", "uml", *words)


def test_guest__command__output_exit_status_and_files_as_promised(guest, tmp_path):
    kept, lost = tmp_path / "kept", tmp_path / "lost"
    kept.mkdir()
    lost.mkdir()
    (kept / "in").write_text("from the host")
    script = f"cat {kept}/in; echo told >&2; echo guest >{kept}/out; echo x >{lost}/out; exit 7"
    done = guest("--rw", str(kept), "--", "sh", "-c", script)
    assert done.returncode == 7, done.stderr
    assert done.stdout == "from the host"
    assert "told\n" in done.stderr
    assert done.stderr.splitlines()[-1].startswith("lab: exit 7, ")
    assert (kept / "out").read_text() == "guest\n"
    assert list(lost.iterdir()) == []


def test_guest__interfaces__are_up(guest):
    done = guest("--", "ip", "-brief", "link")
    assert done.returncode == 0, done.stderr
    up = {line.split()[0].partition("@")[0] for line in done.stdout.splitlines() if "UP" in line}
    assert up == {"lo", "vcan0", "vcan1", "vxcan0", "vxcan1"}


def test_guest__command_hangs__ends_after_the_time_out_and_leaves_no_process(guest, tmp_path):
    done = guest("--timeout", "4", "--", "sh", "-c", "echo begun; sleep 600")
    assert done.returncode == 124
    assert "timed out after 4 s" in done.stderr
    marks = [path for path in Path("/proc").glob("[0-9]*/cmdline") if _mentions(path, "hil-lab-")]
    assert marks == []


def _mentions(path, words):
    try:
        line = path.read_bytes().decode("utf-8", "replace")
    except OSError:
        return False
    return "linux.uml" in line and words in line


def test_host_kernel__without_can__one_line_and_status_125():
    done = lab("--kernel", "host", "--", "true")
    if done.returncode == 0:
        pytest.skip("this host's kernel has CAN")
    assert done.returncode == 125
    (line,) = done.stderr.splitlines()
    assert line.startswith("lab: cannot run: ")


@pytest.mark.parametrize(("ci", "status"), [("true", 125), ("false", 0)])
def test_optional__no_lab__warns_by_name_and_fails_only_in_ci(ci, status):
    done = lab("--kernel", "host", "--optional", "--", "true", CI=ci, PATH="/nowhere")
    assert done.returncode == status
    (line,) = done.stderr.splitlines()
    assert line.startswith("lab: WARNING: not run: " if status == 0 else "lab: cannot run: ")
