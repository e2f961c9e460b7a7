"""Poses in the frames of other tools put the hand where those tools' descriptions put it."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from helpers.hands import write_pincer
from helpers.objects import model_of
from scipy.spatial.transform import Rotation

from drakegrasp.errors import GraspError, HandError
from drakegrasp.exchange.attempts import read_attempts
from drakegrasp.frames import make_pose, rotation_about
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.settings import load_config
from drakegrasp.simulation.placement import PlacedObject
from drakegrasp.simulation.posture import Posture
from drakegrasp.verification.hints import fingertips, posture_readings
from drakegrasp.verification.placing import place_on_object

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


#: The cubes stand on the fingertips [m].
LIFTED = np.array([0.0, 0.0, 0.006])


def described(name: str, tool: str) -> np.ndarray:
    p, wxyz = X_AB[name, tool]
    return make_pose(Rotation.from_quat(wxyz, scalar_first=True).as_matrix(), p)


def object_at(hand, X_OG: np.ndarray) -> trimesh.Trimesh:
    """An object with a cube at each fingertip of the half closed hand, and a lump on one side."""
    points = fingertips(hand, Posture(X_OG)) @ X_OG[:3, :3].T + X_OG[:3, 3]
    cubes = [trimesh.creation.box([0.012] * 3).apply_translation(p + LIFTED) for p in points]
    lump = trimesh.creation.box([0.03, 0.02, 0.02]).apply_translation(points.mean(0) + 0.03)
    return trimesh.util.concatenate([*cubes, lump])


@pytest.mark.parametrize(("name", "tool"), X_AB)
def test_a_frame_that_is_turned_is_found(tmp_path, name, tool):
    """The fingertips meet the object as the description says, and in no frame that is turned."""
    hand, config = load_hand(name), load_config(overrides=[f"hand={name}"])
    X_OG = make_pose(rotation_about([0.0, 0.6, 0.8], 0.7), [0.02, -0.03, 0.05])
    mesh = object_at(hand, X_OG)
    centre = mesh.bounds.mean(axis=0)
    model = model_of(mesh, tmp_path)
    X_OG[:3, 3] -= centre
    X_OA = X_OG @ np.linalg.inv(hand.X_BG) @ np.linalg.inv(described(name, tool))

    def off(X: np.ndarray, link: str | None) -> tuple[float, tuple[str, ...]]:
        content = {"object": ["a"], "X_FG": X[None]}
        np.savez(tmp_path / "p.npz", **content, **({} if link is None else {"link": link}))
        table = read_attempts(tmp_path / "p.npz", hand)
        posture = table.posture(0, np.eye(4))
        spread = np.linalg.norm(posture.X_OG[:3, 3] - X_OG[:3, 3])
        turn = Rotation.from_matrix(posture.X_OG[:3, :3].T @ X_OG[:3, :3]).magnitude()
        placed = PlacedObject(model=model, X_TO=np.eye(4), config=config)
        (grasp,) = place_on_object(table, placed)
        readings, _ = posture_readings(grasp, placed, posture)
        return float(spread + turn), tuple(reading.text for reading in readings)

    assert off(X_OA, tool) == (pytest.approx(0.0, abs=1e-6), ())
    for axis in np.eye(3):
        turned = X_OA @ make_pose(rotation_about(axis, np.pi), np.zeros(3))
        assert off(turned, tool)[0] > 1.0
    # What is taken for the palm's pose is told by its fingertips.
    distance, hints = off(X_OA, None)
    assert distance > 0.05
    assert hints == (f"poses in the frame of {tool} (link: {tool})",)


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
