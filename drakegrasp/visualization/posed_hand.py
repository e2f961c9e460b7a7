"""A hand's links as meshes, and where they are at given joint positions; nothing is simulated.

In: a `Hand`. Out: a binary glTF file (GLB) per link with what its SDFormat shows of it, and poses
of the links. A link without a visual shape is shown by its collision shapes.
"""

from __future__ import annotations

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
    Rgba,
    Role,
    SceneGraph,
    SceneGraphInspector,
    Sphere,
)
from pydrake.multibody.plant import MultibodyPlant

from drakegrasp.arithmetic import multiply
from drakegrasp.frames import Array, invert_pose
from drakegrasp.hand.description import Hand
from drakegrasp.hand.kinematics import joint_positions
from drakegrasp.hand.parsing import add_model
from drakegrasp.hand.shapes import hull_corners
from drakegrasp.objects.model import ObjectModel, object_colour

#: Colour of a link whose model names none.
GREY = (0.62, 0.63, 0.65, 1.0)


class PosedHand:
    """A hand in Drake, with its base in the world's origin. Not for several threads at once.

    Args:
        hand: The hand.
    """

    def __init__(self, hand: Hand) -> None:
        # The scene graph must outlive the plant's inspector.
        self._hand, self._scene_graph = hand, SceneGraph()
        self._plant = MultibodyPlant(0.0)
        self._plant.RegisterAsSourceForSceneGraph(self._scene_graph)
        self._instance = add_model(self._plant, hand.model)
        self._base = self._plant.GetBodyByName(hand.palm_link, self._instance)
        self._plant.WeldFrames(self._plant.world_frame(), self._base.body_frame())
        self._plant.Finalize()
        self._context = self._plant.CreateDefaultContext()

    @property
    def links(self) -> tuple[str, ...]:
        """Names of the links that have a shape."""
        return tuple(body.name() for body in self._bodies() if self._geometries(body))

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints in the order of the dataset's files."""
        names = self._plant.GetPositionNames(
            self._instance, add_model_instance_prefix=False, always_add_suffix=False
        )
        return tuple(names)

    def open_positions(self, spread: float) -> Array:
        """Return the joint positions (j,) [rad or m] of the open hand at a spread [rad]."""
        named = joint_positions(self._hand, spread, np.zeros(self._hand.num_fingers))
        return np.array([named[name] for name in self.joints])

    def link_poses(self, X_AG: npt.ArrayLike, q: npt.ArrayLike) -> dict[str, Array]:
        """Return the poses X_AL (4, 4) of the links, by name.

        Args:
            X_AG: (4, 4), pose of the palm.
            q: (j,), positions of the joints in the order of the dataset's files [rad or m].
        """
        self._plant.SetPositions(self._context, self._instance, np.asarray(q, dtype=float))
        X_AB = multiply(X_AG, invert_pose(self._hand.X_BG))
        return {
            body.name(): multiply(
                X_AB, self._plant.EvalBodyPoseInWorld(self._context, body).GetAsMatrix4()
            )
            for body in self._bodies()
            if self._geometries(body)
        }

    def link_glb(self, link: str) -> bytes:
        """Return a link as a GLB file, in the link's frame [m].

        Raises:
            KeyError: If there is no link of that name with a shape.
        """
        if link not in self.links:
            raise KeyError(link)
        body = self._plant.GetBodyByName(link, self._instance)
        inspector = self._scene_graph.model_inspector()
        meshes = [_mesh(inspector, geometry) for geometry in self._geometries(body)]
        return _glb([mesh for mesh in meshes if mesh is not None])

    def _bodies(self) -> list[Any]:
        return [self._plant.get_body(i) for i in self._plant.GetBodyIndices(self._instance)]

    def _geometries(self, body: Any) -> list[GeometryId]:
        """Return the shapes that show a link: visual ones, else those of collisions."""
        visual = self._plant.GetVisualGeometriesForBody(body)
        return list(visual or self._plant.GetCollisionGeometriesForBody(body))


def object_glb(model: ObjectModel) -> bytes:
    """Return an object's visual mesh as a GLB file, in {O} [m]."""
    mesh = trimesh.Trimesh(model.visual_vertices, model.visual_faces, process=False)
    return _glb([_painted(mesh, (*object_colour(model.name), 1.0))])


def _mesh(inspector: SceneGraphInspector, geometry: GeometryId) -> trimesh.Trimesh | None:
    """Return a shape as a mesh in its link's frame; None for what cannot be drawn."""
    # The shape in its own frame; all of Drake's are centred, along z.
    shape = inspector.GetShape(geometry)
    mesh: Any
    if isinstance(shape, Box):
        mesh = trimesh.creation.box(shape.size())
    elif isinstance(shape, Cylinder):
        mesh = trimesh.creation.cylinder(shape.radius(), shape.length(), sections=32)
    elif isinstance(shape, Capsule):
        mesh = trimesh.creation.capsule(shape.length(), shape.radius(), count=(16, 24))
        mesh.apply_translation(-mesh.bounds.mean(axis=0))
    elif isinstance(shape, Sphere):
        mesh = trimesh.creation.icosphere(3, shape.radius())
    elif isinstance(shape, Mesh | Convex):
        mesh = _file_mesh(inspector, geometry, shape)
    else:
        return None

    mesh.apply_transform(inspector.GetPoseInFrame(geometry).GetAsMatrix4())
    properties = inspector.GetProperties(geometry, Role.kIllustration)
    colour = GREY
    if properties is not None and properties.HasProperty("phong", "diffuse"):
        rgba: Rgba = properties.GetProperty("phong", "diffuse")
        colour = (rgba.r(), rgba.g(), rgba.b(), rgba.a())
    return _painted(mesh, colour)


def _file_mesh(inspector: SceneGraphInspector, geometry: GeometryId, shape: Any) -> Any:
    """Return the mesh of a file; its convex hull where trimesh cannot read the file."""
    source = shape.source()
    path = Path(str(source.path())) if source.is_path() else None
    if path is not None and path.is_file():
        try:
            mesh = trimesh.load_mesh(path, process=False)
            mesh.apply_scale(shape.scale3() if hasattr(shape, "scale3") else shape.scale())
            return mesh
        except (ValueError, NotImplementedError, ImportError):
            pass
    corners = hull_corners(inspector, geometry)
    return trimesh.convex.convex_hull(corners)


def _painted(mesh: Any, colour: tuple[float, float, float, float]) -> Any:
    """Return a mesh of one colour, sRGB and opacity, 0 to 1."""
    # glTF wants linear light; 2.2 is close to sRGB's curve.
    linear = np.append(np.array(colour[:3]) ** 2.2, colour[3])
    material = trimesh.visual.material.PBRMaterial(
        baseColorFactor=linear, metallicFactor=0.0, roughnessFactor=0.75
    )
    visual = trimesh.visual.TextureVisuals(material=material)
    return trimesh.Trimesh(mesh.vertices, mesh.faces, visual=visual, process=False)


def _glb(meshes: list[Any]) -> bytes:
    """Return meshes as a GLB file."""
    content = trimesh.Scene(meshes).export(file_type="glb")
    return bytes(content)
