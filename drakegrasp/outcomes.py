"""How an attempt can end, and how far it got: the enums that all files share."""

from __future__ import annotations

from enum import IntEnum


class Stage(IntEnum):
    """How far an attempt got; it decides which columns of `trials.hdf5` hold values."""

    PLACED = 0  # geometry only: nothing was simulated
    CLOSED = 1  # the fingers were closed and judged
    LIFTED = 2  # the object was freed, lifted and judged again


class Outcome(IntEnum):
    """The verdict on one attempt. Values are stored in files: never renumber them."""

    SUCCESS = 0  # every fingertip holds the object at the lift's target, clear of the table
    BELOW_TABLE = 1  # the palm's origin would lie below the table
    RAY_MISS = 2  # the palm ray does not meet the object
    START_COLLISION = 3  # the open hand collides with the object or the table at the start pose
    SCREENED = 4  # geometry shows that not every fingertip can reach the object
    MISSING_FINGERTIP = 5  # after closing, a fingertip does not touch the object
    HAND_CONTACT = 6  # after closing, a hand link other than a fingertip touches the object
    # After closing the hand touches the table, or after the lift the object does; or the hand came
    # too far below the table's top on its way (`close.scrape_depth`).
    TABLE_CONTACT = 7
    # A fingertip lost contact during the lift, and none holds the object off the table; in datasets
    # of older versions, also what is PARTLY_HELD now.
    SLIPPED = 8
    DROPPED = 9  # the object fell during the lift
    SOLVER_ERROR = 10  # Drake failed or the state diverged; says nothing about the grasp
    TIMEOUT = 11  # the attempt's limit of computing time passed; says nothing about the grasp
    CRASHED = 12  # the attempt killed its process; says nothing about the grasp
    # Result files of older versions: no wrist pose brought the fingertips to the contacts.
    UNREACHABLE = 13
    OFF_SURFACE = 14  # verification by forces only: a contact, or its normal, is off the surface
    # The lift was ended early because the object moved more in the hand than a sample may: it is
    # no sample, but whether the hand would have held it is unknown.
    MOVED = 15
    # The closed hand might lift, but its chance of a sample was below `lift.least_chance`, or its
    # image is too flat for one: whether it would have held the object is unknown.
    NOT_LIFTED = 16
    INVALID = 17  # verification only: the row of numbers is no grasp; it counts as a failure
    # A fingertip lost contact during the lift; at its end, which may be early, others still hold
    # the object off the table.
    PARTLY_HELD = 18

    @property
    def label(self) -> str:
        """The name as written in tables and on the command line, e.g. `ray_miss`."""
        return self.name.lower()

    @property
    def inconclusive(self) -> bool:
        """Whether the simulator failed rather than the grasp: never count it as a negative."""
        return self in (Outcome.SOLVER_ERROR, Outcome.TIMEOUT, Outcome.CRASHED)

    @property
    def verification_only(self) -> bool:
        """Whether only verification gives this outcome; no file of a dataset holds it."""
        return self in (Outcome.UNREACHABLE, Outcome.OFF_SURFACE, Outcome.INVALID)

    @property
    def dataset_only(self) -> bool:
        """Whether only attempts of a dataset have this outcome: verification tries whole lifts."""
        return self in (Outcome.MOVED, Outcome.NOT_LIFTED)

    @property
    def stage(self) -> Stage:
        """The stage that every attempt with this outcome has reached, at least."""
        return _STAGE[self]


_STAGE = {
    Outcome.SUCCESS: Stage.LIFTED,
    Outcome.BELOW_TABLE: Stage.PLACED,
    Outcome.RAY_MISS: Stage.PLACED,
    Outcome.START_COLLISION: Stage.PLACED,
    Outcome.SCREENED: Stage.PLACED,
    Outcome.MISSING_FINGERTIP: Stage.CLOSED,
    Outcome.HAND_CONTACT: Stage.CLOSED,
    Outcome.TABLE_CONTACT: Stage.CLOSED,
    Outcome.SLIPPED: Stage.LIFTED,
    Outcome.DROPPED: Stage.LIFTED,
    Outcome.SOLVER_ERROR: Stage.PLACED,
    Outcome.TIMEOUT: Stage.PLACED,
    Outcome.CRASHED: Stage.PLACED,
    Outcome.UNREACHABLE: Stage.PLACED,
    Outcome.OFF_SURFACE: Stage.PLACED,
    Outcome.MOVED: Stage.LIFTED,
    Outcome.NOT_LIFTED: Stage.CLOSED,
    Outcome.INVALID: Stage.PLACED,
    Outcome.PARTLY_HELD: Stage.LIFTED,
}
