"""Rows of a file of postures as they are read, and the table that is made of them.

In: poses of a link of the hand, and joints by name. Out: a `PostureTable`: poses of the palm, and
joints in the plant's order.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from drakegrasp.arithmetic import multiply
from drakegrasp.errors import GraspError, listed, one_line
from drakegrasp.frames import Array, make_pose
from drakegrasp.hand.description import Hand
from drakegrasp.simulation.postures.posture import joint_order, preshape_index
from drakegrasp.simulation.postures.table import PostureTable, known_preshapes, make_table

#: How far the length of a quaternion may be from one.
UNIT_TOLERANCE = 1e-3


@dataclass(frozen=True, kw_only=True, eq=False)
class Rows:
    """The n postures of one file.

    Attributes:
        objects: (n,), names of the objects.
        X_FL: (n, 4, 4), pose of a link in the frame.
        link: Name of the palm link, whose pose it is; None: the palm frame G.
        frame: One of `TABLE_FRAMES`.
        q: Joint positions (n, m) [rad or m] by "grasp", "pregrasp" and "squeeze".
        joints: (m,), names of the joints; None: all, in the plant's order. A joint that the hand
            file couples, or that the preshapes of all rows keep, may be missing.
        X_TC: (n, 4, 4), for the frame "camera".
        numbers: `resting`, `log_density` and `scale`, (n,) each, as far as they are known.
        said: (n,), where each comes from.
        preshape: (n,), name of the hand's preshape; empty or None: all fingers close.
    """

    objects: Sequence[str]
    X_FL: Array
    link: str | None = None
    frame: str = "object"
    q: Mapping[str, Any]
    joints: Sequence[str] | None = None
    X_TC: Array | None = None
    numbers: Mapping[str, Any] = field(default_factory=dict)
    said: Sequence[str] | None = None
    preshape: Sequence[str | None] | None = None


def table_of(hand: Hand, parts: Sequence[Rows]) -> PostureTable:
    """Return the table of the postures of some files, one after the other.

    Raises:
        GraspError: If a part is none, or the parts are in different frames.
    """
    frames = {part.frame for part in parts}
    if len(frames) > 1:
        raise GraspError(f"files must be in one frame, got {', '.join(sorted(frames))}")
    counts = [len(part.objects) for part in parts]

    def joined(values: Sequence[Any], shape: tuple[int, ...] = ()) -> Array:
        return np.concatenate(
            [
                np.full((n, *shape), np.nan) if value is None else np.asarray(value, dtype=float)
                for n, value in zip(counts, values, strict=True)
            ]
        )

    q = [_in_order(hand, part) for part in parts]
    joints = (len(hand.joint_names),)
    try:
        return make_table(
            hand,
            [name for part in parts for name in part.objects],
            joined([_palm_poses(hand, part) for part in parts]),
            joined([each["grasp"] for each in q]),
            q_pregrasp=joined([each.get("pregrasp") for each in q], joints),
            q_squeeze=joined([each.get("squeeze") for each in q], joints),
            resting=joined(
                [
                    part.numbers.get("resting", np.zeros(n))
                    for n, part in zip(counts, parts, strict=True)
                ]
            ),
            frame=frames.pop(),
            X_TC=None if parts[0].X_TC is None else joined([part.X_TC for part in parts]),
            scale=joined([part.numbers.get("scale") for part in parts]),
            log_density=joined([part.numbers.get("log_density") for part in parts]),
            said=[
                text
                for n, part in zip(counts, parts, strict=True)
                for text in (part.said or [""] * n)
            ],
            preshape=[
                name or ""
                for n, part in zip(counts, parts, strict=True)
                for name in (part.preshape or [""] * n)
            ],
        )
    except (TypeError, ValueError) as error:
        raise GraspError(one_line(error)) from None


def _palm_poses(hand: Hand, part: Rows) -> Array:
    """Return the poses (n, 4, 4) of the palm frame."""
    if part.link is None:
        return part.X_FL
    if part.link != hand.palm_link:
        raise GraspError(
            f"link must be 'palm' for the palm frame, or {hand.palm_link!r}, got {part.link!r}"
        )
    return multiply(part.X_FL, hand.X_BG)


def _in_order(hand: Hand, part: Rows) -> dict[str, Array]:
    """Return the joint positions (n, j) by their stage, in the plant's order."""
    order = joint_order(hand)
    joints = list(order if part.joints is None else part.joints)
    if unknown := [name for name in joints if name not in order]:
        raise GraspError(
            f"joints must be those of the hand ({', '.join(order)}), got {unknown[0]!r}"
        )
    if len(set(joints)) < len(joints):
        raise GraspError("joints must be named once each, got one twice")

    # Joints that the hand file moves or keeps may be left out.
    followers = {
        c.joint: (hand.fingers[i].closing_joint, c.ratio, c.offset)
        for i in hand.motor_fingers
        for c in hand.followers(i)
    }
    count = len(part.objects)
    names = known_preshapes(part.preshape or [None] * count, count, hand)
    kept = [hand.at(preshape_index(hand, name or None)).preshape for name in names]
    still = set(order).intersection(*kept)
    known = {*joints, *still, *followers}
    if missing := [name for name in order if name not in known]:
        raise GraspError(f"joints must include {listed(missing)}, got {listed(joints)}")
    found = {}
    turning = [hand.joint_units[name] == "rad" for name in joints]
    for stage, values in part.q.items():
        rows = _rows(values, (count, len(joints)), stage)
        _refuse_degrees(rows[:, turning], stage)
        columns = dict(zip(joints, rows.T, strict=True))
        given = ~np.isnan(rows[:, 0])
        for name in still - columns.keys():
            columns[name] = np.where(given, [of_row[name] for of_row in kept], np.nan)
        for name, (leader, ratio, offset) in followers.items():
            if name not in columns:
                columns[name] = ratio * columns[leader] + offset
        found[stage] = np.column_stack([columns[name] for name in order])
    return found


def _rows(values: Any, shape: tuple[int, int], stage: str) -> Array:
    try:
        rows = np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        raise GraspError(f"{stage} joints must be numbers, got something else") from None
    if rows.shape != shape:
        raise GraspError(f"{stage} joints must be of shape {shape}, got {rows.shape}")
    return rows


def _refuse_degrees(rows: Array, stage: str) -> None:
    """Refuse joints of which most rows have one beyond a whole turn, as in degrees."""
    largest = np.abs(rows[np.isfinite(rows).all(axis=1)]).max(axis=1, initial=0.0)
    if len(largest) and np.median(largest) > 2.0 * np.pi:
        raise GraspError(
            f"{stage} joints must be in radians, got up to {largest.max():.4g}: these look like "
            "degrees"
        )


def quaternion_poses(positions: npt.ArrayLike, quaternions: npt.ArrayLike) -> Array:
    """Return poses (n, 4, 4) of positions (n, 3) [m] and quaternions (n, 4) w, x, y, z.

    Raises:
        GraspError: If they are not finite numbers, or a quaternion is not of length 1.
    """
    try:
        p, wxyz = np.asarray(positions, dtype=float), np.asarray(quaternions, dtype=float)
    except (TypeError, ValueError):
        raise GraspError("positions and quaternions must be numbers, got something else") from None
    if p.ndim != 2 or p.shape[1] != 3 or wxyz.shape != (len(p), 4):
        raise GraspError(
            "positions must be of shape (n, 3) and quaternions of (n, 4), "
            f"got {p.shape} and {wxyz.shape}"
        )
    length = np.linalg.norm(wxyz, axis=1)
    bad = ~np.isfinite(p).all(axis=1) | ~(np.abs(length - 1.0) <= UNIT_TOLERANCE)
    if bad.any():
        i = int(np.argmax(bad))
        raise GraspError(
            f"row {i}: position and quaternion must be finite, and the quaternion of length 1, "
            f"got {p[i].tolist()} and {wxyz[i].tolist()}"
        )
    # In single precision a quaternion is off by some 1e-7.
    R = Rotation.from_quat(wxyz / length[:, None], scalar_first=True).as_matrix()
    return np.array([make_pose(*each) for each in zip(R, p, strict=True)]).reshape(-1, 4, 4)
