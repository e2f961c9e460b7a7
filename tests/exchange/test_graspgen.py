"""Files of GraspGen beside isaac_grasp are read as they are, and their confidence ranks."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from helpers.datasets import OTO

from drakegrasp.cli.verify import Target, place
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.errors import GraspError
from drakegrasp.exchange.attempts import has_rows, holds_postures, read_attempts
from drakegrasp.frames import make_pose, rotation_about
from drakegrasp.hand.description import load_hand

X_MA = np.stack(
    [make_pose(rotation_about([0.0, 0.6, 0.8], turn), [0.01, turn, 0.3]) for turn in (0.1, 0.7)]
)
FRANKA = load_hand("franka")


def write_json(path: Path, poses: np.ndarray = X_MA, **changes: Any) -> Path:
    """A file of its datasets, as its page on their format describes it."""
    grasps = {"transforms": poses.tolist(), "object_in_gripper": [False, True]}
    tree = {"object": {"file": "meshes/ab/mug.obj", "scale": 0.5}, "grasps": grasps}
    path.write_text(json.dumps(tree | changes))
    return path


def write_hdf5(path: Path, poses: np.ndarray = X_MA) -> Path:
    """What `inference_graspgen.py` writes with `write_info`: single precision, nested keys."""
    with h5py.File(path, "w") as file:
        file.create_group("misc")["gripper_name"] = "franka_panda"
        for key, name, confidence in (("x/mug.obj", "mug", [0.2, 0.9]), ("can", "can", [0.5, 0.4])):
            group = file.create_group(f"objects/{key}")
            group["asset_path"], group["asset_scale"] = f"meshes/{name}.obj", np.float32(0.5)
            group["pred_grasps"] = poses.astype(np.float32)
            group["confidence"] = np.array(confidence, dtype=np.float32)
            group["gt_grasps"] = poses[:0].astype(np.float32)
    return path


def test_a_file_of_its_datasets_is_read_in_its_gripper_frame(tmp_path: Path) -> None:
    table = read_attempts(write_json(tmp_path / "a.json"), FRANKA)
    assert table.objects == ("mug", "mug") and table.frame == "mesh"
    np.testing.assert_allclose(table.X_FG, X_MA @ FRANKA.palm_in("graspgen"), atol=1e-12)
    np.testing.assert_array_equal(table.confidence, [0.0, 1.0])
    np.testing.assert_array_equal(table.scale, [0.5, 0.5])
    # Another hand has no such frame, and its caller says which it is.
    with pytest.raises(GraspError, match="got 'graspgen'"):
        read_attempts(tmp_path / "a.json", load_hand("leap"))
    table = read_attempts(tmp_path / "a.json", load_hand("leap"), read_as={"link": "palm"})
    np.testing.assert_allclose(table.X_FG, X_MA, atol=1e-12)


def test_in_the_frame_of_the_object_a_scale_of_one_is_any(tmp_path: Path) -> None:
    """Exported meshes are in metres, and so are poses on them, whatever unit the sources had."""
    for scale, known in ((1, np.nan), (0.5, 0.5)):
        thing = {"file": "mug.obj", "scale": scale}
        path = write_json(tmp_path / "a.json", object=thing)
        table = read_attempts(path, FRANKA, read_as={"frame": "object"})
        np.testing.assert_array_equal(table.scale, [known] * 2)
        np.testing.assert_array_equal(read_attempts(path, FRANKA).scale, [scale] * 2)


def test_its_predictions_of_many_objects_are_read(tmp_path: Path) -> None:
    path = write_hdf5(tmp_path / "a.h5")
    assert holds_postures(path) and not has_rows(path)
    table = read_attempts(path, FRANKA)
    # HDF5 has groups in the order of their names.
    assert table.objects == ("can", "can", "mug", "mug")
    np.testing.assert_allclose(table.confidence, [0.5, 0.4, 0.2, 0.9], atol=1e-7)
    palms = X_MA @ FRANKA.palm_in("graspgen")
    np.testing.assert_allclose(table.X_FG, [*palms, *palms], atol=1e-6)
    assert set(table.invalid) == {""}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            {"pc": [], "grasp_poses": []},
            "with object .file, scale. and grasps .*got grasp_poses, pc",
        ),
        ([], "got list"),
        ({"object": {"file": "a", "scale": 1}, "grasps": {"transforms": [[1]]}}, "got grasps, obj"),
    ],
)
def test_other_json_is_refused_in_one_line(tmp_path: Path, content: Any, message: str) -> None:
    (tmp_path / "a.json").write_text(json.dumps(content))
    with pytest.raises(GraspError, match=message) as caught:
        read_attempts(tmp_path / "a.json", FRANKA)
    assert "\n" not in str(caught.value)


def test_grasps_of_another_gripper_are_refused(tmp_path: Path) -> None:
    """Files of its datasets and of its inference name it; a caller who names the frame knows it."""
    path = write_json(tmp_path / "a.json", gripper={"name": "franka_panda", "width": 0.08})
    assert read_attempts(path, FRANKA).invalid == ("", "")
    write_json(path, gripper={"name": "robotiq_2f_140", "width": 0.136})
    other = write_hdf5(tmp_path / "a.h5")
    with h5py.File(other, "a") as file:
        file["misc/gripper_name"][()] = "single_suction_cup_30mm"
    for file_of_another in (path, other):
        with pytest.raises(GraspError, match=r"of the hand franka \(--hand\), got those of the gr"):
            read_attempts(file_of_another, FRANKA)
        assert not any(read_attempts(file_of_another, FRANKA, read_as={"link": "palm"}).invalid)
    write_json(path, gripper="robotiq")
    with pytest.raises(GraspError, match="must be a file of GraspGen's datasets"):
        read_attempts(path, FRANKA)


@pytest.mark.parametrize("scale", [True, "0.5", None, [0.5, 0.5]])
def test_a_scale_is_a_number(tmp_path: Path, scale: Any) -> None:
    path = write_json(tmp_path / "a.json", object={"file": "mug.obj", "scale": scale})
    with pytest.raises(GraspError, match="must be a file of GraspGen's datasets"):
        read_attempts(path, FRANKA)


def test_damaged_predictions_are_refused(tmp_path: Path) -> None:
    path = write_hdf5(tmp_path / "a.h5")
    with h5py.File(path, "a") as file:
        del file["objects/can/confidence"]
    with pytest.raises(GraspError, match="pred_grasps and confidence, got others"):
        read_attempts(path, FRANKA)


def test_a_verdict_ranks_by_object_and_by_row(out: Path, tmp_path: Path) -> None:
    data = GraspDataset(out / OTO, split="train")
    names = data.column("object_props/object_name").tolist()
    thing = {"file": f"{names[0]}.obj", "scale": 1}
    path = write_json(tmp_path / "a.json", object=thing)
    where: dict[str, Any] = {"dataset": out / OTO, "frame": "object", "link": "palm"}
    placed, _, rows = place(path, Target(**where))
    assert rows is None
    assert [grasp.rank for grasp in placed] == [1, 0]

    # A mesh of half the size is another object.
    write_json(path, object=thing | {"scale": 0.5})
    with pytest.raises(GraspError, match=rf"a\.json: scale must be that of {names[0]}, .*got 0.5"):
        place(path, Target(**where))
    write_json(path, object=thing)

    # As a score has them: both grasps on each row of their object.
    placed, _, rows = place(path, Target(**where, split="train"))
    assert rows is not None
    own = [row for row, name in enumerate(names) if name == names[0]]
    assert rows.row.tolist() == own * 2
    found = {grasp.index: grasp.rank for grasp in placed}
    assert [found[i] for i in range(len(found))] == [1] * len(own) + [0] * len(own)
    assert {grasp.placed.model.name for grasp in placed} == {names[0]}
