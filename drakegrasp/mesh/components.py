"""Components: the connected pieces of surface of a file, closed and united to one surface.

All faces of a component agree on which side is outside, and a component shares no vertex with
another. Half-edge 3f + i starts at corner i of face f; its twin is the opposite half-edge of the
neighbouring face, or -1 at a rim. Only an open rim that is flat or small is certainly a hole and
can be closed; other rims raise `MeshError`.

Closed components may overlap, be inside of each other, and be inside out. Their union encloses each
point at most once; one that passes through itself is refused.
"""

from __future__ import annotations

from dataclasses import dataclass

import manifold3d
import numpy as np

from drakegrasp.arithmetic import dot, multiply, norm
from drakegrasp.errors import MeshError
from drakegrasp.frames import Array
from drakegrasp.mesh.surfaces import (
    MAX_OVERLAP,
    Faces,
    compact,
    connect,
    diagonal,
    face_areas,
    from_manifold,
    half_edges,
    is_solid_surface,
    overlap_share,
    signed_volume,
    split_faces,
    stack,
    to_manifold,
)

#: If two touching edges belong to one face, the faces between their new vertices still touch and
#: are parted in a second turn; a third turn was never needed.
MAX_PARTINGS = 4
#: Triangles whose height is below this fraction of the diagonal are slivers due to rounding.
SLIVER = 1e-8
#: Tolerance of the clean-up after a Boolean operation, as a fraction of the diagonal.
TIDY = 1e-5
#: Pieces of a union below this fraction of its volume are due to rounding, not geometry.
CHIP = 1e-6
#: Share of a volume from which on a surface that passes through itself is noted.
NOTED_OVERLAP = 0.002


@dataclass(frozen=True, kw_only=True, eq=False)
class Component:
    """One connected piece of surface.

    Attributes:
        vertices: (n, 3) [m].
        faces: (m, 3).
        twins: (3m,), the half-edge opposite to each half-edge, or -1.
    """

    vertices: Array
    faces: Faces
    twins: Faces

    @property
    def is_closed(self) -> bool:
        """Whether every edge belongs to two faces."""
        return bool((self.twins >= 0).all())


def find_components(vertices: Array, faces: Faces, notes: list[str]) -> list[Component]:
    """Return the components of a surface, each consistently oriented and with its own vertices.

    Args:
        vertices: (n, 3) [m].
        faces: (m, 3).
        notes: Repairs are appended here, in sentences.

    Raises:
        MeshError: If a component has only one side.
    """
    twins = pair_half_edges(vertices, faces, radial=True)

    # Corners that meet across a paired edge share a vertex. All other corners are separated, even
    # if two components of the file touch at a single point.
    halves = np.flatnonzero(twins >= 0)
    ends = half_edges(faces)
    start, end = halves, halves - halves % 3 + (halves + 1) % 3
    other = twins[halves]
    other_end = other - other % 3 + (other + 1) % 3
    same = ends[halves, 0] == ends[other, 0]
    rows = np.concatenate((start, end))
    columns = np.concatenate((np.where(same, other, other_end), np.where(same, other_end, other)))
    _, corner_vertex = connect(rows, columns, len(ends))
    _, first = np.unique(corner_vertex, return_index=True)
    vertices = vertices[faces.ravel()[first]]
    faces = corner_vertex.reshape(-1, 3).astype(np.int64)

    # Neighbouring faces must have opposite directions along their common edge.
    flip, flipped = _orient(vertices, faces, twins)
    if flipped:
        notes.append(
            f"{flipped} of {len(faces)} faces ran against their neighbours and were turned"
        )
    faces = np.where(flip[:, None], faces[:, ::-1], faces)

    # One component for each connected set of faces.
    count, piece = face_components(twins, len(faces))
    components = []
    for index in range(count):
        own = np.flatnonzero(piece == index)
        part_vertices, part_faces = compact(vertices, faces[own])
        part_twins = pair_half_edges(part_vertices, part_faces, radial=False)
        components.append(Component(vertices=part_vertices, faces=part_faces, twins=part_twins))
    return components


def _orient(vertices: Array, faces: Faces, twins: Faces) -> tuple[Faces, int]:
    """Return whether to flip each face (m,) so that neighbours agree, and how many to flip.

    Each face and its flipped copy are two nodes of a graph, whose connected components are
    consistent choices. The choice that keeps the orientation of the larger area is taken.
    """
    # A node is joined to the neighbour's node that has the opposite direction along their edge.
    m = len(faces)
    halves = np.flatnonzero(twins >= 0)
    ends = half_edges(faces)
    clash = (ends[halves, 0] == ends[twins[halves], 0]).astype(np.int64)
    f, g = halves // 3, twins[halves] // 3
    rows, columns = np.concatenate((f, f + m)), np.concatenate((g + m * clash, g + m * (1 - clash)))
    _, labels = connect(rows, columns, 2 * m)
    if (labels[:m] == labels[m:]).any():
        raise MeshError("the surface must have two sides, got one like a Möbius strip")

    # Keep the first face of each component, or flip the component if that keeps more of the area.
    count, piece = face_components(twins, m)
    _, first = np.unique(piece, return_index=True)
    flip = labels[:m] != labels[first[piece]]
    areas = face_areas(vertices, faces)
    flipped = np.bincount(piece, areas * flip, count) > 0.5 * np.bincount(piece, areas, count)
    flip = flip ^ flipped[piece]
    return flip, int(flip.sum())


def count_parts(vertices: Array, faces: Faces) -> int:
    """Return the number of separate parts of a solid; cavities do not count."""
    count, piece = face_components(pair_half_edges(vertices, faces, radial=False), len(faces))
    if count == 1:
        return 1
    return sum(signed_volume(vertices, faces[piece == index]) > 0.0 for index in range(count))


def part_touching_edges(vertices: Array, faces: Faces) -> tuple[Array, Faces]:
    """Return the same surface with as few edges of four or more faces as possible.

    If a surface touches itself along an edge, the two faces that bound the same wedge of solid get
    their own vertex at the centre of the edge, so that each half of the edge has two faces again.

    Args:
        vertices: (n, 3) [m].
        faces: (m, 3).
    """
    for _ in range(MAX_PARTINGS):
        # The pairs of half-edges at such edges, each pair once.
        ids, counts = edge_ids(faces)
        if not (counts > 2).any():
            break
        twins = pair_half_edges(vertices, faces, radial=True)
        halves = np.arange(len(twins))
        first = halves[(counts[ids] > 2) & (halves < twins)]

        # A vertex for each pair, on both of its half-edges.
        ends = half_edges(faces)[first]
        midpoints = np.full(len(twins), -1, dtype=np.int64)
        midpoints[first] = midpoints[twins[first]] = len(vertices) + np.arange(len(first))
        new = (vertices[ends[:, 0]] + vertices[ends[:, 1]]) / 2.0
        vertices = np.vstack((vertices, new))
        faces = split_faces(vertices, faces, midpoints.reshape(-1, 3))
    return vertices, faces


# Half-edges


def edge_ids(faces: Faces) -> tuple[Faces, Faces]:
    """Return the edge of every half-edge (3m,), and the number of faces of every edge."""
    halves = np.sort(half_edges(faces), axis=1)
    key = halves[:, 0] * (int(faces.max(initial=0)) + 1) + halves[:, 1]
    _, ids, counts = np.unique(key, return_inverse=True, return_counts=True)
    return ids.reshape(-1), counts


def pair_half_edges(vertices: Array, faces: Faces, *, radial: bool) -> Faces:
    """Return the opposite of every half-edge (3m,), or -1 if it has none.

    At an edge with four or more faces, `radial` pairs the faces that bound the same wedge of solid,
    so that components that touch along an edge are separated.
    """
    # The two faces of an edge with two faces are neighbours.
    ids, counts = edge_ids(faces)
    order = np.argsort(ids, kind="stable")
    starts = np.concatenate(([0], np.cumsum(counts)[:-1]))
    twins = np.full(3 * len(faces), -1, dtype=np.int64)
    pairs = starts[counts == 2]
    twins[order[pairs]], twins[order[pairs + 1]] = order[pairs + 1], order[pairs]

    # An edge with four or more faces.
    if radial:
        for edge in np.flatnonzero((counts > 2) & (counts % 2 == 0)):
            _pair_radially(
                vertices, faces, order[starts[edge] : starts[edge] + counts[edge]], twins
            )
    return twins


def _pair_radially(vertices: Array, faces: Faces, halves: Faces, twins: Faces) -> None:
    """Pair the half-edges of one edge by their angles around it.

    They stay unpaired if the numbers of half-edges in the two directions differ.
    """
    face, corner = halves // 3, halves % 3
    start, end = faces[face, corner], faces[face, (corner + 1) % 3]
    leaves = start < end
    if 2 * int(leaves.sum()) != len(halves):
        return

    # The angle of each face around the edge, from its third corner.
    low, high = int(start.min()), int(end.max())
    axis = vertices[high] - vertices[low]
    axis = axis / norm(axis)
    arms = vertices[faces[face, (corner + 2) % 3]] - vertices[low]
    first = np.cross(axis, arms[0])
    second = np.cross(axis, first)
    angles = np.round(np.arctan2(dot(arms, second), dot(arms, first)) % (2.0 * np.pi), 6)
    angles[angles >= 6.283185] = 0.0

    # Around the axis, the solid ends at a face whose half-edge has the axis' direction, and begins
    # at a face with the opposite one. At equal angles the end comes first, so that components that
    # share a wall stay two.
    turn = np.lexsort((~leaves, angles))
    depth = np.cumsum(np.where(leaves[turn], -1, 1))
    turn = np.roll(turn, -(int(np.argmin(depth)) + 1))

    # Each end is paired with the last beginning before it.
    entered: list[int] = []
    for half in turn:
        if leaves[half]:
            other = entered.pop()
            twins[halves[half]], twins[halves[other]] = halves[other], halves[half]
        else:
            entered.append(int(half))


def face_components(twins: Faces, face_count: int) -> tuple[int, Faces]:
    """Return the number of connected components, and the component of every face (m,)."""
    halves = np.flatnonzero(twins >= 0)
    return connect(halves // 3, twins[halves] // 3, face_count)


#: A rim is planar if it deviates from its plane by at most this fraction of its own size ...
PLANAR = 0.05
#: ... and small if its size is below this fraction of the object's diagonal.
SMALL_RIM = 0.15
#: A rim has an area if it is larger than this fraction of the square of its farthest distance from
#: its mean.
SLIT = 1e-6


def close_rims(component: Component, size: float) -> tuple[list[Faces], int]:
    """Return the triangles that close all rims of a component, and the number of rims.

    Args:
        component: The surface; the triangles use its vertices.
        size: Diagonal of the whole object [m].

    Raises:
        MeshError: If a rim is neither flat nor small, is large and crosses itself, or is no closed
            loop.
    """
    # Large rims come first, so that an outer rim comes before the inner rims in its plane.
    vertices = component.vertices
    rims = sorted(_rims(component), key=lambda r: -float(norm(_area_vector(vertices[r]))))
    lids: list[Faces] = []
    closed = 0
    while rims:
        # A plane through the rim, with its normal out of the solid.
        outer = rims.pop(0)
        points = vertices[outer]
        centre, width = points.mean(axis=0), diagonal(points)
        basis, normal = _plane_axes(points - centre)
        off_plane = float(np.abs(dot(points - centre, normal)).max())
        if off_plane > PLANAR * width and width > SMALL_RIM * size:
            raise MeshError(
                f"open edges must surround a flat or a small hole, got {len(outer)} that span "
                f"{width * 1e3:.3g} mm and leave their plane by {off_plane * 1e3:.3g} mm"
            )

        # A second rim in the same plane, inside the first and in the opposite direction, is the
        # inner edge of a wall: the gap between the two rims is a ring.
        flat = multiply(points - centre, basis.T)
        loops, polygons = [outer], [flat]
        for rim in list(rims):
            local = multiply(vertices[rim] - centre, basis.T)
            away = np.abs(dot(vertices[rim] - centre, normal)).max()
            backward = float(dot(_area_vector(vertices[rim]), normal)) < 0.0
            if away < 1e-3 * width and backward and _inside_polygon(local[0], flat):
                loops.append(rim)
                polygons.append(local)
                rims = [r for r in rims if r is not rim]

        # Triangulate in the plane. A rim that crosses itself covers more than its area.
        triangles = manifold3d.triangulate([np.ascontiguousarray(p) for p in polygons])
        corners = np.vstack(polygons)[triangles]
        u, v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        covered = np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]).sum() / 2.0
        wanted = sum(_area_vector(np.pad(p, ((0, 0), (0, 1))))[2] for p in polygons)
        if covered > 1.01 * abs(wanted) + 1e-6 * width**2 and width > SMALL_RIM * size:
            raise MeshError(f"the rim of a hole of {width * 1e3:.3g} mm must not cross itself")
        lids.append(np.concatenate(loops)[triangles].astype(np.int64))
        closed += len(loops)
    return lids, closed


def _rims(component: Component) -> list[Faces]:
    """Return the boundary loops as vertex indices, in the direction of the missing faces."""
    # The successor of each vertex; a vertex with two successors means that two rims touch.
    open_halves = np.flatnonzero(component.twins < 0)
    ends = half_edges(component.faces)[open_halves]
    after = {int(b): int(a) for a, b in ends}
    if len(after) != len(ends):
        raise MeshError("the rim of a hole must not cross itself")

    # Follow each loop from its lowest vertex.
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
    """Return the vector area (3,) [m^2] of a closed polygon (n, 3)."""
    centred = points - points.mean(axis=0)
    return np.asarray(np.cross(centred, np.roll(centred, -1, axis=0)).sum(axis=0) / 2.0)


def _plane_axes(points: Array) -> tuple[Array, Array]:
    """Return two axes (2, 3) and the normal (3,) of the plane of a rim (n, 3) about its mean.

    The normal is the direction of the rim's area. A rim without an area is a slit: then it is any
    direction perpendicular to that of the farthest point.
    """
    area, far = _area_vector(points), points[np.argmax(norm(points))]
    slit = norm(area) <= SLIT * norm(far) ** 2
    normal = _across(far) if slit else area / norm(area)
    first = _across(normal)
    return np.array([first, np.cross(normal, first)]), normal


def _across(direction: Array) -> Array:
    """Return a unit vector (3,) perpendicular to a direction (3,) and to a coordinate axis."""
    found = np.cross(np.eye(3)[np.argmin(np.abs(direction))], direction)
    return np.asarray(found / norm(found))


def _inside_polygon(point: Array, polygon: Array) -> bool:
    """Return whether a point (2,) is in a polygon (n, 2), by the crossings of a ray."""
    (x, y), a, b = point, polygon, np.roll(polygon, -1, axis=0)
    crosses = (a[:, 1] > y) != (b[:, 1] > y)
    a, b = a[crosses], b[crosses]
    at = a[:, 0] + (y - a[:, 1]) / (b[:, 1] - a[:, 1]) * (b[:, 0] - a[:, 0])
    return bool((at > x).sum() % 2)


# The union


def unite(
    components: list[tuple[Array, Faces]], size: float, notes: list[str]
) -> tuple[Array, Faces]:
    """Return the surface of the union of closed components.

    Args:
        components: Vertices (n, 3) [m] and faces (m, 3) of each.
        size: Diagonal of the whole object [m].
        notes: Repairs are appended here, in sentences.
    """
    # A single component keeps its triangles, unless some are degenerate.
    if len(components) == 1:
        vertices, faces = components[0]
        if signed_volume(vertices, faces) < 0.0:
            notes.append("the surface was inside out and was turned")
            faces = faces[:, ::-1]
        a, b, c = np.moveaxis(vertices[faces], 1, 0)
        longest = np.linalg.norm(np.stack((b - a, c - b, a - c)), axis=2).max(axis=0)
        low = 2.0 * face_areas(vertices, faces) < SLIVER * size * longest
        if not low.any() and is_solid_surface(faces):
            return vertices, faces
        notes.append("degenerate triangles were collapsed")
        return _tidy(to_manifold(vertices, faces), size)

    shells = _shells(components, notes)
    if len(shells) > 1:
        notes.append(f"{len(shells)} bodies were united into one solid")
    return _tidy(manifold3d.Manifold.batch_boolean(shells, manifold3d.OpType.Add), size)


def _shells(components: list[tuple[Array, Faces]], notes: list[str]) -> list[manifold3d.Manifold]:
    """Return closed components as solids: cavities are cut out, other inverted ones turned."""
    volumes = [signed_volume(*component) for component in components]
    if volumes[int(np.argmax(np.abs(volumes)))] < 0.0:
        # The largest component decides: the whole file is inside out, cavities included.
        notes.append("the surface was inside out and was turned")
        components = [(v, f[:, ::-1]) for v, f in components]
        volumes = [-volume for volume in volumes]
    solids = [
        to_manifold(v, f if volume > 0.0 else f[:, ::-1])
        for (v, f), volume in zip(components, volumes, strict=True)
    ]

    # A component that is inside out is a cavity of the smallest component around it, if any.
    boxes = [(v.min(axis=0), v.max(axis=0)) for v, _ in components]
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
        notes.append(f"{turned} of {len(components)} bodies were inside out and were turned")
    if hollow:
        notes.append(f"{hollow} sealed cavities were kept hollow")

    # A cavity is cut only from the component around it, so that components inside it remain.
    cut = {i for holes in cavities.values() for i in holes}
    return [
        manifold3d.Manifold.batch_boolean(
            [solids[i], *(solids[j] for j in cavities[i])], manifold3d.OpType.Subtract
        )
        if i in cavities
        else solids[i]
        for i in range(len(components))
        if i not in cut
    ]


def _tidy(solid: manifold3d.Manifold, size: float) -> tuple[Array, Faces]:
    """Return the result of a Boolean operation without its slivers and chips."""
    solid = solid.as_original().simplify(TIDY * size)
    pieces = solid.decompose()
    kept = [p for p in pieces if abs(p.volume()) > CHIP * abs(solid.volume())]
    if 0 < len(kept) < len(pieces):
        tidied = stack([from_manifold(p) for p in kept])
        return tidied.vertices, tidied.faces
    return from_manifold(solid)


def check_self_intersection(vertices: Array, faces: Faces, notes: list[str]) -> None:
    """Reject a surface that passes through itself; a little of it is noted.

    Args:
        vertices: (n, 3) [m].
        faces: (m, 3).
        notes: A note is appended here, in a sentence.

    Raises:
        MeshError: If more than `MAX_OVERLAP` of its volume is enclosed twice or backwards.
    """
    share = overlap_share(vertices, faces)
    if share > MAX_OVERLAP:
        raise MeshError(
            f"the surface must not pass through itself, got {share:.1%} of its volume "
            "enclosed twice or backwards"
        )
    if share > NOTED_OVERLAP:
        notes.append(f"the surface passes through itself in {share:.1%} of its volume")
