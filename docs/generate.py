"""Writes docs/reference/ from the program: configuration, command line, keys and messages.

Run it as `.venv/bin/python docs/generate.py` when a setting, an option or a message has changed;
`tests/hil/test_docs.py` says when that is due.
"""

# ruff: noqa: SLF001, ANN401 - argparse tells of itself in private, annotations are of any type

import argparse
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Final, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from drivers.registry import SETTINGS
from hil.cli import make_parser
from hil.config import Config
from hil.messages import schemas

ROOT: Final = Path(__file__).parents[1]
OUT: Final = ROOT / "docs" / "reference"
NOTE: Final = "<!-- Written by docs/generate.py: change the program, not this page. -->"
UNITS: Final = {
    "rad": "rad", "rad_s": "rad/s", "rad_s2": "rad/s^2", "rad_s3": "rad/s^3", "Nm": "Nm",
    "Nm_s": "Nm/s", "Nm_A": "Nm/A", "Nm_rad": "Nm/rad", "Nms_rad": "Nms/rad", "s": "s",
    "ms": "ms", "ns": "ns", "Hz": "Hz", "m": "m", "kg": "kg", "kg_m2": "kg m^2", "m_s2": "m/s^2",
    "s_rad": "s/rad", "V": "V", "A": "A", "H": "H", "ohm": "ohm", "MB": "10^6 bytes",
    "counts": "counts", "bits": "bit", "rad2_s2": "rad^2/s^2", "W": "W",
}  # fmt: skip
SIGNS: Final = {"gt": "above", "ge": "at least", "lt": "below", "le": "at most"}
SCHEMA_SIGNS: Final = {
    "exclusiveMinimum": "above",
    "minimum": "at least",
    "exclusiveMaximum": "below",
    "maximum": "at most",
    "maxLength": "characters at most",
}
STREAMS: Final = {
    "telemetry": "`hil.v1.SampleBatch`, Protobuf: every cycle's sample, none left out",
    "status": "JSON object, ten times a second, and the last one of a run",
    "event": "JSON object: `t_ns`, `cycle`, `kind` and what belongs to the kind, see Events",
}
QUERYABLES: Final = {
    "schema": "JSON Schema of every command's request, by command, and of `reply`; `version` of "
    "these; `proto`, the text of `telemetry.proto`",
    "config": "the running configuration as JSON, of the form of the TOML file",
    "status": "the last status, for those who come late",
}
EVENTS: Final = {
    "start": "the loop runs: `amplifiers`, `is_lockstep`, `scheduler`, `kernel`, `machine`",
    "warning": "a setting that works against the user: `detail`",
    "state": "of the arm: `from`, `to`",
    "fault": "a fault was seen: `code`, `reaction`, and what is known of it",
    "input": "what came from outside of the bus, before it is carried out: `command`",
    "command": "what became of a command: `id`, `verb`, `ok`, `reason`",
    "recording": "`action`: `continued` in `file`, `removed` `file`, `stopped` for `reason`",
    "timing": "at the end of the loop: misses, page faults and context switches, of the whole run",
    "bus_load": "simulation with the wire model: load, waiting times",
}


def cell(text: str) -> str:
    """Return a text as it may stand in a table."""
    return " ".join(text.split()).replace("|", "\\|")


def table(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> Iterator[str]:
    """Yield the lines of a table."""
    yield "| " + " | ".join(titles) + " |"
    yield "|" + "---|" * len(titles)
    for row in rows:
        yield "| " + " | ".join(map(cell, row)) + " |"
    yield ""


def unit(name: str) -> str:
    """Return the unit that the suffix of a name says; empty if it says none."""
    parts = name.split("_")
    endings = ("_".join(parts[k:]) for k in range(1, len(parts)))
    return next((UNITS[ending] for ending in endings if ending in UNITS), "")


# --- configuration ------------------------------------------------------------------------------


def models_of(annotation: Any) -> list[type[BaseModel]]:
    """Return the settings classes that a field holds, in a list or in a choice."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    if get_origin(annotation) in (Union, UnionType, tuple, Annotated):
        return [model for part in get_args(annotation) for model in models_of(part)]
    return []


def choices_of(annotation: Any) -> list[str]:
    """Return the values of a literal."""
    if get_origin(annotation) is Literal:
        return [json.dumps(value) for value in get_args(annotation)]
    return [text for part in get_args(annotation) for text in choices_of(part)]


def default_of(field: FieldInfo) -> str:
    """Return the default as TOML."""
    value = field.default
    if value is PydanticUndefined:
        return "preset"
    if value is None:
        return "none"
    if isinstance(value, BaseModel):
        return "its own"
    return f"`{json.dumps(value)}`"


def bounds_of(field: FieldInfo) -> str:
    """Return what values are accepted."""
    choices = choices_of(field.annotation)
    if choices:
        return ", ".join(f"`{choice}`" for choice in choices)
    found = []
    for constraint in field.metadata:
        for name, words in SIGNS.items():
            if getattr(constraint, name, None) is not None:
                found.append(f"{words} {json.dumps(getattr(constraint, name))}")
    return ", ".join(found)


def settings(path: str, model: type[BaseModel], title: str = "") -> Iterator[str]:
    """Yield the section of one table, then those of the tables within it."""
    yield f"## {title or path}"
    yield ""
    yield (model.__doc__ or "").partition("\n\n")[0].replace("\n", " ").strip()
    yield ""
    rows, below = [], []
    for name, field in model.model_fields.items():
        inner = models_of(field.annotation)
        number = ".1" if get_origin(field.annotation) is tuple else ""
        below += [(f"{path}.{name}{number}", kind) for kind in inner]
        meaning = field.description or ""
        if inner:
            meaning += f"{'; ' if meaning else ''}see {path}.{name}{number}"
        rows.append((f"`{name}`", default_of(field), unit(name), bounds_of(field), meaning))
    yield from table(("setting", "default", "unit", "accepted", "what it is"), rows)
    for inner_path, kind in below:
        yield from settings(inner_path, kind)


def configuration() -> Iterator[str]:
    """Yield the page of all settings."""
    yield from head("Configuration", """
One TOML file; what it leaves out comes from the arm preset (`arm.preset`) and from the defaults
below. Command line over environment over file over default: `--set loop.cpu=1` wins over
`HIL_LOOP__CPU=1`. Lists have one entry per joint, shoulder first; one entry of a list of tables is
`axes.2.node_id`. `deploy/bench.toml` is an example with comments. What cannot be is refused in one
line with the setting, the value and the reason; an unknown setting is refused, too.

The `controller` table has [a page of its own](../configuration.md). A default "preset" is the arm
preset's. A list that is empty by default shows its tables as entry 1.
""")  # fmt: skip
    rows = []
    for name, field in Config.model_fields.items():
        if not models_of(field.annotation):
            rows.append((f"`{name}`", default_of(field), field.description or ""))
    yield from table(("setting outside of tables", "default", "what it is"), rows)
    for name, field in Config.model_fields.items():
        kinds = models_of(field.annotation)
        if name == "axes":
            for family, kind in SETTINGS.items():
                yield from settings("axes.1", kind, f"axes, family {family}")
        elif kinds and name != "controller":
            yield from settings(f"{name}{'.1' if name == 'servos' else ''}", kinds[0])


# --- command line -------------------------------------------------------------------------------


def option_row(action: argparse.Action) -> tuple[str, str, str]:
    """Return name, default and meaning of one option or argument."""
    metavar = action.metavar or ("" if action.nargs == 0 else action.dest.upper())
    if isinstance(metavar, tuple):
        metavar = " ".join(metavar)
    if action.option_strings:
        shown = ", ".join(action.option_strings) + (f" {metavar}" if action.nargs != 0 else "")
    else:
        shown = str(action.metavar or action.dest)
    is_plain = action.default in (None, False, [], argparse.SUPPRESS) or not action.option_strings
    default = "" if is_plain else f"`{action.default}`"
    meaning = (action.help or "") % vars(action) if action.help else ""
    if action.choices and not isinstance(action.choices, Mapping):
        meaning += f" ({', '.join(map(str, action.choices))})"
    return f"`{shown}`", default, meaning + (" (required)" if action.required else "")


def verb_sections(name: str, parser: argparse.ArgumentParser, summary: str) -> Iterator[str]:
    """Yield the section of a verb, then those of its commands."""
    yield f"## {name}"
    yield ""
    yield summary[:1].upper() + summary[1:] + "."
    yield ""
    rows, nested = [], []
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            nested.append(action)
        elif not isinstance(action, argparse._HelpAction):
            rows.append(option_row(action))
    if rows:
        yield from table(("option", "default", "what it is"), rows)
    for action in nested:
        summaries = {choice.dest: choice.help or "" for choice in action._choices_actions}
        for command, inner in action.choices.items():
            yield from verb_sections(f"{name} {command}", inner, summaries.get(command, ""))


def command_line() -> Iterator[str]:
    """Yield the page of all verbs and options."""
    yield from head("Command line", """
Exit status: 0 done, 1 refused or failed (one line on stderr), 2 usage, 130 interrupted. `hil VERB
--help` says the same as this page.
""")  # fmt: skip
    parser = make_parser()
    (verbs,) = (a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    summaries = {choice.dest: choice.help or "" for choice in verbs._choices_actions}
    for verb, inner in verbs.choices.items():
        yield from verb_sections(f"hil {verb}", inner, summaries[verb])


# --- Zenoh --------------------------------------------------------------------------------------


def type_of(schema: Mapping[str, Any]) -> str:
    """Return a field's type and bounds in words."""
    if "const" in schema:
        return f"`{json.dumps(schema['const'])}`"
    if "enum" in schema:
        return ", ".join(f"`{json.dumps(value)}`" for value in schema["enum"])
    if "anyOf" in schema:
        return " or ".join(type_of(part) for part in schema["anyOf"])
    if "$ref" in schema:
        return str(schema["$ref"]).rpartition("/")[2]
    kind = str(schema.get("type", "any"))
    if kind == "array":
        return f"list of {type_of(schema.get('items', {}))}"
    bounds = [f"{word} {schema[key]}" for key, word in SCHEMA_SIGNS.items() if key in schema]
    return ", ".join([kind, *bounds])


def message(title: str, schema: Mapping[str, Any]) -> Iterator[str]:
    """Yield one message's heading, description and fields; of a choice, those of each."""
    if "oneOf" in schema or "anyOf" in schema:
        for name in schema["$defs"]:
            part = schema["$defs"][name]
            kind = part.get("properties", {}).get("kind", {}).get("const")
            yield from message(f"{title}, kind {kind}" if kind else name, part)
        return
    yield f"### {title}"
    yield ""
    yield str(schema.get("description", "")).replace("\n", " ")
    yield ""
    required = schema.get("required", [])
    rows = []
    for name, field in schema.get("properties", {}).items():
        default = "required" if name in required else f"`{json.dumps(field.get('default'))}`"
        rows.append((f"`{name}`", type_of(field), default, field.get("description", "")))
    yield from table(("field", "type", "default", "what it is"), rows)


def proto_message(name: str, text: str) -> Iterator[str]:
    """Yield the fields of one Protobuf message with their comments."""
    body = re.search(rf"^message {name} \{{\n(.*?)^\}}", text, re.M | re.S)
    if body is None:
        raise SystemExit(f"telemetry.proto has no message {name}")
    yield f"### hil.v1.{name}"
    yield ""
    found = re.findall(r"^\s+(repeated )?(\w+) (\w+) = (\d+);\s*(?://\s*(.*))?$", body[1], re.M)
    rows = [
        (number, f"`{field}`", f"{repeated}{kind}", comment)
        for repeated, kind, field, number, comment in found
    ]
    yield from table(("number", "field", "type", "what it is"), rows)


def keys_and_messages() -> Iterator[str]:
    """Yield the page of all keys and what travels on them."""
    yield from head("Zenoh keys and messages", """
All keys are below `hil/ARM/`, ARM being `arm.name`. `hil.client` is a client in Python; this page
is for all others, and `hil/ARM/schema` answers it to programs.
""")  # fmt: skip
    yield "## Streams"
    yield ""
    yield from table(("key", "payload"), [(f"`{key}`", text) for key, text in STREAMS.items()])
    yield "## Queries"
    yield ""
    known = schemas()
    commands = [name for name in known if name != "reply"]
    rows = [(f"`{key}`", text) for key, text in QUERYABLES.items()]
    rows += [(f"`cmd/{name}`", "takes the request below, answers a reply") for name in commands]
    rows.append(("`alive`", "liveliness token: there while the daemon's gateway is"))
    rows.append(("`operator/NAME`", "liveliness token of an operator's session, declared by it"))
    yield from table(("key", "what it answers"), rows)
    yield "## Requests and the reply"
    yield ""
    yield (
        "JSON objects; SI units, angles in rad, lists have one entry per joint, shoulder first. A"
        " field that is not known is refused. A refusal has changed nothing. [Remote"
        " operation](../remote.md) says what `lease`, `request_id` and `sent_ns` are for."
    )
    yield ""
    for name, schema in known.items():
        yield from message(name if name == "reply" else f"cmd/{name}", schema)
    yield "## Events"
    yield ""
    yield from table(("kind", "what it tells"), [(f"`{k}`", text) for k, text in EVENTS.items()])
    yield "## Telemetry and recordings"
    yield ""
    yield (
        "The contract is `hil/proto/telemetry.proto`. Every field has a fixed size on the wire;"
        " lists have one entry per joint. A recording is MCAP with the channels `telemetry`"
        " (Sample), `bus` (BusLog) and `event` (Event), the metadata `config`, and played"
        " references as attachments."
    )
    yield ""
    text = (ROOT / "hil" / "proto" / "telemetry.proto").read_text(encoding="utf-8")
    for name in re.findall(r"^message (\w+) \{", text, re.M):
        yield from proto_message(name, text)


def head(title: str, text: str) -> Iterator[str]:
    """Yield what every page begins with."""
    yield from (NOTE, "", f"# {title}", text)


PAGES: Final[Mapping[str, Callable[[], Iterator[str]]]] = {
    "configuration.md": configuration,
    "command-line.md": command_line,
    "zenoh.md": keys_and_messages,
}


def page(name: str) -> str:
    """Return a page of the reference as it should be."""
    return "\n".join(PAGES[name]()).rstrip() + "\n"


if __name__ == "__main__":
    OUT.mkdir(exist_ok=True)
    for name in PAGES:
        (OUT / name).write_text(page(name), encoding="utf-8")
