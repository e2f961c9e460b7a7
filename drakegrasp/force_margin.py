"""By what margin contacts can hold an object, from the contacts alone.

In: an object at rest, contact points and normals. Out: a `ForceMargin`. Nothing is
simulated and no hand is asked whether it can get there, only how hard its fingertips push.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy.typing as npt

from drakegrasp.config import Config
from drakegrasp.contact_forces import smallest_friction
from drakegrasp.hand import load_hand
from drakegrasp.lift_path import lift_path
from drakegrasp.object_model import ObjectModel
from drakegrasp.wrenches import characteristic_length, ferrari_canny


@dataclass(frozen=True, kw_only=True)
class ForceMargin:
    """How far a grasp is from not holding.

    Attributes:
        smallest_friction: Coefficient at which the forces of the lift would just be within
            the limit of the hand's fingertips; inf if none is enough.
        epsilon: Of Ferrari and Canny at the friction of the configuration, torques divided
            by the largest distance of the object's surface from its centre of mass; 0
            without force closure.
    """

    smallest_friction: float
    epsilon: float


def force_margin(
    model: ObjectModel,
    X_TO: npt.ArrayLike,
    p_OQ: npt.ArrayLike,
    nhat_Q_O: npt.ArrayLike,
    config: Config,
) -> ForceMargin:
    """Return the margin of a grasp for the lift that `force_lift` simulates.

    Args:
        model: The object.
        X_TO: Its resting pose, (4, 4).
        p_OQ: (k, 3), contact points in {O} [m].
        nhat_Q_O: (k, 3), normals out of the object in {O}.
        config: Hand, friction and lift.
    """
    return ForceMargin(
        smallest_friction=smallest_friction(
            p_OQ,
            nhat_Q_O,
            model.p_OOcm,
            lift_path(X_TO, config).wrenches(model),
            load_hand(config.hand).fingertip_force_limit,
        ),
        epsilon=ferrari_canny(
            p_OQ,
            nhat_Q_O,
            model.p_OOcm,
            friction=config.physics.friction_hand,
            length=characteristic_length(model.visual_vertices, model.p_OOcm),
        ),
    )
