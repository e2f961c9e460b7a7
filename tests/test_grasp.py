"""The grasp vector: its order, its change of frame, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from drakegrasp.frames import Array, invert_pose, make_pose
from drakegrasp.grasp import pack_grasp, transform_grasp, unpack_grasp

vectors = arrays(np.float64, 3, elements=st.floats(-3.0, 3.0))
poses = st.builds(lambda r, p: make_pose(Rotation.from_rotvec(r).as_matrix(), p), vectors, vectors)
grasps = st.integers(1, 5).flatmap(
    lambda k: arrays(np.float64, 6 * k, elements=st.floats(-1.0, 1.0))
)


def test_vector_is_all_points_then_all_normals_in_finger_order() -> None:
    points = [[1, 2, 3], [4, 5, 6], [7, 8, 9]]
    normals = [[10, 11, 12], [13, 14, 15], [16, 17, 18]]
    np.testing.assert_array_equal(pack_grasp(points, normals), np.arange(1, 19))


@given(grasps)
def test_unpacking_and_packing_loses_no_bit(grasp: Array) -> None:
    points, normals = unpack_grasp(grasp)
    assert points.shape == normals.shape == (len(grasp) // 6, 3)
    np.testing.assert_array_equal(pack_grasp(points, normals), grasp)


@given(grasps, vectors)
def test_translation_moves_points_and_leaves_normals(grasp: Array, p_AB: Array) -> None:
    points, normals = unpack_grasp(transform_grasp(make_pose(np.eye(3), p_AB), grasp))
    old_points, old_normals = unpack_grasp(grasp)
    np.testing.assert_allclose(points - old_points, np.tile(p_AB, (len(points), 1)), atol=1e-14)
    np.testing.assert_array_equal(normals, old_normals)


def test_rotation_turns_points_and_normals_alike() -> None:
    """A quarter turn about z takes x to y and y to -x."""
    R_AB = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    grasp_A = transform_grasp(make_pose(R_AB, [0, 0, 0]), [1, 0, 5, 0, 1, 0])
    np.testing.assert_array_equal(grasp_A, [0, 1, 5, -1, 0, 0])


@given(poses, poses, grasps)
def test_change_of_frame_composes_and_undoes(X_AB: Array, X_BC: Array, grasp_C: Array) -> None:
    grasp_A = transform_grasp(X_AB @ X_BC, grasp_C)
    np.testing.assert_allclose(
        grasp_A, transform_grasp(X_AB, transform_grasp(X_BC, grasp_C)), atol=1e-13
    )
    np.testing.assert_allclose(
        transform_grasp(invert_pose(X_AB @ X_BC), grasp_A), grasp_C, atol=1e-13
    )


@pytest.mark.parametrize("shape", [(0,), (5,), (17,), (3, 6), (2, 18), ()])
def test_vector_of_a_wrong_shape_is_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"must be a vector of 6 .* got an array of shape"):
        unpack_grasp(np.zeros(shape))


@pytest.mark.parametrize(
    ("points", "normals"), [((3, 3), (2, 3)), ((3, 2), (3, 2)), ((9,), (9,)), ((3, 3), (9,))]
)
def test_points_and_normals_that_do_not_pair_are_refused(
    points: tuple[int, ...], normals: tuple[int, ...]
) -> None:
    with pytest.raises(ValueError, match=r"must both be \(k, 3\) arrays, got"):
        pack_grasp(np.zeros(points), np.zeros(normals))
