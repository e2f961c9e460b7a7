"""Mesh files of a unit cube in many forms, some of which trimesh reads as something else."""

from __future__ import annotations

import json
import re
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


def ply(vertices: np.ndarray, faces: Polygons, order: str, extra: bool = False) -> bytes:
    kind = {"<": "binary_little_endian", ">": "binary_big_endian", "": "ascii"}[order]
    head = f"ply\nformat {kind} 1.0\nelement vertex {len(vertices)}\n"
    head += "".join(f"property double {axis}\n" for axis in "xyz")
    head += "property list uchar short tags\n" * extra
    head += f"element face {len(faces)}\nproperty list uchar int vertex_index\nend_header\n"
    tags = [(k % 3, *range(k % 3)) if extra else () for k in range(len(vertices))]
    if not order:
        rows = [(*p, *t) for p, t in zip(vertices.tolist(), tags, strict=True)]
        rows += [(len(f), *(k - 1 for k in f)) for f in faces]
        return (head + "".join(" ".join(map(str, row)) + "\n" for row in rows)).encode()
    data = head.encode()
    for p, t in zip(vertices.tolist(), tags, strict=True):
        data += struct.pack(f"{order}3d", *p)
        data += struct.pack(f"{order}B{len(t) - 1}h", *t) if extra else b""
    for f in faces:
        data += struct.pack(f"{order}B{len(f)}i", len(f), *(k - 1 for k in f))
    return data


def stl(vertices: np.ndarray = CUBE) -> str:
    return str(trimesh.Trimesh(vertices, TRIANGLES, process=False).export(file_type="stl_ascii"))


def binary_stl(said: int = 12, behind: bytes = b"") -> bytes:
    content = trimesh.Trimesh(CUBE, TRIANGLES, process=False).export(file_type="stl")
    return bytes(content[:80] + struct.pack("<I", said) + content[84:] + behind)


class Glb:
    """A GLB file of the cube, made of accessors."""

    def __init__(self) -> None:
        self.data = b""
        self.accessors: list[dict[str, Any]] = []
        self.views: list[dict[str, Any]] = []
        self.extra: dict[str, Any] = {}

    def view(self, values: np.ndarray) -> int:
        self.data += bytes(-len(self.data) % 4)
        self.views.append({"buffer": 0, "byteOffset": len(self.data), "byteLength": values.nbytes})
        self.data += values.tobytes()
        return len(self.views) - 1

    def accessor(self, values: np.ndarray, **more: Any) -> int:
        kinds = {"u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
        width = 1 if values.ndim == 1 else values.shape[1]
        self.accessors.append({
            "bufferView": self.view(values), "count": len(values),
            "componentType": kinds[values.dtype.str[1:]],
            "type": {1: "SCALAR", 3: "VEC3", 16: "MAT4"}[width], **more,
        })  # fmt: skip
        return len(self.accessors) - 1

    def sparse(self, values: np.ndarray, where: np.ndarray) -> dict[str, Any]:
        kind = {"u1": 5121, "u2": 5123, "u4": 5125}[where.dtype.str[1:]]
        indices = {"bufferView": self.view(where), "componentType": kind}
        return {
            "count": len(where),
            "indices": indices,
            "values": {"bufferView": self.view(values)},
        }

    def primitive(self, positions: int | None = None, **more: Any) -> dict[str, Any]:
        if positions is None:
            positions = self.accessor(CUBE.astype("<f4"))
        indices = self.accessor(TRIANGLES.astype("<u2").ravel())
        return {"attributes": {"POSITION": positions}, "indices": indices, **more}

    def pack(self, meshes: list[dict[str, Any]], nodes: list[dict[str, Any]]) -> bytes:
        tree = {
            "asset": {"version": "2.0"}, "accessors": self.accessors, "bufferViews": self.views,
            "buffers": [{"byteLength": len(self.data)}], "meshes": meshes, "nodes": nodes,
            "scenes": [{"nodes": list(range(len(nodes)))}],
        } | self.extra  # fmt: skip
        text = json.dumps(tree).encode()
        text += b" " * (-len(text) % 4)
        data = self.data + bytes(-len(self.data) % 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text
        chunks += struct.pack("<I4s", len(data), b"BIN\0") + data
        return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


RAISE = np.vstack((np.zeros((4, 3)), [(0, 0, 1)] * 4)).astype("<f4")
LIFTED = CUBE[4:].astype("<f4") + RAISE[4:]


def sparse_glb(kind: str, **more: Any) -> bytes:
    g = Glb()
    sparse = g.sparse(LIFTED, np.arange(4, 8).astype(kind))
    positions = g.accessor(CUBE.astype("<f4"), sparse=sparse, **more)
    return g.pack([{"primitives": [g.primitive(positions)]}], [{"mesh": 0}])


def morphed_glb(weights: list[float], *nodes: dict[str, Any]) -> bytes:
    g = Glb()
    targets = [{"POSITION": g.accessor(RAISE)}]
    mesh = {"primitives": [g.primitive(targets=targets)], "weights": weights}
    return g.pack([mesh], [{"mesh": 0, **node} for node in nodes])


def skinned_glb(raised: float) -> bytes:
    g = Glb()
    g.extra["skins"] = [{"joints": [1, 2]}]
    mesh = {"primitives": [g.primitive()]}
    return g.pack([mesh], [{"mesh": 0, "skin": 0}, {}, {"translation": [0, 0, raised]}])


def modes_glb() -> bytes:
    g = Glb()
    p = {"POSITION": g.accessor(CUBE.astype("<f4"))}
    strip = np.array([5, 1, 6, 2, 8, 4, 7, 3, 5, 1], dtype="<u2") - 1
    fans = [np.array(q, dtype="<u2") - 1 for q in QUADS[:2]]
    parts = [{"attributes": p, "indices": g.accessor(strip), "mode": 5}]
    parts += [{"attributes": p, "indices": g.accessor(fan), "mode": 6} for fan in fans]
    return g.pack([{"primitives": parts}], [{"mesh": 0}])


def edited_glb(edit: Callable[[Glb], list[dict[str, Any]]], **positions: Any) -> bytes:
    g = Glb()
    mesh = {"primitives": [g.primitive(g.accessor(CUBE.astype("<f4"), **positions))]}
    return g.pack([mesh], edit(g))


def quantized_glb() -> bytes:
    g = Glb()
    positions = g.accessor((CUBE * 32767).astype("<i2"), normalized=True)
    g.extra["extensionsRequired"] = ["KHR_mesh_quantization"]
    return g.pack([{"primitives": [g.primitive(positions)]}], [{"mesh": 0}])


def two_scenes() -> bytes:
    g = Glb()
    parts = [{"primitives": [g.primitive()]}]
    g.extra.update(scenes=[{"nodes": [0]}, {"nodes": [0, 1]}])
    return g.pack(parts, [{"mesh": 0}, {"mesh": 0, "translation": [3, 0, 0]}])


def using(extension: str, key: str = "extensionsUsed") -> bytes:
    def edit(g: Glb) -> list[dict[str, Any]]:
        g.extra[key] = [extension]
        if "draco" in extension:
            del g.accessors[0]["bufferView"]
            g.accessors[0]["extensions"] = {extension: {}}
        return [{"mesh": 0}]

    return edited_glb(edit)


def scaled_glb() -> bytes:
    """Positions are integers that the node scales, as packers of GLB write them."""
    g = Glb()
    positions = g.accessor((CUBE * 4096).astype("<i2"), min=[0, 0, 0], max=[4096, 4096, 4096])
    g.extra["extensionsRequired"] = ["KHR_mesh_quantization"]
    mesh = {"primitives": [g.primitive(positions)]}
    return g.pack([mesh], [{"mesh": 0, "scale": [1 / 4096] * 3}])


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
_TEXTURED = re.sub(r"(-\d)", r"\1/-1/-1", RELATIVE).replace("f ", "vt 0 0\nvn 0 0 1\nf ")
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
    "obj, triangles": ("a.obj", obj(faces=_FACES), _ONE),
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
    "stl, text": ("a.stl", stl(), _ONE),
    "stl, two solids": ("a.stl", _TWO_TEXTS, _TWO),
    "glb, looks": ("a.glb", using("KHR_materials_unlit", "extensionsRequired"), _ONE),
    "glb, scaled integers": ("a.glb", scaled_glb(), _ONE),
    "glb, two nodes": (
        "a.glb",
        edited_glb(lambda _: [{"mesh": 0}, {"mesh": 0, "translation": [3, 0, 0]}]),
        _TWO,
    ),
    "glb, mirrored": ("a.glb", edited_glb(lambda _: [{"mesh": 0, "scale": [-1, 1, 1]}]), _ONE),
}  # fmt: skip
#: Files that are refused: name, content, and what is said of it.
REFUSED: dict[str, tuple[str, str | bytes, str]] = {
    "obj, relative": ("a.obj", RELATIVE, "line 'f -8 -6 -5 -7', whose numbers .* not from 1 on"),
    "obj, relative, textured": ("a.obj", _TEXTURED, "line 'f -8/-1/-1 .* not from 1 on"),
    "obj, vertices before each face": (
        "a.obj",
        "".join(obj(CUBE[np.array(q) - 1], [(-4, -3, -2, -1)]) for q in QUADS),
        "line 'f -4 -3 -2 -1', whose numbers of vertices are not from 1 on",
    ),
    "obj, back before the first": ("a.obj", obj(CUBE[:3], [(-4, 2, 3)]), "line 'f -4 2 3'"),
    "obj, number 0": ("a.obj", obj(faces=[(0, 1, 2)]), "line 'f 0 1 2'"),
    "obj, number beyond": ("a.obj", obj(faces=[*QUADS, (1, 2, 9)]), "index 8 is out of bounds"),
    "obj, tabs": ("a.obj", obj(blank="\t"), r"line 'v\\t0.0.*no plain vertex or face"),
    "obj, blanks before": ("a.obj", obj().replace("v 1", "  v 1"), "line 'v 1.*no plain vertex"),
    "obj, continued lines": ("a.obj", obj().replace("f 1 3 ", "f 1 3\\\n"), "no plain vertex"),
    "obj, remarks": ("a.obj", obj().replace("\n", " # said\n"), "text in place of a number"),
    "obj, decimal commas": ("a.obj", obj(CUBE / 2).replace(".5", ",5"), "text in place of a numb"),
    "obj, free form": ("a.obj", obj() + "surf 0 1 0 1 1 2 3\n", "'surf 0 .* no plain vertex"),
    "obj, concave": ("a.obj", obj(*prism(OUTLINES["u"], 5)), "polygons that are concave or fold"),
    "ply, mixed": ("a.ply", ply(CUBE, _MIXED, "<"), "faces must have equally many corners: expo"),
    "ply, mixed, big end": ("a.ply", ply(CUBE, _MIXED, ">"), "faces must have equally many corner"),
    "ply, concave": ("a.ply", ply(*prism(OUTLINES["arrow"], 1), ""), "concave or fold back"),
    "ply, lists of vertices": ("a.ply", ply(CUBE, QUADS, "<", extra=True), "unexpected length"),
    "ply, line end behind": ("a.ply", ply(CUBE, QUADS, "<") + b"\n", "unexpected length"),
    "ply, strips": ("a.ply", _STRIPS, "strips of triangles"),
    "ply, decimal commas": ("a.ply", ply(CUBE / 2, QUADS, "").replace(b".5", b",5"), "text in pla"),
    "ply, more than declared": ("a.ply", ply(CUBE, QUADS, "") + b"3 0 1 2\n", "15 lines, but a h"),
    "ply, fewer lines": ("a.ply", ply(CUBE, QUADS, "")[:-8], "14 lines|13 lines|12 faces declared"),
    "ply, a line cut": ("a.ply", ply(CUBE, QUADS, "")[:-3], "12 faces declared, but 11 that can"),
    "ply, fewer bytes": ("a.ply", ply(CUBE, QUADS, ">")[:-1], "unexpected length"),
    "stl, more than declared": ("a.stl", binary_stl(10), "684 bytes, but its 10 triangles take 5"),
    "stl, fewer than declared": ("a.stl", binary_stl(14), "684 bytes, but its 14 triangles take 7"),
    "stl, bytes behind": ("a.stl", binary_stl(behind=b"\r\n"), "686 bytes, but its 12 triangles"),
    "stl, cut off": ("a.stl", stl()[:900], "9 faces declared, but 0 that can be read"),
    "stl, second solid cut off": ("a.stl", _TWO_TEXTS[:2300], r"\d+ faces declared, but 12 that c"),
    "stl, end solid": ("a.stl", stl().replace("endsolid", "end solid"), "12 faces declared, but 0"),
    "stl, old line ends": ("a.stl", stl().replace("\n", "\r"), "text in place of a number"),
    "stl, decimal commas": ("a.stl", stl().replace(".", ","), "text in place of a number"),
    "glb, cut off": ("a.glb", sparse_glb("<u1")[:300], "no whole binary glTF"),
    "glb, sparse": ("a.glb", sparse_glb("<u1"), "sparse or compressed values"),
    "glb, sparse u32": ("a.glb", sparse_glb("<u4"), "sparse or compressed values"),
    "glb, weights of the mesh": ("a.glb", morphed_glb([1.0], {}), "a morph target that changes"),
    "glb, weights of the node": ("a.glb", morphed_glb([0.0], {"weights": [1.0]}), "a morph target"),
    "glb, skin": ("a.glb", skinned_glb(1.0), "a skin, whose joints may bend it"),
    "glb, strips and fans": ("a.glb", modes_glb(), "12 faces declared, but 8 that can be read"),
    "glb, fractions": ("a.glb", quantized_glb(), "positions as fractions of the largest integer"),
    "glb, camera on a mesh": (
        "a.glb",
        edited_glb(lambda g: [
            g.extra.update(cameras=[{"type": "perspective", "perspective": {
                "yfov": 1.0, "znear": 0.1, "aspectRatio": 1.0}}]) or {"mesh": 0, "camera": 0},
            {"mesh": 0, "translation": [3, 0, 0]},
        ]),
        "24 faces declared, but 12 that can be read",
    ),
    "glb, bounds": (
        "a.glb",
        edited_glb(lambda _: [{"mesh": 0}], min=[0, 0, 0], max=[1, 1, 2]),
        r"positions in .*1\.0\]\], but it states bounds of .*2\.0\]\]",
    ),
    "glb, draco": ("a.glb", using("KHR_draco_mesh_compression"), "sparse or compressed values"),
    "glb, unknown": ("a.glb", using("EXT_my_shape", "extensionsRequired"), "extension EXT_my_sha"),
    "glb, instances": ("a.glb", using("EXT_mesh_gpu_instancing"), "extension EXT_mesh_gpu"),
    "glb, crowded": (
        "a.glb",
        edited_glb(lambda _: [{"children": [0]}]),
        "more than 10,000 nodes",
    ),
    "glb, long place": (
        "a.glb",
        edited_glb(lambda _: [{"mesh": 0, "translation": [0.0] * 100_000}]),
        "a node whose translation is not 3 numbers",
    ),
    "glb, other file": (
        "a.glb",
        edited_glb(lambda g: [
            g.extra.update(buffers=[{"byteLength": len(g.data), "uri": "x.bin"}]) or {"mesh": 0}
        ]),
        "a buffer that is not in the file itself",
    ),
    "glb, no default scene": ("a.glb", two_scenes(), "2 scenes, none of which is the default"),
}  # fmt: skip


def write_file(folder: Path, name: str, content: str | bytes) -> Path:
    """Write a file, and return its path."""
    (folder / name).write_bytes(content.encode() if isinstance(content, str) else content)
    return folder / name
