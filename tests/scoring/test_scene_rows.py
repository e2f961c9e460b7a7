"""Views of scenes as rows: grasps come back to where they were in their trials, references look."""

from __future__ import annotations

import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.datasets import OTO, make_dataset
from helpers.tiers import in_second_tier

from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.dataset.scenes import SceneRows, open_rows
from drakegrasp.dataset.trials import Trials
from drakegrasp.errors import DataError
from drakegrasp.frames import invert_pose, transform_points, unpack_pose
from drakegrasp.generation.scenes import make_scenes
from drakegrasp.scoring.benchmark import rows_digest
from drakegrasp.scoring.references import REFERENCES, ReferenceInput
from drakegrasp.simulation.attempts import GraspTable
from drakegrasp.verification.placing import dataset_config, place_on_rows

pytestmark = pytest.mark.sim


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenes")
    out = make_dataset(folder / "out", folder / "meshes", overrides=["split.by=class"])
    make_scenes(out, overrides=["scenes.views=3"])
    return out / "scenes.hdf5"


def test_a_row_is_a_view_of_a_scene_with_a_sample(path):
    rows = open_rows(path, split="test")
    assert isinstance(rows, SceneRows) and len(rows) == 5 * len(
        set(rows.column("object_props/object_name"))
    )
    sample = Trials(path.parent)[rows.column("trial_id")]["removal"]
    assert not sample.any()
    assert isinstance(open_rows(path.parent / OTO, split="test"), GraspDataset)


def test_own_grasps_come_back_to_the_contacts_of_their_trials(path):
    rows = open_rows(path, split="test")
    due = Trials(path.parent)[rows.column("trial_id")].columns(("closed_p_OQ", "X_TO"))
    placed = place_on_rows(rows.column("grasps"), rows, config=dataset_config(rows))
    order = [grasp.index for grasp in placed]
    found = np.array([grasp.in_object_frame()[0] for grasp in placed])
    np.testing.assert_allclose(found, due["closed_p_OQ"][order], atol=1e-6)


def test_palms_of_the_own_grasps_are_those_of_their_trials(path):
    rows = SceneRows(path, split="test")
    due = Trials(path.parent)[rows.column("trial_id")].columns(("X_OG", "closed_p_OQ"))
    X_GC = invert_pose(unpack_pose(rows.column("grasp_props/X_CG")))
    X_GO = invert_pose(unpack_pose(due["X_OG"]))
    for row, grasp in enumerate(rows.column("grasps")):
        p_GQ = transform_points(X_GO[row], due["closed_p_OQ"][row])
        found = transform_points(X_GC[row], grasp[:9].reshape(3, 3))
        np.testing.assert_allclose(found, p_GQ, atol=1e-5)
    assert len(rows_digest(rows, range(len(rows)))) == 64


def test_images_show_the_object_where_the_grasp_is(path):
    rows = SceneRows(path, split="test")
    inputs = ReferenceInput(data=rows, rows=range(len(rows)), train=open_rows(path, split="train"))
    contacts = Trials(path.parent)[rows.column("trial_id")]["closed_p_OQ"]
    for row in inputs.rows:
        with h5py.File(path) as file:
            X_TO = file["scenes/X_TO"][file["views/scene"][rows.views[row]], 0].reshape(3, 4)
            X_TC = file["views/X_TC"][rows.views[row]].reshape(3, 4)
        p_TQ = transform_points(np.vstack([X_TO, [0, 0, 0, 1]]), contacts[row])
        seen = transform_points(np.vstack([X_TC, [0, 0, 0, 1]]), inputs.visible(row))
        apart = np.linalg.norm(p_TQ.mean(axis=0) - seen.mean(axis=0))
        assert apart < 0.06
        assert rows.value("images", row).shape == (4, 240, 320)


@pytest.mark.parametrize(
    "name", [in_second_tier(name) if name == "closing" else name for name in REFERENCES]
)
def test_every_reference_can_be_made_on_views(path, name):
    rows = open_rows(path, split="test")
    train = open_rows(path, split="train")
    made = REFERENCES[name].make(ReferenceInput(data=rows, rows=range(len(rows)), train=train))
    if isinstance(made, GraspTable):
        assert len(made) == len(rows) and not made.refused
        return
    assert made.shape == (len(rows), 18)
    lengths = np.linalg.norm(made[:, 9:].reshape(-1, 3, 3), axis=-1)
    np.testing.assert_allclose(lengths, 1.0, atol=1e-6)


def test_scenes_of_other_trials_are_refused(path, tmp_path):
    out = Path(shutil.copytree(path.parent, tmp_path / "out"))
    with h5py.File(out / "scenes.hdf5", "r+") as file:
        file.attrs["shards"] = "0" * 64
    with pytest.raises(DataError, match="run `drakegrasp scenes` again"):
        open_rows(out / "scenes.hdf5", split="test")
