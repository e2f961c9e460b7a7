"""Violations, a line each with file, row and figure, and their collection."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

#: Rows listed per broken invariant and group; further rows are only counted.
MAX_LISTED = 20


@dataclass(frozen=True, kw_only=True)
class Violation:
    """One broken invariant.

    Attributes:
        file: Path within the dataset's directory.
        group: Group or split within the file, e.g. `/train`; empty for the whole file.
        row: Row of the group; None for all of it.
        what: The invariant in words, with its unit.
        got: The value that breaks it.
    """

    file: str
    group: str = ""
    row: int | None = None
    what: str
    got: str

    def __str__(self) -> str:
        place = " ".join(p for p in (self.file, self.group) if p)
        row = "" if self.row is None else f" row {self.row}"
        return f"{place}{row}: {self.what}, got {self.got}"


def of_file(file: str, what: str, got: object, group: str = "") -> Violation:
    """Return a violation of a file, or of a group of it, as a whole."""
    return Violation(file=file, group=group, what=what, got=str(got))


@dataclass
class Findings:
    """The violations of a check, up to MAX_LISTED per invariant and group of a file."""

    _listed: dict[tuple[str, str, str], list[Violation]] = field(default_factory=dict)
    _more: dict[tuple[str, str, str], int] = field(default_factory=dict)

    def __bool__(self) -> bool:
        return bool(self._listed)

    def add(self, violations: Iterable[Violation]) -> set[int]:
        """Collect violations; return the rows that they are in."""
        rows = set()
        for violation in violations:
            key = (violation.file, violation.group, violation.what)
            listed = self._listed.setdefault(key, [])
            if len(listed) < MAX_LISTED:
                listed.append(violation)
            else:
                self._more[key] = self._more.get(key, 0) + 1
            if violation.row is not None:
                rows.add(violation.row)
        return rows

    def merge(self, other: Findings) -> None:
        """Take over what a task found."""
        for key, listed in other._listed.items():
            self.add(listed)
            if key in other._more:
                self._more[key] = self._more.get(key, 0) + other._more[key]

    def violations(self) -> list[Violation]:
        """Return the listed violations, with a line for those that were only counted."""
        result = []
        for key, listed in self._listed.items():
            result += listed
            if key in self._more:
                file, group, what = key
                got = f"{self._more[key]} more rows that break it"
                result.append(Violation(file=file, group=group, what=what, got=got))
        return result
