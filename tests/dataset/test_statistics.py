"""Counts of a dataset, finished and not."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.datasets import SLIPPED, SUCCESS, TRIALS, change, make_dataset

from drakegrasp.dataset.filters import Removal
from drakegrasp.dataset.statistics import count_funnel, count_unfinished
from drakegrasp.outcomes import Outcome


@pytest.fixture
def out(tmp_path: Path) -> Path:
    (tmp_path / "meshes").mkdir()
    return make_dataset(tmp_path / "out", tmp_path / "meshes")


def test_words_are_counted_by_object(out: Path) -> None:
    """Of the nine successes two of the first object lose a word; a lost lift never has one."""
    change(out, TRIALS, "trials/stable", SUCCESS, lambda _: False)
    change(out, TRIALS, "trials/precision", SUCCESS, lambda _: False)
    change(out, TRIALS, "trials/stable", 3, lambda _: False)
    funnel = count_funnel(out)
    assert funnel.outcomes[:, Outcome.SUCCESS].tolist() == [3, 3, 3]
    assert funnel.precision.tolist() == [2, 3, 3]
    assert funnel.stable.tolist() == [1, 3, 3]
    assert SLIPPED not in (SUCCESS, 3)


def test_words_of_a_build_that_runs_are_those_of_its_shards(out: Path) -> None:
    """The second shard of an object has one of its successes."""
    (out / TRIALS).unlink()
    (out / "shards/2_box_b/0000002-0000004.h5").unlink()
    unfinished = count_unfinished(out)
    assert unfinished is not None
    assert unfinished.funnel.precision.tolist() == [3, 2, 3]
    assert unfinished.funnel.stable.tolist() == [3, 2, 3]
    assert not unfinished.funnel.removals[:, Removal.KEPT].any()
