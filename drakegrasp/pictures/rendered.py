"""Pictures of a hand, which Drake renders.

Input: a hand. Output: a figure. As in `vision.rendering`, all pictures must be rendered in one
thread.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from pydrake.geometry import Cylinder, LightParameter
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex

from drakegrasp.frames import (
    Array,
    invert_pose,
    transform_points,
)
from drakegrasp.hand.description import Hand
from drakegrasp.hand.finger_sweep import link_points
from drakegrasp.hand.kinematics import closed_positions
from drakegrasp.hand.shapes import pad_surfaces
from drakegrasp.pictures.still_scene import (
    Lighting,
    Poses,
    StillScene,
    camera_pose,
)
from drakegrasp.pictures.style import (
    FINGER_COLOURS,
    INK,
    add_axes,
    hide_ticks,
    save_figure,
)
from drakegrasp.vision.rendering import drawn_mesh

#: Fraction by which the hand has closed in each panel, and the title of the panel.
PANELS = ((0.0, "open"), (0.5, "half closed"), (1.0, "closed"))
#: Distance at which pads are drawn in front of the fingertip [m].
PAD_LIFT = 4e-4
#: Length and radius of the axes of the palm frame [m], and their colours.
AXIS, AXIS_RADIUS = 0.05, 0.0012
#: Length of the axes of other tools' frames [m], and the fraction of white in their colours.
FOREIGN_AXIS, PALE = 0.12, 0.5
AXIS_COLOURS = {"Gx": "#CC3333", "Gy": "#339933", "Gz": "#3355CC"}
#: Lights for a hand: one at the camera and one from above, as in the images of a dataset.
_TOWARDS = (("camera", [0.0, 0.0, 1.0], 0.6), ("world", [0.3, 0.4, -1.0], 0.7))
LIGHTING = Lighting(
    name="hand",
    lights=tuple(
        LightParameter(type="directional", frame=frame, direction=direction, intensity=intensity)
        for frame, direction, intensity in _TOWARDS
    ),
)
#: Edge of a panel of a hand [px], and its size in the figure [inch].
HAND_PIXELS, INCHES = 480, 2.4
#: Width of the marker and the gap of a label in the legend [letters].
SPACE = 5
#: Direction of the camera: beside the line along which fingers close, and above [rad].
AZIMUTH, ELEVATION = np.deg2rad(25.0), np.deg2rad(20.0)


def picture_hand(hand: Hand, png: Path, *, across: float) -> None:
    """Write a picture of a hand.

    Args:
        hand: The hand.
        png: Path of the file.
        across: Direction about Gz, from Gx, from which the fingers' opposition is seen best [rad].

    Raises:
        MachineError: If OpenGL failed.
        OSError: If the file cannot be written.
    """
    # The palm frame is the world frame; all panels share one camera.
    scene = StillScene(hand, add=lambda plant, instance: _add_marks(plant, instance, hand))
    postures = [scene.positions(0.0, share * closed_positions(hand)) for share, _ in PANELS]
    outline = np.concatenate([_surface(scene, q) for q in postures])
    X_WC = camera_pose(outline, across + AZIMUTH, ELEVATION, fill=1.15)

    # Three panels side by side, over a legend.
    width, height = 3 * INCHES + 0.4, INCHES + 0.75
    figure = Figure(figsize=(width, height))
    for i, ((_, title), q) in enumerate(zip(PANELS, postures, strict=True)):
        axes = add_axes(figure, 0.1 + i * (INCHES + 0.1), 0.3, INCHES, INCHES)
        scene.pose(Poses(X_WG=np.eye(4), q=q))
        picture = scene.picture(X_WC, (HAND_PIXELS, HAND_PIXELS), LIGHTING)
        axes.imshow(picture, interpolation="antialiased")
        axes.set_title(title, fontsize=9, color=INK, pad=4.0)
        hide_ticks(axes)
    entries = [(f"pad of {finger.name}", _colour(i)) for i, finger in enumerate(hand.fingers)]
    entries += list(AXIS_COLOURS.items())
    entries += [(f"{tool}: paler axes", INK) for tool in hand.frames]
    letters = [len(label) + SPACE for label, _ in entries]
    for i, (label, colour) in enumerate(entries):
        left = 0.1 + sum(letters[:i]) * (width - 0.2) / sum(letters)
        text = f"\N{BLACK SQUARE} {label}"
        figure.text(left / width, 0.16 / height, text, color=colour, fontsize=8)
    save_figure(figure, png, dpi=200)


def _colour(finger: int) -> str:
    return FINGER_COLOURS[finger % len(FINGER_COLOURS)]


def _add_marks(plant: MultibodyPlant, instance: ModelInstanceIndex, hand: Hand) -> None:
    """Add the pads to the fingertips, and the axes of the palm frame to the world."""
    # The pads, slightly in front of their surfaces.
    for i, (finger, pad) in enumerate(
        zip(hand.fingers, pad_surfaces(hand.model, hand.fingers), strict=True)
    ):
        body = plant.GetBodyByName(finger.fingertip, instance)
        mesh = drawn_mesh(*_lifted(pad), f"pad {i}")
        colour = np.array(to_rgba(_colour(i)))
        plant.RegisterVisualGeometry(body, RigidTransform(), mesh, f"drakegrasp pad {i}", colour)

    # The axes, and longer, paler axes of other tools' frames, whose origins are inside the hand.
    frames = {"": np.eye(4)} | {tool: invert_pose(hand.palm_in(tool)) for tool in hand.frames}
    for tool, X_GA in frames.items():
        length, pale = (FOREIGN_AXIS, PALE) if tool else (AXIS, 0.0)
        for name, direction in zip(AXIS_COLOURS, np.eye(3), strict=True):
            along = RotationMatrix.MakeFromOneVector(direction, 2)
            X_AC = RigidTransform(along, 0.5 * length * direction)
            colour = (1.0 - pale) * np.array(to_rgba(AXIS_COLOURS[name])) + pale
            shape = Cylinder(AXIS_RADIUS, length)
            X_WC = RigidTransform(X_GA) @ X_AC
            plant.RegisterVisualGeometry(plant.world_body(), X_WC, shape, f"{tool} {name}", colour)


def _lifted(pad: Array) -> tuple[Array, Array]:
    """Return vertices and faces of a pad's triangles (t, 3, 3), in front of it and facing out."""
    # The triangles of a hull have no orientation: draw each on both sides; one side is hidden.
    normals = np.cross(pad[:, 1] - pad[:, 0], pad[:, 2] - pad[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    both = np.concatenate([pad + PAD_LIFT * normals[:, None], pad - PAD_LIFT * normals[:, None]])
    faces = np.arange(3 * len(both)).reshape(-1, 3)
    return both.reshape(-1, 3), np.concatenate([faces[: len(pad)], faces[len(pad) :, ::-1]])


def _surface(scene: StillScene, q: Array) -> Array:
    """Move the hand's joints, and return points (n, 3) of the hand's surface in {G} [m]."""
    scene.pose(Poses(X_WG=np.eye(4), q=q))
    points = link_points(scene.hand)
    return np.concatenate(
        [transform_points(scene.link_pose(link), points[link]) for link in scene.hand.link_chains]
    )
