"""Sheets, plots and thumbnails: contacts are where they project, bars as long as counts."""

from __future__ import annotations

import json
import re
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import h5py
import matplotlib as mpl
import numpy as np
import pytest
from helpers import datasets
from helpers.assertions import contents
from helpers.data_files import write_data_file
from helpers.datasets import OTO, TRIALS, edit_file, make_dataset
from matplotlib.figure import Figure
from matplotlib.image import imread

from drakegrasp.config import CameraConfig
from drakegrasp.dataset.assemble import assemble
from drakegrasp.dataset.schema import Field
from drakegrasp.errors import DataError
from drakegrasp.filters import Removal
from drakegrasp.frames import Array, make_pose, pack_pose
from drakegrasp.grasp import pack_grasp
from drakegrasp.outcomes import Outcome
from drakegrasp.pictures import figures
from drakegrasp.pictures.charts import card_picture, draw_distributions
from drakegrasp.pictures.figures import NUMBERS_FILE, sample_sheet, write_figures
from drakegrasp.pictures.style import MASK, NO_DEPTH, draw_contacts, strip_png
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
    with pytest.raises(DataError, match=r"oto\.hdf5: must be a data file"):
        sample_sheet(path)
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


# Plots and thumbnails


def test_what_is_beyond_a_histogram_is_in_its_last_bin() -> None:
    values = np.append(np.linspace(0.0, 1.0, 99), [50.0, np.nan])
    groups = {"samples": np.ones(101, bool), "stable": values < 0.5}
    figure = draw_distributions([("slip [mm]", values)], groups, title="101 samples")
    assert figure.legends[0].get_title().get_text() == "101 samples"
    samples, stable = (patch.get_data().values for patch in figure.axes[0].patches)
    assert samples.sum() == 100
    assert stable.sum() == (values < 0.5).sum()
    assert figure.axes[0].get_xlim()[1] < 2.0


def test_panels_of_a_card_state_what_they_draw(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("drakegrasp.pictures.charts.png_bytes", lambda figure, dpi: figure)
    each = {
        "measures": {
            "headline": {"value": 0.5, "low": 0.25, "high": 0.75},
            "lifted": {"value": 0.6},
        },
        "lifted_within_mm": {"0": 0.0, "20": 0.5, "40": 0.6},
        "calibration": [{"confidence": 0.1, "share": 0.2}, {"confidence": 0.9, "share": 0.7}],
    }
    card = {
        "sets": {"net": each},
        "headline": ["net"],
        "measures": ["lifted"],
        "limit_mm": 20.0,
        "rows": 8,
        "objects": 2,
        "classes": 1,
        "dataset": {"file": "data.hdf5", "split": "test", "rows_sha256": "0" * 64},
        "settings": {"versions": {"drake": "1", "drakegrasp": "2"}},
    }
    figure: Any = card_picture(card)
    headline, curves, calibration = figure.axes
    assert headline.get_xlabel() == "per cent of rows, mean over objects"
    assert curves.get_xlabel() == "d: largest distance from a requested contact [mm]"
    assert calibration.get_xlabel() == "stated confidence, five groups"
    assert [line.get_xdata().tolist() for line in headline.lines] == [[25.0, 75.0], [50.0], [60.0]]
    assert curves.lines[0].get_xydata().tolist() == [[0.0, 0.0], [20.0, 50.0], [40.0, 60.0]]
    assert calibration.lines[0].get_xydata().tolist() == [[0.1, 20.0], [0.9, 70.0]]


def panels(image: np.ndarray, mask: np.ndarray) -> list[np.ndarray]:
    """Return the three panels (S, S, 4) uint8 of a strip."""
    strip = imread(BytesIO(strip_png(image, mask, far=0.75)))
    assert strip.shape == (4, 12, 4)
    return np.split(np.rint(255.0 * strip).astype(np.uint8), 3, axis=1)


def test_strip_is_colour_depth_and_mask() -> None:
    image = np.zeros((4, 4, 4), dtype=np.float32)
    image[0, 1, 2], image[3] = 1.0, 0.75
    image[3, 1, 2], image[3, 0, 0] = 0.3, 0.5
    mask = np.zeros((4, 4), dtype=np.uint8)
    mask[1, 2] = 1
    colour, depth, seen = panels(image, mask)
    assert colour[1, 2].tolist() == [255, 0, 0, 255]
    assert (np.delete(colour.reshape(16, 4), 6, axis=0) == [0, 0, 0, 255]).all()
    # The nearest pixel is the first of the colours, the farthest with a depth the last.
    assert depth[1, 2].tolist() == [253, 231, 37, 255]
    assert depth[0, 0].tolist() == [68, 1, 84, 255]
    assert (depth[2:] == NO_DEPTH).all()
    assert seen[1, 2].tolist() == MASK[1].tolist()
    assert (seen[2:] == MASK[0]).all()


# All figures of a dataset


ALL = {"sheet", "outcomes", "distributions"}


def lose_all(out: Path) -> None:
    """Let every attempt of a dataset end as a failure."""

    def lose(file: h5py.File) -> None:
        file["trials/outcome"][:] = Outcome.DROPPED
        file["successes/removal"][:] = Removal.SLID

    edit_file(out / TRIALS, lose)


@pytest.mark.nightly
def test_the_same_dataset_gives_the_same_bytes(
    sound: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written = write_figures(sound, tmp_path / "a")
    assert written.left_out == {}
    assert set(written.names) == ALL
    files = contents(tmp_path / "a")
    assert set(files) == {f"{n}{s}" for n in ALL for s in (".png", ".svg")} | {NUMBERS_FILE}
    for name, content in files.items():
        if name.endswith(".svg"):
            ElementTree.fromstring(content)
            assert b"<dc:date>" not in content
    numbers = json.loads(files[NUMBERS_FILE])
    assert numbers["outcomes"]["samples"] == 9

    # The style of somebody's papers changes nothing.
    with mpl.rc_context({"font.size": 25, "axes.grid": True, "savefig.dpi": 30}):
        write_figures(sound, tmp_path / "b")
    again = contents(tmp_path / "b")
    assert {name for name in files if files[name] != again[name]} == set()


def test_what_the_dataset_lacks_is_left_out(out: Path, tmp_path: Path) -> None:
    (out / OTO).unlink()
    lose_all(out)
    folder = tmp_path / "figures"
    folder.mkdir()
    for name in ("distributions.png", "sheet.svg", "mine.png"):
        (folder / name).touch()
    written = write_figures(out, folder)
    assert set(written.names) == {"outcomes"}
    assert written.left_out["distributions"] == "no attempt became a sample"
    assert OTO in written.left_out["sheet"]
    # A picture of what was there before is removed, and nothing else.
    assert {p.name for p in folder.glob("*.png")} == {
        *(f"{name}.png" for name in written.names),
        "mine.png",
    }
    assert not (folder / "sheet.svg").exists()
    assert json.loads((folder / NUMBERS_FILE).read_text())["outcomes"]["samples"] == 0


def test_pictures_of_samples_count_the_same_rows(out: Path, tmp_path: Path) -> None:
    """Two of the nine successes are removed; each picture tells of the seven samples."""
    assemble(out, rejected=[0, 12])
    assert "sheet" in write_figures(out, tmp_path / "figures").names
    numbers = json.loads((tmp_path / "figures" / NUMBERS_FILE).read_text())
    assert numbers["outcomes"]["samples"] == 7
    assert numbers["outcomes"]["removed: rejected"] == 2
    assert sum(numbers["outcomes"].values()) == 36
    assert sorted(numbers["sheet"]["trial_ids"]) == [3, 11, 15, 23, 24, 27, 35]


def test_names_are_drawn_as_they_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of one object, whose name would be a formula, a tag, and letters that the font lacks."""
    name = "1_$^$ <script>&\"' 碗 x" + 30 * "y"
    monkeypatch.setattr(datasets, "BOXES", {name: ((0.06, 0.05, 0.10), "a $^$ class")})
    out = make_dataset(tmp_path / "out", tmp_path)
    written = write_figures(out, tmp_path / "figures")
    assert set(written.names) == ALL
    for svg in (tmp_path / "figures").glob("*.svg"):
        assert b"<script" not in svg.read_bytes()
