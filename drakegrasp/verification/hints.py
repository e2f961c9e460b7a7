"""Possible faults in the numbers of a grasp that fails; hints do not change a verdict.

Input: a placed grasp. Output: how its contacts lie on the surface, and readings of the same numbers
that would fit much better: in a different frame or unit, with reversed normals, or with the fingers
in a different order. All factors are own choices.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from itertools import permutations

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
    1e-3: "{points} in millimetres instead of metres",
    1e-2: "{points} in centimetres instead of metres",
    1e2: "{points} 100 times as large",
    1e3: "{points} 1000 times as large",
}


@dataclass(frozen=True, kw_only=True)
class Reading:
    """A way to read the numbers of a grasp, in which it would fit much better.

    Attributes:
        frame: Frame of the numbers, or what a pose means, in words; empty for the given one.
        factor: Factor of lengths to metres.
        palm: Whether the lengths are positions of the palm, and not points.
        reversed: Whether the normals point the other way.
        order: Indices of the fingers; empty for the given order.
    """

    frame: str = ""
    factor: float = 1.0
    palm: bool = False
    reversed: bool = False
    order: tuple[int, ...] = ()

    @property
    def text(self) -> str:
        """The reading in words, a part of a sentence."""
        points = "positions of the palm" if self.palm else "points"
        facts = [self.frame, _UNITS[self.factor].format(points=points)]
        if self.reversed:
            facts.append("normals that point the other way, out of the object")
        if self.order:
            fingers = " ".join(str(i + 1) for i in self.order)
            facts.append(f"contacts in the order {fingers} of the fingers")
        return ", with ".join(filter(None, facts))


def contact_readings(grasp: PlacedGrasp, nhat_Q_O: Array, *, fits: bool) -> tuple[Reading, ...]:
    """Return readings in which the contacts of a grasp would fit much better.

    Args:
        grasp: The grasp on its object.
        nhat_Q_O: (k, 3), its rounded normals in {O}.
        fits: Whether the hand makes the contacts; then only their place may be wrong.
    """
    placed, (p_OQ, _) = grasp.placed, grasp.in_object_frame()
    surface = fit_surface(placed.model, p_OQ, nhat_Q_O)
    X_AO = invert_pose(grasp.X_OA(placed))
    p_AQ, nhat_Q_A = transform_points(X_AO, p_OQ), rotate_vectors(X_AO, nhat_Q_O)

    # If the points are elsewhere, neither normals nor fingers are informative.
    if surface.distance.max() > FAR:
        better = _better_place(
            placed.model,
            surface,
            _frames(grasp, placed),
            lambda X_OF, factor: (
                transform_points(X_OF, factor * p_AQ),
                rotate_vectors(X_OF, nhat_Q_A),
            ),
        )
        if better:
            return (better,)
    if fits:
        return ()
    turned = _points_inwards(placed.model, surface, p_OQ, nhat_Q_O)
    order = _better_order(load_hand(grasp.config.hand_source), placed, p_OQ, nhat_Q_O)
    return (
        *([Reading(reversed=True)] if turned else []),
        *([Reading(order=order)] if order else []),
    )


def posture_readings(
    grasp: PlacedGrasp, placed: PlacedObject, posture: Posture
) -> tuple[tuple[Reading, ...], Array]:
    """Return readings that bring the fingertips of a posture much closer to the object.

    Args:
        grasp: The grasp of the posture.
        placed: The object in its resting pose.
        posture: Wrist and joints, in {O} of this object.

    Returns:
        The readings, and the distances (m,) from the surface of the fingertips that the posture
        closes [m]. There are none for a palm pose alone, or if the hand's fingertips have no
        nominal contact points.
    """
    hand = load_hand(grasp.config.hand_source)
    try:
        p_GQ = fingertips(hand, posture)
    except HandError:
        return (), np.zeros(0)
    p_OQ = transform_points(posture.X_OG, p_GQ)
    surface = fit_surface(placed.model, p_OQ, np.zeros_like(p_OQ))
    # The final positions of the fingers of a palm pose alone are unknown.
    distance = np.zeros(0) if posture.q_grasp is None else surface.distance
    if surface.distance.mean() <= FAR:
        return (), distance

    # Other meanings of the pose in the given frame.
    X_AG, X_OA = grasp.X_AG, grasp.X_OA(placed)
    assert X_AG is not None
    X_AL = multiply(X_AG, invert_pose(hand.palm_in(grasp.link))) if grasp.link else X_AG
    meant = dict[str, Array]()
    if grasp.X_AG_xyzw is not None:
        meant["quaternions x, y, z, w instead of w, x, y, z"] = grasp.X_AG_xyzw
    if not grasp.link:
        at_link = f"poses of the palm link instead of the palm (link: {hand.palm_link})"
        meant[at_link] = multiply(X_AG, hand.X_BG)
    for name in hand.frames:
        if name != grasp.link:
            at_tool = f"poses in the frame of {name} (link: {name})"
            meant[at_tool] = multiply(X_AL, hand.palm_in(name))

    # The position of the given pose: lengths in another unit move the palm with it.
    def at(X_OF: Array, factor: float) -> tuple[Array, None]:
        X_FG = X_AG.copy()
        X_FG[:3, 3] += (factor - 1.0) * X_AL[:3, 3]
        return transform_points(multiply(X_OF, X_FG), p_GQ), None

    better = _better_place(
        placed.model,
        surface,
        _frames(grasp, placed),
        at,
        others={n: transform_points(multiply(X_OA, X), p_GQ) for n, X in meant.items()},
    )
    return ((better,) if better else ()), distance


def count_hints(hints: Iterable[tuple[str, ...]]) -> list[tuple[str, int]]:
    """Return the hints of many grasps with their counts, the most frequent first."""
    return Counter(hint for each in hints for hint in each).most_common()


def _frames(grasp: PlacedGrasp, placed: PlacedObject) -> dict[str, Array]:
    """Return the poses X_OF (4, 4) of possible frames of the numbers; the given frame is first."""
    X_OT = invert_pose(placed.X_TO)
    frames = {
        "": grasp.X_OA(placed),
        "the object's frame (object)": np.eye(4),
        "the table's frame (table)": X_OT,
        "the world's frame": multiply(X_OT, invert_pose(X_WT)),
        "the mesh file's frame (mesh)": placed.model.X_OM,
    }
    frames |= {name: multiply(X_OT, X_TC) for name, X_TC in grasp.cameras.items()}
    if grasp.X_TC is not None and not grasp.cameras:
        # A caller who gives the pose of a camera may mean another pose.
        X_CT = invert_pose(grasp.X_TC)
        frames |= {
            "the inverse of X_TC": multiply(X_OT, X_CT),
            "the inverse of X_TC, which is the object's pose in the camera's frame": X_CT,
            "X_TC as the camera's pose in the object's frame": grasp.X_TC,
        }
    return frames


def _better_place(
    model: ObjectModel,
    given: Table,
    frames: Mapping[str, Array],
    read: Callable[[Array, float], tuple[Array, Array | None]],
    others: Mapping[str, Array] | None = None,
) -> Reading | None:
    """Return the frame and unit in which far points are near the surface; None if there is none.

    Of several readings, one that changes only frame or unit wins, then the closest one.

    Args:
        model: The object.
        given: How the given points lie on the surface, see `fit_surface`.
        frames: Poses X_OF (4, 4) of possible frames, by their names.
        read: Returns points (k, 3) [m] and normals (k, 3) in {O}, or no normals, for the pose of a
            frame and the factor of a unit.
        others: For postures: points (k, 3) [m] in {O} by other meanings of the palm's pose.
    """
    limit, palm = min(MUCH_NEARER * given.distance.mean(), FAR), others is not None
    found = list[tuple[bool, float, Reading]]()
    readings: list[tuple[Reading, Array, Array | None]] = [
        (Reading(frame=name, palm=palm), points, None) for name, points in (others or {}).items()
    ]
    readings += [
        (Reading(frame=name, factor=factor, palm=palm), *read(X_OF, factor))
        for name, X_OF in frames.items()
        for factor in _UNITS
    ]
    for reading, points, normals in readings:
        frame, other_unit = reading.frame, reading.factor != 1.0
        shrunk = normals is not None and np.ptp(points, axis=0).max() < LEAST_SPREAD
        if shrunk or not (frame or other_unit):
            continue
        there = fit_surface(model, points, np.zeros_like(points) if normals is None else normals)
        # Another unit does not turn normals, so they are not informative for it.
        agrees = normals is None or not frame or there.agreement.mean() > AGREEMENT
        if there.distance.mean() <= limit and agrees:
            found.append((bool(frame and other_unit), float(there.distance.max()), reading))
    return min(found, key=lambda each: each[:2])[2] if found else None


def fingertips(hand: Hand, posture: Posture) -> Array:
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


def _points_inwards(model: ObjectModel, surface: Table, p_OQ: Array, nhat_Q_O: Array) -> bool:
    """Return whether the normals point into the object."""
    given, other = surface.agreement.mean(), fit_surface(model, p_OQ, -nhat_Q_O).agreement.mean()
    # Next to a thin wall both sides are near; then only points on the surface are informative.
    if surface.distance.max() < ON_SURFACE:
        given = np.sum(nhat_Q_O * surface.normals, axis=1).mean()
        other = -given
    return bool(given < 0.0 and other > AGREEMENT)


def _better_order(
    hand: Hand, placed: PlacedObject, p_OQ: Array, nhat_Q_O: Array
) -> tuple[int, ...] | None:
    """Return the order of the fingers in which the hand reaches the contacts much better.

    The table of postures is coarse and permits palms below the table, where the mirror image of an
    order fits as well. So it only chooses the orders that the wrist problem is solved for.
    """
    postures, X_TO = make_postures(hand), placed.X_TO_simulated
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
    return best if reach[best] < MUCH_LIKER * reach[given] else None
