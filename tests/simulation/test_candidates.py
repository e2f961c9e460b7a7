"""Palm poses: the paper's counts, proved by other means, and draws that repeat themselves."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import trimesh
from helpers.objects import model_of
from scipy.spatial import cKDTree

from drakegrasp.frames import Array, make_pose
from drakegrasp.hand.settings import load_config
from drakegrasp.objects.model import ObjectModel
from drakegrasp.seeding import Stream
from drakegrasp.simulation.attempt import Attempt
from drakegrasp.simulation.candidates import (
    Candidates,
    Drawing,
    palm_attempts,
    rotation_candidates,
)

#: Full extents of three of the paper's meshes [m]; their files are in centimetres. Counts
#: of valid and of distinct poses.
BOXES = {
    "24_mug": ((0.09347607, 0.09348067, 0.14255742), 122_272, 29_992),
    "104_toaster": ((0.1324396, 0.2934922, 0.17027119), 98_688, 25_432),
    "39_beerbottle": ((0.05897712, 0.05885956, 0.23366707), 75_776, 16_296),
}

DEFAULTS = load_config().candidates
NORMALS = load_config(overrides=["candidates.method=normals", "candidates.max=400"])


def standing(half: Array) -> Array:
    """Return X_TO of a box that stands on the table unturned."""
    return make_pose(np.eye(3), [0.0, 0.0, half[2]])


def euler(angles_deg: list[tuple[int, ...]]) -> Array:
    """Return Rx Ry Rz (n, 3, 3) from sines and cosines, apart from the implementation's SciPy."""
    (cx, cy, cz), (sx, sy, sz) = (f(np.deg2rad(angles_deg)).T for f in (np.cos, np.sin))
    rows = [
        [cy * cz, -cy * sz, sy],
        [cx * sz + sx * sy * cz, cx * cz - sx * sy * sz, -sx * cy],
        [sx * sz - cx * sy * cz, sx * cz + cx * sy * sz, cx * cy],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def line_meets_box(p: Array, z: Array, half: Array) -> Array:
    """Return whether lines pass a box, by the separating axes of a line and a box.

    The axes are z x e_i: there is no division and no slab.
    """
    moment, z = np.abs(np.cross(p, z)), np.abs(z)
    reach = np.stack(
        [
            half[1] * z[:, 2] + half[2] * z[:, 1],
            half[0] * z[:, 2] + half[2] * z[:, 0],
            half[0] * z[:, 1] + half[1] * z[:, 0],
        ],
        axis=1,
    )
    # A line along e_i has no such axis: 0 <= 0, but for rounding.
    return np.all(moment <= reach + 1e-15, axis=1)


def every_valid_pose(half: Array, scale: float = 1.0) -> tuple[Array, Array]:
    """Return rotations (n, 3, 3) and positions (n, 3) of all valid combinations, repeats too.

    The box that the rays must meet is `scale` times the one that the palms stand around.
    """
    eighths = range(0, 360, 45)
    R_global = euler(list(itertools.product(range(0, 181, 30), range(0, 360, 30), eighths)))
    R_local = euler(list(itertools.product(range(0, 181, 20), range(0, 360, 20), eighths)))
    radius = np.sqrt(half @ half)
    rotations, positions = [], []
    for R in R_global:
        p = radius * R[:, 2]
        if p[2] + half[2] <= 0.0:
            continue
        z = R_local[:, :, 2] @ (R @ np.diag([1.0, -1.0, -1.0])).T
        # The palm is outside of the box: a line that meets it does so ahead if z looks inward.
        hits = line_meets_box(np.broadcast_to(p, z.shape), z, scale * half) & (z @ p < 0.0)
        rotations.append(R @ np.diag([1.0, -1.0, -1.0]) @ R_local[hits])
        positions.append(np.broadcast_to(p, (hits.sum(), 3)))
    return np.concatenate(rotations), np.concatenate(positions)


def coordinates(R: Array, p: Array, half: Array) -> Array:
    """Return poses as points (n, 12) whose distance tells poses apart."""
    return np.hstack([R.reshape(-1, 9), p / np.linalg.norm(half)])


@pytest.fixture(scope="module")
def box(tmp_path_factory: pytest.TempPathFactory) -> ObjectModel:
    mesh = trimesh.creation.box((0.06, 0.08, 0.10))
    return model_of(mesh, tmp_path_factory.mktemp("mesh"), "box")


BOX_X_TO = make_pose(np.eye(3), [0.0, 0.0, 0.05])


@pytest.mark.parametrize(("extents", "valid", "distinct"), BOXES.values(), ids=BOXES)
def test_poses_are_the_distinct_ones_of_all_that_a_brute_force_finds(
    extents: tuple[float, ...], valid: int, distinct: int
) -> None:
    """No ray grazes the box, so that the count does not hang on rounding. No pose comes twice."""
    half = np.array(extents) / 2.0
    every_valid = coordinates(*every_valid_pose(half), half)
    assert len(every_valid) == valid
    for scale in (1.0 - 1e-7, 1.0 + 1e-7):
        assert len(every_valid_pose(half, scale)[0]) == valid
    poses = rotation_candidates(half, standing(half), DEFAULTS, Stream(0))
    tree = cKDTree(ours := coordinates(poses[:, :3, :3], poses[:, :3, 3], half))
    assert not tree.query_pairs(1e-6)
    nearest, index = tree.query(every_valid)
    assert nearest.max() < 1e-9
    assert len(np.unique(index)) == len(ours) == distinct


@pytest.mark.parametrize(
    ("method", "most"),
    [("rotations", 150), ("normals, normals, rotations", 1500), ("closing", 90)],
)
def test_smaller_number_of_turns_is_a_prefix(box: ObjectModel, method: str, most: int) -> None:
    """So more candidates can be tried later without losing the shards of the first."""
    upside_down = BOX_X_TO @ np.diag([1.0, -1.0, -1.0, 1.0])
    poses = np.stack([BOX_X_TO, upside_down])
    config = load_config(overrides=[f"candidates.method=[{method}]"])
    many, few = (Drawing(box, poses, config).candidates(n) for n in (most, 40))
    assert (len(many), len(few)) == (most, 40)
    for name in ("X_OG", "distance", "resting", "source", "spread"):
        np.testing.assert_array_equal(getattr(many, name)[:40], getattr(few, name))


def test_normals_approach_the_faces_of_a_box_squarely_and_not_from_below(box: ObjectModel) -> None:
    """Gz is minus a face's normal, and the palm ray ends on that face."""
    drawn = Drawing(box, BOX_X_TO, NORMALS).candidates()
    z = drawn.X_OG[:, :3, 2]
    np.testing.assert_allclose(np.abs(z).max(axis=1), 1.0, atol=1e-12)
    surface = drawn.X_OG[:, :3, 3] + drawn.distance[:, None] * z
    axis = np.abs(z).argmax(axis=1)
    rows = np.arange(len(z))
    np.testing.assert_allclose(
        surface[rows, axis], -z[rows, axis] * box.half_extents[axis], atol=1e-7
    )
    assert (np.abs(surface) <= box.half_extents + 1e-7).all()
    radius = np.linalg.norm(box.half_extents)
    # Far enough away to be outside of any object with this box.
    assert drawn.distance.min() > radius - 1e-7
    assert np.ptp(drawn.distance) < 1e-7
    assert len(drawn) == 400
    assert (drawn.X_OG[:, 2, 3] > -0.05).all()
    assert not (z[:, 2] > 0.5).any()


def some_candidates(n: int = 30) -> Candidates:
    X_OG = np.tile(make_pose(np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, 0.3]), (n, 1, 1))
    distance = np.linspace(0.2, 0.25, n)
    distance[1] = np.nan
    return Candidates(
        X_OG=X_OG,
        distance=distance,
        resting=np.zeros(n, dtype=np.int64),
        source=np.zeros(n, dtype=np.int64),
        spread=np.full(n, np.nan),
        preshape_index=np.full(n, -1),
    )


def attempts(preshapes: int = 0) -> list[Attempt]:
    drawn, config = some_candidates(), load_config().candidates
    made = palm_attempts(drawn, range(30), config, name="thing", seed=0, preshapes=preshapes)
    return list(made)


def test_every_candidate_is_tried_at_every_standoff_from_the_surface() -> None:
    """From 0.3 m down by distance - standoff, the orientation kept; as it is if its ray misses."""
    drawn, found = some_candidates(), attempts()
    ids = [(a.candidate, a.standoff_index, a.standoff) for a in found]
    assert ids == [(i, j, s) for i in range(30) for j, s in enumerate((0.06, 0.09, 0.12))]
    for attempt in found:
        expected = drawn.X_OG[attempt.candidate].copy()
        assert attempt.ray_hits == (attempt.candidate != 1)
        if attempt.ray_hits:
            expected[2, 3] = 0.3 - (drawn.distance[attempt.candidate] - attempt.standoff)
        np.testing.assert_allclose(attempt.X_OG, expected, atol=1e-15)


def test_each_standoff_draws_its_own_spread() -> None:
    """Of three spreads two stand-offs share one in a third of the cases."""
    drawn = np.array([a.spread for a in attempts()]).reshape(30, 3)
    np.testing.assert_allclose(np.unique(drawn), np.deg2rad([0.0, 11.25, 22.5]))
    for i, j in ((0, 1), (0, 2), (1, 2)):
        assert 2 <= np.count_nonzero(drawn[:, i] == drawn[:, j]) <= 20


def test_preshapes_are_drawn_after_the_spreads() -> None:
    """So spreads are the same with and without them, whatever the number of either."""
    without, shaped = attempts(), attempts(preshapes=3)
    assert [a.spread for a in without] == [a.spread for a in shaped]
    assert {a.preshape for a in without} == {None}
    assert sorted({a.preshape for a in shaped}) == [0, 1, 2]
    assert [a.preshape for a in attempts(preshapes=3)] == [a.preshape for a in shaped]
