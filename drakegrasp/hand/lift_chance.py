"""The chance that a lift yields a sample, predicted when the hand has closed.

Input: the contacts of closed hands, and the weights in a small file next to the hand file. Output:
chances from a logistic model (docs/explanation/sampling.md). Its features are computed from
normals, forces, distances and moments, and from nothing that identifies the object. Does not
import Drake.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
import numpy.typing as npt
import yaml

from drakegrasp.arithmetic import Array, dot, multiply, norm
from drakegrasp.config import HandSource
from drakegrasp.errors import HandError, one_line
from drakegrasp.foreign_files import read_text
from drakegrasp.hand.files import chance_file
from drakegrasp.yaml_text import parse_yaml_once

#: Chances are rounded to multiples of this, because the last bits of an exponential depend on the
#: machine.
GRID = 2.0**-20
#: The search for forces that balance: number of steps, and fraction of the friction that the forces
#: may use. The steps are few because forces that are hard to find are hard to reach by closing.
STEPS, SHARE = 20, 0.7
#: Smallest divisor, far below the forces [N] and lengths [m] of contacts.
LEAST = 1e-9


@dataclass(frozen=True, kw_only=True, eq=False)
class ClosedGrasp:
    """Hands with k fingers, closed on objects that are held in place; arrays have leading axes.

    Attributes:
        touching: (..., k), whether each fingertip touches the object.
        p_OQ, nhat_Q_O, f_Q_O: (..., k, 3), contact points [m], unit normals out of the object, and
            forces on the object [N]; NaN or 0 for fingertips that do not touch.
        X_TO: (..., 4, 4), pose of the object.
        p_OOcm: (3,), its centre of mass [m].
        friction_hand: (...,), coefficient of friction between hand and object.
    """

    touching: npt.NDArray[np.bool_]
    p_OQ: Array
    nhat_Q_O: Array
    f_Q_O: Array
    X_TO: Array
    p_OOcm: Array
    friction_hand: Array


#: The contact fields of a closed grasp, by the names of `simulation.contacts.Contacts`.
GRASP_CONTACTS = ("touching", "p_OQ", "nhat_Q_O", "f_Q_O")


@dataclass(frozen=True)
class LiftChance:
    """A logistic model of the chance that a lift yields a sample.

    Attributes:
        bias: Log-odds if all features are 0.
        weights: Change of the log-odds per unit of each feature, by the names of `features`.
    """

    bias: float
    weights: Mapping[str, float]

    def of(self, grasp: ClosedGrasp) -> Array:
        """Return the chances (...,) of closed grasps, multiples of `GRID`."""
        values = features(grasp)
        score = np.array(self.bias)
        for name, weight in self.weights.items():
            score = score + weight * values[name]
        return np.asarray(np.rint(1.0 / (1.0 + np.exp(-score)) / GRID) * GRID)


def read_lift_chance(source: HandSource) -> LiftChance | None:
    """Return the model of a hand; None if the hand has no model.

    Raises:
        HandError: If there is no such hand, or its file of weights is invalid.
    """
    path = chance_file(source)
    if not path.is_file():
        return None
    try:
        tree: Any = parse_yaml_once(read_text(path))
        weights = {str(name): float(value) for name, value in dict(tree["weights"]).items()}
        model = LiftChance(float(tree["bias"]), weights)
    except (yaml.YAMLError, UnicodeDecodeError, KeyError, TypeError, ValueError) as error:
        raise HandError(
            f"{path}: must be YAML with a number bias and numbers weights, got {one_line(error)}"
        ) from None
    if not weights or weights.keys() - set(FEATURES):
        got = ", ".join(sorted(weights)) or "none"
        raise HandError(f"{path}: weights must be of {', '.join(FEATURES)}, got {got}")
    if not np.isfinite([model.bias, *weights.values()]).all():
        raise HandError(f"{path}: bias and weights must be finite, got {model}")
    return model


def features(grasp: ClosedGrasp) -> dict[str, Array]:
    """Return the features of closed grasps, (...,) each, by the names of `FEATURES`."""
    # Contacts; all values of a fingertip that does not touch are 0.
    on = grasp.touching[..., None]
    p_OQ, nhat, f_Q = (np.where(on, v, 0.0) for v in (grasp.p_OQ, grasp.nhat_Q_O, grasp.f_Q_O))
    count = np.maximum(_total(grasp.touching), 1.0)
    p_OP = _total(p_OQ, axis=-2) / count[..., None]
    p_PQ = np.where(on, p_OQ - p_OP[..., None, :], 0.0)
    radius = np.sqrt(_total(dot(p_PQ, p_PQ)) / count)

    # The forces, and the offset of the centre of mass from the contacts.
    force = norm(f_Q)
    least = np.where(grasp.touching, force, np.inf).min(axis=-1)
    p_CmQ = np.where(on, p_OQ - grasp.p_OOcm, 0.0)
    moment = norm(_total(np.cross(p_CmQ, f_Q), axis=-2))
    p_PCm, up = grasp.p_OOcm - p_OP, grasp.X_TO[..., 2, :3]
    across = p_PCm - dot(p_PCm, up)[..., None] * up

    # Cosines of the angles between the normals of each pair of contacts.
    pairs = list(combinations(range(nhat.shape[-2]), 2))
    cosines = np.stack([dot(nhat[..., i, :], nhat[..., j, :]) for i, j in pairs], axis=-1)
    rest = _unbalanced(on, p_PQ / np.maximum(radius, LEAST)[..., None, None], nhat, grasp)
    values = (
        norm(_total(nhat, axis=-2)) / count,
        cosines.max(axis=-1),
        rest,
        np.sqrt(rest),
        moment / np.maximum(_total(force) * radius, LEAST),
        least / np.maximum(force.max(axis=-1), LEAST),
        norm(across),
    )
    return dict(zip(FEATURES, values, strict=True))


#: The features, in order: length of the mean normal; largest cosine between two normals; residual
#: of the wrench for a total normal force of 1, see `_unbalanced`; its square root; moment of the
#: forces about the centre of mass, divided by their sum and the contacts' radius; smallest force
#: divided by largest; horizontal distance of the centre of mass from the contacts' centre [m].
FEATURES = (
    *("normal_sum", "least_opposed", "unbalanced", "root_unbalanced", "moment", "evenness"),
    "across",
)


def _unbalanced(on: npt.NDArray[np.bool_], p_PQ: Array, nhat: Array, grasp: ClosedGrasp) -> Array:
    """Return how far forces with a total normal force of 1 are from balance, (...,).

    A few steps of projected gradient descent search for forces in the friction cones whose sum and
    moment vanish. They start from equal forces along the normals.

    Args:
        on: (..., k, 1), whether each fingertip touches.
        p_PQ: (..., k, 3), contacts relative to their centre, of root mean square length 1.
        nhat: (..., k, 3), unit normals, 0 for fingertips that do not touch.
        grasp: The closed grasps; only their friction is used.
    """
    # Sum, moment and normal force of forces f (3k,) are A f. The goal is 0 for the first six, 1 for
    # the last.
    lead, k = nhat.shape[:-2], nhat.shape[-2]
    x, y, z = np.moveaxis(p_PQ, -1, 0)
    o = np.zeros_like(x)
    arms = np.moveaxis(np.array([[o, -z, y], [z, o, -x], [-y, x, o]]), (0, 1), (-2, -1))
    ones = np.broadcast_to(np.eye(3), arms.shape)
    blocks = np.concatenate([ones, arms, -nhat[..., None, :]], axis=-2)
    A = np.moveaxis(blocks, -3, -2).reshape(*lead, 7, 3 * k)

    # Each step goes against the gradient of half the squared residual; its Hessian is below 3 k.
    size, goal = 1.0 / (3.0 * k), np.eye(7)[:, -1:]
    gain = np.swapaxes(A, -1, -2) * size
    keep, push = np.eye(3 * k) - multiply(gain, A), multiply(gain, goal)

    mu = SHARE * np.asarray(grasp.friction_hand)[..., None, None]
    f = -nhat / np.maximum(_total(on, axis=-2), 1.0)[..., None, :]
    for _ in range(STEPS):
        f = (multiply(keep, f.reshape(*lead, -1, 1)) + push).reshape(nhat.shape)

        # Project onto the friction cone.
        normal = -dot(f, nhat)[..., None]
        tangential = f + normal * nhat
        length = np.maximum(norm(tangential)[..., None], LEAST)
        pushed = np.maximum((mu * length + normal) / (mu * mu + 1.0), 0.0)
        nearest = mu * pushed / length * tangential - pushed * nhat
        f = np.where(on, np.where(length <= mu * normal, f, nearest), 0.0)
    return norm((multiply(A, f.reshape(*lead, -1, 1)) - goal)[..., 0])


def _total(values: npt.NDArray[Any], axis: int = -1) -> Array:
    """Return sums over an axis, added in the order of the axis."""
    along = np.moveaxis(np.asarray(values, dtype=float), axis, -1)
    return dot(along, np.ones(along.shape[-1]))
