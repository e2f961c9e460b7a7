"""Cameras against Drake and by closed forms: poses, image frame, viewpoints, what is hidden.

The errors of a depth camera: noise of the stated size, shadows where geometry puts them.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from pydrake.systems.sensors import CameraInfo
from scipy.spatial.transform import Rotation

from drakegrasp.config import CameraConfig, ScenesConfig
from drakegrasp.frames import Array, invert_pose, make_pose, transform_points
from drakegrasp.seeding import Stream
from drakegrasp.vision.camera import (
    FIXED_AIM,
    DepthSensor,
    camera_pose_otm,
    camera_pose_oto,
    draw_viewpoint,
    fixed_viewpoints,
    image_frame,
    intrinsics,
    project,
    shadow,
    spoil_depth,
    unproject,
    visible_contacts,
)

CONFIG = CameraConfig()
K = intrinsics(CONFIG)

vectors = arrays(np.float64, 3, elements=st.floats(-3.0, 3.0))
palms = st.builds(lambda r, p: make_pose(Rotation.from_rotvec(r).as_matrix(), p), vectors, vectors)
#: Palms that do not look within a degree of straight up or down.
slanted_palms = palms.filter(lambda X_TG: abs(X_TG[2, 2]) < np.cos(np.deg2rad(1.0)))


@pytest.mark.parametrize(("size", "fov_y_deg"), [(128, 50.0), (64, 40.0), (33, 90.0)])
def test_camera_matrix_is_drakes(size: int, fov_y_deg: float) -> None:
    drake = CameraInfo(width=size, height=size, fov_y=np.deg2rad(fov_y_deg))
    ours = intrinsics(CameraConfig(size=size, fov_y_deg=fov_y_deg))
    np.testing.assert_allclose(ours, drake.intrinsic_matrix(), rtol=1e-14)


@given(palms)
def test_oto_stands_behind_the_palm_and_rolls_with_it(X_TG: Array) -> None:
    X_GC = invert_pose(X_TG) @ camera_pose_oto(X_TG, CONFIG)
    np.testing.assert_allclose(X_GC, make_pose(np.eye(3), [0.0, 0.0, -0.25]), atol=1e-13)


@given(palms)
def test_otm_differs_from_oto_by_a_roll_only(X_TG: Array) -> None:
    X_TG.setflags(write=False)
    X_TC_otm, X_TC_oto = camera_pose_otm(X_TG, CONFIG), camera_pose_oto(X_TG, CONFIG)
    np.testing.assert_array_equal(X_TC_otm[:, 2:], X_TC_oto[:, 2:])
    np.testing.assert_allclose(X_TC_otm[:3, :3] @ X_TC_otm[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(X_TC_otm[:3, :3]) == pytest.approx(1.0)


@given(slanted_palms)
def test_world_up_is_up_in_the_otm_image(X_TG: Array) -> None:
    """A point above another in the world is above it in the image, in the same column."""
    X_CT = invert_pose(camera_pose_otm(X_TG, CONFIG))
    ahead = X_TG[:3, 3] + 0.05 * X_TG[:3, 2]
    (u0, v0), (u1, v1) = project(K, transform_points(X_CT, [ahead, ahead + np.array([0, 0, 1e-3])]))
    assert u1 == pytest.approx(u0, abs=1e-6)
    assert v1 < v0
    # Up has no part along Cx: the horizon is level.
    assert X_CT[0, 2] == pytest.approx(0.0, abs=1e-12)


@given(st.sampled_from([1.0, -1.0]), st.floats(-np.pi, np.pi))
def test_otm_that_looks_straight_up_or_down_has_ty_on_top(sign: float, roll: float) -> None:
    """Looking down, Cx = Tx and Cy = -Ty, as on a map; looking up, Cx = -Tx."""
    flip = np.diag([1.0, sign, sign])
    R_TG = flip @ Rotation.from_rotvec([0.0, 0.0, roll]).as_matrix()
    X_TC = camera_pose_otm(make_pose(R_TG, [0.1, 0.2, 0.3]), CONFIG)
    expected = np.diag([-sign, -1.0, sign])
    np.testing.assert_allclose(X_TC[:3, :3], expected, atol=1e-12)
    np.testing.assert_allclose(X_TC[:3, 3], [0.1, 0.2, 0.3 - sign * 0.25], atol=1e-15)


@given(
    arrays(np.float64, (4, 2), elements=st.floats(-0.5, 127.5)),
    arrays(np.float64, 4, elements=st.floats(0.01, 0.75)),
)
def test_unprojected_pixels_project_to_themselves(pixels: Array, depth: Array) -> None:
    p_CQ = unproject(K, pixels, depth)
    np.testing.assert_allclose(p_CQ[:, 2], depth, rtol=1e-12)
    np.testing.assert_allclose(project(K, p_CQ), pixels, atol=1e-9)


def bar(angle_deg: float, *, half_length: float = 40.3, half_width: float = 6.3) -> Array:
    """Return a mask (128, 128) of a bar about (63, 60), `angle_deg` clockwise from +u."""
    v, u = np.mgrid[:128, :128]
    c, s = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
    along, across = c * (u - 63) + s * (v - 60), -s * (u - 63) + c * (v - 60)
    return (np.abs(along) <= half_length) & (np.abs(across) <= half_width)


DEPTH = np.full((128, 128), 0.3)


@pytest.mark.parametrize("angle_deg", [0.0, 30.0, 89.0, 90.0, -89.0, -45.0, 135.0, 180.0])
def test_image_frame_of_a_bar_lies_along_it(angle_deg: float) -> None:
    """Iz to the image's right, or straight down; Ix away from the camera; Iy = Iz x Ix."""
    X_CI = image_frame(K, bar(angle_deg), DEPTH)
    angle = np.deg2rad((angle_deg + 90.0) % 180.0 - 90.0)
    if angle_deg == 90.0:
        angle = np.pi / 2.0
    Iz = np.array([np.cos(angle), np.sin(angle), 0.0])
    expected = np.column_stack([[0.0, 0.0, 1.0], np.cross(Iz, [0.0, 0.0, 1.0]), Iz])
    # A bar of pixels has steps: its axis is true to a fifth of a degree.
    np.testing.assert_allclose(X_CI[:3, :3], expected, atol=np.deg2rad(0.2))
    assert np.linalg.det(X_CI[:3, :3]) == pytest.approx(1.0)
    np.testing.assert_allclose(np.cross(X_CI[:3, 1], X_CI[:3, 2]), X_CI[:3, 0], atol=1e-12)
    # It sits at the unprojected centroid; the bar is symmetric about the pixel (63, 60).
    expected_p = np.array([-0.5, -3.5, K[0, 0]]) / K[0, 0] * 0.3
    np.testing.assert_allclose(X_CI[:3, 3], expected_p, atol=1e-12)


def test_depth_is_that_of_the_object_where_the_centroid_falls_beside_it() -> None:
    """Two separate patches at different depths: the nearest object pixel counts, not the gap."""
    mask, depth = np.zeros((128, 128)), np.full((128, 128), 0.75)
    mask[60:63, 20:30] = mask[60:63, 80:84] = 1
    depth[60:63, 20:30], depth[60:63, 80:84] = 0.2, 0.4
    # Centroid at u = (10 * 24.5 + 4 * 81.5) / 14 = 40.8: the left patch ends nearer, at 29.
    X_CI = image_frame(K, mask, depth)
    assert X_CI[2, 3] == 0.2
    (uv,) = project(K, X_CI[None, :3, 3])
    np.testing.assert_allclose(uv, [(10 * 24.5 + 4 * 81.5) / 14, 61.0])


@given(arrays(np.uint8, (8, 8), elements=st.integers(0, 1)).filter(np.any))
def test_any_mask_gives_a_right_handed_frame_with_the_stated_signs(mask: Array) -> None:
    X_CI = image_frame(intrinsics(CameraConfig(size=8)), mask, np.full((8, 8), 0.5))
    np.testing.assert_allclose(X_CI[:3, :3] @ X_CI[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(X_CI[:3, :3]) == pytest.approx(1.0)
    np.testing.assert_array_equal(X_CI[:3, 0], [0.0, 0.0, 1.0])
    x, y = X_CI[:2, 2]
    assert x > 1e-9 or (abs(x) <= 1e-9 and y > 0.0)


def test_empty_mask_is_refused() -> None:
    with pytest.raises(ValueError, match="at least one object pixel, got none"):
        image_frame(K, np.zeros((128, 128)), DEPTH)


# Cameras that know no grasp: they look where they should, from within the ranges

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


@pytest.mark.parametrize(
    ("column", "z", "up", "seen"),
    [
        (36, 0.0, 1.0, True),
        # Its own normal hides it, or what is before it, by more than 3 mm.
        (36, 0.0, -1.0, False),
        (8, 0.0, 1.0, False),
        (36, -0.002, 1.0, True),
        (36, -0.004, 1.0, False),
        # Beyond the mask by more than a pixel, beyond the image, and nowhere.
        (39.5, 0.0, 1.0, True),
        (41.5, 0.0, 1.0, True),
        (42.1, 0.0, 1.0, False),
        (50, 0.0, 1.0, False),
        (232, 0.0, 1.0, False),
        (np.nan, 0.0, 1.0, False),
    ],
)
def test_what_hides_a_contact(column: float, z: float, up: float, seen: bool) -> None:
    """From 0.5 m above, where a pixel is 5 mm; the mask ends at column 40, and a post at 16."""
    X_TC = make_pose(np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, 0.5])
    K = np.array([[100.0, 0.0, 32.0], [0.0, 100.0, 24.0], [0.0, 0.0, 1.0]])
    depth, mask = np.full((48, 64), 0.5), np.zeros((48, 64), dtype=np.uint8)
    depth[:, :16], mask[:, :41] = 0.4, 1
    contact = np.array([[0.005 * (column - 32), 0.0, z]]), np.array([[0.0, 0.0, up]])
    assert visible_contacts(*contact, X_TC, K, depth, mask).tolist() == [seen]
    assert not visible_contacts(*contact, X_TC, K, depth, 0 * mask).any()


FAR = np.float32(CONFIG.far)
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
