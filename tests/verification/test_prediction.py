"""What may be handed in to be verified: rows that are no grasp say why, equal frames, and files."""

from __future__ import annotations

from types import SimpleNamespace

import h5py
import numpy as np
import pytest
from helpers.assertions import refused
from scipy.spatial.transform import Rotation

from drakegrasp.errors import GraspError
from drakegrasp.exchange.columns import read_contacts, read_numbers
from drakegrasp.frames import GRASP_FRAMES, X_WT, invert_pose, make_pose
from drakegrasp.grasp import pack_grasp, transform_grasp
from drakegrasp.simulation.placement import PlacedObject
from drakegrasp.verification.placing import contacts_on_object
from drakegrasp.verification.prediction import read_grasps


def one_grasp(seed=0, k=3):
    """Return a grasp vector of k fingers, points within 5 cm of the origin."""
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(k, 3))
    return pack_grasp(
        rng.uniform(-0.05, 0.05, (k, 3)), normals / np.linalg.norm(normals, axis=1)[:, None]
    )


def random_pose(seed):
    rng = np.random.default_rng(seed)
    R = Rotation.random(random_state=rng).as_matrix()
    return make_pose(R, rng.uniform(-1.0, 1.0, 3))


# Grasp vectors


@pytest.mark.parametrize("k", [1, 2, 3, 5])
def test_points_come_first_then_normals_in_finger_order(k):
    grasps = np.array([one_grasp(i, k) for i in range(4)])
    read = read_grasps(grasps, k)
    points, normals = read.points, read.normals
    assert read.invalid == ("",) * 4 and not read.normalised.any()
    assert points.shape == normals.shape == (4, k, 3)
    for row, p, n in zip(grasps, points, normals, strict=True):
        np.testing.assert_allclose(pack_grasp(p, n), row, atol=1e-15)


@pytest.mark.parametrize("kind", [list, tuple, np.float32, np.float64])
def test_one_grasp_is_a_set_of_one_of_any_kind_of_numbers(kind):
    read = read_grasps(kind(one_grasp().tolist()), 3)
    np.testing.assert_allclose(read.points[0], one_grasp()[:9].reshape(3, 3), atol=1e-7)
    np.testing.assert_allclose(np.linalg.norm(read.normals, axis=-1), 1.0, atol=1e-12)
    assert not read.normalised.any()


@pytest.mark.parametrize(
    ("length", "told"), [(0.995, False), (1.005, False), (0.9, True), (100.0, True), (1e-3, True)]
)
def test_normals_are_normalised_and_that_is_told(length, told):
    grasp = one_grasp()
    grasp[12:15] *= length
    read = read_grasps([one_grasp(), grasp], 3)
    np.testing.assert_allclose(read.normals[1], one_grasp()[9:].reshape(3, 3), atol=1e-12)
    np.testing.assert_array_equal(read.points[1], one_grasp()[:9].reshape(3, 3))
    assert read.normalised.tolist() == [False, told] and read.invalid == ("", "")
    assert np.linalg.norm(grasp[12:15]) == pytest.approx(length)  # the caller's array is as it was


def with_value(number, value):
    grasp = one_grasp()
    grasp[number] = value
    return grasp


def without_normal():
    grasp = one_grasp()
    grasp[12:15] = 0.0
    return grasp


@pytest.mark.parametrize(
    ("row", "reason"),
    [
        (with_value(0, np.nan), "number 1 is nan, not finite"),
        (with_value(17, np.inf), "number 18 is inf, not finite"),
        (with_value(8, -np.inf), "number 9 is -inf, not finite"),
        (with_value(3, 1e6), "number 4 is 1e+06, beyond 1000"),
        (with_value(9, 1e200), "number 10 is 1e+200, beyond 1e+12"),
        (without_normal(), "normal 2 is zero"),
    ],
)
def test_a_bad_row_says_why_and_spoils_no_other(row, reason):
    read = read_grasps([one_grasp(1), row, one_grasp(2)], 3)
    assert read.invalid == ("", reason, "")
    assert np.isnan(read.points[1]).all() and np.isnan(read.normals[1]).all()
    for i, seed in ((0, 1), (2, 2)):
        np.testing.assert_allclose(pack_grasp(read.points[i], read.normals[i]), one_grasp(seed))


@pytest.mark.parametrize("shape", [(17,), (19,), (2, 17), (1, 19), (), (0,), (2, 3, 18), (3, 6)])
def test_other_sizes_are_refused(shape):
    assert refused(read_grasps, np.zeros(shape), 3) == (
        "a grasp must be 18 numbers (3 points, then 3 outward normals), "
        f"got an array of shape {shape}"
    )
    assert "a grasp must be 12 numbers (2 points" in refused(read_grasps, one_grasp(), 2)


@pytest.mark.parametrize(
    ("value", "got"),
    [
        ("abc", "got text"),
        (["0.5"] * 18, "got text"),
        ([True] * 18, "got truth values"),
        ([1j] * 18, "got complex numbers"),
        ({"p": 1}, "got a dict"),
        (None, "got None"),
        ([[0.0] * 18, [0.0] * 17], "a grasp must be 18 numbers"),
    ],
)
def test_what_is_no_numbers_is_refused(value, got):
    message = refused(read_grasps, value, 3)
    assert message.startswith("a grasp must be 18 numbers")
    assert got in message


# Frames


def placed_at(X_TO, X_OM):
    """Return an object at a pose, whose file has this frame; of both, only the poses are read."""
    model = SimpleNamespace(X_OM=X_OM)
    return PlacedObject(model=model, X_TO=X_TO)


@pytest.mark.parametrize("cameras", [1, 4])
def test_the_frames_agree(cameras):
    X_TO, X_OM, *poses = (random_pose(seed) for seed in range(1, 3 + cameras))
    grasps_O = np.array([one_grasp(i) for i in range(4)])
    X_TC = poses[0] if cameras == 1 else np.array(poses)
    to_frame = {
        "object": np.eye(4),
        "table": X_TO,
        "world": X_WT @ X_TO,
        "mesh": invert_pose(X_OM),
        "camera": invert_pose(X_TC) @ X_TO,
    }
    assert set(to_frame) == set(GRASP_FRAMES)
    for frame, X in to_frame.items():
        each = zip(np.broadcast_to(X, (4, 4, 4)), grasps_O, strict=True)
        given = [transform_grasp(*pair) for pair in each]
        where = {"X_TC": X_TC} if frame == "camera" else {}
        found = contacts_on_object(given, placed_at(X_TO, X_OM), frame=frame, **where)
        packed = [pack_grasp(*grasp.in_object_frame()) for grasp in found]
        np.testing.assert_allclose(packed, grasps_O, atol=1e-12)


@pytest.mark.parametrize(
    ("frame", "X", "message"),
    [
        ("palm", None, "frame must be one of object, table, camera, world, mesh, got 'palm'"),
        ("", None, "frame must be one of object, table, camera, world, mesh, got ''"),
        (None, None, "frame must be one of object, table, camera, world, mesh, got None"),
        ("camera", None, "X_TC must be the camera's pose in the table-top frame"),
        ("object", np.eye(4), "X_TC must be None if frame is object, got a pose"),
        ("table", np.eye(4), "X_TC must be None if frame is table, got a pose"),
        (
            "camera",
            np.tile(np.eye(4), (3, 1, 1)),
            "X_TC must be one pose, or one per grasp (2), got 3",
        ),
        ("camera", np.eye(4)[None], "X_TC must be one pose, or one per grasp (2), got 1"),
    ],
)
def test_a_frame_out_of_place_is_refused(frame, X, message):
    placed = placed_at(np.eye(4), np.eye(4))
    text = refused(contacts_on_object, np.ones((2, 18)), placed, frame=frame, X_TC=X)
    assert text.startswith(message)


# Files

NUMBERS = np.random.default_rng(0).normal(size=(4, 18)).round(6)


def write(path, content):
    """Write bytes, an array, or the arrays of an HDF5 file by their names."""
    if isinstance(content, dict):
        with h5py.File(path, "w") as file:
            for name, values in content.items():
                file[name] = values
    elif isinstance(content, bytes):
        path.write_bytes(content)
    else:
        np.save(path, content)
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


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.txt", b"1,2,3", r"must be a file \.npy, \.h5 or \.hdf5, got '\.txt'"),
        ("a.npy", [[1j] * 18], "must hold real numbers, got complex numbers"),
        ("a.npy", [[True] * 18], "must hold real numbers, got truth values"),
        ("a.npy", np.zeros((2, 3, 6)), r"or one grasp, got an array of shape \(2, 3, 6\)"),
        ("a.h5", {"images": np.zeros(3)}, "must hold an array 'grasps' .*, got none$"),
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
