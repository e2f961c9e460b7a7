"""Predictions for views of scenes of several objects: the mask chooses one, the others count."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import drakegrasp as dg
from drakegrasp.arithmetic import multiply
from drakegrasp.dataset.clutter import load_scene
from drakegrasp.dataset.scenes import SceneDataset, SceneRows
from drakegrasp.errors import ConfigError
from drakegrasp.frames import unpack_pose
from drakegrasp.objects.surroundings import load_surroundings
from drakegrasp.scoring.predicting import predict_scenes
from drakegrasp.scoring.ranking import seen_neighbours
from drakegrasp.verification.placing import dataset_config, place_on_rows
from drakegrasp.vision.depth_image import View

pytestmark = pytest.mark.sim


@pytest.fixture(scope="module")
def path(small_clutter: Path) -> Path:
    return small_clutter / "clutter.hdf5"


def test_grasps_are_for_the_objects_of_the_rows(path: Path) -> None:
    rows = SceneRows(path, split="test")
    found, blind = predict_scenes(path, count=2)
    assert blind == 0 and set(found.of_row) == set(range(len(rows)))
    names = rows.column("object_props/object_name")
    assert list(found.objects) == names[found.of_row].tolist()
    # Palms are near their object, and can be tried there.
    placed = place_on_rows(found, rows, config=dataset_config(rows))
    for each in placed:
        assert not each.invalid and each.placed.around is not None
        assert np.linalg.norm(each.postures[0].X_OG[:3, 3]) < 0.25
    X_TO = np.array([each.placed.X_TO for each in sorted(placed, key=lambda each: each.index)])
    scene = load_scene(path, int(rows.scenes[0]))
    np.testing.assert_array_equal(X_TO[0], scene.X_TO[rows.places[0]])
    assert multiply(X_TO, found.X_FG)[:, 2, 3].min() > 0.0


def test_the_others_are_completed_from_the_view(path: Path) -> None:
    rows, data = SceneRows(path, split="test"), SceneDataset(path, points=None, split="test")
    view = int(rows.views[0])
    seen, place = data.images(view), int(rows.places[0])
    X_TC = unpack_pose(data.tables["views"]["X_TC"][view])
    own = View(seen["depth"], rows.value("masks", 0), seen["K"], X_TC)
    boxes = load_surroundings("bin").boxes
    around = seen_neighbours(own, seen["mask"], boxes, dataset_config(rows))
    (model,), (X_TN,) = around.models, around.X_TN
    assert around.boxes == boxes
    due = load_scene(path, int(rows.scenes[0])).X_TO[1 - place]
    assert np.linalg.norm(X_TN[:3, 3] - due[:3, 3]) < 0.03
    assert 0.04 < 2.0 * model.half_extents.max() < 0.2


def test_a_neighbour_in_the_way_counts_if_grasps_are_lifted(path: Path) -> None:
    """The same neighbour far away and where the best palm is."""
    rows, data = SceneRows(path, split="test"), SceneDataset(path, points=None, split="test")
    view, config = int(rows.views[0]), dataset_config(rows)
    seen, X_TC = data.images(view), unpack_pose(data.tables["views"]["X_TC"][rows.views[0]])
    own = View(seen["depth"], rows.value("masks", 0), seen["K"], X_TC)
    cloud = dg.cloud_from_depth(own.depth, own.K, own.mask, own.X_TC)
    around = seen_neighbours(own, seen["mask"], (), config)
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


def test_arms_are_refused(path: Path) -> None:
    with pytest.raises(ConfigError, match="arm must be None for scenes of several objects, got x"):
        predict_scenes(path, arm=SimpleNamespace(name="x"))  # type: ignore[arg-type]
