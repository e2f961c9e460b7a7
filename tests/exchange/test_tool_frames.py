"""Poses in the frames of other tools put the hand where those tools' descriptions put it."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.hands import write_pincer
from scipy.spatial.transform import Rotation

from drakegrasp.errors import GraspError, HandError
from drakegrasp.exchange.attempts import read_attempts
from drakegrasp.frames import make_pose, rotation_about
from drakegrasp.hand.description import load_hand

#: What the public descriptions say: the palm link's pose in the tool's frame, as position and
#: quaternion w, x, y, z. GraspGen's hand.stl is the panda_hand's collision mesh turned by +90
#: degrees about z. In GraspGenX's description of the Barrett Hand finger 3 is on +x, and its joint
#: is 59.1 mm above the origin, not 75.4 mm. The MJCF of DexGraspBench has the palm at these poses
#: in its world, which is the root of its grasps.
X_AB = {
    ("franka", "graspgen"): ([0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 1.0]),
    ("barrett", "graspgen"): ([0.0, 0.0, 0.0591 - 0.0754], [1.0, 0.0, 0.0, -1.0]),
    ("allegro", "dexgraspbench"): ([0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 1.0]),
    ("allegro_four", "dexgraspbench"): ([0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 1.0]),
    ("leap", "dexgraspbench"): ([0.0, 0.0, 0.1], [0.0, 1.0, 0.0, 0.0]),
}


def described(name: str, tool: str) -> np.ndarray:
    p, wxyz = X_AB[name, tool]
    return make_pose(Rotation.from_quat(wxyz, scalar_first=True).as_matrix(), p)


@pytest.mark.parametrize(("name", "tool"), X_AB)
def test_a_pose_in_the_frame_of_a_tool_puts_the_palm_where_its_description_says(
    tmp_path, name, tool
):
    hand = load_hand(name)
    X_OG = make_pose(rotation_about([0.0, 0.6, 0.8], 0.7), [0.02, -0.03, 0.05])
    X_OA = X_OG @ np.linalg.inv(hand.X_BG) @ np.linalg.inv(described(name, tool))

    def off(X: np.ndarray) -> float:
        np.savez(tmp_path / "p.npz", object=["a"], X_FG=X[None], link=tool)
        found = read_attempts(tmp_path / "p.npz", hand).X_FG[0]
        turn = Rotation.from_matrix(found[:3, :3].T @ X_OG[:3, :3]).magnitude()
        return float(np.linalg.norm(found[:3, 3] - X_OG[:3, 3]) + turn)

    assert off(X_OA) == pytest.approx(0.0, abs=1e-6)
    for axis in np.eye(3):
        assert off(X_OA @ make_pose(rotation_about(axis, np.pi), np.zeros(3))) > 1.0


def test_a_hand_file_names_frames(tmp_path):
    frame = {"p_BA": [0.0, 0.0, 0.1], "rpy_deg": [0.0, 180.0, 0.0]}
    hand = load_hand(write_pincer(tmp_path, frames={"mine": frame}))
    X_AG = hand.palm_in("mine")
    expected = np.linalg.inv(make_pose(np.diag([-1.0, 1.0, -1.0]), [0.0, 0.0, 0.1])) @ hand.X_BG
    np.testing.assert_allclose(X_AG, expected, atol=1e-12)
    np.savez(tmp_path / "p.npz", object=["a"], X_FG=np.eye(4)[None], link="mine")
    np.testing.assert_allclose(read_attempts(tmp_path / "p.npz", hand).X_FG[0], X_AG, atol=1e-12)
    with pytest.raises(GraspError, match="got 'mine'"):
        read_attempts(tmp_path / "p.npz", load_hand())
    with pytest.raises(HandError, match=r"frames.palm must have another name"):
        load_hand(write_pincer(tmp_path, frames={"palm": frame}))
