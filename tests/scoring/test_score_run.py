"""The path of a score with verdicts that a test states: card, cache, warnings, order of sets."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.datasets import OTM, OTO
from helpers.scores import FakeVerify

import drakegrasp as dg
from drakegrasp.dataset.manifest import installed_versions, read_manifest, write_manifest
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.errors import GraspError
from drakegrasp.foreign_files import read_json
from drakegrasp.scoring.card import card_text
from drakegrasp.scoring.run import VERDICTS, score
from drakegrasp.scoring.verdict import ranked_sets
from drakegrasp.verification.placing import dataset_config


def scored(data, /, given=(), *, tries=None, others=None, overridden=(), **changes):
    """Return the score of predictions beside two reference rows; own grasps hold."""
    name, ranked = ranked_sets(given, data)
    config = changes.get("config", dataset_config(data, overrides=("verify.max_tries=1",)))
    values: dict[str, Any] = {
        "data": data,
        "methods": {name: ranked, **(others or {})},
        "verify": tries or FakeVerify(is_own(data)),
        "train": GraspDataset(data.path, split="train"),
        "references": ("own", "constant"),
        "per_object": None,
        "config": config,
        "settings": {
            "config": config.to_dict(),
            "overridden": ["verify.max_tries", *overridden],
            "versions": installed_versions(config),
        },
        "again": "drakegrasp score",
    }
    return score(**(values | changes))


def is_own(data):
    own = data.column("grasps")
    return lambda grasp: bool((np.abs(own - grasp).max(axis=1) < 1e-6).any())


def test_predictions_stand_beside_reference_rows_on_the_same_rows(data):
    predicted = data.column("grasps").astype(float)
    predicted[::2] = np.nan
    card = scored(data, predicted).card
    assert list(card["sets"]) == ["predictions", "own", "constant"]
    assert {each["predictions"] for each in card["sets"].values()} == {len(data)}
    shares = {name: each["measures"]["headline"]["value"] for name, each in card["sets"].items()}
    assert shares["own"] == 1.0
    assert shares["constant"] == 0.0
    assert 0.0 < shares["predictions"] < 1.0
    assert card["above"]["predictions"]["own"]["value"] < 0.0
    assert card["warnings"][0].startswith("only 2 test objects")
    assert "clean" not in card["measures"] | card["sets"]["own"]["measures"]  # no neighbours


def test_an_interrupted_score_goes_on(data, tmp_path):
    """Also after a line that a crash cut off."""
    with pytest.raises(KeyboardInterrupt):
        scored(data, tries=FakeVerify(is_own(data), stop_after=3), folder=tmp_path)
    lines = (tmp_path / VERDICTS).read_bytes()
    (tmp_path / VERDICTS).write_bytes(lines[:-20])

    second = FakeVerify(is_own(data))
    card = scored(data, tries=second, folder=tmp_path).card
    assert second.asked == 2 * len(data) - 2
    third = FakeVerify(is_own(data))
    assert scored(data, tries=third, folder=tmp_path).card == card
    assert third.asked == 0
    assert card == scored(data).card


def other_friction(data):
    return {"config": dataset_config(data, overrides=("physics.friction_hand=0.5",))}


def same_friction_for_all_rows(data):
    return {"overridden": ["physics.friction_hand"]}


def other_camera(data):
    path = data.path.parent / OTM
    return {"data": GraspDataset(path, split="test"), "train": GraspDataset(path, split="train")}


@pytest.mark.parametrize("change", [other_friction, same_friction_for_all_rows, other_camera])
def test_verdicts_of_other_rules_are_not_taken(data, tmp_path, change):
    given, other = np.ones((len(data), 18)), FakeVerify(is_own(data))
    scored(data, given, references=(), folder=tmp_path)
    scored(data, given, references=(), **change(data), tries=other, folder=tmp_path)
    assert other.asked == len(data)


def test_some_rows_of_each_object_are_the_same_for_all_sets(data):
    card = scored(data, per_object=1).card
    assert card["rows"] == card["objects"] == 2
    assert f"2 of the {len(data)} rows of the split were scored" in card["warnings"]
    assert "of the split were scored" not in " ".join(scored(data).card["warnings"])


def test_files_of_several_training_seeds_are_one_set(data, tmp_path):
    grasps = data.column("grasps")
    np.save(tmp_path / "a.npy", grasps)
    np.save(tmp_path / "b.npy", np.zeros_like(grasps))
    paths = [tmp_path / "a.npy", tmp_path / "b.npy"]
    card = scored(data, paths).card
    assert card["headline"]["a.npy and 1 more"]["value"] == 0.5
    assert card["intervals"]["training_seeds"] == 2


def test_next_to_nothing_has_no_sign(data):
    card = scored(data, data.column("grasps")).card
    card["above"]["predictions"]["own"] = {"value": 0.1, "low": -0.001, "high": 0.2}
    assert "* predictions above own: 10 (0 to 20)\n" in card_text(card)


def test_another_method_stands_beside_the_predictions(data):
    """Of all seeds, on the same rows, and before the reference rows."""
    grasps, rest = data.column("grasps"), np.zeros((len(data), 18))
    other = ranked_sets(grasps, data)[1] + ranked_sets(rest, data)[1]
    card = scored(data, rest, others={"before": other}, per_object=1).card
    assert list(card["sets"]) == ["predictions", "before", "own", "constant"]
    assert card["sets"]["before"]["predictions"] == 2 * card["rows"] == 4
    assert card["above"]["predictions"]["before"]["value"] == -0.5
    assert card["headline"]["before"]["value"] == 0.5
    ours, theirs = card["above"]["predictions"]["before"], card["above"]["before"]["predictions"]
    assert (theirs["value"], theirs["low"]) == (0.5, 0.0)
    assert (theirs["low"], theirs["high"]) == (-ours["high"], -ours["low"])


def test_predictions_for_different_rows_are_refused(data):
    one = ranked_sets(data.column("grasps")[:1], data, rows=[0])[1]
    other = ranked_sets(data.column("grasps")[:1], data, rows=[1])[1]
    for methods in ({"a": one + other}, {"a": one, "b": other}):
        with pytest.raises(GraspError, match="must have predictions for the rows"):
            scored(data, methods=methods)


def test_a_method_that_the_card_could_not_tell_is_refused(data, tmp_path):
    files = [tmp_path / "net.npy", tmp_path / "older" / "net.npy"]
    files[1].parent.mkdir()
    for file in files:
        np.save(file, data.column("grasps"))
    for given, of in ((files[0], "net.npy"), ((), "no predictions")):
        with pytest.raises(GraspError, match=f"against must be .* has another name, got {of}"):
            dg.score(given, data, against=files[1])


def other_hand(data):
    grasps = np.zeros((2, 24))
    return {
        "train": SimpleNamespace(path=Path("four.hdf5"), camera="oto", column=lambda name: grasps)
    }


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda data: {"given": np.zeros((len(data), 12))},
            "must be 18 numbers .*, got an array of shape",
        ),
        (lambda data: {"given": None}, "predictions must be an array, a file or .*, got None"),
        (lambda data: {"references": ()}, "predictions or reference rows to score, got none"),
        (lambda data: {"per_object": 0}, "per_object must be 1 or more, got 0"),
        (lambda data: {"train": other_camera(data)["train"]}, "got otm, 18 numbers"),
        (other_hand, r"must be of the camera .* \(oto, 18 numbers\), got oto, 24 numbers"),
    ],
)
def test_what_cannot_be_scored_is_refused(data, change, message):
    with pytest.raises(GraspError, match=message):
        scored(data, **change(data))


def test_without_blind_rows_a_card_says_so(data):
    card = scored(data, references=("own",)).card
    assert any(warning.startswith("no reference row") for warning in card["warnings"])


TRAINED_ON = "2 test objects also in training, by name"


def test_objects_that_were_trained_on_are_a_warning(data, tmp_path):
    """Not those of equal names and other meshes; a file alone says nothing of meshes."""
    assert TRAINED_ON in scored(data, train=data).card["warnings"]
    assert not any("also in training" in warning for warning in scored(data).card["warnings"])
    out = tmp_path / "other"
    shutil.copytree(data.path.parent, out)
    manifest = read_manifest(out)
    changed = tuple(replace(each, mesh_sha256="0" * 64) for each in manifest.objects)
    write_manifest(replace(manifest, objects=changed), out)
    train = GraspDataset(out / OTO, split="test")
    warnings = scored(data, train=train).card["warnings"]
    assert not any("also in training" in warning for warning in warnings)
    (out / "manifest.json").unlink()
    assert TRAINED_ON in scored(data, train=train).card["warnings"]


def test_files_of_a_card_are_whole_and_come_again(data, tmp_path):
    predicted = np.repeat(data.column("grasps")[:, None], 5, axis=1).astype(float)
    predicted[:, 1:] = 0.0
    confidence = np.linspace(0.9, 0.1, 5 * len(data)).reshape(len(data), 5)
    _, ranked = ranked_sets(predicted, data, confidence=confidence)
    made = scored(data, methods={"net": ranked})
    paths = made.save(tmp_path)
    assert read_json(paths[0]) == made.card
    groups = made.card["sets"]["net"]["calibration"]
    assert sum(group["count"] for group in groups) == 5 * len(data)
    text = paths[1].read_text()
    assert "**net: 100 (no interval)** sample" in text
    assert "net, success@5" in text
    assert "confidence" in text
    picture = paths[2].read_bytes()
    assert picture.startswith(b"\x89PNG")
    assert made.save(tmp_path)[2].read_bytes() == picture


@pytest.mark.parametrize("where", ["client", "scheduler", "scheduler_file"])
def test_protocol_of_mujoco_runs_on_this_machine(data, where):
    pytest.importorskip("mujoco")
    with pytest.raises(dg.ConfigError, match=f"^{where} must be None with protocol dexgraspbench"):
        dg.score([], data, protocol="dexgraspbench", **{where: "tcp://x"})
