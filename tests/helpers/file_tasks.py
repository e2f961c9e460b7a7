"""A task on files for tests of how files travel; quick to import."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path


@dataclass(frozen=True, kw_only=True)
class Join:
    """Joins two files into a third, removes a fourth, and dies so many times before.

    Attributes:
        out: Directory.
        number: Of the task.
        deaths: How often its process dies.
    """

    out: Path
    number: int
    deaths: int = 0

    def reads(self) -> dict[str, Path]:
        """Return the files that it reads."""
        own = f"in/{self.number}"
        return {"in/common": self.out / "in/common", own: self.out / own}

    def writes(self) -> tuple[str, ...]:
        """Return what it writes and removes."""
        return f"out/{self.number}", "old"

    def moved(self, folder: Path) -> Join:
        """Return it in a directory with copies."""
        return replace(self, out=folder)


def join(task: Join) -> int:
    """Do a task; return its number.

    Raises:
        ValueError: If its number is negative.
    """
    if task.number < 0:
        raise ValueError(f"{task.number} < 0")
    died = task.out / f"died-{task.number}"
    before = len(died.read_text()) if died.exists() else 0
    if before < task.deaths:
        died.write_text("x" * (before + 1))
        os._exit(1)
    (task.out / "out").mkdir(exist_ok=True)
    both = (path.read_bytes() for path in task.reads().values())
    (task.out / f"out/{task.number}").write_bytes(b" ".join(both))
    return task.number
