"""Surfaces of triangles: vertices in metres and faces come in, measures of them go out.

Vertices are (n, 3) [m], faces (m, 3), counter-clockwise seen from outside. Nothing here
changes a shape.
"""

from __future__ import annotations

from dataclasses import dataclass

import manifold3d
import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import dot, norm
from drakegrasp.errors import MeshError
from drakegrasp.frames import Array

Faces = npt.NDArray[np.int64]

#: Points of the winding-number check, and its budget of point-triangle pairs.
CHECK_POINTS = 2000
CHECK_BUDGET = 20_000_000
#: Distance from the faces at which thin objects are checked, as a part of the diagonal.
NEAR = 3e-4
#: Part of its volume that a surface may enclose twice or backwards: an error of the mass
#: properties, not of the surface that is touched (slots of real toasters are dents deeper
#: than the wall).
MAX_OVERLAP = 0.05


@dataclass(frozen=True, kw_only=True, eq=False)
class Solid:
    """A mended surface: vertices (n, 3) [m], faces (m, 3), and what was mended."""

    vertices: Array
    faces: Faces
    notes: tuple[str, ...] = ()


# Measures


def signed_volume(vertices: Array, faces: Faces) -> float:
    """Return the volume enclosed by a closed surface [m^3], negative if inside out."""
    a, b, c = np.moveaxis((vertices - vertices.mean(axis=0))[faces], 1, 0)
    return float(dot(a, np.cross(b, c)).sum() / 6.0)


def face_areas(vertices: Array, faces: Faces) -> Array:
    """Return the area of every triangle (m,) [m^2]."""
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    return norm(np.cross(b - a, c - a)) / 2.0


def diagonal(vertices: Array) -> float:
    """Return the diagonal of the bounding box [m]."""
    return float(norm(np.ptp(vertices, axis=0)))


def is_solid_surface(faces: Faces) -> bool:
    """Return whether each edge has two faces that run along it in opposite directions."""
    halves = half_edges(faces)
    count = int(halves.max()) + 1
    forward = np.unique(halves[:, 0] * count + halves[:, 1])
    backward = np.unique(halves[:, 1] * count + halves[:, 0])
    return len(forward) == len(halves) and np.array_equal(forward, backward)


def half_edges(faces: Faces) -> Faces:
    """Return the half-edges (3m, 2); half-edge 3f + i leaves corner i of face f."""
    return faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)


# Inside and outside


def winding_numbers(p_OQ: Array, vertices: Array, faces: Faces) -> Array:
    """Return how often a surface winds around points (k, 3), as (k,).

    1 is inside, 0 outside; other integers mean a surface that is inside out or passes
    through itself, and fractions an open one (Jacobson et al. 2013; solid angles after
    Van Oosterom and Strackee 1983).
    """
    triangles = vertices[faces]
    out = np.empty(len(p_OQ))
    step = max(1, 400_000 // len(faces))
    for start in range(0, len(p_OQ), step):
        a, b, c = np.moveaxis(triangles[None] - p_OQ[start : start + step, None, None], 2, 0)
        la, lb, lc = (norm(x) for x in (a, b, c))
        numerator = dot(a, np.cross(b, c))
        ab, bc, ca = (dot(x, y) for x, y in ((a, b), (b, c), (c, a)))
        angle = np.arctan2(numerator, la * lb * lc + ab * lc + bc * la + ca * lb)
        out[start : start + step] = angle.sum(axis=1) / (2.0 * np.pi)
    return out


def overlap_share(vertices: Array, faces: Faces, *, points: int = CHECK_POINTS) -> float:
    """Return the part of the volume that a surface encloses more than once or backwards.

    Measured at a fixed set of evenly spread points of the bounding box, or, if the
    object fills little of it, on both sides of its faces.
    """
    count = int(np.clip(CHECK_BUDGET // len(faces), min(points, 200), points))
    spread = even_points(count)
    low, size = vertices.min(axis=0), np.ptp(vertices, axis=0)
    inside, wrong = _count_wrong(low + spread * size, vertices, faces)
    if inside < count // 20:
        on_face, picked = on_faces(vertices, faces, spread[: count // 2])
        a, b, c = np.moveaxis(vertices[faces[picked]], 1, 0)
        normals = np.cross(b - a, c - a)
        normals /= np.maximum(norm(normals), 1e-300)[:, None]
        offsets = NEAR * float(norm(size)) * normals
        both_sides = np.vstack((on_face - offsets, on_face + offsets))
        inside, wrong = _count_wrong(both_sides, vertices, faces)
    return wrong / max(1, inside)


def _count_wrong(points: Array, vertices: Array, faces: Faces) -> tuple[int, int]:
    w = winding_numbers(points, vertices, faces)
    wrong = np.minimum(np.abs(w), np.abs(w - 1.0)) > 0.05
    return int((np.abs(w) > 0.5).sum()), int(wrong.sum())


def on_faces(vertices: Array, faces: Faces, spread: Array) -> tuple[Array, Faces]:
    """Return points (k, 3) [m] of a surface and the face (k,) of each.

    Args:
        vertices: (n, 3) [m].
        faces: (m, 3).
        spread: Points (k, 3) of the unit cube; even ones give points that are even over the area.
    """
    until = np.cumsum(face_areas(vertices, faces))
    picked = np.minimum(np.searchsorted(until, spread[:, 2] * until[-1]), len(faces) - 1)
    a, b, c = np.moveaxis(vertices[faces[picked]], 1, 0)
    root, part = np.sqrt(spread[:, :1]), spread[:, 1:2]
    return (1.0 - root) * a + root * (1.0 - part) * b + root * part * c, picked


def even_points(count: int) -> Array:
    """Return points (count, 3) that fill the unit cube evenly and are always the same."""
    root = 1.2207440846057596  # of x^4 = x + 1: the R3 sequence
    return np.asarray((0.5 + np.arange(1, count + 1)[:, None] / root ** np.arange(1, 4)) % 1.0)


# Other forms


def compact(vertices: Array, faces: Faces) -> tuple[Array, Faces]:
    """Drop unused vertices and keep the order of the others."""
    used, inverse = np.unique(faces, return_inverse=True)
    return vertices[used], inverse.reshape(-1, 3).astype(np.int64)


def stack(parts: list[tuple[Array, Faces]]) -> Solid:
    """Return surfaces as one, in their order and sharing no vertex."""
    offsets = np.cumsum([0] + [len(vertices) for vertices, _ in parts[:-1]])
    faces = [faces + offset for (_, faces), offset in zip(parts, offsets, strict=True)]
    return Solid(vertices=np.vstack([vertices for vertices, _ in parts]), faces=np.vstack(faces))


def to_manifold(vertices: Array, faces: Faces) -> manifold3d.Manifold:
    """Return a closed surface as Manifold's solid, for Boolean operations.

    Raises:
        MeshError: If the surface is not closed.
    """
    solid = manifold3d.Manifold(
        manifold3d.Mesh64(
            np.ascontiguousarray(vertices, dtype=np.float64),
            np.ascontiguousarray(faces, dtype=np.uint64),
        )
    )
    if solid.status() != manifold3d.Error.NoError:
        raise MeshError(f"the surface must bound a solid, got {solid.status().name}")
    return solid


def from_manifold(solid: manifold3d.Manifold) -> tuple[Array, Faces]:
    """Return the surface of a solid of Manifold's."""
    mesh = solid.to_mesh64()
    faces = np.array(mesh.tri_verts, dtype=np.int64)
    return compact(np.array(mesh.vert_properties[:, :3], dtype=np.float64), faces)
