"""The grasp vector: its order, its change of frame; which palm poses are distinct."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from drakegrasp.frames import Array, make_pose, rotate_vectors, rotation_about, transform_points
from drakegrasp.grasp import (
    approach_cells,
    cell_directions,
    distinct_grasps,
    elevation,
    elevation_bands,
    pack_grasp,
    transform_grasp,
    unpack_grasp,
)

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


@given(poses, grasps)
def test_points_are_moved_by_the_pose_and_normals_by_its_rotation(
    X_AB: Array, grasp_B: Array
) -> None:
    p_BQ, nhat_Q_B = unpack_grasp(grasp_B)
    p_AQ, nhat_Q_A = unpack_grasp(transform_grasp(X_AB, grasp_B))
    np.testing.assert_array_equal(p_AQ, transform_points(X_AB, p_BQ))
    np.testing.assert_array_equal(nhat_Q_A, rotate_vectors(X_AB, nhat_Q_B))


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


def pose(x: float = 0.0, turn_deg: float = 0.0, axis: tuple[float, ...] = (0, 0, 1)) -> np.ndarray:
    """A palm at x [m] along Ox, turned about an axis."""
    return make_pose(rotation_about(axis, np.deg2rad(turn_deg)), [x, 0.1, -0.2])


@pytest.mark.parametrize(
    ("other", "is_distinct"),
    [
        (pose(0.020), False),
        (pose(0.0201), True),
        (pose(turn_deg=-30.0), False),
        (pose(turn_deg=31.0, axis=(1, 2, 3)), True),
        (pose(0.019, 29.0), False),
    ],
)
def test_palms_are_near_within_both_limits(other: np.ndarray, is_distinct: bool) -> None:
    for pair in ([pose(), other], [other, pose()]):
        assert distinct_grasps([0, 0], np.array(pair)).tolist() == [True, is_distinct]


def test_nothing_is_distinct_of_nothing() -> None:
    assert distinct_grasps(np.zeros((0, 2)), np.zeros((0, 4, 4))).shape == (0,)
    assert approach_cells(np.zeros((0, 4, 4))).shape == (0,)


def test_cover_is_that_of_comparing_all_pairs() -> None:
    """Hundreds of palms in all directions, some of them near."""
    rng = np.random.default_rng(0)
    poses = np.array([
        make_pose(rotation_about(rng.normal(size=3), rng.uniform(0.0, 1.0)), p)
        for p in rng.uniform(-0.05, 0.05, (600, 3))
    ])  # fmt: skip
    groups = rng.integers(2, size=(600, 2))
    kept: list[int] = []
    for row, (X, group) in enumerate(zip(poses, groups, strict=True)):
        near = [
            np.linalg.norm(X[:3, 3] - poses[k][:3, 3]) <= 0.020
            and (np.trace(X[:3, :3].T @ poses[k][:3, :3]) - 1.0) / 2.0 >= np.sqrt(3.0) / 2.0
            for k in kept
            if (groups[k] == group).all()
        ]
        if not any(near):
            kept.append(row)
    found = distinct_grasps(groups, poses)
    assert 100 < len(kept) < 500
    assert np.flatnonzero(found).tolist() == kept


def test_cells_are_the_vertices_of_an_icosahedron_that_is_subdivided_once() -> None:
    """Twelve corners, and the middles of the thirty edges, each of which is next to two corners."""
    found, golden = cell_directions(), (1.0 + np.sqrt(5.0)) / 2.0
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, rtol=1e-15)
    next_to = np.isclose(found @ found.T, golden / np.hypot(1.0, golden))
    assert sorted(next_to.sum(axis=1)) == [2] * 30 + [5] * 12
    assert (found @ [0.0, 1.0, golden] / np.hypot(1.0, golden)).max() == pytest.approx(1.0)


def test_a_palm_is_in_the_cell_of_the_nearest_direction() -> None:
    rng = np.random.default_rng(0)
    poses = np.array([make_pose(rotation_about(rng.normal(size=3), a), [0, 0, 0.1])
                      for a in rng.uniform(0.0, np.pi, 500)])  # fmt: skip
    found = approach_cells(poses)
    brute = [int(np.argmin(np.linalg.norm(cell_directions() - X[:3, 2], axis=1))) for X in poses]
    assert found.tolist() == brute
    assert len(set(brute)) > 35
    # A palm at a direction is in its cell, and the first of two equally near ones counts.
    for k, direction in enumerate(cell_directions()):
        assert approach_cells(looking(direction)[None])[0] == k
    between = cell_directions()[0] + cell_directions()[12]
    assert approach_cells(looking(between / np.linalg.norm(between))[None])[0] == 0


def looking(z: np.ndarray) -> np.ndarray:
    """A palm whose +Gz has a direction; its other axes do not matter here."""
    X_OG = np.eye(4)
    X_OG[:3, 2] = z
    return X_OG


@pytest.mark.parametrize(
    ("tilt_deg", "expected_deg", "band"),
    [
        (180.0, 90.0, 2),  # straight from above
        (150.0, 60.0, 1),
        (151.0, 61.0, 2),
        (120.0, 30.0, 0),
        (121.0, 31.0, 1),
        (90.0, 0.0, 0),  # from the side
        (60.0, -30.0, 0),
    ],
)
@pytest.mark.parametrize("yaw", [0.0, 77.0])
def test_elevation_is_the_angle_of_the_approach_above_the_table(
    tilt_deg: float, expected_deg: float, band: int, yaw: float
) -> None:
    turn = rotation_about([0, 0, 1], np.deg2rad(yaw))
    tilt = rotation_about([1, 0, 0], np.deg2rad(tilt_deg))
    X_TG = make_pose(turn @ tilt, [0.3, 0.1, 0.2])[None]
    assert np.rad2deg(elevation(X_TG)) == pytest.approx([expected_deg], abs=1e-5)
    assert elevation_bands(X_TG).tolist() == [band]
