"""Stage "sample": palm poses about an object, and the attempts that follow from them.

In: the object's box and mesh, and how it rests on the table. Out: up to
`candidates.max` distinct palm poses X_OG and, for each, where its palm ray meets the
object. The paper's method (`rotations`) multiplies a first palm pose with global and
local rotations; `normals` is the baseline of its Figure 2.

Nothing here needs Drake: everything is vectorised NumPy, and embree casts the rays.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import trimesh
from scipy.spatial.transform import Rotation

from drakegrasp.config import CandidateConfig
from drakegrasp.frames import Array, make_pose
from drakegrasp.objects.model import ObjectModel
from drakegrasp.seeding import object_key

#: The first palm's axes in {O}: +Gz looks down onto the object, Gx = Ox.
R_OG0 = np.diag([1.0, -1.0, -1.0])
#: Poses that agree to this in every rotation entry, and in position relative to the
#: object's size, are one pose: Euler products repeat themselves up to rounding.
SAME_POSE = 1e-6
#: Combinations whose poses are computed at a time; bounds the memory.
CHUNK = 131_072


@dataclass(frozen=True, kw_only=True, eq=False)
class Candidates:
    """Palm poses of one object.

    Attributes:
        X_OG: (n, 4, 4), the drawn poses, in drawing order.
        distance: (n,), from the palm's origin along +Gz to the object's surface [m]; NaN
            where the palm ray misses the object.
        combinations: Number of combinations of rotations (or surface samples).
        valid: Those above the table whose palm ray meets the bounding box.
        distinct: Different poses among them.
    """

    X_OG: Array
    distance: Array
    combinations: int
    valid: int
    distinct: int

    def __len__(self) -> int:
        return len(self.X_OG)


@dataclass(frozen=True, kw_only=True, eq=False)
class Attempt:
    """One candidate at one stand-off: what a trial starts from.

    Attributes:
        candidate: Index of the candidate of its object.
        standoff_index: Index into `candidates.standoffs`.
        standoff: Distance of the palm from the surface point along -Gz [m].
        spread: Angle of the spread joints [rad].
        X_OG: Pose of the palm (4, 4); the candidate's own where its ray misses.
        ray_hits: Whether the palm ray meets the object.
        seed: What `spread` was drawn from.
        closing: Angles of the closing joints (k,) [rad] from which the fingers close; None is
            the open hand.
    """

    candidate: int
    standoff_index: int
    standoff: float
    spread: float
    X_OG: Array
    ray_hits: bool
    seed: int
    closing: Array | None = None


def sample_candidates(
    model: ObjectModel, X_TO: npt.ArrayLike, config: CandidateConfig, seed: int
) -> Candidates:
    """Return the palm poses of an object, drawn with the seed, with their palm rays.

    Args:
        model: The object.
        X_TO: Its resting pose in the table-top frame, (4, 4).
        config: Method, rotations and number.
        seed: Of the dataset.
    """
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(object_key(model.name),)))
    X_TO = np.asarray(X_TO, dtype=float)
    if config.method == "rotations":
        poses, combinations, valid = rotation_candidates(model.half_extents, X_TO, config, rng)
        distinct = len(poses)
        poses = poses[rng.permutation(distinct)[: config.max]]
    else:
        poses = normal_candidates(model, config.max, rng)
        combinations = len(poses)
        poses = poses[above_table(poses[:, :3, 3], X_TO)]
        valid = distinct = len(poses)
    return Candidates(
        X_OG=poses,
        distance=palm_ray_distance(model.collision, poses),
        combinations=combinations,
        valid=valid,
        distinct=distinct,
    )


def rotation_candidates(
    half_extents: npt.ArrayLike,
    X_TO: Array,
    config: CandidateConfig,
    rng: np.random.Generator,
) -> tuple[Array, int, int]:
    """Return the distinct valid poses of the paper's method, and two counts.

    X_OG = R_global X_OG0 R_local with R = Rx Ry Rz each, and X_OG0 on +Oz at the distance
    of the box's corner from its centre, looking at it (Veres et al., equation 1). Valid:
    the palm's origin is above the table and the ray along +Gz meets the box.

    Args:
        half_extents: (3,), of the box about the origin of {O} [m].
        X_TO: Resting pose (4, 4).
        config: The rotations; with `jitter_deg` each angle gets a random addition.
        rng: Draws the jitter.

    Returns:
        Poses (n, 4, 4) in a definite order; the number of combinations; of valid ones.
    """
    half = np.asarray(half_extents, dtype=float)
    radius = float(np.linalg.norm(half))
    rotations, positions, combinations = [], [], 0
    for R_global, R_local in _rotation_chunks(config, rng):
        combinations += len(R_global)
        p_OG = radius * R_global[:, :, 2]
        keep = above_table(p_OG, X_TO)
        R_OG = R_global[keep] @ R_OG0 @ R_local[keep]
        p_OG = p_OG[keep]
        hits = ray_meets_box(p_OG, R_OG[:, :, 2], half)
        rotations.append(R_OG[hits])
        positions.append(p_OG[hits])
    R, p = np.concatenate(rotations), np.concatenate(positions)
    key = np.rint(np.hstack([R.reshape(-1, 9), p / radius]) / SAME_POSE).astype(np.int64)
    _, first = np.unique(key, axis=0, return_index=True)
    poses = np.tile(np.eye(4), (len(first), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = R[first], p[first]
    return poses, combinations, len(R)


def normal_candidates(model: ObjectModel, count: int, rng: np.random.Generator) -> Array:
    """Return poses (n, 4, 4) that look at random surface points against their normals.

    The points are spread evenly over the area, the roll about the normal is uniform, and
    the palm starts two of the box's half diagonals away, outside of the object.
    """
    mesh = model.visual
    points, faces = trimesh.sample.sample_surface(mesh, count, seed=int(rng.integers(2**31)))
    z = -mesh.face_normals[faces]
    # Any direction that is not parallel to z serves to start the roll from.
    helper = np.where(np.abs(z[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    x = np.cross(helper, z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    roll = rng.uniform(0.0, 2.0 * np.pi, count)[:, None]
    x = np.cos(roll) * x + np.sin(roll) * np.cross(z, x)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, 0], poses[:, :3, 1], poses[:, :3, 2] = x, np.cross(z, x), z
    poses[:, :3, 3] = points - 2.0 * z * np.linalg.norm(model.half_extents)
    return poses


def above_table(p_OG: Array, X_TO: Array) -> npt.NDArray[np.bool_]:
    """Return for points (n, 3) in {O} whether they lie above the table."""
    return p_OG @ X_TO[2, :3] + X_TO[2, 3] > 0.0


def ray_meets_box(p_OG: Array, z_O: Array, half: Array) -> npt.NDArray[np.bool_]:
    """Return for rays from (n, 3) along (n, 3) whether they meet the box of half extents (3,)."""
    # A component that should be zero may be 1e-17: as an exact zero it divides to infinity,
    # which is what the slab test wants.
    direction = np.where(np.abs(z_O) < 1e-12, 0.0, z_O)
    with np.errstate(divide="ignore", invalid="ignore"):
        t1, t2 = (-half - p_OG) / direction, (half - p_OG) / direction
    # 0/0, a ray within a slab's face, constrains nothing: fmax and fmin skip the NaN.
    entry = np.fmax.reduce(np.minimum(t1, t2), axis=1)
    leave = np.fmin.reduce(np.maximum(t1, t2), axis=1)
    return leave >= np.maximum(entry, 0.0)


def palm_ray_distance(mesh: trimesh.Trimesh, X_OG: Array) -> Array:
    """Return the distance (n,) [m] along +Gz to the mesh's surface; NaN where it is missed."""
    distance = np.full(len(X_OG), np.nan)
    if len(X_OG):
        origins, directions = X_OG[:, :3, 3], X_OG[:, :3, 2]
        points, rays, _ = mesh.ray.intersects_location(origins, directions, multiple_hits=False)
        along = np.einsum("ni,ni->n", points - origins[rays], directions[rays])
        distance[rays] = along
    return distance


def make_attempts(
    candidates: Candidates,
    indices: range,
    config: CandidateConfig,
    *,
    name: str,
    seed: int,
) -> Iterator[Attempt]:
    """Yield the attempts of a range of an object's candidates, a row of the dataset each.

    Args:
        candidates: Of the object.
        indices: Which of them.
        config: Stand-offs and spreads.
        name: The object's name.
        seed: Of the dataset; with name and candidate it decides the spreads.
    """
    spreads = np.deg2rad(config.spreads_deg)
    for i in indices:
        sequence = np.random.SeedSequence(seed, spawn_key=(object_key(name), i))
        drawn = np.random.default_rng(sequence).integers(len(spreads), size=len(config.standoffs))
        distance = candidates.distance[i]
        for j, standoff in enumerate(config.standoffs):
            X_OG = candidates.X_OG[i]
            if np.isfinite(distance):
                X_OG = X_OG @ make_pose(np.eye(3), [0.0, 0.0, distance - standoff])
            yield Attempt(
                candidate=i,
                standoff_index=j,
                standoff=standoff,
                spread=float(spreads[drawn[j]]),
                X_OG=X_OG,
                ray_hits=bool(np.isfinite(distance)),
                seed=int(sequence.generate_state(1, np.uint64)[0]),
            )


def _rotation_chunks(
    config: CandidateConfig, rng: np.random.Generator
) -> Iterator[tuple[Array, Array]]:
    """Yield R_global and R_local, (m, 3, 3) each, of all combinations, in chunks."""
    grid_global = _angle_grid(config.global_x_deg, config.global_y_deg, config.global_z_deg)
    grid_local = _angle_grid(config.local_x_deg, config.local_y_deg, config.local_z_deg)
    per_chunk = max(1, CHUNK // len(grid_local))
    for start in range(0, len(grid_global), per_chunk):
        block = grid_global[start : start + per_chunk]
        angles_global = np.repeat(block, len(grid_local), axis=0)
        angles_local = np.tile(grid_local, (len(block), 1))
        if config.jitter_deg:
            shape = (len(angles_global), 3)
            angles_global = angles_global + np.floor(rng.uniform(0, config.jitter_deg, shape))
            angles_local = angles_local + np.floor(rng.uniform(0, config.jitter_deg, shape))
        yield _rotation_xyz(angles_global), _rotation_xyz(angles_local)


def _angle_grid(*axes_deg: tuple[float, ...]) -> Array:
    """Return all combinations (n, 3) of angles [degree]; 360 and 0 count once."""
    unique = [np.unique(np.mod(np.asarray(axis, dtype=float), 360.0)) for axis in axes_deg]
    return np.stack(np.meshgrid(*unique, indexing="ij"), axis=-1).reshape(-1, 3)


def _rotation_xyz(angles_deg: Array) -> Array:
    """Return Rx Ry Rz, (n, 3, 3), of angles (n, 3) [degree]."""
    return Rotation.from_euler("XYZ", angles_deg, degrees=True).as_matrix()
