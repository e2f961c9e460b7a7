"""The verdict's rules, one attempt at a time and many at once."""

from __future__ import annotations

import numpy as np
import pytest

from drakegrasp.config import CloseConfig
from drakegrasp.hand.settings import load_config
from drakegrasp.outcomes import Outcome
from drakegrasp.simulation.verdict import (
    STABLE_SLIP,
    STABLE_TURN,
    is_lost_sample,
    is_precision,
    is_stable,
    judge_closed,
    judge_lifted,
    scrapes,
)

ALL, ONE_OFF, NONE = [True, True, True], [True, False, True], [False, False, False]


@pytest.mark.parametrize(
    ("judge", "touching", "other_links", "on_table", "outcome"),
    [
        (judge_closed, ALL, 0, False, Outcome.SUCCESS),
        (judge_closed, ONE_OFF, 0, False, Outcome.MISSING_FINGERTIP),
        (judge_closed, NONE, 0, False, Outcome.MISSING_FINGERTIP),
        (judge_closed, ALL, 1, False, Outcome.HAND_CONTACT),
        (judge_closed, ALL, 0, True, Outcome.TABLE_CONTACT),
        (judge_closed, ONE_OFF, 1, True, Outcome.MISSING_FINGERTIP),
        (judge_closed, ALL, 1, True, Outcome.HAND_CONTACT),
        (judge_lifted, ALL, 0, False, Outcome.SUCCESS),
        # The palm may touch a lifted object that the fingertips hold.
        (judge_lifted, ALL, 1, False, Outcome.SUCCESS),
        (judge_lifted, ONE_OFF, 0, False, Outcome.PARTLY_HELD),
        (judge_lifted, ONE_OFF, 1, False, Outcome.PARTLY_HELD),
        # No finger holds what lies on the palm.
        (judge_lifted, NONE, 1, False, Outcome.SLIPPED),
        (judge_lifted, NONE, 0, False, Outcome.DROPPED),
        (judge_lifted, ALL, 0, True, Outcome.TABLE_CONTACT),
        (judge_lifted, NONE, 0, True, Outcome.DROPPED),
        (judge_lifted, ONE_OFF, 0, True, Outcome.SLIPPED),
    ],
)
def test_first_rule_that_applies_decides(judge, touching, other_links, on_table, outcome) -> None:
    """Only fingertips may touch what a closed hand lifts; all hold it in the end, off the table."""
    assert judge(touching, other_links, on_table) == outcome


@pytest.mark.parametrize(
    ("outcome", "other_links", "slip", "turn", "precision", "stable"),
    [
        (Outcome.SUCCESS, 0, 0.0, 0.0, True, True),
        (Outcome.SUCCESS, 0, 4.9e-3, np.deg2rad(4.9), True, True),
        # The limits themselves are beyond.
        (Outcome.SUCCESS, 0, 5e-3, 0.0, True, False),
        (Outcome.SUCCESS, 0, 0.0, STABLE_TURN, True, False),
        # On the palm nothing is stable.
        (Outcome.SUCCESS, 1, 0.0, 0.0, False, False),
        (Outcome.SLIPPED, 0, 0.0, 0.0, False, False),
        # Before the lift the motion is NaN.
        (Outcome.MISSING_FINGERTIP, 0, np.nan, np.nan, False, False),
    ],
)
def test_stable_is_a_precision_grasp_that_stays(
    outcome: Outcome,
    other_links: int,
    slip: float,
    turn: float,
    precision: bool,
    stable: bool,
) -> None:
    assert is_precision(outcome, other_links) == precision
    assert is_stable(outcome, other_links, slip, turn) == stable
    assert STABLE_SLIP == 5e-3


@pytest.mark.parametrize(
    ("slip", "turn", "lost"),
    [
        (0.02, np.deg2rad(30.0), False),
        (np.nextafter(0.02, 1.0), 0.0, True),
        (0.0, np.deg2rad(30.000001), True),
    ],
)
def test_sample_is_lost_beyond_either_limit_where_that_ends_lifts(
    slip: float, turn: float, lost: bool
) -> None:
    """At the limit itself a filter with the same limit keeps it."""
    limits = ["lift.stop_slip=0.02", "lift.stop_turn_deg=30"]
    for stop, ends in (("lost_sample", lost), ("never", False)):
        rules = load_config(overrides=[*limits, f"lift.stop_when={stop}"]).lift
        assert is_lost_sample(slip, turn, rules) == ends


def test_hand_that_scraped_the_table_is_refused_last() -> None:
    """Where nothing else refuses it; one that was not measured is not refused."""
    rules = CloseConfig(scrape_depth=5e-4)
    scraped = scrapes([-6e-4, -5e-4, np.nan, -6e-4], rules)
    assert scraped.tolist() == [True, False, False, True]
    assert not scrapes(-1.0, CloseConfig(scrape_depth=None))
    touching = np.array([ALL, ALL, ALL, [True, False, True]])
    none = np.zeros(4, dtype=bool)
    ends = (Outcome.TABLE_CONTACT, Outcome.SUCCESS, Outcome.SUCCESS)
    closed = judge_closed(touching, none, none, scraped=scraped)
    assert closed.tolist() == [*ends, Outcome.MISSING_FINGERTIP]
    lifted = judge_lifted(touching, none, none, scraped=scraped)
    assert lifted.tolist() == [*ends, Outcome.PARTLY_HELD]
