"""Whether forces of the hand's strength at the surface's own contacts can carry the object's lift.

In: an object at rest on the table, predicted points and normals, the hand. Out: a `ForceVerdict`.
Nothing is simulated: all wrenches of a lift at constant orientation lie between two, and forces
that apply these two, within the friction cones and the fingertips' limits, apply all of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from drakegrasp.config import Config
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.strength import fingertip_forces, within_load
from drakegrasp.objects.model import ObjectModel
from drakegrasp.simulation.drive import drive_of
from drakegrasp.simulation.trajectory import lift_path
from drakegrasp.verification.forces.contact_forces import (
    ContactForces,
    ForceProgram,
    GraspContacts,
    hardest_forces,
)
from drakegrasp.verification.forces.surface_contacts import (
    MAX_ANGLE,
    MAX_DISTANCE,
    SurfaceContacts,
    patch_points,
    surface_contacts,
)

#: Hands with so many fingers hold an object by points alone. With fewer, points resist no torque
#: about the line between them, and patches decide.
ENOUGH_POINTS = 3


@dataclass(frozen=True, kw_only=True, eq=False)
class ForceVerdict:
    """What forces at the contacts that a prediction selects can do.

    Attributes:
        contacts: On the surface, and how far the prediction is from them.
        points: Forces at one point of each contact, for the harder of the lift's two wrenches.
        patches: Forces at the patches about them, likewise.
    """

    contacts: SurfaceContacts
    points: ContactForces
    patches: ContactForces

    @property
    def deciding(self) -> ContactForces:
        """The forces that decide: at points, for a hand with two fingertips at patches."""
        return self.points if len(self.contacts.p_OQ) >= ENOUGH_POINTS else self.patches

    @property
    def on_surface(self) -> bool:
        """Whether every predicted contact is near the surface, and its normal near its own."""
        return not self.contacts.off_surface.any()

    @property
    def held(self) -> bool:
        """Whether the contacts are on the surface, and forces at them carry the object."""
        return self.on_surface and self.planned_share <= 1.0

    @property
    def planned_force(self) -> float:
        """Normal force of the finger that takes the largest share of its limit [N]; may be inf."""
        return float(self.deciding.normal[np.argmax(self.deciding.shares)])

    @property
    def planned_share(self) -> float:
        """That share, as small as the lift allows; above 1 the fingers are too weak."""
        return self.deciding.share

    @property
    def reason(self) -> str:
        """Why the grasp holds or fails, in one sentence without a full stop."""
        # The prediction may be too far off to select a contact.
        found, shares = self.contacts, self.deciding.shares
        off = int(np.argmax(found.distance))
        if found.distance[off] > MAX_DISTANCE:
            side = "inside" if found.inside[off] else "outside"
            return (
                f"contact {off + 1} is {1e3 * found.distance[off]:.1f} mm {side} the object's "
                f"surface, more than {1e3 * MAX_DISTANCE:.0f} mm"
            )
        off = int(np.argmax(found.angle))
        if found.angle[off] > MAX_ANGLE:
            return (
                f"normal {off + 1} is {np.rad2deg(found.angle[off]):.0f}° off the surface's own, "
                f"more than {np.rad2deg(MAX_ANGLE):.0f}°"
            )

        # Or the surface there cannot carry the load.
        if not np.isfinite(self.planned_share):
            return f"no forces within the surface's friction cones carry it{self._other()}"
        if self.planned_share > 1.0:
            limit = self.planned_force / shares.max()
            return (
                f"it takes a normal force of {self.planned_force:.1f} N, more than the "
                f"{limit:.1f} N that the fingertip carries{self._other()}"
            )
        return (
            f"normal forces of at most {self.deciding.largest_normal:.1f} N carry it: "
            f"{_percent(self.points)} of a fingertip's strength at points, "
            f"{_percent(self.patches)} at patches"
        )

    def _other(self) -> str:
        """Return what patches would do where points decide and fail."""
        if self.deciding is self.patches:
            return ""
        if not np.isfinite(self.patches.share):
            return ", nor do patches"
        return f"; at patches it takes {_percent(self.patches)} of a fingertip's strength"


def judge_forces(
    model: ObjectModel,
    X_TO: npt.ArrayLike,
    p_OQ: npt.ArrayLike,
    nhat_Q_O: npt.ArrayLike,
    config: Config,
) -> ForceVerdict:
    """Return whether forces at the contacts that a prediction selects carry the object's lift.

    The object moves along `trajectory.lift_path`; friction is its own, or `physics.friction_hand`.

    Args:
        model: The object.
        X_TO: (4, 4), its resting pose.
        p_OQ: (k, 3), predicted points in {O} [m].
        nhat_Q_O: (k, 3), predicted unit normals out of the object in {O}.
        config: The hand, its drive, friction and lift.
    """
    contacts = surface_contacts(model, p_OQ, nhat_Q_O)
    friction = model.own_physics(config.physics).friction_hand
    wrenches = lift_path(X_TO, config).wrenches(model)
    return ForceVerdict(
        contacts=contacts,
        points=hardest_forces(
            ForceProgram(_grasp(model, contacts, config, patches=False), friction), wrenches
        ),
        patches=hardest_forces(
            ForceProgram(_grasp(model, contacts, config, patches=True), friction), wrenches
        ),
    )


def hand_contacts(
    model: ObjectModel, p_OQ: npt.ArrayLike, nhat_Q_O: npt.ArrayLike, config: Config
) -> GraspContacts:
    """Return the contacts on the surface that a prediction selects for the configuration's hand.

    They are points; for a hand with two fingertips patches.

    Args:
        model: The object.
        p_OQ: (k, 3), predicted points in {O} [m].
        nhat_Q_O: (k, 3), predicted unit normals out of the object in {O}.
        config: The hand and its drive.
    """
    contacts = surface_contacts(model, p_OQ, nhat_Q_O)
    return _grasp(model, contacts, config, patches=len(contacts.p_OQ) < ENOUGH_POINTS)


def _grasp(
    model: ObjectModel, contacts: SurfaceContacts, config: Config, *, patches: bool
) -> GraspContacts:
    """Return contacts as points or patches, with the limits of the hand's fingertips."""
    hand = within_load(load_hand(config.hand_source), config.physics.finger_load)
    points = patch_points(model, contacts) if patches else (contacts.p_OQ, contacts.nhat_Q_O)
    return GraspContacts(
        *points, model.p_OOcm, force_limit=fingertip_forces(hand, drive_of(hand, config.lift))
    )


def _percent(forces: ContactForces) -> str:
    """Return the largest share of a fingertip's limit as text."""
    return f"{100.0 * forces.share:.0f} %" if np.isfinite(forces.share) else "more than all"
