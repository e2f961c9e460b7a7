"""The palm frame G of a grip: where the palm's surface is, and which direction it faces.

Input: a model and a `Grip`. Output: poses X_BG, the best first. Gz is perpendicular to the line
along which the fingers close, and no link is on the line from the palm along Gz to the place where
the fingers pinch. Gy points to the finger that opposes the others.

The best frame faces along an axis of the palm link, or else as nearly as possible from the palm to
the pinch. A frame comes last if its ray to the pinch does not come out of the palm, or if the hand
reaches far beyond the pinch, where a table would be.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.math import RollPitchYaw, RotationMatrix

from drakegrasp.frames import Array, invert_pose, make_pose, transform_points
from drakegrasp.hand.checks import PALM_DEPTH, ray_end
from drakegrasp.hand.draft.grips import Grip
from drakegrasp.hand.draft.vendor import VendorModel
from drakegrasp.hand.shapes import ray_span

#: Step between the tested directions [deg], and largest angle from an axis of the palm that is
#: replaced by the axis.
STEP_DEG, ALIGNED = 15, np.deg2rad(15.0)
#: Smallest distance of the pinch in front of the palm, and largest reach of the hand beyond the
#: pinch [m].
AHEAD, BEYOND = 0.015, 0.06


@dataclass(frozen=True, kw_only=True, eq=False)
class PalmFrame:
    """A palm frame.

    Attributes:
        p_BG: (3,), origin of G in B [m].
        rpy_deg: (3,), roll, pitch and yaw of G in B [deg].
        height: Height of the pinch above the palm [m].
        rank: What it lacks, then its angle to the line from the palm to the pinch [rad]: the
            smallest is the best.
    """

    p_BG: Array
    rpy_deg: Array
    height: float
    rank: tuple[int, float]

    @property
    def X_BG(self) -> Array:
        """The pose X_BG (4, 4)."""
        R = RollPitchYaw(np.deg2rad(self.rpy_deg)).ToRotationMatrix().matrix()
        return make_pose(R, self.p_BG)


def find_palm_frames(
    model: VendorModel,
    palm: str,
    grip: Grip,
    postures: Sequence[Mapping[str, float]],
) -> list[PalmFrame]:
    """Return the palm frames of a grip, the best first; empty if the palm faces no pinch.

    Args:
        model: The model.
        palm: Link B.
        grip: The fingers.
        postures: Positions of all joints, from the open to the closed hand.
    """

    # The corners of each shape in B, in a posture.
    def placed(posture: Mapping[str, float]) -> list[Array]:
        return [
            transform_points(model.pose(name, posture, palm), shape.corners())
            for name, link in model.links.items()
            if name == palm or model.carries(palm, name)
            for shape in link.collisions
        ]

    opened = placed(postures[0])
    cloud = np.concatenate([c for posture in postures for c in placed(posture)])
    parts = [shape.corners() for shape in model.links[palm].collisions] or opened
    frames = []
    centre = np.concatenate(parts).mean(axis=0)
    for direction, aside in _directions(grip, centre):
        found = _origin(grip, direction, parts)
        if found is None:
            continue
        p_BG, beside = found
        y = grip.axis - (grip.axis @ direction) * direction
        y /= np.linalg.norm(y)
        X_BG = make_pose(np.column_stack([np.cross(y, direction), y, direction]), p_BG)
        inside = [transform_points(invert_pose(X_BG), corners) for corners in opened]
        if max(map(ray_end, inside)) > PALM_DEPTH:
            continue
        beyond = float((cloud @ direction).max() - grip.middle @ direction)
        oblique = np.arccos(min(float(np.abs(direction).max()), 1.0)) > 1e-3
        rpy = RotationMatrix.ProjectToRotationMatrix(X_BG[:3, :3]).ToRollPitchYaw().vector()
        frames.append(
            PalmFrame(
                p_BG=np.round(X_BG[:3, 3], 4) + 0.0,
                rpy_deg=np.round(np.rad2deg(rpy), 1) + 0.0,
                height=float((grip.middle - p_BG) @ direction),
                # An axis of the palm may be one step farther from the line.
                rank=(int(beside) + int(beyond > BEYOND), aside + oblique * np.deg2rad(STEP_DEG)),
            )
        )
    return sorted(frames, key=lambda frame: frame.rank)


def _directions(grip: Grip, centre: Array) -> list[tuple[Array, float]]:
    """Return possible unit directions (3,) of Gz, with angles to the line palm-pinch [rad]."""
    axis = grip.axis
    line = grip.middle - centre
    line = line - (line @ axis) * axis
    if np.linalg.norm(line) < 1e-6:
        line = np.cross(axis, np.roll(axis, 1))
    line /= np.linalg.norm(line)
    third = np.cross(axis, line)
    turns = np.deg2rad(np.arange(-165, 181, STEP_DEG))
    found = [np.cos(t) * line + np.sin(t) * third for t in turns]
    found += [own for own in (*np.eye(3), *-np.eye(3)) if abs(own @ axis) < np.sin(ALIGNED)]
    return [(d, float(np.arccos(np.clip(d @ line, -1.0, 1.0)))) for d in found]


def _origin(grip: Grip, direction: Array, parts: list[Array]) -> tuple[Array, bool] | None:
    """Return the origin (3,) of G below the pinch, and whether the palm is beside the ray."""
    # Find where the ray to the pinch leaves the palm, or else the palm's foremost point.
    spans = [ray_span(corners, grip.middle, direction) for corners in parts]
    leaves = [span[1] for span in spans if span is not None]
    if leaves:
        back = max(leaves)
    else:
        ahead = max(float((corners @ direction).max()) for corners in parts)
        back = min(ahead - float(grip.middle @ direction), -2.0 * AHEAD)
    return (grip.middle + back * direction, not leaves) if back <= -AHEAD else None
