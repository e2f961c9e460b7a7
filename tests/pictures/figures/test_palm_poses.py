"""The figure of the samplers: a panel each, with what it found or that nobody tried."""

from __future__ import annotations

import numpy as np
from helpers.meshes import FIXED
from matplotlib.collections import LineCollection

from drakegrasp.pictures.figures.orthographic import view_rotation
from drakegrasp.pictures.figures.palm_poses import caption, palm_poses_figure

BOX = FIXED["10_box_tall"]
RAYS = np.array([[[0.2, 0.0, 0.0], [0.0, 0.0, 0.0]], [[0.0, 0.0, 0.2], [0.0, 0.0, 0.1]]])
NUMBERS = {
    "palm_rays": 87,
    "palm_poses": 200,
    "coverage": 0.541,
    "attempts": 1600,
    "successes": 22,
    "successes_per_1000_attempts": 13.75,
}


def test_rays_are_drawn_beside_each_other() -> None:
    figure = palm_poses_figure(
        BOX.vertices, BOX.faces, {"a": RAYS, "b": RAYS[:1]}, captions={"a": "x\ny"}, name="$$"
    )
    first, second = figure.axes
    assert (first.get_title(), second.get_title()) == ("a", "b")
    assert first.get_xlim() == second.get_xlim()
    # Those before the object's middle are drawn once; those behind it also shine through.
    segments = [
        segment
        for collection in first.collections
        if isinstance(collection, LineCollection)
        for segment in collection.get_segments()
    ]
    ends = (RAYS @ view_rotation().T)[..., :2]
    for ray in ends:
        assert any(np.allclose(ray, segment) for segment in segments)


def test_a_view_keeps_lengths_and_shows_up_as_up() -> None:
    R = view_rotation()
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) > 0.0
    up = R @ [0.0, 0.0, 1.0]
    assert abs(up[0]) < 1e-12
    assert up[1] > 0.9


def test_a_caption_says_what_was_not_tried() -> None:
    text = caption(NUMBERS, {**NUMBERS, "coverage": 0.6}, 5)
    assert "87 of 200 palm rays" in text
    assert "54 % of the directions" in text
    assert "13.8 successes per 1,000 attempts (22 of 1,600)" in text
    assert "all 5 objects: 60 %; 13.8 per 1,000" in text
    assert "all" not in caption(NUMBERS, NUMBERS, 1)
    drawn = {**NUMBERS, "attempts": None, "successes": None, "successes_per_1000_attempts": None}
    assert caption(drawn, None, 5).endswith("not tried in this dataset")
