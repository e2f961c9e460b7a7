"""Drafts a hand file from a vendor's model.

In: a URDF, SDFormat or MJCF file, and what a person says of the hand. Out: a folder that is
complete by itself: hand file, model, meshes. Of several ways to grasp, the first is taken that
passes `hand check`, else the one that fails the fewest of its checks.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, count, islice
from pathlib import Path

from drakegrasp.commissioning.draft.answers import Answers
from drakegrasp.commissioning.draft.clearance import Clearance
from drakegrasp.commissioning.draft.fingers import find_chains, find_palm
from drakegrasp.commissioning.draft.hand_text import hand_text
from drakegrasp.commissioning.draft.hand_tree import Draft, draft_tree, positions
from drakegrasp.commissioning.draft.notes import unused_parts
from drakegrasp.commissioning.draft.opposition import Grip, find_grips, find_reach
from drakegrasp.commissioning.draft.palm import find_palm_frames
from drakegrasp.commissioning.finding import Finding
from drakegrasp.commissioning.model_checks import check_couplings, check_efforts, check_limits
from drakegrasp.commissioning.run import check_geometry
from drakegrasp.commissioning.trial_grasps import GRASPS, check_grasp
from drakegrasp.config import Config
from drakegrasp.errors import HandError
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.draft.model import VendorModel
from drakegrasp.hand.draft.parsing import read_model
from drakegrasp.hand.draft.source import read_source
from drakegrasp.hand.draft.writing import write_urdf
from drakegrasp.hand.settings import load_config
from drakegrasp.runtime.environment import one_thread
from drakegrasp.runtime.files import atomic_folder

#: Grips that are tried, palm frames with each, and shares of the closing at which links are seen.
GRIPS, FRAMES, SHARES = 6, 2, (0.0, 0.25, 0.5, 0.75, 1.0)
#: Postures at which links of different fingers are compared.
POSTURES = 24
#: A pinch that costs more than this is none: fingers that pass each other.
WORST = 2.4
#: Files of a vendor that say what may be done with the model.
LICENCES = ("LICENSE*", "LICENCE*", "COPYING*", "NOTICE*")
#: So many folders above the model's may have them.
MOST_ABOVE = 4


@dataclass(frozen=True, kw_only=True)
class NewHand:
    """A hand that was drafted.

    Attributes:
        path: Its hand file.
        notes: What was left out of the model, put in, or is not used.
        findings: What the checks of its files and geometry say.
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
    roots: Sequence[Path] = (),
) -> NewHand:
    """Write a hand file, its model and its meshes into a new folder.

    Args:
        path: A URDF, SDFormat or MJCF file.
        out: The folder; it must not exist, or be empty.
        answers: What overrides the guesses.
        packages: Folders of package:// URIs, by name.
        roots: Folders outside of the model's whose files it may use.

    Raises:
        HandError: If the model cannot be used, or something cannot be guessed; one line that says
            how to mend or answer it.
    """
    answers, config = answers or Answers(), load_config()
    if out.exists() and not (out.is_dir() and not any(out.iterdir())):
        raise HandError(f"--out must be a new or empty folder, got {str(out)!r}")
    model = read_model(read_source(path, packages or {}, roots))
    _refuse_unknown(model, answers)

    best, findings = _find_best(model, path, answers, config)
    if out.exists():
        out.rmdir()
    with atomic_folder(out) as folder:
        written = _write(best, folder, path)
        licences = _licences(path.resolve().parent)
        for licence in licences:
            shutil.copyfile(licence, folder / licence.name)
    far = {str(each) for each in licences if each.parent != path.resolve().parent}
    notes = [f"{each} is copied: see that the model is under it" for each in sorted(far)]
    notes = [*model.notes, *unused_parts(model, best.grip, answers), *notes]
    return NewHand(path=out / written.name, notes=tuple(notes), findings=findings)


def _licences(folder: Path) -> list[Path]:
    """Return the licence files of the nearest folder that has some, from that of a model upwards.

    A repository often has one at its root. What is above that, or far above, is another's.
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
    """Return the first draft that passes all checks, or that which passes most, and its findings.

    Raises:
        HandError: If there is none.
    """
    best: tuple[int, Draft, tuple[Finding, ...]] | None = None
    with tempfile.TemporaryDirectory() as scratch:
        folders = (Path(scratch) / str(n) for n in count())
        for drafts in _drafts(model, answers, config):
            # The palm frames of a grip, until its geometry is sound; then whether it holds.
            for draft in drafts:
                file = _write(_undrawn(draft), next(folders), path)
                findings = _findings(file, config)
                sound = all(finding.ok for finding in findings)
                if sound:
                    findings = (*findings, *_grasps(file, config))
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


def _refuse_unknown(model: VendorModel, answers: Answers) -> None:
    """Refuse answers about joints that the model does not have."""
    for option, names in (("--joint", answers.joints), ("--reverse", answers.reverse)):
        for name in names:
            if name not in model.joints:
                joints = ", ".join(model.joints)
                raise HandError(f"{option} must name one of {joints}, got {name!r}")
    for name, position in answers.joints.items():
        lower, upper = model.joints[name].limits
        if not lower <= position <= upper:
            raise HandError(f"--joint {name} must be {lower:g}..{upper:g}, got {position:g}")


def _drafts(model: VendorModel, answers: Answers, config: Config) -> Iterator[Iterator[Draft]]:
    """Yield hand files, the likeliest first: for each grip those of its palm frames."""
    palm = find_palm(model, answers)
    chains = find_chains(model, palm, answers)
    grips = find_grips([find_reach(model, palm, c) for c in chains])
    if not grips or grips[0].cost > WORST:
        tips = ", ".join(c.tip for c in chains)
        raise HandError(
            f"model: no fingers of {tips} close against each other: give positions of joints that "
            "do not close with --joint NAME=POSITION, or what closes the other way with --reverse "
            "JOINT"
        )
    # Those whose links meet too early are left out; the first of all is better than none.
    clearance = Clearance(model, palm)
    clear = (g for g in grips if clearance.is_clear(g, _on_the_way(model, g)))
    for grip in chain(islice(clear, GRIPS), grips[:1]):
        postures = [positions(model, grip, share) for share in SHARES]
        frames = find_palm_frames(model, palm, grip, postures, answers.approach)
        yield (draft_tree(model, palm, grip, frame, answers, config) for frame in frames[:FRAMES])


def _on_the_way(model: VendorModel, grip: Grip) -> Iterator[dict[str, float]]:
    """Yield the positions of all joints on the way from the open hand to the closed one."""
    return (positions(model, grip, n / (POSTURES - 1)) for n in range(POSTURES))


def _undrawn(draft: Draft) -> Draft:
    """Return a draft without pictures: most of the time of writing one is theirs."""
    links = {name: replace(link, visuals=()) for name, link in draft.model.links.items()}
    return replace(draft, model=replace(draft.model, links=links))


def _write(draft: Draft, folder: Path, path: Path) -> Path:
    """Write the files of a hand, and return the hand file."""
    folder.mkdir(exist_ok=True)
    stem = path.stem if path.stem.endswith("_hand") else f"{path.stem}_hand"
    model = folder / f"{stem}.urdf"
    head = [f"Made from {path.name} by `drakegrasp hand new`.", *draft.changed, *draft.model.notes]
    write_urdf(draft.model, model, head)
    file = folder / f"{stem}.yaml"
    lines = [
        f"Drafted from {path.name} by `drakegrasp hand new`. Values with a comment were guessed:",
        "look at the picture, mend them, and run `drakegrasp hand check` again.",
        "Units: m, rad, N, N m, kg; degrees in keys that end in _deg.",
    ]
    text = hand_text({**draft.tree, "model": model.name}, draft.reasons, lines)
    file.write_text(text, encoding="utf-8")
    return file


def _findings(file: Path, config: Config) -> tuple[Finding, ...]:
    """Return what is right and wrong about a hand; nothing is simulated."""
    try:
        hand = load_hand(file)
    except HandError as error:
        return (Finding(name="files", ok=False, text=str(error).removeprefix(f"{file}: ")),)
    limits = check_limits(hand)
    if not limits.ok:
        return (limits,)
    return limits, check_couplings(hand), check_efforts(hand, config), *check_geometry(hand)


def _grasps(file: Path, config: Config) -> Iterator[Finding]:
    """Yield what trial grasps say, up to the first that fails."""
    for shape, line in GRASPS:
        finding = check_grasp(load_hand(file), config, shape, line)
        yield finding
        if not finding.ok:
            return
