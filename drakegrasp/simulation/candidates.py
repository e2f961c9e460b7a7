"""Stage "sample": palm poses around an object, and the attempts that follow from them.

Input: an object and its resting poses. Output: palm poses X_OG and, for each, its resting pose and
the distance along its palm ray to the object.

A sampler yields the palm poses of one resting pose. Resting poses and samplers take turns. The
first n poses are the same however many follow, so a dataset can grow. The paper's method
(`rotations`) multiplies a first palm pose with global and local rotations. `normals` is the
baseline of the paper's Figure 2; its palms, too, are moved along their ray to each stand-off.
`closing` (see `closing_sampler`) places the palm and chooses the spread. A user-defined class may
be another sampler.

Nothing here needs Drake. Poses are bitwise equal on every machine: sums, products and square roots
have a fixed order (`arithmetic`), limits are inclusive by more than rounding, poses are compared
as rounded integers, and random numbers come from `seeding`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import count, islice
from numbers import Real
from typing import Any, Protocol, TypeAlias

import numpy as np
import numpy.typing as npt
import trimesh

from drakegrasp import registry
from drakegrasp.arithmetic import Array, dot, multiply, norm, sin_cos_deg
from drakegrasp.config import CandidateConfig, Config, is_own_class
from drakegrasp.errors import ConfigError, GraspError, HandError, listed
from drakegrasp.frames import read_pose
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.hand.finger_sweep import has_paths
from drakegrasp.hand.kinematics import coordinate_limits
from drakegrasp.mesh.surfaces import first_hits, on_faces
from drakegrasp.objects.model import ObjectModel
from drakegrasp.registry import own_class, run_own
from drakegrasp.seeding import Draw, Stream, object_key
from drakegrasp.simulation.attempt import Attempt, Source
from drakegrasp.simulation.palms import Shape
from drakegrasp.table import Table

#: The samplers of the package, whose `Source` has their name.
OURS = ("rotations", "normals", "closing")
#: Number of surface points that `normals` draws together; another number changes the draw.
BLOCK = 1000
#: Palms farther than this from the object must face it [m]; no hand is so large.
FAR = 1.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Candidates:
    """Palm poses of one object.

    Attributes:
        X_OG: (n, 4, 4), the drawn poses, in drawing order.
        distance: (n,), distance from the palm's origin along +Gz to the object's surface [m]; NaN
            if the palm ray misses the object.
        resting: (n,), index of each pose's resting pose.
        source: (n,), `Source` of each pose.
        spread: (n,), spread with which each palm is tried [rad]; NaN if the palm is moved along its
            ray to each stand-off, with drawn spreads.
        preshape_index: (n,), index of the preshape of each palm; -1 if there is none, or it is
            drawn.
        postures: Columns `q_grasp`, `q_pregrasp`, `q_squeeze`, `row` and `preshape` of a
            `GraspTable`, if the poses come from outside; None if they come from samplers.
    """

    X_OG: Array
    distance: Array
    resting: npt.NDArray[np.int64]
    source: npt.NDArray[np.int64]
    spread: Array
    preshape_index: npt.NDArray[np.int64]
    postures: Table | None = None

    def __len__(self) -> int:
        return len(self.X_OG)


#: The shape of a palm whose spread and preshape are drawn for each attempt.
DRAWN = Shape(None, np.nan)
#: The resting pose and the sampler of a palm.
Place: TypeAlias = tuple[int, str]
#: What every sampler takes.
ARGUMENTS = ("model", "X_TO", "stream", "config")
#: A palm pose X_OG (4, 4) that is moved along its ray to each stand-off, with drawn spreads; or one
#: that is tried as it is, with the shape of the hand.
SampledPalm: TypeAlias = Array | tuple[Array, Shape]


class Sampler(Protocol):
    """The palms of an object at a resting pose, of the package, the user or another package."""

    def __init__(self, model: ObjectModel, X_TO: Array, stream: Stream, config: Config) -> None:
        """Take the object, its resting pose (4, 4), random numbers, and the configuration."""

    def poses(self) -> Iterator[SampledPalm | None]:
        """Yield the palms; they do not depend on how many are taken.

        None tells that the palms that follow are nearer to each other.
        """


class Rotations:
    """The distinct poses of the paper's rotations in random order, see `rotation_candidates`."""

    def __init__(self, model: ObjectModel, X_TO: Array, stream: Stream, config: Config) -> None:
        """Enumerate and shuffle the poses."""
        poses = rotation_candidates(model.half_extents, X_TO, config.candidates, stream)
        self._poses = poses[stream.permutation(len(poses))]

    def poses(self) -> Iterator[Array]:
        """Yield the poses."""
        yield from self._poses


class Normals:
    """Poses above the table that look at random surface points, see `normal_candidates`."""

    def __init__(self, model: ObjectModel, X_TO: Array, stream: Stream, config: Config) -> None:
        """Draw nothing yet."""
        self._model, self._X_TO, self._stream = model, X_TO, stream

    def poses(self) -> Iterator[Array]:
        """Yield the poses without end."""
        # A solid has faces that look up, and palms above these faces are above the table.
        while True:
            poses = normal_candidates(self._model, BLOCK, self._stream)
            yield from poses[above_table(poses[:, :3, 3], self._X_TO)]


class Drawing:
    """The palm poses of an object that are drawn so far, and its samplers, which can draw more."""

    def __init__(self, model: ObjectModel, X_TO: npt.ArrayLike, config: Config) -> None:
        """Make the samplers.

        Args:
            model: The object.
            X_TO: Resting poses in the table-top frame, (r, 4, 4), or one pose (4, 4).
            config: Samplers, hand and seed.

        Raises:
            ConfigError: If a user-defined sampler cannot be run.
            HandError: If a sampler cannot be used with the hand.
        """
        # One sampler for each method at each resting pose; a method that is named twice has two
        # turns.
        resting = np.asarray(X_TO, dtype=float).reshape(-1, 4, 4)
        places = [(k, method) for method in config.candidates.method for k in range(len(resting))]
        palms = {
            (k, method): _palms(method, k, model, resting[k], config)
            for k, method in dict.fromkeys(places)
        }
        self._model, self._most = model, config.candidates.max
        self._more, self._turns = _turns(places, palms), list[tuple[Place, SampledPalm]]()

    def candidates(self, most: int | None = None) -> Candidates:
        """Return the first palm poses, drawn with the seed, with their palm rays.

        Args:
            most: Largest number of palm poses; None for `candidates.max`.

        Raises:
            ConfigError: If a user-defined sampler cannot be run, or all its poses are far away.
        """
        most = self._most if most is None else most
        self._turns += islice(self._more, max(0, most - len(self._turns)))
        turns, model = self._turns[:most], self._model

        palms = [palm if isinstance(palm, tuple) else (palm, DRAWN) for _, palm in turns]
        poses = np.array([X_OG for X_OG, _ in palms]).reshape(-1, 4, 4)
        distance = palm_ray_distance(model.collision, poses)
        methods = [method for (_, method), _ in turns]
        for method in {of for of in methods if _source(of) is Source.OWN}:
            of_method = [of == method for of in methods]
            _validate_palms(method, model, poses[of_method], distance[of_method])
        preshapes = [-1 if shape.preshape is None else shape.preshape for _, shape in palms]
        return Candidates(
            X_OG=poses,
            distance=distance,
            resting=np.array([k for (k, _), _ in turns], dtype=np.int64),
            source=np.array([_source(method) for method in methods], dtype=np.int64),
            spread=np.array([shape.spread for _, shape in palms], dtype=float),
            preshape_index=np.array(preshapes, dtype=np.int64),
        )


def _validate_palms(method: str, model: ObjectModel, poses: Array, distance: Array) -> None:
    """Reject a user-defined sampler whose palms are all far away and do not face the object.

    Raises:
        ConfigError: If all palms are, with the distance of the nearest palm.
    """
    if not len(poses) or np.isfinite(distance).any():
        return
    outside = np.maximum(np.abs(poses[:, :3, 3]) - model.half_extents, 0.0)
    nearest = float(np.linalg.norm(outside, axis=1).min())
    if nearest > FAR:
        raise ConfigError(
            f"{method.partition('@')[0]}: poses must be X_OG in metres, within {FAR:g} m of the "
            f"object or facing it, got the nearest {nearest:.3g} m from {model.name}"
        )


def sampler_class(method: str, config: CandidateConfig) -> Callable[..., Sampler]:
    """Return the class of a sampler: a registered or a user-defined one.

    Raises:
        ConfigError: If it cannot be imported or has another signature.
    """
    if is_own_class(method):
        key = "candidates.method"
        return own_class(method, config.code, key=key, arguments=ARGUMENTS, method="poses")
    found: Callable[..., Sampler] = registry.find("samplers", method)
    if not registry.accepts(found, ARGUMENTS):
        raise ConfigError(f"{method}: must take ({', '.join(ARGUMENTS)}), got other arguments")
    return found


def validate_samplers(config: Config) -> None:
    """Reject samplers that cannot be used.

    Raises:
        ConfigError: See `sampler_class`.
        HandError: If the sampler `closing` cannot close the hand.
    """
    for method in config.candidates.method:
        sampler_class(method, config.candidates)
    hand = load_hand(config.hand_source)
    if "closing" in config.candidates.method and not all(map(has_paths, hand.preshapes or [hand])):
        raise HandError(
            "hand must be one whose fingers share no link for the sampler closing, got "
            f"{hand.name}; candidates.method=normals takes any hand"
        )


def _palms(
    method: str, resting: int, model: ObjectModel, X_TO: Array, config: Config
) -> Iterator[SampledPalm | None]:
    """Return the palms of a sampler at a resting pose of an object, its index and X_TO (4, 4).

    Raises:
        ConfigError: If a user-defined sampler cannot be run.
        HandError: If the sampler cannot be used with the hand.
    """
    found = sampler_class(method, config.candidates)
    arguments = model, X_TO, _sampler_stream(model.name, config.seed, resting, method), config
    if _source(method) is not Source.OWN:
        return found(*arguments).poses()
    sampler = run_own(method, found, *arguments)
    return checked_poses(method, sampler, load_hand(config.hand_source))


def _source(method: str) -> Source:
    """Return the `Source` that is stored for a sampler."""
    return Source[method.upper()] if method in OURS else Source.OWN


def _sampler_stream(name: str, seed: int, resting: int, method: str) -> Stream:
    """Return the random numbers of a sampler at a resting pose of an object."""
    # The paper's method uses the object's first stream.
    if (resting, method) == (0, "rotations"):
        return Stream(seed, object_key(name))
    place = (resting, _source(method), Draw.SAMPLER)
    if _source(method) is not Source.OWN:
        return Stream(seed, object_key(name), *place)
    # Two user-defined samplers do not share numbers, and a new digest of a file changes no numbers.
    return Stream(seed, object_key(name), *place, object_key(method.partition("@")[0]))


def _turns(
    places: Sequence[Place], palms: Mapping[Place, Iterator[SampledPalm | None]]
) -> Iterator[tuple[Place, SampledPalm]]:
    """Yield a palm of each place in turn, until no sampler yields another one.

    A place whose palms become nearer to each other waits until those of all others are as near.
    """
    waits, left = dict.fromkeys(palms, 0), list(places)
    while left:
        first = min(waits[place] for place in left)
        for place in [place for place in left if waits[place] == first]:
            try:
                palm = next(palms[place])
            except StopIteration:
                left = [other for other in left if other != place]
                continue
            if palm is None:
                waits[place] += 1
            else:
                yield place, palm


def normal_candidates(model: ObjectModel, count: int, stream: Stream) -> Array:
    """Return poses (n, 4, 4) that look at random surface points against their normals.

    The points are uniform over the surface area and the roll about the normal is uniform. The palm
    is two half diagonals of the box away from its point, outside the object. Each pose takes four
    numbers of the stream.
    """
    # Random points of the surface, with the outward normals of their faces.
    vertices, faces = model.visual_vertices, model.visual_faces.astype(np.int64)
    numbers = stream.uniform(4 * count).reshape(count, 4)
    points, picked = on_faces(vertices, faces, numbers[:, :3])
    a, b, c = np.moveaxis(vertices[faces[picked]], 1, 0)
    outward = np.cross(b - a, c - a)
    z = -outward / norm(outward)[:, None]

    # Roll from any direction that is not parallel to z.
    helper = np.where(np.abs(z[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    x = np.cross(helper, z)
    x /= norm(x)[:, None]
    sine, cosine = sin_cos_deg(360.0 * numbers[:, 3:])
    x = cosine * x + sine * np.cross(z, x)
    R = np.stack([x, np.cross(z, x), z], axis=2)
    return make_poses(R, points - 2.0 * z * norm(model.half_extents))


def palm_ray_distance(mesh: trimesh.Trimesh, X_OG: Array) -> Array:
    """Return the distance (n,) [m] along +Gz to the mesh's surface; NaN for a ray that misses."""
    distance = first_hits(np.asarray(mesh.triangles), X_OG[:, :3, 3], X_OG[:, :3, 2])
    return np.where(np.isfinite(distance), distance, np.nan)


def palm_attempts(
    candidates: Candidates,
    indices: range,
    config: CandidateConfig,
    *,
    name: str,
    seed: int,
    preshapes: int = 0,
) -> Iterator[Attempt]:
    """Yield the attempts of a range of an object's candidates; each is a row of the dataset.

    A palm with a spread is tried once, as it is. Any other is tried at each stand-off.

    Args:
        candidates: Candidates of the object.
        indices: The range.
        config: Stand-offs and spreads.
        name: The object's name.
        seed: Seed of the dataset; with name and candidate it decides spreads and preshapes.
        preshapes: Number of preshapes of the hand.
    """
    spreads, standoffs = np.deg2rad(config.spreads_deg), config.standoffs
    for i in indices:
        # Each candidate has its own stream, so ranges do not depend on each other.
        stream = Stream(seed, object_key(name), i)
        distance = float(candidates.distance[i])
        attempt = Attempt(
            candidate=i,
            standoff=distance,
            spread=float(candidates.spread[i]),
            X_OG=candidates.X_OG[i],
            seed=stream.key,
            resting=int(candidates.resting[i]),
            source=Source(candidates.source[i]),
            preshape=None
            if candidates.preshape_index[i] < 0
            else int(candidates.preshape_index[i]),
        )
        if np.isfinite(attempt.spread):
            yield attempt
            continue

        # Move the palm along its ray to each stand-off from the surface.
        drawn = stream.integers(len(spreads), len(standoffs))
        shapes = stream.integers(preshapes, len(standoffs)) if preshapes else None
        for j, standoff in enumerate(standoffs):
            X_OG = attempt.X_OG.copy()
            if np.isfinite(distance):
                X_OG[:3, 3] += (distance - standoff) * X_OG[:3, 2]
            yield replace(
                attempt,
                standoff_index=j,
                standoff=standoff,
                spread=float(spreads[drawn[j]]),
                X_OG=X_OG,
                ray_hits=bool(np.isfinite(distance)),
                preshape=None if shapes is None else int(shapes[j]),
            )


# Palm poses of the paper's rotations, and of user-defined samplers.

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
#: Bits of one rounded entry (-1e6 to 1e6); three entries are in one 64-bit integer.
BITS = 21

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
