"""An object as DexGraspBench stores it: convex parts, and the volume from which its density comes.

In: a folder with `urdf/meshes/*.obj` and `info/simplified.json`. Out: an `ObjectFolder`.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from pathlib import Path

from drakegrasp.errors import DataError, one_line
from drakegrasp.foreign_files import read_json

#: Where the parts and the volume are.
PARTS, INFO = "urdf/meshes", "info/simplified.json"


@dataclass(frozen=True, kw_only=True)
class ObjectFolder:
    """Convex parts in the object's frame {O}.

    Attributes:
        parts: Wavefront files, sorted by name.
        scale: By which their coordinates are multiplied.
        volume: Of the scaled object [m^3].
        digest: 16 digits of the SHA-256 of the parts and the volume.
    """

    parts: tuple[Path, ...]
    scale: float
    volume: float
    digest: str


def read_object_folder(folder: Path, scale: float) -> ObjectFolder:
    """Return the object of a folder.

    Args:
        folder: Of DexGraspBench's layout.
        scale: Of the object.

    Raises:
        DataError: If the folder has no parts, or its volume cannot be read.
    """
    parts = tuple(sorted((folder / PARTS).glob("*.obj")))
    if not parts:
        raise DataError(f"{folder / PARTS}: must hold the object's convex parts (.obj), got none")
    if not (math.isfinite(scale) and scale > 0.0):
        raise DataError(f"{folder}: scale must be a positive number, got {scale}")
    try:
        info = read_json(folder / INFO)
        unit = info["mass"] / (info["density"] * info["scale"] ** 3)
    except (KeyError, TypeError, ArithmeticError, OSError, ValueError) as error:
        raise DataError(
            f"{folder / INFO}: must have mass, density and scale, got {one_line(error)}"
        ) from None
    if not (math.isfinite(unit) and unit > 0.0):
        raise DataError(f"{folder / INFO}: the volume must be positive, got {unit}")

    # What the object is, whatever its folder is called.
    text = hashlib.sha256()
    for part in parts:
        text.update(part.read_bytes())
    text.update(repr((unit, scale)).encode())
    return ObjectFolder(
        parts=parts, scale=scale, volume=unit * scale**3, digest=text.hexdigest()[:16]
    )
