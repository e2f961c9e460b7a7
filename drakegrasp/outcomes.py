"""How an attempt can end, and how far it got: the enums that all files share.

This module has the properties of an outcome that need no attempt. `drakegrasp.simulation.trial`
decides when an attempt has an outcome.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Self


class Stage(IntEnum):
    """How far an attempt got; it decides which columns of `trials.hdf5` have values."""

    PLACED = 0  # geometry only: nothing was simulated
    CLOSED = 1  # the fingers were closed and judged
    TRIED = 2  # a lift was tried: the object was freed, lifted and judged again


#: Groups of outcomes in the order of the funnel, each with the minimum stage that its attempts have
#: reached. Outcomes without a group are only for verification: no file of a dataset has them.
GROUPS = {
    "no ray": Stage.PLACED,
    "collis.": Stage.PLACED,
    "no grip": Stage.CLOSED,
    "lost": Stage.TRIED,
    "moved": Stage.TRIED,
    "errors": Stage.PLACED,
    "success": Stage.TRIED,
}


class Outcome(IntEnum):
    """The verdict on one attempt. Values are stored in files: never renumber them.

    Attributes:
        group: One of `GROUPS`, or empty.
        text: What happened, as a part of a sentence.
    """

    group: str
    text: str

    def __new__(cls, value: int, group: str = "", text: str = "") -> Self:
        """Create a member that equals its value."""
        member = int.__new__(cls, value)
        member._value_, member.group, member.text = value, group, text
        return member

    SUCCESS = 0, "success", "every fingertip touches it at the end of the lift, clear of the table"
    BELOW_TABLE = 1, "no ray", "the palm would be below the table"
    RAY_MISS = 2, "no ray", "the palm does not face the object"
    START_COLLISION = 3, "collis.", "the opened hand would be inside the object or the table"
    SCREENED = 4, "collis.", "geometry shows that not every fingertip can reach the object"
    MISSING_FINGERTIP = 5, "no grip", "a fingertip closes without touching the object"
    HAND_CONTACT = 6, "no grip", "a part of the hand that is not a fingertip touches the object"
    # This also includes a hand that was too far below the table's top (`close.scrape_depth`).
    TABLE_CONTACT = (
        7,
        "no grip",
        "the closing or lifting hand, or the lifted object, touches the table",
    )
    SLIPPED = (
        8,
        "lost",
        "a fingertip loses contact during the lift, and no other holds the object",
    )
    DROPPED = 9, "lost", "the hand loses the object during the lift"
    SOLVER_ERROR = 10, "errors", "the simulation failed, which says nothing about the grasp"
    TIMEOUT = (
        11,
        "errors",
        "the limit of computing time passed, which says nothing about the grasp",
    )
    CRASHED = 12, "errors", "its process was killed, which says nothing about the grasp"
    # For this outcome and the next, it is unknown whether the hand would have held the object.
    MOVED = 15, "moved", "the object moved more in the hand than a sample may"
    INVALID = 17, "", "the row of numbers is not a valid grasp"  # it counts as a failure
    PARTLY_HELD = (
        18,
        "lost",
        "a fingertip loses contact during the lift; others still hold the object",
    )
    # Only in scenes of several objects.
    NEIGHBOUR_HIT = 19, "no grip", "the closing hand presses on another object"

    @property
    def label(self) -> str:
        """The name as written in tables and on the command line, e.g. `ray_miss`."""
        return self.name.lower()

    @property
    def inconclusive(self) -> bool:
        """Whether the simulator failed rather than the grasp: never count it as a negative."""
        return self.group == "errors"

    @property
    def verification_only(self) -> bool:
        """Whether only verification has this outcome; no file of a dataset has it."""
        return not self.group

    @property
    def dataset_only(self) -> bool:
        """Whether only datasets have this outcome, because verification tries whole lifts."""
        return self.group == "moved"

    @property
    def stage(self) -> Stage:
        """The minimum stage that every attempt with this outcome has reached."""
        return GROUPS.get(self.group, Stage.PLACED)


#: Outcomes of lifts in which fingertips lost the object.
LOST = tuple(outcome for outcome in Outcome if outcome.group == "lost")
