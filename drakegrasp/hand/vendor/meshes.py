"""Mesh files of a vendor's model, as Wavefront files.

In: a file that trimesh reads. Out: its triangles in metres, few enough to be drawn quickly, and
the colour that stands for it.
"""

from __future__ import annotations

import hashlib
import logging
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import fast_simplification
import numpy as np
import trimesh

from drakegrasp.errors import HandError, first_line
from drakegrasp.frames import Array
from drakegrasp.mesh.surfaces import Faces
from drakegrasp.mesh.wavefront import obj_text

#: Formats of mesh files.
FORMATS = (".obj", ".stl", ".dae", ".glb", ".gltf", ".ply")
#: A mesh file has at most so many bytes; a mesh with more faces than this is drawn with so many.
LARGEST, MOST_FACES = 200_000_000, 8_000
#: No colour is darker: nothing of a black hand can be told in a picture.
DARKEST = 0.15


@dataclass(eq=False)
class MeshFolder:
    """A scratch folder of converted meshes.

    Attributes:
        folder: Where they are.
        colours: Colour (3,) of each converted file by its name, where its file gives one.
    """

    folder: Path
    colours: dict[str, Array] = field(default_factory=dict)
    _converted: dict[Path, Path] = field(default_factory=dict)

    def convert(self, path: Path) -> Path:
        """Return the Wavefront file of a mesh file.

        Raises:
            HandError: If it is missing or no mesh that can be read.
        """
        if path not in self._converted:
            vertices, faces, colour = read_mesh(path)
            digest = hashlib.sha256(str(path).encode()).hexdigest()[:6]
            stem = "".join(c if c.isalnum() else "_" for c in path.stem)
            made = self.folder / f"{stem}_{digest}.obj"
            made.write_text(obj_text(vertices, faces, normals=True), encoding="utf-8")
            self._converted[path] = made
            if colour is not None:
                self.colours[made.name] = colour
        return self._converted[path]


def read_mesh(path: Path) -> tuple[Array, Faces, Array | None]:
    """Return vertices (n, 3), faces (m, 3) and the colour (3,) of a mesh file, if it has one.

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
    if len(faces) > MOST_FACES:
        vertices, faces = fast_simplification.simplify(
            vertices.astype(np.float32), faces.astype(np.int32), target_count=MOST_FACES
        )
    return vertices.astype(float), faces.astype(np.int64), _colour(scene)


def _colour(scene: Any) -> Array | None:
    """Return the colour (3,) that most of a scene's surface has; None if it has none."""
    found: list[tuple[float, Array]] = []
    for mesh in scene.geometry.values():
        material = getattr(mesh.visual, "material", None)
        colour = getattr(material, "main_color", None)
        if colour is not None:
            found.append((float(mesh.area), np.asarray(colour, dtype=float)[:3] / 255.0))
    return np.maximum(max(found, key=lambda pair: pair[0])[1], DARKEST) if found else None
