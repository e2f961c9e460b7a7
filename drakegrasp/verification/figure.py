"""The figure of a verified grasp: predicted and reached contacts on the object.

In: a verification. Out: a matplotlib figure: the object from two sides with its contacts, and
the hand, or the object alone where forces lift it, at the last instant that was reached.

The pictures are those of `visualization.third_person`: they need what rendering needs, and one
thread.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke
from pydrake.geometry import LightParameter

from drakegrasp.frames import X_WT, Array, invert_pose, make_pose, transform_points
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.hand.kinematics import joint_positions
from drakegrasp.objects.model import ObjectModel
from drakegrasp.outcomes import Outcome
from drakegrasp.simulation.contacts import Contacts
from drakegrasp.simulation.placement import canonical_pose
from drakegrasp.simulation.trajectory import lifted_palm
from drakegrasp.vision.camera import Picture
from drakegrasp.visualization.style import (
    ARROW,
    HIDDEN,
    INK,
    PREDICTED,
    REACHED,
    add_axes,
    hide_ticks,
)
from drakegrasp.visualization.third_person import (
    AZIMUTHS_DEG,
    Moment,
    build_theatre,
    choose_view,
    outline,
    show,
    take,
    view,
)

if TYPE_CHECKING:
    from drakegrasp.verification.result import Verification

#: Lamps beside the camera and above the table that cast no shadow: contacts are on all sides of
#: an object, and none is to be in the dark.
LIGHTS = (
    LightParameter(type="point", frame="camera", position=[-0.25, -0.15, 0.0], intensity=0.85),
    LightParameter(type="point", frame="camera", position=[0.4, 0.0, 0.0], intensity=0.4),
    LightParameter(type="point", frame="world", position=[0.0, 0.0, 4.0], intensity=0.4),
)
#: Where the hand is when only the object is to be seen: beyond what the camera shows.
AWAY = make_pose(np.eye(3), [0.0, 0.0, -100.0])
#: Height of the camera that looks at the object alone, above the horizontal [rad].
ELEVATION = np.deg2rad(24.0)
#: A contact is looked at where the cosine between its normal and the line of sight is larger.
FACING = 0.1
#: Length of the arrow of the largest force [m].
LARGEST_FORCE = 0.05
#: Distance of a number from its arrow [points].
NUMBER = 7.0
#: Edge of a panel [inch], [px].
EDGE, PIXELS = 3.3, 560
#: Colours of the verdict.
HOLDS, FAILS = "#1B7F3B", "#B3261E"


@dataclass(frozen=True, kw_only=True, eq=False)
class Marks:
    """Contacts to be drawn, of one kind.

    Attributes:
        kind: What they are called in the figure's elements.
        colour: Of dots and arrows.
        size: Diameter of the dots; the arrows go by it [points].
        p_OQ: (n, 3), points in {O} [m].
        nhat_Q_O: (n, 3), outward normals in {O}.
        tail_O, tip_O: (n, 3), ends of the arrows in {O} [m].
        names: Text at the end of each arrow.
    """

    kind: str
    colour: str
    size: float
    p_OQ: Array
    nhat_Q_O: Array
    tail_O: Array
    tip_O: Array
    names: Sequence[str]


@dataclass(frozen=True, kw_only=True, eq=False)
class View:
    """A picture of an object at X_WO (4, 4) and what is to be drawn over it."""

    title: str
    picture: Picture
    X_WO: Array
    marks: Sequence[Marks]


def verification_figure(verified: Verification) -> Figure:
    """Return the figure of a verified grasp.

    Args:
        verified: The result.

    Raises:
        MachineError: If a picture is blank, which means that OpenGL failed.
    """
    stage = _Stage(verified.placed.model, load_hand(verified.config.hand))
    X_WO = X_WT @ canonical_pose(verified.placed.X_TO)
    closed = None if verified.trial is None else verified.trial.closed
    marks = [_predicted(verified), *_reached(closed, _force_scale(verified))]
    first, second = _two_sides(stage.model, X_WO, marks)
    views = [
        stage.object("contacts", X_WO, marks, first),
        stage.object("from another side", X_WO, marks, second),
        *_last_view(stage, verified, marks, first),
    ]
    return _draw_figure(verified, stage.model, views)


def _last_view(
    stage: _Stage, verified: Verification, marks: Sequence[Marks], azimuth: float
) -> list[View]:
    """Return the view of the last instant that was reached, if anything was tried at all."""
    X_WO = X_WT @ canonical_pose(verified.placed.X_TO)
    trial, lift, fit = verified.trial, verified.lift, verified.fit
    if lift is not None and lift.X_TO_lifted is not None:
        return [stage.object("end of the lift", X_WT @ lift.X_TO_lifted, marks, azimuth)]
    if trial is not None and trial.X_TO_lifted is not None and trial.q_lifted is not None:
        X_WG = lifted_palm(trial.X_TO @ trial.X_OG, trial.time_lift, verified.config)
        X_WO = X_WT @ trial.X_TO_lifted
        moment = Moment(X_WG=X_WG, X_WO=X_WO, q=trial.q_lifted)
        reached = _reached(trial.lifted, _force_scale(verified))
        return [stage.hand("end of the lift", moment, reached)]
    if trial is not None and trial.q_closed is not None:
        moment = Moment(X_WG=X_WO @ trial.X_OG, X_WO=X_WO, q=trial.q_closed)
        return [stage.hand("after closing", moment, marks)]
    if fit is not None:
        q = stage.posture(fit.spread, fit.closing)
        moment = Moment(X_WG=X_WO @ fit.X_OG, X_WO=X_WO, q=q)
        return [stage.hand("the hand where it comes closest", moment, marks)]
    return []


class _Stage:
    """Takes the pictures."""

    def __init__(self, model: ObjectModel, hand: Hand) -> None:
        self.model = model
        self._theatre = build_theatre(model, hand, lights=LIGHTS)

    def object(self, title: str, X_WO: Array, marks: Sequence[Marks], azimuth: float) -> View:
        """Return a view of the object alone, at X_WO (4, 4), from an azimuth [rad]."""
        q = self.posture(0.0, np.zeros(self._theatre.hand.num_fingers))
        X_WC = _camera(self.model, X_WO, marks, azimuth)
        return self._view(title, Moment(X_WG=AWAY, X_WO=X_WO, q=q), X_WC, marks)

    def hand(self, title: str, moment: Moment, marks: Sequence[Marks]) -> View:
        """Return a view of the hand and the object, from where most of both is seen."""
        around = outline(self._theatre, moment, self.model.half_extents)
        return self._view(title, moment, choose_view(self._theatre, around), marks)

    def posture(self, spread: float, closing: Array) -> Array:
        """Return the positions of the hand's joints as a `Moment` has them [rad]."""
        angles = joint_positions(self._theatre.hand, spread, closing)
        return np.array([angles[name] for name in self._theatre.joint_names])

    def _view(self, title: str, moment: Moment, X_WC: Array, marks: Sequence[Marks]) -> View:
        show(self._theatre, moment)
        picture = take(self._theatre, X_WC, (PIXELS, PIXELS))
        return View(title=title, picture=picture, X_WO=moment.X_WO, marks=marks)


def _predicted(verified: Verification) -> Marks:
    p, n = verified.p_OQ, verified.nhat_Q_O
    names = [str(i + 1) for i in range(len(p))]
    tip = p + ARROW * n
    return Marks(
        kind="predicted",
        colour=PREDICTED,
        size=9.0,
        p_OQ=p,
        nhat_Q_O=n,
        tail_O=p,
        tip_O=tip,
        names=names,
    )


def _reached(contacts: Contacts | None, scale: float) -> list[Marks]:
    """Return the contacts that are there, if any, with an arrow per force, `scale` [m/N]."""
    if contacts is None or not contacts.touching.any():
        return []
    p, n, f = (
        values[contacts.touching] for values in (contacts.p_OQ, contacts.nhat_Q_O, contacts.f_Q_O)
    )
    tail = p - scale * f
    names = [""] * len(p)
    return [
        Marks(
            kind="reached",
            colour=REACHED,
            size=5.0,
            p_OQ=p,
            nhat_Q_O=n,
            tail_O=tail,
            tip_O=p,
            names=names,
        )
    ]


def _largest_force(verified: Verification) -> float:
    """Return the largest force of a fingertip that is drawn [N], infinite if there is none."""
    trial = verified.trial
    stages = [] if trial is None else [trial.closed, trial.lifted]
    forces = [float(np.linalg.norm(c.f_Q_O, axis=1).max()) for c in stages if c is not None]
    return max(forces, default=0.0) or np.inf


def _force_scale(verified: Verification) -> float:
    """Return the length of a force's arrow [m/N]."""
    return LARGEST_FORCE / _largest_force(verified)


def _two_sides(model: ObjectModel, X_WO: Array, marks: Sequence[Marks]) -> tuple[float, float]:
    """Return two azimuths [rad] from which the predicted contacts are seen, together all of them.

    The first sees most; the second most of those that the first does not.
    """
    azimuths = np.deg2rad(AZIMUTHS_DEG)
    cameras = [_camera(model, X_WO, marks, azimuth)[:3, 3] for azimuth in azimuths]
    seen = np.array([_is_seen(model, X_WO, marks[0], p_WC) for p_WC in cameras])
    towards = np.array([_towards(marks[0], X_WO, p_WC) for p_WC in cameras])
    normals = np.broadcast_to(marks[0].nhat_Q_O, towards.shape)
    facing = np.sum(towards * normals, axis=2) > FACING
    # An arrow that points at the camera says little.
    across = np.linalg.norm(np.cross(towards, normals), axis=2)
    worth = (seen & facing) * (1.0 + 0.5 * across)
    first = int(np.argmax(worth.sum(axis=1)))
    opposite = 1e-3 * np.cos(azimuths - azimuths[first])
    second = int(np.argmax((worth * (worth[first] == 0.0)).sum(axis=1) - opposite))
    return float(azimuths[first]), float(azimuths[second])


def _camera(
    model: ObjectModel, X_WO: Array, marks: Sequence[Marks], azimuth: float, fill: float = 1.3
) -> Array:
    """Return X_WC of a camera that has the object and its marks in view."""
    half = model.half_extents
    corners = half * np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T
    around = np.vstack([corners, *(m.tail_O for m in marks), *(m.tip_O for m in marks)])
    return view(transform_points(X_WO, around), azimuth, ELEVATION, fill=fill)


def _towards(marks: Marks, X_WO: Array, p_WC: Array) -> Array:
    """Return the unit vectors (n, 3) in {O} from contacts to a camera at p_WC (3,)."""
    p_OC = transform_points(invert_pose(X_WO), p_WC[None])[0]
    away = p_OC - marks.p_OQ
    return away / np.linalg.norm(away, axis=1, keepdims=True)


def _is_seen(model: ObjectModel, X_WO: Array, marks: Marks, p_WC: Array) -> npt.NDArray[np.bool_]:
    """Return for each contact whether the object leaves it in sight of a camera at p_WC (3,)."""
    start = marks.p_OQ + HIDDEN * marks.nhat_Q_O
    return ~model.visual.ray.intersects_any(start, _towards(marks, X_WO, p_WC))


def _draw_figure(verified: Verification, model: ObjectModel, views: Sequence[View]) -> Figure:
    gap, margin, head, foot = 0.08, 0.12, 0.85, 0.4
    width = len(views) * (EDGE + gap) - gap + 2.0 * margin
    figure = Figure(figsize=(width, EDGE + head + foot), facecolor="white")
    for k, one in enumerate(views):
        axes = add_axes(figure, margin + k * (EDGE + gap), head, EDGE, EDGE)
        axes.imshow(one.picture.image, interpolation="antialiased")
        axes.set(xlim=(-0.5, PIXELS - 0.5), ylim=(PIXELS - 0.5, -0.5))
        axes.set_title(one.title, fontsize=9.5, color=INK, loc="left", pad=4)
        hide_ticks(axes)
        for marks in one.marks:
            _draw_marks(axes, one, model, marks)
    holds = verified.outcome is Outcome.SUCCESS
    verdict = "holds" if holds else f"fails: {verified.outcome.label.replace('_', ' ')}"
    left, height = margin / width, EDGE + head + foot
    figure.text(left, 1.0 - 0.1 / height, f"{model.name}  {verdict}", fontsize=12.5, va="top",
                weight="bold", color=HOLDS if holds else FAILS)  # fmt: skip
    figure.text(left, 1.0 - 0.36 / height, verified.reason, fontsize=9.5, va="top", color=INK,
                wrap=True)  # fmt: skip
    _draw_legend(figure, verified, (left, 0.3 / height))
    return figure


def _draw_marks(axes: Axes, one: View, model: ObjectModel, marks: Marks) -> None:
    halo = [withStroke(linewidth=3.0, foreground="white")]
    pixels = [
        one.picture.pixels(transform_points(one.X_WO, p))
        for p in (marks.p_OQ, marks.tail_O, marks.tip_O)
    ]
    seen = _is_seen(model, one.X_WO, marks, one.picture.X_WC[:3, 3])
    rows = zip(*pixels, marks.names, seen, strict=True)
    for i, (dot, tail, tip, name, is_seen) in enumerate(rows):
        arrow = {"arrowstyle": "-|>", "color": marks.colour, "linewidth": 0.36 * marks.size,
                 "shrinkA": 0.0, "shrinkB": 0.0, "mutation_scale": 4.0 + marks.size,
                 "path_effects": halo}  # fmt: skip
        axes.annotate("", tip, tail, arrowprops=arrow, zorder=3)
        axes.plot(*dot, "o", markersize=marks.size, markeredgewidth=1.0 if is_seen else 1.7,
                  zorder=4, gid=f"{marks.kind} {i}",
                  markerfacecolor=marks.colour if is_seen else "white",
                  markeredgecolor="white" if is_seen else marks.colour)  # fmt: skip
        axes.annotate(name, tip, _beyond(tail, tip), textcoords="offset points", ha="center",
                      va="center", fontsize=10.0, weight="bold", color=marks.colour, zorder=5,
                      path_effects=halo)  # fmt: skip


def _beyond(tail: Array, tip: Array) -> tuple[float, float]:
    """Return how far from an arrow's tip its name is written [points], y up."""
    along = (tip - tail) * [1.0, -1.0]
    length = float(np.linalg.norm(along))
    # An arrow that points at the camera is a dot: its name goes above that.
    if length < NUMBER:
        return 0.0, 1.5 * NUMBER
    return float(NUMBER * along[0] / length), float(NUMBER * along[1] / length)


def _draw_legend(figure: Figure, verified: Verification, corner: tuple[float, float]) -> None:
    def dot(colour: str, inside: str, label: str) -> Line2D:
        return Line2D([], [], marker="o", linestyle="none", markersize=6.5, label=label,
                      markerfacecolor=inside, markeredgecolor=colour)  # fmt: skip

    handles = [dot(PREDICTED, PREDICTED, "predicted, with its normal")]
    force = _largest_force(verified)
    if np.isfinite(force):
        text = f"reached, with the finger's force (longest: {force:.1f} N)"
        handles.append(dot(REACHED, REACHED, text))
    handles.append(dot(INK, "white", "behind the object"))
    figure.legend(handles=handles, loc="upper left", bbox_to_anchor=corner, ncols=len(handles),
                  fontsize=9.0, frameon=False, handletextpad=0.2, columnspacing=1.5,
                  borderaxespad=0.0, borderpad=0.0, labelcolor=INK)  # fmt: skip
