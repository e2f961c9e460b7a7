"""The frozen benchmark `drakegrasp-clutter-1`: scenes of several built-in objects.

Input: a directory. Output: whether its clutter.hdf5 has the published scenes. The recipe is a
dataset of the preset `clutter1`, and the scenes of `SCENES` on it; a third of the scenes have each
of the surroundings. All draws come from `seeding`; how objects come to rest is simulated, so that
another CPU or version may give other scenes, which the comparison then tells.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

from drakegrasp.dataset.hdf5 import open_scenes

NAME, PRESET = "drakegrasp-clutter-1", "clutter1"
#: Arguments of `build_clutter`.
SCENES: dict[str, Any] = {
    "scenes": 60,
    "objects": (2, 6),
    "surroundings": ("table", "bin", "shelf"),
    "tries": 10,
}


@dataclass(frozen=True, kw_only=True)
class ClutterFacts:
    """What identifies the scenes of a file.

    Attributes:
        scenes, grasps: Their numbers.
        sha256: Hash of the objects, their poses, and the palm poses and labels of the grasps.
    """

    scenes: int
    grasps: int
    sha256: str


def facts_of(path: Path) -> ClutterFacts:
    """Return what identifies the scenes of a clutter.hdf5.

    Raises:
        DataError: If the file is missing, damaged or differs from the schema.
    """
    with open_scenes(path) as file:
        names = json.dumps(file["objects/name"].asstr()[:].tolist())
        digest = hashlib.sha256(names.encode())
        for place in _IDENTITY:
            digest.update(file[place][:].tobytes())
        counts = {"scenes": len(file["scenes/split"]), "grasps": len(file["grasps/scene"])}
    return ClutterFacts(**counts, sha256=digest.hexdigest())


#: The columns that the hash covers.
_IDENTITY = (
    *("scenes/object", "scenes/X_TO"),
    *(f"grasps/{name}" for name in ("scene", "object", "X_TG", "free", "outcome")),
)


def published() -> ClutterFacts:
    """Return what identifies the published scenes."""
    text = resources.files("drakegrasp.scoring").joinpath("clutter1.json").read_text("utf-8")
    return ClutterFacts(**json.loads(text))
