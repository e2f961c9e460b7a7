"""The request for a build, and the part of its work units that a job builds."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from drakegrasp.errors import ConfigError, MeshError, listed

if TYPE_CHECKING:
    from drakegrasp.config import Config


#: Name that requests the built-in objects instead of a directory of meshes.
BUILTIN = "builtin"


@dataclass(frozen=True, kw_only=True)
class BuildRequest:
    """What to build; the workers are specified elsewhere.

    Attributes:
        objects: Directory of meshes, or "builtin".
        out: Directory of the dataset.
        config: Configuration of the dataset.
        units: Unit of length of the meshes.
        manifest: YAML file with units and classes by mesh.
        only: Names of the objects to build; all if empty.
        postures: File of postures that are tried instead of drawn palm poses.
        show: Whether to show progress on standard error.
        read_as: Values for all postures, see `exchange.attempts.read_attempts`.
    """

    objects: str
    out: Path
    config: Config
    units: str
    manifest: Path | None
    only: tuple[str, ...]
    postures: Path | None
    show: bool
    read_as: Mapping[str, str] = field(default_factory=dict)


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
