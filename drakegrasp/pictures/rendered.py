"""Pictures that Drake renders: a hand, the objects of an audit, and the phases of a grasp.

Input: a hand; the rows of an audit; or a dataset and the number of a trial, whose poses are those
in trials.hdf5: nothing is simulated. Output: figures. As in `vision.rendering`, all pictures must
be rendered in one thread.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.legend_handler import HandlerTuple
from matplotlib.lines import Line2D
from pydrake.geometry import Cylinder, LightParameter
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex

from drakegrasp.arithmetic import multiply, norm
from drakegrasp.config import CameraConfig, Config
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.prepared_objects import load_prepared
from drakegrasp.dataset.trials import Trials
from drakegrasp.errors import DataError
from drakegrasp.frames import (
    X_WT,
    Array,
    invert_pose,
    make_pose,
    rotate_vectors,
    transform_points,
    unpack_pose,
)
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.hand.finger_sweep import link_points
from drakegrasp.hand.kinematics import closed_positions
from drakegrasp.hand.shapes import pad_surfaces
from drakegrasp.objects.audit import AuditRow
from drakegrasp.objects.model import ObjectModel
from drakegrasp.outcomes import Outcome, Stage
from drakegrasp.pictures.still_scene import (
    NO_SHADOWS,
    SHADOWS,
    TABLE_SIZE,
    Lighting,
    Poses,
    StillScene,
    camera_pose,
)
from drakegrasp.pictures.style import (
    ARROW,
    FINGER_COLOURS,
    INK,
    add_axes,
    draw_marks,
    hide_ticks,
    new_page,
    save_figure,
    shortened,
    show_image,
    write_beside,
)
from drakegrasp.runtime.progress import Report, silent
from drakegrasp.vision.camera import camera_pose_oto, intrinsics, unproject
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
#: Colours of the line of sight and of the field of view, as in the paper.
SIGHT, FIELD = "#D81B9A", "#1F4FD8"
#: How far the field of view is drawn [m].
FIELD_DEPTH = 0.1
#: Edge of a picture [px] and in the figure [inch]; spaces between pictures, for titles and legend.
PIXELS, EDGE, GAP, TITLE, LEGEND = 720, 4.0, 0.1, 0.56, 0.34
#: Azimuths between the line of sight and the view, which shows it from the side [rad].
SIDE_VIEWS = np.deg2rad([-105.0, -90.0, -75.0, -60.0, 60.0, 75.0, 90.0, 105.0])
#: Edge of the table [m]: the light does not reach farther.
TABLE = 0.9
#: A line of sight has no azimuth if its horizontal part is below this.
VERTICAL = 1e-3


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


# The phases of a grasp.


@dataclass(frozen=True, kw_only=True, eq=False)
class TrialStages:
    """A trial at its three stages, and the scene in which they are rendered.

    Attributes:
        scene: Scene of the trial's object and hand.
        place, close, lift: Poses at the start, after closing, and after the lift.
        model: The object.
        config: Configuration of the dataset.
        row: Fields of the trial in `/trials`, by name.
        palm_distance: Distance of the palm from the surface along +Gz [m]; NaN if the palm was
            tried as it is and does not look at the object.
    """

    scene: StillScene
    place: Poses
    close: Poses
    lift: Poses
    model: ObjectModel
    config: Config
    row: Mapping[str, Any]
    palm_distance: float

    def normals(self, when: Literal["closed", "lifted"]) -> dict[str, tuple[Array, Array]]:
        """Return the tail and tip (3,) in {W} [m] of each contact's normal, by Q and finger."""
        X_WO = self.close.X_WO if when == "closed" else self.lift.X_WO
        p_WQ = transform_points(X_WO, self.row[f"{when}_p_OQ"])
        tips = p_WQ + ARROW * rotate_vectors(X_WO, self.row[f"{when}_nhat_Q_O"])
        touching = self.row[f"{when}_touching"]
        return {f"Q{k + 1}": (p_WQ[k], tips[k]) for k in np.flatnonzero(touching)}


def load_trial(out: Path, trial_id: int, *, table_size: float = TABLE_SIZE) -> TrialStages:
    """Return a lifted trial, ready to be rendered.

    Args:
        out: Directory of the dataset.
        trial_id: Row of trials.hdf5.
        table_size: Edge of the table [m].

    Raises:
        DataError: If the trial does not exist, or ended before the lift.
    """
    # Read the trial.
    row = Trials(out).trial(trial_id)
    name = row["object_name"]
    config = read_manifest(out).config_of(name)
    outcome = Outcome(int(row["outcome"]))
    if outcome.stage is not Stage.LIFTED:
        raise DataError(f"{out}: trial {trial_id} must have been lifted, got {outcome.label}")

    # Poses of palm and object at the start, and after the lift.
    X_WO = X_WT @ unpack_pose(row["X_TO"])
    X_WG = X_WO @ unpack_pose(row["X_OG"])
    X_WO_lifted = X_WT @ unpack_pose(row["X_TO_lifted"])
    X_WG_lifted = X_WO_lifted @ unpack_pose(row["X_OG_lifted"])

    prepared = load_prepared(out, name, config)
    model, standoffs = prepared.model, np.array(config.candidates.standoffs)
    place = np.array([int(row["candidate"])]), standoffs[[int(row["standoff_index"])]]
    scene = StillScene(load_hand(config.hand_source), model, table_size=table_size)
    return TrialStages(
        scene=scene,
        place=Poses(X_WG=X_WG, q=scene.positions(float(row["spread"])), X_WO=X_WO),
        close=Poses(X_WG=X_WG, q=row["closed_q"], X_WO=X_WO),
        lift=Poses(X_WG=X_WG_lifted, q=row["lifted_q"], X_WO=X_WO_lifted),
        model=model,
        config=config,
        row=row,
        palm_distance=float(prepared.candidates.palm_distance(*place)[0]),
    )


def frustum(X_WC: Array, K: Array, size: int, depth: float) -> list[Array]:
    """Return polylines (n, 3) in {W} of a camera's field of view, up to a depth [m]."""
    edge = size - 0.5
    pixels = np.array([[-0.5, -0.5], [edge, -0.5], [edge, edge], [-0.5, edge]])
    corners = transform_points(X_WC, unproject(K, pixels, np.full(4, depth)))
    rays = [np.vstack([X_WC[:3, 3], corner]) for corner in corners]
    return [np.vstack([corners, corners[:1]]), *rays]


def phases_figure(out: Path, trial_id: int) -> Figure:
    """Return three pictures of a trial from the side: start, closed, lifted.

    Args:
        out: Directory of the dataset.
        trial_id: Row of trials.hdf5.

    Raises:
        DataError: If the trial does not exist, or ended before the lift.
        MachineError: If OpenGL failed.
    """
    # The camera at the pose in which it took the images, before the hand closes.
    trial = load_trial(out, trial_id, table_size=TABLE)
    camera = trial.config.camera
    X_TG = multiply(invert_pose(X_WT), trial.place.X_WG)
    X_WC = multiply(X_WT, camera_pose_oto(X_TG, camera, unpack_pose(trial.row["X_C0C"])))
    distance = trial.palm_distance
    end = X_WC[:3, 3] + (camera.distance + np.nan_to_num(distance)) * X_WC[:3, 2]
    strokes = {
        SIGHT: [np.vstack([X_WC[:3, 3], end])],
        FIELD: frustum(X_WC, intrinsics(camera), camera.size, FIELD_DEPTH),
    }

    # The texts of the pictures. The picture of the lift also shows the table's centre.
    force, slip = float(norm(trial.row["closed_f_Q_O"]).max()), 1e3 * float(trial.row["slip"])
    turn, table = np.rad2deg(float(trial.row["turn"])), X_WT[None, :3, 3]
    start = "start"
    if np.isfinite(distance):
        start += f"\npalm {1e3 * distance:.0f} mm from the surface"
    closed = f"closed\nlargest force of a fingertip {force:.0f} N"
    lifted = f"lifted\nslip {slip:.1f} mm, turn {turn:.1f}° in the hand"

    # All three pictures are from the same side.
    azimuth, elevation = _side(trial, X_WC)
    width, height = 3 * (EDGE + GAP) + GAP, TITLE + EDGE + LEGEND
    figure = new_page(width, height)
    for k, (title, poses, arrows, more, lighting) in enumerate(
        (
            (start, trial.place, {}, [], SHADOWS),
            (closed, trial.close, trial.normals("closed"), [], SHADOWS),
            (lifted, trial.lift, trial.normals("lifted"), [table], NO_SHADOWS),
        )
    ):
        around = np.vstack([trial.scene.outline(poses), X_WC[None, :3, 3], *more])
        view = camera_pose(around, azimuth, elevation)
        picture = trial.scene.picture(view, (PIXELS, PIXELS), lighting)
        axes = add_axes(figure, GAP + k * (EDGE + GAP), TITLE, EDGE, EDGE)
        show_image(axes, picture.image)
        draw_marks(axes, picture, strokes=strokes, points={"C": X_WC[:3, 3]}, arrows=arrows)
        stage, _, detail = title.partition("\n")
        write_beside(axes, 0.0, 1.072, f"{k + 1}  {stage}", 12.0, weight="bold")
        write_beside(axes, 0.0, 1.018, detail, 9.5)
    _draw_phases_legend(figure, camera)
    name = f"{shortened(trial.model.name, 30)}, trial {trial_id}"
    figure.text(1.0 - GAP / width, 0.1 / height, name, fontsize=9, color=INK, ha="right",
                va="bottom", parse_math=False)  # fmt: skip
    return figure


def _side(trial: TrialStages, X_WC: Array) -> tuple[float, float]:
    """Return azimuth and elevation [rad] of the side view that sees the closed fingers best."""
    # If the camera looks straight down, any side is suitable.
    x, y, _ = X_WC[:3, 2]
    along = 0.0 if np.hypot(x, y) < VERTICAL else float(np.arctan2(y, x))
    X_WV = trial.scene.choose_view(trial.scene.outline(trial.close), azimuths=along + SIDE_VIEWS)
    x, y, z = -X_WV[:3, 2]
    return float(np.arctan2(y, x)), float(np.arcsin(z))


def _draw_phases_legend(figure: Figure, camera: CameraConfig) -> None:
    """Draw the legend of the colours."""
    dots = [
        Line2D([], [], color=colour, marker="o", linestyle="none", markeredgecolor="white",
               markersize=8) for colour in FINGER_COLOURS[:3]
    ]  # fmt: skip
    field = f"field of view, {camera.fov_y_deg:g}°"
    marks: dict[str, Any] = {
        "line of sight of the camera C": Line2D([], [], color=SIGHT, linewidth=1.6),
        f"{field}; C stands {camera.distance:g} m behind the palm": Line2D(
            [], [], color=FIELD, linewidth=1.6
        ),
        "contacts, with their outward normals": tuple(dots),
    }
    figure.legend(
        handles=list(marks.values()), labels=list(marks),
        handler_map={tuple: HandlerTuple(ndivide=None, pad=0.2)},
        loc="lower left", bbox_to_anchor=(GAP / figure.get_figwidth(), 0.02), ncols=len(marks),
        fontsize=9, frameon=False, borderaxespad=0.0, borderpad=0.0, labelcolor=INK,
        columnspacing=1.6,
    )  # fmt: skip
