"""Rules of the chances by which closed hands are lifted: they follow from contacts and weights.

In: a `Batch` of rows of `/trials`, with finite contacts. Out: a `Violation` for every row that is
wrong. No file is read.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from drakegrasp.dataset.checks.findings import Batch, Violation
from drakegrasp.hand.lift_chance import GRASP_CONTACTS, ClosedGrasp, LiftChance
from drakegrasp.objects.model import ObjectModel
from drakegrasp.outcomes import Outcome
from drakegrasp.simulation.verdict import judge_closed

#: Chances are rounded to about a millionth.
TOLERANCE = 1e-5


def as_computed(
    batch: Batch,
    required: Sequence[bool],
    names: Sequence[str],
    model: Callable[[str], ObjectModel | None],
    chance: LiftChance | None,
) -> Iterator[Violation]:
    """A closed hand that may lift has the chance that follows from its contacts; others have none.

    Args:
        batch: Rows of `/trials`.
        required: Whether a grasp needs each fingertip on the object.
        names: Names of the objects, by row of `/objects`.
        model: Returns an object by its name, None where its file is broken.
        chance: The model of the hand, None if it has none.
    """
    # A hand that was never closed has no `time_close`.
    verdict = judge_closed(
        batch["closed_touching"],
        batch["closed_other_links"],
        batch["closed_hand_on_table"],
        required=required,
    )
    may_lift = np.isfinite(batch["time_close"]) & (verdict == Outcome.SUCCESS)

    expected = np.full(len(batch), np.nan)
    for index in np.unique(batch["object"][may_lift]).tolist() if chance is not None else ():
        rows = np.flatnonzero(may_lift & (batch["object"] == index))
        known = model(names[index])
        if known is None or chance is None:
            expected[rows] = batch["chance"][rows]  # a finding already
            continue
        closed = ClosedGrasp(
            **{name: batch[f"closed_{name}"][rows] for name in GRASP_CONTACTS},
            X_TO=batch.pose("X_TO")[rows],
            p_OOcm=known.p_OOcm,
            friction_hand=batch["friction_hand"][rows],
        )
        expected[rows] = chance.of(closed)
    yield from batch.broken(
        "chance must follow from the contacts after closing",
        ~np.isclose(batch["chance"], expected, rtol=0.0, atol=TOLERANCE, equal_nan=True),
        batch["chance"],
    )
