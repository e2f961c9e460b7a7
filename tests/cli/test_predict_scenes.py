"""`drakegrasp predict` of scenes, and of what a camera of a scene saw."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, cast

import h5py
import numpy as np
import pytest
from helpers.arms import write_arm
from helpers.commands import error_line, run
from helpers.datasets import make_dataset
from PIL import Image

import drakegrasp as dg
from drakegrasp.dataset.scenes import SceneDataset, SceneRows
from drakegrasp.dataset.schema import DEPTH_UNIT
from drakegrasp.errors import ConfigError
from drakegrasp.exchange.attempts import read_attempts
from drakegrasp.generation.scenes import make_scenes
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.settings import load_config
from drakegrasp.outcomes import Outcome
from drakegrasp.reach.arm import mount_of
from drakegrasp.reach.branches import flange_poses
from drakegrasp.reach.cell import make_cell
from drakegrasp.scoring.predicting import predict
from drakegrasp.simulation.attempts import GraspTable
from drakegrasp.vision.depth_image import cloud_from_depth

if TYPE_CHECKING:
    from distributed import Client

pytestmark = pytest.mark.sim
#: The views of the training split, of which there are few.
FEW = ("--split", "train", "--count", 2, "--quiet")


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Small scenes of boxes."""
    folder = tmp_path_factory.mktemp("scenes")
    out = make_dataset(folder / "out", folder / "meshes", overrides=["split.by=class"])
    make_scenes(out, overrides=["scenes.views=1"])
    return out / "scenes.hdf5"


@pytest.fixture(scope="module")
def cloud(scenes: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the first view of the training scenes shows of its object."""
    data = SceneDataset(scenes, points=None, negatives="none", balance="view")
    seen, X_TC = data.images(data.views[0]), data[0]["X_TC"]
    path = tmp_path_factory.mktemp("cloud") / "cloud.npy"
    np.save(path, cloud_from_depth(seen["depth"], seen["K"], seen["mask"], X_TC))
    return path


@pytest.fixture(scope="module")
def own(cloud: Path) -> GraspTable:
    """The grasps for that cloud."""
    return predict(np.load(cloud), None, load_config("fast"), simulate=0)[0]


@pytest.fixture(scope="module")
def predicted(scenes: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("predicted") / "predicted.h5"
    result = run("predict", scenes, "--out", path, *FEW, "--workers", 1)
    assert result.exit_code == 0, result.output
    assert result.stdout.split() == [str(path)]
    return path


@pytest.mark.cluster
def test_a_client_predicts_the_same(scenes: Path) -> None:
    with pytest.raises(ConfigError, match="workers must not be given with a client, got both"):
        dg.predict_scenes(scenes, client=cast("Client", object()), workers=2)
    expected, blind = dg.predict_scenes(scenes, split="train", simulate=1, count=2, workers=1)
    assert np.isfinite(expected.confidence).all() and blind == 0
    with dg.connect(2) as client:
        found = dg.predict_scenes(scenes, split="train", simulate=1, count=2, client=client)
    assert found[1] == 0
    for name in ("X_FG", "q_grasp", "of_row", "resting", "confidence"):
        np.testing.assert_array_equal(getattr(found[0], name), getattr(expected, name))


def test_grasps_of_scenes_are_those_of_their_views(
    scenes: Path, predicted: Path, own: GraspTable
) -> None:
    """Each row has its best grasps, in the frame of its object."""
    rows = SceneRows(scenes, split="train")
    table = read_attempts(predicted, load_hand(), of=rows)
    assert table.of_row.tolist() == np.repeat(np.arange(len(rows)), 2).tolist()
    assert not any(table.invalid) and table.frame == "object"
    assert table.resting.tolist() == rows.column("grasp_props/resting")[table.of_row].tolist()
    assert set(table.said) == {"from above"}

    data = SceneDataset(scenes, points=None, negatives="none", balance="view")
    X_TG = data[0]["X_AO"].astype(float) @ table.X_FG[:2]
    np.testing.assert_allclose(X_TG, own.X_FG[:2], atol=1e-5)
    np.testing.assert_allclose(table.confidence[:2], own.confidence[:2], atol=1e-3)


def test_an_arm_is_asked_for_the_grasps_of_scenes(
    scenes: Path, predicted: Path, tmp_path: Path
) -> None:
    """Of each view, what the arm reaches comes first, with its joints, in the scene's table."""
    path, arm = tmp_path / "arm.h5", write_arm(tmp_path)
    given = ("--arm", arm, "--base", "-0.42,0,0,0", "--workers", 1)
    result = run("predict", scenes, "--out", path, *FEW[:2], "--count", 40, *given)
    assert result.exit_code == 0, result.output
    rows = SceneRows(scenes, split="train")
    table = read_attempts(path, load_hand(), of=rows)
    with h5py.File(path) as file:
        q, names = file["q_arm"][:], json.loads(file.attrs["arm_joints"])
    assert names == ["pan", "lift", "elbow", "wrist_1", "wrist_2", "wrist_3"]
    assert q.shape == (len(table), 6)
    reached = np.isfinite(q).all(axis=1)
    assert 0 < reached.sum() < len(reached)
    np.testing.assert_array_equal(table.confidence == 0.0, ~reached)
    views = table.of_row
    assert (np.diff(reached.astype(int))[np.diff(views) == 0] <= 0).all()
    count, served = len(set(views.tolist())), len(set(views[reached].tolist()))
    assert f"the arm reaches a grasp of {served} of {count} views" in result.output

    # The joints bring the palm to the object, where the scene has it.
    cell_arm = dg.load_arm(arm, (-0.42, 0.0, 0.0, 0.0))
    cell = make_cell(cell_arm, "barrett", mount_of(cell_arm, load_hand()))
    data = SceneDataset(scenes, points=None, negatives="none", balance="view")
    X_TO = np.array([data[row]["X_AO"] for row in range(len(rows))], dtype=float)
    X_TG = X_TO[views] @ table.X_FG
    found = flange_poses(cell.chain, q[reached])[0] @ cell.X_FG
    np.testing.assert_allclose(found, X_TG[reached], atol=1e-3)
    assert np.abs(X_TO[:, :2, 3]).max() > 0.01  # not in the middle of the table


@pytest.mark.slow
@pytest.mark.nightly
def test_grasps_of_scenes_are_scored(scenes: Path, predicted: Path, tmp_path: Path) -> None:
    given = ("--dataset", scenes, "--split", "train", "--reference", "own", "--quiet")
    result = run("score", predicted, *given, "--out", tmp_path / "card", "--workers", 1)
    assert result.exit_code == 0, result.output
    assert float(result.stdout.split()[1]) > 50.0


@pytest.mark.slow
@pytest.mark.nightly
def test_grasps_of_scenes_become_a_dataset(
    small_dataset: Path, small_meshes: Path, tmp_path: Path
) -> None:
    """The loop: a build, its scenes, grasps for them, and a build of these grasps."""
    out = Path(shutil.copytree(small_dataset, tmp_path / "out"))
    make_scenes(out, overrides=["scenes.views=1"])
    path, tried = tmp_path / "predicted.h5", tmp_path / "tried"
    result = run("predict", out / "scenes.hdf5", "--split", "train", "--out", path, "--count", 1)
    assert result.exit_code == 0, result.output
    given = ("--objects", small_meshes, "--out", tried, "--postures", path, "--quiet")
    result = run("build", *given, "--workers", 1)
    assert result.exit_code == 0, result.output
    with h5py.File(tried / "trials.hdf5") as file, h5py.File(path) as postures:
        outcomes = file["trials/outcome"][:]
        assert len(outcomes) == len(postures["row"]) and Outcome.SUCCESS in outcomes


def test_a_cloud_may_be_in_any_unit(cloud: Path, own: GraspTable, tmp_path: Path) -> None:
    points, path, out = np.load(cloud), tmp_path / "cloud.ply", tmp_path / "grasps.h5"
    lines = "\n".join(" ".join(f"{1e3 * x:.6f}" for x in point) for point in points)
    path.write_text(
        f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n"
        "property float x\nproperty float y\nproperty float z\nend_header\n" + lines
    )
    result = run("predict", path, "--units", "mm", "--out", out, "--count", 3, "--simulate", 0)
    assert result.exit_code == 0, result.output
    assert result.stdout.split() == [str(out)]
    found = read_attempts(out, load_hand(), of="mug")
    assert found.frame == "table" and len(found) == 3
    np.testing.assert_allclose(found.X_FG, own.X_FG[:3], atol=1e-6)


def test_grasps_of_a_depth_image_are_in_the_frame_of_its_camera(
    scenes: Path, tmp_path: Path
) -> None:
    """The table is fitted, and close to the true one; a pose that is given is used."""
    data = SceneDataset(scenes, points=None, negatives="none", balance="view")
    (_, stored, own), X_TC = data.stored_images(data.views[0]), data[0]["X_TC"].astype(float)
    Image.fromarray(stored).save(tmp_path / "depth.png")
    Image.fromarray(own).save(tmp_path / "mask.png")
    camera = tmp_path / "camera.json"
    camera.write_text(json.dumps({"K": data.images(data.views[0])["K"].tolist()}))
    given = ("predict", tmp_path / "depth.png", "--depth-scale", DEPTH_UNIT, "--camera", camera)
    given += ("--mask", tmp_path / "mask.png", "--count", 3, "--simulate", 0)
    result = run(*given, "--out", tmp_path / "fitted.h5")
    assert result.exit_code == 0, result.output
    assert "table: " in result.stderr
    with h5py.File(tmp_path / "fitted.h5") as file:
        assert file["frame"].asstr()[()] == "camera"
        X_TC_fitted, X_CG = file["X_TC"][0], file["X_FG"][:]

    # {T} is elsewhere on the table; the palms are over the object.
    angle = np.rad2deg(np.arccos(min(1.0, X_TC_fitted[2, :3] @ X_TC[2, :3])))
    assert abs(X_TC_fitted[2, 3] - X_TC[2, 3]) < 1e-3 and angle < 0.5
    palms = (X_TC @ X_CG)[:, :3, 3] - data[0]["X_AO"][:3, 3]
    assert np.abs(palms[:, :2]).max() < 0.06 and palms[:, 2].min() > 0.04

    # A pose that is given is used: here the camera is a metre lower.
    np.save(tmp_path / "X_TC.npy", X_TC - np.eye(4, k=1) * [[0], [0], [1], [0]])
    result = run(*given, "--camera-pose", tmp_path / "X_TC.npy", "--out", tmp_path / "known.h5")
    assert "X_TC must place 5% of the pixels" in error_line(result)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--units mm", "--units must be given with a cloud only, got scenes"),
        ("--split valid", "scenes.hdf5: split valid is empty; not empty: train, test"),
        ("--out out.npz", "--out must be a file .h5 or .hdf5"),
        ("--out {scenes}", "another file than INPUT"),
    ],
)
def test_bad_input_is_refused_with_one_line(
    scenes: Path, tmp_path: Path, words: str, said: str
) -> None:
    before, given = scenes.read_bytes(), words.format(scenes=scenes).split()
    result = run("predict", scenes, "--out", tmp_path / "out.h5", *given)
    assert result.exit_code == 2 and said in error_line(result)
    assert not (tmp_path / "out.h5").exists() and scenes.read_bytes() == before
