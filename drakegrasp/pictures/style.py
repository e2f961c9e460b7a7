"""Style shared by all figures: colours, axes, legends, samples, and marks drawn over images.

A contact is drawn where the camera matrix projects it: a dot in its finger's colour and a short
arrow along the outward normal. The dot is hollow if the object hides the contact.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from itertools import cycle, islice
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.colors import Colormap, to_hex, to_rgba_array
from matplotlib.figure import Figure
from matplotlib.image import imsave
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke

from drakegrasp.dataset.hdf5 import open_samples
from drakegrasp.dataset.reader import Sample
from drakegrasp.frames import Array
from drakegrasp.grasp import unpack_grasp
from drakegrasp.vision.camera import project

#: Colours of contacts: predicted, after closing, and those of the dataset's own grasp (Okabe and
#: Ito: safe for the colour-blind).
PREDICTED, REACHED, TRUE = "#0072B2", "#D55E00", "#009E73"
#: Colours of the fingers in grasp order (Okabe and Ito: safe for the colour-blind).
FINGER_COLOURS = ("#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00")
#: Colour of an arm, which does not move, and how opaque it is if it can be seen through.
STILL, SEEN_THROUGH = (0.6, 0.66, 0.74), 0.25
#: Colours of the objects of a scene by their index, the strong ones first; two for each hue.
INSTANCE_COLOURS = tuple(
    to_hex(colour) for colour in mpl.colormaps["tab20"]([*range(0, 20, 2), *range(1, 20, 2)])
)
#: Length of the arrows along the normals [m].
ARROW = 0.03
#: A contact that is farther than this behind the depth image counts as hidden [m]; fingertips are
#: compressed by less.
HIDDEN = 0.006
#: Colour of text and lines.
INK = "#333333"
#: Colours of depths; on thumbnails also colours of pixels without depth, and of the mask's
#: background and object. Empty pixels are transparent, and the object is neither dark nor light, so
#: that it is visible on any page.
DEPTHS = "viridis_r"
NO_DEPTH = np.array([0, 0, 0, 0], dtype=np.uint8)
MASK = np.array([[0, 0, 0, 0], [0x7D, 0x88, 0x96, 0xFF]], dtype=np.uint8)
#: Smallest range of the depth colours [m].
MIN_RANGE = 0.05


def draw_sample(axes: Sequence[Axes], sample: Sample, K: Array, *, near: float, far: float) -> None:
    """Draw colour, depth and mask of a sample, each with its contacts.

    Args:
        axes: Three axes for the three images.
        sample: The sample.
        K: (3, 3), camera matrix [px].
        near: Depth of the brightest end of the colour scale [m].
        far: Far plane; pixels beyond it have no depth [m].
    """
    colour, depth, mask = axes
    colour.imshow(np.moveaxis(sample.image[:3], 0, 2), interpolation="nearest")
    shown = np.ma.masked_greater_equal(sample.image[3], far)
    depth.imshow(shown, cmap=_depth_colours(), vmin=near, vmax=far, interpolation="nearest")
    mask.imshow(sample.mask, cmap="gray", vmin=-0.25, vmax=1.1, interpolation="nearest")
    for panel in axes:
        draw_contacts(panel, sample, K)


def draw_contacts(axes: Axes, sample: Sample, K: Array) -> None:
    """Draw the contacts of a sample over its image: a dot with an arrow per finger.

    Args:
        axes: Axes that show the image.
        sample: The sample, with its grasp in {C}.
        K: (3, 3), camera matrix [px].
    """
    # Project the contacts and the tips of their normals.
    p_CQ, nhat_Q_C = unpack_grasp(sample.grasp)
    dots = project(K, p_CQ)
    ends = project(K, p_CQ + ARROW * nhat_Q_C)
    height, width = sample.mask.shape

    # A finger that the grasp leaves out has no contact.
    for i in np.flatnonzero(sample.fingers).tolist():
        # A contact is hidden if something nearer is at its pixel.
        column, row = np.clip(np.rint(dots[i]), 0, (width - 1, height - 1)).astype(int)
        hidden = p_CQ[i, 2] > sample.image[3, row, column] + HIDDEN
        _draw_contact(axes, i, dots[i], ends[i], hidden=bool(hidden))

    # Contacts outside of the image must not change the range of the axes; pixel centres have
    # integer coordinates.
    axes.set_xlim(-0.5, width - 0.5)
    axes.set_ylim(height - 0.5, -0.5)
    hide_ticks(axes)


def _draw_contact(axes: Axes, finger: int, dot: Array, end: Array, *, hidden: bool) -> None:
    """Draw a finger's contact at a pixel (2,), with a line to the pixel (2,) of its normal's tip.

    The dot of a hidden contact is hollow.
    """
    # The line, then the dot over its start.
    colour = FINGER_COLOURS[finger % len(FINGER_COLOURS)]
    axes.plot(
        *np.column_stack([dot, end]), color=colour, linewidth=1.2, solid_capstyle="round",
        path_effects=[withStroke(linewidth=2.25, foreground="white")], zorder=3,
    )  # fmt: skip
    axes.plot(
        *dot, marker="o", markersize=3.9, markeredgewidth=0.75,
        markerfacecolor="white" if hidden else colour,
        markeredgecolor=colour if hidden else "white",
        linestyle="none", zorder=4, gid=f"contact {finger}",
        path_effects=[withStroke(linewidth=1.2, foreground="white")] if hidden else [],
    )  # fmt: skip


def read_far(path: Path) -> float:
    """Return the far plane [m] of a data file."""
    with open_samples(path) as file:
        return float(file.attrs["far"])


def _depth_colours() -> Colormap:
    """Return the colours of depths; pixels without depth are light grey."""
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
        figure: Figure to draw in.
        fingers: Number of fingers.
        corner: Upper left corner of the legend, as fractions of the figure's width and height.
        size: Size of the text [points].
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
        handles=marks, loc="upper left", bbox_to_anchor=corner, ncols=len(marks),
        fontsize=size, frameon=False, handletextpad=0.1, columnspacing=1.2, borderaxespad=0.0,
        borderpad=0.0, labelcolor=INK,
    )  # fmt: skip


def write_beside(axes: Axes, x: float, y: float, text: str, size: float, **more: Any) -> None:
    """Write a text literally, at fractions of the width and the height of axes."""
    look = {"color": INK, "parse_math": False, **more}
    axes.text(x, y, text, transform=axes.transAxes, fontsize=size, **look)


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
    """Return a name in at most `most` characters; the end distinguishes variants of one mesh."""
    return name if len(name) <= most else f"{name[: most - 10]}…{name[-9:]}"


def save_figure(figure: Figure, png: Path, *, dpi: int) -> None:
    """Write a figure as PNG, at a resolution [pixels per inch]."""
    png.write_bytes(png_bytes(figure, dpi=dpi))


def png_bytes(figure: Figure, *, dpi: int) -> bytes:
    """Return a figure as PNG, at a resolution [pixels per inch]."""
    # Without the version of the writing software, the same figure produces the same bytes.
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=dpi, format="png", metadata={"Software": None})
    return buffer.getvalue()


def svg_bytes(figure: Figure, *, dpi: int) -> bytes:
    """Return a figure as SVG; the same figure produces the same bytes.

    Args:
        figure: The figure.
        dpi: Resolution of the parts that are rasterized [pixels per inch].
    """
    buffer = io.BytesIO()
    with mpl.rc_context({"svg.hashsalt": "drakegrasp"}):
        figure.savefig(buffer, format="svg", dpi=dpi, metadata={"Date": None, "Creator": None})
    return buffer.getvalue()


def strip_png(image: npt.NDArray[np.float32], mask: npt.NDArray[np.uint8], *, far: float) -> bytes:
    """Return colour, depth and mask side by side as a PNG, (S, 3 S) pixels.

    The colours of depth range from the nearest pixel of the image to the farthest before `far`.

    Args:
        image: (4, S, S): R, G, B in 0..1 and depth [m].
        mask: (S, S), 1 where the object is seen.
        far: Far plane [m]; pixels beyond it have no depth.
    """
    # Depths as indices into the colours.
    depth = np.asarray(image[3], dtype=float)
    seen = depth < far
    near, end = (depth[seen].min(), depth[seen].max()) if seen.any() else (0.0, far)
    share = (depth - near) / max(end - near, MIN_RANGE)
    table = np.rint(255.0 * mpl.colormaps[DEPTHS](np.arange(256))).astype(np.uint8)
    depths = np.where(
        seen[..., None], table[np.rint(255.0 * share.clip(0, 1)).astype(int)], NO_DEPTH
    )

    colours = np.rint(255.0 * np.moveaxis(image[:3], 0, 2).clip(0.0, 1.0)).astype(np.uint8)
    colours = np.dstack([colours, np.full(colours.shape[:2], 255, dtype=np.uint8)])
    strip = np.concatenate([colours, depths, MASK[(mask > 0).astype(int)]], axis=1)
    return colour_png(strip)


def beside_instances(
    colours: npt.NDArray[np.uint8], mask: npt.NDArray[np.uint8]
) -> npt.NDArray[np.uint8]:
    """Return colours (h, w, 3) beside a mask (h, w), with opacity, (h, 2 w, 4).

    The mask has 1 + the index of the object, which is drawn in one of INSTANCE_COLOURS.
    """
    palette = np.vstack([NO_DEPTH, np.rint(255.0 * to_rgba_array(INSTANCE_COLOURS))])
    known = np.dstack([colours, np.full(mask.shape, 255, dtype=np.uint8)])
    return np.concatenate([known, palette[mask].astype(np.uint8)], axis=1)


def colour_png(colours: npt.NDArray[np.uint8]) -> bytes:
    """Return colours (h, w, 3), or colours with opacity (h, w, 4), as a PNG."""
    buffer = io.BytesIO()
    imsave(buffer, colours, format="png")
    return buffer.getvalue()
