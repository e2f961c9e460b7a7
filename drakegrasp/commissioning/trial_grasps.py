"""Trial grasps: the hand closes on simple objects, and lifts them, in simulation.

In: a hand. Out: for each object the best of a few attempts, whose palm poses follow from how the
fingertips close (`pinch`). The attempts are those of a build: `run_attempt` simulates them. The
object hangs in the air until it is held, so that gravity may act along the line on which the
fingers close, across it, or in between: a hand whose fingers do not resist along that line holds in
only some of these.
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
from drakegrasp.frames import Array, make_pose, rotation_about
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
ABOVE_TABLE, BEFORE_PALM, AROUND_PADS = 0.1, 0.008, 0.012
#: Least size of an object in any direction [m].
LEAST_SIZE = 0.03
#: Fingers farther beside the middle than this share of a ball's width meet only its sides.
WIDEST = 0.7
#: The line along which the fingers close, by its angle above the horizontal [rad]. Where it is
#: level, the palm faces the table.
LINES = {"level": 0.0, "tilted": np.deg2rad(45.0), "upright": np.deg2rad(90.0)}
#: Objects that the hand must grasp, and the lines on which it must.
GRASPS = (
    *(("box", line) for line in LINES),
    ("cylinder", "level"),
    ("sphere", "level"),
)


@dataclass(frozen=True, kw_only=True, eq=False)
class TrialGrasp:
    """An object on the table, and an attempt to grasp it.

    Attributes:
        model: The object.
        X_TO: Its pose in the table-top frame, (4, 4).
        pregrasp: Where the hand starts.
        width: Of the object between the fingers [m].
    """

    model: ObjectModel
    X_TO: Array
    pregrasp: Pregrasp
    width: float


def check_grasp(hand: Hand, config: Config, shape: str, line: str = "level") -> Finding:
    """Return whether the hand can grasp and lift an object, and how far that slips.

    Fingers that can be pushed open may lose what nothing centres between them. Of such a hand the
    finding says whether it holds with locked fingers, and what becomes of that grasp without.

    Args:
        hand: The hand.
        config: The rules.
        shape: "box", "cylinder" or "sphere".
        line: On which the fingers close, one of `LINES`.
    """
    name = f"{shape}, {line}"
    if shape == "sphere" and _stands_wide(hand):
        return Finding(name=name, ok=True, text="left out: the fingers stand too wide for a ball")

    # Try until one holds, which a whole lift shows.
    config = with_whole_lifts(config)
    drive = drive_of(hand, config.lift)
    rules = _with_drive(config, "locked" if drive == "torque" else drive)
    outcomes: Counter[str] = Counter()
    missing: Counter[str] = Counter()
    for grasp in trial_grasps(hand, shape, line):
        scene = build_scene(grasp.model, config.physics, hand)
        record = run_attempt(scene, grasp.X_TO, grasp.pregrasp, rules)
        held = record.outcome is Outcome.SUCCESS
        outcomes[record.outcome.label if not held or _stays(record, config) else MOVED] += 1
        if not held or not _stays(record, config):
            missing.update(_missing(hand, record))
            continue
        text = (
            f"holds {1e3 * grasp.width:.0f} mm and {grasp.model.mass:g} kg; {_slip(record)} with "
            f"fingers that are {_HOW[rules.lift.drive or drive]}"
        )
        if drive != "torque":
            return Finding(name=name, ok=True, text=text)
        free = run_attempt(scene, grasp.X_TO, grasp.pregrasp, config)
        text += f", {_slip(free)} with its own, which are pushed open"
        ok = _stays(free, config) or not LINES[line]
        mend = "" if ok else f": {_SOFT}"
        return Finding(name=name, ok=ok, text=text + mend)

    tried = ", ".join(f"{count} {label}" for label, count in outcomes.items())
    text = f"a {shape} must be held, got {tried or 'no posture that holds one'}"
    return Finding(name=name, ok=False, text=text + _mend(outcomes, missing))


def _stands_wide(hand: Hand) -> bool:
    """Return whether the fingers stand too far beside each other to hold a ball."""
    pinch = find_pinch(hand, max(WIDTHS))
    if pinch is None:
        return False
    across = np.cross([0.0, 0.0, 1.0], find_opposition(hand).axis)
    aside = np.abs((pinch.p_GQ - pinch.p_GM) @ across).max()
    return bool(aside > WIDEST * pinch.width)


#: What is held, but moves more in the hand than a sample may.
MOVED = "moved too far in the hand"
#: How to mend a hand that holds nothing along the line on which its fingers close.
_SOFT = (
    "two motors that push against each other do not hold along their line; say `drive: worm` if "
    "its gears cannot be pushed open, or its fingers share a motor"
)


def _missing(hand: Hand, record: TrialRecord) -> list[str]:
    """Return the names of the fingers that do not touch the object when the hand has closed."""
    if record.closed is None:
        return []
    touching = record.closed.contacts.touching
    return [f.name for f, touches in zip(hand.fingers, touching, strict=True) if not touches]


def _mend(outcomes: Counter[str], missing: Counter[str]) -> str:
    """Return what may mend a hand whose trial grasps fail."""
    label = outcomes.most_common(1)[0][0] if outcomes else ""
    if label == Outcome.MISSING_FINGERTIP.label and missing:
        names = ", ".join(missing)
        return (
            f": {names} must touch it within the pad_region, which contact elsewhere on the link "
            "misses; let the region reach 3 mm behind its face and to the end of the finger"
        )
    if label == Outcome.HAND_CONTACT.label:
        return ": other links touch it first; open the hand wider, or move the palm back (p_BG)"
    if label == Outcome.START_COLLISION.label:
        return ": the open hand is in its way; keep fingers that do not grasp away with preshape"
    lost = (Outcome.SLIPPED, Outcome.PARTLY_HELD, Outcome.DROPPED)
    if label in (*(outcome.label for outcome in lost), MOVED):
        return ": pads must face each other where they meet, and motors press enough (efforts)"
    return ""


def _stays(record: TrialRecord, config: Config) -> bool:
    """Return whether an object is held without moving more than a sample may."""
    if record.outcome is not Outcome.SUCCESS or record.lift is None:
        return False
    turned = np.rad2deg(record.lift.turn)
    return bool(record.lift.slip <= config.lift.stop_slip and turned <= config.lift.stop_turn_deg)


#: What a drive does to the fingers.
_HOW = {"worm": "held by worms", "locked": "locked", "torque": "pushed open"}


def _with_drive(config: Config, drive: Drive) -> Config:
    return config.model_copy(update={"lift": config.lift.model_copy(update={"drive": drive})})


def _slip(record: TrialRecord) -> str:
    """Return how far an object slipped in the lift, in words."""
    if record.outcome is not Outcome.SUCCESS or record.lift is None:
        return f"is {record.outcome.label}"
    return f"slips by {1e3 * record.lift.slip:.2f} mm and {np.rad2deg(record.lift.turn):.1f}°"


def trial_grasps(hand: Hand, shape: str, line: str = "level") -> Iterator[TrialGrasp]:
    """Yield attempts at an object of a few widths, see `check_grasp`."""
    for width in WIDTHS:
        pinch = find_pinch(hand, width)
        grasp = None if pinch is None else _trial_grasp(hand, shape, pinch, LINES[line])
        if grasp is not None:
            yield grasp


def _trial_grasp(hand: Hand, shape: str, pinch: Pinch, angle: float) -> TrialGrasp | None:
    """Return an attempt; None where nothing fits between palm and fingertips.

    Args:
        hand: The hand.
        shape: "box", "cylinder" or "sphere".
        pinch: The posture in which it will hold the object.
        angle: Of the line on which the fingers close, above the horizontal [rad].
    """
    # The object's axes: x beside the fingers, y along their line, z towards the palm.
    axis = find_opposition(hand).axis
    R_OG = np.stack([np.cross([0.0, 0.0, 1.0], axis), axis, [0.0, 0.0, -1.0]])
    offsets = (pinch.p_GQ - pinch.p_GM) @ R_OG.T
    room = float(pinch.p_GM[2]) - BEFORE_PALM
    aside = float(np.abs(offsets[:, 0]).max())
    above = min(max(float(offsets[:, 2].max()) + AROUND_PADS, LEAST_SIZE / 2.0), room)
    below = max(float(-offsets[:, 2].min()) + AROUND_PADS, LEAST_SIZE / 2.0)
    wide = max(2.0 * (aside + AROUND_PADS), LEAST_SIZE)
    if above < AROUND_PADS:
        return None

    # A cylinder lies across the fingers. Those beside each other meet a ball off its middle.
    radius = pinch.width / 2.0
    if shape == "box":
        mesh = trimesh.creation.box([wide, pinch.width, above + below]).subdivide().subdivide()
        p_OM = np.array([0.0, 0.0, (below - above) / 2.0])
    elif shape == "cylinder":
        mesh = trimesh.creation.cylinder(radius, wide, sections=48)
        mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2.0, [0, 1, 0]))
        p_OM = np.zeros(3)
    else:
        radius = max((pinch.width**2 + aside**2) / (2.0 * pinch.width), radius)
        mesh = trimesh.creation.icosphere(3, radius)
        p_OM = np.zeros(3)
    if shape != "box" and radius > room:
        return None
    mass = MASS if hand.payload is None else min(MASS, hand.payload)
    model = make_object(
        mesh.vertices, mesh.faces, ObjectConfig(mass=mass),
        name=shape, class_name=shape, mesh_sha256="",
    )  # fmt: skip
    X_OG = make_pose(R_OG, p_OM - R_OG @ pinch.p_GM)

    # It hangs so high that the hand is clear of the table.
    R_TO = rotation_about([1.0, 0.0, 0.0], angle)
    down = R_OG.T @ R_TO.T @ [0.0, 0.0, -1.0]
    height = reach(hand, down) - float((R_TO @ X_OG[:3, 3])[2]) + ABOVE_TABLE
    height = max(height, float(-(mesh.vertices @ R_TO.T)[:, 2].min()) + ABOVE_TABLE)
    return TrialGrasp(
        model=model,
        X_TO=make_pose(R_TO, [0.0, 0.0, height]),
        pregrasp=Pregrasp(X_OG=X_OG, spread=0.0),
        width=pinch.width,
    )
