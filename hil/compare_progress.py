"""Rows of a comparison that is under way, on disk: interrupted, the same command goes on."""

import json
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

from hil.batch import fingerprint
from hil.compare import Case, Row

FILE_NAME: Final = "unfinished.jsonl"


class Progress:
    """Keeps every row as it comes, one line each, until all are there.

    A context manager: closed by an error, it leaves the file for the next start; else it takes the
    file away.

    Attributes:
        rows: Rows of an interrupted comparison by this same program, by their case.
    """

    def __init__(self, directory: Path) -> None:
        self._path = directory / FILE_NAME
        self._mark = json.dumps({"program": fingerprint()})
        self.rows = self._load()
        self._file = self._path.open("w", encoding="utf-8")
        self._write(self._mark)
        for row in self.rows.values():
            self.add(row)

    def add(self, row: Row) -> None:
        """Keep a row."""
        self._write(json.dumps(asdict(row)))

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close the file, and remove it if nothing went wrong."""
        self._file.close()
        if kind is None:
            self._path.unlink()

    def _write(self, line: str) -> None:
        self._file.write(f"{line}\n")
        self._file.flush()

    def _load(self) -> dict[Case, Row]:
        if not self._path.exists():
            return {}
        mark, *lines = self._path.read_text(encoding="utf-8", errors="replace").split("\n")
        if mark != self._mark:
            return {}
        rows = [_parse(line) for line in lines]
        return {row.case: row for row in rows if row is not None}


def _parse(line: str) -> Row | None:
    """Return the row of a line, None for one that was cut short."""
    try:
        fields: dict[str, Any] = json.loads(line)
        case = {key: _frozen(value) for key, value in fields.pop("case").items()}
        return Row(Case(**case), **{key: _frozen(value) for key, value in fields.items()})
    except (ValueError, TypeError, KeyError):
        return None


def _frozen(value: Any) -> Any:  # noqa: ANN401 - JSON is what it is
    return tuple(value) if isinstance(value, list) else value
