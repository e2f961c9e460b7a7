"""SceneDataset: what an item holds lies on what the camera sees, and what is drawn is as asked."""

from __future__ import annotations

import multiprocessing
import pickle
import shutil
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from helpers.datasets import REPEATED, make_dataset

from drakegrasp.dataset.scenes import SceneDataset, count_scenes
from drakegrasp.errors import DataError
from drakegrasp.frames import invert_pose, rotate_vectors, transform_points
from drakegrasp.generation.scenes import make_scenes

pytestmark = pytest.mark.sim


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out, meshes = tmp_path_factory.mktemp("scenes") / "out", tmp_path_factory.mktemp("meshes")
    make_dataset(out, meshes, overrides=[*REPEATED, "split.by=class"])
    make_scenes(out)
    return out / "scenes.hdf5"


def same(a: dict[str, Any], b: dict[str, Any]) -> bool:
    return a.keys() == b.keys() and all(np.array_equal(a[k], b[k], equal_nan=True) for k in a)


@pytest.mark.parametrize("frame", ["table", "camera"])
def test_points_lie_on_object_and_table(path: Path, frame: Any) -> None:
    data = SceneDataset(path, points=512, frame=frame)
    item = data[3]
    X_TA = item["X_TC"].astype(float) if frame == "camera" else np.eye(4)
    p_TP = transform_points(X_TA, item["points"])
    assert np.abs(p_TP[~item["on_object"], 2]).max() < 3e-4
    assert 0.7 < item["on_object"].mean() < 0.8

    # The object is a box, whose surface points are in its own frame.
    X_OA = invert_pose(item["X_AO"])
    own, _ = data.surface(int(item["object"]))
    half = np.abs(own).max(axis=0)
    p_OP = transform_points(X_OA, item["points"][item["on_object"]])
    outside = np.abs(np.abs(p_OP) - half).min(axis=1)
    assert outside.max() < 5e-4 and (np.abs(p_OP) < half + 5e-4).all()
    # Contacts of the dataset are on the box, too.
    touching = np.isfinite(item["p_AQ"]).all(axis=2)
    p_OQ = transform_points(X_OA, item["p_AQ"][touching])
    assert np.abs(np.abs(p_OQ) - half).min(axis=1).max() < 1e-3
    # They press against the sides of the box, also those of the lifted hand.
    for lifted in ("", "_lifted"):
        there = np.isfinite(item[f"p_AQ{lifted}"]).all(axis=2)
        n, f = (item[f"{key}{lifted}"][there] for key in ("nhat_Q_A", "f_Q_A"))
        along = np.abs(rotate_vectors(X_OA, n)).max(axis=1)
        np.testing.assert_allclose(along, 1.0, atol=1e-5)
        np.testing.assert_allclose(f, -np.linalg.norm(f, axis=1, keepdims=True) * n, atol=1e-3)


def test_good_and_bad_grasps_come_in_turns(path: Path) -> None:
    data = SceneDataset(path, points=16, grasps=6, split="test")
    for item in data:
        assert item["kept"].tolist() == [True, False] * 3
        assert item["tested"].all() and not item["lifted"][1::2].any()
    assert all(item["kept"].all() for item in SceneDataset(path, points=16, negatives="none"))
    closed = SceneDataset(path, points=16, grasps=64, negatives="closed")[0]
    assert not closed["tested"].all() and closed["lifted"][::2].all()


def test_objects_come_as_often_as_each_other(path: Path) -> None:
    data = SceneDataset(path, points=16, split="test")
    assert len(data) == 10
    assert sorted(np.unique([int(i["object"]) for i in data], return_counts=True)[1]) == [5, 5]
    # Each view once, in an order that the epoch changes.
    views = [int(item["view"]) for item in data]
    data.epoch = 1
    again = [int(item["view"]) for item in data]
    assert sorted(views) == sorted(again) == data.views.tolist() and views != again


def test_items_are_of_the_objects_that_are_named(path: Path) -> None:
    every = SceneDataset(path, points=16, split="test")
    row = int(every[0]["object"])
    name = every.names[row]
    for balance in ("object", "view"):
        some = SceneDataset(path, points=16, split="test", objects=[name], balance=balance)
        assert len(some) == 5 and {int(item["object"]) for item in some} == {row}
    with pytest.raises(DataError, match=r"objects must be of .*, got 'unicorn'"):
        SceneDataset(path, objects=[name, "unicorn"])


def test_each_round_draws_anew_and_says_its_epoch(path: Path) -> None:
    data = SceneDataset(path, points=16, split="test")
    rounds = data.rounds()
    first, second = list(rounds), list(rounds)
    assert sorted(first) == [(0, i) for i in range(10)] and sorted(second)[0] == (1, 0)
    assert [i for _, i in first] != [i for _, i in second]
    zero, one = data[0, 3], data[1, 3]
    data.epoch = 1
    assert same(data[3], one) and not same(one, zero)


def test_images_are_those_of_the_file(path: Path) -> None:
    item = SceneDataset(path, points=None)[0]
    assert item["rgb"].shape == (240, 320, 3) and item["rgb"].dtype == np.uint8
    assert item["depth"].dtype == np.float32 and 0.3 < item["depth"][item["mask"] > 0].min() < 1.0
    v, u = np.nonzero(item["mask"])
    centre = np.array([u.mean(), v.mean(), 1.0]) * item["depth"][item["mask"] > 0].mean()
    p_TP = transform_points(item["X_TC"], (np.linalg.inv(item["K"]) @ centre)[None])[0]
    assert np.linalg.norm(p_TP - item["X_AO"][:3, 3]) < 0.06


def _item(data: SceneDataset) -> dict[str, Any]:
    return data[1]


@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_other_processes_read_the_same(path: Path, method: str) -> None:
    data = SceneDataset(path, points=32)
    first = data[1]
    assert same(pickle.loads(pickle.dumps(data))[1], first)
    with multiprocessing.get_context(method).Pool(1) as pool:
        assert same(pool.apply(_item, (data,)), first)


def test_a_cache_that_is_full_changes_nothing(path: Path) -> None:
    small, large = SceneDataset(path, points=32, cache=0), SceneDataset(path, points=32)
    assert same(small[2], large[2]) and same(small[2], large[2])
    assert not small._pools and len(large._pools) == 1


def test_another_file_and_unknown_arguments_are_refused(path: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copy(path, tmp_path))
    data = SceneDataset(copy, points=32)
    data[0]
    copy.write_bytes(path.read_bytes())
    with pytest.raises(DataError, match="must stay while it is read"):
        data[1]
    with h5py.File(copy, "r+") as file:
        file["views/scene"][0] = 99
    with pytest.raises(DataError, match=r"/views/scene must be 0 to 2, got 99 in row 0"):
        SceneDataset(copy, points=32)
    with pytest.raises(DataError, match="frame must be one of table, camera, got 'palm'"):
        SceneDataset(path, frame="palm")  # type: ignore[arg-type]


def test_split_without_grasps_has_length_0(path: Path) -> None:
    data = SceneDataset(path, split="valid")
    assert len(data) == 0 and list(data) == [] and list(data.rounds()) == []
    with pytest.raises(IndexError, match=r"^split valid is empty; not empty: train, test$"):
        data[0]


# Scenes of several objects: an item tells which grasp is on which object


@pytest.fixture(scope="module")
def clutter(small_clutter: Path) -> Path:
    return small_clutter / "clutter.hdf5"


@pytest.mark.parametrize("frame", ["table", "camera"])
def test_grasps_and_points_are_on_the_objects_of_the_scene(clutter: Path, frame: str) -> None:
    data = SceneDataset(clutter, points=256, split="test", grasps=16, frame=frame)
    item = data[0]
    assert item["X_AO"].shape == (2, 4, 4) and item["mass"].shape == item["object"].shape == (2,)
    assert item["on_object"].any() and not item["on_object"].all()
    surfaces = [
        transform_points(X_AO, data.surface(int(row))[0])
        for X_AO, row in zip(item["X_AO"], item["object"], strict=True)
    ]
    touched = np.isfinite(item["p_AQ"]).all(axis=2)
    for p_AQ, there, i in zip(item["p_AQ"], touched, item["grasp_object"], strict=True):
        apart = np.linalg.norm(p_AQ[there][:, None] - surfaces[i], axis=2).min(axis=1)
        assert apart.max() < 0.005
    apart = np.linalg.norm(
        item["points"][item["on_object"]][:, None] - np.concatenate(surfaces), axis=2
    )
    assert apart.min(axis=1).max() < 0.01
    assert item["free"].all() and (item["clean"] <= item["kept"]).all()


def test_masks_tell_the_objects_apart(clutter: Path) -> None:
    data = SceneDataset(clutter, points=None, split="test", balance="view")
    item = data[4]  # from above
    assert sorted(np.unique(item["mask"])) == [0, 1, 2]
    for i, X_TO in enumerate(item["X_AO"]):
        v, u = np.nonzero(item["mask"] == i + 1)
        ray = np.linalg.inv(item["K"]) @ [u.mean(), v.mean(), 1.0]
        p_TP = transform_points(item["X_TC"], (ray * item["depth"][v, u].mean())[None])[0]
        nearest = np.linalg.norm(item["X_AO"][:, :2, 3] - p_TP[:2], axis=1).argmin()
        assert nearest == i, X_TO


def test_an_object_beyond_the_last_has_no_values(clutter: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copy(clutter, tmp_path))
    with h5py.File(copy, "r+") as file:
        alone = file["grasps/object"][:] == 0
        assert alone[file["grasps/scene"][:] == 0].any()
        file["grasps/object"][:] = 0
        file["scenes/object"][:, 1] = -1
        for name in ("X_TO", "mass", "friction_hand", "friction_table"):
            file["scenes"][name][:, 1] = np.nan
    item = SceneDataset(copy, points=8, split="test")[0]
    assert item["object"].tolist() == [0, -1] and np.isnan(item["X_AO"][1, :3]).all()
    with h5py.File(copy) as file:
        assert count_scenes(file)["test"]["objects"] == 1
    with h5py.File(copy, "r+") as file:
        file["grasps/object"][3] = 1
    with pytest.raises(DataError, match=r"/grasps/object must be 0 to 1, got -1 in row 3"):
        SceneDataset(copy)


def test_views_count_for_the_objects_that_are_grasped(clutter: Path, tmp_path: Path) -> None:
    """The second object of a scene is another one, and only it has grasps to draw there."""
    copy = Path(shutil.copy(clutter, tmp_path))
    with h5py.File(copy, "r+") as file:
        file["scenes/object"][0, 1] = 1
        own = file["grasps/scene"][:] == 0
        file["grasps/object"][: own.sum()] = 1
    first, second = SceneDataset(copy).names
    every = SceneDataset(copy, points=8, split="test")
    scenes = [int(item["scene"]) for item in every]
    assert scenes.count(0) == scenes.count(2) == 5
    for name, scene in ((first, 2), (second, 0)):
        some = SceneDataset(copy, points=8, split="test", objects=[name])
        assert len(some) == 5 and {int(item["scene"]) for item in some} == {scene}
        assert all(
            (item["object"][item["grasp_object"]] == int(name == second)).all() for item in some
        )
