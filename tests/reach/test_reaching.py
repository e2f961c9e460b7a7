"""An arm's branches, what it collides with, and what it can do about a grasp."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.objects import box_model

from drakegrasp.errors import ConfigError
from drakegrasp.frames import Array, invert_pose, make_pose, rotation_about, rotation_angle
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.kinematics import joint_positions
from drakegrasp.objects.model import ObjectModel
from drakegrasp.objects.surroundings import CORNERS, Box, Hull, Neighbourhood, Wall
from drakegrasp.reach.arm import load_arm, mount_of, mount_pose
from drakegrasp.reach.branches import find_branches, flange_poses, follow
from drakegrasp.reach.cell import Cell, make_cell
from drakegrasp.reach.reaching import Grasp, Reach, approach_path, lift_path, reach_grasp

#: Height of the box [m].
HEIGHT = 0.1
BASE = (-0.5, 0.0, 0.0, 0.3)


@pytest.fixture(scope="module")
def box(tmp_path_factory: pytest.TempPathFactory) -> ObjectModel:
    return box_model(tmp_path_factory.mktemp("box"), [0.06, 0.06, HEIGHT])


def cell_of(path: Path, base: tuple[float, ...] = BASE, hand: str = "barrett") -> Cell:
    arm = load_arm(path, base)
    return make_cell(arm, hand, mount_of(arm, load_hand(hand)))


def hand_at(cell: Cell, share: float) -> Array:
    """Return the joints of a hand that has closed by a share of a radian."""
    named = joint_positions(cell.hand, 0.0, np.full(cell.hand.num_fingers, share))
    return np.array([named[name] for name in cell.hand_joints])


def drawn(cell: Cell, count: int) -> Array:
    """Return configurations (count, a) within the limits, and within a turn."""
    lower, upper = np.clip(cell.limits, -3.0, 3.0).T
    return lower + np.random.default_rng(0).random((count, len(lower))) * (upper - lower)


def pose_by_drake(cell: Cell, q: Array, frame: str) -> Array:
    plant, context = cell.checker.plant(), cell.checker.plant_context()
    cell.checker.UpdatePositions(cell.positions(q, np.zeros(len(cell.hand_columns))))
    return np.asarray(plant.GetFrameByName(frame).CalcPoseInWorld(context).GetAsMatrix4())


def top_grasp(cell: Cell, **changes: object) -> Grasp:
    """Return a grasp of the box from above, with the palm 80 mm above it."""
    down = make_pose(np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, HEIGHT + 0.08])
    grasp = Grasp(
        X_TO=make_pose(np.eye(3), [0.0, 0.0, HEIGHT / 2.0]),
        X_TG=down,
        q_open=hand_at(cell, 0.0),
        q_closed=hand_at(cell, 0.8),
        p_TG_lifted=np.array([0.0, 0.0, 0.4]),
    )
    return replace(grasp, **changes)


def test_branches_meet_their_pose_by_drake_within_limits(six: Path) -> None:
    cell = cell_of(six)
    lower, upper = cell.limits.T
    np.testing.assert_allclose(cell.limits[[0, 5]], [[-6.2, 6.2], [-2 * np.pi, 2 * np.pi]])
    for q in drawn(cell, 8):
        X_TF = pose_by_drake(cell, q, "flange")
        found = find_branches(cell.chain, cell.limits, X_TF)
        for row in found:
            X = invert_pose(X_TF) @ pose_by_drake(cell, row, "flange")
            assert np.abs(X[:3, 3]).max() < 1e-4
            assert rotation_angle(X[:3, :3]) < 1e-3
        assert ((found >= lower) & (found <= upper)).all()
        # The drawn configuration is among them, and no two are one.
        turns = np.abs(np.sin((found - q) / 2.0)).max(axis=1)
        assert (turns < 1e-3).sum() == 1
        apart = np.abs(found[:, None] - found[None]).max(axis=2) + np.eye(len(found))
        assert apart.min() >= 0.05


def test_six_joints_have_eight_branches(six: Path) -> None:
    cell = cell_of(six)
    q = np.array([-1.4, 1.3, 0.7, 1.1, -1.2, 1.2])
    found = find_branches(cell.chain, cell.limits, flange_poses(cell.chain, q[None])[0][0])
    assert len(found) == 8
    # The first one is farthest from its limits.
    middle, half = cell.limits.mean(axis=1), np.diff(cell.limits, axis=1)[:, 0] / 2.0
    use = np.abs((found - middle) / half).max(axis=1)
    assert (np.diff(use) >= 0.0).all()
    assert not len(find_branches(cell.chain, cell.limits, make_pose(np.eye(3), [9.0, 0.0, 0.0])))


def test_a_branch_is_followed_without_a_jump(six: Path) -> None:
    cell = cell_of(six)
    q = np.array([[0.4, 0.2, 1.6, 0.4, 1.1, 0.2]])
    start, way = flange_poses(cell.chain, q)[0][0], np.array([-0.05, 0.05, 0.12])
    path = np.tile(start, (12, 1, 1))
    path[:, :3, 3] += np.linspace(1.0 / 12.0, 1.0, 12)[:, None] * way
    found, alive = follow(cell.chain, cell.limits, path, q, 0.3)
    assert alive.all()
    np.testing.assert_allclose(flange_poses(cell.chain, found[:, 0])[0], path, atol=1e-4)
    moved = np.abs(np.diff(np.concatenate([q[None], found]), axis=0)).max()
    for jump, expected in ((1.01 * moved, True), (0.99 * moved, False)):
        assert follow(cell.chain, cell.limits, path, q, jump)[1][0] == expected

    # Limits that the branch crosses on its way, and a pose beyond the arm, end it.
    tight = np.stack([np.minimum(q[0], found[5, 0]), np.maximum(q[0], found[5, 0])], axis=1)
    assert not follow(cell.chain, tight, path, q, 0.3)[1][0]
    path[-1, 0, 3] += 3.0
    stopped, alive = follow(cell.chain, cell.limits, path, q, 0.3)
    assert not alive[0]
    np.testing.assert_array_equal(stopped[-1], stopped[-2])


def test_what_collides(six: Path) -> None:
    cell = cell_of(six)
    closed = hand_at(cell, 0.5)
    up, flat = np.zeros(6), np.array([0.0, np.pi / 2.0, 0.0, 0.0, 0.0, 0.0])
    assert cell.is_free(up, closed)
    # The shoulder, a ball of 60 mm, is 150 mm above the table.
    assert cell.table_distance(up, closed) == pytest.approx(0.09, abs=1e-3)
    assert cell.is_free(flat, closed)
    # The fore arm lies 0.11 m above the table; turned down by 0.4 rad it enters the table.
    assert 0.0 < cell.table_distance(flat, closed) < 0.11
    low = flat + 0.4 * np.eye(6)[1]
    assert not cell.is_free(low, closed)
    assert cell.table_distance(low, closed) < 0.0
    # The fore arm folds into the upper arm.
    assert not cell.is_free(up + 3.0 * np.eye(6)[2], closed)
    # Fingers that overlap are the hand's own matter.
    allegro = cell_of(six, hand="allegro")
    assert allegro.is_free(up, hand_at(allegro, 1.2))
    # Beside the table there is nothing below.
    assert cell_of(six, (-2.0, 0.0, 0.0, 0.0)).is_free(low, closed)


def test_a_reachable_grasp(six: Path, box: ObjectModel) -> None:
    cell = cell_of(six)
    grasp = top_grasp(cell)
    found = reach_grasp(cell, box.field, grasp)
    assert found.outcome == "reachable"
    assert 0.0 < found.clearance <= cell.table_distance(found.q[1], grasp.q_closed) < 0.1
    X_FG = cell.X_FG
    for q, X_TG in zip(
        found.q, (approach_path(grasp)[-1], grasp.X_TG, lift_path(grasp)[-1]), strict=True
    ):
        X = invert_pose(X_TG) @ pose_by_drake(cell, q, "flange") @ X_FG
        assert np.abs(X[:3, 3]).max() < 1e-3
        assert rotation_angle(X[:3, :3]) < np.deg2rad(0.5)
        assert cell.is_free(q, grasp.q_open)
    # The palm link is where the mount says.
    mount = mount_pose([0.01, 0.0, 0.02], [0.0, 0.0, 30.0])
    cell = make_cell(load_arm(six, BASE), "barrett", mount)
    q = reach_grasp(cell, box.field, grasp).q[1]
    X_TB = pose_by_drake(cell, q, "flange") @ mount
    np.testing.assert_allclose(X_TB @ cell.hand.X_BG, grasp.X_TG, atol=1e-3)
    np.testing.assert_allclose(approach_path(grasp)[-1][:3, 3], [0.0, 0.0, HEIGHT + 0.18])
    np.testing.assert_allclose(lift_path(grasp)[-1][:3, 3], grasp.p_TG_lifted)
    again = reach_grasp(cell_of(six), box.field, grasp)
    np.testing.assert_array_equal(again.q, found.q)


def test_why_a_grasp_is_not_reachable(six: Path, box: ObjectModel) -> None:
    near, far = cell_of(six), cell_of(six, (-1.9, 0.0, 0.0, 0.0))
    aside = cell_of(six, (-0.1, 0.0, 0.0, 0.0))
    from_below = make_pose(np.eye(3), [0.0, 0.0, -0.05])
    turned = make_pose(rotation_about([0.0, 1.0, 0.0], np.pi / 2.0), [-0.10, 0.0, 0.06])
    cases = {
        "out_of_reach": (far, top_grasp(far)),
        "approach": (near, top_grasp(near, X_TG=from_below)),
        "lift": (near, top_grasp(near, p_TG_lifted=np.array([0.0, 0.0, 2.0]))),
        "collision": (aside, top_grasp(aside, X_TG=turned, p_TG_lifted=np.array([0.0, 0.0, 0.2]))),
    }
    for outcome, (cell, grasp) in cases.items():
        found = reach_grasp(cell, box.field, grasp)
        assert found.outcome == outcome
        assert np.isnan(found.q).all()
        assert np.isnan(found.clearance)


def test_the_hand_must_not_meet_the_object_on_its_way(six: Path, box: ObjectModel) -> None:
    """The Barrett Hand's palm is 1.35 mm in front of {G}, and 2.5 mm may overlap."""
    cell = cell_of(six)
    for height, outcome in ((-0.04, "approach"), (-0.012, "approach"), (0.0, "reachable")):
        X_TG = make_pose(np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, HEIGHT + height])
        grasp = top_grasp(cell, X_TG=X_TG, q_closed=hand_at(cell, 0.0))
        assert reach_grasp(cell, box.field, grasp).outcome == outcome


def test_the_arm_must_not_meet_the_object(six: Path, tmp_path: Path) -> None:
    """From behind a post the arm reaches around it, but not over a wall."""
    cell = cell_of(six, (-0.35, 0.0, 0.0, 0.0))
    back = make_pose([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]], [0.1, 0.0, 0.4])
    about = {
        "X_TO": make_pose(np.eye(3), [0.0, 0.0, 0.25]),
        "X_TG": back,
        "p_TG_lifted": np.array([0.1, 0.0, 0.45]),
    }
    for name, width, reachable in (("post", 0.06, True), ("wall", 0.9, False)):
        (tmp_path / name).mkdir()
        model = box_model(tmp_path / name, [0.04, width, 0.5])
        assert reach_grasp(cell, model.field, top_grasp(cell, **about)).reachable == reachable


def test_the_object_moves_with_the_hand(six: Path, tmp_path: Path) -> None:
    """A plate below the arm is lifted into it, if it is lifted high."""
    cell = cell_of(six, (-0.45, 0.0, 0.0, 0.0))
    plate = box_model(tmp_path, [0.6, 0.3, 0.03])
    for height, outcome in ((0.3, "reachable"), (0.45, "lift")):
        grasp = top_grasp(
            cell,
            X_TO=make_pose(np.diag([1.0, -1.0, -1.0]), [-0.06, 0.0, 0.015]),
            X_TG=make_pose(np.diag([1.0, -1.0, -1.0]), [0.19, 0.0, 0.13]),
            q_closed=hand_at(cell, 0.0),
            p_TG_lifted=np.array([0.19, 0.0, height]),
        )
        assert reach_grasp(cell, plate.field, grasp).outcome == outcome


def wall(x: float, height: float) -> Box:
    """Return a wall of 10 cm across the table."""
    size = np.array([0.1, 1.6, height])
    return Box(size=size, X_TB=make_pose(np.eye(3), [x, 0.0, height / 2.0]))


def around_of(*walls: Wall, neighbours: dict[ObjectModel, Array] | None = None) -> Neighbourhood:
    """Return walls, and neighbours by their positions."""
    found = neighbours or {}
    X_TN = [make_pose(np.eye(3), p_TN) for p_TN in found.values()]
    return Neighbourhood(
        models=tuple(found), X_TN=np.array(X_TN).reshape(-1, 4, 4), walls=tuple(walls)
    )


def reach_among(
    six: Path,
    box: ObjectModel,
    around: Neighbourhood | None,
    base: tuple[float, ...] = BASE,
    **changes: object,
) -> Reach:
    """Return what an arm can do about the grasp from above."""
    arm = load_arm(six, base)
    cell = make_cell(arm, "barrett", mount_of(arm, load_hand()), around)
    return reach_grasp(cell, box.field, top_grasp(cell, around=around, **changes))


def hull(box: Box) -> Hull:
    return Hull(vertices=box.size * CORNERS, X_TB=box.X_TB)


@pytest.mark.parametrize("of", [lambda box: box, hull], ids=["box", "hull"])
def test_a_wall_in_the_way_of_the_arm(
    six: Path, box: ObjectModel, of: Callable[[Box], Wall]
) -> None:
    free, beside = reach_among(six, box, None), reach_among(six, box, around_of(of(wall(0.6, 0.3))))
    assert free.reachable
    np.testing.assert_array_equal(beside.q, free.q)
    assert beside.clearance == free.clearance

    # Nothing gets past a high wall, unless the arm stands on the other side of it.
    high = around_of(of(wall(-0.25, 1.2)))
    assert reach_among(six, box, high).outcome == "collision"
    assert reach_among(six, box, high, (0.5, 0.0, 0.0, 0.3)).reachable
    # A low wall is passed, and the arm comes nearer to it than to the table.
    low = reach_among(six, box, around_of(of(wall(-0.15, 0.1))))
    assert low.reachable
    assert low.clearance < free.clearance
    with pytest.raises(ConfigError, match="base must be clear of the walls, got 'base' in one"):
        reach_among(six, box, around_of(of(wall(-0.45, 0.05))))


def test_a_neighbour_in_the_way_of_arm_or_hand(six: Path, box: ObjectModel, tmp_path: Path) -> None:
    (tmp_path / "high").mkdir()
    high = box_model(tmp_path / "high", [0.1, 1.2, 1.2])
    post = box_model(tmp_path, [0.04, 0.04, 0.3])
    free = reach_among(six, box, None)
    for neighbours, outcome in (
        ({high: [-0.25, 0.0, 0.6]}, "collision"),
        ({post: [0.0, 0.09, 0.15]}, "approach"),
        ({post: [0.4, 0.3, 0.15]}, "reachable"),
        ({post: [0.4, 0.3, 0.15], high: [-0.25, 0.0, 0.6]}, "collision"),
    ):
        found = reach_among(six, box, around_of(neighbours=neighbours))
        assert found.outcome == outcome
    far = reach_among(six, box, around_of(neighbours={post: [0.4, 0.3, 0.15]}))
    np.testing.assert_array_equal(far.q, free.q)


def test_a_neighbour_stays_when_the_object_is_lifted(
    six: Path, box: ObjectModel, tmp_path: Path
) -> None:
    """A beam above the arm is hit by the lift alone."""
    beam = around_of(neighbours={box_model(tmp_path, [0.06, 1.0, 0.06]): [-0.25, 0.0, 0.7]})
    for height, outcome in ((0.4, "reachable"), (0.6, "lift")):
        up = np.array([0.0, 0.0, height])
        assert reach_among(six, box, None, p_TG_lifted=up).reachable
        assert reach_among(six, box, beam, p_TG_lifted=up).outcome == outcome
