"""The theatre: an object, a hand and a table in a diagram that is only looked at.

In: an object's model and a hand, and a `Moment` to show. Out: pictures with their cameras,
so that frames can be drawn into them. The camera is chosen by itself: of a ring of
viewpoints, the one that sees most of the fingertip it sees least of.

As for `vision.rendering`: a theatre must be made and used in one thread.
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
from drakegrasp.hand.description import Hand, make_parser
from drakegrasp.objects.model import ObjectModel
from drakegrasp.vision.camera import Picture
from drakegrasp.vision.rendering import BLANK, ENGINE, add_drawn_object

#: Vertical field of view [deg]: narrow, so that nothing is distorted.
FOV_Y_DEG = 26.0
#: Viewpoints that are tried: around the vertical, and above the horizontal [deg].
AZIMUTHS_DEG, ELEVATIONS_DEG = range(0, 360, 20), (19.0, 28.0)
#: Height of the pictures among which the viewpoint is chosen [px].
TRIAL_SIZE = 120
#: Pictures are drawn this many times larger and averaged: VTK alone leaves jagged edges.
OVERSAMPLING = 2
#: What the hand needs around the origins of its links [m].
MARGIN = 0.035
BACKGROUND = np.array([0.95, 0.96, 0.97])
TABLE_COLOUR = np.array([0.74, 0.70, 0.64, 1.0])
TABLE_SIZE, TABLE_THICKNESS = 1.6, 0.1
#: Edge of the map that the shadows are looked up in [px].
SHADOW_MAP = 4096
#: For pictures of hand and object together. Camera axes: +X right, +Y down. Point lights cast
#: no shadow in VTK; the spot does.
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
class Moment:
    """Where everything is at one instant: palm X_WG, object X_WO (4, 4), joints q [rad]."""

    X_WG: Array
    X_WO: Array
    q: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class Theatre:
    """A diagram of the object, the hand and the table that is only looked at."""

    diagram: Diagram
    context: Context
    plant: MultibodyPlant
    object: RigidBody
    hand: Hand
    hand_instance: ModelInstanceIndex
    wrist: FixedOffsetFrame

    @property
    def joint_names(self) -> list[str]:
        """Names of the hand's joints in the order of `Moment.q`."""
        names = self.plant.GetPositionNames(
            self.hand_instance, add_model_instance_prefix=False, always_add_suffix=False
        )
        return list(names)

    def pose(self, link: str) -> Array:
        """Return the pose X_WL (4, 4) of a link of the hand now."""
        body = self.plant.GetBodyByName(link, self.hand_instance)
        context = self.plant.GetMyContextFromRoot(self.context)
        return self.plant.EvalBodyPoseInWorld(context, body).GetAsMatrix4()


def build_theatre(
    model: ObjectModel,
    hand: Hand,
    *,
    table_size: float = TABLE_SIZE,
    lights: Sequence[LightParameter] = LIGHTS,
) -> Theatre:
    """Return a diagram of an object, a hand and a square table of an edge [m], lit by lights."""
    builder = DiagramBuilder()
    parameters = RenderEngineVtkParams(
        default_clear_color=BACKGROUND,
        lights=list(lights),
        cast_shadows=True,
        shadow_map_size=SHADOW_MAP,
    )
    plant, body = add_drawn_object(builder, model, parameters)
    X_WB = RigidTransform(X_WT @ make_pose(np.eye(3), [0.0, 0.0, -TABLE_THICKNESS / 2.0]))
    slab = Box(table_size, table_size, TABLE_THICKNESS)
    plant.RegisterVisualGeometry(plant.world_body(), X_WB, slab, "table", TABLE_COLOUR)
    (instance,) = make_parser(plant).AddModels(hand.sdf_path)
    base = plant.GetBodyByName(hand.palm_link, instance)
    palm = plant.AddFrame(
        FixedOffsetFrame("palm", base.body_frame(), RigidTransform(hand.X_BG), instance)
    )
    # Its pose is a parameter of the context: the palm can be put anywhere without a joint.
    wrist = plant.AddFrame(FixedOffsetFrame("wrist", plant.world_frame(), RigidTransform()))
    plant.WeldFrames(wrist, palm)
    plant.Finalize()
    diagram = builder.Build()
    return Theatre(
        diagram=diagram,
        context=diagram.CreateDefaultContext(),
        plant=plant,
        object=body,
        hand=hand,
        hand_instance=instance,
        wrist=wrist,
    )


def show(theatre: Theatre, moment: Moment) -> None:
    """Put hand and object where they are at a moment."""
    plant = theatre.plant
    context = plant.GetMyMutableContextFromRoot(theatre.context)
    plant.SetFreeBodyPose(context, theatre.object, RigidTransform(moment.X_WO))
    theatre.wrist.SetPoseInParentFrame(context, RigidTransform(moment.X_WG))
    plant.SetPositions(context, theatre.hand_instance, moment.q)


def take(theatre: Theatre, X_WC: Array, size: tuple[int, int]) -> Picture:
    """Return what a camera at X_WC (4, 4) sees, `size` = (width, height) [px].

    Raises:
        MachineError: If the picture is blank, which means that OpenGL failed.
    """
    query, camera, world = _camera(theatre, (OVERSAMPLING * size[0], OVERSAMPLING * size[1]))
    large = query.RenderColorImage(camera, world, RigidTransform(X_WC)).data[:, :, :3]
    if not large.any():
        raise MachineError(BLANK)
    blocks = large.reshape(size[1], OVERSAMPLING, size[0], OVERSAMPLING, 3)
    image = np.rint(blocks.mean(axis=(1, 3))).astype(np.uint8)
    focal = size[1] / (2.0 * np.tan(np.deg2rad(FOV_Y_DEG) / 2.0))
    K = np.array([[focal, 0.0, (size[0] - 1) / 2], [0.0, focal, (size[1] - 1) / 2], [0, 0, 1.0]])
    return Picture(image=image, K=K, X_WC=X_WC)


def labels(theatre: Theatre, X_WC: Array, size: tuple[int, int]) -> npt.NDArray[np.int16]:
    """Return the body index (height, width) that each pixel shows."""
    query, camera, world = _camera(theatre, size)
    return query.RenderLabelImage(camera, world, RigidTransform(X_WC)).data[:, :, 0].copy()


def choose_view(theatre: Theatre, p_WA: Array, *, fill: float = 1.0) -> Array:
    """Return X_WC of a camera that has points p_WA (n, 3) in view and all fingertips in sight.

    Args:
        theatre: As it is to be seen.
        p_WA: What must be in the picture [m].
        fill: The camera's distance is divided by it.
    """
    tips = [
        int(theatre.plant.GetBodyByName(name, theatre.hand_instance).index())
        for name in theatre.hand.fingertip_links
    ]
    best, most = np.eye(4), (-1, -1)
    for elevation in np.deg2rad(ELEVATIONS_DEG):
        for azimuth in np.deg2rad(AZIMUTHS_DEG):
            X_WC = view(p_WA, azimuth, elevation, fill=fill)
            seen = labels(theatre, X_WC, (TRIAL_SIZE, TRIAL_SIZE))
            counts = [int(np.sum(seen == tip)) for tip in tips]
            score = min(counts), sum(counts) + int(np.sum(seen == int(theatre.object.index())))
            if score > most:
                best, most = X_WC, score
    return best


def view(p_WA: Array, azimuth: float, elevation: float, *, fill: float = 1.0) -> Array:
    """Return X_WC (4, 4) of a camera that looks at the middle of points from two angles [rad]."""
    middle = (p_WA.min(axis=0) + p_WA.max(axis=0)) / 2.0
    radius = np.linalg.norm(p_WA - middle, axis=1).max() + MARGIN
    distance = radius / np.sin(np.deg2rad(FOV_Y_DEG) / 2.0) / fill
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


def outline(theatre: Theatre, moment: Moment, half_extents: Array) -> Array:
    """Return points (n, 3) that span what is shown: links of the hand, corners of the box."""
    show(theatre, moment)
    plant = theatre.plant
    links = [plant.get_body(i).name() for i in plant.GetBodyIndices(theatre.hand_instance)]
    corners = half_extents * np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T
    return np.vstack(
        [
            transform_points(moment.X_WO, corners),
            *(theatre.pose(link)[None, :3, 3] for link in links),
        ]
    )


def _camera(
    theatre: Theatre, size: tuple[int, int]
) -> tuple[QueryObject, ColorRenderCamera, FrameId]:
    plant = theatre.plant
    core = RenderCameraCore(
        ENGINE,
        CameraInfo(*size, np.deg2rad(FOV_Y_DEG)),
        ClippingRange(0.05, 20.0),
        RigidTransform(),
    )
    query = plant.get_geometry_query_input_port().Eval(plant.GetMyContextFromRoot(theatre.context))
    world = plant.GetBodyFrameIdOrThrow(plant.world_body().index())
    return query, ColorRenderCamera(core, False), world
