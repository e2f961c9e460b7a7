"""Postures: Drake's poses of the links are those of the kinematics, and joints have an order."""

from __future__ import annotations

import numpy as np
import pytest

from drakegrasp.hand.description import load_hand
from drakegrasp.hand.kinematics import fingertip_poses, joint_positions
from drakegrasp.hand.posture import Posture


def test_links_are_where_the_kinematics_puts_them() -> None:
    hand = load_hand()
    posture = Posture(hand)
    closing = np.array([0.3, 0.9, 1.4])
    angles = joint_positions(hand, 0.2, closing)
    poses = posture.link_poses([angles[joint] for joint in posture.joints])
    expected = fingertip_poses(hand, spread=0.2, closing=closing)
    for link, X_GF in zip(hand.fingertip_links, expected, strict=True):
        assert poses[link] == pytest.approx(X_GF, abs=1e-12)
