"""Poses of links and surfaces for the browser: the hand that is shown is the one simulated."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.pages import surface_of

from drakegrasp.frames import make_pose, rotation_about
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.kinematics import fingertip_poses
from drakegrasp.hand.shapes import link_shapes
from drakegrasp.pictures.still_scene import StillScene, link_surfaces

HAND = load_hand()


@pytest.fixture(scope="module")
def scene() -> StillScene:
    return StillScene(HAND)


def test_fingertips_are_where_the_kinematics_put_them(scene: StillScene) -> None:
    X_WG = make_pose(rotation_about([0.6, 0.0, 0.8], 1.1), [0.1, -0.2, 0.3])
    spread, closing = 0.3, np.array([0.4, 0.9, 1.3])
    scene.pose(X_WG, scene.positions(spread, closing))
    expected = fingertip_poses(HAND, spread=spread, closing=closing)
    for finger, X_GF in zip(HAND.fingers, expected, strict=True):
        np.testing.assert_allclose(scene.link_pose(finger.fingertip), X_WG @ X_GF, atol=1e-9)
    # The open hand is the one whose fingers have not closed.
    assert scene.positions(spread).tolist() == scene.positions(spread, np.zeros(3)).tolist()


def test_each_link_fills_its_collision_shapes(scene: StillScene) -> None:
    """The Barrett Hand is shown as it collides, so the boxes around both are equal."""
    shapes, surfaces = link_shapes(HAND.model), link_surfaces(scene)
    assert set(surfaces) == {link for link, parts in shapes.items() if parts}
    for link, content in surfaces.items():
        corners = np.concatenate(shapes[link])
        box = np.array([corners.min(axis=0), corners.max(axis=0)])
        # The corners of a cylinder enclose its circle.
        np.testing.assert_allclose(surface_of(content).bounds, box, atol=1.5e-3)
