"""The verdict on an attempt: what follows from its contacts.

In: contacts of one attempt, or of many with leading axes. Out: values of `Outcome`. Trials and the
check of a dataset both decide by these two functions. Does not import Drake.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from drakegrasp.outcomes import Outcome

Outcomes = npt.NDArray[np.int64]


def judge_closed(
    touching: npt.ArrayLike, other_links: npt.ArrayLike, hand_on_table: npt.ArrayLike
) -> Outcomes:
    """Return the outcomes (...,) of closed hands: `SUCCESS` where the hand may lift.

    The first rule that applies decides.

    Args:
        touching: (..., k), whether each fingertip touches the object.
        other_links: (...,), number of other links of the hand that touch the object.
        hand_on_table: (...,), whether the hand touches the table.
    """
    touching = np.asarray(touching)
    return _first(
        (~touching.all(axis=-1), Outcome.MISSING_FINGERTIP),
        (np.asarray(other_links) > 0, Outcome.HAND_CONTACT),
        (hand_on_table, Outcome.TABLE_CONTACT),
    )


def judge_lifted(
    touching: npt.ArrayLike, other_links: npt.ArrayLike, object_on_table: npt.ArrayLike
) -> Outcomes:
    """Return the outcomes (...,) of attempts after the lift.

    The first rule that applies decides.

    Args:
        touching: (..., k), whether each fingertip touches the object.
        other_links: (...,), number of other links of the hand that touch the object.
        object_on_table: (...,), whether the object touches the table.
    """
    touching = np.asarray(touching)
    return _first(
        (~touching.any(axis=-1) & (np.asarray(other_links) == 0), Outcome.DROPPED),
        (~touching.all(axis=-1), Outcome.SLIPPED),
        (object_on_table, Outcome.TABLE_CONTACT),
    )


def _first(*rules: tuple[npt.ArrayLike, Outcome]) -> Outcomes:
    """Return the outcome of the first rule that applies, `SUCCESS` where none does."""
    conditions = [np.asarray(condition) for condition, _ in rules]
    values = [outcome.value for _, outcome in rules]
    return np.select(conditions, values, Outcome.SUCCESS.value)
