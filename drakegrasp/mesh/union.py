"""Union: closed components come in, one surface that encloses each point at most once goes out.

Components may overlap, be inside of each other, and be inside out. One that passes through itself
is rejected.
"""

from __future__ import annotations

import manifold3d
import numpy as np

from drakegrasp.errors import MeshError
from drakegrasp.frames import Array
from drakegrasp.mesh.surfaces import (
    MAX_OVERLAP,
    Faces,
    face_areas,
    from_manifold,
    is_solid_surface,
    overlap_share,
    signed_volume,
    stack,
    to_manifold,
)

#: Triangles whose height is below this fraction of the diagonal are slivers due to rounding.
SLIVER = 1e-8
#: Tolerance of the clean-up after a Boolean operation, as a fraction of the diagonal.
TIDY = 1e-5
#: Pieces of a union below this fraction of its volume are due to rounding, not geometry.
CHIP = 1e-6
#: Share of a volume from which on a surface that passes through itself is noted.
NOTED_OVERLAP = 0.002


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
