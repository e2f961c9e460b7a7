"""Figures of a dataset, drawn by matplotlib; no Drake.

In: data files, and pictures with their cameras (`snapshots` takes them). Out: PNG files.
Contacts are drawn where the camera matrix projects them: a dot per finger with a short
arrow along the outward normal; a dot is hollow where the object hides the contact.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import cycle, groupby, islice
from pathlib import Path

import h5py
import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import Colormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke

from drakegrasp.camera import project
from drakegrasp.dataset import GraspDataset, Sample
from drakegrasp.errors import DataError
from drakegrasp.frames import Array, invert_pose, transform_points
from drakegrasp.grasp import unpack_grasp
from drakegrasp.schema import SPLITS

#: Colours of the fingers in grasp order, told apart by the colour-blind too (Okabe and Ito).
FINGER_COLOURS = ("#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00")
#: Colours of the x, y and z axes of a frame.
AXIS_COLOURS = ("#D62728", "#2CA02C", "#1F4FD8")
#: Length of the arrows along the normals [m].
ARROW = 0.03
#: A contact this much behind what the depth image shows is hidden [m]; fingertips give way
#: by less.
HIDDEN = 0.006
#: Distance of a label from its point [points].
LABEL_REACH = 13.0
#: Samples side by side in a contact sheet, and an image's edge in it [inch].
ACROSS, EDGE = 3, 1.12
_INK = "#333333"


@dataclass(frozen=True, kw_only=True, eq=False)
class Picture:
    """An image and the camera that took it.

    Attributes:
        image: (height, width, 3) uint8.
        K: Camera matrix (3, 3) [px].
        X_WC: Pose of the camera (4, 4).
    """

    image: npt.NDArray[np.uint8]
    K: Array
    X_WC: Array

    def pixels(self, p_WA: npt.ArrayLike) -> Array:
        """Return where points (n, 3) of the world are in the image, (n, 2) [px]."""
        return project(self.K, transform_points(invert_pose(self.X_WC), p_WA))


@dataclass(frozen=True, kw_only=True, eq=False)
class Triad:
    """A frame to be drawn into a picture: its label, pose X_WA (4, 4), length of its axes [m]."""

    label: str
    X_WA: Array
    length: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Panel:
    """A picture with what is to be drawn over it.

    Attributes:
        title: Text above.
        picture: The picture.
        triads: Frames.
        lines: Dashed polylines (n, 3) in {W}.
        points: Named points (3,) in {W}.
        arrows: Named arrows from (3,) to (3,) in {W}, in the colours of the fingers.
    """

    title: str
    picture: Picture
    triads: Sequence[Triad]
    lines: Sequence[Array] = ()
    points: Mapping[str, Array] = field(default_factory=dict)
    arrows: Mapping[str, tuple[Array, Array]] = field(default_factory=dict)


def contact_sheet(path: Path, png: Path, *, rows: int = 8, split: str | None = None) -> int:
    """Draw samples of a data file: colour, depth and mask of each, with its contacts.

    Different objects come first, so that the sheet shows as many as it can; the choice is
    the same every time.

    Args:
        path: `grasping_oto.hdf5` or `grasping_otm.hdf5`.
        png: The file to write.
        rows: Lines of samples at most.
        split: Of which split; of all if None.

    Returns:
        The number of samples drawn.

    Raises:
        DataError: If the file is no data file or holds no sample.
    """
    parts = [GraspDataset(path, split=name) for name in (SPLITS if split is None else (split,))]
    places = [(part, row) for part in parts for row in range(len(part))]
    if not places:
        raise DataError(f"{path}: must hold at least one sample to draw, got none")
    names = [str(name) for part in parts for name in part.column("object_props/object_name")]
    chosen = spread_over_objects(names, rows * ACROSS)
    samples = [places[i][0][places[i][1]] for i in chosen]
    figure = draw_sheet(samples, parts[0].K, far=_far(path))
    _save(figure, png, dpi=130)
    return len(samples)


def spread_over_objects(names: Sequence[str], count: int) -> list[int]:
    """Return indices of at most `count` samples, over as many objects as possible.

    Objects are in the order of their numbers; where there are more of them than places,
    every so manyth is taken. Of an object with many samples the first come first.
    """
    order = sorted(range(len(names)), key=lambda i: (_natural(names[i]), i))
    turns: list[list[int]] = []
    for _, group in groupby(order, key=lambda i: names[i]):
        for turn, i in enumerate(group):
            if turn == len(turns):
                turns.append([])
            turns[turn].append(i)
    chosen: list[int] = []
    for turn_indices in turns:
        room = min(count - len(chosen), len(turn_indices))
        picks = np.linspace(0, len(turn_indices) - 1, room).round().astype(int)
        chosen += [turn_indices[k] for k in picks]
    place = {i: k for k, i in enumerate(order)}
    return sorted(chosen, key=place.__getitem__)


def draw_sheet(samples: Sequence[Sample], K: Array, *, far: float) -> Figure:
    """Return the contact sheet of samples as a figure.

    Its axes come in threes: colour, depth and mask of each sample, then the colour bar.
    """
    across = min(ACROSS, len(samples))
    lines = -(-len(samples) // across)
    gap, between, caption, margin = 0.035, 0.22, 0.21, 0.16
    # One sample alone is too narrow for the legend and the colour bar side by side.
    head = 0.42 if across > 1 else 0.62
    block = 3 * EDGE + 2 * gap
    width = across * block + (across - 1) * between + 2 * margin
    height = lines * (EDGE + caption) + head + margin
    figure = Figure(figsize=(width, height), facecolor="white")

    nearest = min(float(sample.image[3].min()) for sample in samples)
    for i, sample in enumerate(samples):
        line, column = divmod(i, across)
        left = margin + column * (block + between)
        top = head + line * (EDGE + caption) + caption
        axes = [_add(figure, left + k * (EDGE + gap), top, EDGE, EDGE) for k in range(3)]
        draw_sample(axes, sample, K, near=nearest, far=far, scale=0.75)
        name = str(sample.props["object_name"]).replace("_", " ")
        axes[0].text(0.0, 1.05, name, transform=axes[0].transAxes, fontsize=7.0, color=_INK)
        axes[2].text(
            1.0, 1.05, f"trial {sample.trial_id}", transform=axes[2].transAxes,
            fontsize=6.0, color="#888888", ha="right",
        )  # fmt: skip
    bar_width = min(1.6, block / 2.2)
    bar = _add(figure, width - margin - bar_width, head - 0.29, bar_width, 0.09)
    _colour_bar(figure, bar, nearest, far, size=6.5)
    _finger_legend(figure, len(samples[0].grasp) // 6, (margin / width, 1.0 - 0.10 / height), 7.0)
    return figure


def draw_sample(
    axes: Sequence[Axes], sample: Sample, K: Array, *, near: float, far: float, scale: float = 1.0
) -> None:
    """Draw colour, depth and mask of a sample into three axes, contacts and all."""
    colour, depth, mask = axes
    colour.imshow(np.moveaxis(sample.image[:3], 0, 2), interpolation="nearest")
    shown = np.ma.masked_greater_equal(sample.image[3], far)
    depth.imshow(shown, cmap=_depth_colours(), vmin=near, vmax=far, interpolation="nearest")
    mask.imshow(sample.mask, cmap="gray", vmin=-0.25, vmax=1.1, interpolation="nearest")
    for one in axes:
        draw_contacts(one, sample, K, scale=scale)
        _bare(one)


def draw_contacts(axes: Axes, sample: Sample, K: Array, *, scale: float = 1.0) -> None:
    """Draw the contacts of a sample into its image: one dot, with an arrow, per finger."""
    p_CQ, nhat_Q_C = unpack_grasp(sample.grasp)
    dots = project(K, p_CQ)
    ends = project(K, p_CQ + ARROW * nhat_Q_C)
    size = np.array(sample.mask.shape[::-1])
    for i, (dot, end) in enumerate(zip(dots, ends, strict=True)):
        colour = FINGER_COLOURS[i % len(FINGER_COLOURS)]
        column, row = np.clip(np.rint(dot), 0, size - 1).astype(int)
        hidden = p_CQ[i, 2] > sample.image[3, row, column] + HIDDEN
        white = [withStroke(linewidth=3.0 * scale, foreground="white")]
        axes.plot(
            *np.column_stack([dot, end]), color=colour, linewidth=1.6 * scale,
            solid_capstyle="round", path_effects=white, zorder=3,
        )  # fmt: skip
        axes.plot(
            *dot, marker="o", markersize=5.2 * scale, markeredgewidth=1.0 * scale,
            markerfacecolor="white" if hidden else colour,
            markeredgecolor=colour if hidden else "white",
            linestyle="none", zorder=4, gid=f"contact {i}",
            path_effects=[withStroke(linewidth=1.6 * scale, foreground="white")] if hidden else [],
        )  # fmt: skip
    axes.set_xlim(-0.5, size[0] - 0.5)
    axes.set_ylim(size[1] - 0.5, -0.5)


def hero_figure(
    oto: Path, otm: Path, trial_id: int, pictures: Sequence[Picture], png: Path
) -> None:
    """Draw one trial: its pictures in a row, and below what both cameras saw.

    Args:
        oto: `grasping_oto.hdf5`.
        otm: `grasping_otm.hdf5` of the same dataset.
        trial_id: A trial that became a sample.
        pictures: Of the trial placed, closed and lifted, from `snapshots.trial_snapshots`.
        png: The file to write.

    Raises:
        DataError: If the trial is no sample.
    """
    top, gap, between, margin = 3.0, 0.04, 0.12, 0.1
    width = 3 * top + 2 * gap + 2 * margin
    edge = (width - 2 * margin - 4 * gap - between) / 6
    height = margin + top + 0.3 + edge + 0.38
    figure = Figure(figsize=(width, height), facecolor="white")
    words = ("place", "close", "lift")
    for k, (picture, word) in enumerate(zip(pictures, words, strict=True)):
        axes = _add(figure, margin + k * (top + gap), margin, top, top)
        _show_image(axes, picture.image)
        axes.text(0.035, 0.93, f"{k + 1}  {word}", transform=axes.transAxes, fontsize=13,
                  color=_INK, weight="bold", va="center")  # fmt: skip
    line = margin + top + 0.3
    files = {"oto: the camera rolls with the palm": oto, "otm: world up is up": otm}
    found = {title: find_sample(path, trial_id) for title, path in files.items()}
    near = min(float(sample.image[3].min()) for sample, _ in found.values())
    far = _far(oto)
    for k, (title, (sample, K)) in enumerate(found.items()):
        left = margin + k * (3 * edge + 2 * gap + between)
        axes_of_sample = [_add(figure, left + i * (edge + gap), line, edge, edge) for i in range(3)]
        draw_sample(axes_of_sample, sample, K, near=near, far=far)
        axes_of_sample[0].text(0.0, 1.045, title, transform=axes_of_sample[0].transAxes,
                               fontsize=9, color=_INK)  # fmt: skip
    bar = _add(figure, width - margin - 1.9, line + edge + 0.08, 1.9, 0.09)
    _colour_bar(figure, bar, near, far, size=7.5)
    corner = (margin / width, 0.26 / height)
    _finger_legend(figure, len(sample.grasp) // 6, corner, 8.5)
    _save(figure, png, dpi=150)


def find_sample(path: Path, trial_id: int) -> tuple[Sample, Array]:
    """Return the sample of a trial and the camera matrix K (3, 3).

    Raises:
        DataError: If the trial is no sample of the file.
    """
    for split in SPLITS:
        data = GraspDataset(path, split=split)
        rows = np.flatnonzero(data.column("trial_id") == trial_id)
        if len(rows):
            return data[int(rows[0])], data.K
    raise DataError(f"{path}: must have a sample of trial {trial_id}, got none")


def frames_figure(panels: Sequence[Panel], png: Path) -> None:
    """Draw panels side by side; the last is a camera's image, with its pixel axes."""
    high, gap, margin, head = 5.0, 0.15, 0.1, 0.3
    aspects = [p.picture.image.shape[1] / p.picture.image.shape[0] for p in panels]
    heights = [high] * (len(panels) - 1) + [0.62 * high]
    width = sum(a * h for a, h in zip(aspects, heights, strict=True))
    width += gap * (len(panels) - 1) + 2 * margin
    figure = Figure(figsize=(width, high + head + margin), facecolor="white")
    left = margin
    for panel, aspect, tall in zip(panels, aspects, heights, strict=True):
        axes = _add(figure, left, head, aspect * tall, tall)
        left += aspect * tall + gap
        _show_image(axes, panel.picture.image)
        axes.set_title(panel.title, fontsize=9.5, color=_INK, loc="left", pad=5)
        draw_panel(axes, panel)
    _draw_pixel_axes(axes)
    text = (
        "axes: x red, y green, z blue\n"
        "arrows: contacts Q1 .. Q3 and their unit\nnormals, out of the object\n"
        "Ocm: centre of mass\n"
        "dashed: p_WT = (0, 0, 0.65) m, the line from\n"
        "G to C, 0.25 m, and the camera's field of view"
    )
    axes.text(0.0, -0.06, text, transform=axes.transAxes, fontsize=9.5, color=_INK, va="top",
              linespacing=1.5)  # fmt: skip
    _save(figure, png, dpi=130)


def draw_panel(axes: Axes, panel: Panel) -> None:
    """Draw lines, frames, points and arrows of a panel over its picture."""
    picture, halo = panel.picture, [withStroke(linewidth=3.0, foreground="white")]
    for line in panel.lines:
        axes.plot(*picture.pixels(line).T, color=_INK, linewidth=0.9, linestyle=(0, (5, 3)))
    for triad in panel.triads:
        tips = triad.X_WA[:3, 3] + triad.length * triad.X_WA[:3, :3].T
        # The axis that is furthest away is drawn first.
        depths = transform_points(invert_pose(picture.X_WC), tips)[:, 2]
        for k in np.argsort(-depths):
            ends = picture.pixels(np.vstack([triad.X_WA[:3, 3], tips[k]]))
            axes.plot(*ends.T, color=AXIS_COLOURS[k], linewidth=2.2, solid_capstyle="round",
                      path_effects=halo, zorder=5)  # fmt: skip
    for i, (start, end) in enumerate(panel.arrows.values()):
        colour = FINGER_COLOURS[i % len(FINGER_COLOURS)]
        tail, tip = picture.pixels(np.vstack([start, end]))
        axes.annotate("", tip, tail, zorder=6, arrowprops={
            "arrowstyle": "-|>", "color": colour, "linewidth": 2.0, "shrinkA": 0.0, "shrinkB": 0.0,
            "path_effects": halo, "mutation_scale": 11.0})  # fmt: skip
        axes.plot(*tail, "o", color=colour, markersize=6.5, markeredgecolor="white", zorder=7)
    for point in panel.points.values():
        axes.plot(*picture.pixels(point[None])[0], "o", color=_INK, markersize=6.0,
                  markeredgecolor="white", zorder=7)  # fmt: skip
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
    """Draw the palm's approaches to a mesh, a panel per method.

    Args:
        vertices: Of the mesh, (n, 3) [m].
        faces: Of the mesh, (m, 3).
        rays: By title, (r, 2, 3): from the palm's origin to the surface, in {O}.
        png: The file to write.
    """
    azimuth, elevation = np.deg2rad(-55.0), np.deg2rad(20.0)
    out = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    right, towards = np.cross([0.0, 0.0, 1.0], out), np.cos(elevation) * out
    towards[2] = np.sin(elevation)
    # Orthographic view: rows are the axes to the right, up and towards the reader.
    R_VO = np.vstack([right, np.cross(towards, right), towards])
    triangles = vertices[faces] @ R_VO.T
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    front = np.flatnonzero(normals[:, 2] > 0.0)
    front = front[np.argsort(triangles[front, :, 2].mean(axis=1))]
    shade = 0.55 + 0.45 * np.clip(normals[front] @ [-0.48, 0.6, 0.64], 0.0, 1.0)
    colours = np.column_stack([np.outer(shade, [0.70, 0.77, 0.86]), np.full(len(front), 0.8)])
    seen = {title: ends @ R_VO.T for title, ends in rays.items()}
    every = np.concatenate([triangles, *(ends[:, [0, 1, 1]] for ends in seen.values())])[..., :2]
    low, high = every.min(axis=(0, 1)), every.max(axis=(0, 1))
    wide, margin, head = 3.6, 0.1, 0.3
    tall = float(wide * (high[1] - low[1]) / (high[0] - low[0]))
    figure = Figure(
        figsize=(len(rays) * (wide + margin) + margin, tall + head + margin), facecolor="white"
    )
    for k, (title, ends) in enumerate(seen.items()):
        axes = _add(figure, margin + k * (wide + margin), head, wide, tall)
        # The mesh lets what is behind it shine through.
        behind = ends[:, :, 2].mean(axis=1) < 0.0
        for part, order in ((ends[behind], 1), (ends[~behind], 3)):
            axes.add_collection(LineCollection(part[..., :2], colors="#7B2FA8", linewidths=0.6,
                                               alpha=0.6, zorder=order))  # fmt: skip
        axes.add_collection(
            PolyCollection(triangles[front, :, :2], facecolors=colours, antialiaseds=False,
                           edgecolors="none", zorder=2)
        )  # fmt: skip
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        axes.set_title(title, fontsize=10.5, color=_INK, pad=5)
        _bare(axes)
    _save(figure, png, dpi=130)


def _natural(name: str) -> tuple[int, str]:
    number, _, rest = name.partition("_")
    return (int(number), rest) if number.isdecimal() else (10**9, name)


def _far(path: Path) -> float:
    with h5py.File(path, "r") as file:
        return float(file.attrs["far"])


def _depth_colours() -> Colormap:
    # What is beyond the far plane has no depth.
    return mpl.colormaps["viridis_r"].with_extremes(bad="#E3E6EA")


def _colour_bar(figure: Figure, axes: Axes, near: float, far: float, *, size: float) -> None:
    scale = mpl.cm.ScalarMappable(mpl.colors.Normalize(near, far), _depth_colours())
    bar = figure.colorbar(scale, cax=axes, orientation="horizontal")
    bar.outline.set_visible(False)
    axes.tick_params(labelsize=size, length=2.0, pad=1.5, color=_INK, labelcolor=_INK)
    axes.set_ylabel("depth [m]", rotation=0, ha="right", va="center", fontsize=size, color=_INK)


def _finger_legend(figure: Figure, fingers: int, corner: tuple[float, float], size: float) -> None:
    def mark(colour: str, inside: str, edge: str, label: str) -> Line2D:
        return Line2D([], [], marker="o", linestyle="none", markersize=0.75 * size, color=colour,
                      markerfacecolor=inside, markeredgecolor=edge, label=label)  # fmt: skip

    marks = [
        mark(c, c, "white", f"finger {i + 1}")
        for i, c in enumerate(islice(cycle(FINGER_COLOURS), fingers))
    ]
    marks.append(mark(_INK, "white", _INK, "hidden by the object"))
    figure.legend(
        handles=marks, loc="upper left", bbox_to_anchor=corner, ncols=len(marks), fontsize=size,
        frameon=False, handletextpad=0.1, columnspacing=1.2, borderaxespad=0.0, borderpad=0.0,
        labelcolor=_INK,
    )  # fmt: skip


def _draw_labels(axes: Axes, pixels: Mapping[str, Array], obstacles: Array) -> None:
    """Write names beside points, each on the side where there is most room."""
    # Points of the paper per pixel of the image, and pixels per label's distance.
    window = axes.get_window_extent()
    reach = LABEL_REACH * axes.figure.dpi / 72.0 * abs(np.ptp(axes.get_xlim())) / window.width
    angles = np.deg2rad(np.arange(0.0, 360.0, 30.0))
    directions = np.column_stack([np.cos(angles), np.sin(angles)])
    taken = np.vstack([obstacles, *pixels.values()])
    for name, pixel in pixels.items():
        places = pixel + reach * directions * [1.0 + 0.25 * len(name), 1.0]
        distances = np.linalg.norm(places[:, None] - taken[None], axis=2)
        place = places[np.argmax(np.sort(distances, axis=1)[:, :3] @ [4.0, 2.0, 1.0])]
        taken = np.vstack([taken, place])
        axes.text(
            place[0], place[1], name, ha="center", va="center", fontsize=10.5, weight="bold",
            color="black", zorder=9, path_effects=[withStroke(linewidth=3.0, foreground="white")],
        )  # fmt: skip


def _draw_pixel_axes(axes: Axes) -> None:
    """Draw where pixel coordinates start, and which way u and v go."""
    halo = [withStroke(linewidth=3.0, foreground="white")]
    for tip in ((30.0, 0.0), (0.0, 30.0)):
        arrow = {"arrowstyle": "-|>", "color": _INK, "shrinkA": 0.0, "shrinkB": 0.0,
                 "path_effects": halo, "linewidth": 1.6}  # fmt: skip
        axes.annotate("", tip, (0.0, 0.0), arrowprops=arrow)
    for x, y, text in ((34.0, 3.0, "u"), (3.5, 34.0, "v"), (10.0, 5.0, "(0, 0)")):
        axes.text(x, y, text, color=_INK, fontsize=10, ha="center", va="center",
                  path_effects=halo)  # fmt: skip


def _add(figure: Figure, left: float, top: float, wide: float, high: float) -> Axes:
    """Add axes, measured in inches from the upper left corner of the figure."""
    width, height = figure.get_size_inches()
    box = (left / width, 1.0 - (top + high) / height, wide / width, high / height)
    return figure.add_axes(box)


def _show_image(axes: Axes, image: npt.NDArray[np.uint8]) -> None:
    axes.imshow(image, interpolation="antialiased")
    axes.set_xlim(-0.5, image.shape[1] - 0.5)
    axes.set_ylim(image.shape[0] - 0.5, -0.5)
    axes.set_autoscale_on(False)
    _bare(axes)


def _bare(axes: Axes) -> None:
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(False)


def _save(figure: Figure, png: Path, *, dpi: int) -> None:
    # No version in the file: the same figure gives the same bytes.
    figure.savefig(png, dpi=dpi, metadata={"Software": None})
