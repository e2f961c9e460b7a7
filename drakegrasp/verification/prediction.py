"""Predicted contacts: grasp vectors become a table of contact points and normals; their margin.

Input: grasp vectors in one of five frames, as a network returned them. Output: contact points and
unit normals in that frame, or the reason why a row is not a valid grasp. An array that cannot hold
grasps at all is an error, with a message of one line.

The margin of contacts is the epsilon of Ferrari and Canny: the smallest wrench that forces at the
contacts alone cannot resist.

A prediction only selects contacts on the surface that the hand meets in the simulation. The
selected contact is the closest point to the predicted one on a face whose normal is within
`MAX_ANGLE` of the predicted normal, and which is at most `MAX_DETOUR` farther than the closest
face. At an edge, where several of these faces are equally close, it is on the face whose normal is
closest to the predicted one. So a point on the wrong side of a wall that is thinner than
`MAX_DETOUR` is moved to the side that its normal names. If no such face is within `MAX_DISTANCE`,
the contact is on the closest face of all.

A fingertip touches at a point with Coulomb friction. It pushes along the inward normal and along
the surface; it neither pulls nor twists. So two fingertips have no force closure: they resist no
torque about the line between them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
import trimesh
from scipy.spatial import ConvexHull, QhullError

from drakegrasp.config import LARGEST, PhysicsConfig
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.errors import GraspError
from drakegrasp.frames import FARTHEST, Array, as_numbers
from drakegrasp.objects.model import ObjectModel
from drakegrasp.simulation.attempts import GraspRows, read_confidence

#: The row of a split for each of n grasps, or one row for all; None for all rows, in order.
RowChoice: TypeAlias = Sequence[int] | npt.NDArray[np.int64] | int | None

#: A normal whose length differs from one by more than this is reported as normalised.
NORMAL_TOLERANCE = 0.01
#: Length below which a normal has no direction.
SHORTEST_NORMAL = 1e-6
#: A prediction is off the surface if its point is farther from the surface than this [m], about the
#: radius of a patch, or if its normal differs from the surface normal by more than this [rad].
MAX_DISTANCE, MAX_ANGLE = 0.005, np.deg2rad(45.0)
#: Distances that differ by less than this are equal [m]: predictions are rounded to 0.1 mm.
SAME_DISTANCE = 1e-4
#: A face that agrees with the normal may be farther than the closest face by at most this [m], less
#: than the wall of a cup.
MAX_DETOUR = 1e-3
#: Edges of the pyramid that approximates a friction cone from inside. With 16 edges, epsilon is
#: about 2 % too small and varies by as much with the frame; the hull takes 15 ms.
FRICTION_EDGES = 16
#: An epsilon below this is a rounding error: the origin is on the surface of the hull.
ROUNDING = 1e-9


@dataclass(frozen=True, kw_only=True, eq=False)
class ContactRows(GraspRows):
    """n grasps of k contacts, without wrist and joints, built by `read_grasps`.

    Attributes:
        grasps: (n, 6k), the numbers as they were given.
        points, normals: (n, k, 3), contact points [m] and unit normals in the frame of the caller;
            NaN in rows without a valid grasp.
        normalised: (n,), whether a normal was not of unit length.
    """

    grasps: Array
    points: Array
    normals: Array
    normalised: npt.NDArray[np.bool_]

    def numbers(self) -> Array:
        """Return the numbers (n, 6k) as they were given."""
        return self.grasps


def read_grasps(
    grasps: npt.ArrayLike,
    fingers: int,
    *,
    rows: npt.NDArray[np.int64] | None = None,
    confidence: Array | None = None,
) -> ContactRows:
    """Return the grasps of grasp vectors (n, 6k); a bad row does not affect other rows.

    Args:
        grasps: (n, 6k), or (6k,) for one grasp: k points [m], then k outward normals.
        fingers: Number of fingers, k.
        rows: (n,), row of a split that each grasp is for.
        confidence: (n,), greater is better.

    Raises:
        GraspError: If the array does not hold such rows.
    """
    # Each valid row has 6k numbers.
    size = 6 * fingers
    array = as_numbers(grasps, f"a grasp must be {size} numbers")
    if array.ndim not in (1, 2) or array.shape[-1] != size:
        raise GraspError(
            f"a grasp must be {size} numbers ({fingers} points, then {fingers} outward normals), "
            f"got an array of shape {array.shape}"
        )
    array = np.atleast_2d(array)
    invalid = [""] * len(array)

    # Reject numbers that no contact has.
    limit = np.r_[np.full(size // 2, FARTHEST), np.full(size // 2, LARGEST)]
    usable = np.abs(array) <= limit  # false for NaN
    for row, column in zip(*np.nonzero(~usable), strict=True):
        value = array[row, column]
        must = f"beyond {limit[column]:g}" if np.isfinite(value) else "not finite"
        invalid[row] = invalid[row] or f"number {column + 1} is {value:g}, {must}"

    # Reject normals without a direction.
    known = np.where(usable, array, np.nan)
    points, normals = known.reshape(len(array), 2, fingers, 3).swapaxes(0, 1).copy()
    length = np.linalg.norm(normals, axis=-1)
    for row, finger in zip(*np.nonzero(length < SHORTEST_NORMAL), strict=True):
        invalid[row] = invalid[row] or f"normal {finger + 1} is zero"

    # Normalise the remaining normals.
    bad = np.array([bool(reason) for reason in invalid], dtype=np.bool_)
    points[bad], normals[bad], length[bad] = np.nan, np.nan, 1.0
    return ContactRows(
        row=np.arange(len(array), dtype=np.int64),
        invalid=tuple(invalid),
        of_row=rows,
        confidence=confidence,
        grasps=array,
        points=points,
        normals=normals / length[..., None],
        normalised=np.abs(length - 1.0).max(axis=1, initial=0.0) > NORMAL_TOLERANCE,
    )


def choose_rows(
    dataset: GraspDataset,
    rows: RowChoice,
    count: int,
    *,
    said: str = "`rows` says for which rows they are",
) -> npt.NDArray[np.int64]:
    """Return the row (n,) of the dataset's split for each of `count` grasps; one may be for all.

    `said` is the part of the error message that explains how to give rows.

    Raises:
        GraspError: If there is not exactly one row per grasp, or a row does not exist.
    """
    chosen = np.arange(count) if rows is None else np.asarray(rows)
    # NumPy treats an empty list as real numbers.
    if chosen.size and chosen.dtype.kind not in "iu":
        raise GraspError(f"rows must be whole numbers, got values of type {chosen.dtype}")
    chosen = chosen.astype(np.int64)
    chosen = np.full(count, chosen) if chosen.ndim == 0 else chosen.ravel()

    # Check that there is one row per grasp.
    if len(chosen) != count:
        raise GraspError(f"rows must be one per grasp ({count}), got {len(chosen)}")
    if not len(dataset):
        raise GraspError(f"{dataset.path}: {dataset.emptiness}")
    if rows is None and count != len(dataset):
        raise GraspError(
            f"without rows there must be a grasp for each of the {len(dataset)} rows of "
            f"{dataset.split} in {dataset.path.name}, got {count} grasps ({said})"
        )

    # Check that the rows exist.
    wrong = chosen[(chosen < 0) | (chosen >= len(dataset))]
    if len(wrong):
        raise GraspError(
            f"rows must be 0 to {len(dataset) - 1} of {dataset.split} in {dataset.path.name}, "
            f"got {wrong[0]}"
        )
    return chosen


def read_several(
    grasps: npt.ArrayLike,
    data: GraspDataset,
    *,
    fingers: int,
    rows: RowChoice = None,
    confidence: npt.ArrayLike | None = None,
) -> ContactRows:
    """Return predicted contacts for rows of a split; a row may have several predictions.

    Args:
        grasps: (n, 6k), or (n, m, 6k) with m grasps per row. NaN is kept: it is a bad prediction,
            not a mistake of the caller.
        data: The split.
        fingers: Number of fingers, k.
        rows: (n,), row that each prediction is for, with repeats; None for all rows in order.
        confidence: (n,) or (n, m), greater is better.

    Raises:
        GraspError: If the shapes do not match, or a row does not exist.
    """
    array = as_numbers(grasps, "grasps must be numbers")
    if array.ndim not in (2, 3) or array.size == 0:
        raise GraspError(f"grasps must be (n, 6k), or (n, m, 6k) for m per row, got {array.shape}")
    of_row = np.repeat(choose_rows(data, rows, len(array)), array[0, ..., 0].size)
    stated = None
    if confidence is not None:
        stated = read_confidence(confidence, array.shape[:-1]).ravel()
    flat = array.reshape(-1, array.shape[-1])
    return read_grasps(flat, fingers, rows=of_row, confidence=stated)


def contact_epsilon(
    model: ObjectModel, p_OQ: Array, nhat_Q_O: Array, physics: PhysicsConfig
) -> float:
    """Return the epsilon of Ferrari and Canny of predicted contacts, see `ferrari_canny`.

    Torques are divided by the largest distance of the object's surface from its centre of mass.

    Args:
        model: The object.
        p_OQ: (k, 3), predicted points in {O} [m].
        nhat_Q_O: (k, 3), predicted unit normals out of the object in {O}.
        physics: The friction, unless the object has its own.
    """
    points, normals = surface_contacts(model, p_OQ, nhat_Q_O)
    return ferrari_canny(
        points - model.p_OOcm,
        normals,
        friction=model.own_physics(physics).friction_hand,
        length=float(np.linalg.norm(model.visual_vertices - model.p_OOcm, axis=1).max()),
    )


def surface_feet(triangles: Array, points: Array) -> Array:
    """Return the closest point (n, m, 3) on each of m triangles to each of n points."""
    n, m = len(points), len(triangles)
    near = trimesh.triangles.closest_point(
        np.tile(triangles, (n, 1, 1)), np.repeat(points, m, axis=0)
    )
    return np.asarray(near).reshape(n, m, 3)


def surface_contacts(model: ObjectModel, p_OQ: Array, nhat_Q_O: Array) -> tuple[Array, Array]:
    """Return the contacts that predicted points (k, 3) [m] and outward unit normals (k, 3) select.

    Returns:
        Points of the surface (k, 3) in {O} [m], and outward normals (k, 3) of the faces there.
    """
    # Choose the closest face among those that agree with the normal, or else among all. No
    # fingertip can be beyond a wall, so a face that is much farther than the closest one is not
    # chosen.
    feet = surface_feet(model.collision.triangles, p_OQ)
    distance = np.linalg.norm(feet - p_OQ[:, None], axis=2)
    cosine = nhat_Q_O @ model.collision.face_normals.T
    near_enough = distance <= distance.min(axis=1, keepdims=True) + MAX_DETOUR
    agreeing = np.where((cosine >= np.cos(MAX_ANGLE)) & near_enough, distance, np.inf)
    found = agreeing.min(axis=1) <= MAX_DISTANCE
    chosen = _nearest(np.where(found[:, None], agreeing, distance), cosine)
    return feet[np.arange(len(p_OQ)), chosen], np.asarray(model.collision.face_normals[chosen])


def _nearest(distance: Array, cosine: Array) -> npt.NDArray[np.int64]:
    """Return the index (n,) of the closest face (n, m); of equally close ones the most parallel."""
    near = distance <= distance.min(axis=1, keepdims=True) + SAME_DISTANCE
    return np.argmax(np.where(near, cosine, -np.inf), axis=1)


def contact_axes(nhat_Q_O: Array) -> Array:
    """Return axes (n, 3, 3) at each contact, as columns: the inward normal and two tangents.

    Args:
        nhat_Q_O: (n, 3), normals out of the object in {O}.
    """
    inward = -nhat_Q_O / np.linalg.norm(nhat_Q_O, axis=1, keepdims=True)
    # The axis of {O} with the smallest component along the normal is never parallel to it.
    first = np.cross(inward, np.eye(3)[np.argmin(np.abs(inward), axis=1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([inward, first, np.cross(inward, first)], axis=2)


def ferrari_canny(p_OcmQ: Array, nhat_Q_O: Array, *, friction: float, length: float) -> float:
    """Return the epsilon of a grasp: the smallest wrench that can break it.

    This is the L1 version of C. Ferrari and J. Canny, "Planning optimal grasps", ICRA 1992: the
    distance of the origin from the surface of the convex hull of all contacts' friction cones, for
    normal forces that sum to one. Each cone is approximated by a pyramid with `FRICTION_EDGES`
    edges. Edge e of point i, with the inward normal n_i, the tangents t, the arm p_i and the length
    L, has the wrench

        w_ie = [p_i × f_ie / L; f_ie],   f_ie = n_i + μ (cos(α_e) t_i1 + sin(α_e) t_i2).

    If the origin is inside the hull, ε = min over |u| = 1 of max over i, e of u·w_ie.

    Args:
        p_OcmQ: (..., 3), arms of the points about the centre of mass in {O} [m].
        nhat_Q_O: (..., 3), outward normals there.
        friction: Coulomb coefficient.
        length: Length by which torques are divided [m].

    Returns:
        Epsilon, without unit; 0 if the origin is not inside the hull, or the hull is flat.
    """
    # Wrenches of the edges of all cones, for a normal force of one.
    angles = 2.0 * np.pi * np.arange(FRICTION_EDGES) / FRICTION_EDGES
    edges = np.stack(
        [np.ones(FRICTION_EDGES), friction * np.cos(angles), friction * np.sin(angles)]
    )
    forces = contact_axes(nhat_Q_O.reshape(-1, 3)) @ edges  # (n, 3, edges)
    forces = forces.transpose(0, 2, 1)  # (n, edges, 3)
    torques = np.cross(p_OcmQ.reshape(-1, 1, 3), forces) / length
    wrenches = np.concatenate([torques, forces], axis=2).reshape(-1, 6)

    # Compute the distance of the origin from the hull of these wrenches.
    try:
        hull = ConvexHull(wrenches)
    except QhullError:
        return 0.0  # flat, or too few points: some wrench cannot be resisted at all
    # A row is a unit outward normal and an offset, which is negative if the origin is inside.
    epsilon = -float(hull.equations[:, -1].max())
    return epsilon if epsilon > ROUNDING else 0.0
