"""Directions from which palms approached objects: coverage, rays around objects, and maps.

Objects on the table are drawn in parallel projection, in a view {V} whose axes point right, up and
towards the reader. Input: attempts at some objects. Output: figures. Needs matplotlib, but not
Drake.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from scipy.spatial import KDTree

from drakegrasp.config import Config
from drakegrasp.dataset.prepared_objects import load_prepared
from drakegrasp.dataset.statistics import distinct_samples
from drakegrasp.dataset.trials import Trials
from drakegrasp.errors import counted
from drakegrasp.filters import Removal
from drakegrasp.frames import Array, unpack_pose
from drakegrasp.outcomes import Outcome
from drakegrasp.pictures.charts import GROUPS
from drakegrasp.pictures.style import (
    INK,
    add_axes,
    draw_legend,
    hide_ticks,
    new_page,
    shortened,
    write_beside,
)

#: A direction is covered if an approach is at most this far from it [deg].
NEAR_DEG = 10.0
#: Number of tested directions on the hemisphere above the table.
PROBES = 2000
#: Direction of the reader: about the vertical from +x, and above the horizontal [rad].
AZIMUTH, ELEVATION = np.deg2rad(-55.0), np.deg2rad(20.0)
#: Direction of the light in the view: from the upper left and from the front.
LIGHT = np.array([-0.48, 0.6, 0.64])
OBJECT_COLOUR = np.array([0.70, 0.77, 0.86])
#: Colour of attempts that failed.
FAILED = "#B8BDC4"
#: How a sample holds, from a sample that is no precision grasp to a stable one.
HOLDS = ("samples", "precision", "stable")
#: Maximum numbers of rays and dots in a panel.
MAX_RAYS, MAX_DOTS = 300, 3000
#: Elevations above the table that have a circle on a map [deg].
CIRCLES_DEG = (60.0, 30.0, 0.0)
#: Half the edge of a map, which also shows directions slightly below the horizon.
EXTENT = 1.24
#: Edge of a picture or a map, spaces, caption, head and foot [inch]; number of objects in a row.
EDGE, GAP, BETWEEN, CAPTION, HEAD, FOOT, ACROSS = 2.5, 0.05, 0.3, 0.28, 0.24, 0.34, 2


def approach_directions(X_TO: Array, X_OG: Array) -> Array:
    """Return the unit directions (n, 3) in {T} from which palms (n, 4, 4) approach: -Gz."""
    return np.asarray(-X_OG[:, :3, 2] @ X_TO[:3, :3].T)


def coverage(directions: Array) -> float:
    """Return the fraction of the hemisphere above the table that is near an approach direction.

    A tested direction is near an approach if the angle between them is at most NEAR_DEG. The tested
    directions are on a spiral that represents equal areas (Fibonacci lattice; Gonzalez 2010,
    Mathematical Geosciences 42).

    Args:
        directions: (n, 3), unit, in {T}.
    """
    if not len(directions):
        return 0.0
    i = np.arange(PROBES)
    height, turn = (i + 0.5) / PROBES, i * np.pi * (3.0 - np.sqrt(5.0))
    radius = np.sqrt(1.0 - height**2)
    probes = np.column_stack([radius * np.cos(turn), radius * np.sin(turn), height])

    # The chord of the angle, enlarged so that a direction at the limit does not depend on rounding.
    chord = 2.0 * np.sin(np.deg2rad(NEAR_DEG) / 2.0) + 1e-9
    distance, _ = KDTree(directions).query(probes)
    return float(np.count_nonzero(distance <= chord)) / PROBES


def map_directions(directions: Array) -> Array:
    """Return the positions (n, 2) of directions on Lambert's equal-area map about +Tz.

    Straight up is the origin, the horizon is the unit circle, and directions from below are outside
    of the circle.

    Args:
        directions: (n, 3), unit, in {T}.
    """
    # With the angle from +Tz, r = sqrt(2) sin(angle / 2), which is 1 at the horizon.
    across = np.hypot(directions[:, 0], directions[:, 1])
    r = np.sqrt(np.maximum(1.0 - directions[:, 2], 0.0))
    scale = np.divide(r, across, out=np.zeros_like(r), where=across > 1e-12)
    return np.asarray(directions[:, :2] * scale[:, None])


@dataclass(frozen=True, kw_only=True, eq=False)
class ObjectApproaches:
    """An object, and the directions from which it was approached.

    Attributes:
        name: Name of the object.
        vertices, faces: (n, 3) in {O} [m] and (m, 3).
        R_TO: (3, 3), orientation in which it rests.
        attempts: Number of attempts in this resting pose.
        distinct: Number of distinct grasps among the samples, see `distinct_samples`.
        elsewhere: Number of samples in other resting poses, which are not drawn.
        directions: (a, 3) in {T}, directions of palms that gave no sample, without those whose palm
            ray misses.
        rays: (s, 2, 3) in {O}, rays of the samples from the palm's origin to the surface [m]; of
            length 0 if a palm that was tried as it is does not look at the object.
        samples: (s, 3) in {T}, directions of the samples.
        holds: (s,), index into HOLDS of how each sample holds.
    """

    name: str
    vertices: Array
    faces: npt.NDArray[np.int32]
    R_TO: Array
    attempts: int
    distinct: int
    elsewhere: int
    directions: Array
    rays: Array
    samples: Array
    holds: npt.NDArray[np.int64]


def read_approaches(out: Path, name: str, config: Config) -> ObjectApproaches:
    """Return an object's approaches in the resting pose with most samples.

    Args:
        out: Directory of the dataset.
        name: Name of the object.
        config: Configuration of the object, see `Manifest.config_of`.

    Raises:
        DataError: If a file is missing or damaged.
    """
    # A picture shows one resting pose: that with the most samples.
    prepared = load_prepared(out, name, config)
    trials = Trials(out).where(object_name=name)
    resting, kept = trials["resting"], trials["removal"] == Removal.KEPT
    counts = np.bincount(resting[kept], minlength=1)
    pose = int(counts.argmax())
    own = trials[resting == pose]
    columns = own.columns(
        ("outcome", "removal", "X_OG", "candidate", "standoff_index", "precision", "stable")
    )
    outcome, removal, packed, candidate, standoff, precision, stable = columns.values()
    X_OG = unpack_pose(packed)

    # Attempts whose palm ray misses do not approach the object.
    won, approached = removal == Removal.KEPT, outcome != Outcome.RAY_MISS
    X_TO = prepared.resting_poses[pose]
    directions = approach_directions(X_TO, X_OG)
    standoffs = np.array(config.candidates.standoffs)[standoff[won]]
    reach = np.nan_to_num(prepared.candidates.palm_distance(candidate[won], standoffs))
    p_OG, z_O = X_OG[won, :3, 3], X_OG[won, :3, 2]
    return ObjectApproaches(
        name=name,
        vertices=prepared.model.visual_vertices,
        faces=prepared.model.visual_faces,
        R_TO=X_TO[:3, :3],
        attempts=len(outcome),
        distinct=len(distinct_samples(own)),
        elsewhere=int(counts.sum() - counts[pose]),
        directions=directions[approached & ~won],
        rays=np.stack([p_OG, p_OG + reach[:, None] * z_O], axis=1),
        samples=directions[won],
        holds=(precision[won].astype(np.int64) + stable[won]),
    )


def approaches_figure(objects: Sequence[ObjectApproaches], *, left_out: int) -> Figure:
    """Return a figure with a picture and a map for each object.

    Args:
        objects: Objects to draw, at least one.
        left_out: Number of objects with samples that are not drawn.
    """
    # The page: blocks of a picture and a map, below a head with the legend.
    across = min(ACROSS, len(objects))
    lines = -(-len(objects) // across)
    block = 2 * EDGE + GAP
    width = max(across * block + (across - 1) * BETWEEN + 0.3, 7.0)
    height = HEAD + lines * (CAPTION + EDGE) + FOOT
    figure = new_page(width, height)

    for i, item in enumerate(objects):
        line, column = divmod(i, across)
        left, top = 0.15 + column * (block + BETWEEN), HEAD + line * (CAPTION + EDGE) + CAPTION
        picture = add_axes(figure, left, top, EDGE, EDGE)
        _draw_picture(picture, item)
        _draw_map(add_axes(figure, left + EDGE + GAP, top, EDGE, EDGE), item)
        write_beside(picture, 0.0, 1.02, f"{shortened(item.name, 24)}: {_counts(item)}", 8.5)

    # The head, and below the drawings what they show.
    colours = {**{name: GROUPS[name] for name in HOLDS}, "attempts without a sample": FAILED}
    marks = [
        Line2D([], [], color=colour, label=name, markersize=6 if name in HOLDS else 4, marker="o",
               linestyle="none", markeredgewidth=0.0) for name, colour in colours.items()
    ]  # fmt: skip
    draw_legend(figure, marks, (0.15 / width, 1.0 - 0.08 / height), 9)
    text = "Each object in its resting pose with the most samples."
    if left_out:
        text += f" {counted(left_out, 'object')} with fewer samples not drawn."
    figure.text(0.15 / width, 0.08 / height, text, fontsize=8.5, color=INK, va="bottom")
    return figure


def _counts(item: ObjectApproaches) -> str:
    """Return the numbers of the samples and attempts that are drawn of an object."""
    shown, total = len(item.samples), len(item.samples) + item.elsewhere
    samples = counted(total, "sample")
    if item.elsewhere:
        samples = f"{shown:,} of {samples}"
    return f"{samples} ({item.distinct:,} distinct), {counted(item.attempts, 'attempt')}"


def spread(count: int, most: int) -> npt.NDArray[np.int64]:
    """Return the indices of at most `most` of `count` items, evenly spaced."""
    return np.linspace(0, count - 1, min(count, most)).round().astype(np.int64)


def _draw_picture(axes: Axes, item: ObjectApproaches) -> None:
    """Draw the object with the palm rays of its samples."""
    R_VO = view_rotation() @ item.R_TO
    triangles = triangles_in_view(item.vertices, item.faces, item.R_TO)
    shown = spread(len(item.rays), MAX_RAYS)
    rays, holds = item.rays[shown] @ R_VO.T, item.holds[shown]
    for number, name in enumerate(HOLDS):
        draw_rays(axes, rays[holds == number], GROUPS[name])
    draw_object(axes, triangles)

    # A square around everything.
    low, high = frame_of([triangles, rays])
    middle, half = (low + high) / 2.0, (high - low).max() / 2.0
    finish_view(axes, middle - half, middle + half)


def _draw_map(axes: Axes, item: ObjectApproaches) -> None:
    """Draw the map of directions: straight up at the centre, the horizon as a circle."""
    for height in CIRCLES_DEG:
        radius = np.sqrt(1.0 - np.sin(np.deg2rad(height)))
        horizon = height == CIRCLES_DEG[-1]
        axes.add_patch(Circle((0.0, 0.0), radius, facecolor="none", edgecolor="#8A9099",
                              linewidth=1.0 if horizon else 0.5, zorder=2))  # fmt: skip
        axes.text(0.0, -radius, f"{height:.0f}°", fontsize=7, color="#6A7078", ha="center",
                  va="center", zorder=3,
                  bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.6})  # fmt: skip
    for place, text in (((EXTENT - 0.06, 0.0), "+Tx"), ((0.0, EXTENT - 0.06), "+Ty")):
        axes.text(*place, text, fontsize=7.5, color="#6A7078", ha="center", va="center", zorder=5)

    # Attempts without a sample are dots in the background; samples are drawn over them.
    failed = map_directions(item.directions[spread(len(item.directions), MAX_DOTS)])
    axes.plot(*failed.T, "o", color=FAILED, markersize=1.7, markeredgewidth=0.0, zorder=1,
              rasterized=len(failed) > 500)  # fmt: skip
    places = map_directions(item.samples)
    for number, name in enumerate(HOLDS):
        axes.plot(*places[item.holds == number].T, "o", color=GROUPS[name], markersize=4.2,
                  markeredgecolor="white", markeredgewidth=0.4, zorder=4)  # fmt: skip
    axes.set(xlim=(-EXTENT, EXTENT), ylim=(-EXTENT, EXTENT), aspect="equal")
    hide_ticks(axes)


# An object on the table with rays around it, in parallel projection.


def view_rotation() -> Array:
    """Return R_VT (3, 3) of the view {V}, whose axes point right, up, and towards the reader."""
    out = np.array([np.cos(AZIMUTH), np.sin(AZIMUTH), 0.0])
    right, towards = np.cross([0.0, 0.0, 1.0], out), np.cos(ELEVATION) * out
    towards[2] = np.sin(ELEVATION)
    return np.vstack([right, np.cross(towards, right), towards])


def frame_of(shapes: Sequence[Array], *, border: float = 0.03) -> tuple[Array, Array]:
    """Return the lower left and the upper right corners (2,) of points seen in the view [m].

    Args:
        shapes: Arrays (..., 3) of points in {V}.
        border: Border of the picture, as a fraction of its size.
    """
    points = np.concatenate([shape.reshape(-1, 3)[:, :2] for shape in shapes])
    low, high = points.min(axis=0), points.max(axis=0)
    edge = border * (high - low).max()
    return low - edge, high + edge


def draw_object(axes: Axes, triangles: Array) -> None:
    """Draw triangles (m, 3, 3) in {V} with shading; triangles that face away are left out."""
    # The farthest come first, so that nearer ones cover them.
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    front = np.flatnonzero(normals[:, 2] > 0.0)
    front = front[np.argsort(triangles[front, :, 2].mean(axis=1), kind="stable")]

    # Thousands of triangles are rasterized even in an SVG, since no program could open it
    # otherwise. Edges close the seams.
    shade = 0.55 + 0.45 * np.clip(normals[front] @ LIGHT, 0.0, 1.0)
    colours = np.outer(shade, OBJECT_COLOUR)
    axes.add_collection(
        PolyCollection(list(triangles[front, :, :2]), facecolors=colours, edgecolors="face",
                       linewidths=0.4, zorder=2, rasterized=True)
    )  # fmt: skip


def draw_rays(axes: Axes, rays: Array, colour: str) -> None:
    """Draw rays (n, 2, 3) [m] in {V}; those behind the object's centre are behind the object."""
    behind = rays[:, :, 2].mean(axis=1) < 0.0
    for part, order in ((rays[behind], 1.0), (rays[~behind], 3.0)):
        if len(part):
            lines = LineCollection(list(part[..., :2]), colors=colour, linewidths=0.8)
            lines.set(alpha=0.85, zorder=order)
            axes.add_collection(lines)


def finish_view(axes: Axes, low: Array, high: Array) -> None:
    """Set the range that axes show, with equal scales [m]."""
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    hide_ticks(axes)


def triangles_in_view(vertices: Array, faces: npt.NDArray[np.int32], R_TO: Array) -> Array:
    """Return the triangles (m, 3, 3) of a mesh in {V}, relative to the origin of {O} [m].

    Args:
        vertices: (n, 3) in {O} [m].
        faces: (m, 3).
        R_TO: (3, 3), orientation in which the object rests.
    """
    return np.asarray((vertices @ (view_rotation() @ R_TO).T)[faces])
