"""Reading: samples, columns, refusals, and use from other processes."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.data_files import write_data_file

from drakegrasp.dataset import hdf5
from drakegrasp.dataset.hdf5 import ImageRows, create_field
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.dataset.schema import DATA_FIELDS, VIEW_FIELDS, Field, sizes
from drakegrasp.errors import DataError, GraspError, MachineError
from drakegrasp.verification.placing import choose_rows

LETTERS = sizes(fingers=3, joints=8, image=16)


def write_numbered(path: Path, trial_ids: range, unused: int = 0) -> Path:
    """Write a data file whose train split has its trial's id in every value of a sample.

    All grasps leave out the fingers of the bits `unused`.
    """

    def value(field: Field, row: int) -> object:
        if field.name == "grasp_props/unused":
            return unused
        return f"object {trial_ids[row]} ü" if field.dtype == "str" else trial_ids[row]

    return write_data_file(path, len(trial_ids), value)


@pytest.fixture(scope="module")
def data_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data file with five samples to train on."""
    return write_numbered(tmp_path_factory.mktemp("data") / "grasping_oto.hdf5", range(5))


def test_the_working_directory_may_change(
    data_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A loader is often made by a script that goes elsewhere before the first batch."""
    monkeypatch.chdir(data_file.parent)
    data = GraspDataset(data_file.name)
    monkeypatch.chdir(tmp_path)
    assert data[0].trial_id == GraspDataset(data_file)[0].trial_id
    assert pickle.loads(pickle.dumps(data)).path == data_file


def test_samples_come_by_index(data_file: Path) -> None:
    data = GraspDataset(data_file, split="train")
    assert len(data) == 5
    sample = data[3]
    assert sample.image.shape == (4, 16, 16)
    assert sample.image.dtype == np.float32
    assert np.all(sample.grasp == 3.0)
    assert sample.grasp_lifted.shape == (18,)
    assert np.all(sample.grasp_lifted == 3.0)
    assert sample.grasp_props["f_Q_C_lifted"].shape == (3, 3)
    assert sample.grasp_props["stable"]
    assert sample.trial_id == 3
    assert sample.props["object_name"] == "object 3 ü"
    assert data[-1].trial_id == 4
    assert [s.trial_id for s in data] == [0, 1, 2, 3, 4]
    assert data.camera == "oto"
    assert np.array_equal(data.K, np.eye(3))
    assert list(GraspDataset(data_file, split="valid")) == []


def test_several_samples_come_as_a_list(data_file: Path) -> None:
    data = GraspDataset(data_file)
    for index, rows in [
        (slice(0, 3), [0, 1, 2]),
        (slice(None, None, -2), [4, 2, 0]),
        (slice(3, 99), [3, 4]),
        ([4, -5], [4, 0]),
        (np.array([1, 1]), [1, 1]),
        (range(2), [0, 1]),
    ]:
        assert [sample.trial_id for sample in data[index]] == rows
    assert data[np.int64(-2)].trial_id == 3
    for wrong in ("grasps", 1.0, (0, 1), [0.5]):
        with pytest.raises(TypeError):
            data[wrong]
    for beyond in (5, -6, [0, 7]):
        with pytest.raises(IndexError, match=r"index must be below 5, got (5|-6|7)"):
            data[beyond]


@pytest.mark.parametrize("split", ["valid", "test"])
def test_an_empty_split_names_those_with_samples(data_file: Path, split: str) -> None:
    data, said = GraspDataset(data_file, split=split), f"split {split} is empty; not empty: train"
    for index in (0, -1, 7, [0]):
        with pytest.raises(IndexError, match=f"^{said}$"):
            data[index]
    assert data[:] == list(data) == []
    for rows in (None, [0]):
        with pytest.raises(GraspError, match=f"{data_file}: {said}$"):
            choose_rows(data, rows, 1)


def test_a_file_that_another_program_writes_names_the_remedy(tmp_path: Path) -> None:
    path = write_numbered(tmp_path / "grasping_oto.hdf5", range(2))
    code = f"import h5py; file = h5py.File({str(path)!r}, 'r+'); print('open', flush=True); input()"
    command = [sys.executable, "-c", code]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout is not None and other.stdout.readline() == b"open\n"
        with pytest.raises(DataError, match=r"open to write: close it there, .*FILE_LOCKING=FALSE"):
            GraspDataset(path)
        other.communicate(b"\n")
    assert len(GraspDataset(path)) == 2


def test_columns_come_whole(data_file: Path) -> None:
    data = GraspDataset(data_file)
    assert data.column("grasps").shape == (5, 18)
    assert data.column("object_props/class_name").tolist()[1] == "object 1 ü"
    with pytest.raises(DataError, match=r"field must be one of images, .*, got 'poses'"):
        data.column("poses")


def test_other_things_are_refused(data_file: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="split must be one of train, valid, test, got 'dev'"):
        GraspDataset(data_file, split="dev")
    with pytest.raises(DataError, match="must be a data file"):
        GraspDataset(tmp_path / "nothing.hdf5")
    (tmp_path / "text.hdf5").write_text("text")
    with pytest.raises(DataError, match="must be a data file"):
        GraspDataset(tmp_path / "text.hdf5")


def test_grasps_of_fewer_fingers_are_read_by_who_asks_for_them(tmp_path: Path) -> None:
    """NaN does not come into training unnoticed; the other splits have none."""
    path = write_numbered(tmp_path / "grasping_oto.hdf5", range(2), unused=0b010)
    with pytest.raises(
        DataError,
        match=r"train must have contacts of all fingers, got 2 of 2 .*: commands need a split "
        r"of a hand whose preshapes close all fingers; in Python .* fewer_fingers=True",
    ):
        GraspDataset(path, split="train")
    assert len(GraspDataset(path, split="test")) == 0
    sample = GraspDataset(path, split="train", fewer_fingers=True)[1]
    assert sample.fingers.tolist() == [True, False, True]


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


def handles(path: Path) -> list[int]:
    """Return the descriptors by which this process has a file open."""
    found = []
    for name in os.listdir("/proc/self/fd"):
        try:
            if os.readlink(f"/proc/self/fd/{name}") == str(path.resolve()):
                found.append(int(name))
        except FileNotFoundError:  # that of the list itself
            continue
    return found


#: A place in the file that a handle is set to; who shares the handle sees it there.
MARK = 1234


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="needs the handles of Linux")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_no_handle_is_shared_across_a_fork(data_file: Path) -> None:
    """Also not that of another split of the same file, which HDF5 would go on with."""
    datasets = GraspDataset(data_file), GraspDataset(data_file, split="valid")
    assert datasets[0][0].trial_id == 0
    assert len(datasets[1].column("grasps")) == 0
    for handle in handles(data_file):
        os.lseek(handle, MARK, os.SEEK_SET)
    _inherited["datasets"] = datasets  # by no pickle: as a worker has them that is forked
    with multiprocessing.get_context("fork").Pool(1) as pool:
        assert pool.apply(_of_inherited) == [False]
    assert datasets[0][1].trial_id == 1


_inherited: dict[str, tuple[GraspDataset, GraspDataset]] = {}


def _of_inherited() -> list[bool]:
    for data in _inherited["datasets"]:
        list(data)
    path = _inherited["datasets"][0].path
    return [os.lseek(h, 0, os.SEEK_CUR) == MARK for h in handles(path)]


def test_a_file_with_other_samples_is_refused(tmp_path: Path) -> None:
    """A worker that opens it after it was assembled anew would give other samples, silently."""
    path = write_numbered(tmp_path / "grasping_oto.hdf5", range(5))
    data = GraspDataset(path)
    path.unlink()
    write_numbered(path, range(1, 6))
    with pytest.raises(DataError, match=r"must hold the samples that it held when .* opened"):
        data[0]
    path.unlink()
    with pytest.raises(DataError, match=r"must hold the samples that it held when .* opened"):
        data.column("grasps")


def test_images_inflated_here_are_those_of_hdf5(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("deflate")
    rng = np.random.default_rng(0)
    with h5py.File(tmp_path / "images.hdf5", "w") as file:
        for field in (*DATA_FIELDS[:2], *(f for f in VIEW_FIELDS if f.sample)):
            dataset = create_field(file, field, field.row_shape(LETTERS | {"h": 5, "w": 3}))
            dataset.resize(4, axis=0)
            values = rng.integers(0, 255 if field.dtype == "uint8" else 65535, dataset.shape)
            values = values / (7 if field.dtype == "float32" else 1)
            dataset[:3] = values[:3]  # the last was never written
            rows = ImageRows(dataset)
            for row in range(4):
                assert rows[row].dtype == dataset.dtype
                assert rows[row].tobytes() == dataset[row].tobytes()
            monkeypatch.setattr(ImageRows, "_inflate", lambda *_: pytest.fail("inflated here"))
            with pytest.raises(pytest.fail.Exception):
                rows[0]
            monkeypatch.undo()


def test_files_that_are_packed_otherwise_are_read_by_hdf5(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    values = np.arange(3 * 16, dtype=np.float32).reshape(3, 4, 2, 2)
    with h5py.File(tmp_path / "images.hdf5", "w") as file:
        ways = {
            "plain": {},
            "lzf": {"compression": "lzf", "chunks": (1, 4, 2, 2)},
            "together": {"compression": "gzip", "shuffle": True, "chunks": (2, 4, 2, 2)},
            "unshuffled": {"compression": "gzip", "chunks": (1, 4, 2, 2)},
        }
        for name, options in ways.items():
            rows = ImageRows(file.create_dataset(name, data=values, **options))
            assert all((rows[k] == values[k]).all() for k in range(3))
        big = file.create_dataset(
            "big", data=values.astype(">f4"), compression="gzip", shuffle=True, chunks=(1, 4, 2, 2)
        )
        assert (ImageRows(big)[1] == values[1]).all()
        monkeypatch.setattr(hdf5, "deflate", None)
        usual = file.create_dataset(
            "usual", data=values, compression="gzip", shuffle=True, chunks=(1, 4, 2, 2)
        )
        assert (ImageRows(usual)[1] == values[1]).all()


def test_missing_torch_is_one_line_and_unknown_fields_are_refused_first(
    data_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(MachineError, match=r"to_torch needs torch, got none: pip install"):
        GraspDataset(data_file).to_torch()
    with pytest.raises(DataError, match=r"field must be one of images, .*, got 'image'"):
        GraspDataset(data_file).to_torch(["image"])
