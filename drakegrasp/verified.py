"""What recordings and figures show of a grasp that was verified, and in which colours.

`verification.Verification` is what they are given; it offers them as methods and so is
above them. Here is what they need to know of it.
"""

from __future__ import annotations

from typing import Protocol

from drakegrasp.candidates import Attempt
from drakegrasp.config import Config
from drakegrasp.force_lift import ForceLift
from drakegrasp.frames import Array
from drakegrasp.outcomes import Outcome
from drakegrasp.placed import PlacedObject
from drakegrasp.trial import TrialRecord
from drakegrasp.wrist_fit import WristFit

#: Colours of what was predicted and of what was reached, told apart by the colour-blind too.
PREDICTED, REACHED = "#0072B2", "#D55E00"


class Verified(Protocol):
    """A `Verification`, as far as it is shown; see there for shapes and units."""

    @property
    def outcome(self) -> Outcome:
        """The verdict."""

    @property
    def reason(self) -> str:
        """Why."""

    @property
    def placed(self) -> PlacedObject:
        """The object on the table."""

    @property
    def config(self) -> Config:
        """The rules that it was verified by."""

    @property
    def p_OQ(self) -> Array:
        """Predicted points (k, 3) in {O} [m]."""

    @property
    def nhat_Q_O(self) -> Array:
        """Predicted normals (k, 3) in {O}."""

    @property
    def fit(self) -> WristFit | None:
        """The palm pose that was found."""

    @property
    def attempt(self) -> Attempt | None:
        """What was tried."""

    @property
    def trial(self) -> TrialRecord | None:
        """What happened then."""

    @property
    def lift(self) -> ForceLift | None:
        """What happened under forces alone."""
