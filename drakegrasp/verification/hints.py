"""Possible faults in the numbers of a grasp that fails; hints do not change a verdict.

Input: a placed grasp. Output: how its contacts lie on the surface, and hints in words. A hint
states that the same numbers would fit much better if they were read in a different way: in a
different frame or unit, with reversed normals, or with the fingers in a different order. All
factors are own choices.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from itertools import permutations
from typing import TypeAlias

import numpy as np

from drakegrasp.arithmetic import multiply
from drakegrasp.errors import HandError
from drakegrasp.frames import X_WT, Array, invert_pose, rotate_vectors, transform_points
from drakegrasp.grasp import unused_fingers
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.hand.kinematics import coordinate_limits, fingertip_poses
from drakegrasp.objects.model import ObjectModel
from drakegrasp.simulation.placement import PlacedObject
from drakegrasp.simulation.posture import Posture, joint_order, preshape_index, start_of
from drakegrasp.table import Table
from drakegrasp.verification.forces import surface_feet
from drakegrasp.verification.placing import PlacedGrasp
from drakegrasp.verification.wrist_problem import hand_constants
from drakegrasp.verification.wrist_solver import fit_wrist, make_postures, posture_misfit

#: A face may be farther than the closest one by this and still be next to the point [m]. A
#: predicted point is as often on the wrong side of a cup's wall as beside the wall.
WALL = 0.005


def fit_surface(model: ObjectModel, p_OQ: Array, nhat_Q_O: Array) -> Table:
    """Return how k contacts lie on the surface that the hand meets.

    A predicted point may be beside an edge or on the wrong side of a thin wall. So each face that
    is at most `WALL` farther than the closest one is "next to" the point.

    Args:
        model: The object.
        p_OQ: (k, 3), points in {O} [m].
        nhat_Q_O: (k, 3), unit normals in {O}.

    Returns:
        A table of k rows. `distance` (k,) is the distance of the points from the surface [m],
        `nearest` (k, 3) are the closest points of the surface in {O} [m], and `normals` (k, 3) the
        outward normals of their faces. `agreement` (k,) is the largest cosine between each normal
        and the outward normal of a face next to its point; it is negative if the normal points
        inwards.
    """
    feet, rows = surface_feet(model.collision.triangles, p_OQ), np.arange(len(p_OQ))
    distances = np.linalg.norm(feet - p_OQ[:, None], axis=2)
    face = distances.argmin(axis=1)
    beside = distances <= distances[rows, face][:, None] + WALL
    cosine = nhat_Q_O @ model.collision.face_normals.T
    return Table(
        distance=distances[rows, face],
        nearest=feet[rows, face],
        normals=model.collision.face_normals[face],
        agreement=np.where(beside, cosine, -1.0).max(axis=1),
    )


#: Contacts are misplaced if one of them is farther from the surface than this [m].
FAR = 0.01
#: A posture is misplaced if all fingertips of its grasp are farther from the surface than this [m].
FAR_POSTURE = 0.05
#: Another reading fits much better if the mean distance of its points from the surface is at most
#: this fraction of the given one's, and at most `FAR`.
MUCH_NEARER = 0.25
#: Smallest distance between contacts [m]; any contacts that shrink come close to a small object.
LEAST_SPREAD = 0.01
#: Normals agree with the surface if their mean cosine to its normals is above this. They point the
#: wrong way if this cosine is below zero and the reversed normals agree.
AGREEMENT = 0.5
#: Points this close to the surface are on the intended side of a thin wall [m].
ON_SURFACE = 0.001
#: Another order of the fingers fits much better if the sum of squares of its wrist problem is below
#: this fraction of the given order's. In 40 samples of `fast`, no true order lost to another one.
MUCH_LIKER = 0.5
#: Number of other orders for which the wrist problem is solved; all of them for three fingers.
MOST_ORDERS = 5
#: Units that lengths may have been meant in, by their factors to metres.
_UNITS = {
    1.0: "",
    1e-3: "points in millimetres instead of metres",
    1e-2: "points in centimetres instead of metres",
    1e2: "points 100 times as large",
    1e3: "points 1000 times as large",
}
#: The hint about normals.
REVERSED = "normals that point the other way, out of the object"

#: A possible reading of the numbers: frame and unit in words, empty for the given ones, and the
#: resulting points (k, 3) [m] and unit normals (k, 3), or None, in {O}.
Reading: TypeAlias = tuple[str, str, Array, Array | None]


def _frames(grasp: PlacedGrasp, thing: PlacedObject) -> dict[str, Array]:
    """Return the poses X_OF (4, 4) of possible frames of the numbers; the given frame is first."""
    X_OT, given = invert_pose(thing.X_TO), grasp.attempt.X_TC
    frames = {
        "": grasp.X_OA(thing),
        "the object's frame (object)": np.eye(4),
        "the table's frame (table)": X_OT,
        "the world's frame": multiply(X_OT, invert_pose(X_WT)),
        "the mesh file's frame (mesh)": thing.model.X_OM,
    }
    frames |= {name: multiply(X_OT, X_TC) for name, X_TC in grasp.cameras.items()}
    if given is not None and not grasp.cameras:
        # A caller who gives the pose of a camera may mean another pose.
        X_CT = invert_pose(given[0])
        frames |= {
            "the inverse of X_TC": multiply(X_OT, X_CT),
            "the inverse of X_TC, which is the object's pose in the camera's frame": X_CT,
            "X_TC as the camera's pose in the object's frame": given[0],
        }
    return frames


def find_hints(
    grasp: PlacedGrasp, p_OQ: Array, nhat_Q_O: Array, *, fits: bool = False
) -> tuple[str, ...]:
    """Return hints on readings in which the contacts would fit much better.

    Args:
        grasp: The grasp on its object.
        p_OQ: (k, 3), contact points in {O} [m].
        nhat_Q_O: (k, 3), unit normals in {O}.
        fits: Whether the hand makes the contacts; then only their place may be wrong.
    """
    thing, hand = grasp.placed, load_hand(grasp.config.hand_source)
    fit = fit_surface(thing.model, p_OQ, nhat_Q_O)
    X_AO = invert_pose(grasp.X_OA(thing))
    p_AQ, nhat_Q_A = transform_points(X_AO, p_OQ), rotate_vectors(X_AO, nhat_Q_O)

    # If the points are elsewhere, neither normals nor fingers are informative.
    if fit.distance.max() > FAR:
        readings: list[Reading] = [
            (name, unit, transform_points(X_OF, factor * p_AQ), rotate_vectors(X_OF, nhat_Q_A))
            for name, X_OF in _frames(grasp, thing).items()
            for factor, unit in _UNITS.items()
        ]
        if place := _better_place(thing.model, fit, readings):
            return (place,)
    if fits:
        return ()
    return (*_turned(thing.model, fit, p_OQ, nhat_Q_O), *_reordered(hand, thing, p_OQ, nhat_Q_O))


def find_posture_hints(
    grasp: PlacedGrasp, thing: PlacedObject, posture: Posture
) -> tuple[tuple[str, ...], Array]:
    """Return hints on readings that bring the fingertips of a posture much closer to the object.

    Args:
        grasp: The grasp of the posture.
        thing: The object in its resting pose.
        posture: Wrist and joints, in {O} of this object.

    Returns:
        The hints, and the distances (m,) from the surface of the fingertips that the posture closes
        [m]. There are none for a palm pose alone, or if the hand's fingertips have no nominal
        contact points.
    """
    hand = load_hand(grasp.config.hand_source)
    try:
        p_GQ = _fingertips(hand, posture)
    except HandError:
        return (), np.zeros(0)

    def fingertips(X_OG: Array) -> tuple[Array, None]:
        return transform_points(X_OG, p_GQ), None

    p_OQ, _ = fingertips(posture.X_OG)
    fit = fit_surface(thing.model, p_OQ, np.zeros_like(p_OQ))
    # The final positions of the fingers of a palm pose alone are unknown.
    distance = np.zeros(0) if posture.q_grasp is None else fit.distance
    if fit.distance.mean() <= FAR:
        return (), distance

    # The position of the given pose: lengths in another unit move the palm with it.
    X_AG, X_OA, attempt = grasp.attempt.X_FG[0], grasp.X_OA(thing), grasp.attempt
    X_AL = multiply(X_AG, invert_pose(hand.palm_in(attempt.link))) if attempt.link else X_AG
    p_AL = X_AL[:3, 3]
    meant = dict[str, Array]()
    if attempt.X_FG_xyzw is not None and np.isfinite(attempt.X_FG_xyzw).all():
        meant["quaternions x, y, z, w instead of w, x, y, z"] = attempt.X_FG_xyzw[0]
    if not attempt.link:
        at_link = f"poses of the palm link instead of the palm (link: {hand.palm_link})"
        meant[at_link] = multiply(X_AG, hand.X_BG)
    for name in hand.frames:
        if name != attempt.link:
            at_tool = f"poses in the frame of {name} (link: {name})"
            meant[at_tool] = multiply(X_AL, hand.palm_in(name))
    readings: list[Reading] = [
        (text, "", *fingertips(multiply(X_OA, X))) for text, X in meant.items()
    ]
    for name, X_OF in _frames(grasp, thing).items():
        for factor, unit in _UNITS.items():
            X = X_AG.copy()
            X[:3, 3] += (factor - 1.0) * p_AL
            readings.append((name, unit, *fingertips(multiply(X_OF, X))))
    place = _better_place(thing.model, fit, readings).replace("points", "positions of the palm")
    return (place,) if place else (), distance


def count_hints(hints: Iterable[tuple[str, ...]]) -> list[tuple[str, int]]:
    """Return the hints of many grasps with their counts, the most frequent first."""
    return Counter(hint for each in hints for hint in each).most_common()


def _better_place(model: ObjectModel, fit: Table, readings: Iterable[Reading]) -> str:
    """Return the frame and unit in which far points are near the surface; empty if there is none.

    Of several readings, one that changes only frame or unit wins, then the closest one.
    """
    limit, found = min(MUCH_NEARER * fit.distance.mean(), FAR), list[tuple[bool, float, str]]()
    for frame, unit, points, normals in readings:
        shrunk = normals is not None and np.ptp(points, axis=0).max() < LEAST_SPREAD
        if shrunk or not (frame or unit):
            continue
        there = fit_surface(model, points, np.zeros_like(points) if normals is None else normals)
        # Another unit does not turn normals, so they are not informative for it.
        agrees = normals is None or not frame or there.agreement.mean() > AGREEMENT
        if there.distance.mean() <= limit and agrees:
            text = ", with ".join(filter(None, (frame, unit)))
            found.append((bool(frame and unit), float(there.distance.max()), text))
    return min(found, key=lambda each: each[:2])[2] if found else ""


def _fingertips(hand: Hand, posture: Posture) -> Array:
    """Return the nominal contact points p_GQ (m, 3) of the fingers that a posture closes.

    A palm pose alone closes the hand until something stops it; here it is treated as half closed.

    Raises:
        HandError: If the hand has fingertips without such points.
    """
    index = {name: i for i, name in enumerate(joint_order(hand))}
    q = posture.q_grasp
    if q is None:
        spread, closing = start_of(posture, hand).spread, coordinate_limits(hand)[1:].mean(axis=1)
    else:
        spread = float(q[index[hand.spread.joints[0]]]) if hand.spread.joints else 0.0
        closing = np.array([q[index[finger.closing_joint]] for finger in hand.fingers])
    X_GF = fingertip_poses(hand, spread=spread, closing=closing)
    points = np.einsum("kab,kb->ka", X_GF[:, :3, :3], hand_constants(hand).pad_points)
    unused = unused_fingers(hand.unused_in(preshape_index(hand, posture.preshape)), len(points))
    return np.asarray((points + X_GF[:, :3, 3])[~unused])


def _turned(model: ObjectModel, fit: Table, p_OQ: Array, nhat_Q_O: Array) -> Iterator[str]:
    """Yield the hint that the normals point inwards, if they do."""
    given, other = fit.agreement.mean(), fit_surface(model, p_OQ, -nhat_Q_O).agreement.mean()
    # Next to a thin wall both sides are near; then only points on the surface are informative.
    if fit.distance.max() < ON_SURFACE:
        given = np.sum(nhat_Q_O * fit.normals, axis=1).mean()
        other = -given
    if given < 0.0 and other > AGREEMENT:
        yield REVERSED


def _reordered(hand: Hand, thing: PlacedObject, p_OQ: Array, nhat_Q_O: Array) -> Iterator[str]:
    """Yield the order of the fingers in which the hand reaches the contacts best, if much better.

    The table of postures is coarse and permits palms below the table, where the mirror image of an
    order fits as well. So it only chooses the orders that the wrist problem is solved for.
    """
    postures, X_TO = make_postures(hand), thing.X_TO_simulated
    given, *others = permutations(range(hand.num_fingers))  # 6 for three fingers, 120 for five
    likely = sorted(
        others, key=lambda order: posture_misfit(postures, p_OQ[[*order]], nhat_Q_O[[*order]])
    )
    reach = {
        order: fit_wrist(
            hand, p_OQ[[*order]], nhat_Q_O[[*order]], up_O=X_TO[2, :3], height=float(X_TO[2, 3])
        )[0].objective
        for order in (given, *likely[:MOST_ORDERS])
    }
    best = min(reach, key=lambda order: reach[order])
    if reach[best] < MUCH_LIKER * reach[given]:
        yield f"contacts in the order {' '.join(str(i + 1) for i in best)} of the fingers"
