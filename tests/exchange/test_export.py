"""Exporting: what is refused, and that a folder is complete or absent."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from helpers.commands import run

from drakegrasp import registry
from drakegrasp.dataset.assemble import assemble
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.errors import DataError
from drakegrasp.exchange import dexgraspbench
from drakegrasp.exchange.export import ClosedGrasp, export_dataset


def test_closed_grasps_are_the_samples_of_all_splits(
    dataset: Path, grasps: list[ClosedGrasp]
) -> None:
    for split in ("train", "valid", "test"):
        data = GraspDataset(dataset / "grasping_oto.hdf5", split=split)
        here = {grasp.trial_id: grasp.object_name for grasp in grasps if grasp.split == split}
        names = data.column("object_props/object_name").tolist()
        assert here == dict(zip(data.column("trial_id").tolist(), names, strict=True))
        assert here


def test_help_names_every_format() -> None:
    text = run("export", "--help").output
    assert all(f"\n  {form} " in text for form in registry.names("exporters"))


def test_command_says_how_many(dataset: Path, grasps: list[ClosedGrasp], tmp_path: Path) -> None:
    to = tmp_path / "new" / "folder"
    done = run("export", str(dataset), str(to), "--to", "dexgraspbench")
    assert done.exit_code == 0, done.output
    assert f"{len(grasps)} samples in {to}" in done.output
    assert len(list(to.rglob("*.npy"))) == len(grasps)


def test_folder_that_holds_files_is_refused(dataset: Path, tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(DataError, match="must be a new or empty directory"):
        export_dataset(dataset, tmp_path, "original")
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_missing_dataset_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="must be a data file of drakegrasp"):
        export_dataset(tmp_path / "out", tmp_path / "to", "original")
    assert not list(tmp_path.iterdir())


def test_dataset_without_samples_is_refused(dataset: Path, tmp_path: Path) -> None:
    out = Path(shutil.copytree(dataset, tmp_path / "out"))
    assemble(out, overrides=["filters.max_slip=1e-9"])
    for form in registry.names("exporters"):
        with pytest.raises(DataError, match="must have samples to export, got none"):
            export_dataset(out, tmp_path / "to", form)
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_samples_go_into_the_dataset_by_default(dataset: Path, tmp_path: Path) -> None:
    out = Path(shutil.copytree(dataset, tmp_path / "out"))
    done = run("export", str(out), "--to", "original")
    assert done.exit_code == 0
    assert (out / "export_original" / "grasping_oto.hdf5").is_file()


def test_export_that_fails_leaves_nothing(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(dexgraspbench, "grasp_dictionary", fail)
    with pytest.raises(OSError, match="No space left"):
        export_dataset(dataset, tmp_path / "to", "dexgraspbench")
    assert not list(tmp_path.iterdir())
