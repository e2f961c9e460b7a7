"""The paper's Figure 2: palm poses around an object, by surface normals and by rotations.

In: a mesh, and palm rays by method. Out: a figure. Needs matplotlib, not Drake.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from drakegrasp.frames import Array
from drakegrasp.pictures.figures.approach_sphere import NEAR_DEG
from drakegrasp.pictures.figures.orthographic import (
    draw_object,
    draw_rays,
    finish_view,
    frame_of,
    triangles_in_view,
    view_rotation,
)
from drakegrasp.pictures.style import INK, add_axes, shortened

#: Colour of a palm's approach, as in the paper.
APPROACH = "#7B2FA8"
#: Width of a panel, space beside it, and height of its title and of a line of text [inch].
WIDE, MARGIN, TITLE, LINE = 3.9, 0.12, 0.34, 0.2


def palm_poses_figure(
    vertices: Array,
    faces: npt.NDArray[np.int32],
    rays: Mapping[str, Array],
    *,
    R_TO: npt.ArrayLike | None = None,
    captions: Mapping[str, str] | None = None,
    name: str = "",
) -> Figure:
    """Return the approach rays of palm poses to a mesh, a panel per method.

    Args:
        vertices: Of the mesh, (n, 3) in {O} [m].
        faces: Of the mesh, (m, 3).
        rays: By title, (r, 2, 3): from the palm's origin to the surface, in {O} [m].
        R_TO: (3, 3), how the object rests; as in its file if None.
        captions: By the same titles, the text below a panel.
        name: Of the object, for the last line.
    """
    # One scale for all panels, which shows every ray.
    R_TO = np.eye(3) if R_TO is None else np.asarray(R_TO)
    triangles = triangles_in_view(vertices, faces, R_TO)
    seen = {title: ends @ (view_rotation() @ R_TO).T for title, ends in rays.items()}
    low, high = frame_of([triangles, *seen.values()])

    # The page: panels side by side over their captions.
    captions = captions or {}
    lines = max((text.count("\n") + 1 for text in captions.values()), default=0)
    foot = LINE if name else 0.0
    tall = float(WIDE * (high[1] - low[1]) / (high[0] - low[0]))
    width = len(rays) * (WIDE + MARGIN) + MARGIN
    height = TITLE + tall + LINE * lines + foot + MARGIN
    figure = Figure(figsize=(width, height), facecolor="white")

    for k, (title, ends) in enumerate(seen.items()):
        axes = add_axes(figure, MARGIN + k * (WIDE + MARGIN), TITLE, WIDE, tall)
        # The object is translucent, as in the paper: rays behind it shine through.
        draw_rays(axes, ends, APPROACH, width=0.6, opacity=0.6, through=0.25)
        draw_object(axes, triangles)
        finish_view(axes, low, high)
        axes.set_title(title, fontsize=11, color=INK, pad=6)
        axes.text(0.5, 0.0, captions.get(title, ""), transform=axes.transAxes, fontsize=9,
                  color=INK, ha="center", va="top", linespacing=1.5, parse_math=False)  # fmt: skip
    if name:
        text = f"{shortened(name, 40)}; rays: from the largest stand-off to the surface"
        figure.text(MARGIN / width, 0.06 / height, text, fontsize=8, color=INK, va="bottom",
                    parse_math=False)  # fmt: skip
    return figure


def caption(of_object: Mapping[str, Any], of_all: Mapping[str, Any] | None, objects: int) -> str:
    """Return what stands below a panel.

    Args:
        of_object: Numbers of the sampler on the object that is drawn, see `samplers`.
        of_all: On all objects; None if it was only drawn.
        objects: Their number.
    """
    lines = [
        f"{of_object['palm_rays']:,} of {of_object['palm_poses']:,} palm rays meet the object",
        f"{_percent(of_object)} of the directions from above lie within {NEAR_DEG:g}° of one",
        _rate(of_object, "successes per 1,000 attempts"),
    ]
    if of_all is not None and objects > 1:
        lines.append(f"all {objects:,} objects: {_percent(of_all)}; {_rate(of_all, 'per 1,000')}")
    return "\n".join(lines)


def _percent(numbers: Mapping[str, Any]) -> str:
    return f"{100.0 * numbers['coverage']:.0f} %"


def _rate(numbers: Mapping[str, Any], unit: str) -> str:
    rate = numbers["successes_per_1000_attempts"]
    if rate is None:
        return "not tried in this dataset"
    return f"{rate:.1f} {unit} ({numbers['successes']:,} of {numbers['attempts']:,})"
