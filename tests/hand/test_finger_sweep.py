"""Paths of fingers: points on the links, moved as forward kinematics moves them."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.hands import PINCER_SDF, write_pincer

from drakegrasp.frames import transform_points
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.finger_sweep import hand_paths
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


def test_hand_with_an_unlimited_finger_has_none(tmp_path):
    free = PINCER_SDF.replace("<limit><lower>0</lower><upper>1</upper></limit>", "")
    assert free != PINCER_SDF
    assert hand_paths(load_hand(write_pincer(tmp_path, sdf=free)), 0.0) is None
