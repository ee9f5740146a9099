"""The page beside a comparison's tables: its origin, what its words mean, and an overview."""

import os
import platform
from collections.abc import Iterator, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

from hil.compare import (
    ALL_LAWS,
    CLIPPED,
    DURATION_S,
    PERTURBATIONS,
    SCENARIOS,
    STAT_START_S,
    VARIANTS,
    Row,
)

CSV_NAME: Final = "compare.csv"
TABLES_NAME: Final = "compare.md"
PAGE_NAME: Final = "README.md"

PERTURBATION_NOTES: Final[Mapping[str, str]] = {
    "nominal": "nothing",
    "friction x3": "viscous and Coulomb friction three times as large",
    "payload +50 %": "a point mass of half the last link's mass at its tip",
    "load step": "0.3 Nm on joint 1 and 0.15 Nm on joint 2 from 14 s on",
    "Stribeck": "static torque 1.5 times Coulomb's, falling within 0.1 rad/s",
    "backlash": "a gap of 2 mrad behind a rotor of 0.01 kg m2, encoder on the link",
    "encoder 10 bit": "1024 counts a turn",
    "encoder 14 bit": "16384 counts a turn",
    "encoder 16 bit": "65536 counts a turn",
    "delay +1 ms": "the amplifier applies a torque 1 ms later",
}
"""What a perturbation changes; `hil.compare.PERTURBATIONS` does it."""

_COLUMNS_NOTE: Final = f"""\
All figures are of joint 1 / joint 2. rms and peak error: of the arm's true angle, in counts of a
12-bit encoder (1.534 mrad) whatever encoder is fitted, over {STAT_START_S:g} to {DURATION_S:g} s.
settled: the last time the error exceeds 20 mrad. rate: ln 10 over the time until |S| is below a
tenth of where it started, S from the true motion. peak torque and effort: largest and rms torque
sent, up to the end of the trajectory; the stop after it does not count. variation: sum of |change
of torque| per second, over the same time as the errors. Kd: smallest and largest gain in use.
"""


def cover_page(rows: Sequence[Row], command: str, pictures: Sequence[str]) -> str:
    """Return the page as Markdown.

    Args:
        rows: Rows of the comparison.
        command: What was typed.
        pictures: File names of the plots beside the page.
    """
    lines = ["# Laws side by side", "", *_origin(rows, command), ""]
    lines += [
        "Simulated in virtual time through CiA 402 frames; no hardware was involved. The figures"
    ]
    lines += [
        "do not depend on the machine's speed. The command above makes this folder again.",
        "",
    ]
    lines += [f"[{TABLES_NAME}]({TABLES_NAME}) has every figure, [{CSV_NAME}]({CSV_NAME}) the same"]
    lines += ["as numbers.", "", "## Words", "", _COLUMNS_NOTE, *_notes(rows)]
    lines += ["## rms error [counts]", ""]
    for scenario in dict.fromkeys(row.case.scenario for row in rows):
        lines += [*_overview(scenario, [r for r in rows if r.case.scenario == scenario]), ""]
    lines += [f"![error over torque variation]({name})\n" for name in pictures]
    return "\n".join(lines).rstrip() + "\n"


def _origin(rows: Sequence[Row], command: str) -> Iterator[str]:
    tripped = sum(bool(row.failed) for row in rows)
    yield "| | |"
    yield "|---|---|"
    yield f"| command | `{command}` |"
    yield f"| program | hil {version('hil')} |"
    host = f"{cpu_model()}, {os.cpu_count()} cores"
    yield f"| machine | {host}, {platform.system()} {platform.release()} |"
    software = " ".join(f"{name} {version(name)}," for name in ("pymunk", "numpy"))
    yield f"| software | Python {platform.python_version()}, {software.rstrip(',')} |"
    spent_s = sum(row.cpu_s for row in rows)
    yield f"| runs | {len(rows)}, {tripped} of them tripped; {spent_s:.0f} s of processor time |"


def cpu_model() -> str:
    """Return the processor's name as the kernel tells it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, "") or platform.machine()


def _notes(rows: Sequence[Row]) -> Iterator[str]:
    yield "| scenario | arm, trajectory |"
    yield "|---|---|"
    for name in dict.fromkeys(row.case.scenario for row in rows):
        preset, rate = SCENARIOS[name]
        trajectory = f"exponential sine at rate {rate:g}, start error (0.4, -0.5) rad"
        yield f"| {name} | `{preset}`, {trajectory} |"
    yield ""
    yield "| law | settings of `controller` |"
    yield "|---|---|"
    for name in dict.fromkeys(row.case.law for row in rows):
        clip = ", `tau_clip_Nm` the peak torque of the self-tuned law" if name == CLIPPED else ""
        base = "self-tuning pid with " if name in VARIANTS else ""
        yield f"| {name} | {base}{_settings(ALL_LAWS[name])}{clip} |"
    yield ""
    yield "| changed | what; the controller is not told |"
    yield "|---|---|"
    for name in dict.fromkeys(row.case.perturbation for row in rows):
        yield f"| {name} | {PERTURBATION_NOTES[name]} |"
    yield ""


def _settings(table: Mapping[str, Any]) -> str:
    pairs = ((f"{group}.{key}", value) for group in table for key, value in table[group].items())
    return ", ".join(f"`{key} = {value}`" for key, value in pairs)


def _overview(scenario: str, rows: Sequence[Row]) -> Iterator[str]:
    found = {(row.case.law, row.case.perturbation): row for row in rows}
    columns = [name for name in PERTURBATIONS if any(row.case.perturbation == name for row in rows)]
    yield f"### {scenario}"
    yield ""
    yield f"| law | {' | '.join(columns)} |"
    yield "|---" * (len(columns) + 1) + "|"
    for law in dict.fromkeys(row.case.law for row in rows):
        cells = [_rms(found.get((law, column))) for column in columns]
        yield f"| {law} | {' | '.join(cells)} |"


def _rms(row: Row | None) -> str:
    if row is None:
        return ""
    return "tripped" if row.failed else " / ".join(f"{rms:.2f}" for rms in row.rms_counts)
