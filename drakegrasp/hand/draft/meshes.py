"""Mesh files of a vendor's model, as Wavefront files.

In: the XML of a model, and the mesh files that it names, in any format that trimesh reads. Out: XML
that names Wavefront files of a scratch folder, which Drake reads, and what they hold: triangles in
metres, few enough to be drawn quickly, and the colour that stands for a mesh.
"""

from __future__ import annotations

import hashlib
import logging
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import fast_simplification
import numpy as np
import trimesh

from drakegrasp.errors import HandError, first_line
from drakegrasp.frames import Array
from drakegrasp.hand.draft.source import Source
from drakegrasp.mesh.surfaces import Faces
from drakegrasp.mesh.wavefront import obj_text

#: Formats of mesh files.
FORMATS = (".obj", ".stl", ".dae", ".glb", ".gltf", ".ply")
#: A mesh file has at most so many bytes; a mesh with more faces than this is drawn with so many.
LARGEST, MOST_FACES = 200_000_000, 8_000
#: No colour is darker: nothing of a black hand can be told in a picture.
DARKEST = 0.15


@dataclass(frozen=True, kw_only=True, eq=False)
class MeshFile:
    """Vertices (n, 3) [m], faces (m, 3), and the colour (3,) of a mesh file, if it has one."""

    vertices: Array
    faces: Faces
    colour: Array | None


@dataclass(frozen=True)
class MeshFolder:
    """A scratch folder of Wavefront files.

    Attributes:
        folder: Where they are.
        files: What they hold, by their names.
    """

    folder: Path
    files: dict[str, MeshFile] = field(default_factory=dict)

    def convert(self, path: Path) -> str:
        """Return the name of the Wavefront file of a mesh file.

        Raises:
            HandError: If it is missing or no mesh that can be read.
        """
        name = f"{hashlib.sha256(str(path).encode()).hexdigest()[:16]}.obj"
        if name not in self.files:
            mesh = self.files[name] = read_mesh(path)
            text = obj_text(mesh.vertices, mesh.faces, normals=True)
            (self.folder / name).write_text(text, encoding="utf-8")
        return name


def read_mesh(path: Path) -> MeshFile:
    """Return what a mesh file holds.

    Raises:
        HandError: If it is missing, of another format, or holds no triangles.
    """
    # Refuse what trimesh need not see.
    if path.suffix.lower() not in FORMATS:
        raise HandError(
            f"model: mesh {path.name!r} must be one of {', '.join(FORMATS)}, got {path.suffix!r}"
        )
    if not path.is_file():
        raise HandError(f"model: mesh {str(path)!r} must be a file, got none")
    if path.stat().st_size > LARGEST:
        raise HandError(f"model: mesh {path.name!r} must have at most {LARGEST // 10**6} MB")

    # Libraries raise all kinds of errors for a broken file.
    logging.getLogger("trimesh").setLevel(logging.CRITICAL)
    try:
        scene: Any = trimesh.load_scene(path)
        mesh: Any = scene.to_mesh()
        # Seams of textures and shading would tear where faces are left out.
        mesh.merge_vertices(merge_tex=True, merge_norm=True)
        vertices = np.asarray(mesh.vertices, dtype=float)
        faces = np.asarray(mesh.faces, dtype=np.int64)
    except ImportError as error:
        missing = "pycollada" if path.suffix.lower() == ".dae" else first_line(error)
        raise HandError(
            f"model: mesh {path.name!r} needs `pip install {missing}`, or another format"
        ) from None
    except Exception as error:
        raise HandError(
            f"model: mesh {path.name!r} must be readable, got: {first_line(error)}"
        ) from None
    if not len(faces) or not np.isfinite(vertices).all():
        raise HandError(f"model: mesh {path.name!r} must hold triangles with finite corners")

    # Few faces are enough for a picture.
    if len(faces) > MOST_FACES:
        vertices, faces = fast_simplification.simplify(
            vertices.astype(np.float32), faces.astype(np.int32), target_count=MOST_FACES
        )
    return MeshFile(
        vertices=vertices.astype(float), faces=faces.astype(np.int64), colour=_colour(scene)
    )


def _colour(scene: Any) -> Array | None:
    """Return the colour (3,) that most of a scene's surface has; None if it has none."""
    found: list[tuple[float, Array]] = []
    for mesh in scene.geometry.values():
        material = getattr(mesh.visual, "material", None)
        colour = getattr(material, "main_color", None)
        if colour is not None:
            found.append((float(mesh.area), np.asarray(colour, dtype=float)[:3] / 255.0))
    return np.maximum(max(found, key=lambda pair: pair[0])[1], DARKEST) if found else None


def replace_meshes(source: Source, folder: MeshFolder) -> list[str]:
    """Replace every mesh in the XML by its conversion, and return notes of what was left out.

    A picture of a link that cannot be read is left out: its collision shapes are drawn instead.

    Raises:
        HandError: If a mesh of a collision shape cannot be read.
    """
    if source.root.tag == "mujoco":
        _replace_assets(source, folder)
        return []

    # URDF and SDFormat: shapes of links that hold meshes.
    notes: list[str] = []
    for link in source.root.iter("link"):
        shapes = [*link.findall("collision"), *link.findall("visual")]
        for shape in shapes:
            try:
                for mesh in shape.iter("mesh"):
                    _replace(mesh, source, folder)
            except HandError as error:
                if shape.tag == "collision":
                    raise
                notes.append(f"not drawn: {str(error).removeprefix('model: ')}")
                link.remove(shape)
    return notes


def _replace(mesh: Element, source: Source, folder: MeshFolder) -> None:
    """Replace the file of a mesh in URDF or SDFormat."""
    if source.root.tag == "robot":
        path = source.folders.find(mesh.get("filename", ""), source.folders.model)
        mesh.set("filename", folder.convert(path))
        return
    uri = mesh.find("uri")
    if uri is None or mesh.find("submesh") is not None:
        raise HandError("model: a mesh must be a whole file, got <submesh> or no <uri>")
    path = source.folders.find((uri.text or "").strip(), source.folders.model)
    uri.text = folder.convert(path)


def _replace_assets(source: Source, folder: MeshFolder) -> None:
    """Replace the files of an MJCF model's meshes, and leave out its textures."""
    # The folder of the meshes is the compiler's.
    base = source.folders.model
    for compiler in source.root.iter("compiler"):
        place = compiler.attrib.pop("meshdir", None) or compiler.attrib.pop("assetdir", None)
        base = base / place if place else base
        for key in ("assetdir", "texturedir", "strippath"):
            compiler.attrib.pop(key, None)

    # A file's name stands for a name that is not given.
    for assets in source.root.iter("asset"):
        for element in list(assets):
            if element.tag == "texture":
                assets.remove(element)
            element.attrib.pop("texture", None)
            file = element.get("file")
            if element.tag == "mesh" and file:
                element.attrib.setdefault("name", Path(file).stem)
                element.set("file", folder.convert(source.folders.find(file, base)))
