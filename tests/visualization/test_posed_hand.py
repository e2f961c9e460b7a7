"""Meshes of links and their poses: the hand that is shown is the hand that is simulated."""

from __future__ import annotations

from io import BytesIO

import numpy as np
import pytest
import trimesh

from drakegrasp.frames import make_pose, rotation_about
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.kinematics import fingertip_poses, joint_positions
from drakegrasp.hand.shapes import link_shapes
from drakegrasp.visualization.posed_hand import PosedHand

HAND = load_hand()


@pytest.fixture(scope="module")
def posed() -> PosedHand:
    return PosedHand(HAND)


def test_fingertips_are_where_the_kinematics_put_them(posed: PosedHand) -> None:
    X_TG = make_pose(rotation_about([0.6, 0.0, 0.8], 1.1), [0.1, -0.2, 0.3])
    spread, closing = 0.3, np.array([0.4, 0.9, 1.3])
    named = joint_positions(HAND, spread, closing)
    open_named = joint_positions(HAND, spread, np.zeros(3))
    # The order of the joints is Drake's; the open hand shows it.
    q_open = posed.open_positions(spread)
    assert sorted(q_open.tolist()) == pytest.approx(sorted(open_named.values()))
    names = posed._plant.GetPositionNames(posed._instance, False, False)
    poses = posed.link_poses(X_TG, [named[name] for name in names])
    expected = fingertip_poses(HAND, spread=spread, closing=closing)
    for finger, X_GF in zip(HAND.fingers, expected, strict=True):
        np.testing.assert_allclose(poses[finger.fingertip], X_TG @ X_GF, atol=1e-9)


def test_each_link_fills_its_collision_shapes(posed: PosedHand) -> None:
    """The Barrett Hand is shown as it collides, so the boxes around both are equal."""
    shapes = link_shapes(HAND)
    assert set(posed.links) == {link for link, parts in shapes.items() if parts}
    for link in posed.links:
        scene = trimesh.load(BytesIO(posed.link_glb(link)), file_type="glb")
        corners = np.concatenate(shapes[link])
        box = np.array([corners.min(axis=0), corners.max(axis=0)])
        # The corners of a cylinder enclose its circle.
        np.testing.assert_allclose(scene.bounds, box, atol=1.5e-3)


def test_a_link_that_is_not_there_is_refused(posed: PosedHand) -> None:
    with pytest.raises(KeyError, match="thumb"):
        posed.link_glb("thumb")
