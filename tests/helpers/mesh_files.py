"""Mesh files of a unit cube in many forms, some of which trimesh reads as something else."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from drakegrasp.mesh.loading import clean_triangles, load_surface

#: Corners of the unit cube, those of another, and the faces of each, from 1.
CUBE = np.array([(x, y, z) for z in (0, 1) for y in (0, 1) for x in (0, 1)], dtype=np.float64)
ASIDE = CUBE + np.array((3, 0, 0))
QUADS = ((1, 3, 4, 2), (5, 6, 8, 7), (1, 2, 6, 5), (2, 4, 8, 6), (4, 3, 7, 8), (3, 1, 5, 7))
TRIANGLES = np.array([(a, b, c) for q in QUADS for a, b, c in (q[:3], (q[2], q[3], q[0]))]) - 1
#: Outlines that no fan from all of their corners fills.
OUTLINES = {
    "u": [(0, 0), (9, 0), (9, 8), (7, 8), (7, 2), (2, 2), (2, 8), (0, 8)],
    "arrow": [(0, 0), (2, -1), (0, 3), (-2, -1)],
    "doubled": [(0, 0), (9, 0), (9, 8), (7, 8), (7, 8), (7, 2), (2, 2), (2, 8), (0, 8)],
}
Polygons = Sequence[Sequence[int]]


def load_mesh(path: Path) -> trimesh.Trimesh:
    """Return the triangles of a mesh file, as of an object's."""
    return clean_triangles(*load_surface(path), path.name)


def prism(outline: list[tuple[int, int]], start: int) -> tuple[np.ndarray, Polygons]:
    """Return a prism of height 1 in a slanted plane, whose lids begin at a corner."""
    n = len(outline)
    flat = np.hstack((np.vstack((outline, outline)), np.repeat((0.0, 1.0), n)[:, None]))
    turn = trimesh.transformations.euler_matrix(0.4, 0.7, 1.1)[:3, :3]
    ring = [(start + k) % n for k in range(n)]
    sides = [(k + 1, (k + 1) % n + 1, (k + 1) % n + n + 1, k + n + 1) for k in range(n)]
    return flat @ turn.T, [[k + 1 for k in ring[::-1]], [k + n + 1 for k in ring], *sides]


def obj(vertices: np.ndarray = CUBE, faces: Polygons = QUADS, blank: str = " ") -> str:
    rows = [["v", *map(repr, row)] for row in vertices.tolist()]
    return "".join(blank.join(map(str, row)) + "\n" for row in [*rows, *(["f", *f] for f in faces)])


def ply(vertices: np.ndarray, faces: Polygons, order: str) -> bytes:
    kind = {"<": "binary_little_endian", ">": "binary_big_endian", "": "ascii"}[order]
    head = f"ply\nformat {kind} 1.0\nelement vertex {len(vertices)}\n"
    head += "".join(f"property double {axis}\n" for axis in "xyz")
    head += f"element face {len(faces)}\nproperty list uchar int vertex_index\nend_header\n"
    if not order:
        rows = [*vertices.tolist(), *((len(f), *(k - 1 for k in f)) for f in faces)]
        return (head + "".join(" ".join(map(str, row)) + "\n" for row in rows)).encode()
    data = head.encode() + vertices.astype(f"{order}f8").tobytes()
    for f in faces:
        data += struct.pack(f"{order}B{len(f)}i", len(f), *(k - 1 for k in f))
    return data


def stl(vertices: np.ndarray = CUBE) -> str:
    return str(trimesh.Trimesh(vertices, TRIANGLES, process=False).export(file_type="stl_ascii"))


def binary_stl(said: int = 12) -> bytes:
    content = trimesh.Trimesh(CUBE, TRIANGLES, process=False).export(file_type="stl")
    return bytes(content[:80] + struct.pack("<I", said) + content[84:])


#: Of the cube's positions in a GLB file that trimesh writes.
POSITIONS = 1
Tree = dict[str, Any]


def glb(edit: Callable[[Tree], object] = lambda _: None, positions: str = "<f4") -> bytes:
    """Return a GLB file of the cube, with positions of a type, after its JSON was edited."""
    content = trimesh.Trimesh(CUBE, TRIANGLES, process=False).export(file_type="glb")
    end = 20 + struct.unpack("<I", content[12:16])[0]
    tree = json.loads(content[20:end])
    tree["scenes"], tree["nodes"] = [{"nodes": [0]}], [{"mesh": 0}]
    del tree["scene"]
    edit(tree)
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    data = CUBE.astype(positions) if positions == "<f4" else (4096 * CUBE).astype(positions)
    place = len(content) - CUBE.size * 4
    tail = (content[:place] + data.tobytes()).ljust(len(content), b"\0")[end:]
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + tail
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def nodes_glb(*nodes: Tree, **more: Any) -> bytes:
    """Return a GLB file with these nodes, all of which are shown unless `scenes` says otherwise."""
    every = {"nodes": list(nodes), "scenes": [{"nodes": list(range(len(nodes)))}]}
    return glb(lambda tree: tree.update(every | more))


def using(*names: str, key: str = "extensionsRequired") -> bytes:
    """Return a GLB file that names extensions."""
    return glb(lambda tree: tree.update({key: names}))


def accessor_glb(**changes: Any) -> bytes:
    """Return a GLB file whose accessor of positions has other keys."""
    return glb(lambda tree: tree["accessors"][POSITIONS].update(changes))


def scaled_glb() -> bytes:
    """Positions are integers that the node scales, as packers of GLB write them."""

    def edit(tree: Tree) -> None:
        integers = {"componentType": 5122, "min": [0, 0, 0], "max": [4096, 4096, 4096]}
        tree["accessors"][POSITIONS].update(integers)
        tree["bufferViews"][POSITIONS]["byteLength"] = CUBE.size * 2
        tree.update(extensionsRequired=["KHR_mesh_quantization"])
        tree["nodes"] = [{"mesh": 0, "scale": [1 / 4096] * 3}]

    return glb(edit, "<i2")


def fans_glb() -> bytes:
    """Beside the triangles is a fan, which trimesh does not read."""

    def edit(tree: Tree) -> None:
        (first,) = tree["meshes"][0]["primitives"]
        tree["meshes"][0]["primitives"].append({**first, "mode": 6})

    return glb(edit)


def draco_glb() -> bytes:
    def edit(tree: Tree) -> None:
        tree.update(extensionsUsed=["KHR_draco_mesh_compression"])
        del tree["accessors"][POSITIONS]["bufferView"]

    return glb(edit)


#: Two nodes with the mesh, one of them moved.
_MOVED = ({"mesh": 0}, {"mesh": 0, "translation": [3, 0, 0]})
_CAMERA = {"type": "perspective", "perspective": {"yfov": 1.0, "znear": 0.1, "aspectRatio": 1.0}}


def dae(unit: str = '<unit meter="1"/>', vertices: np.ndarray = CUBE, count: int = 12) -> str:
    """COLLADA, whose geometry states a number of triangles."""
    numbers = " ".join(map(str, vertices.ravel().tolist()))
    corners = " ".join(map(str, TRIANGLES.ravel().tolist()))
    axes = "".join(f'<param name="{axis}" type="float"/>' for axis in "XYZ")
    return (
        '<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1"><asset>'
        f"<created>2020-01-01T00:00:00</created><modified>2020-01-01T00:00:00</modified>{unit}"
        '</asset><library_geometries><geometry id="g"><mesh><source id="p"><float_array id="a" '
        f'count="24">{numbers}</float_array><technique_common><accessor source="#a" count="8" '
        f'stride="3">{axes}</accessor></technique_common></source><vertices id="v"><input '
        f'semantic="POSITION" source="#p"/></vertices><triangles count="{count}"><input '
        f'semantic="VERTEX" source="#v" offset="0"/><p>{corners}</p></triangles></mesh></geometry>'
        '</library_geometries><library_visual_scenes><visual_scene id="s"><node id="n">'
        '<instance_geometry url="#g"/></node></visual_scene></library_visual_scenes><scene>'
        '<instance_visual_scene url="#s"/></scene></COLLADA>'
    )


#: Two blocks of a Wavefront file whose faces count back from the vertices before them.
_BEHIND = [[k - 9 for k in q] for q in QUADS]
RELATIVE = obj(faces=_BEHIND) + "g b\nusemtl b\n" + obj(ASIDE, _BEHIND)
_STRIP = "4 0 5 1 7 3 6 2 4 0 -1 0 2 1 3 -1 4 5 6 7"
_STRIPS = ply(CUBE, [], "").decode().split("element face")[0] + (
    "element tristrips 1\nproperty list int int vertex_indices\nend_header\n"
    + "".join(" ".join(map(str, p)) + "\n" for p in CUBE.tolist())
    + f"{len(_STRIP.split())} {_STRIP}\n"
)
_FACES = [tuple(k + 1 for k in face) for face in TRIANGLES.tolist()]
#: A cube of four triangles and four quadrilaterals.
_MIXED = [*_FACES[:4], *QUADS[2:]]
_FAR = [[k + 8 for k in q] for q in QUADS]
_TWO_TEXTS = stl() + "\n" + stl(ASIDE)
_HEXAGON = [(2, 0), (1, 2), (-1, 2), (-2, 0), (-1, -2), (1, -2)]
_ONE, _TWO = (1.0, 6.0), (2.0, 12.0)

#: Files that trimesh reads right: name, content, volume and area.
READ: dict[str, tuple[str, str | bytes, tuple[float, float]]] = {
    "obj": ("a.obj", obj(), _ONE),
    "obj, mixed": ("a.obj", obj(faces=_MIXED), _ONE),
    "obj, convex polygons": ("a.obj", obj(*prism(_HEXAGON, 1)), (12.0, 24.0 + 4.0 + 4.0 * 5**0.5)),
    "obj, equal polygons": ("a.obj", obj(faces=[(*q, q[0]) for q in QUADS]), _ONE),
    "obj, two materials": ("a.obj", f"usemtl a\n{obj()}usemtl b\n{obj(ASIDE, _FAR)}", _TWO),
    "obj, colours of vertices": ("a.obj", obj(np.hstack((CUBE, CUBE))), _ONE),
    "obj, byte-order mark": ("a.obj", "\ufeff" + obj(), _ONE),
    "ply": ("a.ply", ply(CUBE, QUADS, "<"), _ONE),
    "ply, big end first": ("a.ply", ply(CUBE, _FACES, ">"), _ONE),
    "ply, text": ("a.ply", ply(CUBE, QUADS, ""), _ONE),
    "ply, mixed text": ("a.ply", ply(CUBE, _MIXED, ""), _ONE),
    "stl": ("a.stl", binary_stl(), _ONE),
    "stl, two solids": ("a.stl", _TWO_TEXTS, _TWO),
    "glb, looks": ("a.glb", using("KHR_materials_unlit"), _ONE),
    "glb, scaled integers": ("a.glb", scaled_glb(), _ONE),
    "glb, two nodes": ("a.glb", nodes_glb(*_MOVED), _TWO),
    "glb, mirrored": ("a.glb", nodes_glb({"mesh": 0, "scale": [-1, 1, 1]}), _ONE),
}  # fmt: skip
#: Files that are refused: name, content, and what is said of it.
REFUSED: dict[str, tuple[str, str | bytes, str]] = {
    "obj, relative": ("a.obj", RELATIVE, "line 'f -8 -6 -5 -7', whose numbers .* not from 1 on"),
    "obj, number 0": ("a.obj", obj(faces=[(0, 1, 2)]), "line 'f 0 1 2'"),
    "obj, tabs": ("a.obj", obj(blank="\t"), r"line 'v\\t0.0.*no plain vertex or face"),
    "obj, blanks before": ("a.obj", obj().replace("v 1", "  v 1"), "line 'v 1.*no plain vertex"),
    "obj, continued lines": ("a.obj", obj().replace("f 1 3 ", "f 1 3\\\n"), "no plain vertex"),
    "obj, remarks": ("a.obj", obj().replace("\n", " # said\n"), "text in place of a number"),
    "obj, free form": ("a.obj", obj() + "surf 0 1 0 1 1 2 3\n", "'surf 0 .* no plain vertex"),
    "ply, mixed": ("a.ply", ply(CUBE, _MIXED, "<"), "faces must have equally many corners: expo"),
    "ply, concave": ("a.ply", ply(*prism(OUTLINES["arrow"], 1), ""), "concave or fold back"),
    "ply, line end behind": ("a.ply", ply(CUBE, QUADS, "<") + b"\n", "unexpected length"),
    "ply, strips": ("a.ply", _STRIPS, "strips of triangles"),
    "ply, more than declared": ("a.ply", ply(CUBE, QUADS, "") + b"3 0 1 2\n", "15 lines, but a h"),
    "ply, a line cut": ("a.ply", ply(CUBE, QUADS, "")[:-3], "12 faces declared, but 11 that can"),
    "stl, more than declared": ("a.stl", binary_stl(10), "684 bytes, but its 10 triangles take 5"),
    "stl, cut off": ("a.stl", stl()[:900], "9 faces declared, but 0 that can be read"),
    "stl, end solid": ("a.stl", stl().replace("endsolid", "end solid"), "12 faces declared, but 0"),
    "stl, old line ends": ("a.stl", stl().replace("\n", "\r"), "text in place of a number"),
    "glb, cut off": ("a.glb", glb()[:300], "no whole binary glTF"),
    "glb, sparse": ("a.glb", accessor_glb(sparse={"count": 4}), "sparse or compressed values"),
    "glb, weights of the mesh": (
        "a.glb", glb(lambda t: t["meshes"][0].update(weights=[1.0])), "a morph target that changes",
    ),
    "glb, weights of the node": ("a.glb", nodes_glb({"mesh": 0, "weights": [1.0]}), "a morph targ"),
    "glb, skin": ("a.glb", nodes_glb({"mesh": 0, "skin": 0}), "a skin, whose joints may bend it"),
    "glb, fans": ("a.glb", fans_glb(), "46 faces declared, but 12 that can be read"),
    "glb, fractions": ("a.glb", accessor_glb(normalized=True), "positions as fractions of"),
    "glb, camera on a mesh": (
        "a.glb", nodes_glb({**_MOVED[0], "camera": 0}, _MOVED[1], cameras=[_CAMERA]),
        "24 faces declared, but 12 that can be read",
    ),
    "glb, bounds": (
        "a.glb", accessor_glb(max=[1, 1, 2]),
        r"positions in .*1\.0\]\], but it states bounds of .*2\.0\]\]",
    ),
    "glb, draco": ("a.glb", draco_glb(), "sparse or compressed values"),
    "glb, unknown": ("a.glb", using("EXT_my_shape"), "extension EXT_my_shape"),
    "glb, instances": (
        "a.glb", using("EXT_mesh_gpu_instancing", key="extensionsUsed"), "extension EXT_mesh_gpu",
    ),
    "glb, crowded": ("a.glb", nodes_glb({"children": [0]}), "more than 10,000 nodes"),
    "glb, long place": (
        "a.glb", nodes_glb({"mesh": 0, "translation": [0.0] * 100_000}),
        "a node whose translation is not 3 numbers",
    ),
    "glb, other file": (
        "a.glb", glb(lambda t: t["buffers"][0].update(uri="x.bin")),
        "a buffer that is not in the file itself",
    ),
    "glb, no default scene": (
        "a.glb", nodes_glb(*_MOVED, scenes=[{"nodes": [0]}, {"nodes": [0, 1]}]),
        "2 scenes, none of which is the default",
    ),
}  # fmt: skip


def write_file(folder: Path, name: str, content: str | bytes) -> Path:
    """Write a file, and return its path."""
    (folder / name).write_bytes(content.encode() if isinstance(content, str) else content)
    return folder / name
