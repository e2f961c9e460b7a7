"""Binary glTF files: the surface that the default scene shows before anything moves."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from typing import Any

import numpy as np

from drakegrasp.foreign_files import parse_json
from drakegrasp.frames import Array
from drakegrasp.mesh.declared import Declared
from drakegrasp.mesh.ply import strip_faces
from drakegrasp.mesh.surfaces import Faces

#: Maximum number of nodes of a scene: trimesh takes a millisecond for each.
MOST_NODES = 10_000
#: Parts of the names of extensions that change the look of a mesh, but not its shape.
_LOOKS = ("material", "texture", "light")
#: Extensions of shape that are read, and those that change the shape even if not required.
_READ = frozenset(("KHR_mesh_quantization",))
_SHAPES = frozenset(("EXT_mesh_gpu_instancing",))
#: Lengths of the arrays that place a node: trimesh would make a matrix of any length it is given.
_PLACES = {"matrix": 16, "translation": 3, "rotation": 4, "scale": 3}
_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
#: Modes of a primitive that has faces.
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
#: Fraction of its diagonal by which a part may differ from the bounds that the file states for it.
BOUNDS = 1e-3
#: Largest difference, by rounding, of two matrices that count as equal.
_SAME = 1e-5


def declared_glb(content: bytes) -> Declared:
    """Return the surface of a GLB file's default scene, with all transforms applied.

    Sparse accessors, default weights of morph targets, and skins in their bind pose are applied.
    Lines and points are ignored, since they are not surfaces; animations are not played.

    Raises:
        ValueError: If the shape needs an extension or another file, if it differs from the bounds
            that the file states, or if it is placed by something that is not read.
    """
    tree, chunk = _read_chunks(content)
    _refuse_description(tree)

    # Each mesh of the scene, at the pose of its node or its skin.
    file = _File(tree, chunk, len(content))
    X_SN = _place_nodes(tree)
    vertices, faces, total = [np.zeros((0, 3))], [np.zeros((0, 3), dtype=np.int64)], 0
    surfaces: dict[tuple[int, str], list[tuple[Array, Faces]]] = {}
    for number, X in X_SN.items():
        node = tree["nodes"][number]
        if "mesh" not in node:
            continue
        mesh = tree["meshes"][node["mesh"]]
        weights = node.get("weights", mesh.get("weights", []))
        if "skin" in node:
            X = file.skin_pose(tree["skins"][node["skin"]], X_SN)
        key = (node["mesh"], repr(weights))
        if key not in surfaces:
            surfaces[key] = [file.surface(primitive, weights) for primitive in mesh["primitives"]]
        for part, triangles in surfaces[key]:
            if np.linalg.det(X[:3, :3]) < 0.0:
                triangles = triangles[:, ::-1]
            vertices.append(part @ X[:3, :3].T + X[:3, 3])
            faces.append(triangles + total)
            total += len(part)
    return Declared(vertices=np.concatenate(vertices), faces=np.concatenate(faces))


def _read_chunks(content: bytes) -> tuple[dict[str, Any], bytes]:
    """Return the description and the binary chunk, which is empty if the file has none."""
    chunks: dict[bytes, bytes] = {}
    at, length = 12, int.from_bytes(content[8:12], "little")
    if content[:4] != b"glTF" or content[4:8] != b"\2\0\0\0" or length > len(content):
        raise ValueError("no whole binary glTF 2.0")
    while at + 8 <= length:
        size, kind = int.from_bytes(content[at : at + 4], "little"), content[at + 4 : at + 8]
        if at + 8 + size > length:
            raise ValueError("a chunk that is cut off")
        chunks.setdefault(kind, content[at + 8 : at + 8 + size])
        at += 8 + size
    tree = parse_json(chunks.get(b"JSON", b""))
    if not isinstance(tree, dict):
        raise ValueError("a description that is no object")
    return tree, chunks.get(b"BIN\0", b"")


def _refuse_description(tree: dict[str, Any]) -> None:
    """Raise an error for a file that trimesh would read only in part or never finish reading.

    Raises:
        ValueError: If the shape needs an extension, if there are too many nodes, or if the pose of
            a node has the wrong number of values.
    """
    # Extensions of the shape.
    shapes = [
        name
        for name in tree.get("extensionsRequired", [])
        if name not in _READ and not any(word in name for word in _LOOKS)
    ]
    shapes += [name for name in tree.get("extensionsUsed", []) if name in _SHAPES]
    if shapes:
        raise _needs(shapes[0])

    # Nodes.
    nodes = tree.get("nodes", [])
    if len(nodes) > MOST_NODES:
        raise ValueError(f"{len(nodes):,} nodes, more than {MOST_NODES:,}")
    for node in nodes:
        for key, count in _PLACES.items():
            numbers = node.get(key, [0] * count)
            if not isinstance(numbers, list) or len(numbers) != count:
                raise ValueError(f"a node whose {key} is not {count} numbers")


def _needs(extension: str) -> ValueError:
    return ValueError(f"the extension {extension}, which is not read; export without it")


def _place_nodes(tree: dict[str, Any]) -> dict[int, Array]:
    """Return the pose X_SN (4, 4) of each node of the default scene, scales included."""
    # The roots of the scene.
    nodes, scenes = tree.get("nodes", []), tree.get("scenes", [])
    if len(scenes) > 1 and "scene" not in tree:
        raise ValueError(f"{len(scenes)} scenes, none of which is the default")
    if scenes:
        roots = scenes[tree.get("scene", 0)].get("nodes", [])
    else:
        inner = {child for node in nodes for child in node.get("children", [])}
        roots = [number for number in range(len(nodes)) if number not in inner]

    # From the roots to all children.
    X_SN: dict[int, Array] = {}
    waiting = [(number, np.eye(4)) for number in reversed(roots)]
    while waiting:
        number, X_SP = waiting.pop()
        if number in X_SN:
            raise ValueError(f"node {number} in two places of the scene")
        X_SN[number] = X_SP @ _local_pose(nodes[number])
        children = nodes[number].get("children", [])
        waiting += [(child, X_SN[number]) for child in reversed(children)]
    return X_SN


def _local_pose(node: dict[str, Any]) -> Array:
    if "matrix" in node:
        return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    x, y, z, w = node.get("rotation", (0.0, 0.0, 0.0, 1.0))
    square = x * x + y * y + z * z + w * w
    s = 2.0 / square if square else 0.0
    X = np.eye(4)
    X[:3, :3] -= s * np.array(
        [
            [y * y + z * z, w * z - x * y, -x * z - w * y],
            [-x * y - w * z, x * x + z * z, w * x - y * z],
            [w * y - x * z, -y * z - w * x, x * x + y * y],
        ]
    )
    X[:3, :3] *= np.array(node.get("scale", (1.0, 1.0, 1.0)), dtype=np.float64)
    X[:3, 3] = node.get("translation", (0.0, 0.0, 0.0))
    return X


@dataclass
class _File:
    tree: dict[str, Any]
    chunk: bytes
    size: int  # size of the whole file [bytes]

    def surface(self, primitive: dict[str, Any], weights: list[float]) -> tuple[Array, Faces]:
        """Return the vertices and triangles of a primitive, with its morph targets applied."""
        mode = primitive.get("mode", _TRIANGLES)
        if mode not in (_TRIANGLES, _STRIP, _FAN):
            return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)

        # Compressed values are not in a buffer.
        number = primitive["attributes"]["POSITION"]
        for one in (number, primitive.get("indices", number)):
            accessor = self.tree["accessors"][one]
            extensions = [*primitive.get("extensions", {}), *accessor.get("extensions", {})]
            if "bufferView" not in accessor and "sparse" not in accessor and extensions:
                raise _needs(extensions[0])

        # Vertices.
        p = self._positions(number)
        targets = primitive.get("targets", [])
        for target, weight in zip(targets, weights, strict=False):
            if weight and "POSITION" in target:
                p = p + weight * self._positions(target["POSITION"])

        # Triangles.
        if "indices" in primitive:
            index = self.values(primitive["indices"]).reshape(-1).astype(np.int64)
        else:
            index = np.arange(len(p))
        wrong = index[(index < 0) | (index >= len(p))]
        if len(wrong):
            raise ValueError(f"a face with vertex {wrong[0]} of {len(p)}")
        if mode == _STRIP:
            return p, strip_faces(index)
        if mode == _FAN:
            middle = np.full(max(len(index) - 2, 0), index[0] if len(index) else 0)
            return p, np.stack((middle, index[1:-1], index[2:]), axis=1)
        if len(index) % 3:
            raise ValueError(f"triangles of {len(index)} corners, no multiple of three")
        return p, index.reshape(-1, 3)

    def _positions(self, number: int) -> Array:
        """Return positions (n, 3), compared with the bounds that the file states."""
        accessor, raw = self.tree["accessors"][number], self.values(number)
        if accessor["type"] != "VEC3":
            raise ValueError(f"positions of type {accessor['type']!r}")
        for key, found in (("min", np.minimum), ("max", np.maximum)):
            stated = accessor.get(key)
            if stated is None or not len(raw):
                continue
            bound = found.reduce(raw.astype(np.float64), axis=0)
            size = float(np.linalg.norm(np.ptp(raw.astype(np.float64), axis=0)))
            if np.abs(bound - np.asarray(stated, dtype=np.float64)).max() > BOUNDS * size:
                raise ValueError(
                    f"positions whose {key} is {_numbers(bound)}, but the file states "
                    f"{_numbers(stated)}"
                )

        # Normalized integers represent the range -1 to 1.
        values = raw.astype(np.float64)
        if accessor.get("normalized") and raw.dtype.kind in "iu":
            values = np.maximum(values / np.iinfo(raw.dtype).max, -1.0)
        return values

    def skin_pose(self, skin: dict[str, Any], X_SN: dict[int, Array]) -> Array:
        """Return the pose that a skin applies to all its vertices.

        Raises:
            ValueError: If its joints have moved relative to each other.
        """
        inverse = np.tile(np.eye(4), (len(skin["joints"]), 1, 1))
        if "inverseBindMatrices" in skin:
            inverse = self.values(skin["inverseBindMatrices"]).reshape(-1, 4, 4)
            inverse = inverse.astype(np.float64).swapaxes(1, 2)
        poses = [
            X_SN.get(joint, np.eye(4)) @ X
            for joint, X in zip(skin["joints"], inverse, strict=False)
        ]
        if not poses or np.abs(np.array(poses) - poses[0]).max() > _SAME * np.abs(poses[0]).max():
            raise ValueError("a skin out of its bind pose, which is not read; apply the armature")
        return poses[0]

    def values(self, number: int) -> np.ndarray:
        """Return the values (n, width) of an accessor."""
        accessor = self.tree["accessors"][number]
        width, count = _WIDTHS[accessor["type"]], accessor["count"]
        kind = accessor["componentType"]
        if "bufferView" in accessor:
            values = self._view(accessor, kind, width, count)
        else:
            # Declaring zeros takes no bytes, so their number is limited by the size of the file.
            if count > self.size:
                raise ValueError(f"{count:,} values without bytes")
            values = np.zeros((count, width), dtype=_COMPONENTS[kind])
        if (sparse := accessor.get("sparse")) is not None:
            indices = sparse["indices"]
            where = self._view(indices, indices["componentType"], 1, sparse["count"])[:, 0]
            values = values.copy()
            values[where] = self._view(sparse["values"], kind, width, sparse["count"])
        return values

    def _view(self, place: dict[str, Any], kind: int, width: int, count: int) -> np.ndarray:
        """Return numbers (count, width) of a buffer view."""
        # The bytes.
        view = self.tree["bufferViews"][place["bufferView"]]
        data = self._buffer(view)
        start = view.get("byteOffset", 0)
        data = data[start : start + view["byteLength"]]
        if len(data) != view["byteLength"]:
            raise ValueError("a buffer that is cut off")

        # The numbers, which may be interleaved with others.
        dtype = np.dtype(_COMPONENTS[kind])
        step = view.get("byteStride", width * dtype.itemsize)
        return np.ndarray(
            (count, width), dtype, data, place.get("byteOffset", 0), (step, dtype.itemsize)
        )

    def _buffer(self, view: dict[str, Any]) -> bytes:
        uri = self.tree["buffers"][view["buffer"]].get("uri")
        if uri is None and view["buffer"] == 0:
            return self.chunk
        if isinstance(uri, str) and uri.startswith("data:"):
            return base64.b64decode(uri.partition(",")[2])
        if extensions := list(view.get("extensions", {})):
            raise _needs(extensions[0])
        raise ValueError(f"a buffer in another file ({str(uri)[:60]}); export one GLB")


def _numbers(values: Any) -> str:
    return "(" + ", ".join(f"{float(value):.4g}" for value in values) + ")"
