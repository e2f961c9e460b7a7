"""What a hand meets on its way to a grasp and when it has closed, by geometry alone.

Input: a scene with neighbours or walls, an attempt, and the joints after closing. Output: the body
that the hand intersects first, if any. The open hand comes straight along its z-axis, and is tested
every `SPACING` of the way and at the grasp; the closed hand is tested at the grasp. The grasped
object does not count: whether the open hand intersects it is a question of the trial.
"""

from __future__ import annotations

import numpy as np
from pydrake.multibody.tree import BodyIndex

from drakegrasp.arithmetic import multiply
from drakegrasp.frames import X_WT, Array
from drakegrasp.simulation.attempt import Attempt
from drakegrasp.simulation.contacts import hand_meets
from drakegrasp.simulation.scene import Scene, reset_attempt

#: Length of the straight way to the grasp, and distance between two tests on it [m].
APPROACH, SPACING = 0.10, 0.01


def first_hit(scene: Scene, X_TO: Array, attempt: Attempt, q_closed: Array) -> BodyIndex | None:
    """Return the body that the hand intersects first; walls are the table, None is nothing.

    Args:
        scene: Scene of the object and the hand, with what is around the object.
        X_TO: Pose of the object, (4, 4).
        attempt: The attempt.
        q_closed: Positions of the hand's joints after closing (j,) [rad or m], in the plant's
            order.
    """
    X_WO = multiply(X_WT, X_TO)
    X_WG = multiply(X_WO, attempt.X_OG)
    q_open = None if attempt.path is None else attempt.path[0]
    reset_attempt(scene, X_WO, X_WG, spread=attempt.spread, closing=attempt.closing, q=q_open)

    # The wrist slides along the axes of {W}, so the way is a motion of its joints.
    for back in np.linspace(APPROACH, 0.0, round(APPROACH / SPACING) + 1):
        place = X_WG[:3, 3] - back * X_WG[:3, 2]
        for joint, p in zip(scene.wrist_joints, place, strict=True):
            joint.set_translation(scene.context, float(p))
        if (met := _met(scene)) is not None:
            return met
    reset_attempt(scene, X_WO, X_WG, spread=attempt.spread, q=q_closed)
    return _met(scene)


def _met(scene: Scene) -> BodyIndex | None:
    """Return the first of the neighbours, then the table, that the hand intersects now."""
    met = hand_meets(scene)
    bodies = [*(each.body for each in scene.neighbours), scene.table]
    return next((body.index() for body in bodies if body.index() in met), None)
