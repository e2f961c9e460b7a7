"""SceneDataset on scenes of several objects: an item tells which grasp is on which object."""

from __future__ import annotations

import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest

from drakegrasp.dataset.scenes import SceneDataset, count_scenes
from drakegrasp.errors import DataError
from drakegrasp.frames import invert_pose, transform_points

pytestmark = pytest.mark.sim


@pytest.fixture(scope="module")
def path(small_clutter: Path) -> Path:
    return small_clutter / "clutter.hdf5"


@pytest.mark.parametrize("frame", ["table", "camera"])
def test_grasps_and_points_are_on_the_objects_of_the_scene(path: Path, frame: str) -> None:
    data = SceneDataset(path, points=256, split="test", grasps=16, frame=frame)
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


def test_masks_tell_the_objects_apart(path: Path) -> None:
    data = SceneDataset(path, points=None, split="test", balance="view")
    item = data[4]  # from above
    assert sorted(np.unique(item["mask"])) == [0, 1, 2]
    for i, X_TO in enumerate(item["X_AO"]):
        v, u = np.nonzero(item["mask"] == i + 1)
        ray = np.linalg.inv(item["K"]) @ [u.mean(), v.mean(), 1.0]
        p_TP = transform_points(item["X_TC"], (ray * item["depth"][v, u].mean())[None])[0]
        nearest = np.linalg.norm(item["X_AO"][:, :2, 3] - p_TP[:2], axis=1).argmin()
        assert nearest == i, X_TO


def test_an_object_beyond_the_last_has_no_values(path: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copy(path, tmp_path))
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


def test_views_count_for_the_objects_that_are_grasped(path: Path, tmp_path: Path) -> None:
    """The second object of a scene is another one, and only it has grasps to draw there."""
    copy = Path(shutil.copy(path, tmp_path))
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


def test_poses_are_those_of_the_scene_in_both_frames(path: Path) -> None:
    table, camera = (
        SceneDataset(path, points=8, split="test", frame=frame)[1] for frame in ("table", "camera")
    )
    moved = invert_pose(table["X_TC"].astype(float)) @ table["X_AO"]
    np.testing.assert_allclose(camera["X_AO"], moved, atol=1e-6)
