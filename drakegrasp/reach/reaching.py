"""Whether an arm gets its hand to a grasp, straight in and straight up.

Input: a `Cell`, an object on the table and a `Grasp`: palm pose and the hand's joints before and
after closing. Output: a `Reach`. The hand comes 10 cm straight along the palm's +Gz to the palm
pose, closes there, and goes straight to the end of the trial's lift, with the object in it. The arm
must do all of it in one branch of its inverse kinematics, without a jump, within its joint limits
and without a collision. How it comes to the start of the approach is not planned.

The hand's own way along the approach does not depend on the arm, and is decided first. Neighbours
stay where they are. Whether the closed hand or the carried object pushes them is a question of the
trial.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from drakegrasp.arithmetic import norm
from drakegrasp.config import Config
from drakegrasp.dataset.schema import REACHES
from drakegrasp.frames import Array, invert_pose
from drakegrasp.generation.scenes import open_joints
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.finger_sweep import link_points
from drakegrasp.hand.kinematics import posed_links
from drakegrasp.mesh.distance_field import DistanceField
from drakegrasp.objects.surroundings import Neighbourhood
from drakegrasp.reach.arm import Arm, mount_of
from drakegrasp.reach.branches import find_branches, follow
from drakegrasp.reach.cell import FIRST, NEAR, Cell, make_cell
from drakegrasp.runtime.environment import one_thread
from drakegrasp.simulation.attempt import Attempt
from drakegrasp.simulation.placement import canonical_pose
from drakegrasp.simulation.screen import PointLookup, extra_margin

#: Length of the straight approach [m].
APPROACH = 0.10
#: Distance between two configurations on a path, and between two places of the open hand [m].
STEP, HAND_STEP = 0.02, 0.005
#: Largest motion of a joint in a step of a path [rad or m]: at 0.1 m/s it is 1.5 rad/s.
JUMP = 0.3
#: An open hand that is deeper in an object or the table than this collides on its way [m]. It is
#: the margin with which attempts are screened, see `ScreenConfig.start_margin`.
HAND_MARGIN = 0.0025
#: Objects that an arm may hit: the distances from each in its own frame, and its pose (4, 4).
Solids: TypeAlias = Sequence[tuple[DistanceField, Array]]


@dataclass(frozen=True, kw_only=True, eq=False)
class Grasp:
    """A grasp of an object on the table, as an arm sees it.

    Attributes:
        X_TO: Pose (4, 4) of the object.
        X_TG: Pose (4, 4) of the palm at the grasp.
        q_open, q_closed: (j,), joints of the hand before and after closing [rad or m].
        p_TG_lifted: (3,), where the lift takes the palm's origin [m].
        around: What is around the object; its walls are those of the cell. None for an object that
            is alone.
    """

    X_TO: Array
    X_TG: Array
    q_open: Array
    q_closed: Array
    p_TG_lifted: Array
    around: Neighbourhood | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Reach:
    """What an arm can do about a grasp.

    Attributes:
        outcome: One of REACHES: that of the branch which comes farthest.
        q: (3, a), joints at the start of the approach, at the grasp and at the end of the lift;
            NaN if the grasp is not reachable.
        clearance: Least distance [m] of arm and hand from table and walls, and of the arm and the
            open hand from all objects, all the way; at most `cell.FARTHEST`. NaN if not reachable.
    """

    outcome: str
    q: Array
    clearance: float

    @property
    def reachable(self) -> bool:
        """Whether the arm gets its hand there and lifts."""
        return self.outcome == REACHES[0]


def reach_grasp(cell: Cell, field: DistanceField, grasp: Grasp) -> Reach:
    """Return what an arm can do about a grasp.

    Args:
        cell: The arm and its hand, and the walls around the object.
        field: Distances from the object in {O}.
        grasp: The grasp.
    """
    around = grasp.around or Neighbourhood(X_TN=np.zeros((0, 4, 4)))
    beside = [(model.field, X) for model, X in zip(around.models, around.X_TN, strict=True)]
    at_rest = [(field, grasp.X_TO), *beside]
    rooms = [_room_of_hand(cell, *solid, grasp) for solid in at_rest]
    allowed = [-HAND_MARGIN - extra_margin(solid) for solid, _ in at_rest]
    if any(room < least for room, least in zip(rooms, allowed, strict=True)):
        return _unreachable(cell, "approach")

    # All branches of the grasp itself, and those that collide with nothing.
    X_GF = invert_pose(cell.X_FG)
    branches = find_branches(cell.chain, cell.limits, grasp.X_TG @ X_GF)
    if not len(branches):
        return _unreachable(cell, "out_of_reach")
    free = [
        q
        for q in branches
        if _is_free(cell, at_rest, q, grasp.q_open) and _is_free(cell, at_rest, q, grasp.q_closed)
    ]
    if not free:
        return _unreachable(cell, "collision")

    # Each branch goes back along the approach, and up.
    back, up = approach_path(grasp), lift_path(grasp)
    approach, approaches = follow(cell.chain, cell.limits, back @ X_GF, np.array(free), JUMP)
    lift, lifts = follow(cell.chain, cell.limits, up @ X_GF, np.array(free), JUMP)
    farthest = "approach"
    carried = [[(field, X), *beside] for X in up @ invert_pose(grasp.X_TG) @ grasp.X_TO]
    for i, q in enumerate(free):
        if not approaches[i] or not all(
            _is_free(cell, at_rest, row, grasp.q_open) for row in approach[:, i]
        ):
            continue
        farthest = "lift"
        if lifts[i] and all(
            _is_free(cell, solids, row, grasp.q_closed)
            for row, solids in zip(lift[:, i], carried, strict=True)
        ):
            way = [(at_rest, row, grasp.q_open) for row in (*approach[:, i], q)]
            way += [(at_rest, q, grasp.q_closed)]
            way += [(s, row, grasp.q_closed) for row, s in zip(lift[:, i], carried, strict=True)]
            return Reach(
                outcome=REACHES[0],
                q=np.stack([approach[-1, i], q, lift[-1, i]]),
                clearance=min(*rooms, *(_clearance(cell, *state) for state in way)),
            )
    return _unreachable(cell, farthest)


@one_thread
def reach_attempt(
    arm: Arm,
    field: DistanceField,
    attempt: Attempt,
    X_TO: Array,
    config: Config,
    *,
    q_closed: Array | None = None,
    X_TO_simulated: Array | None = None,
    around: Neighbourhood | None = None,
) -> Reach:
    """Return what an arm can do about an attempt, wherever its object is on the table.

    Args:
        arm: The arm.
        field: Distances from the object in {O}.
        attempt: Palm pose, and the open hand.
        X_TO: Pose (4, 4) of the object.
        config: Hand and lift.
        q_closed: (j,), joints of the closed hand [rad or m]; None for those of the open hand.
        X_TO_simulated: Pose (4, 4) of the object in a simulation, relative to which the lift goes;
            None for the middle of the table, without yaw.
        around: What is around the object at X_TO.

    Raises:
        ConfigError: If the arm does not carry the hand, or stands in a wall.
    """
    hand = load_hand(config.hand_source)
    cell = make_cell(arm, config.hand_source, mount_of(arm, hand), around)
    q_open = open_joints(attempt, hand, cell.hand_joints)
    middle = canonical_pose(X_TO) if X_TO_simulated is None else X_TO_simulated
    moved = X_TO @ invert_pose(middle)
    grasp = Grasp(
        X_TO=X_TO,
        X_TG=X_TO @ attempt.X_OG,
        q_open=q_open,
        q_closed=q_open if q_closed is None else q_closed,
        p_TG_lifted=moved[:3, :3] @ config.lift.p_TG + moved[:3, 3],
        around=around,
    )
    return reach_grasp(cell, field, grasp)


def draw_arm(arm: Arm, q: Array, config: Config) -> dict[str, Array]:
    """Return triangles (t, 3, 3) [m] of an arm at the grasp and before the approach, in {T}.

    Args:
        arm: The arm.
        q: (3, a), joints, see `Reach`; nothing is returned for NaN.
        config: The hand.
    """
    if np.isnan(q).any():
        return {}
    cell = make_cell(arm, config.hand_source, mount_of(arm, load_hand(config.hand_source)))
    return {"grasp": cell.arm_triangles(q[1]), "approach": cell.arm_triangles(q[0])}


def approach_path(grasp: Grasp, step: float = STEP) -> Array:
    """Return the palm poses X_TG (m, 4, 4) from the first step before a grasp to the start."""
    path = np.tile(grasp.X_TG, (round(APPROACH / step), 1, 1))
    away = step * np.arange(1, len(path) + 1)
    path[:, :3, 3] -= away[:, None] * grasp.X_TG[:3, 2]
    return path


def lift_path(grasp: Grasp) -> Array:
    """Return the palm poses X_TG (m, 4, 4) from the first step after a grasp to its lift's end."""
    way = grasp.p_TG_lifted - grasp.X_TG[:3, 3]
    count = max(1, int(np.ceil(norm(way) / STEP)))
    path = np.tile(grasp.X_TG, (count, 1, 1))
    path[:, :3, 3] += np.arange(1, count + 1)[:, None] / count * way
    return path


def _room_of_hand(cell: Cell, field: DistanceField, X_TO: Array, grasp: Grasp) -> float:
    """Return the least distance [m] of the open hand from an object and the table on its way."""
    names = cell.hand_joints
    positions = {n: np.asarray(q) for n, q in zip(names, grasp.q_open.tolist(), strict=True)}
    surfaces = link_points(cell.hand)
    p_GQ = np.concatenate(
        [
            surfaces[link] @ X_GL[:3, :3].T + X_GL[:3, 3]
            for link, X_GL in posed_links(cell.hand, positions).items()
        ]
    ).astype(np.float32)
    X_TG = approach_path(grasp, HAND_STEP)
    lookup = PointLookup(field, np.broadcast_to(X_TO, X_TG.shape), invert_pose(X_TO) @ X_TG)
    rows = np.arange(len(lookup))
    to_object = lookup.distances(rows, p_GQ, NEAR)
    return float(min(to_object.min(), lookup.heights(rows, p_GQ).min()))


def _is_free(cell: Cell, solids: Solids, q: Array, q_hand: Array) -> bool:
    return cell.is_free(q, q_hand) and _from_solids(cell, solids, q, q_hand) > 0.0


def _from_solids(cell: Cell, solids: Solids, q: Array, q_hand: Array) -> float:
    """Return the distance [m] of the arm, without the hand, from the nearest object."""
    points = cell.arm_points(q, q_hand).astype(np.float32)
    return min(
        float(PointLookup(f, X[None], invert_pose(X)[None]).distances(FIRST, points, NEAR).min())
        for f, X in solids
    )


def _clearance(cell: Cell, solids: Solids, q: Array, q_hand: Array) -> float:
    return min(cell.table_distance(q, q_hand), _from_solids(cell, solids, q, q_hand))


def _unreachable(cell: Cell, outcome: str) -> Reach:
    return Reach(outcome=outcome, q=np.full((3, len(cell.limits)), np.nan), clearance=np.nan)
