"""An object among others: how they come to rest, what a hand meets, and what a trial does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.objects import STANDOFF, box_model, from_above, standing

from drakegrasp.config import Config
from drakegrasp.frames import make_pose, rotation_about, transform_points
from drakegrasp.hand.description import Hand
from drakegrasp.objects.model import ObjectModel
from drakegrasp.objects.surroundings import Box, Neighbourhood
from drakegrasp.outcomes import Outcome
from drakegrasp.seeding import Stream
from drakegrasp.simulation.construction import build_scene
from drakegrasp.simulation.fixtures import load_surroundings
from drakegrasp.simulation.free import first_hit
from drakegrasp.simulation.pile import PileError, pile_up
from drakegrasp.simulation.placement import aligned_pose, canonical_pose
from drakegrasp.simulation.scene import Scene
from drakegrasp.simulation.trial import TrialRecord, run_attempt

pytestmark = pytest.mark.sim

UP = np.eye(3)


@pytest.fixture(scope="module")
def brick(tmp_path_factory: pytest.TempPathFactory) -> ObjectModel:
    return box_model(tmp_path_factory.mktemp("brick"), [0.06, 0.05, 0.04], "2_brick_a")


def beside(model: ObjectModel, x: float, y: float, below: float = 0.0) -> Neighbourhood:
    """Return one neighbour that stands on the table, or at a height."""
    height = below + float(model.half_extents[2])
    return Neighbourhood(models=(model,), X_TN=make_pose(UP, [x, y, height])[None])


def scene_of(cube: ObjectModel, config: Config, hand: Hand, around: Neighbourhood) -> Scene:
    return build_scene(cube, config.physics, hand, around=around)


def tried(cube: ObjectModel, config: Config, hand: Hand, around: Neighbourhood) -> TrialRecord:
    scene = scene_of(cube, config, hand, around)
    return run_attempt(scene, standing(cube), from_above(cube, STANDOFF), config)


def motion(record: TrialRecord, around: Neighbourhood) -> float:
    end = record.lift or record.closed
    assert end is not None
    return float(np.linalg.norm(end.X_TN[0, :3, 3] - around.X_TN[0, :3, 3]))


@pytest.mark.parametrize("name", ["bin", "table", "shelf"])
def test_objects_come_to_rest_within_their_surroundings(
    cube: ObjectModel, brick: ObjectModel, config: Config, name: str
) -> None:
    """On the table or on each other, not in them, and the same from the same stream."""
    models, around = [cube, brick, brick], load_surroundings(name)
    resting = [standing(model) for model in models]
    X_TN = pile_up(models, resting, around, config, Stream(3, 0))
    np.testing.assert_array_equal(X_TN, pile_up(models, resting, around, config, Stream(3, 0)))
    assert (np.abs(X_TN[:, :2, 3]) <= around.extent).all()
    lows = [
        transform_points(X, each.collision_vertices)[:, 2].min()
        for each, X in zip(models, X_TN, strict=True)
    ]
    assert min(lows) > -5e-4
    # Every corner is outside of the other boxes, to a fraction of a millimetre.
    for a, X_TA in zip(models, X_TN, strict=True):
        for b, X_TB in zip(models, X_TN, strict=True):
            if X_TA is not X_TB:
                p_BA = transform_points(np.linalg.inv(X_TB) @ X_TA, a.collision_vertices)
                depth = (b.half_extents - np.abs(p_BA)).min(axis=1).max()
                assert depth < 5e-4


def test_first_object_stands_in_a_resting_pose_and_another_one_may_lie_on_it(
    cube: ObjectModel, brick: ObjectModel, config: Config
) -> None:
    around = load_surroundings("table")
    (alone,) = pile_up([cube], [standing(cube)], around, config, Stream(0, 1))
    np.testing.assert_allclose(canonical_pose(alone), canonical_pose(standing(cube)), atol=2e-6)
    np.testing.assert_array_equal(aligned_pose(alone, standing(cube)[None]), standing(cube))
    on_side = make_pose(rotation_about([1.0, 0.0, 0.0], 0.5 * np.pi), [0.0, 0.0, 0.025])
    (lying,) = pile_up([brick], [on_side], around, config, Stream(0, 1))
    np.testing.assert_allclose(canonical_pose(lying), canonical_pose(on_side), atol=2e-6)
    tilted = make_pose(rotation_about([1.0, 0.0, 0.0], 0.3), alone[:3, 3])
    np.testing.assert_array_equal(
        aligned_pose(tilted, standing(cube)[None]), canonical_pose(tilted)
    )


def test_too_many_objects_have_no_room(cube: ObjectModel, config: Config) -> None:
    shelf, models = load_surroundings("shelf"), [cube] * 40
    with pytest.raises(PileError, match="1_box_a must have room in the shelf, got none"):
        pile_up(models, [standing(cube)] * 40, shelf, config, Stream(0, 0))


@pytest.fixture(scope="module")
def pole(tmp_path_factory: pytest.TempPathFactory) -> ObjectModel:
    return box_model(tmp_path_factory.mktemp("pole"), [0.03, 0.03, 0.1], "3_pole_a")


@pytest.mark.parametrize(
    ("p_OP", "outcome"),
    [
        ([0.0, 0.06, 0.0], Outcome.NEIGHBOUR_HIT),
        ([0.0, -0.09, 0.0], Outcome.NEIGHBOUR_HIT),
        ([0.06, 0.0, 0.0], Outcome.SUCCESS),
        ([0.0, 0.4, 0.0], Outcome.SUCCESS),
    ],
)
def test_hand_that_closes_on_a_neighbour_hits_it(
    cube: ObjectModel,
    pole: ObjectModel,
    config: Config,
    hand: Hand,
    p_OP: list[float],
    outcome: Outcome,
) -> None:
    """The fingers close along Oy, so a pole at the cube's other sides is not in their way."""
    x, y, _ = standing(cube)[:3, :3] @ p_OP
    around = beside(pole, float(x), float(y))
    record = tried(cube, config, hand, around)
    assert record.outcome is outcome
    assert (motion(record, around) < 1e-4) == (outcome is Outcome.SUCCESS)
    assert (record.lift is None) == (outcome is Outcome.NEIGHBOUR_HIT)


def test_neighbour_that_leans_on_the_object_falls_when_it_is_lifted(
    cube: ObjectModel, pole: ObjectModel, config: Config, hand: Hand
) -> None:
    tilt = 0.35
    turn = standing(cube)[:3, :3] @ rotation_about([0.0, 1.0, 0.0], -tilt)
    # Its lower edge is on the table and its side touches the cube's upper edge.
    half = pole.half_extents
    top = float(2.0 * cube.half_extents[2])
    x = float(cube.half_extents[0]) + (top * np.sin(tilt) + half[0]) / np.cos(tilt)
    x -= half[2] * np.sin(tilt)
    lowest = -float((pole.collision_vertices @ turn[2]).min())
    X_TN = make_pose(turn, [*(standing(cube)[:2, :3] @ [x, 0.0, 0.0]), lowest])
    around = Neighbourhood(models=(pole,), X_TN=X_TN[None])
    record = tried(cube, config, hand, around)
    assert record.outcome is Outcome.SUCCESS
    assert motion(record, around) > 0.01


def test_what_the_hand_meets_first_is_told(
    cube: ObjectModel, brick: ObjectModel, config: Config, hand: Hand
) -> None:
    """A neighbour in the way of the open hand, one above the palm, a wall, or nothing."""
    X_TO, attempt = standing(cube), from_above(cube, STANDOFF)
    q = np.zeros(len(hand.joint_order))

    def met(around: Neighbourhood) -> str:
        scene = scene_of(cube, config, hand, around)
        body = first_hit(scene, X_TO, attempt, q)
        return "" if body is None else scene.plant.get_body(body).name()

    assert met(beside(brick, 0.4, 0.0)) == ""
    palm = float(X_TO[2, 3] + attempt.X_OG[2, 3])
    assert met(beside(brick, 0.0, 0.0, below=palm + 0.12)) == "neighbour_0"
    wall = Box(size=np.array([0.5, 0.02, 0.3]), X_TB=make_pose(UP, [0.0, 0.05, 0.15]))
    assert met(Neighbourhood(X_TN=np.zeros((0, 4, 4)), walls=(wall,))) == "table"


def test_a_neighbour_with_points_that_are_almost_equal_can_be_there(
    cube: ObjectModel, brick: ObjectModel, config: Config, hand: Hand
) -> None:
    """Drake refuses the hull of such points; surfaces of images have them."""
    points, faces = brick.collision_vertices, brick.collision_faces
    doubled = replace(
        brick,
        collision_vertices=np.concatenate([points, points + 1e-14 * np.array([1, -1, 1])]),
        collision_faces=np.concatenate([faces, faces + len(points)]).astype(faces.dtype),
    )
    around = Neighbourhood(models=(doubled,), X_TN=make_pose(UP, [0.5, 0.0, 0.02])[None])
    assert scene_of(cube, config, hand, around).neighbours


def test_neighbours_and_walls_move_together(brick: ObjectModel) -> None:
    wall = Box(size=np.array([0.5, 0.02, 0.3]), X_TB=make_pose(UP, [0.0, 0.2, 0.15]))
    around = Neighbourhood(
        models=(brick,), X_TN=make_pose(UP, [0.1, 0.0, 0.02])[None], walls=(wall,)
    )
    moved = around.moved(make_pose(rotation_about([0.0, 0.0, 1.0], np.pi / 2.0), [0.3, 0.0, 0.0]))
    np.testing.assert_allclose(moved.X_TN[0, :3, 3], [0.3, 0.1, 0.02], atol=1e-12)
    np.testing.assert_allclose(moved.walls[0].X_TB[:3, 3], [0.1, 0.0, 0.15], atol=1e-12)
    np.testing.assert_allclose(moved.walls[0].X_TB[:3, 0], [0.0, 1.0, 0.0], atol=1e-12)
