"""`draft_hand`: a folder with a hand file, made from a vendor's model.

Input: a URDF, SDFormat or MJCF file, and a person's answers about the hand. Output: a folder with
the hand file, the model as URDF, and meshes. Of several possible grips, the first one that passes
`hand check` is used, or else the one that fails the fewest checks.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import chain, islice
from pathlib import Path

import numpy as np

from drakegrasp.config import Config
from drakegrasp.errors import HandError
from drakegrasp.hand.checks import (
    Finding,
    check_couplings,
    check_efforts,
    check_geometry,
    check_limits,
    judge,
)
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.draft.fingers import Answers, find_fingers, find_palm
from drakegrasp.hand.draft.grips import find_grips, is_clear, trace_finger
from drakegrasp.hand.draft.hand_file import Draft, draft_file, positions, unused_fingers
from drakegrasp.hand.draft.palm import find_palm_frames
from drakegrasp.hand.draft.source import read_model
from drakegrasp.hand.draft.urdf import write_urdf
from drakegrasp.hand.draft.vendor import VendorModel, doubtful_units
from drakegrasp.hand.overlaps import overlap_query
from drakegrasp.hand.parsing import ModelFile
from drakegrasp.hand.settings import load_config
from drakegrasp.hand_setup.check import GRASPS, check_grasp
from drakegrasp.runtime.environment import one_thread
from drakegrasp.runtime.files import atomic_folder

#: Number of tested grips, number of palm frames with each, and fractions of the closing at
#: which links are placed.
GRIPS, FRAMES, SHARES = 6, 2, (0.0, 0.25, 0.5, 0.75, 1.0)
#: Number of postures in which links of different fingers are compared.
POSTURES = 24
#: Largest cost of a grip [rad]: it lacks one thing of a usual pinch, and its angles are below 90°.
WORST = 1.5 * np.pi
#: Patterns of a vendor's licence files.
LICENCES = ("LICENSE*", "LICENCE*", "COPYING*", "NOTICE*")
#: Number of folders above the model's that may have licence files.
MOST_ABOVE = 4


@dataclass(frozen=True, kw_only=True)
class NewHand:
    """A drafted hand.

    Attributes:
        path: The hand file.
        notes: What was left out of the model, added to it, or is not used.
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
    answers.refuse_unknown(model)

    doubts = tuple(doubtful_units(model))
    try:
        best, findings = _find_best(model, path, answers, config)
    except HandError as error:
        raise HandError("; ".join((str(error), *doubts))) from None
    if out.exists():
        out.rmdir()
    with atomic_folder(out) as folder:
        written = _write(best, folder, path)
        licences = _licences(path.resolve().parent)
        for licence in licences:
            shutil.copyfile(licence, folder / licence.name)
    far = sorted({str(each) for each in licences if each.parent != path.resolve().parent})
    notes = [f"{each} is copied: check that it is the licence of the model" for each in far]
    notes = [*doubts, *model.notes, *unused_fingers(model, best.grip, answers), *notes]
    return NewHand(path=out / written.name, notes=tuple(notes), findings=findings)


def _licences(folder: Path) -> list[Path]:
    """Return the licence files of the closest folder with some, from the model's folder upwards.

    A repository often has one at its root. A file above the root, or far above, is another
    project's.
    """
    for above in (folder, *folder.parents[:MOST_ABOVE]):
        found = chain.from_iterable(above.glob(name) for name in LICENCES)
        if files := sorted({file for file in found if file.is_file()}):
            return files
        if (above / ".git").exists() or above == Path.home():
            break
    return []


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
                file = _write(draft, Path(scratch) / f"{g}_{f}", path, drawn=False)
                findings = _findings(file, config)
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
            "model: no direction in which the palm faces the pinch is free: say it with --approach "
            "X,Y,Z in the palm link, or which fingers grasp with --fingers LINK,LINK"
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
            f"model: no fingers of {tips} close against each other: give positions of joints that "
            "do not close with --joint NAME=POSITION, or what closes the other way with --reverse "
            "JOINT"
        )

    # Leave out grips whose links collide too early; if all do, the first of all is used.
    write_urdf(_undrawn(model), scratch / "vendor.urdf", [])
    overlaps, shares = (
        overlap_query(ModelFile(scratch / "vendor.urdf"), palm),
        np.linspace(0.0, 1.0, POSTURES),
    )
    clear = (g for g in grips if is_clear(g, (positions(model, g, s) for s in shares), overlaps))
    for grip in chain(islice(clear, GRIPS), grips[:1]):
        postures = [positions(model, grip, share) for share in SHARES]
        frames = find_palm_frames(model, palm, grip, postures, answers.approach)
        yield (draft_file(model, palm, grip, frame, answers, config) for frame in frames[:FRAMES])


def _undrawn(model: VendorModel) -> VendorModel:
    """Return a model without its visual shapes, which take most of the time of writing."""
    links = {name: replace(link, visuals=()) for name, link in model.links.items()}
    return replace(model, links=links)


def _write(draft: Draft, folder: Path, path: Path, *, drawn: bool = True) -> Path:
    """Write the files of a hand, and return the hand file."""
    folder.mkdir(exist_ok=True)
    stem = path.stem if path.stem.endswith("_hand") else f"{path.stem}_hand"
    model, file = folder / f"{stem}.urdf", folder / f"{stem}.yaml"
    head = [f"Made from {path.name} by `drakegrasp hand new`.", *draft.changed, *draft.model.notes]
    write_urdf(draft.model if drawn else _undrawn(draft.model), model, head)
    lines = [
        f"Drafted from {path.name} by `drakegrasp hand new`. A comment is why a value was guessed:",
        "look at the picture, correct them, and run `drakegrasp hand check` again.",
        "Units: m, rad, N, N m, kg; degrees in keys that end in _deg.",
    ]
    named = replace(draft, tree={**draft.tree, "model": model.name})
    file.write_text(named.text(lines), encoding="utf-8")
    return file


def _findings(file: Path, config: Config) -> tuple[Finding, ...]:
    """Return the findings of the checks without a simulation."""
    try:
        hand = load_hand(file)
    except HandError as error:
        return (judge("files", [str(error).removeprefix(f"{file}: ")], ""),)
    limits = check_limits(hand)
    if not limits.ok:
        return (limits,)
    return limits, check_couplings(hand), check_efforts(hand, config), *check_geometry(hand)
