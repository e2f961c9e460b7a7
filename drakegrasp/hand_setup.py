"""Checks and drafts of a hand, with trial grasps in which it lifts simple objects.

`check_hand` checks a hand before it is used: its files and geometry (`hand/checks.py`), then trial
grasps. Their palm poses follow from how the fingertips close (`find_pinch`), and `run_attempt`
simulates them as in a build. The object hangs in the air until it is held. So gravity can act along
the line on which the fingers close, across it, or in between. A hand whose fingers do not resist
along that line holds in only some of these cases.

`draft_hand` makes a folder with a hand file from a vendor's model. Of several possible grips, the
first one that passes these checks is used, or else the one that fails the fewest.
"""

from __future__ import annotations

import shutil
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path
from typing import TypeAlias

import numpy as np
import trimesh
import yaml

from drakegrasp.config import Config, ObjectConfig, with_whole_lifts
from drakegrasp.errors import HandError
from drakegrasp.frames import Array, make_pose, rotation_about
from drakegrasp.hand.checks import Finding, check_files, early_overlaps, judge, overlap_query
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.hand.draft.fingers import Answers, find_fingers, find_palm
from drakegrasp.hand.draft.grips import Grip, find_grips, find_palm_frames, trace_finger
from drakegrasp.hand.draft.hand_file import Draft, draft_file, positions
from drakegrasp.hand.draft.source import read_model
from drakegrasp.hand.draft.vendor import VendorModel, write_urdf
from drakegrasp.hand.file_format import Drive
from drakegrasp.hand.finger_sweep import Pinch, find_opposition, find_pinch, reach
from drakegrasp.hand.parsing import ModelFile
from drakegrasp.hand.settings import load_config
from drakegrasp.objects.model import ObjectModel, make_object
from drakegrasp.outcomes import Outcome
from drakegrasp.runtime.environment import one_thread
from drakegrasp.runtime.files import atomic_folder
from drakegrasp.simulation.attempt import Attempt
from drakegrasp.simulation.construction import build_scene
from drakegrasp.simulation.drive import drive_of
from drakegrasp.simulation.trial import TrialRecord, run_attempt

#: Widths of the trial objects [m].
WIDTHS = (0.045, 0.06, 0.03)
#: Largest mass of the objects [kg]; a smaller payload of the hand replaces it.
MASS = 0.3
#: Space between hand and table, between palm and object, and around the pads on the object [m].
ABOVE_TABLE, BEFORE_PALM, AROUND_PADS = 0.1, 0.008, 0.012
#: Smallest size of an object in any direction [m].
LEAST_SIZE = 0.03
#: Fingers farther from the centre than this fraction of a ball's width only meet its sides.
WIDEST = 0.7
#: Angle of the line on which the fingers close, above the horizontal [rad]. If the line is level,
#: the palm faces the table.
LINES = {"level": 0.0, "tilted": np.deg2rad(45.0), "upright": np.deg2rad(90.0)}
#: Objects that the hand must grasp, and the lines on which it must grasp them.
GRASPS = (
    *(("box", line) for line in LINES),
    ("cylinder", "level"),
    ("sphere", "level"),
)


#: An object, its pose X_TO (4, 4) on the table, the start of the hand, and the width of the object
#: between the fingers [m].
TrialGrasp: TypeAlias = tuple[ObjectModel, Array, Attempt, float]
#: Label of a grasp that holds, but moves more in the hand than a sample may.
MOVED = "moved too far in the hand"
#: What a drive does to the fingers, in words.
_HOW = {"worm": "held by worms", "locked": "locked", "torque": "pushed open"}
#: How to repair a hand that holds nothing along the line on which its fingers close.
_SOFT = (
    "two motors that push against each other do not hold along their line; say `drive: worm` if "
    "its gears cannot be pushed open, or its fingers share a motor"
)
#: Number of tested grips, number of palm frames with each, and fractions of the closing at
#: which links are placed.
GRIPS, FRAMES, SHARES = 6, 2, (0.0, 0.25, 0.5, 0.75, 1.0)
#: Number of postures in which links of different fingers are compared.
POSTURES = 24
#: Allowed overlap of links other than fingertips [m].
SUNK = 5e-4
#: Largest cost of a grip [rad]: it lacks one thing of a usual pinch, and its angles are below 90°.
WORST = 1.5 * np.pi
#: Patterns of licence files beside a model.
LICENCES = ("LICENSE*", "LICENCE*", "COPYING*", "NOTICE*")


@one_thread
def check_hand(
    name_or_yaml: str | Path,
    *,
    config: Config | None = None,
    report: Callable[[Finding], None] | None = None,
) -> list[Finding]:
    """Return the findings of all checks of a hand.

    A check that others depend on comes before them; if it fails, they are left out. So are the
    trial grasps if any other check fails.

    Args:
        name_or_yaml: A hand of the package, or a hand file.
        config: The rules of the trial grasps; None for the defaults.
        report: Is called with each finding as soon as it is known.
    """
    findings = []
    for finding in _findings(name_or_yaml, config or load_config()):
        findings.append(finding)
        if report is not None:
            report(finding)
    return findings


def _findings(name_or_yaml: str | Path, config: Config) -> Iterator[Finding]:
    sound = True
    for finding in check_files(name_or_yaml, config):
        sound = sound and finding.ok
        yield finding
    for shape, line in GRASPS if sound else ():
        yield check_grasp(load_hand(name_or_yaml), config, shape, line)


def check_grasp(hand: Hand, config: Config, shape: str, line: str = "level") -> Finding:
    """Return whether the hand can grasp and lift an object, and how far the object slips.

    Fingers that can be pushed open may lose an object that nothing centres between them. For such a
    hand, the finding states whether it holds with locked fingers, and the result of the same grasp
    without locking.

    Args:
        hand: The hand.
        config: The rules.
        shape: "box", "cylinder" or "sphere".
        line: Line on which the fingers close, one of `LINES`.
    """
    name = f"{shape}, {line}"
    if shape == "sphere" and _stands_wide(hand):
        return judge(name, [], "left out: the fingers stand too wide for a ball")

    # Try until one grasp holds, which only a whole lift shows.
    config = with_whole_lifts(config)
    drive = drive_of(hand, config.lift)
    rules: Drive = "locked" if drive == "torque" else drive
    locked = config.model_copy(update={"lift": config.lift.model_copy(update={"drive": rules})})
    outcomes: Counter[str] = Counter()
    for model, X_TO, pregrasp, width in trial_grasps(hand, shape, line):
        scene = build_scene(model, config.physics, hand)
        record = run_attempt(scene, X_TO, pregrasp, locked)
        if not _stays(record, config):
            lifted = record.outcome is Outcome.SUCCESS
            outcomes[MOVED if lifted else record.outcome.label] += 1
            continue
        text = (
            f"holds {1e3 * width:.0f} mm and {model.mass:g} kg; {_slip(record)} with "
            f"fingers that are {_HOW[rules]}"
        )
        if drive != "torque":
            return judge(name, [], text)
        free = run_attempt(scene, X_TO, pregrasp, config)
        text += f", and {_slip(free)} with fingers that motors of its own strength keep closed"
        ok = _stays(free, config) or not LINES[line]
        return judge(name, [] if ok else [f"{text}: {_SOFT}"], text)

    tried = ", ".join(f"{count} {label}" for label, count in outcomes.items())
    return judge(name, [f"a {shape} must be held, got {tried or 'no posture that holds one'}"], "")


def _stands_wide(hand: Hand) -> bool:
    """Return whether the fingers are too far beside each other to hold a ball."""
    pinch = find_pinch(hand, max(WIDTHS))
    if pinch is None:
        return False
    axis, _ = find_opposition(hand)
    across = np.cross([0.0, 0.0, 1.0], axis)
    aside = np.abs((pinch.p_GQ - pinch.p_GM) @ across).max()
    return bool(aside > WIDEST * pinch.width)


def _stays(record: TrialRecord, config: Config) -> bool:
    """Return whether an object is held and moves at most as much as a sample may."""
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
    """Return an attempt; None if no object fits between palm and fingertips.

    Args:
        hand: The hand.
        shape: "box", "cylinder" or "sphere".
        pinch: The posture in which the hand will hold the object.
        angle: Angle of the line on which the fingers close, above the horizontal [rad].
    """
    # The object's axes: x across the fingers, y along their line, z towards the palm.
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

    # A cylinder lies across the fingers. Fingers beside each other meet a ball beside its centre.
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

    # The object hangs so high that the hand is clear of the table.
    R_TO = rotation_about([1.0, 0.0, 0.0], angle)
    down = R_OG.T @ R_TO.T @ [0.0, 0.0, -1.0]
    height = reach(hand, down) - float((R_TO @ X_OG[:3, 3])[2]) + ABOVE_TABLE
    height = max(height, float(-(mesh.vertices @ R_TO.T)[:, 2].min()) + ABOVE_TABLE)
    X_TO = make_pose(R_TO, [0.0, 0.0, height])
    return model, X_TO, Attempt(X_OG=X_OG, spread=0.0), pinch.width


@dataclass(frozen=True, kw_only=True)
class NewHand:
    """A drafted hand.

    Attributes:
        path: The hand file.
        notes: What was left out of the model or added to it.
        findings: Findings of the checks of its files and geometry.
    """

    path: Path
    notes: tuple[str, ...]
    findings: tuple[Finding, ...]


@one_thread
def draft_hand(
    path: Path,
    out: Path,
    *,
    answers: Answers | None = None,
    packages: Mapping[str, Path] | None = None,
) -> NewHand:
    """Write a hand file, its model and its meshes into a new folder.

    Args:
        path: A URDF, SDFormat or MJCF file.
        out: The folder; it must not exist, or be empty.
        answers: Answers that override the guesses.
        packages: Folders of package:// URIs, by name.

    Raises:
        HandError: If the model cannot be used, or something cannot be guessed. The message has one
            line, which states how to repair the model or give an answer.
    """
    answers, config = answers or Answers(), load_config()
    if out.exists() and not (out.is_dir() and not any(out.iterdir())):
        raise HandError(f"--out must be a new or empty folder, got {str(out)!r}")
    model = read_model(path, packages)

    best, findings = _find_best(model, path, answers, config)
    if out.exists():
        out.rmdir()
    with atomic_folder(out) as folder:
        written = _write(best, folder, path)
        for licence in chain.from_iterable(path.resolve().parent.glob(name) for name in LICENCES):
            if licence.is_file():
                shutil.copyfile(licence, folder / licence.name)
    return NewHand(path=out / written.name, notes=model.notes, findings=findings)


def _find_best(
    model: VendorModel, path: Path, answers: Answers, config: Config
) -> tuple[Draft, tuple[Finding, ...]]:
    """Return the first draft that passes all checks, or that passes most, and its findings.

    Raises:
        HandError: If there is no draft.
    """
    best: tuple[int, Draft, tuple[Finding, ...]] | None = None
    with tempfile.TemporaryDirectory() as scratch:
        for g, drafts in enumerate(_drafts(model, answers, config, Path(scratch))):
            # Try the palm frames of a grip until its geometry is sound, then whether it holds.
            for f, draft in enumerate(drafts):
                file = _write(draft, Path(scratch) / f"{g}_{f}", path)
                findings = tuple(check_files(file, config))
                sound = all(finding.ok for finding in findings)
                for shape, line in GRASPS if sound else ():
                    findings = *findings, check_grasp(load_hand(file), config, shape, line)
                    if not findings[-1].ok:
                        break
                passed = sum(finding.ok for finding in findings)
                if best is None or passed > best[0]:
                    best = passed, draft, findings
                if sound:
                    break
            if best is not None and best[0] == len(best[2]):
                break
    if best is None:
        raise HandError(
            "model: no direction in which the palm faces the pinch is free: say which "
            "fingers grasp with --fingers LINK,LINK"
        )
    return best[1:]


def _drafts(
    model: VendorModel, answers: Answers, config: Config, scratch: Path
) -> Iterator[Iterator[Draft]]:
    """Yield hand files, the likeliest first: for each grip those of its palm frames."""
    palm = find_palm(model, answers)
    fingers = find_fingers(model, palm, answers)
    grips = find_grips([trace_finger(model, palm, *finger) for finger in fingers])
    if not grips or grips[0].cost > WORST:
        tips = ", ".join(joints[-1].child for joints, _ in fingers)
        raise HandError(
            f"model: no fingers of {tips} close against each other: say which fingers grasp "
            "with --fingers LINK,LINK"
        )

    # Leave out grips whose links collide too early; if all do, the first of all is used.
    write_urdf(model, scratch / "vendor.urdf", [])
    query = overlap_query(ModelFile(scratch / "vendor.urdf"), palm)

    def is_clear(grip: Grip) -> bool:
        movers = {joint.child: i for i, f in enumerate(grip.fingers) for joint in f.joints}
        postures = (positions(model, grip, share) for share in np.linspace(0.0, 1.0, POSTURES))
        tips = {finger.tip for finger in grip.fingers}
        return max(early_overlaps(query, postures, movers, tips).values(), default=0.0) <= SUNK

    for grip in chain(islice(filter(is_clear, grips), GRIPS), grips[:1]):
        postures = [positions(model, grip, share) for share in SHARES]
        frames = find_palm_frames(model, palm, grip, postures)
        yield (draft_file(model, palm, grip, frame, answers, config) for frame in frames[:FRAMES])


def _write(draft: Draft, folder: Path, path: Path) -> Path:
    """Write the files of a hand, and return the hand file."""
    folder.mkdir(exist_ok=True)
    stem = path.stem if path.stem.endswith("_hand") else f"{path.stem}_hand"
    model, file = folder / f"{stem}.urdf", folder / f"{stem}.yaml"
    head = [f"Made from {path.name} by `drakegrasp hand new`.", *draft.changed, *draft.model.notes]
    write_urdf(draft.model, model, head)
    lines = [
        f"Drafted from {path.name} by `drakegrasp hand new`. Values are guesses: look at the",
        "picture, correct them, and run `drakegrasp hand check` again.",
        "Units: m, rad, N, N m, kg; degrees in keys that end in _deg.",
    ]
    text = yaml.safe_dump(
        {**draft.tree, "model": model.name}, sort_keys=False, default_flow_style=None, width=100
    )
    file.write_text("".join(f"# {line}\n" for line in lines) + text, encoding="utf-8")
    return file
