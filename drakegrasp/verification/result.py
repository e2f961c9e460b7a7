"""The result of verifying one grasp: the verdict, what was simulated, and the margin."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drakegrasp.config import Config
from drakegrasp.frames import Array
from drakegrasp.generation.columns import unjudged
from drakegrasp.grasp import for_all_fingers
from drakegrasp.outcomes import Outcome, Removal
from drakegrasp.simulation.candidates import Pregrasp
from drakegrasp.simulation.contacts import Contacts
from drakegrasp.simulation.placement import PlacedObject
from drakegrasp.simulation.trial import TrialRecord
from drakegrasp.verification.explanation import explain
from drakegrasp.verification.forces.verdict import ForceVerdict
from drakegrasp.verification.hints import FAR, FAR_POSTURE
from drakegrasp.verification.wrist.solver import WristFit

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseTrial:
    """One wrist pose for a grasp of k contacts, and its trial.

    Attributes:
        fit: Palm pose and joints that bring the fingertips to the contacts; None for a posture,
            which says them itself.
        pregrasp: Palm and opened fingers that the trial started from.
        trial: What happened in the simulator.
        contact_error: (k,), distance between the contact that was asked for and the one after
            closing [m]; NaN for a fingertip that does not touch, and for a posture.
        normal_error: (k,), angle between their normals [rad]; NaN likewise.
        removal: The first filter of a dataset that would remove the grasp, `KEPT` if none does, see
            `build.columns`; None if it does not hold.
    """

    fit: WristFit | None
    pregrasp: Pregrasp
    trial: TrialRecord
    contact_error: Array
    normal_error: Array
    removal: Removal | None = None

    @property
    def held(self) -> bool:
        """Whether every fingertip touches the object at the end of the lift, clear of the table."""
        return self.trial.outcome is Outcome.SUCCESS


@dataclass(frozen=True, kw_only=True, eq=False)
class Verification:
    """The verdict on a grasp of k contacts. Stages that were not reached are None or NaN.

    The grasp is judged by its first wrist pose, the one that fits the contacts best.

    Attributes:
        method: "hand", "forces" or "posture".
        outcome: How the trial of the first wrist pose ended; as in a dataset, or `invalid`, or with
            method `forces` `off_surface`.
        reason: Why, in one sentence without a full stop.
        placed: The object and its pose on the table.
        config: Hand, physics, lift and rules of the verification.
        p_OQ, nhat_Q_O: (k, 3), the contact points [m] and unit normals in {O} that were tried; NaN
            where an invalid row or a posture has none.
        surface_distance: (k,), of the predicted points from the object's surface [m].
        fingertip_distance: Of a posture that fails, distances of the fingertips of its grasp from
            the surface [m], one per finger that it closes; None of all else.
        normalised: Whether a predicted normal was not of unit length, and was normalised.
        snapped: Whether the points were moved to the nearest points of the surface.
        hints: What would make a grasp that fails fit much better, see `verification.hints`.
        tries: The wrist poses that were simulated, in order.
        forces: What forces at the contacts alone can do, with method `forces`.
        epsilon: Ferrari-Canny measure of the contacts; 0 without force closure.
        smallest_friction: Smallest friction coefficient at which forces within the hand's limit
            hold the object at the contacts; inf if none does.
        seconds: Wall-clock time by stage [s].
        stand: Which of the resting poses that a posture may be for gave this verdict, the best.
    """

    method: str
    outcome: Outcome
    reason: str
    placed: PlacedObject
    config: Config
    p_OQ: Array
    nhat_Q_O: Array
    surface_distance: Array
    fingertip_distance: Array | None = None
    normalised: bool = False
    snapped: bool = False
    hints: tuple[str, ...] = ()
    tries: tuple[PoseTrial, ...] = ()
    forces: ForceVerdict | None = None
    epsilon: float = np.nan
    smallest_friction: float = np.nan
    seconds: dict[str, float] = field(default_factory=dict)
    stand: int = 0

    @property
    def success(self) -> bool:
        """Whether the first wrist pose holds, with every contact where it was asked for.

        That is within `verify.max_contact_error`. With method `forces`: whether forces hold it; of
        a posture, which asks for no contacts: whether it holds.
        """
        return self.held and not self.farthest_contact > self.config.verify.max_contact_error

    @property
    def held(self) -> bool:
        """Whether the first wrist pose holds the object at the end of the lift, wherever."""
        return self.outcome is Outcome.SUCCESS

    @property
    def held_any(self) -> bool:
        """Whether any of the wrist poses that were tried holds it; nobody knows which in advance.

        The 18 numbers leave the wrist open: this is what an oracle that chooses it would reach.
        """
        return self.held or self.held_by is not None

    @property
    def held_by(self) -> int | None:
        """Index of the first wrist pose that holds the object, None if none does."""
        return next((i for i, each in enumerate(self.tries) if each.held), None)

    @property
    def misplaced(self) -> bool:
        """Whether a contact is more than 10 mm off the surface: frame or unit may be wrong.

        A posture that fails is misplaced if that is so of all its fingertips, and hints say more or
        it is 50 mm.
        """
        if self.fingertip_distance is not None:
            limit = FAR if self.hints else FAR_POSTURE
            return bool(self.fingertip_distance.size and self.fingertip_distance.min() > limit)
        return bool(np.any(self.surface_distance > FAR))

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
    def sample(self) -> bool:
        """Whether the grasp passes the filters of a dataset, but for those in `unjudged`."""
        return self.removal is Removal.KEPT

    @property
    def removal(self) -> Removal | None:
        """The first filter that removes it, `KEPT` if none does; None if the hand lost it."""
        return self.first.removal if self.first else None

    @property
    def unjudged(self) -> tuple[Removal, ...]:
        """Filters about which a verdict knows nothing, e.g. those of images."""
        return unjudged(self.config.filters)

    @property
    def words(self) -> str:
        """The verdict in words: those of held to sample that apply, or the failure."""
        if not self.held:
            return f"fails: {self.outcome.label.replace('_', ' ')}"
        names = ("held", "precision", "stable", "sample")
        words = [name for name in names if getattr(self, name)]
        return ", ".join([*words, *([] if self.success else ["not as asked"])])

    @property
    def first(self) -> PoseTrial | None:
        """The first wrist pose and its trial; None with method `forces` or an invalid row."""
        return self.tries[0] if self.tries else None

    @property
    def num_tries(self) -> int:
        """Number of wrist poses that were simulated."""
        return len(self.tries)

    @property
    def fit(self) -> WristFit | None:
        """The first wrist pose that was fitted to contacts, with its joints."""
        return self.first.fit if self.first else None

    @property
    def pregrasp(self) -> Pregrasp | None:
        """Palm and opened fingers that the first trial started from."""
        return self.first.pregrasp if self.first else None

    @property
    def closing_start(self) -> Array | None:
        """(k,), where the closing joints began; NaN for fingers that a preshape leaves out."""
        start = self.pregrasp
        if start is None or start.closing is None:
            return None
        return for_all_fingers(start.closing, start.unused, len(self.p_OQ))

    @property
    def trial(self) -> TrialRecord | None:
        """The first trial."""
        return self.first.trial if self.first else None

    @property
    def contact_error(self) -> Array | None:
        """(k,), distances [m] between contacts asked for and reached, of the first wrist pose."""
        return self.first.contact_error if self.first else None

    @property
    def normal_error(self) -> Array | None:
        """(k,), angles [rad] between their normals."""
        return self.first.normal_error if self.first else None

    @property
    def farthest_contact(self) -> float:
        """The largest `contact_error` [m]; NaN if no fingertip touches.

        The share of grasps that hold within d, as a curve, is that of `held` ones with less.
        """
        return _largest(self.contact_error)

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

    @property
    def hint_text(self) -> str:
        """The hints in a line; empty if there are none."""
        return "; ".join(self.hints)

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
        return explain(self)

    def __repr__(self) -> str:
        return f"Verification({self.method}, {self.words}: {self.reason})"


def _largest(values: Array | None) -> float:
    """Return the largest number, NaN if there is none."""
    there = np.zeros(0) if values is None else values[np.isfinite(values)]
    return float(there.max()) if there.size else np.nan
