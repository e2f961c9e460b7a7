"""A scene of a dataset, read from its file, in which grasps of any of its objects are tried.

Input: scenes.hdf5 or clutter.hdf5, and the number of a scene. Output: its objects, each as an
object on the table with its neighbours and walls around it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from drakegrasp.arithmetic import multiply
from drakegrasp.config import Config
from drakegrasp.dataset.hdf5 import open_scenes, opened, read_columns, read_texts
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.prepared_objects import PreparedObject, load_prepared
from drakegrasp.dataset.schema import NO_OBJECT, SCENE_FIELDS
from drakegrasp.errors import GraspError
from drakegrasp.foreign_files import parse_json
from drakegrasp.frames import Array, invert_pose, unpack_pose
from drakegrasp.objects.model import ObjectModel
from drakegrasp.objects.surroundings import (
    BUILT_IN,
    Neighbourhood,
    Surroundings,
    surroundings_of,
)
from drakegrasp.simulation.placement import PlacedObject, aligned_pose


@dataclass(frozen=True, kw_only=True, eq=False)
class Clutter:
    """Objects at rest together.

    Attributes:
        names: Names of the o objects; a name may be there twice.
        X_TO: Their poses in the table-top frame, (o, 4, 4).
        surroundings: What is around them.
        config: Configuration of the dataset.
        prepared: The objects with their meshes and resting poses.
    """

    names: tuple[str, ...]
    X_TO: Array
    surroundings: Surroundings
    config: Config
    prepared: tuple[PreparedObject, ...]

    @property
    def models(self) -> tuple[ObjectModel, ...]:
        """The objects."""
        return tuple(each.model for each in self.prepared)

    def placed(self, object: int | str) -> PlacedObject:
        """Return an object with the others around it.

        An object in one of its resting poses is simulated exactly in it, so that an object that is
        alone gives the verdicts of a dataset.

        Args:
            object: Index in the scene, or a name if only one object has it.

        Raises:
            GraspError: If there is no such object, or several have the name.
        """
        i = self._index(object)
        own = self.prepared[i]
        return PlacedObject(
            model=own.model,
            X_TO=self.X_TO[i],
            config=self.config,
            around=self.around(i) or None,
            X_TO_rest=aligned_pose(self.X_TO[i], own.resting_poses),
        )

    def around(self, i: int) -> Neighbourhood:
        """Return what is around object i."""
        return Neighbourhood.of(i, self.models, self.X_TO, self.surroundings.walls)

    def simulated(self, i: int) -> tuple[Array, Neighbourhood]:
        """Return the pose (4, 4) at which object i is simulated, and what is around it there."""
        X_TO = aligned_pose(self.X_TO[i], self.prepared[i].resting_poses)
        return X_TO, self.around(i).moved(multiply(X_TO, invert_pose(self.X_TO[i])))

    def __repr__(self) -> str:
        return f"Clutter({', '.join(self.names)}; {self.surroundings.name})"

    def _index(self, object: int | str) -> int:
        if isinstance(object, str) and self.names.count(object) == 1:
            return self.names.index(object)
        whole = isinstance(object, int) and not isinstance(object, bool)
        if isinstance(object, int) and whole and 0 <= object < len(self.names):
            return object
        raise GraspError(
            f"object must be 0 to {len(self.names) - 1} or a name that is once in "
            f"{', '.join(self.names)}, got {object!r}"
        )


def load_scene(path: str | Path, number: int) -> Clutter:
    """Return a scene of a dataset.

    >>> scene = load_scene("OUT/clutter.hdf5", 0)             # doctest: +SKIP
    >>> verdict = verify_grasp(grasp, on=scene, object=1)     # doctest: +SKIP

    Args:
        path: OUT/clutter.hdf5 or OUT/scenes.hdf5, in the directory of its dataset.
        number: Number of the scene, from 0.

    Raises:
        GraspError: If there is no such scene.
        DataError: If the file or the dataset is missing or damaged.
    """
    path = Path(path)
    with open_scenes(path) as file:
        scenes = read_columns(file["scenes"], SCENE_FIELDS, ["object", "X_TO", "surroundings"])
        known = read_texts(file["objects"]["name"])
        several = "clutter" in file.attrs
    whole = isinstance(number, int) and not isinstance(number, bool)
    if not whole or not 0 <= number < scenes.count:
        raise GraspError(f"number must be that of a scene, 0 to {scenes.count - 1}, got {number!r}")

    around, config = str(scenes["surroundings"][number]), read_manifest(path.parent).config
    rows = scenes["object"][number]
    names = tuple(known[row] for row in rows[rows != NO_OBJECT])
    # An object that is there twice is loaded once.
    prepared = {name: load_prepared(path.parent, name, config) for name in dict.fromkeys(names)}
    return Clutter(
        names=names,
        X_TO=unpack_pose(scenes["X_TO"][number, : len(names)]),
        surroundings=surroundings_in(path)[around] if several else BUILT_IN["table"],
        config=config,
        prepared=tuple(prepared[name] for name in names),
    )


def surroundings_in(path: Path) -> dict[str, Surroundings]:
    """Return what is around the objects of a clutter.hdf5, by the names that its scenes have.

    Raises:
        DataError: If the file has no scenes of several objects, or is damaged.
    """
    with opened(path, "scenes of several objects") as file:
        trees = parse_json(file.attrs["clutter"])["surroundings"].items()
        return {name: surroundings_of(name, tree, str(path)) for name, tree in trees}
