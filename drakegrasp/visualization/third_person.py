"""Third-person pictures of an object, a hand and a table; nothing is simulated.

In: an object's model, a hand, and a `Snapshot` of their poses. Out: pictures with their
cameras, so that frames and contacts can be drawn over them. `choose_view` tries a ring of
viewpoints and takes the one whose least visible fingertip covers the most pixels.

As in `vision.rendering`, a scene must be made and used in one thread.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from pydrake.geometry import (
    Box,
    ClippingRange,
    ColorRenderCamera,
    FrameId,
    LightParameter,
    QueryObject,
    RenderCameraCore,
    RenderEngineVtkParams,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import FixedOffsetFrame, ModelInstanceIndex, RigidBody
from pydrake.systems.framework import Context, Diagram, DiagramBuilder
from pydrake.systems.sensors import CameraInfo

from drakegrasp.errors import MachineError
from drakegrasp.frames import X_WT, Array, make_pose, transform_points
from drakegrasp.hand.description import Hand
from drakegrasp.hand.parsing import add_model
from drakegrasp.objects.model import ObjectModel
from drakegrasp.vision.camera import Picture
from drakegrasp.vision.rendering import BLANK, ENGINE, add_drawn_object

#: Vertical field of view [deg]: narrow, so that perspective distorts little.
FOV_Y_DEG = 26.0
#: Viewpoints that `choose_view` tries: azimuths, and elevations above the horizontal [deg].
AZIMUTHS_DEG, ELEVATIONS_DEG = range(0, 360, 20), (19.0, 28.0)
#: Edge of the label images by which viewpoints are compared [px].
TRIAL_SIZE = 120
#: Pictures are rendered this many times larger and averaged: VTK alone leaves jagged edges.
OVERSAMPLING = 2
#: Space around the origins of the hand's links that the hand fills [m].
MARGIN = 0.035
BACKGROUND = np.array([0.95, 0.96, 0.97])
TABLE_COLOUR = np.array([0.74, 0.70, 0.64, 1.0])
TABLE_SIZE, TABLE_THICKNESS = 1.6, 0.1
#: Edge of the shadow map [px].
SHADOW_MAP = 4096
#: Lights for pictures of hand and object together. Camera axes: +X right, +Y down. In VTK spot
#: lights cast shadows, point lights do not.
LIGHTS = (
    LightParameter(type="point", frame="camera", position=[0.3, -0.3, -0.5], intensity=0.5),
    LightParameter(type="point", frame="world", position=[0.0, 0.0, 4.0], intensity=0.25),
    LightParameter(
        type="spot",
        frame="camera",
        position=[-1.0, -1.3, 0.2],
        direction=[1.0, 1.3, 1.0],
        intensity=0.7,
        cone_angle=26.0,
    ),
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Snapshot:
    """Poses of hand and object at one instant.

    Attributes:
        X_WG: (4, 4), pose of the palm.
        X_WO: (4, 4), pose of the object.
        q: (n,), positions of the hand's joints [rad or m], in the order of
            `RenderScene.joint_names`.
    """

    X_WG: Array
    X_WO: Array
    q: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class RenderScene:
    """A diagram of object, hand and table that is rendered, never simulated.

    Attributes:
        diagram: The diagram.
        context: Its context, with the poses of the last `Snapshot`.
        plant: The bodies.
        object: The object's body.
        hand: Description of the hand.
        hand_instance: The hand in the plant.
        wrist: Frame that the palm is welded to; its pose is a parameter of the context.
    """

    diagram: Diagram
    context: Context
    plant: MultibodyPlant
    object: RigidBody
    hand: Hand
    hand_instance: ModelInstanceIndex
    wrist: FixedOffsetFrame

    @property
    def joint_names(self) -> list[str]:
        """Names of the hand's joints, in the order of `Snapshot.q`."""
        names = self.plant.GetPositionNames(
            self.hand_instance, add_model_instance_prefix=False, always_add_suffix=False
        )
        return list(names)

    def pose(self, link: str) -> Array:
        """Return the current pose X_WL (4, 4) of a link of the hand."""
        body = self.plant.GetBodyByName(link, self.hand_instance)
        context = self.plant.GetMyContextFromRoot(self.context)
        return self.plant.EvalBodyPoseInWorld(context, body).GetAsMatrix4()


def build_render_scene(
    model: ObjectModel,
    hand: Hand,
    *,
    table_size: float = TABLE_SIZE,
    lights: Sequence[LightParameter] = LIGHTS,
) -> RenderScene:
    """Return a diagram of an object, a hand and a square table.

    Args:
        model: The object.
        hand: The hand.
        table_size: Edge of the table [m].
        lights: What lights it.
    """
    # The object, rendered by VTK.
    builder = DiagramBuilder()
    parameters = RenderEngineVtkParams(
        default_clear_color=BACKGROUND,
        lights=list(lights),
        cast_shadows=True,
        shadow_map_size=SHADOW_MAP,
    )
    plant, body = add_drawn_object(builder, model, parameters)

    # The table, with its top at {T}.
    X_WB = RigidTransform(X_WT @ make_pose(np.eye(3), [0.0, 0.0, -TABLE_THICKNESS / 2.0]))
    slab = Box(table_size, table_size, TABLE_THICKNESS)
    plant.RegisterVisualGeometry(plant.world_body(), X_WB, slab, "table", TABLE_COLOUR)

    # The hand, welded by its palm to a frame whose pose is a parameter of the context: the palm
    # can be put anywhere without a joint.
    instance = add_model(plant, hand.model)
    base = plant.GetBodyByName(hand.palm_link, instance)
    # Links of any name may be in the hand's model: ours must not be one of them.
    palm = plant.AddFrame(
        FixedOffsetFrame("drakegrasp_palm", base.body_frame(), RigidTransform(hand.X_BG), instance)
    )
    wrist = plant.AddFrame(FixedOffsetFrame("wrist", plant.world_frame(), RigidTransform()))
    plant.WeldFrames(wrist, palm)
    plant.Finalize()

    diagram = builder.Build()
    return RenderScene(
        diagram=diagram,
        context=diagram.CreateDefaultContext(),
        plant=plant,
        object=body,
        hand=hand,
        hand_instance=instance,
        wrist=wrist,
    )


def set_snapshot(scene: RenderScene, snapshot: Snapshot) -> None:
    """Move hand and object to the poses of a snapshot."""
    plant = scene.plant
    context = plant.GetMyMutableContextFromRoot(scene.context)
    plant.SetFreeBodyPose(context, scene.object, RigidTransform(snapshot.X_WO))
    scene.wrist.SetPoseInParentFrame(context, RigidTransform(snapshot.X_WG))
    plant.SetPositions(context, scene.hand_instance, snapshot.q)


def render_view(scene: RenderScene, X_WC: Array, size: tuple[int, int]) -> Picture:
    """Return the picture of a camera.

    Args:
        scene: In the poses of `set_snapshot`.
        X_WC: (4, 4), pose of the camera.
        size: Width and height of the picture [px].

    Raises:
        MachineError: If the picture is blank, which means that OpenGL failed.
    """
    # Render larger, then average blocks of pixels.
    query, camera, world = _camera(scene, (OVERSAMPLING * size[0], OVERSAMPLING * size[1]))
    large = query.RenderColorImage(camera, world, RigidTransform(X_WC)).data[:, :, :3]
    if not large.any():
        raise MachineError(BLANK)
    blocks = large.reshape(size[1], OVERSAMPLING, size[0], OVERSAMPLING, 3)
    image = np.rint(blocks.mean(axis=(1, 3))).astype(np.uint8)

    # The camera matrix of the averaged picture.
    focal = size[1] / (2.0 * np.tan(np.deg2rad(FOV_Y_DEG) / 2.0))
    K = np.array([[focal, 0.0, (size[0] - 1) / 2], [0.0, focal, (size[1] - 1) / 2], [0, 0, 1.0]])
    return Picture(image=image, K=K, X_WC=X_WC)


def render_labels(scene: RenderScene, X_WC: Array, size: tuple[int, int]) -> npt.NDArray[np.int16]:
    """Return the index of the body that each pixel shows, (height, width).

    Args:
        scene: In the poses of `set_snapshot`.
        X_WC: (4, 4), pose of the camera.
        size: Width and height of the image [px].
    """
    query, camera, world = _camera(scene, size)
    return query.RenderLabelImage(camera, world, RigidTransform(X_WC)).data[:, :, 0].copy()


def choose_view(
    scene: RenderScene, p_WA: Array, *, fill: float = 1.0, azimuths: Array | None = None
) -> Array:
    """Return the pose X_WC (4, 4) of a camera that sees given points and all fingertips.

    Args:
        scene: In the poses of `set_snapshot`.
        p_WA: (n, 3), points that must be in the picture [m].
        fill: The camera's distance is divided by it; above 1 the points fill more of the picture.
        azimuths: Those to try [rad]; all around if None.
    """
    azimuths = np.deg2rad(AZIMUTHS_DEG) if azimuths is None else azimuths
    tips = [
        int(scene.plant.GetBodyByName(name, scene.hand_instance).index())
        for name in scene.hand.fingertip_links
    ]

    # The best view is the one whose least visible fingertip covers the most pixels; among equals
    # the one with the most pixels of fingertips and object.
    best, most = np.eye(4), (-1, -1)
    for elevation in np.deg2rad(ELEVATIONS_DEG):
        for azimuth in azimuths:
            X_WC = camera_pose(p_WA, azimuth, elevation, fill=fill)
            seen = render_labels(scene, X_WC, (TRIAL_SIZE, TRIAL_SIZE))
            counts = [int(np.sum(seen == tip)) for tip in tips]
            score = min(counts), sum(counts) + int(np.sum(seen == int(scene.object.index())))
            if score > most:
                best, most = X_WC, score
    return best


def camera_pose(p_WA: Array, azimuth: float, elevation: float, *, fill: float = 1.0) -> Array:
    """Return the pose X_WC (4, 4) of a camera that looks at the middle of points.

    Args:
        p_WA: (n, 3), points that must be in the picture [m].
        azimuth: Direction of the camera about the vertical, from +x of {W} [rad].
        elevation: Height of the camera above the horizontal [rad].
        fill: The camera's distance is divided by it; above 1 the points fill more of the picture.
    """
    # Far enough away for a ball around the points to fit into the field of view.
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


def outline_points(scene: RenderScene, snapshot: Snapshot, half_extents: Array) -> Array:
    """Move the scene to a snapshot and return the points that a picture of it must contain.

    Args:
        scene: Of the hand and the object.
        snapshot: The poses.
        half_extents: (3,), of the object's bounding box [m].

    Returns:
        (n, 3) in {W}: the origins of the hand's links and the corners of the object's box [m].
    """
    set_snapshot(scene, snapshot)
    plant = scene.plant
    links = [plant.get_body(i).name() for i in plant.GetBodyIndices(scene.hand_instance)]
    corners = half_extents * np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T
    return np.vstack(
        [
            transform_points(snapshot.X_WO, corners),
            *(scene.pose(link)[None, :3, 3] for link in links),
        ]
    )


def _camera(
    scene: RenderScene, size: tuple[int, int]
) -> tuple[QueryObject, ColorRenderCamera, FrameId]:
    """Return the query object, a camera of a size (width, height) [px], and the world's frame."""
    plant = scene.plant
    core = RenderCameraCore(
        ENGINE,
        CameraInfo(*size, np.deg2rad(FOV_Y_DEG)),
        ClippingRange(0.05, 20.0),
        RigidTransform(),
    )
    query = plant.get_geometry_query_input_port().Eval(plant.GetMyContextFromRoot(scene.context))
    world = plant.GetBodyFrameIdOrThrow(plant.world_body().index())
    return query, ColorRenderCamera(core, False), world
