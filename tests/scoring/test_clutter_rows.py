"""Views of scenes of several objects as rows: predictions are tried among the neighbours."""

from __future__ import annotations

import shutil
from pathlib import Path
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
from helpers.scores import FakeVerify

from drakegrasp.api.scoring import score
from drakegrasp.api.verifying import run_verification, verify_grasp, verify_grasps
from drakegrasp.dataset.clutter import load_scene
from drakegrasp.dataset.scenes import SceneDataset, SceneRows, open_rows
from drakegrasp.dataset.trials import Trials
from drakegrasp.errors import ConfigError, DataError
from drakegrasp.frames import transform_points, unpack_pose
from drakegrasp.grasp import transform_grasp
from drakegrasp.hand.description import load_hand
from drakegrasp.scoring.card import share_text
from drakegrasp.scoring.references import REFERENCES, ReferenceInput
from drakegrasp.scoring.run import score as score_by
from drakegrasp.simulation.attempts import make_attempts
from drakegrasp.verification.placing import dataset_config, place_on_rows

pytestmark = pytest.mark.sim
#: A rule that no pose of a camera passes.
NO_CAMERA = "filters.min_camera_height=9"


@pytest.fixture(scope="module")
def path(small_clutter: Path) -> Path:
    return small_clutter / "clutter.hdf5"


@pytest.fixture(scope="module")
def rows(path: Path) -> SceneRows:
    found = open_rows(path, split="test")
    assert isinstance(found, SceneRows) and found.several
    return found


def test_a_row_is_a_view_that_shows_the_object_of_its_grasp(rows: SceneRows) -> None:
    assert set(rows.scenes) == {0, 2} and len(rows) > 5
    inputs = ReferenceInput(data=rows, rows=range(len(rows)), train=rows)
    poses = unpack_pose(rows.column("object_props/frame_work2cam_view"))
    for row, grasp in enumerate(rows.column("grasps")):
        scene = load_scene(rows.path, int(rows.scenes[row]))
        p_TQ = transform_points(poses[row], grasp[:9].reshape(3, 3).astype(float))
        seen = transform_points(poses[row], inputs.visible(row))
        apart = np.linalg.norm(scene.X_TO[:, :3, 3] - p_TQ.mean(axis=0), axis=1)
        assert apart.argmin() == rows.places[row]
        assert np.linalg.norm(p_TQ.mean(axis=0) - seen.mean(axis=0)) < 0.08


def test_views_that_do_not_show_the_object_are_no_rows(path: Path, tmp_path: Path) -> None:
    out = Path(shutil.copytree(path.parent, tmp_path / "out"))
    with h5py.File(out / "clutter.hdf5", "r+") as file:
        file["views/visible_share"][0] = 0.0
        file["views/visible_share"][1] = np.nan
    hidden = open_rows(out / "clutter.hdf5", split="test")
    assert isinstance(hidden, SceneRows) and hidden.views.min() == 2


def test_grasps_are_placed_among_the_neighbours_of_their_scene(rows: SceneRows) -> None:
    config, places = dataset_config(rows), rows.column("grasps")
    hand = load_hand(config.hand_source)
    X_TO = np.array(
        [
            load_scene(rows.path, s).X_TO[i]
            for s, i in zip(rows.scenes.tolist(), rows.places, strict=True)
        ]
    )
    q = np.zeros((len(rows), len(hand.joint_names)))
    names = rows.column("object_props/object_name").tolist()
    chosen = np.arange(len(rows))
    postures = make_attempts(hand, names, X_TO, q, frame="table", of_row=chosen)
    for given in (places, postures):
        placed = place_on_rows(given, rows, config=config)
        assert sorted(each.index for each in placed) == chosen.tolist()
        for each in placed:
            assert each.placed.around is not None and len(each.placed.around.models) == 1
            np.testing.assert_array_equal(each.placed.X_TO, X_TO[each.index])
            for posture in each.postures:
                np.testing.assert_allclose(posture.X_OG, np.eye(4), atol=1e-9)
    due = Trials(rows.path.parent)[rows.column("trial_id")]["closed_p_OQ"]
    for each in place_on_rows(places, rows, config=config):
        np.testing.assert_allclose(each.in_object_frame()[0], due[each.index], atol=1e-6)


def test_a_verdict_is_that_of_the_scene(rows: SceneRows) -> None:
    row = len(rows) - 1
    grasp = rows.column("grasps")[row].astype(float)
    (verdict,) = verify_grasps(grasp, on=rows, rows=[row])
    scene, X_TC = (
        load_scene(rows.path, int(rows.scenes[row])),
        rows.column("object_props/frame_work2cam_view"),
    )
    in_table = transform_grasp(unpack_pose(X_TC[row]), grasp)
    due = verify_grasp(in_table, on=scene, object=int(rows.places[row]), frame="table")
    assert verdict.explain() == due.explain() and verdict.disturbance == due.disturbance


@pytest.mark.parametrize("name", ["own", "top-down", "closing"])
def test_references_without_training_can_be_made(rows: SceneRows, name: str) -> None:
    made = REFERENCES[name].make(ReferenceInput(data=rows, rows=range(len(rows)), train=rows))
    assert len(made) == len(rows)


def test_a_score_counts_verdicts_in_the_scene(rows: SceneRows, path: Path) -> None:
    scored = score([], rows, references=["own", "constant"], per_object=1, workers=1)
    assert set(scored.card["sets"]) == {"own"}, "no training row has a kept grasp"
    assert scored.card["dataset"]["file"] == "clutter.hdf5"
    (judged,) = scored.sets
    (verdicts,) = judged.verdicts
    assert len(verdicts) == 1


def test_a_card_tells_how_many_kept_grasps_leave_their_neighbours(rows: SceneRows) -> None:
    """Here only the grasp of the first row. The table has the interval, of one object none."""
    own, names = rows.column("grasps"), rows.column("object_props/object_name")
    tries = FakeVerify(lambda _: True, leaves=lambda grasp: (grasp == own[0]).all())
    config, settings = dataset_config(rows), {"versions": {}}
    about = {"config": config, "settings": settings, "per_object": None, "again": ""}
    scored = score_by(rows, {}, tries, train=rows, references=["own"], **about)
    found = scored.card["sets"]["own"]["measures"]
    share = 1.0 / (np.count_nonzero(names == names[0]) * len(set(names)))
    assert found["kept"]["value"] == 1.0 > found["clean"]["value"] == pytest.approx(share, abs=1e-6)
    assert f"| own | 100 (no interval) | 100 | 100 | {share_text(found['clean'])} |" in scored.text


def test_postures_are_judged_by_the_rules_of_contacts(rows: SceneRows) -> None:
    """The filters of the cameras of a build do not count among others."""
    data, row = SceneDataset(rows.path, points=None, split="test"), len(rows) - 1
    grasps, config = data.tables["grasps"], dataset_config(rows, overrides=(NO_CAMERA,))
    (i,) = np.flatnonzero(
        (grasps["trial_id"] == rows.column("trial_id")[row])
        & (grasps["scene"] == rows.scenes[row])
        & (grasps["object"] == rows.places[row])
    )
    about = unpack_pose(grasps["X_TG"][[i]].astype(float)), grasps["q"][[i]].astype(float)
    how = {"q_pregrasp": grasps["q_open"][[i]].astype(float), "joints": data.joints}
    names = [rows.column("object_props/object_name")[row]]
    hand, of_row = load_hand(config.hand_source), np.array([row])
    posture = make_attempts(hand, names, *about, frame="table", of_row=of_row, **how)
    for given in (posture, rows.column("grasps")[[row]]):
        placed = place_on_rows(given, rows, [row], config=config)
        (verdict,) = run_verification(placed, config, show=False)
        assert verdict.kept, verdict.explain()


def test_what_does_not_know_neighbours_is_refused(rows: SceneRows) -> None:
    with pytest.raises(
        ConfigError, match="protocol must be lift for scenes of several objects, got"
    ):
        score([], rows, references=["own"], protocol="dexgraspbench")
    with pytest.raises(
        ConfigError, match="arm must be None for scenes of several objects, got panda"
    ):
        score([], rows, references=["own"], arm=SimpleNamespace(name="panda"))  # type: ignore[arg-type]


def test_scenes_of_other_trials_are_refused(path: Path, tmp_path: Path) -> None:
    out = Path(shutil.copytree(path.parent, tmp_path / "out"))
    with h5py.File(out / "clutter.hdf5", "r+") as file:
        file.attrs["shards"] = "0" * 64
    with pytest.raises(DataError, match="run `drakegrasp clutter` again"):
        open_rows(out / "clutter.hdf5", split="test")


def test_another_scene_is_another_content(rows: SceneRows, tmp_path: Path) -> None:
    out = Path(shutil.copytree(rows.path.parent, tmp_path / "out"))
    with h5py.File(out / "clutter.hdf5", "r+") as file:
        file["scenes/X_TO"][0, 1, 3] += 0.01
    assert open_rows(out / "clutter.hdf5", split="test").content != rows.content
