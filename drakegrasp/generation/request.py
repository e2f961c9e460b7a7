"""What a caller asks to be built."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from drakegrasp.errors import MeshError, listed

if TYPE_CHECKING:
    from drakegrasp.config import Config


#: Stands for the built-in objects in place of a directory.
BUILTIN = "builtin"


@dataclass(frozen=True, kw_only=True)
class BuildRequest:
    """What to build; who does the work is said elsewhere.

    Attributes:
        objects: Directory of meshes, or "builtin".
        out: Directory of the dataset.
        config: All the rules.
        units: Unit of length of the meshes.
        manifest: YAML file with units and classes by mesh.
        only: Names of the objects to build; all if empty.
        postures: File of postures that are tried instead of drawn palm poses.
        show: Whether to show progress on standard error.
    """

    objects: str
    out: Path
    config: Config
    units: str
    manifest: Path | None
    only: tuple[str, ...]
    postures: Path | None
    show: bool


def refuse_unknown(only: Sequence[str], names: Sequence[str]) -> None:
    """Refuse names that no object has.

    Raises:
        MeshError: If there is one.
    """
    unknown = [name for name in only if name not in names]
    if unknown:
        known = listed(names)
        raise MeshError(f"only must be names of objects ({known}), got {unknown[0]!r}")
