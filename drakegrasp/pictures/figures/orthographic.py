"""An object on the table with rays around it, seen in parallel projection.

In: triangles and rays over the table. Out: axes of a figure. Needs matplotlib, not Drake.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection

from drakegrasp.frames import Array
from drakegrasp.pictures.style import hide_ticks

#: From where the reader looks: about the vertical from +x, and above the horizontal [rad].
AZIMUTH, ELEVATION = np.deg2rad(-55.0), np.deg2rad(20.0)
#: Direction of the light in the view: from the upper left and from the front.
LIGHT = np.array([-0.48, 0.6, 0.64])
OBJECT_COLOUR = np.array([0.70, 0.77, 0.86])


def view_rotation() -> Array:
    """Return R_VT (3, 3) of the view {V}: its axes point right, up, and towards the reader."""
    out = np.array([np.cos(AZIMUTH), np.sin(AZIMUTH), 0.0])
    right, towards = np.cross([0.0, 0.0, 1.0], out), np.cos(ELEVATION) * out
    towards[2] = np.sin(ELEVATION)
    return np.vstack([right, np.cross(towards, right), towards])


def frame_of(shapes: Sequence[Array], *, border: float = 0.03) -> tuple[Array, Array]:
    """Return the lower left and the upper right corner (2,) of points seen in the view [m].

    Args:
        shapes: Arrays (..., 3) of points in {V}.
        border: Of the picture, as a share of its size.
    """
    points = np.concatenate([shape.reshape(-1, 3)[:, :2] for shape in shapes])
    low, high = points.min(axis=0), points.max(axis=0)
    edge = border * (high - low).max()
    return low - edge, high + edge


def draw_object(axes: Axes, triangles: Array) -> None:
    """Draw triangles (m, 3, 3) in {V}, shaded by one light; those that face away are left out."""
    # The farthest first, so that nearer ones cover them.
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    front = np.flatnonzero(normals[:, 2] > 0.0)
    front = front[np.argsort(triangles[front, :, 2].mean(axis=1), kind="stable")]

    # Thousands of triangles are pixels in an SVG, too: else no program could open it. Edges close
    # the seams.
    shade = 0.55 + 0.45 * np.clip(normals[front] @ LIGHT, 0.0, 1.0)
    colours = np.outer(shade, OBJECT_COLOUR)
    axes.add_collection(
        PolyCollection(list(triangles[front, :, :2]), facecolors=colours, edgecolors="face",
                       linewidths=0.4, zorder=2, rasterized=True)
    )  # fmt: skip


def draw_rays(
    axes: Axes, rays: Array, colour: str, *, width: float, opacity: float, through: float = 0.0
) -> None:
    """Draw rays (n, 2, 3) in {V}: those behind the object's middle stand behind it.

    Args:
        axes: Where to draw.
        rays: The rays [m].
        colour: Of the rays.
        width: Of a ray [points].
        opacity: Of a ray, 0 to 1.
        through: That of what shines through the object.
    """
    behind = rays[:, :, 2].mean(axis=1) < 0.0
    for part, order, alpha in (
        (rays[behind], 1.0, opacity),
        (rays[behind], 2.5, through),
        (rays[~behind], 3.0, opacity),
    ):
        if len(part) and alpha > 0.0:
            lines = LineCollection(list(part[..., :2]), colors=colour, linewidths=width)
            lines.set(alpha=alpha, zorder=order)
            axes.add_collection(lines)


def finish_view(axes: Axes, low: Array, high: Array) -> None:
    """Set what axes show, in equal scales [m]."""
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    hide_ticks(axes)


def triangles_in_view(vertices: Array, faces: npt.NDArray[np.int32], R_TO: Array) -> Array:
    """Return the triangles (m, 3, 3) of a mesh in {V}, about the origin of {O} [m].

    Args:
        vertices: (n, 3) in {O} [m].
        faces: (m, 3).
        R_TO: (3, 3), how the object rests.
    """
    return np.asarray((vertices @ (view_rotation() @ R_TO).T)[faces])
