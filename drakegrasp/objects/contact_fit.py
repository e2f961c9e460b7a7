"""How contacts lie on an object's true surface: their distance from it, and their normals.

In: contacts in {O}, of the collision mesh. Out: how far they are from the full mesh. Where a
fingertip presses on both sides of an edge, the centre of its patches lies off the surface, or their
mean normal is that of no face.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drakegrasp.arithmetic import dot
from drakegrasp.frames import Array
from drakegrasp.objects.model import ObjectModel

#: On a wall thinner than twice this the face behind a contact may be nearer than its own, so the
#: face nearest to the point this far ahead along the normal counts too [m].
AHEAD = 2e-3


@dataclass(frozen=True, kw_only=True, eq=False)
class ContactFit:
    """How n contacts lie on the full mesh.

    Attributes:
        distance: (n,), of the points from the mesh [m]; NaN for a point that is NaN.
        normal_angle: (n,), between the normals and that face's which agrees better: the one nearest
            to the point, or the one nearest to the point `AHEAD` of it [rad]; pi for a normal
            that is NaN, which has no direction, and NaN for a point that is.
    """

    distance: Array
    normal_angle: Array


def fit_contacts(model: ObjectModel, p_OQ: Array, nhat_Q_O: Array) -> ContactFit:
    """Return how contacts lie on an object.

    Args:
        model: The object.
        p_OQ: (n, 3), points [m]; NaN for a fingertip that does not touch.
        nhat_Q_O: (n, 3), unit normals out of the object.
    """
    # Points that there are.
    distance, angle = np.full((2, len(p_OQ)), np.nan)
    there = np.asarray(np.isfinite(p_OQ).all(axis=1))
    if there.any():
        distance[there], angle[there] = _fit(model, p_OQ[there], nhat_Q_O[there])
    return ContactFit(distance=distance, normal_angle=angle)


def _fit(model: ObjectModel, p_OQ: Array, nhat_Q_O: Array) -> tuple[Array, Array]:
    """Return distances and angles (n,), as in `ContactFit`, of contacts that all exist."""
    mesh = model.visual
    known = np.asarray(np.isfinite(nhat_Q_O).all(axis=1))
    ahead = p_OQ + AHEAD * np.where(known[:, None], nhat_Q_O, 0.0)

    # The faces nearest to the points, and to those ahead of them.
    _, distance, here = mesh.nearest.on_surface(p_OQ)
    _, _, there = mesh.nearest.on_surface(ahead)
    cosine = np.maximum(
        dot(nhat_Q_O, mesh.face_normals[here]), dot(nhat_Q_O, mesh.face_normals[there])
    )

    angle = np.where(known, np.arccos(np.clip(cosine, -1.0, 1.0)), np.pi)
    return np.asarray(distance), angle
