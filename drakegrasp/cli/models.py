"""The commands for objects and hands: `audit`, `objects` and `hand`."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import click

from drakegrasp.cli.console import progress_bar, say, say_finding
from drakegrasp.cli.options import FILE, NEW_FILE, PATH, chosen_settings, described, shared
from drakegrasp.errors import counted

if TYPE_CHECKING:
    from drakegrasp.hand.checks import Finding


@click.command()
@described
@click.argument("mesh_dir", type=PATH)
def audit(
    mesh_dir: Path,
    units: str,
    manifest: Path | None,
    hand: str | None = None,
    json_file: Path | None = None,
    sheet: Path | None = None,
) -> None:
    """Check which meshes are fit, repaired or refused.

    Meshes are prepared as in a build with the default configuration. A build also drops each object
    on the table, and refuses objects that do not come to rest. The exit code is 1 if every mesh is
    refused.

    Options:
        --units, --manifest
        --hand HAND: Hand whose opening and stand-offs are compared with the objects' sizes.
            [default: barrett]
        --json FILE (json_file): Write all findings as JSON.
        --sheet FILE: Write a picture of every object with its status (.png).
    """
    from drakegrasp.cli.tables import ROOMY, audit_line, audit_table, make_console, memory_line
    from drakegrasp.hand.description import load_hand
    from drakegrasp.hand.kinematics import flat_limits, opening
    from drakegrasp.hand.settings import load_config
    from drakegrasp.objects.audit import audit as audit_meshes
    from drakegrasp.runtime.files import atomic_path, write_atomic

    config = load_config(overrides=[f"hand={hand}"] if hand else [])
    own = load_hand(config.hand_source)
    limits: Any = {"opening": opening(own), "flat": flat_limits(own)}
    with progress_bar("audit", "meshes") as progress:
        rows = audit_meshes(mesh_dir, units=units, manifest=manifest, **limits, progress=progress)
    console = make_console()
    console.print(audit_table(rows, compact=console.width < ROOMY))
    say(audit_line(rows))
    if line := memory_line(rows):
        say(line)

    if json_file is not None:
        text = json.dumps([row.to_json() for row in rows], indent=1, ensure_ascii=False)
        write_atomic(json_file, f"{text}\n".encode())
    if sheet is not None:
        from drakegrasp.pictures.rendered import object_sheet

        with progress_bar("draw", "objects") as progress, atomic_path(sheet) as png:
            object_sheet(rows, png, progress=progress)
    if all(row.status == "refused" for row in rows):
        sys.exit(1)


@click.group()
def objects() -> None:
    """List or export the built-in objects, or make morphs of meshes."""


@objects.command("list")
def list_objects() -> None:
    """Print every built-in class with its drawn parameters."""
    from drakegrasp.shapes.catalog import CLASSES

    for item in CLASSES:
        sizes = ", ".join(f"{name} {span}" for name, span in item.parameters.items())
        say(f"{item.number:>2} {item.name:<15} {sizes}")


@objects.command("export")
@click.argument("directory", type=PATH)
@shared("--per-class", "--objects-seed")
def export_objects(directory: Path, **options: Any) -> None:
    """Write the built-in objects' meshes (.obj, metres) to DIRECTORY.

    The same options write the same bytes on every machine.
    """
    from drakegrasp.generation.request import BUILTIN
    from drakegrasp.hand.settings import load_config
    from drakegrasp.shapes.catalog import export_builtin

    config = load_config(overrides=chosen_settings({"objects": BUILTIN, **options}))
    with progress_bar("objects", "meshes") as progress:
        paths = export_builtin(directory, config=config.builtin, progress=progress)
    say(f"{counted(len(paths), 'mesh', 'meshes')} in {directory}")


@objects.command("morph")
@described
@click.argument("mesh_dir", type=PATH)
def morph(
    mesh_dir: Path,
    units: str,
    manifest: Path | None,
    *,
    per_mesh: Annotated[int, click.IntRange(min=1)],
    seed: Annotated[int, click.IntRange(min=0)] = 0,
    out: Path,
) -> None:
    """Create objects with other proportions from meshes.

    Each mesh of MESH_DIR is widened, narrowed and stretched along a random axis. The morphs (.obj,
    metres, +z up) stand on the table like the mesh, and an objects.yaml in DIR keeps their classes.
    The same seed writes the same files.

    Options:
        --per-mesh N: Number of morphs of each mesh.
        --seed S: Seed of the draws.
        --out DIR: Directory of the morphs; new or empty.
        --units, --manifest
    """
    from drakegrasp.objects.morph import morph_meshes

    with progress_bar("morph", "morphs") as progress:
        report = morph_meshes(
            mesh_dir,
            out,
            per_mesh=per_mesh,
            seed=seed,
            units=units,
            manifest=manifest,
            progress=progress,
        )
    for reason in report.refused:
        say(f"no morphs of {reason}", err=True)
    for name, count in report.crossing.items():
        faces = counted(count, "face")
        say(f"{name} passes through itself in {faces}, and so do its morphs", err=True)
    share = report.first_draws / report.morphs
    say(f"{counted(report.morphs, 'morph')} in {out}; {share:.0%} by the first draw")


@click.group()
def hand() -> None:
    """List the hands, draft a hand file, or check a hand."""


@hand.command("list")
def list_hands() -> None:
    """Print the names of the hands that come with the package."""
    from drakegrasp.hand.files import hand_names

    for name in hand_names():
        say(name)


@hand.command("new")
@described
@click.argument("model", type=FILE, metavar="MODEL")
def new_hand(
    model: Path,
    *,
    out: Path,
    palm: str | None = None,
    approach: str | None = None,
    fingers: str | None = None,
    joints: tuple[str, ...] = (),
    reverse: tuple[str, ...] = (),
    effort: Annotated[float | None, click.FloatRange(min=0.0, min_open=True)] = None,
    settings: tuple[str, ...] = (),
    packages: tuple[str, ...] = (),
) -> None:
    """Draft a hand file from a model, and draw it.

    MODEL is a URDF, SDFormat or MJCF file as its vendor ships it. The command writes the hand file,
    in which each guess has a comment, the model, its meshes and a picture to FOLDER. Options
    override guesses. The exit code is 1 if a check of the drafted hand fails.

    Options:
        --out FOLDER: A new folder for the hand's files.
        --palm LINK: The link from which the fingers branch.
        --approach X,Y,Z: Direction that the palm faces: +Gz, in the axes of the palm link.
        --fingers LINK,LINK: The fingertip links of the grasping fingers.
        --joint NAME=POSITION (joints): The position of a joint that does not close [rad or m], as
            in the vendor's model.
        --reverse JOINT: A joint whose positive position opens the hand.
        --effort E: Largest effort of each motor at its joint [N m, or N].
        --set KEY=VALUE (settings): A key of the hand file, as in --set drive=torque.
        --package NAME=FOLDER (packages): Folder of package://NAME/.
    """
    import numpy as np

    from drakegrasp.hand.draft.fingers import Answers
    from drakegrasp.hand_setup.new import draft_hand

    # The user's answers.
    answers = Answers(
        approach=None if approach is None else np.array(_numbers(approach)),
        fingers=tuple(fingers.split(",")) if fingers else (),
        joints={name: _number(text) for name, text in _pairs("--joint", joints)},
        palm=palm,
        reverse=reverse,
        effort=effort,
        settings=settings,
    )
    folders = {name: Path(text) for name, text in _pairs("--package", packages)}
    drafted = draft_hand(model, out, answers=answers, packages=folders)

    # The drafted hand.
    for note in drafted.notes:
        say(f"note  {note}")
    for finding in drafted.findings:
        _print(finding)
    picture = drafted.path.with_suffix(".png")
    if drafted.findings[0].name != "files":
        _draw(drafted.path, picture)
        say(
            f"Look at {picture}: pads must face each other, and Gz (blue) must point out of the "
            "palm."
        )
    say(f"Then: drakegrasp hand check {drafted.path}")
    if not all(finding.ok for finding in drafted.findings):
        sys.exit(1)


def _pairs(option: str, texts: Sequence[str]) -> list[tuple[str, str]]:
    """Return the name and the value of each NAME=VALUE."""
    for text in texts:
        if not all(text.partition("=")):
            raise click.BadParameter(f"{option} must be NAME=VALUE, got {text!r}")
    return [(name, value) for name, _, value in (text.partition("=") for text in texts)]


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise click.BadParameter(f"must be a number, got {text!r}") from None


def _numbers(text: str) -> list[float]:
    numbers = [_number(part) for part in text.split(",")]
    if len(numbers) != 3 or not any(numbers):
        raise click.BadParameter(f"--approach must be X,Y,Z, not all zero, got {text!r}")
    return numbers


@hand.command("check")
@described
@click.argument("hand_file", metavar="NAME|YAML")
def check_hand_file(hand_file: str, picture: Annotated[Path | None, NEW_FILE] = None) -> None:
    """Check a hand before it is used, with trial grasps.

    The command checks files, motion, strength and trial grasps in simulation. NAME is a hand that
    comes with the package, YAML is a hand file. The exit code is 1 if anything is wrong.

    Options:
        --picture PNG: Write a picture of the hand, open and closed, with pads and palm frame.
    """
    from drakegrasp.hand_setup.check import check_hand

    findings = check_hand(hand_file, report=_print)

    # If the files of the hand can be read, it can be drawn.
    if picture is not None and findings[0].ok:
        _draw(hand_file, picture)
        say(str(picture))
    if not all(finding.ok for finding in findings):
        sys.exit(1)


def _draw(hand_file: str | Path, picture: Path) -> None:
    """Draw a hand."""
    from drakegrasp.hand.description import load_hand
    from drakegrasp.hand.finger_sweep import across
    from drakegrasp.pictures.rendered import picture_hand

    loaded = load_hand(hand_file)
    x, y, _ = across(loaded)
    picture_hand(loaded, picture, across=math.atan2(y, x))


def _print(finding: Finding) -> None:
    say_finding(finding.ok, "FAIL", f"{finding.name:<20} {finding.text}")
