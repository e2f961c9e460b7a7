"""A judge gives the chances of proposals; the package's judge is for one hand."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import click
import grasp_choice
import numpy as np
import pytest
import trimesh

import drakegrasp as dg
from drakegrasp.scoring.judge import ARRAYS, fingerprint, judge_names, load_judge
from drakegrasp.scoring.ranking import measured
from drakegrasp.shapes.catalog import CLASSES, BuiltinObject

sys.path.append(str(Path(__file__).resolve().parents[2] / "pipelines" / "baseline"))
import train_judge

NAME = "barrett-1"


@pytest.fixture(scope="module")
def cloud():
    box = trimesh.creation.box([0.12, 0.05, 0.08])
    points = trimesh.sample.sample_surface(box, 1500, seed=0)[0] + np.array([0, 0, 0.04])
    return points[points @ [1, 1, 1] > 0.06]


@pytest.fixture(scope="module")
def grasps(cloud):
    return dg.propose(cloud).at(list(range(0, 40, 4)))


def write(path, *, hand="barrett"):
    """Write a judge with one feature."""
    arrays = {"mean": [0.0], "scale": [0.01], "weights": [[-2.0, -6.0]], "offset": [0.5, 0.1]}
    about = {"name": "toy", "hand": hand, "features": ["gap"]}
    about["fingerprint"] = fingerprint(dg.load_hand(hand))
    path.write_bytes(train_judge.packed({"about": json.dumps(about), **arrays}))
    return path


def test_chances_are_those_of_the_network_and_order_the_proposals(tmp_path, cloud, grasps):
    ranked = dg.rank(grasps, cloud, judge=write(tmp_path / "toy.npz"))
    gap = measured(grasps, cloud, dg.load_hand())["gap"]
    held, sample = 1 / (1 + np.exp(2 * gap / 0.01 - 0.5)), 1 / (1 + np.exp(6 * gap / 0.01 - 0.1))
    np.testing.assert_allclose(ranked.features["held"], held)
    np.testing.assert_allclose(ranked.score, sample)
    assert ranked.order.tolist() == np.argsort(-ranked.score, kind="stable").tolist()
    assert "held" not in dg.rank(grasps, cloud).features.names


def test_a_row_that_is_no_posture_is_last_for_a_judge_also(cloud, grasps):
    spoilt = grasps.refuse(["bad", *[""] * (len(grasps) - 1)])
    ranked = dg.rank(spoilt, cloud, judge=NAME)
    assert ranked.score[0] == -1.0
    assert ranked.order[-1] == 0


def test_the_judge_of_the_package_prefers_what_the_hand_can_close_on(cloud, grasps):
    judge = load_judge(NAME)
    assert judge_names() == [NAME]
    assert (judge.name, judge.about["hand"]) == (NAME, "barrett")
    assert judge.about["data_sha256"]
    above = grasps.X_FG[:1].copy()
    above[0, 2, 3] += 0.15  # too high to touch
    ranked = dg.rank(np.concatenate([above, grasps.X_FG[:1]]), cloud, judge=judge)
    assert ranked.order.tolist() == [1, 0]
    assert ranked.score[0] < 0.1
    assert ranked.score[1] > 0.3


def test_an_unknown_judge_is_refused(cloud, grasps):
    with pytest.raises(dg.GraspError, match=f"judge must be one of {NAME}, or a file, got 'b'"):
        dg.rank(grasps, cloud, judge="b")


def spoil(path, about=None, **arrays):
    """Write a judge again with other content."""
    with np.load(path) as file:
        known = {name: file[name] for name in ARRAYS}
        said = json.loads(str(file["about"]))
    said = {key: value for key, value in (said | (about or {})).items() if value is not None}
    path.write_bytes(train_judge.packed({"about": json.dumps(said), **known, **arrays}))


@pytest.mark.parametrize("damage", ["text", "truncated", "array"])
def test_a_file_that_is_no_judge_is_refused(tmp_path, damage):
    path = write(tmp_path / "toy.npz")
    if damage == "text":
        path.write_text("judge")
    elif damage == "truncated":
        path.write_bytes(path.read_bytes()[:-40])
    else:
        with path.open("wb") as file:
            np.save(file, np.zeros(3))
    with pytest.raises(dg.GraspError, match="must be the file of a judge"):
        load_judge(path)


@pytest.mark.parametrize(
    ("spoilt", "said"),
    [
        ({"about": {"features": ["gap", "push"]}}, "its mean must be finite numbers of shape"),
        ({"about": {"fingerprint": None}}, "its fingerprint is None"),
        ({"about": {"features": None}}, "its features must be a list of names"),
        ({"about": {"features": 7}}, "its features must be a list of names"),
        ({"about": {"features": "gap"}}, "its features must be a list of names"),
        ({"about": {"features": [["gap"]]}}, "its features must be a list of names"),
        ({"about": {"hand": 7}}, "its hand is 7"),
        ({"about": {"hand": "../secret"}}, "its hand is '../secret'"),
        ({"about": {"name": "a\nb"}}, "its name is "),
        ({"mean": [1j]}, "Cannot cast"),
        ({"offset": [0.0, 0.0, 0.0]}, "its offset must be finite numbers of shape"),
        ({"weights": [[np.nan, 0.0]]}, "its weights must be finite numbers"),
        ({"scale": [0.0]}, "its scale must be positive"),
    ],
)
def test_a_judge_that_is_spoilt_says_what_is_wrong(tmp_path, spoilt, said):
    path = write(tmp_path / "toy.npz")
    spoil(path, **spoilt)
    with pytest.raises(dg.GraspError, match=f"must be the file of a judge .*{said}"):
        load_judge(path)


def test_a_small_file_that_unpacks_to_a_large_one_is_refused(tmp_path):
    path = tmp_path / "toy.npz"
    np.savez_compressed(path, mean=np.zeros(3_000_000))
    with pytest.raises(dg.GraspError, match="arrays of 24,000,128 byte, more than 16,000,000"):
        load_judge(path)


def test_a_network_is_for_a_hand_of_the_package_or_a_plugin(tmp_path, monkeypatch):
    """The name of another file is no hand, and the text of the file is not printed."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "secret").write_text("my password")
    path = write(tmp_path / "toy.npz")
    spoil(path, about={"hand": "secret"})
    with pytest.raises(dg.GraspError, match=r"must be for a hand of .*barrett.*, got 'secret'$"):
        dg.load_network(path)


def test_a_feature_that_nobody_measures_is_refused(tmp_path, cloud, grasps):
    path = write(tmp_path / "toy.npz")
    spoil(path, about={"features": ["colour"]})
    with pytest.raises(dg.GraspError, match="must use features of this version, got colour"):
        dg.rank(grasps, cloud, judge=path)


@pytest.mark.parametrize("judge", [None, NAME])
def test_nothing_to_rank_is_ranked(cloud, grasps, judge):
    none = dg.rank(np.zeros((0, 4, 4)), cloud, judge=judge)
    assert none.score.shape == none.order.shape == (0,)
    bad = dg.rank(grasps.refuse(["bad"] * len(grasps)), cloud, judge=judge)
    assert (bad.score == -1.0).all()
    assert bad.order.tolist() == list(range(len(grasps)))
    assert np.isnan(bad.features["touch"]).all()


@pytest.mark.parametrize("change", ["required", "pad", "torque"])
def test_a_hand_with_other_fingers_is_another_hand(change):
    hand = dg.load_hand()
    changed = {
        "required": {"required": False},
        "pad": {"pad_region": hand.fingers[0].pad_region[1:]},
        "torque": {"torque_limit": 0.2},
    }[change]
    other = replace(hand, fingers=(replace(hand.fingers[0], **changed), *hand.fingers[1:]))
    assert fingerprint(other) != fingerprint(hand)
    assert fingerprint(replace(hand, preshape_names=("pinch",))) != fingerprint(hand)


def test_a_judge_is_refused_for_another_hand(tmp_path, cloud):
    with pytest.raises(dg.HandError, match=f"must be barrett for the judge {NAME}.*got franka"):
        dg.rank(dg.propose(cloud, "franka"), cloud, "franka", judge=NAME)


def test_training_gives_the_same_bytes_and_learns(tmp_path, cloud):
    # A grasp holds if its palm is low; heights differ between objects.
    items = [BuiltinObject(object_class=each, index=1) for each in CLASSES[:4]]
    found = dg.propose(cloud)
    for k, item in enumerate(items):
        rows = found.at(list(range(k, len(found), 8)))
        low = rows.X_FG[:, 2, 3] < np.median(rows.X_FG[:, 2, 3])
        arrays = {
            "cloud": cloud,
            "X_TG": rows.X_FG,
            "q_grasp": rows.q_grasp,
            "q_pregrasp": rows.q_pregrasp,
            "ends": np.column_stack([low, low, ~low]),
        }
        (tmp_path / f"{item.name}.npz").write_bytes(train_judge.packed(arrays))
    files = [train_judge.learn(tmp_path, items, "toy") for _ in range(2)]
    assert files[0] == files[1]
    (tmp_path / "toy.npz").write_bytes(files[0])
    ranked = dg.rank(found, cloud, judge=tmp_path / "toy.npz")
    heights = found.X_FG[ranked.order, 2, 3]
    assert heights[:5].max() < heights[-5:].min()


def test_data_of_other_settings_are_refused(tmp_path, monkeypatch):
    for _ in range(2):
        train_judge.claim(tmp_path / "data", lifts=3)
    with pytest.raises(
        click.ClickException, match=r"must have data of .*'lifts': 4.*got .*'lifts': 3"
    ):
        train_judge.claim(tmp_path / "data", lifts=4)
    monkeypatch.setattr(train_judge, "HAND", "franka")
    with pytest.raises(click.ClickException, match=r"franka.*got .*barrett"):
        train_judge.claim(tmp_path / "data", lifts=3)
    (tmp_path / "data" / "settings.json").rename(tmp_path / "data" / "1_mug_1.npz")
    with pytest.raises(click.ClickException, match="got None"):
        train_judge.claim(tmp_path / "data", lifts=3)


def test_an_object_of_the_data_is_placed_for_the_hand_of_the_judge(monkeypatch):
    monkeypatch.setattr(train_judge, "HAND", "franka")
    placed = train_judge.placed_object(BuiltinObject(object_class=CLASSES[0], index=1))
    assert placed.config.hand == "franka"


def test_results_of_other_settings_are_refused(tmp_path):
    path, row = tmp_path / "results.jsonl", {"name": "1_mug_1"}
    assert grasp_choice.stored(path, {"lifts": 3}) == {}
    with path.open("a") as file:
        file.write(json.dumps(row) + "\n")
    assert grasp_choice.stored(path, {"lifts": 3}) == {"1_mug_1": row}
    with pytest.raises(click.ClickException, match=r"must be of the settings .*4.*got .*3"):
        grasp_choice.stored(path, {"lifts": 4})
    path.write_text(json.dumps(row) + "\n")
    with pytest.raises(click.ClickException, match="got None"):
        grasp_choice.stored(path, {"lifts": 3})
