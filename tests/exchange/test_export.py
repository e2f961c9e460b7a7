"""Exporting: what is refused, and that a folder is complete or absent."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from helpers.commands import error_line, run
from helpers.datasets import change

from drakegrasp import registry
from drakegrasp.dataset.assemble import assemble
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.paths import model_path
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.errors import DataError, DiskFullError
from drakegrasp.exchange import dexgraspbench
from drakegrasp.exchange.export import ClosedGrasp, export_dataset
from drakegrasp.objects.model import load_object, prepare_object
from drakegrasp.objects.sources import find_meshes


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


def test_command_says_how_many_samples_go_where(
    out: Path, grasps: list[ClosedGrasp], tmp_path: Path
) -> None:
    """By default into the dataset."""
    to = tmp_path / "new" / "folder"
    for given, folder in (([to], to), ([], out / "export_isaac_grasp")):
        done = run("export", out, *given, "--to", "isaac_grasp")
        assert done.exit_code == 0, done.output
        assert f"{len(grasps)} samples in {folder}" in done.output
        assert list(folder.rglob("*.yaml"))


def test_folder_that_holds_files_is_refused(dataset: Path, tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(DataError, match="must be a new or empty directory"):
        export_dataset(dataset, tmp_path, "original")
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_dataset_without_samples_is_refused(dataset: Path, tmp_path: Path) -> None:
    out = Path(shutil.copytree(dataset, tmp_path / "out"))
    assemble(out, overrides=["filters.max_slip=1e-9"])
    for form in registry.names("exporters"):
        with pytest.raises(DataError, match="must have samples to export, got none"):
            export_dataset(out, tmp_path / "to", form)
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_export_that_fails_leaves_nothing(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(dexgraspbench, "grasp_dictionary", fail)
    with pytest.raises(DiskFullError, match=r"to: the disk or the quota is full .*; make room"):
        export_dataset(dataset, tmp_path / "to", "dexgraspbench")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("form", ["isaac_grasp", "dexgraspbench", "mjcf"])
@pytest.mark.parametrize(
    ("name", "value"), [("X_TO", np.nan), ("closed_q", np.inf), ("spread", -np.inf)]
)
def test_numbers_that_are_not_finite_are_one_line(
    out: Path, tmp_path: Path, form: str, name: str, value: float
) -> None:
    row = int(GraspDataset(out / "grasping_oto.hdf5", split="test").column("trial_id")[0])
    change(out, "trials.hdf5", f"trials/{name}", row, lambda values: np.full_like(values, value))
    done = run("export", out, tmp_path / "to", "--to", form)
    assert done.exit_code == 1
    assert (
        error_line(done)
        == f"error: {out}: {name} of trial {row} must be finite numbers, got others"
    )
    assert not (tmp_path / "to").exists()


def test_meshes_are_in_the_frame_of_the_objects(
    dataset: Path, exported: Callable[[str], Path]
) -> None:
    folder, entries = exported("meshes"), read_manifest(dataset).objects
    for entry in entries:
        mesh = trimesh.load(folder / f"{entry.name}.obj", process=False)
        model = load_object(model_path(dataset, entry.name))
        np.testing.assert_array_equal(mesh.vertices, model.visual_vertices)

    # A build makes the same objects of the folder, whose lengths are in metres.
    for source, entry in zip(find_meshes(folder), entries, strict=True):
        again = prepare_object(source)
        assert (again.name, again.class_name, again.mass) == (
            entry.name,
            entry.class_name,
            entry.mass,
        )
        np.testing.assert_allclose(again.X_OM, np.eye(4), atol=1e-15)
