"""The rules of the verdict: which one decides, and their limits."""

from __future__ import annotations

import numpy as np
import pytest

from drakegrasp.config import CloseConfig
from drakegrasp.hand.settings import load_config
from drakegrasp.outcomes import Outcome
from drakegrasp.simulation.contacts import scrapes
from drakegrasp.simulation.lift import is_lost_sample
from drakegrasp.simulation.trial import judge_closed, judge_lifted

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
    assert judge(touching, other_links, on_table) is outcome


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


@pytest.mark.parametrize(
    ("clearance", "depth", "scraped"),
    [(-6e-4, 5e-4, True), (-5e-4, 5e-4, False), (np.nan, 5e-4, False), (-1.0, None, False)],
)
def test_hand_that_scraped_the_table_is_refused_last(clearance, depth, scraped) -> None:
    """Where nothing else refuses it; one that was not measured is not refused."""
    assert scrapes(clearance, CloseConfig(scrape_depth=depth)) == scraped
    due = Outcome.TABLE_CONTACT if scraped else Outcome.SUCCESS
    assert judge_closed(ALL, 0, False, scraped=scraped) is due
    assert judge_lifted(ALL, 0, False, scraped=scraped) is due
    assert judge_closed(ONE_OFF, 0, False, scraped=scraped) is Outcome.MISSING_FINGERTIP
    assert judge_lifted(ONE_OFF, 0, False, scraped=scraped) is Outcome.PARTLY_HELD
