"""What a build is asked for: names of objects, and the part of its work units of a job."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from drakegrasp.errors import ConfigError, MeshError, listed

#: Name that requests the built-in objects instead of a directory of meshes.
BUILTIN = "builtin"


@dataclass(frozen=True)
class Part:
    """A part of the work units of a build, for jobs that do not communicate.

    Attributes:
        number: Number of the part, from 1.
        of: Number of parts.
    """

    number: int
    of: int

    def has(self, unit: int) -> bool:
        """Return whether a work unit, counted from 0, belongs to the part."""
        return unit % self.of == self.number - 1


def read_part(text: str) -> Part:
    """Return the part that a text such as 3/16 names.

    Raises:
        ConfigError: If the text does not name a part.
    """
    match = re.fullmatch(r"([0-9]{1,9})/([0-9]{1,9})", text.strip())
    part = Part(*map(int, match.groups())) if match else Part(0, 0)
    if not 1 <= part.number <= part.of:
        raise ConfigError(f"part must be I/N, with I from 1 to N, got {text[:40]!r}")
    return part


def refuse_unknown(only: Sequence[str], names: Sequence[str]) -> None:
    """Check that each name is the name of an object.

    Raises:
        MeshError: If no object has one of the names.
    """
    unknown = [name for name in only if name not in names]
    if unknown:
        known = listed(names)
        raise MeshError(f"only must be names of objects ({known}), got {unknown[0]!r}")
