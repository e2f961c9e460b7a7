"""Union: closed components come in, one surface that encloses each point at most once goes out.

Components may overlap, be inside of each other, be inside out, and pass through themselves.
"""

from __future__ import annotations

import manifold3d
import numpy as np

from drakegrasp.errors import MeshError
from drakegrasp.frames import Array
from drakegrasp.mesh.surfaces import (
    CHECK_POINTS,
    MAX_OVERLAP,
    Faces,
    diagonal,
    even_points,
    face_areas,
    from_manifold,
    is_solid_surface,
    overlap_share,
    signed_volume,
    stack,
    to_manifold,
    whole_windings,
)

#: Triangles whose height is below this fraction of the diagonal are slivers due to rounding.
SLIVER = 1e-8
#: Tolerance of the clean-up after a Boolean operation, as a fraction of the diagonal.
TIDY = 1e-5
#: Pieces of a union below this fraction of its volume are due to rounding, not geometry.
CHIP = 1e-6
#: A surface is untangled if it passes through itself in more than NOTICED_OVERLAP and at most
#: MAX_TANGLED of its volume. What is left is noted above NOTED_OVERLAP, and rejected above
#: `MAX_OVERLAP`.
NOTICED_OVERLAP = 0.01
MAX_TANGLED = 0.10
NOTED_OVERLAP = 0.002
#: Fraction of the volume that untangling may change by mistake.
MAX_CHANGED = 0.01
#: Largest number of successive cuts while untangling, and the position of each cut: not exactly at
#: the centre, where modelled objects often have a face.
MAX_CUTS = 6
CUT = 0.4871
#: Number of points at which a piece is checked.
CELL_POINTS = 300
#: Pieces smaller than this [m^3] are due to rounding.
NOTHING = 1e-15
#: Pieces of an untangled surface below this fraction of its volume are dropped: loose small
#: fragments where walls cross.
CRUMB = 1e-3


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


def _tidy(solid: manifold3d.Manifold, size: float, *, chip: float = CHIP) -> tuple[Array, Faces]:
    """Return the result of a Boolean operation without its slivers and chips."""
    solid = solid.as_original().simplify(TIDY * size)
    pieces = solid.decompose()
    kept = [p for p in pieces if abs(p.volume()) > chip * abs(solid.volume())]
    if 0 < len(kept) < len(pieces):
        tidied = stack([from_manifold(p) for p in kept])
        return tidied.vertices, tidied.faces
    return from_manifold(solid)


# Surfaces that pass through themselves


def separate(vertices: Array, faces: Faces, notes: list[str]) -> tuple[Array, Faces]:
    """Return a surface that does not pass through itself and encloses no point twice.

    Args:
        vertices: (n, 3) [m].
        faces: (m, 3).
        notes: Repairs are appended here, in sentences.

    Raises:
        MeshError: If the surface still passes through itself in more than `MAX_OVERLAP` of its
            volume.
    """
    # Untangle it if needed, and keep the result if it is better and has the same shape.
    tangled = left = overlap_share(vertices, faces)
    if NOTICED_OVERLAP < tangled <= MAX_TANGLED:
        solid = to_manifold(vertices, faces)
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

    # Report what is left.
    if left > MAX_OVERLAP:
        raise MeshError(
            f"the surface must not pass through itself, got {left:.1%} of its volume "
            "enclosed twice or backwards"
        )
    if left > NOTED_OVERLAP:
        notes.append(f"the surface still passes through itself in {left:.1%} of its volume")
    return vertices, faces


def _untangle(solid: manifold3d.Manifold, depth: int) -> list[manifold3d.Manifold]:
    """Return pieces that do not pass through themselves and together make up the solid.

    A surface that passes through itself falls apart into separate pieces if it is cut small enough,
    and separate pieces can be united. Only pieces that are still tangled are cut again, so that the
    others keep their large triangles. A part that is inside out contains no material: it is a dent
    deeper than the wall is thick.
    """
    # Drop dents.
    pieces = [piece for piece in solid.decompose() if abs(piece.volume()) > NOTHING]
    if any(piece.volume() < 0.0 for piece in pieces):
        pieces = [piece for piece in pieces if not _is_dent(piece, pieces)]
        # Any other piece of negative volume is a cavity, or too tangled to tell: it stays together
        # with the pieces around it.
        pieces = [manifold3d.Manifold.compose(pieces)] if pieces else []

    # Cut pieces that are still tangled across their longest side, and continue with the halves.
    done: list[manifold3d.Manifold] = []
    for piece in pieces:
        vertices, faces = from_manifold(piece)
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
    """Return whether a piece is inside out throughout and is not inside of another piece."""
    if piece.volume() > 0.0:
        return False
    vertices, faces = from_manifold(piece)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    for other in pieces:
        box = np.array(other.bounding_box())
        if other.volume() > 0.0 and (box[:3] <= low).all() and (high <= box[3:]).all():
            return False
    return overlap_share(vertices, faces[:, ::-1], points=CELL_POINTS) == 0.0


def _changed_share(candidate: tuple[Array, Faces], vertices: Array, faces: Faces) -> float:
    """Return the fraction of a solid's volume that a candidate has lost or added."""
    points = vertices.min(axis=0) + np.ptp(vertices, axis=0) * even_points(CHECK_POINTS)
    before = whole_windings(points, vertices, faces) > 0.5
    after = whole_windings(points, *candidate) > 0.5
    return float((before != after).sum() / max(1, before.sum()))
