"""Unions and differences of solids, with sound triangles along their seams.

manifold3d, through trimesh, cuts triangles where surfaces meet, and leaves slivers there and long
triangles in flat faces. Both are mended: they would cost contact patches for nothing. Nothing is
random.
"""

from __future__ import annotations

import numpy as np
import trimesh

from drakegrasp.arithmetic import dot, norm
from drakegrasp.frames import Array
from drakegrasp.mesh.surfaces import Faces
from drakegrasp.shapes.modelling.solids import ON_AXIS, grid_box, solid

#: Triangles lower than this [m] are removed after a Boolean operation: their normals mean little.
SLIVER = 0.0005

#: Four points nearer to one plane than this are in it [m]; files round to a tenth of it.
FLAT = 1e-6

#: Passes at most over all slivers, or over all edges of flat faces; a seam needs some dozens.
MAX_PASSES = 100


def fuse(*parts: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return the union of overlapping solids."""
    return _from_boolean(trimesh.boolean.union(list(parts), engine="manifold"))


def cut(body: trimesh.Trimesh, *tools: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return a solid without the space of the tools."""
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
    """Return the result of a boolean without the slivers along its seams."""
    # A canonical order first, because the repairs below depend on the order.
    tidy = solid(mesh.vertices, mesh.faces)
    points = np.array(tidy.vertices, dtype=float)
    faces = _even_out(points, np.array(tidy.faces, dtype=np.int64))
    refused: set[tuple[int, ...]] = set()

    # The lowest slivers first, each away from what was mended in the same pass.
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
    """Return the faces without a sliver, None if it must stay; `points` may be moved.

    Its shortest edge is collapsed if that is short, else its longest is turned.
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
    """Return the faces with edges turned in flat places, as in a Delaunay triangulation.

    An edge between two faces of one plane is turned if the angles opposite to it add up to more
    than a half turn. Equal angles, as in grids, stay as they are.
    """
    for _ in range(MAX_PASSES):
        a, b, left, right, first, second = _edges(faces)
        excess = -(_cotangent(points, a, b, left) + _cotangent(points, a, b, right))
        flat = _height_above(points, a, b, left, right) < FLAT
        wanted = np.flatnonzero(flat & (excess > 1e-3))
        if not len(wanted):
            break

        # The worst first, each face at most once in a pass; the new edge must be new.
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
    """Return the edges of a closed surface once each.

    Returns:
        Their ends a and b in the order of the first face, the vertices opposite to them in the
        first and in the second face, and the two faces; (n,) each.
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
    """Return how far (n,) [m] `right` is from the plane of `a`, `b` and `left`."""
    normal = np.cross(points[b] - points[a], points[left] - points[a])
    above = np.abs(dot(points[right] - points[a], normal))
    return np.asarray(above / np.maximum(norm(normal), ON_AXIS**2))


def _heights(points: Array, faces: Faces) -> Array:
    """Return the height (n,) [m] of each face above its longest edge."""
    corners = points[faces]
    longest = norm(np.roll(corners, -1, axis=1) - corners).max(axis=1)
    return np.asarray(norm(_normals(points, faces)) / np.maximum(longest, ON_AXIS))


def _normals(points: Array, faces: Faces) -> Array:
    """Return normals (n, 3) of faces, as long as twice their area [m^2]."""
    p, q, r = np.moveaxis(points[faces], 1, 0)
    return np.asarray(np.cross(q - p, r - p))


def _collapse(points: Array, faces: Faces, a: int, b: int) -> Faces | None:
    """Return the faces with vertex `b` made one with `a`.

    None if that would pinch the surface, or fold it where the two meet halfway.
    """
    around_a = set(faces[(faces == a).any(axis=1)].ravel().tolist())
    around_b = set(faces[(faces == b).any(axis=1)].ravel().tolist())
    if len((around_a & around_b) - {a, b}) != 2:
        return None
    joined = np.where(faces == b, a, faces)
    kept = (joined != np.roll(joined, 1, axis=1)).all(axis=1)

    # A face that turns over would cross its neighbours; a sliver may turn as it likes.
    touched = np.flatnonzero(kept & (joined == a).any(axis=1))
    touched = touched[_heights(points, faces[touched]) > SLIVER]
    met = points.copy()
    met[a] = (points[a] + points[b]) / 2.0
    turn = dot(_normals(points, faces[touched]), _normals(met, joined[touched]))
    return None if (turn <= 0.0).any() else joined[kept]


def _flip(points: Array, faces: Faces, a: int, b: int) -> Faces | None:
    """Return the faces with the edge from `a` to `b` turned, None if that does not help."""
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

    # The new pair must be higher, and look the same way as the old one.
    turned = np.array([(a, right, left), (right, b, left)])
    before, after = (_heights(points, either).min() for either in (faces[pair], turned))
    whole = _normals(points, faces[pair]).sum(axis=0)
    if after <= before or (dot(_normals(points, turned), whole) <= 0.0).any():
        return None
    result = faces.copy()
    result[pair] = turned
    return result
