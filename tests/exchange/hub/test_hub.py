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
from helpers.commands import run

from drakegrasp.dataset.card import LIMITS, card_content
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.dataset.schema import DEPTH_UNIT
from drakegrasp.errors import DataError, MachineError
from drakegrasp.exchange import hub as hub
from drakegrasp.exchange import hub as table
from drakegrasp.exchange.export import export_dataset, read_publication

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
streamed = {
    f"{camera}/{split}": [row["trial_id"] for row in rows]
    for camera in ("oto", "otm")
    for split, rows in datasets.load_dataset(folder, camera, streaming=True).items()
}
records = mlcroissant.Dataset(f"{folder}/croissant.json")
issues = records.metadata.ctx.issues
counts = {
    each.uuid: sum(1 for _ in records.records(each.uuid)) for each in records.metadata.record_sets
}
complaints = sorted(issues.errors | issues.warnings)
known = {"rows": found, "streamed": streamed, "croissant": counts, "complaints": complaints}
print(json.dumps(known))
"""


@pytest.fixture(scope="module")
def folder(exported: Callable[[str], Path]) -> Path:
    return exported("hf")


@pytest.mark.nightly
@pytest.mark.slow
def test_official_loaders_read_what_the_dataset_holds(
    dataset: Path, folder: Path, tmp_path: Path
) -> None:
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
    assert found["complaints"] == []
    for camera in ("oto", "otm"):
        for split in SPLITS:
            data = GraspDataset(dataset / f"grasping_{camera}.hdf5", split=split)
            rows = found["rows"][f"{camera}/{split}"]
            assert [row["trial_id"] for row in rows] == data.column("trial_id").tolist()
            assert found["streamed"][f"{camera}/{split}"] == data.column("trial_id").tolist()
            assert found["croissant"][f"{camera}/{split}-00000-of-00001"] == len(data) > 0
            for row, sample in zip(rows, data, strict=True):
                assert row["object_name"] == sample.props["object_name"]
                assert np.array(row["grasp"], dtype=np.float32).tolist() == sample.grasp.tolist()
                assert row["f_Q_C"] == sample.grasp_props["f_Q_C"].tolist()
                colour = np.moveaxis(np.array(row["image"]) / 255.0, -1, 0)
                assert np.abs(colour - sample.image[:3]).max() <= 0.5 / 255.0 + 1e-6
                depth = np.array(row["depth"]) * DEPTH_UNIT
                assert np.abs(depth - sample.image[3]).max() <= 0.51 * DEPTH_UNIT
                assert (np.array(row["mask"]) == 255 * sample.mask).all()


def test_every_column_is_that_of_the_data_file(dataset: Path, folder: Path) -> None:
    """Contacts, poses, joints, forces and all else that is no image, bit for bit."""
    import pyarrow.parquet as pq

    for camera in ("oto", "otm"):
        for split in SPLITS:
            data = GraspDataset(dataset / f"grasping_{camera}.hdf5", split=split)
            (path,) = (folder / camera).glob(f"{split}-*.parquet")
            table = pq.read_table(path)
            assert set(table.column_names) == set(hub.COLUMNS)
            for name, field in hub.COLUMNS.items():
                if not field.sample:
                    own = data.column(field.name).tolist()
                    np.testing.assert_equal(table[name].to_pylist(), own, err_msg=name)


def test_card_names_licence_files_and_counts(dataset: Path, folder: Path) -> None:
    head, text = (folder / "README.md").read_text(encoding="utf-8").split("---\n")[1:]
    described = yaml.safe_load(head)
    assert described["license"] == "cc-by-4.0"
    for config in described["configs"]:
        for entry in config["data_files"]:
            assert list(folder.glob(entry["path"]))
    # What the dataset's own card says of how it was made, word for word.
    own = (dataset / "DATACARD.md").read_text(encoding="utf-8")
    assert own[own.index("## How it was made") :] in text
    for split in SPLITS:
        count = len(GraspDataset(dataset / "grasping_oto.hdf5", split=split))
        assert f"| {split} | {count} | {count} |" in text


def test_card_says_what_the_folder_holds_and_nothing_else(dataset: Path, folder: Path) -> None:
    text = (folder / "README.md").read_text(encoding="utf-8")
    for absent in ("trials.hdf5", "manifest.json", "grasping_o", "in 0..1", "objects/"):
        assert absent not in text.partition("## Columns")[0]
    assert "| `oto/, otm/` |" in text
    data = GraspDataset(dataset / "grasping_oto.hdf5")
    assert f"focal lengths {data.K[0, 0]:.6f} and {data.K[1, 1]:.6f}" in text
    assert f"centre at ({data.K[0, 2]:g}, {data.K[1, 2]:g}) [px]" in text
    assert "the depth is 0.75 m" in text
    for name, field in hub.COLUMNS.items():
        rows = [line for line in text.splitlines() if line.startswith(f"| `{name}` |")]
        assert len(rows) == 1
        assert field is None or f"| {field.unit} | {field.frame} |" in rows[0]


def test_croissant_says_who_published_it_and_how_it_was_made(dataset: Path, folder: Path) -> None:
    said = json.loads((folder / "croissant.json").read_text(encoding="utf-8"))
    assert (said["name"], said["version"]) == ("Two made-up boxes", "2.1.0")
    assert (said["url"], said["datePublished"]) == ("https://example.org/boxes", "2026-11-25")
    assert [each["name"] for each in said["creator"]] == ["A. Author", "The Box Group"]
    assert (said["license"], said["citeAs"]) == ("cc-by-4.0", "@misc{boxes}")
    counts = card_content(dataset)["counts"]["all"]
    made = f"{counts['attempts']} attempts to grasp, of which {counts['held']} hold"
    assert made in said["rai:dataCollection"]
    assert LIMITS[0][0] in said["rai:dataLimitations"]


def test_what_nobody_said_is_left_out_and_told(dataset: Path, tmp_path: Path) -> None:
    about = tmp_path / "about.yaml"
    about.write_text("name: Boxes\nlicence: cc0-1.0\n")
    arguments = ("export", dataset, tmp_path / "to", "--to", "hf", "--about", about)
    result = run(*arguments, "--licence", "mit")
    assert "should say: url, creators, published" in result.output
    said = json.loads((tmp_path / "to" / "croissant.json").read_text(encoding="utf-8"))
    assert (said["name"], said["license"]) == ("Boxes", "mit")
    assert not {"url", "creator", "datePublished", "version"} & set(said)


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("author: me", r"author: must be a known key \(name, version, url, creators, "),
        ("version: one", r"version: must .*, got 'one'"),
        ("url: ftp://here", "url: must .*, got 'ftp"),
        ("published: 2026-13-01", "must be a readable YAML file"),
        ("creators: me", "creators: must be a list, got 'me'"),
        ("[", "must be a readable YAML file"),
    ],
)
def test_bad_word_of_the_publishers_is_one_line(tmp_path: Path, text: str, line: str) -> None:
    (tmp_path / "about.yaml").write_text(text)
    with pytest.raises(DataError, match=line) as error:
        read_publication(tmp_path / "about.yaml")
    assert "\n" not in str(error.value)


def test_long_splits_are_cut_into_files(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import pyarrow.parquet as pq

    monkeypatch.setattr(table, "FILE_BYTES", 1)
    monkeypatch.setattr(table, "GROUP_ROWS", 2)
    export_dataset(dataset, tmp_path / "to", "hf")
    data = GraspDataset(dataset / "grasping_oto.hdf5", split="test")
    files = sorted((tmp_path / "to" / "oto").glob("test-*.parquet"))
    ids = [i for file in files for i in pq.read_table(file)["trial_id"].to_pylist()]
    assert len(files) == -(-len(data) // 2) > 1
    assert ids == data.column("trial_id").tolist()


def test_missing_pyarrow_is_one_line(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(MachineError, match=r"needs pyarrow, got none: pip install"):
        export_dataset(dataset, tmp_path / "to", "hf")
    assert not list(tmp_path.iterdir())
