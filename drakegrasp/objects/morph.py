"""Morphs: one object comes in, others of its kind and of other proportions go out.

The radial morph of the Grasping 3D Database [Kleinhans2016], from whose morphs the paper's objects
come. Around an axis, with p the projection of a vertex on it, normalised to -1..1,
and r its distance from it: the distance is scaled by max(0.25, c1 + c2 p + c3 p^2), and the
projection by c4 + c5 (r / r_max)^2.

Axis and origin are our own choice: the axis is one of x, y and z, and passes through the middle of
the footprint at the height of the base. So what is flat at the base stays flat and on the table.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drakegrasp.arithmetic import norm
from drakegrasp.config import ObjectConfig
from drakegrasp.errors import MeshError
from drakegrasp.frames import Array
from drakegrasp.mesh.repair import repair_solid
from drakegrasp.mesh.self_intersection import crossing_faces
from drakegrasp.mesh.subdivision import subdivide
from drakegrasp.mesh.surfaces import Faces, diagonal, is_solid_surface, signed_volume
from drakegrasp.objects.sources import MeshSource, load_source, upright_vertices
from drakegrasp.seeding import Stream, object_key

#: Bounds of the draws: of c1 and c4, and of c2, c3 and c5 (the database's).
SCALE, CURVE = (0.75, 1.5), (-0.25, 0.25)
#: The distance is scaled by at least this (the database's).
LEAST_SCALE = 0.25
#: Longest edge of what is morphed, as a fraction of the diagonal, and faces up to which longer ones
#: are split: a long straight edge would not bend.
BEND, MAX_FACES = 0.06, 4000
#: A morph of a mesh whose faces pass through others may have so many times as many of them: a morph
#: of space keeps the curves along which they do, but not which faces lie there.
SLACK = 1.5
#: Draws of one morph before its mesh is given up.
MAX_DRAWS = 20
#: Decimals of the coordinates [m].
DECIMALS = 7
#: Least thickness of a morph.
MIN_EXTENT = 2e-3  # [m]


@dataclass(frozen=True, kw_only=True)
class Morph:
    """One draw.

    Attributes:
        axis: 0, 1 or 2 for x, y or z.
        c: The five coefficients c1 .. c5.
    """

    axis: int
    c: tuple[float, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class Original:
    """An object to make morphs of.

    Attributes:
        vertices: (n, 3) [m], +z up.
        faces: (m, 3), a closed surface.
        crossing: Number of faces that pass through others: 0 unless the mesh itself is so.
    """

    vertices: Array
    faces: Faces
    crossing: int


@dataclass(frozen=True, kw_only=True, eq=False)
class Morphed:
    """A morph of an object.

    Attributes:
        vertices: (n, 3) [m], +z up, as high above z = 0 as the original.
        faces: (m, 3).
        draws: How many draws it took; the last one was accepted.
    """

    vertices: Array
    faces: Faces
    draws: int


def draw_morph(stream: Stream) -> Morph:
    """Return the next draw of a stream."""
    (axis,) = stream.integers(3, 1).tolist()
    low = np.array([SCALE[0], CURVE[0], CURVE[0], SCALE[0], CURVE[0]])
    high = np.array([SCALE[1], CURVE[1], CURVE[1], SCALE[1], CURVE[1]])
    return Morph(axis=axis, c=tuple((low + (high - low) * stream.uniform(5)).tolist()))


def morph_points(points: Array, morph: Morph) -> Array | None:
    """Return where a morph puts the vertices of an object (n, 3) [m].

    Returns:
        The points (n, 3) [m], or None if the morph turns a part of space inside out.
    """
    # Coordinates about the middle of the footprint.
    low, high = points.min(axis=0), points.max(axis=0)
    origin = np.array([(low[0] + high[0]) / 2.0, (low[1] + high[1]) / 2.0, low[2]])
    local = points - origin
    across = [k for k in range(3) if k != morph.axis]
    along, r = local[:, morph.axis], norm(local[:, across])
    p = along / max(float(np.abs(along).max()), 1e-300)
    share = (r / max(float(r.max()), 1e-300)) ** 2

    # The two scales; space keeps its sides where the determinant is positive.
    c1, c2, c3, c4, c5 = morph.c
    radial, axial = c1 + c2 * p + c3 * p * p, c4 + c5 * share
    slope = np.where(radial > LEAST_SCALE, c2 + 2.0 * c3 * p, 0.0)
    radial = np.maximum(LEAST_SCALE, radial)
    if (axial * radial - 2.0 * c5 * share * p * slope <= 0.0).any():
        return None

    moved = np.empty_like(local)
    moved[:, across] = local[:, across] * radial[:, None]
    moved[:, morph.axis] = along * axial
    return moved + origin


def load_original(source: MeshSource) -> Original:
    """Return the repaired surface of a mesh, fine enough to bend.

    Raises:
        MeshError: If the mesh cannot be a solid or is of implausible size.
    """
    limits = ObjectConfig()
    mesh, _ = load_source(source)
    try:
        vertices = upright_vertices(mesh, source)
        if not limits.min_diagonal <= diagonal(vertices) <= limits.max_diagonal:
            raise MeshError(
                f"the diagonal must be {limits.min_diagonal:g} m to {limits.max_diagonal:g} m, "
                f"got {diagonal(vertices):.4g} m: give the file's unit"
            )
        solid = repair_solid(vertices, np.asarray(mesh.faces))
    except MeshError as reason:
        raise MeshError(f"{source.path.name}: {reason}") from reason
    fine = subdivide(solid, BEND * diagonal(solid.vertices), MAX_FACES)
    return Original(
        vertices=np.round(fine.vertices, DECIMALS) + 0.0,
        faces=fine.faces,
        crossing=len(crossing_faces(fine.vertices, fine.faces)),
    )


def morph_object(original: Original, name: str, number: int, seed: int) -> Morphed:
    """Return one morph of an object: watertight, and no more self-intersecting than it.

    Args:
        original: From `load_original`.
        name: Of the original.
        number: Of the morph among those of the original.
        seed: Of the draws.

    Raises:
        MeshError: If no draw of `MAX_DRAWS` can be used.
    """
    stream = Stream(seed, object_key(name), number)
    for draw in range(1, MAX_DRAWS + 1):
        points = morph_points(original.vertices, draw_morph(stream))
        if points is None:
            continue
        vertices = np.round(points, DECIMALS) + 0.0
        if _is_sound(vertices, original):
            return Morphed(vertices=vertices, faces=original.faces, draws=draw)
    raise MeshError(
        f"{name}: one of {MAX_DRAWS} draws must give a morph that does not pass through itself, "
        "got none"
    )


def _is_sound(vertices: Array, original: Original) -> bool:
    """Return whether a morph's surface bounds a solid and crosses no more than the original's."""
    return (
        is_solid_surface(original.faces)
        and signed_volume(vertices, original.faces) > 0.0
        and float(np.ptp(vertices, axis=0).min()) > MIN_EXTENT
        and len(crossing_faces(vertices, original.faces)) <= SLACK * original.crossing
    )
