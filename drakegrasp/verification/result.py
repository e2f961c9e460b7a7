"""The result of verifying one grasp: the verdict, what was simulated, and why, in sentences.

Input: what `verify` measured. Output: a `Verification` and its explanation. The explanation states
whether the grasp holds and why, what moved, how close the contacts are to the requested ones, and
what forces at the contacts alone can do. Numbers in another frame or unit, or normals that point
inwards, are reported first.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drakegrasp.arithmetic import norm
from drakegrasp.config import Config
from drakegrasp.filters import Removal
from drakegrasp.frames import Array
from drakegrasp.generation.attempts import unjudged
from drakegrasp.grasp import for_all_fingers
from drakegrasp.hand.description import load_hand
from drakegrasp.outcomes import Outcome
from drakegrasp.runtime.environment import one_thread, timed
from drakegrasp.simulation.attempt import Attempt
from drakegrasp.simulation.contacts import Contacts
from drakegrasp.simulation.lift import Lift
from drakegrasp.simulation.placement import PlacedObject
from drakegrasp.simulation.posture import Posture
from drakegrasp.simulation.trial import TrialRecord
from drakegrasp.verification.forces import ForceVerdict, force_margin
from drakegrasp.verification.hints import (
    FAR,
    FAR_POSTURE,
    Reading,
    contact_readings,
    posture_readings,
)
from drakegrasp.verification.placing import PlacedGrasp
from drakegrasp.verification.wrist_solver import WristFit

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseTrial:
    """One wrist pose for a grasp of k contacts, and its trial.

    Attributes:
        fit: Palm pose and joints that bring the fingertips to the contacts; None for a posture,
            which specifies them itself.
        pregrasp: Palm and opened fingers at the start of the trial.
        trial: What happened in the simulator.
        contact_error: (k,), distance between the requested contact and the contact after closing
            [m]; NaN for a fingertip that does not touch, and for a posture.
        normal_error: (k,), angle between the two normals [rad]; NaN in the same cases.
        removal: The first filter of a dataset that would remove the grasp, `KEPT` if no filter
            would, see `generation.attempts`; None if the grasp does not hold.
    """

    fit: WristFit | None
    pregrasp: Attempt
    trial: TrialRecord
    contact_error: Array
    normal_error: Array
    removal: Removal | None = None

    @property
    def held(self) -> bool:
        """Whether every fingertip touches the object at the end of the lift, clear of the table."""
        return self.trial.outcome is Outcome.SUCCESS


@dataclass(frozen=True, kw_only=True, eq=False)
class Findings:
    """What was found about a grasp: a verdict without the grasp and the object's meshes.

    Attributes:
        outcome: Outcome of the trial of the first wrist pose, as in a dataset; or `invalid`; or
            `off_surface` with method `forces`.
        reason: Reason for the outcome, in one sentence without a full stop.
        p_OQ, nhat_Q_O: (k, 3), the contact points [m] and unit normals in {O} that were tried; NaN
            for an invalid row or a posture.
        surface_distance: (k,), distances of the predicted points from the object's surface [m].
        posture: The posture that was tried, in {O}; None for contacts.
        tries: The wrist poses that were simulated, in order.
        forces: What forces at the contacts alone can do, with method `forces`.
        seconds: Wall-clock time by stage [s].
        stand: Index of the resting pose of this verdict: the best of those in which a posture was
            tried.
        margin: Epsilon and smallest friction, if they were computed already.
        doubts: Readings and fingertip distances, if they were computed already.
    """

    outcome: Outcome
    reason: str
    p_OQ: Array
    nhat_Q_O: Array
    surface_distance: Array
    posture: Posture | None = None
    tries: tuple[PoseTrial, ...] = ()
    forces: ForceVerdict | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    stand: int = 0
    margin: tuple[float, float] | None = None
    doubts: tuple[tuple[Reading, ...], Array | None] | None = None

    def of(self, grasp: PlacedGrasp) -> Verification:
        """Return the verdict on the grasp that this was found about."""
        return Verification(grasp=grasp, **{f.name: getattr(self, f.name) for f in fields(self)})


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Verification(Findings):
    """The verdict on a grasp of k contacts. Stages that were not reached are None or NaN.

    The grasp is judged by its first wrist pose, which fits the contacts best. Margins and hints are
    computed when they are asked for.

    Attributes:
        grasp: The grasp on its object, as it was requested.
    """

    grasp: PlacedGrasp

    @property
    def method(self) -> str:
        """The way of verification: "hand", "forces" or "posture"."""
        return self.grasp.method

    @property
    def placed(self) -> PlacedObject:
        """The object and its pose on the table."""
        return self.grasp.stands[self.stand]

    @property
    def config(self) -> Config:
        """Hand, physics, lift and rules of the verification."""
        return self.grasp.config

    @property
    def normalised(self) -> bool:
        """Whether a predicted normal was not of unit length, and was normalised."""
        return self.grasp.normalised

    @property
    def snapped(self) -> bool:
        """Whether the points were moved to the closest points of the surface."""
        return self.grasp.snap_points and not self.grasp.invalid

    @property
    def confidence(self) -> float:
        """Confidence of the grasp in the caller's file; NaN if the file has none."""
        return self.grasp.confidence

    @property
    def rank(self) -> int:
        """Rank by confidence among the grasps for the same row, or of the same object.

        It is 0 for the best, -1 without confidence.
        """
        return self.grasp.rank

    @property
    def epsilon(self) -> float:
        """Ferrari-Canny measure of the contacts; 0 without force closure."""
        return self._margin[0]

    @property
    def smallest_friction(self) -> float:
        """Smallest friction coefficient at which forces hold the object at the contacts.

        The forces are within the hand's limit; it is inf if no coefficient suffices.
        """
        return self._margin[1]

    @cached_property
    @one_thread
    def _margin(self) -> tuple[float, float]:
        if self.margin is not None:
            return self.margin
        if self.posture is not None or self.grasp.invalid:
            return np.nan, np.nan
        with timed(self.seconds, "margin"):
            X_TO = self.placed.X_TO_simulated
            return force_margin(self.placed.model, X_TO, self.p_OQ, self.nhat_Q_O, self.config)

    @property
    def hints(self) -> tuple[str, ...]:
        """Readings in which a grasp that fails would fit much better, in words."""
        return tuple(reading.text for reading in self._doubts[0])

    @property
    def fingertip_distance(self) -> Array | None:
        """For a posture that fails, distances of its grasp's fingertips from the surface [m].

        There is one per finger that the posture closes; it is None for all other grasps.
        """
        return None if self.posture is None else self._doubts[1]

    @cached_property
    @one_thread
    def _doubts(self) -> tuple[tuple[Reading, ...], Array | None]:
        """Readings that fit much better, and the distances of a posture's fingertips."""
        if self.doubts is not None:
            return self.doubts
        fits = self.held if self.posture else self.success and not self.misplaced
        if fits or self.grasp.invalid or self.outcome.inconclusive:
            return (), None
        with timed(self.seconds, "hints"):
            if self.posture is not None:
                return posture_readings(self.grasp, self.placed, self.posture)
            return contact_readings(self.grasp, self.nhat_Q_O, fits=self.success), None

    def explained(self) -> Findings:
        """Return what was found, with margins and hints, which are computed now."""
        return replace(self, margin=self._margin, doubts=self._doubts).findings

    @property
    def findings(self) -> Findings:
        """What was found, without the grasp."""
        return Findings(**{f.name: getattr(self, f.name) for f in fields(Findings)})

    @property
    def success(self) -> bool:
        """Whether the first wrist pose holds, with every contact where it was requested.

        "Where it was requested" means within `verify.max_contact_error`. With method `forces`, it
        is whether forces hold the object. A posture requests no contacts, so it is whether it
        holds.
        """
        return self.held and not self.farthest_contact > self.config.verify.max_contact_error

    @property
    def held(self) -> bool:
        """Whether the first wrist pose holds the object at the end of the lift, anywhere."""
        return self.outcome is Outcome.SUCCESS

    @property
    def held_any(self) -> bool:
        """Whether any of the tried wrist poses holds the object.

        The 18 numbers leave the wrist open, and nobody knows in advance which pose holds. This is
        what an oracle that chooses the wrist pose would reach.
        """
        return self.held or self.held_by is not None

    @property
    def held_by(self) -> int | None:
        """Index of the first wrist pose that holds the object, None if no wrist pose does."""
        return next((i for i, each in enumerate(self.tries) if each.held), None)

    @property
    def misplaced(self) -> bool:
        """Whether a contact is more than 10 mm off the surface: frame or unit may be wrong.

        A posture that fails is misplaced if all its fingertips are more than 10 mm off and there
        are hints, or if all are more than 50 mm off.
        """
        if self.fingertip_distance is not None:
            limit = FAR if self.hints else FAR_POSTURE
            return bool(self.fingertip_distance.size and self.fingertip_distance.min() > limit)
        return bool(np.any(self.surface_distance > FAR))

    @property
    def precision(self) -> bool:
        """Whether the object is held, and only by the fingertips."""
        return self.held and (self.trial is None or self.trial.precision)

    @property
    def stable(self) -> bool:
        """Whether it is a precision grasp that moves less than 5 mm and 5 degrees in the hand.

        With method `forces` nothing moves, so a grasp that holds is stable.
        """
        return self.held and (self.trial is None or self.trial.stable)

    @property
    def sample(self) -> bool:
        """Whether the grasp passes the filters of a dataset, except for those in `unjudged`."""
        return self.removal is Removal.KEPT

    @property
    def removal(self) -> Removal | None:
        """The first filter that removes the grasp, `KEPT` if none does; None if not held."""
        return self.first.removal if self.first else None

    @property
    def unjudged(self) -> tuple[Removal, ...]:
        """Filters that a verdict cannot judge, e.g. those of images."""
        return unjudged(self.config.filters)

    @property
    def words(self) -> str:
        """The verdict in words: "held", "precision", "stable", "sample", or the failure."""
        if not self.held:
            return f"fails: {self.outcome.label.replace('_', ' ')}"
        names = ("held", "precision", "stable", "sample")
        words = [name for name in names if getattr(self, name)]
        return ", ".join([*words, *([] if self.success else ["not as requested"])])

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
    def pregrasp(self) -> Attempt | None:
        """Palm and opened fingers at the start of the first trial."""
        return self.first.pregrasp if self.first else None

    @property
    def closing_start(self) -> Array | None:
        """(k,), initial closing positions; NaN for fingers that a preshape leaves out."""
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
        """(k,), distances [m] between requested and reached contacts, of the first wrist pose."""
        return self.first.contact_error if self.first else None

    @property
    def normal_error(self) -> Array | None:
        """(k,), angles [rad] between the requested and reached normals, of the first wrist pose."""
        return self.first.normal_error if self.first else None

    @property
    def farthest_contact(self) -> float:
        """The largest `contact_error` [m]; NaN if no fingertip touches.

        A curve over d of the fraction of grasps that hold within d counts the `held` grasps with a
        smaller value than d.
        """
        return _largest(self.contact_error)

    @property
    def closed(self) -> Contacts | None:
        """Contacts after closing; `trial.closed` also has the joint positions at that time."""
        end = None if self.trial is None else self.trial.closed
        return None if end is None else end.contacts

    @property
    def lifted(self) -> Contacts | None:
        """Contacts after the lift; `trial.lift` also has joints, poses, slip and turn then."""
        end = None if self.trial is None else self.trial.lift
        return None if end is None else end.contacts

    @property
    def solver_status(self) -> int:
        """Exit mode of SLSQP, 0 for success; -1 if it was not used."""
        return -1 if self.fit is None else self.fit.status

    @property
    def hint_text(self) -> str:
        """The hints in a line; empty if there are none."""
        return "; ".join(self.hints)

    def save_html(self, path: str | Path) -> None:
        """Write an HTML file that plays the simulation in a browser, from any side.

        The grasp is simulated again for the file, which gives the same bits.

        Args:
            path: The file to write.

        Raises:
            OSError: If the file cannot be written.
        """
        from drakegrasp.verification.figure import record_verification

        record_verification(self, Path(path))

    def figure(self) -> Figure:
        """Return a matplotlib figure of predicted and reached contacts on the mesh."""
        from drakegrasp.verification.figure import verification_figure

        return verification_figure(self)

    def explain(self) -> str:
        """Return the verdict and its reason in a few sentences."""
        return " ".join(_sentences(self))

    def __repr__(self) -> str:
        return f"Verification({self.method}, {self.words}: {self.reason})"


def _largest(values: Array | None) -> float:
    """Return the largest finite number, NaN if there is none."""
    there = np.zeros(0) if values is None else values[np.isfinite(values)]
    return float(there.max()) if there.size else np.nan


def _sentences(verified: Verification) -> Iterator[str]:
    # Faults in the numbers come first: if there are any, all else is about another grasp.
    inwards = any(reading.reversed for reading in verified._doubts[0])
    if verified.misplaced:
        yield from _misplaced(verified)
    elif inwards:
        yield (
            "The normals point into the object; a grasp has normals that point out of it. This "
            f"would fit much better: {verified.hint_text}."
        )

    # The verdict, and the changes to the row of numbers.
    verdict = "holds" if verified.held else f"fails ({verified.outcome.label})"
    yield f"The grasp of {verified.placed.model.name} {verdict}: {verified.reason}."
    if verified.outcome is Outcome.INVALID:
        return
    if verified.normalised:
        yield "A predicted normal was not of unit length; it was normalised."
    if verified.snapped:
        moved = in_mm(verified.surface_distance.max())
        yield f"The points were moved to the surface, by at most {moved}."

    # What the hand did, with the first wrist pose and with the others.
    if verified.fit is not None:
        yield from _contacts(verified)
    if verified.num_tries > 1:
        yield _other_poses(verified)
    if verified.trial is not None and verified.trial.lift is not None:
        yield _in_the_hand(verified, verified.trial.lift)
    if verified.misplaced:
        return
    if verified.removal is not None:
        yield _as_a_sample(verified, verified.removal)
        yield from _loads(verified)

    # What forces at the contacts alone can do, and other possible faults in the numbers.
    if not np.isnan(verified.smallest_friction):
        yield _margin(verified)
    if verified.hints and not inwards:
        yield f"This would fit much better: {verified.hint_text}."


def _misplaced(verified: Verification) -> Iterator[str]:
    """Yield how far the contacts or the posture are off the object, and where they would fit."""
    # State what is off and how far.
    distance = verified.surface_distance
    all_far = bool(np.all(distance > FAR))
    more = ", so the requested grasp does not touch it"
    if verified.fingertip_distance is not None:
        distance, all_far = verified.fingertip_distance, True
        what, more = "The posture's fingertips are", ""
    elif all_far:
        what = "The points lie"
    else:
        far = int(np.sum(distance > FAR))
        what = f"{far} of {len(distance)} points {'lies' if far == 1 else 'lie'}"
        distance, more = distance[distance > FAR], f"{more} there"
    between = in_mm(distance.max())
    if len(distance) > 1 and in_mm(distance.min()) != between:
        between = f"{1e3 * distance.min():.1f} to {between}"
    yield f"{what} {between} off the object{more}."

    # State where it would fit. If some points are near, the frame is hardly wrong.
    if verified.hints:
        yield f"This would fit much better: {verified.hint_text}."
    elif all_far:
        yield (
            "They fit in no other known frame or unit. Are they in the frame of a camera whose "
            "pose is not given, or do they belong to another object?"
        )


def _contacts(verified: Verification) -> Iterator[str]:
    """Yield how well the hand makes the requested contacts."""
    # Before closing, according to the fit.
    fit, limit = verified.fit, verified.config.verify.max_contact_error
    errors = verified.contact_error, verified.normal_error
    assert fit is not None and errors[0] is not None and errors[1] is not None
    if not verified.misplaced:
        yield (
            f"Before closing, the fingertips are within {in_mm(fit.residual.max())} of the "
            f"predicted points, and the pads within {np.rad2deg(fit.normal_error).max():.0f}° of "
            "the predicted normals."
        )
    if np.isnan(verified.farthest_contact):
        return

    # After closing, and whether that is a success.
    angle = np.rad2deg(np.nanmax(np.append(errors[1], 0.0)))
    yield (
        f"After closing, the fingertips touch the object within {in_mm(verified.farthest_contact)} "
        f"of the predicted points, and within {angle:.0f}° of the predicted normals."
    )
    if verified.held and not verified.success:
        finger = int(np.nanargmax(errors[0])) + 1
        yield (
            f"It is not a success: fingertip {finger} is more than {in_mm(limit)} from its point, "
            "so another grasp holds than the requested one."
        )


def _other_poses(verified: Verification) -> str:
    """Return the results of the other wrist poses."""
    if verified.held_by is None:
        return f"None of {verified.num_tries} wrist poses for these contacts holds it."
    return (
        f"The wrist pose that fits best does not hold it, but number {verified.held_by + 1} of "
        f"{verified.num_tries} does."
    )


def _in_the_hand(verified: Verification, lift: Lift) -> str:
    """Return what moved in the hand, and what touched the object at the end."""
    # State what happened.
    links = lift.contacts.other_links
    touching = {0: "no other link of the hand touches it", 1: "another link touches it"}.get(
        links, f"{links} other links touch it"
    )
    text = (
        f"During the lift the object slips by {in_mm(lift.slip)} and turns by "
        f"{np.rad2deg(lift.turn):.1f}° in the hand, and at the end {touching}"
    )

    # Name the kind of grasp, if the object is held at all.
    if not verified.held:
        tips = lift.contacts.touching
        still = f"{int(tips.sum())} of {len(tips)} fingertips still touch it"
        return f"{text}; {still}."
    precision = "a precision grasp" if verified.precision else "no precision grasp"
    return f"{text}: {precision}, {'' if verified.stable else 'not '}stable."


def _loads(verified: Verification) -> Iterator[str]:
    """Yield how the largest fingertip force compares with the hand's rated load, if known."""
    rated, trial = load_hand(verified.config.hand_source).rated_load, verified.trial
    if rated is None or trial is None or trial.closed is None or trial.lift is None:
        return
    forces = [norm(stage.contacts.f_Q_O).max() for stage in (trial.closed, trial.lift)]
    largest = float(max(forces))
    yield (
        f"The largest force of a fingertip is {largest:.1f} N, {largest / rated:.1f} times the "
        f"hand's rated load of {rated:.1f} N."
    )


def _as_a_sample(verified: Verification, removal: Removal) -> str:
    """Return whether it would be a sample of a dataset, and which filters were not judged."""
    kept = removal is Removal.KEPT
    verdict = "would be a sample" if kept else f"would be no sample ({removal.label})"
    rules = ", ".join(each.label for each in verified.unjudged)
    return f"In a dataset it {verdict}; not judged: {rules}."


def _margin(verified: Verification) -> str:
    """Return the friction that forces at the contacts alone need."""
    physics = verified.placed.model.own_physics(verified.config.physics)
    needed, simulated = verified.smallest_friction, physics.friction_hand
    if np.isfinite(needed):
        text = f"Forces at these points alone need a friction coefficient of {needed:.2f}"
    else:
        text = "Forces at these points alone are not enough at any friction"
    text += f"; the simulation has {simulated:.2f}"
    if verified.held and verified.method == "hand" and needed > simulated:
        # A point does not resist twisting, but an area of contact does; and a grasp that slips is
        # held at other points.
        text += ", but the hand's contacts are areas"
        text += "" if verified.stable else ", and the object is not held where they were"
    return f"{text} (epsilon {verified.epsilon:.3f})."


def in_mm(length: float) -> str:
    """Return a length [m] as text in millimetres."""
    return f"{1e3 * length:.1f} mm"
