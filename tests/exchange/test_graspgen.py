"""Predictions of GraspGen, and palm poses alone: read as they are, and tried through every door."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import trimesh
from helpers.commands import run
from helpers.datasets import OTO
from helpers.isaac import isaac_grasp, write_isaac

from drakegrasp.cli.arguments import Postures
from drakegrasp.cli.verify import Target, place
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.errors import GraspError
from drakegrasp.exchange.attempts import has_rows, holds_postures, read_attempts
from drakegrasp.frames import make_pose, rotation_about
from drakegrasp.hand.description import load_hand

X_MA = np.stack(
    [make_pose(rotation_about([0.0, 0.6, 0.8], turn), [0.01, turn, 0.3]) for turn in (0.1, 0.7)]
)
FRANKA, LEAP = load_hand("franka"), load_hand("leap")


def write(
    path: Path,
    confidence: dict[str, list[float]] | None = None,
    *,
    scale: Any = 0.5,
    gripper: str = "franka_panda",
    poses: Any = X_MA,
) -> Path:
    """What `inference_graspgen.py` writes with `write_info`: single precision, nested keys."""
    with h5py.File(path, "w") as file:
        file.create_group("misc")["gripper_name"] = gripper
        for name, stated in (confidence or {"mug": [0.2, 0.9]}).items():
            group = file.create_group(f"objects/x/{name}.obj")
            group["asset_path"], group["asset_scale"] = f"meshes/ab/{name}.obj", scale
            group["pred_grasps"] = np.asarray(poses, dtype=np.float32)
            group["confidence"] = np.array(stated, dtype=np.float32)
            group["gt_grasps"] = X_MA[:0].astype(np.float32)
    return path


def test_predictions_of_many_objects_are_read_in_its_gripper_frame(tmp_path: Path) -> None:
    path = write(tmp_path / "a.h5", {"mug": [0.2, 0.9], "can": [0.5, 0.4]})
    assert holds_postures(path) and not has_rows(path)
    table = read_attempts(path, FRANKA)
    # HDF5 has groups in the order of their names.
    assert table.objects == ("can", "can", "mug", "mug") and table.frame == "mesh"
    np.testing.assert_allclose(table.confidence, [0.5, 0.4, 0.2, 0.9], atol=1e-7)
    palms = X_MA @ FRANKA.palm_in("graspgen")
    np.testing.assert_allclose(table.X_FG, [*palms, *palms], atol=1e-6)
    np.testing.assert_array_equal(table.scale, [0.5] * 4)
    assert set(table.invalid) == {""}

    # Another hand has no such frame, and its caller says which it is.
    write(path, gripper="leap")
    with pytest.raises(GraspError, match="got 'graspgen'"):
        read_attempts(path, LEAP)
    table = read_attempts(path, LEAP, read_as={"link": "palm"})
    np.testing.assert_allclose(table.X_FG, X_MA, atol=1e-6)


@pytest.mark.parametrize(("scale", "known"), [(1.0, np.nan), (0.5, 0.5)])
def test_in_the_frame_of_the_object_a_scale_of_one_is_any(
    tmp_path: Path, scale: float, known: float
) -> None:
    """Exported meshes are in metres, and so are poses on them, whatever unit the sources had."""
    path = write(tmp_path / "a.h5", scale=scale)
    table = read_attempts(path, FRANKA, read_as={"frame": "object"})
    np.testing.assert_array_equal(table.scale, [known] * 2)
    np.testing.assert_array_equal(read_attempts(path, FRANKA).scale, [scale] * 2)


def test_grasps_of_another_gripper_are_refused_unless_their_frame_is_named(tmp_path: Path) -> None:
    path = write(tmp_path / "a.h5", gripper="single_suction_cup_30mm")
    with pytest.raises(GraspError, match=r"of the hand franka \(--hand\), got those of the gr"):
        read_attempts(path, FRANKA)
    assert not any(read_attempts(path, FRANKA, read_as={"link": "palm"}).invalid)


def test_damaged_predictions_are_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "a.h5", scale=[0.5, 0.5])
    with pytest.raises(GraspError, match="asset_scale, pred_grasps and confidence, got others"):
        read_attempts(path, FRANKA)
    write(path, poses=X_MA[:, :3])
    with pytest.raises(GraspError, match=r"poses must be of shape \(n, 4, 4\), got \(2, 3, 4\)"):
        read_attempts(path, FRANKA)
    write(path)
    with h5py.File(path, "a") as file:
        del file["objects/x/mug.obj/confidence"]
    with pytest.raises(GraspError, match="pred_grasps and confidence, got others"):
        read_attempts(path, FRANKA)


def test_a_verdict_ranks_by_object_and_by_row(out: Path, tmp_path: Path) -> None:
    data = GraspDataset(out / OTO, split="train")
    names = data.column("object_props/object_name").tolist()
    path = write(tmp_path / "a.h5", {names[0]: [0.2, 0.9]}, scale=1.0)
    where = Target(dataset=out / OTO, frame="object", reading=Postures(link="palm"))
    placed, _, rows = place(path, where)
    assert rows is None
    assert [grasp.rank for grasp in placed] == [1, 0]

    # As a score has them: both grasps on each row of their object.
    placed, _, rows = place(path, replace(where, split="train"))
    assert rows is not None
    own = [row for row, name in enumerate(names) if name == names[0]]
    assert rows.row.tolist() == own * 2
    found = {grasp.index: grasp.rank for grasp in placed}
    assert [found[i] for i in range(len(found))] == [1] * len(own) + [0] * len(own)
    assert {grasp.placed.model.name for grasp in placed} == {names[0]}


# Palm poses alone come through every door

#: A box in centimetres, away from the origin of its file, and where its middle is [m].
EDGES, MIDDLE = np.array([4.0, 9.0, 3.6]), np.array([0.03, -0.02, 0.05])
#: Of its origin above the middle [m].
ABOVE = np.array([0.0, 0.0, 0.1064])
#: From above, with the tips of the Franka Hand at its middle, in GraspGen's frame.
X_ABOVE = make_pose(rotation_about([1.0, 0.0, 0.0], np.pi), MIDDLE + ABOVE)
ON_BOX = ("--object", "box.obj", "--units", "cm", "--hand", "franka", "--set", "objects.mass=0.2")


def write_box(folder: Path) -> None:
    mesh = trimesh.creation.box(EDGES).subdivide().subdivide()
    mesh.apply_translation(100.0 * MIDDLE)
    mesh.export(folder / "box.obj")


@pytest.mark.sim
def test_graspgen_is_verified_on_a_mesh_in_centimetres(tmp_path, monkeypatch):
    """With its frame named the first grasp holds; turned about x it faces away."""
    monkeypatch.chdir(tmp_path)
    write_box(tmp_path)
    turned = X_ABOVE @ make_pose(rotation_about([1.0, 0.0, 0.0], np.pi), np.zeros(3))
    first, second = isaac_grasp(X_ABOVE, confidence=0.9), isaac_grasp(turned, confidence=0.8)
    write_isaac(tmp_path / "box.yaml", grasp_0=first, grasp_1=second)
    done = run("verify", "box.yaml", *ON_BOX, "--link", "graspgen", "--workers", "1")
    assert done.exit_code == 0, done.stderr
    verdicts = [json.loads(line) for line in done.stdout.splitlines()]
    assert [verdict["matches"] for verdict in verdicts] == [True, False]
    # As if it were the palm link's, the fingers close along the long edges, which are too far.
    done = run("verify", "box.yaml", *ON_BOX, "--workers", "1")
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
