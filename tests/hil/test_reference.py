"""docs/configuration.md against the settings themselves, and every link in the documents."""

import re
import tomllib
from pathlib import Path
from typing import get_args

import pytest
from pydantic_core import PydanticUndefined

from controller.settings import (
    ControllerSettings,
    LawSettings,
    LimitSettings,
    LinkModel,
    ModelSettings,
    MonitorSettings,
    SlotineLiSettings,
    VelocitySettings,
)
from hil.config import load_config, merge, parse_assignment

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "configuration.md").read_text()
TABLES = {
    "controller.law": LawSettings,
    "controller.velocity": VelocitySettings,
    "controller.limits": LimitSettings,
    "controller.model": ModelSettings,
    "controller.model.links": LinkModel,
    "controller.slotine_li": SlotineLiSettings,
    "controller.monitor": MonitorSettings,
}
FIELDS = [(table, name) for table, model in TABLES.items() for name in model.model_fields]
UNITS = {"rad": "rad", "rad_s": "rad/s", "rad_s2": "rad/s^2", "rad_s3": "rad/s^3", "Nm": "Nm",
         "Nm_s": "Nm/s", "s": "s", "Hz": "Hz", "m": "m", "kg": "kg", "kg_m2": "kg m^2",
         "Nms_rad": "Nms/rad", "m_s2": "m/s^2", "s_rad": "s/rad"}  # fmt: skip
"""Unit by the suffix of a name."""


def documented(table):
    """(default, unit, meaning) by setting, of one section's table."""
    section = re.search(rf"^## {re.escape(table)}\n(.*?)(?=^## |\Z)", PAGE, re.M | re.S)
    assert section is not None, f"docs/configuration.md has no section {table}"
    cells = (
        re.split(r"(?<!\\)\|", line)[1:-1]
        for line in section[1].splitlines()
        if line.startswith("| `")
    )
    return {name.strip(" `"): tuple(c.strip() for c in rest) for name, *rest in cells}


def value_of(text):
    """What a cell says in backticks, read as TOML."""
    quoted = re.search(r"`([^`]+)`", text)
    return tomllib.loads(f"v = {quoted[1]}")["v"] if quoted else None


def plain(value):
    return list(value) if isinstance(value, tuple) else value


def of_preset(table, name):
    """The value that the default arm preset has for a setting."""
    node = load_config().controller
    for part in table.split(".")[1:]:
        node = getattr(node, part)
    return plain(getattr(node[0] if isinstance(node, tuple) else node, name))


def test_tables__every_part_of_the_controller__is_documented():
    parts = {f"controller.{name}" for name in ControllerSettings.model_fields}
    assert parts | {"controller.model.links"} == set(TABLES)


@pytest.mark.parametrize("table", TABLES)
def test_table__settings__all_there_are_and_no_others_in_order(table):
    assert list(documented(table)) == list(TABLES[table].model_fields)


@pytest.mark.parametrize(("table", "name"), FIELDS)
def test_setting__default__is_the_one_documented(table, name):
    default, *_ = documented(table)[name]
    given = TABLES[table].model_fields[name].default
    if given is PydanticUndefined:
        assert default.startswith("preset")
        if value_of(default) is not None:
            assert value_of(default) == of_preset(table, name)
    elif given is None:
        assert default == "none"
    else:
        assert value_of(default) == plain(given)
        assert type(value_of(default)) is type(plain(given))


@pytest.mark.parametrize(("table", "name"), FIELDS)
def test_setting__unit__is_that_of_its_suffix(table, name):
    _, unit, _ = documented(table)[name]
    tail = name.split("_")
    endings = ["_".join(tail[k:]) for k in range(1, len(tail))]
    suffix = next((ending for ending in endings if ending in UNITS), None)
    if name == "Kd_ramp_per_s":
        assert unit == "Nms/rad per s"
    elif suffix is not None:
        assert unit == UNITS[suffix]


@pytest.mark.parametrize(("table", "name"), FIELDS)
def test_setting__choices__each_is_explained(table, name):
    *_, meaning = documented(table)[name]
    for choice in get_args(TABLES[table].model_fields[name].annotation):
        if isinstance(choice, str):
            assert f"`{choice}`" in meaning


def test_example__as_written__is_accepted():
    (line,) = re.findall(r"^hil sim .*$", PAGE, re.M)
    over = {}
    for assignment in re.findall(r"--set (\S+)", line):
        over = merge(over, parse_assignment(assignment))
    law = load_config(None, over).controller.law
    assert (law.name, law.tau_clip_Nm) == ("pid", (2.0, 3.75))
