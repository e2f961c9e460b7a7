"""Cameras that know no grasp: they look where they should, from within the ranges."""

from __future__ import annotations

import numpy as np

from drakegrasp.config import ScenesConfig
from drakegrasp.frames import invert_pose, transform_points
from drakegrasp.seeding import Stream
from drakegrasp.vision.viewpoints import FIXED_AIM, draw_viewpoint, fixed_viewpoints

P_TO = np.array([0.1, -0.2, 0.07])


def test_drawn_cameras_keep_to_the_ranges() -> None:
    config = ScenesConfig(aim=0.0)
    poses = np.array([draw_viewpoint(Stream(0, i), P_TO, config) for i in range(400)])
    back = poses[:, :3, 3] - P_TO
    distance = np.linalg.norm(back, axis=1)
    elevation = np.rad2deg(np.arcsin(back[:, 2] / distance))
    roll = np.rad2deg(np.arcsin(poses[:, 2, 0] / np.cos(np.deg2rad(elevation))))

    assert 0.4 <= distance.min() < 0.41 and 0.89 < distance.max() <= 0.9
    assert 20.0 <= elevation.min() < 21.0 and 80.0 < elevation.max() <= 85.0
    assert 14.0 < np.abs(roll).max() <= 15.0 + 1e-9
    # Image down has a component downwards, and what is aimed at is on the optical axis.
    assert (poses[:, 2, 1] < 0.0).all()
    p_CO = np.array([transform_points(invert_pose(X), P_TO[None])[0] for X in poses])
    np.testing.assert_allclose(p_CO[:, :2], 0.0, atol=1e-12)
    np.testing.assert_allclose(p_CO[:, 2], distance)


def test_cameras_aim_beside_the_object_by_at_most_the_jitter() -> None:
    poses = [draw_viewpoint(Stream(0, i), P_TO, ScenesConfig()) for i in range(400)]
    # The distance of the optical axis from the object: below that of the corner of a cube.
    off = [np.linalg.norm(transform_points(invert_pose(X), P_TO[None])[0, :2]) for X in poses]
    assert 0.06 < max(off) <= 0.05 * np.sqrt(3.0)


def test_fixed_cameras_are_the_published_ones() -> None:
    back = fixed_viewpoints()[:, :3, 3] - FIXED_AIM
    np.testing.assert_allclose(np.linalg.norm(back, axis=1), [0.65] * 4 + [0.7])
    elevation = np.rad2deg(np.arcsin(back[:, 2] / np.linalg.norm(back, axis=1)))
    np.testing.assert_allclose(elevation, [45.0] * 4 + [60.0])
    azimuth = np.rad2deg(np.arctan2(back[:, 1], back[:, 0])) % 360.0
    np.testing.assert_allclose(azimuth, [0.0, 90.0, 180.0, 270.0, 45.0], atol=1e-9)
