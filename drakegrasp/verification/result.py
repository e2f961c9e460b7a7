"""The result of verifying one grasp: the verdict, what was simulated, and why; results as files.

Input: what `verify` measured. Output: a `Verification` and its explanation. The explanation states
whether the grasp holds and why, what moved, and how close the contacts are to the requested ones.
If the points are off the object, this is reported first. Results are written as lines of strict
JSON and as an HDF5 file, both with the fields `schema.VERIFICATION_FIELDS`. Equal results give
equal HDF5 files, because only the JSON contains wall-clock times.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from drakegrasp.arithmetic import multiply, norm
from drakegrasp.config import Config
from drakegrasp.dataset.hdf5 import AnyArray, write_field
from drakegrasp.dataset.json_files import strict_json
from drakegrasp.dataset.manifest import installed_versions, origin_attributes
from drakegrasp.dataset.reader import PredictedRows
from drakegrasp.dataset.schema import VERIFICATION_FIELDS, Field, sizes
from drakegrasp.filters import Removal
from drakegrasp.frames import X_WT, Array, invert_pose, pack_pose, transform_points
from drakegrasp.generation.attempts import Disturbance, disturbance_of, unjudged
from drakegrasp.hand.description import load_hand
from drakegrasp.outcomes import Outcome
from drakegrasp.reach.arm import Arm
from drakegrasp.reach.reaching import Reach, draw_arm, reach_attempt
from drakegrasp.runtime.environment import one_thread, timed
from drakegrasp.runtime.files import atomic_hdf5
from drakegrasp.simulation.attempt import Attempt
from drakegrasp.simulation.lift import Lift
from drakegrasp.simulation.placement import PlacedObject
from drakegrasp.simulation.trial import TrialRecord
from drakegrasp.verification.hints import FAR, find_hints
from drakegrasp.verification.placing import PlacedGrasp
from drakegrasp.verification.prediction import contact_epsilon
from drakegrasp.verification.wrist_solver import WristFit

#: Group of the HDF5 file that holds the fields.
GROUP = "grasps"


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
    def lifted(self) -> bool:
        """Whether each required fingertip touches the object after the lift, above the table."""
        return self.trial.outcome is Outcome.SUCCESS


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Verification:
    """The verdict on a grasp of k contacts. Stages that were not reached are None or NaN.

    The grasp is judged by its first wrist pose, which fits the contacts best. Epsilon and hints are
    computed when they are asked for.

    Attributes:
        grasp: The grasp on its object, as it was requested.
        outcome: Outcome of the trial of the first wrist pose, as in a dataset; or `invalid`.
        reason: Reason for the outcome, in one sentence without a full stop.
        p_OQ, nhat_Q_O: (k, 3), the contact points [m] and unit normals in {O} that were tried; NaN
            for an invalid row or a posture.
        surface_distance: (k,), distances of the predicted points from the object's surface [m].
        tries: The wrist poses that were simulated, in order; none for an invalid row. Of a grasp of
            two contacts, poses at which the open hand would be in object or table are left out,
            unless all are.
        seconds: Wall-clock time by stage [s].
        stand: Index of the resting pose of this verdict: the best of those in which a posture was
            tried.
        margin: Epsilon, if it was computed already.
        told: The hints, if they were found already.
        arm: The arm that was asked, if any.
        reach: What it can do about the first wrist pose; None if no arm was asked.
    """

    grasp: PlacedGrasp
    outcome: Outcome
    reason: str
    p_OQ: Array
    nhat_Q_O: Array
    surface_distance: Array
    tries: tuple[PoseTrial, ...] = ()
    seconds: dict[str, float] = field(default_factory=dict)
    stand: int = 0
    margin: float | None = None
    told: tuple[str, ...] | None = None
    arm: Arm | None = None
    reach: Reach | None = None

    @property
    def placed(self) -> PlacedObject:
        """The object and its pose on the table."""
        return self.grasp.stands[self.stand]

    @property
    def config(self) -> Config:
        """Hand, physics, lift and rules of the verification."""
        return self.grasp.config

    # How well it holds

    @property
    def matches(self) -> bool:
        """Whether the first wrist pose holds, with every contact where it was requested.

        "Where it was requested" means within `verify.max_contact_error`. A posture requests no
        contacts, so it is whether it holds.
        """
        return self.lifted and not self.farthest_contact > self.config.verify.max_contact_error

    @property
    def lifted(self) -> bool:
        """Whether the first wrist pose holds the object at the end of the lift, anywhere."""
        return self.outcome is Outcome.SUCCESS

    @property
    def lifted_any(self) -> bool:
        """Whether any of the tried wrist poses holds the object.

        The 18 numbers leave the wrist open, and nobody knows in advance which pose holds. This is
        what an oracle that chooses the wrist pose would reach.
        """
        return self.lifted or self.lifted_by is not None

    @property
    def lifted_by(self) -> int | None:
        """Index of the first wrist pose that holds the object, None if no wrist pose does."""
        return next((i for i, each in enumerate(self.tries) if each.lifted), None)

    @property
    def precision(self) -> bool:
        """Whether the object is lifted, and only by the fingertips."""
        return self.lifted and (self.trial is None or self.trial.precision)

    @property
    def stable(self) -> bool:
        """Whether it is a precision grasp that moves less than 5 mm and 5 degrees in the hand."""
        return self.lifted and (self.trial is None or self.trial.stable)

    @property
    def kept(self) -> bool:
        """Whether the grasp passes the filters of a dataset, except for those in `unjudged`.

        Among other objects the filters of camera poses are not applied, either.
        """
        return self.removal is Removal.KEPT

    @property
    def clean(self) -> bool:
        """Whether it is kept and left its neighbours in place: within 10 mm and 10 degrees."""
        return self.kept and (self.disturbance is None or self.disturbance.is_small)

    @property
    def disturbance(self) -> Disturbance | None:
        """What the first trial did to the neighbours, which are those of `placed.around`.

        None for an object without neighbours, and for a hand that did not close.
        """
        return disturbance_of(self.trial, self.placed.around_simulated) if self.trial else None

    @property
    def removal(self) -> Removal | None:
        """The first filter that removes the grasp, `KEPT` if none does; None if not lifted."""
        return self.first.removal if self.first else None

    @property
    def unjudged(self) -> tuple[Removal, ...]:
        """Filters that a verdict cannot judge, e.g. those of images."""
        return unjudged(self.config.filters)

    # The first wrist pose

    @property
    def first(self) -> PoseTrial | None:
        """The first wrist pose and its trial; None for an invalid row."""
        return self.tries[0] if self.tries else None

    @property
    def fit(self) -> WristFit | None:
        """The first wrist pose that was fitted to contacts, with its joints."""
        return self.first.fit if self.first else None

    @property
    def pregrasp(self) -> Attempt | None:
        """Palm and opened fingers at the start of the first trial."""
        return self.first.pregrasp if self.first else None

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

        A curve over d of the fraction of grasps that hold within d counts the `lifted` grasps
        with a smaller value than d.
        """
        errors = np.zeros(0) if self.contact_error is None else self.contact_error
        known = errors[np.isfinite(errors)]
        return float(known.max()) if known.size else np.nan

    @property
    def num_tries(self) -> int:
        """Number of wrist poses that were simulated."""
        return len(self.tries)

    # Margins and hints

    @cached_property
    @one_thread
    def epsilon(self) -> float:
        """Ferrari-Canny measure of the contacts; 0 without force closure, NaN for a posture."""
        if self.margin is not None:
            return self.margin
        if self.grasp.postures or self.grasp.invalid:
            return np.nan
        with timed(self.seconds, "margin"):
            about = self.placed.model, self.p_OQ, self.nhat_Q_O
            return contact_epsilon(*about, self.config.physics)

    @property
    def misplaced(self) -> bool:
        """Whether a contact is more than 10 mm off the surface: frame or unit may be wrong."""
        return bool(np.any(self.surface_distance > FAR))

    @cached_property
    @one_thread
    def hints(self) -> tuple[str, ...]:
        """Readings in which contacts that fail would fit much better, in words."""
        if self.told is not None:
            return self.told
        fits = self.matches and not self.misplaced
        if fits or self.grasp.postures or self.grasp.invalid or self.outcome.inconclusive:
            return ()
        with timed(self.seconds, "hints"):
            return find_hints(self.grasp, self.nhat_Q_O, fits=self.matches)

    @property
    def hint_text(self) -> str:
        """The hints in a line; empty if there are none."""
        return "; ".join(self.hints)

    def explained(self) -> Verification:
        """Return the verdict with margins and hints, which are computed now."""
        return replace(self, margin=self.epsilon, told=self.hints)

    def reached_by(self, arm: Arm) -> Verification:
        """Return the verdict with what an arm can do about the first wrist pose, if there is one.

        Raises:
            ConfigError: If the arm does not carry the hand.
        """
        if self.first is None:
            return self
        closed, about = self.first.trial.closed, (self.placed.model.field, self.first.pregrasp)
        q_closed = None if closed is None else closed.q
        X_TO, around = self.placed.X_TO, self.placed.around
        reach = reach_attempt(arm, *about, X_TO, self.config, q_closed=q_closed, around=around)
        return replace(self, arm=arm, reach=reach)

    def findings(self) -> dict[str, Any]:
        """Return the attributes without the grasp, whose meshes are large."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name != "grasp"}

    # For people

    def save_html(self, path: str | Path) -> None:
        """Write an HTML file that plays the simulation in a browser, from any side.

        The grasp is simulated again for the file, which gives the same bits. For an invalid row,
        the file shows the object at rest. An arm that reaches the grasp is shown at the grasp, and
        as a shadow where it begins its approach.

        Args:
            path: The file to write.

        Raises:
            OSError: If the file cannot be written.
        """
        from drakegrasp.pictures.recording import record_attempt, record_object

        about = self.placed.model, self.placed.X_TO_simulated
        if self.pregrasp is None:
            record_object(*about, self.config, Path(path), caption=self.explain())
            return
        record_attempt(
            *about,
            self.pregrasp,
            self.config,
            Path(path),
            p_OQ=self.p_OQ,
            nhat_Q_O=self.nhat_Q_O,
            caption=self.explain(),
            around=self.placed.around_simulated,
            still=self._arm_in_world(),
        )

    def _arm_in_world(self) -> dict[str, Array]:
        """Return triangles (t, 3, 3) [m] of the arm in {W}, where the object is simulated."""
        if self.arm is None or self.reach is None:
            return {}
        moved = multiply(self.placed.X_TO_simulated, invert_pose(self.placed.X_TO))
        X_WT_moved = multiply(X_WT, moved)
        drawn = draw_arm(self.arm, self.reach.q, self.config)
        return {
            name: transform_points(X_WT_moved, triangles.reshape(-1, 3)).reshape(-1, 3, 3)
            for name, triangles in drawn.items()
        }

    def explain(self) -> str:
        """Return the verdict and its reason in a few sentences."""
        return " ".join(_sentences(self))

    def __repr__(self) -> str:
        return f"Verification({self.outcome.label}: {self.reason})"


def _sentences(verified: Verification) -> Iterator[str]:
    # Points off the object come first: then all else is about another grasp.
    better = f"This would fit much better: {verified.hint_text}."
    if verified.misplaced:
        yield _misplaced(verified)
        if verified.hints:
            yield better
        elif (verified.surface_distance > FAR).all():
            yield (
                "They fit in no other known frame or unit. Are they in the frame of a camera whose "
                "pose is not given, or do they belong to another object?"
            )

    # The verdict, and the changes to the row of numbers.
    verdict = "holds" if verified.lifted else f"fails ({verified.outcome.label})"
    yield f"The grasp of {verified.placed.model.name} {verdict}: {verified.reason}."
    if verified.outcome is Outcome.INVALID:
        return
    if verified.grasp.normalised:
        yield "A predicted normal was not of unit length; it was normalised."

    # What the hand did, with the first wrist pose and with the others.
    if verified.fit is not None:
        yield from _contacts(verified, verified.fit)
    if verified.num_tries > 1:
        yield _other_poses(verified)
    if verified.trial is not None and verified.trial.lift is not None:
        yield _in_the_hand(verified, verified.trial.lift)
    if verified.disturbance is not None:
        yield _among_others(verified, verified.disturbance)
    if verified.misplaced:
        return
    if verified.removal is not None:
        yield _as_a_sample(verified, verified.removal)
        yield from _loads(verified)

    if verified.reach is not None:
        yield _by_the_arm(verified.reach)

    # Other possible faults in the numbers.
    if verified.hints:
        yield better


def _among_others(verified: Verification, moved: Disturbance) -> str:
    assert verified.placed.around is not None
    name = verified.placed.around.models[moved.neighbour].name
    return (
        f"Of its neighbours {name} is shifted most, by {in_mm(moved.shift)}; the largest turn of a "
        f"neighbour is {np.rad2deg(moved.turn):.1f}°."
    )


def _by_the_arm(reach: Reach) -> str:
    if reach.reachable:
        return f"The arm reaches it, with a clearance of {in_mm(reach.clearance)}."
    why = {
        "out_of_reach": "the palm pose is out of its reach",
        "collision": "arm or hand collides at the palm pose",
        "approach": "it cannot come straight to the palm pose",
        "lift": "it cannot lift straight from there",
    }
    return f"The arm does not reach it: {why[reach.outcome]}."


def _misplaced(verified: Verification) -> str:
    """Return how far the contacts are off the object."""
    distance, there = verified.surface_distance, ""
    far = distance[distance > FAR]
    what = "The points lie"
    if len(far) < len(distance):
        what, there = (
            f"{len(far)} of {len(distance)} points {'lies' if len(far) == 1 else 'lie'}",
            " there",
        )
    between = in_mm(far.max())
    if in_mm(far.min()) != between:
        between = f"{1e3 * far.min():.1f} to {between}"
    return f"{what} {between} off the object, so the requested grasp does not touch it{there}."


def _contacts(verified: Verification, fit: WristFit) -> Iterator[str]:
    """Yield how well the hand makes the requested contacts."""
    # Before closing, according to the fit.
    limit = verified.config.verify.max_contact_error
    errors = verified.contact_error, verified.normal_error
    assert errors[0] is not None and errors[1] is not None
    if not verified.misplaced:
        yield (
            f"Before closing, the fingertips are within {in_mm(fit.residual.max())} of the "
            f"predicted points, and the pads within {np.rad2deg(fit.normal_error).max():.0f}° of "
            "the predicted normals."
        )
    if np.isnan(verified.farthest_contact):
        return

    # After closing, and whether that matches the request.
    angle = np.rad2deg(np.nanmax(np.append(errors[1], 0.0)))
    yield (
        f"After closing, the fingertips touch the object within {in_mm(verified.farthest_contact)} "
        f"of the predicted points, and within {angle:.0f}° of the predicted normals."
    )
    if verified.lifted and not verified.matches:
        finger = int(np.nanargmax(errors[0])) + 1
        yield (
            f"It does not match its request: fingertip {finger} is more than {in_mm(limit)} from "
            "its point, so another grasp holds than the requested one."
        )


def _other_poses(verified: Verification) -> str:
    """Return the results of the other wrist poses."""
    if verified.lifted_by is None:
        return f"None of {verified.num_tries} wrist poses for these contacts holds it."
    return (
        f"The wrist pose that fits best does not hold it, but number {verified.lifted_by + 1} of "
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

    # Name the kind of grasp, if the object is lifted at all.
    if not verified.lifted:
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


def in_mm(length: float) -> str:
    """Return a length [m] as text in millimetres."""
    return f"{1e3 * length:.1f} mm"


# Files


def json_line(index: int, result: Verification) -> str:
    """Return a verdict as a line of strict JSON; NaN and infinity become null.

    Keys are those of the HDF5 fields, and what only people and logs need.

    Args:
        index: Index of the grasp.
        result: The verdict on the grasp.
    """
    values = {field.name: field.value_of(result) for field in VERIFICATION_FIELDS}
    line = {
        "index": index,
        **values,
        "unjudged": result.unjudged if result.removal is not None else (),
        "outcomes": [each.trial.outcome for each in result.tries],
        "explain": result.explain(),
        "seconds": result.seconds,
    }
    return strict_json(line)


def write_results(
    results: Sequence[Verification],
    path: Path,
    config: Config,
    rows: PredictedRows | None = None,
) -> None:
    """Write results to an HDF5 file, which appears complete or not at all.

    Args:
        results: The results, in the order of the grasps.
        path: The file.
        config: Configuration of the verification.
        rows: Rows of the dataset that the grasps are for, in the same order; None without a
            dataset.

    Raises:
        OSError: If the disk is full or the folder cannot be written.
    """
    hand = load_hand(config.hand_source)
    shape = sizes(fingers=hand.num_fingers, joints=len(hand.joint_names), image=0)
    with atomic_hdf5(path) as file:
        versions, joints = installed_versions(config), hand.joint_order
        origin = origin_attributes(config, versions, hand.finger_names, joints)
        file.attrs.update(origin)
        group = file.create_group(GROUP)
        for field in VERIFICATION_FIELDS:
            write_field(group, field, _column(field, results, shape))
        if rows is not None:
            rows.write(file)


def _column(field: Field, results: Sequence[Verification], shape: dict[str, int]) -> AnyArray:
    """Return the values of a field for all results; empty values for stages not reached."""
    if field.dtype == "str":
        return np.array([field.value_of(result) for result in results], dtype=object)
    column = field.empty(len(results), shape)
    for i, result in enumerate(results):
        value = field.value_of(result)
        if value is not None:
            column[i] = pack_pose(value) if field.shape == "12" else value
    return column
