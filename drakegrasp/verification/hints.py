"""What may be wrong with the numbers of a grasp that fails; nothing is changed by it.

In: contacts in {O}, and the frame in which they were given. Out: hints in words. A hint says that
the same numbers, read in another way, would fit much better: lengths in another unit, the camera
of the dataset's other file, normals that point inwards, fingers in another order. All factors are
own choices.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from itertools import permutations

import numpy as np

from drakegrasp.frames import Array, invert_pose, rotate_vectors, transform_points
from drakegrasp.hand.description import Hand
from drakegrasp.objects.model import ObjectModel
from drakegrasp.verification.contact_surface import SurfaceFit, fit_surface
from drakegrasp.verification.wrist.initial_guesses import make_postures, posture_misfit

#: Another reading fits much better if its points are at most this share as far from the surface
#: (mean over the contacts), and not far, while the given ones are [m].
MUCH_NEARER, FAR = 0.25, 0.01
#: Contacts of a hand are at least so far apart [m]: any that shrink come close to a small object.
LEAST_SPREAD = 0.01
#: Normals point the wrong way if the mean cosine to those of the surface is below minus this, and
#: above this for the reversed ones.
REVERSED = 0.5
#: Another order of the fingers fits much better if its misfit to the hand's postures is at most
#: this share of the given one's.
MUCH_LIKER = 0.25
#: The units that a length may have been meant in, by the factors to metres.
_UNITS = {1e-3: "millimetres", 1e-2: "centimetres"}


def find_hints(
    model: ObjectModel, hand: Hand, p_OQ: Array, nhat_Q_O: Array, *, X_OA: Array, X_OB: Array | None
) -> tuple[str, ...]:
    """Return what would make contacts fit much better.

    Args:
        model: The object.
        hand: Of k fingers.
        p_OQ: (k, 3), contact points in {O} [m].
        nhat_Q_O: (k, 3), unit normals in {O}.
        X_OA: (4, 4), pose of the frame in which the contacts were given.
        X_OB: (4, 4), pose of the dataset's other camera; None if there is none.
    """
    fit = fit_surface(model, p_OQ, nhat_Q_O)
    # Where the points are elsewhere, neither normals nor fingers say anything.
    placed = list(_places(model, fit, p_OQ, nhat_Q_O, X_OA, X_OB))
    if placed:
        return tuple(placed)
    return (*_turned(model, fit, p_OQ, nhat_Q_O), *_reordered(hand, p_OQ, nhat_Q_O))


def count_hints(hints: Iterable[tuple[str, ...]]) -> list[tuple[str, int]]:
    """Return the hints of many grasps with how many have each, the most frequent first."""
    return Counter(hint for each in hints for hint in each).most_common()


def _places(
    model: ObjectModel,
    fit: SurfaceFit,
    p_OQ: Array,
    nhat_Q_O: Array,
    X_OA: Array,
    X_OB: Array | None,
) -> Iterator[str]:
    """Yield other units and the other camera, if the points are far away and would not be."""
    distance = fit.distance.mean()
    if distance < FAR:
        return
    X_AO = invert_pose(X_OA)
    p_AQ, nhat_Q_A = transform_points(X_AO, p_OQ), rotate_vectors(X_AO, nhat_Q_O)

    def fits(X: Array, points: Array) -> bool:
        there = fit_surface(model, transform_points(X, points), rotate_vectors(X, nhat_Q_A))
        near = there.distance.mean() <= min(MUCH_NEARER * distance, FAR)
        return bool(near and np.ptp(points, axis=0).max() >= LEAST_SPREAD)

    for factor, unit in _UNITS.items():
        if fits(X_OA, factor * p_AQ):
            yield f"points in {unit} instead of metres"
    if X_OB is not None and fits(X_OB, p_AQ):
        yield "the frame of the dataset's other camera"


def _turned(model: ObjectModel, fit: SurfaceFit, p_OQ: Array, nhat_Q_O: Array) -> Iterator[str]:
    """Yield that the normals point inwards, if they do."""
    if fit.agreement.mean() < -REVERSED:
        reversed_fit = fit_surface(model, p_OQ, -nhat_Q_O)
        if reversed_fit.agreement.mean() > REVERSED:
            yield "normals that point the other way, out of the object"


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
