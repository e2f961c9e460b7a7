"""What may be handed in to be verified: rows that are no grasp say why, and equal frames."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import numpy.typing as npt
import pytest
from helpers.assertions import refused
from scipy.spatial.transform import Rotation

from drakegrasp.frames import GRASP_FRAMES, X_WT, invert_pose, make_pose, pack_pose, read_pose
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


@pytest.mark.parametrize("single", [False, True], ids=["float64", "float32 rows"])
@pytest.mark.parametrize("cameras", [1, 4], ids=["one camera", "one per grasp"])
def test_the_frames_agree(single, cameras):
    X_TO, X_OM, *X_TC = (random_pose(seed) for seed in range(1, 3 + cameras))
    grasps_O = np.array([one_grasp(i) for i in range(4)])
    given: npt.ArrayLike = X_TC[0] if cameras == 1 else np.array(X_TC)
    if single:
        given = pack_pose(given).astype(np.float32)
    X = read_pose(given, "X_TC")
    # The poses that were handed in, after rounding, are the true ones.
    each = np.broadcast_to(X, (4, 4, 4))
    grasps = {
        "object": grasps_O,
        "table": np.array([transform_grasp(X_TO, g) for g in grasps_O]),
        "world": np.array([transform_grasp(X_WT @ X_TO, g) for g in grasps_O]),
        "mesh": np.array([transform_grasp(invert_pose(X_OM), g) for g in grasps_O]),
        "camera": np.array(
            [transform_grasp(invert_pose(C) @ X_TO, g) for C, g in zip(each, grasps_O, strict=True)]
        ),
    }
    assert set(grasps) == set(GRASP_FRAMES)
    placed = placed_at(X_TO, X_OM)
    for frame, values in grasps.items():
        where = {"X_TC": X} if frame == "camera" else {}
        for grasp, due in zip(
            contacts_on_object(values, placed, frame=frame, **where), grasps_O, strict=True
        ):
            found = pack_grasp(*grasp.in_object_frame())
            np.testing.assert_allclose(found, due, atol=1e-12)
    if single:
        np.testing.assert_allclose(X, np.squeeze(X_TC), atol=1e-6)


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
