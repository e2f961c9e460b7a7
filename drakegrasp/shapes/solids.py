"""Curves, solids built from them, and solids combined from others: watertight meshes [m].

A curve is a polyline: corners and sizes in metres come in, evenly spaced points go out. It is
either a profile (r, z) that is revolved about z, or an outline (x, y) that is moved along a path.

`trimesh.creation` is not enough: its `revolve` puts the same number of vertices on every ring, so
that a stem gets slivers where a rim gets good triangles, and its `extrude_polygon` needs Shapely.
Here the number of vertices of a ring depends on its circumference.

manifold3d, through trimesh, cuts triangles where surfaces meet; it leaves slivers there, and long
triangles in flat faces. Both are repaired, since they would only cost contact patches. Nothing is
random.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import numpy.typing as npt
import trimesh
from scipy.interpolate import PchipInterpolator

from drakegrasp.arithmetic import dot, norm, sin_cos_deg
from drakegrasp.frames import Array
from drakegrasp.mesh.surfaces import Faces, from_manifold, is_solid_surface, to_manifold

#: Number of decimals to which vertices are rounded [m], in files as well. This also hides the
#: differences of rounding between machines.
DECIMALS = 7

#: Points nearer to the axis than this are on it, and no edge is shorter than this [m].
ON_AXIS = 1e-9

#: Normal of the plane y = 0.
ACROSS = (0.0, 1.0, 0.0)

#: Usual edge length where fingers touch [m], which is below the width of a fingertip.
EDGE = 0.006

#: Edge lengths of objects with many parts, and of large flat sides [m].
BROAD, LARGE = 1.3 * EDGE, 1.8 * EDGE

#: Edges inside a cavity or below a foot are longer by this factor, since no finger touches them.
COARSE = 1.7

#: Possible numbers of points of a ring: few, so that neighbouring rings mostly have equal numbers.
RING_SIZES = np.array([8, 12, 16, 24, 32, 48, 64])

#: A piece of a curve starts at the end of the previous piece if they are this close [m].
MEETS = 1e-9

#: Distance from its ends at which an inset profile starts to follow the original profile [m].
OVERLAP = 0.001


# Curves


def resample(points: npt.ArrayLike, step: float) -> Array:
    """Return a polyline (n, d) with its corners kept and no piece longer than `step` [m]."""
    corners = np.asarray(points, dtype=float)
    pieces = [corners[:1]]
    for start, end in pairwise(corners):
        count = max(1, int(np.ceil(np.linalg.norm(end - start) / step - 1e-6)))
        fractions = np.linspace(0.0, 1.0, count + 1)[1:, None]
        pieces.append(start + fractions * (end - start))
    return np.concatenate(pieces)


def spaced(step: float, *knots: float) -> Array:
    """Return numbers (n,) from knot to knot with steps of at most `step`."""
    return resample([[knot] for knot in knots], step)[:, 0]


def scaled(shares: npt.ArrayLike, *sizes: float) -> Array:
    """Return points (n, d) whose coordinates are given as fractions of the sizes (d,) [m]."""
    return np.asarray(shares, dtype=float) * sizes


def joined(*pieces: npt.ArrayLike) -> Array:
    """Return curves (n, d) as one curve; a common end point of two pieces occurs once."""
    curve = np.asarray(pieces[0], dtype=float)
    for piece in pieces[1:]:
        points = np.asarray(piece, dtype=float)
        meets = np.abs(points[0] - curve[-1]).max() < MEETS
        curve = np.vstack([curve, points[int(meets) :]])
    return curve


def smooth(points: npt.ArrayLike, step: float) -> Array:
    """Return points (n, d) about `step` [m] apart on a curve through `points` (k, d).

    The curve is a monotone cubic in the chord length: it does not overshoot.
    """
    knots = np.asarray(points, dtype=float)
    fine = PchipInterpolator(arc_length(knots), knots)(np.linspace(0.0, arc_length(knots)[-1], 400))
    return spread_evenly(fine, step)


def between(knots: npt.ArrayLike, at: npt.ArrayLike) -> Array:
    """Return the values at `at` (n,) of a monotone cubic through knots (k, 2) or (k, 1 + d)."""
    rows = np.asarray(knots, dtype=float)
    values = rows[:, 1] if rows.shape[1] == 2 else rows[:, 1:]
    return np.asarray(PchipInterpolator(rows[:, 0], values)(at))


def inset(side: npt.ArrayLike, distance: float, *, floor: float) -> Array:
    """Return the profile `side` (n, 2) moved inwards by `distance` [m] and cut at z = `floor` [m].

    `side` is a profile (r, z) with rising z. The result ends at the same height.
    """
    fine = resample(side, 0.0005)
    height = fine[-1, 1]
    tangent = np.gradient(fine, arc_length(fine), axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    moved = fine + distance * np.column_stack([-tangent[:, 1], tangent[:, 0]])
    moved = moved[np.argsort(moved[:, 1], kind="stable")]
    inside = moved[(moved[:, 1] > floor + OVERLAP) & (moved[:, 1] < height - OVERLAP)]
    ends = [(np.interp(z, moved[:, 1], moved[:, 0]), z) for z in (floor, height)]
    return np.vstack([ends[0], inside, ends[1]])


def bevelled(radius: float, height: float, bevel: float) -> list[tuple[float, float]]:
    """Return the corners (r, z) of an upright wall with bevelled foot and head, off the axis."""
    foot = foot_and_wall(radius, height - bevel, bevel)
    return [*foot, (radius - bevel, height)]


def foot_and_wall(radius: float, height: float, bevel: float) -> list[tuple[float, float]]:
    """Return the corners (r, z) of an upright wall with a bevelled foot only."""
    return [(radius - bevel, 0.0), (radius, bevel), (radius, height)]


def arch(
    a: float, b: float, *, x: float = 0.0, z: float, degrees: tuple[float, float], count: int
) -> Array:
    """Return an arc (count, 3) of an ellipse of half-axes `a` and `b` [m] in the plane y = 0.

    Args:
        a: Half-axis along x [m].
        b: Half-axis along z [m].
        x: Coordinate of the centre [m].
        z: Coordinate of the centre [m].
        degrees: Angles at which the arc starts and ends [deg].
        count: Number of points.
    """
    s, c = sin_cos_deg(np.linspace(*degrees, count))
    return np.column_stack([x + a * c, 0.0 * c, z + b * s])


def ellipse(a: float, b: float, *, edge: float) -> Array:
    """Return an ellipse (n, 2) with half-axes `a` and `b` [m], counter-clockwise."""
    angles = ring_angles(ring_size((a + b) / 2.0, edge))
    return np.column_stack([a * np.cos(angles), b * np.sin(angles)])


def rounded_polygon(corners: npt.ArrayLike, radius: float, *, edge: float) -> Array:
    """Return a convex polygon (n, 2), counter-clockwise, with corners rounded by `radius` [m]."""
    points = np.asarray(corners, dtype=float)
    outline = []
    for before, corner, after in zip(
        np.roll(points, 1, axis=0), points, np.roll(points, -1, axis=0), strict=True
    ):
        u = (before - corner) / np.linalg.norm(before - corner)
        v = (after - corner) / np.linalg.norm(after - corner)
        half = np.arccos(np.clip(u @ v, -1.0, 1.0)) / 2.0
        centre = corner + radius / np.sin(half) * (u + v) / np.linalg.norm(u + v)
        touch = corner + u * radius / np.tan(half) - centre
        start = np.arctan2(touch[1], touch[0])
        turn = np.pi - 2.0 * half
        count = max(2, int(np.ceil(radius * turn / edge)))
        angles = start + np.linspace(0.0, turn, count + 1)
        outline.append(centre + radius * np.column_stack([np.cos(angles), np.sin(angles)]))
    ring = np.concatenate(outline)
    return resample(np.vstack([ring, ring[:1]]), edge)[:-1]


def rounded_rectangle(width: float, depth: float, radius: float, *, edge: float) -> Array:
    """Return a centred rectangle (n, 2) of `width` x `depth` [m] with rounded corners."""
    x, y = width / 2.0, depth / 2.0
    return rounded_polygon([(x, -y), (x, y), (-x, y), (-x, -y)], radius, edge=edge)


def ring_size(radius: float, edge: float) -> int:
    """Return the number of points of a ring of `radius` [m] for edges of about `edge` [m]."""
    wanted = 2.0 * np.pi * radius / edge
    return int(RING_SIZES[np.argmin(np.abs(np.log(RING_SIZES / wanted)))])


def ring_angles(count: int) -> Array:
    """Return the angles (count,) [rad] of a ring, from 0."""
    return 2.0 * np.pi * np.arange(count) / count


def arc_length(points: Array) -> Array:
    """Return the length along a polyline (n, d) at each of its points, (n,) [m]."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])


def spread_evenly(points: Array, step: float) -> Array:
    """Return points (m, d) spread evenly along a polyline (n, d), about `step` [m] apart."""
    s = arc_length(points)
    even = np.linspace(0.0, s[-1], max(1, round(s[-1] / step)) + 1)
    return np.column_stack([np.interp(even, s, column) for column in points.T])


# Solids


def solid(vertices: npt.ArrayLike, faces: npt.ArrayLike) -> trimesh.Trimesh:
    """Return a mesh with outward winding, rounded vertices, and both in a canonical order.

    The order depends only on the shape, not on the numbering by a library.
    """
    mesh = trimesh.Trimesh(
        np.round(np.asarray(vertices, dtype=float), DECIMALS) + 0.0, faces, process=False
    )
    mesh.merge_vertices(digits_vertex=DECIMALS)
    mesh.update_faces(mesh.nondegenerate_faces(height=0.0))
    mesh.remove_unreferenced_vertices()
    if mesh.volume < 0.0:
        mesh.invert()

    # Sort the vertices, start each face at its lowest vertex, then sort the faces.
    order = np.lexsort(mesh.vertices.T[::-1])
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    ranked = rank[mesh.faces]
    first = ranked.argmin(axis=1)
    ranked = np.take_along_axis(ranked, (first[:, None] + np.arange(3)) % 3, axis=1)
    ranked = ranked[np.lexsort(ranked.T[::-1])]
    return trimesh.Trimesh(mesh.vertices[order], ranked, process=False)


# From curves


def revolve(
    profile: npt.ArrayLike, *, edge: float | npt.ArrayLike = EDGE, closed: bool = False
) -> trimesh.Trimesh:
    """Return the solid of revolution about z of a profile (n, 2) of points (r, z) [m].

    Args:
        profile: Outline from one point of the axis to another, or, if `closed`, a loop off the
            axis. Its points become rings, see `resample` and `smooth`.
        edge: Desired edge length along a ring [m], one for all rings or one per point.
        closed: Whether the last ring is joined to the first.
    """
    points = np.asarray(profile, dtype=float)
    edges = np.broadcast_to(np.asarray(edge, dtype=float), len(points))
    rings = []
    for (r, z), length in zip(points, edges, strict=True):
        circle = ellipse(r, r, edge=length) if r >= ON_AXIS else np.zeros((1, 2))
        rings.append(at_height(circle, z))
    return skin(rings, closed=closed)


def sweep(
    path: npt.ArrayLike,
    section: npt.ArrayLike,
    *,
    normal: npt.ArrayLike = ACROSS,
    scale: npt.ArrayLike = 1.0,
) -> trimesh.Trimesh:
    """Return the solid of a section that moves along a plane path, with flat ends.

    Args:
        path: Points (k, 3) [m] in a plane.
        section: Closed outline (n, 2) [m] around its origin: the first coordinate is in the plane
            of the path, across it; the second is along `normal`.
        normal: Unit normal (3,) of the plane of the path.
        scale: Factor on the section, (), (k,) or, with one per coordinate of the section, (k, 2).
            Zero makes an end a point.
    """
    points, outline = np.asarray(path, dtype=float), np.asarray(section, dtype=float)
    factors = np.asarray(scale, dtype=float)
    if factors.ndim < 2:
        factors = np.repeat(np.broadcast_to(factors, len(points))[:, None], 2, axis=1)
    binormal = np.asarray(normal, dtype=float)
    tangent = np.gradient(points, arc_length(points), axis=0)
    across = np.cross(binormal, tangent)
    across /= np.linalg.norm(across, axis=1, keepdims=True)

    rings = []
    for point, side, (a, b) in zip(points, across, factors, strict=True):
        ring = point + np.outer(a * outline[:, 0], side) + np.outer(b * outline[:, 1], binormal)
        rings.append(ring if a > 0.0 else point[None])
    return skin(fanned(rings, points))


def bar(
    start: npt.ArrayLike,
    end: npt.ArrayLike,
    section: npt.ArrayLike,
    *,
    normal: npt.ArrayLike = ACROSS,
    scale: npt.ArrayLike = ((0.0, 1.0), (1.0, 1.0)),
    edge: float = EDGE,
) -> trimesh.Trimesh:
    """Return a straight bar with rounded ends.

    Args:
        start: Centre (3,) [m] of one end.
        end: Centre (3,) [m] of the other end.
        section: As for `sweep`.
        normal: As for `sweep`.
        scale: Thickness along the bar: pairs (fraction of the length, factor).
        edge: Edge length along the bar [m].
    """
    p, q = np.asarray(start, dtype=float), np.asarray(end, dtype=float)
    length = float(np.linalg.norm(q - p))
    along = np.linspace(0.0, 1.0, max(4, round(length / edge)) + 1)
    factor = between(scale, along)
    # The end rings are smaller, so that the ends have a bevel instead of a sharp edge.
    factor[[0, -1]] *= 0.8
    return sweep(p + along[:, None] * (q - p), section, normal=normal, scale=factor)


def extrude(section: npt.ArrayLike, profile: npt.ArrayLike) -> trimesh.Trimesh:
    """Return a section (n, 2) [m] raised along z by a profile (k, 2) of points (scale, z [m])."""
    outline = np.asarray(section, dtype=float)
    levels = np.asarray(profile, dtype=float)
    return skin([at_height(scale * outline, z) for scale, z in levels])


def at_height(outline: Array, z: float, middle: npt.ArrayLike = (0.0, 0.0)) -> Array:
    """Return an outline (n, 2) [m] as a ring (n, 3) at a height; one point if it has no size.

    Args:
        outline: Outline around its origin.
        z: Height of the ring [m].
        middle: Position of the outline's origin, (2,) [m].
    """
    flat = outline if outline.any() else outline[:1]
    return np.column_stack([flat + np.asarray(middle, dtype=float), np.full(len(flat), z)])


def grid_box(extents: npt.ArrayLike, *, centre: npt.ArrayLike, edge: float) -> trimesh.Trimesh:
    """Return a box of `extents` (3,) [m] around `centre` (3,) [m] whose faces are grids."""
    size = np.asarray(extents, dtype=float)
    counts = np.maximum(1, np.round(size / edge).astype(int))
    vertices: list[Array] = []
    faces: list[Faces] = []
    total = 0
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        i, j = np.meshgrid(np.arange(counts[u] + 1), np.arange(counts[v] + 1), indexing="ij")
        number = np.arange(i.size).reshape(i.shape)
        a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
        quads = np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)
        for side in (0.0, 1.0):
            points = np.empty((i.size, 3))
            points[:, axis] = side
            points[:, u], points[:, v] = i.ravel() / counts[u], j.ravel() / counts[v]
            vertices.append((points - 0.5) * size + np.asarray(centre, dtype=float))
            faces.append((quads if side else quads[:, ::-1]) + total)
            total += i.size
    return solid(np.concatenate(vertices), np.concatenate(faces))


def capped(rings: list[Array]) -> trimesh.Trimesh:
    """Return the surface through rings (n_i, 3) of vertices [m], with a fan at both ends."""
    return skin(fanned(rings, np.array([ring.mean(axis=0) for ring in rings])))


def fanned(rings: list[Array], centres: Array) -> list[Array]:
    """Return rings (n_i, 3) with the centre (k, 3) [m] of each end that is not a tip: a fan."""
    first = [centres[:1]] if len(rings[0]) > 1 else []
    last = [centres[-1:]] if len(rings[-1]) > 1 else []
    return [*first, *rings, *last]


def skin(rings: list[Array], *, closed: bool = False) -> trimesh.Trimesh:
    """Return the surface through rings (n_i, 3) of vertices [m].

    All rings begin at the same angle; a ring of one point is a tip.

    Args:
        rings: Rings in order.
        closed: Whether the last ring is joined to the first.
    """
    points = np.concatenate(rings)
    numbers = np.split(np.arange(len(points)), np.cumsum([len(ring) for ring in rings])[:-1])
    faces: list[tuple[int, int, int]] = []
    for lower, upper in pairwise([*numbers, *numbers[:1]] if closed else numbers):
        faces += _zip_rings(lower.tolist(), upper.tolist())
    return solid(points, np.array(faces))


def _zip_rings(a: list[int], b: list[int]) -> list[tuple[int, int, int]]:
    """Return the triangles between two rings of vertex numbers; the ring behind steps next."""
    a_steps, b_steps = (len(ring) if len(ring) > 1 else 0 for ring in (a, b))
    faces = []
    i = j = 0
    while i < a_steps or j < b_steps:
        low, high = a[i % len(a)], b[j % len(b)]
        if j == b_steps or (i < a_steps and (2 * i + 1) * len(b) <= (2 * j + 1) * len(a)):
            i += 1
            faces.append((low, a[i % len(a)], high))
        else:
            j += 1
            faces.append((low, b[j % len(b)], high))
    return faces


# Combined solids

#: Triangles whose height is below this [m] are removed after a Boolean operation, since their
#: normals are unreliable.
SLIVER = 0.0005

#: Four points are in one plane if they are closer to it than this [m]; files round to a tenth of
#: it.
FLAT = 1e-6

#: Maximum number of passes over all slivers, or over all edges of flat faces; a seam needs dozens.
MAX_PASSES = 100


def fuse(*parts: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return the union of overlapping solids."""
    return _from_boolean(trimesh.boolean.union(list(parts), engine="manifold"))


def cut(body: trimesh.Trimesh, *tools: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return a solid without the space that the tools occupy."""
    return _from_boolean(trimesh.boolean.difference([body, *tools], engine="manifold"))


def flat_base(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return the part of a mesh above z = 0."""
    low, high = mesh.bounds
    size = np.append(1.5 * (high - low)[:2], 0.2)
    middle = np.append((low + high)[:2] / 2.0, -0.1)
    return cut(mesh, grid_box(size, centre=middle, edge=1.0))


def stand(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return the mesh moved along z until its lowest point is at z = 0."""
    return solid(mesh.vertices - [0.0, 0.0, mesh.bounds[0, 2]], mesh.faces)


def _from_boolean(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return the result of a Boolean operation without the slivers along its seams."""
    # Establish a canonical order first, because the repairs below depend on the order.
    tidy = solid(mesh.vertices, mesh.faces)
    if not is_solid_surface(np.asarray(tidy.faces)):
        # Rounding has opened the surface at edges that are too short: remove these edges first.
        whole = to_manifold(np.asarray(mesh.vertices), np.asarray(mesh.faces)).as_original()
        tidy = solid(*from_manifold(whole.simplify(10.0**-DECIMALS)))
    points = np.array(tidy.vertices, dtype=float)
    faces = _even_out(points, np.array(tidy.faces, dtype=np.int64))
    refused: set[tuple[int, ...]] = set()

    # The lowest slivers come first, each away from what was repaired in the same pass.
    for _ in range(MAX_PASSES):
        heights = _heights(points, faces)
        low = np.flatnonzero(heights < SLIVER)
        order = low[np.argsort(heights[low], kind="stable")]
        slivers = [tuple(face) for face in faces[order].tolist()]
        slivers = [sliver for sliver in slivers if sliver not in refused]
        if not slivers:
            break
        touched: set[int] = set()
        for sliver in slivers:
            if touched.isdisjoint(sliver):
                repaired = _mend(points, faces, sliver)
                if repaired is None:
                    refused.add(sliver)
                else:
                    touched |= set(faces[np.isin(faces, sliver).any(axis=1)].ravel().tolist())
                    faces = repaired
    return solid(points, _even_out(points, faces))


def _mend(points: Array, faces: Faces, sliver: tuple[int, ...]) -> Faces | None:
    """Return the faces without a sliver, or None if it must stay; `points` may be moved.

    The sliver's shortest edge is collapsed if that is short, else its longest edge is flipped.
    """
    corners = points[list(sliver)]
    lengths = norm(np.roll(corners, -1, axis=0) - corners)
    if lengths.min() < 2.0 * SLIVER:
        short = int(lengths.argmin())
        a, b = sliver[short], sliver[(short + 1) % 3]
        repaired = _collapse(points, faces, a, b)
        if repaired is not None:
            points[a] = (points[a] + points[b]) / 2.0
        return repaired
    long = int(lengths.argmax())
    return _flip(points, faces, sliver[long], sliver[(long + 1) % 3])


def _even_out(points: Array, faces: Faces) -> Faces:
    """Return the faces with edges flipped in flat places, as in a Delaunay triangulation.

    An edge between two faces of one plane is flipped if the angles opposite to it add up to more
    than half a turn. Equal angles, as in grids, are not changed.
    """
    for _ in range(MAX_PASSES):
        a, b, left, right, first, second = _edges(faces)
        excess = -(_cotangent(points, a, b, left) + _cotangent(points, a, b, right))
        flat = _height_above(points, a, b, left, right) < FLAT
        wanted = np.flatnonzero(flat & (excess > 1e-3))
        if not len(wanted):
            break

        # The worst edge comes first, each face at most once per pass; the flipped edge must be new.
        known = set(zip(np.minimum(a, b).tolist(), np.maximum(a, b).tolist(), strict=True))
        order = wanted[np.argsort(-np.round(excess[wanted], 6), kind="stable")]
        used: set[int] = set()
        faces = faces.copy()
        for k in order.tolist():
            pair, edge = (int(first[k]), int(second[k])), sorted((int(left[k]), int(right[k])))
            if used & set(pair) or tuple(edge) in known:
                continue
            faces[list(pair)] = [(a[k], right[k], left[k]), (right[k], b[k], left[k])]
            known.add((edge[0], edge[1]))
            used |= set(pair)
        if not used:
            break
    return faces


def _edges(faces: Faces) -> tuple[Faces, Faces, Faces, Faces, Faces, Faces]:
    """Return the edges of a closed surface, each once.

    Returns:
        The ends a and b of the edges in the order of the first face, the vertices opposite to them
        in the first and in the second face, and the two faces; (n,) each.
    """
    starts, ends = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    opposite = np.roll(faces, -2, axis=1).ravel()
    face = np.repeat(np.arange(len(faces)), 3)
    order = np.lexsort((starts > ends, np.maximum(starts, ends), np.minimum(starts, ends)))
    one, two = order[0::2], order[1::2]
    return starts[one], ends[one], opposite[one], opposite[two], face[one], face[two]


def _cotangent(points: Array, a: Faces, b: Faces, apex: Faces) -> Array:
    """Return the cotangents (n,) of the angles at `apex` between `a` and `b`."""
    u, v = points[a] - points[apex], points[b] - points[apex]
    return dot(u, v) / np.maximum(norm(np.cross(u, v)), ON_AXIS**2)


def _height_above(points: Array, a: Faces, b: Faces, left: Faces, right: Faces) -> Array:
    """Return the distance (n,) [m] of `right` from the plane of `a`, `b` and `left`."""
    normal = np.cross(points[b] - points[a], points[left] - points[a])
    above = np.abs(dot(points[right] - points[a], normal))
    return np.asarray(above / np.maximum(norm(normal), ON_AXIS**2))


def _heights(points: Array, faces: Faces) -> Array:
    """Return the height (n,) [m] of each face above its longest edge."""
    corners = points[faces]
    longest = norm(np.roll(corners, -1, axis=1) - corners).max(axis=1)
    return np.asarray(norm(_normals(points, faces)) / np.maximum(longest, ON_AXIS))


def _normals(points: Array, faces: Faces) -> Array:
    """Return normals (n, 3) of faces, each with the length of twice the face's area [m^2]."""
    p, q, r = np.moveaxis(points[faces], 1, 0)
    return np.asarray(np.cross(q - p, r - p))


def _collapse(points: Array, faces: Faces, a: int, b: int) -> Faces | None:
    """Return the faces with vertex `b` merged into `a`.

    None if the merge would pinch the surface, or if moving both vertices to their midpoint would
    fold it.
    """
    around_a = set(faces[(faces == a).any(axis=1)].ravel().tolist())
    around_b = set(faces[(faces == b).any(axis=1)].ravel().tolist())
    if len((around_a & around_b) - {a, b}) != 2:
        return None
    joined = np.where(faces == b, a, faces)
    kept = (joined != np.roll(joined, 1, axis=1)).all(axis=1)

    # A face that turns over would cross its neighbours; a sliver may turn over.
    touched = np.flatnonzero(kept & (joined == a).any(axis=1))
    touched = touched[_heights(points, faces[touched]) > SLIVER]
    met = points.copy()
    met[a] = (points[a] + points[b]) / 2.0
    turn = dot(_normals(points, faces[touched]), _normals(met, joined[touched]))
    return None if (turn <= 0.0).any() else joined[kept]


def _flip(points: Array, faces: Faces, a: int, b: int) -> Faces | None:
    """Return the faces with the edge from `a` to `b` flipped, or None if that does not help."""
    pair = np.flatnonzero((faces == a).any(axis=1) & (faces == b).any(axis=1))
    start, end, apex = (np.roll(faces[pair], -k, axis=1) for k in range(3))
    left, right = (int(apex[(start == p) & (end == q)][0]) for p, q in ((a, b), (b, a)))
    if ((faces == left).any(axis=1) & (faces == right).any(axis=1)).any():
        return None

    # The new pair must be higher, and face the same way as the old pair.
    turned = np.array([(a, right, left), (right, b, left)])
    before, after = (_heights(points, either).min() for either in (faces[pair], turned))
    whole = _normals(points, faces[pair]).sum(axis=0)
    if after <= before or (dot(_normals(points, turned), whole) <= 0.0).any():
        return None
    result = faces.copy()
    result[pair] = turned
    return result
