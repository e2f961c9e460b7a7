"""Parametric everyday solids: lengths in metres come in, watertight meshes go out.

The first half holds the tools (profile, revolve, sweep, grid box, fuse), the second one
function per class of object. Every mesh stands on the plane z = 0 as it would on a table,
z up; `drakegrasp.builtin` holds the table of sizes.

Why not `trimesh.creation` alone: its `revolve` puts the same number of vertices on every
ring, so that a stem gets slivers where a rim gets good triangles, and its `extrude_polygon`
needs Shapely. Here each ring has as many vertices as its circumference asks for.
Booleans are Manifold's, by trimesh. No function draws random numbers.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import numpy.typing as npt
import trimesh
from scipy.interpolate import PchipInterpolator

from drakegrasp.frames import Array

Faces = npt.NDArray[np.int64]

#: Usual edge length where fingers touch [m]: below the width of a fingertip.
EDGE = 0.006

#: Edges inside a cavity or below a foot are this much longer: no finger goes there.
COARSE = 1.7

#: Sizes of a ring. A short ladder, so that neighbouring rings mostly agree and zip up evenly.
RING_SIZES = np.array([8, 12, 16, 24, 32, 48, 64])

#: Vertices are rounded to this many decimals [m], which also removes what rounding errors
#: could make differ between machines. Files keep the same number.
DECIMALS = 7

#: How far a part that must cut through or overlap another goes beyond it [m].
OVERLAP = 0.001

#: Triangles lower than this [m] are mended after a boolean: contact normals mean little there.
SLIVER = 0.0005

#: Bound on those mends; a seam needs some dozens.
MAX_REPAIRS = 1000

#: A point nearer to the axis than this lies on it [m].
ON_AXIS = 1e-9


# Curves in the plane.


def resample(points: npt.ArrayLike, step: float) -> Array:
    """Return a polyline (n, d) with its corners kept and no piece longer than `step` [m]."""
    corners = np.asarray(points, dtype=float)
    pieces = [corners[:1]]
    for start, end in pairwise(corners):
        count = max(1, int(np.ceil(np.linalg.norm(end - start) / step - 1e-6)))
        fractions = np.linspace(0.0, 1.0, count + 1)[1:, None]
        pieces.append(start + fractions * (end - start))
    return np.concatenate(pieces)


def smooth(points: npt.ArrayLike, step: float) -> Array:
    """Return points (n, d) about `step` [m] apart on a curve through `points` (k, d).

    The curve is a monotone cubic in the chord length: it does not overshoot.
    """
    knots = np.asarray(points, dtype=float)
    fine = PchipInterpolator(_arc_length(knots), knots)(
        np.linspace(0.0, _arc_length(knots)[-1], 400)
    )
    return _even(fine, step)


def inset(side: npt.ArrayLike, distance: float, *, floor: float) -> Array:
    """Return the profile `side` (n, 2) moved inwards by `distance` [m] and cut at z = `floor` [m].

    `side` is a profile (r, z) of rising z. The result ends at the same height.
    """
    fine = resample(side, 0.0005)
    height = fine[-1, 1]
    tangent = np.gradient(fine, _arc_length(fine), axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    moved = fine + distance * np.column_stack([-tangent[:, 1], tangent[:, 0]])
    moved = moved[np.argsort(moved[:, 1], kind="stable")]
    inside = moved[(moved[:, 1] > floor + OVERLAP) & (moved[:, 1] < height - OVERLAP)]
    ends = [(np.interp(z, moved[:, 1], moved[:, 0]), z) for z in (floor, height)]
    return np.vstack([ends[0], inside, ends[1]])


def ellipse(a: float, b: float, *, edge: float) -> Array:
    """Return an ellipse (n, 2) of half-axes `a` and `b` [m], anticlockwise."""
    angles = _ring_angles(_ring_size((a + b) / 2.0, edge))
    return np.column_stack([a * np.cos(angles), b * np.sin(angles)])


def rounded_polygon(corners: npt.ArrayLike, radius: float, *, edge: float) -> Array:
    """Return a convex polygon (n, 2), anticlockwise, with its corners rounded by `radius` [m]."""
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


def _arc_length(points: Array) -> Array:
    """Return the length along a polyline (n, d) at each of its points, (n,) [m]."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])


def _even(points: Array, step: float) -> Array:
    """Return points (m, d) spread evenly along a polyline (n, d), about `step` [m] apart."""
    s = _arc_length(points)
    even = np.linspace(0.0, s[-1], max(1, round(s[-1] / step)) + 1)
    return np.column_stack([np.interp(even, s, column) for column in points.T])


def _ring_size(radius: float, edge: float) -> int:
    wanted = 2.0 * np.pi * radius / edge
    return int(RING_SIZES[np.argmin(np.abs(np.log(RING_SIZES / wanted)))])


def _ring_angles(count: int) -> Array:
    return 2.0 * np.pi * np.arange(count) / count


# Surfaces and solids.


def solid(vertices: npt.ArrayLike, faces: npt.ArrayLike) -> trimesh.Trimesh:
    """Return a mesh with outward winding, rounded vertices and a canonical order of both.

    The order depends on the shape alone, not on how a library numbered it.
    """
    mesh = trimesh.Trimesh(
        np.round(np.asarray(vertices, dtype=float), DECIMALS) + 0.0, faces, process=False
    )
    mesh.merge_vertices(digits_vertex=DECIMALS)
    mesh.update_faces(mesh.nondegenerate_faces(height=0.0))
    mesh.remove_unreferenced_vertices()
    if mesh.volume < 0.0:
        mesh.invert()

    # Sort the vertices, start each face at its lowest one, then sort the faces.
    order = np.lexsort(mesh.vertices.T[::-1])
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    ranked = rank[mesh.faces]
    first = ranked.argmin(axis=1)
    ranked = np.take_along_axis(ranked, (first[:, None] + np.arange(3)) % 3, axis=1)
    ranked = ranked[np.lexsort(ranked.T[::-1])]
    return trimesh.Trimesh(mesh.vertices[order], ranked, process=False)


def revolve(
    profile: npt.ArrayLike, *, edge: float | npt.ArrayLike = EDGE, closed: bool = False
) -> trimesh.Trimesh:
    """Return the solid of a profile (n, 2) of points (r, z) [m] turned about z.

    Args:
        profile: Outline from one point of the axis to another, or, if `closed`, a loop
            off the axis. Its points become rings: see `resample` and `smooth`.
        edge: Wanted edge length along a ring [m], one for all or one per point.
        closed: Whether the last ring joins the first.
    """
    points = np.asarray(profile, dtype=float)
    edges = np.broadcast_to(np.asarray(edge, dtype=float), len(points))
    rings: list[Array] = []
    for (r, z), length in zip(points, edges, strict=True):
        if r < ON_AXIS:
            rings.append(np.array([[0.0, 0.0, z]]))
            continue
        angles = _ring_angles(_ring_size(float(r), float(length)))
        rings.append(
            np.column_stack([r * np.cos(angles), r * np.sin(angles), np.full(len(angles), z)])
        )
    return _skin(rings, closed=closed)


def sweep(
    path: npt.ArrayLike, section: npt.ArrayLike, *, normal: npt.ArrayLike, scale: npt.ArrayLike
) -> trimesh.Trimesh:
    """Return the solid of a section moved along a plane path, with flat ends.

    Args:
        path: Points (k, 3) [m] in a plane.
        section: Closed outline (n, 2) [m] round its origin: first coordinate in the plane
            of the path, across it, second along `normal`.
        normal: Unit normal (3,) of the plane of the path.
        scale: Factor on the section, (), (k,) or, one per coordinate of it, (k, 2).
            Zero makes an end a point.
    """
    points, outline = np.asarray(path, dtype=float), np.asarray(section, dtype=float)
    factors = np.asarray(scale, dtype=float)
    if factors.ndim < 2:
        factors = np.repeat(np.broadcast_to(factors, len(points))[:, None], 2, axis=1)
    binormal = np.asarray(normal, dtype=float)
    tangent = np.gradient(points, _arc_length(points), axis=0)
    across = np.cross(binormal, tangent)
    across /= np.linalg.norm(across, axis=1, keepdims=True)

    rings = []
    for point, side, (a, b) in zip(points, across, factors, strict=True):
        ring = point + np.outer(a * outline[:, 0], side) + np.outer(b * outline[:, 1], binormal)
        rings.append(ring if a > 0.0 else point[None])
    # A flat end is a fan round its centre.
    if len(rings[0]) > 1:
        rings.insert(0, points[:1])
    if len(rings[-1]) > 1:
        rings.append(points[-1:])
    return _skin(rings, closed=False)


def extrude(section: npt.ArrayLike, profile: npt.ArrayLike) -> trimesh.Trimesh:
    """Return a section (n, 2) [m] raised along z by a profile (k, 2) of points (scale, z [m])."""
    outline = np.asarray(section, dtype=float)
    rings = []
    for scale, z in np.asarray(profile, dtype=float):
        ring = np.column_stack([scale * outline, np.full(len(outline), z)])
        rings.append(ring if scale > 0.0 else np.array([[0.0, 0.0, z]]))
    return _skin(rings, closed=False)


def grid_box(extents: npt.ArrayLike, *, centre: npt.ArrayLike, edge: float) -> trimesh.Trimesh:
    """Return a box of `extents` (3,) [m] round `centre` (3,) [m] whose faces are grids."""
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


def fuse(*parts: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return the union of overlapping solids."""
    return _from_boolean(trimesh.boolean.union(list(parts), engine="manifold"))


def cut(body: trimesh.Trimesh, *tools: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return a solid without the space of the tools."""
    return _from_boolean(trimesh.boolean.difference([body, *tools], engine="manifold"))


def stand(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return the mesh moved along z until its lowest point is at z = 0."""
    return solid(mesh.vertices - [0.0, 0.0, mesh.bounds[0, 2]], mesh.faces)


def _from_boolean(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return the result of a boolean without the slivers along its seams."""
    # Another order first: the mending below depends on it.
    tidy = solid(mesh.vertices, mesh.faces)
    points, faces = tidy.vertices.copy(), tidy.faces.copy()
    refused: set[tuple[int, ...]] = set()
    for _ in range(MAX_REPAIRS):
        lengths, heights = _edge_lengths(points, faces), _heights(points, faces)
        slivers = [
            k for k in np.flatnonzero(heights < SLIVER) if tuple(faces[k].tolist()) not in refused
        ]
        if not slivers:
            break
        k = min(slivers, key=lambda face: float(heights[face]))
        sliver = tuple(faces[k].tolist())
        if lengths[k].min() < 2.0 * SLIVER:
            short = int(lengths[k].argmin())
            a, b = sliver[short], sliver[(short + 1) % 3]
            mended = _collapse(faces, a, b)
            if mended is not None:
                points[a] = (points[a] + points[b]) / 2.0
        else:
            long = int(lengths[k].argmax())
            mended = _flip(points, faces, sliver[long], sliver[(long + 1) % 3])
        if mended is None:
            refused.add(sliver)
        else:
            faces = mended
    return solid(points, faces)


def _edge_lengths(points: Array, faces: Faces) -> Array:
    """Return the lengths (n, 3) [m] of the edges that start at each corner of each face."""
    corners = points[faces]
    return np.asarray(np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2))


def _heights(points: Array, faces: Faces) -> Array:
    """Return the height (n,) [m] of each face above its longest edge."""
    p, q, r = np.moveaxis(points[faces], 1, 0)
    doubled = np.linalg.norm(np.cross(q - p, r - p), axis=1)
    return np.asarray(doubled / np.maximum(_edge_lengths(points, faces).max(axis=1), ON_AXIS))


def _collapse(faces: Faces, a: int, b: int) -> Faces | None:
    """Return the faces with vertex `b` made one with `a`, None if that would pinch the surface."""
    around_a = set(faces[(faces == a).any(axis=1)].ravel().tolist())
    around_b = set(faces[(faces == b).any(axis=1)].ravel().tolist())
    if len((around_a & around_b) - {a, b}) != 2:
        return None
    joined = np.where(faces == b, a, faces)
    return joined[(joined != np.roll(joined, 1, axis=1)).all(axis=1)]


def _flip(points: Array, faces: Faces, a: int, b: int) -> Faces | None:
    """Return the faces with the edge from `a` to `b` turned, None if that mends nothing."""
    pair = np.flatnonzero((faces == a).any(axis=1) & (faces == b).any(axis=1))
    left, right = (
        next(
            int(face[(i + 2) % 3])
            for face in faces[pair]
            for i in range(3)
            if face[i] == start and face[(i + 1) % 3] == end
        )
        for start, end in ((a, b), (b, a))
    )
    if ((faces == left).any(axis=1) & (faces == right).any(axis=1)).any():
        return None
    turned = faces.copy()
    turned[pair] = [(a, right, left), (right, b, left)]
    before, after = (_heights(points, either[pair]).min() for either in (faces, turned))
    return turned if after > before else None


def _skin(rings: list[Array], *, closed: bool) -> trimesh.Trimesh:
    """Return the surface through rings (n_i, 3) that start alike; one point is a tip."""
    starts = np.cumsum([0, *(len(ring) for ring in rings)])
    faces: list[tuple[int, int, int]] = []
    pairs = [(k, k + 1) for k in range(len(rings) - 1)]
    if closed:
        pairs.append((len(rings) - 1, 0))
    for lower, upper in pairs:
        faces += _zip_rings(
            int(starts[lower]), len(rings[lower]), int(starts[upper]), len(rings[upper])
        )
    return solid(np.concatenate(rings), np.array(faces))


def _zip_rings(a0: int, a_size: int, b0: int, b_size: int) -> list[tuple[int, int, int]]:
    """Return the triangles between two rings of vertex numbers, stepping on the one behind."""
    a_steps, b_steps = (size if size > 1 else 0 for size in (a_size, b_size))
    faces = []
    i = j = 0
    while i < a_steps or j < b_steps:
        a, b = a0 + i % a_size, b0 + j % b_size
        if j == b_steps or (i < a_steps and (2 * i + 1) * b_size <= (2 * j + 1) * a_size):
            faces.append((a, a0 + (i + 1) % a_size, b))
            i += 1
        else:
            faces.append((a, b0 + (j + 1) % b_size, b))
            j += 1
    return faces


# Parts that several classes share.


def vessel(
    side: npt.ArrayLike, *, wall: float, floor: float, edge: float = EDGE
) -> tuple[trimesh.Trimesh, trimesh.Trimesh]:
    """Return an open vessel and the core that its handles must keep clear of.

    The core fills the cavity and half of the wall: what is cut by it ends inside the wall.

    Args:
        side: Outer profile (r, z) [m] from the foot, z = 0, to the rim.
        wall: Thickness of the wall, across it [m].
        floor: Thickness of the floor [m].
        edge: Edge length outside [m].
    """
    outer = np.asarray(side, dtype=float)
    coarse = COARSE * edge
    inner = _even(inset(outer, wall, floor=floor), coarse)[::-1]
    foot = resample([(0.0, 0.0), outer[0]], coarse)[:-1]
    bottom = resample([inner[-1], (0.0, floor)], coarse)[1:]
    profile = np.vstack([foot, outer, inner, bottom])
    edges = np.full(len(profile), coarse)
    edges[len(foot) : len(foot) + len(outer)] = edge

    middle = _even(inset(outer, wall / 2.0, floor=floor / 2.0), coarse)
    top = middle[-1] + [0.0, 0.1]
    core = np.vstack([(0.0, middle[0, 1]), middle, top, (0.0, top[1])])
    return revolve(profile, edge=edges), revolve(core, edge=coarse)


def loop_handle(
    *, x: float, top: float, bottom: float, reach: float, radius: float, edge: float = EDGE
) -> trimesh.Trimesh:
    """Return a D-shaped handle in the plane y = 0, open towards -x.

    Args:
        x: Where both ends lie, inside the body's wall [m].
        top: Height of the upper end's centre line [m].
        bottom: Height of the lower end's centre line [m].
        reach: How far the centre line goes beyond `x` [m].
        radius: Half the thickness in the plane; the handle is 1.3 times as wide [m].
        edge: Edge length [m].
    """
    angles = np.linspace(0.0, np.pi, 200)
    middle, half = (top + bottom) / 2.0, (top - bottom) / 2.0
    # A power below one squares the half ellipse, as a hand likes it.
    curve = np.column_stack(
        [
            x + reach * np.sin(angles) ** 0.7,
            np.zeros_like(angles),
            middle + half * np.sign(np.cos(angles)) * np.abs(np.cos(angles)) ** 0.85,
        ]
    )
    section = ellipse(radius, 1.3 * radius, edge=edge * 0.7)
    return sweep(_even(curve, edge), section, normal=(0.0, 1.0, 0.0), scale=1.0)


def bar(
    start: npt.ArrayLike,
    end: npt.ArrayLike,
    section: npt.ArrayLike,
    *,
    normal: npt.ArrayLike,
    scale: npt.ArrayLike = ((0.0, 1.0), (1.0, 1.0)),
    edge: float = EDGE,
) -> trimesh.Trimesh:
    """Return a straight bar with rounded ends.

    Args:
        start: Point (3,) [m] in the middle of one end.
        end: Point (3,) [m] in the middle of the other.
        section: As for `sweep`.
        normal: As for `sweep`.
        scale: Thickness along the bar: pairs (fraction of the length, factor).
        edge: Edge length along the bar [m].
    """
    p, q = np.asarray(start, dtype=float), np.asarray(end, dtype=float)
    length = float(np.linalg.norm(q - p))
    along = np.linspace(0.0, 1.0, max(4, round(length / edge)) + 1)
    knots = np.asarray(scale, dtype=float)
    factor = PchipInterpolator(knots[:, 0], knots[:, 1])(along)
    # The end rings are smaller: a bevel instead of a sharp edge.
    factor[[0, -1]] *= 0.8
    return sweep(p + along[:, None] * (q - p), section, normal=normal, scale=factor)


def _trimmed(part: trimesh.Trimesh, core: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return the piece of a handle that lies outside the core, without crumbs."""
    pieces = cut(part, core).split(only_watertight=True)
    return max(pieces, key=lambda piece: piece.volume)


def _bevelled(radius: float, height: float, bevel: float) -> list[tuple[float, float]]:
    """Return corners (r, z) of an upright wall with a bevelled foot and head, off the axis."""
    return [
        (radius - bevel, 0.0),
        (radius, bevel),
        (radius, height - bevel),
        (radius - bevel, height),
    ]


# The classes, in the order of the table.


def mug(
    *, radius: float, height: float, handle_reach: float, handle_radius: float, wall: float = 0.005
) -> trimesh.Trimesh:
    """Return a hollow straight mug with a handle at +x; `handle_reach` is how far it stands out.

    All lengths are in [m].
    """
    shell, core = vessel(
        resample([*_bevelled(radius, height, 0.004)[:2], (radius, height)], EDGE),
        wall=wall,
        floor=0.007,
    )
    handle = loop_handle(
        x=radius - wall / 2.0,
        top=0.84 * height,
        bottom=0.2 * height,
        reach=handle_reach - handle_radius + wall / 2.0,
        radius=handle_radius,
    )
    return fuse(shell, _trimmed(handle, core))


def cup(
    *, top_radius: float, bottom_radius: float, height: float, wall: float = 0.0045
) -> trimesh.Trimesh:
    """Return a hollow tapered cup without a handle.

    All lengths are in [m].
    """
    side = resample([(bottom_radius, 0.0), (top_radius, height)], EDGE)
    return vessel(side, wall=wall, floor=0.006)[0]


def bowl(
    *, radius: float, height: float, foot_radius: float, wall: float = 0.005
) -> trimesh.Trimesh:
    """Return a hollow bowl on a ring foot.

    All lengths are in [m].
    """
    side = smooth(
        [
            (foot_radius, 0.0),
            (foot_radius + 0.001, 0.005),
            (0.72 * radius, 0.22 * height),
            (0.92 * radius, 0.58 * height),
            (radius, height),
        ],
        EDGE,
    )
    return vessel(side, wall=wall, floor=0.008)[0]


def vase(
    *,
    foot_radius: float,
    belly_radius: float,
    neck_radius: float,
    lip_radius: float,
    height: float,
    wall: float = 0.005,
    edge: float = EDGE,
) -> trimesh.Trimesh:
    """Return a hollow vase with a belly, a neck and a lip.

    All lengths are in [m].
    """
    side = smooth(
        [
            (foot_radius, 0.0),
            (belly_radius, 0.4 * height),
            (neck_radius, 0.82 * height),
            (lip_radius, height),
        ],
        edge,
    )
    return vessel(side, wall=wall, floor=0.008, edge=edge)[0]


def wineglass(
    *,
    foot_radius: float,
    stem_radius: float,
    belly_radius: float,
    rim_radius: float,
    height: float,
    stem_height: float,
    wall: float = 0.0045,
) -> trimesh.Trimesh:
    """Return a wineglass: a solid foot and stem, a hollow cup.

    All lengths are in [m].
    """
    cup_height = height - stem_height
    outer = smooth(
        [
            (stem_radius, stem_height),
            (0.75 * belly_radius, stem_height + 0.14 * cup_height),
            (belly_radius, stem_height + 0.42 * cup_height),
            (rim_radius, height),
        ],
        EDGE,
    )
    floor = stem_height + 0.012
    inner = _even(inset(outer, wall, floor=floor), COARSE * EDGE)[::-1]
    foot = resample([(0.0, 0.0), (foot_radius, 0.0), (foot_radius, 0.005)], EDGE)
    stem = smooth(
        [
            (foot_radius, 0.005),
            (0.4 * foot_radius, 0.009),
            (stem_radius, 0.3 * stem_height),
            (stem_radius, stem_height),
        ],
        EDGE,
    )
    bottom = resample([inner[-1], (0.0, floor)], COARSE * EDGE)[1:]
    profile = np.vstack([foot, stem[1:], outer[1:], inner, bottom])
    edges = np.full(len(profile), EDGE)
    edges[len(profile) - len(inner) - len(bottom) :] *= COARSE
    return revolve(profile, edge=edges)


def pitcher(
    *,
    foot_radius: float,
    belly_radius: float,
    neck_radius: float,
    rim_radius: float,
    height: float,
    handle_reach: float,
    handle_radius: float,
    lip: float,
    wall: float = 0.005,
    edge: float = 0.007,
) -> trimesh.Trimesh:
    """Return a hollow pitcher with a handle at +x and a lip pulled out by `lip` at -x.

    All lengths are in [m].
    """
    side = smooth(
        [
            (foot_radius, 0.0),
            (belly_radius, 0.35 * height),
            (neck_radius, 0.8 * height),
            (rim_radius, height),
        ],
        edge,
    )
    shell, core = vessel(side, wall=wall, floor=0.008, edge=edge)
    handle = loop_handle(
        x=neck_radius - wall / 2.0,
        top=0.85 * height,
        bottom=0.3 * height,
        reach=belly_radius - neck_radius + handle_reach,
        radius=handle_radius,
        edge=edge,
    )
    body = fuse(shell, _trimmed(handle, core))

    # The lip: points near the rim on the far side move outwards, the wall with them.
    x, y, z = body.vertices.T
    rise = np.clip((z / height - 0.7) / 0.3, 0.0, 1.0)
    pull = lip * rise**2 * np.exp(-((np.arctan2(y, -x) / 0.4) ** 2))
    return solid(np.column_stack([x - pull, y, z]), body.faces)


def saucepan(
    *, radius: float, height: float, handle_length: float, wall: float = 0.005
) -> trimesh.Trimesh:
    """Return a hollow saucepan with a straight handle along +x.

    All lengths are in [m].
    """
    edge = 1.2 * EDGE
    shell, core = vessel(
        resample([*_bevelled(radius, height, 0.005)[:2], (radius, height)], edge),
        wall=wall,
        floor=0.007,
        edge=edge,
    )
    z = 0.78 * height
    handle = bar(
        (radius - wall, 0.0, z),
        (radius + handle_length, 0.0, z),
        ellipse(0.008, 0.011, edge=edge),
        normal=(0.0, 1.0, 0.0),
        scale=((0.0, 0.9), (0.4, 0.8), (1.0, 1.0)),
        edge=edge,
    )
    return fuse(shell, _trimmed(handle, core))


def bottle(*, radius: float, height: float, neck_radius: float) -> trimesh.Trimesh:
    """Return a closed bottle, solid, with a shoulder, a neck and a cap.

    All lengths are in [m].
    """
    shoulder, neck, cap = 0.58 * height, 0.78 * height, 0.9 * height
    side = np.vstack(
        [
            resample([*_bevelled(radius, height, 0.004)[:2], (radius, shoulder)], EDGE),
            smooth([(radius, shoulder), (0.8 * radius, 0.66 * height), (neck_radius, neck)], EDGE)[
                1:
            ],
            resample(
                [
                    (neck_radius, neck),
                    (neck_radius, cap),
                    (neck_radius + 0.003, cap),
                    (neck_radius + 0.003, height - 0.003),
                    (neck_radius, height),
                ],
                EDGE,
            )[1:],
        ]
    )
    return _lathe(side)


def can(*, radius: float, height: float) -> trimesh.Trimesh:
    """Return a closed can: a cylinder with bevelled rims.

    All lengths are in [m].
    """
    return _lathe(resample(_bevelled(radius, height, 0.002), EDGE))


def jar(*, radius: float, height: float, lid_radius: float, lid_height: float) -> trimesh.Trimesh:
    """Return a closed jar, solid: a body, a short neck and a lid.

    All lengths are in [m].
    """
    shoulder = height - lid_height - 0.018
    neck = min(lid_radius - 0.004, radius - 0.008)
    side = np.vstack(
        [
            resample([*_bevelled(radius, height, 0.005)[:2], (radius, shoulder)], EDGE),
            smooth(
                [
                    (radius, shoulder),
                    (radius - 0.25 * (radius - neck), shoulder + 0.006),
                    (neck, shoulder + 0.013),
                ],
                EDGE / 2.0,
            )[1:],
            resample(
                [
                    (neck, height - lid_height),
                    (lid_radius, height - lid_height),
                    (lid_radius, height - 0.003),
                    (lid_radius - 0.003, height),
                ],
                EDGE,
            ),
        ]
    )
    return _lathe(side)


def candlestick(*, foot_radius: float, stem_radius: float, height: float) -> trimesh.Trimesh:
    """Return a candlestick with a wide foot, a knob and a drip cup with a socket.

    All lengths are in [m].
    """
    cup, socket = 2.6 * stem_radius, 0.010
    outline = [
        (foot_radius, 0.0),
        (foot_radius, 0.008),
        (0.55 * foot_radius, 0.020),
        (stem_radius, 0.3 * height),
        (stem_radius, 0.5 * height),
        (1.6 * stem_radius, 0.56 * height),
        (stem_radius, 0.62 * height),
        (stem_radius, 0.78 * height),
        (cup, height - 0.012),
        (cup, height),
    ]
    side = np.vstack([resample(outline[:2], EDGE), smooth(outline[1:], 0.8 * EDGE)[1:]])
    top = [(cup, height), (socket, height), (socket, height - 0.018), (0.0, height - 0.018)]
    foot = resample([(0.0, 0.0), side[0]], COARSE * EDGE)[:-1]
    return revolve(np.vstack([foot, side, resample(top, EDGE)[1:]]))


def flashlight(
    *, head_radius: float, body_radius: float, height: float, head_height: float
) -> trimesh.Trimesh:
    """Return a flashlight that stands on its lens, with a switch at +x.

    All lengths are in [m].
    """
    taper = head_height + 0.022
    side = resample(
        [
            *_bevelled(head_radius, head_height, 0.003)[:2],
            (head_radius, head_height),
            (body_radius, taper),
            (body_radius, height - 0.024),
            (body_radius + 0.0025, height - 0.021),
            (body_radius + 0.0025, height - 0.003),
            (body_radius - 0.0005, height),
        ],
        EDGE,
    )
    z = taper + 0.022
    switch = bar(
        (0.0, 0.0, z),
        (body_radius + 0.003, 0.0, z),
        ellipse(0.010, 0.006, edge=0.5 * EDGE),
        normal=(0.0, 1.0, 0.0),
    )
    return fuse(_lathe(side), switch)


def funnel(
    *, radius: float, spout_radius: float, cone_height: float, height: float, wall: float = 0.0045
) -> trimesh.Trimesh:
    """Return a funnel, open at both ends, that stands on its wide end.

    All lengths are in [m].
    """
    outer = resample(
        [
            (radius, 0.0),
            (radius, 0.008),
            (spout_radius + 0.002, cone_height),
            (spout_radius, height),
        ],
        EDGE,
    )
    # Across a sloping wall the thickness is measured along r: wall / sin(slope).
    slope = np.arctan2(cone_height - 0.008, radius - spout_radius)
    step = wall / np.sin(slope)
    inner = resample(
        [
            (spout_radius - wall, height),
            (spout_radius + 0.002 - wall, cone_height),
            (radius - step, 0.008),
            (radius - step, 0.0),
        ],
        COARSE * EDGE,
    )
    profile = np.vstack([outer, inner])
    edges = np.r_[np.full(len(outer), EDGE), np.full(len(inner), COARSE * EDGE)]
    return revolve(profile, edge=edges, closed=True)


def box(*, width: float, depth: float, height: float, edge: float = 1.2 * EDGE) -> trimesh.Trimesh:
    """Return an upright box: `width` along x, `depth` along y.

    All lengths are in [m].
    """
    return grid_box((width, depth, height), centre=(0.0, 0.0, height / 2.0), edge=edge)


def book(*, width: float, length: float, thickness: float, edge: float = 0.011) -> trimesh.Trimesh:
    """Return a closed book that lies flat, its round spine along y at -x.

    All lengths are in [m].
    """
    cover, inlay, bulge = 0.004, 0.005, 0.008
    x, y, hinge = width / 2.0, length / 2.0, 0.006 - width / 2.0

    def ring(z: float, *, setback: float, scale: float = 1.0) -> Array:
        """Return the outline at height `z`, the pages `setback` behind the cover's edge."""
        level = 2.0 * z / thickness - 1.0
        back = -x - bulge * np.sqrt(1.0 - level**2)
        right, front = x - setback, y - setback
        corners = [(right, front), (hinge, front), (hinge, y), (back, y)]
        corners = [(right, -front), *corners, *((u, -v) for u, v in reversed(corners[1:]))]
        corners.append(corners[0])
        # The same number of pieces at every height, whatever their length.
        sizes = [length, width, 0.0, bulge, length, bulge, 0.0, width]
        outline = []
        for start, end, size in zip(corners[:-1], corners[1:], sizes, strict=True):
            count = max(1, round(size / edge))
            outline.append(np.linspace(start, end, count, endpoint=False))
        flat = scale * np.concatenate(outline)
        return np.column_stack([flat, np.full(len(flat), z)])

    scales = np.linspace(0.0, 1.0, max(2, round(x / edge)), endpoint=False)[1:]
    board = [ring(0.0, setback=0.0), ring(cover, setback=0.0)]
    heights = resample([[cover], [thickness - cover]], 0.7 * edge)[:, 0]
    pages = [ring(z, setback=inlay) for z in heights]
    lid = [ring(thickness - cover, setback=0.0), ring(thickness, setback=0.0)]
    under = [ring(0.0, setback=0.0, scale=scale) for scale in scales]
    over = [ring(thickness, setback=0.0, scale=scale) for scale in scales[::-1]]
    tips = [np.array([[0.0, 0.0, z]]) for z in (0.0, thickness)]
    return _skin([tips[0], *under, *board, *pages, *lid, *over, tips[1]], closed=False)


def spray_bottle(
    *, width: float, depth: float, height: float, edge: float = EDGE
) -> trimesh.Trimesh:
    """Return a spray bottle, solid: an oval body, a neck, a head and a trigger towards +x.

    All lengths are in [m].
    """
    body_height = 0.68 * height
    neck, section = 0.013, rounded_rectangle(width, depth, 0.45 * depth, edge=edge)
    foot = [(0.0, 0.0), (0.5, 0.0), (0.94, 0.0), (1.0, 0.004)]
    side = resample([(0.0, 0.004), (0.0, 0.72 * body_height)], edge)[1:]
    shoulder = smooth(
        [
            (width / 2.0, 0.72 * body_height),
            (0.42 * width, 0.85 * body_height),
            (neck, body_height),
        ],
        edge,
    )[1:] / [width / 2.0, 1.0]
    profile = [*foot, *((1.0, z) for z in side[:, 1]), *shoulder, (0.0, body_height)]
    body = extrude(section, profile)

    head_z = height - 0.014
    collar = revolve(
        resample(
            [
                (0.0, body_height - 0.01),
                (neck + 0.002, body_height - 0.01),
                (neck + 0.002, body_height + 0.014),
                (0.011, body_height + 0.018),
                (0.011, head_z),
                (0.0, head_z),
            ],
            edge,
        )
    )
    head = bar(
        (-0.028, 0.0, head_z),
        (0.048, 0.0, head_z),
        rounded_rectangle(0.028, 0.024, 0.007, edge=edge),
        normal=(0.0, 1.0, 0.0),
        scale=((0.0, 0.75), (0.35, 1.0), (0.75, 0.9), (1.0, 0.55)),
    )
    reach = np.linspace(0.0, 1.0, 50)
    trigger = sweep(
        _even(
            np.column_stack(
                [0.026 + 0.014 * np.sin(1.6 * reach), 0.0 * reach, head_z - 0.055 * reach]
            ),
            edge,
        ),
        rounded_rectangle(0.008, 0.014, 0.003, edge=edge),
        normal=(0.0, 1.0, 0.0),
        scale=1.0,
    )
    return fuse(body, collar, head, trigger)


def hammer(
    *, length: float, head_length: float, head_thickness: float, claw: bool
) -> trimesh.Trimesh:
    """Return a hammer that lies on its side, handle along -x, head along y.

    With `claw` one half of the head is a bent claw, else the head is a square mallet.
    All lengths are in [m].
    """
    half = head_thickness / 2.0
    up = (0.0, 0.0, 1.0)
    grip = min(half, 0.016)
    # The handle leans, if need be, so that its end lies on the table beside the head.
    handle = bar(
        (-length, 0.0, grip),
        (0.0, 0.0, half),
        ellipse(0.85 * grip, grip, edge=EDGE),
        normal=up,
        scale=((0.0, 1.0), (0.3, 1.0), (0.55, 0.75), (1.0, 0.75)),
    )
    reach = head_length / 2.0
    if claw:
        y = np.linspace(reach, -reach, 60)
        bend = np.clip(-(y + 0.012), 0.0, None)
        path = np.column_stack([-8.0 * bend**2, y, np.full_like(y, half)])
        path = _even(path, EDGE)
        knots = np.array(
            [
                (-1.0, 0.18, 0.8),
                (-0.35, 0.75, 0.9),
                (0.0, 1.0, 1.0),
                (0.35, 1.0, 1.0),
                (0.55, 0.72, 0.72),
                (0.75, 1.0, 1.0),
                (0.93, 1.0, 1.0),
                (1.0, 0.88, 0.88),
            ]
        )
        scale = PchipInterpolator(knots[:, 0], knots[:, 1:])(path[:, 1] / reach)
        section = rounded_rectangle(2.0 * half, 2.0 * half, 0.55 * half, edge=EDGE)
        head = sweep(path, section, normal=up, scale=scale)
    else:
        section = rounded_rectangle(1.1 * head_thickness, head_thickness, 0.006, edge=EDGE)
        head = bar(
            (0.0, reach, half),
            (0.0, -reach, half),
            section,
            normal=up,
            scale=((0.0, 1.0), (1.0, 1.0)),
        )
    return fuse(handle, head)


def dumbbell(
    *, length: float, head_width: float, head_length: float, grip_radius: float
) -> trimesh.Trimesh:
    """Return a dumbbell along x with six-sided heads of `head_width` between flats.

    All lengths are in [m].
    """
    apothem = head_width / 2.0
    turns = 2.0 * np.pi * (np.arange(6) + 0.5) / 6.0
    corners = apothem / np.cos(np.pi / 6.0) * np.column_stack([np.cos(turns), np.sin(turns)])
    hexagon = rounded_polygon(corners, 0.15 * head_width, edge=EDGE)
    across = (0.0, 1.0, 0.0)
    start, end = -length / 2.0, length / 2.0
    heads = []
    for low, high in ((start, start + head_length), (end - head_length, end)):
        stations = resample([[low], [low + 0.005], [high - 0.005], [high]], 1.4 * EDGE)[:, 0]
        path = np.column_stack([stations, 0.0 * stations, np.full_like(stations, apothem)])
        scale = np.interp(stations, [low, low + 0.005, high - 0.005, high], [0.86, 1.0, 1.0, 0.86])
        # The section's first coordinate runs along -z: two of the flats are level.
        heads.append(sweep(path, hexagon, normal=across, scale=scale))
    grip = bar(
        (start + head_length / 2.0, 0.0, apothem),
        (end - head_length / 2.0, 0.0, apothem),
        ellipse(grip_radius, grip_radius, edge=EDGE),
        normal=across,
        scale=((0.0, 0.85), (0.25, 0.85), (0.5, 1.0), (0.75, 0.85), (1.0, 0.85)),
    )
    return fuse(*heads, grip)


def banana(*, bend_radius: float, angle: float, thickness: float) -> trimesh.Trimesh:
    """Return a banana that lies on its side, bent by `angle` [rad] about `bend_radius`.

    All lengths are in [m].
    """
    theta = np.linspace(-angle / 2.0, angle / 2.0, round(bend_radius * angle / EDGE) + 1)
    knots = np.array(
        [
            (0.0, 0.34),
            (0.03, 0.38),
            (0.12, 0.36),
            (0.26, 0.85),
            (0.5, 1.0),
            (0.78, 0.85),
            (0.95, 0.42),
            (1.0, 0.24),
        ]
    )
    scale = PchipInterpolator(knots[:, 0], knots[:, 1])(np.linspace(0.0, 1.0, len(theta)))
    half = thickness / 2.0
    # Five soft edges, one face down; the underside stays on the table along the whole fruit.
    turns = 2.0 * np.pi * np.arange(5) / 5.0 - np.pi / 2.0 + np.pi / 5.0
    corners = 1.18 * half * np.column_stack([np.cos(turns), np.sin(turns)])
    section = rounded_polygon(corners, 0.45 * half, edge=EDGE)
    lowest = -section[:, 1].min()
    path = np.column_stack(
        [
            bend_radius * np.sin(theta),
            bend_radius * (1.0 - np.cos(theta)),
            lowest * scale,
        ]
    )
    return sweep(path, section, normal=(0.0, 0.0, 1.0), scale=scale)


def apple(*, radius: float, height: float) -> trimesh.Trimesh:
    """Return an apple with a stem; `height` is without the stem.

    All lengths are in [m].
    """
    side = smooth(
        [
            (0.0, 0.07 * height),
            (0.18 * radius, 0.03 * height),
            (0.36 * radius, 0.0),
            (0.72 * radius, 0.16 * height),
            (0.95 * radius, 0.42 * height),
            (radius, 0.62 * height),
            (0.88 * radius, 0.86 * height),
            (0.5 * radius, height),
            (0.2 * radius, 0.93 * height),
            (0.0, 0.82 * height),
        ],
        EDGE,
    )
    stem = bar(
        (0.0, 0.0, 0.7 * height),
        (0.004, 0.0, height + 0.010),
        ellipse(0.0025, 0.0025, edge=0.002),
        normal=(0.0, 1.0, 0.0),
    )
    return stand(fuse(revolve(side), stem))


def pear(*, radius: float, neck_radius: float, height: float) -> trimesh.Trimesh:
    """Return a pear that stands on its wide end, with a stem; `height` is without the stem.

    All lengths are in [m].
    """
    side = smooth(
        [
            (0.0, 0.04 * height),
            (0.35 * radius, 0.0),
            (0.85 * radius, 0.14 * height),
            (radius, 0.32 * height),
            (0.85 * radius, 0.5 * height),
            (neck_radius, 0.75 * height),
            (0.85 * neck_radius, 0.92 * height),
            (0.4 * neck_radius, height),
            (0.0, 0.98 * height),
        ],
        EDGE,
    )
    stem = bar(
        (0.0, 0.0, 0.85 * height),
        (-0.004, 0.0, height + 0.014),
        ellipse(0.0025, 0.0025, edge=0.002),
        normal=(0.0, 1.0, 0.0),
    )
    return stand(fuse(revolve(side), stem))


def _lathe(side: Array) -> trimesh.Trimesh:
    """Return the solid of a side (r, z) from its foot to its head, closed at both."""
    foot = resample([(0.0, side[0, 1]), side[0]], COARSE * EDGE)[:-1]
    head = resample([side[-1], (0.0, side[-1, 1])], EDGE)[1:]
    return revolve(np.vstack([foot, side, head]))
