"""`drakegrasp predict` of clouds and depth images: the grasps, and what is refused."""

from __future__ import annotations

import json
import re
from pathlib import Path

import h5py
import numpy as np
import pytest
import trimesh
from helpers.commands import error_line, run
from helpers.depth_images import WIDE, X_TC, K, image
from PIL import Image

from drakegrasp.frames import invert_pose


@pytest.fixture
def files(tmp_path: Path) -> Path:
    """A folder with a depth image, a mask, poses of the camera and clouds."""
    depth, mask = image()
    np.save(tmp_path / "depth.npy", depth)
    Image.fromarray(mask).save(tmp_path / "mask.png")
    sides = np.where(mask, 1 + (np.arange(WIDE) >= 80), 0)
    for name, values in {"labels": sides, "left": sides == 1}.items():
        np.save(tmp_path / f"{name}.npy", values)
    np.save(tmp_path / "sunk.npy", np.where(sides == 2, 1.5 * depth, depth))
    np.save(tmp_path / "one.npy", np.ones((4, 5)))
    for name, pose in {"X_TC": X_TC, "X_CT": invert_pose(X_TC)}.items():
        np.save(tmp_path / f"{name}.npy", pose)
    corners = np.random.default_rng(0).uniform(-1.0, 1.0, (60, 3)) * [0.04, 0.03, 0.05]
    for name, z in {"cloud": 0.05, "below": -0.2}.items():
        np.save(tmp_path / f"{name}.npy", corners + np.array([0.0, 0.0, z]))
    np.save(tmp_path / "nan.npy", np.where(corners > 0.03, np.nan, corners))
    np.save(tmp_path / "far.npy", 1e3 * corners)
    Image.fromarray(0 * mask.astype(np.uint8)).save(tmp_path / "zero.png")
    trimesh.creation.box([0.1, 0.1, 0.1]).export(tmp_path / "mesh.ply")
    K_of = {"K": K.tolist(), "width": 1280, "height": 960}
    (tmp_path / "K.json").write_text(json.dumps(K_of))
    (tmp_path / "a.txt").write_text("points")
    return tmp_path


#: The depth image, its camera and its mask.
SEEN = f"depth.npy --camera {K[0, 0]},{K[1, 1]},{K[0, 2]},{K[1, 2]} --mask mask.png"
LABELLED = SEEN.replace("mask.png", "labels.npy")
NINE = "one.npy --camera 9,9,2,1.5"


def predict(files: Path, words: str):
    """Run the command on files of a folder."""
    given = [str(files / word) if (files / word).exists() else word for word in words.split()]
    return run("predict", *given, "--out", files / "out.h5")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (f"{SEEN} --camera-pose X_CT.npy", "is it inverted (X_CT), or in another unit?"),
        ("cloud.npy --units cm", "must be points (n, 3) of one object"),
        ("cloud.npy --mask cloud.npy", "--mask must be given with a depth image only, got a cloud"),
        ("cloud.npy --split test", "--split must be given with scenes only, got a cloud"),
        ("cloud.npy --set hand=magic", "got 'magic'"),
        ("cloud.npy --simulate -1", "Must be >= 0"),
        ("cloud.npy --count 0", "Must be >= 1"),
        ("one.npy --units m", "must be a cloud (n, 3), got (4, 5): a depth image needs --camera"),
        (NINE, "--mask must be given with a depth image, got none"),
        ("one.npy --camera 9,9,2 --mask one.npy", "must be fx,fy,cx,cy in pixels, or a JSON file"),
        (f"{NINE} --mask one.npy", "mask must be 0 beside the object"),
        (f"{NINE} --mask one.npy --depth-scale 2", "with a .png only"),
        ("a.txt", "INPUT must be .hdf5, .npy, .ply or .png"),
        ("below.npy", "the table must be z = 0"),
        (
            "depth.npy --camera K.json --mask mask.png",
            "K.json: camera must be for 160 x 120 pixels",
        ),
        ("far.npy", "m apart: is it in another unit?"),
        ("nan.npy", "of 180 numbers that are not finite"),
        ("mesh.ply", "got a mesh: sample its surface"),
        ("depth.npy --mask mask.png", "a depth image in a .npy file needs --camera"),
        (SEEN.replace("mask.png", "zero.png"), "zero.png: mask is 0 everywhere"),
        (f"{SEEN} --camera-pose one.npy", "one.npy: X_TC must be a pose"),
        ("cloud.npy --object-label 1", "--object-label must be given with a depth image only, got"),
        (
            f"{SEEN} --object-label 1",
            "mask must be whole numbers (h, w), with 1 on the object, got bool",
        ),
        (LABELLED, "or of several objects (--object-label)? Write the mask of one as PNG or .npy"),
        (f"{LABELLED} --object-label 3", "with 3 on the object, got 0, 1, 2"),
        (
            f"{LABELLED} --object-label 1 --camera-pose X_TC.npy".replace("depth", "sunk"),
            "neighbour 2 of the mask: cloud must be points (n, 3) of one object",
        ),
    ],
)
def test_bad_input_is_refused_with_one_line(files: Path, words: str, said: str) -> None:
    result = predict(files, words)
    assert result.exit_code == 2 and said in error_line(result)
    assert not (files / "out.h5").exists()


@pytest.mark.parametrize("old", ["dataset", "text"])
def test_no_file_but_postures_is_replaced(files: Path, old: str) -> None:
    if old == "text":
        (files / "out.h5").write_text("notes")
    else:
        with h5py.File(files / "out.h5", "w") as file:
            file["trials/outcome"] = [1, 2]
    before = (files / "out.h5").read_bytes()
    assert "must be a new file or one of postures" in error_line(predict(files, "cloud.npy"))
    assert (files / "out.h5").read_bytes() == before


@pytest.mark.sim
def test_lifts_change_the_chances_and_what_to_expect_is_printed(files: Path) -> None:
    """The second file replaces the first. A folder with a name that is not written does not matter.

    A view shows more than its cloud.
    """
    (files / "out.jsonl").mkdir()
    told = []
    for words in ("cloud.npy --simulate 0", "cloud.npy --simulate 1", f"{SEEN} --simulate 1"):
        result = predict(files, f"{words} --set objects.mass=0.3 --count 3")
        assert result.exit_code == 0, result.output
        told.append(result.stderr.splitlines()[-1])
        with h5py.File(files / "out.h5") as file:
            confidence = file["confidence"][:]
        assert len(confidence) == 3 and (np.diff(confidence) <= 0.0).all()
        assert f"{confidence[0]:.0%}" in told[-1]
    assert "no lift was tried" in told[0]
    assert "1 tried on the object completed from the cloud" in told[1]
    assert "1 tried on the object completed from the view" in told[2]
    assert "chance" not in predict(files, "cloud.npy --simulate 0 --quiet").stderr


@pytest.mark.sim
def test_neighbours_in_the_mask_are_in_the_way_of_lifts(files: Path) -> None:
    """The left half of the box: alone, and with the other half beside it."""
    found = dict[tuple[str, int], tuple[np.ndarray, str]]()
    for name, mask in {"left": "left.npy", "labels": "labels.npy --object-label 1"}.items():
        for lifts in (0, 1):
            seen = f"{SEEN.replace('mask.png', mask)} --camera-pose X_TC.npy --simulate {lifts}"
            result = predict(files, f"{seen} --set objects.mass=0.3")
            assert result.exit_code == 0, result.output
            with h5py.File(files / "out.h5") as file:
                found[name, lifts] = file["confidence"][:], result.stderr
    np.testing.assert_array_equal(found["labels", 0][0], found["left", 0][0])
    assert found["labels", 1][0].max() < found["left", 1][0].max() - 0.005
    told = {
        key for key, (_, words) in found.items() if "1 neighbour completed from the view" in words
    }
    assert told == {("labels", 1)}


def test_a_pose_that_is_given_is_checked_with_the_image(files: Path) -> None:
    result = predict(files, f"{SEEN} --camera-pose X_TC.npy --count 1 --simulate 0")
    assert result.exit_code == 0, result.output
    assert "% of the pixels beside the object; the camera is" in result.stderr


def test_a_png_is_in_millimetres_unless_its_scale_is_given(files: Path) -> None:
    """Of the same image, quantised: the camera is as far above the fitted table."""
    depth = np.nan_to_num(np.load(files / "depth.npy"))
    for name, unit in (("mm", 0.001), ("quarters", 0.00025)):
        Image.fromarray(np.rint(depth / unit).astype(np.uint16)).save(files / f"{name}.png")
    heights = []
    for seen in ("depth.npy", "mm.png", "quarters.png --depth-scale 0.00025"):
        result = predict(files, SEEN.replace("depth.npy", seen) + " --count 1 --simulate 0")
        assert result.exit_code == 0, result.output
        heights += re.findall(r"the camera is (\d+) mm above it", result.stderr)
    np.testing.assert_allclose(list(map(int, heights)), [1e3 * X_TC[2, 3]] * 3, atol=1.0)
