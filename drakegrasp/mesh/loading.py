"""Mesh files: a file's bytes come in, triangles go out.

This is the one door for meshes: of objects, of the shapes of a hand, and of clouds. trimesh reads
them, and leaves out what it does not know. So the numbers of triangles and the bounds that a file
declares are compared with those that trimesh returns. A file that differs is refused, and so is one
that moves vertices or names them in a way that trimesh reads differently.
"""

from __future__ import annotations

import codecs
import io
import logging
import re
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from drakegrasp.arithmetic import norm
from drakegrasp.errors import MeshError, one_line
from drakegrasp.foreign_files import parse_json, read_content
from drakegrasp.frames import Array
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
#: Extensions of glTF that are read. Others are refused if they are required or change the shape,
#: unless a part of their names says that they change the look alone.
_READ = ("KHR_mesh_quantization", "material", "texture", "light")
_SHAPES = ("EXT_mesh_gpu_instancing",)
#: Maximum number of nodes of a scene: trimesh takes a millisecond for each.
MOST_NODES = 10_000
#: Modes of a glTF primitive: points, lines, triangles, strips and fans.
_POINTS, _LINES, _TRIANGLES, _STRIP, _FAN = 0, 1, 4, 5, 6
#: Lengths of the arrays that place a node: trimesh would make a matrix of any length it is given.
_PLACES = {"matrix": 16, "translation": 3, "rotation": 4, "scale": 3}
#: Sizes of a triangle and of the header of a binary STL file [bytes].
_RECORD, _HEADER = 50, 84


def load_surface(path: Path) -> tuple[Array, Faces]:
    """Return the triangles of a mesh file of any format, in the file's units and axes.

    Raises:
        MeshError: If the file cannot be read or contains no finite triangles.
    """
    vertices, faces = join_scene(_parse_scene(path.name, read_bytes(path)))
    validate_triangles(vertices, faces, path.name)
    return vertices, faces


def load_points(path: Path) -> Array:
    """Return the points (n, 3) of a PLY file without faces, in the file's units and axes.

    Raises:
        MeshError: If the file cannot be read or holds something else.
    """
    clouds = list(_parse_scene(path.name, read_bytes(path)).geometry.values())
    if len(clouds) != 1 or not isinstance(clouds[0], trimesh.PointCloud):
        raise MeshError(f"{path.name}: must hold points, got a mesh: sample its surface")
    return np.asarray(clouds[0].vertices, dtype=np.float64)


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
        _validate_declared(scene, declared)
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


def _validate_declared(scene: trimesh.Scene, declared: Declared) -> None:
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
    validate_triangles(vertices, faces, name)
    vertices, faces = weld(vertices, faces)
    if not len(faces):
        raise MeshError(f"{name}: must hold triangles, got only degenerate faces")
    return trimesh.Trimesh(vertices, faces, process=False)


def validate_triangles(vertices: Array, faces: Faces, name: str) -> None:
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


# What a file states of itself


@dataclass(frozen=True, kw_only=True)
class Declared:
    """What a file states of its surface.

    Attributes:
        triangles: Number of its triangles, after all polygons are cut into triangles; None if the
            file does not state it.
        polygons: Smallest number of its faces, which are polygons or triangles.
        bounds: Lowest and highest corner (2, 3) of each geometry that trimesh makes, in its own
            frame; None for a geometry whose bounds are not stated.
    """

    triangles: int | None
    polygons: int
    bounds: tuple[Array | None, ...] = ()


def declared_obj(content: bytes) -> Declared:
    """Return what a Wavefront file states.

    Raises:
        ValueError: If a line has something that trimesh skips or reads as another vertex.
    """
    text = content.replace(b"\r", b"\n")
    if found := re.search(rb"^(?:(?:[ \t]+[vf]|[vf]\t|surf|curv|call|fo)\b.*|.*\\$)", text, re.M):
        raise ValueError(f"the line {_said(found[0])}, which is no plain vertex or face")
    if found := re.search(rb"^f[^#\n]*[ \t](?:-|0+(?![0-9])).*", text, re.M):
        raise ValueError(f"the line {_said(found[0])}, whose numbers of vertices are not from 1 on")
    corners = (len(row[1].split()) for row in re.finditer(rb"^f (.*)", text, re.M))
    counts = [count for count in corners if count > 2]
    return Declared(triangles=sum(counts) - 2 * len(counts), polygons=len(counts))


def declared_stl(content: bytes) -> Declared:
    """Return what an STL file states, binary or text.

    Raises:
        ValueError: If the size of a binary file is not that of its triangles.
    """
    count = int.from_bytes(content[80:_HEADER], "little")
    size = _HEADER + _RECORD * count
    if len(content) != size:
        if b"\0" in content[:_HEADER]:
            raise ValueError(f"{len(content):,} bytes, but its {count:,} triangles take {size:,}")
        count = len(re.findall(rb"^[ \t]*facet\b", content, re.M | re.I))
    return Declared(triangles=count, polygons=count)


def declared_ply(content: bytes) -> Declared:
    """Return what a PLY file states.

    Raises:
        ValueError: If a text file has more or fewer lines than its header declares, or if the file
            has strips of triangles.
    """
    head, _, body = content.partition(b"end_header")
    elements: dict[bytes, int] = {}
    lists: dict[bytes, list[bool]] = {}
    for line in head.splitlines():
        match line.split():
            case [b"element", name, count]:
                elements[name], lists[name] = int(count), []
            case [b"property", kind, *_] if elements:
                lists[list(elements)[-1]].append(kind == b"list")
    if b"tristrips" in elements:
        raise ValueError("strips of triangles")
    faces = elements.get(b"face", 0)
    if not re.search(rb"^format[ \t]+ascii", head, re.M):
        return Declared(triangles=None, polygons=faces)

    # A text file has a line for each row. A face has its number of corners before its first list.
    rows = [line for line in body.splitlines() if line.strip()]
    if len(rows) != sum(elements.values()):
        raise ValueError(
            f"{len(rows):,} lines, but a header that declares {sum(elements.values()):,}"
        )
    if not faces:
        return Declared(triangles=0, polygons=0)
    names = list(elements)
    start = sum(elements[name] for name in names[: names.index(b"face")])
    place = lists[b"face"].index(True)
    counts = [int(row.split()[place]) for row in rows[start : start + faces]]
    return Declared(triangles=sum(counts) - 2 * faces, polygons=faces)


def declared_glb(content: bytes) -> Declared:
    """Return what a binary glTF file states of its default scene.

    Raises:
        ValueError: If its shape depends on something that trimesh does not read.
    """
    end = 20 + int.from_bytes(content[12:16], "little")
    if content[:8] != b"glTF\2\0\0\0" or content[16:20] != b"JSON" or len(content) < end:
        raise ValueError("no whole binary glTF 2.0")
    tree = parse_json(content[20:end])
    required = [name for name in tree.get("extensionsRequired", []) if not _is_read(name)]
    used = [name for name in tree.get("extensionsUsed", []) if name in _SHAPES]
    for name in required + used:
        raise ValueError(f"the extension {name}")
    if any("uri" in buffer for buffer in tree.get("buffers", [])):
        raise ValueError("a buffer that is not in the file itself")

    # Bounds of the geometries that trimesh makes of each primitive.
    accessors, shown = tree.get("accessors", []), (_POINTS, _LINES, _TRIANGLES, _STRIP)
    bounds = tuple(
        _bounds(accessors[primitive["attributes"]["POSITION"]])
        for mesh in tree.get("meshes", [])
        for primitive in mesh["primitives"]
        if primitive.get("mode", _TRIANGLES) in shown
    )
    count = sum(_triangles(mesh, accessors) for mesh in _shown_meshes(tree))
    return Declared(triangles=count, polygons=count, bounds=bounds)


def _is_read(extension: str) -> bool:
    return any(part in extension for part in _READ)


def _shown_meshes(tree: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield the mesh of each node of the default scene.

    Raises:
        ValueError: If there are too many nodes, or if a mesh is bent.
    """
    scenes, seen = tree["scenes"], 0
    if len(scenes) > 1 and "scene" not in tree:
        raise ValueError(f"{len(scenes)} scenes, none of which is the default")

    # From the roots to all children; a circle of nodes has no end.
    waiting = list(scenes[tree.get("scene", 0)].get("nodes", []))
    while waiting:
        node = tree["nodes"][waiting.pop()]
        seen += 1
        if seen > MOST_NODES:
            raise ValueError(f"more than {MOST_NODES:,} nodes")
        waiting += node.get("children", [])
        for key, length in _PLACES.items():
            if key in node and np.shape(node[key]) != (length,):
                raise ValueError(f"a node whose {key} is not {length} numbers")
        if "mesh" not in node:
            continue
        mesh = tree["meshes"][node["mesh"]]
        if "skin" in node:
            raise ValueError("a skin, whose joints may bend it")
        if any(node.get("weights", mesh.get("weights", []))):
            raise ValueError("a morph target that changes the shape")
        yield mesh


def _triangles(mesh: Mapping[str, Any], accessors: list[dict[str, Any]]) -> int:
    """Return the number of triangles of a glTF mesh."""
    total = 0
    for primitive in mesh["primitives"]:
        mode, position = primitive.get("mode", _TRIANGLES), primitive["attributes"]["POSITION"]
        corners = accessors[primitive.get("indices", position)]
        for accessor in (accessors[position], corners):
            if "bufferView" not in accessor or "sparse" in accessor:
                raise ValueError("sparse or compressed values")
        count = corners["count"]
        total += {_TRIANGLES: count // 3, _STRIP: count - 2, _FAN: count - 2}.get(mode, 0)
    return total


def _bounds(position: Mapping[str, Any]) -> Array | None:
    """Return the bounds (2, 3) that a glTF accessor states for its values."""
    if position.get("normalized"):
        raise ValueError("positions as fractions of the largest integer")
    stated = [position.get("min"), position.get("max")]
    return None if None in stated else np.array(stated, dtype=float)


def declared_dae(content: bytes) -> Declared:
    """Return what a COLLADA file states: the faces of its geometries, each of which is shown.

    Raises:
        ValueError: If a geometry is bent by a controller, or if the unit is not a number.
    """
    unit = re.search(rb"<unit\b[^>]*\bmeter=[\"']([^\"']*)", content)
    if unit and not re.fullmatch(rb"[0-9.eE+-]+", unit[1]):
        raise ValueError(f"a unit of {_said(unit[1])} metres")
    if b"<instance_controller" in content:
        raise ValueError("a controller, which may bend its mesh")
    counts = re.findall(
        rb"<(?:triangles|polylist|polygons|tristrips|trifans)\b[^>]*\bcount=[\"'](\d+)", content
    )
    return Declared(triangles=None, polygons=sum(map(int, counts)))


def _said(line: bytes) -> str:
    return repr(line.strip()[:60].decode(errors="replace"))


#: What reads the statement of a file of each kind, and how such a file is exported again.
DECLARED: dict[str, tuple[Callable[[bytes], Declared], str]] = {
    ".obj": (declared_obj, "export triangles, with vertices numbered from 1"),
    ".stl": (declared_stl, "export it as binary STL"),
    ".ply": (
        declared_ply,
        "faces must have equally many corners: export binary PLY of triangles",
    ),
    ".glb": (declared_glb, "export one GLB of plain triangles, with armatures and shapes applied"),
    ".dae": (declared_dae, "export triangles as .obj or .stl"),
}
