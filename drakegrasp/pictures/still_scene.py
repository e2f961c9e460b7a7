"""A still scene: a hand, posed and drawn.

Input: a hand, and `Poses`. Output: poses of the links, and pictures. Nothing is simulated.

For the 3D view of a browser, links and objects are JSON: a list of parts, each with its `colour`
"#rrggbb", `vertices` (n, 3) as float32 [m] and `faces` (m, 3) as uint32, both little-endian in
base64. A link is in its own frame, an object in {O}.

OpenGL starts with the first picture. As in `vision.rendering`, all pictures of a process must be
rendered in one thread.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import trimesh
from pydrake.geometry import (
    Box,
    Capsule,
    ClippingRange,
    ColorRenderCamera,
    Convex,
    Cylinder,
    GeometryId,
    LightParameter,
    MakeRenderEngineVtk,
    Mesh,
    QueryObject,
    RenderCameraCore,
    RenderEngineVtkParams,
    Role,
    SceneGraphInspector,
    Sphere,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import FixedOffsetFrame, ModelInstanceIndex, RigidBody
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.sensors import CameraInfo

from drakegrasp.errors import MachineError, MeshError
from drakegrasp.frames import Array, make_pose
from drakegrasp.hand.description import Hand
from drakegrasp.hand.kinematics import joint_positions
from drakegrasp.hand.parsing import add_model
from drakegrasp.hand.shapes import hull_corners
from drakegrasp.mesh.loading import load_surface
from drakegrasp.objects.model import ObjectModel
from drakegrasp.runtime.environment import prepare_rendering
from drakegrasp.vision.camera import object_colour
from drakegrasp.vision.rendering import BLANK, GREY

#: Vertical field of view [deg]: narrow, so that perspective distorts little.
FOV_Y_DEG = 26.0
#: Pictures are rendered larger by this factor and averaged, since VTK alone leaves jagged edges.
OVERSAMPLING = 2
#: Margin around the origins of the hand's links for the links' own size [m].
MARGIN = 0.035
BACKGROUND = np.array([0.95, 0.96, 0.97])


@dataclass(frozen=True, kw_only=True, eq=False)
class Lighting:
    """The lights of a picture.

    Attributes:
        name: Unique name of the lighting, also of Drake's render engine with these lights.
        lights: Lights; in camera axes +X is right and +Y down.
    """

    name: str
    lights: Sequence[LightParameter]


@dataclass(frozen=True, kw_only=True, eq=False)
class Poses:
    """Poses of a hand.

    Attributes:
        X_WG: (4, 4), pose of the palm.
        q: (j,), positions of the hand's joints [rad or m], in the order of the dataset's files.
    """

    X_WG: Array
    q: npt.ArrayLike


class StillScene:
    """A hand in Drake. Not thread-safe.

    Args:
        hand: The hand.
        add: Function that adds more shapes to the plant, before it is finalized, and to the hand's
            model instance in it.

    Attributes:
        hand: The hand.
        joints: Names of the hand's joints, in the order of the dataset's files.
        links: Names of the hand's links.
    """

    def __init__(
        self,
        hand: Hand,
        *,
        add: Callable[[MultibodyPlant, ModelInstanceIndex], None] | None = None,
    ) -> None:
        # The hand, whose palm can be placed anywhere.
        builder = DiagramBuilder()
        plant, graph = AddMultibodyPlant(MultibodyPlantConfig(time_step=0.0), builder)
        instance, self._wrist = _add_posed_hand(plant, hand)
        if add is not None:
            add(plant, instance)
        plant.Finalize()

        # The diagram and its only context.
        self._diagram = builder.Build()
        self._root = self._diagram.CreateDefaultContext()
        self._plant, self._graph, self._instance = plant, graph, instance
        self._context = plant.GetMyMutableContextFromRoot(self._root)
        self.hand = hand
        self.joints: tuple[str, ...] = tuple(plant.GetPositionNames(instance, False, False))
        self.links = tuple(plant.get_body(i).name() for i in plant.GetBodyIndices(instance))

    def positions(self, spread: float, closing: npt.ArrayLike | None = None) -> Array:
        """Return the positions (j,) of the hand's joints [rad or m] for `Poses`.

        Args:
            spread: Angle of the spread joints [rad].
            closing: (k,), positions of the closing joints [rad or m]; the open hand if None.
        """
        closing = np.zeros(self.hand.num_fingers) if closing is None else closing
        named = joint_positions(self.hand, spread, closing)
        return np.array([named[name] for name in self.joints])

    def pose(self, poses: Poses) -> None:
        """Move the hand."""
        self._wrist.SetPoseInParentFrame(self._context, RigidTransform(poses.X_WG))
        self._plant.SetPositions(self._context, self._instance, np.asarray(poses.q, dtype=float))

    def link_pose(self, link: str) -> Array:
        """Return the pose X_WL (4, 4) of a link of the hand."""
        return self._plant.EvalBodyPoseInWorld(self._context, self._body(link)).GetAsMatrix4()

    def shapes(self, link: str) -> tuple[SceneGraphInspector, list[GeometryId]]:
        """Return the shapes that show a link: its visual shapes, or else its collision shapes.

        They are returned with the inspector that describes them. A link may have no shape.
        """
        body = self._body(link)
        shapes = self._plant.GetVisualGeometriesForBody(body)
        shapes = shapes or self._plant.GetCollisionGeometriesForBody(body)
        return self._graph.model_inspector(), list(shapes)

    def picture(
        self, X_WC: Array, size: tuple[int, int], lighting: Lighting
    ) -> npt.NDArray[np.uint8]:
        """Return the picture (height, width, 3) of a camera.

        Args:
            X_WC: (4, 4), pose of the camera.
            size: Width and height of the picture [px].
            lighting: Lights of the picture.

        Raises:
            MachineError: If the picture is blank, which means that OpenGL failed.
        """
        # Render larger, then average blocks of pixels.
        width, height = size
        camera = self._camera((OVERSAMPLING * width, OVERSAMPLING * height), lighting)
        large = self._query().RenderColorImage(camera, self._world(), RigidTransform(X_WC)).data
        if not large.any():
            raise MachineError(BLANK)
        blocks = large[:, :, :3].reshape(height, OVERSAMPLING, width, OVERSAMPLING, 3)
        return np.rint(blocks.mean(axis=(1, 3))).astype(np.uint8)

    def _body(self, link: str) -> RigidBody:
        return self._plant.GetBodyByName(link, self._instance)

    def _query(self) -> QueryObject:
        return self._plant.get_geometry_query_input_port().Eval(self._context)

    def _world(self) -> object:
        return self._plant.GetBodyFrameIdOrThrow(self._plant.world_body().index())

    def _camera(self, size: tuple[int, int], lighting: Lighting) -> ColorRenderCamera:
        """Return a camera of a size (width, height) [px], whose render engine has the lights."""
        # Engines are added when needed: a scene that is not drawn does not start OpenGL.
        context = self._graph.GetMyMutableContextFromRoot(self._root)
        if not self._graph.HasRenderer(context, lighting.name):
            prepare_rendering()
            parameters = RenderEngineVtkParams(
                default_clear_color=BACKGROUND,
                default_diffuse=GREY,
                lights=list(lighting.lights),
            )
            self._graph.AddRenderer(context, lighting.name, MakeRenderEngineVtk(parameters))
        info = CameraInfo(*size, np.deg2rad(FOV_Y_DEG))
        core = RenderCameraCore(lighting.name, info, ClippingRange(0.05, 20.0), RigidTransform())
        return ColorRenderCamera(core, False)


def _add_posed_hand(
    plant: MultibodyPlant, hand: Hand
) -> tuple[ModelInstanceIndex, FixedOffsetFrame]:
    """Add a hand whose palm can be placed anywhere without a joint.

    The palm is welded to a frame whose pose is a parameter of the context.

    Args:
        plant: Not finalized; its shapes are drawn.
        hand: The hand. Its model may contain links of any name: our names must differ from them.

    Returns:
        The plant's model of the hand, and that frame in the world.
    """
    instance = add_model(plant, hand.model)
    base = plant.GetBodyByName(hand.palm_link, instance)
    X_BG = RigidTransform(hand.X_BG)
    palm = plant.AddFrame(FixedOffsetFrame("drakegrasp_palm", base.body_frame(), X_BG, instance))
    wrist = plant.AddFrame(FixedOffsetFrame("wrist", plant.world_frame(), RigidTransform()))
    plant.WeldFrames(wrist, palm)
    return instance, wrist


def camera_pose(p_WA: Array, azimuth: float, elevation: float, *, fill: float = 1.0) -> Array:
    """Return the pose X_WC (4, 4) of a camera that looks at the centre of points.

    Args:
        p_WA: (n, 3), points that must be in the picture [m].
        azimuth: Direction of the camera about the vertical, from +x of {W} [rad].
        elevation: Angle of the camera above the horizontal [rad].
        fill: Factor by which the camera's distance is divided; above 1 the points fill more of the
            picture.
    """
    # The distance is large enough for a sphere around the points to fit into the field of view.
    middle = (p_WA.min(axis=0) + p_WA.max(axis=0)) / 2.0
    radius = np.linalg.norm(p_WA - middle, axis=1).max() + MARGIN
    distance = radius / np.sin(np.deg2rad(FOV_Y_DEG) / 2.0) / fill

    # The camera's axes: +Z towards the points, +X horizontal to the right, +Y down.
    z = -np.array(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ]
    )
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    return make_pose(np.column_stack([x, np.cross(z, x), z]), middle - distance * z)


def object_json(model: ObjectModel) -> bytes:
    """Return the visual mesh of an object, as JSON."""
    colour = object_colour(model.name)
    return json.dumps([_part(model.visual_vertices, model.visual_faces, colour)]).encode()


def link_surfaces(scene: StillScene) -> dict[str, bytes]:
    """Return the surface of each link of a hand that has a shape as JSON, by the link's name.

    A link without visual shapes is shown by its collision shapes.
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
            surfaces[link] = json.dumps(parts).encode()
    return surfaces


def _part(vertices: npt.ArrayLike, faces: npt.ArrayLike, colour: npt.ArrayLike) -> dict[str, str]:
    """Return a part with one colour (3,): red, green and blue in 0..1."""
    levels = np.rint(255.0 * np.asarray(colour)).astype(np.uint8)
    return {
        "colour": f"#{levels.tobytes().hex()}",
        "vertices": base64.b64encode(np.asarray(vertices, dtype="<f4").tobytes()).decode(),
        "faces": base64.b64encode(np.asarray(faces, dtype="<u4").tobytes()).decode(),
    }


def _colour(inspector: SceneGraphInspector, geometry: GeometryId) -> Array:
    """Return the colour (3,) of a shape in the model, or grey if it has none."""
    properties = inspector.GetProperties(geometry, Role.kIllustration)
    if properties is None or not properties.HasProperty("phong", "diffuse"):
        return GREY[:3]
    rgba = properties.GetProperty("phong", "diffuse")
    return np.array([rgba.r(), rgba.g(), rgba.b()])


def _mesh(inspector: SceneGraphInspector, geometry: GeometryId) -> Any:
    """Return a shape as a mesh in its own frame; None if it cannot be drawn."""
    # All of Drake's shapes are centred, with their axis along z.
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
    """Return the mesh of a file; its convex hull if the file cannot be read."""
    source = shape.source()
    path = Path(str(source.path())) if source.is_path() else None
    if path is not None and path.is_file():
        try:
            mesh = trimesh.Trimesh(*load_surface(path), process=False)
            return mesh.apply_scale(shape.scale3())
        except MeshError:
            pass
    return trimesh.convex.convex_hull(hull_corners(inspector, geometry))
