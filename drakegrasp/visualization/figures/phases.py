"""The phases of one grasp from the side: start, closed, lifted, with the camera's line of sight.

As the paper's Figure 5: each picture has the camera where it took the images, its line of sight and
its field of view. In: a dataset and a trial. Out: a figure. Needs Drake's renderer.
"""

from __future__ import annotations

from collections.abc import Mapping
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
    rotate_vectors,
    transform_points,
    unpack_pose,
)
from drakegrasp.vision.camera import camera_pose_oto, intrinsics
from drakegrasp.visualization.figures.panels import Panel, draw_panel, show_image
from drakegrasp.visualization.figures.trial_stages import TrialStages, frustum, load_trial
from drakegrasp.visualization.still_scene import NO_SHADOWS, SHADOWS, Poses, camera_pose
from drakegrasp.visualization.style import ARROW, FINGER_COLOURS, INK, add_axes, shortened

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
    standoff = trial.config.candidates.drawn_standoffs[int(trial.row["standoff_index"])]
    end = X_WC[:3, 3] + (camera.distance + standoff) * X_WC[:3, 2]
    strokes = {
        SIGHT: [np.vstack([X_WC[:3, 3], end])],
        FIELD: frustum(X_WC, intrinsics(camera), camera.size, FIELD_DEPTH),
    }

    # The same side of all three.
    azimuth, elevation = _side(trial, X_WC)
    panels = []
    for poses, title, when in (
        (trial.place, _start_title(standoff), None),
        (trial.close, _closed_title(trial.row), "closed"),
        (trial.lift, _lifted_title(trial.row), "lifted"),
    ):
        around = [trial.scene.outline(poses), X_WC[None, :3, 3]]
        if when == "lifted":
            around.append(X_WT[None, :3, 3])
        view = camera_pose(np.vstack(around), azimuth, elevation)
        lighting = NO_SHADOWS if when == "lifted" else SHADOWS
        panels.append(
            Panel(
                title=title,
                picture=trial.scene.picture(view, (PIXELS, PIXELS), lighting),
                triads=[],
                strokes=strokes,
                points={"C": X_WC[:3, 3]},
                arrows=_contacts(trial, poses, when) if when else {},
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


def _contacts(trial: TrialStages, poses: Poses, when: str) -> dict[str, Any]:
    """Return tails and tips of the normals at the contacts of an instant, by finger, in {W}."""
    p_WQ = transform_points(poses.X_WO, trial.row[f"{when}_p_OQ"])
    tips = p_WQ + ARROW * rotate_vectors(poses.X_WO, trial.row[f"{when}_nhat_Q_O"])
    touching = trial.row[f"{when}_touching"]
    return {f"Q{k + 1}": (p_WQ[k], tips[k]) for k in np.flatnonzero(touching)}


def _start_title(standoff: float) -> str:
    return f"start\npalm {1e3 * standoff:.0f} mm from the surface"


def _closed_title(row: Mapping[str, Any]) -> str:
    force = float(norm(row["closed_f_Q_O"]).max())
    return f"closed\nlargest force of a fingertip {force:.0f} N"


def _lifted_title(row: Mapping[str, Any]) -> str:
    slip, turn = 1e3 * float(row["slip"]), np.rad2deg(float(row["turn"]))
    return f"lifted\nslip {slip:.1f} mm, turn {turn:.1f}° in the hand"


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
