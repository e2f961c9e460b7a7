"""Rendering: RGB, depth and mask of the resting object from a camera pose.

Input: an object, its resting pose and a camera pose. Output: images of object and table. The
renderer has its own diagram, without physics, and its images show no hand.

A renderer must be built and used in one thread. Drake's first rendering thread owns the OpenGL
context, and any other thread silently gets a blank image. A blank image is an error here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
import numpy.typing as npt
from pydrake.common import MemoryFile
from pydrake.geometry import (
    Box,
    ClippingRange,
    ColorRenderCamera,
    DepthRange,
    DepthRenderCamera,
    InMemoryMesh,
    LightParameter,
    MakeRenderEngineVtk,
    Mesh,
    PerceptionProperties,
    RenderCameraCore,
    RenderEngineVtkParams,
    Rgba,
    Role,
    SceneGraph,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import RigidBody, SpatialInertia
from pydrake.systems.framework import Context, Diagram, DiagramBuilder
from pydrake.systems.sensors import CameraInfo

from drakegrasp.arithmetic import Array, multiply
from drakegrasp.config import CameraConfig
from drakegrasp.errors import BlankImageError
from drakegrasp.frames import X_WT, invert_pose, make_pose, transform_points
from drakegrasp.hand.file_format import MODELS
from drakegrasp.hand.parsing import make_parser
from drakegrasp.mesh.surfaces import convex_hull, obj_text
from drakegrasp.objects.model import ObjectModel
from drakegrasp.objects.surroundings import Hull, Neighbourhood
from drakegrasp.runtime.environment import prepare_rendering
from drakegrasp.vision.camera import Appearance, Lens, object_colour, unproject, usual_appearance

#: Colour of pixels beyond the table.
BACKGROUND = np.array([0.86, 0.90, 0.94])
#: Colour of links whose model specifies none; Drake's own default is the colour of an object.
GREY = np.array([0.70, 0.71, 0.73, 1.0])
#: Colour of walls, R, G, B and opacity.
WALL_COLOUR = np.array([0.62, 0.64, 0.68, 1.0])
#: Intensity of the light at the camera, which never changes.
CAMERA_LIGHT = 0.6
#: Message of the error about a blank image.
BLANK = (
    "the rendered image must not be blank, got all zeros: OpenGL works in one thread of a "
    "process only, and needs EGL (run `drakegrasp doctor`)"
)
#: A pixel's depth is corrected by at most this, if it is on a face continued beyond its edge [m].
FARTHEST = 0.03
#: Distance below the table at which an object is out of sight [m].
FAR_BELOW = 50.0
#: Name of the render engine in a diagram.
ENGINE = "vtk"


@dataclass(frozen=True, kw_only=True, eq=False)
class RenderedView:
    """The images of one camera as the engine returns them.

    Attributes:
        rgb: (H, W, 3) uint8.
        depth: (H, W) float32 [m]; 0 where something is too near, inf where everything is too far.
        mask: (H, W) uint8, 1 on the object, 2 on its first neighbour and so on, 0 elsewhere.
        lens: The camera.
    """

    rgb: npt.NDArray[np.uint8]
    depth: npt.NDArray[np.float32]
    mask: npt.NDArray[np.uint8]
    lens: Lens

    @cached_property
    def image(self) -> npt.NDArray[np.float32]:
        """The image for data files, (4, H, W): R, G, B in 0..1 and depth [m] within near..far."""
        image = np.empty_like(self.rgb, shape=(4, *self.mask.shape), dtype=np.float32)
        image[:3] = np.moveaxis(self.rgb, 2, 0) / np.float32(255.0)
        image[3] = np.clip(self.depth, self.lens.near, self.lens.far)
        return image


@dataclass(kw_only=True, eq=False)
class Renderer:
    """A diagram that renders one object, what is around it, and the table.

    Attributes:
        diagram, context: The diagram with its one context.
        plant, scene_graph: The two systems of the diagram.
        object, table: The bodies.
        neighbours: Bodies of the n neighbours.
        half_extents: Half extents of the boxes of object and neighbours, (1 + n, 3) [m].
        config: The camera.
        appearance: Colours of object and table, and the light; `paint` changes it.
    """

    diagram: Diagram
    context: Context
    plant: MultibodyPlant
    scene_graph: SceneGraph
    object: RigidBody
    table: RigidBody
    neighbours: tuple[RigidBody, ...]
    half_extents: Array
    config: CameraConfig
    appearance: Appearance


def build_renderer(
    model: ObjectModel, config: CameraConfig, around: Neighbourhood | None = None
) -> Renderer:
    """Return a renderer of an object's full mesh on the table, with what is around it."""
    prepare_rendering()

    # The object, and the table of the simulation.
    builder, appearance = DiagramBuilder(), usual_appearance(model.name)
    plant, scene_graph = AddMultibodyPlant(MultibodyPlantConfig(time_step=0.0), builder)
    scene_graph.AddRenderer(ENGINE, MakeRenderEngineVtk(_engine_parameters(appearance)))
    body = add_drawn_object(plant, model)
    models = () if around is None else around.models
    names = [f"neighbour_{i}" for i in range(len(models))]
    neighbours = tuple(map(partial(add_drawn_object, plant), models, names))
    (instance,) = make_parser(plant).AddModels(MODELS / "table.urdf")
    table = plant.GetBodyByName("table", instance)
    plant.WeldFrames(plant.world_frame(), table.body_frame(), RigidTransform(X_WT))
    for i, wall in enumerate(() if around is None else around.walls):
        X_WB = RigidTransform(multiply(X_WT, wall.X_TB))
        shape = _drawn_hull(wall) if isinstance(wall, Hull) else Box(*wall.size)
        plant.RegisterVisualGeometry(plant.world_body(), X_WB, shape, f"wall_{i}", WALL_COLOUR)
    plant.Finalize()
    diagram = builder.Build()
    return Renderer(
        diagram=diagram,
        context=diagram.CreateDefaultContext(),
        plant=plant,
        scene_graph=scene_graph,
        object=body,
        table=table,
        neighbours=neighbours,
        half_extents=np.array([each.half_extents for each in (model, *models)]),
        config=config,
        appearance=appearance,
    )


def paint(renderer: Renderer, appearance: Appearance) -> None:
    """Give a renderer the colours and the light of an attempt; does nothing if it already has them.

    The lights of a render engine are fixed, so this creates a new engine, which takes as long as
    about ten images.
    """
    now = vars(renderer.appearance).items()
    if all(np.array_equal(value, getattr(appearance, name)) for name, value in now):
        return

    # An engine takes over the colours when it is added.
    graph = renderer.scene_graph
    context = graph.GetMyMutableContextFromRoot(renderer.context)
    graph.RemoveRenderer(context, ENGINE)
    _set_colour(renderer, renderer.object, appearance.object_colour)
    _set_colour(renderer, renderer.table, appearance.table_colour)
    graph.AddRenderer(context, ENGINE, MakeRenderEngineVtk(_engine_parameters(appearance)))
    renderer.appearance = appearance


def _engine_parameters(appearance: Appearance) -> RenderEngineVtkParams:
    """Return background and lights: one at the camera, one from above."""
    at_camera = LightParameter(
        type="directional", frame="camera", direction=[0.0, 0.0, 1.0], intensity=CAMERA_LIGHT
    )
    above = LightParameter(
        type="directional",
        frame="world",
        direction=appearance.light_direction,
        intensity=appearance.light_strength,
    )
    return RenderEngineVtkParams(
        default_clear_color=BACKGROUND, default_diffuse=GREY, lights=[at_camera, above]
    )


def _set_colour(renderer: Renderer, body: RigidBody, colour: Array) -> None:
    """Set the colour (3,) of all shapes of a body."""
    plant, graph = renderer.plant, renderer.scene_graph
    context, source = graph.GetMyMutableContextFromRoot(renderer.context), plant.get_source_id()
    inspector = plant.EvalSceneGraphInspector(plant.GetMyContextFromRoot(renderer.context))
    for geometry in plant.GetVisualGeometriesForBody(body):
        # Drake cannot replace properties of this role, so remove the role and assign it again.
        properties = PerceptionProperties(inspector.GetPerceptionProperties(geometry))
        properties.UpdateProperty("phong", "diffuse", Rgba(*colour))
        graph.RemoveRole(context, source, geometry, Role.kPerception)
        graph.AssignRole(context, source, geometry, properties)


def add_drawn_object(plant: MultibodyPlant, model: ObjectModel, name: str = "object") -> RigidBody:
    """Add an object's full mesh to a plant for drawing, and return its body.

    Args:
        plant: A plant that is drawn and not simulated; not finalized.
        model: The object.
        name: Name of the body.
    """
    # The mass properties are arbitrary, because nothing moves by itself.
    body = plant.AddRigidBody(name, SpatialInertia.SolidSphereWithMass(1.0, 1.0))
    mesh = drawn_mesh(model.visual_vertices, model.visual_faces, model.name)
    colour = np.array([*object_colour(model.name), 1.0])
    plant.RegisterVisualGeometry(body, RigidTransform(), mesh, "surface", colour)
    return body


def drawn_mesh(vertices: npt.ArrayLike, faces: npt.ArrayLike, name: str) -> Mesh:
    """Return vertices (n, 3) [m] and faces (m, 3) as a named shape with smooth shading."""
    text = obj_text(vertices, faces, normals=True)
    return Mesh(InMemoryMesh(mesh_file=MemoryFile(text, ".obj", name)))


def _drawn_hull(hull: Hull) -> Mesh:
    solid = convex_hull(hull.vertices)
    return drawn_mesh(solid.vertices, solid.faces, "hull")


def render(
    renderer: Renderer,
    X_TO: npt.ArrayLike,
    X_TC: npt.ArrayLike,
    lens: Lens | None = None,
    X_TN: Sequence[Array] | Array = (),
) -> RenderedView:
    """Return the images of an object at X_TO (4, 4) from a camera at X_TC (4, 4).

    Args:
        renderer: Renderer from `build_renderer`.
        X_TO: Pose of the object (4, 4).
        X_TC: Pose of the camera (4, 4).
        lens: Lens of the camera; None for the lens of the renderer's configuration.
        X_TN: Poses of the neighbours, (n, 4, 4).

    Raises:
        BlankImageError: If the image is blank, which means that OpenGL failed.
    """
    lens, poses = lens or Lens.of(renderer.config), [np.asarray(X_TO), *X_TN]
    query, world, X_WC = _query(renderer, poses, X_TC)
    core, K = _core(lens), lens.K
    depth_camera = DepthRenderCamera(core, DepthRange(lens.near, lens.far))
    colour_camera = ColorRenderCamera(core, False)

    # Render depth, labels and colour.
    depth = query.RenderDepthImage(depth_camera, world, X_WC).data[:, :, 0]
    labels = query.RenderLabelImage(colour_camera, world, X_WC).data[:, :, 0]
    rgb = query.RenderColorImage(colour_camera, world, X_WC).data[:, :, :3]
    if not rgb.any() or not depth.any():
        raise BlankImageError(BLANK)
    mask = np.zeros(labels.shape, dtype=np.uint8)
    bodies = (renderer.object, *renderer.neighbours)
    for number, (body, pose) in enumerate(zip(bodies, poses, strict=True), start=1):
        own = labels == int(body.index())
        mask[own] = number
        X_OC = multiply(invert_pose(pose), X_TC)
        depth = depth_in_box(depth, own, K, X_OC, renderer.half_extents[number - 1])
    return RenderedView(rgb=rgb, depth=depth, mask=mask, lens=lens)


def outline_sizes(
    renderer: Renderer, X_TN: Array, X_TC: npt.ArrayLike, lens: Lens
) -> npt.NDArray[np.int64]:
    """Return how many pixels each of n objects covers if it is alone on the table, (n,).

    Args:
        renderer: Renderer of the object and its neighbours, without walls.
        X_TN: Poses of the object and its neighbours, (n, 4, 4).
        X_TC: Pose of the camera (4, 4).
        lens: Lens of the camera.
    """
    # Objects below the table's slab are not in the image.
    away, sizes = make_pose(np.eye(3), [0.0, 0.0, -FAR_BELOW]), []
    camera = ColorRenderCamera(_core(lens), False)
    bodies = (renderer.object, *renderer.neighbours)
    for i, (body, X) in enumerate(zip(bodies, X_TN, strict=True)):
        poses = [np.asarray(X) if j == i else away for j in range(len(bodies))]
        query, world, X_WC = _query(renderer, poses, X_TC)
        labels = query.RenderLabelImage(camera, world, X_WC).data[:, :, 0]
        sizes.append(int((labels == int(body.index())).sum()))
    return np.array(sizes)


def _query(
    renderer: Renderer, poses: Sequence[Array], X_TC: npt.ArrayLike
) -> tuple[Any, Any, RigidTransform]:
    """Place object and neighbours; return what renders, the world's frame and the camera's pose."""
    plant, bodies = renderer.plant, (renderer.object, *renderer.neighbours)
    context = plant.GetMyMutableContextFromRoot(renderer.context)
    for body, pose in zip(bodies, poses, strict=True):
        plant.SetFreeBodyPose(context, body, RigidTransform(multiply(X_WT, pose)))
    query = plant.get_geometry_query_input_port().Eval(context)
    world = plant.GetBodyFrameIdOrThrow(plant.world_body().index())
    return query, world, RigidTransform(multiply(X_WT, X_TC))


def _core(lens: Lens) -> RenderCameraCore:
    K = lens.K
    return RenderCameraCore(
        ENGINE,
        # The engine measures the principal point from the corner of pixel (0, 0), not its centre.
        CameraInfo(lens.width, lens.height, K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5),
        ClippingRange(lens.near, lens.far),
        RigidTransform(),
    )


def depth_in_box(
    depth: npt.NDArray[np.float32],
    mask: npt.NDArray[Any],
    K: Array,
    X_OC: Array,
    half_extents: Array,
) -> npt.NDArray[np.float32]:
    """Return a depth image (H, W) [m] whose object points are in the object's box, if possible.

    A face that is seen almost edge-on can give a pixel at its edge the depth of the face's plane
    beyond the edge, up to centimetres away. Such a point is moved along its ray to where the ray
    enters or leaves the box. It is not moved if the ray misses the box, which happens by a fraction
    of a pixel, or if it would move by more than `FARTHEST`: that is another fault, which `check`
    reports.

    Args:
        depth: (H, W) [m], 0 where something is too near, inf where everything is too far.
        mask: (H, W), 1 on the object.
        K: Camera matrix (3, 3) [px].
        X_OC: Pose of the camera (4, 4).
        half_extents: Half extents of the box, (3,) [m].
    """
    v, u = np.nonzero((mask == 1) & (depth > 0.0) & np.isfinite(depth))
    z = depth[v, u]
    p_OQ = transform_points(X_OC, unproject(K, np.column_stack([u, v]), z))
    # Float32 depths have errors of less than 1e-6 m.
    outside = np.flatnonzero((np.abs(p_OQ) > half_extents + 1e-6).any(axis=1))
    if not len(outside):
        return depth

    # Depths at which the rays cross the box's six planes.
    u, v, z = u[outside], v[outside], z[outside]
    along = (p_OQ[outside] - X_OC[:3, 3]) / z[:, None]
    along = np.where(np.abs(along) < 1e-12, 1e-12, along)
    walls = np.stack([-1.0, 1.0])[:, None, None] * half_extents
    cuts = (walls - X_OC[:3, 3]) / along
    enters, leaves = cuts.min(axis=0).max(axis=1), cuts.max(axis=0).min(axis=1)
    found = depth.copy()
    moved = np.clip(z, enters, leaves)
    good = (enters <= leaves) & (leaves > 0.0) & (np.abs(moved - z) <= FARTHEST)
    found[v, u] = np.where(good, moved, z)
    return found
