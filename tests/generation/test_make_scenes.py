"""scenes.hdf5: the same bytes whoever makes it, places and cameras, labels, visible contacts."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.errors import ConfigError
from drakegrasp.frames import unpack_pose
from drakegrasp.generation.scenes import make_scenes, split_objects
from drakegrasp.outcomes import Outcome
from drakegrasp.runtime.executor import processes
from drakegrasp.vision.camera import fixed_viewpoints

pytestmark = pytest.mark.sim

#: They are rendered in a tenth of the time.
SMALL_IMAGES = ("scenes.width=64", "scenes.height=48")


@pytest.fixture(scope="module")
def scenes(sound: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = Path(shutil.copytree(sound, tmp_path_factory.mktemp("scenes") / "out"))
    make_scenes(out, overrides=SMALL_IMAGES)
    return out / "scenes.hdf5"


@pytest.mark.nightly
def test_bytes_do_not_depend_on_the_number_of_workers(scenes: Path, out: Path) -> None:
    with processes(2) as execute:
        make_scenes(out, execute=execute, overrides=SMALL_IMAGES)
    assert (out / "scenes.hdf5").read_bytes() == scenes.read_bytes()


def test_nothing_else_of_the_dataset_changes(sound: Path, scenes: Path) -> None:
    names = {path.name for path in scenes.parent.iterdir()} - {"build.lock"}
    assert names == {path.name for path in sound.iterdir()} | {"scenes.hdf5"}
    for path in sound.iterdir():
        if path.is_file():
            assert path.read_bytes() == (scenes.parent / path.name).read_bytes()


def test_objects_are_turned_and_moved_and_cameras_differ_by_split(scenes: Path) -> None:
    with h5py.File(scenes) as file:
        X_TO = unpack_pose(file["scenes/X_TO"][:, 0])
        split, X_TC = file["scenes/split"][:], unpack_pose(file["views/X_TC"][:])
        scene, kind = file["views/scene"][:], file["views/kind"][:]
        names = file["objects/name"].asstr()[file["scenes/object"][:, 0]]
    assert len(np.unique(X_TO[:, :2, 3])) == 6 and np.abs(X_TO[:, :2, 3]).max() <= 0.1
    # Each is turned about Tz from where it rested.
    entries = {entry.name: entry for entry in read_manifest(scenes.parent).objects}
    for name, X in zip(names, X_TO, strict=True):
        rested = unpack_pose(np.array(entries[name].resting[0].X_TO))
        turn = X[:3, :3] @ rested[:3, :3].T
        assert abs(turn[0, 1]) > 0.01 and abs(turn[2, 2] - 1.0) < 1e-9
    for number, own in enumerate(split):
        poses, kinds = X_TC[scene == number], kind[scene == number]
        if own == 0:
            assert len(poses) == 16 and not kinds.any()
            assert len(np.unique(poses[:, :3, 3], axis=0)) == 16
        else:
            np.testing.assert_array_equal(poses, fixed_viewpoints())
            assert kinds.tolist() == [1, 1, 1, 1, 2]


def test_only_lifts_to_a_verdict_are_tested(scenes: Path) -> None:
    with h5py.File(scenes) as file:
        grasps = {name: file["grasps"][name][:] for name in ("outcome", "tested", "lifted", "kept")}
        ids = file["grasps/trial_id"][:]
    tested = set(grasps["outcome"][grasps["tested"]].tolist())
    assert tested == {Outcome.SUCCESS, Outcome.SLIPPED, Outcome.DROPPED, Outcome.TABLE_CONTACT}
    untested = set(grasps["outcome"][~grasps["tested"]].tolist())
    # A hand that touched the table after closing was not lifted.
    assert untested == {Outcome.MISSING_FINGERTIP, Outcome.HAND_CONTACT, Outcome.TABLE_CONTACT}
    assert (grasps["lifted"] == (grasps["outcome"] == Outcome.SUCCESS)).all()
    assert grasps["kept"].sum() > 0 and len(np.unique(ids)) == len(ids)


def test_other_settings_than_of_scenes_are_refused(out: Path) -> None:
    with pytest.raises(ConfigError, match="only keys of scenes can change"):
        make_scenes(out, overrides=["filters.max_slip=1"])
    made = make_scenes(out, overrides=["scenes.views=2", *SMALL_IMAGES])
    assert made["train"]["views"] == 2 * made["train"]["scenes"]
    with h5py.File(out / "scenes.hdf5") as file:
        assert file["views/rgb"].shape[1:] == (48, 64, 3)


@pytest.mark.parametrize(
    ("present", "splits"),
    [
        ([{0, 1}, {2}, {2}], [0, 2, 2]),
        # The first has no sample: its class trains.
        ([set(), {2}, {2}], [0, 2, 2]),
        # The last is the only one of its class, which does not train.
        ([{0}, {2}, set()], [0, 2, 2]),
    ],
)
def test_by_class_no_object_is_in_two_splits(
    sound: Path, present: list[set[int]], splits: list[int]
) -> None:
    manifest = read_manifest(sound)
    split = manifest.config.split.model_copy(update={"by": "class", "valid_fraction": 0.0})
    manifest = replace(manifest, config=manifest.config.model_copy(update={"split": split}))
    assert split_objects(manifest, present) == splits
