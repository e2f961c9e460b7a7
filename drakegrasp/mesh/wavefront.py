"""Wavefront texts, for Drake's in-memory meshes."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import trimesh
from scipy.sparse import coo_matrix

from drakegrasp.frames import Array
from drakegrasp.mesh.surfaces import Faces

#: Faces that meet at an angle below this are shaded as one smooth surface.
CREASE_DEG = 30.0


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


def hull_text(corners: npt.ArrayLike) -> str:
    """Return the convex hull of corners (n, 3) as Wavefront text, with its faces turned outward."""
    hull = trimesh.convex.convex_hull(np.asarray(corners, dtype=float))
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
