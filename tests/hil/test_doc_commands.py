"""Commands that the reference pages name: the parser takes them and the settings exist."""

import re
import shlex
from pathlib import Path

import pytest

from hil.cli import make_parser
from hil.cli.options import configuration
from hil.compare import ALL_LAWS, PERTURBATIONS, SCENARIOS

ROOT = Path(__file__).parents[2]
PAGES = ("docs/paper.md", "docs/tuner.md", "docs/configuration.md", "docs/compare/README.md")


def commands(page):
    """Every whole command of a page, in backticks or on a line of its own; not a verb's name."""
    text = (ROOT / page).read_text(encoding="utf-8")
    found = re.findall(r"`(hil [^`]+)`", text) + re.findall(r"^(hil .*)$", text, re.M)
    whole = (command for command in found if " --" in command or command.endswith(".mcap"))
    return [(page, command) for command in dict.fromkeys(whole)]


COMMANDS = [command for page in PAGES for command in commands(page)]


def test_pages__together__name_commands():
    assert len(COMMANDS) > 15


@pytest.mark.parametrize(("page", "command"), COMMANDS)
def test_command__as_named__parsed_and_its_settings_accepted(page, command):
    options = make_parser().parse_args(shlex.split(command)[1:])
    if options.verb == "sim":
        configuration(options)
    if options.verb == "compare":
        assert set(options.law or ()) <= set(ALL_LAWS)
        assert set(options.scenario or ()) <= set(SCENARIOS)
        assert set(options.perturbation or ()) <= set(PERTURBATIONS)
