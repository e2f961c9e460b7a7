"""Drafts a hand file from a vendor's model.

Input: a URDF, SDFormat or MJCF file, and a person's answers about the hand. Output: a complete
folder with the hand file, which has a comment on each guessed line, the model as URDF, and meshes.
Of several possible grips, the first one that passes `hand check` is used, or else the one that
fails the fewest checks.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, combinations_with_replacement, count, islice
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np
import yaml
from pydrake.geometry import Box, Capsule, Cylinder, Sphere
from pydrake.math import RotationMatrix

from drakegrasp.commissioning.checks import (
    Finding,
    check_couplings,
    check_efforts,
    check_geometry,
    check_limits,
    judge,
)
from drakegrasp.commissioning.draft.fingers import Answers, find_fingers, find_palm
from drakegrasp.commissioning.draft.grips import clear_grips, find_grips, find_members
from drakegrasp.commissioning.draft.model import (
    VendorJoint,
    VendorModel,
    doubtful_units,
    read_model,
)
from drakegrasp.commissioning.draft.palm import find_palm_frames
from drakegrasp.commissioning.draft.parts import Link
from drakegrasp.commissioning.draft.shapes import Shape
from drakegrasp.commissioning.draft.source import read_source
from drakegrasp.commissioning.draft.tree import Draft, draft_tree, positions, unused_parts
from drakegrasp.commissioning.trial_grasps import GRASPS, check_grasp
from drakegrasp.config import Config
from drakegrasp.errors import HandError
from drakegrasp.frames import Array
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.parsing import Mimic
from drakegrasp.hand.settings import load_config
from drakegrasp.mesh.wavefront import obj_text
from drakegrasp.runtime.environment import one_thread
from drakegrasp.runtime.files import atomic_folder

#: Folder of the meshes.
MESHES = "meshes"
#: Velocity limit of a joint that has none [rad/s or m/s].
FAST = 10.0
#: Column of the comments of a hand file.
COLUMN = 56


def write_urdf(model: VendorModel, path: Path, comments: Sequence[str]) -> None:
    """Write a model.

    Args:
        model: The model.
        path: The URDF file; meshes are written to a folder beside it.
        comments: Lines for the beginning of the file.
    """
    robot = Element("robot", {"name": model.name, "xmlns:drake": "https://drake.mit.edu"})
    for line in comments:
        robot.append(ElementTree.Comment(f" {line.replace('--', '- -')} "))
    (path.parent / MESHES).mkdir(parents=True, exist_ok=True)
    for number, link in enumerate(model.links.values()):
        name = "".join(c if c.isalnum() else "_" for c in link.name)
        _add_link(robot, link, f"{number:02d}_{name}", path.parent)
    for joint in model.joints.values():
        _add_joint(robot, joint, model.mimics.get(joint.name))
    ElementTree.indent(robot)
    text = ElementTree.tostring(robot, encoding="unicode")
    path.write_text(f'<?xml version="1.0"?>\n{text}\n', encoding="utf-8")


def _add(parent: Element, tag: str, **given: str | float | Array) -> Element:
    """Add an element with its attributes: texts, numbers, or arrays of numbers."""
    return SubElement(parent, tag, {
        key: value if isinstance(value, str) else " ".join(
            f"{float(number) + 0.0:.10g}" for number in np.ravel(value))
        for key, value in given.items()
    })  # fmt: skip


def _add_origin(parent: Element, X: Array) -> None:
    rpy = RotationMatrix.ProjectToRotationMatrix(X[:3, :3]).ToRollPitchYaw().vector()
    _add(parent, "origin", xyz=X[:3, 3], rpy=rpy)


def _add_link(robot: Element, link: Link, stem: str, folder: Path) -> None:
    """Add a link; its meshes become files whose names start with `stem`."""
    # Inertia about the centre of mass.
    element = _add(robot, "link", name=link.name)
    inertial, p_LLcm = _add(element, "inertial"), link.inertia.get_com()
    tensor = link.inertia.Shift(p_LLcm).CalcRotationalInertia().CopyToFullMatrix3()
    _add(inertial, "origin", xyz=p_LLcm)
    _add(inertial, "mass", value=link.inertia.get_mass())
    pairs = combinations_with_replacement(range(3), 2)
    _add(inertial, "inertia", **{f"i{'xyz'[a]}{'xyz'[b]}": tensor[a, b] for a, b in pairs})

    # Shapes; meshes are separate files.
    for tag, shapes in (("collision", link.collisions), ("visual", link.visuals)):
        for n, shape in enumerate(shapes):
            _add_shape(element, tag, shape, f"{stem}_{tag}_{n}", folder)


def _add_shape(parent: Element, tag: str, shape: Shape, name: str, folder: Path) -> None:
    """Add a shape; a mesh becomes a file."""
    element = _add(parent, tag, name=name)
    _add_origin(element, shape.X_LS)
    geometry, own = _add(element, "geometry"), shape.primitive
    if isinstance(own, Box):
        _add(geometry, "box", size=own.size())
    elif isinstance(own, Sphere):
        _add(geometry, "sphere", radius=own.radius())
    elif isinstance(own, Cylinder | Capsule):
        kind = "cylinder" if isinstance(own, Cylinder) else "drake:capsule"
        _add(geometry, kind, radius=own.radius(), length=own.length())
    else:
        assert shape.vertices is not None and shape.faces is not None
        file = f"{MESHES}/{name}.obj"
        text = obj_text(shape.vertices, shape.faces, normals=tag == "visual")
        (folder / file).write_text(text, encoding="utf-8")
        mesh = _add(geometry, "mesh", filename=file)
        if tag == "collision":
            _add(mesh, "drake:declare_convex")

    # Only visual shapes have a colour.
    if tag == "visual" and shape.colour is not None:
        material = _add(element, "material", name=f"{name}_colour")
        _add(material, "color", rgba=np.array([*shape.colour, 1.0]))


def _add_joint(robot: Element, joint: VendorJoint, mimic: Mimic | None) -> None:
    """Add a joint, with the joint that it follows."""
    limited = bool(np.isfinite(joint.limits).all())
    turns = "revolute" if limited else "continuous"
    element = _add(robot, "joint", name=joint.name, type="prismatic" if joint.slides else turns)
    _add(element, "parent", link=joint.parent)
    _add(element, "child", link=joint.child)
    _add_origin(element, joint.X_PJ)
    _add(element, "axis", xyz=joint.axis)

    # Limits, and the leader.
    ends = dict(zip(("lower", "upper"), joint.limits, strict=True)) if limited else {}
    speed = joint.velocity if np.isfinite(joint.velocity) else FAST
    _add(element, "limit", **ends, effort=joint.effort, velocity=speed)
    if mimic is not None:
        line = {"multiplier": mimic.ratio, "offset": mimic.offset}
        _add(element, "mimic", joint=mimic.leader, **line)


def hand_text(tree: Mapping[str, Any], reasons: Mapping[str, str], head: list[str]) -> str:
    """Return the YAML of a hand file.

    Args:
        tree: Keys and values of the file.
        reasons: Comments, by the paths of keys.
        head: Lines at the top of the file.
    """
    lines = [f"# {line}" for line in head]
    for key, value in tree.items():
        # A mapping, or a list of mappings, is a block with one line per key: start, value and path.
        rows: list[tuple[str, Any, str]] = []
        if isinstance(value, dict):
            rows = [(f"  {_flow(n)}:", item, f"{key}.{n}") for n, item in value.items()]
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            rows = [
                (f"  {'-' if n == 0 else ' '} {name}:", item, f"{key}.{i}.{name}")
                for i, entry in enumerate(value)
                for n, (name, item) in enumerate(entry.items())
            ]
        if not rows:
            # Separate a block from what follows it.
            lines += [""] if lines[-1].startswith(" ") else []
            lines.append(_line(f"{key}: {_flow(value)}", reasons.get(key)))
            continue
        lines += ["", _line(f"{key}:", reasons.get(key))]
        for start, item, path in rows:
            nested = isinstance(item, list) and bool(item) and isinstance(item[0], dict)
            lines.append(_line(start if nested else f"{start} {_flow(item)}", reasons.get(path)))
            lines += [f"      - {_flow(part)}" for part in item] if nested else []
    return "\n".join(lines) + "\n"


def _line(text: str, why: str | None) -> str:
    return text if why is None else f"{text:<{COLUMN}} # {why}"


def _flow(value: Any) -> str:
    text = yaml.safe_dump(value, default_flow_style=True, width=10_000, sort_keys=False)
    return text.removesuffix("\n").removesuffix("\n...").strip()


#: Number of tested grips, number of palm frames with each, and fractions of the closing at
#: which links are placed.
GRIPS, FRAMES, SHARES = 6, 2, (0.0, 0.25, 0.5, 0.75, 1.0)
#: Number of postures in which links of different fingers are compared.
POSTURES = 24
#: Largest cost of a pinch; fingers with a larger cost pass each other.
WORST = 2.4
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
    roots: Sequence[Path] = (),
) -> NewHand:
    """Write a hand file, its model and its meshes into a new folder.

    Args:
        path: A URDF, SDFormat or MJCF file.
        out: The folder; it must not exist, or be empty.
        answers: Answers that override the guesses.
        packages: Folders of package:// URIs, by name.
        roots: Folders outside the model's folder whose files it may use.

    Raises:
        HandError: If the model cannot be used, or something cannot be guessed. The message has one
            line, which states how to repair the model or give an answer.
    """
    answers, config = answers or Answers(), load_config()
    if out.exists() and not (out.is_dir() and not any(out.iterdir())):
        raise HandError(f"--out must be a new or empty folder, got {str(out)!r}")
    model = read_model(read_source(path, packages or {}, roots))
    _refuse_unknown(model, answers)

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
    far = {str(each) for each in licences if each.parent != path.resolve().parent}
    notes = [f"{each} is copied: check that it is the licence of the model" for each in sorted(far)]
    notes = [*doubts, *model.notes, *unused_parts(model, best.grip, answers), *notes]
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
        folders = (Path(scratch) / str(n) for n in count())
        for drafts in _drafts(model, answers, config):
            # Try the palm frames of a grip until its geometry is sound, then whether it holds.
            for draft in drafts:
                file = _write(draft, next(folders), path, drawn=False)
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


def _refuse_unknown(model: VendorModel, answers: Answers) -> None:
    """Reject answers about joints that the model does not have."""
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
    fingers = find_fingers(model, palm, answers)
    grips = find_grips([find_members(model, palm, *finger) for finger in fingers])
    if not grips or grips[0].cost > WORST:
        tips = ", ".join(joints[-1].child for joints, _ in fingers)
        raise HandError(
            f"model: no fingers of {tips} close against each other: give positions of joints that "
            "do not close with --joint NAME=POSITION, or what closes the other way with --reverse "
            "JOINT"
        )

    # Leave out grips whose links collide too early; if all do, the first of all is used.
    shares = np.arange(POSTURES) / (POSTURES - 1)
    clear = clear_grips(model, palm, grips, lambda g: (positions(model, g, s) for s in shares))
    for grip in chain(islice(clear, GRIPS), grips[:1]):
        postures = [positions(model, grip, share) for share in SHARES]
        frames = find_palm_frames(model, palm, grip, postures, answers.approach)
        yield (draft_tree(model, palm, grip, frame, answers, config) for frame in frames[:FRAMES])


def _write(draft: Draft, folder: Path, path: Path, *, drawn: bool = True) -> Path:
    """Write the files of a hand, and return the hand file.

    Visual shapes take most of the time of writing, so they can be left out.
    """
    vendor = draft.model
    if not drawn:
        links = {name: replace(link, visuals=()) for name, link in vendor.links.items()}
        vendor = replace(vendor, links=links)
    folder.mkdir(exist_ok=True)
    stem = path.stem if path.stem.endswith("_hand") else f"{path.stem}_hand"
    model = folder / f"{stem}.urdf"
    head = [f"Made from {path.name} by `drakegrasp hand new`.", *draft.changed, *vendor.notes]
    write_urdf(vendor, model, head)
    file = folder / f"{stem}.yaml"
    lines = [
        f"Drafted from {path.name} by `drakegrasp hand new`. Values with a comment were guessed:",
        "look at the picture, correct them, and run `drakegrasp hand check` again.",
        "Units: m, rad, N, N m, kg; degrees in keys that end in _deg.",
    ]
    text = hand_text({**draft.tree, "model": model.name}, draft.reasons, lines)
    file.write_text(text, encoding="utf-8")
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
