"""From where grasps succeed: palm rays over the objects, and maps of approach directions.

In: attempts of some objects. Out: a figure. Needs matplotlib, not Drake.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle

from drakegrasp.frames import Array
from drakegrasp.pictures.charts import GROUPS
from drakegrasp.pictures.figures.approach_sphere import map_directions
from drakegrasp.pictures.figures.orthographic import (
    draw_object,
    draw_rays,
    finish_view,
    frame_of,
    triangles_in_view,
    view_rotation,
)
from drakegrasp.pictures.style import INK, add_axes, hide_ticks, shortened

#: Colour of attempts that failed.
FAILED = "#B8BDC4"
#: Rays and dots of a panel, at most.
MAX_RAYS, MAX_DOTS = 300, 3000
#: Heights above the table that have a circle on a map [deg].
CIRCLES_DEG = (60.0, 30.0, 0.0)
#: Half the edge of a map: what comes from a little below the horizon is still on it.
EXTENT = 1.24
#: Edge of a picture or a map, spaces, caption and head [inch]; objects in a row.
EDGE, GAP, BETWEEN, CAPTION, HEAD, ACROSS = 2.5, 0.05, 0.3, 0.28, 0.24, 2


@dataclass(frozen=True, kw_only=True, eq=False)
class ObjectApproaches:
    """An object, and from where it was approached.

    Attributes:
        name: Of the object.
        vertices, faces: (n, 3) in {O} [m] and (m, 3).
        R_TO: (3, 3), how it rests.
        attempts: Their number.
        directions: (a, 3) in {T}, from which palms came that found no grasp; without those whose
            palm ray misses.
        rays: (s, 2, 3) in {O}, of the successes: from the palm's origin to the surface [m].
        successes: (s, 3) in {T}, directions of the successes.
        groups: (s,), how each success holds: index into GROUPS.
    """

    name: str
    vertices: Array
    faces: npt.NDArray[np.int32]
    R_TO: Array
    attempts: int
    directions: Array
    rays: Array
    successes: Array
    groups: npt.NDArray[np.int64]


def approaches_figure(objects: Sequence[ObjectApproaches], *, left_out: int) -> Figure:
    """Return a picture and a map per object.

    Args:
        objects: What to draw, at least one.
        left_out: Number of objects with successes that are not drawn.
    """
    # The page: blocks of a picture and a map, below a head with the legend.
    across = min(ACROSS, len(objects))
    lines = -(-len(objects) // across)
    block = 2 * EDGE + GAP
    width = max(across * block + (across - 1) * BETWEEN + 0.3, 7.0)
    height = HEAD + lines * (CAPTION + EDGE) + 0.1
    figure = Figure(figsize=(width, height), facecolor="white")

    for i, item in enumerate(objects):
        line, column = divmod(i, across)
        left, top = 0.15 + column * (block + BETWEEN), HEAD + line * (CAPTION + EDGE) + CAPTION
        picture = add_axes(figure, left, top, EDGE, EDGE)
        _draw_picture(picture, item)
        _draw_map(add_axes(figure, left + EDGE + GAP, top, EDGE, EDGE), item)
        counts = f"{len(item.successes):,} of {item.attempts:,} attempts"
        picture.text(
            0.0, 1.02, f"{shortened(item.name, 30)}: {counts}", transform=picture.transAxes,
            fontsize=9.5, color=INK, parse_math=False,
        )  # fmt: skip

    # The head.
    dot = {"marker": "o", "linestyle": "none", "markeredgewidth": 0.0}
    marks = [Line2D([], [], color=c, label=g, markersize=6, **dot) for g, c in GROUPS.items()]  # type: ignore[arg-type]
    marks.append(Line2D([], [], color=FAILED, label="attempt that failed", markersize=4, **dot))  # type: ignore[arg-type]
    figure.legend(
        handles=marks, loc="upper left", bbox_to_anchor=(0.15 / width, 1.0 - 0.08 / height),
        ncols=len(marks), fontsize=9, frameon=False, borderaxespad=0.0, borderpad=0.0,
        handletextpad=0.1, columnspacing=1.2, labelcolor=INK,
    )  # fmt: skip
    if left_out:
        text = f"{left_out:,} objects with fewer successes are left out"
        figure.text(1.0 - 0.15 / width, 1.0 - 0.1 / height, text, fontsize=9, color=INK,
                    ha="right", va="top")  # fmt: skip
    return figure


def spread(count: int, most: int) -> npt.NDArray[np.int64]:
    """Return which of `count` things to draw: evenly spaced ones, `most` at most."""
    return np.linspace(0, count - 1, min(count, most)).round().astype(np.int64)


def _draw_picture(axes: Axes, item: ObjectApproaches) -> None:
    """Draw the object with the palm rays of its successes."""
    R_VO = view_rotation() @ item.R_TO
    triangles = triangles_in_view(item.vertices, item.faces, item.R_TO)
    shown = spread(len(item.rays), MAX_RAYS)
    rays, groups = item.rays[shown] @ R_VO.T, item.groups[shown]
    for number, colour in enumerate(GROUPS.values()):
        draw_rays(axes, rays[groups == number], colour, width=0.8, opacity=0.85)
    draw_object(axes, triangles)

    # A square about all of it.
    low, high = frame_of([triangles, rays])
    middle, half = (low + high) / 2.0, (high - low).max() / 2.0
    finish_view(axes, middle - half, middle + half)


def _draw_map(axes: Axes, item: ObjectApproaches) -> None:
    """Draw the map of directions: straight above in the middle, the horizon as a circle."""
    for height in CIRCLES_DEG:
        radius = np.sqrt(1.0 - np.sin(np.deg2rad(height)))
        horizon = height == CIRCLES_DEG[-1]
        axes.add_patch(Circle((0.0, 0.0), radius, facecolor="none", edgecolor="#8A9099",
                              linewidth=1.0 if horizon else 0.5, zorder=2))  # fmt: skip
        axes.text(0.0, -radius, f"{height:.0f}°", fontsize=7, color="#6A7078", ha="center",
                  va="center", zorder=5,
                  bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.6})  # fmt: skip
    for place, text in (((EXTENT - 0.06, 0.0), "+Tx"), ((0.0, EXTENT - 0.06), "+Ty")):
        axes.text(*place, text, fontsize=7.5, color="#6A7078", ha="center", va="center", zorder=5)

    # Failures are a ground of dots; successes stand on it.
    failed = map_directions(item.directions[spread(len(item.directions), MAX_DOTS)])
    axes.plot(*failed.T, "o", color=FAILED, markersize=1.7, markeredgewidth=0.0, zorder=1,
              rasterized=len(failed) > 500)  # fmt: skip
    places = map_directions(item.successes)
    for number, colour in enumerate(GROUPS.values()):
        axes.plot(*places[item.groups == number].T, "o", color=colour, markersize=4.2,
                  markeredgecolor="white", markeredgewidth=0.4, zorder=4)  # fmt: skip
    axes.set(xlim=(-EXTENT, EXTENT), ylim=(-EXTENT, EXTENT), aspect="equal")
    hide_ticks(axes)
