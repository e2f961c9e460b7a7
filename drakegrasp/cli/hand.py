"""`drakegrasp hand`: the hands that there are, and whether one is fit to use."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from drakegrasp.cli.errors import say, say_finding
from drakegrasp.cli.options import NEW_FILE

if TYPE_CHECKING:
    from drakegrasp.commissioning.finding import Finding


@click.group()
def hand() -> None:
    """List the hands, or check one before it is used."""


@hand.command("list")
def list_hands() -> None:
    """Print the names of the hands that come with the package."""
    from drakegrasp.hand.files import hand_names

    for name in hand_names():
        say(name)


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
        from drakegrasp.commissioning.pinch import across_angle
        from drakegrasp.hand.description import load_hand
        from drakegrasp.visualization.hand_picture import picture_hand

        loaded = load_hand(hand_file)
        picture_hand(loaded, picture, across=across_angle(loaded))
        say(str(picture))
    if not all(finding.ok for finding in findings):
        sys.exit(1)


def _print(finding: Finding) -> None:
    say_finding(finding.ok, "FAIL", f"{finding.name:<20} {finding.text}")
