"""The figures of the README and the docs. Needs matplotlib, not Drake.

In: data files, meshes, and pictures with their cameras (from `trial_pictures`). Out: PNG files:
one trial from start to lift, all frames, and the candidates of a mesh.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

from drakegrasp.dataset.reader import GraspDataset, Sample
from drakegrasp.dataset.schema import SPLITS
from drakegrasp.errors import DataError
from drakegrasp.frames import Array, invert_pose, transform_points
from drakegrasp.vision.camera import Picture
from drakegrasp.visualization.style import (
    FINGER_COLOURS,
    INK,
    add_axes,
    draw_colour_bar,
    draw_finger_legend,
    draw_sample,
    hide_ticks,
    read_far,
    save_figure,
)

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
        points: By name, points (3,) in {W} [m].
        arrows: By name, tail (3,) and tip (3,) in {W} [m], drawn in the colours of the fingers.
    """

    title: str
    picture: Picture
    triads: Sequence[Triad]
    lines: Sequence[Array] = ()
    points: Mapping[str, Array] = field(default_factory=dict)
    arrows: Mapping[str, tuple[Array, Array]] = field(default_factory=dict)


def hero_figure(
    oto: Path, otm: Path, trial_id: int, pictures: Sequence[Picture], png: Path
) -> None:
    """Draw one trial: three pictures in a row, and below them the images of both cameras.

    Args:
        oto: `grasping_oto.hdf5`.
        otm: `grasping_otm.hdf5` of the same dataset.
        trial_id: A trial that became a sample.
        pictures: Of the trial placed, closed and lifted, from `trial_pictures.render_trial`.
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
        _show_image(axes, picture.image)
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
    """Draw panels side by side. The last is a camera's image; its pixel axes are drawn too.

    Args:
        panels: From `trial_pictures.frames_panels`.
        png: The file to write.
    """
    # The page [inch]: all panels of one height but the last, which is smaller.
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
        _show_image(axes, panel.picture.image)
        axes.set_title(panel.title, fontsize=9.5, color=INK, loc="left", pad=5)
        draw_panel(axes, panel)

    # Below the last one there is room for the legend.
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


def draw_panel(axes: Axes, panel: Panel) -> None:
    """Draw lines, frames, points and arrows of a panel over its picture."""
    picture, halo = panel.picture, [withStroke(linewidth=3.0, foreground="white")]

    # Lines and frames.
    for line in panel.lines:
        axes.plot(*picture.pixels(line).T, color=INK, linewidth=0.9, linestyle=(0, (5, 3)))
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
    _draw_labels(axes, anchors, picture.pixels(np.vstack(drawn)))


def candidates_figure(
    vertices: Array, faces: npt.NDArray[np.int32], rays: Mapping[str, Array], png: Path
) -> None:
    """Draw the approach rays of palm poses to a mesh, a panel per method.

    Args:
        vertices: Of the mesh, (n, 3) [m].
        faces: Of the mesh, (m, 3).
        rays: By title, (r, 2, 3): from the palm's origin to the surface, in {O} [m].
        png: The file to write.
    """
    # An orthographic view {V}: its axes point right, up, and towards the reader.
    azimuth, elevation = np.deg2rad(-55.0), np.deg2rad(20.0)
    out = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    right, towards = np.cross([0.0, 0.0, 1.0], out), np.cos(elevation) * out
    towards[2] = np.sin(elevation)
    R_VO = np.vstack([right, np.cross(towards, right), towards])

    # Triangles that face the reader, the farthest first, shaded by one light.
    triangles = vertices[faces] @ R_VO.T
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    front = np.flatnonzero(normals[:, 2] > 0.0)
    front = front[np.argsort(triangles[front, :, 2].mean(axis=1))]
    shade = 0.55 + 0.45 * np.clip(normals[front] @ [-0.48, 0.6, 0.64], 0.0, 1.0)
    colours = np.column_stack([np.outer(shade, [0.70, 0.77, 0.86]), np.full(len(front), 0.8)])

    # One scale for all panels, which shows every ray.
    seen = {title: ends @ R_VO.T for title, ends in rays.items()}
    every = np.concatenate([triangles, *(ends[:, [0, 1, 1]] for ends in seen.values())])[..., :2]
    low, high = every.min(axis=(0, 1)), every.max(axis=(0, 1))
    wide, margin, head = 3.6, 0.1, 0.3  # [inch]
    tall = float(wide * (high[1] - low[1]) / (high[0] - low[0]))
    figure = Figure(
        figsize=(len(rays) * (wide + margin) + margin, tall + head + margin), facecolor="white"
    )

    for k, (title, ends) in enumerate(seen.items()):
        axes = add_axes(figure, margin + k * (wide + margin), head, wide, tall)
        # The mesh is translucent: rays behind it are drawn first.
        behind = ends[:, :, 2].mean(axis=1) < 0.0
        for part, order in ((ends[behind], 1), (ends[~behind], 3)):
            axes.add_collection(LineCollection(part[..., :2], colors="#7B2FA8", linewidths=0.6,
                                               alpha=0.6, zorder=order))  # fmt: skip
        axes.add_collection(
            PolyCollection(triangles[front, :, :2], facecolors=colours, antialiaseds=False,
                           edgecolors="none", zorder=2)
        )  # fmt: skip
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        axes.set_title(title, fontsize=10.5, color=INK, pad=5)
        hide_ticks(axes)
    save_figure(figure, png, dpi=130)


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
        place = places[np.argmax(np.sort(distances, axis=1)[:, :3] @ [4.0, 2.0, 1.0])]
        taken = np.vstack([taken, place])
        axes.text(
            place[0], place[1], name, ha="center", va="center", fontsize=10.5, weight="bold",
            color="black", zorder=9, path_effects=[withStroke(linewidth=3.0, foreground="white")],
        )  # fmt: skip


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


def _show_image(axes: Axes, image: npt.NDArray[np.uint8]) -> None:
    """Show an image whose pixel centres have whole coordinates."""
    axes.imshow(image, interpolation="antialiased")
    axes.set_xlim(-0.5, image.shape[1] - 0.5)
    axes.set_ylim(image.shape[0] - 0.5, -0.5)
    axes.set_autoscale_on(False)
    hide_ticks(axes)
