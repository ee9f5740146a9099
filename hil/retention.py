"""How much of the disk an arm's recordings may take, and which of them go first."""

import os
import re
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final

from hil.config import Config
from hil.recording import Part, is_part

MB: Final = 1e6
_STAMP: Final = r"-\d{8}-\d{6}(-\d+)?"


class Retention:
    """Keeps one arm's recordings within their budget.

    An arm's recordings are the files that the daemon has named itself (`NAME-DATE-TIME.mcap` and
    their parts), and the earlier parts of the running one, whatever its name. Nothing else is
    counted or removed.

    Args:
        config: Budget, free space and the arm's name.
        first: Part 1 of the running recording.
    """

    def __init__(self, config: Config, first: Path) -> None:
        budget_MB = config.recording.disk_budget_MB
        self._budget_bytes = None if budget_MB is None else budget_MB * MB
        self._min_free_MB = config.recording.min_free_MB
        self._first = first
        self._verified: dict[int, bool] = {}
        self._own_name = re.compile(rf"{re.escape(config.arm.name)}{_STAMP}\.mcap").fullmatch

    def lack_of_space(self) -> str:
        """Say why nothing may be recorded any more; empty while there is room."""
        folder = self._first.parent
        try:
            space = os.statvfs(folder)
        except OSError:  # creating a file there will say what is wrong
            return ""
        if not space.f_blocks:  # no disk at all: creating a file there will tell
            return ""
        free_MB = space.f_bavail * space.f_frsize / MB
        if free_MB >= self._min_free_MB:
            return ""
        return (
            f"{folder} has {free_MB:.0f} MB free, recording.min_free_MB is {self._min_free_MB:g}: "
            "free some space, then start the daemon again"
        )

    def remove_oldest(self, running: Part) -> list[Path]:
        """Remove recordings, oldest first, until they are within the budget.

        Args:
            running: The part being written; it is never removed.

        Returns:
            What was removed. A file that cannot be removed stays, and counts.
        """
        if self._budget_bytes is None:
            return []
        current = running.path(self._first)
        sizes = self._sizes(running)
        total = sum(size for _, size in sizes.values())
        removed = []
        for path in sorted(sizes, key=lambda path: (sizes[path][0], path.name)):
            if total <= self._budget_bytes:
                break
            if path != current:
                with suppress(OSError):
                    path.unlink()
                    removed.append(path)
                    total -= sizes[path][1]
        return removed

    def _sizes(self, running: Part) -> dict[Path, tuple[int, int]]:
        """Return (time of the last write, bytes) of everything that counts."""
        sizes = {}
        for path in {*self._recordings(), *self._own_parts(running)}:
            with suppress(OSError):
                stat = path.stat()
                sizes[path] = stat.st_mtime_ns, stat.st_size
        return sizes

    def _recordings(self) -> Iterator[Path]:
        with suppress(OSError):
            for entry in self._first.parent.iterdir():
                if self._own_name(entry.name):
                    yield entry

    def _own_parts(self, running: Part) -> Iterator[Path]:
        for number in range(1, running.number + 1):
            part = Part(running.series, number)
            if number not in self._verified:  # it could be an older run's of the same name
                self._verified[number] = is_part(part.path(self._first), part)
            if self._verified[number]:
                yield part.path(self._first)
