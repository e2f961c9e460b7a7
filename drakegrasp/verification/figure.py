"""The figure of a verified grasp: predicted and reached contacts on the object.

In: a verification. Out: a matplotlib figure of its views (`views`), with the verdict and a legend.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke

from drakegrasp.frames import Array, transform_points
from drakegrasp.objects.model import ObjectModel
from drakegrasp.outcomes import Outcome
from drakegrasp.pictures.figures.panels import show_image
from drakegrasp.pictures.style import INK, LIFTED, PREDICTED, REACHED, add_axes
from drakegrasp.verification.views import Marks, View, is_seen, largest_force, render_views

if TYPE_CHECKING:
    from drakegrasp.verification.result import Verification

#: Edge of a panel [inch].
EDGE = 3.3
#: Distance of a number from its arrow [points].
NUMBER = 7.0
#: Shorter arrows are not drawn [px].
SHORTEST = 8.0
#: Colours of the verdict: success and stable, held otherwise, not held.
STABLE, HELD, FAILS = "#1B7F3B", "#8A5A00", "#B3261E"


def verification_figure(verified: Verification) -> Figure:
    """Return the figure of a verified grasp.

    Args:
        verified: The verdict.

    Raises:
        MachineError: If a picture is blank, which means that OpenGL failed.
    """
    return _draw_figure(verified, verified.placed.model, render_views(verified))


def _draw_figure(verified: Verification, model: ObjectModel, views: Sequence[View]) -> Figure:
    """Draw the views side by side, with the verdict above and the legend below."""
    # The page [inch].
    gap, margin, head, foot = 0.08, 0.12, 1.25, 0.4
    width = len(views) * (EDGE + gap) - gap + 2.0 * margin
    figure = Figure(figsize=(width, EDGE + head + foot), facecolor="white")

    # The views, with their contacts.
    for k, view in enumerate(views):
        axes = add_axes(figure, margin + k * (EDGE + gap), head, EDGE, EDGE)
        show_image(axes, view.picture.image)
        axes.set_title(view.title, fontsize=9.5, color=INK, loc="left", pad=4)
        for marks in view.marks:
            _draw_marks(axes, view, model, marks)

    # The verdict, its reason, and what happened in the hand.
    left, height = margin / width, EDGE + head + foot
    firm = verified.success and verified.stable
    colour = STABLE if firm else HELD if verified.held else FAILS
    figure.text(left, 1.0 - 0.1 / height, f"{model.name}  {verified.words}", fontsize=12.5,
                va="top", weight="bold", color=colour)  # fmt: skip
    lines = (verified.reason, _contact_line(verified), _lift_line(verified))
    figure.text(left, 1.0 - 0.36 / height, "\n".join(filter(None, lines)), fontsize=9.5, va="top",
                color=INK, linespacing=1.35)  # fmt: skip

    _draw_legend(figure, verified, (left, 0.3 / height))
    return figure


def _contact_line(verified: Verification) -> str:
    """Return the line on how close the contacts are to those asked for, and on other poses."""
    if verified.outcome is Outcome.INVALID or verified.first is None:
        return ""
    words = []
    if np.isfinite(verified.farthest_contact):
        limit = verified.config.verify.max_contact_error
        words.append(f"contacts within {1e3 * verified.farthest_contact:.1f} mm of those asked for"
                     f" (success: {1e3 * limit:g} mm)")  # fmt: skip
    if verified.num_tries > 1:
        by = "none" if verified.held_by is None else f"number {verified.held_by + 1}"
        words.append(f"of {verified.num_tries} wrist poses {by} holds")
    return "; ".join(words)


def _lift_line(verified: Verification) -> str:
    """Return the line on slip, turn and other links; empty if the hand lifted nothing."""
    lift = None if verified.trial is None else verified.trial.lift
    if lift is None:
        return ""
    return (
        f"in the hand: slip {1e3 * lift.slip:.1f} mm, turn {np.rad2deg(lift.turn):.1f}°; "
        f"other links at the end: {lift.contacts.other_links}"
    )


def _draw_marks(axes: Axes, view: View, model: ObjectModel, marks: Marks) -> None:
    """Draw contacts of one kind; the dots of those that the object hides are hollow."""
    # Project them into the picture, and ask which are visible.
    halo = [withStroke(linewidth=3.0, foreground="white")]
    pixels = [
        view.picture.pixels(transform_points(view.X_WO, p))
        for p in (marks.p_OQ, marks.tail_O, marks.tip_O)
    ]
    seen = is_seen(model, view.X_WO, marks, view.picture.X_WC[:3, 3])

    # An arrow, the dot, and the name beyond the arrow's tip.
    rows = zip(*pixels, marks.names, seen, strict=True)
    for i, (dot, tail, tip, name, visible) in enumerate(rows):
        arrow = {"arrowstyle": "-|>", "color": marks.colour, "linewidth": 0.36 * marks.size,
                 "shrinkA": 0.0, "shrinkB": 0.0, "mutation_scale": 4.0 + marks.size,
                 "path_effects": halo}  # fmt: skip
        # The head of a shorter arrow would be larger than the arrow.
        if np.linalg.norm(tip - tail) > SHORTEST:
            axes.annotate("", tip, tail, arrowprops=arrow, zorder=3)
        axes.plot(*dot, "o", markersize=marks.size, markeredgewidth=1.0 if visible else 1.7,
                  zorder=4, gid=f"{marks.kind} {i}",
                  markerfacecolor=marks.colour if visible else "white",
                  markeredgecolor="white" if visible else marks.colour)  # fmt: skip
        axes.annotate(name, tip, _beyond(tail, tip), textcoords="offset points", ha="center",
                      va="center", fontsize=10.0, weight="bold", color=marks.colour, zorder=5,
                      path_effects=halo)  # fmt: skip


def _beyond(tail: Array, tip: Array) -> tuple[float, float]:
    """Return the offset (x, y up) of an arrow's name from its tip [points]."""
    along = (tip - tail) * [1.0, -1.0]
    length = float(np.linalg.norm(along))
    # An arrow that points at the camera looks like a dot: its name goes above that.
    if length < NUMBER:
        return 0.0, 1.5 * NUMBER
    return float(NUMBER * along[0] / length), float(NUMBER * along[1] / length)


def _draw_legend(figure: Figure, verified: Verification, corner: tuple[float, float]) -> None:
    """Draw the legend below a corner, given as shares of the figure's width and height."""

    def dot(colour: str, inside: str, label: str) -> Line2D:
        return Line2D([], [], marker="o", linestyle="none", markersize=6.5, label=label,
                      markerfacecolor=inside, markeredgecolor=colour)  # fmt: skip

    handles = [dot(PREDICTED, PREDICTED, "predicted, with its normal")]
    force = largest_force(verified)
    if np.isfinite(force):
        text = f"after closing, with the finger's force (longest: {force:.1f} N)"
        handles.append(dot(REACHED, REACHED, text))
    if verified.lifted is not None and verified.lifted.touching.any():
        handles.append(dot(LIFTED, LIFTED, "after the lift, and how far it slid"))
    handles.append(dot(INK, "white", "behind the object"))
    figure.legend(handles=handles, loc="upper left", bbox_to_anchor=corner, ncols=len(handles),
                  fontsize=9.0, frameon=False, handletextpad=0.2, columnspacing=1.5,
                  borderaxespad=0.0, borderpad=0.0, labelcolor=INK)  # fmt: skip
