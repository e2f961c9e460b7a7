"""`drakegrasp predict`: scenes, clouds and depth images to files of postures."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.commands import error_line, run
from helpers.datasets import make_dataset

from drakegrasp.dataset.scenes import SceneDataset, SceneRows
from drakegrasp.exchange.attempts import read_attempts
from drakegrasp.generation.scenes import make_scenes
from drakegrasp.hand.description import load_hand
from drakegrasp.scoring.network import load_network
from drakegrasp.vision.depth_image import cloud_from_depth

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
def predicted(scenes: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("predicted") / "predicted.h5"
    result = run("predict", scenes, "--out", path, *FEW, "--workers", 1)
    assert result.exit_code == 0, result.output
    assert result.stdout.split() == [str(path)]
    return path


def test_grasps_of_scenes_are_those_of_their_views(
    scenes: Path, predicted: Path, cloud: Path
) -> None:
    """Each row has its best grasps, in the frame of its object."""
    rows = SceneRows(scenes, split="train")
    table = read_attempts(predicted, load_hand(), of=rows)
    assert table.of_row.tolist() == np.repeat(np.arange(len(rows)), 2).tolist()
    assert not any(table.invalid) and table.frame == "object"
    assert table.resting.tolist() == rows.column("grasp_props/resting")[table.of_row].tolist()
    assert set(table.said) == {"from above"}

    own = load_network().predict(np.load(cloud), count=2)
    data = SceneDataset(scenes, points=None, negatives="none", balance="view")
    X_TG = data[0]["X_AO"].astype(float) @ table.X_FG[:2]
    np.testing.assert_allclose(X_TG, own.X_FG, atol=1e-5)
    np.testing.assert_allclose(table.confidence[:2], own.confidence, atol=1e-3)


@pytest.mark.slow
@pytest.mark.nightly
def test_grasps_of_scenes_are_scored(scenes: Path, predicted: Path, tmp_path: Path) -> None:
    given = (
        "--dataset",
        scenes,
        "--split",
        "train",
        "--reference",
        "own",
        "--out",
        tmp_path / "card",
        "--quiet",
    )
    result = run("score", predicted, *given, "--workers", 1)
    assert result.exit_code == 0, result.output
    assert float(result.stdout.split()[1]) > 50.0


@pytest.mark.slow
@pytest.mark.nightly
def test_grasps_of_scenes_become_a_dataset(
    small_dataset: Path, small_meshes: Path, tmp_path: Path
) -> None:
    """The loop: a build, its scenes, grasps for them, and a build of these grasps."""
    out = tmp_path / "out"
    out.symlink_to(small_dataset)
    make_scenes(out, overrides=["scenes.views=1"])
    path, tried = tmp_path / "predicted.h5", tmp_path / "tried"
    result = run("predict", out / "scenes.hdf5", "--split", "train", "--out", path, "--count", 1)
    assert result.exit_code == 0, result.output
    given = ("--objects", small_meshes, "--out", tried, "--postures", path, "--quiet")
    result = run("build", *given, "--workers", 1)
    assert result.exit_code == 0, result.output
    with h5py.File(tried / "trials.hdf5") as file, h5py.File(path) as postures:
        assert len(file["trials/outcome"]) == len(postures["row"])


@pytest.mark.slow
@pytest.mark.nightly
def test_workers_change_nothing(scenes: Path, predicted: Path, tmp_path: Path) -> None:
    result = run("predict", scenes, "--out", tmp_path / "by 2.h5", *FEW, "--workers", 2)
    assert result.exit_code == 0, result.output
    assert (tmp_path / "by 2.h5").read_bytes() == predicted.read_bytes()


def test_a_cloud_may_be_in_any_unit(cloud: Path, tmp_path: Path) -> None:
    out, points = tmp_path / "grasps.h5", np.load(cloud)
    result = run("predict", cloud, "--out", out)
    assert result.exit_code == 0, result.output
    assert result.stdout.split()[0] == str(out) and "The best grasps" in result.stdout
    lines = "\n".join(" ".join(f"{1e3 * x:.6f}" for x in point) for point in points)
    (tmp_path / "cloud.ply").write_text(
        f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n"
        "property float x\nproperty float y\nproperty float z\nend_header\n" + lines
    )
    again = tmp_path / "again.h5"
    result = run("predict", tmp_path / "cloud.ply", "--units", "mm", "--out", again, "--count", 3)
    assert result.exit_code == 0, result.output
    one, other = (read_attempts(path, load_hand(), of="seen") for path in (out, again))
    assert one.frame == "table" and len(other) == 3
    np.testing.assert_allclose(other.X_FG, one.X_FG[:3], atol=1e-6)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("{cloud} --units cm", "must be points (n, 3) of one object"),
        ("{cloud} --mask {cloud}", "--mask must be given with a depth image only, got a cloud"),
        ("{cloud} --split test", "--split must be given with scenes only, got a cloud"),
        ("{scenes} --units mm", "--units must be given with a cloud only, got scenes"),
        ("{cloud} --network magic", "got 'magic'"),
        ("{cloud} --count 0", "0 is not in the range"),
        ("{image} --units m", "must be a cloud (n, 3), got (4, 5): a depth image needs --camera"),
        ("{image} --camera 9,9,2,2", "--mask must be given with a depth image, got none"),
        ("{image} --camera 9,9,2 --mask {image}", "must be fx,fy,cx,cy in pixels, or a JSON file"),
        ("{scenes} --split valid", "in valid"),
        ("{text}", "INPUT must be .hdf5, .npy, .ply or .png"),
    ],
)
def test_bad_input_is_refused_with_one_line(
    scenes: Path, cloud: Path, tmp_path: Path, words: str, said: str
) -> None:
    image, text = tmp_path / "image.npy", tmp_path / "a.txt"
    np.save(image, np.ones((4, 5)))
    text.write_text("points")
    given = words.format(scenes=scenes, cloud=cloud, image=image, text=text).split()
    result = run("predict", *given, "--out", tmp_path / "out.h5")
    assert result.exit_code == 2 and said in error_line(result)
    assert not (tmp_path / "out.h5").exists()


def test_a_file_that_cannot_be_written_is_refused_before_any_work(scenes: Path) -> None:
    assert "--out must be a file .h5 or .hdf5" in error_line(
        run("predict", scenes, "--out", "out.npz")
    )
