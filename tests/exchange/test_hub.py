"""A folder for the Hub: the official loaders open it, and its values are those of the dataset."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml

from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.errors import MachineError
from drakegrasp.exchange import hub
from drakegrasp.exchange.export import export_dataset

pytest.importorskip("pyarrow")

SPLITS = ("train", "valid", "test")

#: What the official loaders say of a folder. They run in a process of their own: they load half
#: of the packages of the environment, whose warnings are not ours.
LOADERS = """
import json, sys
import datasets, mlcroissant, numpy as np
folder, cache = sys.argv[1:]
found = {}
for camera in ("oto", "otm"):
    for split, rows in datasets.load_dataset(folder, camera, cache_dir=cache).items():
        found[f"{camera}/{split}"] = [
            {
                "trial_id": row["trial_id"],
                "grasp": row["grasp"],
                "object_name": row["object_name"],
                "f_Q_C": row["f_Q_C"],
                "image": np.asarray(row["image"]).tolist(),
                "depth": np.asarray(row["depth"]).tolist(),
                "mask": np.asarray(row["mask"]).tolist(),
            }
            for row in rows
        ]
records = mlcroissant.Dataset(f"{folder}/croissant.json")
counts = {
    each.uuid: sum(1 for _ in records.records(each.uuid)) for each in records.metadata.record_sets
}
print(json.dumps({"rows": found, "croissant": counts}))
"""


@pytest.fixture(scope="module")
def folder(exported: Callable[[str], Path]) -> Path:
    return exported("hf")


@pytest.mark.slow
def test_official_loaders_read_what_the_dataset_holds(
    sound: Path, folder: Path, tmp_path: Path
) -> None:
    pytest.importorskip("datasets")
    pytest.importorskip("mlcroissant")
    run = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", LOADERS, str(folder), str(tmp_path)],
        capture_output=True,
        text=True,
        check=False,
        env={"PATH": "", "HOME": str(tmp_path), "HF_HUB_OFFLINE": "1", "HF_HOME": str(tmp_path)},
    )
    assert run.returncode == 0, run.stderr
    found = json.loads(run.stdout.splitlines()[-1])
    for camera in ("oto", "otm"):
        for split in SPLITS:
            data = GraspDataset(sound / f"grasping_{camera}.hdf5", split=split)
            rows = found["rows"][f"{camera}/{split}"]
            assert [row["trial_id"] for row in rows] == data.column("trial_id").tolist()
            assert found["croissant"][f"{camera}/{split}-00000-of-00001"] == len(data) > 0
            for row, sample in zip(rows, data, strict=True):
                assert row["object_name"] == sample.props["object_name"]
                assert np.array(row["grasp"], dtype=np.float32).tolist() == sample.grasp.tolist()
                assert row["f_Q_C"] == sample.grasp_props["f_Q_C"].tolist()
                colour = np.moveaxis(np.array(row["image"]) / 255.0, -1, 0)
                assert np.abs(colour - sample.image[:3]).max() <= 0.5 / 255.0 + 1e-6
                depth = np.array(row["depth"]) * hub.DEPTH_UNIT
                assert np.abs(depth - sample.image[3]).max() <= 0.51 * hub.DEPTH_UNIT
                assert (np.array(row["mask"]) == 255 * sample.mask).all()


def test_every_column_is_that_of_the_data_file(sound: Path, folder: Path) -> None:
    """Contacts, poses, joints, forces and all else that is no image, bit for bit."""
    import pyarrow.parquet as pq

    for camera in ("oto", "otm"):
        for split in SPLITS:
            data = GraspDataset(sound / f"grasping_{camera}.hdf5", split=split)
            (path,) = (folder / camera).glob(f"{split}-*.parquet")
            table = pq.read_table(path)
            assert set(table.column_names) == set(hub.columns())
            for name, field in hub.columns().items():
                if field is not None:
                    assert table[name].to_pylist() == data.column(field.name).tolist(), name


def test_card_names_licence_files_and_counts(sound: Path, folder: Path) -> None:
    head, text = (folder / "README.md").read_text(encoding="utf-8").split("---\n")[1:]
    described = yaml.safe_load(head)
    assert described["license"] == "cc-by-4.0"
    for config in described["configs"]:
        for entry in config["data_files"]:
            assert list(folder.glob(entry["path"]))
    # What the dataset's own card says of how it was made, word for word.
    own = (sound / "DATACARD.md").read_text(encoding="utf-8")
    assert own[own.index("## How it was made") :] in text
    for split in SPLITS:
        count = len(GraspDataset(sound / "grasping_oto.hdf5", split=split))
        assert f"| {split} | {count} | {count} |" in text


def test_card_says_what_the_folder_holds_and_nothing_else(sound: Path, folder: Path) -> None:
    text = (folder / "README.md").read_text(encoding="utf-8")
    for absent in ("trials.hdf5", "manifest.json", "grasping_o", "in 0..1", "objects/"):
        assert absent not in text.partition("## Columns")[0]
    assert "| `oto/, otm/` |" in text
    data = GraspDataset(sound / "grasping_oto.hdf5")
    assert f"focal lengths {data.K[0, 0]:.6f} and {data.K[1, 1]:.6f}" in text
    assert f"centre at ({data.K[0, 2]:g}, {data.K[1, 2]:g}) [px]" in text
    assert "the depth is 0.75 m" in text
    for name, field in hub.columns().items():
        rows = [line for line in text.splitlines() if line.startswith(f"| `{name}` |")]
        assert len(rows) == 1
        assert field is None or f"| {field.unit} | {field.frame} |" in rows[0]


def test_long_splits_are_cut_into_files(
    sound: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import pyarrow.parquet as pq

    monkeypatch.setattr(hub, "FILE_ROWS", 2)
    monkeypatch.setattr(hub, "GROUP_ROWS", 1)
    export_dataset(sound, tmp_path / "to", "hf")
    data = GraspDataset(sound / "grasping_oto.hdf5", split="test")
    files = sorted((tmp_path / "to" / "oto").glob("test-*.parquet"))
    ids = [i for file in files for i in pq.read_table(file)["trial_id"].to_pylist()]
    assert len(files) == -(-len(data) // 2) > 1
    assert ids == data.column("trial_id").tolist()


def test_missing_pyarrow_is_one_line(
    sound: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(MachineError, match=r"needs pyarrow, got none: pip install"):
        export_dataset(sound, tmp_path / "to", "hf")
    assert not list(tmp_path.iterdir())
