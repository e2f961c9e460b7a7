"""The result of verifying one grasp: the verdict, what was simulated, and the margin."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drakegrasp.config import Config
from drakegrasp.frames import Array
from drakegrasp.outcomes import Outcome
from drakegrasp.simulation.candidates import Pregrasp
from drakegrasp.simulation.contacts import Contacts
from drakegrasp.simulation.lift import Lift
from drakegrasp.simulation.placement import PlacedObject
from drakegrasp.simulation.trial import TrialRecord
from drakegrasp.verification.forces.verdict import ForceVerdict
from drakegrasp.verification.wrist.solver import WristFit

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, kw_only=True, eq=False)
class Verification:
    """The verdict on a grasp of k contacts. Stages that were not reached are None or NaN.

    Attributes:
        method: "hand" or "forces".
        outcome: The verdict; as in a dataset, or `unreachable` or `off_surface`.
        reason: Why, in one sentence without a full stop.
        placed: The object and its pose on the table.
        config: Hand, physics, lift and limits of the verification.
        p_OQ, nhat_Q_O: (k, 3), the predicted contact points [m] and unit normals in {O}.
        surface_distance: (k,), of the points from the object's surface [m].
        fit: Palm pose and joints of the reported trial, or of the best fit if none was simulated.
        tries: Number of palm poses that were tried.
        pregrasp: Palm and opened fingers that the trial started from.
        trial: What happened in the simulator.
        contact_error: (k,), distance of each contact after closing from its prediction [m]; NaN
            for a fingertip that does not touch and need not.
        forces: What forces at the contacts alone can do, with method `forces`.
        epsilon: Ferrari-Canny measure of the predicted contacts; 0 without force closure.
        smallest_friction: Smallest friction coefficient at which forces within the hand's limit
            hold the object at the predicted contacts; inf if none does.
        seconds: Wall-clock time by stage [s].
    """

    method: str
    outcome: Outcome
    reason: str
    placed: PlacedObject
    config: Config
    p_OQ: Array
    nhat_Q_O: Array
    surface_distance: Array
    fit: WristFit | None = None
    tries: int = 0
    pregrasp: Pregrasp | None = None
    trial: TrialRecord | None = None
    contact_error: Array | None = None
    forces: ForceVerdict | None = None
    epsilon: float = np.nan
    smallest_friction: float = np.nan
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def success(self) -> bool:
        """Whether the grasp holds; the same as `held`."""
        return self.held

    @property
    def held(self) -> bool:
        """Whether every fingertip touches the object at the end of the lift, clear of the table."""
        return self.outcome is Outcome.SUCCESS

    @property
    def precision(self) -> bool:
        """Whether the grasp is held, and by the fingertips alone."""
        return self.held and (self.trial is None or self.trial.precision)

    @property
    def stable(self) -> bool:
        """Whether it is a precision grasp that moved less than 5 mm and 5 degrees in the hand.

        With method `forces` nothing moves: what is held is stable.
        """
        return self.held and (self.trial is None or self.trial.stable)

    @property
    def words(self) -> str:
        """The verdict in words: those of held, precision and stable that apply, or the failure."""
        if not self.held:
            return f"fails: {self.outcome.label.replace('_', ' ')}"
        names = ("held", "precision", "stable")
        return ", ".join(name for name in names if getattr(self, name))

    @property
    def closed(self) -> Contacts | None:
        """Contacts after closing; `trial.closed` has the joints then, too."""
        end = None if self.trial is None else self.trial.closed
        return None if end is None else end.contacts

    @property
    def lifted(self) -> Contacts | None:
        """Contacts after the lift; `trial.lift` has joints, poses, slip and turn then, too."""
        end = None if self.trial is None else self.trial.lift
        return None if end is None else end.contacts

    @property
    def X_TO_lifted(self) -> Array | None:
        """Pose (4, 4) of the object after the lift."""
        return self.trial.lift.X_TO if self.trial is not None and self.trial.lift else None

    @property
    def solver_status(self) -> int:
        """Exit mode of SLSQP, 0 for success; -1 where it was not asked."""
        return -1 if self.fit is None else self.fit.status

    def save_html(self, path: str | Path) -> None:
        """Write an HTML file that plays the simulation in a browser, from any side.

        The grasp is simulated again for it, which gives the same bits.

        Args:
            path: The file to write.

        Raises:
            OSError: If the file cannot be written.
        """
        from drakegrasp.verification.recording import record_verification

        record_verification(self, Path(path))

    def figure(self) -> Figure:
        """Return a figure of predicted and reached contacts on the mesh; it has `savefig`."""
        from drakegrasp.verification.figure import verification_figure

        return verification_figure(self)

    def explain(self) -> str:
        """Return the verdict, and why, in a few sentences."""
        # The verdict.
        verdict = "holds" if self.success else f"fails ({self.outcome.label})"
        sentences = [f"The grasp of {self.placed.model.name} {verdict}: {self.reason}."]

        # What happened in the hand.
        if self.trial is not None and self.trial.lift is not None:
            sentences.append(self._explain_lift(self.trial.lift))

        # How well the hand makes the predicted contacts.
        if self.fit is not None:
            angle = np.rad2deg(self.fit.normal_error).max()
            sentences.append(
                f"Before closing, the fingertips are within "
                f"{in_mm(self.fit.residual.max())} of the predicted points, and the pads within "
                f"{angle:.0f}° of the predicted normals."
            )
        if self.contact_error is not None:
            sentences.append(
                "After closing, they touch the object within "
                f"{in_mm(np.nanmax(self.contact_error))} of the predicted points."
            )

        # What forces at the contacts alone can do.
        if not np.isnan(self.smallest_friction):
            sentences.append(self._explain_margin())
        return " ".join(sentences)

    def _explain_lift(self, lift: Lift) -> str:
        """Return the sentence on what moved in the hand, and what touched the object at the end."""
        # What happened.
        links = lift.contacts.other_links
        touching = {0: "no other link of the hand touches it", 1: "another link touches it"}.get(
            links, f"{links} other links touch it"
        )
        text = (
            f"During the lift the object slips by {in_mm(lift.slip)} and turns by "
            f"{np.rad2deg(lift.turn):.1f}° in the hand, and at the end {touching}"
        )

        # What that is called, if it is held at all.
        if not self.held:
            return f"{text}."
        precision = "a precision grasp" if self.precision else "no precision grasp"
        return f"{text}: {precision}, {'' if self.stable else 'not '}stable."

    def _explain_margin(self) -> str:
        """Return the sentence on the friction that the contacts alone need."""
        simulated = self.placed.model.own_physics(self.config.physics).friction_hand
        if np.isfinite(self.smallest_friction):
            needed = f"need a friction coefficient of {self.smallest_friction:.2f}"
        else:
            needed = "are not enough at any friction"
        text = f"Forces at these points alone {needed}; the simulation has {simulated:.2f}"
        if self.held and self.method == "hand" and self.smallest_friction > simulated:
            # A point does not resist twisting, an area of contact does; and what slips is held
            # elsewhere.
            text += ", but the hand's contacts are areas"
            text += "" if self.stable else ", and the object is not held where they were"
        return f"{text} (epsilon {self.epsilon:.3f})."

    def __repr__(self) -> str:
        return f"Verification({self.method}, {self.words}: {self.reason})"


def in_mm(length: float) -> str:
    """Return a length [m] as text in millimetres."""
    return f"{1e3 * length:.1f} mm"
