"""`draft_hand`: a folder with a hand file, made from a vendor's model.

Input: a URDF, SDFormat or MJCF file, and a person's answers about the hand. Output: a folder with
the hand file, the model as URDF, and meshes. Of several possible grips, the first one that passes
`hand check` is used, or else the one that fails the fewest checks.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path

import numpy as np
import yaml

from drakegrasp.config import Config
from drakegrasp.errors import HandError
from drakegrasp.hand.checks import Finding, early_overlaps, overlap_query
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.draft.fingers import Answers, find_fingers, find_palm
from drakegrasp.hand.draft.grips import Grip, find_grips, trace_finger
from drakegrasp.hand.draft.hand_file import Draft, draft_file, positions
from drakegrasp.hand.draft.palm import find_palm_frames
from drakegrasp.hand.draft.source import read_model
from drakegrasp.hand.draft.vendor import VendorModel, write_urdf
from drakegrasp.hand.parsing import ModelFile
from drakegrasp.hand.settings import load_config
from drakegrasp.hand_setup.check import GRASPS, check_files, check_grasp
from drakegrasp.runtime.environment import one_thread
from drakegrasp.runtime.files import atomic_folder

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
