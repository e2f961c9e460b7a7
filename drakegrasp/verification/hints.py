"""Possible faults in the contacts of a grasp that fails; hints do not change a verdict.

Input: a placed grasp. Output: how its contacts lie on the surface, and ways to read the same
numbers that would fit much better, in words: in a different frame or unit, with reversed normals,
or with the fingers in a different order. All factors are own choices.
"""

from __future__ import annotations

from itertools import permutations

import numpy as np

from drakegrasp.arithmetic import multiply
from drakegrasp.frames import X_WT, Array, invert_pose, rotate_vectors, transform_points
from drakegrasp.hand.description import load_hand
from drakegrasp.objects.model import ObjectModel
from drakegrasp.table import Table
from drakegrasp.verification.placing import PlacedGrasp
from drakegrasp.verification.prediction import surface_feet
from drakegrasp.verification.wrist_solver import fit_wrist, make_postures, posture_misfit

#: A face may be farther than the closest one by this and still be next to the point [m]. A
#: predicted point is as often on the wrong side of a cup's wall as beside the wall.
WALL = 0.005
#: Contacts are misplaced if one of them is farther from the surface than this [m].
FAR = 0.01
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
UNITS = {
    1.0: "",
    1e-3: "points in millimetres instead of metres",
    1e-2: "points in centimetres instead of metres",
    1e2: "points 100 times as large",
    1e3: "points 1000 times as large",
}


def fit_surface(model: ObjectModel, p_OQ: Array, nhat_Q_O: Array) -> Table:
    """Return how k contacts lie on the surface that the hand meets.

    A predicted point may be beside an edge or on the wrong side of a thin wall. So each face that
    is at most `WALL` farther than the closest one is "next to" the point.

    Args:
        model: The object.
        p_OQ: (k, 3), points in {O} [m].
        nhat_Q_O: (k, 3), unit normals in {O}.

    Returns:
        A table of k rows. `distance` (k,) is the distance of the points from the surface [m], and
        `normals` (k, 3) are the outward normals of the closest faces. `agreement` (k,) is the
        largest cosine between each normal and the outward normal of a face next to its point; it is
        negative if the normal points inwards.
    """
    feet = surface_feet(model.collision.triangles, p_OQ)
    distances = np.linalg.norm(feet - p_OQ[:, None], axis=2)
    face = distances.argmin(axis=1)
    nearest = distances[np.arange(len(p_OQ)), face]
    cosine = nhat_Q_O @ model.collision.face_normals.T
    return Table(
        distance=nearest,
        normals=model.collision.face_normals[face],
        agreement=np.where(distances <= nearest[:, None] + WALL, cosine, -1.0).max(axis=1),
    )


def find_hints(grasp: PlacedGrasp, nhat_Q_O: Array, *, fits: bool) -> tuple[str, ...]:
    """Return readings in which the contacts of a grasp would fit much better, each in words.

    Args:
        grasp: The contacts on their object.
        nhat_Q_O: (k, 3), the rounded normals in {O}.
        fits: Whether the hand makes the contacts; then only their place may be wrong.
    """
    model, (p_OQ, _) = grasp.placed.model, grasp.in_object_frame()
    surface = fit_surface(model, p_OQ, nhat_Q_O)
    # If the points are elsewhere, neither normals nor fingers are informative.
    if surface.distance.max() > FAR and (better := _better_place(grasp, surface)):
        return (better,)
    if fits:
        return ()

    # Next to a thin wall both sides are near; then only points on the surface are informative.
    given = surface.agreement.mean()
    other = fit_surface(model, p_OQ, -nhat_Q_O).agreement.mean()
    if surface.distance.max() < ON_SURFACE:
        given = np.sum(nhat_Q_O * surface.normals, axis=1).mean()
        other = -given
    hints = list[str]()
    if given < 0.0 and other > AGREEMENT:
        hints.append("normals that point the other way, out of the object")
    if order := _better_order(grasp, p_OQ, nhat_Q_O):
        fingers = " ".join(str(i + 1) for i in order)
        hints.append(f"contacts in the order {fingers} of the fingers")
    return tuple(hints)


def _better_place(grasp: PlacedGrasp, given: Table) -> str:
    """Return the frame and unit in which far points are near the surface; empty if none is.

    Of several readings, one that changes only frame or unit wins, then the closest one.

    Args:
        grasp: The contacts on their object.
        given: How they lie on the surface, see `fit_surface`.
    """
    model, X_OT = grasp.placed.model, invert_pose(grasp.placed.X_TO)
    frames = {
        "": grasp.X_OA,
        "the object's frame (object)": np.eye(4),
        "the table's frame (table)": X_OT,
        "the world's frame (world)": multiply(X_OT, invert_pose(X_WT)),
        "the mesh file's frame (mesh)": model.X_OM,
        **{name: multiply(X_OT, X_TC) for name, X_TC in grasp.cameras.items()},
    }
    found = list[tuple[bool, float, str]]()
    for frame, X_OF in frames.items():
        for factor, unit in UNITS.items():
            points = transform_points(X_OF, factor * grasp.p_AQ)
            if not (frame or unit) or np.ptp(points, axis=0).max() < LEAST_SPREAD:
                continue
            there = fit_surface(model, points, rotate_vectors(X_OF, grasp.nhat_Q_A))
            # Another unit does not turn normals, so they are not informative for it.
            agrees = not frame or there.agreement.mean() > AGREEMENT
            near = there.distance.mean() <= min(MUCH_NEARER * given.distance.mean(), FAR)
            if near and agrees:
                text = ", with ".join(filter(None, (frame, unit)))
                found.append((bool(frame and unit), float(there.distance.max()), text))
    return min(found, key=lambda each: each[:2])[2] if found else ""


def _better_order(grasp: PlacedGrasp, p_OQ: Array, nhat_Q_O: Array) -> tuple[int, ...] | None:
    """Return the order of the fingers in which the hand reaches the contacts much better.

    The table of postures is coarse and permits palms below the table, where the mirror image of an
    order fits as well. So it only chooses the orders that the wrist problem is solved for.
    """
    hand = load_hand(grasp.config.hand_source)
    postures, X_TO = make_postures(hand), grasp.placed.X_TO_simulated
    given, *others = permutations(range(hand.num_fingers))  # 6 for three fingers, 120 for five
    likely = sorted(
        others, key=lambda order: posture_misfit(postures, p_OQ[[*order]], nhat_Q_O[[*order]])
    )
    reach = {
        order: fit_wrist(hand, p_OQ[[*order]], nhat_Q_O[[*order]], X_TO)[0].objective
        for order in (given, *likely[:MOST_ORDERS])
    }
    best = min(reach, key=lambda order: reach[order])
    return best if reach[best] < MUCH_LIKER * reach[given] else None
