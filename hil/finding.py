"""What a check of `hil doctor` says."""

from dataclasses import dataclass
from typing import Literal

Level = Literal["pass", "warn", "fail"]


@dataclass(frozen=True, slots=True)
class Finding:
    """One check: what was found and, unless it passed, what to do about it."""

    name: str
    level: Level
    found: str
    remedy: str = ""
