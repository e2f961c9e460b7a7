"""The sheet of an audit: a picture of each object with its name and status, as a page.

In: the rows of an audit. Out: a PNG file. Needs Drake's renderer and matplotlib.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from drakegrasp.arithmetic import norm
from drakegrasp.config import CameraConfig
from drakegrasp.frames import Array, make_pose
from drakegrasp.objects.audit import AuditRow
from drakegrasp.objects.model import ObjectModel
from drakegrasp.pictures.style import INK, add_axes, hide_ticks, save_figure, shortened
from drakegrasp.runtime.progress import Report, silent
from drakegrasp.vision.rendering import build_renderer, render

#: Objects in a row, the edge of a picture [inch], and its pixels.
ACROSS, EDGE, PIXELS = 8, 1.45, 220
#: From where an object is seen, in the table-top frame: from the front right, from above.
TOWARDS_CAMERA = np.array([0.62, -0.62, 0.48])
#: Vertical field of view [deg], and the share of it that an object's bounding sphere fills.
FIELD_DEG, FILL = 30.0, 0.95
#: Colours of the status (Okabe and Ito: safe for the colour-blind).
STATUS_COLOURS = {"fit": "#009E73", "repaired": "#B07A00", "refused": "#D55E00"}
#: Characters of a name that fit above a picture, and of a reason in a line of an empty one.
NAME, LINE = 24, 24


def object_sheet(rows: Sequence[AuditRow], png: Path, *, progress: Report = silent) -> None:
    """Draw the objects of an audit, as they stand in their files, each in its own scale.

    Args:
        rows: Of the audit; a refused mesh has its reason in place of a picture.
        png: The file to write.
        progress: Is told of each object.
    """
    # The page.
    across = min(ACROSS, len(rows))
    lines = -(-len(rows) // across)
    gap, caption, margin = 0.12, 0.36, 0.15
    width = across * EDGE + (across - 1) * gap + 2 * margin
    height = lines * (EDGE + caption) + 2 * margin
    figure = Figure(figsize=(width, height), facecolor="white")

    for i, row in enumerate(rows):
        line, column = divmod(i, across)
        left, top = margin + column * (EDGE + gap), margin + line * (EDGE + caption) + caption
        axes = add_axes(figure, left, top, EDGE, EDGE)
        hide_ticks(axes)
        if row.model is not None:
            axes.imshow(draw_object(row.model), interpolation="bilinear")
        else:
            axes.set_facecolor("#f4f1ee")
            axes.text(
                0.5, 0.5, _wrapped(row.notes[0]), transform=axes.transAxes, fontsize=4.6,
                color=INK, ha="center", va="center",
            )  # fmt: skip

        # Name, and status below it.
        status = row.status + (" !" if row.warnings else "")
        for text, height_above, colour in (
            (shortened(row.name, NAME), 1.135, INK),
            (status, 1.02, STATUS_COLOURS[row.status]),
        ):
            axes.text(
                0.0, height_above, text, transform=axes.transAxes, fontsize=6.2, color=colour,
                parse_math=False,
            )  # fmt: skip
        progress(i + 1, len(rows))
    save_figure(figure, png, dpi=150)


def draw_object(model: ObjectModel) -> npt.NDArray[np.float32]:
    """Return a picture (PIXELS, PIXELS, 3) of an object that stands as in its file, 0 to 1."""
    # Far enough that the sphere around the object fills the picture.
    radius = float(norm(model.half_extents))
    distance = radius / np.sin(np.deg2rad(FIELD_DEG) / 2.0) / FILL
    camera = CameraConfig(
        size=PIXELS, fov_y_deg=FIELD_DEG, near=0.02 * distance, far=20.0 * distance
    )

    height = float(model.half_extents[2])
    X_TO = make_pose(np.eye(3), [0.0, 0.0, height])
    back = TOWARDS_CAMERA / norm(TOWARDS_CAMERA)
    X_TC = make_pose(_looking_along(-back), X_TO[:3, 3] + distance * back)
    view = render(build_renderer(model, camera), X_TO, X_TC)
    return np.asarray(np.moveaxis(view.image[:3], 0, 2))


def _looking_along(z: Array) -> Array:
    """Return the rotation (3, 3) of a camera that looks along z (3,), with world up in the image.

    Camera axes are OpenCV's: +x right, +y down, +z forward.
    """
    x = np.cross(z, [0.0, 0.0, 1.0])
    x = x / norm(x)
    return np.column_stack((x, np.cross(z, x), z))


def _wrapped(text: str) -> str:
    """Return a reason in lines that fit into a picture's place."""
    lines = [""]
    for word in text.split():
        if len(lines[-1]) + len(word) >= LINE and lines[-1]:
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}".strip()
    return "\n".join(lines[:12])
