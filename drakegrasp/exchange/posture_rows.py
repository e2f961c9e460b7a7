"""Rows of a file of postures as they are read, and the table that is made of them.

In: poses of a link of the hand, and joints by name. Out: a `PostureTable`: poses of the palm, and
joints in the plant's order.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from drakegrasp.arithmetic import multiply
from drakegrasp.errors import GraspError, listed, one_line
from drakegrasp.frames import Array, make_pose
from drakegrasp.hand.description import Hand
from drakegrasp.simulation.posture import joint_order, preshape_index
from drakegrasp.simulation.posture_table import PostureTable, known_preshapes, make_table

#: How far the length of a quaternion may be from one.
UNIT_TOLERANCE = 1e-3


@dataclass(frozen=True, kw_only=True, eq=False)
class Rows:
    """The n postures of one file.

    Attributes:
        objects: (n,), names of the objects; empty where only `of_row` says it.
        X_FL: (n, 4, 4), pose of a link in the frame.
        link: Name of the palm link, whose pose it is; None: the palm frame G.
        frame: One of `TABLE_FRAMES`.
        q: Joint positions (n, m) [rad or m] by "grasp", "pregrasp" and "squeeze".
        joints: (m,), names of the joints; None: all, in the plant's order. A joint that the hand
            file couples, or that the preshapes of all rows keep, may be missing.
        X_TC: (n, 4, 4), for the frame "camera".
        numbers: `resting`, `log_density` and `scale`, (n,) each, `X_TO` (n, 4, 4) and `conditions`
            (n, 3), as far as they are known; see `PostureTable`.
        said: (n,), where each comes from.
        invalid: (n,), why a row is known to be none; None: no row is.
        of_row: (n,), of predictions: the row of a dataset's split that each is for.
        confidence: (n,), of predictions: greater is better.
        preshape: (n,), name of the hand's preshape; empty or None: all fingers close.
        of_trial: (n,), of samples that were exported: the trial that each was.
        hand: Name of the hand; None: the file does not say.
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
    invalid: Sequence[str] | None = None
    of_row: Any = None
    confidence: Any = None
    preshape: Sequence[str | None] | None = None
    of_trial: npt.NDArray[np.int64] | None = None
    hand: str | None = None

    def at(self, rows: Sequence[int]) -> Rows:
        """Return some of the rows, in the given order."""
        chosen: dict[str, Any] = {
            name: None if (value := getattr(self, name)) is None else _chosen(value, rows)
            for name in _OF_EACH
        }
        return replace(self, **chosen)


#: What `Rows` has of each row, as a sequence or as a mapping of arrays.
_OF_EACH = (
    *("objects", "X_FL", "q", "X_TC", "numbers", "said", "invalid", "of_row", "confidence"),
    *("preshape", "of_trial"),
)


def _chosen(value: Any, rows: Sequence[int]) -> Any:
    if isinstance(value, Mapping):
        return {name: _chosen(each, rows) for name, each in value.items()}
    return value[rows] if isinstance(value, np.ndarray) else [value[i] for i in rows]


def table_of(hand: Hand, rows: Rows) -> PostureTable:
    """Return the table of the postures of a file.

    Raises:
        GraspError: If the file is none of this hand.
    """
    if rows.hand not in (None, hand.name):
        raise GraspError(f"hand must be {rows.hand}, as the file says, got {hand.name} (--hand)")

    # Poses and joints as the hand has them.
    q = _in_order(hand, rows)
    try:
        return make_table(
            hand,
            rows.objects,
            _palm_poses(hand, rows),
            q["grasp"],
            q_pregrasp=q.get("pregrasp"),
            q_squeeze=q.get("squeeze"),
            frame=rows.frame,
            X_TC=rows.X_TC,
            said=rows.said,
            invalid=rows.invalid,
            preshape=rows.preshape,
            **rows.numbers,
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
    bad = [""] * count
    names = known_preshapes(part.preshape or [None] * count, count, hand, bad)
    kept = [
        dict.fromkeys(order, np.nan)
        if none
        else hand.at(preshape_index(hand, name or None)).preshape
        for name, none in zip(names, bad, strict=True)
    ]
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


def quaternion_poses(
    positions: npt.ArrayLike, quaternions: npt.ArrayLike
) -> tuple[Array, list[str]]:
    """Return poses (n, 4, 4) of positions (n, 3) [m] and quaternions (n, 4) w, x, y, z.

    Returns:
        The poses, NaN where there is none; and for each the reason, empty where there is one.

    Raises:
        GraspError: If they are no numbers, or of other shapes.
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
    reasons = [
        "position and quaternion must be finite, and the quaternion of length 1, got "
        f"{p[i].tolist()} and {wxyz[i].tolist()}"
        if none
        else ""
        for i, none in enumerate(bad.tolist())
    ]
    # In single precision a quaternion is off by some 1e-7.
    X = np.full((len(p), 4, 4), np.nan)
    good = np.flatnonzero(~bad)
    if good.size:
        R = Rotation.from_quat(wxyz[good] / length[good, None], scalar_first=True).as_matrix()
        X[good] = [make_pose(*each) for each in zip(R, p[good], strict=True)]
    return X, reasons
