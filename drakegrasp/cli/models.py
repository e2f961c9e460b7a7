"""The commands for objects and hands: `audit`, `objects` and `hand`."""

from __future__ import annotations

import json
import math
import sys
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter
from cyclopts.validators import Number

import drakegrasp as dg
from drakegrasp.cli.arguments import AnyPath, Count, File, Folder, Name, NewFile, Units
from drakegrasp.cli.console import UsageError, new_group, progress_bar, say, say_finding
from drakegrasp.errors import counted

if TYPE_CHECKING:
    from drakegrasp.hand.checks import Finding

objects = new_group("objects", "List or export the built-in objects.")
hand = new_group("hand", "List the hands, draft a hand file, or check a hand.")


def audit(
    mesh_dir: Folder,
    /,
    *,
    units: Units = "m",
    manifest: Annotated[AnyPath | None, Parameter(metavar="FILE")] = None,
    json_file: Annotated[NewFile | None, Parameter(name="--json")] = None,
) -> None:
    """Check which meshes are fit, repaired or refused.

    Meshes are prepared as in a build with the default configuration. A build also drops each object
    on the table, and refuses objects that do not come to rest. The exit code is 1 if every mesh is
    refused.

    Args:
        mesh_dir: Directory of meshes.
        units: Unit of length of the meshes.
        manifest: YAML file with units and classes by mesh. [default: objects.yaml in the directory
            of the meshes]
        json_file: Write all findings as JSON.
    """
    from drakegrasp.objects.audit import audit as audit_meshes
    from drakegrasp.runtime.files import write_atomic

    with progress_bar("audit", "meshes") as progress:
        rows = audit_meshes(mesh_dir, units=units, manifest=manifest, progress=progress)
    for row in rows:
        words = "; ".join([*row.notes, *(f"! {text}" for text in row.warnings)])
        say(f"{row.status:<9} {row.name}{': ' * bool(words)}{words}")
    counts = Counter(row.status for row in rows)
    told = ", ".join(f"{counts[status]} {status}" for status in ("fit", "repaired", "refused"))
    warned = sum(bool(row.warnings) for row in rows)
    say(f"{counted(len(rows), 'mesh', 'meshes')}: {told}; {warned} with a warning (!)")
    if json_file is not None:
        text = json.dumps([row.to_json() for row in rows], indent=1, ensure_ascii=False)
        write_atomic(json_file, f"{text}\n".encode())
    if all(row.status == "refused" for row in rows):
        sys.exit(1)


@objects.command(name="list")
def list_objects() -> None:
    """Print every built-in class with its drawn parameters."""
    from drakegrasp.shapes.catalog import CLASSES

    for item in CLASSES:
        sizes = ", ".join(f"{name} {span}" for name, span in item.parameters.items())
        say(f"{item.number:>2} {item.name:<15} {sizes}")


@objects.command(name="export")
def export_objects(directory: Folder, /, *, per_class: Count = 2, objects_seed: Count = 0) -> None:
    """Write the built-in objects' meshes (.obj, metres) to DIRECTORY.

    The same options write the same bytes on every machine.

    Args:
        directory: Folder of the meshes.
        per_class: Number of objects of each class.
        objects_seed: Seed of the sizes of the objects.
    """
    from drakegrasp.shapes.catalog import export_builtin

    drawn = [f"builtin.per_class={per_class}", f"builtin.seed={objects_seed}"]
    config = dg.load_config(overrides=drawn)
    with progress_bar("objects", "meshes") as progress:
        paths = export_builtin(directory, config=config.builtin, progress=progress)
    say(f"{counted(len(paths), 'mesh', 'meshes')} in {directory}")


@hand.command(name="list")
def list_hands() -> None:
    """Print the names of the hands that come with the package."""
    from drakegrasp.hand.file_format import hand_names

    for name in hand_names():
        say(name)


@hand.command(name="new")
def new_hand(
    model: File,
    /,
    *,
    out: Folder,
    palm: Annotated[str | None, Parameter(metavar="LINK")] = None,
    fingers: Annotated[str | None, Parameter(metavar="LINK,LINK")] = None,
    effort: Annotated[float | None, Parameter(metavar="E", validator=Number(gt=0.0))] = None,
    packages: Annotated[tuple[str, ...], Parameter(name="--package", metavar="NAME=FOLDER")] = (),
) -> None:
    """Draft a hand file from a model, and draw it.

    MODEL is a URDF, SDFormat or MJCF file as its vendor ships it. The command writes a hand
    file, the model, its meshes and a picture to DIR. Options override guesses. The exit code is 1
    if a check of the drafted hand fails.

    Args:
        model: The model of the hand.
        out: A new folder for the hand's files.
        palm: The link from which the fingers branch.
        fingers: The fingertip links of the grasping fingers.
        effort: Largest effort of each motor at its joint [N m, or N].
        packages: Folder of package://NAME/.
    """
    from drakegrasp.hand.draft.fingers import Answers
    from drakegrasp.hand_setup import draft_hand

    # The user's answers.
    answers = Answers(
        fingers=tuple(fingers.split(",")) if fingers else (),
        palm=palm,
        effort=effort,
    )
    folders = dict[str, Path]()
    for text in packages:
        name, _, folder = text.partition("=")
        if not (name and folder):
            raise UsageError(f"--package must be NAME=FOLDER, got {text!r}")
        folders[name] = Path(folder)
    drafted = draft_hand(model, out, answers=answers, packages=folders)

    # The drafted hand.
    for note in drafted.notes:
        say(f"note  {note}")
    for finding in drafted.findings:
        _print(finding)
    picture = drafted.path.with_suffix(".png")
    if drafted.findings[0].ok:
        _draw(drafted.path, picture)
        say(
            f"Look at {picture}: pads must face each other, and Gz (blue) must point out of the "
            "palm."
        )
    say(f"Then: drakegrasp hand check {drafted.path}")
    if not all(finding.ok for finding in drafted.findings):
        sys.exit(1)


@hand.command(name="check")
def check_hand_file(hand_file: Name, /, *, picture: NewFile | None = None) -> None:
    """Check a hand before it is used, with trial grasps.

    The command checks files, motion, strength and trial grasps in simulation. The exit code is 1 if
    anything is wrong.

    Args:
        hand_file: Name of a hand that comes with the package, or a hand file (YAML).
        picture: Write a picture of the hand, open, half closed and closed, with pads and palm
            frame.
    """
    from drakegrasp.hand_setup import check_hand

    findings = check_hand(hand_file, report=_print)

    # If the files of the hand can be read, it can be drawn.
    if picture is not None and findings[0].ok:
        _draw(hand_file, picture)
        say(str(picture))
    if not all(finding.ok for finding in findings):
        sys.exit(1)


def _draw(hand_file: str | Path, picture: Path) -> None:
    """Draw a hand."""
    from drakegrasp.hand.finger_sweep import across
    from drakegrasp.pictures.still_scene import picture_hand

    loaded = dg.load_hand(hand_file)
    x, y, _ = across(loaded)
    picture_hand(loaded, picture, across=math.atan2(y, x))


def _print(finding: Finding) -> None:
    say_finding(finding.ok, "FAIL", f"{finding.name:<20} {finding.text}")
