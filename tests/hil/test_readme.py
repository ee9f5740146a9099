"""The README's quick start, run as it stands."""

import os
import re
import shlex
import signal
import socket
import subprocess
import sys
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

README = Path(__file__).parents[2] / "README.md"


def quick_start() -> list[list[str]]:
    block = re.search(r"<!-- quick-start.*?-->\s*```\n(.*?)```", README.read_text(), re.DOTALL)
    assert block is not None
    commands = [shlex.split(line, comments=True) for line in block[1].splitlines()]
    assert all(command[0] == ".venv/bin/hil" for command in commands)
    return [[sys.executable, "-m", "hil", *command[1:]] for command in commands]


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture
def environment(tmp_path):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    return os.environ | {
        "HIL_BUS__ADDRESS": f"unix:{tmp_path}/bus.sock",
        "HIL_ARM__NAME": "readme",
        "HIL_ZENOH__LISTEN": f'["{endpoint}"]',
        "HIL_CONNECT": endpoint,
    }


@contextmanager
def server(command, environment, cwd):
    process = subprocess.Popen(command, env=environment, cwd=cwd, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout.readline(), f"{command} said nothing"
        yield
    finally:
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=20)
        assert process.returncode == 0


def test_quick_start__as_written__every_command_succeeds(environment, tmp_path):
    emulate, run, *commands = quick_start()
    assert len(commands) == 5
    with ExitStack() as stack:
        for command in (emulate, run):
            stack.enter_context(server(command, environment, tmp_path))
        for command in commands:
            sent = subprocess.run(
                [*command, "--arm", "readme"],
                env=environment,
                capture_output=True,
                text=True,
                timeout=60,
                check=False,
            )
            assert sent.returncode == 0, sent.stderr
    assert list(tmp_path.glob("runs/readme-*.mcap"))


def test_refusal__as_shown__same_words(environment, tmp_path):
    emulate, run, *_ = quick_start()
    shown = re.search(r"\$ hil (send trajectory .*)\n(hil: .*)\n", README.read_text())
    with ExitStack() as stack:
        for command in (emulate, run):
            stack.enter_context(server(command, environment, tmp_path))
        hil = [sys.executable, "-m", "hil"]
        tail = ["--arm", "readme"]
        subprocess.run([*hil, "send", "enable", *tail], env=environment, check=True, timeout=60)
        sent = subprocess.run(
            [*hil, *shlex.split(shown[1]), *tail],
            env=environment,
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
    assert (sent.returncode, sent.stderr.strip()) == (1, shown[2])
