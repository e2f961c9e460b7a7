"""A picture of a hand: open, half closed and closed, with its pads and its palm frame.

In: a hand. Out: a PNG. As in `vision.rendering`, it must be made in one thread.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from pydrake.common import MemoryFile
from pydrake.geometry import (
    ClippingRange,
    ColorRenderCamera,
    Cylinder,
    InMemoryMesh,
    LightParameter,
    MakeRenderEngineVtk,
    Mesh,
    RenderCameraCore,
    RenderEngineVtkParams,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.framework import Context, Diagram, DiagramBuilder
from pydrake.systems.sensors import CameraInfo

from drakegrasp.errors import MachineError
from drakegrasp.frames import Array, transform_points
from drakegrasp.hand.description import Hand
from drakegrasp.hand.finger_sweep import link_points
from drakegrasp.hand.kinematics import coordinate_limits, joint_positions, link_poses
from drakegrasp.hand.parsing import add_model
from drakegrasp.hand.shapes import pad_surfaces
from drakegrasp.mesh.wavefront import obj_text
from drakegrasp.vision.rendering import BLANK, ENGINE
from drakegrasp.visualization.style import FINGER_COLOURS, INK, add_axes, hide_ticks, save_figure
from drakegrasp.visualization.third_person import (
    BACKGROUND,
    FOV_Y_DEG,
    OVERSAMPLING,
    camera_pose,
)

#: How far each panel's hand has closed, and what it is called.
PANELS = ((0.0, "open"), (0.5, "half closed"), (1.0, "closed"))
#: Pads are drawn this far in front of the fingertip [m].
PAD_LIFT = 4e-4
#: Length and radius of the axes of the palm frame [m], and their colours.
AXIS, AXIS_RADIUS = 0.05, 0.0012
AXIS_COLOURS = {"Gx": "#CC3333", "Gy": "#339933", "Gz": "#3355CC"}
#: Colour of links without one: Drake's own is that of a pad.
GREY = np.array([0.70, 0.71, 0.73, 1.0])
#: A light at the camera and one from above, as in the images of a dataset.
LIGHTS = (
    LightParameter(type="directional", frame="camera", direction=[0.0, 0.0, 1.0], intensity=0.6),
    LightParameter(type="directional", frame="world", direction=[0.3, 0.4, -1.0], intensity=0.7),
)
#: Edge of a panel [px] and its size in the figure [inch].
PIXELS, INCHES = 480, 2.4
#: Where the camera stands: beside the line along which fingers close, and above [rad].
AZIMUTH, ELEVATION = np.deg2rad(25.0), np.deg2rad(20.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Scene:
    """A hand whose palm frame is the world's, with a context."""

    hand: Hand
    plant: MultibodyPlant
    instance: ModelInstanceIndex
    diagram: Diagram
    context: Context


def picture_hand(hand: Hand, png: Path, *, across: float) -> None:
    """Write a picture of a hand.

    Args:
        hand: The hand.
        png: The file.
        across: Direction from which the fingers' opposition is seen best, about Gz from Gx [rad].

    Raises:
        MachineError: If OpenGL failed.
        OSError: If the file cannot be written.
    """
    # All panels have one camera.
    scene = _build(hand)
    outline = np.concatenate([_outline(hand, share) for share, _ in PANELS])
    X_WC = camera_pose(outline, across + AZIMUTH, ELEVATION, fill=1.15)

    # Three panels side by side, over a legend.
    width, height = 3 * INCHES + 0.4, INCHES + 0.75
    figure = Figure(figsize=(width, height))
    for i, (share, title) in enumerate(PANELS):
        axes = add_axes(figure, 0.1 + i * (INCHES + 0.1), 0.3, INCHES, INCHES)
        axes.imshow(_render(scene, share, X_WC), interpolation="antialiased")
        axes.set_title(title, fontsize=9, color=INK, pad=4.0)
        hide_ticks(axes)
    entries = [(f"pad of {finger.name}", _colour(i)) for i, finger in enumerate(hand.fingers)]
    entries += list(AXIS_COLOURS.items())
    for i, (label, colour) in enumerate(entries):
        left = 0.1 + i * (width - 0.2) / len(entries)
        text = f"\N{BLACK SQUARE} {label}"
        figure.text(left / width, 0.16 / height, text, color=colour, fontsize=8)
    save_figure(figure, png, dpi=200)


def _colour(finger: int) -> str:
    return FINGER_COLOURS[finger % len(FINGER_COLOURS)]


def _build(hand: Hand) -> _Scene:
    """Return the hand with its pads and its palm frame drawn."""
    # The hand, with its palm frame at the world's.
    os.environ.setdefault("LP_NUM_THREADS", "0")
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlant(MultibodyPlantConfig(time_step=0.0), builder)
    parameters = RenderEngineVtkParams(
        default_clear_color=BACKGROUND, default_diffuse=GREY, lights=list(LIGHTS)
    )
    scene_graph.AddRenderer(ENGINE, MakeRenderEngineVtk(parameters))
    instance = add_model(plant, hand.model)
    base = plant.GetFrameByName(hand.palm_link, instance)
    plant.WeldFrames(plant.world_frame(), base, RigidTransform(hand.X_BG).inverse())

    # Its pads, a little in front of their surfaces.
    for i, (finger, pad) in enumerate(zip(hand.fingers, pad_surfaces(hand), strict=True)):
        body = plant.GetBodyByName(finger.fingertip, instance)
        text = obj_text(*_lifted(pad), normals=True)
        mesh = Mesh(InMemoryMesh(mesh_file=MemoryFile(text, ".obj", f"pad {i}")))
        colour = np.array([*to_rgb(_colour(i)), 1.0])
        plant.RegisterVisualGeometry(body, RigidTransform(), mesh, f"drakegrasp pad {i}", colour)

    # The axes of the palm frame.
    for name, direction in zip(AXIS_COLOURS, np.eye(3), strict=True):
        X_WA = RigidTransform(
            RotationMatrix.MakeFromOneVector(direction, 2), 0.5 * AXIS * direction
        )
        colour = np.array([*to_rgb(AXIS_COLOURS[name]), 1.0])
        shape = Cylinder(AXIS_RADIUS, AXIS)
        plant.RegisterVisualGeometry(plant.world_body(), X_WA, shape, name, colour)
    plant.Finalize()
    diagram = builder.Build()
    return _Scene(
        hand=hand,
        plant=plant,
        instance=instance,
        diagram=diagram,
        context=diagram.CreateDefaultContext(),
    )


def _lifted(pad: Array) -> tuple[Array, Array]:
    """Return vertices and faces of a pad's triangles (t, 3, 3), in front of it and facing out."""
    # The triangles of a hull have no order: draw each on both sides, one is hidden.
    normals = np.cross(pad[:, 1] - pad[:, 0], pad[:, 2] - pad[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    both = np.concatenate([pad + PAD_LIFT * normals[:, None], pad - PAD_LIFT * normals[:, None]])
    faces = np.arange(3 * len(both)).reshape(-1, 3)
    return both.reshape(-1, 3), np.concatenate([faces[: len(pad)], faces[len(pad) :, ::-1]])


def _closing(hand: Hand, share: float) -> Array:
    limits = coordinate_limits(hand)[1:, 1]
    return share * np.where(np.isfinite(limits), limits, 0.0)


def _outline(hand: Hand, share: float) -> Array:
    """Return points (n, 3) of the hand's surface in {G} [m], when it has closed by a share."""
    points, closing = link_points(hand), _closing(hand, share)
    return np.concatenate(
        [
            transform_points(link_poses(hand, link, spread=0.0, closing=closing), points[link])
            for link in hand.link_chains
        ]
    )


def _render(scene: _Scene, share: float, X_WC: Array) -> Array:
    """Return the picture (n, n, 3) of the hand when it has closed by a share."""
    # The posture.
    plant, context = scene.plant, scene.plant.GetMyMutableContextFromRoot(scene.context)
    q = joint_positions(scene.hand, 0.0, _closing(scene.hand, share))
    names = plant.GetPositionNames(
        scene.instance, add_model_instance_prefix=False, always_add_suffix=False
    )
    plant.SetPositions(context, scene.instance, np.array([q[name] for name in names]))

    # Render larger, then average blocks of pixels.
    large = OVERSAMPLING * PIXELS
    core = RenderCameraCore(
        ENGINE,
        CameraInfo(large, large, np.deg2rad(FOV_Y_DEG)),
        ClippingRange(0.05, 20.0),
        RigidTransform(),
    )
    query = plant.get_geometry_query_input_port().Eval(context)
    world = plant.GetBodyFrameIdOrThrow(plant.world_body().index())
    camera = ColorRenderCamera(core, False)
    image = query.RenderColorImage(camera, world, RigidTransform(X_WC)).data[:, :, :3]
    if not image.any():
        raise MachineError(BLANK)
    blocks = image.reshape(PIXELS, OVERSAMPLING, PIXELS, OVERSAMPLING, 3)
    return np.rint(blocks.mean(axis=(1, 3))).astype(np.uint8)
