"""The collision shapes of a hand's links, as convex sets of points.

Input: a hand's model. Output: for each link the corners of its collision shapes, in the link's
frame. Every shape of a hand is convex (`models/README.md`), so its corners describe it completely.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import lru_cache

import numpy as np
from pydrake.geometry import (
    Box,
    Capsule,
    Cylinder,
    GeometryId,
    SceneGraph,
    SceneGraphInspector,
    Shape,
    Sphere,
)
from pydrake.multibody.plant import MultibodyPlant
from scipy.spatial import ConvexHull

from drakegrasp.arithmetic import dot, norm, sin_cos
from drakegrasp.errors import HandError
from drakegrasp.frames import Array, transform_points
from drakegrasp.hand.file_format import Finger, HalfSpace
from drakegrasp.hand.parsing import KEPT_HANDS, ModelFile, add_model

#: Number of corners of the polygon that replaces a circle and encloses it.
CIRCLE = 16
#: A plane is parallel to a line if the component of its normal along the line is below this.
PARALLEL = 1e-9
#: Largest allowed reach of a shape from its link's origin [m]; a larger shape has wrong units.
FARTHEST = 3.0
#: Triangles with less than this twice-area are treated as lines [m^2].
SLIVER = 1e-12


@lru_cache(maxsize=KEPT_HANDS)
def link_shapes(model: ModelFile) -> dict[str, tuple[Array, ...]]:
    """Return the corners (n, 3) [m] of each collision shape of each link, in the link's frame.

    Raises:
        HandError: If a shape is not a box, cylinder, capsule, sphere or convex mesh, or is too
            large.
    """
    shapes = {}
    for link, inspector, geometries in _links(model):
        found = tuple(shape_corners(inspector, geometry) for geometry in geometries)
        reach = max((float(np.abs(corners).max()) for corners in found), default=0.0)
        if not reach <= FARTHEST:
            raise HandError(
                f"shapes of link {link!r} must be within {FARTHEST:g} m of it, got one that "
                f"reaches {reach:.3g} m: check units and scales of its meshes"
            )
        shapes[link] = found
    return shapes


@lru_cache(maxsize=KEPT_HANDS)
def link_rims(model: ModelFile) -> dict[str, Array]:
    """Return points, balls and discs whose convex hulls are exactly a link's collision shapes.

    They are in the link's frame. A row (p, a, r) of the result (n, 7) is the corner p [m] if the
    radius r is 0 [m], a ball about p if the axis a is zero, and otherwise the disc about p across
    the unit axis a.
    """
    return {
        link: np.concatenate([np.zeros((0, 7)), *[_rims(inspector, g) for g in geometries]])
        for link, inspector, geometries in _links(model)
    }


def _links(
    model: ModelFile,
) -> Iterator[tuple[str, SceneGraphInspector, Sequence[GeometryId]]]:
    """Yield each link of a model, with the inspector of its shapes, and its collision shapes."""
    plant, scene_graph = MultibodyPlant(0.0), SceneGraph()
    plant.RegisterAsSourceForSceneGraph(scene_graph)
    instance = add_model(plant, model)
    for body in map(plant.get_body, plant.GetBodyIndices(instance)):
        geometries = plant.GetCollisionGeometriesForBody(body)
        yield body.name(), scene_graph.model_inspector(), geometries


def _rims(inspector: SceneGraphInspector, geometry: GeometryId) -> Array:
    """Return the rows of `link_rims` of one shape."""
    shape = inspector.GetShape(geometry)
    if not isinstance(shape, Cylinder | Capsule | Sphere):
        corners = shape_corners(inspector, geometry)
        return np.column_stack([corners, np.zeros((len(corners), 4))])
    X_BS = inspector.GetPoseInFrame(geometry).GetAsMatrix4()
    half = 0.0 if isinstance(shape, Sphere) else shape.length() / 2.0
    ends = transform_points(X_BS, np.array([[0.0, 0.0, half], [0.0, 0.0, -half]]))
    axis = X_BS[:3, 2] if isinstance(shape, Cylinder) else np.zeros(3)
    return np.column_stack([ends, np.tile([*axis, shape.radius()], (2, 1))])


def pad_surfaces(model: ModelFile, fingers: Sequence[Finger]) -> tuple[Array, ...]:
    """Return the surface (t, 3, 3) [m] of each fingertip's pad as triangles, in its link's frame.

    The surface is the part of the surface of the convex hull of the link's shapes that is in the
    hand file's pad region. It is open at the planes of the region. A fingertip without shapes has
    no triangles.

    Raises:
        HandError: See `link_shapes`.
    """
    surfaces, shapes = [], link_shapes(model)
    for finger in fingers:
        parts = shapes[finger.fingertip]
        triangles = hull_triangles(np.concatenate(parts)) if parts else np.zeros((0, 3, 3))
        for half_space in finger.pad_region:
            triangles = _clip(triangles, half_space)
        surfaces.append(triangles)
    return tuple(surfaces)


def ray_span(corners: Array, start: Array, direction: Array) -> tuple[float, float] | None:
    """Return where a line enters and leaves the convex hull of corners; None if it misses.

    Args:
        corners: (n, 3) [m].
        start: (3,), a point on the line [m].
        direction: (3,), direction of the line; positions on the line are multiples of it, negative
            before the start.
    """
    # On the line p = start + t direction, each plane n.p + d <= 0 of the hull limits t.
    planes = ConvexHull(corners).equations
    slope, offset = planes[:, :3] @ direction, planes[:, :3] @ start + planes[:, 3]
    if (offset[np.abs(slope) < PARALLEL] > 0.0).any():
        return None
    out, into = slope >= PARALLEL, slope <= -PARALLEL
    leaves, enters = (-offset[out] / slope[out]).min(), (-offset[into] / slope[into]).max()
    return (float(enters), float(leaves)) if enters <= leaves else None


def hull_triangles(corners: Array) -> Array:
    """Return the triangles (t, 3, 3) [m] of the convex hull of corners (n, 3) [m]."""
    hull = ConvexHull(corners)
    return np.asarray(hull.points[hull.simplices])


def _clip(triangles: Array, half_space: HalfSpace) -> Array:
    """Return the part of triangles (t, 3, 3) [m] in a half-space, as triangles (s, 3, 3) [m]."""
    normal, offset = np.array(half_space[:3]), half_space[3]
    kept = []
    for triangle, heights in zip(triangles, dot(triangles, normal) - offset, strict=True):
        # Sutherland and Hodgman: keep the corners inside, and cut the edges that leave.
        corners = []
        for i, j in ((0, 1), (1, 2), (2, 0)):
            if heights[i] >= 0.0:
                corners.append(triangle[i])
            if (heights[i] >= 0.0) != (heights[j] >= 0.0):
                share = heights[i] / (heights[i] - heights[j])
                corners.append(triangle[i] + share * (triangle[j] - triangle[i]))
        kept += [(corners[0], corners[i], corners[i + 1]) for i in range(1, len(corners) - 1)]
    found = np.reshape(kept, (-1, 3, 3))

    # Edges on the plane leave triangles without area.
    sides = found[:, 1:] - found[:, :1]
    return found[norm(np.cross(sides[:, 0], sides[:, 1])) > SLIVER]


def hull_corners(inspector: SceneGraphInspector, geometry: GeometryId) -> Array | None:
    """Return the corners (n, 3) [m] of a mesh's hull in its own frame; None for a primitive."""
    hull = inspector.GetConvexHull(geometry)
    if hull is None:
        return None
    return np.array([hull.vertex(i) for i in range(hull.num_vertices())])


def shape_corners(inspector: SceneGraphInspector, geometry: GeometryId) -> Array:
    """Return the corners of a shape in its body's frame."""
    # A mesh has a hull.
    shape, corners = inspector.GetShape(geometry), hull_corners(inspector, geometry)
    if corners is None:
        corners = primitive_corners(shape)
    if corners is None:
        raise HandError(
            f"{inspector.GetName(geometry)}: must be a box, cylinder, capsule, sphere or convex "
            f"mesh, got {type(shape).__name__}"
        )
    X_BS = inspector.GetPoseInFrame(geometry).GetAsMatrix4()
    return transform_points(X_BS, corners)


def primitive_corners(shape: Shape) -> Array | None:
    """Return points (n, 3) around a primitive shape, in its frame [m]; None for another shape."""
    if isinstance(shape, Box):
        return _box(shape.size() / 2.0)
    if isinstance(shape, Cylinder):
        return _prism(shape.radius(), shape.length() / 2.0)
    if isinstance(shape, Capsule):
        ball, end = ball_corners(shape.radius()), np.array([[0.0, 0.0, shape.length() / 2.0]])
        return np.concatenate([ball + end, ball - end])
    return ball_corners(shape.radius()) if isinstance(shape, Sphere) else None


def _box(half: Array) -> Array:
    signs = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.asarray(signs * half)


def _prism(radius: float, half_length: float) -> Array:
    angles = 2.0 * np.pi * np.arange(CIRCLE) / CIRCLE
    sine, cosine = sin_cos(angles)
    ring = radius / sin_cos(np.pi / CIRCLE)[1] * np.column_stack([cosine, sine])
    ends = [np.column_stack([ring, np.full(CIRCLE, z)]) for z in (-half_length, half_length)]
    return np.concatenate(ends)


def ball_corners(radius: float, count: int = CIRCLE**2) -> Array:
    """Return points (count, 3) on a sphere about the origin [m]."""
    # A Fibonacci lattice has even spacing without poles.
    i = np.arange(count) + 0.5
    z, turn = 1.0 - 2.0 * i / count, np.pi * (1.0 + np.sqrt(5.0)) * i
    across = np.sqrt(1.0 - z**2)
    sine, cosine = sin_cos(turn)
    return radius * np.column_stack([across * cosine, across * sine, z])
