"""A mesh file is read as it declares itself, or refused with what it has."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from drakegrasp.errors import MeshError
from drakegrasp.mesh.loading import load_mesh

#: Corners of the unit cube, those of another, and the faces of each, from 1.
CUBE = np.array([(x, y, z) for z in (0, 1) for y in (0, 1) for x in (0, 1)], dtype=np.float64)
ASIDE = CUBE + np.array((3, 0, 0))
QUADS = ((1, 3, 4, 2), (5, 6, 8, 7), (1, 2, 6, 5), (2, 4, 8, 6), (4, 3, 7, 8), (3, 1, 5, 7))
TRIANGLES = np.array([(a, b, c) for q in QUADS for a, b, c in (q[:3], (q[2], q[3], q[0]))]) - 1
#: Volume and area of what files declare.
ONE, TWO, TALL = (1.0, 6.0), (2.0, 12.0), (2.0, 10.0)
#: Outlines that no fan from all of their corners fills.
OUTLINES = {
    "u": [(0, 0), (9, 0), (9, 8), (7, 8), (7, 2), (2, 2), (2, 8), (0, 8)],
    "arrow": [(0, 0), (2, -1), (0, 3), (-2, -1)],
    "doubled": [(0, 0), (9, 0), (9, 8), (7, 8), (7, 8), (7, 2), (2, 2), (2, 8), (0, 8)],
}
Polygons = Sequence[Sequence[int]]


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


BEHIND = [[k - 9 for k in q] for q in QUADS]
RELATIVE = obj(faces=BEHIND) + "g b\nusemtl b\n" + obj(ASIDE, BEHIND)
TEXTURED = RELATIVE.replace("-1", "-1/-1/-1").replace("f ", "vt 0 0\nvn 0 0 1\nf ")
TRUE_STRIP = "4 0 5 1 7 3 6 2 4 0 -1 0 2 1 3 -1 4 5 6 7"
STRIPS = ply(CUBE, [], "").decode().split("element face")[0] + (
    "element tristrips 1\nproperty list int int vertex_indices\nend_header\n"
    + "".join(" ".join(map(str, p)) + "\n" for p in CUBE.tolist())
    + f"{len(TRUE_STRIP.split())} {TRUE_STRIP}\n"
)
READ: dict[str, tuple[str, str | bytes, tuple[float, float]]] = {
    "obj, indices back from each block": ("a.obj", RELATIVE, TWO),
    "obj, the same with vt and vn": ("a.obj", TEXTURED, TWO),
    "obj, vertices before each face": (
        "a.obj",
        "".join(obj(CUBE[np.array(q) - 1], [(-4, -3, -2, -1)]) for q in QUADS),
        ONE,
    ),
    "obj, tabs": ("a.obj", obj(blank="\t"), ONE),
    "obj, continued lines": ("a.obj", obj().replace("f 1 3 ", "f 1 3\\\n"), ONE),
    "obj, remarks behind values": ("a.obj", obj().replace("\n", " # said\n"), ONE),
    "obj, byte-order mark": ("a.obj", "\ufeff" + obj(), ONE),
    "ply, mixed": ("a.ply", ply(*prism(OUTLINES["u"], 5), "<"), (42.0, 130.0)),
    "ply, mixed, big end first": ("a.ply", ply(*prism(OUTLINES["u"], 5), ">"), (42.0, 130.0)),
    "ply, mixed text": ("a.ply", ply(*prism(OUTLINES["u"], 5), ""), (42.0, 130.0)),
    "ply, lists of vertices": ("a.ply", ply(CUBE, QUADS, "<", extra=True), ONE),
    "ply, line end behind": ("a.ply", ply(CUBE, QUADS, "<") + b"\n", ONE),
    "ply, strips": ("a.ply", STRIPS, ONE),
    "stl, end solid": ("a.stl", stl().replace("endsolid", "end solid"), ONE),
    "stl, two bodies, end solid": (
        "a.stl",
        (stl() + "\n" + stl(ASIDE)).replace("endsolid", "end solid"),
        TWO,
    ),
    "stl, one line end in a file": ("a.stl", stl().replace("\n", "\r"), ONE),
    "stl, bytes behind": ("a.stl", binary_stl(behind=b"\r\n"), ONE),
    "stl, zeros behind": ("a.stl", binary_stl(behind=bytes(512)), ONE),
    "glb, sparse u8": ("a.glb", sparse_glb("<u1"), TALL),
    "glb, sparse u32": ("a.glb", sparse_glb("<u4"), TALL),
    "glb, morph weights of the mesh": ("a.glb", morphed_glb([1.0], {}), TALL),
    "glb, morph weights of the node": ("a.glb", morphed_glb([0.0], {"weights": [1.0]}), TALL),
    "glb, two nodes, two shapes": (
        "a.glb",
        morphed_glb([1.0], {}, {"weights": [0.0], "translation": [3, 0, 0]}),
        (3.0, 16.0),
    ),
    "glb, strips and fans": ("a.glb", modes_glb(), ONE),
    "glb, camera on a mesh": (
        "a.glb",
        edited_glb(lambda g: [
            g.extra.update(cameras=[{"type": "perspective", "perspective": {
                "yfov": 1.0, "znear": 0.1, "aspectRatio": 1.0}}]) or {"mesh": 0, "camera": 0},
            {"mesh": 0, "translation": [3, 0, 0]},
        ]),
        TWO,
    ),
    "glb, looks": ("a.glb", using("KHR_materials_unlit", "extensionsRequired"), ONE),
    "glb, quantized": ("a.glb", quantized_glb(), ONE),
}  # fmt: skip


def write(folder: Any, name: str, content: str | bytes) -> Any:
    (folder / name).write_bytes(content.encode() if isinstance(content, str) else content)
    return folder / name


@pytest.mark.parametrize("case", READ)
def test_all_that_a_file_declares_is_read(tmp_path, case):
    name, content, (volume, area) = READ[case]
    mesh = load_mesh(write(tmp_path, name, content))
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(volume, rel=1e-4)
    assert mesh.area == pytest.approx(area, rel=1e-4)


@pytest.mark.parametrize("outline", OUTLINES)
def test_concave_polygons_are_filled_whatever_their_first_corner(tmp_path, outline):
    x, y = np.array(OUTLINES[outline], dtype=np.float64).T
    area = float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum()) / 2.0
    girth = float(np.hypot(np.roll(x, -1) - x, np.roll(y, -1) - y).sum())
    for start in range(len(x)):
        vertices, faces = prism(OUTLINES[outline], start)
        for mirrored in (faces, [f[::-1] for f in faces]):
            mesh = load_mesh(write(tmp_path, "a.obj", obj(vertices, mirrored)))
            assert mesh.is_watertight and abs(mesh.volume) == pytest.approx(area)
            assert mesh.area == pytest.approx(2.0 * area + girth)


REFUSED: dict[str, tuple[str, str | bytes, str]] = {
    "obj, decimal commas": ("a.obj", obj(CUBE / 2).replace(".5", ",5"), r"line 2, 'v 0,5 0\.0"),
    "obj, back before the first": ("a.obj", obj(CUBE[:3], [(-4, 2, 3)]), "line 4, 'f -4 2 3'"),
    "obj, number 0": ("a.obj", obj(faces=[(0, 1, 2)]), "line 9, 'f 0 1 2'"),
    "obj, free form": ("a.obj", obj() + "surf 0 1 0 1 1 2 3\n", "line 15, 'surf', .* no polygon"),
    "ply, decimal commas": ("a.ply", ply(CUBE / 2, QUADS, "").replace(b".5", b",5"), "'0,5' in pl"),
    "ply, more than declared": ("a.ply", ply(CUBE, QUADS, "") + b"3 0 1 2\n", "1 lines more than"),
    "ply, fewer than declared": ("a.ply", ply(CUBE, QUADS, ">")[:-1], "fewer bytes than its head"),
    "stl, more than declared": ("a.stl", binary_stl(10), "12 triang.* its header declares 10"),
    "stl, fewer than declared": ("a.stl", binary_stl(14), "12 triang.* its header declares 14"),
    "stl, cut off": ("a.stl", stl()[:900], "begins 1 solids and ends 0"),
    "stl, decimal commas": ("a.stl", stl().replace(".", ","), "'0,0+' in place of a number"),
    "glb, bounds": (
        "a.glb",
        edited_glb(lambda g: [{"mesh": 0}], min=[0, 0, 0], max=[1, 1, 2]),
        r"max is \(1, 1, 1\), but the file states \(1, 1, 2\)",
    ),
    "glb, bent by joints": ("a.glb", skinned_glb(1.0), "a skin out of its bind pose"),
    "glb, draco": ("a.glb", using("KHR_draco_mesh_compression"), "extension KHR_draco"),
    "glb, unknown": ("a.glb", using("EXT_my_shape", "extensionsRequired"), "extension EXT_my_sha"),
    "glb, crowded": ("a.glb", edited_glb(lambda g: [{}] * 10_001), "10,001 nodes, more than 10"),
    "glb, long place": (
        "a.glb",
        edited_glb(lambda g: [{"mesh": 0, "translation": [0.0] * 100_000}]),
        "a node whose translation is not 3 numbers",
    ),
    "glb, instances": ("a.glb", using("EXT_mesh_gpu_instancing"), "extension EXT_mesh_gpu"),
    "glb, other file": (
        "a.glb",
        edited_glb(lambda g: [
            g.extra.update(buffers=[{"byteLength": len(g.data), "uri": "x.bin"}]) or {"mesh": 0}
        ]),
        r"a buffer in another file \(x.bin\)",
    ),
    "glb, no default scene": ("a.glb", two_scenes(), "2 scenes, none of which is the default"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_not_as_declared_is_refused_in_one_line(tmp_path, case):
    name, content, message = REFUSED[case]
    with pytest.raises(MeshError, match=message) as caught:
        load_mesh(write(tmp_path, name, content))
    assert "\n" not in str(caught.value)


def test_a_skin_in_its_bind_pose_is_read(tmp_path):
    assert load_mesh(write(tmp_path, "a.glb", skinned_glb(0.0))).volume == pytest.approx(1.0)


def test_node_is_scaled_then_turned_then_moved(tmp_path):
    turn, scale, place = (
        Rotation.from_euler("xyz", [0.4, 0.7, 1.1]),
        [1.0, 2.0, 3.0],
        [4.0, 5.0, 6.0],
    )
    pose = {"rotation": turn.as_quat().tolist(), "scale": scale, "translation": place}
    mesh = load_mesh(write(tmp_path, "a.glb", edited_glb(lambda g: [{"mesh": 0, **pose}])))
    wanted = turn.apply(CUBE * scale) + place
    found = [np.linalg.norm(mesh.vertices - corner, axis=1).min() for corner in wanted]
    np.testing.assert_allclose(found, 0.0, atol=1e-6)


def test_child_is_moved_in_the_axes_of_its_parent(tmp_path):
    turn = Rotation.from_euler("xyz", [0.4, 0.7, 1.1])
    parent = {"rotation": turn.as_quat().tolist(), "translation": [4.0, 5.0, 6.0]}
    child = {"mesh": 0, "translation": [1.0, 2.0, 3.0]}

    def edit(g):
        g.extra.update(scene=0, scenes=[{"nodes": [0]}])
        return [{"children": [1], **parent}, child]

    mesh = load_mesh(write(tmp_path, "a.glb", edited_glb(edit)))
    wanted = turn.apply(CUBE + np.array([1.0, 2.0, 3.0])) + np.array([4.0, 5.0, 6.0])
    found = [np.linalg.norm(mesh.vertices - corner, axis=1).min() for corner in wanted]
    np.testing.assert_allclose(found, 0.0, atol=1e-6)


def test_order_of_existing_datasets_stays(tmp_path):
    """The last material of a Wavefront file comes first, as trimesh has it."""
    far = [[k + 8 for k in q] for q in QUADS]
    text = f"usemtl a\n{obj()}usemtl b\n{obj(ASIDE, far)}"
    mesh = load_mesh(write(tmp_path, "a.obj", text))
    np.testing.assert_array_equal(mesh.vertices, np.vstack((ASIDE, CUBE)))
    assert (mesh.faces[:12] < 8).all() and (mesh.faces[12:] >= 8).all()
