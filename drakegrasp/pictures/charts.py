"""Charts of numbers: of a whole dataset, and of a score card.

Input: counts and columns, or a card that `scoring.card` has computed. Output: figures. Names are
drawn literally: a dollar sign does not start a formula.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from drakegrasp.errors import counted
from drakegrasp.frames import Array
from drakegrasp.pictures.style import INK, PREDICTED, png_bytes, shortened

#: Colours of groups of grasps (Okabe and Ito), and of failures.
GROUPS = {
    "samples": "#E69F00",
    "distinct": "#0072B2",
    "precision": "#56B4E9",
    "stable": "#009E73",
}
FAILED = "#9AA0A8"
#: Numbers of things, by kind.
Counts: TypeAlias = npt.NDArray[np.int64]
#: Bins of a histogram, and the fraction of the values that determines its range, since a few
#: extreme values would squeeze the others.
BINS, SHOWN = 40, 0.98
#: Colours of the reference rows (Okabe and Ito: safe for the colour-blind); predictions are blue.
_COLOURS = ("#000000", "#D55E00", "#999999", "#B9B9B9", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
#: Colours of predictions, in the order of their sets.
_OWN = (PREDICTED, "#56B4E9")
#: Longest name of a set in the picture [characters].
LONGEST = 28
#: Width that the caption needs [in].
NARROWEST = 7.6


def draw_counts(counts: Mapping[str, int], what: str, *, title: str = "") -> Figure:
    """Return the counts of each kind as bars on a logarithmic scale.

    Args:
        counts: Counts by kind, in the order of the bars; the first kind is the desired one.
        what: What is counted, e.g. "attempts".
        title: What the figure counts; none if empty.
    """
    names, numbers = list(counts), np.array(list(counts.values()))
    figure = Figure(figsize=(8.0, 0.9 + 0.3 * len(names)), layout="constrained")
    axes = figure.add_subplot()
    axes.set_title(title, fontsize="medium", color=INK)
    colours = [GROUPS["stable"] if i == 0 else FAILED for i in range(len(names))]
    bars = axes.barh(range(len(names)), np.maximum(numbers, 0.8), color=colours, height=0.72)
    axes.bar_label(bars, [f"{n:,}" for n in numbers], padding=3, color=INK, fontsize=9)
    _name_bars(axes, [name.replace("_", " ") for name in names])
    axes.set_xscale("log")
    axes.set_xlim(0.8, 6.0 * max(10, numbers.max(initial=0)))
    axes.set_xlabel(what)
    return figure


def draw_distributions(
    quantities: Sequence[tuple[str, Array]], groups: Mapping[str, Array], *, title: str = ""
) -> Figure:
    """Return histograms of quantities of grasps, one panel each.

    The range of a panel contains 98 % of the values; larger values are counted in its last bin.

    Args:
        quantities: Title with unit, and values (n,) of all grasps.
        groups: Which grasps (n,) are in each group, by the names of GROUPS.
        title: What the figure counts; none if empty.
    """
    columns = 2
    rows = -(-len(quantities) // columns)
    figure = Figure(figsize=(8.0, 2.0 * rows), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes in panels[len(quantities) :]:
        axes.set_visible(False)
    for axes, (quantity, values) in zip(panels, quantities, strict=False):
        _histogram(axes, quantity, values, groups)

    # One legend for all panels.
    figure.supylabel("grasps", fontsize="medium", color=INK)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(
        handles,
        labels,
        loc="outside upper center",
        ncols=3,
        frameon=False,
        labelcolor=INK,
        title=title,
    )
    return figure


def draw_parts(
    groups: Mapping[str, tuple[Counts, Counts]], names: Sequence[str], *, title: str, what: str
) -> Figure:
    """Return fractions as bars, with their counts, a colour per group.

    Args:
        groups: By name, counts of parts (k,) and of wholes (k,).
        names: Names of the k wholes.
        title: What the fractions are of.
        what: What the names tell.
    """
    figure = Figure(figsize=(8.0, 3.2), layout="constrained")
    axes, width = figure.add_subplot(), 0.8 / len(groups)
    axes.set_title(title, fontsize="medium", color=INK)
    for i, (name, (parts, wholes)) in enumerate(groups.items()):
        x = np.arange(len(names)) + (i - (len(groups) - 1) / 2.0) * width
        shares, colour = parts / np.maximum(wholes, 1), _COLOURS[-1 - i % len(_COLOURS)]
        bars = axes.bar(x, shares, width, color=colour, label=name.replace("$", r"\$"))
        labels = [f"{part}\nof {whole}" for part, whole in zip(parts, wholes, strict=True)]
        axes.bar_label(bars, labels, padding=3, color=INK, fontsize=8)
    axes.set_xticks(range(len(names)), names)
    axes.set_ylim(0.0, 1.2)  # room for the counts above a bar
    axes.set_yticks(np.linspace(0.0, 1.0, 6))
    axes.set_xlabel(what)
    axes.legend(frameon=False, labelcolor=INK, loc="center left", bbox_to_anchor=(1.0, 0.5))
    _plain(axes)
    return figure


def draw_reach(p_TS: Array, share: Array, base: Sequence[float], *, title: str = "") -> Figure:
    """Return a map of the table: which fraction of grasps an arm reaches at each place.

    Args:
        p_TS: (m, 2), places on a square grid [m].
        share: (m,), fractions.
        base: X, Y [m] of the arm's base, Z, and its yaw [rad].
        title: What the figure shows; none if empty.
    """
    figure = Figure(figsize=(6.2, 5.4), layout="constrained")
    axes = figure.add_subplot()
    axes.set_title(title, fontsize="medium", color=INK)
    count = round(np.sqrt(len(p_TS)))
    x, y = (p_TS[:, k].reshape(count, count) for k in range(2))
    shares = axes.pcolormesh(x, y, share.reshape(count, count), cmap="viridis", vmin=0.0, vmax=1.0)
    figure.colorbar(shares, ax=axes, label="fraction of the samples that are reachable")

    # The base, and the direction of its x axis.
    x_base, y_base, _, yaw = base
    axes.plot(x_base, y_base, "o", color=PREDICTED, markersize=10, markeredgecolor="white")
    forward = x_base + 0.15 * np.cos(yaw), y_base + 0.15 * np.sin(yaw)
    arrow = {"arrowstyle": "->", "color": PREDICTED}
    axes.annotate("", forward, (x_base, y_base), arrowprops=arrow)
    axes.set_aspect("equal")
    axes.set_xlabel("x of the object in {T} [m]")
    axes.set_ylabel("y of the object in {T} [m]")
    return figure


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
    """Name horizontal bars, with the first one on top."""
    axes.set_yticks(range(len(names)))
    axes.set_yticklabels([name.replace("$", r"\$") for name in names], fontsize=9)
    axes.invert_yaxis()
    _plain(axes)


def _plain(axes: Axes) -> None:
    """Remove lines without information from axes."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(color=INK, labelcolor=INK, labelsize=9)
    axes.xaxis.label.set_color(INK)


def card_picture(card: Mapping[str, Any]) -> bytes:
    """Return a card as PNG."""
    calibrated = {n: s["calibration"] for n, s in card["sets"].items() if s["calibration"]}
    protocol = card["settings"].get("protocol")
    columns = 1 + (protocol is None) + bool(calibrated)
    size = (max(4.6 * columns, NARROWEST), 1.6 + 0.36 * max(len(card["sets"]), 6))
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(1, columns, squeeze=False)[0]
    colours = _colours(card)

    _draw_headline(axes[0], card, colours)
    if protocol is None:
        _draw_curves(axes[1], card, colours)
    if calibrated:
        _draw_calibration(axes[-1], calibrated, colours)
    for panel in axes:
        panel.spines[["top", "right"]].set_visible(False)
        panel.tick_params(colors=INK)
        panel.set_axisbelow(True)
        panel.xaxis.label.set_color(INK)
        panel.title.set(fontsize="medium", color=INK)
    _caption(figure, card)

    return png_bytes(figure, dpi=150)


def _colours(card: Mapping[str, Any]) -> dict[str, str]:
    """Return the colour of each set."""
    own, references = iter(_OWN * len(card["sets"])), iter(_COLOURS * len(card["sets"]))
    return {name: next(own if name in card["headline"] else references) for name in card["sets"]}


def _draw_headline(axes: Axes, card: Mapping[str, Any], colours: Mapping[str, str]) -> None:
    """Draw the headline of each set with its interval, and a tick for what is lifted anywhere."""
    for i, (name, each) in enumerate(card["sets"].items()):
        value, low, high = (100.0 * each["measures"]["headline"][k] for k in _ENDS)
        axes.plot([low, high], [i, i], color=colours[name], linewidth=2.2, solid_capstyle="round")
        axes.plot(value, i, "o", color=colours[name], markersize=7)
        if "lifted" in card["measures"]:
            lifted = 100.0 * each["measures"]["lifted"]["value"]
            axes.plot(lifted, i, "|", color=colours[name], markersize=11, markeredgewidth=1.4)

    # The names of the sets, in their colours.
    axes.set_yticks(range(len(card["sets"])), [shortened(name, LONGEST) for name in card["sets"]])
    for label, name in zip(axes.get_yticklabels(), card["sets"], strict=True):
        label.set_color(colours[name])
    axes.set_ylim(len(card["sets"]) - 0.5, -0.5)
    axes.set_xlim(-2.0, 102.0)
    axes.grid(axis="x", color="#E3E6EA")
    axes.set_xlabel("per cent of rows, mean over objects")
    protocol = card["settings"].get("protocol")
    title = f"Sample within {card['limit_mm']:g} mm, 95 % interval\n(tick: lifted anywhere)"
    if protocol is not None:
        title = f"Success by {protocol['protocol']}, 95 % interval"
    axes.set_title(title)


_ENDS = ("value", "low", "high")


def _draw_curves(axes: Axes, card: Mapping[str, Any], colours: Mapping[str, str]) -> None:
    """Draw lifted(d) of each set, in the colour of its name in the first panel."""
    for name, each in card["sets"].items():
        curve = each["lifted_within_mm"]
        values = [100.0 * share for share in curve.values()]
        wide = 2.4 if name in card["headline"] else 1.5
        limits = [float(d) for d in curve]
        axes.plot(limits, values, color=colours[name], linewidth=wide)
    axes.axvline(card["limit_mm"], color=INK, linewidth=0.8, linestyle=":")
    axes.set_xlim(0.0, max(float(d) for d in curve))
    axes.set_ylim(-2.0, 102.0)
    axes.grid(color="#E3E6EA")
    axes.set_xlabel("d: largest distance from a requested contact [mm]")
    axes.set_title("lifted(d) [%]")


def _draw_calibration(
    axes: Axes, groups: Mapping[str, Sequence[Mapping[str, float]]], colours: Mapping[str, str]
) -> None:
    """Draw the fraction that counts against the stated confidence."""
    for name, each in groups.items():
        stated = [group["confidence"] for group in each]
        shares = [100.0 * group["share"] for group in each]
        axes.plot(stated, shares, "o-", color=colours[name])
        if min(stated) >= 0.0 and max(stated) <= 1.0:
            axes.plot([0.0, 1.0], [0.0, 100.0], color=INK, linewidth=0.8, linestyle=":")
    axes.set_ylim(-2.0, 102.0)
    axes.grid(color="#E3E6EA")
    axes.set_xlabel("stated confidence, five groups")
    axes.set_title("fraction that counts [%]")


def _caption(figure: Figure, card: Mapping[str, Any]) -> None:
    """Write below the picture what was scored."""
    where, protocol = card["dataset"], card["settings"].get("protocol")
    simulator = f"Drake {card['settings']['versions']['drake']}"
    if protocol is not None:
        simulator = f"MuJoCo {protocol['versions']['mujoco']}"
    text = (
        f"{counted(card['rows'], 'row')}, {counted(card['objects'], 'object')}, "
        f"{counted(card['classes'], 'class', 'classes')} of "
        f"{where['file']} ({where['split']}, {where['rows_sha256'][:8]}); "
        f"drakegrasp {card['settings']['versions']['drakegrasp']}, {simulator}"
    )
    figure.supxlabel(text, fontsize="small", color=INK)
