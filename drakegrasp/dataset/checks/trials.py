"""What must hold in the rows of trials.hdf5: numbers, stages, contacts, poses, the verdict.

In: a `Batch` of rows of `/trials`. Out: a `Violation` for every row and figure that is wrong.
A rule may rely on those that `check` applies before it, because it is given no row that
broke one of them. No file is read.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from drakegrasp.dataset.checks.findings import (
    POSITION_TOLERANCE,
    AnyArray,
    Batch,
    Violation,
    all_per_row,
    rotation,
    unit_length,
)
from drakegrasp.dataset.schema import TRIAL_FIELDS
from drakegrasp.outcomes import Outcome, Stage
from drakegrasp.simulation.verdict import judge_closed, judge_lifted

#: A patch's mean normal and its force are two averages: where a fingertip is just losing the
#: object they may disagree by as much as the force from which on a contact counts [N].
PULL = 0.05


def numbers(
    batch: Batch, objects: int, candidates: Sequence[int] | None, standoffs: int | None
) -> Iterator[Violation]:
    """Numbers of a trial are legal: its own row, outcome, object, candidate, stand-off.

    Args:
        batch: Rows of `/trials`.
        objects: Number of objects.
        candidates: Number of candidates by object, if they are known.
        standoffs: Number of stand-offs, if it is known.
    """
    yield from batch.broken(
        "trial_id must be the row's number", batch["trial_id"] != batch.rows, batch["trial_id"]
    )
    outcome, known = batch["outcome"], [o.value for o in Outcome if not o.verification_only]
    yield from batch.broken(f"outcome must be 0..{max(known)}", ~np.isin(outcome, known), outcome)
    index, candidate = batch["object"], batch["candidate"]
    wild = (index < 0) | (index >= objects)
    yield from batch.broken(f"object must be a row of /objects, 0..{objects - 1}", wild, index)
    limit = np.full(objects, np.iinfo(np.int64).max)
    if candidates is not None and len(candidates) == objects:
        limit = np.array(candidates, dtype=np.int64)
    # An index out of range is found above; any object's limit will do for it.
    above = candidate >= np.take(limit, index, mode="clip") if objects else np.zeros_like(wild)
    yield from batch.broken(
        "candidate must be one of its object's candidates",
        ~wild & ((candidate < 0) | above),
        candidate,
    )
    if standoffs is not None:
        number = batch["standoff_index"]
        yield from batch.broken(
            f"standoff_index must be below {standoffs}", number >= standoffs, number
        )


def stages(batch: Batch) -> Iterator[Violation]:
    """A stage's fields have values where the attempt came that far and nowhere else."""
    stage = _stages(batch)
    for f in TRIAL_FIELDS:
        values = batch[f.name]
        came = stage >= f.stage
        if np.dtype(f.dtype).kind != "f":
            bad = ~came & ~all_per_row(values == 0)
            what = f"{f.name} must be 0 before the stage {f.stage.name.lower()}"
        elif f.per_finger:
            touching = came[:, None] & batch[f"{f.name.split('_')[0]}_touching"]
            bad = ~all_per_row(_as_due(values, touching[:, :, None]))
            what = f"{f.name} must be finite where the finger touches and NaN elsewhere"
        else:
            due = came.reshape(-1, *(1,) * (values.ndim - 1))
            bad = ~all_per_row(_as_due(values, due))
            what = f"{f.name} must be finite from the stage {f.stage.name.lower()} on"
            what += "" if f.stage is Stage.PLACED else " and NaN before"
        yield from batch.broken(what, bad, lambda i: _outcome(batch, i))


def verdicts(batch: Batch) -> Iterator[Violation]:
    """The outcome is what follows from the recorded contacts (`simulation.verdict`)."""
    closed = judge_closed(
        batch["closed_touching"], batch["closed_other_links"], batch["closed_hand_on_table"]
    )
    lifted = judge_lifted(
        batch["lifted_touching"], batch["lifted_other_links"], batch["lifted_object_on_table"]
    )
    expected = np.where(closed != Outcome.SUCCESS, closed, lifted)
    judged = _stages(batch) >= Stage.CLOSED
    yield from batch.broken(
        "outcome must follow from the contacts",
        judged & (expected != batch["outcome"]),
        lambda i: (
            f"{Outcome(int(batch['outcome'][i])).label} where the contacts say "
            f"{Outcome(int(expected[i])).label}"
        ),
    )


def contacts(batch: Batch) -> Iterator[Violation]:
    """Fingertips that touch have a patch, a unit normal, and push into an object that is held.

    Where an object slides through the hand a patch may lie across a rim, with faces that look in
    opposite directions: their mean normal then says nothing of the force.
    """
    success = batch["outcome"] == Outcome.SUCCESS.value
    for stage, held in (("closed", True), ("lifted", success)):
        touching = batch[f"{stage}_touching"]
        normals, forces = batch[f"{stage}_nhat_Q_O"], batch[f"{stage}_f_Q_O"]
        lengths = np.where(touching, np.linalg.norm(normals, axis=2), 1.0)
        yield from unit_length(batch, lengths, f"{stage}_nhat_Q_O of finger")
        push = (normals * forces).sum(axis=2)
        area, depth = batch[f"{stage}_area"], batch[f"{stage}_penetration"]
        for k in range(touching.shape[1]):
            touches = touching[:, k]
            yield from batch.broken(
                f"{stage}_f_Q_O of finger {k + 1} must push into the object [N]",
                held & touches & ~(push[:, k] < PULL),
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
    """Poses of trials are rotations and positions."""
    for name in ("X_TO", "X_OG", "X_TO_lifted"):
        yield from rotation(batch, name)


def resting_poses(batch: Batch, X_TO: Sequence[Sequence[float]]) -> Iterator[Violation]:
    """Every attempt starts from its object's resting pose, given by object as (12,)."""
    expected = np.array(X_TO, dtype=float).reshape(-1, 12)[batch["object"].astype(int)]
    off = np.abs(batch["X_TO"] - expected).max(axis=1)
    yield from batch.broken(
        "X_TO must be the object's resting pose in manifest.json",
        off > POSITION_TOLERANCE,
        lambda i: f"a pose that is off by {off[i]:.4g}",
    )


def _as_due(values: AnyArray, due: AnyArray) -> AnyArray:
    """Return where values are finite and should be, or NaN and should be."""
    return np.asarray(np.where(due, np.isfinite(values), np.isnan(values)))


def _stages(batch: Batch) -> AnyArray:
    table = np.zeros(max(Outcome) + 1, dtype=int)
    table[[o.value for o in Outcome]] = [o.stage.value for o in Outcome]
    # The table can be touched by the hand at closing, or by the object after the lift.
    lifted = (batch["outcome"] == Outcome.TABLE_CONTACT) & ~batch["closed_hand_on_table"]
    return np.where(lifted, Stage.LIFTED.value, table[batch["outcome"]])


def _outcome(batch: Batch, i: int) -> str:
    return f"the contrary at outcome {Outcome(int(batch['outcome'][i])).label}"
