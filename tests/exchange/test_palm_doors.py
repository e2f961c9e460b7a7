"""Palm poses alone come through every door: a verdict, a score and a build of a dataset."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml
from helpers.commands import run
from scipy.spatial.transform import Rotation

from drakegrasp.exchange.attempts import read_attempts
from drakegrasp.frames import make_pose, rotation_about
from drakegrasp.hand.description import load_hand

#: A box in centimetres, away from the origin of its file, and where its middle is [m].
EDGES, MIDDLE = np.array([4.0, 9.0, 3.6]), np.array([0.03, -0.02, 0.05])
#: Of its origin above the middle [m].
ABOVE = np.array([0.0, 0.0, 0.1064])
#: From above, with the tips of the Franka Hand at its middle, in GraspGen's frame.
X_MA = make_pose(rotation_about([1.0, 0.0, 0.0], np.pi), MIDDLE + ABOVE)
FRANKA = ("--object", "box.obj", "--units", "cm", "--hand", "franka", "--set", "objects.mass=0.2")


def write_box(folder: Path) -> None:
    mesh = trimesh.creation.box(EDGES).subdivide().subdivide()
    mesh.apply_translation(100.0 * MIDDLE)
    mesh.export(folder / "box.obj")


def write_graspgen(path: Path, poses: list[np.ndarray], confidence: list[float]) -> Path:
    """A file as `save_to_isaac_grasp_format` of GraspGen writes it."""
    grasps = {}
    for i, (X, stated) in enumerate(zip(poses, confidence, strict=True)):
        w, *xyz = Rotation.from_matrix(X[:3, :3]).as_quat(scalar_first=True).tolist()
        turn = {"w": w, "xyz": xyz}
        place = {"position": X[:3, 3].tolist(), "orientation": turn}
        grasps[f"grasp_{i}"] = {"confidence": stated, **place}
    tree = {"format": "isaac_grasp", "format_version": 1.0, "grasps": grasps}
    path.write_text(yaml.dump(tree, default_flow_style=False, sort_keys=False))
    return path


@pytest.mark.sim
def test_graspgen_is_verified_on_a_mesh_in_centimetres(tmp_path, monkeypatch):
    """With its frame named the first grasp holds; turned about x it faces away."""
    monkeypatch.chdir(tmp_path)
    write_box(tmp_path)
    turned = X_MA @ make_pose(rotation_about([1.0, 0.0, 0.0], np.pi), np.zeros(3))
    write_graspgen(tmp_path / "box.yaml", [X_MA, turned], [0.9, 0.8])
    done = run("verify", "box.yaml", *FRANKA, "--link", "graspgen", "--workers", "1")
    assert done.exit_code == 0, done.stderr
    verdicts = [json.loads(line) for line in done.stdout.splitlines()]
    assert [verdict["matches"] for verdict in verdicts] == [True, False]
    # As if it were the palm link's, the fingers close along the long edges, which are too far.
    done = run("verify", "box.yaml", *FRANKA, "--workers", "1")
    assert not any(json.loads(line)["matches"] for line in done.stdout.splitlines())


def test_the_caller_says_the_preshape_of_rows_that_name_none(tmp_path):
    hand = load_hand("allegro_four")
    first, second = hand.preshape_names
    poses, names = np.stack([np.eye(4)] * 2), np.array(["mug", "can"])
    np.savez(tmp_path / "p.npz", object=names, X_FG=poses, preshape=[first, ""], link="base")
    table = read_attempts(tmp_path / "p.npz", hand, read_as={"preshape": second, "link": "palm"})
    assert table.preshape == (first, second)
    np.testing.assert_array_equal(table.X_FG, poses)
    table = read_attempts(tmp_path / "p.npz", hand, read_as={"preshape": "each"})
    assert table.shapes(1, hand) == (first, second)


@pytest.mark.sim
@pytest.mark.usefixtures("builds_here")
def test_palm_poses_are_built_in_each_preshape_and_a_third_resting_pose(tmp_path, monkeypatch):
    import h5py

    monkeypatch.chdir(tmp_path)
    (tmp_path / "meshes").mkdir()
    write_box(tmp_path / "meshes")
    X_TG = make_pose(rotation_about([1.0, 0.0, 0.0], np.pi), [0.0, 0.0, 0.3])
    content = {"object": ["box"], "X_FG": X_TG[None], "frame": "table", "resting": [2]}
    np.savez(tmp_path / "p.npz", **content)
    settings = ("hand=allegro_four", "objects.resting_poses=3", "objects.mass=0.2")
    done = run(
        *("build", "--objects", "meshes", "--units", "cm", "--out", "out", "--config", "fast"),
        *("--postures", "p.npz", "--preshape", "each", "--workers", "1", "--quiet"),
        *(word for each in settings for word in ("--set", each)),
    )
    assert done.exit_code == 0, done.stderr
    with h5py.File(tmp_path / "out" / "trials.hdf5") as file:
        trials = file["trials"]
        assert trials["preshape"][:].tolist() == [0, 1]
        assert trials["resting"][:].tolist() == [2, 2]
        assert trials["posture_row"][:].tolist() == [0.0, 0.0]
