"""Figures: contacts are drawn where they project, and what is shown is what was asked for."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.data_files import write_data_file
from matplotlib.figure import Figure

from drakegrasp.config import CameraConfig
from drakegrasp.dataset.schema import Field
from drakegrasp.errors import DataError
from drakegrasp.frames import Array, make_pose, pack_pose
from drakegrasp.grasp import pack_grasp
from drakegrasp.pictures import figures
from drakegrasp.pictures.figures import (
    sample_sheet,
)
from drakegrasp.pictures.style import draw_contacts
from drakegrasp.vision.camera import intrinsics, project

DOCS = Path(__file__).resolve().parents[2] / "docs"
CAMERA = CameraConfig()
K = intrinsics(CAMERA)
#: Contacts in {C}: two in front of the surface at 0.25 m, one behind it.
P_CQ = np.array([[-0.03, -0.02, 0.24], [0.04, 0.01, 0.25], [0.0, 0.03, 0.28]])
NHAT_Q_C = np.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
#: X_TC: straight down from 0.5 m over the table.
X_TC = make_pose(np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, 0.5])


def write_blocks(path: Path, names: list[str], split: str = "train") -> None:
    """Write a data file whose samples are all of a square block, 0.25 m before the camera."""
    image = np.full((4, CAMERA.size, CAMERA.size), 0.5, dtype=np.float32)
    mask = np.zeros((CAMERA.size, CAMERA.size), dtype=np.uint8)
    mask[40:90, 40:90] = 1
    image[3] = np.where(mask, 0.25, CAMERA.far)
    values = {
        "images": image,
        "masks": mask,
        "grasps": pack_grasp(P_CQ, NHAT_Q_C),
        "object_props/frame_cam2img_otm": pack_pose(make_pose(np.eye(3), [0.0, 0.0, 0.25])),
        "object_props/frame_work2cam_oto": pack_pose(X_TC),
        "object_props/frame_work2cam_otm": pack_pose(X_TC),
    }

    def value(field: Field, row: int) -> object:
        if field.name == "trial_id":
            return 10 + row
        return names[row] if field.dtype == "str" else values.get(field.name, 0.0)

    camera = {"K": K, "near": CAMERA.near, "far": CAMERA.far}
    write_data_file(path, len(names), value, split=split, image=CAMERA.size, **camera)


def test_the_sheet_of_a_dataset_has_all_objects(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "grasping_oto.hdf5"
    write_blocks(path, [])
    with pytest.raises(DataError, match="at least one sample"):
        sample_sheet(path)
    write_blocks(path, ["1_mug_small", "1_mug_small", "2_box"], split="test")
    figure, trials = sample_sheet(path)
    assert trials == [10, 11, 12]
    assert notes(figure) == "3 of 3 samples, 2 of 2 objects with samples"

    # More objects than places have a sample each, and there is a limit.
    monkeypatch.setattr(figures, "PLACES", 4)
    monkeypatch.setattr(figures, "MOST", 6)
    for objects, drawn, note in (
        (2, [10, 12, 11, 13], "4 of 10 samples, 2 of 2 objects with samples"),
        (5, [10, 11, 12, 13, 14], "5 of 10 samples, 5 of 5 objects with samples"),
        (9, [10, 12, 13, 15, 16, 18], "6 of 10 samples, 6 of 9 objects with samples"),
    ):
        write_blocks(path, [f"{1 + i % objects}_box" for i in range(10)])
        figure, trials = sample_sheet(path)
        assert trials == drawn
        assert notes(figure) == note


def notes(figure: Figure) -> str:
    return figure.texts[0].get_text()


def test_examples_of_the_docs_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (DOCS / "reference" / "frames-and-units.md").read_text(encoding="utf-8")
    (tmp_path / "OUT").mkdir()
    write_blocks(tmp_path / "OUT" / "grasping_oto.hdf5", ["1_mug"])
    monkeypatch.chdir(tmp_path)
    space: dict[str, Array] = {}
    for block in re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL):
        exec(block, space)
    np.testing.assert_allclose(space["uv"], project(K, P_CQ), atol=1e-4)
    assert "Q3: pixel (64, 78), 30 mm behind" in capsys.readouterr().out
    np.testing.assert_allclose(space["p_TQ"][0], [-0.03, 0.02, 0.26], atol=1e-6)
    np.testing.assert_allclose(space["p_DQ"], P_CQ, atol=1e-6)
    np.testing.assert_allclose(space["p_LQ"], P_CQ * [1.0, -1.0, -1.0], atol=1e-6)
    np.testing.assert_allclose(space["X_TL"][:3, 2], [0.0, 0.0, 1.0], atol=1e-6)
    assert f"f = {K[0, 0]:.2f} px, c = {K[0, 2]:.1f} px" in text


def test_a_finger_that_a_grasp_leaves_out_is_not_drawn() -> None:
    """Its contact is NaN."""
    points = np.array([[0.0, 0.0, 0.3], [np.nan] * 3, [0.01, 0.0, 0.3]])
    sample = SimpleNamespace(
        image=np.ones((4, 16, 16), np.float32),
        mask=np.ones((16, 16), np.uint8),
        grasp=pack_grasp(points, np.where(np.isnan(points), np.nan, [0.0, 1.0, 0.0])),
        fingers=np.array([True, False, True]),
    )
    axes = Figure().add_subplot()
    draw_contacts(axes, sample, np.diag([20.0, 20.0, 1.0]))
    assert {line.get_gid() for line in axes.lines} - {None} >= {"contact 0", "contact 2"}
    assert "contact 1" not in {line.get_gid() for line in axes.lines}


def test_a_file_that_is_missing_is_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"missing\.hdf5: must be a data file"):
        sample_sheet(tmp_path / "missing.hdf5")
