"""A comparison as text: CSV with every figure, and Markdown tables."""

import csv
import io
from collections.abc import Iterator, Sequence
from typing import Final

from hil.batch import FIGURES, figure_columns
from hil.compare import Row


def to_csv(rows: Sequence[Row]) -> str:
    """Return every figure of every run, one line per run."""
    joints = max((len(row.rms_counts) for row in rows), default=0)
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(["law", "scenario", "perturbation", "failed", *figure_columns(joints)])
    for row in rows:
        values = [v for name in FIGURES for v in _padded(getattr(row, name), joints)]
        case = row.case
        writer.writerow([case.law, case.scenario, case.perturbation, row.failed, *values])
    return stream.getvalue()


def _padded(values: tuple[float, ...], joints: int) -> list[float | str]:
    return [*values, *[""] * (joints - len(values))]


COLUMNS: Final = (
    ("rms [counts]", "rms_counts", "{:.2f}"),
    ("peak [counts]", "peak_counts", "{:.2f}"),
    ("settled [s]", "ts20_s", "{:.2f}"),
    ("rate [1/s]", "rate10_1_s", "{:.0f}"),
    ("peak torque [Nm]", "peak_tau_Nm", "{:.2f}"),
    ("effort [Nm rms]", "effort_Nm", "{:.3f}"),
    ("variation [Nm/s]", "tv_Nm_s", "{:.0f}"),
    ("Kd", "", ""),
)


def to_markdown(rows: Sequence[Row]) -> str:
    """Return one table per scenario and perturbation, joint 1 / joint 2."""
    lines: list[str] = []
    groups = dict.fromkeys((row.case.scenario, row.case.perturbation) for row in rows)
    for scenario, perturbation in groups:
        lines += [f"### {scenario}, {perturbation}", ""]
        lines += ["| law | " + " | ".join(title for title, *_ in COLUMNS) + " |"]
        lines += ["|---" * (len(COLUMNS) + 1) + "|"]
        for row in rows:
            if (row.case.scenario, row.case.perturbation) == (scenario, perturbation):
                lines.append(f"| {row.case.law} | " + " | ".join(_cells(row)) + " |")
        lines.append("")
    return "\n".join(lines)


def _cells(row: Row) -> Iterator[str]:
    if row.failed:
        yield f"tripped: {row.failed}"
        yield from [""] * (len(COLUMNS) - 1)
        return
    for _, name, layout in COLUMNS:
        if name:
            yield " / ".join(layout.format(value) for value in getattr(row, name))
        else:
            pairs = zip(row.Kd_min, row.Kd_max, strict=True)
            yield " / ".join(f"{low:.2f}..{high:.2f}" for low, high in pairs)
