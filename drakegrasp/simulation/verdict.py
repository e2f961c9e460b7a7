"""The verdict on an attempt: what follows from its contacts, and how well it holds.

Input: contacts of one attempt, or of many with leading axes. Output: values of `Outcome`, and
whether a grasp is a precision grasp and a stable grasp. Trials, builds and the check of a dataset
all use these functions. Does not import Drake.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from drakegrasp.config import CloseConfig, LiftConfig
from drakegrasp.outcomes import Outcome

Outcomes = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

#: In a stable grasp, the object moves and turns in the hand by less than this [m], [rad]; own
#: choice.
STABLE_SLIP, STABLE_TURN = 5e-3, float(np.deg2rad(5.0))


def judge_closed(
    touching: npt.ArrayLike,
    other_links: npt.ArrayLike,
    hand_on_table: npt.ArrayLike,
    *,
    required: npt.ArrayLike = True,
    scraped: npt.ArrayLike = False,
) -> Outcomes:
    """Return the outcomes (...,) of closed hands: `SUCCESS` if the hand may lift.

    The first rule that applies decides.

    Args:
        touching: (..., k), whether each fingertip touches the object.
        other_links: (...,), number of other links of the hand that touch the object.
        hand_on_table: (...,), whether the hand touches the table.
        required: (k,), whether each fingertip must touch the object; one value applies to all.
        scraped: (...,), whether the hand was too far below the table's top, see `scrapes`.
    """
    return _first(
        (_misses(touching, required), Outcome.MISSING_FINGERTIP),
        (np.asarray(other_links) > 0, Outcome.HAND_CONTACT),
        (np.asarray(hand_on_table) | np.asarray(scraped), Outcome.TABLE_CONTACT),
    )


def judge_lifted(
    touching: npt.ArrayLike,
    other_links: npt.ArrayLike,
    object_on_table: npt.ArrayLike,
    *,
    required: npt.ArrayLike = True,
    scraped: npt.ArrayLike = False,
) -> Outcomes:
    """Return the outcomes (...,) of attempts after the lift.

    The first rule that applies decides.

    Args:
        touching: (..., k), whether each fingertip touches the object.
        other_links: (...,), number of other links of the hand that touch the object.
        object_on_table: (...,), whether the object touches the table.
        required: (k,), whether each fingertip must touch the object; one value applies to all.
        scraped: (...,), whether the hand was too far below the table's top, see `scrapes`.
    """
    touching = np.asarray(touching)
    some, misses = touching.any(axis=-1), _misses(touching, required)
    return _first(
        (~some & (np.asarray(other_links) == 0), Outcome.DROPPED),
        (misses & some & ~np.asarray(object_on_table), Outcome.PARTLY_HELD),
        (misses, Outcome.SLIPPED),
        (np.asarray(object_on_table) | np.asarray(scraped), Outcome.TABLE_CONTACT),
    )


def scrapes(clearance: npt.ArrayLike, rules: CloseConfig) -> Flags:
    """Return (...,) whether a hand was too far below the table's top on its way.

    Args:
        clearance: (...,), smallest height of the hand above the top [m]; NaN if not measured.
        rules: The largest allowed depth.
    """
    depth = np.inf if rules.scrape_depth is None else rules.scrape_depth
    return np.asarray(np.asarray(clearance) < -depth)


def is_lost_sample(slip: npt.ArrayLike, turn: npt.ArrayLike, rules: LiftConfig) -> Flags:
    """Return (...,) whether a lift ends at a check because the grasp can no longer be a sample.

    Args:
        slip: (...,), distance that the object has moved in the hand since it is free [m].
        turn: (...,), angle that the object has turned in the hand [rad].
        rules: When lifts end.
    """
    too_far = (np.asarray(slip) > rules.stop_slip) | (np.degrees(turn) > rules.stop_turn_deg)
    return np.asarray((rules.stop_when == "lost_sample") & too_far)


def is_precision(outcome: npt.ArrayLike, other_links: npt.ArrayLike) -> Flags:
    """Return (...,) whether only the fingertips hold the object.

    Args:
        outcome: (...,), values of `Outcome`.
        other_links: (...,), number of other links of the hand that touch the object after the lift.
    """
    return np.asarray(
        (np.asarray(outcome) == Outcome.SUCCESS.value) & (np.asarray(other_links) == 0)
    )


def is_stable(
    outcome: npt.ArrayLike,
    other_links: npt.ArrayLike,
    slip: npt.ArrayLike,
    turn: npt.ArrayLike,
) -> Flags:
    """Return (...,) whether a grasp is a precision grasp in which the object hardly moves.

    Args:
        outcome: (...,), values of `Outcome`.
        other_links: (...,), number of other links of the hand that touch the object after the lift.
        slip: (...,), distance that the object moved in the hand during the lift [m].
        turn: (...,), angle that the object turned in the hand [rad].
    """
    still = (np.asarray(slip) < STABLE_SLIP) & (np.asarray(turn) < STABLE_TURN)
    return is_precision(outcome, other_links) & still


def _misses(touching: npt.ArrayLike, required: npt.ArrayLike) -> Flags:
    """Return (...,) whether a required fingertip does not touch, from (..., k)."""
    return np.asarray((~np.asarray(touching) & np.asarray(required)).any(axis=-1))


def _first(*rules: tuple[npt.ArrayLike, Outcome]) -> Outcomes:
    """Return the outcome of the first rule that applies, `SUCCESS` if none applies."""
    conditions = [np.asarray(condition) for condition, _ in rules]
    values = [outcome.value for _, outcome in rules]
    return np.select(conditions, values, Outcome.SUCCESS.value)
