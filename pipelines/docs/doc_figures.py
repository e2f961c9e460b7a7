"""The figures of the README and the docs. They need matplotlib, but not Drake.

Input: data files, and pictures with their cameras (from `trial_pictures`). Output: PNG files, one
of a trial from start to lift and one of all frames.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

from drakegrasp.dataset.reader import GraspDataset, Sample
from drakegrasp.dataset.schema import SPLITS
from drakegrasp.errors import DataError
from drakegrasp.frames import Array, invert_pose, transform_points
from drakegrasp.pictures.style import (
    INK,
    add_axes,
    draw_colour_bar,
    draw_finger_legend,
    draw_marks,
    draw_sample,
    read_far,
    save_figure,
    show_image,
)
from drakegrasp.vision.camera import Picture

#: Colours of the x, y and z axes of a frame.
AXIS_COLOURS = ("#D62728", "#2CA02C", "#1F4FD8")


class Triad(NamedTuple):
    """A frame {A} to draw over a picture.

    Attributes:
        label: Letter of the frame.
        X_WA: (4, 4), pose of the frame.
        length: Length of its axes [m].
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
        triads: Frames to draw.
        lines: Dashed polylines, each (n, 3) in {W} [m].
        points: Points (3,) in {W} [m], by name.
        arrows: Tail (3,) and tip (3,) of each arrow in {W} [m], by name; drawn in the colours of
            the fingers.
    """

    title: str
    picture: Picture
    triads: Sequence[Triad] = ()
    lines: Sequence[Array] = ()
    points: Mapping[str, Array] = field(default_factory=dict)
    arrows: Mapping[str, tuple[Array, Array]] = field(default_factory=dict)


def draw_panel(axes: Axes, panel: Panel) -> None:
    """Draw the lines, frames, points and arrows of a panel over its picture."""
    picture, halo = panel.picture, [withStroke(linewidth=3.0, foreground="white")]
    for line in panel.lines:
        axes.plot(*picture.pixels(line).T, color=INK, linewidth=0.9, linestyle=(0, (5, 3)))
    for triad in panel.triads:
        tips = triad.X_WA[:3, 3] + triad.length * triad.X_WA[:3, :3].T
        # Draw the farthest axis first, so that nearer axes cover it.
        depths = transform_points(invert_pose(picture.X_WC), tips)[:, 2]
        for k in np.argsort(-depths):
            ends = picture.pixels(np.vstack([triad.X_WA[:3, 3], tips[k]]))
            axes.plot(*ends.T, color=AXIS_COLOURS[k], linewidth=2.2, solid_capstyle="round",
                      path_effects=halo, zorder=5)  # fmt: skip
    draw_marks(
        axes,
        picture,
        points=panel.points,
        arrows=panel.arrows,
        labels={triad.label: triad.X_WA[:3, 3] for triad in panel.triads},
        obstacles=[
            t.X_WA[:3, 3] + f * t.length * t.X_WA[:3, :3].T for t in panel.triads for f in (0.5, 1)
        ],
    )


def hero_figure(
    oto: Path, otm: Path, trial_id: int, pictures: Sequence[Picture], png: Path
) -> None:
    """Draw one trial: three pictures in a row, and below them the images of both cameras.

    Args:
        oto: `grasping_oto.hdf5`.
        otm: `grasping_otm.hdf5` of the same dataset.
        trial_id: A trial that became a sample.
        pictures: Pictures of the trial placed, closed and lifted, from
            `trial_pictures.render_trial`.
        png: The file to write.

    Raises:
        DataError: If the trial is not a sample.
    """
    # The page [inch]: a row of three pictures above a row of six images.
    top, gap, between, margin = 3.0, 0.04, 0.12, 0.1
    width = 3 * top + 2 * gap + 2 * margin
    edge = (width - 2 * margin - 4 * gap - between) / 6
    height = margin + top + 0.3 + edge + 0.38
    figure = Figure(figsize=(width, height), facecolor="white")

    # The pictures.
    words = ("place", "close", "lift")
    for k, (picture, word) in enumerate(zip(pictures, words, strict=True)):
        axes = add_axes(figure, margin + k * (top + gap), margin, top, top)
        show_image(axes, picture.image)
        axes.text(0.035, 0.93, f"{k + 1}  {word}", transform=axes.transAxes, fontsize=13,
                  color=INK, weight="bold", va="center")  # fmt: skip

    # Colour, depth and mask of both cameras, with the same scale of depths.
    line = margin + top + 0.3
    files = {"oto: the camera rolls with the palm": oto, "otm: world up is up": otm}
    samples = {title: find_sample(path, trial_id) for title, path in files.items()}
    near = min(float(sample.image[3].min()) for sample, _ in samples.values())
    far = read_far(oto)
    for k, (title, (sample, K)) in enumerate(samples.items()):
        left = margin + k * (3 * edge + 2 * gap + between)
        axes_of_sample = [
            add_axes(figure, left + i * (edge + gap), line, edge, edge) for i in range(3)
        ]
        draw_sample(axes_of_sample, sample, K, near=near, far=far)
        axes_of_sample[0].text(0.0, 1.045, title, transform=axes_of_sample[0].transAxes,
                               fontsize=9, color=INK)  # fmt: skip

    # Colour bar and legend.
    bar = add_axes(figure, width - margin - 1.9, line + edge + 0.08, 1.9, 0.09)
    draw_colour_bar(figure, bar, near, far, size=7.5)
    corner = (margin / width, 0.26 / height)
    draw_finger_legend(figure, len(sample.grasp) // 6, corner, 8.5)
    save_figure(figure, png, dpi=150)


def find_sample(path: Path, trial_id: int) -> tuple[Sample, Array]:
    """Return the sample of a trial and the camera matrix K (3, 3) [px].

    Args:
        path: A data file.
        trial_id: Row of trials.hdf5.

    Raises:
        DataError: If the file has no sample of the trial.
    """
    for split in SPLITS:
        data = GraspDataset(path, split=split)
        rows = np.flatnonzero(data.column("trial_id") == trial_id)
        if len(rows):
            return data[int(rows[0])], data.K
    raise DataError(f"{path}: must have a sample of trial {trial_id}, got none")


def frames_figure(panels: Sequence[Panel], png: Path) -> None:
    """Draw panels side by side. The last panel is a camera's image, with its pixel axes.

    Args:
        panels: Panels from `trial_pictures.frames_panels`.
        png: The file to write.
    """
    # The page [inch]: all panels have the same height except the last one, which is smaller.
    high, gap, margin, head = 5.0, 0.15, 0.1, 0.3
    aspects = [p.picture.image.shape[1] / p.picture.image.shape[0] for p in panels]
    heights = [high] * (len(panels) - 1) + [0.62 * high]
    width = sum(a * h for a, h in zip(aspects, heights, strict=True))
    width += gap * (len(panels) - 1) + 2 * margin
    figure = Figure(figsize=(width, high + head + margin), facecolor="white")

    # The panels.
    left = margin
    for panel, aspect, tall in zip(panels, aspects, heights, strict=True):
        axes = add_axes(figure, left, head, aspect * tall, tall)
        left += aspect * tall + gap
        show_image(axes, panel.picture.image)
        axes.set_title(panel.title, fontsize=9.5, color=INK, loc="left", pad=5)
        draw_panel(axes, panel)

    # The legend is below the last panel, which is smaller.
    _draw_pixel_axes(axes)
    text = (
        "axes: x red, y green, z blue\n"
        "arrows: contacts Q1 .. Q3 and their unit\nnormals, out of the object\n"
        "Ocm: centre of mass\n"
        "dashed: p_WT = (0, 0, 0.65) m, the line from\n"
        "G to C, 0.25 m, and the camera's field of view"
    )
    axes.text(0.0, -0.06, text, transform=axes.transAxes, fontsize=9.5, color=INK, va="top",
              linespacing=1.5)  # fmt: skip
    save_figure(figure, png, dpi=130)


def _draw_pixel_axes(axes: Axes) -> None:
    """Draw the origin and the directions of pixel coordinates u and v."""
    halo = [withStroke(linewidth=3.0, foreground="white")]
    for tip in ((30.0, 0.0), (0.0, 30.0)):
        arrow = {"arrowstyle": "-|>", "color": INK, "shrinkA": 0.0, "shrinkB": 0.0,
                 "path_effects": halo, "linewidth": 1.6}  # fmt: skip
        axes.annotate("", tip, (0.0, 0.0), arrowprops=arrow)
    for x, y, text in ((34.0, 3.0, "u"), (3.5, 34.0, "v"), (10.0, 5.0, "(0, 0)")):
        axes.text(x, y, text, color=INK, fontsize=10, ha="center", va="center",
                  path_effects=halo)  # fmt: skip
