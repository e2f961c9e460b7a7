"""Surfaces of triangles: measures, points on them, inside and outside, rays, other forms.

Vertices are (n, 3) [m]; faces are (m, 3), counter-clockwise seen from outside. Nothing here changes
a shape.

Where rays meet a surface has the same bits on every machine, since only sums, products and roots
are used. Embree cannot replace it: it computes in single precision, with kernels that depend on the
CPU.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import manifold3d
import numpy as np
import numpy.typing as npt
import trimesh
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from drakegrasp.arithmetic import dot, multiply, norm
from drakegrasp.errors import MeshError
from drakegrasp.frames import Array

Faces = npt.NDArray[np.int64]

#: Number of points of the winding-number check, and its budget of point-triangle pairs.
CHECK_POINTS = 2000
CHECK_BUDGET = 20_000_000
#: Number of point-triangle pairs of winding numbers in memory at a time.
CHUNK_PAIRS = 400_000
#: Limits of rounding: a line certainly passes beside a triangle's edge if the area between them
#: exceeds this fraction of the diagonal squared; a point is certainly off a triangle if the volume
#: between them exceeds this fraction of the diagonal cubed.
ROUNDING = 1e-12
#: Distance from the faces at which thin objects are checked, as a fraction of the diagonal.
NEAR = 3e-4
#: Fraction of its volume that a surface may enclose twice or backwards. This falsifies the mass
#: properties, but not the surface that is touched (slots of real toasters are dents deeper than the
#: wall).
MAX_OVERLAP = 0.05
#: A ray that misses a triangle by this fraction of its size still meets it, so that no ray passes
#: between two triangles.
RAY_EDGE = 1e-9
#: Margin of the sphere around a triangle [m], far above rounding.
RAY_MARGIN = 1e-6
#: Number of pairs of a ray and a triangle that are tested together; they fit into a CPU's cache.
RAY_PAIRS = 65_536
#: Faces that meet at an angle below this are shaded as one smooth surface.
CREASE_DEG = 30.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Solid:
    """A closed surface whose faces point outwards.

    Attributes:
        vertices: (n, 3) [m].
        faces: (m, 3).
        notes: What was repaired, in sentences.
    """

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


def unit_normals(triangles: Array) -> Array:
    """Return the outward unit normals (m, 3) of triangles (m, 3, 3); 0 if they have no area."""
    a, b, c = np.moveaxis(triangles, 1, 0)
    normals = np.cross(b - a, c - a)
    return np.asarray(normals / np.maximum(norm(normals), 1e-300)[:, None])


def diagonal(vertices: Array) -> float:
    """Return the diagonal of the bounding box [m]."""
    return float(norm(np.ptp(vertices, axis=0)))


def is_solid_surface(faces: Faces) -> bool:
    """Return whether each edge has two faces with opposite directions along it."""
    halves = half_edges(faces)
    count = int(halves.max()) + 1
    forward = np.unique(halves[:, 0] * count + halves[:, 1])
    backward = np.unique(halves[:, 1] * count + halves[:, 0])
    return len(forward) == len(halves) and np.array_equal(forward, backward)


def half_edges(faces: Faces) -> Faces:
    """Return the half-edges (3m, 2) as start and end; 3f + i starts at corner i of face f."""
    return faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)


# Connections and pairs


def connect(first: Faces, second: Faces, count: int) -> tuple[int, Faces]:
    """Return the number of connected sets of nodes, and the set (count,) of each node.

    Args:
        first: (e,), one node of each edge.
        second: (e,), the other node of each edge.
        count: Number of nodes.
    """
    edges = np.ones(len(first), dtype=bool), (first, second)
    number, sets = connected_components(coo_matrix(edges, shape=(count, count)), directed=False)
    return int(number), sets


def enumerate_pairs(counts: Faces) -> tuple[Faces, Faces]:
    """Return all pairs (i, j) with i < len(counts) and j < counts[i], as two arrays (n,)."""
    i = np.repeat(np.arange(len(counts)), counts)
    return i, np.arange(len(i)) - np.repeat(np.cumsum(counts) - counts, counts)


def pair_blocks(counts: Faces, most: int) -> Iterator[tuple[Faces, Faces]]:
    """Yield the pairs of `enumerate_pairs` in blocks of roughly `most` pairs each."""
    blocks = np.flatnonzero(np.diff(np.cumsum(counts) // most, prepend=0))
    for run in np.split(np.arange(len(counts)), blocks):
        i, j = enumerate_pairs(counts[run])
        yield run[i], j


# Inside and outside


def winding_numbers(p_OQ: Array, vertices: Array, faces: Faces) -> Array:
    """Return the winding numbers (k,) of a surface around points (k, 3).

    1 is inside, 0 is outside; other integers mean that the surface is inside out or passes through
    itself, and fractions that it is open (Jacobson et al. 2013, "Robust inside-outside segmentation
    using generalized winding numbers"; solid angles after Van Oosterom and Strackee 1983, "The
    solid angle of a plane triangle").
    """
    triangles = vertices[faces]
    winding = np.empty(len(p_OQ))
    step = max(1, CHUNK_PAIRS // len(faces))
    for start in range(0, len(p_OQ), step):
        # Half of the solid angle of each triangle, seen from each point.
        a, b, c = np.moveaxis(triangles[None] - p_OQ[start : start + step, None, None], 2, 0)
        la, lb, lc = (norm(x) for x in (a, b, c))
        numerator = dot(a, np.cross(b, c))
        ab, bc, ca = (dot(x, y) for x, y in ((a, b), (b, c), (c, a)))
        angle = np.arctan2(numerator, la * lb * lc + ab * lc + bc * la + ca * lb)
        winding[start : start + step] = angle.sum(axis=1) / (2.0 * np.pi)
    return winding


def whole_windings(p_OQ: Array, vertices: Array, faces: Faces) -> Array:
    """Return the winding numbers (k,) of a closed surface around points (k, 3).

    These are the integers that `winding_numbers` returns up to rounding, in a small part of the
    time. Along a ray up from a point, a face that faces up ends a winding and a face that faces
    down begins one. If rounding may decide whether the ray meets a face, solid angles are used.
    """
    # The points between each triangle's smallest and largest x are consecutive in sorted order.
    triangles = vertices[faces]
    low, high = triangles.min(axis=1), triangles.max(axis=1)
    order = np.argsort(p_OQ[:, 0], kind="stable")
    begins = np.searchsorted(p_OQ[order, 0], low[:, 0], side="left")
    counts = np.searchsorted(p_OQ[order, 0], high[:, 0], side="right") - begins
    area, volume = ROUNDING * diagonal(vertices) ** 2, ROUNDING * diagonal(vertices) ** 3

    winding, doubtful = np.zeros(len(p_OQ)), np.zeros(len(p_OQ), dtype=bool)
    for t, j in pair_blocks(counts, CHUNK_PAIRS):
        # Keep the pairs whose triangle may be above the point, at least in part.
        q = order[begins[t] + j]
        y, z = p_OQ[q, 1], p_OQ[q, 2]
        near = (low[t, 1] <= y) & (y <= high[t, 1]) & (z <= high[t, 2])
        t, q = t[near], q[near]

        # The ray passes all three edges on the same side, or it passes beside the triangle.
        a, b, c = np.moveaxis(triangles[t] - p_OQ[q, None], 1, 0)
        sides = np.stack(
            [i[:, 0] * j[:, 1] - i[:, 1] * j[:, 0] for i, j in ((b, c), (c, a), (a, b))], axis=1
        )
        least, most = sides.min(axis=1), sides.max(axis=1)
        meets = (least > area) | (most < -area)
        beside = (least < -area) & (most > area)

        # The triangle is above the point if their tetrahedron is on the side that it faces.
        height = dot(sides, np.stack([a[:, 2], b[:, 2], c[:, 2]], axis=1)) * np.sign(least)
        above = (low[t, 2] > p_OQ[q, 2]) | (height > volume)
        doubtful[q[~(beside | (meets & (above | (height < -volume))))]] = True
        up = meets & above
        winding += np.bincount(q[up], np.sign(least[up]), len(p_OQ))

    winding[doubtful] = winding_numbers(p_OQ[doubtful], vertices, faces)
    return winding


def overlap_share(vertices: Array, faces: Faces, *, points: int = CHECK_POINTS) -> float:
    """Return the fraction of the volume that a closed surface encloses twice or backwards.

    It is measured at fixed points, evenly spread in the bounding box, or on both sides of the faces
    if the object fills little of the box.

    Args:
        vertices: (n, 3) [m].
        faces: (m, 3).
        points: Number of points; fewer, but at least 200, for a large number of faces.
    """
    # In the bounding box.
    count = int(np.clip(CHECK_BUDGET // len(faces), min(points, 200), points))
    spread = even_points(count)
    low, size = vertices.min(axis=0), np.ptp(vertices, axis=0)
    inside, wrong = _count_wrong(low + spread * size, vertices, faces)

    # Near the faces, if too few of those points are inside.
    if inside < count // 20:
        on_face, picked = on_faces(vertices, faces, spread[: count // 2])
        offsets = NEAR * float(norm(size)) * unit_normals(vertices[faces[picked]])
        both_sides = np.vstack((on_face - offsets, on_face + offsets))
        inside, wrong = _count_wrong(both_sides, vertices, faces)
    return wrong / max(1, inside)


def _count_wrong(points: Array, vertices: Array, faces: Faces) -> tuple[int, int]:
    """Return the number of points inside, and of points whose winding number is not 0 or 1."""
    w = whole_windings(points, vertices, faces)
    wrong = np.minimum(np.abs(w), np.abs(w - 1.0)) > 0.05
    return int((np.abs(w) > 0.5).sum()), int(wrong.sum())


def on_faces(vertices: Array, faces: Faces, spread: Array) -> tuple[Array, Faces]:
    """Return points (k, 3) [m] on a surface and the face (k,) of each.

    Args:
        vertices: (n, 3) [m].
        faces: (m, 3).
        spread: Points (k, 3) of the unit cube; if these are evenly spread, so are the results over
            the area.
    """
    until = np.cumsum(face_areas(vertices, faces))
    picked = np.minimum(np.searchsorted(until, spread[:, 2] * until[-1]), len(faces) - 1)
    a, b, c = np.moveaxis(vertices[faces[picked]], 1, 0)
    root, part = np.sqrt(spread[:, :1]), spread[:, 1:2]
    return (1.0 - root) * a + root * (1.0 - part) * b + root * part * c, picked


def even_points(count: int) -> Array:
    """Return points (count, 3) that fill the unit cube evenly: the R3 sequence.

    The points are always the same (Roberts 2018, "The unreasonable effectiveness of quasirandom
    sequences").
    """
    root = 1.2207440846057596  # of x^4 = x + 1
    powers = np.cumprod([root, root, root])  # NumPy's power has other last bits on some CPUs
    return np.asarray((0.5 + np.arange(1, count + 1)[:, None] / powers) % 1.0)


def cover_triangles(triangles: Array, spacing: float) -> tuple[Array, Faces]:
    """Return points (k, 3) [m] that cover triangles, and the triangle (k,) of each.

    Each triangle gets a regular grid of points that includes its corners. Triangles with equally
    fine grids are consecutive in the result.

    Args:
        triangles: (m, 3, 3) [m], without degenerate ones.
        spacing: Largest distance between neighbouring points [m].
    """
    edges = norm(triangles - np.roll(triangles, 1, axis=1)).max(axis=1)
    parts = np.maximum(1, np.ceil(edges / spacing)).astype(int)
    points, owners = [], []
    for n in np.unique(parts):
        same = np.flatnonzero(parts == n)

        # Barycentric coordinates (i, j, n - i - j) / n of all grid points.
        i, j = (a.ravel() for a in np.indices((n + 1, n + 1)))
        i, j = i[i + j <= n], j[i + j <= n]
        weights = np.column_stack([i, j, n - i - j]) / n
        points.append(multiply(weights, triangles[same]).reshape(-1, 3))
        owners.append(np.repeat(same, len(weights)))
    return np.concatenate(points), np.concatenate(owners)


# Rays


def first_hits(triangles: Array, p: Array, z: Array) -> Array:
    """Return the distance (n,) [m] at which each ray first meets a triangle; inf if it meets none.

    Möller and Trumbore's test (1997); a ray through an edge or a corner counts as a hit.

    Args:
        triangles: Corners (m, 3, 3) [m].
        p: Starting points of the rays, (n, 3) [m].
        z: Unit directions of the rays, (n, 3).
    """
    # A sphere around each triangle.
    a, b, c = np.moveaxis(np.asarray(triangles, dtype=float), 1, 0)
    centre = (a + b + c) / 3.0
    radius = np.sqrt(np.max([dot(q - centre, q - centre) for q in (a, b, c)], axis=0, initial=0.0))

    # Test only triangles whose sphere the ray meets.
    distance = np.full(len(p), np.inf)
    step = max(1, RAY_PAIRS // max(1, len(a)))
    for start in range(0, len(p), step):
        block = slice(start, start + step)
        ray, triangle = np.nonzero(_pass_spheres(p[block], z[block], centre, radius + RAY_MARGIN))
        ray += start
        hits = _triangle_hits(p[ray], z[ray], a[triangle], b[triangle], c[triangle])
        np.minimum.at(distance, ray, hits)
    return distance


def _pass_spheres(p: Array, z: Array, centre: Array, radius: Array) -> npt.NDArray[np.bool_]:
    """Return (n, m) whether each ray meets each sphere of centre (m, 3) and radius (m,)."""
    along, squared = np.zeros((len(p), len(centre))), np.zeros((len(p), len(centre)))
    for axis in range(3):
        apart = centre[:, axis] - p[:, None, axis]
        along += apart * z[:, None, axis]
        squared += apart * apart
    # The difference of two squares loses digits; RAY_MARGIN in the radius is far above this error.
    return (squared - along * along <= radius * radius) & (along >= -radius)


def _triangle_hits(p: Array, z: Array, a: Array, b: Array, c: Array) -> Array:
    """Return the distance (n,) at which each ray meets its triangle; inf if it does not."""
    ab, ac, ap = b - a, c - a, p - a
    across, up = np.cross(z, ac), np.cross(ap, ab)
    volume = dot(ab, across)
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v, t = dot(ap, across) / volume, dot(z, up) / volume, dot(ac, up) / volume
        meets = (u >= -RAY_EDGE) & (v >= -RAY_EDGE) & (u + v <= 1.0 + RAY_EDGE) & (t >= 0.0)
    # A triangle seen edge-on is skipped: the ray meets its neighbours.
    flat = np.abs(volume) <= RAY_EDGE * norm(ab) * norm(ac)
    return np.where(meets & ~flat, t, np.inf)


# Other forms


def compact(vertices: Array, faces: Faces) -> tuple[Array, Faces]:
    """Return a surface without its unused vertices; the other vertices keep their order."""
    used = np.zeros(len(vertices), dtype=bool)
    used[faces] = True
    return vertices[used], (np.cumsum(used) - 1)[faces].astype(np.int64)


def split_faces(vertices: Array, faces: Faces, midpoints: Faces) -> Faces:
    """Return faces (k, 3), each split at the midpoints of its edges.

    Args:
        vertices: (n, 3) [m], which include the midpoints.
        faces: (m, 3).
        midpoints: (m, 3), the vertex at the centre of the edge that starts at each corner, or -1.
    """
    # Rotate the corners of each face so that a single midpoint is on its first edge, and a single
    # unsplit edge is its last.
    split = midpoints >= 0
    number = split.sum(axis=1)
    turn = np.where(number == 1, split.argmax(axis=1), 0)
    turn = np.where(number == 2, (split.argmin(axis=1) + 1) % 3, turn)
    order = (np.arange(3) + turn[:, None]) % 3
    a, b, c = np.take_along_axis(faces, order, axis=1).T
    d, e, f = np.take_along_axis(midpoints, order, axis=1).T  # midpoints of ab, bc, ca

    # Two midpoints leave a quadrilateral a d e c, which its shorter diagonal halves.
    ae, dc = vertices[e] - vertices[a], vertices[c] - vertices[d]
    shorter = (number == 2) & (dot(ae, ae) <= dot(dc, dc))
    other = (number == 2) & ~shorter
    parts = [
        (number == 0, [(a, b, c)]),
        (number == 1, [(a, d, c), (d, b, c)]),
        (shorter, [(d, b, e), (a, d, e), (a, e, c)]),
        (other, [(d, b, e), (a, d, c), (d, e, c)]),
        (number == 3, [(a, d, f), (d, b, e), (f, e, c), (d, e, f)]),
    ]
    return np.vstack(
        [np.column_stack(corners)[chosen] for chosen, pieces in parts for corners in pieces]
    )


def stack(parts: list[tuple[Array, Faces]]) -> Solid:
    """Return several surfaces as one, in their order; they do not share vertices."""
    offsets = np.cumsum([0] + [len(vertices) for vertices, _ in parts[:-1]])
    faces = [faces + offset for (_, faces), offset in zip(parts, offsets, strict=True)]
    return Solid(vertices=np.vstack([vertices for vertices, _ in parts]), faces=np.vstack(faces))


def to_manifold(vertices: Array, faces: Faces) -> manifold3d.Manifold:
    """Return a closed surface as a solid of manifold3d, for Boolean operations.

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
    """Return the vertices (n, 3) [m] and faces (m, 3) of a solid of manifold3d."""
    mesh = solid.to_mesh64()
    faces = np.array(mesh.tri_verts, dtype=np.int64)
    return compact(np.array(mesh.vert_properties[:, :3], dtype=np.float64), faces)


def obj_text(vertices: npt.ArrayLike, faces: npt.ArrayLike, *, normals: bool) -> str:
    """Return a triangle mesh as Wavefront text, for Drake's in-memory meshes.

    Coordinates are written so that they are read back exactly. With `normals`, every corner gets
    the area-weighted mean normal of the faces at its vertex that are within 30 degrees of its own
    face: curved surfaces look smooth, and edges of boxes stay crisp.
    """
    v = np.asarray(vertices, dtype=np.float64)
    f = np.asarray(faces, dtype=np.int64)
    # Positions, and faces without normals if none are requested.
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in v.tolist()]
    if not normals:
        lines += [f"f {a} {b} {c}" for a, b, c in (f + 1).tolist()]
        return "\n".join(lines) + "\n"

    # Equal normals are written once; each corner refers to one normal.
    vn, index = np.unique(np.round(_corner_normals(v, f), 6), axis=0, return_inverse=True)
    lines += [f"vn {x:.6f} {y:.6f} {z:.6f}" for x, y, z in (vn + 0.0).tolist()]
    corners = np.stack((f, index.reshape(f.shape)), axis=2).reshape(-1, 6) + 1
    lines += ["f {}//{} {}//{} {}//{}".format(*row) for row in corners.tolist()]
    return "\n".join(lines) + "\n"


def convex_hull(corners: npt.ArrayLike) -> Solid:
    """Return the convex hull of corners (n, 3) [m]."""
    hull = trimesh.convex.convex_hull(np.asarray(corners, dtype=float))
    return Solid(vertices=np.asarray(hull.vertices), faces=np.asarray(hull.faces))


def hull_text(corners: npt.ArrayLike) -> str:
    """Return the convex hull of corners (n, 3) as Wavefront text, with its faces turned outward."""
    hull = convex_hull(corners)
    return obj_text(hull.vertices, hull.faces, normals=False)


def _corner_normals(vertices: Array, faces: Faces) -> Array:
    """Return the unit shading normal of every corner (3m, 3)."""
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    weighted = np.cross(b - a, c - a)
    unit = weighted / np.maximum(np.linalg.norm(weighted, axis=1, keepdims=True), 1e-300)

    # Pairs of a corner and a face at its vertex.
    corner = np.arange(faces.size)
    at_vertex = coo_matrix(
        (np.ones(faces.size), (faces.ravel(), corner // 3)), shape=(len(vertices), len(faces))
    ).tocsr()
    pairs = at_vertex[faces.ravel()].tocoo()

    # The area-weighted mean of the faces within the crease angle of the corner's own face.
    smooth = (unit[pairs.row // 3] * unit[pairs.col]).sum(axis=1) >= np.cos(np.radians(CREASE_DEG))
    smooth |= pairs.row // 3 == pairs.col
    rows, columns = pairs.row[smooth], pairs.col[smooth]
    mean = (
        coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(faces.size, len(faces))).tocsr()
        @ weighted
    )
    return np.asarray(mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-300))
