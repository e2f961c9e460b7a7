"""Initial guesses for the wrist problem, from a table of hand postures.

In: a hand, k contact points and outward normals. Out: a few palm poses with joints whose nominal
fingertip contacts are close to the given ones. Distances and angles among contacts and normals do
not depend on the frame, so a tree finds the postures in which they are similar, and only those are
aligned with the contacts (our own construction).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import combinations

import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree

from drakegrasp.arithmetic import multiply
from drakegrasp.frames import Array, make_pose, rotation_about
from drakegrasp.hand.description import Hand
from drakegrasp.hand.kinematics import fingertip_poses
from drakegrasp.verification.wrist.hand_constants import hand_constants
from drakegrasp.verification.wrist.pads import signed_distance

#: Steps of the table's angles [rad]; closing steps are longer for hands with many fingers. Closing
#: joints that slide count in `Hand.closing_unit`.
SPREAD_STEP, CLOSING_STEP = np.deg2rad(11.25), np.deg2rad(8.0)
#: Least number of closing steps from the open hand to the limit: some fingers move by little.
LEAST_STEPS = 5
#: Most closing postures in the table.
MAX_CLOSINGS = 5000
#: Largest angles in the table [rad]: spread fingers point sideways, closed fingers make almost a
#: fist.
MAX_SPREAD, MAX_CLOSING = np.deg2rad(45.0), np.deg2rad(112.0)
#: Lever by which normals are weighed against points when contacts are compared [m].
LEVER = 0.02
#: Number of postures that are aligned with the contacts.
NEAREST = 96
#: Any two starts differ in some joint by more than this [rad], because contacts leave a family of
#: postures open.
DIFFERENT = np.deg2rad(14.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class Start:
    """A start for the wrist problem.

    Attributes:
        X_OG: (4, 4), palm pose.
        coordinates: (1 + m,), see `HandConstants.limits` [rad or m].
    """

    X_OG: Array
    coordinates: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class Postures:
    """N postures of a hand.

    Attributes:
        coordinates: (N, 1 + m), see `HandConstants.limits` [rad or m].
        p_GP: (N, k, 3), nominal contact points in {G} [m].
        n_G: (N, k, 3), outward pad normals there, in {G}.
        units: (1 + m,), what counts as a radian of each coordinate [rad or m].
        tree: Of their features, see `_features`.
    """

    coordinates: Array
    units: Array
    p_GP: Array
    n_G: Array
    tree: KDTree


@lru_cache(maxsize=4)
def make_postures(hand: Hand) -> Postures:
    """Return the table of a hand's postures."""
    # A grid of coordinates.
    constants = hand_constants(hand)
    lower, upper = constants.limits.T
    most, motors = MAX_CLOSING * constants.units, len(upper) - 1
    most[0] = MAX_SPREAD
    upper = np.minimum(upper, most)
    fewest = MAX_CLOSINGS ** (1.0 / motors) - 1.0
    step = max(CLOSING_STEP, MAX_CLOSING / fewest) * constants.units
    step[0] = SPREAD_STEP
    step[1:] = np.minimum(step[1:], (upper - lower)[1:] / min(LEAST_STEPS, fewest))
    axes = [np.arange(low, high + 1e-9, s) for low, high, s in zip(lower, upper, step, strict=True)]
    c = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 1 + motors)

    # The contacts of each posture: the points of the pads next to the pad points.
    X_GF = fingertip_poses(hand, spread=c[:, 0], closing=multiply(c[:, 1:], hand.closing_ratio.T))
    contact = signed_distance(constants.pads, constants.pad_points)
    on_pad = constants.pad_points - contact.distance[:, None] * contact.normal
    p_GP = np.einsum("nkab,kb->nka", X_GF[..., :3, :3], on_pad) + X_GF[..., :3, 3]
    n_G = np.einsum("nkab,kb->nka", X_GF[..., :3, :3], contact.normal)
    tree = KDTree(_features(p_GP, n_G))
    return Postures(coordinates=c, units=constants.units, p_GP=p_GP, n_G=n_G, tree=tree)


def find_starts(postures: Postures, p_OQ: Array, nhat_Q_O: Array, count: int) -> list[Start]:
    """Return up to `count` different starts, the best first.

    Args:
        postures: Of the hand.
        p_OQ: (k, 3), contact points [m].
        nhat_Q_O: (k, 3), outward unit normals.
        count: Most starts to return.
    """
    rows, X_OG, misfit = _nearest_postures(postures, p_OQ, nhat_Q_O)

    # The best of them that differ enough.
    starts: list[Start] = []
    for i in np.argsort(misfit, kind="stable"):
        c = postures.coordinates[rows[i]]
        distance = [np.abs((start.coordinates - c) / postures.units).max() for start in starts]
        if all(d > DIFFERENT for d in distance):
            starts.append(Start(X_OG=X_OG[i], coordinates=c))
        if len(starts) == count:
            break
    return starts


def posture_misfit(postures: Postures, p_OQ: Array, nhat_Q_O: Array) -> float:
    """Return how little contacts look like those of any posture: a sum of squares [m^2].

    Args:
        postures: Of the hand.
        p_OQ: (k, 3), contact points [m].
        nhat_Q_O: (k, 3), outward unit normals.
    """
    return float(_nearest_postures(postures, p_OQ, nhat_Q_O)[2].min())


def _nearest_postures(
    postures: Postures, p_OQ: Array, nhat_Q_O: Array
) -> tuple[npt.NDArray[np.int64], Array, Array]:
    """Return the rows of the postures with the most similar contacts, aligned, and the misfits."""
    # Pads face against the normals.
    nearest = min(NEAREST, len(postures.coordinates))
    _, rows = postures.tree.query(_features(p_OQ, -nhat_Q_O), k=np.arange(1, nearest + 1))
    X_OG, misfit = _align(postures.p_GP[rows], postures.n_G[rows], p_OQ, -nhat_Q_O)
    return rows, X_OG, misfit


def turned_starts(starts: Sequence[Start], p_OQ: Array, count: int) -> list[Start]:
    """Return starts turned about the line through two contacts, which leaves both where they are.

    Two contacts leave that turn open, and most of these palm poses would be within the object or
    the table. Those of one turn come together, the starts as they are first.

    Args:
        starts: For a hand of two fingers.
        p_OQ: (2, 3), the contact points [m].
        count: Number of turns, evenly over a full one.
    """
    centre, line = p_OQ.mean(axis=0), p_OQ[1] - p_OQ[0]
    axis = line / max(float(np.linalg.norm(line)), 1e-9)
    turned = []
    for angle in 2.0 * np.pi * np.arange(count) / count:
        R = rotation_about(axis, angle)
        X_OO = make_pose(R, centre - R @ centre)
        turned += [replace(start, X_OG=X_OO @ start.X_OG) for start in starts]
    return turned


def _features(p: Array, n: Array) -> Array:
    """Return features (..., f) [m] of contacts that do not depend on their frame.

    Args:
        p: (..., k, 3), points [m].
        n: (..., k, 3), unit normals.
    """
    # Distances, and angles of the normals to each other and to the line between the points.
    values = [np.zeros(p.shape[:-2])]
    for i, j in combinations(range(p.shape[-2]), 2):
        d = p[..., i, :] - p[..., j, :]
        length = np.linalg.norm(d, axis=-1)
        away = d / np.maximum(length, 1e-6)[..., None]
        values += [
            length,
            LEVER * np.sum(n[..., i, :] * n[..., j, :], axis=-1),
            LEVER * np.sum(away * n[..., i, :], axis=-1),
            LEVER * np.sum(away * n[..., j, :], axis=-1),
        ]
    if p.shape[-2] >= 3:
        # Distances and angles are the same for mirror images; the side of the triangle is not.
        across = np.cross(p[..., 1, :] - p[..., 0, :], p[..., 2, :] - p[..., 0, :])
        across /= np.maximum(np.linalg.norm(across, axis=-1), 1e-9)[..., None]
        values += [LEVER * np.sum(across * n[..., i, :], axis=-1) for i in range(p.shape[-2])]
    return np.stack(values, axis=-1)


def _align(p_GP: Array, n_G: Array, p_OQ: Array, n_O: Array) -> tuple[Array, Array]:
    """Return the palm poses that bring N sets of contacts closest to the given ones.

    Kabsch (1976), on the points and on points `LEVER` along the normals: with the centred sets A
    and B as rows, AᵀB = U Σ Vᵀ, the sum Σ_i |R a_i + p − b_i|² is smallest for

        R = V diag(1, 1, det(U Vᵀ)) Uᵀ,   p = mean(b) − R mean(a).

    Args:
        p_GP: (N, k, 3), points of the postures in {G} [m].
        n_G: (N, k, 3), normals of the pads in {G}.
        p_OQ: (k, 3), points to meet in {O} [m].
        n_O: (k, 3), normals that the pads should have in {O}.

    Returns:
        Poses X_OG (N, 4, 4), and the sums of squared distances (N,) [m^2].
    """
    # Rotations between the centred sets, without mirror images.
    A = np.concatenate([p_GP, p_GP + LEVER * n_G], axis=-2)
    B = np.concatenate([p_OQ, p_OQ + LEVER * n_O], axis=-2)
    centre_A, centre_B = A.mean(axis=-2, keepdims=True), B.mean(axis=-2)
    U, _, Vt = np.linalg.svd(np.swapaxes(A - centre_A, -1, -2) @ (B - centre_B))
    mirrored = np.linalg.det(U @ Vt) < 0.0
    V = np.swapaxes(Vt, -1, -2)
    V[mirrored, :, 2] *= -1.0
    R = V @ np.swapaxes(U, -1, -2)

    # Translations, and what distance remains.
    p = centre_B - np.einsum("nab,nb->na", R, centre_A[:, 0])
    misfit = np.sum((A @ np.swapaxes(R, -1, -2) + p[:, None] - B) ** 2, axis=(-1, -2))
    X = np.tile(np.eye(4), (len(R), 1, 1))
    X[:, :3, :3], X[:, :3, 3] = R, p
    return X, misfit
