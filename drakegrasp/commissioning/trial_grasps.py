"""`check_hand`: all checks of a hand, and at last trial grasps: it lifts simple objects.

In: a hand. Out: for each object the best of a few attempts, whose palm poses follow from how the
fingertips close (`find_pinch`). The attempts are those of a build: `run_attempt` simulates them.
The object hangs in the air until it is held, so that gravity may act along the line on which the
fingers close, across it, or in between: a hand whose fingers do not resist along that line holds in
only some of these.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeAlias

import numpy as np
import trimesh

from drakegrasp.commissioning.checks import (
    Finding,
    check_couplings,
    check_efforts,
    check_geometry,
    check_limits,
    check_masses,
    judge,
)
from drakegrasp.config import Config, ObjectConfig, with_whole_lifts
from drakegrasp.errors import HandError
from drakegrasp.frames import Array, make_pose, rotation_about
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.hand.file_format import Drive
from drakegrasp.hand.finger_sweep import Pinch, find_opposition, find_pinch, reach
from drakegrasp.hand.settings import load_config
from drakegrasp.hand.shapes import link_shapes
from drakegrasp.objects.model import ObjectModel, make_object
from drakegrasp.outcomes import LOST, Outcome
from drakegrasp.runtime.environment import one_thread
from drakegrasp.simulation.attempt import Attempt
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


#: An object, its pose X_TO (4, 4) on the table, where the hand starts, and the width of the object
#: between the fingers [m].
TrialGrasp: TypeAlias = tuple[ObjectModel, Array, Attempt, float]
#: What is held, but moves more in the hand than a sample may.
MOVED = "moved too far in the hand"
#: What a drive does to the fingers.
_HOW = {"worm": "held by worms", "locked": "locked", "torque": "pushed open"}
#: How to mend a hand that holds nothing along the line on which its fingers close.
_SOFT = (
    "two motors that push against each other do not hold along their line; say `drive: worm` if "
    "its gears cannot be pushed open, or its fingers share a motor"
)
#: How to mend a hand that loses what it holds, and one whose grasps end otherwise, by what is said.
_LOST = "pads must face each other where they meet, and motors press enough (efforts)"
_MENDS = {
    Outcome.HAND_CONTACT.label: "other links touch it first; open the hand wider, or move the palm "
    "back (p_BG)",
    Outcome.START_COLLISION.label: "the open hand is in its way; keep fingers that do not grasp "
    "away with preshape",
    **{o.label: _LOST for o in LOST},
    MOVED: _LOST,
}


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
        return judge(name, [], "left out: the fingers stand too wide for a ball")

    # Try until one holds, which a whole lift shows.
    config = with_whole_lifts(config)
    drive = drive_of(hand, config.lift)
    rules: Drive = "locked" if drive == "torque" else drive
    locked = config.model_copy(update={"lift": config.lift.model_copy(update={"drive": rules})})
    outcomes: Counter[str] = Counter()
    missing: Counter[str] = Counter()
    for model, X_TO, pregrasp, width in trial_grasps(hand, shape, line):
        scene = build_scene(model, config.physics, hand)
        record = run_attempt(scene, X_TO, pregrasp, locked)
        if not _stays(record, config):
            held = record.outcome is Outcome.SUCCESS
            outcomes[MOVED if held else record.outcome.label] += 1
            if record.closed is not None:
                rows = zip(hand.fingers, record.closed.contacts.touching, strict=True)
                missing.update(finger.name for finger, touches in rows if not touches)
            continue
        text = (
            f"holds {1e3 * width:.0f} mm and {model.mass:g} kg; {_slip(record)} with "
            f"fingers that are {_HOW[rules]}"
        )
        if drive != "torque":
            return judge(name, [], text)
        free = run_attempt(scene, X_TO, pregrasp, config)
        text += f", {_slip(free)} with its own, which are pushed open"
        ok = _stays(free, config) or not LINES[line]
        return judge(name, [] if ok else [f"{text}: {_SOFT}"], text)

    tried = ", ".join(f"{count} {label}" for label, count in outcomes.items())
    text = f"a {shape} must be held, got {tried or 'no posture that holds one'}"
    mend = _mend(outcomes, missing)
    return judge(name, [f"{text}: {mend}" if mend else text], "")


def _stands_wide(hand: Hand) -> bool:
    """Return whether the fingers stand too far beside each other to hold a ball."""
    pinch = find_pinch(hand, max(WIDTHS))
    if pinch is None:
        return False
    axis, _ = find_opposition(hand)
    across = np.cross([0.0, 0.0, 1.0], axis)
    aside = np.abs((pinch.p_GQ - pinch.p_GM) @ across).max()
    return bool(aside > WIDEST * pinch.width)


def _mend(outcomes: Counter[str], missing: Counter[str]) -> str:
    """Return what may mend a hand whose trial grasps fail; nothing if it is not known."""
    label = outcomes.most_common(1)[0][0] if outcomes else ""
    if label == Outcome.MISSING_FINGERTIP.label and missing:
        return (
            f"{', '.join(missing)} must touch it within the pad_region, which contact elsewhere on "
            "the link misses; let the region reach 3 mm behind its face and to the end of the "
            "finger"
        )
    return _MENDS.get(label, "")


def _stays(record: TrialRecord, config: Config) -> bool:
    """Return whether an object is held without moving more than a sample may."""
    if record.outcome is not Outcome.SUCCESS or record.lift is None:
        return False
    turned = np.rad2deg(record.lift.turn)
    return bool(record.lift.slip <= config.lift.stop_slip and turned <= config.lift.stop_turn_deg)


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
    axis, _ = find_opposition(hand)
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
    radius, p_OM = pinch.width / 2.0, np.zeros(3)
    if shape == "box":
        mesh = trimesh.creation.box([wide, pinch.width, above + below]).subdivide().subdivide()
        p_OM[2] = (below - above) / 2.0
    elif shape == "cylinder":
        mesh = trimesh.creation.cylinder(radius, wide, sections=48)
        mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2.0, [0, 1, 0]))
    else:
        radius = max((pinch.width**2 + aside**2) / (2.0 * pinch.width), radius)
        mesh = trimesh.creation.icosphere(3, radius)
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
    X_TO = make_pose(R_TO, [0.0, 0.0, height])
    return model, X_TO, Attempt(X_OG=X_OG, spread=0.0), pinch.width


@one_thread
def check_hand(
    name_or_yaml: str | Path,
    *,
    config: Config | None = None,
    report: Callable[[Finding], None] | None = None,
) -> list[Finding]:
    """Return what is right and wrong about a hand.

    A check that others rely on comes before them, and where it fails they are left out.

    Args:
        name_or_yaml: A hand that comes with the package, or a hand file.
        config: The rules of its trial grasps; the defaults if None.
        report: Is called with each finding when it is there.
    """
    findings = []
    for finding in _findings(name_or_yaml, config or load_config()):
        findings.append(finding)
        if report is not None:
            report(finding)
    return findings


def _findings(name_or_yaml: str | Path, config: Config) -> Iterator[Finding]:
    """Yield the findings, up to the first check without which others make no sense."""
    # The files: without them there is no hand.
    try:
        hand = load_hand(name_or_yaml)
        count = sum(map(len, link_shapes(hand.model).values()))
    except HandError as error:
        yield judge("files", [str(error)], "")
        return
    joints, model = len(hand.joint_names), hand.model.path.name
    fine = f"{hand.num_fingers} fingers, {joints} joints, {count} shapes in {model}"
    yield judge("files", [], fine)

    # Masses, limits and couplings; the rest closes the hand, for which it needs its limits.
    yield check_masses(hand)
    limits = check_limits(hand)
    yield limits
    yield check_couplings(hand)
    if not limits.ok:
        return
    yield check_efforts(hand, config)

    # Geometry, then grasps.
    sound = True
    for finding in check_geometry(hand):
        sound = sound and finding.ok
        yield finding
    if sound:
        for shape, line in GRASPS:
            yield check_grasp(hand, config, shape, line)
