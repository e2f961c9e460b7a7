"""Geometric repair: from a soup of triangles to one watertight solid, and to fewer faces.

`mend_solid` takes welded triangles in metres and returns the surface of one solid:
closed, every edge shared by exactly two faces that run along it in opposite
directions, normals outward. What it had to change it says in sentences. What it
cannot change honestly raises `MeshError` with the reason and without a file name,
which `drakegrasp.meshes` adds. A mesh that is a clean solid keeps its own vertices.

The order matters: gaps are stitched and inner walls dropped while the neighbours are
still known, then the surface falls apart into bodies, whose holes are filled and
whose insides are told from their outsides; last come the union and a check of the
result by generalised winding numbers, which knows nothing of the steps before it.
"""

from __future__ import annotations

from dataclasses import dataclass

import fast_simplification
import manifold3d
import numpy as np
import numpy.typing as npt
import trimesh
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from drakegrasp.errors import MeshError
from drakegrasp.frames import Array

Faces = npt.NDArray[np.int64]

#: Vertices closer than this part of the diagonal are one: above the rounding of files
#: with eight digits, far below the detail of any scan.
WELD = 1e-8
#: Rims closer than this part of the diagonal are the two sides of one seam.
STITCH = 1e-4
#: Triangles lower than this part of the diagonal are slivers of rounding.
SLIVER = 1e-8
#: Tolerance of the clean-up after a Boolean operation, as a part of the diagonal.
TIDY = 1e-5
#: A body whose mean thickness is below this part of its diagonal encloses nothing.
FLAT = 1e-4
#: Filled holes may make up this part of the surface: an open box just passes (1/6),
#: a hemispherical bowl made of a single sheet (1/3) is not taken for a solid one.
MAX_FILLED = 0.25
#: A rim is planar if it leaves its plane by no more than this part of its own size ...
PLANAR = 0.05
#: ... and small if its size is below this part of the object's diagonal.
SMALL_RIM = 0.15
#: Fragments outside the solid that may be dropped, as a part of the surface.
MAX_DROPPED = 0.01
#: Inner walls are found by trying all subsets of patches; 2^12 take milliseconds.
MAX_PATCHES = 12
#: Part of the volume in which a surface may pass through itself and still be trusted ...
MAX_TANGLED = 0.10
#: ... what may be left of that after it was untangled: an error of the mass properties, not
#: of the surface that is touched (slots of real toasters are dents deeper than the wall) ...
MAX_OVERLAP = 0.05
#: ... how much of the volume untangling may change by mistake ...
MAX_CHANGED = 0.01
#: ... from where it is worth new triangles, and from where a note.
NOTICED_OVERLAP = 0.01
NOTED_OVERLAP = 0.002
#: Untangling cuts a body in two at most so often in a row, and not quite in the middle,
#: where modelled objects like to have a face.
MAX_CUTS = 6
CUT = 0.4871
#: Bodies smaller than this [m^3] are rounding.
NOTHING = 1e-15
#: Pieces of a union below this part of its volume are rounding, not geometry.
CHIP = 1e-6
#: Untangling leaves crumbs where walls cross, which are loose and of no use.
CRUMB = 1e-3
#: Points of the winding-number check, and its budget of point-triangle pairs.
CHECK_POINTS = 2000
CELL_POINTS = 300
CHECK_BUDGET = 20_000_000
#: Distance from the faces at which thin objects are checked, as a part of the diagonal.
NEAR = 3e-4
#: Aggressiveness of the quadric decimation, best quality first.
DECIMATION_STEPS = (2.0, 3.0, 5.0, 7.0)
#: Deviation, as a part of the diagonal, from which a second decimation is tried.
FAITHFUL = 2e-3
#: Volume that a decimated mesh may gain or lose.
MAX_VOLUME_CHANGE = 0.05
#: Points on each surface at which the deviation of two surfaces is measured.
DEVIATION_POINTS = 3000


@dataclass(frozen=True, kw_only=True, eq=False)
class Solid:
    """A mended surface: vertices (n, 3) [m], faces (m, 3), and what was mended."""

    vertices: Array
    faces: Faces
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True, eq=False)
class _Body:
    """One connected piece of surface; `twins[h]` is the half-edge opposite to h, or -1."""

    vertices: Array
    faces: Faces
    twins: Faces

    @property
    def is_closed(self) -> bool:
        return bool((self.twins >= 0).all())


# Measures of triangles


def signed_volume(vertices: Array, faces: Faces) -> float:
    """Return the volume enclosed by a closed surface [m^3], negative if inside out."""
    a, b, c = np.moveaxis((vertices - vertices.mean(axis=0))[faces], 1, 0)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)


def face_areas(vertices: Array, faces: Faces) -> Array:
    """Return the area of every triangle (m,) [m^2]."""
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    return np.asarray(np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2.0)


def diagonal(vertices: Array) -> float:
    """Return the diagonal of the bounding box [m]."""
    return float(np.linalg.norm(np.ptp(vertices, axis=0)))


def is_solid_surface(faces: Faces) -> bool:
    """Return whether each edge has two faces that run along it in opposite directions."""
    halves = _half_edges(faces)
    count = int(halves.max()) + 1
    forward = np.unique(halves[:, 0] * count + halves[:, 1])
    backward = np.unique(halves[:, 1] * count + halves[:, 0])
    return len(forward) == len(halves) and np.array_equal(forward, backward)


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
        la, lb, lc = (np.sqrt(np.einsum("...i,...i", x, x)) for x in (a, b, c))
        numerator = np.einsum("...i,...i", a, np.cross(b, c))
        ab, bc, ca = (np.einsum("...i,...i", x, y) for x, y in ((a, b), (b, c), (c, a)))
        angle = np.arctan2(numerator, la * lb * lc + ab * lc + bc * la + ca * lb)
        out[start : start + step] = angle.sum(axis=1) / (2.0 * np.pi)
    return out


def overlap_share(vertices: Array, faces: Faces, *, points: int = CHECK_POINTS) -> float:
    """Return the part of the volume that a surface encloses more than once or backwards.

    Measured at a fixed set of evenly spread points of the bounding box, or, if the
    object fills little of it, on both sides of its faces.
    """
    count = int(np.clip(CHECK_BUDGET // len(faces), min(points, 200), points))
    spread = _even_points(count)
    low, size = vertices.min(axis=0), np.ptp(vertices, axis=0)
    inside, wrong = _count_wrong(low + spread * size, vertices, faces)
    if inside < count // 20:
        areas = face_areas(vertices, faces)
        picked = np.searchsorted(np.cumsum(areas), spread[: count // 2, 2] * areas.sum())
        a, b, c = np.moveaxis(vertices[faces[np.minimum(picked, len(faces) - 1)]], 1, 0)
        root, part = np.sqrt(spread[: count // 2, :1]), spread[: count // 2, 1:2]
        on_face = (1.0 - root) * a + root * (1.0 - part) * b + root * part * c
        normals = np.cross(b - a, c - a)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
        offsets = NEAR * float(np.linalg.norm(size)) * normals
        both_sides = np.vstack((on_face - offsets, on_face + offsets))
        inside, wrong = _count_wrong(both_sides, vertices, faces)
    return wrong / max(1, inside)


def _count_wrong(points: Array, vertices: Array, faces: Faces) -> tuple[int, int]:
    w = winding_numbers(points, vertices, faces)
    wrong = np.minimum(np.abs(w), np.abs(w - 1.0)) > 0.05
    return int((np.abs(w) > 0.5).sum()), int(wrong.sum())


def _even_points(count: int) -> Array:
    """Return points (count, 3) that fill the unit cube evenly and are always the same."""
    root = 1.2207440846057596  # of x^4 = x + 1: the R3 sequence
    return np.asarray((0.5 + np.arange(1, count + 1)[:, None] / root ** np.arange(1, 4)) % 1.0)


# Topology


def weld(vertices: Array, faces: Faces) -> tuple[Array, Faces]:
    """Return a mesh with equal vertices merged and worthless faces dropped.

    Faces that use a vertex twice, and faces that occur twice, go. Collinear faces
    with three different vertices stay, because dropping them would open the surface.
    """
    grid = np.round(vertices / (WELD * max(diagonal(vertices[faces.ravel()]), 1e-300)))
    _, first, inverse = np.unique(grid, axis=0, return_index=True, return_inverse=True)
    faces = first[inverse.reshape(-1)][faces].astype(np.int64)
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]

    # A face that occurs twice is a copy, or the wall between two touching solids. The
    # reading that leaves fewer edges with an odd number of faces is the right one.
    _, index, inverse, counts = np.unique(
        np.sort(faces, axis=1), axis=0, return_index=True, return_inverse=True, return_counts=True
    )
    if (counts > 1).any():
        once = faces[np.sort(index)]
        without = faces[counts[inverse.reshape(-1)] != 2]
        faces = min((once, without), key=_odd_edges) if len(without) else once
    return _compact(vertices, faces)


def _compact(vertices: Array, faces: Faces) -> tuple[Array, Faces]:
    """Drop unused vertices and keep the order of the others."""
    used, inverse = np.unique(faces, return_inverse=True)
    return vertices[used], inverse.reshape(-1, 3).astype(np.int64)


def _half_edges(faces: Faces) -> Faces:
    """Return the half-edges (3m, 2); half-edge 3f + i leaves corner i of face f."""
    return faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)


def _edge_ids(faces: Faces) -> tuple[Faces, Faces]:
    """Return the edge of every half-edge (3m,) and the number of faces of every edge."""
    halves = np.sort(_half_edges(faces), axis=1)
    key = halves[:, 0] * (int(faces.max(initial=0)) + 1) + halves[:, 1]
    _, ids, counts = np.unique(key, return_inverse=True, return_counts=True)
    return ids.reshape(-1), counts


def _odd_edges(faces: Faces) -> int:
    return int((_edge_ids(faces)[1] % 2).sum())


def _stitch(vertices: Array, faces: Faces, notes: list[str]) -> tuple[Array, Faces]:
    """Merge vertices on rims that nearly touch, if that closes edges."""
    ids, counts = _edge_ids(faces)
    rim = np.unique(_half_edges(faces)[counts[ids] == 1])
    if not len(rim):
        return vertices, faces
    pairs = cKDTree(vertices[rim]).query_pairs(STITCH * diagonal(vertices), output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(rim), len(rim)))
    _, labels = connected_components(graph, directed=False)
    _, first = np.unique(labels, return_index=True)
    merged = np.arange(len(vertices))
    merged[rim] = rim[first[labels]]
    stitched = merged[faces]
    stitched = stitched[(stitched != np.roll(stitched, 1, axis=1)).all(axis=1)]
    before, after = int((counts == 1).sum()), int((_edge_ids(stitched)[1] == 1).sum())
    if not len(stitched) or _odd_edges(stitched) >= _odd_edges(faces):
        return vertices, faces
    notes.append(f"{before - after} open edges were stitched together")
    return _compact(vertices, stitched)


def _drop_inner_walls(vertices: Array, faces: Faces) -> tuple[Faces, Faces]:
    """Split faces into those that bound the solid and patches that end inside it.

    Where three faces meet at an edge, one of them is a wall inside the solid or a fin.
    Among all choices of patches, the best leaves the fewest edges with an odd number
    of faces, and then keeps the most surface.
    """
    ids, counts = _edge_ids(faces)
    if not ((counts > 2) & (counts % 2 == 1)).any():
        return faces, faces[:0]
    twins = _pair(vertices, faces, radial=False)
    patch_count, patch = _face_components(twins, len(faces))
    bad = counts != 2
    order = np.cumsum(bad) - 1
    table = np.zeros((int(bad.sum()), patch_count), dtype=np.int64)
    owners = np.repeat(patch, 3)[bad[ids]]
    np.add.at(table, (order[ids[bad[ids]]], owners), 1)
    doubtful = np.flatnonzero(table.any(axis=0))
    if len(doubtful) > MAX_PATCHES:
        raise MeshError(
            f"edges with three or more faces must part at most {MAX_PATCHES} pieces of surface "
            f"from each other, got {len(doubtful)}"
        )
    bits = (np.arange(2 ** len(doubtful))[:, None] >> np.arange(len(doubtful))) & 1
    odd = ((bits @ table[:, doubtful].T) % 2).sum(axis=1)
    areas = np.bincount(patch, face_areas(vertices, faces), patch_count)[doubtful]
    best = bits[np.lexsort((-(bits @ areas), odd))[0]]
    dropped = np.isin(patch, doubtful[best == 0])
    return faces[~dropped], faces[dropped]


def _pair(vertices: Array, faces: Faces, *, radial: bool) -> Faces:
    """Return the opposite of every half-edge (3m,), -1 where there is none.

    At an edge with four or more faces, `radial` pairs those that bound the same wedge
    of solid, so that bodies that touch along an edge come apart.
    """
    ids, counts = _edge_ids(faces)
    order = np.argsort(ids, kind="stable")
    starts = np.concatenate(([0], np.cumsum(counts)[:-1]))
    twins = np.full(3 * len(faces), -1, dtype=np.int64)
    pairs = starts[counts == 2]
    twins[order[pairs]], twins[order[pairs + 1]] = order[pairs + 1], order[pairs]
    if radial:
        for edge in np.flatnonzero((counts > 2) & (counts % 2 == 0)):
            _pair_radially(
                vertices, faces, order[starts[edge] : starts[edge] + counts[edge]], twins
            )
    return twins


def _pair_radially(vertices: Array, faces: Faces, halves: Faces, twins: Faces) -> None:
    """Pair the half-edges of one edge by their angles; leave them if they do not add up."""
    face, corner = halves // 3, halves % 3
    start, end = faces[face, corner], faces[face, (corner + 1) % 3]
    leaves = start < end
    if 2 * int(leaves.sum()) != len(halves):
        return
    low, high = int(start.min()), int(end.max())
    axis = vertices[high] - vertices[low]
    axis = axis / np.linalg.norm(axis)
    arms = vertices[faces[face, (corner + 2) % 3]] - vertices[low]
    first = np.cross(axis, arms[0])
    second = np.cross(axis, first)
    angles = np.round(np.arctan2(arms @ second, arms @ first) % (2.0 * np.pi), 6)
    angles[angles >= 6.283185] = 0.0
    # Around the axis, a face that runs along it is where the solid ends. At equal
    # angles it comes first: bodies that share a wall are two, not one.
    turn = np.lexsort((~leaves, angles))
    depth = np.cumsum(np.where(leaves[turn], -1, 1))
    turn = np.roll(turn, -(int(np.argmin(depth)) + 1))
    entered: list[int] = []
    for half in turn:
        if leaves[half]:
            other = entered.pop()
            twins[halves[half]], twins[halves[other]] = halves[other], halves[half]
        else:
            entered.append(int(half))


def _face_components(twins: Faces, face_count: int) -> tuple[int, Faces]:
    halves = np.flatnonzero(twins >= 0)
    graph = coo_matrix(
        (np.ones(len(halves)), (halves // 3, twins[halves] // 3)), shape=(face_count, face_count)
    )
    count, labels = connected_components(graph, directed=False)
    return int(count), labels


def _orient(vertices: Array, faces: Faces, twins: Faces) -> tuple[Faces, int]:
    """Return for every face (m,) whether to flip it, so that neighbours agree.

    A face and its flipped copy are two nodes of a graph: components of the graph are
    consistent choices. The choice that keeps more of the file's surface wins.
    """
    m = len(faces)
    halves = np.flatnonzero(twins >= 0)
    ends = _half_edges(faces)
    clash = (ends[halves, 0] == ends[twins[halves], 0]).astype(np.int64)
    f, g = halves // 3, twins[halves] // 3
    rows, columns = np.concatenate((f, f + m)), np.concatenate((g + m * clash, g + m * (1 - clash)))
    graph = coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(2 * m, 2 * m))
    _, labels = connected_components(graph, directed=False)
    if (labels[:m] == labels[m:]).any():
        raise MeshError("the surface must have two sides, got one like a Möbius strip")
    count, piece = _face_components(twins, m)
    _, first = np.unique(piece, return_index=True)
    flip = labels[:m] != labels[first[piece]]
    areas = face_areas(vertices, faces)
    flipped = np.bincount(piece, areas * flip, count) > 0.5 * np.bincount(piece, areas, count)
    flip = flip ^ flipped[piece]
    return flip, int(flip.sum())


def _bodies(vertices: Array, faces: Faces, notes: list[str]) -> list[_Body]:
    """Return the connected bodies, each with agreeing faces and vertices of its own."""
    twins = _pair(vertices, faces, radial=True)

    # Corners that meet across a paired edge share a vertex; all others are parted, also
    # where the file makes two bodies touch in a single point.
    halves = np.flatnonzero(twins >= 0)
    ends = _half_edges(faces)
    start, end = halves, halves - halves % 3 + (halves + 1) % 3
    other = twins[halves]
    other_end = other - other % 3 + (other + 1) % 3
    same = ends[halves, 0] == ends[other, 0]
    rows = np.concatenate((start, end))
    columns = np.concatenate((np.where(same, other, other_end), np.where(same, other_end, other)))
    graph = coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(len(ends), len(ends)))
    _, corner_vertex = connected_components(graph, directed=False)
    _, first = np.unique(corner_vertex, return_index=True)
    vertices = vertices[faces.ravel()[first]]
    faces = corner_vertex.reshape(-1, 3).astype(np.int64)

    flip, flipped = _orient(vertices, faces, twins)
    if flipped:
        notes.append(
            f"{flipped} of {len(faces)} faces ran against their neighbours and were turned"
        )
    count, piece = _face_components(twins, len(faces))
    faces = np.where(flip[:, None], faces[:, ::-1], faces)
    bodies = []
    for index in range(count):
        own = np.flatnonzero(piece == index)
        part_vertices, part_faces = _compact(vertices, faces[own])
        part_twins = _pair(part_vertices, part_faces, radial=False)
        bodies.append(_Body(vertices=part_vertices, faces=part_faces, twins=part_twins))
    return bodies


# Holes


def _rims(body: _Body) -> list[Faces]:
    """Return the boundary loops as vertex indices, in the direction of the missing faces."""
    open_halves = np.flatnonzero(body.twins < 0)
    ends = _half_edges(body.faces)[open_halves]
    after = {int(b): int(a) for a, b in ends}
    if len(after) != len(ends):
        raise MeshError("the rim of a hole must not cross itself")
    loops = []
    while after:
        first = min(after)
        loop = [first]
        while (vertex := after.pop(loop[-1])) != first:
            if vertex not in after:
                raise MeshError("the rim of a hole must be a closed loop")
            loop.append(vertex)
        loops.append(np.array(loop, dtype=np.int64))
    return loops


def _area_vector(points: Array) -> Array:
    centred = points - points.mean(axis=0)
    return np.asarray(np.cross(centred, np.roll(centred, -1, axis=0)).sum(axis=0) / 2.0)


def _inside_polygon(point: Array, polygon: Array) -> bool:
    (x, y), a, b = point, polygon, np.roll(polygon, -1, axis=0)
    crosses = (a[:, 1] > y) != (b[:, 1] > y)
    a, b = a[crosses], b[crosses]
    at = a[:, 0] + (y - a[:, 1]) / (b[:, 1] - a[:, 1]) * (b[:, 0] - a[:, 0])
    return bool((at > x).sum() % 2)


def _lids(body: _Body, size: float) -> tuple[list[Faces], int]:
    """Return triangles that close all rims of a body, and the number of holes."""
    rims = sorted(_rims(body), key=lambda r: -float(np.linalg.norm(_area_vector(body.vertices[r]))))
    lids: list[Faces] = []
    holes = 0
    while rims:
        outer = rims.pop(0)
        points = body.vertices[outer]
        centre, width = points.mean(axis=0), diagonal(points)
        basis = np.linalg.svd(points - centre, full_matrices=False)[2][:2]
        if np.dot(np.cross(basis[0], basis[1]), _area_vector(points)) < 0.0:
            basis = basis[::-1]
        normal = np.cross(basis[0], basis[1])
        off_plane = float(np.abs((points - centre) @ normal).max())
        if off_plane > PLANAR * width and width > SMALL_RIM * size:
            raise MeshError(
                f"open edges must surround a flat or a small hole, got {len(outer)} that span "
                f"{width * 1e3:.3g} mm and leave their plane by {off_plane * 1e3:.3g} mm"
            )

        # A second rim in the same plane, inside the first and running the other way,
        # is the inner edge of a wall: the gap between the two is a ring.
        flat = (points - centre) @ basis.T
        loops, polygons = [outer], [flat]
        for rim in list(rims):
            local = (body.vertices[rim] - centre) @ basis.T
            away = np.abs((body.vertices[rim] - centre) @ normal).max()
            backward = float(np.dot(_area_vector(body.vertices[rim]), normal)) < 0.0
            if away < 1e-3 * width and backward and _inside_polygon(local[0], flat):
                loops.append(rim)
                polygons.append(local)
                rims = [r for r in rims if r is not rim]
        triangles = manifold3d.triangulate([np.ascontiguousarray(p) for p in polygons])
        corners = np.vstack(polygons)[triangles]
        u, v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        covered = np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]).sum() / 2.0
        wanted = sum(_area_vector(np.pad(p, ((0, 0), (0, 1))))[2] for p in polygons)
        if covered > 1.01 * abs(wanted) + 1e-6 * width**2 and width > SMALL_RIM * size:
            raise MeshError(f"the rim of a hole of {width * 1e3:.3g} mm must not cross itself")
        lids.append(np.concatenate(loops)[triangles].astype(np.int64))
        holes += len(loops)
    return lids, holes


# Solids


def _to_manifold(vertices: Array, faces: Faces) -> manifold3d.Manifold:
    solid = manifold3d.Manifold(
        manifold3d.Mesh64(
            np.ascontiguousarray(vertices, dtype=np.float64),
            np.ascontiguousarray(faces, dtype=np.uint64),
        )
    )
    if solid.status() != manifold3d.Error.NoError:
        raise MeshError(f"the surface must bound a solid, got {solid.status().name}")
    return solid


def _from_manifold(solid: manifold3d.Manifold) -> tuple[Array, Faces]:
    mesh = solid.to_mesh64()
    faces = np.array(mesh.tri_verts, dtype=np.int64)
    return _compact(np.array(mesh.vert_properties[:, :3], dtype=np.float64), faces)


def _tidy(solid: manifold3d.Manifold, size: float, *, chip: float = CHIP) -> tuple[Array, Faces]:
    """Collapse the slivers that a Boolean operation leaves, and drop its chips."""
    solid = solid.as_original().simplify(TIDY * size)
    pieces = solid.decompose()
    kept = [p for p in pieces if abs(p.volume()) > chip * abs(solid.volume())]
    if 0 < len(kept) < len(pieces):
        tidied = _stack([_from_manifold(p) for p in kept])
        return tidied.vertices, tidied.faces
    return _from_manifold(solid)


def _stack(parts: list[tuple[Array, Faces]]) -> Solid:
    offsets = np.cumsum([0] + [len(vertices) for vertices, _ in parts[:-1]])
    faces = [faces + offset for (_, faces), offset in zip(parts, offsets, strict=True)]
    return Solid(vertices=np.vstack([vertices for vertices, _ in parts]), faces=np.vstack(faces))


def _shells(bodies: list[tuple[Array, Faces]], notes: list[str]) -> list[manifold3d.Manifold]:
    """Return closed bodies as solids: cavities cut out, other inside-out bodies turned."""
    volumes = [signed_volume(*body) for body in bodies]
    if volumes[int(np.argmax(np.abs(volumes)))] < 0.0:
        # The largest body decides: the whole file is inside out, cavities included.
        notes.append("the surface was inside out and was turned")
        bodies = [(v, f[:, ::-1]) for v, f in bodies]
        volumes = [-volume for volume in volumes]
    solids = [
        _to_manifold(v, f if volume > 0.0 else f[:, ::-1])
        for (v, f), volume in zip(bodies, volumes, strict=True)
    ]
    boxes = [(v.min(axis=0), v.max(axis=0)) for v, _ in bodies]
    outer = [i for i, volume in enumerate(volumes) if volume > 0.0]
    inverted = [i for i, volume in enumerate(volumes) if volume <= 0.0]
    cavities: dict[int, list[int]] = {}
    for i in inverted:
        around = [
            j
            for j in outer
            if (boxes[j][0] <= boxes[i][0]).all()
            and (boxes[i][1] <= boxes[j][1]).all()
            and (solids[j] ^ solids[i]).volume() > (1.0 - 1e-6) * abs(volumes[i])
        ]
        if around:
            cavities.setdefault(min(around, key=lambda j: volumes[j]), []).append(i)
    hollow = sum(len(holes) for holes in cavities.values())
    if turned := len(inverted) - hollow:
        notes.append(f"{turned} of {len(bodies)} bodies were inside out and were turned")
    if hollow:
        notes.append(f"{hollow} sealed cavities were kept hollow")
    # A cavity is cut from the body around it only, so that a body inside it survives.
    cut = {i for holes in cavities.values() for i in holes}
    return [
        manifold3d.Manifold.batch_boolean(
            [solids[i], *(solids[j] for j in cavities[i])], manifold3d.OpType.Subtract
        )
        if i in cavities
        else solids[i]
        for i in range(len(bodies))
        if i not in cut
    ]


def _unite(bodies: list[tuple[Array, Faces]], size: float, notes: list[str]) -> tuple[Array, Faces]:
    """Return the surface of the union of closed bodies."""
    if len(bodies) == 1:
        vertices, faces = bodies[0]
        if signed_volume(vertices, faces) < 0.0:
            notes.append("the surface was inside out and was turned")
            faces = faces[:, ::-1]
        a, b, c = np.moveaxis(vertices[faces], 1, 0)
        longest = np.linalg.norm(np.stack((b - a, c - b, a - c)), axis=2).max(axis=0)
        low = 2.0 * face_areas(vertices, faces) < SLIVER * size * longest
        if not low.any() and is_solid_surface(faces):
            return vertices, faces
        notes.append("degenerate triangles were collapsed")
        return _tidy(_to_manifold(vertices, faces), size)
    shells = _shells(bodies, notes)
    if len(shells) > 1:
        notes.append(f"{len(shells)} bodies were united into one solid")
    return _tidy(manifold3d.Manifold.batch_boolean(shells, manifold3d.OpType.Add), size)


def _untangle(solid: manifold3d.Manifold, depth: int) -> list[manifold3d.Manifold]:
    """Return pieces that do not pass through themselves and together make up the solid.

    A surface that passes through itself falls apart into separate bodies when it is
    cut small enough, and separate bodies can be united. Only what is still tangled is
    cut again, so that the rest keeps its large triangles. Where the surface lies
    inside out there is no material: such places are dents deeper than the wall is thick.
    """
    pieces = [piece for piece in solid.decompose() if abs(piece.volume()) > NOTHING]
    if any(piece.volume() < 0.0 for piece in pieces):
        pieces = [piece for piece in pieces if not _is_dent(piece, pieces)]
        # What is left of negative volume is a cavity, or too tangled to tell: it stays
        # together with what is around it.
        pieces = [manifold3d.Manifold.compose(pieces)] if pieces else []
    done: list[manifold3d.Manifold] = []
    for piece in pieces:
        vertices, faces = _from_manifold(piece)
        if overlap_share(vertices, faces, points=CELL_POINTS) == 0.0:
            done.append(piece)
        elif depth == 0:
            done += [part for part in piece.decompose() if part.volume() > 0.0]
        else:
            low, size = vertices.min(axis=0), np.ptp(vertices, axis=0)
            axis = int(np.argmax(size))
            normal = [float(axis == i) for i in range(3)]
            for half in piece.split_by_plane(normal, float(low[axis] + CUT * size[axis])):
                done += _untangle(half, depth - 1)
    return done


def _is_dent(piece: manifold3d.Manifold, pieces: list[manifold3d.Manifold]) -> bool:
    """Return whether a piece is inside out throughout and in no other piece."""
    if piece.volume() > 0.0:
        return False
    vertices, faces = _from_manifold(piece)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    for other in pieces:
        box = np.array(other.bounding_box())
        if other.volume() > 0.0 and (box[:3] <= low).all() and (high <= box[3:]).all():
            return False
    return overlap_share(vertices, faces[:, ::-1], points=CELL_POINTS) == 0.0


def _separate(vertices: Array, faces: Faces, notes: list[str]) -> tuple[Array, Faces]:
    """Return a surface that does not pass through itself, counting every place once."""
    tangled = left = overlap_share(vertices, faces)
    if NOTICED_OVERLAP < tangled <= MAX_TANGLED:
        solid = _to_manifold(vertices, faces)
        pieces = _untangle(solid, MAX_CUTS)
        united = manifold3d.Manifold.batch_boolean(pieces, manifold3d.OpType.Add)
        candidate = _tidy(united, diagonal(vertices), chip=CRUMB)
        left_then = overlap_share(*candidate)
        if left_then < tangled and _changed_share(candidate, vertices, faces) < MAX_CHANGED:
            (vertices, faces), left = candidate, left_then
            notes.append(
                f"the surface passed through itself in {tangled:.1%} of its volume, "
                "which now counts once"
            )
    if left > MAX_OVERLAP:
        raise MeshError(
            f"the surface must not pass through itself, got {left:.1%} of its volume "
            "enclosed twice or backwards"
        )
    if left > NOTED_OVERLAP:
        notes.append(f"the surface still passes through itself in {left:.1%} of its volume")
    return vertices, faces


def _changed_share(candidate: tuple[Array, Faces], vertices: Array, faces: Faces) -> float:
    """Return the part of a solid's volume that a candidate has lost or added."""
    points = vertices.min(axis=0) + np.ptp(vertices, axis=0) * _even_points(CHECK_POINTS)
    before = winding_numbers(points, vertices, faces) > 0.5
    after = winding_numbers(points, *candidate) > 0.5
    return float((before != after).sum() / max(1, before.sum()))


def mend_solid(vertices: Array, faces: Faces) -> Solid:
    """Return the surface of one solid from welded triangles.

    Args:
        vertices: (n, 3) [m].
        faces: (m, 3), as `weld` returns them.

    Raises:
        MeshError: If the surface cannot become a solid without inventing shape.
    """
    notes: list[str] = []
    size = diagonal(vertices)
    vertices, faces = _stitch(vertices, faces, notes)
    faces, walls = _drop_inner_walls(vertices, faces)
    total = float(face_areas(vertices, faces).sum())
    fragments = [(vertices[walls], "it ends at edges with three faces")] if len(walls) else []

    closed: list[tuple[Array, Faces]] = []
    holes, filled = 0, 0.0
    for body in _bodies(vertices, faces, notes):
        new_faces, new_holes, new_area = body.faces, 0, 0.0
        if not body.is_closed:
            try:
                lids, new_holes = _lids(body, size)
            except MeshError as error:
                fragments.append((body.vertices[body.faces], str(error)))
                continue
            new_area = sum(float(face_areas(body.vertices, lid).sum()) for lid in lids)
            new_faces = np.vstack((body.faces, *lids))
        area = float(face_areas(body.vertices, new_faces).sum())
        thickness = 2.0 * abs(signed_volume(body.vertices, new_faces)) / max(area, 1e-300)
        if thickness < FLAT * diagonal(body.vertices):
            fragments.append(
                (body.vertices[body.faces], "it must enclose a volume, got a flat sheet")
            )
            continue
        closed.append((body.vertices, new_faces))
        holes += new_holes
        filled += new_area
    if not closed:
        raise MeshError(max(fragments, key=lambda fragment: _triangle_area(fragment[0]))[1])
    share = filled / (filled + total)
    if share > MAX_FILLED:
        raise MeshError(
            f"holes must make up at most {MAX_FILLED:.0%} of the surface, got {share:.0%} "
            f"({holes} open rims): the surface is too open to be a solid"
        )
    if holes:
        notes.append(f"{holes} open rims were closed, {share:.1%} of the surface: solid there now")

    vertices, faces = _separate(*_unite(closed, size, notes), notes)
    if not len(faces) or not is_solid_surface(faces) or signed_volume(vertices, faces) <= 0.0:
        raise MeshError("the mended surface must be watertight with outward normals, got gaps")
    _drop_fragments(fragments, vertices, faces, total, notes)
    return Solid(vertices=vertices, faces=faces, notes=tuple(notes))


def _triangle_area(triangles: Array) -> float:
    return float(
        face_areas(triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3)).sum()
    )


def _drop_fragments(
    fragments: list[tuple[Array, str]],
    vertices: Array,
    faces: Faces,
    total: float,
    notes: list[str],
) -> None:
    """Note the pieces that are no part of the solid; refuse to lose visible ones."""
    lost, worst, reason = 0.0, 0.0, ""
    for triangles, why in fragments:
        # A quarter, not a half: a wall that lies in the surface itself is not visible.
        hidden = winding_numbers(triangles.mean(axis=1), vertices, faces) > 0.25
        visible = _triangle_area(triangles[~hidden])
        lost += visible
        if visible > worst:
            worst, reason = visible, why
    if lost > MAX_DROPPED * total:
        raise MeshError(
            f"pieces that enclose nothing must be at most {MAX_DROPPED:.0%} of the surface, got "
            f"{lost / total:.1%}; the largest: {reason}"
        )
    if fragments:
        notes.append(
            f"{len(fragments)} pieces that enclose nothing were dropped "
            f"({lost / total:.2%} of the surface, the rest inside the solid)"
        )


def count_parts(vertices: Array, faces: Faces) -> int:
    """Return the number of pieces of a solid that do not touch; cavities do not count."""
    count, piece = _face_components(_pair(vertices, faces, radial=False), len(faces))
    if count == 1:
        return 1
    return sum(signed_volume(vertices, faces[piece == index]) > 0.0 for index in range(count))


# Fewer faces


def surface_deviation(first: Solid, second: Solid) -> float:
    """Return the largest distance between two surfaces [m], both ways, at fixed points."""
    meshes = [trimesh.Trimesh(s.vertices, s.faces, process=False) for s in (first, second)]
    worst = 0.0
    for here, there in (meshes, meshes[::-1]):
        rng = np.random.default_rng(0)
        areas = face_areas(here.vertices, here.faces)
        picked = rng.choice(len(areas), DEVIATION_POINTS, p=areas / areas.sum())
        weights = rng.dirichlet((1.0, 1.0, 1.0), DEVIATION_POINTS)
        points = np.einsum("ij,ijk->ik", weights, here.vertices[here.faces[picked]])
        corners = rng.permutation(len(here.vertices))[:DEVIATION_POINTS]
        points = np.vstack((points, here.vertices[corners]))
        worst = max(worst, float(trimesh.proximity.closest_point(there, points)[1].max()))
    return worst


def decimate(solid: Solid, max_faces: int) -> tuple[Solid, float]:
    """Return a solid with at most `max_faces` faces, and its deviation from the given one [m].

    Quadric decimation keeps the shape better, but promises no closed surface;
    manifold3d's simplification does. The second is tried where the first fails or
    leaves the surface by more than `FAITHFUL`; the closer one wins.

    Raises:
        MeshError: If neither gives a closed surface of about the same volume.
    """
    if len(solid.faces) <= max_faces:
        return solid, 0.0
    faithful = FAITHFUL * diagonal(solid.vertices)
    best: tuple[Solid, float] | None = None
    for candidate in (_decimate_quadric, _simplify_manifold):
        reduced = candidate(solid, max_faces)
        if reduced is not None and _is_sound(reduced, solid):
            error = surface_deviation(solid, reduced)
            if best is None or error < best[1]:
                best = reduced, error
            if error <= faithful:
                break
    if best is None:
        raise MeshError(
            f"the collision mesh must keep its shape with at most {max_faces} faces, got a broken "
            f"one from {len(solid.faces)}: raise max_collision_faces"
        )
    return best


def _is_sound(reduced: Solid, solid: Solid) -> bool:
    volume = signed_volume(solid.vertices, solid.faces)
    change = signed_volume(reduced.vertices, reduced.faces) / volume - 1.0
    return (
        is_solid_surface(reduced.faces)
        and abs(change) < MAX_VOLUME_CHANGE
        and overlap_share(reduced.vertices, reduced.faces) < MAX_OVERLAP
    )


def _decimate_quadric(solid: Solid, max_faces: int) -> Solid | None:
    for aggressiveness in DECIMATION_STEPS:
        vertices, faces = fast_simplification.simplify(
            np.ascontiguousarray(solid.vertices),
            np.ascontiguousarray(solid.faces),
            target_count=max_faces,
            agg=aggressiveness,
        )
        if not 0 < len(faces) <= max_faces:
            continue
        # Walls that have come to touch share edges now; parting them closes both again.
        bodies = _bodies(np.asarray(vertices, dtype=np.float64), np.asarray(faces, np.int64), [])
        return _stack([(body.vertices, body.faces) for body in bodies])
    return None


def _simplify_manifold(solid: Solid, max_faces: int) -> Solid | None:
    """Find the smallest tolerance that gives few enough faces, by bisection of its logarithm."""
    source = _to_manifold(solid.vertices, solid.faces).as_original()
    low, high = np.log(1e-6 * diagonal(solid.vertices)), np.log(0.05 * diagonal(solid.vertices))
    best = None
    for _ in range(14):
        middle = (low + high) / 2.0
        reduced = source.simplify(float(np.exp(middle)))
        if 0 < reduced.num_tri() <= max_faces:
            best, high = reduced, middle
        else:
            low = middle
    return None if best is None else _stack([_from_manifold(best)])
