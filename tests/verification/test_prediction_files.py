"""Files of predicted grasps: the same numbers from every format, one line for what is wrong."""

from __future__ import annotations

import io

import h5py
import numpy as np
import pytest

from drakegrasp.errors import GraspError
from drakegrasp.exchange.columns import read_contacts, read_numbers

NUMBERS = np.random.default_rng(0).normal(size=(4, 18)).round(6)


def stored(array):
    """Return the bytes of a .npy file."""
    stream = io.BytesIO()
    np.save(stream, array, allow_pickle=True)
    return stream.getvalue()


def write(path, content):
    """Write bytes, an array, or the arrays of an HDF5 file by their names; None: a folder."""
    if content is None:
        path.mkdir()
    elif isinstance(content, dict):
        with h5py.File(path, "w") as file:
            for name, values in content.items():
                file[name] = values
    else:
        path.write_bytes(content if isinstance(content, bytes) else stored(np.asarray(content)))
    return path


IN_A_GROUP = {"a/grasps": NUMBERS, "a/rows": np.arange(4), "losses/valid": np.zeros(3)}


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("grasps.npy", NUMBERS),
        ("grasps.npy", NUMBERS.astype(np.float32)),
        ("grasps.h5", {"grasps": NUMBERS}),
        ("GRASPS.HDF5", IN_A_GROUP),
    ],
)
def test_every_format_gives_the_same_numbers(tmp_path, name, content):
    found = read_contacts(write(tmp_path / name, content))
    np.testing.assert_allclose(found["grasps"], NUMBERS, atol=1e-6)
    assert found["grasps"].dtype == np.float64
    assert (found["rows"] is not None) == (content is IN_A_GROUP)


def test_one_grasp_may_be_a_vector(tmp_path):
    found = read_contacts(write(tmp_path / "one.npy", NUMBERS[0]))
    assert np.array_equal(found["grasps"], NUMBERS[:1])


@pytest.fixture
def splits(tmp_path):
    arrays = {"test/grasps": NUMBERS[:1], "test/rows": [5], "valid/grasps": NUMBERS[1:]}
    return write(tmp_path / "splits.h5", arrays)


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
    valid = write(tmp_path / "valid.h5", {"valid/grasps": NUMBERS})
    with pytest.raises(GraspError, match="got them in /valid; choose with --split"):
        read_contacts(valid, split="test")


def test_root_is_taken_for_any_split(tmp_path):
    path = write(tmp_path / "grasps.h5", {"grasps": NUMBERS})
    assert len(read_contacts(path, split="valid")["grasps"]) == 4


NPY = stored(NUMBERS)
#: A header that claims more numbers than any memory holds.
ABSURD = NPY.replace(b"(4, 18), } ", b"(9999999999999, 18), }")[:200]


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.h5", None, r"a\.h5: must be a file of grasps, got none"),
        ("a.txt", b"1,2,3", r"must be a file \.npy, \.h5 or \.hdf5, got '\.txt'"),
        ("a.npy", b"", r"a\.npy: must be a \.npy file of numbers, got none"),
        ("a.npy", b"PK\x03\x04 zip", r"a\.npy: must be a \.npy file of numbers, got none"),
        ("a.npy", NPY[:-100], "must be a .npy file of numbers, got none"),
        ("a.npy", ABSURD, "must be a .npy file of numbers, got none"),
        ("a.npy", [{"p": 1}], "must be a .npy file of numbers, got none .*allow_pickle"),
        ("a.npy", ["1", "2"], "must hold real numbers, got text"),
        ("a.npy", [[1j] * 18], "must hold real numbers, got complex numbers"),
        ("a.npy", [[True] * 18], "must hold real numbers, got truth values"),
        ("a.npy", np.zeros((2, 3, 6)), r"or one grasp, got an array of shape \(2, 3, 6\)"),
        ("a.npy", 1.0, r"or one grasp, got an array of shape \(\)"),
        ("a.npy", np.zeros((0, 18)), "must hold at least one grasp, got none"),
        ("a.h5", b"no HDF5", "must be a file of grasps, .* by the name 'grasps', got none"),
        ("a.h5", {"images": np.zeros(3)}, "must hold an array 'grasps' .*, got none$"),
        ("a.h5", {"grasps": ["a"]}, "/grasps: must hold real numbers"),
        ("a.h5", {"grasps": NUMBERS, "rows": [0, 1]}, "/rows must hold one whole number for each"),
        (
            "a.h5",
            {"grasps": NUMBERS, "rows": [0.0] * 4},
            "/rows must hold .* number .*, got float64",
        ),
    ],
)
def test_bad_file_is_one_line(tmp_path, name, content, words):
    with pytest.raises(GraspError, match=words) as raised:
        read_contacts(write(tmp_path / name, content))
    assert "\n" not in str(raised.value)


def test_poses_are_read_as_they_are(tmp_path):
    poses = write(tmp_path / "poses.npy", np.stack([np.eye(4)] * 3))
    assert read_numbers(poses).shape == (3, 4, 4)
