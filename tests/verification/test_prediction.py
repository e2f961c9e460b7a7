"""What may be handed in to be verified: every refusal in one line, and three equal frames."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from helpers.assertions import refused
from scipy.spatial.transform import Rotation

from drakegrasp.frames import Array, invert_pose, make_pose, pack_pose, read_pose
from drakegrasp.grasp import pack_grasp, transform_grasp
from drakegrasp.verification.prediction import (
    FRAMES,
    read_grasps,
    refuse_other_units,
    to_object_frame,
)


def one_grasp(seed: int = 0, k: int = 3) -> Array:
    """Return a grasp vector of k fingers, points within 5 cm of the origin."""
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(k, 3))
    return pack_grasp(
        rng.uniform(-0.05, 0.05, (k, 3)), normals / np.linalg.norm(normals, axis=1)[:, None]
    )


def random_pose(seed: int) -> Array:
    rng = np.random.default_rng(seed)
    R = Rotation.random(random_state=rng).as_matrix()
    return make_pose(R, rng.uniform(-1.0, 1.0, 3))


# Grasp vectors


@pytest.mark.parametrize("k", [1, 2, 3, 5])
def test_points_come_first_then_normals_in_finger_order(k: int) -> None:
    grasps = np.array([one_grasp(i, k) for i in range(4)])
    points, normals = read_grasps(grasps, k)
    assert points.shape == normals.shape == (4, k, 3)
    for row, p, n in zip(grasps, points, normals, strict=True):
        np.testing.assert_allclose(pack_grasp(p, n), row, atol=1e-15)


@pytest.mark.parametrize("kind", [list, tuple, np.float32, np.float64])
def test_one_grasp_is_a_set_of_one_of_any_kind_of_numbers(kind: Any) -> None:
    points, normals = read_grasps(kind(one_grasp().tolist()), 3)
    np.testing.assert_allclose(points[0], one_grasp()[:9].reshape(3, 3), atol=1e-7)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1.0, atol=1e-12)


@pytest.mark.parametrize("length", [0.951, 0.97, 1.03, 1.049])
def test_nearly_unit_normals_are_mended(length: float) -> None:
    grasp = one_grasp()
    grasp[12:15] *= length
    points, normals = read_grasps(grasp, 3)
    np.testing.assert_allclose(normals, one_grasp()[9:].reshape(1, 3, 3), atol=1e-12)
    np.testing.assert_array_equal(points, one_grasp()[:9].reshape(1, 3, 3))
    assert np.linalg.norm(grasp[12:15]) == pytest.approx(length)  # the caller's array is as it was


@pytest.mark.parametrize(("length", "got"), [(0.9, "0.9"), (1.1, "1.1"), (0.0, "0"), (100, "100")])
def test_other_normals_are_refused(length: float, got: str) -> None:
    grasp = one_grasp()
    grasp[12:15] *= length
    assert refused(read_grasps, grasp, 3) == f"normal 2 must be of length 1 within 5%, got {got}"
    several = np.array([one_grasp(), one_grasp(), grasp])
    assert refused(read_grasps, several, 3).startswith("grasp 2: normal 2 must be of length 1")


@pytest.mark.parametrize("shape", [(17,), (19,), (2, 17), (1, 19), (), (0,), (2, 3, 18), (3, 6)])
def test_other_sizes_are_refused(shape: tuple[int, ...]) -> None:
    assert refused(read_grasps, np.zeros(shape), 3) == (
        "a grasp must be 18 numbers (3 points, then 3 outward normals), "
        f"got an array of shape {shape}"
    )
    assert "a grasp must be 12 numbers (2 points" in refused(read_grasps, one_grasp(), 2)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("number", [0, 8, 9, 17])
def test_numbers_that_are_not_finite_are_refused(value: float, number: int) -> None:
    grasp = one_grasp()
    grasp[number] = value
    assert refused(read_grasps, grasp, 3) == f"number {number + 1} must be finite, got {value}"
    assert refused(read_grasps, [one_grasp(), grasp], 3).startswith(f"grasp 1: number {number + 1}")


@pytest.mark.parametrize(
    ("value", "got"),
    [
        ("abc", "got text"),
        (["0.5"] * 18, "got text"),
        ([True] * 18, "got truth values"),
        ([1j] * 18, "got complex numbers"),
        ([[1.0] * 18, [1.0] * 17], "got a list that is none (setting an array element"),
        ({"p": 1}, "got a dict"),
        (None, "got None"),
    ],
)
def test_what_is_no_numbers_is_refused(value: Any, got: str) -> None:
    message = refused(read_grasps, value, 3)
    assert message.startswith("a grasp must be 18 numbers")
    assert got in message


# Frames


@pytest.mark.parametrize("single", [False, True], ids=["float64", "float32 rows"])
@pytest.mark.parametrize("cameras", [1, 4], ids=["one camera", "one per grasp"])
def test_the_three_frames_agree(single: bool, cameras: int) -> None:
    X_TO, X_TC = random_pose(1), np.array([random_pose(10 + i) for i in range(cameras)])
    grasps_O = np.array([one_grasp(i) for i in range(4)])
    given: npt.ArrayLike = X_TC[0] if cameras == 1 else X_TC
    if single:
        given = pack_pose(given).astype(np.float32)
    X = read_pose(given, "X_TC")
    # The poses that were handed in, after rounding, are the true ones.
    each = np.broadcast_to(X, (4, 4, 4))
    grasps = {
        "object": grasps_O,
        "workspace": np.array([transform_grasp(X_TO, g) for g in grasps_O]),
        "camera": np.array(
            [transform_grasp(invert_pose(C) @ X_TO, g) for C, g in zip(each, grasps_O, strict=True)]
        ),
    }
    assert set(grasps) == set(FRAMES)
    expected = read_grasps(grasps_O, 3)
    for frame, values in grasps.items():
        p_OQ, nhat_Q_O = to_object_frame(
            *read_grasps(values, 3),
            frame=frame,
            X_TC=X if frame == "camera" else None,
            X_TO=X_TO,
        )
        np.testing.assert_allclose(p_OQ, expected[0], atol=1e-12)
        np.testing.assert_allclose(nhat_Q_O, expected[1], atol=1e-12)
    if single:
        np.testing.assert_allclose(X, np.squeeze(X_TC), atol=1e-6)


@pytest.mark.parametrize("frame", FRAMES)
def test_no_grasps_have_no_contacts_in_any_frame(frame: str) -> None:
    points, normals = read_grasps(np.zeros((0, 18)), 3)
    for X in [np.eye(4), np.zeros((0, 4, 4))] if frame == "camera" else [None]:
        p, n = to_object_frame(points, normals, frame=frame, X_TC=X, X_TO=np.eye(4))
        assert p.shape == n.shape == (0, 3, 3)


@pytest.mark.parametrize(
    ("frame", "X", "message"),
    [
        ("world", None, "frame must be one of object, camera, workspace, got 'world'"),
        ("", None, "frame must be one of object, camera, workspace, got ''"),
        (None, None, "frame must be one of object, camera, workspace, got None"),
        ("camera", None, "X_TC must be the camera's pose in the table-top frame"),
        ("object", np.eye(4), "X_TC must be None if frame is object, got a pose"),
        ("workspace", np.eye(4), "X_TC must be None if frame is workspace, got a pose"),
        (
            "camera",
            np.tile(np.eye(4), (3, 1, 1)),
            "X_TC must be one pose, or one per grasp (2), got 3",
        ),
        (
            "camera",
            np.tile(np.eye(4), (1, 1, 1)),
            "X_TC must be one pose, or one per grasp (2), got 1",
        ),
    ],
)
def test_a_frame_out_of_place_is_refused(frame: Any, X: Array | None, message: str) -> None:
    points, normals = read_grasps([one_grasp(0), one_grasp(1)], 3)
    text = refused(to_object_frame, points, normals, frame=frame, X_TC=X, X_TO=np.eye(4))
    assert text.startswith(message)


# Units


HALF_EXTENTS = np.array([0.03, 0.04, 0.05])


def on_the_box(n: int = 2) -> Array:
    """Return points (n, 3, 3) on the faces of the box."""
    rng = np.random.default_rng(0)
    p = rng.uniform(-1.0, 1.0, (n, 3, 3))
    return np.asarray(p / np.abs(p).max(axis=-1, keepdims=True) * HALF_EXTENTS)


def refuse(p: Array) -> None:
    refuse_other_units(list(p), [HALF_EXTENTS] * len(p))


@pytest.mark.parametrize(("factor", "times"), [(100.0, "100"), (1000.0, "1e+03")])
def test_points_in_centimetres_or_millimetres_are_refused(factor: float, times: str) -> None:
    text = refused(refuse, factor * on_the_box())
    assert text.startswith(
        "contact points must lie on the object, whose box is 0.06 x 0.08 x 0.1 m, "
        f"got points all outside 3 times that (the nearest at {times} times)"
    )
    assert "units" in text
    assert "frame" in text


def test_points_near_the_object_are_not_refused() -> None:
    p = on_the_box()
    # One grasp that is right is enough: the others are the prediction's fault.
    for points in (p, 2.9 * p, p[:0], np.concatenate([100.0 * p, p])):
        refuse(points)
