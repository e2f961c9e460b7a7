"""Mesh files: a file's bytes come in, triangles go out."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import trimesh

from drakegrasp.errors import MeshError, one_line
from drakegrasp.foreign_files import read_content
from drakegrasp.frames import Array
from drakegrasp.mesh.declared import Declared, declared_stl
from drakegrasp.mesh.glb import declared_glb
from drakegrasp.mesh.ply import declared_ply
from drakegrasp.mesh.repair import weld
from drakegrasp.mesh.surfaces import Faces, compact, stack
from drakegrasp.mesh.wavefront import declared_obj

#: Reader of each kind of mesh file that can be read; other files are ignored.
_DECLARED = {".obj": declared_obj, ".stl": declared_stl, ".ply": declared_ply, ".glb": declared_glb}
SUFFIXES = tuple(_DECLARED)
#: Fraction of the largest coordinate by which transforms of the same vertex may differ.
SAME = 1e-6
#: Largest valid coordinate, in any unit: beyond it, squares and single precision overflow.
LARGEST = 1e9
#: Number of faces from which on the memory of reading a file is freed at once: a scene of trimesh
#: refers to itself, so it would wait for Python's garbage collector.
MANY_FACES = 100_000


def load_mesh(path: str | Path) -> trimesh.Trimesh:
    """Return the triangles of a mesh file, in the file's units and axes.

    Raises:
        MeshError: If the file cannot be read or contains no finite triangles.
    """
    path = Path(path)
    vertices, faces = parse_mesh(path.name, read_bytes(path))
    return clean_triangles(vertices, faces, path.name)


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
    result is the surface that the file declares, see `drakegrasp.mesh.declared`. The triangles are
    unchanged; `clean_triangles` cleans them.

    Args:
        name: Name of the file; its suffix determines the format.
        content: The file's bytes.

    Raises:
        MeshError: If the file is not a mesh file.
    """
    suffix = Path(name).suffix.lower()
    if suffix not in SUFFIXES:
        raise MeshError(f"{name}: must be one of {', '.join(SUFFIXES)}, got {suffix!r}")
    if not content:
        raise MeshError(f"{name}: must hold a mesh, got an empty file")

    # Parsers raise all kinds of exceptions for files of other formats.
    try:
        with np.errstate(all="ignore"):
            declared = _DECLARED[suffix](content)
    except Exception as error:
        raise MeshError(f"{name}: must be a valid {suffix} mesh, got: {one_line(error)}") from error
    if suffix == ".stl":
        return declared.vertices, declared.faces

    # Existing datasets have the order of vertices and faces that trimesh returns. If trimesh leaves
    # something out, the file's own order is used.
    try:
        vertices, faces = _read_by_trimesh(suffix[1:], content)
        if _are_same(vertices, faces, declared):
            return vertices, faces
    except Exception:
        pass  # the file was read without trimesh
    return compact(declared.vertices, declared.faces)


def _read_by_trimesh(kind: str, content: bytes) -> tuple[Array, Faces]:
    """Return the vertices and faces that trimesh finds; `IndexError` if it finds none."""
    with np.errstate(all="ignore"):
        scene = trimesh.load_scene(
            io.BytesIO(content), file_type=kind, process=False, skip_materials=True
        )
    parts = []
    for node in scene.graph.nodes_geometry:
        X_SN, key = scene.graph[node]
        part = scene.geometry[key]
        if isinstance(part, trimesh.Trimesh) and len(part.faces):
            part = trimesh.Trimesh(part.vertices, part.faces, process=False)
            part.apply_transform(X_SN)
            parts.append((part.vertices.view(np.ndarray), part.faces.view(np.ndarray)))
    surface = stack(parts) if len(parts) > 1 else None
    vertices, faces = (surface.vertices, surface.faces) if surface else parts[0]
    return vertices.astype(np.float64, copy=False), faces.astype(np.int64, copy=False)


def _are_same(vertices: Array, faces: Faces, declared: Declared) -> bool:
    """Return whether a surface has the triangles that a file declares, in any order."""
    if len(faces) != len(declared.faces) or not declared.fans:
        return False
    if len(faces) and (faces.min() < 0 or faces.max() >= len(vertices)):
        return False
    if np.array_equal(faces, declared.faces) and np.array_equal(vertices, declared.vertices):
        return True
    used = np.abs(declared.vertices[declared.faces])
    size = used.max(initial=0.0, where=np.isfinite(used))
    for axis in range(3):
        ours = np.sort(declared.vertices[:, axis][declared.faces.reshape(-1)])
        theirs = np.sort(vertices[:, axis][faces.reshape(-1)])
        if not np.allclose(ours, theirs, rtol=0.0, atol=SAME * size, equal_nan=True):
            return False
    return True


def clean_triangles(vertices: Array, faces: Faces, name: str) -> trimesh.Trimesh:
    """Return triangles with equal vertices merged and degenerate faces dropped.

    Args:
        vertices: (n, 3).
        faces: (m, 3).
        name: Name of the mesh, for errors.

    Raises:
        MeshError: If there are no triangles, or if vertices are missing or not finite.
    """
    # Check that the arrays are a mesh.
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

    # Merge equal vertices.
    vertices, faces = weld(vertices, faces)
    if not len(faces):
        raise MeshError(f"{name}: must hold triangles, got only degenerate faces")
    return trimesh.Trimesh(vertices, faces, process=False)
