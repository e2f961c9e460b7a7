"""Pictures that Drake renders: a hand, and the objects of an audit.

Input: a hand, or the rows of an audit. Output: figures. As in `vision.rendering`, all pictures must
be rendered in one thread.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from pydrake.geometry import Cylinder, LightParameter
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex

from drakegrasp.arithmetic import norm
from drakegrasp.config import CameraConfig
from drakegrasp.frames import (
    Array,
    invert_pose,
    make_pose,
    transform_points,
)
from drakegrasp.hand.description import Hand
from drakegrasp.hand.finger_sweep import link_points
from drakegrasp.hand.kinematics import closed_positions
from drakegrasp.hand.shapes import pad_surfaces
from drakegrasp.objects.audit import AuditRow
from drakegrasp.objects.model import ObjectModel
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
    new_page,
    save_figure,
    shortened,
    write_beside,
)
from drakegrasp.runtime.progress import Report, silent
from drakegrasp.vision.rendering import build_renderer, drawn_mesh, render

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
#: Number of objects in a row, the edge of a picture [inch], and its pixels.
ACROSS, OBJECT, OBJECT_PIXELS = 8, 1.45, 220
#: Direction from which an object is seen, in the table-top frame: from the front right, from above.
TOWARDS_CAMERA = np.array([0.62, -0.62, 0.48])
#: Vertical field of view [deg], and the fraction of it that an object's bounding sphere fills.
FIELD_DEG, FILL = 30.0, 0.95
#: Colours of the status (Okabe and Ito: safe for the colour-blind).
STATUS_COLOURS = {"fit": "#009E73", "repaired": "#B07A00", "refused": "#D55E00"}
#: Characters of a name that fit above a picture, and of a reason that fit in a line of a picture.
NAME, LINE = 24, 24


# A hand.


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
        axes.imshow(picture.image, interpolation="antialiased")
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


# The objects of an audit.


def object_sheet(rows: Sequence[AuditRow], png: Path, *, progress: Report = silent) -> None:
    """Draw the objects of an audit, oriented as in their files, each at its own scale.

    Args:
        rows: Rows of the audit; a rejected mesh is shown by its reason instead of a picture.
        png: Path of the file to write.
        progress: Called after each object.
    """
    # The page.
    across = min(ACROSS, len(rows))
    lines = -(-len(rows) // across)
    gap, caption, margin = 0.12, 0.36, 0.15
    width = across * OBJECT + (across - 1) * gap + 2 * margin
    height = lines * (OBJECT + caption) + 2 * margin
    figure = new_page(width, height)

    for i, row in enumerate(rows):
        line, column = divmod(i, across)
        left, top = margin + column * (OBJECT + gap), margin + line * (OBJECT + caption) + caption
        axes = add_axes(figure, left, top, OBJECT, OBJECT)
        hide_ticks(axes)
        if row.model is not None:
            axes.imshow(draw_object(row.model), interpolation="bilinear")
        else:
            axes.set_facecolor("#f4f1ee")
            centred = {"ha": "center", "va": "center"}
            write_beside(axes, 0.5, 0.5, _wrapped(row.notes[0]), 4.6, **centred)

        # The name, and the status below it.
        status = row.status + (" !" if row.warnings else "")
        write_beside(axes, 0.0, 1.135, shortened(row.name, NAME), 6.2)
        write_beside(axes, 0.0, 1.02, status, 6.2, color=STATUS_COLOURS[row.status])
        progress(i + 1, len(rows))
    save_figure(figure, png, dpi=150)


def draw_object(model: ObjectModel) -> npt.NDArray[np.float32]:
    """Return a picture (s, s, 3) in 0..1 of an object that is oriented as in its file."""
    # The distance at which the sphere around the object fills the picture.
    radius = float(norm(model.half_extents))
    distance = radius / np.sin(np.deg2rad(FIELD_DEG) / 2.0) / FILL
    camera = CameraConfig(
        size=OBJECT_PIXELS, fov_y_deg=FIELD_DEG, near=0.02 * distance, far=20.0 * distance
    )

    height = float(model.half_extents[2])
    X_TO = make_pose(np.eye(3), [0.0, 0.0, height])
    back = TOWARDS_CAMERA / norm(TOWARDS_CAMERA)
    X_TC = make_pose(_looking_along(-back), X_TO[:3, 3] + distance * back)
    view = render(build_renderer(model, camera), X_TO, X_TC)
    return np.asarray(np.moveaxis(view.image[:3], 0, 2))


def _looking_along(z: Array) -> Array:
    """Return the rotation (3, 3) of a camera that looks along z (3,), with world up at the top.

    Camera axes are OpenCV's: +x right, +y down, +z forward.
    """
    x = np.cross(z, [0.0, 0.0, 1.0])
    x = x / norm(x)
    return np.column_stack((x, np.cross(z, x), z))


def _wrapped(text: str) -> str:
    """Return a reason in lines that fit into the space of a picture."""
    lines = [""]
    for word in text.split():
        if len(lines[-1]) + len(word) >= LINE and lines[-1]:
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}".strip()
    return "\n".join(lines[:12])
