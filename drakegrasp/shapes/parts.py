"""Parts of shapes: sizes and positions in metres come in, watertight parts go out.

An object of a class consists of a few of these parts, combined by `drakegrasp.shapes.solids`. Parts
that are to be joined overlap.
"""

from __future__ import annotations

from itertools import product

import numpy as np
import numpy.typing as npt
import trimesh

from drakegrasp.arithmetic import dot, multiply, norm, sin_cos_deg
from drakegrasp.frames import Array
from drakegrasp.shapes.solids import (
    COARSE,
    EDGE,
    arc_length,
    at_height,
    cut,
    ellipse,
    extrude,
    fanned,
    inset,
    resample,
    revolve,
    ring_angles,
    ring_size,
    rounded_rectangle,
    skin,
    solid,
    spread_evenly,
    sweep,
)

#: Signs of the two sides, and of the four corners, of symmetrical shapes.
SIDES = (-1.0, 1.0)
CORNERS = tuple(product(SIDES, SIDES))

#: Rings of a flat end, as fractions of its outline: the triangles at the centre stay well shaped.
FLAT_END = (0.0, 0.5, 0.93)

#: Bevel at the edge of a flat end [m].
BEVEL = 0.0015


def lathe(side: npt.ArrayLike, *, edge: float = EDGE) -> trimesh.Trimesh:
    """Return the solid of revolution of a side (n, 2) of points (r, z) [m], closed at both ends.

    Args:
        side: Points from the foot to the head.
        edge: Edge length [m].
    """
    points = np.asarray(side, dtype=float)
    foot = resample([(0.0, points[0, 1]), points[0]], COARSE * edge)[:-1]
    head = resample([points[-1], (0.0, points[-1, 1])], edge)[1:]
    return revolve(np.vstack([foot, points, head]), edge=edge)


def ball(centre: npt.ArrayLike, radii: npt.ArrayLike, *, edge: float = EDGE) -> trimesh.Trimesh:
    """Return an ellipsoid.

    Args:
        centre: Centre (3,) [m].
        radii: Half-axes (3,) [m], or the radius of a sphere.
        edge: Edge length [m].
    """
    half = np.broadcast_to(np.asarray(radii, dtype=float), 3)
    count = max(6, round(np.pi * float(half.mean()) / edge))
    sine, cosine = sin_cos_deg(np.linspace(-90.0, 90.0, count + 1))
    unit = revolve(np.column_stack([cosine * half[:2].mean(), sine * half[2]]), edge=edge)
    stretch = [half[0] / half[:2].mean(), half[1] / half[:2].mean(), 1.0]
    return solid(unit.vertices * stretch + np.asarray(centre, dtype=float), unit.faces)


def rod(
    start: npt.ArrayLike,
    end: npt.ArrayLike,
    radius: float,
    end_radius: float | None = None,
    *,
    edge: float = EDGE,
) -> trimesh.Trimesh:
    """Return a round bar, or a truncated cone, with bevelled ends.

    Args:
        start: Centre (3,) of one end [m].
        end: Centre (3,) of the other end [m].
        radius: Radius at the start [m].
        end_radius: Radius at the end [m]; None: the same as at the start.
        edge: Edge length [m].
    """
    p, q = np.asarray(start, dtype=float), np.asarray(end, dtype=float)
    length = float(norm(q - p))
    tip = radius if end_radius is None else end_radius
    bevel = min(BEVEL, 0.2 * min(radius, tip), 0.2 * length)
    side = resample(
        [(radius - bevel, 0.0), (radius, bevel), (tip, length - bevel), (tip - bevel, length)], edge
    )
    upright = lathe(side, edge=edge)
    return solid(multiply(upright.vertices, _axes((q - p) / length).T) + p, upright.faces)


def post(
    low: float,
    high: float,
    radius: float,
    end_radius: float | None = None,
    *,
    at: tuple[float, float] = (0.0, 0.0),
    edge: float = EDGE,
) -> trimesh.Trimesh:
    """Return an upright `rod` from z = `low` to z = `high` [m] at the position `at` (x, y) [m]."""
    return rod((*at, low), (*at, high), radius, end_radius, edge=edge)


def tube(path: npt.ArrayLike, radius: npt.ArrayLike, *, edge: float = EDGE) -> trimesh.Trimesh:
    """Return a round bar along a curve, with flat ends.

    Args:
        path: Points (k, 3) [m], about an edge length apart.
        radius: () or (k,) [m]; zero makes an end a point.
        edge: Edge length [m].
    """
    points = np.asarray(path, dtype=float)
    radii = np.broadcast_to(np.asarray(radius, dtype=float), len(points))
    angles = ring_angles(ring_size(float(radii.max()), edge))
    tangents = np.gradient(points, arc_length(points), axis=0)
    tangents /= norm(tangents)[:, None]

    # The section turns with the path, but not around it.
    across = _axes(tangents[0])[:, 0]
    rings = []
    for point, tangent, size in zip(points, tangents, radii, strict=True):
        across = across - tangent * dot(across, tangent)
        across /= norm(across)
        other = np.cross(tangent, across)
        circle = np.outer(np.cos(angles), across) + np.outer(np.sin(angles), other)
        rings.append(point + size * circle if size > 0.0 else point[None])
    return skin(fanned(rings, points))


def hoop(path: Array, radius: float, *, edge: float) -> list[trimesh.Trimesh]:
    """Return the two parts of a round bar along a closed curve (k, 3) whose ends coincide."""
    half = len(path) // 2
    return [tube(part, radius, edge=edge) for part in (path[: half + 2], path[half - 1 :])]


def block(
    size: tuple[float, float, float],
    centre: tuple[float, float, float],
    *,
    corner: float = 0.002,
    edge: float = 1.2 * EDGE,
) -> trimesh.Trimesh:
    """Return an upright box with rounded upright edges.

    Args:
        size: Size (3,) along x, y and z [m].
        centre: Centre (3,) [m].
        corner: Radius of the upright edges [m].
        edge: Edge length [m].
    """
    (width, depth, height), (x, y, z) = size, centre
    levels = [(z + share * height, width, depth, x, y) for share in (-0.5, 0.5)]
    return pillar(levels, corner=corner, edge=edge)


def pillar(
    levels: npt.ArrayLike, *, corner: float = 0.002, edge: float = 1.2 * EDGE
) -> trimesh.Trimesh:
    """Return a solid of rounded rectangles, one above the other, with bevelled ends.

    Args:
        levels: Rows (z, width, depth) or (z, width, depth, x, y) with rising z [m].
        corner: Radius of the upright edges of the largest rectangle [m].
        edge: Edge length [m].
    """
    rows = np.asarray(levels, dtype=float)
    if rows.shape[1] == 3:
        rows = np.hstack([rows, np.zeros((len(rows), 2))])
    width, depth = rows[:, 1].max(), rows[:, 2].max()
    outline = rounded_rectangle(width, depth, corner, edge=edge) / [width, depth]

    # The bevels are a little inwards at both ends.
    rows = resample(rows, edge)
    first, last = rows[0].copy(), rows[-1].copy()
    rows[0, 0], rows[-1, 0] = first[0] + BEVEL, last[0] - BEVEL
    for row in (first, last):
        row[1:3] -= np.minimum(2.0 * BEVEL, 0.3 * row[1:3])

    def ring(row: Array, share: float = 1.0) -> Array:
        return at_height(share * outline * row[1:3], row[0], row[3:])

    low = [ring(first, share) for share in FLAT_END]
    high = [ring(last, share) for share in FLAT_END[::-1]]
    return skin([*low, ring(first), *map(ring, rows), ring(last), *high])


def prism(
    outline: npt.ArrayLike, low: float, high: float, *, top: float = 1.0, edge: float = 1.2 * EDGE
) -> trimesh.Trimesh:
    """Return an outline raised from z = `low` to z = `high` [m], with bevelled ends.

    Args:
        outline: (n, 2), closed, with all of it visible from the origin [m].
        low: Height of the lower end [m].
        high: Height of the upper end [m].
        top: Scale of the outline at the upper end.
        edge: Edge length [m].
    """
    section = np.asarray(outline, dtype=float)
    inward = 1.0 - BEVEL / float(norm(section).min())
    heights = resample([[low + BEVEL], [high - BEVEL]], edge)[:, 0]
    profile = [
        *((inward * share, low) for share in (*FLAT_END, 1.0)),
        *zip(np.linspace(1.0, top, len(heights)), heights, strict=True),
        *((inward * top * share, high) for share in (1.0, *FLAT_END[::-1])),
    ]
    return extrude(section, profile)


def scalloped(radius: float, depth: float, count: int, *, edge: float = EDGE) -> Array:
    """Return a closed outline (n, 2) with `count` round lobes and grooves `depth` [m] deep.

    Args:
        radius: Radius of the tips of the lobes [m].
        depth: Depth of the grooves [m].
        count: Number of lobes.
        edge: Edge length [m].
    """
    pieces = max(4, 2 * round(np.pi * radius / (count * edge)))
    angles = np.arange(count * pieces) * 360.0 / (count * pieces)
    sine, cosine = sin_cos_deg(angles)
    lobes = np.abs(sin_cos_deg(angles * count / 2.0)[1])
    reach = radius - depth * (1.0 - lobes)
    return np.column_stack([reach * cosine, reach * sine])


def moved(mesh: trimesh.Trimesh, offset: npt.ArrayLike, **turns: float) -> trimesh.Trimesh:
    """Return a mesh turned about axes by angles such as `x=90.0` [deg], then moved by (3,) [m]."""
    for axis, degrees in turns.items():
        mesh = rotated(mesh, axis, degrees)
    return solid(mesh.vertices + np.asarray(offset, dtype=float), mesh.faces)


def rotated(mesh: trimesh.Trimesh, axis: str, degrees: float) -> trimesh.Trimesh:
    """Return a mesh turned about an axis of its frame, "x", "y" or "z", by an angle [deg]."""
    s, c = (float(value) for value in sin_cos_deg(degrees))
    R = {
        "x": [[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]],
        "y": [[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]],
        "z": [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]],
    }[axis]
    return solid(multiply(mesh.vertices, np.transpose(R)), mesh.faces)


def _axes(direction: Array) -> Array:
    """Return a rotation matrix (3, 3) whose third column is a unit vector."""
    helper = np.array([0.0, 1.0, 0.0]) if abs(direction[1]) < 0.9 else np.array([1.0, 0.0, 0.0])
    x = np.cross(helper, direction)
    x /= norm(x)
    return np.column_stack([x, np.cross(direction, x), direction])


def vessel(
    side: npt.ArrayLike, *, wall: float, floor: float, edge: float = EDGE
) -> tuple[trimesh.Trimesh, trimesh.Trimesh]:
    """Return an open vessel, and the core that its handles must not enter.

    The core fills the cavity and half of the wall: a part that is cut by it ends inside the wall.

    Args:
        side: Outer profile (r, z) [m] from the foot, z = 0, to the rim.
        wall: Thickness of the wall, perpendicular to it [m].
        floor: Thickness of the floor [m].
        edge: Edge length outside [m].
    """
    outer = np.asarray(side, dtype=float)
    coarse = COARSE * edge
    inner = spread_evenly(inset(outer, wall, floor=floor), coarse)[::-1]
    foot = resample([(0.0, 0.0), outer[0]], coarse)[:-1]
    bottom = resample([inner[-1], (0.0, floor)], coarse)[1:]
    profile = np.vstack([foot, outer, inner, bottom])
    edges = np.full(len(profile), coarse)
    edges[len(foot) : len(foot) + len(outer)] = edge

    middle = spread_evenly(inset(outer, wall / 2.0, floor=floor / 2.0), coarse)
    top = middle[-1] + [0.0, 0.1]
    core = np.vstack([(0.0, middle[0, 1]), middle, top, (0.0, top[1])])
    return revolve(profile, edge=edges), revolve(core, edge=coarse)


def loop_handle(
    x: float, bottom: float, top: float, reach: float, radius: float, *, edge: float = EDGE
) -> trimesh.Trimesh:
    """Return a D-shaped handle in the plane y = 0, open towards -x.

    Args:
        x: Position of both ends, inside the body's wall [m].
        bottom: Height of the lower end's centre line [m].
        top: Height of the upper end's centre line [m].
        reach: Distance of the centre line's outermost point from `x` [m].
        radius: Half the thickness in the plane; the handle is 1.3 times as wide [m].
        edge: Edge length [m].
    """
    angles = np.linspace(0.0, np.pi, 200)
    s, c = np.sin(angles), np.cos(angles)
    middle, half = (top + bottom) / 2.0, (top - bottom) / 2.0
    # A power below one makes the half ellipse squarer, like a real handle.
    z = middle + half * np.sign(c) * np.abs(c) ** 0.85
    curve = np.column_stack([x + reach * s**0.7, np.zeros_like(angles), z])
    section = ellipse(radius, 1.3 * radius, edge=edge * 0.7)
    return sweep(spread_evenly(curve, edge), section)


def trimmed(part: trimesh.Trimesh, core: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return the piece of a handle that is outside of the core, without small fragments."""
    pieces = cut(part, core).split(only_watertight=True)
    return max(pieces, key=lambda piece: piece.volume)
