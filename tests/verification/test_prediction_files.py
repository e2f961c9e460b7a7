"""Files of predicted grasps: the same numbers from every format, one line for what is wrong."""

from __future__ import annotations

import h5py
import numpy as np
import pytest

from drakegrasp.errors import GraspError
from drakegrasp.exchange.columns import read_contacts, read_numbers

NUMBERS = np.random.default_rng(0).normal(size=(4, 18)).round(6)


def _npy(path):
    np.save(path / "grasps.npy", NUMBERS)
    return path / "grasps.npy"


def _npy_single(path):
    np.save(path / "grasps.npy", NUMBERS.astype(np.float32))
    return path / "grasps.npy"


def _hdf5(path):
    with h5py.File(path / "grasps.h5", "w") as file:
        file["grasps"] = NUMBERS
    return path / "grasps.h5"


def _hdf5_in_a_group(path):
    with h5py.File(path / "GRASPS.HDF5", "w") as file:
        file["epoch_7/grasps"] = NUMBERS
        file["epoch_7/rows"] = np.arange(4)
        file["losses/valid"] = np.zeros(3)
    return path / "GRASPS.HDF5"


@pytest.mark.parametrize("make", [_npy, _npy_single, _hdf5, _hdf5_in_a_group])
def test_every_format_gives_the_same_numbers(tmp_path, make):
    found = read_contacts(make(tmp_path))
    np.testing.assert_allclose(found["grasps"], NUMBERS, atol=1e-6)
    assert found["grasps"].dtype == np.float64
    assert (found["rows"] is not None) == (make is _hdf5_in_a_group)


def test_one_grasp_may_be_a_vector(tmp_path):
    np.save(tmp_path / "one.npy", NUMBERS[0])
    assert np.array_equal(read_contacts(tmp_path / "one.npy")["grasps"], NUMBERS[:1])


@pytest.fixture
def splits(tmp_path):
    with h5py.File(tmp_path / "splits.h5", "w") as file:
        file["test/grasps"], file["test/rows"] = NUMBERS[:1], [5]
        file["valid/grasps"] = NUMBERS[1:]
    return tmp_path / "splits.h5"


def test_split_chooses_the_group(splits):
    test, valid = (read_contacts(splits, split=name) for name in ("test", "valid"))
    assert np.array_equal(test["grasps"], NUMBERS[:1])
    assert test["rows"].tolist() == [5]
    assert np.array_equal(valid["grasps"], NUMBERS[1:])
    assert valid["rows"] is None


def test_group_that_was_not_asked_for_is_never_taken(splits, tmp_path):
    with pytest.raises(GraspError, match=r"in /train or at the root, got them in /test, /valid"):
        read_contacts(splits, split="train")
    with pytest.raises(GraspError, match=r"root or in one group, got .*; choose with --split"):
        read_contacts(splits)
    with h5py.File(tmp_path / "valid.h5", "w") as file:
        file["valid/grasps"] = NUMBERS
    with pytest.raises(GraspError, match="got them in /valid; choose with --split"):
        read_contacts(tmp_path / "valid.h5", split="test")


def test_root_is_taken_for_any_split(tmp_path):
    assert len(read_contacts(_hdf5(tmp_path), split="valid")["grasps"]) == 4


def _missing(path):
    return path / "grasps.npy"


def _folder(path):
    (path / "grasps.h5").mkdir()
    return path / "grasps.h5"


def _other_suffix(path):
    (path / "grasps.txt").write_text("1,2,3")
    return path / "grasps.txt"


def _of(name, content):
    def make(path):
        (path / name).write_bytes(content)
        return path / name

    return make


def _array(values):
    def make(path):
        np.save(path / "grasps.npy", np.asarray(values), allow_pickle=True)
        return path / "grasps.npy"

    return make


def _tree(**arrays):
    def make(path):
        with h5py.File(path / "grasps.h5", "w") as file:
            for name, values in arrays.items():
                file[name] = values
        return path / "grasps.h5"

    return make


def _cut_off(path):
    file = _npy(path)
    file.write_bytes(file.read_bytes()[:-100])
    return file


def _absurd(path):
    """A header that claims more numbers than any memory holds."""
    file = _npy(path)
    file.write_bytes(file.read_bytes().replace(b"(4, 18), } ", b"(9999999999999, 18), }")[:200])
    return file


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (_missing, r"grasps\.npy: must be a file of grasps, got none"),
        (_folder, r"grasps\.h5: must be a file of grasps, got none"),
        (_other_suffix, r"must be a file \.npy, \.h5 or \.hdf5, got '\.txt'"),
        (_of("a.npy", b""), r"a\.npy: must be a \.npy file of numbers, got none"),
        (_of("a.npy", b"PK\x03\x04 zip"), r"a\.npy: must be a \.npy file of numbers, got none"),
        (_cut_off, "must be a .npy file of numbers, got none"),
        (_absurd, "must be a .npy file of numbers, got none"),
        (_array([{"p": 1}]), "must be a .npy file of numbers, got none .*allow_pickle"),
        (_array(["1", "2"]), "must hold real numbers, got text"),
        (_array([[1j] * 18]), "must hold real numbers, got complex numbers"),
        (_array([[True] * 18]), "must hold real numbers, got truth values"),
        (_array(np.zeros((2, 3, 6))), r"or one grasp, got an array of shape \(2, 3, 6\)"),
        (_array(1.0), r"or one grasp, got an array of shape \(\)"),
        (_array(np.zeros((0, 18))), "must hold at least one grasp, got none"),
        (_of("a.h5", b"no HDF5"), "must be a file of grasps, .* by the name 'grasps', got none"),
        (_tree(images=np.zeros(3)), "must hold an array 'grasps' .*, got none$"),
        (_tree(grasps=["a"]), "/grasps: must hold real numbers"),
        (_tree(grasps=NUMBERS, rows=[0, 1]), r"/rows must hold one whole number for each of the 4"),
        (_tree(grasps=NUMBERS, rows=[0.0] * 4), "/rows must hold one whole number .*, got float64"),
    ],
)
def test_bad_file_is_one_line(tmp_path, make, words):
    with pytest.raises(GraspError, match=words) as raised:
        read_contacts(make(tmp_path))
    assert "\n" not in str(raised.value)


def test_poses_are_read_as_they_are(tmp_path):
    np.save(tmp_path / "poses.npy", np.stack([np.eye(4)] * 3))
    assert read_numbers(tmp_path / "poses.npy").shape == (3, 4, 4)
