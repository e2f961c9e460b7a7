"""A score card as a picture: the sets beside each other, held(d), and stated confidence.

In: a card, as `scoring.card` makes it. Out: the bytes of a PNG file.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from drakegrasp.pictures.style import INK, PREDICTED, shortened

#: Colours of the reference rows (Okabe and Ito: safe for the colour-blind); predictions are blue.
_COLOURS = ("#000000", "#D55E00", "#999999", "#B9B9B9", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
#: Of predictions in the order of their sets.
_OWN = (PREDICTED, "#56B4E9")
#: Longest name of a set in the picture [characters].
LONGEST = 28
#: Width that the caption needs [in].
NARROWEST = 7.6


def card_picture(card: Mapping[str, Any], *, dpi: int = 150) -> bytes:
    """Return a card as PNG, at a resolution [pixels per inch]."""
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
        for side in ("top", "right"):
            panel.spines[side].set_visible(False)
        panel.tick_params(colors=INK)
    _caption(figure, card)

    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=dpi, format="png", metadata={"Software": None})
    return buffer.getvalue()


def _colours(card: Mapping[str, Any]) -> dict[str, str]:
    """Return the colour of each set."""
    own, references = iter(_OWN * len(card["sets"])), iter(_COLOURS * len(card["sets"]))
    return {name: next(own if name in card["headline"] else references) for name in card["sets"]}


def _draw_headline(axes: Axes, card: Mapping[str, Any], colours: Mapping[str, str]) -> None:
    """Draw the headline of each set with its interval, and what is held beside it."""
    for i, (name, each) in enumerate(card["sets"].items()):
        value, low, high = (100.0 * each["measures"]["headline"][k] for k in _ENDS)
        axes.plot([low, high], [i, i], color=colours[name], linewidth=2.2, solid_capstyle="round")
        axes.plot(value, i, "o", color=colours[name], markersize=7)
        if "held" in card["measures"]:
            held = 100.0 * each["measures"]["held"]["value"]
            axes.plot(held, i, "|", color=colours[name], markersize=11, markeredgewidth=1.4)

    # The names of the sets, in their colours.
    axes.set_yticks(range(len(card["sets"])), [shortened(name, LONGEST) for name in card["sets"]])
    for label, name in zip(axes.get_yticklabels(), card["sets"], strict=True):
        label.set_color(colours[name])
    axes.set_ylim(len(card["sets"]) - 0.5, -0.5)
    axes.set_xlim(-2.0, 102.0)
    axes.grid(axis="x", color="#E3E6EA")
    axes.set_axisbelow(True)
    axes.set_xlabel("per cent of rows, mean over objects", color=INK)
    protocol = card["settings"].get("protocol")
    title = f"Sample within {card['limit_mm']:g} mm, 95 % interval\n(tick: held anywhere)"
    if protocol is not None:
        title = f"Success by {protocol['protocol']}, 95 % interval"
    axes.set_title(title, fontsize="medium", color=INK)


_ENDS = ("value", "low", "high")


def _draw_curves(axes: Axes, card: Mapping[str, Any], colours: Mapping[str, str]) -> None:
    """Draw held(d) of each set, in the colour of its name in the first panel."""
    for name, each in card["sets"].items():
        curve = each["held_within_mm"]
        values = [100.0 * share for share in curve.values()]
        wide = 2.4 if name in card["headline"] else 1.5
        limits = [float(d) for d in curve]
        axes.plot(limits, values, color=colours[name], linewidth=wide)
    axes.axvline(card["limit_mm"], color=INK, linewidth=0.8, linestyle=":")
    axes.set_xlim(0.0, max(float(d) for d in curve))
    axes.set_ylim(-2.0, 102.0)
    axes.grid(color="#E3E6EA")
    axes.set_axisbelow(True)
    axes.set_xlabel("d: farthest contact from the one asked for [mm]", color=INK)
    axes.set_title("held(d) [%]", fontsize="medium", color=INK)


def _draw_calibration(
    axes: Axes, groups: Mapping[str, Sequence[Mapping[str, float]]], colours: Mapping[str, str]
) -> None:
    """Draw the share that counts against the stated confidence."""
    for name, each in groups.items():
        stated = [group["confidence"] for group in each]
        shares = [100.0 * group["share"] for group in each]
        axes.plot(stated, shares, "o-", color=colours[name])
        if min(stated) >= 0.0 and max(stated) <= 1.0:
            axes.plot([0.0, 1.0], [0.0, 100.0], color=INK, linewidth=0.8, linestyle=":")
    axes.set_ylim(-2.0, 102.0)
    axes.grid(color="#E3E6EA")
    axes.set_axisbelow(True)
    axes.set_xlabel("stated confidence, five groups", color=INK)
    axes.set_title("share that counts [%]", fontsize="medium", color=INK)


def _caption(figure: Figure, card: Mapping[str, Any]) -> None:
    """Write what was scored under the picture."""
    where, protocol = card["dataset"], card["settings"].get("protocol")
    simulator = f"Drake {card['settings']['versions']['drake']}"
    if protocol is not None:
        simulator = f"MuJoCo {protocol['versions']['mujoco']}"
    text = (
        f"{card['rows']} rows, {card['objects']} objects, {card['classes']} classes of "
        f"{where['file']} ({where['split']}, {where['rows_sha256'][:8]}); "
        f"drakegrasp {card['settings']['versions']['drakegrasp']}, {simulator}"
    )
    figure.supxlabel(text, fontsize="small", color=INK)
