"""A folder for the Hub: its values are those of the dataset, and its card says what they are."""

from __future__ import annotations

import io
import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from helpers.commands import run
from helpers.datasets import change
from PIL import Image

from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.dataset.schema import DEPTH_UNIT, SPLITS
from drakegrasp.dataset.statistics import count_funnel
from drakegrasp.errors import MachineError
from drakegrasp.exchange import hub
from drakegrasp.exchange.export import export_dataset

pq = pytest.importorskip("pyarrow.parquet")
pytest.importorskip("datasets")

#: What `datasets` finds in a folder, in a process of its own: it loads half of the packages of the
#: environment, whose warnings are not ours.
LOADER = """
import json, sys
import datasets, numpy as np
folder, cache = sys.argv[1:]
found = {}
for config in datasets.get_dataset_config_names(folder):
    for split, rows in datasets.load_dataset(folder, config, cache_dir=cache).items():
        streamed = datasets.load_dataset(folder, config, streaming=True)[split]
        found[f"{config}/{split}"] = {
            "trial_id": rows["trial_id"][:],
            "streamed": [row["trial_id"] for row in streamed],
            "pixels": [
                [np.asarray(row[name]).tolist() for name in ("image", "depth", "mask")]
                for row in rows
            ],
        }
print(json.dumps(found))
"""


@pytest.fixture(scope="module")
def folder(exported: Callable[[str], Path]) -> Path:
    return exported("hf")


def table_of(folder: Path, config: str, split: str) -> list[dict[str, Any]]:
    paths = sorted((folder / config).glob(f"{split}-*.parquet"))
    return [row for path in paths for row in pq.read_table(path).to_pylist()]


def pixels_of(cell: dict[str, Any]) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(cell["bytes"])))


@pytest.mark.parametrize("camera", ["oto", "otm"])
@pytest.mark.parametrize("split", SPLITS)
def test_rows_are_those_of_the_data_file(
    dataset: Path, folder: Path, camera: str, split: str
) -> None:
    """Contacts, poses, joints, forces and all else that is no image bit for bit."""
    data = GraspDataset(dataset / f"grasping_{camera}.hdf5", split=split)
    rows = table_of(folder, camera, split)
    assert len(rows) == len(data) > 0
    assert set(rows[0]) == {*hub.COLUMNS, "image", "depth", "mask"}
    for name, field in hub.COLUMNS.items():
        own = data.column(field.name).tolist()
        np.testing.assert_equal([row[name] for row in rows], own, err_msg=name)
    for row, sample in zip(rows, data, strict=True):
        colour = np.moveaxis(pixels_of(row["image"]) / 255.0, -1, 0)
        assert np.abs(colour - sample.image[:3]).max() <= 0.5 / 255.0 + 1e-6
        depth = pixels_of(row["depth"]) * DEPTH_UNIT
        assert np.abs(depth - sample.image[3]).max() <= 0.51 * DEPTH_UNIT
        assert (pixels_of(row["mask"]) == 255 * sample.mask).all()


@pytest.mark.nightly
@pytest.mark.slow
def test_datasets_loads_what_the_files_hold(folder: Path, tmp_path: Path) -> None:
    process = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", LOADER, str(folder), str(tmp_path)],
        capture_output=True,
        text=True,
        check=False,
        env={"PATH": "", "HOME": str(tmp_path), "HF_HUB_OFFLINE": "1", "HF_HOME": str(tmp_path)},
    )
    assert process.returncode == 0, process.stderr
    found = json.loads(process.stdout.splitlines()[-1])
    assert set(found) == {f"{camera}/{split}" for camera in ("oto", "otm") for split in SPLITS}
    for name, read in found.items():
        rows = table_of(folder, *name.split("/"))
        assert read["trial_id"] == read["streamed"] == [row["trial_id"] for row in rows]
        for pixels, row in zip(read["pixels"], rows, strict=True):
            for values, image in zip(pixels, ("image", "depth", "mask"), strict=True):
                np.testing.assert_array_equal(values, pixels_of(row[image]))


def test_card_names_licence_files_and_samples(dataset: Path, folder: Path) -> None:
    head, text = (folder / "README.md").read_text(encoding="utf-8").split("---\n")[1:]
    described = yaml.safe_load(head)
    assert described["license"] == "cc-by-4.0"
    assert [config["config_name"] for config in described["configs"]] == ["oto", "otm"]
    for config in described["configs"]:
        for entry in config["data_files"]:
            assert list(folder.glob(entry["path"]))
    assert described["pretty_name"] == "Simulated grasps of 3 objects"
    for count in count_funnel(dataset).splits:
        assert f"| {count.split} | {count.samples} | {count.distinct} |" in text
    assert "* not stated: 1_box_a, 2_box_b, 3_brick" in text
    assert str(GraspDataset(dataset / "grasping_oto.hdf5").K.tolist()) in text
    assert "it is 0.75 m" in " ".join(text.split())
    for absent in ("trials.hdf5", "manifest.json", "grasping_o"):
        assert absent not in text


def test_long_splits_are_cut_into_files(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hub, "FILE_ROWS", 2)
    assert run("export", dataset, tmp_path / "to", "--to", "hf").exit_code == 0
    data = GraspDataset(dataset / "grasping_oto.hdf5", split="test")
    assert len(list((tmp_path / "to" / "oto").glob("test-*.parquet"))) == -(-len(data) // 2) > 1
    ids = [row["trial_id"] for row in table_of(tmp_path / "to", "oto", "test")]
    assert ids == data.column("trial_id").tolist()


def test_seeds_of_64_bits_are_exported(dataset: Path, tmp_path: Path) -> None:
    out = Path(shutil.copytree(dataset, tmp_path / "out"))
    change(out, "grasping_oto.hdf5", "test/conditions/depth_seed", 0, lambda _: 2**64 - 1)
    export_dataset(out, tmp_path / "to", "hf")
    assert table_of(tmp_path / "to", "oto", "test")[0]["depth_seed"] == 2**64 - 1


def test_missing_datasets_is_one_line(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "datasets", None)
    with pytest.raises(MachineError, match=r"needs datasets, got none: pip install"):
        export_dataset(dataset, tmp_path / "to", "hf")
    assert not list(tmp_path.iterdir())
