"""What stands around a grasped object: walls that never move, and neighbours that do.

Surroundings are a few boxes and convex hulls on the table, by name (`BUILT_IN`) or in a YAML file:

    extent: [0.20, 0.15]     # half lengths in x and y of the area of the objects [m]
    drops: true              # objects are dropped; false: they stand in their resting poses
    boxes:
      - {size: [0.02, 0.34, 0.10], position: [0.21, 0.0, 0.05], yaw_deg: 0.0}
    hulls:                   # points [m], whose convex hulls are solids
      - {vertices: [[0.1, 0.0, 0.0], [0.2, 0.0, 0.0], [0.1, 0.1, 0.0], [0.1, 0.0, 0.1]]}

All poses are in the table-top frame {T}. The table itself is always there.
`simulation.fixtures` reads such files, and models of Drake.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, TypeAlias

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from drakegrasp.arithmetic import multiply
from drakegrasp.config import Number, Positive, describe_mistake
from drakegrasp.errors import ConfigError
from drakegrasp.frames import Array, make_pose, rotation_about, transform_points
from drakegrasp.objects.model import ObjectModel

#: Thickness of the walls of bin and shelf [m]; a thin compliant wall would let objects through.
WALL = 0.02
#: Decimals of the yaw of a box [degree].
DECIMALS = 9
#: Corners (8, 3) of a box with edges of 1 m about its centre [m].
CORNERS = np.array(list(np.ndindex(2, 2, 2))) - 0.5


@dataclass(frozen=True, kw_only=True, eq=False)
class Box:
    """A box that never moves.

    Attributes:
        size: Lengths of its edges, (3,) [m].
        X_TB: Pose of its centre, (4, 4).
    """

    size: Array
    X_TB: Array

    @property
    def corners(self) -> Array:
        """Its corners in {T}, (8, 3) [m]."""
        return transform_points(self.X_TB, self.size * CORNERS)


@dataclass(frozen=True, kw_only=True, eq=False)
class Hull:
    """A convex solid that never moves.

    Attributes:
        vertices: Points (n, 3) in {B}, whose convex hull it is [m].
        X_TB: Pose of {B}, (4, 4).
    """

    vertices: Array
    X_TB: Array

    @property
    def corners(self) -> Array:
        """The points in {T}, (n, 3) [m]."""
        return transform_points(self.X_TB, self.vertices)


Wall: TypeAlias = Box | Hull


@dataclass(frozen=True, kw_only=True, eq=False)
class Surroundings:
    """The walls between which the objects of a scene lie or stand.

    Attributes:
        name: Its name, or that of its file without suffix.
        extent: Half lengths in x and y of the area of the objects, (2,) [m]; a scene that has an
            object with its centre outside is drawn again.
        drops: Whether objects are dropped; otherwise they stand in their resting poses.
        boxes: The walls that are boxes.
        hulls: The other walls.
    """

    name: str
    extent: Array
    drops: bool = True
    boxes: tuple[Box, ...] = ()
    hulls: tuple[Hull, ...] = ()

    @property
    def walls(self) -> tuple[Wall, ...]:
        """All walls."""
        return (*self.boxes, *self.hulls)

    def tree(self) -> dict[str, Any]:
        """Return the content of its YAML file."""
        hulls = [{"vertices": hull.corners.tolist()} for hull in self.hulls]
        return {
            "extent": self.extent.tolist(),
            "drops": self.drops,
            "boxes": [
                {
                    "size": box.size.tolist(),
                    "position": box.X_TB[:3, 3].tolist(),
                    # Rounded, so that what is read back has the same bits.
                    "yaw_deg": round(
                        float(np.degrees(np.arctan2(box.X_TB[1, 0], box.X_TB[0, 0]))), DECIMALS
                    ),
                }
                for box in self.boxes
            ],
            **({"hulls": hulls} if hulls else {}),
        }


@dataclass(frozen=True, kw_only=True, eq=False)
class Neighbourhood:
    """What is around an object: n movable neighbours, and walls.

    Attributes:
        models: The n neighbours.
        X_TN: Their poses, (n, 4, 4).
        walls: The walls.
    """

    models: tuple[ObjectModel, ...] = ()
    X_TN: Array
    walls: tuple[Wall, ...] = ()

    @classmethod
    def of(
        cls, i: int, models: Sequence[ObjectModel], X_TN: Array, walls: tuple[Wall, ...]
    ) -> Neighbourhood:
        """Return what is around object i of a scene.

        Args:
            i: Index of the object.
            models: All objects of the scene.
            X_TN: Their poses, (o, 4, 4).
            walls: The walls.
        """
        others = [j for j in range(len(models)) if j != i]
        return cls(models=tuple(models[j] for j in others), X_TN=X_TN[others], walls=walls)

    def __bool__(self) -> bool:
        return bool(self.models or self.walls)

    def moved(self, X: Array) -> Neighbourhood:
        """Return it moved by a pose (4, 4) that maps {T} to {T}: a yaw and a shift."""
        walls = tuple(replace(wall, X_TB=multiply(X, wall.X_TB)) for wall in self.walls)
        return replace(self, X_TN=multiply(X, self.X_TN), walls=walls)

    def digest(self) -> str:
        """Return a hash of meshes, masses, inertias, frictions and poses."""
        parts: list[Any] = [self.X_TN]
        for wall in self.walls:
            parts += [wall.size if isinstance(wall, Box) else wall.vertices, wall.X_TB]
        for model in self.models:
            parts += [model.collision_vertices, model.collision_faces, np.float64(model.mass)]
            parts += [model.p_OOcm, model.I_OOcm_O, np.array(str(model.friction).encode())]
        content = hashlib.sha256()
        for part in parts:
            content.update(np.ascontiguousarray(part).tobytes())
        return content.hexdigest()


def _walls(inner: tuple[float, float], height: float, sides: Iterable[str]) -> tuple[Box, ...]:
    """Return walls around an area of the table, by their sides: -x, +x, -y, +y.

    Args:
        inner: Lengths of the area in x and y [m].
        height: Height of the walls [m].
        sides: The sides that have a wall.
    """
    boxes = []
    for side in sides:
        axis = "xy".index(side[1])
        size = np.array([inner[0] + 2 * WALL, inner[1] + 2 * WALL, height])
        centre = np.zeros(3)
        size[axis] = WALL
        centre[axis] = float(f"{side[0]}1") * 0.5 * (inner[axis] + WALL)
        centre[2] = 0.5 * height
        boxes.append(Box(size=size, X_TB=make_pose(np.eye(3), centre)))
    return tuple(boxes)


#: Surroundings by name: the bare table; a container of 60 x 40 cm outside (the Euro size), low
#: enough for a wide hand; the upper board of a shelf with back and sides, with room for a lift.
BUILT_IN = {
    each.name: each
    for each in (
        Surroundings(name="table", extent=np.array([0.15, 0.15])),
        Surroundings(
            name="bin",
            extent=np.array([0.28, 0.18]),
            boxes=_walls((0.56, 0.36), 0.10, ("-x", "+x", "-y", "+y")),
        ),
        Surroundings(
            name="shelf",
            extent=np.array([0.40, 0.15]),
            drops=False,
            boxes=_walls((0.80, 0.30), 0.25, ("-x", "+x", "+y")),
        ),
    )
}


def surroundings_of(name: str, tree: Any, where: str) -> Surroundings:
    """Return the surroundings of the content of a YAML file.

    Args:
        name: Their name.
        tree: The content, see `Surroundings.tree`.
        where: File of the content, for messages.

    Raises:
        ConfigError: If the content cannot be used.
    """
    try:
        read = _Tree.model_validate(tree)
    except ValidationError as error:
        mistake = describe_mistake(error.errors()[0], whole="surroundings", legal="a known key")
        raise ConfigError(f"{where}: {mistake}") from None
    boxes = []
    for box in read.boxes:
        turn = rotation_about([0.0, 0.0, 1.0], np.radians(round(box.yaw_deg, DECIMALS)))
        boxes.append(Box(size=np.array(box.size), X_TB=make_pose(turn, box.position)))
    hulls = [Hull(vertices=np.array(hull.vertices), X_TB=np.eye(4)) for hull in read.hulls]
    return Surroundings(
        name=name,
        extent=np.array(read.extent),
        drops=read.drops,
        boxes=tuple(boxes),
        hulls=tuple(hulls),
    )


class _BoxTree(BaseModel):
    model_config = ConfigDict(extra="forbid")

    size: tuple[Positive, Positive, Positive]
    position: tuple[Number, Number, Number]
    yaw_deg: Number = 0.0


class _HullTree(BaseModel):
    model_config = ConfigDict(extra="forbid")

    vertices: Annotated[tuple[tuple[Number, Number, Number], ...], Field(min_length=4)]


class _Tree(BaseModel):
    model_config = ConfigDict(extra="forbid")

    extent: tuple[Positive, Positive]
    drops: bool = True
    boxes: tuple[_BoxTree, ...] = ()
    hulls: tuple[_HullTree, ...] = ()
