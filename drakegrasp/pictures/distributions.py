"""Plots of a whole dataset: how attempts ended, what became of each object, distributions.

In: counts and columns. Out: figures. Names are drawn as they are: a dollar sign starts no formula.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from drakegrasp.frames import Array
from drakegrasp.pictures.style import INK

#: Colours of grasps that are held, precision and stable (Okabe and Ito), and of failures.
HELD, PRECISION, STABLE, FAILED = "#E69F00", "#56B4E9", "#009E73", "#9AA0A8"
GROUPS = {"held": HELD, "precision": PRECISION, "stable": STABLE}
#: Objects in a plot, at most: those with the most grasps.
MAX_OBJECTS = 60
#: Bins of a histogram, and the share of the values that it shows: a few wild ones squeeze the rest.
BINS, SHOWN = 40, 0.98


def draw_counts(
    counts: Mapping[str, int], what: str, *, colours: Sequence[str] | None = None
) -> Figure:
    """Return how many there are of each kind, as bars on a logarithmic scale.

    Args:
        counts: Numbers by kind, in the order of the bars; the first is the one that is wanted.
        what: What is counted, e.g. "attempts".
        colours: Of the bars; that of the first is another if None.
    """
    names, numbers = list(counts), np.array(list(counts.values()))
    figure = Figure(figsize=(8.0, 0.9 + 0.3 * len(names)), layout="constrained")
    axes = figure.add_subplot()
    colours = colours or [STABLE if i == 0 else FAILED for i in range(len(names))]
    bars = axes.barh(range(len(names)), np.maximum(numbers, 0.8), color=colours, height=0.72)
    axes.bar_label(bars, [f"{n:,}" for n in numbers], padding=3, color=INK, fontsize=9)
    _name_bars(axes, [name.replace("_", " ") for name in names])
    axes.set_xscale("log")
    axes.set_xlim(0.8, 6.0 * max(10, numbers.max(initial=0)))
    axes.set_xlabel(what)
    return figure


def draw_objects(names: Sequence[str], counts: Mapping[str, Sequence[int]]) -> Figure:
    """Return how many grasps each object has, and how well they hold.

    Args:
        names: Of the objects.
        counts: Numbers of grasps by object that are `held`, `precision` and `stable`; each is a
            part of the one before.
    """
    # The objects with the most grasps, the largest on top.
    held = np.array(counts["held"], dtype=int)
    order = np.argsort(-held, kind="stable")[:MAX_OBJECTS]
    figure = Figure(figsize=(8.0, 1.1 + 0.22 * max(len(order), 1)), layout="constrained")
    axes = figure.add_subplot()

    # Bars over one another: stable are precision, and precision are held.
    for group, colour in GROUPS.items():
        numbers = np.array(counts[group], dtype=int)[order]
        axes.barh(range(len(order)), numbers, color=colour, height=0.78, label=group)
    _name_bars(axes, [names[i] for i in order])
    axes.set_xlabel("grasps")
    figure.legend(
        loc="outside upper center", ncols=3, frameon=False, labelcolor=INK, title=_left_out(names)
    )
    return figure


def draw_distributions(
    quantities: Sequence[tuple[str, Array]], groups: Mapping[str, Array]
) -> Figure:
    """Return histograms of quantities of the held grasps, one panel each.

    A panel ends where all but 2 % of the values are; what is beyond is counted in its last bin.

    Args:
        quantities: Title with unit, and values (n,) of all held grasps.
        groups: Which (n,) of them are in each group, by the names of GROUPS.
    """
    columns = 2
    rows = -(-len(quantities) // columns)
    figure = Figure(figsize=(8.0, 2.0 * rows), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes in panels[len(quantities) :]:
        axes.set_visible(False)
    for axes, (title, values) in zip(panels, quantities, strict=False):
        _histogram(axes, title, values, groups)
    figure.supylabel("grasps", fontsize="medium", color=INK)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=3, frameon=False)
    return figure


def svg_bytes(figure: Figure, *, dpi: int = 72) -> bytes:
    """Return a figure as SVG; the same figure gives the same bytes.

    Args:
        figure: The figure.
        dpi: Resolution of what is pixels in it [pixels per inch].
    """
    buffer = io.BytesIO()
    with mpl.rc_context({"svg.hashsalt": "drakegrasp"}):
        figure.savefig(buffer, format="svg", dpi=dpi, metadata={"Date": None, "Creator": None})
    return buffer.getvalue()


def _histogram(axes: Axes, title: str, values: Array, groups: Mapping[str, Array]) -> None:
    """Draw the histogram of one quantity, a colour per group."""
    finite = values[np.isfinite(values)]
    end = float(np.quantile(finite, SHOWN)) if len(finite) else 1.0
    edges = np.linspace(0.0, end if end > 0.0 else 1.0, BINS + 1)
    for group, members in groups.items():
        shown = np.minimum(values[members & np.isfinite(values)], edges[-1])
        counts, _ = np.histogram(shown, edges)
        axes.stairs(counts, edges, fill=True, color=GROUPS[group], label=group)
    axes.set_xlabel(title)
    axes.yaxis.set_major_locator(MaxNLocator(nbins=5, integer=True))
    _plain(axes)


def _name_bars(axes: Axes, names: Sequence[str]) -> None:
    """Name horizontal bars, the first on top."""
    axes.set_yticks(range(len(names)))
    axes.set_yticklabels([name.replace("$", r"\$") for name in names], fontsize=9)
    axes.invert_yaxis()
    _plain(axes)


def _plain(axes: Axes) -> None:
    """Remove what says nothing from axes."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(color=INK, labelcolor=INK, labelsize=9)
    axes.xaxis.label.set_color(INK)


def _left_out(names: Sequence[str]) -> str | None:
    """Return how many objects a plot leaves out, in words."""
    more = len(names) - MAX_OBJECTS
    return f"{more:,} objects with fewer are left out" if more > 0 else None
