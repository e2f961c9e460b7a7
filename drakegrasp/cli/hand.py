"""`drakegrasp hand`: the hands that there are, a new one from its model, and whether one is fit."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from drakegrasp.cli.errors import say, say_finding
from drakegrasp.cli.options import FILE, NEW_FILE, PATH

if TYPE_CHECKING:
    from drakegrasp.commissioning.finding import Finding


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
@click.argument("model", type=FILE, metavar="MODEL")
@click.option(
    "--out", type=PATH, required=True, metavar="FOLDER", help="A new folder for the hand's files."
)
@click.option("--palm", metavar="LINK", help="The link that carries the fingers.")
@click.option(
    "--approach", metavar="X,Y,Z", help="Where the palm faces: +Gz, in the axes of the palm link."
)
@click.option("--fingers", metavar="LINK,LINK", help="The fingertip links that grasp.")
@click.option(
    "--joint",
    "joints",
    multiple=True,
    metavar="NAME=POSITION",
    help="The position of a joint that does not close [rad or m], as in the vendor's model.",
)
@click.option(
    "--reverse", multiple=True, metavar="JOINT", help="A joint whose positive position opens."
)
@click.option(
    "--effort",
    type=click.FloatRange(min=0.0, min_open=True),
    metavar="E",
    help="What each motor gives at its joint [N m, or N].",
)
@click.option(
    "--set",
    "settings",
    multiple=True,
    metavar="KEY=VALUE",
    help="A key of the hand file, as in --set drive=torque.",
)
@click.option(
    "--package",
    "packages",
    multiple=True,
    metavar="NAME=FOLDER",
    help="Where package://NAME/ is.",
)
@click.option(
    "--root",
    "roots",
    type=PATH,
    multiple=True,
    metavar="FOLDER",
    help="A folder outside of the model's whose meshes it may use.",
)
def new_hand(
    model: Path,
    out: Path,
    palm: str | None,
    approach: str | None,
    fingers: str | None,
    joints: Sequence[str],
    reverse: Sequence[str],
    effort: float | None,
    settings: Sequence[str],
    packages: Sequence[str],
    roots: Sequence[Path],
) -> None:
    """Draft a hand file from a model, and draw it.

    MODEL is a URDF, SDFormat or MJCF file as its vendor ships it. FOLDER gets the hand file, in
    which each guess has a comment, the model, its meshes and a picture. Options override guesses.
    Exit code 1 if a check of the drafted hand fails.
    """
    import numpy as np

    from drakegrasp.commissioning.draft.answers import Answers
    from drakegrasp.commissioning.draft.run import draft_hand

    # What a person says.
    facing = None if approach is None else np.array(_numbers(approach))
    answers = Answers(
        palm=palm,
        approach=facing,
        fingers=tuple(fingers.split(",")) if fingers else (),
        joints={name: _number(text) for name, text in _pairs("--joint", joints)},
        reverse=tuple(reverse),
        effort=effort,
        settings=tuple(settings),
    )
    folders = {name: Path(text) for name, text in _pairs("--package", packages)}
    drafted = draft_hand(model, out, answers=answers, packages=folders, roots=roots)

    # What was made of it.
    for note in drafted.notes:
        say(f"note  {note}")
    for finding in drafted.findings:
        _print(finding)
    picture = drafted.path.with_suffix(".png")
    if drafted.findings[0].name != "files":
        _draw(drafted.path, picture)
        say(f"Look at {picture}: pads must face each other, and Gz (blue) leave the palm.")
    say(f"Then: drakegrasp hand check {drafted.path}")
    if not all(finding.ok for finding in drafted.findings):
        sys.exit(1)


def _pairs(option: str, texts: Sequence[str]) -> list[tuple[str, str]]:
    """Return name and value of each NAME=VALUE."""
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
@click.argument("hand_file", metavar="NAME|YAML")
@click.option(
    "--picture",
    type=NEW_FILE,
    metavar="PNG",
    help="Write a picture of the hand, open and closed, with pads and palm frame.",
)
def check_hand_file(hand_file: str, picture: Path | None) -> None:
    """Check a hand before it is used, with trial grasps.

    Files, motion, strength and trial grasps in simulation are checked. NAME is a hand that comes
    with the package, YAML a hand file. Exit code 1 if anything is wrong.
    """
    from drakegrasp.commissioning.run import check_hand

    findings = check_hand(hand_file, report=_print)

    # A hand whose files can be read can be drawn.
    if picture is not None and findings[0].ok:
        _draw(hand_file, picture)
        say(str(picture))
    if not all(finding.ok for finding in findings):
        sys.exit(1)


def _draw(hand_file: str | Path, picture: Path) -> None:
    """Draw a hand."""
    from drakegrasp.commissioning.pinch import across_angle
    from drakegrasp.hand.description import load_hand
    from drakegrasp.pictures.hand_picture import picture_hand

    loaded = load_hand(hand_file)
    picture_hand(loaded, picture, across=across_angle(loaded))


def _print(finding: Finding) -> None:
    say_finding(finding.ok, "FAIL", f"{finding.name:<20} {finding.text}")
