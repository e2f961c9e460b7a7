"""A configuration is complete when it is loaded: what it leaves open is the hand's own."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.hands import write_pincer

from drakegrasp.config import CarriedHand
from drakegrasp.errors import HandError
from drakegrasp.hand.settings import load_config, override_config


def test_stand_offs_and_spreads_are_the_hands_own_unless_they_are_set(tmp_path: Path) -> None:
    paper = load_config().candidates
    assert paper.standoffs == (0.06, 0.09, 0.12)
    assert paper.spreads_deg == (0.0, 11.25, 22.5)
    gripper = load_config(hand=str(write_pincer(tmp_path))).candidates
    assert (gripper.standoffs, gripper.spreads_deg) == ((0.03, 0.05), (0.0,))
    config = load_config(overrides=["candidates.standoffs=[0.01]"], hand="franka")
    assert config.candidates.standoffs == (0.01,)
    assert config.candidates.spreads_deg == (0.0,)


def test_null_is_the_hands_own() -> None:
    config = load_config("released")
    assert config.candidates.standoffs == (0.04, 0.07, 0.10)
    own = override_config(config, ["candidates.standoffs=null"])
    assert own.candidates.standoffs == load_config().candidates.standoffs


def test_null_is_that_of_the_hand_that_a_dataset_carries(tmp_path: Path) -> None:
    """Its name says where it lies in the dataset."""
    carried = CarriedHand(path=write_pincer(tmp_path), digest="")
    config = load_config().with_hand("hand/pincer_hand.yaml", carried)
    own = override_config(config, ["candidates.standoffs=null"])
    assert own.candidates.standoffs == (0.03, 0.05)
    assert own.hand_source == carried


def test_another_hand_brings_its_own_unless_they_are_overridden(tmp_path: Path) -> None:
    """Nothing of the first hand's is tried with the second."""
    config, path = load_config(), write_pincer(tmp_path)
    candidates = override_config(config, [f"hand={path}"]).candidates
    assert (candidates.standoffs, candidates.spreads_deg) == ((0.03, 0.05), (0.0,))
    changed = override_config(config, ["candidates.standoffs=[0.01]"], hand=str(path))
    assert changed.candidates.standoffs == (0.01,)
    assert changed.candidates.spreads_deg == (0.0,)


def test_hand_that_is_not_there_is_refused_where_it_is_needed() -> None:
    """A dataset's configuration has the numbers: it is read where the hand is not."""
    with pytest.raises(HandError, match=r"hand must be one of .*barrett.*, got 'no_hand'"):
        load_config(hand="no_hand")
    given = ["candidates.standoffs=[0.01]", "candidates.spreads_deg=[0]"]
    assert load_config(overrides=given, hand="no_hand").hand == "no_hand"


def test_file_of_a_hand_is_stored_as_an_absolute_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_pincer(tmp_path)
    monkeypatch.chdir(tmp_path)
    assert load_config(hand=path.name).hand == str(path)
    assert override_config(load_config(), [], hand=path.name).hand == str(path)
