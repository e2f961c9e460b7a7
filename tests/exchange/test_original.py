"""The original layout: equal counts, depth first, and the same geometry in its camera's axes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.frames import rotate_vectors, transform_points, unpack_pose

SPLITS = ("train", "valid", "test")


@pytest.fixture(scope="module")
def folder(exported: Callable[[str], Path]) -> Path:
    return exported("original")


@pytest.mark.parametrize("camera", ["oto", "otm"])
@pytest.mark.parametrize("split", SPLITS)
def test_images_and_properties_are_those_of_the_dataset(
    sound: Path, folder: Path, camera: str, split: str
) -> None:
    data = GraspDataset(sound / f"grasping_{camera}.hdf5", split=split)
    with h5py.File(folder / f"grasping_{camera}.hdf5") as file:
        group = file[split]
        images, ours = group["images"][:], data.column("images")
        assert images.shape == ours.shape
        assert (images[:, 0] == ours[:, 3]).all()
        assert (images[:, 1:] == ours[:, :3]).all()
        assert group["grasps"].shape == (len(data), 27)
        for name in ("work2com", "work2mass", "work2inertia", "frame_world2obj"):
            values = group[f"object_props/{name}"][:]
            assert (values == data.column(f"object_props/{name}")).all()
        names = group["object_props/object_name"].asstr()[:]
        assert names.tolist() == data.column("object_props/object_name").tolist()


@pytest.mark.parametrize("camera", ["oto", "otm"])
@pytest.mark.parametrize("split", SPLITS)
def test_grasps_are_at_the_same_place_over_the_table(
    sound: Path, folder: Path, camera: str, split: str
) -> None:
    data = GraspDataset(sound / f"grasping_{camera}.hdf5", split=split)
    assert len(data) > 0
    with h5py.File(folder / f"grasping_{camera}.hdf5") as file:
        vectors = file[f"{split}/grasps"][:].reshape(len(data), 3, 3, 3)
        frames = unpack_pose(file[f"{split}/object_props/frame_work2cam_{camera}"][:])
        back = unpack_pose(file[f"{split}/object_props/frame_cam2work_{camera}"][:])
    X_TC = unpack_pose(data.column(f"object_props/frame_work2cam_{camera}"))
    ours = data.column("grasps").reshape(len(data), 2, 3, 3)
    forces = data.column("grasp_props/f_Q_C")

    for i in range(len(data)):
        # The axes of its camera: +X left, +Y up, +Z forward.
        assert frames[i][:3, 0] == pytest.approx(-X_TC[i][:3, 0], abs=1e-6)
        assert frames[i][:3, 1] == pytest.approx(-X_TC[i][:3, 1], abs=1e-6)
        assert frames[i][:3, 2] == pytest.approx(X_TC[i][:3, 2], abs=1e-6)
        assert frames[i] @ back[i] == pytest.approx(np.eye(4), abs=1e-6)

        points, normals, pushes = vectors[i]
        assert transform_points(frames[i], points) == pytest.approx(
            transform_points(X_TC[i], ours[i, 0]), abs=1e-6
        )
        assert rotate_vectors(frames[i], normals) == pytest.approx(
            rotate_vectors(X_TC[i], ours[i, 1]), abs=1e-6
        )
        assert rotate_vectors(frames[i], pushes) == pytest.approx(
            rotate_vectors(X_TC[i], forces[i]), abs=1e-5
        )


def test_image_frame_stays_where_it_is(sound: Path, folder: Path) -> None:
    data = GraspDataset(sound / "grasping_otm.hdf5", split="train")
    with h5py.File(folder / "grasping_otm.hdf5") as file:
        props = file["train/object_props"]
        X_TV = unpack_pose(props["frame_work2cam_otm"][:])
        X_VI = unpack_pose(props["frame_cam2img_otm"][:])
    X_TC = unpack_pose(data.column("object_props/frame_work2cam_otm"))
    X_CI = unpack_pose(data.column("object_props/frame_cam2img_otm"))
    assert pytest.approx(X_TC @ X_CI, abs=1e-6) == X_TV @ X_VI
