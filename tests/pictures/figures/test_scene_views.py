"""The sheet of views: a line per scene, and contacts hollow where the camera does not see them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from drakegrasp.dataset.scenes.reader import SceneDataset
from drakegrasp.errors import DataError
from drakegrasp.generation.scenes.make import make_scenes
from drakegrasp.pictures.figures.scene_views import scene_views

pytestmark = pytest.mark.sim


def test_each_view_shows_the_contacts_of_a_sample_of_its_scene(out: Path) -> None:
    path = make_scenes(out, overrides=["scenes.views=3"]).path
    figure, drawn = scene_views(path)
    # Three drawn views of the object to train on, four of each to test.
    assert len(drawn) == len(figure.axes) == 3 + 4 + 4
    data = SceneDataset(path, points=None, split="train")
    for axes, told in zip(figure.axes, drawn, strict=True):
        grasps = data.grasps_in(told["view"])
        row = int(np.argmax(grasps["trial_id"] == told["trial_id"]))
        assert grasps["sample"][row]
        dots = {line.get_gid(): line for line in axes.lines if line.get_gid()}
        hollow = [dots[f"contact {i}"].get_markerfacecolor() == "white" for i in range(3)]
        assert hollow == (~grasps["visible"][row]).tolist()
    assert any(not data.grasps_in(told["view"])["visible"].all() for told in drawn)


def test_a_file_that_is_missing_is_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"scenes\.hdf5: must be the scenes of a dataset"):
        scene_views(tmp_path / "scenes.hdf5")
