"""Shapes of a vendor's links: primitives of Drake, and meshes of many formats.

Input: the XML of a model, the mesh files that it names, and the shapes that Drake parsed. Output:
XML that names Wavefront files of a scratch folder, which Drake can read, and `Shape`s on the links.
A shape that is not a primitive becomes triangles, few enough to be drawn quickly. A collision shape
becomes a convex hull.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import fast_simplification
import numpy as np
import numpy.typing as npt
import trimesh
from pydrake.geometry import (
    Box,
    Capsule,
    Convex,
    Cylinder,
    Ellipsoid,
    GeometryId,
    Mesh,
    Role,
    SceneGraphInspector,
    Sphere,
)
from pydrake.multibody.tree import CalcSpatialInertia, SpatialInertia
from scipy.spatial import cKDTree

from drakegrasp.arithmetic import dot
from drakegrasp.commissioning.draft.source import Source
from drakegrasp.errors import HandError, MeshError
from drakegrasp.frames import Array, transform_points
from drakegrasp.hand.shapes import ball_corners, hull_corners, primitive_corners
from drakegrasp.mesh.loading import join_scene, load_scene
from drakegrasp.mesh.surfaces import Faces
from drakegrasp.mesh.wavefront import obj_text

#: Number of faces to which larger meshes are simplified.
MOST_FACES = 8_000
#: Lower bound of colours, because the details of a black hand are invisible in a picture.
DARKEST = 0.15
#: Number of corners of the hull of a collision mesh; on a ball of 10 mm radius they miss less than
#: 0.4 mm.
CORNERS = 64
#: Minimum thickness of a hull [m]: a plane has no hull.
THIN = 4e-4
#: Number of points on a hull that are compared with ten times as many points of its mesh, which are
#: about 3 mm apart on a palm.
SAMPLES = 1000
#: Mean density of links whose model gives no mass [kg/m^3]; own choice, that of solid plastic.
DENSITY = 1200.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Shape:
    """A shape on a link: a primitive, or else a mesh.

    Attributes:
        X_LS: Pose of the shape on the link, (4, 4).
        primitive: A box, cylinder, capsule or sphere.
        vertices: (n, 3), vertices of a mesh, in its own frame [m].
        faces: (m, 3), faces of a mesh.
        colour: (3,), if the model or the mesh file gives one.
    """

    X_LS: Array = field(default_factory=lambda: np.eye(4))
    primitive: Box | Cylinder | Capsule | Sphere | None = None
    vertices: Array | None = None
    faces: Faces | None = None
    colour: Array | None = None

    def corners(self) -> Array:
        """Return points (n, 3) with the same hull as the shape, in the link's frame [m]."""
        own = self.vertices if self.primitive is None else primitive_corners(self.primitive)
        assert own is not None
        return transform_points(self.X_LS, own)

    def hull(self) -> Shape:
        """Return the convex hull of a mesh, with few corners; other shapes unchanged."""
        if self.vertices is None:
            return self
        points = self.vertices
        if np.ptp(points, axis=0).min() < THIN / 4.0:
            points = np.concatenate([points - THIN / 2.0, points + THIN / 2.0])

        # The farthest points along the link's axes, and along even directions.
        axes = self.X_LS[:3, :3]
        directions = np.concatenate([axes, -axes, ball_corners(1.0, CORNERS)])
        farthest = np.unique([int(np.argmax(dot(points, d))) for d in directions])
        return _with_hull(self, points[farthest])

    def simplified(self) -> Shape:
        """Return a mesh with at most `MOST_FACES` faces, to be drawn; other shapes unchanged."""
        if self.vertices is None or self.faces is None or len(self.faces) <= MOST_FACES:
            return self
        vertices, faces = fast_simplification.simplify(
            self.vertices.astype(np.float32), self.faces.astype(np.int32), target_count=MOST_FACES
        )
        return replace(self, vertices=vertices.astype(float), faces=faces.astype(np.int64))

    def reach_beyond(self, mesh: Shape) -> float:
        """Return the largest distance of the surface of a hull from that of its mesh [m]."""
        (own, _), (other, _) = (
            trimesh.sample.sample_surface(trimesh.Trimesh(s.vertices, s.faces), count, seed=0)
            for s, count in ((self, SAMPLES), (mesh, 10 * SAMPLES))
        )
        return float(cKDTree(other).query(own)[0].max())


def _with_hull(shape: Shape, points: Array) -> Shape:
    """Return a shape whose mesh is the convex hull of points (n, 3)."""
    solid = trimesh.convex.convex_hull(points)
    return replace(shape, vertices=np.array(solid.vertices), faces=np.array(solid.faces))


def read_shape(
    inspector: SceneGraphInspector,
    geometry: GeometryId,
    role: Role,
    meshes: Mapping[str, Shape],
) -> Shape | None:
    """Return a shape that Drake parsed, on its body; None for a shape without bounds.

    Args:
        inspector: The inspector of the scene graph.
        geometry: The shape.
        role: Whether the shape is drawn or collides.
        meshes: Contents of the mesh files, by their names.
    """
    # Read its kind, and the colour that the model gives it.
    shape, colour = inspector.GetShape(geometry), None
    properties = inspector.GetProperties(geometry, role)
    if properties is not None and properties.HasProperty("phong", "diffuse"):
        rgba = properties.GetProperty("phong", "diffuse")
        colour = np.array([rgba.r(), rgba.g(), rgba.b()])
    found = Shape(X_LS=inspector.GetPoseInFrame(geometry).GetAsMatrix4(), colour=colour)
    if isinstance(shape, Box | Cylinder | Capsule | Sphere):
        return replace(found, primitive=shape)

    # Other shapes become triangles: those of the file, or of the hull.
    if isinstance(shape, Mesh | Convex) and shape.source().is_path():
        mesh = meshes[shape.source().path().name]
        assert mesh.vertices is not None
        vertices = mesh.vertices * np.asarray(shape.scale3())
        colour = mesh.colour if colour is None else colour
        return replace(found, vertices=vertices, faces=mesh.faces, colour=colour)
    if isinstance(shape, Ellipsoid):
        return replace(found, **ellipsoid([shape.a(), shape.b(), shape.c()]))
    corners = hull_corners(inspector, geometry)
    return None if corners is None else _with_hull(found, corners)


def ellipsoid(axes: npt.ArrayLike) -> dict[str, Any]:
    """Return vertices and faces of an ellipsoid with half axes (3,) [m]."""
    ball = trimesh.creation.icosphere(2)
    return {"vertices": np.array(ball.vertices) * np.asarray(axes), "faces": np.array(ball.faces)}


def solid_inertia(shapes: Sequence[Shape]) -> SpatialInertia:
    """Return M_LLo_L of convex shapes of a link, solids of `DENSITY`, which may overlap."""
    total = SpatialInertia.Zero()
    for shape in shapes:
        # Flat shapes have no volume, so half a millimetre is added on all sides.
        corners = shape.corners()
        solid = Convex(np.concatenate([corners - 5e-4, corners + 5e-4]).T, "hull")
        try:
            total = added(total, CalcSpatialInertia(solid, DENSITY))
        except (RuntimeError, ValueError):  # lengths whose powers overflow
            reach = float(np.abs(corners).max())
            raise HandError(
                f"model: must be a hand in metres, got a shape that reaches {reach:.3g} m from its "
                "link and has no inertia"
            ) from None
    return total


def added(one: SpatialInertia, other: SpatialInertia) -> SpatialInertia:
    """Return the inertia of two bodies about the same point, in the same axes."""
    if one.get_mass() == 0.0:
        return other
    total = one.Shift(np.zeros(3))
    total += other
    return total


def replace_meshes(source: Source, folder: Path) -> tuple[dict[str, Shape], list[str]]:
    """Replace every mesh in the XML of a URDF or SDFormat model by a Wavefront file in a folder.

    A visual shape that cannot be read is left out; the collision shapes are drawn instead.

    Returns:
        The contents of the files by their names, and notes of what was left out.

    Raises:
        HandError: If a mesh of a collision shape cannot be read.
    """
    files: dict[str, Shape] = {}

    def convert(uri: str) -> str:
        path = source.find(uri, source.folder)
        name = f"{hashlib.sha256(str(path).encode()).hexdigest()[:16]}.obj"
        if name not in files:
            files[name] = read_mesh(path)
            # Drake must find a file, but its triangles are not used.
            few = files[name].simplified()
            assert few.vertices is not None and few.faces is not None
            text = obj_text(few.vertices, few.faces, normals=False)
            (folder / name).write_text(text, encoding="utf-8")
        return name

    notes: list[str] = []
    for link in source.root.iter("link"):
        for shape in [*link.findall("collision"), *link.findall("visual")]:
            try:
                for mesh in shape.iter("mesh"):
                    _replace(mesh, source, convert)
            except HandError as error:
                if shape.tag == "collision":
                    raise
                notes.append(f"not drawn: {str(error).removeprefix('model: ')}")
                link.remove(shape)
    return files, notes


def _replace(mesh: Element, source: Source, convert: Callable[[str], str]) -> None:
    """Change the file that a mesh element of a URDF or SDFormat model names."""
    if source.root.tag == "robot":
        mesh.set("filename", convert(mesh.get("filename", "")))
        return
    uri = mesh.find("uri")
    if uri is None or mesh.find("submesh") is not None:
        raise HandError("model: a mesh must be a whole file, got <submesh> or no <uri>")
    uri.text = convert((uri.text or "").strip())


def read_mesh(path: Path) -> Shape:
    """Return the content of a mesh file.

    Raises:
        HandError: If the file is missing or not a mesh, see `drakegrasp.mesh.loading`.
    """
    try:
        scene = load_scene(path)
    except MeshError as error:
        raise HandError(f"model: mesh {error}") from None
    # Seams of textures and shading would become gaps when faces are removed.
    mesh = trimesh.Trimesh(*join_scene(scene), process=False)
    mesh.merge_vertices()
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces)
    return Shape(vertices=vertices, faces=faces, colour=_colour(scene))


def _colour(scene: Any) -> Array | None:
    """Return the colour (3,) of the largest mesh of a scene; None if no mesh has a colour."""
    found: list[tuple[float, Array]] = []
    for mesh in scene.geometry.values():
        colour = getattr(getattr(mesh.visual, "material", None), "main_color", None)
        if colour is not None:
            found.append((float(mesh.area), np.asarray(colour, dtype=float)[:3] / 255.0))
    return np.maximum(max(found, key=lambda pair: pair[0])[1], DARKEST) if found else None
