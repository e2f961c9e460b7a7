"""The phases of one grasp from the side: start, closed, lifted, with the camera's line of sight.

As the paper's Figure 5: each picture has the camera where it took the images, its line of sight and
its field of view. In: a dataset and a trial. Out: a figure. Needs Drake's renderer.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.legend_handler import HandlerTuple
from matplotlib.lines import Line2D

from drakegrasp.arithmetic import multiply, norm
from drakegrasp.frames import (
    X_WT,
    Array,
    invert_pose,
    unpack_pose,
)
from drakegrasp.pictures.figures.panels import Panel, draw_panel, show_image
from drakegrasp.pictures.figures.trial_stages import TrialStages, frustum, load_trial
from drakegrasp.pictures.still_scene import NO_SHADOWS, SHADOWS, camera_pose
from drakegrasp.pictures.style import FINGER_COLOURS, INK, add_axes, shortened
from drakegrasp.vision.camera import camera_pose_oto, intrinsics

#: Colours of the line of sight and of the field of view, as in the paper.
SIGHT, FIELD = "#D81B9A", "#1F4FD8"
#: How far the field of view is drawn [m].
FIELD_DEPTH = 0.1
#: Edge of a picture [px] and in the figure [inch]; space between them, for titles and legend.
PIXELS, EDGE, GAP, TITLE, LEGEND = 720, 4.0, 0.1, 0.56, 0.34
#: Azimuths between the line of sight and the view, which shows it from the side [rad].
SIDE_VIEWS = np.deg2rad([-105.0, -90.0, -75.0, -60.0, 60.0, 75.0, 90.0, 105.0])
#: Edge of the table [m]: what is farther away is not in the light.
TABLE = 0.9
#: Below this share of it along the vertical a line of sight has no azimuth.
VERTICAL = 1e-3


def phases_figure(out: Path, trial_id: int) -> Figure:
    """Return three pictures of a trial from the side: start, closed, lifted.

    Args:
        out: Directory of the dataset.
        trial_id: Row of trials.hdf5.

    Raises:
        DataError: If the trial does not exist, or ended before the lift.
        MachineError: If OpenGL failed.
    """
    # The camera, where it took the images: before the hand closes.
    trial = load_trial(out, trial_id, table_size=TABLE)
    camera = trial.config.camera
    X_TG = multiply(invert_pose(X_WT), trial.place.X_WG)
    X_WC = multiply(X_WT, camera_pose_oto(X_TG, camera, unpack_pose(trial.row["X_C0C"])))
    standoff = trial.config.candidates.standoffs[int(trial.row["standoff_index"])]
    end = X_WC[:3, 3] + (camera.distance + standoff) * X_WC[:3, 2]
    strokes = {
        SIGHT: [np.vstack([X_WC[:3, 3], end])],
        FIELD: frustum(X_WC, intrinsics(camera), camera.size, FIELD_DEPTH),
    }

    # What each picture says; that of the lift shows the table's middle, too.
    force, slip = float(norm(trial.row["closed_f_Q_O"]).max()), 1e3 * float(trial.row["slip"])
    turn, table = np.rad2deg(float(trial.row["turn"])), X_WT[None, :3, 3]
    start = f"start\npalm {1e3 * standoff:.0f} mm from the surface"
    closed = f"closed\nlargest force of a fingertip {force:.0f} N"
    lifted = f"lifted\nslip {slip:.1f} mm, turn {turn:.1f}° in the hand"

    # The same side of all three.
    azimuth, elevation = _side(trial, X_WC)
    panels = []
    for title, poses, arrows, more, lighting in (
        (start, trial.place, {}, [], SHADOWS),
        (closed, trial.close, trial.normals("closed"), [], SHADOWS),
        (lifted, trial.lift, trial.normals("lifted"), [table], NO_SHADOWS),
    ):
        around = np.vstack([trial.scene.outline(poses), X_WC[None, :3, 3], *more])
        view = camera_pose(around, azimuth, elevation)
        panels.append(
            Panel(
                title=title,
                picture=trial.scene.picture(view, (PIXELS, PIXELS), lighting),
                strokes=strokes,
                points={"C": X_WC[:3, 3]},
                arrows=arrows,
            )
        )
    name = f"{shortened(trial.model.name, 30)}, trial {trial_id}"
    return _draw(panels, name, camera.fov_y_deg, camera.distance)


def _side(trial: TrialStages, X_WC: Array) -> tuple[float, float]:
    """Return azimuth and elevation [rad] of the side view that sees the closed fingers best."""
    # From straight above any side will do.
    x, y, _ = X_WC[:3, 2]
    along = 0.0 if np.hypot(x, y) < VERTICAL else float(np.arctan2(y, x))
    X_WV = trial.scene.choose_view(trial.scene.outline(trial.close), azimuths=along + SIDE_VIEWS)
    x, y, z = -X_WV[:3, 2]
    return float(np.arctan2(y, x)), float(np.arcsin(z))


def _draw(panels: list[Panel], name: str, field_deg: float, distance: float) -> Figure:
    """Return the page: the panels side by side over a legend."""
    width = len(panels) * (EDGE + GAP) + GAP
    height = TITLE + EDGE + LEGEND
    figure = Figure(figsize=(width, height), facecolor="white")
    for k, panel in enumerate(panels):
        axes = add_axes(figure, GAP + k * (EDGE + GAP), TITLE, EDGE, EDGE)
        show_image(axes, panel.picture.image)
        draw_panel(axes, panel)
        stage, _, detail = panel.title.partition("\n")
        for text, above, size, weight in (
            (f"{k + 1}  {stage}", 1.072, 12.0, "bold"),
            (detail, 1.018, 9.5, "normal"),
        ):
            axes.text(0.0, above, text, transform=axes.transAxes, fontsize=size, color=INK,
                      weight=weight)  # fmt: skip

    # What the colours are, and of which trial.
    dots = [
        Line2D([], [], color=colour, marker="o", linestyle="none", markeredgecolor="white",
               markersize=8) for colour in FINGER_COLOURS[:3]
    ]  # fmt: skip
    marks: dict[str, Any] = {
        "line of sight of the camera C": Line2D([], [], color=SIGHT, linewidth=1.6),
        f"field of view, {field_deg:g}°; C stands {distance:g} m behind the palm": Line2D(
            [], [], color=FIELD, linewidth=1.6
        ),
        "contacts, with their outward normals": tuple(dots),
    }
    figure.legend(
        handles=list(marks.values()), labels=list(marks),
        handler_map={tuple: HandlerTuple(ndivide=None, pad=0.2)},
        loc="lower left", bbox_to_anchor=(GAP / width, 0.02), ncols=len(marks),
        fontsize=9, frameon=False, borderaxespad=0.0, borderpad=0.0, labelcolor=INK,
        columnspacing=1.6,
    )  # fmt: skip
    figure.text(1.0 - GAP / width, 0.1 / height, name, fontsize=9, color=INK, ha="right",
                va="bottom", parse_math=False)  # fmt: skip
    return figure
