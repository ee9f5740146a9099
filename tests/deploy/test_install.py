"""docs/install.md, followed as far as a test may: files in a directory that stands for `/`."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from hil.config import load_config

ROOT = Path(__file__).parents[2]
BLOCK = re.compile(r"^```sh (\w+)\n(.*?)^```", re.M | re.S)
PLACES = ("/etc/", "/opt/", "/root/", "/usr/local/", "/var/lib/")
FILE_COMMANDS = ("install ", "sed ", "cp ")


def commands(name):
    """The commands of one block of the page."""
    blocks = dict(BLOCK.findall((ROOT / "docs" / "install.md").read_text()))
    return blocks[name].splitlines()


def below(line, root):
    """A command with the host's places moved below `root`, and without another owner."""
    for place in PLACES:
        line = re.sub(rf"(?:^|(?<=[\s'\"])){place}", f"{root}{place}", line)
    return re.sub(r" -o \w+ -g \w+", "", line)


def follow(lines, root):
    """Run commands in the source tree."""
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    for line in lines:
        subprocess.run(
            ["sh", "-ec", below(line, root)],
            cwd=ROOT, check=True, timeout=600, env=os.environ | {"PATH": path},
        )  # fmt: skip


@pytest.mark.parametrize("name", ["service", "network", "isolation"])
def test_install__blocks_of_files__put_them_in_place(tmp_path, name):
    lines = [line for line in commands(name) if line.startswith(FILE_COMMANDS)]
    assert lines
    follow(lines, tmp_path)
    assert [path for path in tmp_path.rglob("*") if path.is_file()]
    if name == "service":
        config = load_config(str(tmp_path / "etc" / "hil" / "bench.toml"))
        assert config.bus.address == "unix:/run/hil/bench.sock"
        assert (tmp_path / "etc" / "systemd" / "system" / "hil@.service").is_file()


def test_install__keys__daemon_gets_its_own_alone(tmp_path):
    (tmp_path / "root").mkdir()
    follow([line for line in commands("keys") if not line.startswith("chown")], tmp_path)
    placed = tmp_path / "etc" / "hil" / "zenoh"
    assert [path.name for path in placed.iterdir()] == ["daemon"]
    assert (placed / "daemon" / "key.pem").stat().st_mode & 0o077 == 0


def test_install__every_file_named__is_there():
    text = (ROOT / "docs" / "install.md").read_text()
    for pattern in re.findall(r"deploy/[\w./*@-]*[\w*]", text):
        assert list(ROOT.glob(pattern)), pattern


@pytest.mark.nightly
@pytest.mark.skipif("HIL_NIGHTLY" not in os.environ, reason="takes minutes: HIL_NIGHTLY=1")
@pytest.mark.timeout(900)
def test_install__program_in_a_clean_environment__runs(tmp_path):
    source = tmp_path / "source"
    tracked = subprocess.run(
        ["git", "ls-files", "-co", "--exclude-standard"], cwd=ROOT, capture_output=True, check=True
    )
    for name in tracked.stdout.decode().splitlines():
        if (ROOT / name).is_file():
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, source / name)
    (tmp_path / "usr" / "local" / "bin").mkdir(parents=True)
    script = "\n".join(below(line, tmp_path) for line in commands("program")[:-1])
    subprocess.run(["sh", "-ec", script], cwd=source, check=True, timeout=800)
    hil = tmp_path / "usr" / "local" / "bin" / "hil"
    for arguments in (["--version"], ["demo", "--help"], ["keys", "init", str(tmp_path / "keys")]):
        subprocess.run([hil, *arguments], check=True, timeout=60, cwd=tmp_path)
