"""Geometric repair: from a soup of triangles to one watertight solid.

`repair_solid` takes welded triangles in metres and returns the surface of one solid: it is closed,
every edge is shared by exactly two faces with opposite directions along it, and normals point
outward. Notes list what was changed. A mesh that cannot be repaired without inventing shape raises
`MeshError` with the reason; `drakegrasp.objects.model` adds the file's name. A mesh that is a clean
solid keeps its own vertices.

The order matters: gaps are stitched and inner walls are dropped while neighbours are still known.
Then the surface is separated into `components`, whose holes are closed. Finally the components are
united, and the result is checked by generalised winding numbers, which are independent of the
previous steps.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from drakegrasp.arithmetic import dot, norm
from drakegrasp.errors import MeshError
from drakegrasp.frames import Array
from drakegrasp.mesh.components import (
    check_self_intersection,
    close_rims,
    edge_ids,
    face_components,
    find_components,
    pair_half_edges,
    part_touching_edges,
    unite,
)
from drakegrasp.mesh.surfaces import (
    Faces,
    Solid,
    compact,
    connect,
    diagonal,
    face_areas,
    half_edges,
    is_solid_surface,
    signed_volume,
    winding_numbers,
)

#: Vertices closer than this fraction of the diagonal are merged: above the rounding of files
#: with eight digits, far below the detail of any scan.
WELD = 1e-8
#: Maximum number of pieces of a surface: each takes milliseconds, and no object that a hand lifts
#: has more.
MOST_PIECES = 5_000
#: Rims closer than this fraction of the diagonal are the two sides of one seam.
STITCH = 1e-4
#: A component encloses nothing if its mean thickness is below this fraction of its diagonal.
FLAT = 1e-4
#: Fraction of the surface that filled holes may make up: an open box just passes (1/6); a
#: hemispherical bowl of a single sheet (1/3) does not, since it would become solid.
MAX_FILLED = 0.25
#: Fragments outside the solid that may be dropped, as a fraction of the surface.
MAX_DROPPED = 0.01
#: Inner walls are found by testing all subsets of patches; 2^12 subsets take milliseconds.
MAX_PATCHES = 12


def weld(vertices: Array, faces: Faces) -> tuple[Array, Faces]:
    """Return a mesh with equal vertices merged and degenerate and duplicate faces dropped.

    Collinear faces with three different vertices are kept, because dropping them would open the
    surface.

    Args:
        vertices: (n, 3).
        faces: (m, 3).
    """
    # Merge vertices that round to the same grid point; drop faces that then have a vertex twice.
    used = np.zeros(len(vertices), dtype=bool)
    used[faces] = True
    low = vertices.min(axis=0, initial=np.inf, where=used[:, None])
    high = vertices.max(axis=0, initial=-np.inf, where=used[:, None])
    spacing = WELD * max(float(norm(high - low)), 1e-300)
    _, first, inverse = np.unique(
        np.round(vertices / spacing), axis=0, return_index=True, return_inverse=True
    )
    faces = first[inverse.reshape(-1)][faces].astype(np.int64)
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]

    # A face that occurs twice is a copy, or the wall between two touching solids. The
    # interpretation that leaves fewer edges with an odd number of faces is taken.
    _, index, inverse, counts = np.unique(
        np.sort(faces, axis=1), axis=0, return_index=True, return_inverse=True, return_counts=True
    )
    if (counts > 1).any():
        once = faces[np.sort(index)]
        without = faces[counts[inverse.reshape(-1)] != 2]
        faces = min((once, without), key=_odd_edges) if len(without) else once
    return compact(vertices, faces)


def repair_solid(vertices: Array, faces: Faces) -> Solid:
    """Return the surface of one solid from welded triangles.

    Args:
        vertices: (n, 3) [m].
        faces: (m, 3), as `weld` returns them.

    Raises:
        MeshError: If the surface cannot become a solid without inventing shape.
    """
    try:
        return _repair(vertices, faces, [])
    except MeshError as reason:
        # Scans touch themselves along edges, where rims then cross: part these edges and try again.
        touching = int((edge_ids(faces)[1] > 2).sum())
        if not touching:
            raise
        note = f"the surface touched itself along {touching} edges and was parted there"
        try:
            return _repair(*part_touching_edges(vertices, faces), [note])
        except MeshError:
            raise reason from None


def _repair(vertices: Array, faces: Faces, notes: list[str]) -> Solid:
    # Make one surface, while neighbours are still known.
    size = diagonal(vertices)
    vertices, faces = _stitch(vertices, faces, notes)
    faces, walls = _drop_inner_walls(vertices, faces)
    total = float(face_areas(vertices, faces).sum())
    fragments = [(vertices[walls], "it ends at edges with three faces")] if len(walls) else []

    # Close each component; components that enclose nothing are fragments.
    closed: list[tuple[Array, Faces]] = []
    rims, filled = 0, 0.0
    components = find_components(vertices, faces, notes)
    if len(components) > MOST_PIECES:
        raise MeshError(
            f"the surface must be of at most {MOST_PIECES:,} pieces, got {len(components):,}: keep "
            "the large ones"
        )
    for component in components:
        new_faces, new_rims, new_area = component.faces, 0, 0.0
        if not component.is_closed:
            try:
                lids, new_rims = close_rims(component, size)
            except MeshError as error:
                fragments.append((component.vertices[component.faces], str(error)))
                continue
            new_area = sum(float(face_areas(component.vertices, lid).sum()) for lid in lids)
            new_faces = np.vstack((component.faces, *lids))
        area = float(face_areas(component.vertices, new_faces).sum())
        thickness = 2.0 * abs(signed_volume(component.vertices, new_faces)) / max(area, 1e-300)
        if thickness < FLAT * diagonal(component.vertices):
            fragments.append(
                (component.vertices[component.faces], "it must enclose a volume, got a flat sheet")
            )
            continue
        closed.append((component.vertices, new_faces))
        rims += new_rims
        filled += new_area

    # Reject a surface that is too open to be a solid.
    if not closed:
        raise MeshError(max(fragments, key=lambda fragment: _triangle_area(fragment[0]))[1])
    share = filled / (filled + total)
    if share > MAX_FILLED:
        raise MeshError(
            f"holes must make up at most {MAX_FILLED:.0%} of the surface, got {share:.0%} "
            f"({rims} open rims): the surface is too open to be a solid"
        )
    if rims:
        notes.append(f"{rims} open rims were closed, {share:.1%} of the surface: solid there now")

    # Unite the components, and check the result.
    vertices, faces = unite(closed, size, notes)
    check_self_intersection(vertices, faces, notes)
    if not len(faces) or not is_solid_surface(faces) or signed_volume(vertices, faces) <= 0.0:
        raise MeshError("the repaired surface must be watertight with outward normals, got gaps")
    _note_fragments(fragments, vertices, faces, total, notes)
    return Solid(vertices=vertices, faces=faces, notes=tuple(notes))


def _stitch(vertices: Array, faces: Faces, notes: list[str]) -> tuple[Array, Faces]:
    """Return a surface whose nearly touching rim vertices are merged, if that closes edges."""
    ids, counts = edge_ids(faces)
    rim = np.unique(half_edges(faces)[counts[ids] == 1])
    if not len(rim):
        return vertices, faces

    # Merge rim vertices that are close to each other, directly or through others between them.
    pairs = cKDTree(vertices[rim]).query_pairs(STITCH * diagonal(vertices), output_type="ndarray")
    _, labels = connect(pairs[:, 0], pairs[:, 1], len(rim))
    _, first = np.unique(labels, return_index=True)
    merged = np.arange(len(vertices))
    merged[rim] = rim[first[labels]]
    stitched = merged[faces]
    stitched = stitched[(stitched != np.roll(stitched, 1, axis=1)).all(axis=1)]

    # Keep the result only if fewer edges have an odd number of faces.
    before, after = int((counts == 1).sum()), int((edge_ids(stitched)[1] == 1).sum())
    if not len(stitched) or _odd_edges(stitched) >= _odd_edges(faces):
        return vertices, faces
    notes.append(f"{before - after} open edges were stitched together")
    return compact(vertices, stitched)


def _drop_inner_walls(vertices: Array, faces: Faces) -> tuple[Faces, Faces]:
    """Return the faces that bound the solid, and the faces of inner walls and fins.

    If three faces meet at an edge, one of them is a fin or a wall inside the solid. Patches are the
    pieces of surface between such edges. The best choice of patches leaves the fewest edges with an
    odd number of faces; among equal choices, the one that keeps the most area is taken.
    """
    ids, counts = edge_ids(faces)
    if not ((counts > 2) & (counts % 2 == 1)).any():
        return faces, faces[:0]
    twins = pair_half_edges(vertices, faces, radial=False)
    patch_count, patch = face_components(twins, len(faces))

    # How many faces each patch (column) has at each edge (row) whose number of faces is not two.
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

    # Test all subsets of these patches.
    bits = (np.arange(2 ** len(doubtful))[:, None] >> np.arange(len(doubtful))) & 1
    odd = ((bits @ table[:, doubtful].T) % 2).sum(axis=1)
    areas = np.bincount(patch, face_areas(vertices, faces), patch_count)[doubtful]
    best = bits[np.lexsort((-dot(bits, areas), odd))[0]]
    dropped = np.isin(patch, doubtful[best == 0])
    return faces[~dropped], faces[dropped]


def _odd_edges(faces: Faces) -> int:
    """Return the number of edges with an odd number of faces."""
    return int((edge_ids(faces)[1] % 2).sum())


def _note_fragments(
    fragments: list[tuple[Array, str]],
    vertices: Array,
    faces: Faces,
    total: float,
    notes: list[str],
) -> None:
    """Add a note about the fragments that are not part of the solid.

    Args:
        fragments: Corners (m, 3, 3) [m] of each fragment, and why it is a fragment.
        vertices: Vertices of the solid (n, 3) [m].
        faces: Faces of the solid (k, 3).
        total: Area of the whole surface [m^2].
        notes: The note is appended here.

    Raises:
        MeshError: If too much of the visible surface would be lost.
    """
    lost, worst, reason = 0.0, 0.0, ""
    for triangles, why in fragments:
        # A quarter instead of a half, since a wall within the surface itself is not visible.
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


def _triangle_area(triangles: Array) -> float:
    """Return the total area of triangles (m, 3, 3) [m^2]."""
    return float(
        face_areas(triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3)).sum()
    )
