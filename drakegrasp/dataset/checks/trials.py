"""Rules of the rows of trials.hdf5: numbers, stages, contacts, poses, the verdict, the hold.

In: a `Batch` of rows of `/trials`. Out: a `Violation` for every row that is wrong. A rule relies
on those that `trials_file` applies before it: it is given no row that breaks one of them. No file
is read.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from drakegrasp.config import CloseConfig, LiftConfig
from drakegrasp.dataset.checks.findings import Violation
from drakegrasp.dataset.checks.rows import AnyArray, Batch, all_per_row, rotation, unit_length
from drakegrasp.dataset.schema import NO_PRESHAPE, TRIAL_FIELDS
from drakegrasp.frames import invert_pose
from drakegrasp.grasp import unused_fingers
from drakegrasp.outcomes import Outcome, Stage
from drakegrasp.simulation.candidates import Source
from drakegrasp.simulation.verdict import (
    is_lost_sample,
    is_precision,
    is_stable,
    judge_closed,
    judge_lifted,
    scrapes,
)

#: Slip [m] and turn [rad] are as exact as the poses that they follow from; the angle of a rotation
#: close to none is less exact than its matrix.
MOTION_TOLERANCE = 1e-4
#: Largest outward force of a fingertip on the object [N]. The mean normal and the force of a patch
#: are separate averages: where a fingertip is about to lose the object they may disagree, by no
#: more than the force from which on a contact counts.
PULL = 0.05
#: With more friction a force may leave the object's side of a mean normal: a cone of 45 degrees.
MAX_FRICTION = 1.0


def numbers(
    batch: Batch,
    objects: int,
    candidates: Sequence[int] | None,
    standoffs: int | None,
    children: int | None,
) -> Iterator[Violation]:
    """The numbers of a trial are legal, and a refined palm pose has a parent.

    Args:
        batch: Rows of `/trials`.
        objects: Number of objects.
        candidates: Number of candidates by object, if known.
        standoffs: Number of stand-offs, if known.
        children: Number of children of each parent, if known.
    """
    yield from batch.follows("trial_id", batch.rows, "the row's number")
    outcome, known = batch["outcome"], [o.value for o in Outcome if not o.verification_only]
    what = f"outcome must be one of {', '.join(map(str, known))}"
    yield from batch.broken(what, ~np.isin(outcome, known), outcome)

    # Of an unknown object, which is a finding, no number is too large.
    most = np.full(len(batch), np.iinfo(np.int64).max)
    index = batch["object"]
    if candidates is not None and len(candidates) == objects:
        there = (index >= 0) & (index < objects)
        most[there] = np.array(candidates)[index[there]]
    for name, of, limit in (
        ("object", "rows of /objects", objects),
        ("candidate", "candidates of its object", most),
        ("standoff_index", "stand-offs", standoffs),
        ("child", "numbers in a family", np.inf),
    ):
        bad = (batch[name] < 0) | (batch[name] >= (np.inf if limit is None else limit))
        yield from batch.broken(f"{name} must be one of the {of}", bad, batch[name])

    # The first of a family has no parent.
    child, source = batch["child"], batch["source"]
    refined = child > 0
    what = "generation must be 0 for the first of a family and positive for others"
    yield from batch.broken(what, (batch["generation"] > 0) != refined, batch["generation"])
    what = "source must be 2 (refine) for a refined palm pose, and 0, 1, 3 or 4 for another"
    bad = ((source == Source.REFINE) != refined) | (source > max(Source))
    yield from batch.broken(what, bad, source)

    # Only of a posture from outside may the density be unknown.
    what, density = "log_density must be finite but for postures", batch["log_density"]
    yield from batch.broken(what, ~np.isfinite(density) & (source != Source.POSTURES), density)
    what = "preshape must be 255 of postures only, which use all fingers"
    bad = (source != Source.POSTURES) | (batch["unused"] > 0)
    bad &= batch["preshape"] == NO_PRESHAPE
    yield from batch.broken(what, bad, batch["preshape"])
    if children is not None:
        parent = np.where(refined, (child - 1) // max(children, 1), 0)
        yield from batch.follows("parent", parent, "child")


def stages(batch: Batch, close: CloseConfig | None) -> Iterator[Violation]:
    """The fields of a stage have values if the attempt reached it, and none otherwise.

    Args:
        batch: Rows of `/trials`.
        close: How hands close, if known.
    """
    stage = _stages(batch, close)
    if close is not None:
        yield from _clearances(batch, stage, close.scrape_depth is not None)
    for f in TRIAL_FIELDS:
        if f.derive is not None:
            of = ", ".join(f.needs)
            yield from batch.follows(f.name, f.derive(batch.columns), of)
            continue
        values = batch[f.name]
        reached = stage >= f.stage

        # What a value must be depends on its kind.
        if np.dtype(f.dtype).kind != "f":
            bad = ~reached & ~all_per_row(values == 0)
            what = f"{f.name} must be 0 before the stage {f.stage.name.lower()}"
        elif f.per_finger:
            instant = "lifted" if f.name.startswith("lifted_") else "closed"
            touching = reached[:, None] & batch[f"{instant}_touching"]
            due = touching.reshape(*touching.shape, *(1,) * (values.ndim - 2))
            bad = ~all_per_row(_as_due(values, due))
            what = f"{f.name} must be finite where the finger touches and NaN elsewhere"
        elif f.some:
            bad = ~reached & ~np.isnan(values)
            what = f"{f.name} must be NaN before the stage {f.stage.name.lower()}"
        else:
            due = reached.reshape(-1, *(1,) * (values.ndim - 1))
            bad = ~all_per_row(_as_due(values, due))
            what = f"{f.name} must be finite from the stage {f.stage.name.lower()} on"
            what += "" if f.stage is Stage.PLACED else " and NaN before"
        yield from batch.broken(what, bad, lambda i: _outcome(batch, i))


def _clearances(batch: Batch, stage: AnyArray, measured: bool) -> Iterator[Violation]:
    """Heights above the table are there where the configuration says so, and nowhere else."""
    state = "finite" if measured else "NaN"
    must = f"must be {state} with close.scrape_depth {'given' if measured else 'null'}"
    for name, reached in (("close", Stage.CLOSED), ("lift", Stage.LIFTED)):
        values = batch[f"clearance_{name}"]
        bad = (stage >= reached) & (np.isfinite(values) != measured)
        yield from batch.broken(f"clearance_{name} {must}", bad, values)


def repeats(batch: Batch, most: int | None) -> Iterator[Violation]:
    """Of the repeats of an attempt some hold, and some of these are samples.

    Args:
        batch: Rows of `/trials`.
        most: Number of repeats of an attempt that is drawn, if known.
    """
    probability = batch["p_hold_probability"]
    drawn = ~np.isnan(probability)
    bad = drawn & ~((probability > 0.0) & (probability <= 1.0))
    yield from batch.broken("p_hold_probability must be NaN or in 0..1", bad, probability)
    limit = np.where(drawn, np.inf if most is None else most, 0)
    for name in ("repeats", "held", "samples"):
        values = batch[f"p_hold_{name}"]
        what = "those drawn for" if name == "repeats" else "p_hold_repeats"
        what = "p_hold_held" if name == "samples" else what
        yield from batch.broken(f"p_hold_{name} must be at most {what}", values > limit, values)
        limit = values
    half = batch["p_hold_half_step"]
    bad = ~np.isnan(half) & (~np.isin(half, [0.0, 1.0]) | ~drawn)
    yield from batch.broken("p_hold_half_step must be 0, 1 or NaN, of those drawn", bad, half)


def verdicts(
    batch: Batch,
    required: Sequence[bool],
    rules: LiftConfig | None,
    close: CloseConfig | None,
) -> Iterator[Violation]:
    """The outcome is what follows from the recorded contacts and motion (`simulation.verdict`).

    Args:
        batch: Rows of `/trials`.
        required: Whether a grasp needs each fingertip on the object.
        rules: When lifts end, if known.
        close: How hands close, if known.
    """
    # What the contacts of each stage say.
    own = required_of(batch, required)
    closed = judge_closed(
        batch["closed_touching"],
        batch["closed_other_links"],
        batch["closed_hand_on_table"],
        required=own,
        scraped=_scraped(batch, "close", close),
    )
    lifted = judge_lifted(
        batch["lifted_touching"],
        batch["lifted_other_links"],
        batch["lifted_object_on_table"],
        required=own,
        scraped=_scraped(batch, "lift", close),
    )

    # Older versions called slipped what is partly held.
    older = (batch["outcome"] == Outcome.SLIPPED) & (lifted == Outcome.PARTLY_HELD)
    lifted = np.where(older, Outcome.SLIPPED.value, lifted)

    # A lift that was ended has no verdict, but a reason.
    moved = batch["outcome"] == Outcome.MOVED
    lifted = np.where(moved, Outcome.MOVED.value, lifted)
    if rules is not None:
        yield from batch.broken(
            "outcome must be moved only where lift.stop_when, stop_slip and stop_turn_deg say so",
            moved & ~is_lost_sample(batch["slip"], batch["turn"], rules),
            lambda i: (
                f"a slip of {batch['slip'][i]:.4g} m and a turn of {batch['turn'][i]:.4g} rad"
            ),
        )

    # Neither has a closed hand that was not lifted.
    judged, left = _stages(batch, close) >= Stage.CLOSED, batch["outcome"] == Outcome.NOT_LIFTED
    lifted = np.where(left, Outcome.NOT_LIFTED.value, lifted)
    if rules is not None:
        may_lift, audited = judged & (closed == Outcome.SUCCESS), batch["audited"]
        unlikely = (batch["chance"] < rules.least_chance) & ~audited
        yield from batch.broken(
            "outcome must be not_lifted where the hand may lift, the chance is below "
            "lift.least_chance and the trial is not audited",
            may_lift & unlikely & ~left,
            batch["chance"],
        )
        # Of a flat image the trial knows nothing; it has none.
        flat = (rules.least_depth_variance > 0.0) & ~audited
        yield from batch.broken(
            "outcome must be not_lifted only where the chance is below lift.least_chance, or the "
            "image may be flat, and the trial is not audited",
            may_lift & left & ~unlikely & ~flat,
            batch["chance"],
        )

    # A hand that may not lift has no second verdict.
    expected = np.where(closed != Outcome.SUCCESS, closed, lifted)
    yield from batch.broken(
        "outcome must follow from the contacts and the clearance",
        judged & (expected != batch["outcome"]),
        lambda i: (
            f"{Outcome(int(batch['outcome'][i])).label} where these say "
            f"{Outcome(int(expected[i])).label}"
        ),
    )


def required_of(batch: Batch, required: Sequence[bool]) -> AnyArray:
    """Return whether the grasp of each row needs each fingertip, (n, k): those of its preshape."""
    return np.asarray(required) & ~unused_fingers(batch["unused"], len(required))


def contacts(batch: Batch) -> Iterator[Violation]:
    """Fingertips that touch have a patch and a unit normal, and push into an object that is held.

    A patch may span an edge or a thin rim: its mean normal then does not tell the direction of the
    force. So that rule is for successes only, and only where friction turns a force by less than
    `MAX_FRICTION` does.
    """
    success = batch["outcome"] == Outcome.SUCCESS.value
    judged = success & (batch["friction_hand"] <= MAX_FRICTION)
    for stage in ("closed", "lifted"):
        touching = batch[f"{stage}_touching"]
        normals, forces = batch[f"{stage}_nhat_Q_O"], batch[f"{stage}_f_Q_O"]
        lengths = np.where(touching, np.linalg.norm(normals, axis=2), 1.0)
        yield from unit_length(batch, lengths, f"{stage}_nhat_Q_O of finger")

        # Forces, areas and depths, finger by finger.
        push = (normals * forces).sum(axis=2)
        area, depth = batch[f"{stage}_area"], batch[f"{stage}_penetration"]
        for k in range(touching.shape[1]):
            touches = touching[:, k]
            yield from batch.broken(
                f"{stage}_f_Q_O of finger {k + 1} must push into the object [N]",
                judged & touches & ~(push[:, k] < PULL),
                push[:, k],
            )
            yield from batch.broken(
                f"{stage}_area of finger {k + 1} must be positive where it touches [m^2]",
                touches & ~(area[:, k] > 0.0),
                area[:, k],
            )
            yield from batch.broken(
                f"{stage}_penetration of finger {k + 1} must not be negative [m]",
                depth[:, k] < 0.0,
                depth[:, k],
            )


def poses(batch: Batch) -> Iterator[Violation]:
    """The rotations of a trial's poses are orthonormal with determinant +1."""
    for name in ("X_TO", "X_OG", "X_C0C", "X_TO_lifted", "X_OG_lifted"):
        yield from rotation(batch, name)


def motion(batch: Batch) -> Iterator[Violation]:
    """How the object moved in the hand is possible, and follows from the palm's two poses."""
    for name, largest in (("slip", np.inf), ("turn", np.pi)):
        for key in (name, f"{name}_released"):
            bad = (batch[key] < 0.0) | (batch[key] > largest)
            yield from batch.broken(f"{key} must be 0..{largest:.4g}", bad, batch[key])

    # X_GO before and after the lift.
    before, after = (invert_pose(batch.pose(name)) for name in ("X_OG", "X_OG_lifted"))
    slip = np.linalg.norm(after[:, :3, 3] - before[:, :3, 3], axis=1)
    cosine = (np.einsum("nij,nij->n", before[:, :3, :3], after[:, :3, :3]) - 1.0) / 2.0
    turn = np.arccos(np.clip(cosine, -1.0, 1.0))
    for name, due in (("slip", slip), ("turn", turn)):
        yield from batch.follows(name, due, "X_OG and X_OG_lifted", MOTION_TOLERANCE)

    # The words for it.
    outcome, other_links = batch["outcome"], batch["lifted_other_links"]
    stable = is_stable(outcome, other_links, batch["slip"], batch["turn"])
    yield from batch.follows(
        "precision", is_precision(outcome, other_links), "outcome and lifted_other_links"
    )
    yield from batch.follows("stable", stable, "precision, slip and turn")


def _as_due(values: AnyArray, due: AnyArray) -> AnyArray:
    """Return where values are finite if they are due, and NaN if they are not."""
    return np.asarray(np.where(due, np.isfinite(values), np.isnan(values)))


def _scraped(batch: Batch, when: str, close: CloseConfig | None) -> AnyArray:
    """Return (n,) whether the hand came too far below the table's top; not where unknown."""
    if close is None:
        return np.zeros(len(batch), dtype=np.bool_)
    return scrapes(batch[f"clearance_{when}"], close)


def _stages(batch: Batch, close: CloseConfig | None) -> AnyArray:
    """Return the stage (n,) that each attempt reached."""
    table = np.zeros(max(Outcome) + 1, dtype=int)
    table[[o.value for o in Outcome]] = [o.stage.value for o in Outcome]
    # The table can be touched by the hand as it closes, or in the lift.
    by_hand = batch["closed_hand_on_table"] | _scraped(batch, "close", close)
    lifted = (batch["outcome"] == Outcome.TABLE_CONTACT) & ~by_hand
    return np.where(lifted, Stage.LIFTED.value, table[batch["outcome"]])


def _outcome(batch: Batch, i: int) -> str:
    return f"the contrary at outcome {Outcome(int(batch['outcome'][i])).label}"
