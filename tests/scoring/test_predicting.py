"""Grasps are predicted for what a camera saw, and lifts on the completed object decide."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from helpers.depth_images import X_TC, K, box_view, cloud_of

import drakegrasp as dg
from drakegrasp.arithmetic import multiply
from drakegrasp.dataset.clutter import load_scene
from drakegrasp.dataset.scenes import SceneDataset, SceneRows
from drakegrasp.frames import unpack_pose
from drakegrasp.scoring import ranking
from drakegrasp.scoring.predicting import _predict_view, _SceneView, predict, predict_scenes
from drakegrasp.simulation.attempt import Attempt
from drakegrasp.simulation.fixtures import load_surroundings
from drakegrasp.verification.placing import dataset_config, place_on_rows
from drakegrasp.vision.depth_image import View

CONFIG = dg.load_config("fast", ["objects.mass=0.3"])


@pytest.fixture(scope="module")
def view():
    """A box on a table before a wall, 80 x 60 mm wide and 100 mm high."""
    return box_view()


@pytest.fixture(scope="module")
def cloud(view):
    return cloud_of(view)


def test_grasps_come_with_the_best_first(cloud):
    """They are those that `propose` returns, in the order of their chances."""
    found, ranked = predict(cloud, None, CONFIG, simulate=0, name="mug")
    assert found.frame == "table" and set(found.objects) == {"mug"} and not any(found.invalid)
    assert (np.diff(found.confidence) <= 0.0).all() and 0.0 < found.confidence[0] < 1.0
    assert found.row.tolist() == list(range(len(found)))
    assert np.isnan(ranked.share).all() and ranked.completion == ""
    proposed = dg.propose(cloud)
    for name in ("X_FG", "q_grasp", "q_pregrasp"):
        np.testing.assert_array_equal(getattr(found, name), getattr(proposed, name)[ranked.order])
    few, _ = predict(cloud, None, CONFIG, simulate=0, count=2)
    np.testing.assert_array_equal(few.X_FG, found.X_FG[:2])
    np.testing.assert_array_equal(few.confidence, found.confidence[:2])


@pytest.mark.sim
def test_lifts_end_at_the_first_grasp_that_holds_in_all_of_them(cloud, view):
    proposed = dg.propose(cloud)
    seen = dg.rank(proposed, cloud, simulate=8, view=view, config=CONFIG)
    tried = np.argsort(-seen.score, kind="stable")[: np.isfinite(seen.share).sum()]
    assert set(tried) == set(np.flatnonzero(np.isfinite(seen.share)))
    assert (
        seen.share[seen.order[0]] == 1.0
        and np.nanmax(np.delete(seen.share, seen.order[0]), initial=0.0) < 1.0
    )
    assert seen.completion == "view" and seen.likely
    # No more than what was measured on household meshes is promised, however good a grasp looks.
    assert seen.explain().startswith("the first grasp is a sample with a chance of 9")
    assert 0.9 < seen.chance.max() <= 0.92
    # The same bits again.
    again = dg.rank(proposed, cloud, simulate=8, view=tuple(view), config=CONFIG)
    np.testing.assert_array_equal(again.share, seen.share)
    assert dg.rank(proposed, cloud, simulate=1, config=CONFIG).completion == "cloud"


@pytest.mark.sim
def test_a_share_is_of_all_lifts_of_a_grasp(monkeypatch):
    """On both solids, then with the palm 4 mm aside and with less friction on the first."""
    placed, starts = dg.place_object(trimesh.creation.box([0.06] * 3)), list[Attempt]()

    def is_sample(placed, start):
        starts.append(start)
        return start.conditions is None

    monkeypatch.setattr(ranking, "_lifts_to_sample", is_sample)
    assert ranking.lift_shares(
        [placed, placed], [Attempt(X_OG=np.eye(4), spread=0.0)]
    ).tolist() == [0.8]
    assert [start.X_OG[0, 3] for start in starts] == [0.0, 0.0, 0.004, -0.004, 0.0]


@pytest.mark.sim
def test_no_grasp_of_what_lies_flat_is_likely():
    """A pen on the table: no lift is a sample, and the ranking says so."""
    x, turn = np.meshgrid(np.linspace(-0.07, 0.07, 60), np.linspace(0.0, np.pi, 20))
    pen = np.stack([x, 0.005 * np.cos(turn), 0.005 + 0.005 * np.sin(turn)], axis=-1).reshape(-1, 3)
    ranked = dg.rank(dg.propose(pen), pen, simulate=2, config=CONFIG)
    assert np.nanmax(ranked.share) == 0.0 and not ranked.likely
    assert ranked.explain().startswith("no grasp is likely: the best one is a sample with a chance")
    assert "10 mm high" in ranked.explain()


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"simulate": -1}, "simulate must be a whole number, 0 or more, got -1"),
        ({"view": (1, 2)}, "view must be depth, mask, K, X_TC, got 2 values"),
        ({"view": (np.ones((9, 9)), np.ones((9, 9)), K, X_TC)}, "mask must be 0 beside"),
    ],
)
def test_bad_arguments_are_one_line(cloud, given, said):
    with pytest.raises(dg.GraspError, match=said):
        dg.rank(np.eye(4), cloud, **given)
    with pytest.raises(dg.ConfigError, match="config must be of the hand franka, got one of barr"):
        dg.rank(np.eye(4), cloud, "franka", simulate=1, config=CONFIG)


def test_a_view_without_its_object_is_told_from_a_bad_one(view):
    """Too few points, none high enough, or a flat object yield no grasps; other mistakes raise."""
    scene = _SceneView(name="box", resting=0, X_TO=np.eye(4), view=view)
    lower = X_TC - np.eye(4, k=1) * [[0.0], [0.0], [0.12], [0.0]]
    beside = np.zeros_like(view.mask)
    beside[-20:-10, 60:90] = True

    def predicted(**changes):
        return _predict_view(CONFIG, 0, 1, None, scene._replace(view=view._replace(**changes)))

    for changes in ({"mask": 0 * view.mask}, {"mask": beside}):
        assert predicted(**changes) is None
    depth = 1e3 * view.depth
    for changes in ({"mask": view.mask[1:]}, {"K": 2 * K}, {"depth": depth}, {"X_TC": lower}):
        with pytest.raises(dg.GraspError, match="view of box"):
            predicted(**changes)


# Scenes of several objects: the mask chooses one, the others count


@pytest.fixture(scope="module")
def rows(small_clutter: Path) -> SceneRows:
    return SceneRows(small_clutter / "clutter.hdf5", split="test")


@pytest.fixture(scope="module")
def first(rows: SceneRows) -> tuple[View, np.ndarray]:
    """What the first row shows of its object, and a mask of all objects."""
    data, view = SceneDataset(rows.path, points=None, split="test"), rows.views[0]
    seen, X_TC = data.images(int(view)), unpack_pose(data.tables["views"]["X_TC"][view])
    return View(seen["depth"], rows.value("masks", 0), seen["K"], X_TC), seen["mask"]


@pytest.mark.sim
def test_grasps_are_for_the_objects_of_the_rows(rows: SceneRows) -> None:
    found, blind = predict_scenes(rows.path, count=2)
    assert blind == 0 and set(found.of_row) == set(range(len(rows)))
    names = rows.column("object_props/object_name")
    assert list(found.objects) == names[found.of_row].tolist()
    # Palms are near their object, and can be tried there.
    placed = place_on_rows(found, rows, config=dataset_config(rows))
    for each in placed:
        assert not each.invalid and each.placed.around is not None
        assert np.linalg.norm(each.postures[0].X_OG[:3, 3]) < 0.25
    X_TO = np.array([each.placed.X_TO for each in sorted(placed, key=lambda each: each.index)])
    scene = load_scene(rows.path, int(rows.scenes[0]))
    np.testing.assert_array_equal(X_TO[0], scene.X_TO[rows.places[0]])
    assert multiply(X_TO, found.X_FG)[:, 2, 3].min() > 0.0


@pytest.mark.sim
def test_the_others_are_completed_from_the_view(
    rows: SceneRows, first: tuple[View, np.ndarray]
) -> None:
    (view, instances), walls = first, load_surroundings("bin").walls
    around = dg.seen_neighbours(
        [each.tolist() for each in view], instances, walls=walls, config=dataset_config(rows)
    )
    (model,), (X_TN,) = around.models, around.X_TN
    assert around.walls == walls
    due = load_scene(rows.path, int(rows.scenes[0])).X_TO[1 - int(rows.places[0])]
    assert np.linalg.norm(X_TN[:3, 3] - due[:3, 3]) < 0.03
    assert 0.04 < 2.0 * model.half_extents.max() < 0.2
    must = r"instances must be whole numbers of the size .*, got "
    with pytest.raises(dg.GraspError, match=must + r"int64 of \(1, 2\)"):
        dg.seen_neighbours(view, [[0, 1]])
    with pytest.raises(dg.GraspError, match=must + "float64 of"):
        dg.seen_neighbours(view, instances + 0.5)

    # A mask that is smaller than the object in the instances makes it no neighbour of its own.
    smaller = np.array(view.mask)
    smaller[np.flatnonzero(smaller.any(axis=1))[0]] = 0
    again = dg.seen_neighbours(view._replace(mask=smaller), instances, config=dataset_config(rows))
    assert len(again.models) == 1


@pytest.mark.sim
def test_a_neighbour_in_the_way_counts_if_grasps_are_lifted(
    rows: SceneRows, first: tuple[View, np.ndarray]
) -> None:
    """The same neighbour far away and where the best palm is."""
    (own, mask), config = first, dataset_config(rows)
    cloud = dg.cloud_from_depth(own.depth, own.K, own.mask, own.X_TC)
    around = dg.seen_neighbours(own, mask, config=config)
    proposed = dg.propose(cloud)
    best = int(dg.rank(proposed, cloud, config=config).order[0])
    one = proposed.at([best])
    X_TN = around.X_TN.copy()
    X_TN[0, :3, 3] = one.X_FG[0, :3, 3]
    far = around.X_TN.copy()
    far[0, :2, 3] += 1.0
    for X, share in ((far, 1.0), (X_TN, 0.0)):
        there = type(around)(models=around.models, X_TN=X)
        found = dg.rank(one, cloud, simulate=1, view=own, config=config, around=there)
        assert (found.share[0] > 0.0) == (share > 0.0)
