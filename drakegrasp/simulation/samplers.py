"""Palm poses of the paper's rotations, and of user-defined samplers.

The paper's poses are products of global and local rotations with a first palm pose. The module
computes the distinct valid poses X_OG in a fixed order, from the half extents of an object's box,
its resting pose, and the angles. Relative to the size of the box they are the same for all objects.
Without jitter, the hundreds of thousands of combinations are therefore compared only once per
process.

A class that the user gives as `file.py:Name` yields its own poses, alone or with the shape of the
hand. Both are checked; docs/how-to/own-sampler.md has an example.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from itertools import count
from numbers import Real
from typing import Any

import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import dot, multiply, norm, sin_cos_deg
from drakegrasp.config import CandidateConfig
from drakegrasp.errors import ConfigError, GraspError, listed
from drakegrasp.frames import Array, read_pose
from drakegrasp.hand.description import Hand
from drakegrasp.hand.kinematics import coordinate_limits
from drakegrasp.registry import run_own
from drakegrasp.seeding import Stream
from drakegrasp.simulation.palms import Shape

#: The first palm's axes in {O}: +Gz points down at the object, Gx = Ox.
R_OG0 = np.diag([1.0, -1.0, -1.0])
#: Two poses are the same if they agree to this in each rotation entry, and in position relative to
#: the object's size. Different Euler angles give equal rotations only up to rounding.
SAME_POSE = 1e-6
#: A palm this far below the table, or a palm ray this far beside the bounding box, is still valid
#: [m]. This distance is far above rounding errors and too small to matter.
EDGE = 1e-6
#: A spread may be beyond its limits by this much [rad], and is then moved to the limit. This
#: distance is above the rounding of angles in files.
EDGE_SPREAD = 1e-6
#: Length at which a value in a message is cut.
LONGEST = 60
#: Number of combinations whose poses are computed together, which bounds the memory. With
#: `jitter_deg` it also decides which word of the stream jitters which angle, so another number
#: changes the draw.
CHUNK = 131_072
#: Bits of one rounded entry (-1e6 to 1e6), and number of entries in one 64-bit integer.
BITS, PER_WORD = 21, 3

Numbers = npt.NDArray[np.int64]
#: The angles of three axes [degree].
Axes = tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]


def rotation_candidates(
    half_extents: npt.ArrayLike,
    X_TO: Array,
    config: CandidateConfig,
    stream: Stream,
) -> Array:
    """Return the distinct valid poses (n, 4, 4) of the paper's method.

    X_OG = R_global X_OG0 R_local, with R = Rx Ry Rz each. X_OG0 is on +Oz, as far from the box's
    centre as its corner, and looks at it (Veres et al., equation 1). A pose is valid if the palm's
    origin is above the table and the ray along +Gz meets the box, edges included. The poses are
    sorted as rounded integers by the entries of their rotations, row by row, and then by position.

    Args:
        half_extents: (3,), half extents of the box about the origin of {O} [m].
        X_TO: Resting pose (4, 4).
        config: The rotations; with `jitter_deg`, each angle gets a random addition.
        stream: Draws the jitter.
    """
    half, radius = np.asarray(half_extents, dtype=float), float(norm(half_extents))
    axes_global = (config.global_x_deg, config.global_y_deg, config.global_z_deg)
    axes_local = (config.local_x_deg, config.local_y_deg, config.local_z_deg)
    grids = _angle_grid(axes_global), _angle_grid(axes_local)

    # With jitter, the poses are drawn: compare the valid ones and keep the first of equal ones.
    if config.jitter_deg:
        rotations, positions = [], []
        for R_global, R_local in _jittered(*grids, config.jitter_deg, stream):
            p_OG = radius * R_global[:, :, 2]
            keep = np.flatnonzero(above_table(p_OG, X_TO))
            R_OG = multiply(R_global[keep] * np.diag(R_OG0), R_local[keep])
            hits = ray_meets_box(p_OG[keep], R_OG[:, :, 2], half)
            rotations.append(R_OG[hits])
            positions.append(p_OG[keep[hits]])
        R, p = np.concatenate(rotations), np.concatenate(positions)
        first = _distinct(_words(R, p / radius))
        return make_poses(R[first], p[first])

    # Without jitter, equal poses are equally valid: test only the first of each set.
    numbers = _distinct_combinations(axes_global, axes_local)
    R_global, R_local = map(_rotation_xyz, grids)
    p_OG, R_first = radius * R_global[:, :, 2], R_global * np.diag(R_OG0)
    i, j = np.divmod(numbers, len(R_local))
    keep = np.flatnonzero(above_table(p_OG, X_TO)[i])
    z_O = dot(R_first[i[keep]], R_local[j[keep], None, :, 2])
    keep = keep[ray_meets_box(p_OG[i[keep]], z_O, half)]
    i, j = i[keep], j[keep]
    return make_poses(multiply(R_first[i], R_local[j]), p_OG[i])


def make_poses(R: Array, p: Array) -> Array:
    """Return poses (n, 4, 4) of rotations (n, 3, 3) and positions (n, 3)."""
    poses = np.tile(np.eye(4), (len(R), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = R, p
    return poses


def above_table(p_OG: Array, X_TO: Array) -> npt.NDArray[np.bool_]:
    """Return whether points (n, 3) in {O} lie above the table or on it."""
    return dot(p_OG, X_TO[2, :3]) + X_TO[2, 3] > -EDGE


def ray_meets_box(p_OG: Array, z_O: Array, half: Array) -> npt.NDArray[np.bool_]:
    """Return whether rays from (n, 3) along (n, 3) meet the box of half extents (3,)."""
    # The slab test (Kay and Kajiya 1986) needs exact zeros, because it divides by them to get
    # infinity. Rounding may leave 1e-17 instead.
    direction = np.where(np.abs(z_O) < 1e-12, 0.0, z_O)
    wide = half + EDGE
    with np.errstate(divide="ignore", invalid="ignore"):
        t1, t2 = (-wide - p_OG) / direction, (wide - p_OG) / direction

    # 0/0, from a ray within a slab's face, is no constraint: fmax and fmin skip the NaN.
    entry = np.fmax.reduce(np.minimum(t1, t2), axis=1)
    leave = np.fmin.reduce(np.maximum(t1, t2), axis=1)
    return leave >= np.maximum(entry, 0.0)


# Combinations of angles


@lru_cache(maxsize=1)
def _distinct_combinations(global_deg: Axes, local_deg: Axes) -> Numbers:
    """Return the first combination (n,) of each distinct pose.

    Combination i m + j consists of the global rotation i and the local rotation j of m. The poses
    are in the order of `rotation_candidates`.
    """
    # Compare the poses of each chunk first, so that fewer poses are left to compare.
    R_global, R_local = (_rotation_xyz(_angle_grid(axes)) for axes in (global_deg, local_deg))
    total = len(R_global) * len(R_local)
    words, numbers = [], []
    for start in range(0, total, CHUNK):
        i, j = np.divmod(np.arange(start, min(start + CHUNK, total)), len(R_local))
        R_OG = multiply(R_global[i] * np.diag(R_OG0), R_local[j])
        key = _words(R_OG, R_global[i, :, 2])
        first = _distinct(key)
        words.append(key[first])
        numbers.append(start + first)

    # Compare the poses of all chunks; the earliest of equal poses is the first.
    number = np.concatenate(numbers)[_distinct(np.concatenate(words))]
    number.setflags(write=False)
    return number


def _words(R: Array, p: Array) -> Numbers:
    """Return poses as integers (n, 4) that are equal and sorted like their rounded entries.

    Args:
        R: Rotations (n, 3, 3).
        p: Positions (n, 3), relative to the object's size.
    """
    entries = np.rint(np.hstack([R.reshape(-1, 9), p]) / SAME_POSE).astype(np.int64)
    a, b, c = np.moveaxis((entries + (1 << BITS - 1)).reshape(-1, 4, 3), 2, 0)
    return np.asarray((a << 2 * BITS) | (b << BITS) | c)


def _distinct(words: Numbers) -> Numbers:
    """Return the first row (k,) of each set of equal rows (n, 4), sorted."""
    order = np.lexsort(words.T[::-1])
    new = np.ones(len(order), dtype=np.bool_)
    new[1:] = (words[order[1:]] != words[order[:-1]]).any(axis=1)
    return order[new]


def _jittered(
    grid_global: Array, grid_local: Array, jitter_deg: float, stream: Stream
) -> Iterator[tuple[Array, Array]]:
    """Yield R_global and R_local, (m, 3, 3) each, of all combinations, in chunks."""
    per_chunk = max(1, CHUNK // len(grid_local))
    for start in range(0, len(grid_global), per_chunk):
        block = grid_global[start : start + per_chunk]
        angles_global = np.repeat(block, len(grid_local), axis=0)
        angles_local = np.tile(grid_local, (len(block), 1))
        drawn = np.floor(jitter_deg * stream.uniform(6 * len(angles_global)))
        jitter_global, jitter_local = drawn.reshape(2, -1, 3)
        angles_global, angles_local = angles_global + jitter_global, angles_local + jitter_local
        yield _rotation_xyz(angles_global), _rotation_xyz(angles_local)


def _angle_grid(axes_deg: Axes) -> Array:
    """Return all combinations (n, 3) of angles [degree]; 360 and 0 count once."""
    unique = [np.unique(np.mod(np.asarray(axis, dtype=float), 360.0)) for axis in axes_deg]
    return np.stack(np.meshgrid(*unique, indexing="ij"), axis=-1).reshape(-1, 3)


def _rotation_xyz(angles_deg: Array) -> Array:
    """Return Rx Ry Rz, (n, 3, 3), of angles (n, 3) [degree]."""
    (sx, sy, sz), (cx, cy, cz) = (np.moveaxis(f, -1, 0) for f in sin_cos_deg(angles_deg))
    rows = [
        [cy * cz, -cy * sz, sy],
        [cx * sz + sx * sy * cz, cx * cz - sx * sy * sz, -sx * cy],
        [sx * sz - cx * sy * cz, sx * cz + cx * sy * sz, cx * cy],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def checked_poses(method: str, sampler: Any, hand: Hand) -> Iterator[Array | tuple[Array, Shape]]:
    """Yield the palm poses of a sampler of the user or of another package, after checking them.

    Args:
        method: Name of the sampler in the configuration.
        sampler: The sampler.
        hand: The hand, to whose preshapes and limits the shapes are compared.

    Raises:
        ConfigError: If the sampler cannot be run, or yields something other than poses and shapes
            of the hand.
    """
    palms = run_own(method, lambda: iter(sampler.poses()))
    for i in count():
        palm = run_own(method, next, palms, None)
        if palm is None:
            return
        where = f"{method.partition('@')[0]}: pose {i}"
        if isinstance(palm, tuple) and len(palm) == 2:
            yield _pose(where, palm[0]), _shape(where, palm[1], hand)
        else:
            yield _pose(where, palm)


def _pose(name: str, X_OG: npt.ArrayLike) -> Array:
    """Return the yielded value as a pose (4, 4) with an exact rotation."""
    try:
        X = read_pose(X_OG, name)
    except GraspError as error:
        raise ConfigError(str(error)) from None
    if X.shape != (4, 4):
        raise ConfigError(f"{name} must be one pose, 4 x 4 numbers, got {len(X)} of them")
    return X


def _shape(name: str, shape: object, hand: Hand) -> Shape:
    """Return the yielded shape of a hand, with the index of its preshape."""
    if not isinstance(shape, tuple) or len(shape) != 2:
        got = type(shape).__name__
        raise ConfigError(f"{name} must have a shape (preshape, spread in rad), got {got}")

    # A hand with preshapes closes in one of them.
    preshape, spread = shape
    names, index = hand.preshape_names, preshape
    if isinstance(preshape, str) and preshape in names:
        index = names.index(preshape)
    known = (
        isinstance(index, int | np.integer) and 0 <= index < len(names) if names else index is None
    )
    if not known:
        must = f"one of {listed(names)}, or its index," if names else "None"
        raise ConfigError(
            f"{name}: preshape must be {must} for the hand {hand.name}, got {_said(preshape)}"
        )

    low, high = coordinate_limits(hand.at(index))[0].tolist()
    if not isinstance(spread, Real) or not low - EDGE_SPREAD <= spread <= high + EDGE_SPREAD:
        raise ConfigError(
            f"{name}: spread must be {low:.3g} to {high:.3g} rad for the hand {hand.name}, got "
            f"{_said(spread)}"
        )
    return Shape(None if index is None else int(index), float(np.clip(float(spread), low, high)))


def _said(value: object) -> str:
    """Return a number as text, and anything else as its representation, in one short line."""
    text = f"{float(value):g}" if isinstance(value, Real) else repr(value)
    return " ".join(text.split())[:LONGEST]
