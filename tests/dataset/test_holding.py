"""How much grasps bear: shares with intervals, and what is said of them where they are shown."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np
import pytest
from click.testing import CliRunner
from helpers.datasets import TRIALS, change, make_dataset, must_find, must_find_without_shards

from drakegrasp.cli.main import main
from drakegrasp.dataset.quality import (
    PREDICTED_BY,
    area_under_roc,
    bearing,
    holding_of,
    predictors,
    share_text,
)
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.dataset.schema import HOLD_FIELDS
from drakegrasp.dataset.trials import Trials
from drakegrasp.outcomes import Outcome


def test_files_of_certified_builds_alone_have_the_columns(out: Path, tmp_path: Path) -> None:
    plain = make_dataset(tmp_path / "plain", tmp_path)
    for path, there in ((out, True), (plain, False)):
        with h5py.File(path / TRIALS) as trials, h5py.File(path / "grasping_oto.hdf5") as data:
            for field in HOLD_FIELDS:
                assert (field.name in trials["trials"]) is there
                assert (f"grasp_props/{field.name}" in data["train"]) is there
        samples = GraspDataset(path / "grasping_oto.hdf5")
        assert samples[0].grasp_props["p_hold_repeats"] == (4 if there else 0)
        must_find(path)


def test_repeats_are_checked(out: Path) -> None:
    wrong = {
        (0, "repeats"): (2, "p_hold_held must be at most p_hold_repeats"),
        (3, "repeats"): (9, "p_hold_repeats must be at most"),
        (12, "probability"): (1.5, "p_hold_probability must be above 0..1"),
        (15, "half_step"): (0.5, "p_hold_half_step must be 0, 1 or NaN"),
        (24, "held"): (2, "p_hold_samples must be at most p_hold_held"),
    }
    for (row, column), (value, _) in wrong.items():
        change(out, TRIALS, f"trials/p_hold_{column}", row, lambda _, value=value: value)
    found = [(TRIALS, "/trials", row, what) for (row, _), (_, what) in wrong.items()]
    must_find_without_shards(out, *found)


def columns_of(*rows: tuple[int, int, int, float]) -> dict[str, np.ndarray]:
    names = ("samples", "held", "repeats", "probability")
    return {f"p_hold_{n}": np.array(v) for n, v in zip(names, zip(*rows, strict=True), strict=True)}


def test_a_grasp_counts_for_the_inverse_of_its_probability() -> None:
    found = bearing(columns_of((4, 4, 4, 0.25), (0, 2, 4, 1.0), (0, 0, 0, np.nan)))
    assert found is not None
    assert (found.drawn, found.much) == (2, 1)
    assert (found.samples, found.held) == pytest.approx((0.8, 0.9))
    # Two grasps, of which one counts four times, tell no more than 25 / 17 of one.
    assert found.low < 0.3
    assert found.high > 0.97
    assert bearing(columns_of((0, 0, 0, np.nan))) is None


def test_area_is_the_share_of_pairs_in_order() -> None:
    positive = np.array([True, True, False, False, False])
    assert area_under_roc(np.array([2.0, 5.0, 1.0, 2.0, 3.0]), positive) == pytest.approx(4.5 / 6)
    assert area_under_roc(np.array([2.0, 5.0, 1.0, np.nan, 3.0]), positive) == 0.75
    assert np.isnan(area_under_roc(np.ones(2), np.array([True, True])))


def test_margin_of_a_force_on_the_cone_is_zero_and_of_one_along_the_normal_one(out: Path) -> None:
    columns = Trials(out).where(outcome=Outcome.SUCCESS)[:3].columns(PREDICTED_BY)
    normals, friction = columns["lifted_nhat_Q_O"], columns["friction_hand"]
    across = np.roll(normals, 1, axis=2)
    for slope, margin in ((0.0, 1.0), (1.0, 0.0), (0.5, 0.5)):
        columns["lifted_f_Q_O"] = slope * friction[:, None, None] * across - normals
        found = predictors(columns)["least margin to the friction cone"]
        assert found == pytest.approx(np.full(3, margin))


def test_interval_stands_beside_k_of_n_and_the_predictor_beside_p_hold(out: Path) -> None:
    assert share_text(3, 4) == "3 of 4 (30 to 95 %)"
    change(out, TRIALS, "trials/p_hold_samples", 0, lambda _: 0)
    holding = holding_of(Trials(out))
    assert holding is not None
    assert set(holding.groups) == {"samples", "others"}
    assert holding.groups["others"].samples == 0.0
    assert holding.predictor is not None
    said = CliRunner().invoke(main, ["stats", str(out)]).output
    assert "% of the disturbed repeats would be samples (" in said
    assert f"ranks these samples best (AUC {holding.predictor[1]:.2f})" in said
    card = json.loads((out / "DATACARD.json").read_text(encoding="utf-8"))
    assert card["p_hold"]["groups"]["samples"]["drawn"] == 9
    text = (out / "DATACARD.md").read_text(encoding="utf-8")
    assert "## How much disturbance a grasp tolerates" in text
