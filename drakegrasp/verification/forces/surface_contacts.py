"""The contacts on an object's surface that a prediction selects: points, and patches about them.

In: predicted points and normals. Out: `SurfaceContacts`, at the surface's own points with its own
normals. A prediction only selects among them, so no choice of its numbers makes a force possible
that the surface does not allow.

The surface is the one that the hand meets in the simulation. The contact is the point nearest to
the predicted one on a face whose normal is within `MAX_ANGLE` of the predicted normal. At an edge,
where several of these faces are equally near, it is the one whose normal is closest to the
predicted one; so a point on the wrong side of a thin wall is on the side that its normal names. If
no such face is within `MAX_DISTANCE`, the contact is on the nearest face of all, and the prediction
is off the surface by that distance or angle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import trimesh

from drakegrasp.frames import Array
from drakegrasp.mesh.surfaces import winding_numbers
from drakegrasp.objects.model import ObjectModel
from drakegrasp.verification.forces.contact_forces import contact_axes

#: Usual area of a fingertip's contact [m^2]: the median of 498 patches of the Barrett Hand
#: after closing, on five G3DB meshes; half of them are between 57 and 89 mm^2.
PATCH_AREA = 68e-6
#: Radius of a disc of this area [m], 4.65 mm, and its torsion radius under even pressure, 3.1 mm: a
#: normal force f resists a torsional moment of mu f r (R. Howe, M. Cutkosky, "Practical
#: force-motion models for sliding manipulation", IJRR 15(6), 1996).
PATCH_RADIUS = float(np.sqrt(PATCH_AREA / np.pi))
TORSION_RADIUS = 2.0 / 3.0 * PATCH_RADIUS
#: A prediction is off the surface if its point is farther from it than this [m], about the radius
#: of a patch, or if its normal is farther from the surface's own than this [rad].
MAX_DISTANCE, MAX_ANGLE = 0.005, np.deg2rad(45.0)
#: Distances that differ by less are equal [m]: predictions are rounded to 0.1 mm.
SAME_DISTANCE = 1e-4
#: A face that agrees with the normal may be so much farther than the nearest one [m]: less than the
#: wall of a cup.
MAX_DETOUR = 1e-3
#: Points on the ring of a patch.
RING_POINTS = 8


@dataclass(frozen=True, kw_only=True, eq=False)
class SurfaceContacts:
    """Contacts of k fingertips on the surface, and how far the predicted ones are from them.

    Attributes:
        p_OQ: (k, 3), points of the surface in {O} [m].
        nhat_Q_O: (k, 3), outward normals of the faces there, in {O}.
        distance: (k,), of the predicted points from them [m].
        inside: (k,), whether the predicted points are in the object.
        angle: (k,), between the predicted normals and these [rad].
    """

    p_OQ: Array
    nhat_Q_O: Array
    distance: Array
    inside: npt.NDArray[np.bool_]
    angle: Array

    @property
    def off_surface(self) -> npt.NDArray[np.bool_]:
        """(k,), whether a prediction is too far from the surface, or its normal from its own."""
        return ~((self.distance <= MAX_DISTANCE) & (self.angle <= MAX_ANGLE))


def surface_contacts(
    model: ObjectModel, p_OQ: npt.ArrayLike, nhat_Q_O: npt.ArrayLike
) -> SurfaceContacts:
    """Return the contacts that predicted points (k, 3) [m] and outward unit normals (k, 3) select.

    Args:
        model: The object.
        p_OQ: In {O}.
        nhat_Q_O: In {O}.
    """
    points, normals = np.asarray(p_OQ, dtype=float), np.asarray(nhat_Q_O, dtype=float)

    # Nearest among the faces that agree with the normal, else among all. Beyond a wall's other side
    # no fingertip can be: a face that is much farther than the nearest one is not chosen.
    feet = _feet(model.collision.triangles, points)
    distance = np.linalg.norm(feet - points[:, None], axis=2)
    cosine = normals @ model.collision.face_normals.T
    near_enough = distance <= distance.min(axis=1, keepdims=True) + MAX_DETOUR
    agreeing = np.where((cosine >= np.cos(MAX_ANGLE)) & near_enough, distance, np.inf)
    found = agreeing.min(axis=1) <= MAX_DISTANCE
    chosen = _nearest(np.where(found[:, None], agreeing, distance), cosine)

    # The point of that face, and how far the prediction is from it.
    near = feet[np.arange(len(points)), chosen]
    own = np.asarray(model.collision.face_normals[chosen])
    winding = winding_numbers(
        points, model.collision_vertices, model.collision_faces.astype(np.int64)
    )
    along = np.clip(np.einsum("ij,ij->i", own, normals), -1.0, 1.0)
    return SurfaceContacts(
        p_OQ=near,
        nhat_Q_O=own,
        distance=np.linalg.norm(points - near, axis=1),
        inside=winding > 0.5,
        angle=np.arccos(along),
    )


def patch_points(model: ObjectModel, contacts: SurfaceContacts) -> tuple[Array, Array]:
    """Return points (k, m, 3) [m] of the patches about k contacts, and normals (k, m, 3) there.

    A patch is its contact and a ring of `RING_POINTS` points about it, each with the normal of its
    own face. They are the surface's nearest points to a circle of the radius `TORSION_RADIUS` in
    the contact's tangent plane; of equally near faces that most parallel to the contact's counts.
    So a patch ends at an edge of 90 degrees or more, and bends around a blunter one.

    Args:
        model: The object.
        contacts: On its surface.
    """
    # A circle about each contact.
    angles = 2.0 * np.pi * np.arange(RING_POINTS) / RING_POINTS
    ring = np.column_stack([np.zeros(RING_POINTS), np.cos(angles), np.sin(angles)])
    axes = contact_axes(contacts.nhat_Q_O)
    circles = contacts.p_OQ[:, None] + TORSION_RADIUS * ring @ axes.transpose(0, 2, 1)

    # A point of it is at most a radius from the surface, so at most two from the contact.
    triangles, face_normals = model.collision.triangles, model.collision.face_normals
    arms = _feet(triangles, contacts.p_OQ) - contacts.p_OQ[:, None]
    near = np.linalg.norm(arms, axis=2) <= 2.0 * TORSION_RADIUS + SAME_DISTANCE
    points, normals = [], []
    for i, circle in enumerate(circles):
        cosine = face_normals @ contacts.nhat_Q_O[i]
        faces = np.flatnonzero(near[i])
        feet = _feet(triangles[faces], circle)
        distance = np.linalg.norm(feet - circle[:, None], axis=2)
        chosen = _nearest(distance, np.broadcast_to(cosine[faces], distance.shape))
        points.append(np.vstack([contacts.p_OQ[i], feet[np.arange(RING_POINTS), chosen]]))
        normals.append(np.vstack([contacts.nhat_Q_O[i], face_normals[faces[chosen]]]))
    return np.array(points), np.array(normals)


def _feet(triangles: Array, points: Array) -> Array:
    """Return the point (n, m, 3) of each of m triangles that is nearest to each of n points."""
    n, m = len(points), len(triangles)
    near = trimesh.triangles.closest_point(
        np.tile(triangles, (n, 1, 1)), np.repeat(points, m, axis=0)
    )
    return np.asarray(near).reshape(n, m, 3)


def _nearest(distance: Array, cosine: Array) -> npt.NDArray[np.int64]:
    """Return the index (n,) of the nearest face (n, m); of equally near ones the most parallel."""
    near = distance <= distance.min(axis=1, keepdims=True) + SAME_DISTANCE
    return np.argmax(np.where(near, cosine, -np.inf), axis=1)
