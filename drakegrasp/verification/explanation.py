"""The verdict on a grasp in sentences, for people.

In: a `Verification`. Out: a few sentences: whether the grasp holds and why, what moved, how close
the contacts are to those asked for, and what forces at them alone could do. Numbers that are in
another frame or unit, or normals that point inwards, come first.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from drakegrasp.arithmetic import norm
from drakegrasp.hand.description import load_hand
from drakegrasp.outcomes import Outcome, Removal
from drakegrasp.simulation.lift import Lift
from drakegrasp.verification.hints import FAR, REVERSED

if TYPE_CHECKING:
    from drakegrasp.verification.result import Verification


def explain(verified: Verification) -> str:
    """Return the verdict, and why, in a few sentences."""
    return " ".join(_sentences(verified))


def _sentences(verified: Verification) -> Iterator[str]:
    # What is wrong with the numbers comes first: all else is of another grasp than was meant.
    inwards = REVERSED in verified.hints
    if verified.misplaced:
        yield from _misplaced(verified)
    elif inwards:
        yield (
            "The normals point into the object; a grasp has normals that point out of it. This "
            f"would fit much better: {verified.hint_text}."
        )

    # The verdict, and what was done to the row of numbers.
    verdict = "holds" if verified.held else f"fails ({verified.outcome.label})"
    yield f"The grasp of {verified.placed.model.name} {verdict}: {verified.reason}."
    if verified.outcome is Outcome.INVALID:
        return
    if verified.normalised:
        yield "A predicted normal was not of unit length; it was normalised."
    if verified.snapped:
        moved = in_mm(verified.surface_distance.max())
        yield f"The points were moved to the surface, by at most {moved}."

    # What the hand did, by the first wrist pose and by the others.
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

    # What forces at the contacts alone can do, and what else may be wrong with the numbers.
    if not np.isnan(verified.smallest_friction):
        yield _margin(verified)
    if verified.hints and not inwards:
        yield f"This would fit much better: {verified.hint_text}."


def _misplaced(verified: Verification) -> Iterator[str]:
    """Yield how far the contacts or the posture are off the object, and where they would fit."""
    # What is how far away.
    distance = verified.surface_distance
    all_far = bool(np.all(distance > FAR))
    more = ", so the grasp that was asked for does not touch it"
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

    # Where it would fit. Where some points are near, the frame is hardly wrong.
    if verified.hints:
        yield f"This would fit much better: {verified.hint_text}."
    elif all_far:
        yield (
            "They fit in no other frame or unit that is known here; are they in the frame of a "
            "camera whose pose is not given, or for another object?"
        )


def _contacts(verified: Verification) -> Iterator[str]:
    """Yield how well the hand makes the contacts that were asked for."""
    # Before closing, as the fit leaves them.
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
        f"After closing, they touch the object within {in_mm(verified.farthest_contact)} of the "
        f"predicted points, and within {angle:.0f}° of the predicted normals."
    )
    if verified.held and not verified.success:
        finger = int(np.nanargmax(errors[0])) + 1
        yield (
            f"It is no success: fingertip {finger} is more than {in_mm(limit)} from its point, so "
            "another grasp holds than the one asked for."
        )


def _other_poses(verified: Verification) -> str:
    """Return what became of the other wrist poses."""
    if verified.held_by is None:
        return f"None of {verified.num_tries} wrist poses for these contacts holds it."
    return (
        f"The wrist pose that fits best does not hold it, but number {verified.held_by + 1} of "
        f"{verified.num_tries} does."
    )


def _in_the_hand(verified: Verification, lift: Lift) -> str:
    """Return what moved in the hand, and what touched the object at the end."""
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
    if not verified.held:
        tips = lift.contacts.touching
        still = f"{int(tips.sum())} of {len(tips)} fingertips still touch it"
        return f"{text}; {still}."
    precision = "a precision grasp" if verified.precision else "no precision grasp"
    return f"{text}: {precision}, {'' if verified.stable else 'not '}stable."


def _loads(verified: Verification) -> Iterator[str]:
    """Yield how the largest force of a fingertip compares with what its maker allows, if known."""
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
    """Return whether it would be a sample of a dataset, and what is not known of that."""
    kept = removal is Removal.KEPT
    verdict = "would be a sample" if kept else f"would be no sample ({removal.label})"
    rules = ", ".join(each.label for each in verified.unjudged)
    return f"In a dataset it {verdict}; not judged: {rules}."


def _margin(verified: Verification) -> str:
    """Return the friction that the contacts alone need."""
    physics = verified.placed.model.own_physics(verified.config.physics)
    needed, simulated = verified.smallest_friction, physics.friction_hand
    if np.isfinite(needed):
        text = f"Forces at these points alone need a friction coefficient of {needed:.2f}"
    else:
        text = "Forces at these points alone are not enough at any friction"
    text += f"; the simulation has {simulated:.2f}"
    if verified.held and verified.method == "hand" and needed > simulated:
        # A point does not resist twisting, an area of contact does; and what slips is held
        # elsewhere.
        text += ", but the hand's contacts are areas"
        text += "" if verified.stable else ", and the object is not held where they were"
    return f"{text} (epsilon {verified.epsilon:.3f})."


def in_mm(length: float) -> str:
    """Return a length [m] as text in millimetres."""
    return f"{1e3 * length:.1f} mm"
