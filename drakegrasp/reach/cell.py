"""An arm with a hand at the table, as a diagram of Drake that answers whether it collides.

Input: an `Arm`, a hand and its mount, and the walls on the table. Output: a `Cell` with the chain
of the arm, and queries at configurations of arm and hand: do links collide with each other, the
table or a wall, how near do they come to table and walls, and where are points on the arm.

Drake checks links against links, the table and walls. Objects need not be convex and Drake would
take their hulls, so points on the links are looked up in their distance fields (`reaching.py`).
Pairs of links that collide in every configuration overlap by construction and are left out; so are
pairs within the hand, whose postures were simulated. The frame {T} is Drake's world.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations
from typing import Any

import numpy as np
import numpy.typing as npt
from pydrake.common import Parallelism
from pydrake.geometry import Box, Convex, Shape
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import CoulombFriction, MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex, RigidBody
from pydrake.planning import RobotDiagramBuilder, SceneGraphCollisionChecker
from scipy.spatial import ConvexHull

from drakegrasp.config import HandSource
from drakegrasp.errors import ConfigError, first_line
from drakegrasp.frames import Array, invert_pose, make_pose, transform_points
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.hand.finger_sweep import even_points
from drakegrasp.hand.parsing import Chain, add_model, find_joints, make_chains
from drakegrasp.hand.shapes import hull_triangles, shape_corners
from drakegrasp.objects.surroundings import CORNERS, Hull, Neighbourhood
from drakegrasp.reach.arm import TABLE_SIZE, Arm
from drakegrasp.runtime.environment import allow_network
from drakegrasp.seeding import Stream

# Drake announces each checker.
logging.getLogger("drake").addFilter(
    lambda record: not record.getMessage().startswith("Allocating contexts")
)

#: Spacing of points on the arm [m].
SPACING = 0.01
#: Number of drawn configurations in which links collide that overlap by construction.
DRAWS = 50
#: Largest distance from table and walls that is measured [m]; it counts as no more than this.
FARTHEST = 0.2
#: Points nearer to an object than this get an exact distance [m].
NEAR = 0.01
#: Range of a joint without limits [rad], as far as the cables of most arms allow.
TURN = 2.0 * np.pi
#: Number of cells that a process keeps.
KEPT = 4
#: The one row of a `PointLookup` of one pose.
FIRST = np.zeros(1, dtype=np.int64)


@dataclass(frozen=True, kw_only=True, eq=False)
class Cell:
    """An arm with a joints, a hand with j joints, the table, and walls on it.

    Attributes:
        arm: The arm.
        hand: The hand.
        X_FG: (4, 4), palm frame on the flange.
        chain: The joints of the arm, from {T} to the flange.
        limits: (a, 2), their limits [rad or m].
        checker: Drake's checker of links, table and walls.
        hand_joints: Names of the hand's joints, in the order of every `q`.
        arm_columns, hand_columns: Places of the joints of arm and hand in Drake's positions.
        points: Points (n, 3) on each link of the arm, by its index in the plant [m].
    """

    arm: Arm
    hand: Hand
    X_FG: Array
    chain: Chain
    limits: Array
    checker: SceneGraphCollisionChecker
    hand_joints: tuple[str, ...]
    arm_columns: npt.NDArray[np.int64]
    hand_columns: npt.NDArray[np.int64]
    points: Mapping[Any, Array]

    def positions(self, q: Array, q_hand: Array) -> Array:
        """Return Drake's positions of arm (a,) and hand (j,)."""
        found = np.zeros(self.checker.plant().num_positions())
        found[self.arm_columns], found[self.hand_columns] = q, q_hand
        return found

    def is_free(self, q: Array, q_hand: Array) -> bool:
        """Return whether no link touches the table, a wall or another link."""
        return bool(self.checker.CheckConfigCollisionFree(self.positions(q, q_hand)))

    def table_distance(self, q: Array, q_hand: Array) -> float:
        """Return the distance [m] of the moving links from table and walls, at most FARTHEST."""
        positions = self.positions(q, q_hand)
        found = self.checker.CalcRobotClearance(positions, FARTHEST)
        table = self.checker.plant().world_body().index()
        pairs = zip(found.distances(), found.other_indices(), strict=True)
        return min((float(d) for d, other in pairs if other == table), default=FARTHEST)

    def arm_points(self, q: Array, q_hand: Array) -> Array:
        """Return points p_TQ (n, 3) [m] on the links of the arm."""
        plant, context = self.checker.plant(), self.checker.plant_context()
        self.checker.UpdatePositions(self.positions(q, q_hand))
        found = []
        for index, points in self.points.items():
            X_TL = plant.EvalBodyPoseInWorld(context, plant.get_body(index)).GetAsMatrix4()
            found.append(points @ X_TL[:3, :3].T + X_TL[:3, 3])
        return np.concatenate(found)

    def arm_triangles(self, q: Array) -> Array:
        """Return the triangles (t, 3, 3) [m] of the shapes of the arm in {T}."""
        plant, context = self.checker.plant(), self.checker.plant_context()
        inspector = self.checker.model().scene_graph().model_inspector()
        self.checker.UpdatePositions(self.positions(q, np.zeros(len(self.hand_columns))))
        found = [np.zeros((0, 3, 3))]
        for index in self.points:
            body = plant.get_body(index)
            X_TL = plant.EvalBodyPoseInWorld(context, body).GetAsMatrix4()
            for shape in plant.GetCollisionGeometriesForBody(body):
                triangles = hull_triangles(shape_corners(inspector, shape))
                found.append(triangles @ X_TL[:3, :3].T + X_TL[:3, 3])
        return np.concatenate(found)


def make_cell(
    arm: Arm, source: HandSource, X_FB: Array, around: Neighbourhood | None = None
) -> Cell:
    """Return an arm with a hand at the table; a process keeps the last ones.

    Args:
        arm: The arm.
        source: The hand, see `load_hand`.
        X_FB: Pose (4, 4) of the hand's palm link on the flange.
        around: What is around the object; its walls are those of the cell.

    Raises:
        ConfigError: If Drake cannot use the arm, or its base is in a wall.
    """
    walls = []
    for wall in around.walls if around else ():
        shape = wall.vertices if isinstance(wall, Hull) else wall.size
        walls.append((_bits(shape), _bits(wall.X_TB)))
    return _cell(arm, source, _bits(X_FB), tuple(walls))


def _bits(array: Array) -> bytes:
    return np.asarray(array, dtype=float).tobytes()


@lru_cache(maxsize=KEPT)
def _cell(
    arm: Arm, source: HandSource, mount: bytes, walls: tuple[tuple[bytes, bytes], ...]
) -> Cell:
    hand, X_FB = load_hand(source), np.frombuffer(mount).reshape(4, 4)
    with allow_network("package_map"):
        builder = RobotDiagramBuilder(time_step=0.0)
    plant = builder.plant()
    instance, hand_instance = _add_arm(plant, builder.parser(), arm), add_model(plant, hand.model)
    joints, welded = find_joints(plant, instance), plant.WeldFrames

    # The first link in {T}, the hand on the flange, the slab of the table, and the walls.
    first = plant.get_body(plant.GetBodyIndices(instance)[0])
    welded(plant.world_frame(), first.body_frame(), RigidTransform(arm.X_TA))
    flange = plant.GetFrameByName(arm.flange, instance)
    palm = plant.GetFrameByName(hand.palm_link, hand_instance)
    welded(flange, palm, RigidTransform(X_FB))
    X_TS = RigidTransform(make_pose(np.eye(3), [0.0, 0.0, -TABLE_SIZE[2] / 2.0]))
    _add_shape(plant, plant.world_body(), X_TS, Box(*TABLE_SIZE), "table")
    # The size of a box is one row, the vertices of a hull are more.
    solids = [(np.frombuffer(s).reshape(-1, 3), np.frombuffer(X).reshape(4, 4)) for s, X in walls]
    for number, (rows, X_TB) in enumerate(solids):
        shape = Box(rows[0]) if len(rows) == 1 else Convex(rows.T, "hull")
        _add_shape(plant, plant.world_body(), RigidTransform(X_TB), shape, f"wall_{number}")
    plant.Finalize()

    chain = _chain_of(joints, first, arm)
    instances = [instance, hand_instance]
    checker = SceneGraphCollisionChecker(
        model=builder.Build(),
        robot_model_instances=instances,
        edge_step_size=0.1,
        implicit_context_parallelism=Parallelism(1),
    )
    cell = Cell(
        arm=arm,
        hand=hand,
        X_FG=X_FB @ hand.X_BG,
        chain=chain,
        limits=_limits(plant, instance, chain.joints),
        checker=checker,
        arm_columns=_columns(plant, instance, chain.joints),
        hand_joints=hand.joint_order,
        hand_columns=_columns(plant, hand_instance, hand.joint_order),
        points=_points(checker),
    )
    _leave_out_overlaps(cell)
    for rows, X_TB in solids:
        p_BQ = transform_points(invert_pose(X_TB) @ arm.X_TA, cell.points[first.index()])
        planes = ConvexHull(rows * CORNERS if len(rows) == 1 else rows).equations
        if (p_BQ @ planes[:, :3].T < -planes[:, 3]).all(axis=1).any():
            raise ConfigError(f"base must be clear of the walls, got {first.name()!r} in one")
    return cell


def _add_arm(plant: MultibodyPlant, parser: Parser, arm: Arm) -> ModelInstanceIndex:
    try:
        (instance,) = parser.AddModelsFromString(arm.urdf, "urdf")
    except (RuntimeError, ValueError) as error:
        raise ConfigError(
            f"arm {arm.name} must be a chain of links, got {first_line(error)}"
        ) from None
    for number, (link, corners) in enumerate(arm.hulls):
        shape = Convex(np.frombuffer(corners).reshape(-1, 3).T, link)
        body = plant.GetBodyByName(link, instance)
        _add_shape(plant, body, RigidTransform(), shape, f"hull_{number}")
    return instance


def _add_shape(
    plant: MultibodyPlant, body: RigidBody, X_BS: RigidTransform, shape: Shape, name: str
) -> None:
    plant.RegisterCollisionGeometry(body, X_BS, shape, name, CoulombFriction())


def _chain_of(joints: list[Any], first: RigidBody, arm: Arm) -> Chain:
    """Return the joints from {T} to the flange; each is a coordinate of its own."""
    names = [joint.name() for joint in joints]
    drives = {name: (row, 0.0) for name, row in zip(names, np.eye(len(names)), strict=True)}
    return make_chains(joints, first, drives, arm.X_TA)[arm.flange]


def _limits(plant: MultibodyPlant, arm: ModelInstanceIndex, names: Sequence[str]) -> Array:
    """Return the limits (a, 2) of joints [rad or m]; one without limits gets a turn each way."""
    joints = [plant.GetJointByName(name, arm) for name in names]
    limits = [(joint.position_lower_limit(), joint.position_upper_limit()) for joint in joints]
    return np.clip(limits, -TURN, TURN)


def _columns(
    plant: MultibodyPlant, instance: ModelInstanceIndex, names: Sequence[str]
) -> npt.NDArray[np.int64]:
    """Return the places of joints in Drake's positions."""
    return np.array([plant.GetJointByName(name, instance).position_start() for name in names])


def _points(checker: SceneGraphCollisionChecker) -> dict[Any, Array]:
    """Return points (n, 3) on each link of the arm, in its frame."""
    plant, found = checker.plant(), dict[Any, Array]()
    inspector = checker.model().scene_graph().model_inspector()
    for index in plant.GetBodyIndices(checker.robot_model_instances()[0]):
        shapes = plant.GetCollisionGeometriesForBody(plant.get_body(index))
        points = [even_points(shape_corners(inspector, shape), SPACING) for shape in shapes]
        found[index] = np.concatenate([np.zeros((0, 3)), *points])
    return found


def _leave_out_overlaps(cell: Cell) -> None:
    """Filter pairs of links that collide in all drawn configurations, and pairs in the hand."""
    checker, plant = cell.checker, cell.checker.plant()
    fingers = plant.GetBodyIndices(checker.robot_model_instances()[1])
    for i, j in combinations(fingers, 2):
        checker.SetCollisionFilteredBetween(i, j, True)
    draws = Stream(0, len(cell.limits)).uniform(DRAWS * len(cell.limits))
    always: set[tuple[Any, Any]] | None = None
    closed = np.zeros(len(cell.hand_columns))
    for row in draws.reshape(DRAWS, -1):
        q = cell.limits[:, 0] + row * (cell.limits[:, 1] - cell.limits[:, 0])
        found = checker.CalcRobotClearance(cell.positions(q, closed), 0.0)
        pairs = set(zip(found.robot_indices(), found.other_indices(), strict=True))
        always = pairs if always is None else always & pairs
    for i, j in always or ():
        if j == plant.world_body().index():
            link = plant.get_body(i).name()
            raise ConfigError(
                f"base must leave the arm clear of table and walls, got {link!r} in them "
                "wherever it moves"
            )
        checker.SetCollisionFilteredBetween(i, j, True)
