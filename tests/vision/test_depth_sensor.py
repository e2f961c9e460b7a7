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
