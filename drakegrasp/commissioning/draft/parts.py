"""The parts of a vendor's model as Drake or MuJoCo reads them: bodies, and what carries them."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from pydrake.multibody.tree import SpatialInertia

from drakegrasp.commissioning.draft.shapes import Shape
from drakegrasp.frames import Array, rotation_about
from drakegrasp.hand.parsing import Mimic

#: Limits of a joint that has none.
ENDLESS = np.array([-np.inf, np.inf])


def motion(axis: Array, slides: bool, positions: Array | float) -> Array:
    """Return the poses (..., 4, 4) of a joint's child at positions (...), relative to position 0.

    Args:
        axis: (3,), unit, in the child's frame.
        slides: Whether the joint slides.
        positions: Positions [rad or m].
    """
    positions = np.asarray(positions, dtype=float)
    X = np.zeros((*positions.shape, 4, 4)) + np.eye(4)
    if slides:
        X[..., :3, 3] = positions[..., None] * axis
    else:
        X[..., :3, :3] = rotation_about(axis, positions)
    return X


@dataclass(frozen=True, kw_only=True, eq=False)
class Link:
    """A rigid link: a vendor's links that are welded together, under the name of the heaviest.

    Attributes:
        name: Name of the link.
        inertia: M_LLo_L; zero for a body whose model gives none, before it is welded.
        collisions: Convex collision shapes.
        visuals: Shapes that are drawn.
    """

    name: str
    inertia: SpatialInertia
    collisions: tuple[Shape, ...] = ()
    visuals: tuple[Shape, ...] = ()

    def corners(self) -> Array:
        """Return the corners (n, 3) of the collision shapes [m]."""
        return np.concatenate([np.zeros((0, 3)), *[s.corners() for s in self.collisions]])

    @property
    def weight(self) -> tuple[float, int, int]:
        """Rank of the link among the links welded to it: the highest gives its name to all."""
        return self.inertia.get_mass(), len(self.collisions), len(self.visuals)


@dataclass(frozen=True, kw_only=True, eq=False)
class Carrier:
    """What joins a body to its parent: a joint, or a weld.

    Attributes:
        name: Name of the joint.
        parent, child: Keys of bodies.
        X_PJ: (4, 4), pose of the joint's frame in the parent at position 0.
        X_CJ: (4, 4), pose of the joint's frame in the child.
        axis: (3,), unit, in the joint's frame; None for a weld.
        slides: Whether the joint slides.
        limits: (2,), lower and upper [rad or m].
        velocity: Largest velocity [rad/s or m/s].
    """

    name: str
    parent: Hashable
    child: Hashable
    X_PJ: Array
    X_CJ: Array
    axis: Array | None = None
    slides: bool = False
    limits: Array = field(default_factory=lambda: ENDLESS)
    velocity: float = np.inf


@dataclass(frozen=True, kw_only=True, eq=False)
class Parts:
    """What a model consists of.

    Attributes:
        name: Name of the model.
        bodies: Its bodies by key, before welded bodies are joined.
        carriers: What carries them; a body without one is a root.
        efforts: Largest effort [N m or N] of each joint that has one.
        mimics: The joints that follow other joints.
        notes: What was left out, one line each.
    """

    name: str
    bodies: Mapping[Hashable, Link]
    carriers: Sequence[Carrier]
    efforts: Mapping[str, float]
    mimics: Sequence[Mimic]
    notes: Sequence[str]
