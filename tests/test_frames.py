"""Poses compose as their letters say, and packing loses nothing."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from helpers.assertions import refused
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from drakegrasp.frames import (
    P_WT,
    X_WT,
    Array,
    invert_pose,
    make_pose,
    pack_pose,
    read_pose,
    rotate_vectors,
    rotation_angle,
    transform_points,
    unpack_pose,
)

vectors = arrays(np.float64, 3, elements=st.floats(-3.0, 3.0))
poses = st.builds(lambda r, p: make_pose(Rotation.from_rotvec(r).as_matrix(), p), vectors, vectors)
points = arrays(np.float64, st.tuples(st.integers(0, 5), st.just(3)), elements=st.floats(-2.0, 2.0))

#: Turns x to y, y to z, z to x.
R_CYCLE = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def test_table_top_is_065_m_above_the_world_and_level() -> None:
    np.testing.assert_array_equal(P_WT, [0.0, 0.0, 0.65])
    np.testing.assert_array_equal(X_WT, make_pose(np.eye(3), [0.0, 0.0, 0.65]))


def test_pose_is_packed_as_its_first_three_rows_row_major() -> None:
    packed = pack_pose(make_pose(R_CYCLE, [0.1, 0.2, 0.3]))
    np.testing.assert_array_equal(packed, [0, 0, 1, 0.1, 1, 0, 0, 0.2, 0, 1, 0, 0.3])


@pytest.mark.parametrize("leading", [(), (1,), (4,), (2, 3), (0,)])
def test_packing_keeps_the_leading_dimensions(leading: tuple[int, ...]) -> None:
    X_AB = np.broadcast_to(make_pose(R_CYCLE, [1.0, 2.0, 3.0]), (*leading, 4, 4))
    packed = pack_pose(X_AB)
    assert packed.shape == (*leading, 12)
    np.testing.assert_array_equal(unpack_pose(packed), X_AB)


@given(st.lists(poses, min_size=1, max_size=4))
def test_poses_times_their_inverses_are_the_identity(many: list[Array]) -> None:
    X_AB = np.stack(many)
    for product in (X_AB @ invert_pose(X_AB), invert_pose(X_AB) @ X_AB):
        np.testing.assert_allclose(product, np.tile(np.eye(4), (len(many), 1, 1)), atol=1e-14)


@given(poses, points)
def test_points_are_moved_by_the_whole_pose_and_vectors_by_its_rotation(
    X_AB: Array, p_BQ: Array
) -> None:
    """As products with 1 or 0 as a fourth coordinate."""
    for move, last in ((transform_points, 1.0), (rotate_vectors, 0.0)):
        expected = np.column_stack([p_BQ, np.full(len(p_BQ), last)]) @ X_AB.T
        np.testing.assert_allclose(move(X_AB, p_BQ), expected[:, :3], atol=1e-13)


@given(vectors, st.floats(0.0, np.pi))
def test_rotation_angle_is_the_angle_about_any_axis(axis: Array, angle: float) -> None:
    axis = axis + np.array([0.0, 0.0, 4.0])  # never zero
    R_AB = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).as_matrix()
    # The arc cosine is worth half the digits at its ends.
    assert rotation_angle(R_AB) == pytest.approx(angle, abs=1e-7)


@pytest.mark.parametrize(("scale", "angle"), [(1.0 + 1e-12, 0.0), (-1.0 / 3.0 - 1e-12, np.pi)])
def test_rotation_angle_survives_rounding_at_its_ends(scale: float, angle: float) -> None:
    """A trace a hair beyond 3 or -1 must give 0 or pi, never NaN."""
    assert rotation_angle(scale * np.eye(3)) == pytest.approx(angle)


def test_no_argument_is_changed() -> None:
    X_AB = make_pose(R_CYCLE, [1.0, 2.0, 3.0])
    for locked in (X_AB, q := np.ones((2, 3))):
        locked.setflags(write=False)
    for result in (invert_pose(X_AB), unpack_pose(pack_pose(X_AB)), transform_points(X_AB, q)):
        assert not np.shares_memory(result, X_AB)


def random_pose(seed: int) -> Array:
    rng = np.random.default_rng(seed)
    R = Rotation.random(random_state=rng).as_matrix()
    return make_pose(R, rng.uniform(-1.0, 1.0, 3))


def test_every_way_to_write_a_pose_is_read() -> None:
    X = random_pose(0)
    for written in (X, X[:3], pack_pose(X), X.tolist(), pack_pose(X).tolist()):
        np.testing.assert_allclose(read_pose(written, "X"), X, atol=1e-12)
    many = np.array([random_pose(i) for i in range(5)])
    for written in (many, many[:, :3], pack_pose(many)):
        np.testing.assert_allclose(read_pose(written, "X"), many, atol=1e-12)
    for none in (np.zeros((0, 4, 4)), np.zeros((0, 12))):
        assert read_pose(none, "X").shape == (0, 4, 4)


def test_single_precision_comes_out_as_an_exact_rotation() -> None:
    """As files hold poses: rows (12,) of float32."""
    many = np.array([random_pose(i) for i in range(5)])
    rows = pack_pose(many).astype(np.float32)
    X = read_pose(rows, "X")
    np.testing.assert_allclose(X, many, atol=1e-6)
    R = X[:, :3, :3]
    np.testing.assert_allclose(np.swapaxes(R, 1, 2) @ R, np.tile(np.eye(3), (5, 1, 1)), atol=1e-14)
    np.testing.assert_array_equal(X[:, :3, 3], rows.reshape(5, 3, 4)[:, :, 3])
    np.testing.assert_array_equal(X[:, 3], np.tile([0.0, 0.0, 0.0, 1.0], (5, 1)))


def changed(X: Array, index: Any, value: npt.ArrayLike) -> Array:
    X = X.copy()
    X[index] = value
    return X


BAD_POSES: dict[str, tuple[Any, str]] = {
    "text": ("abc", "X_TC must be a pose, 4 x 4 numbers, got text"),
    "nothing": (None, "X_TC must be a pose, 4 x 4 numbers, got None"),
    "ragged": ([[1, 2], [3]], "X_TC must be a pose, 4 x 4 numbers, got a list that cannot be read"),
    "rotation": (np.eye(3), "X_TC must be a pose, 4 x 4 numbers, got an array of shape (3, 3)"),
    "vector": (np.zeros(16), "X_TC must be a pose, 4 x 4 numbers, got an array of shape (16,)"),
    "too deep": (np.zeros((2, 2, 4, 4)), "4 x 4 numbers, got an array of shape (2, 2, 4, 4)"),
    "nan": (changed(np.eye(4), (0, 3), np.nan), "X_TC must be finite, got numbers that are not"),
    "mirror": (np.diag([1.0, 1.0, -1.0, 1.0]), "with determinant -1"),
    "scaled": (np.diag([1.001, 1.001, 1.001, 1.0]), "that is off by 0.002"),
    "sheared": (changed(np.eye(4), (0, 1), 0.01), "that is off by 0.01 with determinant 1"),
    "zero": (np.diag([0.0, 0.0, 0.0, 1.0]), "with determinant 0"),
    "transposed": (random_pose(1).T, "X_TC must have 0 0 0 1 as its last row, got another"),
    "homogeneous": (2.0 * np.eye(4), "X_TC must have 0 0 0 1 as its last row, got another"),
}


@pytest.mark.parametrize("case", BAD_POSES)
def test_what_is_no_pose_is_refused(case: str) -> None:
    value, message = BAD_POSES[case]
    assert message in refused(read_pose, value, "X_TC")


@pytest.mark.parametrize("case", ["nan", "mirror", "sheared", "transposed"])
def test_one_bad_pose_among_many_is_refused(case: str) -> None:
    value, message = BAD_POSES[case]
    assert "X_TC must" in refused(read_pose, [np.eye(4), value, np.eye(4)], "X_TC")
    assert message.partition("off by")[0] in refused(read_pose, [np.eye(4), value], "X_TC")
