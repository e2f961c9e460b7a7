"""Reading: samples, columns, refusals, and use from other processes."""

from __future__ import annotations

import multiprocessing
import pickle
from pathlib import Path

import h5py
import numpy as np
import pytest

from drakegrasp.dataset.hdf5 import create_field
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.dataset.schema import DATA_FIELDS, SCHEMA_VERSION, SPLITS, sizes
from drakegrasp.errors import DataError

LETTERS = sizes(fingers=3, joints=8, image=16)


@pytest.fixture(scope="module")
def data_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data file whose train split has five samples with their row in every value."""
    path = tmp_path_factory.mktemp("data") / "grasping_oto.hdf5"
    with h5py.File(path, "w") as file:
        file.attrs["schema_version"] = SCHEMA_VERSION
        file.attrs["K"] = np.eye(3)
        file.attrs["camera"] = "oto"
        for split in SPLITS:
            group = file.create_group(split)
            count = 5 if split == "train" else 0
            for field in DATA_FIELDS:
                shape = field.row_shape(LETTERS)
                dataset = create_field(group, field, shape)
                dataset.resize(count, axis=0)
                for row in range(count):
                    dataset[row] = (
                        f"object {row} ü" if field.dtype == "str" else np.full(shape, row)
                    )
    return path


def test_samples_come_by_index(data_file: Path) -> None:
    data = GraspDataset(data_file, split="train")
    assert len(data) == 5
    sample = data[3]
    assert sample.image.shape == (4, 16, 16)
    assert sample.image.dtype == np.float32
    assert np.all(sample.grasp == 3.0)
    assert sample.grasp_held.shape == (18,)
    assert np.all(sample.grasp_held == 3.0)
    assert sample.grasp_props["f_Q_C_held"].shape == (3, 3)
    assert sample.grasp_props["stable"]
    assert sample.trial_id == 3
    assert sample.props["object_name"] == "object 3 ü"
    assert data[-1].trial_id == 4
    assert [s.trial_id for s in data] == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("index", [5, -6])
def test_index_beyond_the_end_is_refused(data_file: Path, index: int) -> None:
    with pytest.raises(IndexError, match="index must be below 5"):
        GraspDataset(data_file)[index]


def test_columns_come_whole(data_file: Path) -> None:
    data = GraspDataset(data_file)
    assert data.column("grasps").shape == (5, 18)
    assert data.column("object_props/class_name").tolist()[1] == "object 1 ü"
    with pytest.raises(DataError, match=r"field must be one of images, .*, got 'poses'"):
        data.column("poses")


def test_file_says_whose_camera_it_is(data_file: Path) -> None:
    data = GraspDataset(data_file)
    assert data.camera == "oto"
    assert np.array_equal(data.K, np.eye(3))


def test_empty_split_is_empty(data_file: Path) -> None:
    assert list(GraspDataset(data_file, split="valid")) == []


def test_other_things_are_refused(data_file: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="split must be one of train, valid, test, got 'dev'"):
        GraspDataset(data_file, split="dev")
    with pytest.raises(DataError, match="must be a data file"):
        GraspDataset(tmp_path / "nothing.hdf5")
    (tmp_path / "text.hdf5").write_text("text")
    with pytest.raises(DataError, match="must be a data file"):
        GraspDataset(tmp_path / "text.hdf5")


def test_newer_schema_is_refused(data_file: Path, tmp_path: Path) -> None:
    path = tmp_path / "newer.hdf5"
    path.write_bytes(data_file.read_bytes())
    with h5py.File(path, "r+") as file:
        file.attrs["schema_version"] = SCHEMA_VERSION + 1
    with pytest.raises(DataError, match=f"schema must be {SCHEMA_VERSION}, got"):
        GraspDataset(path)


def _trial_id(task: tuple[GraspDataset, int]) -> int:
    data, index = task
    return data[index].trial_id


@pytest.mark.parametrize("method", ["spawn", "fork"])
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_other_processes_read_after_this_one_did(data_file: Path, method: str) -> None:
    """As under torch's DataLoader: the open file is neither pickled nor used after a fork."""
    data = GraspDataset(data_file)
    assert data[0].trial_id == 0
    with multiprocessing.get_context(method).Pool(2) as pool:
        assert pool.map(_trial_id, [(data, i) for i in range(5)]) == [0, 1, 2, 3, 4]
    assert pickle.loads(pickle.dumps(data))[2].trial_id == 2
