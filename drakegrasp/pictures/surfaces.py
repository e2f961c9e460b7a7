"""Surfaces for the 3D view of a browser: vertices, faces and colours as plain data.

In: a link of a `StillScene`, or an object. Out: JSON, a list of parts, each with its `colour`
"#rrggbb", `vertices` (n, 3) as float32 [m] and `faces` (m, 3) as uint32, both little-endian in
base64. A link is in its own frame, an object in {O}.
"""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import trimesh
from pydrake.geometry import (
    Box,
    Capsule,
    Convex,
    Cylinder,
    GeometryId,
    Mesh,
    Role,
    SceneGraphInspector,
    Sphere,
)

from drakegrasp.frames import Array
from drakegrasp.hand.shapes import hull_corners
from drakegrasp.objects.model import ObjectModel, object_colour
from drakegrasp.pictures.still_scene import GREY, StillScene


def object_json(model: ObjectModel) -> bytes:
    """Return the visual mesh of an object."""
    colour = object_colour(model.name)
    return _json([_part(model.visual_vertices, model.visual_faces, colour)])


def link_surfaces(scene: StillScene) -> dict[str, bytes]:
    """Return what a hand's model shows of each link that has a shape, by the link's name.

    A link without visual shapes is shown by those of collisions.
    """
    surfaces = {}
    for link in scene.links:
        inspector, shapes = scene.shapes(link)
        parts = []
        for shape in shapes:
            mesh = _mesh(inspector, shape)
            if mesh is not None:
                mesh.apply_transform(inspector.GetPoseInFrame(shape).GetAsMatrix4())
                parts.append(_part(mesh.vertices, mesh.faces, _colour(inspector, shape)))
        if shapes:
            surfaces[link] = _json(parts)
    return surfaces


def _json(parts: list[dict[str, str]]) -> bytes:
    return json.dumps(parts).encode()


def _part(vertices: npt.ArrayLike, faces: npt.ArrayLike, colour: npt.ArrayLike) -> dict[str, str]:
    """Return a part of one colour (3,), red, green and blue in 0..1."""
    levels = np.rint(255.0 * np.asarray(colour)).astype(np.uint8)
    return {
        "colour": f"#{levels.tobytes().hex()}",
        "vertices": base64.b64encode(np.asarray(vertices, dtype="<f4").tobytes()).decode(),
        "faces": base64.b64encode(np.asarray(faces, dtype="<u4").tobytes()).decode(),
    }


def _colour(inspector: SceneGraphInspector, geometry: GeometryId) -> Array:
    """Return the colour (3,) that the model gives a shape, else grey."""
    properties = inspector.GetProperties(geometry, Role.kIllustration)
    if properties is None or not properties.HasProperty("phong", "diffuse"):
        return GREY[:3]
    rgba = properties.GetProperty("phong", "diffuse")
    return np.array([rgba.r(), rgba.g(), rgba.b()])


def _mesh(inspector: SceneGraphInspector, geometry: GeometryId) -> Any:
    """Return a shape as a mesh in its own frame; None for what cannot be drawn."""
    # All of Drake's shapes are centred, along z.
    shape = inspector.GetShape(geometry)
    if isinstance(shape, Box):
        return trimesh.creation.box(shape.size())
    if isinstance(shape, Cylinder):
        return trimesh.creation.cylinder(shape.radius(), shape.length(), sections=32)
    if isinstance(shape, Capsule):
        mesh = trimesh.creation.capsule(shape.length(), shape.radius(), count=(16, 24))
        return mesh.apply_translation(-mesh.bounds.mean(axis=0))
    if isinstance(shape, Sphere):
        return trimesh.creation.icosphere(3, shape.radius())
    if isinstance(shape, Mesh | Convex):
        return _file_mesh(inspector, geometry, shape)
    return None


def _file_mesh(inspector: SceneGraphInspector, geometry: GeometryId, shape: Mesh | Convex) -> Any:
    """Return the mesh of a file; its convex hull where trimesh cannot read the file."""
    source = shape.source()
    path = Path(str(source.path())) if source.is_path() else None
    if path is not None and path.is_file():
        try:
            mesh = trimesh.load_mesh(path, process=False)
            return mesh.apply_scale(shape.scale3())
        except (ValueError, NotImplementedError, ImportError):
            pass
    return trimesh.convex.convex_hull(hull_corners(inspector, geometry))
