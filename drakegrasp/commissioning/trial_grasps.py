"""Trial grasps: the hand closes on a box and on a cylinder, and lifts them, in simulation.

In: a hand. Out: for each object the best of a few attempts, whose palm poses follow from how the
fingertips close (`pinch`). The attempts are those of a build: `run_attempt` simulates them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import trimesh

from drakegrasp.commissioning.finding import Finding
from drakegrasp.commissioning.pinch import Pinch, find_opposition, find_pinch, reach
from drakegrasp.config import Config, ObjectConfig, with_whole_lifts
from drakegrasp.frames import Array, make_pose
from drakegrasp.hand.description import Hand
from drakegrasp.hand.file_format import Drive
from drakegrasp.objects.model import ObjectModel, make_object
from drakegrasp.outcomes import Outcome
from drakegrasp.simulation.candidates import Pregrasp
from drakegrasp.simulation.construction import build_scene
from drakegrasp.simulation.drive import drive_of
from drakegrasp.simulation.trial import TrialRecord, run_attempt

#: Widths of the objects that are tried [m].
WIDTHS = (0.045, 0.06, 0.03)
#: Mass of the objects, at most [kg]; a smaller payload of the hand counts.
MASS = 0.3
#: Space between hand and table, between palm and object, and around the pads on the object [m].
ABOVE_TABLE, BEFORE_PALM, AROUND_PADS = 0.015, 0.008, 0.012
#: Least size of an object in any direction [m].
LEAST_SIZE = 0.03


@dataclass(frozen=True, kw_only=True, eq=False)
class TrialGrasp:
    """An object on the table, and an attempt to grasp it.

    Attributes:
        model: The object.
        X_TO: Its pose in the table-top frame, (4, 4).
        pregrasp: Where the hand starts.
        approach: From above or from the side, in words.
        width: Of the object between the fingers [m].
    """

    model: ObjectModel
    X_TO: Array
    pregrasp: Pregrasp
    approach: str
    width: float


def check_grasp(hand: Hand, config: Config, shape: str) -> Finding:
    """Return whether the hand can grasp and lift a box or a cylinder, and how far that slips.

    Fingers that can be pushed open may lose what nothing centres between them. Of such a hand the
    finding says whether it holds with locked fingers, and what becomes of that grasp without.
    """
    # Try until one holds, which a whole lift shows.
    config = with_whole_lifts(config)
    drive = drive_of(hand, config.lift)
    rules = _with_drive(config, "locked" if drive == "torque" else drive)
    outcomes: Counter[str] = Counter()
    for grasp in trial_grasps(hand, shape):
        scene = build_scene(grasp.model, config.physics, hand)
        record = run_attempt(scene, grasp.X_TO, grasp.pregrasp, rules)
        outcomes[record.outcome.label] += 1
        if record.outcome is not Outcome.SUCCESS:
            continue
        text = (
            f"holds {1e3 * grasp.width:.0f} mm and {grasp.model.mass:g} kg {grasp.approach}; "
            f"{_slip(record)} with fingers that are {_HOW[rules.lift.drive or drive]}"
        )
        if drive == "torque":
            free = run_attempt(scene, grasp.X_TO, grasp.pregrasp, config)
            text += f", {_slip(free)} with its own, which are pushed open"
        return Finding(name=f"grasp of a {shape}", ok=True, text=text)

    tried = ", ".join(f"{count} {label}" for label, count in outcomes.items())
    text = f"a {shape} must be held, got {tried or 'no posture that holds one'}"
    return Finding(name=f"grasp of a {shape}", ok=False, text=text)


#: What a drive does to the fingers.
_HOW = {"worm": "held by worms", "locked": "locked", "torque": "pushed open"}


def _with_drive(config: Config, drive: Drive) -> Config:
    return config.model_copy(update={"lift": config.lift.model_copy(update={"drive": drive})})


def _slip(record: TrialRecord) -> str:
    """Return how far an object slipped in the lift, in words."""
    if record.outcome is not Outcome.SUCCESS or record.lift is None:
        return f"is {record.outcome.label}"
    return f"slips by {1e3 * record.lift.slip:.2f} mm and {np.rad2deg(record.lift.turn):.1f}°"


def trial_grasps(hand: Hand, shape: str) -> Iterator[TrialGrasp]:
    """Yield attempts at a box or a cylinder, of a few widths, from above and from the side."""
    for width in WIDTHS:
        pinch = find_pinch(hand, width)
        if pinch is None:
            continue
        axis = find_opposition(hand).axis
        across = np.cross([0.0, 0.0, 1.0], axis)
        for down, approach in (
            (np.array([0.0, 0.0, 1.0]), "from above"),
            (across, "from the side"),
            (-across, "from the other side"),
        ):
            grasp = _trial_grasp(hand, shape, pinch, axis, down, approach)
            if grasp is not None:
                yield grasp


def _trial_grasp(
    hand: Hand, shape: str, pinch: Pinch, axis: Array, down: Array, approach: str
) -> TrialGrasp | None:
    """Return an attempt with the hand in a given orientation; None where nothing fits.

    Args:
        hand: The hand.
        shape: "box" or "cylinder".
        pinch: The posture in which it will hold the object.
        axis: (3,), direction in {G} along which the fingers close.
        down: (3,), direction in {G} that points at the table.
        approach: In words.
    """
    # How far the object extends up and down from the pinch, and how thick it is.
    offsets = pinch.p_GQ - pinch.p_GM
    third = np.cross(down, axis)
    up = float(np.max(-offsets @ down)) + AROUND_PADS
    below = reach(hand, down) - float(pinch.p_GM @ down) + ABOVE_TABLE
    thick = max(2.0 * float(np.abs(offsets @ third).max() + AROUND_PADS), LEAST_SIZE)

    # Between palm and fingertips there must be room for it.
    room = float(pinch.p_GM[2]) - BEFORE_PALM
    if approach == "from above":
        up = min(max(up, LEAST_SIZE), room)
    else:
        up, thick = max(up, LEAST_SIZE), min(thick, 2.0 * room)
    if shape == "cylinder":
        thick = pinch.width
        if thick > 2.0 * room and approach != "from above":
            return None
    if min(up, thick) < AROUND_PADS:
        return None

    # The object, and the palm over it: {O} has its z axis up.
    height = up + below
    if shape == "box":
        mesh = trimesh.creation.box([thick, pinch.width, height])
    else:
        mesh = trimesh.creation.cylinder(pinch.width / 2.0, height, sections=48)
    mesh = mesh.subdivide().subdivide() if shape == "box" else mesh
    mass = MASS if hand.payload is None else min(MASS, hand.payload)
    model = make_object(
        mesh.vertices, mesh.faces, ObjectConfig(mass=mass),
        name=shape, class_name=shape, mesh_sha256="",
    )  # fmt: skip
    R_OG = np.stack([third, axis, -down])
    p_OM = np.array([0.0, 0.0, height / 2.0 - up])
    X_OG = make_pose(R_OG, p_OM - R_OG @ pinch.p_GM)
    return TrialGrasp(
        model=model,
        X_TO=make_pose(np.eye(3), [0.0, 0.0, height / 2.0]),
        pregrasp=Pregrasp(X_OG=X_OG, spread=0.0),
        approach=approach,
        width=pinch.width,
    )
