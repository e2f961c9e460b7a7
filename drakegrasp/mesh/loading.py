"""Mesh files: a file's bytes come in, triangles go out."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import trimesh

from drakegrasp.errors import MeshError, one_line
from drakegrasp.foreign_files import read_content
from drakegrasp.frames import Array
from drakegrasp.mesh.repair import weld
from drakegrasp.mesh.surfaces import Faces, stack
from drakegrasp.runtime.json_text import parse_json

#: Mesh files that can be read; other files are ignored.
SUFFIXES = (".obj", ".stl", ".ply", ".glb")
#: Faces from which what reading a file leaves behind is worth freeing at once: a scene of trimesh
#: refers to itself, so it would wait for Python's collector.
MANY_FACES = 100_000


def load_mesh(path: str | Path) -> trimesh.Trimesh:
    """Return the triangles of a mesh file, in the file's units and axes.

    Raises:
        MeshError: If the file cannot be read or holds no finite triangles.
    """
    path = Path(path)
    vertices, faces = parse_mesh(path.name, read_bytes(path))
    return clean_triangles(vertices, faces, path.name)


#: Parts of the names of extensions that change how a mesh looks, not its shape.
_LOOKS = ("material", "texture", "light")
#: Numbers of what places a node: trimesh makes a matrix of as many rows, however many there are.
_PLACES = {"matrix": 16, "translation": 3, "rotation": 4, "scale": 3}
#: Most nodes of a scene: trimesh takes a millisecond for each.
MOST_NODES = 10_000


def read_bytes(path: Path) -> bytes:
    """Return a mesh file's content.

    Raises:
        MeshError: If it cannot be read.
    """
    try:
        return read_content(path)
    except OSError as error:
        raise MeshError(
            f"{path.name}: must be a readable file, got: {error.strerror or error}"
        ) from error


def parse_mesh(name: str, content: bytes) -> tuple[Array, Faces]:
    """Return the vertices (n, 3) and faces (m, 3) of a mesh file, in the file's units and axes.

    All geometries of a scene are joined, with their transforms applied; materials are not read.
    The triangles are as they stand in the file: see `clean_triangles`.

    Args:
        name: Name of the file; its suffix gives the format.
        content: The file's bytes.

    Raises:
        MeshError: If it is no mesh file.
    """
    suffix = Path(name).suffix.lower()
    if suffix not in SUFFIXES:
        raise MeshError(f"{name}: must be one of {', '.join(SUFFIXES)}, got {suffix!r}")
    if not content:
        raise MeshError(f"{name}: must hold a mesh, got an empty file")

    # Parsers raise all kinds of exceptions on foreign bytes.
    try:
        if suffix == ".glb":
            _refuse_description(content)
        with np.errstate(all="ignore"):
            scene = trimesh.load_scene(
                io.BytesIO(content), file_type=suffix[1:], process=False, skip_materials=True
            )
            parts = []
            for node in scene.graph.nodes_geometry:
                X_SN, key = scene.graph[node]
                part = scene.geometry[key]
                if isinstance(part, trimesh.Trimesh) and len(part.faces):
                    part = trimesh.Trimesh(part.vertices, part.faces, process=False)
                    parts.append(part.apply_transform(X_SN))
            return _concatenate(parts)
    except Exception as error:
        # trimesh wants another package to guess the encoding of bytes that are no UTF-8.
        got = "text that is not UTF-8" if isinstance(error, ImportError) else one_line(error)
        raise MeshError(f"{name}: must be a valid {suffix} mesh, got: {got}") from error


def _refuse_description(content: bytes) -> None:
    """Refuse a GLB that trimesh would read without what it needs, or would not end to read.

    Raises:
        ValueError: If its shape needs an extension, it has too many nodes, or one has no place.
    """
    if content[:4] != b"glTF":
        return
    tree = parse_json(content[20 : 20 + int.from_bytes(content[12:16], "little")])
    needed = tree.get("extensionsRequired", []) if isinstance(tree, dict) else []
    shapes = [name for name in needed if not any(word in name for word in _LOOKS)]
    if shapes:
        raise ValueError(f"the extension {shapes[0]}, which is not read; export without it")
    nodes = tree.get("nodes", []) if isinstance(tree, dict) else []
    if len(nodes) > MOST_NODES:
        raise ValueError(f"{len(nodes):,} nodes, more than {MOST_NODES:,}")
    for node in nodes:
        for key, count in _PLACES.items():
            numbers = node.get(key, [0] * count)
            if not isinstance(numbers, list) or len(numbers) != count:
                raise ValueError(f"a node whose {key} is not {count} numbers")


def clean_triangles(vertices: Array, faces: Faces, name: str) -> trimesh.Trimesh:
    """Return triangles with equal vertices merged and degenerate faces dropped.

    Args:
        vertices: (n, 3).
        faces: (m, 3).
        name: What to call the mesh in an error.

    Raises:
        MeshError: If there are no triangles, or vertices that are missing or not finite.
    """
    # Refuse what is no mesh.
    if not len(faces):
        raise MeshError(f"{name}: must hold triangles, got no faces")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise MeshError(
            f"{name}: faces must use vertices 0..{len(vertices) - 1}, "
            f"got {faces.min()}..{faces.max()}"
        )
    infinite = np.asarray(~np.isfinite(vertices).all(axis=1))
    if infinite.any() and infinite[faces].any():
        bad = int(infinite[faces].sum())
        raise MeshError(f"{name}: vertices must be finite, got NaN or inf at {bad} corners")

    # Merge equal vertices.
    vertices, faces = weld(vertices, faces)
    if not len(faces):
        raise MeshError(f"{name}: must hold triangles, got only degenerate faces")
    return trimesh.Trimesh(vertices, faces, process=False)


def _concatenate(parts: list[trimesh.Trimesh]) -> tuple[Array, Faces]:
    """Return the vertices and faces of several meshes as one; of none, empty arrays."""
    if not parts:
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)
    arrays = [(part.vertices.view(np.ndarray), part.faces.view(np.ndarray)) for part in parts]
    if len(arrays) > 1:
        solid = stack(arrays)
        arrays = [(solid.vertices, solid.faces)]
    ((vertices, faces),) = arrays  # no copies of one that may be large
    return vertices.astype(np.float64, copy=False), faces.astype(np.int64, copy=False)
