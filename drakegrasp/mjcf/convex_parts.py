"""The convex parts of an object, as MuJoCo collides convex shapes only (CoACD)."""

from __future__ import annotations

import coacd
import numpy as np

from drakegrasp.frames import Array
from drakegrasp.objects.model import ObjectModel

#: Largest concavity of a convex part over the object's size, and the largest number of its corners.
CONCAVITY, CORNERS = 0.02, 64


def convex_parts(model: ObjectModel) -> list[Array]:
    """Return the corners of an object's convex parts, each (n, 3) in {O} [m]."""
    coacd.set_log_level("error")
    mesh = coacd.Mesh(model.collision_vertices, model.collision_faces)
    parts = coacd.run_coacd(mesh, threshold=CONCAVITY, seed=0, max_convex_hull=CORNERS)
    return [np.asarray(corners, dtype=float) for corners, _ in parts]
