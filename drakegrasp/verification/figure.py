"""Pictures of a verified grasp: a figure of its contacts on the object, and a recording.

Input: a verification. Output: a matplotlib figure, or an HTML file that plays the trial. The figure
shows the object from two sides, then the last state that was reached with the hand, the verdict and
a legend. The pictures come from `pictures.still_scene`, so they need OpenGL and a single thread.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke
from pydrake.geometry import LightParameter, Meshcat

from drakegrasp.frames import X_WT, Array, invert_pose, make_pose, transform_points
from drakegrasp.hand.description import load_hand
from drakegrasp.mesh.rays import first_hits
from drakegrasp.objects.model import ObjectModel
from drakegrasp.outcomes import Outcome
from drakegrasp.pictures.recording import (
    draw_predicted,
    record_attempt,
    record_html,
    show_object,
)
from drakegrasp.pictures.still_scene import (
    AZIMUTHS_DEG,
    Lighting,
    Poses,
    StillScene,
    box_corners,
    camera_pose,
)
from drakegrasp.pictures.style import (
    ARROW,
    HIDDEN,
    INK,
    LIFTED,
    PREDICTED,
    REACHED,
    add_axes,
    show_image,
)
from drakegrasp.simulation.construction import build_object_scene
from drakegrasp.simulation.contacts import Contacts
from drakegrasp.vision.camera import Picture

if TYPE_CHECKING:
    from drakegrasp.verification.result import Verification

#: Lights beside the camera and above the table, without shadows: contacts are on all sides of an
#: object, and none of them should be in the dark.
LIGHTING = Lighting(
    name="contacts",
    lights=(
        LightParameter(type="point", frame="camera", position=[-0.25, -0.15, 0.0], intensity=0.85),
        LightParameter(type="point", frame="camera", position=[0.4, 0.0, 0.0], intensity=0.4),
        LightParameter(type="point", frame="world", position=[0.0, 0.0, 4.0], intensity=0.4),
    ),
)
#: Pose of the hand in pictures of the object alone: out of view.
AWAY = make_pose(np.eye(3), [0.0, 0.0, -100.0])
#: Elevation of the camera in pictures of the object alone [rad].
ELEVATION = np.deg2rad(24.0)
#: A contact faces the camera if the cosine between its normal and the line of sight is above this.
FACING = 0.1
#: Edge of a picture [px].
PIXELS = 560
#: Length of the arrow of the largest force [m].
LARGEST_FORCE = 0.05


@dataclass(frozen=True, kw_only=True, eq=False)
class Marks:
    """Contacts of one kind to draw, each with a dot and an arrow.

    Attributes:
        kind: Name of the kind in the ids of the figure's elements.
        colour: Colour of dots and arrows.
        size: Diameter of the dots [points]; the arrows scale with it.
        p_OQ: (n, 3), points in {O} [m].
        nhat_Q_O: (n, 3), outward unit normals in {O}.
        tail_O, tip_O: (n, 3), ends of the arrows in {O} [m].
    """

    kind: str
    colour: str
    size: float
    p_OQ: Array
    nhat_Q_O: Array
    tail_O: Array
    tip_O: Array


#: A picture with its title, the pose X_WO (4, 4) of the object in it, and the contacts to draw.
View: TypeAlias = tuple[str, Picture, Array, Sequence[Marks]]


def _views(verified: Verification) -> Iterator[View]:
    """Yield views of the object from two sides, then of the last state reached with the hand."""
    # Marks: the predicted contacts; the contacts after closing, with their forces; and the contacts
    # after the lift, on the object in its first pose. An arrow there shows how far a fingertip
    # slid.
    model, closed, lifted = verified.placed.model, verified.closed, verified.lifted
    scene = StillScene(load_hand(verified.config.hand_source), model)
    X_WO = X_WT @ verified.placed.X_TO_simulated
    scale = LARGEST_FORCE / largest_force(verified)
    marks = [_predicted(verified)]
    if closed is not None:
        marks.append(_arriving(closed, closed.p_OQ - scale * closed.f_Q_O, "reached", REACHED))
    if closed is not None and lifted is not None:
        marks.append(_arriving(lifted, closed.p_OQ, "lifted", LIFTED, size=4.0))

    # The object alone.
    azimuths = _two_sides(model, X_WO, marks)
    for title, azimuth in zip(("contacts", "from another side"), azimuths, strict=True):
        scene.pose(Poses(X_WG=AWAY, q=scene.positions(0.0), X_WO=X_WO))
        X_WC = _camera(model, X_WO, marks, azimuth)
        yield title, scene.picture(X_WC, (PIXELS, PIXELS), LIGHTING), X_WO, marks

    # The hand after the lift or after closing, or else in the palm pose that comes closest.
    trial, fit = verified.trial, verified.fit
    if trial is not None and trial.lift is not None:
        X_WO, X_OG, q = X_WT @ trial.lift.X_TO, trial.lift.X_OG, trial.lift.q
        end = trial.lift.contacts
        marks = [_arriving(end, end.p_OQ - scale * end.f_Q_O, "lifted", LIFTED)]
        title = "end of the lift, with forces"
    elif trial is not None and trial.closed is not None:
        title, X_OG, q = "after closing", trial.X_OG, trial.closed.q
    elif fit is not None:
        q, title = scene.positions(fit.spread, fit.closing), "the hand where it comes closest"
        X_OG = fit.X_OG
    else:
        return
    around = scene.outline(Poses(X_WG=X_WO @ X_OG, q=q, X_WO=X_WO))
    picture = scene.picture(scene.choose_view(around), (PIXELS, PIXELS), LIGHTING)
    yield title, picture, X_WO, marks


def _predicted(verified: Verification) -> Marks:
    """Return the predicted contacts, with arrows along their normals."""
    # An invalid row has no contacts.
    there = np.isfinite(verified.p_OQ).all(axis=1)
    p, n = verified.p_OQ[there], verified.nhat_Q_O[there]
    return Marks(kind="predicted", colour=PREDICTED, size=9.0, p_OQ=p, nhat_Q_O=n, tail_O=p,
                 tip_O=p + ARROW * n)  # fmt: skip


def _arriving(
    contacts: Contacts, tail_O: Array, kind: str, colour: str, *, size: float = 5.0
) -> Marks:
    """Return the contacts that touch, at the tips of arrows from tail_O (k, 3); NaN: no mark."""
    there = contacts.touching & np.isfinite(tail_O).all(axis=1)
    p, n = contacts.p_OQ[there], contacts.nhat_Q_O[there]
    return Marks(kind=kind, colour=colour, size=size, p_OQ=p, nhat_Q_O=n, tail_O=tail_O[there],
                 tip_O=p)  # fmt: skip


def largest_force(verified: Verification) -> float:
    """Return the largest drawn force on a fingertip [N]; inf if there is none."""
    ends = (verified.closed, verified.lifted)
    forces = [float(np.linalg.norm(c.f_Q_O, axis=1).max()) for c in ends if c is not None]
    return max(forces, default=0.0) or np.inf


def _two_sides(model: ObjectModel, X_WO: Array, marks: Sequence[Marks]) -> tuple[float, float]:
    """Return two azimuths [rad] that together show as many predicted contacts as possible.

    The first azimuth shows the most contacts; the second shows the most of the remaining ones.
    """
    # Find the contacts that each camera sees, and those that face the camera.
    azimuths = np.deg2rad(AZIMUTHS_DEG)
    cameras = [_camera(model, X_WO, marks, azimuth)[:3, 3] for azimuth in azimuths]
    seen = np.array([is_seen(model, X_WO, marks[0], p_WC) for p_WC in cameras])
    towards = np.array([_towards(marks[0], X_WO, p_WC) for p_WC in cameras])
    normals = np.broadcast_to(marks[0].nhat_Q_O, towards.shape)
    facing = np.sum(towards * normals, axis=2) > FACING

    # An arrow that points at the camera shows little, so an arrow across the line of sight has more
    # weight.
    across = np.linalg.norm(np.cross(towards, normals), axis=2)
    worth = (seen & facing) * (1.0 + 0.5 * across)

    # Among equal second views, take the view opposite to the first.
    first = int(np.argmax(worth.sum(axis=1)))
    opposite = 1e-3 * np.cos(azimuths - azimuths[first])
    second = int(np.argmax((worth * (worth[first] == 0.0)).sum(axis=1) - opposite))
    return float(azimuths[first]), float(azimuths[second])


def _camera(
    model: ObjectModel, X_WO: Array, marks: Sequence[Marks], azimuth: float, fill: float = 1.3
) -> Array:
    """Return the pose X_WC (4, 4) of a camera that has the object and its marks in view."""
    around = np.vstack([box_corners(model), *(m.tail_O for m in marks), *(m.tip_O for m in marks)])
    return camera_pose(transform_points(X_WO, around), azimuth, ELEVATION, fill=fill)


def _towards(marks: Marks, X_WO: Array, p_WC: Array) -> Array:
    """Return the unit vectors (n, 3) in {O} from contacts to a camera at p_WC (3,)."""
    p_OC = transform_points(invert_pose(X_WO), p_WC[None])[0]
    away = p_OC - marks.p_OQ
    return away / np.linalg.norm(away, axis=1, keepdims=True)


def is_seen(model: ObjectModel, X_WO: Array, marks: Marks, p_WC: Array) -> npt.NDArray[np.bool_]:
    """Return (n,), whether a camera at p_WC (3,) sees each contact, unhidden by the object."""
    start = marks.p_OQ + HIDDEN * marks.nhat_Q_O
    hits = first_hits(np.asarray(model.visual.triangles), start, _towards(marks, X_WO, p_WC))
    return ~np.isfinite(hits)


#: Edge of a panel [inch].
EDGE = 3.3
#: Distance of a number from its arrow [points].
NUMBER = 7.0
#: Length below which arrows are not drawn [px].
SHORTEST = 8.0
#: Colours of the verdict: success and stable; held but not both; not held.
STABLE, HELD, FAILS = "#1B7F3B", "#8A5A00", "#B3261E"


def verification_figure(verified: Verification) -> Figure:
    """Return the figure of a verified grasp: views side by side, the verdict, and a legend.

    Args:
        verified: The verdict.

    Raises:
        MachineError: If a picture is blank, which means that OpenGL failed.
    """
    model, views = verified.placed.model, list(_views(verified))

    # The size of the page [inch].
    gap, margin, head, foot = 0.08, 0.12, 1.25, 0.4
    width = len(views) * (EDGE + gap) - gap + 2.0 * margin
    figure = Figure(figsize=(width, EDGE + head + foot), facecolor="white")

    # The views, with their contacts.
    for k, (title, picture, X_WO, marks) in enumerate(views):
        axes = add_axes(figure, margin + k * (EDGE + gap), head, EDGE, EDGE)
        show_image(axes, picture.image)
        axes.set_title(title, fontsize=9.5, color=INK, loc="left", pad=4)
        for each in marks:
            _draw_marks(axes, picture, X_WO, model, each)

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
    """Return the line on how close the contacts are to the requested ones, and on other poses."""
    if verified.outcome is Outcome.INVALID or verified.first is None:
        return ""
    words = []
    if np.isfinite(verified.farthest_contact):
        limit = verified.config.verify.max_contact_error
        words.append(f"contacts within {1e3 * verified.farthest_contact:.1f} mm of the requested "
                     f"ones (success: {1e3 * limit:g} mm)")  # fmt: skip
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


def _draw_marks(
    axes: Axes, picture: Picture, X_WO: Array, model: ObjectModel, marks: Marks
) -> None:
    """Draw contacts of one kind; a contact that the object hides has a hollow dot."""
    # Project them into the picture, and find the visible ones.
    halo = [withStroke(linewidth=3.0, foreground="white")]
    ends = (marks.p_OQ, marks.tail_O, marks.tip_O)
    pixels = [picture.pixels(transform_points(X_WO, p)) for p in ends]
    seen = is_seen(model, X_WO, marks, picture.X_WC[:3, 3])

    # Draw an arrow, the dot, and for a prediction its number beyond the arrow's tip.
    for i, (dot, tail, tip, visible) in enumerate(zip(*pixels, seen, strict=True)):
        name = str(i + 1) if marks.kind == "predicted" else ""
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
    # An arrow that points at the camera looks like a dot; put its name above the dot.
    if length < NUMBER:
        return 0.0, 1.5 * NUMBER
    return float(NUMBER * along[0] / length), float(NUMBER * along[1] / length)


def _draw_legend(figure: Figure, verified: Verification, corner: tuple[float, float]) -> None:
    """Draw the legend below a corner, given as fractions of the figure's width and height."""

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


def record_verification(verified: Verification, path: Path) -> None:
    """Write a recording of a verification with its explanation; the trial is simulated again.

    It is the trial of the first wrist pose. For an invalid row, the recording shows the object at
    rest.

    Args:
        verified: The verdict.
        path: The HTML file.

    Raises:
        OSError: If the file cannot be written.
    """
    if verified.pregrasp is None:
        _record_object(verified, path)
    else:
        record_attempt(
            verified.placed.model,
            verified.placed.X_TO_simulated,
            verified.pregrasp,
            verified.config,
            path,
            p_OQ=verified.p_OQ,
            nhat_Q_O=verified.nhat_Q_O,
            caption=verified.explain(),
        )


def _record_object(verified: Verification, path: Path) -> None:
    """Write a recording of the object at rest, with the contacts at which forces were judged."""
    placed, config = verified.placed, verified.config

    def run(meshcat: Meshcat) -> None:
        scene = build_object_scene(placed.model, config.physics, meshcat=meshcat)
        show_object(meshcat, scene, placed.X_TO_simulated, config)
        if verified.forces is not None:
            draw_predicted(meshcat, verified.p_OQ, verified.nhat_Q_O)

    record_html(run, path, verified.explain())
