"""The contact sheet of a data file, drawn by matplotlib; no Drake.

In: a data file. Out: a PNG file of its samples, and what other figures (`doc_figures`) draw
in the same way. Contacts are drawn where the camera matrix projects them: a dot per finger
with a short arrow along the outward normal; a dot is hollow where the object hides it.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle, groupby, islice
from pathlib import Path

import h5py
import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Colormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke

from drakegrasp.camera import project
from drakegrasp.dataset import GraspDataset, Sample
from drakegrasp.errors import DataError
from drakegrasp.frames import Array
from drakegrasp.grasp import unpack_grasp
from drakegrasp.schema import SPLITS

#: Colours of the fingers in grasp order, told apart by the colour-blind too (Okabe and Ito).
FINGER_COLOURS = ("#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00")
#: Length of the arrows along the normals [m].
ARROW = 0.03
#: A contact this much behind what the depth image shows is hidden [m]; fingertips give way
#: by less.
HIDDEN = 0.006
#: Samples side by side in a contact sheet, and an image's edge in it [inch].
ACROSS, EDGE = 3, 1.12
INK = "#333333"


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
    figure = draw_sheet(samples, parts[0].K, far=read_far(path))
    save_figure(figure, png, dpi=130)
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
        axes = [add_axes(figure, left + k * (EDGE + gap), top, EDGE, EDGE) for k in range(3)]
        draw_sample(axes, sample, K, near=nearest, far=far, scale=0.75)
        name = str(sample.props["object_name"]).replace("_", " ")
        axes[0].text(0.0, 1.05, name, transform=axes[0].transAxes, fontsize=7.0, color=INK)
        axes[2].text(
            1.0, 1.05, f"trial {sample.trial_id}", transform=axes[2].transAxes,
            fontsize=6.0, color="#888888", ha="right",
        )  # fmt: skip
    bar_width = min(1.6, block / 2.2)
    bar = add_axes(figure, width - margin - bar_width, head - 0.29, bar_width, 0.09)
    draw_colour_bar(figure, bar, nearest, far, size=6.5)
    draw_finger_legend(
        figure, len(samples[0].grasp) // 6, (margin / width, 1.0 - 0.10 / height), 7.0
    )
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
        hide_ticks(one)


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


def _natural(name: str) -> tuple[int, str]:
    number, _, rest = name.partition("_")
    return (int(number), rest) if number.isdecimal() else (10**9, name)


def read_far(path: Path) -> float:
    """Return the far plane [m] of a data file."""
    with h5py.File(path, "r") as file:
        return float(file.attrs["far"])


def _depth_colours() -> Colormap:
    # What is beyond the far plane has no depth.
    return mpl.colormaps["viridis_r"].with_extremes(bad="#E3E6EA")


def draw_colour_bar(figure: Figure, axes: Axes, near: float, far: float, *, size: float) -> None:
    """Draw the bar of the depths, with text of a size [points]."""
    scale = mpl.cm.ScalarMappable(mpl.colors.Normalize(near, far), _depth_colours())
    bar = figure.colorbar(scale, cax=axes, orientation="horizontal")
    bar.outline.set_visible(False)
    axes.tick_params(labelsize=size, length=2.0, pad=1.5, color=INK, labelcolor=INK)
    axes.set_ylabel("depth [m]", rotation=0, ha="right", va="center", fontsize=size, color=INK)


def draw_finger_legend(
    figure: Figure, fingers: int, corner: tuple[float, float], size: float
) -> None:
    """Write which colour is which finger, right of a corner (0..1), text of a size [points]."""

    def mark(colour: str, inside: str, edge: str, label: str) -> Line2D:
        return Line2D([], [], marker="o", linestyle="none", markersize=0.75 * size, color=colour,
                      markerfacecolor=inside, markeredgecolor=edge, label=label)  # fmt: skip

    marks = [
        mark(c, c, "white", f"finger {i + 1}")
        for i, c in enumerate(islice(cycle(FINGER_COLOURS), fingers))
    ]
    marks.append(mark(INK, "white", INK, "hidden by the object"))
    figure.legend(
        handles=marks, loc="upper left", bbox_to_anchor=corner, ncols=len(marks), fontsize=size,
        frameon=False, handletextpad=0.1, columnspacing=1.2, borderaxespad=0.0, borderpad=0.0,
        labelcolor=INK,
    )  # fmt: skip


def add_axes(figure: Figure, left: float, top: float, wide: float, high: float) -> Axes:
    """Add axes, measured in inches from the upper left corner of the figure."""
    width, height = figure.get_size_inches()
    box = (left / width, 1.0 - (top + high) / height, wide / width, high / height)
    return figure.add_axes(box)


def hide_ticks(axes: Axes) -> None:
    """Take away the ticks and the frame of axes."""
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(False)


def save_figure(figure: Figure, png: Path, *, dpi: int) -> None:
    """Write a figure as PNG."""
    # No version in the file: the same figure gives the same bytes.
    figure.savefig(png, dpi=dpi, metadata={"Software": None})
