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
