"""What a mesh file states of itself: its bytes come in, counts of its faces and bounds go out.

trimesh reads the files, and leaves out what it does not know. So the numbers of triangles that a
file declares are compared with those that trimesh returns, see `drakegrasp.mesh.loading`. A file is
refused here if it moves vertices or names them in a way that trimesh reads differently.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from drakegrasp.foreign_files import parse_json
from drakegrasp.frames import Array

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
