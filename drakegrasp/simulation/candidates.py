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
from itertools import islice
from typing import Protocol, TypeAlias

import numpy as np
import numpy.typing as npt
import trimesh

from drakegrasp import registry
from drakegrasp.arithmetic import Array, norm, sin_cos_deg
from drakegrasp.config import CandidateConfig, Config, is_own_class
from drakegrasp.errors import ConfigError, HandError
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.finger_sweep import has_paths
from drakegrasp.mesh.rays import first_hits
from drakegrasp.mesh.surfaces import on_faces
from drakegrasp.objects.model import ObjectModel
from drakegrasp.registry import own_class, run_own
from drakegrasp.seeding import Stream, object_key
from drakegrasp.simulation.attempt import Attempt, Source
from drakegrasp.simulation.palms import Shape
from drakegrasp.simulation.samplers import (
    above_table,
    checked_poses,
    make_poses,
    rotation_candidates,
)
from drakegrasp.table import Table

#: The samplers of the package, whose `Source` has their name.
OURS = ("rotations", "normals", "closing")
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
        spread: (n,), spread with which each palm is tried [rad]; NaN if the palm is moved along its
            ray to each stand-off, with drawn spreads.
        preshape_index: (n,), index of the preshape of each palm; -1 if there is none, or it is
            drawn.
        postures: Columns `q_grasp`, `q_pregrasp`, `q_squeeze`, `row` and `preshape` of `Attempts`,
            if the poses come from outside; None if they come from samplers.
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

    def palm_distance(
        self, candidate: npt.NDArray[np.int64], standoff: npt.NDArray[np.float64]
    ) -> Array:
        """Return how far the palms of attempts (n,) are from the surface along +Gz [m].

        Args:
            candidate: (n,), index of each attempt's palm.
            standoff: (n,), stand-off to which a palm was moved [m]; a palm with a spread was not.
        """
        as_it_is = np.isfinite(self.spread[candidate])
        return np.where(as_it_is, self.distance[candidate], standoff)


#: The shape of a palm whose spread and preshape are drawn for each attempt.
DRAWN = Shape(None, np.nan)
#: The resting pose and the sampler of a palm.
Place: TypeAlias = tuple[int, str]
#: What every sampler takes.
ARGUMENTS = ("model", "X_TO", "stream", "config")
#: A palm pose X_OG (4, 4) that is moved along its ray to each stand-off, with drawn spreads; or one
#: that is tried as it is, with the shape of the hand.
Palm: TypeAlias = Array | tuple[Array, Shape]


class Sampler(Protocol):
    """The palms of an object at a resting pose, of the package, the user or another package."""

    def __init__(self, model: ObjectModel, X_TO: Array, stream: Stream, config: Config) -> None:
        """Take the object, its resting pose (4, 4), random numbers, and the configuration."""

    def poses(self) -> Iterator[Palm | None]:
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
        self._more, self._turns = _turns(places, palms), list[tuple[Place, Palm]]()

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
            _refuse_far(method, model, poses[of_method], distance[of_method])
        preshapes = [-1 if shape.preshape is None else shape.preshape for _, shape in palms]
        return Candidates(
            X_OG=poses,
            distance=distance,
            resting=np.array([k for (k, _), _ in turns], dtype=np.int64),
            source=np.array([_source(method) for method in methods], dtype=np.int64),
            spread=np.array([shape.spread for _, shape in palms], dtype=float),
            preshape_index=np.array(preshapes, dtype=np.int64),
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


def refuse_samplers(config: Config) -> None:
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
) -> Iterator[Palm | None]:
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
    place = (resting, _source(method), _SAMPLER)
    if _source(method) is not Source.OWN:
        return Stream(seed, object_key(name), *place)
    # Two user-defined samplers do not share numbers, and a new digest of a file changes no numbers.
    return Stream(seed, object_key(name), *place, object_key(method.partition("@")[0]))


def _turns(
    places: Sequence[Place], palms: Mapping[Place, Iterator[Palm | None]]
) -> Iterator[tuple[Place, Palm]]:
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
