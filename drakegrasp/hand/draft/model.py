"""A vendor's model as data: a tree of rigid links, and the joints between them.

Links that are welded to each other are one, and the frame of a link is that of the joint that
carries it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from pydrake.multibody.tree import SpatialInertia

from drakegrasp.frames import Array, rotation_about
from drakegrasp.hand.draft.shapes import Shape
from drakegrasp.hand.model_text import Mimic


@dataclass(frozen=True, kw_only=True, eq=False)
class Link:
    """A rigid link: vendors' links that are welded together, under the name of the heaviest.

    Attributes:
        name: Its name.
        inertia: M_LLo_L.
        collisions: Convex shapes that collide.
        visuals: Shapes that are drawn.
    """

    name: str
    inertia: SpatialInertia
    collisions: tuple[Shape, ...]
    visuals: tuple[Shape, ...]

    def corners(self) -> Array:
        """Return the corners (n, 3) of its collision shapes [m]."""
        return np.concatenate([np.zeros((0, 3)), *[s.corners() for s in self.collisions]])


@dataclass(frozen=True, kw_only=True, eq=False)
class VendorJoint:
    """A joint that turns or slides; at position 0 the child's frame is at X_PJ in the parent.

    Attributes:
        name: Its name.
        slides: Whether it slides.
        parent, child: Names of links.
        X_PJ: (4, 4).
        axis: (3,), unit, in the child's frame.
        limits: (2,), lower and upper [rad or m].
        effort, velocity: Largest [N m or N], [rad/s or m/s]; infinite or 0 if not given.
    """

    name: str
    slides: bool
    parent: str
    child: str
    X_PJ: Array
    axis: Array
    limits: Array
    effort: float
    velocity: float

    def motion(self, positions: Array | float) -> Array:
        """Return the poses (..., 4, 4) of the child at positions (...), in its own at 0."""
        positions = np.asarray(positions, dtype=float)
        X = np.zeros((*positions.shape, 4, 4)) + np.eye(4)
        if self.slides:
            X[..., :3, 3] = positions[..., None] * self.axis
        else:
            X[..., :3, :3] = rotation_about(self.axis, positions)
        return X

    def pose(self, position: float) -> Array:
        """Return the pose (4, 4) of the child in the parent at a position [rad or m]."""
        return np.asarray(self.X_PJ @ self.motion(position))

    def rebased(self, sign: float, zero: float) -> VendorJoint:
        """Return the joint with positions c instead of q = zero + sign * c."""
        limits = np.sort((self.limits - zero) * sign)
        return replace(self, X_PJ=self.pose(zero), axis=sign * self.axis, limits=limits)


@dataclass(frozen=True, kw_only=True, eq=False)
class VendorModel:
    """A tree of rigid links.

    Attributes:
        name: Of the model.
        root: Name of the link that no joint carries.
        links: By name.
        joints: By name, each after those that carry its parent.
        mimics: What each joint follows, by its name; leaders follow nothing.
        notes: What was left out or put in, a line each.
    """

    name: str
    root: str
    links: dict[str, Link]
    joints: dict[str, VendorJoint]
    mimics: dict[str, Mimic]
    notes: tuple[str, ...]

    def chain(self, link: str, base: str | None = None) -> list[VendorJoint]:
        """Return the joints from a base, or the root, to a link."""
        above = {joint.child: joint for joint in self.joints.values()}
        path: list[VendorJoint] = []
        while link != base and link in above:
            path.insert(0, above[link])
            link = above[link].parent
        return path

    def pose(self, link: str, positions: Mapping[str, float], base: str | None = None) -> Array:
        """Return the pose (4, 4) of a link in a base, or the root; joints are at 0 if not given."""
        X = np.eye(4)
        for joint in self.chain(link, base):
            X = X @ joint.pose(positions.get(joint.name, 0.0))
        return X

    def mimic(self, joint: str) -> Mimic:
        """Return what a joint follows: itself, if nothing else."""
        return self.mimics.get(joint, Mimic(joint=joint, leader=joint, ratio=1.0, offset=0.0))

    def relation(self, joint: str, to: str) -> tuple[float, float] | None:
        """Return ratio and offset of a joint's position to another's; None if none leads both."""
        own, other = self.mimic(joint), self.mimic(to)
        ratio = own.ratio / other.ratio
        return (ratio, own.offset - ratio * other.offset) if own.leader == other.leader else None
