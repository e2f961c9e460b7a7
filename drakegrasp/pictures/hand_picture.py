"""A picture of a hand: open, half closed and closed, with its pads and its palm frame.

In: a hand. Out: a PNG. As in `vision.rendering`, it must be made in one thread.
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

from drakegrasp.frames import Array, transform_points
from drakegrasp.hand.description import Hand
from drakegrasp.hand.finger_sweep import link_points
from drakegrasp.hand.kinematics import closed_positions
from drakegrasp.hand.shapes import pad_surfaces
from drakegrasp.pictures.still_scene import Lighting, Poses, StillScene, camera_pose
from drakegrasp.pictures.style import FINGER_COLOURS, INK, add_axes, hide_ticks, save_figure
from drakegrasp.vision.rendering import drawn_mesh

#: How far each panel's hand has closed, and what it is called.
PANELS = ((0.0, "open"), (0.5, "half closed"), (1.0, "closed"))
#: Pads are drawn this far in front of the fingertip [m].
PAD_LIFT = 4e-4
#: Length and radius of the axes of the palm frame [m], and their colours.
AXIS, AXIS_RADIUS = 0.05, 0.0012
AXIS_COLOURS = {"Gx": "#CC3333", "Gy": "#339933", "Gz": "#3355CC"}
#: A light at the camera and one from above, as in the images of a dataset.
LIGHTING = Lighting(
    name="hand",
    lights=(
        LightParameter(
            type="directional", frame="camera", direction=[0.0, 0.0, 1.0], intensity=0.6
        ),
        LightParameter(
            type="directional", frame="world", direction=[0.3, 0.4, -1.0], intensity=0.7
        ),
    ),
)
#: Edge of a panel [px] and its size in the figure [inch].
PIXELS, INCHES = 480, 2.4
#: Room for the sign and the gap of a label in the legend [letters].
SPACE = 5
#: Where the camera stands: beside the line along which fingers close, and above [rad].
AZIMUTH, ELEVATION = np.deg2rad(25.0), np.deg2rad(20.0)


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
    # The palm frame is the world's; all panels have one camera.
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
        picture = scene.picture(X_WC, (PIXELS, PIXELS), LIGHTING)
        axes.imshow(picture.image, interpolation="antialiased")
        axes.set_title(title, fontsize=9, color=INK, pad=4.0)
        hide_ticks(axes)
    entries = [(f"pad of {finger.name}", _colour(i)) for i, finger in enumerate(hand.fingers)]
    entries += list(AXIS_COLOURS.items())
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
    # The pads, a little in front of their surfaces.
    for i, (finger, pad) in enumerate(zip(hand.fingers, pad_surfaces(hand), strict=True)):
        body = plant.GetBodyByName(finger.fingertip, instance)
        mesh = drawn_mesh(*_lifted(pad), f"pad {i}")
        colour = np.array(to_rgba(_colour(i)))
        plant.RegisterVisualGeometry(body, RigidTransform(), mesh, f"drakegrasp pad {i}", colour)

    # The axes.
    for name, direction in zip(AXIS_COLOURS, np.eye(3), strict=True):
        X_WA = RigidTransform(
            RotationMatrix.MakeFromOneVector(direction, 2), 0.5 * AXIS * direction
        )
        colour = np.array(to_rgba(AXIS_COLOURS[name]))
        shape = Cylinder(AXIS_RADIUS, AXIS)
        plant.RegisterVisualGeometry(plant.world_body(), X_WA, shape, name, colour)


def _lifted(pad: Array) -> tuple[Array, Array]:
    """Return vertices and faces of a pad's triangles (t, 3, 3), in front of it and facing out."""
    # The triangles of a hull have no order: draw each on both sides, one is hidden.
    normals = np.cross(pad[:, 1] - pad[:, 0], pad[:, 2] - pad[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    both = np.concatenate([pad + PAD_LIFT * normals[:, None], pad - PAD_LIFT * normals[:, None]])
    faces = np.arange(3 * len(both)).reshape(-1, 3)
    return both.reshape(-1, 3), np.concatenate([faces[: len(pad)], faces[len(pad) :, ::-1]])


def _surface(scene: StillScene, q: Array) -> Array:
    """Move the hand's joints, and return points (n, 3) of its surface in {G} [m]."""
    scene.pose(Poses(X_WG=np.eye(4), q=q))
    points = link_points(scene.hand)
    return np.concatenate(
        [transform_points(scene.link_pose(link), points[link]) for link in scene.hand.link_chains]
    )
