"""What all figures share: colours, axes, legends, and how to draw a sample.

A contact is drawn where the camera matrix projects it: a dot in its finger's colour and a
short arrow along the outward normal. The dot is hollow if the object hides the contact.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle, islice
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Colormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke

from drakegrasp.dataset.opening import open_samples
from drakegrasp.dataset.reader import Sample
from drakegrasp.frames import Array
from drakegrasp.grasp import unpack_grasp
from drakegrasp.vision.camera import project

#: Colours of contacts: predicted, after closing, after the lift, those of the dataset's own grasp
#: (Okabe and Ito: safe for the colour-blind).
PREDICTED, REACHED, LIFTED, TRUE = "#0072B2", "#D55E00", "#009E73", "#009E73"
#: Colours of the fingers in grasp order (Okabe and Ito: safe for the colour-blind).
FINGER_COLOURS = ("#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00")
#: Length of the arrows along the normals [m].
ARROW = 0.03
#: A contact farther than this behind the depth image counts as hidden [m]; fingertips are
#: compressed by less.
HIDDEN = 0.006
#: Colour of text and lines.
INK = "#333333"


def draw_sample(
    axes: Sequence[Axes], sample: Sample, K: Array, *, near: float, far: float, scale: float = 1.0
) -> None:
    """Draw colour, depth and mask of a sample, each with its contacts.

    Args:
        axes: Three, for the three images.
        sample: What to draw.
        K: (3, 3), camera matrix [px].
        near: Depth of the brightest end of the colour scale [m].
        far: Far plane; pixels beyond it have no depth [m].
        scale: Size of dots and lines; 1 suits images of about two inches.
    """
    colour, depth, mask = axes
    colour.imshow(np.moveaxis(sample.image[:3], 0, 2), interpolation="nearest")
    shown = np.ma.masked_greater_equal(sample.image[3], far)
    depth.imshow(shown, cmap=_depth_colours(), vmin=near, vmax=far, interpolation="nearest")
    mask.imshow(sample.mask, cmap="gray", vmin=-0.25, vmax=1.1, interpolation="nearest")
    for panel in axes:
        draw_contacts(panel, sample, K, scale=scale)
        hide_ticks(panel)


def draw_contacts(axes: Axes, sample: Sample, K: Array, *, scale: float = 1.0) -> None:
    """Draw the contacts of a sample over its image: a dot with an arrow per finger.

    Args:
        axes: That show the image.
        sample: With its grasp in {C}.
        K: (3, 3), camera matrix [px].
        scale: Size of dots and lines.
    """
    # Project the contacts and the tips of their normals.
    p_CQ, nhat_Q_C = unpack_grasp(sample.grasp)
    dots = project(K, p_CQ)
    ends = project(K, p_CQ + ARROW * nhat_Q_C)
    size = np.array(sample.mask.shape[::-1])

    for i, (dot, end) in enumerate(zip(dots, ends, strict=True)):
        # A finger that the grasp leaves out has no contact.
        if not sample.fingers[i]:
            continue
        # Something nearer than the contact, at its pixel, hides it.
        column, row = np.clip(np.rint(dot), 0, size - 1).astype(int)
        hidden = p_CQ[i, 2] > sample.image[3, row, column] + HIDDEN
        mark_contact(axes, i, dot, end, hidden=bool(hidden), scale=scale)

    # Contacts outside the image must not change what the axes show.
    axes.set_xlim(-0.5, size[0] - 0.5)
    axes.set_ylim(size[1] - 0.5, -0.5)


def mark_contact(
    axes: Axes, finger: int, dot: Array, end: Array, *, hidden: bool, scale: float = 1.0
) -> None:
    """Draw a contact at a pixel (2,), with an arrow along its normal to another.

    Args:
        axes: That show the image.
        finger: Index of the finger.
        dot: Where the arrow begins (2,) [px].
        end: Where it ends (2,) [px].
        hidden: Whether the camera does not see the contact: the dot is hollow.
        scale: Size of dot and line.
    """
    # The arrow, then the dot over its tail.
    colour = FINGER_COLOURS[finger % len(FINGER_COLOURS)]
    white = [withStroke(linewidth=3.0 * scale, foreground="white")]
    axes.plot(
        *np.column_stack([dot, end]), color=colour, linewidth=1.6 * scale,
        solid_capstyle="round", path_effects=white, zorder=3,
    )  # fmt: skip
    axes.plot(
        *dot, marker="o", markersize=5.2 * scale, markeredgewidth=1.0 * scale,
        markerfacecolor="white" if hidden else colour,
        markeredgecolor=colour if hidden else "white",
        linestyle="none", zorder=4, gid=f"contact {finger}",
        path_effects=[withStroke(linewidth=1.6 * scale, foreground="white")] if hidden else [],
    )  # fmt: skip


def read_far(path: Path) -> float:
    """Return the far plane [m] of a data file."""
    with open_samples(path) as file:
        return float(file.attrs["far"])


def _depth_colours() -> Colormap:
    """Return the colours of depths; that of pixels without depth is a light grey."""
    # Pixels beyond the far plane are masked: they have no depth.
    return mpl.colormaps["viridis_r"].with_extremes(bad="#E3E6EA")


def draw_colour_bar(figure: Figure, axes: Axes, near: float, far: float, *, size: float) -> None:
    """Draw the colour bar of depths from near to far [m], with text of a size [points]."""
    scale = mpl.cm.ScalarMappable(mpl.colors.Normalize(near, far), _depth_colours())
    bar = figure.colorbar(scale, cax=axes, orientation="horizontal")
    bar.outline.set_visible(False)
    axes.tick_params(labelsize=size, length=2.0, pad=1.5, color=INK, labelcolor=INK)
    axes.set_ylabel("depth [m]", rotation=0, ha="right", va="center", fontsize=size, color=INK)


def draw_finger_legend(
    figure: Figure, fingers: int, corner: tuple[float, float], size: float
) -> None:
    """Draw the legend of the fingers' colours.

    Args:
        figure: Where to draw.
        fingers: Their number.
        corner: Upper left corner of the legend, as shares of the figure's width and height.
        size: Of the text [points].
    """

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
    """Add axes of a size to a figure, placed from its upper left corner [inch]."""
    width, height = figure.get_size_inches()
    box = (left / width, 1.0 - (top + high) / height, wide / width, high / height)
    return figure.add_axes(box)


def hide_ticks(axes: Axes) -> None:
    """Remove the ticks and the frame of axes."""
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(False)


def shortened(name: str, most: int) -> str:
    """Return a name in at most so many characters; its end tells morphs of one mesh apart."""
    return name if len(name) <= most else f"{name[: most - 10]}…{name[-9:]}"


def save_figure(figure: Figure, png: Path, *, dpi: int) -> None:
    """Write a figure as PNG, at a resolution [pixels per inch]."""
    # Without the writing software's version the same figure gives the same bytes.
    figure.savefig(png, dpi=dpi, format="png", metadata={"Software": None})
