"""The posture of a hand whose joints are given, as a file stores them.

In: a `Hand` and the positions of its joints. Out: poses of its links. `kinematics` gives them for
coordinates; a stored posture may differ a little from all coordinates, because forces bend it.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant

from drakegrasp.arithmetic import multiply
from drakegrasp.frames import Array, invert_pose
from drakegrasp.hand.description import Hand
from drakegrasp.hand.parsing import make_parser


class Posture:
    """A hand without a simulation, whose joints take any positions.

    Args:
        hand: The hand.

    Attributes:
        joints: Names of the n joints in the plant's order, in which datasets store them.
    """

    def __init__(self, hand: Hand) -> None:
        # The palm link is the world's frame.
        self._plant = plant = MultibodyPlant(0.0)
        (self._instance,) = make_parser(plant).AddModels(hand.sdf_path)
        base = plant.GetBodyByName(hand.palm_link, self._instance)
        plant.WeldFrames(plant.world_frame(), base.body_frame(), RigidTransform())
        plant.Finalize()

        self._context = plant.CreateDefaultContext()
        self._X_GB = invert_pose(hand.X_BG)
        self.joints: tuple[str, ...] = tuple(
            plant.GetPositionNames(
                self._instance, add_model_instance_prefix=False, always_add_suffix=False
            )
        )

    def link_poses(self, q: npt.ArrayLike) -> dict[str, Array]:
        """Return the poses X_GL (4, 4) of all links in the palm frame, by name.

        Args:
            q: (n,), positions of `joints` [rad].
        """
        self._plant.SetPositions(self._context, self._instance, np.asarray(q, dtype=float))
        poses = {}
        for index in self._plant.GetBodyIndices(self._instance):
            body = self._plant.get_body(index)
            X_BL = self._plant.EvalBodyPoseInWorld(self._context, body).GetAsMatrix4()
            poses[body.name()] = multiply(self._X_GB, X_BL)
        return poses
