"""Grasp quality: the epsilon of Ferrari and Canny, and the least friction that holds an object.

In: contact points, outward normals, a friction coefficient. Out: measures of what forces at the
contacts can do; nothing is simulated. Contacts are points with Coulomb friction, or patches of
several, see `contact_forces`.

A wrench here is [torque about Ocm; force], (6,), in axes of {O} [N m, N], in the order of
Drake's spatial forces.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull, QhullError

from drakegrasp.config import Config
from drakegrasp.objects.model import ObjectModel
from drakegrasp.simulation.trajectory import lift_path
from drakegrasp.verification.forces.contact_forces import (
    ForceProgram,
    GraspContacts,
    grasp_map,
)

#: Edges of the pyramid that approximates a friction cone from inside. With 16, epsilon is about
#: 2 % too small and varies by as much with the frame; the hull takes 15 ms.
FRICTION_EDGES = 16
#: An epsilon below this is rounding: the origin is on the surface of the hull.
ROUNDING = 1e-9
#: Largest friction coefficient that is tried, and the tolerance of the smallest one.
MAX_FRICTION, FRICTION_TOLERANCE = 10.0, 1e-4


def characteristic_length(vertices: npt.ArrayLike, p_OOcm: npt.ArrayLike) -> float:
    """Return the largest distance of a surface from the centre of mass [m].

    No contact has a longer arm, so torques divided by it are comparable with the forces that
    cause them.

    Args:
        vertices: (n, 3), of the surface in {O} [m].
        p_OOcm: (3,), the centre of mass in {O} [m].
    """
    arms = np.asarray(vertices, dtype=float) - np.asarray(p_OOcm, dtype=float)
    return float(np.linalg.norm(arms, axis=1).max())


def ferrari_canny(contacts: GraspContacts, *, friction: float, length: float) -> float:
    """Return the epsilon of a grasp: the smallest wrench that can break it.

    The L1 version of C. Ferrari and J. Canny, "Planning optimal grasps", ICRA 1992: the
    distance of the origin from the surface of the convex hull of all contacts' friction
    cones with unit normal forces, that is, for normal forces that sum to one. Each cone is
    approximated by a pyramid of `FRICTION_EDGES` edges. Edge e of point i, with the inward normal
    n_i, the tangents t, the arm p_i and the length L, has the wrench

        w_ie = [p_i × f_ie / L; f_ie],   f_ie = n_i + μ (cos(α_e) t_i1 + sin(α_e) t_i2),

    and, with the origin inside their hull, ε = min over |u| = 1 of max over i, e of u·w_ie.

    Args:
        contacts: Of the grasp.
        friction: Coulomb coefficient.
        length: Length by which torques are divided [m], see `characteristic_length`.

    Returns:
        Epsilon, without unit; 0 if the origin is not inside the hull, the hull is flat, or a
        number is not finite.
    """
    # Wrenches of the edges of all cones, for a normal force of one.
    angles = 2.0 * np.pi * np.arange(FRICTION_EDGES) / FRICTION_EDGES
    edges = np.stack(
        [np.ones(FRICTION_EDGES), friction * np.cos(angles), friction * np.sin(angles)]
    )
    forces = contacts.axes @ edges  # (n, 3, edges)
    blocks = grasp_map(contacts.p_OcmQ).reshape(6, -1, 3)
    wrenches = np.einsum("wni,nie->new", blocks, forces).reshape(-1, 6)
    wrenches[:, :3] /= length
    if not np.isfinite(wrenches).all():
        return 0.0

    # Distance of the origin from their hull.
    try:
        hull = ConvexHull(wrenches)
    except QhullError:
        return 0.0  # flat, or too few points: some wrench cannot be resisted at all
    # A row is a unit outward normal and an offset, which is negative if the origin is inside.
    epsilon = -float(hull.equations[:, -1].max())
    return epsilon if epsilon > ROUNDING else 0.0


@dataclass(frozen=True, kw_only=True)
class ForceMargin:
    """By what margin forces at the contacts hold the object.

    Attributes:
        smallest_friction: Smallest coefficient at which forces within the limits of the hand's
            fingertips carry the lift; inf if none is enough.
        epsilon: Of Ferrari and Canny at the configured friction, with torques divided by the
            largest distance of the object's surface from its centre of mass; 0 without force
            closure.
    """

    smallest_friction: float
    epsilon: float


def force_margin(
    model: ObjectModel, X_TO: npt.ArrayLike, contacts: GraspContacts, config: Config
) -> ForceMargin:
    """Return the margin of a grasp for the lift of the object.

    Args:
        model: The object.
        X_TO: (4, 4), its resting pose.
        contacts: Of the grasp.
        config: Friction and lift.
    """
    return ForceMargin(
        smallest_friction=smallest_friction(contacts, lift_path(X_TO, config).wrenches(model)),
        epsilon=ferrari_canny(
            contacts,
            friction=model.own_physics(config.physics).friction_hand,
            length=characteristic_length(model.visual_vertices, model.p_OOcm),
        ),
    )


def smallest_friction(contacts: GraspContacts, wrenches_O: npt.ArrayLike) -> float:
    """Return the smallest friction coefficient at which all wrenches can be applied.

    With t(w, μ) the share of the limits that a wrench takes (`ForceProgram`), it is

        μ* = min {μ : max over w of t(w, μ) ≤ 1}.

    The force that is needed never grows with friction, so bisection finds the coefficient.

    Args:
        contacts: Of the grasp.
        wrenches_O: (n, 6), each torque about Ocm and force on the object in {O} [N m, N].

    Returns:
        The coefficient, rounded up by at most `FRICTION_TOLERANCE`; inf if `MAX_FRICTION` is not
        enough.
    """

    def holds(friction: float) -> bool:
        program = ForceProgram(contacts, friction)
        return all(program.smallest(wrench).share <= 1.0 for wrench in np.asarray(wrenches_O))

    low, high = 0.0, MAX_FRICTION
    if not holds(high):
        return float("inf")
    while high - low > FRICTION_TOLERANCE:
        middle = (low + high) / 2.0
        low, high = (low, middle) if holds(middle) else (middle, high)
    return high
