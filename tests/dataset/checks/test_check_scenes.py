"""`drakegrasp check` of scenes.hdf5: each rule finds what alone breaks it."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from itertools import chain
from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers import datasets

from drakegrasp.dataset.checks.run import check_dataset
from drakegrasp.generation.scenes import make_scenes

pytestmark = pytest.mark.sim


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of one box with scenes."""
    folder = tmp_path_factory.mktemp("scenes")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(datasets, "BOXES", dict(list(datasets.BOXES.items())[:1]))
        out = datasets.make_dataset(folder / "out", folder / "meshes")
    make_scenes(out, overrides=["scenes.views=3"])
    return out


def test_what_was_made_is_sound(made: Path) -> None:
    assert check_dataset(made) == []
    assert check_dataset(made / "scenes.hdf5") == []


def add(name: str, value: object, row: int | slice = 0) -> Callable[[h5py.File], None]:
    def spoil(file: h5py.File) -> None:
        file[name][row] = np.asarray(file[name][row]) + value

    return spoil


def put(name: str, value: object, row: int | slice = 0) -> Callable[[h5py.File], None]:
    def spoil(file: h5py.File) -> None:
        file[name][row] = value

    return spoil


def swap(name: str) -> Callable[[h5py.File], None]:
    def spoil(file: h5py.File) -> None:
        file[name][:2] = file[name][:2][::-1]

    return spoil


def success(name: str, value: object) -> Callable[[h5py.File], None]:
    def spoil(file: h5py.File) -> None:
        row = int(np.argmax(file["grasps/sample"][:]))
        file[name][row] = value

    return spoil


def shift_depth(file: h5py.File) -> None:
    depth = file["views/depth"][0]
    file["views/depth"][0] = depth + 10 * (file["views/mask"][0] > 0).astype(np.uint16)


def shrink_mask(file: h5py.File) -> None:
    file["views/mask"][:] = 0


#: How to spoil a file, and the finding.
FAULTS = {
    "height": (add("scenes/X_TO", np.eye(12)[11] * 1e-3), "X_TO must be the object's resting pose"),
    "mass": (add("scenes/mass", 0.1), "mass must be the object's"),
    "split": (put("scenes/split", 3), "split must be 0..2"),
    "order": (swap("visible/grasp"), "rows must be each view with each grasp"),
    "scene": (put("views/scene", 99), "scene must be rows of /scenes"),
    "trial": (add("grasps/trial_id", 1), "must follow from its trial"),
    "palm": (add("grasps/X_TG", np.eye(12)[3] * 1e-3), "X_TG must follow from its trial"),
    "contact": (add("grasps/p_TQ", 1e-3), "p_TQ must follow from its trial"),
    "held": (success("grasps/held", False), "held must be that of a success"),
    "tested": (success("grasps/tested", False), "tested must be that of a lift"),
    "sample": (success("grasps/sample", False), "sample must follow from its trial"),
    "camera": (add("views/X_TC", np.eye(12)[11] * 2e-3), "points beside the mask"),
    "rotation": (add("views/X_TC", np.eye(12)[0] * 1e-3), "orthonormal rotation"),
    "depth": (shift_depth, "points in the mask must be on the object's mesh"),
    "mask": (add("views/mask", 2), "mask must be 0 to the number of objects"),
    "blind": (
        put("visible/visible", False, slice(None)),
        "visible contacts must follow",
    ),
    "sighted": (
        put("visible/visible", True, slice(None)),
        "visible contacts must follow",
    ),
}


#: Faults that do not hide each other; each of the others is alone in its file.
TOGETHER = [
    ("mass", "palm", "contact", "held", "depth", "blind"),
    ("height", "sample", "sighted"),
]
ROUNDS = [*TOGETHER, *((fault,) for fault in FAULTS if fault not in {*chain(*TOGETHER)})]


@pytest.mark.parametrize("faults", ROUNDS, ids=" ".join)
def test_a_fault_is_found(made: Path, tmp_path: Path, faults: tuple[str, ...]) -> None:
    out = Path(shutil.copytree(made, tmp_path / "out"))
    with h5py.File(out / "scenes.hdf5", "r+") as file:
        for fault in faults:
            FAULTS[fault][0](file)
    found = [str(violation) for violation in check_dataset(out)]
    for fault in faults:
        assert any(FAULTS[fault][1] in text for text in found), (fault, found)
    assert all(text.startswith("scenes.hdf5") for text in found)


def test_a_file_of_other_trials_is_found(made: Path, tmp_path: Path) -> None:
    out = Path(shutil.copytree(made, tmp_path / "out"))
    with h5py.File(out / "scenes.hdf5", "r+") as file:
        file.attrs["shards"] = "0" * 64
    (found,) = check_dataset(out)
    assert "run `drakegrasp scenes` again" in str(found)
