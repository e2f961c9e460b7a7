"""Pictures with frames, lines, points and arrows of the world drawn over them.

In: pictures with their cameras. Out: axes of a figure. Needs matplotlib, not Drake.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.patheffects import withStroke

from drakegrasp.frames import Array, invert_pose, transform_points
from drakegrasp.pictures.style import FINGER_COLOURS, INK, hide_ticks
from drakegrasp.vision.camera import Picture

#: Colours of the x, y and z axes of a frame.
AXIS_COLOURS = ("#D62728", "#2CA02C", "#1F4FD8")
#: Distance of a label from its point [points].
LABEL_REACH = 13.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Triad:
    """A frame {A} to draw over a picture.

    Attributes:
        label: Its letter.
        X_WA: (4, 4), its pose.
        length: Of its axes [m].
    """

    label: str
    X_WA: Array
    length: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Panel:
    """A picture, and what to draw over it.

    Attributes:
        title: Text above the picture.
        picture: The picture.
        triads: Frames.
        lines: Dashed polylines, each (n, 3) in {W} [m].
        strokes: By colour, polylines (n, 3) in {W} [m], drawn as they are.
        points: By name, points (3,) in {W} [m].
        arrows: By name, tail (3,) and tip (3,) in {W} [m], drawn in the colours of the fingers.
    """

    title: str
    picture: Picture
    triads: Sequence[Triad] = ()
    lines: Sequence[Array] = ()
    strokes: Mapping[str, Sequence[Array]] = field(default_factory=dict)
    points: Mapping[str, Array] = field(default_factory=dict)
    arrows: Mapping[str, tuple[Array, Array]] = field(default_factory=dict)


def draw_panel(axes: Axes, panel: Panel) -> None:
    """Draw lines, frames, points and arrows of a panel over its picture."""
    picture, halo = panel.picture, [withStroke(linewidth=3.0, foreground="white")]

    # Lines and frames.
    for line in panel.lines:
        axes.plot(*picture.pixels(line).T, color=INK, linewidth=0.9, linestyle=(0, (5, 3)))
    for colour, strokes in panel.strokes.items():
        for line in strokes:
            axes.plot(*picture.pixels(line).T, color=colour, linewidth=1.4, path_effects=halo,
                      solid_capstyle="round")  # fmt: skip
    for triad in panel.triads:
        tips = triad.X_WA[:3, 3] + triad.length * triad.X_WA[:3, :3].T
        # Draw the farthest axis first, so that nearer ones cover it.
        depths = transform_points(invert_pose(picture.X_WC), tips)[:, 2]
        for k in np.argsort(-depths):
            ends = picture.pixels(np.vstack([triad.X_WA[:3, 3], tips[k]]))
            axes.plot(*ends.T, color=AXIS_COLOURS[k], linewidth=2.2, solid_capstyle="round",
                      path_effects=halo, zorder=5)  # fmt: skip

    # Contacts and other points.
    for i, (start, end) in enumerate(panel.arrows.values()):
        colour = FINGER_COLOURS[i % len(FINGER_COLOURS)]
        tail, tip = picture.pixels(np.vstack([start, end]))
        axes.annotate("", tip, tail, zorder=6, arrowprops={
            "arrowstyle": "-|>", "color": colour, "linewidth": 2.0, "shrinkA": 0.0, "shrinkB": 0.0,
            "path_effects": halo, "mutation_scale": 11.0})  # fmt: skip
        axes.plot(*tail, "o", color=colour, markersize=6.5, markeredgecolor="white", zorder=7)
    for point in panel.points.values():
        axes.plot(*picture.pixels(point[None])[0], "o", color=INK, markersize=6.0,
                  markeredgecolor="white", zorder=7)  # fmt: skip

    # Labels, placed where they cover none of the above.
    labels = {triad.label: triad.X_WA[:3, 3] for triad in panel.triads}
    labels |= dict(panel.points) | {name: start for name, (start, _) in panel.arrows.items()}
    drawn = [
        t.X_WA[:3, 3] + f * t.length * t.X_WA[:3, :3].T for t in panel.triads for f in (0.5, 1)
    ]
    drawn += [np.linspace(start, end, 4) for start, end in panel.arrows.values()]
    anchors = {name: picture.pixels(p[None])[0] for name, p in labels.items()}
    _draw_labels(axes, anchors, picture.pixels(np.vstack([np.zeros((0, 3)), *drawn])))


def show_image(axes: Axes, image: npt.NDArray[np.uint8]) -> None:
    """Show an image whose pixel centres have whole coordinates."""
    axes.imshow(image, interpolation="antialiased")
    axes.set_xlim(-0.5, image.shape[1] - 0.5)
    axes.set_ylim(image.shape[0] - 0.5, -0.5)
    axes.set_autoscale_on(False)
    hide_ticks(axes)


def _draw_labels(axes: Axes, pixels: Mapping[str, Array], obstacles: Array) -> None:
    """Write names beside points, each on the side with the most room.

    Args:
        axes: That show the image.
        pixels: By name, (2,), the point that is labelled [px].
        obstacles: (n, 2), what labels should not cover [px].
    """
    # Distance of a label from its point, from points of the paper to pixels of the image.
    window = axes.get_window_extent()
    reach = LABEL_REACH * axes.figure.dpi / 72.0 * abs(np.ptp(axes.get_xlim())) / window.width
    angles = np.deg2rad(np.arange(0.0, 360.0, 30.0))
    directions = np.column_stack([np.cos(angles), np.sin(angles)])
    taken = np.vstack([obstacles, *pixels.values()])

    for name, pixel in pixels.items():
        places = pixel + reach * directions * [1.0 + 0.25 * len(name), 1.0]
        distances = np.linalg.norm(places[:, None] - taken[None], axis=2)
        # The nearest obstacle counts most, the next two count as well.
        nearest = np.sort(distances, axis=1)[:, :3]
        place = places[np.argmax(nearest @ [4.0, 2.0, 1.0][: nearest.shape[1]])]
        taken = np.vstack([taken, place])
        axes.text(
            place[0], place[1], name, ha="center", va="center", fontsize=10.5, weight="bold",
            color="black", zorder=9, path_effects=[withStroke(linewidth=3.0, foreground="white")],
        )  # fmt: skip
