"""Shapes of a vendor's links: primitives of Drake, and meshes.

In: the shapes that Drake parsed. Out: `Shape`s on the links. What is neither becomes the mesh of
its convex hull.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import trimesh
from pydrake.geometry import (
    Box,
    Capsule,
    Convex,
    Cylinder,
    Ellipsoid,
    GeometryId,
    Mesh,
    Role,
    SceneGraphInspector,
    Sphere,
)
from pydrake.multibody.tree import CalcSpatialInertia, SpatialInertia, UnitInertia
from scipy.spatial import cKDTree

from drakegrasp.arithmetic import dot
from drakegrasp.errors import HandError
from drakegrasp.frames import Array, transform_points
from drakegrasp.hand.draft.meshes import MeshFile
from drakegrasp.hand.shapes import ball_corners, hull_corners, primitive_corners
from drakegrasp.mesh.surfaces import Faces

#: Corners of the hull of a collision mesh: of a ball of 10 mm radius they miss less than 0.4 mm.
CORNERS = 64
#: What is thinner than this [m] is made as thick: a plane has no hull.
THIN = 4e-4
#: Points on a hull that are compared with ten times as many of its mesh: some 3 mm apart on a palm.
SAMPLES = 1000
#: Mean density of links whose model gives no mass [kg/m^3]: own choice, that of solid plastic.
DENSITY = 1200.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Shape:
    """A shape on a link: a primitive, or else a mesh.

    Attributes:
        X_LS: Pose on the link, (4, 4).
        primitive: A box, cylinder, capsule or sphere.
        vertices: (n, 3) of a mesh, in its own frame [m].
        faces: (m, 3) of a mesh.
        colour: (3,), if the model gives one.
    """

    X_LS: Array
    primitive: Box | Cylinder | Capsule | Sphere | None = None
    vertices: Array | None = None
    faces: Faces | None = None
    colour: Array | None = None

    def corners(self) -> Array:
        """Return points (n, 3) whose hull is that of the shape, in the link's frame [m]."""
        own = self.vertices if self.primitive is None else primitive_corners(self.primitive)
        assert own is not None
        return transform_points(self.X_LS, own)

    def carried(self, X_AL: Array) -> Shape:
        """Return the shape on a link A that the link is part of."""
        return replace(self, X_LS=X_AL @ self.X_LS)

    def hull(self) -> Shape:
        """Return a mesh as its convex hull of few corners; other shapes as they are."""
        if self.vertices is None:
            return self
        points = self.vertices
        if np.ptp(points, axis=0).min() < THIN / 4.0:
            points = np.concatenate([points - THIN / 2.0, points + THIN / 2.0])

        # The farthest points along even directions.
        directions = np.concatenate([np.eye(3), -np.eye(3), ball_corners(1.0, CORNERS)])
        farthest = np.unique([int(np.argmax(dot(points, d))) for d in directions])
        solid = trimesh.convex.convex_hull(points[farthest])
        return replace(self, vertices=np.array(solid.vertices), faces=np.array(solid.faces))

    def reach_beyond(self, mesh: Shape) -> float:
        """Return how far the surface of a hull is from that of its mesh at most [m]."""
        (own, _), (other, _) = (
            trimesh.sample.sample_surface(trimesh.Trimesh(s.vertices, s.faces), count, seed=0)
            for s, count in ((self, SAMPLES), (mesh, 10 * SAMPLES))
        )
        return float(cKDTree(other).query(own)[0].max())


def read_shape(
    inspector: SceneGraphInspector,
    geometry: GeometryId,
    role: Role,
    meshes: Mapping[str, MeshFile],
) -> Shape | None:
    """Return a shape that Drake parsed, on its body; None for one without bounds.

    Args:
        inspector: Describes it.
        geometry: The shape.
        role: Whether it is seen or collides.
        meshes: What the mesh files hold, by their names.
    """
    # What it is, and the colour that the model gives it.
    shape, colour = inspector.GetShape(geometry), None
    properties = inspector.GetProperties(geometry, role)
    if properties is not None and properties.HasProperty("phong", "diffuse"):
        rgba = properties.GetProperty("phong", "diffuse")
        colour = np.array([rgba.r(), rgba.g(), rgba.b()])
    found = Shape(X_LS=inspector.GetPoseInFrame(geometry).GetAsMatrix4(), colour=colour)
    if isinstance(shape, Box | Cylinder | Capsule | Sphere):
        return replace(found, primitive=shape)

    # Else triangles: of its file, or of its hull.
    if isinstance(shape, Mesh | Convex) and shape.source().is_path():
        mesh = meshes[shape.source().path().name]
        vertices = mesh.vertices * np.asarray(shape.scale3())
        colour = mesh.colour if colour is None else colour
        return replace(found, vertices=vertices, faces=mesh.faces, colour=colour)
    if isinstance(shape, Ellipsoid):
        ball = trimesh.creation.icosphere(2)
        axes = [shape.a(), shape.b(), shape.c()]
        return replace(found, vertices=np.array(ball.vertices) * axes, faces=ball.faces)
    corners = hull_corners(inspector, geometry)
    if corners is None:
        return None
    solid = trimesh.convex.convex_hull(corners)
    return replace(found, vertices=np.array(solid.vertices), faces=np.array(solid.faces))


def solid_inertia(shapes: Sequence[Shape]) -> SpatialInertia:
    """Return M_LLo_L of convex shapes of a link, solids of `DENSITY`, which may overlap."""
    total = SpatialInertia.Zero()
    for shape in shapes:
        # Flat shapes have no volume: half a millimetre around makes one.
        corners = shape.corners()
        solid = Convex(np.concatenate([corners - 5e-4, corners + 5e-4]).T, "hull")
        try:
            total = added(total, CalcSpatialInertia(solid, DENSITY))
        except (RuntimeError, ValueError):  # lengths whose powers are beyond arithmetic
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


def with_mass(inertia: SpatialInertia, mass: float) -> SpatialInertia:
    """Return the inertia of a body of the same shape and another mass [kg]."""
    return SpatialInertia(mass, inertia.get_com(), inertia.get_unit_inertia())


def point_inertia(mass: float, radius: float) -> SpatialInertia:
    """Return M_LLo_L of a ball at the origin, for a link of which nothing is known."""
    return SpatialInertia(mass, np.zeros(3), UnitInertia.SolidSphere(radius))
