"""Shapes of a vendor's links: primitives of Drake, and meshes of many formats.

Input: mesh files, and shapes that Drake parsed. Output: `Shape`s on the links. A shape that is not
a primitive becomes triangles, and in the draft a convex hull.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import trimesh
from pydrake.geometry import (
    Box,
    Capsule,
    Convex,
    Cylinder,
    Ellipsoid,
    GeometryId,
    Mesh,
    SceneGraphInspector,
    Sphere,
)
from pydrake.multibody.tree import CalcSpatialInertia, SpatialInertia

from drakegrasp.arithmetic import dot
from drakegrasp.errors import HandError, MeshError
from drakegrasp.frames import Array, transform_points
from drakegrasp.hand.shapes import ball_corners, hull_corners, primitive_corners
from drakegrasp.mesh.loading import load_surface
from drakegrasp.mesh.surfaces import Faces

#: Number of corners of the hull of a collision mesh; on a ball of 10 mm radius they miss less than
#: 0.4 mm.
CORNERS = 64
#: Minimum thickness of a hull [m]: a plane has no hull.
THIN = 4e-4
#: Mean density of links whose model gives no mass [kg/m^3]; own choice, that of solid plastic.
DENSITY = 1200.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Shape:
    """A shape on a link: a primitive, or else a mesh.

    Attributes:
        X_LS: Pose of the shape on the link, (4, 4).
        primitive: A box, cylinder, capsule or sphere.
        vertices: (n, 3), vertices of a mesh, in its own frame [m].
        faces: (m, 3), faces of a mesh.
    """

    X_LS: Array = field(default_factory=lambda: np.eye(4))
    primitive: Box | Cylinder | Capsule | Sphere | None = None
    vertices: Array | None = None
    faces: Faces | None = None

    def corners(self) -> Array:
        """Return points (n, 3) with the same hull as the shape, in the link's frame [m]."""
        own = self.vertices if self.primitive is None else primitive_corners(self.primitive)
        assert own is not None
        return transform_points(self.X_LS, own)

    def hull(self) -> Shape:
        """Return the convex hull of a mesh, with few corners; other shapes unchanged."""
        if self.vertices is None:
            return self
        points = self.vertices
        if np.ptp(points, axis=0).min() < THIN / 4.0:
            points = np.concatenate([points - THIN / 2.0, points + THIN / 2.0])

        # The farthest points along the link's axes, and along even directions.
        axes = self.X_LS[:3, :3]
        directions = np.concatenate([axes, -axes, ball_corners(1.0, CORNERS)])
        farthest = np.unique([int(np.argmax(dot(points, d))) for d in directions])
        return _with_hull(self, points[farthest])


def _with_hull(shape: Shape, points: Array) -> Shape:
    """Return a shape whose mesh is the convex hull of points (n, 3)."""
    solid = trimesh.convex.convex_hull(points)
    return replace(shape, vertices=np.array(solid.vertices), faces=np.array(solid.faces))


def read_shape(
    inspector: SceneGraphInspector, geometry: GeometryId, find_mesh: Callable[[str], Shape]
) -> Shape | None:
    """Return a shape that Drake parsed, on its body; None if it has no bounds.

    Args:
        inspector: The inspector of the scene graph.
        geometry: The shape.
        find_mesh: Returns the content of the mesh file that Drake knows by a name.

    Raises:
        HandError: If its mesh cannot be read.
    """
    shape = inspector.GetShape(geometry)
    found = Shape(X_LS=inspector.GetPoseInFrame(geometry).GetAsMatrix4())
    if isinstance(shape, Box | Cylinder | Capsule | Sphere):
        return replace(found, primitive=shape)

    # Other shapes become triangles: those of the file, or of the hull.
    if isinstance(shape, Mesh | Convex) and shape.source().is_path():
        mesh = find_mesh(shape.source().path().name)
        assert mesh.vertices is not None
        vertices = mesh.vertices * np.asarray(shape.scale3())
        return replace(found, vertices=vertices, faces=mesh.faces)
    if isinstance(shape, Ellipsoid):
        return replace(found, **ellipsoid([shape.a(), shape.b(), shape.c()]))
    corners = hull_corners(inspector, geometry)
    return None if corners is None else _with_hull(found, corners)


def ellipsoid(axes: npt.ArrayLike) -> dict[str, Any]:
    """Return vertices and faces of an ellipsoid with half axes (3,) [m]."""
    ball = trimesh.creation.icosphere(2)
    return {"vertices": np.array(ball.vertices) * np.asarray(axes), "faces": np.array(ball.faces)}


def solid_inertia(shapes: Sequence[Shape]) -> SpatialInertia:
    """Return M_LLo_L of convex shapes of a link, solids of `DENSITY`, which may overlap."""
    total = SpatialInertia.Zero()
    for shape in shapes:
        # Flat shapes have no volume, so half a millimetre is added on all sides.
        corners = shape.corners()
        solid = Convex(np.concatenate([corners - 5e-4, corners + 5e-4]).T, "hull")
        try:
            total = added(total, CalcSpatialInertia(solid, DENSITY))
        except (RuntimeError, ValueError):  # lengths whose powers overflow
            reach = float(np.abs(corners).max())
            raise HandError(
                f"model: must be a hand in metres, got a shape that reaches {reach:.3g} m from its "
                "link and has no inertia"
            ) from None
    return total


def added(one: SpatialInertia, other: SpatialInertia) -> SpatialInertia:
    """Return the inertia of two bodies about the same point, in the same axes."""
    if one.get_mass() == 0.0:
        return other
    total = one.Shift(np.zeros(3))
    total += other
    return total


def read_mesh(path: Path) -> Shape:
    """Return the content of a mesh file.

    Raises:
        HandError: If the file is missing or not a mesh, see `drakegrasp.mesh.loading`.
    """
    try:
        vertices, faces = load_surface(path)
    except MeshError as error:
        raise HandError(f"model: mesh {error}") from None
    return Shape(vertices=vertices, faces=faces)
