"""Scenes in a folder for the Hub: the official loaders open them, and all is as in scenes.hdf5."""

from __future__ import annotations

import io
import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from PIL import Image

from drakegrasp.dataset.schema import SCENE_GRASP_FIELDS, SPLITS, VIEW_FIELDS, Field
from drakegrasp.errors import DataError
from drakegrasp.exchange.export import export_dataset
from drakegrasp.generation.scenes import make_scenes

pytest.importorskip("pyarrow")
pytestmark = pytest.mark.sim

#: What the official loaders say of a folder, in a process of their own.
LOADERS = """
import json, sys
import datasets, mlcroissant, numpy as np
folder, cache = sys.argv[1:]
views, grasps = (
    datasets.load_dataset(folder, name, cache_dir=cache)["train"]
    for name in ("views", "scene_grasps")
)
records = mlcroissant.Dataset(f"{folder}/croissant.json")
issues = records.metadata.ctx.issues
wanted = [each.uuid for each in records.metadata.record_sets if "/train" in each.uuid]
print(json.dumps({
    "scene": views["scene"][:], "K": views["K"][:], "grasps": grasps["trial_id"][:],
    "sums": [np.asarray(views[0][name]).astype(int).sum().item()
             for name in ("image", "depth", "mask")],
    "croissant": {name: sum(1 for _ in records.records(name)) for name in wanted},
    "complaints": sorted(issues.errors | issues.warnings),
}))
"""


@pytest.fixture(scope="module")
def made(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The dataset with scenes."""
    out = Path(shutil.copytree(dataset, tmp_path_factory.mktemp("scenes") / "out"))
    make_scenes(out, overrides=["scenes.views=2", "scenes.width=64", "scenes.height=48"])
    return out


@pytest.fixture(scope="module")
def folder(made: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    to = tmp_path_factory.mktemp("hub") / "to"
    export_dataset(made, to, "hf")
    return to


def rows_of(folder: Path, config: str, split: str) -> list[dict[str, Any]]:
    import pyarrow.parquet as pq

    return [
        row
        for path in sorted((folder / config).glob(f"{split}-*.parquet"))
        for row in pq.read_table(path).to_pylist()
    ]


@pytest.mark.parametrize(
    ("config", "group", "fields"),
    [("views", "views", VIEW_FIELDS), ("scene_grasps", "grasps", SCENE_GRASP_FIELDS)],
)
def test_every_row_is_that_of_the_file(
    made: Path, folder: Path, config: str, group: str, fields: tuple[Field, ...]
) -> None:
    """Images, numbers, and what is said of the scene, in the split of the scene."""
    with h5py.File(made / "scenes.hdf5") as file:
        own, scenes, names = file[group], file["scenes"], file["objects/name"].asstr()[:]
        of_rows = scenes["split"][:][own["scene"][:]]
        for number, split in enumerate(SPLITS):
            found = rows_of(folder, config, split)
            places = np.flatnonzero(of_rows == number)
            assert len(found) == len(places) > 0 or split == "valid"
            for row, i in zip(found, places, strict=True):
                scene = row["scene"]
                assert row["object_name"] == [names[scenes["object"][scene, 0]]]
                assert row["X_TO"] == scenes["X_TO"][scene].tolist()
                for field in fields:
                    if field.name not in own:  # an optional column
                        continue
                    value = row["image" if field.name == "rgb" else field.name]
                    if field.sample:
                        value = np.asarray(Image.open(io.BytesIO(value["bytes"])))
                    np.testing.assert_array_equal(value, own[field.name][i], err_msg=field.name)


@pytest.mark.slow
def test_official_loaders_read_them(made: Path, folder: Path, tmp_path: Path) -> None:
    pytest.importorskip("datasets")
    pytest.importorskip("mlcroissant")
    process = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", LOADERS, str(folder), str(tmp_path)],
        capture_output=True,
        text=True,
        check=False,
        env={"PATH": "", "HOME": str(tmp_path), "HF_HUB_OFFLINE": "1", "HF_HOME": str(tmp_path)},
    )
    assert process.returncode == 0, process.stderr
    found = json.loads(process.stdout.splitlines()[-1])
    with h5py.File(made / "scenes.hdf5") as file:
        views, grasps = (
            np.flatnonzero(file["scenes/split"][:][file[group]["scene"][:]] == 0)
            for group in ("views", "grasps")
        )
        assert found["scene"] == file["views/scene"][views].tolist()
        assert found["K"] == file["views/K"][views].tolist()
        assert found["grasps"] == file["grasps/trial_id"][grasps].tolist()
        images = [file["views"][name][views[0]] for name in ("rgb", "depth", "mask")]
    assert found["sums"] == [int(image.sum()) for image in images]
    # It was made by nobody who said a licence.
    assert all("license" in text or "recommended" in text for text in found["complaints"])
    counts = {"views": len(views), "scene_grasps": len(grasps)}
    for config, count in counts.items():
        assert found["croissant"][f"{config}/train-00000-of-00001"] == count


def test_card_tells_their_rows_and_columns(folder: Path) -> None:
    text = (folder / "README.md").read_text(encoding="utf-8")
    for config in ("views", "scene_grasps"):
        assert f"- split: test\n    path: {config}/test-*.parquet" in text
        assert f"| `{config}/` |" in text
        table = text.partition(f"## Columns of `{config}`")[2].partition("## ")[0]
        columns = rows_of(folder, config, "test")[0]
        assert [line.split("`")[1] for line in table.splitlines() if "`" in line] == list(columns)


def test_scenes_of_other_trials_are_refused(made: Path, tmp_path: Path) -> None:
    out = Path(shutil.copytree(made, tmp_path / "out"))
    with h5py.File(out / "scenes.hdf5", "r+") as file:
        file.attrs["shards"] = "others"
    with pytest.raises(DataError, match="must be of the trials in its folder, got other scenes"):
        export_dataset(out, tmp_path / "to", "hf")
    assert not (tmp_path / "to").exists()
