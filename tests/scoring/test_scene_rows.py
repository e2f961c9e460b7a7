"""Views of scenes as rows: a grasp comes back to where it was tried, among neighbours if any."""

from __future__ import annotations

import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.datasets import OTO, make_dataset
from helpers.scores import FakeVerify

from drakegrasp.api.scoring import score
from drakegrasp.api.verifying import run_verification, verify_grasp, verify_grasps
from drakegrasp.dataset.clutter import load_scene
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.dataset.scenes import SceneDataset, SceneRows, open_rows
from drakegrasp.dataset.trials import Trials
from drakegrasp.errors import ConfigError, DataError
from drakegrasp.frames import Array, invert_pose, transform_points, unpack_pose
from drakegrasp.generation.scenes import make_scenes
from drakegrasp.grasp import transform_grasp
from drakegrasp.hand.description import load_hand
from drakegrasp.scoring.benchmark import rows_digest
from drakegrasp.scoring.card import share_text
from drakegrasp.scoring.references import REFERENCES, ReferenceInput
from drakegrasp.scoring.run import score as score_by
from drakegrasp.simulation.attempts import GraspTable, make_attempts
from drakegrasp.verification.placing import dataset_config, place_on_rows

pytestmark = pytest.mark.sim
#: A rule that no pose of a camera passes.
NO_CAMERA = "filters.min_camera_height=9"


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Scenes of one box each."""
    folder = tmp_path_factory.mktemp("scenes")
    out = make_dataset(folder / "out", folder / "meshes", overrides=["split.by=class"])
    make_scenes(out, overrides=["scenes.views=3"])
    return out / "scenes.hdf5"


@pytest.fixture(scope="module")
def among(small_clutter: Path) -> SceneRows:
    """Rows of scenes of two objects."""
    return SceneRows(small_clutter / "clutter.hdf5", split="test")


@pytest.fixture(scope="module", params=["alone", "among"])
def rows(request: pytest.FixtureRequest, alone: Path, among: SceneRows) -> SceneRows:
    """Rows of scenes of either kind."""
    found = open_rows(alone if request.param == "alone" else among.path, split="test")
    assert isinstance(found, SceneRows) and found.several == (request.param == "among")
    return found


def simulated_poses(rows: SceneRows) -> Array:
    """Return X_TO (n, 4, 4), under which the object of each row is simulated."""
    if not rows.several:
        return unpack_pose(Trials(rows.path.parent)[rows.column("trial_id")]["X_TO"])
    places = zip(rows.scenes.tolist(), rows.places, strict=True)
    return np.array([load_scene(rows.path, scene).X_TO[place] for scene, place in places])


def test_a_row_is_a_view_of_a_scene_with_a_sample(rows: SceneRows) -> None:
    assert not Trials(rows.path.parent)[rows.column("trial_id")]["removal"].any()
    objects = len(set(rows.column("object_props/object_name")))
    assert len(rows) == 5 * objects if not rows.several else len(rows) > 5
    assert not rows.several or set(rows.scenes) == {0, 2}


def test_other_files_are_no_scenes(alone: Path) -> None:
    assert type(open_rows(alone.parent / OTO, split="test")) is GraspDataset


def test_a_view_shows_the_object_where_its_grasp_is(rows: SceneRows) -> None:
    inputs = ReferenceInput(data=rows, rows=range(len(rows)), train=rows)
    poses = unpack_pose(rows.column("object_props/frame_work2cam_view"))
    p_OQ = Trials(rows.path.parent)[rows.column("trial_id")]["closed_p_OQ"]
    for row, X_TO in enumerate(simulated_poses(rows)):
        p_TQ = transform_points(X_TO, p_OQ[row]).mean(axis=0)
        seen = transform_points(poses[row], inputs.visible(row)).mean(axis=0)
        assert np.linalg.norm(p_TQ - seen) < 0.08
        assert rows.value("images", row).shape == (4, 240, 320)


def test_grasps_and_postures_come_back_to_where_they_were_tried(rows: SceneRows) -> None:
    config, X_TO = dataset_config(rows), simulated_poses(rows)
    hand, chosen = load_hand(config.hand_source), np.arange(len(rows))
    names = rows.column("object_props/object_name").tolist()
    q = np.zeros((len(rows), len(hand.joint_names)))
    postures = make_attempts(hand, names, X_TO, q, frame="table", of_row=chosen)
    for given in (rows.column("grasps"), postures):
        placed = place_on_rows(given, rows, config=config)
        assert sorted(each.index for each in placed) == chosen.tolist()
        for each in placed:
            around = each.placed.around
            assert (0 if around is None else len(around.models)) == int(rows.several)
            np.testing.assert_array_equal(each.placed.X_TO, X_TO[each.index])
            for posture in each.postures:
                np.testing.assert_allclose(posture.X_OG, np.eye(4), atol=1e-9)
    due = Trials(rows.path.parent)[rows.column("trial_id")]["closed_p_OQ"]
    for each in place_on_rows(rows.column("grasps"), rows, config=config):
        np.testing.assert_allclose(each.in_object_frame()[0], due[each.index], atol=1e-6)


def test_palms_of_the_own_grasps_are_those_of_their_trials(rows: SceneRows) -> None:
    due = Trials(rows.path.parent)[rows.column("trial_id")].columns(("X_OG", "closed_p_OQ"))
    X_GC = invert_pose(unpack_pose(rows.column("grasp_props/X_CG")))
    X_GO = invert_pose(unpack_pose(due["X_OG"]))
    for row, grasp in enumerate(rows.column("grasps")):
        p_GQ = transform_points(X_GO[row], due["closed_p_OQ"][row])
        found = transform_points(X_GC[row], grasp[:9].reshape(3, 3))
        np.testing.assert_allclose(found, p_GQ, atol=1e-5)
    assert len(rows_digest(rows, range(len(rows)))) == 64


@pytest.mark.parametrize("name", REFERENCES)
def test_every_reference_can_be_made_on_views(rows: SceneRows, name: str) -> None:
    """Of the first row and the last one; each time the same."""
    inputs = ReferenceInput(data=rows, rows=(0, len(rows) - 1), train=rows)
    made = REFERENCES[name].make(inputs)
    if isinstance(made, GraspTable):
        assert len(made) == 2 and not made.refused
        return
    lengths = np.linalg.norm(made[:, 9:].reshape(2, 3, 3), axis=-1)
    np.testing.assert_allclose(lengths, 1.0, atol=1e-6)
    np.testing.assert_array_equal(REFERENCES[name].make(inputs), made)


def test_scenes_of_other_trials_are_refused(rows: SceneRows, tmp_path: Path) -> None:
    out = Path(shutil.copytree(rows.path.parent, tmp_path / "out"))
    with h5py.File(out / rows.path.name, "r+") as file:
        file.attrs["shards"] = "0" * 64
    with pytest.raises(DataError, match=f"run `drakegrasp {rows.path.stem}` again"):
        open_rows(out / rows.path.name, split="test")


# Several objects


def test_views_that_do_not_show_the_object_are_no_rows(among: SceneRows, tmp_path: Path) -> None:
    out = Path(shutil.copytree(among.path.parent, tmp_path / "out"))
    with h5py.File(out / "clutter.hdf5", "r+") as file:
        file["views/visible_share"][0] = 0.0
        file["views/visible_share"][1] = np.nan
    assert SceneRows(out / "clutter.hdf5", split="test").views.min() == 2


def test_a_verdict_is_that_of_the_scene(among: SceneRows) -> None:
    row = len(among) - 1
    grasp = among.column("grasps")[row].astype(float)
    (verdict,) = verify_grasps(grasp, on=among, rows=[row])
    scene = load_scene(among.path, int(among.scenes[row]))
    X_TC = unpack_pose(among.column("object_props/frame_work2cam_view")[row])
    in_table = transform_grasp(X_TC, grasp)
    due = verify_grasp(in_table, on=scene, object=int(among.places[row]), frame="table")
    assert verdict.explain() == due.explain() and verdict.disturbance == due.disturbance


def test_a_score_counts_verdicts_in_the_scene(among: SceneRows) -> None:
    scored = score([], among, references=["own", "constant"], per_object=1, workers=1)
    assert set(scored.card["sets"]) == {"own"}, "no training row has a kept grasp"
    assert scored.card["dataset"]["file"] == "clutter.hdf5"
    (judged,) = scored.sets
    (verdicts,) = judged.verdicts
    assert len(verdicts) == 1


def test_a_card_tells_how_many_kept_grasps_leave_their_neighbours(among: SceneRows) -> None:
    """Here only the grasp of the first row. The table has the interval, of one object none."""
    own, names = among.column("grasps"), among.column("object_props/object_name")
    tries = FakeVerify(lambda _: True, leaves=lambda grasp: (grasp == own[0]).all())
    config, settings = dataset_config(among), {"versions": {}}
    about = {"config": config, "settings": settings, "per_object": None, "again": ""}
    scored = score_by(among, {}, tries, train=among, references=["own"], **about)
    found = scored.card["sets"]["own"]["measures"]
    share = 1.0 / (np.count_nonzero(names == names[0]) * len(set(names)))
    assert found["kept"]["value"] == 1.0 > found["clean"]["value"] == pytest.approx(share, abs=1e-6)
    assert f"| own | 100 (no interval) | 100 | 100 | {share_text(found['clean'])} |" in scored.text


def test_postures_are_judged_by_the_rules_of_contacts(among: SceneRows) -> None:
    """The filters of the cameras of a build do not count among others."""
    data, row = SceneDataset(among.path, points=None, split="test"), len(among) - 1
    grasps, config = data.tables["grasps"], dataset_config(among, overrides=(NO_CAMERA,))
    (i,) = np.flatnonzero(
        (grasps["trial_id"] == among.column("trial_id")[row])
        & (grasps["scene"] == among.scenes[row])
        & (grasps["object"] == among.places[row])
    )
    about = unpack_pose(grasps["X_TG"][[i]].astype(float)), grasps["q"][[i]].astype(float)
    how = {"q_pregrasp": grasps["q_open"][[i]].astype(float), "joints": data.joints}
    names = [among.column("object_props/object_name")[row]]
    hand, of_row = load_hand(config.hand_source), np.array([row])
    posture = make_attempts(hand, names, *about, frame="table", of_row=of_row, **how)
    for given in (posture, among.column("grasps")[[row]]):
        placed = place_on_rows(given, among, [row], config=config)
        (verdict,) = run_verification(placed, config, show=False)
        assert verdict.kept, verdict.explain()


def test_what_does_not_know_neighbours_is_refused(among: SceneRows) -> None:
    with pytest.raises(ConfigError, match="protocol must be lift for scenes of several objects"):
        score([], among, references=["own"], protocol="dexgraspbench")


def test_another_scene_is_another_content(among: SceneRows, tmp_path: Path) -> None:
    out = Path(shutil.copytree(among.path.parent, tmp_path / "out"))
    with h5py.File(out / "clutter.hdf5", "r+") as file:
        file["scenes/X_TO"][0, 1, 3] += 0.01
    assert SceneRows(out / "clutter.hdf5", split="test").content != among.content
