"""Paths of fingers: points on the links, moved as forward kinematics moves them."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from helpers.hands import PINCER_SDF, SLIDER, write_pincer, write_slider

from drakegrasp.frames import invert_pose, transform_points
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.finger_sweep import (
    even_points,
    find_opposition,
    find_pinch,
    hand_paths,
    pad_points,
    reach,
)
from drakegrasp.hand.kinematics import coordinate_limits, fingertip_poses, link_poses
from drakegrasp.hand.shapes import link_shapes


def test_paths_run_from_the_open_hand_to_the_limit_in_small_steps(hand):
    paths = hand_paths(hand, 0.2)
    limits = coordinate_limits(hand)[1:, 1]
    for path, limit in zip(paths.fingers, limits, strict=True):
        assert path.angles[0] == 0.0
        assert path.angles[-1] == pytest.approx(limit)
        assert path.travel.max() < 0.0015
        steps = np.linalg.norm(np.diff(path.points, axis=0), axis=2)
        assert np.all(steps <= path.travel + 1e-7)


def test_points_of_a_finger_move_with_it(hand):
    spread, k = 0.3, 120
    paths = hand_paths(hand, spread)
    for i, finger in enumerate(hand.fingers):
        path = paths.fingers[i]
        closing = np.zeros(hand.num_fingers)
        closing[i] = path.angles[k]
        X_GF = fingertip_poses(hand, spread=spread, closing=closing)[i]
        corners = transform_points(X_GF, np.concatenate(link_shapes(hand.model)[finger.fingertip]))
        tips = path.points[k, : path.tip]
        distance = np.linalg.norm(corners[:, None] - tips, axis=2).min(axis=1)
        assert distance.max() < 1e-6
        assert np.all(tips > corners.min(axis=0) - 1e-6)
        assert np.all(tips < corners.max(axis=0) + 1e-6)

        # Its other links come after the fingertip, and no link that another finger moves.
        (link,) = (
            name
            for name, chain in hand.link_chains.items()
            if chain.gain[:, 1 + i].any() and name != finger.fingertip
        )
        X_GL = link_poses(hand, link, spread=spread, closing=closing)
        corners = transform_points(X_GL, np.concatenate(link_shapes(hand.model)[link]))
        others = path.points[k, path.tip :]
        assert np.all(others > corners.min(axis=0) - 1e-6)
        assert np.all(others < corners.max(axis=0) + 1e-6)
        assert np.ptp(others, axis=0) == pytest.approx(np.ptp(corners, axis=0), abs=2e-3)


def test_points_leave_no_gap_on_a_surface():
    """On a box: all corners, and one point in each cell of the grid that it crosses."""
    half, spacing = np.array([0.051, 0.033, 0.021]), 0.004
    corners = np.array(list(itertools.product(*zip(-half, half, strict=True))))
    points = even_points(corners, spacing)
    np.testing.assert_array_equal(points[:8], corners)
    assert len(np.unique(np.floor(points[8:] / spacing), axis=0)) == len(points) - 8
    rng = np.random.default_rng(0)
    surface = rng.uniform(-half, half, (5000, 3))
    axis = rng.integers(3, size=5000)
    surface[np.arange(5000), axis] = np.where(rng.random(5000) < 0.5, -1.0, 1.0) * half[axis]
    cells = {tuple(cell) for cell in np.floor(surface / spacing)}
    assert cells <= {tuple(cell) for cell in np.floor(points / spacing)}


def test_points_of_the_pad_come_first(hand):
    """They are those of the pad, which has a band of 1 mm, and next to it: they are 3 mm apart."""
    for i, finger in enumerate(hand.fingers):
        path = hand_paths(hand, 0.0).fingers[i]
        X_FG = invert_pose(fingertip_poses(hand, spread=0.0, closing=np.zeros(3))[i])
        p_FQ = transform_points(X_FG, path.points[0, : path.tip].astype(float))
        x, y = p_FQ[:, 0], p_FQ[:, 1]
        above = 0.085 * x + y - (0.00153 - 0.004 * np.hypot(0.085, 1.0))
        near = (x > 0.014 + 1e-6) & (above > 1e-6)
        off = (x < 0.014 - 1e-6) | (above < -1e-6)
        assert near[: path.pad].sum() == near.sum() > 100
        assert off[path.pad :].sum() == off.sum() > 100
        assert np.allclose(pad_points(hand)[i], p_FQ[: path.pad], atol=1e-6)
        assert finger.on_pad(p_FQ).sum() < path.pad < path.tip


def test_link_poses_of_fingertips_are_the_fingertip_poses(hand):
    closing = np.random.default_rng(0).uniform(0.0, 1.0, (5, hand.num_fingers))
    spread = np.linspace(0.0, 1.0, 5)
    tips = fingertip_poses(hand, spread=spread, closing=closing)
    for i, link in enumerate(hand.fingertip_links):
        assert np.array_equal(link_poses(hand, link, spread=spread, closing=closing), tips[:, i])
    still = link_poses(hand, hand.palm_link, spread=spread, closing=closing)
    assert np.allclose(still @ hand.X_BG, np.eye(4))


def test_gap_is_large_for_open_fingers_and_gone_where_they_cross(hand):
    paths = hand_paths(hand, float(np.deg2rad(22.5)))
    assert set(paths.gaps) == {(0, 1), (0, 2), (1, 2)}
    for gap in paths.gaps.values():
        assert gap[0, 0] > 0.02
    # Finger 3 closes against the two others when they are closed as far.
    assert np.diag(paths.gaps[0, 2]).min() < 0.0


def test_any_hand_has_paths(tmp_path):
    """Nothing is made for one hand: a gripper without spread, with a mount that has no shape."""
    pincer = load_hand(write_pincer(tmp_path))
    paths = hand_paths(pincer, 0.0)
    assert len(paths.fingers) == 2
    assert len(paths.still) > 0
    assert paths.gaps[0, 1][0, 0] == pytest.approx(0.06, abs=0.003)


def test_hand_with_an_unlimited_finger_has_none(tmp_path):
    free = PINCER_SDF.replace("<limit><lower>0</lower><upper>1</upper></limit>", "")
    assert free != PINCER_SDF
    assert hand_paths(load_hand(write_pincer(tmp_path, sdf=free)), 0.0) is None


def test_a_pinch_is_where_the_pads_leave_its_width(tmp_path) -> None:
    """Fingers slide along y from 40 mm to the middle; pads end 110 mm above the palm link."""
    hand = load_hand(write_slider(tmp_path))
    axis, group = find_opposition(hand)
    np.testing.assert_allclose(axis, [0.0, 1.0, 0.0], atol=1e-9)
    assert group.tolist() == [True, False]
    pinch = find_pinch(hand, 0.05)
    assert pinch is not None
    np.testing.assert_allclose(pinch.closing, 0.015, atol=0.002)
    assert pinch.width == pytest.approx(0.05, abs=0.004)
    assert pinch.tilt < np.deg2rad(3.0)
    assert pinch.p_GM[1] == pytest.approx(0.0, abs=1e-3)
    assert find_pinch(hand, 0.1) is None
    assert reach(hand, np.array([0.0, 0.0, 1.0])) == pytest.approx(0.1, abs=1e-9)


@pytest.mark.parametrize("turned", [0.0, 0.02, -0.02])
def test_fingers_around_a_centre_close_against_the_last_one(tmp_path, turned: float) -> None:
    """Three sliding fingers at 120 degrees, two of them mounted a little beside [rad]."""
    palm, _, left = SLIDER.partition('<link name="left">')
    link = left.partition("</link>")[0]
    parts, fingers = [palm], []
    for name, yaw in (
        ("a", turned - np.pi / 6.0),
        ("b", turned + 7.0 * np.pi / 6.0),
        ("c", np.pi / 2.0),
    ):
        x, y = 0.04 * np.cos(yaw), 0.04 * np.sin(yaw)
        parts.append(
            f'<link name="{name}">{link}</link>'
            f'<joint name="{name}_slide" type="prismatic"><parent link="palm"/>'
            f'<child link="{name}"/><origin xyz="{x} {y} 0.01" rpy="0 0 {yaw + np.pi / 2.0}"/>'
            '<axis xyz="0 1 0"/><limit lower="0" upper="0.04" effort="20" velocity="1"/></joint>'
        )
        finger = {"name": name, "fingertip": name, "closing_joint": f"{name}_slide"}
        fingers.append({**finger, "force_limit": 20.0, "pad_point": [0.0, 0.0, 0.09]})
    hand = load_hand(write_slider(tmp_path, "".join([*parts, "</robot>"]), fingers=fingers))
    axis, group = find_opposition(hand)
    np.testing.assert_allclose(axis, [0.0, 1.0, 0.0], atol=1e-9)
    assert group.tolist() == [True, True, False]
