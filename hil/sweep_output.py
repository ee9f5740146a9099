"""What a sweep leaves on disk: a journal of outcomes, and a table of them as CSV and Parquet.

A line goes into the journal as a run ends, and the table is replaced as a whole, so that both are
valid whenever the program is killed.
"""

import csv
import fcntl
import io
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

from hil.batch import FIGURES, Figures, figure_columns
from hil.sweep import Axis, Identity, Outcome, Point, Run, SweepError

JOURNAL_NAME: Final = "runs.jsonl"
CSV_NAME: Final = "sweep.csv"
PARQUET_NAME: Final = "sweep.parquet"
_NO_PYARROW: Final = "Parquet needs pyarrow: pip install 'hil[sweep]', or leave out --parquet"


class Journal:
    """Outcomes so far, one line each; a context manager that one sweep at a time may have.

    Attributes:
        path: The file.
    """

    def __init__(self, directory: Path) -> None:
        self.path = directory / JOURNAL_NAME
        self._identity = Identity()
        self._file = self.path.open("a+b")
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            self._file.close()
            raise SweepError(
                f"{directory} is in use by another sweep; give another --out"
            ) from error
        self._lines = dict(self._load())

    def known(self, runs: Sequence[Run]) -> dict[Run, Outcome]:
        """Return the outcomes that are there already."""
        found = {}
        for run in dict.fromkeys(runs):
            line = self._lines.get(self._identity.of(run))
            outcome = None if line is None else _outcome(run, line)
            if outcome is not None:
                found[run] = outcome
        return found

    def add(self, outcome: Outcome) -> None:
        """Keep an outcome."""
        figures = None if outcome.figures is None else asdict(outcome.figures)
        line = {"id": self._identity.of(outcome.run), "failed": outcome.failed, "figures": figures}
        self._file.write(json.dumps(line).encode() + b"\n")
        self._file.flush()

    def _load(self) -> Iterator[tuple[str, dict[str, Any]]]:
        self._file.seek(0)
        content = self._file.read()
        whole = content.rfind(b"\n") + 1
        self._file.truncate(whole)  # killed while writing the rest
        for text in content[:whole].splitlines():
            try:
                line = json.loads(text)
                yield str(line["id"]), line
            except (ValueError, TypeError, KeyError):
                continue

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close the file."""
        self._file.close()


def _outcome(run: Run, line: Mapping[str, Any]) -> Outcome | None:
    """Return the outcome of a line, None if the line is damaged."""
    try:
        given = line["figures"]
        if given is None:
            return Outcome(run, str(line["failed"]) or "unknown", None)
        values = {name: tuple(float(v) for v in given[name]) for name in FIGURES}
        return Outcome(run, "", Figures(**values))
    except (KeyError, TypeError, ValueError):
        return None


class Table:
    """The outcomes of a grid, in its order; runs that are missing are left out.

    Args:
        axes: A column each, by their keys.
        points: The grid.
    """

    def __init__(self, axes: Sequence[Axis], points: Sequence[Point]) -> None:
        self._axes = axes
        self._points = points

    def columns(self, outcomes: Mapping[Run, Outcome]) -> dict[str, list[Any]]:
        """Return name -> values: run, the axes, failed, figures (None where there is none)."""
        done = [(point, outcomes[point.run]) for point in self._points if point.run in outcomes]
        columns: dict[str, list[Any]] = {"run": [point.number for point, _ in done]}
        for place, axis in enumerate(self._axes):
            columns[axis.key] = [point.values[place] for point, _ in done]
        columns["failed"] = [outcome.failed for _, outcome in done]
        joints = max((_joints(outcome) for _, outcome in done), default=0)
        rows = [_figures(outcome, joints) for _, outcome in done]
        for place, name in enumerate(figure_columns(joints)):
            columns[name] = [row[place] for row in rows]
        return columns

    def write_csv(self, path: Path, outcomes: Mapping[Run, Outcome]) -> None:
        """Write the table as CSV; lists and tables among the values as JSON."""
        columns = self.columns(outcomes)
        stream = io.StringIO()
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(map(_cell, row) for row in zip(*columns.values(), strict=True))
        _replace(path, stream.getvalue().encode())

    def write_parquet(self, path: Path, outcomes: Mapping[Run, Outcome]) -> None:
        """Write the table as Parquet; values of mixed types as JSON.

        Raises:
            SweepError: If pyarrow is not installed.
        """
        require_parquet()
        import pyarrow as pa
        from pyarrow import parquet

        keys = {axis.key for axis in self._axes}
        arrays = {}
        for name, values in self.columns(outcomes).items():
            if name in keys:
                arrays[name] = _typed(values)
            else:
                kinds = {"run": pa.int64(), "failed": pa.string()}
                arrays[name] = pa.array(values, kinds.get(name, pa.float64()))
        sink = pa.BufferOutputStream()
        parquet.write_table(pa.table(arrays), sink)
        _replace(path, sink.getvalue().to_pybytes())


def require_parquet() -> None:
    """Check that Parquet can be written.

    Raises:
        SweepError: If pyarrow is not installed.
    """
    try:
        import pyarrow  # noqa: F401 - only whether it is there
    except ImportError as error:
        raise SweepError(_NO_PYARROW) from error


def _typed(values: list[Any]) -> Any:  # noqa: ANN401 - a pyarrow array
    import pyarrow as pa

    try:
        return pa.array(values)
    except (pa.ArrowInvalid, pa.ArrowTypeError, pa.ArrowNotImplementedError, OverflowError):
        return pa.array([json.dumps(value, default=str) for value in values])


def _joints(outcome: Outcome) -> int:
    return 0 if outcome.figures is None else len(outcome.figures.rms_counts)


def _figures(outcome: Outcome, joints: int) -> list[float | None]:
    row: list[float | None] = []
    for name in FIGURES:
        values = () if outcome.figures is None else getattr(outcome.figures, name)
        row += [*values, *[None] * (joints - len(values))]
    return row


def _cell(value: object) -> object:
    is_text = isinstance(value, bool | list | dict)
    return json.dumps(value, default=str) if is_text else value


def _replace(path: Path, content: bytes) -> None:
    """Put a file in the place of another in one step."""
    fresh = path.with_name(f".{path.name}.new")
    fresh.write_bytes(content)
    os.replace(fresh, path)  # noqa: PTH105 - atomic, and over what is there
