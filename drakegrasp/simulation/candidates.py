"""Stage "sample": palm poses around an object, and the attempts that follow from them.

Input: the object's box and mesh, and its resting poses. Output: up to `candidates.max` palm poses
X_OG and, for each, its resting pose and the distance along its palm ray to the object.

A sampler of the registry yields a sequence of poses at a resting pose. Resting poses and samplers
take turns. The first n poses are the same for every `candidates.max` of at least n, so a dataset
can grow. The paper's method (`rotations`) multiplies a first palm pose with global and local
rotations. `normals` is the baseline of the paper's Figure 2. A user-defined class may be another
sampler.

Nothing here needs Drake. Poses are bitwise equal on every machine: sums, products and square roots
have a fixed order (`arithmetic`), limits are inclusive by more than rounding, poses are compared
as rounded integers, and random numbers come from `seeding`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import numpy as np
import numpy.typing as npt
import trimesh

from drakegrasp import registry
from drakegrasp.arithmetic import Array, norm, sin_cos_deg
from drakegrasp.config import CandidateConfig, is_own_class
from drakegrasp.errors import ConfigError
from drakegrasp.mesh.crossings import first_hits
from drakegrasp.mesh.surfaces import on_faces
from drakegrasp.objects.model import ObjectModel
from drakegrasp.seeding import Stream, object_key
from drakegrasp.simulation.attempt import Attempt, Source
from drakegrasp.simulation.samplers import (
    OwnPoses,
    above_table,
    make_poses,
    own_sampler,
    rotation_candidates,
)
from drakegrasp.table import Table

#: Number of surface points that `normals` draws together; another number changes the draw.
BLOCK = 1000
#: Palms farther than this from the object must face it [m]; no hand is so large.
FAR = 1.0
#: Last number of the place of the stream of a sampler at a resting pose.
_SAMPLER = 2


@dataclass(frozen=True, kw_only=True, eq=False)
class Candidates:
    """Palm poses of one object.

    Attributes:
        X_OG: (n, 4, 4), the drawn poses, in drawing order.
        distance: (n,), distance from the palm's origin along +Gz to the object's surface [m]; NaN
            if the palm ray misses the object.
        resting: (n,), index of each pose's resting pose.
        source: (n,), `Source` of each pose.
        combinations: Number of combinations of rotations, or of surface points drawn.
        valid: Number of combinations above the table whose palm ray meets the bounding box.
        distinct: Number of different poses among the valid ones.
        postures: Columns `q_grasp`, `q_pregrasp`, `q_squeeze`, `row`, `said` and `preshape` of
            `Attempts`, if the poses come from outside; None if they come from samplers.
    """

    X_OG: Array
    distance: Array
    resting: npt.NDArray[np.int64]
    source: npt.NDArray[np.int64]
    combinations: int
    valid: int
    distinct: int
    postures: Table | None = None

    def __len__(self) -> int:
        return len(self.X_OG)


class Sampler(Protocol):
    """A sequence of palm poses of an object at a resting pose; it does not depend on its length."""

    @property
    def limit(self) -> int | None:
        """Number of available poses; None means unlimited."""

    def poses(self, count: int) -> Array:
        """Return the first poses (count, 4, 4)."""

    def counts(self, count: int) -> tuple[int, int, int]:
        """Return how many combinations, valid and distinct ones the first poses were drawn from."""


class Rotations:
    """The distinct poses of the paper's rotations in random order, see `rotation_candidates`."""

    def __init__(
        self, model: ObjectModel, X_TO: Array, config: CandidateConfig, stream: Stream
    ) -> None:
        """Enumerate and shuffle the poses."""
        poses, combinations, valid = rotation_candidates(model.half_extents, X_TO, config, stream)
        self._poses = poses[stream.permutation(len(poses))]
        self._counts = combinations, valid, len(poses)
        self.limit: int | None = len(poses)

    def poses(self, count: int) -> Array:
        """Return the first poses (count, 4, 4)."""
        return self._poses[:count]

    def counts(self, count: int) -> tuple[int, int, int]:
        """Return the numbers of all combinations, valid and distinct ones."""
        return self._counts


class Normals:
    """Poses above the table that look at random surface points, see `normal_candidates`."""

    def __init__(
        self, model: ObjectModel, X_TO: Array, config: CandidateConfig, stream: Stream
    ) -> None:
        """Draw nothing yet; `config` is not used."""
        self._model, self._X_TO, self._stream = model, X_TO, stream
        self._poses, self._numbers, self._drawn = np.zeros((0, 4, 4)), np.zeros(0, dtype=int), 0
        self.limit: int | None = None

    def poses(self, count: int) -> Array:
        """Return the first poses (count, 4, 4)."""
        # A solid has faces that look up, and palms above these faces are above the table.
        while len(self._poses) < count:
            poses = normal_candidates(self._model, BLOCK, self._stream)
            above = np.flatnonzero(above_table(poses[:, :3, 3], self._X_TO))
            self._poses = np.concatenate([self._poses, poses[above]])
            self._numbers = np.concatenate([self._numbers, self._drawn + above])
            self._drawn += BLOCK
        return self._poses[:count]

    def counts(self, count: int) -> tuple[int, int, int]:
        """Return the number of surface points up to the last pose; number of poses, twice."""
        return int(self._numbers[count - 1]) + 1 if count else 0, count, count


def sample_candidates(
    model: ObjectModel, X_TO: npt.ArrayLike, config: CandidateConfig, seed: int
) -> Candidates:
    """Return the palm poses of an object, drawn with the seed, with their palm rays.

    Args:
        model: The object.
        X_TO: Resting poses in the table-top frame, (r, 4, 4), or one pose (4, 4).
        config: Samplers, rotations and number of poses.
        seed: Seed of the dataset.

    Raises:
        ConfigError: If a user-defined sampler cannot be run, or all its poses are far away.
    """
    # One sampler for each method at each resting pose; they take turns.
    resting = np.asarray(X_TO, dtype=float).reshape(-1, 4, 4)
    places = [(k, method) for method in config.methods for k in range(len(resting))]
    samplers = {
        (k, method): found_sampler(method, config)(
            model, resting[k], config, _sampler_stream(model.name, seed, k, method)
        )
        for k, method in dict.fromkeys(places)
    }
    turns = _turns(places, {place: s.limit for place, s in samplers.items()}, config.max)

    # The poses of each sampler, in the order of the turns.
    used = Counter(place for place, _ in turns)
    drawn = {place: sampler.poses(used[place]) for place, sampler in samplers.items()}
    poses = np.array([drawn[place][i] for place, i in turns]).reshape(-1, 4, 4)
    counts = [sampler.counts(used[place]) for place, sampler in samplers.items()]
    combinations, valid, distinct = (sum(numbers) for numbers in zip(*counts, strict=True))
    distance = palm_ray_distance(model.collision, poses)
    for method in {each for each in config.methods if _source(each) is Source.OWN}:
        of_method = [of == method for (_, of), _ in turns]
        _refuse_far(method, model, poses[of_method], distance[of_method])
    return Candidates(
        X_OG=poses,
        distance=distance,
        resting=np.array([k for (k, _), _ in turns], dtype=np.int64),
        source=np.array([_source(method) for (_, method), _ in turns], dtype=np.int64),
        combinations=combinations,
        valid=valid,
        distinct=distinct,
    )


def _refuse_far(method: str, model: ObjectModel, poses: Array, distance: Array) -> None:
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


def found_sampler(
    method: str, config: CandidateConfig
) -> Callable[[ObjectModel, Array, CandidateConfig, Stream], Sampler]:
    """Return the sampler of a name: a registered or a user-defined sampler.

    Another package may register a class with the signature of user-defined samplers,
    (model, X_TO, stream).

    Raises:
        ConfigError: If the sampler cannot be imported or has another signature.
    """
    if is_own_class(method):
        return partial(OwnPoses, method, own_sampler(method, config.code))
    found = registry.find("samplers", method)
    if registry.accepts(found, ("model", "X_TO", "stream")):
        return partial(OwnPoses, method, found)
    if not registry.accepts(found, ("model", "X_TO", "config", "stream")):
        raise ConfigError(f"{method}: must take (model, X_TO, stream), got other arguments")
    sampler: Callable[[ObjectModel, Array, CandidateConfig, Stream], Sampler] = found
    return sampler


def _source(method: str) -> Source:
    """Return the `Source` that is stored for a sampler."""
    return {"rotations": Source.ROTATIONS, "normals": Source.NORMALS}.get(method, Source.OWN)


def _sampler_stream(name: str, seed: int, resting: int, method: str) -> Stream:
    """Return the random numbers of a sampler at a resting pose of an object."""
    # The paper's method uses the object's first stream.
    if (resting, method) == (0, "rotations"):
        return Stream(seed, object_key(name))
    place = (resting, _source(method), _SAMPLER)
    if _source(method) is not Source.OWN:
        return Stream(seed, object_key(name), *place)
    # Two user-defined samplers do not share numbers, and a new digest of a file changes no numbers.
    return Stream(seed, object_key(name), *place, object_key(method.partition("@")[0]))


def _turns(
    places: Sequence[tuple[int, str]], limits: Mapping[tuple[int, str], int | None], count: int
) -> list[tuple[tuple[int, str], int]]:
    """Return the place of each pose's sampler and the pose's index there, until none has more.

    Args:
        places: The places that take turns; a place that is named twice has two turns.
        limits: Number of poses of each place; None for any number.
        count: Number of turns.
    """
    turns: list[tuple[tuple[int, str], int]] = []
    taken = dict.fromkeys(places, 0)
    while len(turns) < count:
        begun = len(turns)
        for place in places:
            limit = limits[place]
            if len(turns) < count and (limit is None or taken[place] < limit):
                turns.append((place, taken[place]))
                taken[place] += 1
        if len(turns) == begun:
            break
    return turns


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


def standoff_attempts(
    candidates: Candidates,
    indices: range,
    config: CandidateConfig,
    *,
    name: str,
    seed: int,
    preshapes: int = 0,
) -> Iterator[Attempt]:
    """Yield the attempts of a range of an object's candidates; each is a row of the dataset.

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
        drawn = stream.integers(len(spreads), len(standoffs))
        shapes = stream.integers(preshapes, len(standoffs)) if preshapes else None

        # Move the palm along its ray to each stand-off from the surface.
        distance = candidates.distance[i]
        for j, standoff in enumerate(standoffs):
            X_OG = candidates.X_OG[i].copy()
            if np.isfinite(distance):
                X_OG[:3, 3] += (distance - standoff) * X_OG[:3, 2]
            yield Attempt(
                candidate=i,
                standoff_index=j,
                standoff=standoff,
                spread=float(spreads[drawn[j]]),
                X_OG=X_OG,
                ray_hits=bool(np.isfinite(distance)),
                seed=stream.key,
                resting=int(candidates.resting[i]),
                source=Source(candidates.source[i]),
                preshape=None if shapes is None else int(shapes[j]),
            )
