"""Coarsening: a surface of very many triangles comes in; one that mending has memory for goes out.

Mending takes kilobytes for each face, and a scan may have millions of them, far finer than what a
fingertip feels or a camera sees. Such a surface is reduced before it is mended, in two steps: near
vertices are merged first, as quadric decimation itself takes much memory, and that does the rest. A
surface of at most `MOST_FACES` faces stays as it is.
"""

from __future__ import annotations

import numpy as np
import trimesh

from drakegrasp.frames import Array
from drakegrasp.mesh.decimation import DECIMATION_STEPS, reduce_and_part, some_vertices
from drakegrasp.mesh.repair import weld
from drakegrasp.mesh.surfaces import Faces, Solid, connect, diagonal
from drakegrasp.runtime.environment import release_memory

#: Faces above which a surface is reduced, to about as many: edges of 0.9 mm on a ball of 10 cm.
MOST_FACES = 100_000
#: Faces above which near vertices are merged first, to at most as many.
MOST_DECIMATED = 300_000
#: Cells in which vertices are merged: the first edge, as a fraction of the diagonal, and the factor
#: from one try to the next. Products, so that every machine has the same.
FIRST_CELL, CELL_FACTOR = 1.0 / 8192.0, 1.25


def coarsen(vertices: Array, faces: Faces) -> tuple[Array, Faces, tuple[str, ...]]:
    """Return a surface with about `MOST_FACES` faces at most, and what was done in a sentence.

    It may be open, and need not be of one piece.

    Args:
        vertices: (n, 3) [m].
        faces: (m, 3), as `weld` returns them.
    """
    if len(faces) <= MOST_FACES:
        return vertices, faces, ()

    # The allocator keeps what reading the file took.
    release_memory()

    # What is too much for quadric decimation is clustered first.
    solid = Solid(vertices=vertices, faces=faces)
    if len(faces) > MOST_DECIMATED:
        solid = _cluster(vertices, faces)

    # The least aggressive decimation that gives few enough faces; what it parts adds some.
    if len(solid.faces) > MOST_FACES:
        full = solid
        for aggressiveness in DECIMATION_STEPS:
            solid = reduce_and_part(full, MOST_FACES, aggressiveness)
            if 0 < len(solid.faces) <= 1.05 * MOST_FACES:
                break

    release_memory()
    deviation = _deviation(vertices, solid)
    note = (
        f"its {len(faces):,} faces were reduced to {len(solid.faces):,}, within "
        f"{deviation * 1e3:.2g} mm"
    )
    return solid.vertices, solid.faces, (note,)


def _cluster(vertices: Array, faces: Faces) -> Solid:
    """Return a surface with at most `MOST_DECIMATED` faces by merging near vertices.

    After Rossignac and Borrel 1993, "Multi-resolution 3D approximations for rendering complex
    scenes": vertices in the same cell of a grid become their mean. Only those that edges join
    within the cell do here, so that two sheets of surface that lie close to each other stay two.
    """
    low, cell = vertices.min(axis=0), FIRST_CELL * diagonal(vertices)
    while True:
        # Of a closed surface, vertices are half as many as faces.
        key = _cells(vertices - low, cell)
        if len(np.unique(key)) <= MOST_DECIMATED // 2:
            merged = weld(*_merge(vertices, faces, key))
            if len(merged[1]) <= MOST_DECIMATED:
                return Solid(vertices=merged[0], faces=merged[1])
        cell *= CELL_FACTOR


def _cells(points: Array, cell: float) -> Faces:
    """Return the number of the cell of each point (n,) in a grid of cubes with an edge `cell`."""
    x, y, z = np.floor(points / cell).astype(np.int64).T
    return np.asarray((x * (int(y.max()) + 1) + y) * (int(z.max()) + 1) + z)


def _merge(vertices: Array, faces: Faces, key: Faces) -> tuple[Array, Faces]:
    """Return a surface whose vertices that edges join within a cell are one, at their mean."""
    # The edges within cells, from each corner to the next.
    pairs = []
    for corner in range(3):
        a, b = faces[:, corner], faces[:, (corner + 1) % 3]
        within = key[a] == key[b]
        pairs.append(np.stack((a[within], b[within])).astype(np.int32))
    first, second = np.concatenate(pairs, axis=1)
    count, cluster = connect(first, second, len(vertices))

    sizes = np.bincount(cluster, minlength=count)
    means = [np.bincount(cluster, vertices[:, axis], count) / sizes for axis in range(3)]
    faces = cluster[faces].astype(np.int64)
    return np.column_stack(means), faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]


def _deviation(vertices: Array, solid: Solid) -> float:
    """Return how far some vertices of the full surface are at most from the reduced one [m]."""
    # In millimetres: trimesh (5) takes triangles with edges below a millimetre for degenerate.
    surface = trimesh.Trimesh(1e3 * solid.vertices, solid.faces, process=False)
    points = 1e3 * some_vertices(vertices)
    return float(trimesh.proximity.closest_point(surface, points)[1].max()) / 1e3
