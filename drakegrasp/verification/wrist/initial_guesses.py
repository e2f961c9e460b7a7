"""Where to start the wrist problem: a table of hand postures, searched by shape of contacts.

In: a hand, k contact points and outward normals. Out: a few palm poses with joints whose
nominal fingertip contacts come closest to them. Distances and angles among contacts and
normals do not depend on the frame, so postures with the right ones are found in a tree
first, and only those are laid over the contacts (own construction).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations

import numpy as np
from scipy.spatial import KDTree

from drakegrasp.frames import Array
from drakegrasp.hand.description import Hand
from drakegrasp.hand.kinematics import coordinate_limits, fingertip_poses
from drakegrasp.verification.wrist.pads import touch
from drakegrasp.verification.wrist.problem import hand_constants

#: Steps of the table's angles [rad]; closing steps are longer where fingers are many.
SPREAD_STEP, CLOSING_STEP = np.deg2rad(11.25), np.deg2rad(8.0)
#: Closing postures of the table at most.
MAX_CLOSINGS = 5000
#: The table ends where fingers are almost in the fist, and where spread fingers look sideways.
MAX_SPREAD, MAX_CLOSING = np.deg2rad(45.0), np.deg2rad(112.0)
#: What a right angle counts as when contacts are compared [m].
LEVER = 0.02
#: Postures that are laid over the contacts.
NEAREST = 96
#: Starts differ in some joint by more than this [rad]: contacts alone leave postures open.
DIFFERENT = np.deg2rad(14.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class Start:
    """A palm pose (4, 4) and coordinates (1 + k,) [rad] to start from."""

    X_OG: Array
    coordinates: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class Postures:
    """N postures of a hand.

    Attributes:
        coordinates: (N, 1 + k) [rad].
        p_GP: (N, k, 3), nominal contact points [m].
        n_G: (N, k, 3), outward pad normals there.
        tree: Of their features.
    """

    coordinates: Array
    p_GP: Array
    n_G: Array
    tree: KDTree


@lru_cache(maxsize=4)
def make_postures(hand: Hand) -> Postures:
    """Return the postures of a hand."""
    constants = hand_constants(hand)
    lower, upper = coordinate_limits(hand).T
    most = np.r_[MAX_SPREAD, np.full(hand.num_fingers, MAX_CLOSING)]
    fewest = MAX_CLOSINGS ** (1.0 / hand.num_fingers) - 1.0
    step = np.r_[SPREAD_STEP, np.full(hand.num_fingers, max(CLOSING_STEP, MAX_CLOSING / fewest))]
    axes = [
        np.arange(low, min(high, limit) + 1e-9, s)
        for low, high, limit, s in zip(lower, upper, most, step, strict=True)
    ]
    c = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 1 + hand.num_fingers)
    X_GF = fingertip_poses(hand, spread=c[:, 0], closing=c[:, 1:])
    contact = touch(constants.pads, constants.pad_points)
    on_pad = constants.pad_points - contact.distance[:, None] * contact.normal
    p_GP = np.einsum("nkab,kb->nka", X_GF[..., :3, :3], on_pad) + X_GF[..., :3, 3]
    n_G = np.einsum("nkab,kb->nka", X_GF[..., :3, :3], contact.normal)
    return Postures(coordinates=c, p_GP=p_GP, n_G=n_G, tree=KDTree(_features(p_GP, n_G)))


def find_starts(postures: Postures, p_OQ: Array, nhat_Q_O: Array, count: int) -> list[Start]:
    """Return up to `count` different starts for contacts (k, 3) [m], (k, 3), best first."""
    nearest = min(NEAREST, len(postures.coordinates))
    _, found = postures.tree.query(_features(p_OQ, -nhat_Q_O), k=np.arange(1, nearest + 1))
    X_OG, misfit = _lay_over(postures.p_GP[found], postures.n_G[found], p_OQ, -nhat_Q_O)
    starts: list[Start] = []
    for i in np.argsort(misfit, kind="stable"):
        c = postures.coordinates[found[i]]
        if all(np.abs(start.coordinates - c).max() > DIFFERENT for start in starts):
            starts.append(Start(X_OG=X_OG[i], coordinates=c))
        if len(starts) == count:
            break
    return starts


def _features(p: Array, n: Array) -> Array:
    """Return lengths (..., f) [m] that tell how points and normals (..., k, 3) are arranged."""
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
        # Lengths and angles do not know left from right; the side of the triangle does.
        across = np.cross(p[..., 1, :] - p[..., 0, :], p[..., 2, :] - p[..., 0, :])
        across /= np.maximum(np.linalg.norm(across, axis=-1), 1e-9)[..., None]
        values += [LEVER * np.sum(across * n[..., i, :], axis=-1) for i in range(p.shape[-2])]
    return np.stack(values, axis=-1)


def _lay_over(p_GP: Array, n_G: Array, p_OQ: Array, n_O: Array) -> tuple[Array, Array]:
    """Return the poses (N, 4, 4) that bring N sets of contacts closest to one, and the misfits.

    Kabsch (1976) on the points and on points `LEVER` along the normals.
    """
    A = np.concatenate([p_GP, p_GP + LEVER * n_G], axis=-2)
    B = np.concatenate([p_OQ, p_OQ + LEVER * n_O], axis=-2)
    centre_A, centre_B = A.mean(axis=-2, keepdims=True), B.mean(axis=-2)
    U, _, Vt = np.linalg.svd(np.swapaxes(A - centre_A, -1, -2) @ (B - centre_B))
    mirrored = np.linalg.det(U @ Vt) < 0.0
    V = np.swapaxes(Vt, -1, -2)
    V[mirrored, :, 2] *= -1.0
    R = V @ np.swapaxes(U, -1, -2)
    p = centre_B - np.einsum("nab,nb->na", R, centre_A[:, 0])
    misfit = np.sum((A @ np.swapaxes(R, -1, -2) + p[:, None] - B) ** 2, axis=(-1, -2))
    X = np.tile(np.eye(4), (len(R), 1, 1))
    X[:, :3, :3], X[:, :3, 3] = R, p
    return X, misfit
