"""Mesh files: a file's bytes come in, triangles go out.

This is the one door for meshes: of objects, of the shapes of a hand, and of clouds. trimesh reads
them, and what it returns is compared with what the file declares. A file that differs is refused.
"""

from __future__ import annotations

import codecs
import io
import logging
import warnings
from pathlib import Path

import numpy as np
import trimesh

from drakegrasp.arithmetic import norm
from drakegrasp.errors import MeshError, one_line
from drakegrasp.foreign_files import read_content
from drakegrasp.frames import Array
from drakegrasp.mesh.declared import DECLARED, Declared
from drakegrasp.mesh.repair import weld
from drakegrasp.mesh.surfaces import Faces, stack, unit_normals

#: Formats of objects; other files of a directory are ignored. Shapes of a hand may also be COLLADA.
SUFFIXES = (".obj", ".stl", ".ply", ".glb")
#: Largest valid coordinate, in any unit: beyond it, squares and single precision overflow.
LARGEST = 1e9
#: Fraction of its diagonal by which a part may differ from the bounds that the file states for it.
BOUNDS = 1e-3
#: Two faces with an edge in common lie on each other if the cosine of the angle between their
#: outward normals is below this.
FOLDED = -0.9998
#: A triangle has no area if twice its area is below this fraction of its longest side squared, and
#: the largest number of such triangles that lie side by side in a polygon.
FLAT, FLAT_STEPS = 1e-6, 8
#: What NumPy says, in a warning or an error, when it stops at a word that is not a number.
_NO_NUMBER = "string or file could not be read"


def load_points(path: Path) -> Array:
    """Return the points (n, 3) of a PLY file without faces, in the file's units and axes.

    Raises:
        MeshError: If the file cannot be read or holds something else.
    """
    clouds = list(_parse_scene(path.name, read_bytes(path)).geometry.values())
    if len(clouds) != 1 or not isinstance(clouds[0], trimesh.PointCloud):
        raise MeshError(f"{path.name}: must hold points, got a mesh: sample its surface")
    return np.asarray(clouds[0].vertices, dtype=np.float64)


def load_surface(path: Path) -> tuple[Array, Faces]:
    """Return the triangles of a mesh file of any format, in the file's units and axes.

    Raises:
        MeshError: If the file cannot be read or contains no finite triangles.
    """
    vertices, faces = join_scene(_parse_scene(path.name, read_bytes(path)))
    refuse_faulty(vertices, faces, path.name)
    return vertices, faces


def read_bytes(path: Path) -> bytes:
    """Return a mesh file's content.

    Raises:
        MeshError: If the file cannot be read.
    """
    try:
        return read_content(path)
    except OSError as error:
        raise MeshError(
            f"{path.name}: must be a readable file, got: {error.strerror or error}"
        ) from error


def parse_mesh(name: str, content: bytes) -> tuple[Array, Faces]:
    """Return the vertices (n, 3) and faces (m, 3) of a mesh file, in the file's units and axes.

    All geometries of a scene are joined, with their transforms applied; materials are not read. The
    triangles are unchanged; `clean_triangles` cleans them.

    Args:
        name: Name of the file; its suffix determines the format.
        content: The file's bytes.

    Raises:
        MeshError: If the file is not a mesh file, or trimesh reads something else than it declares.
    """
    suffix = Path(name).suffix.lower()
    if suffix not in SUFFIXES:
        raise MeshError(f"{name}: must be one of {', '.join(SUFFIXES)}, got {suffix!r}")
    return join_scene(_parse_scene(name, content))


def _parse_scene(name: str, content: bytes) -> trimesh.Scene:
    """Return what trimesh reads from a mesh file, if it is what the file declares.

    Materials are not read.

    Args:
        name: Name of the file; its suffix determines the format.
        content: The file's bytes.

    Raises:
        MeshError: As `parse_mesh`.
    """
    suffix = Path(name).suffix.lower()
    if suffix not in DECLARED:
        raise MeshError(f"{name}: must be one of {', '.join(DECLARED)}, got {suffix!r}")
    if not content:
        raise MeshError(f"{name}: must hold a mesh, got an empty file")

    # Parsers raise all kinds of exceptions for files of other formats.
    declare, remedy = DECLARED[suffix]
    content = content.removeprefix(codecs.BOM_UTF8)
    try:
        declared = declare(content)
        scene = _read_by_trimesh(suffix[1:], content)
        _refuse_difference(scene, declared)
    except ImportError as error:
        missing = "pycollada" if suffix == ".dae" else one_line(error)
        raise MeshError(f"{name}: needs `pip install {missing}`, or another format") from None
    except Exception as error:
        got = one_line(error)
        got = "text in place of a number" if _NO_NUMBER in got else got
        raise MeshError(f"{name}: must be a valid {suffix} mesh, got: {got}; {remedy}") from error
    return scene


def _read_by_trimesh(kind: str, content: bytes) -> trimesh.Scene:
    logging.getLogger("trimesh").setLevel(logging.CRITICAL)
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.filterwarnings("error", message=_NO_NUMBER)
        return trimesh.load_scene(
            io.BytesIO(content), file_type=kind, process=False, skip_materials=True
        )


def _refuse_difference(scene: trimesh.Scene, declared: Declared) -> None:
    """Reject a file that declares another surface than trimesh returned.

    Raises:
        ValueError: If numbers of faces or bounds differ, or if a polygon is concave.
    """
    # Bounds of the geometries, in the order in which trimesh makes them.
    if declared.bounds:
        for part, stated in zip(scene.geometry.values(), declared.bounds, strict=True):
            if stated is not None and isinstance(part, trimesh.Trimesh) and len(part.vertices):
                found = np.stack((part.vertices.min(axis=0), part.vertices.max(axis=0)))
                if np.abs(found - stated).max() > BOUNDS * np.linalg.norm(found[1] - found[0]):
                    raise ValueError(
                        f"positions in {found.round(4).tolist()}, but it states bounds of "
                        f"{stated.round(4).tolist()}"
                    )

    # Numbers of triangles.
    shown = (scene.geometry[scene.graph[node][1]] for node in scene.graph.nodes_geometry)
    read = sum(len(part.faces) for part in shown if isinstance(part, trimesh.Trimesh))
    due = declared.triangles
    if read < declared.polygons or due not in (None, read):
        raise ValueError(
            f"{due or declared.polygons:,} faces declared, but {read:,} that can be read"
        )
    if read > declared.polygons and _is_folded(*join_scene(scene)):
        raise ValueError("polygons that are concave or fold back, which have several readings")


def _is_folded(vertices: Array, faces: Faces) -> bool:
    """Return whether two faces with an edge in common lie on each other.

    The triangles of a concave polygon do, if all of them begin at one of its corners.
    """
    # Equal vertices have one number; a triangle that has one twice is none.
    points, index = np.unique(vertices, axis=0, return_inverse=True)
    faces = index.reshape(-1)[faces]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    sides = points[np.roll(faces, -1, axis=1)] - points[faces]
    normals = unit_normals(points[faces])
    area = norm(np.cross(sides[:, 0], sides[:, 1]))
    normals[area <= FLAT * (sides**2).sum(axis=2).max(axis=1)] = 0.0

    # Neighbours run along their edge in opposite directions.
    start, end = faces.T.reshape(-1), np.roll(faces, -1, axis=1).T.reshape(-1)
    there, back = start * len(points) + end, end * len(points) + start
    _, *pair = np.intersect1d(there, back, return_indices=True)
    one, other = (side % len(faces) for side in pair)

    # A triangle without area is like one of its neighbours.
    for _ in range(FLAT_STEPS):
        flat = ~normals[one].any(axis=1)
        normals[one[flat]] = normals[other[flat]]
    return bool(((normals[one] * normals[other]).sum(axis=1) < FOLDED).any())


def join_scene(scene: trimesh.Scene) -> tuple[Array, Faces]:
    """Return all meshes of a scene as one: vertices (n, 3) and faces (m, 3).

    Lengths are in metres if the file states its unit, as COLLADA does.
    """
    parts: list[tuple[Array, Faces]] = [(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))]
    for node in scene.graph.nodes_geometry:
        X_SN, key = scene.graph[node]
        part = scene.geometry[key]
        if isinstance(part, trimesh.Trimesh) and len(part.faces):
            # trimesh keeps the unit of COLLADA as text: "meters", or "0.001 * meters".
            unit, times, _ = part.metadata.get("units", "").partition(" * ")
            if not np.array_equal(X_SN, np.eye(4)):
                part = trimesh.Trimesh(part.vertices, part.faces, process=False)
                part.apply_transform(X_SN)
            vertices = part.vertices.view(np.ndarray)
            vertices = float(unit) * vertices if times else vertices
            parts.append((vertices, part.faces.view(np.ndarray)))
    if len(parts) == 2:
        vertices, faces = parts[1]
    else:
        surface = stack(parts)
        vertices, faces = surface.vertices, surface.faces
    return vertices.astype(np.float64, copy=False), faces.astype(np.int64, copy=False)


def clean_triangles(vertices: Array, faces: Faces, name: str) -> trimesh.Trimesh:
    """Return triangles with equal vertices merged and degenerate faces dropped.

    Args:
        vertices: (n, 3).
        faces: (m, 3).
        name: Name of the mesh, for errors.

    Raises:
        MeshError: If there are no triangles, or if vertices are missing or not finite.
    """
    refuse_faulty(vertices, faces, name)
    vertices, faces = weld(vertices, faces)
    if not len(faces):
        raise MeshError(f"{name}: must hold triangles, got only degenerate faces")
    return trimesh.Trimesh(vertices, faces, process=False)


def refuse_faulty(vertices: Array, faces: Faces, name: str) -> None:
    """Reject arrays that are not a mesh, see `clean_triangles`.

    Raises:
        MeshError: If there are no triangles, or if vertices are missing or not finite.
    """
    if not len(faces):
        raise MeshError(f"{name}: must hold triangles, got no faces")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise MeshError(
            f"{name}: faces must use vertices 0..{len(vertices) - 1}, "
            f"got {faces.min()}..{faces.max()}"
        )
    infinite = np.asarray(~(np.abs(vertices) <= LARGEST).all(axis=1))
    if infinite.any() and infinite[faces].any():
        bad = int(infinite[faces].sum())
        raise MeshError(
            f"{name}: vertices must be finite, got NaN, inf or more than {LARGEST:g} at {bad} "
            "corners"
        )
