"""The reference pages are what the program says; the user guide names what there is."""

import importlib.util
import re
import shlex
from pathlib import Path

import pytest

from hil.cli import VERBS, make_parser
from hil.config import Config, load_config, merge, parse_assignment

ROOT = Path(__file__).parents[2]
GUIDE = ROOT / "docs" / "user-guide.md"
README = ROOT / "README.md"


def generator():
    spec = importlib.util.spec_from_file_location("generate", ROOT / "docs" / "generate.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


generate = generator()


@pytest.mark.parametrize("name", generate.PAGES)
def test_reference__page__is_what_the_program_says(name):
    written = (ROOT / "docs" / "reference" / name).read_text(encoding="utf-8")
    assert written == generate.page(name), "run: .venv/bin/python docs/generate.py"


def test_configuration__every_table__has_a_section_with_every_setting():
    text = generate.page("configuration.md")
    config = load_config()
    for table in set(Config.model_fields) - {"controller", "axes", "servos", "scenario"}:
        section = re.search(rf"^## {table}$(.*?)(?=^## |\Z)", text, re.M | re.S)
        assert section is not None, table
        settings = set(type(getattr(config, table)).model_fields)
        assert set(re.findall(r"^\| `(\w+)`", section[1], re.M)) == settings


def test_zenoh__keys_in_the_source__are_all_on_the_page():
    """Whatever the daemon declares below `hil/<arm>/`."""
    found = set()
    for path in (ROOT / "hil").glob("*.py"):
        source = path.read_text(encoding="utf-8")
        found |= set(re.findall(r"\{(?:self\.)?_?prefix\}/(\w+)", source))
        found |= set(re.findall(r"_publisher\(\s*\"(\w+)\"", source))
    assert {"telemetry", "status", "event", "cmd", "schema", "config", "alive"} <= found
    text = generate.page("zenoh.md")
    assert {key for key in found if f"`{key}`" not in text and f"`{key}/" not in text} == set()


def test_zenoh__kinds_of_event_in_the_source__are_all_on_the_page():
    found = {"recording"}
    for path in (ROOT / "hil").glob("*.py"):
        source = path.read_text(encoding="utf-8")
        found |= set(re.findall(r"\b_(?:emit|events)\(\s*\"(\w+)\"", source))
    assert {"start", "input", "command", "state", "fault"} <= found
    assert found == set(generate.EVENTS)


def commands(page):
    """Whole `hil` commands of a page, in code blocks or in backticks; comments and paths aside."""
    text = page.read_text(encoding="utf-8")
    blocks = re.findall(r"^```\w*\n(.*?)^```", text, re.M | re.S)
    lines = [line for block in blocks for line in block.splitlines()]
    lines += re.findall(r"`(hil [^`\n]+)`", re.sub(r"^```.*?^```", "", text, flags=re.M | re.S))
    for line in lines:
        if line.startswith(" "):  # a drawing
            continue
        words = shlex.split(re.sub(r"^\$ ", "", line), comments=True)
        while words and (words[0] == "sudo" or "=" in words[0]):
            words = words[1:]
        if words and words[0].rpartition("/")[2] == "hil" and len(words) > 1:
            yield [word for word in words[1:] if word != "&"]


COMMANDS = [(page.name, " ".join(words)) for page in (GUIDE, README) for words in commands(page)]


def test_guide__names__commands_of_most_verbs():
    verbs = {command.split()[0] for page, command in COMMANDS if page == GUIDE.name}
    assert verbs >= {"sim", "run", "emulate", "send", "watch", "doctor", "conform", "report"}
    assert verbs <= set(VERBS)


@pytest.mark.parametrize(("page", "command"), sorted(set(COMMANDS)))
def test_command__as_written__is_understood_and_its_settings_exist(page, command):
    words = shlex.split(command)
    if len(words) == 1 and words[0] in VERBS:  # only its name
        return
    options = make_parser().parse_args(words)
    over = {}
    for assignment in getattr(options, "assignments", []):
        over = merge(over, parse_assignment(assignment))
    load_config(None, over)


def test_guide__settings_in_backticks__exist():
    config = load_config()
    tables = set(type(config).model_fields) - {"scenario"}
    text = GUIDE.read_text(encoding="utf-8")
    named = re.findall(rf"`((?:{'|'.join(tables)})\.[\w.]+)", text)
    named = [name for name in named if not name.endswith((".toml", ".mcap"))]
    assert len(named) > 10
    for name in named:
        node = config
        for part in name.split("."):
            node = node[int(part) - 1] if part.isdigit() else getattr(node, part)


def test_guide__hardware__ten_steps_in_order():
    section = re.search(r"^## Hardware.*?$(.*?)(?=^## )", GUIDE.read_text(), re.M | re.S)
    assert re.findall(r"^(\d+)\. ", section[1], re.M) == [str(n) for n in range(1, 11)]


@pytest.mark.parametrize("page", [GUIDE, README])
def test_page__safety__is_stated(page):
    text = " ".join(page.read_text(encoding="utf-8").split())
    assert "not a safety-rated system" in text
    assert "emergency stop" in text


def test_readme__index__names_every_page_of_the_documents():
    text = README.read_text(encoding="utf-8")
    pages = [
        page.relative_to(ROOT).as_posix()
        for page in (ROOT / "docs").rglob("*.md")
        if page.parent.name not in ("compare", "decisions", "amplifiers") or page.stem == "README"
    ]
    assert [page for page in pages if page not in text] == []
