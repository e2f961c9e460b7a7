"""Shapes of a vendor's links as plain data, and their URDF.

A shape is a box, a cylinder, a capsule, a sphere, or a mesh. Everything else becomes the mesh of
its convex hull.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import trimesh
from pydrake.geometry import (
    Box,
    Capsule,
    Cylinder,
    Ellipsoid,
    GeometryId,
    HalfSpace,
    Mesh,
    Role,
    SceneGraphInspector,
    Sphere,
)

from drakegrasp.arithmetic import dot
from drakegrasp.frames import Array, transform_points
from drakegrasp.hand.shapes import ball_corners, box_corners, hull_corners, prism_corners
from drakegrasp.mesh.surfaces import Faces

#: Corners of the hull of a collision mesh: of a ball of 10 mm radius they miss less than 0.4 mm.
CORNERS = 64


@dataclass(frozen=True, kw_only=True, eq=False)
class Shape:
    """A shape on a link.

    Attributes:
        kind: "box", "cylinder", "capsule", "sphere" or "mesh".
        size: Edges of a box, radius and length of a cylinder or capsule, radius of a sphere [m].
        X_LS: Pose on the link, (4, 4).
        vertices: (n, 3) of a mesh, in its own frame [m].
        faces: (m, 3) of a mesh.
        colour: (3,), if the model gives one.
    """

    kind: str
    size: tuple[float, ...] = ()
    X_LS: Array
    vertices: Array | None = None
    faces: Faces | None = None
    colour: Array | None = None

    def corners(self) -> Array:
        """Return points (n, 3) whose hull is that of the shape, in the link's frame [m]."""
        if self.kind == "box":
            own = box_corners(np.array(self.size) / 2.0)
        elif self.kind == "cylinder":
            own = prism_corners(self.size[0], self.size[1] / 2.0)
        elif self.kind == "sphere":
            own = ball_corners(self.size[0])
        elif self.kind == "capsule":
            end = np.array([[0.0, 0.0, self.size[1] / 2.0]])
            ball = ball_corners(self.size[0])
            own = np.concatenate([ball + end, ball - end])
        else:
            assert self.vertices is not None
            own = self.vertices
        return transform_points(self.X_LS, own)

    def hull(self) -> Shape:
        """Return a mesh as its convex hull of few corners; other shapes as they are."""
        if self.kind != "mesh":
            return self
        assert self.vertices is not None
        solid = trimesh.convex.convex_hull(_thinned(self.vertices))
        return replace(self, vertices=np.array(solid.vertices), faces=np.array(solid.faces))


def read_shape(
    inspector: SceneGraphInspector, geometry: GeometryId, role: Role, colours: dict[str, Array]
) -> Shape | None:
    """Return a shape that Drake parsed, on its body; None for a half-space.

    Args:
        inspector: Describes it.
        geometry: The shape.
        role: Whether it is seen or collides.
        colours: Of the files of meshes, by name.
    """
    shape, X = inspector.GetShape(geometry), inspector.GetPoseInFrame(geometry).GetAsMatrix4()
    colour = None
    properties = inspector.GetProperties(geometry, role)
    if properties is not None and properties.HasProperty("phong", "diffuse"):
        rgba = properties.GetProperty("phong", "diffuse")
        colour = np.array([rgba.r(), rgba.g(), rgba.b()])
    if isinstance(shape, Box):
        return Shape(kind="box", size=tuple(shape.size()), X_LS=X, colour=colour)
    if isinstance(shape, Cylinder | Capsule):
        kind = "cylinder" if isinstance(shape, Cylinder) else "capsule"
        return Shape(kind=kind, size=(shape.radius(), shape.length()), X_LS=X, colour=colour)
    if isinstance(shape, Sphere):
        return Shape(kind="sphere", size=(shape.radius(),), X_LS=X, colour=colour)
    if isinstance(shape, HalfSpace):
        return None

    # Meshes were converted, so their files are ours; all else is known by its hull.
    if isinstance(shape, Mesh):
        path = Path(str(shape.source().path()))
        mesh = trimesh.load_mesh(path, process=False)
        vertices = np.array(mesh.vertices) * np.asarray(shape.scale3())
        colour = colours.get(path.name) if colour is None else colour
        return Shape(kind="mesh", X_LS=X, vertices=vertices, faces=mesh.faces, colour=colour)
    if isinstance(shape, Ellipsoid):
        solid = trimesh.creation.icosphere(2)
        vertices = np.array(solid.vertices) * [shape.a(), shape.b(), shape.c()]
        return Shape(kind="mesh", X_LS=X, vertices=vertices, faces=solid.faces, colour=colour)
    corners = hull_corners(inspector, geometry)
    if corners is None:
        return None
    solid = trimesh.convex.convex_hull(corners)
    return Shape(kind="mesh", X_LS=X, vertices=solid.vertices, faces=solid.faces, colour=colour)


def _thinned(points: Array) -> Array:
    """Return the farthest of points (n, 3) along `CORNERS` even directions; thick, if flat."""
    extents = np.ptp(points, axis=0)
    if extents.min() < 1e-4:
        points = np.concatenate([points - 2e-4, points + 2e-4])
    directions = ball_corners(1.0, CORNERS)
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    directions = np.concatenate([axes, directions])
    farthest = [int(np.argmax(dot(points, direction))) for direction in directions]
    return points[np.unique(farthest)]
