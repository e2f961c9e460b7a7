"""What may be wrong with the numbers of a grasp that fails; nothing is changed by it.

In: contacts or a posture in {O}, and the frames that the numbers could be in. Out: how the contacts
lie on the surface, and hints in words. A hint says that the same numbers, read in another way,
would fit much better: in another frame or unit, with normals that point the other way, with fingers
in another order. All factors are own choices.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import permutations
from typing import TypeAlias

import numpy as np
import trimesh

from drakegrasp.arithmetic import multiply
from drakegrasp.errors import HandError
from drakegrasp.frames import X_WT, Array, invert_pose, rotate_vectors, transform_points
from drakegrasp.grasp import unused_fingers
from drakegrasp.hand.description import Hand
from drakegrasp.hand.kinematics import fingertip_poses
from drakegrasp.objects.model import ObjectModel
from drakegrasp.simulation.posture import Posture, joint_order, preshape_index
from drakegrasp.verification.wrist_problem import hand_constants
from drakegrasp.verification.wrist_solver import make_postures, posture_misfit

#: A face may be this much farther than the nearest one and still count as next to the point [m]: a
#: prediction is as often on the wrong side of a cup's wall as beside the wall.
WALL = 0.005


@dataclass(frozen=True, kw_only=True, eq=False)
class SurfaceFit:
    """How k contacts lie on the surface that the hand meets.

    Attributes:
        distance: (k,), of the points from the surface [m].
        nearest: (k, 3), the points of the surface nearest to them, in {O} [m].
        agreement: (k,), cosine between each normal and the outward normal of a face next to its
            point, of the face where it is largest; negative where the normal points inwards.
        normals: (k, 3), outward unit normals in {O} of the faces nearest to the points.
    """

    distance: Array
    nearest: Array
    agreement: Array
    normals: Array


def fit_surface(model: ObjectModel, p_OQ: Array, nhat_Q_O: Array) -> SurfaceFit:
    """Return how contacts lie on an object's surface.

    A predicted point may be beside an edge or on the wrong side of a thin wall, so each face that
    is at most `WALL` farther than the nearest one is next to it.

    Args:
        model: The object.
        p_OQ: (k, 3), points in {O} [m].
        nhat_Q_O: (k, 3), unit normals in {O}.
    """
    # The point of each of m faces that is nearest to each contact.
    triangles = model.collision.triangles
    k, m = len(p_OQ), len(triangles)
    points = np.repeat(p_OQ, m, axis=0)
    near = trimesh.triangles.closest_point(np.tile(triangles, (k, 1, 1)), points)
    distances = np.linalg.norm(near - points, axis=1).reshape(k, m)

    # The nearest face, and the best of those next to the point.
    face = distances.argmin(axis=1)
    distance = distances[np.arange(k), face]
    cosine = nhat_Q_O @ model.collision.face_normals.T
    beside = distances <= distance[:, None] + WALL
    return SurfaceFit(
        distance=distance,
        nearest=near.reshape(k, m, 3)[np.arange(k), face],
        agreement=np.where(beside, cosine, -1.0).max(axis=1),
        normals=model.collision.face_normals[face],
    )


#: Contacts are misplaced if one is farther from the surface [m].
FAR = 0.01
#: A posture is misplaced if all fingertips of its grasp are farther from the surface [m].
FAR_POSTURE = 0.05
#: Another reading fits much better if its points are at most this share as far from the surface
#: (mean over the contacts), and no farther than `FAR`.
MUCH_NEARER = 0.25
#: Contacts of a hand are at least so far apart [m]: any that shrink come close to a small object.
LEAST_SPREAD = 0.01
#: Normals agree with the surface if their mean cosine to its normals is above this, and point the
#: wrong way if it is below zero and the reversed ones agree.
AGREEMENT = 0.5
#: Points this close to the surface are on the side of a thin wall that they are meant for [m].
ON_SURFACE = 0.001
#: Another order of the fingers fits much better if its misfit to the hand's postures is at most
#: this share of the given one's.
MUCH_LIKER = 0.25
#: What lengths may have been meant in, by the factors to metres.
_UNITS = {
    1e-3: "points in millimetres instead of metres",
    1e-2: "points in centimetres instead of metres",
    1e2: "points 100 times as large",
    1e3: "points 1000 times as large",
}
#: The hint about normals.
REVERSED = "normals that point the other way, out of the object"

#: Returns contacts in {O}, points (k, 3) [m] and unit normals (k, 3) or None, of the same numbers
#: read in a frame X_OF (4, 4) with lengths times a factor.
Reading: TypeAlias = Callable[[Array, float], tuple[Array, Array | None]]


def known_frames(
    X_TO: Array,
    cameras: Mapping[str, Array] | None = None,
    X_TC: Array | None = None,
    X_OM: Array | None = None,
) -> dict[str, Array]:
    """Return the poses X_OF (4, 4) of the frames that numbers could be in, by what to call each.

    Args:
        X_TO: (4, 4), pose of the object.
        cameras: (4, 4), poses in {T} of cameras, by what to call the frame of each.
        X_TC: (4, 4), the camera's pose that the caller states, which may be another pose.
        X_OM: (4, 4), pose of the mesh file's frame in {O}, if it is known.
    """
    X_OT = invert_pose(X_TO)
    frames = {
        "the object's frame (object)": np.eye(4),
        "the table's frame (table)": X_OT,
        "the world's frame": multiply(X_OT, invert_pose(X_WT)),
    }
    frames |= {} if X_OM is None else {"the mesh file's frame (mesh)": X_OM}
    frames |= {name: multiply(X_OT, X) for name, X in (cameras or {}).items()}
    if X_TC is not None:
        X_CT = invert_pose(X_TC)
        frames |= {
            "the inverse of X_TC": multiply(X_OT, X_CT),
            "the inverse of X_TC, which is the object's pose in the camera's frame": X_CT,
            "X_TC as the camera's pose in the object's frame": X_TC,
        }
    return frames


def find_hints(
    model: ObjectModel,
    hand: Hand,
    p_OQ: Array,
    nhat_Q_O: Array,
    *,
    X_OA: Array,
    frames: Mapping[str, Array],
    fits: bool = False,
) -> tuple[str, ...]:
    """Return what would make contacts fit much better.

    Args:
        model: The object.
        hand: Of k fingers.
        p_OQ: (k, 3), contact points in {O} [m].
        nhat_Q_O: (k, 3), unit normals in {O}.
        X_OA: (4, 4), pose of the frame in which the contacts were given.
        frames: (4, 4), poses X_OF of other frames by their names, see `known_frames`.
        fits: Whether the hand makes the contacts: then only their place may be wrong.
    """
    fit = fit_surface(model, p_OQ, nhat_Q_O)
    X_AO = invert_pose(X_OA)
    p_AQ, nhat_Q_A = transform_points(X_AO, p_OQ), rotate_vectors(X_AO, nhat_Q_O)

    def read(X_OF: Array, factor: float) -> tuple[Array, Array | None]:
        return transform_points(X_OF, factor * p_AQ), rotate_vectors(X_OF, nhat_Q_A)

    # Where the points are elsewhere, neither normals nor fingers say anything.
    if fit.distance.max() > FAR and (place := _better_place(model, fit, read, X_OA, frames)):
        return (place,)
    if fits:
        return ()
    return (*_turned(model, fit, p_OQ, nhat_Q_O), *_reordered(hand, p_OQ, nhat_Q_O))


def find_posture_hints(
    model: ObjectModel,
    hand: Hand,
    posture: Posture,
    *,
    X_OA: Array,
    frames: Mapping[str, Array],
    link: bool = False,
    poses: Mapping[str, Array] | None = None,
) -> tuple[tuple[str, ...], Array]:
    """Return what would bring the fingertips of a posture much closer to the object.

    Args:
        model: The object.
        hand: Of the posture.
        posture: Wrist and joints, in {O}.
        X_OA: (4, 4), pose of the frame in which the palm's pose was given.
        frames: (4, 4), poses X_OF of other frames by their names, see `known_frames`.
        link: Whether the pose that was given is that of the palm link.
        poses: (4, 4), other poses X_AG that may have been meant, by what to call them.

    Returns:
        The hints, and how far the fingertips that it closes are from the surface (m,) [m]; none if
        the hand's fingertips have no nominal contact points.
    """
    try:
        p_GQ = _fingertips(hand, posture)
    except HandError:
        return (), np.zeros(0)
    X_AG = multiply(invert_pose(X_OA), posture.X_OG)
    # Where the given pose is: lengths in another unit move the palm with it.
    p_AL = multiply(X_AG, invert_pose(hand.X_BG))[:3, 3] if link else X_AG[:3, 3]

    def read(X_OF: Array, factor: float) -> tuple[Array, Array | None]:
        X = X_AG.copy()
        X[:3, 3] += (factor - 1.0) * p_AL
        return transform_points(multiply(X_OF, X), p_GQ), None

    fit, place = _fit(model, read(X_OA, 1.0)), ""
    if fit.distance.mean() > FAR:
        others = {
            name: (transform_points(multiply(X_OA, X), p_GQ), None)
            for name, X in (poses or {}).items()
            if np.isfinite(X).all()
        }
        place = _better_place(model, fit, read, X_OA, frames, others)
    place = place.replace("points", "positions of the palm")
    return (place,) if place else (), fit.distance


def count_hints(hints: Iterable[tuple[str, ...]]) -> list[tuple[str, int]]:
    """Return the hints of many grasps with how many have each, the most frequent first."""
    return Counter(hint for each in hints for hint in each).most_common()


def _better_place(
    model: ObjectModel,
    fit: SurfaceFit,
    read: Reading,
    X_OA: Array,
    frames: Mapping[str, Array],
    others: Mapping[str, tuple[Array, None]] | None = None,
) -> str:
    """Return the frame and unit in which far points are near the surface; empty if none is.

    Of several, one that changes only frame or unit wins, then the one that is nearest. `others` are
    contacts of other readings, by their names.
    """
    limit = min(MUCH_NEARER * fit.distance.mean(), FAR)
    found = list[tuple[bool, float, str]]()
    for text, other in (others or {}).items():
        there = _fit(model, other)
        if there.distance.mean() <= limit:
            found.append((False, float(there.distance.max()), text))
    for frame, X_OF in {"": X_OA, **frames}.items():
        for factor, unit in {1.0: "", **_UNITS}.items():
            contacts = read(X_OF, factor)
            if not (frame or unit) or np.ptp(contacts[0], axis=0).max() < LEAST_SPREAD:
                continue
            there = _fit(model, contacts)
            # Another unit turns no normals, so these say nothing of it.
            agrees = contacts[1] is None or not frame or there.agreement.mean() > AGREEMENT
            if there.distance.mean() <= limit and agrees:
                both = bool(frame and unit)
                text = ", with ".join(filter(None, (frame, unit)))
                found.append((both, float(there.distance.max()), text))
    return min(found, key=lambda each: each[:2])[2] if found else ""


def _fit(model: ObjectModel, contacts: tuple[Array, Array | None]) -> SurfaceFit:
    points, normals = contacts
    return fit_surface(model, points, np.zeros_like(points) if normals is None else normals)


def _fingertips(hand: Hand, posture: Posture) -> Array:
    """Return the nominal contact points p_GQ (m, 3) of the fingers that a posture closes.

    Raises:
        HandError: If the hand has fingertips without such points.
    """
    index = {name: i for i, name in enumerate(joint_order(hand))}
    q = posture.q_grasp
    spread = float(q[index[hand.spread.joints[0]]]) if hand.spread.joints else 0.0
    closing = np.array([q[index[finger.closing_joint]] for finger in hand.fingers])
    X_GF = fingertip_poses(hand, spread=spread, closing=closing)
    points = np.einsum("kab,kb->ka", X_GF[:, :3, :3], hand_constants(hand).pad_points)
    unused = unused_fingers(hand.unused_in(preshape_index(hand, posture.preshape)), len(points))
    return np.asarray((points + X_GF[:, :3, 3])[~unused])


def _turned(model: ObjectModel, fit: SurfaceFit, p_OQ: Array, nhat_Q_O: Array) -> Iterator[str]:
    """Yield that the normals point inwards, if they do."""
    given, other = fit.agreement.mean(), fit_surface(model, p_OQ, -nhat_Q_O).agreement.mean()
    # Next to a thin wall both sides are near: there only points on the surface tell.
    if fit.distance.max() < ON_SURFACE:
        given = np.sum(nhat_Q_O * fit.normals, axis=1).mean()
        other = -given
    if given < 0.0 and other > AGREEMENT:
        yield REVERSED


def _reordered(hand: Hand, p_OQ: Array, nhat_Q_O: Array) -> Iterator[str]:
    """Yield the order of the fingers that is most like a posture of the hand."""
    postures, given = make_postures(hand), tuple(range(hand.num_fingers))
    misfits = {
        order: posture_misfit(postures, p_OQ[list(order)], nhat_Q_O[list(order)])
        for order in permutations(given)  # 6 for three fingers, 120 for five
    }
    best = min(misfits, key=lambda order: misfits[order])
    if misfits[best] < MUCH_LIKER * misfits[given]:
        yield f"contacts in the order {' '.join(str(i + 1) for i in best)} of the fingers"
