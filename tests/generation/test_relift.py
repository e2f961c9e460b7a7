"""Stored attempts that are tried again: which are drawn, and what is told of them."""

from __future__ import annotations

import numpy as np
import pytest
import relift

from drakegrasp.dataset.trials import Trials
from drakegrasp.outcomes import Outcome


@pytest.mark.parametrize("kind", ["attempts", "lifts", "samples", "both"])
def test_drawn_rows_are_of_their_kind(sound, kind):
    trials = Trials(sound)
    samples = set(trials.where(kept=True).trial_ids.tolist())
    lifts = set(trials.trial_ids[np.isfinite(trials["time_lift"])].tolist())
    closed = set(trials.trial_ids[np.isfinite(trials["time_close"])].tolist())
    every = {"attempts": closed, "samples": samples}.get(kind, lifts)
    assert set(relift.chosen_rows(sound, kind, 1000, 0).tolist()) == every
    few = relift.chosen_rows(sound, kind, 2, 0).tolist()
    assert few == relift.chosen_rows(sound, kind, 2, 0).tolist()
    if kind == "both":
        assert len(set(few) & samples) == len(set(few) - samples) == 2
    else:
        assert len(few) == 2


def test_summary_counts_what_has_a_verdict():
    def row(change, outcome, kept, **more):
        told = {"change": change, "outcome": outcome.label, "kept": kept, "seconds": 1.0}
        return {**told, **more}

    rows = [
        [row("as stored", Outcome.SUCCESS, True), row("half step", Outcome.SLIPPED, False)],
        [row("as stored", Outcome.SUCCESS, False), row("half step", Outcome.TIMEOUT, False)],
    ]
    found = relift.summary(rows)
    assert found["as stored"]["lifted"][0] == 2 and found["as stored"]["kept"][0] == 1
    half = found["half step"]
    assert (half["tried"], half["with a verdict"], half["lifted"][0]) == (2, 1, 0)
    assert half["changed"] == {"success -> slipped": 1, "success -> timeout": 1}
