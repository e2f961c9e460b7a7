"""The errors of a depth camera: noise of the stated size, shadows where geometry puts them."""

from __future__ import annotations

import numpy as np
import pytest

from drakegrasp.config import CameraConfig
from drakegrasp.vision.camera import DepthSensor, intrinsics, shadow, spoil_depth

CONFIG = CameraConfig()
K, FAR = intrinsics(CONFIG), np.float32(CONFIG.far)
NOISY = DepthSensor(noise=2e-3, seed=5)


def wall(z: float) -> np.ndarray:
    """Return the depth image of a wall across the view."""
    return np.full((CONFIG.size, CONFIG.size), z, dtype=np.float32)


def step(near: float, far: float) -> np.ndarray:
    """Return the depth image of a post of 20 pixels before a wall."""
    depth = wall(far)
    depth[:, 60:80] = near
    return depth


@pytest.mark.parametrize("z", [0.2, 0.4, 0.7])
def test_noise_is_normal_and_grows_with_the_square_of_the_distance(z: float) -> None:
    error = spoil_depth(wall(z), K, NOISY, 0, CONFIG).astype(float) - z
    sigma = NOISY.noise * z * z
    assert error.std() == pytest.approx(sigma, rel=0.03)
    assert abs(error.mean()) < 0.03 * sigma
    assert (np.abs(error) < 2.0 * sigma).mean() == pytest.approx(0.954, abs=0.01)


def test_noise_depends_on_seed_and_camera_alone() -> None:
    depth = step(0.2, 0.3)
    first = spoil_depth(depth, K, NOISY, 0, CONFIG)
    assert np.array_equal(first, spoil_depth(depth, K, NOISY, 0, CONFIG))
    assert not np.array_equal(first, spoil_depth(depth, K, NOISY, 1, CONFIG))
    other = DepthSensor(noise=NOISY.noise, seed=6)
    assert not np.array_equal(first, spoil_depth(depth, K, other, 0, CONFIG))


def test_pixels_at_a_clipping_plane_have_no_depth_that_errs() -> None:
    depth = wall(CONFIG.far)
    depth[:50] = CONFIG.near
    assert np.array_equal(spoil_depth(depth, K, NOISY, 0, CONFIG), depth)


def test_depth_that_noise_takes_beyond_the_far_plane_is_lost() -> None:
    spoilt = spoil_depth(wall(CONFIG.far - 1e-4), K, NOISY, 0, CONFIG)
    assert spoilt.max() == FAR
    assert (spoilt == FAR).mean() == pytest.approx(0.46, abs=0.05)


def test_wall_has_no_shadow_and_a_post_has_one_on_the_side_away_from_the_projector() -> None:
    baseline, near, far = 0.02, 0.2, 0.3
    assert not shadow(wall(near), K, baseline).any()

    # The projector is to the right, so the wall lies in the dark left of the post.
    width = K[0, 0] * baseline * (1.0 / near - 1.0 / far)
    hidden = shadow(step(near, far), K, baseline)
    columns = np.flatnonzero(hidden.all(axis=0))
    assert np.array_equal(columns, np.arange(60 - np.floor(width), 60))
    assert hidden.sum() == len(columns) * CONFIG.size
    # There a depth image holds what nothing holds; without errors it stays as it is.
    depth = step(near, far)
    spoilt = spoil_depth(depth, K, DepthSensor(noise=1e-3, baseline=baseline, seed=1), 0, CONFIG)
    assert np.array_equal(spoilt == FAR, hidden) and spoilt.dtype == np.float32
    assert spoil_depth(depth, K, DepthSensor(), 0, CONFIG) is depth


def test_shadow_agrees_with_rays_from_the_projector() -> None:
    """A ball before a wall: each point is lit, or the ball is between it and the projector."""
    centre, radius, far, baseline = np.array([0.01, -0.02, 0.25]), 0.06, 0.4, 0.03
    v, u = np.indices((CONFIG.size, CONFIG.size))
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], axis=2)
    along = rays @ centre
    gap = along**2 - (rays**2).sum(axis=2) * (centre @ centre - radius**2)
    ball = (along - np.sqrt(np.maximum(gap, 0.0))) / (rays**2).sum(axis=2)
    depth = np.where(gap > 0.0, ball, far)

    # Where the ray from the projector to each point passes the ball on its way.
    points, p_CP = rays * depth[:, :, None], np.array([baseline, 0.0, 0.0])
    way = points - p_CP
    share = np.clip(((centre - p_CP) * way).sum(axis=2) / (way**2).sum(axis=2), 0.0, 1.0)
    passes = np.linalg.norm(p_CP + share[:, :, None] * way - centre, axis=2) < radius
    turned_away = ((points - centre) * way).sum(axis=2) > 0.0
    dark = np.where(gap > 0.0, turned_away, passes)

    found = shadow(depth.astype(np.float32), K, baseline)
    # They differ by a pixel along edges.
    assert (found != dark).sum() < 0.1 * dark.sum()
    assert dark.sum() > 200
