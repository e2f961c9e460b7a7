"""Exporting: what is refused, and that a folder is complete or absent."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
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
from drakegrasp.exchange.export import ClosedGrasp, export_dataset, options_of
from drakegrasp.frames import rotate_vectors, transform_points, unpack_pose
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


@pytest.mark.parametrize("form", registry.names("exporters"))
def test_progress_ends_with_all(dataset: Path, tmp_path: Path, form: str) -> None:
    calls = list[tuple[int, int]]()
    said = {"licence": "cc-by-4.0"} if "licence" in options_of(form) else {}
    report = lambda done, total: calls.append((done, total))  # noqa: E731
    count = export_dataset(dataset, tmp_path / "to", form, progress=report, **said)
    done, total = calls[-1]
    assert done == total and total in (count, 2 * count)  # of one data file, or of both
    assert [each for each, _ in calls] == sorted(each for each, _ in calls)


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


# The original layout: depth first, and the same geometry in its camera's axes


SPLITS = ("train", "valid", "test")


@pytest.fixture(scope="module")
def folder(exported: Callable[[str], Path]) -> Path:
    return exported("original")


@pytest.mark.parametrize("camera", ["oto", "otm"])
@pytest.mark.parametrize("split", SPLITS)
def test_samples_are_those_of_the_dataset_at_the_same_place_over_the_table(
    dataset: Path, folder: Path, camera: str, split: str
) -> None:
    data = GraspDataset(dataset / f"grasping_{camera}.hdf5", split=split)
    assert len(data) > 0
    with h5py.File(folder / f"grasping_{camera}.hdf5") as file:
        group, props = file[split], file[split]["object_props"]
        images, ours = group["images"][:], data.column("images")
        assert (images == ours[:, [3, 0, 1, 2]]).all()
        for name in ("work2com", "work2mass", "work2inertia", "frame_world2obj"):
            assert (props[name][:] == data.column(f"object_props/{name}")).all()
        names = props["object_name"].asstr()[:]
        assert names.tolist() == data.column("object_props/object_name").tolist()
        vectors = group["grasps"][:].reshape(len(data), 3, 3, 3)
        X_TV, X_VT = (
            unpack_pose(props[name][:])
            for name in (f"frame_work2cam_{camera}", f"frame_cam2work_{camera}")
        )
        X_VI = unpack_pose(props["frame_cam2img_otm"][:]) if camera == "otm" else None
    X_TC = unpack_pose(data.column(f"object_props/frame_work2cam_{camera}"))
    p_CQ, nhat_Q_C = np.moveaxis(data.column("grasps").reshape(len(data), 2, 3, 3), 1, 0)

    # The axes of its camera: +X left, +Y up, +Z forward.
    np.testing.assert_allclose(X_TV[:, :3, :3], X_TC[:, :3, :3] * [-1.0, -1.0, 1.0], atol=1e-6)
    np.testing.assert_allclose(X_TV @ X_VT, np.tile(np.eye(4), (len(data), 1, 1)), atol=1e-6)
    for i, (points, normals, pushes) in enumerate(vectors):
        for place, found, expected in (
            (transform_points, points, p_CQ[i]),
            (rotate_vectors, normals, nhat_Q_C[i]),
            (rotate_vectors, pushes, data.column("grasp_props/f_Q_C")[i]),
        ):
            np.testing.assert_allclose(place(X_TV[i], found), place(X_TC[i], expected), atol=1e-5)

    # The frame of the image stays where it is.
    if X_VI is not None:
        X_CI = unpack_pose(data.column("object_props/frame_cam2img_otm"))
        np.testing.assert_allclose(X_TV @ X_VI, X_TC @ X_CI, atol=1e-6)
