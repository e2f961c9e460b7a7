"""Grasps from outside: many postures of several objects, and the palm poses of a build from them.

Input: what a file, a network or another tool states about n grasps. Output: one `GraspTable`. A bad
row keeps the reason why it is bad and does not affect other rows. The table is plain data and can
be sent to another process. A build makes its `Candidates` and the `Attempt` of each row from it.
Verification and scoring put its rows on their objects.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Self, TypeVar

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from drakegrasp.arithmetic import multiply
from drakegrasp.config import Config
from drakegrasp.errors import NAMED, GraspError, listed
from drakegrasp.frames import (
    FARTHEST,
    Array,
    as_numbers,
    frame_in_object,
    validate_frame,
)
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.objects.model import ObjectModel
from drakegrasp.seeding import Stream, object_key
from drakegrasp.simulation.attempt import Attempt, Source
from drakegrasp.simulation.candidates import Candidates, make_poses
from drakegrasp.simulation.posture import (
    BESIDE_GRASP,
    Posture,
    exact_pose,
    preshape_index,
    start_of,
)
from drakegrasp.simulation.settle import SAME_UP
from drakegrasp.table import Table

#: Upper bound of the index of a resting pose; no object has so many.
MOST_POSES = 1e6
#: Value of `resting` if a row names no resting pose; all resting poses of the object are tried.
UNTOLD = -1
#: Value of `preshape` if a row without joints is tried in each preshape of the hand.
EACH = "each"
#: Largest allowed difference between the length of a quaternion and one.
UNIT_TOLERANCE = 1e-3
#: Columns of a table of postures that decide a build. The reason why a row is bad follows from the
#: others and from the meshes; a build draws its own conditions.
_DECIDING = (
    *("objects", "resting", "X_TO", "X_FG", "q_grasp", "q_pregrasp", "q_squeeze", "frame", "X_TC"),
    *("scale", "preshape", "row"),
)
#: Attributes of a table that apply to all its rows together.
_OF_ALL = ("frame", "file", "sha256", "without_rows")
#: Conditions that an attempt may have drawn, in the order of `GraspTable.conditions`.
CONDITIONS = ("friction_hand", "friction_table", "mass")


@dataclass(frozen=True, kw_only=True, eq=False)
class GraspRows:
    """n grasps from outside, one in a row: what contacts and postures have in common.

    Attributes:
        row: (n,), row in the file.
        invalid: (n,), reason why a row is not a valid grasp; empty for a valid row.
        of_row: (n,), for predictions: row of the dataset's split that each prediction is for.
        confidence: (n,), for predictions: greater is better.
        rank: (n,), for predictions: 0 for the best prediction of its row or object, see `ranked`.
        file, sha256: Source of predictions to score, and its hash.
        without_rows: For predictions: objects that the files name and the split has no row of.
    """

    row: npt.NDArray[np.int64]
    invalid: tuple[str, ...]
    of_row: Any = None
    confidence: Any = None
    rank: Any = None
    file: str = ""
    sha256: str = ""
    without_rows: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.invalid)

    def __iter__(self) -> Iterator[tuple[str, Any]]:
        """Yield name and values of each column of the table."""
        for f in fields(self):
            if f.name not in _OF_ALL and (value := getattr(self, f.name)) is not None:
                yield f.name, value

    def at(self, rows: Sequence[int]) -> Self:
        """Return some rows, in the given order."""
        chosen: dict[str, Any] = {name: taken(value, rows) for name, value in self}
        return replace(self, **chosen)

    def numbers(self) -> Array:
        """Return all numbers (n, m) that describe the rows; NaN for numbers that a row lacks."""
        raise NotImplementedError

    def refuse(self, reasons: Sequence[str]) -> Self:
        """Return the table with additional reasons (n,) why rows are not valid."""
        both = (one or other for one, other in zip(self.invalid, reasons, strict=True))
        return replace(self, invalid=tuple(both))

    @property
    def left_out(self) -> str:
        """A message on the objects of which the split has no row; empty if there are none."""
        if not self.without_rows:
            return ""
        return f"grasps are left out, as the split has no row of {listed(self.without_rows)}"


#: A table of contacts or of postures.
Rows = TypeVar("Rows", bound=GraspRows)


@dataclass(frozen=True, kw_only=True, eq=False)
class GraspTable(GraspRows):
    """n postures of hands with j joints in the plant's order, built by `make_attempts`.

    Attributes:
        objects: (n,), name of the object of each row.
        resting: (n,), index of the object's resting pose; `UNTOLD` if a row names none.
        X_TO: (n, 4, 4), pose of the object on the table, another way to name the resting pose; NaN
            if not given.
        X_FG: (n, 4, 4), pose of the palm in the frame.
        q_grasp: (n, j), joint positions of the grasp [rad or m]. A row of NaN is a palm pose alone,
            from which the open hand closes.
        q_pregrasp, q_squeeze: (n, j), joint positions before and beyond the grasp; a row of NaN is
            not given.
        frame: One of `frames.GRASP_FRAMES`.
        X_TC: (n, 4, 4), pose of the camera in {T}, for the frame "camera".
        scale: (n,), metres per unit of length of the posture's mesh file; NaN for any scale.
        said: (n,), origin of each row, in words.
        preshape: (n,), name of the hand's preshape; empty if all fingers close; or `EACH`.
        conditions: (n, 3), the `CONDITIONS` under which the grasp held; NaN if unknown.
            Verification uses them; a build draws its own conditions.
        q_arm: (n, a), for predictions with an arm: its joints at the grasp; a row of NaN is out of
            its reach.
    """

    objects: tuple[str, ...]
    resting: npt.NDArray[np.int64]
    X_TO: Array
    X_FG: Array
    q_grasp: Array
    q_pregrasp: Array
    q_squeeze: Array
    frame: str = "object"
    X_TC: Array | None = None
    scale: Array
    said: tuple[str, ...]
    preshape: tuple[str, ...]
    conditions: Array
    q_arm: Array | None = None

    def of_object(self, name: str) -> GraspTable:
        """Return the valid rows of an object, in their order."""
        said = zip(self.objects, self.invalid, strict=True)
        return self.at([i for i, (each, reason) in enumerate(said) if each == name and not reason])

    def posture(self, i: int, X_TO: Array, X_OM: Array | None = None) -> Posture:
        """Return the posture of a row.

        Args:
            i: Index of the row in the table.
            X_TO: Pose (4, 4) of its object on the table.
            X_OM: Pose (4, 4) of the mesh file's frame in {O}, for the frame "mesh".

        Raises:
            GraspError: If the frame is "mesh" and its pose is not given.
        """
        X_TC = None if self.X_TC is None else self.X_TC[i]
        X_OF = frame_in_object(self.frame, X_TO, X_OM, X_TC)
        return _posture(self, i, multiply(X_OF, self.X_FG[i]))

    def names_pose(self, i: int) -> bool:
        """Return whether a row names its resting pose."""
        return bool(np.isfinite(self.X_TO[i]).all() or self.resting[i] != UNTOLD)

    def shapes(self, i: int, hand: Hand) -> tuple[str, ...]:
        """Return the preshapes in which a row is tried: the one that it names, or each preshape."""
        return hand.preshape_names if self.preshape[i] == EACH else (self.preshape[i],)

    def resting_of(self, i: int, poses: Array) -> list[int]:
        """Return the indices of the object's resting poses (r, 4, 4) that a row is tried in.

        It is the resting pose that the row names, or all if it names none. It is empty if the
        object lacks the named resting pose.
        """
        if np.isfinite(X_TO := self.X_TO[i]).all():
            cosines = poses[:, 2, :3] @ X_TO[2, :3]
            nearest = int(np.argmax(cosines))
            return [nearest] if cosines[nearest] > np.cos(SAME_UP) else []
        named, known = int(self.resting[i]), list(range(len(poses)))
        return known if named == UNTOLD else known[named : named + 1]

    def numbers(self) -> Array:
        """Return all numbers (n, m) that describe the rows; NaN for numbers that a row lacks."""
        X = [X for X in (self.X_FG, self.X_TC) if X is not None]
        q = [self.q_grasp, self.q_pregrasp, self.q_squeeze]
        return np.column_stack([*(each.reshape(len(self), 16) for each in X), *q])

    @property
    def refused(self) -> str:
        """A message on the rows that are not valid, with the reasons; empty if all are valid."""
        rows: dict[str, list[str]] = {}
        for row, reason in zip(self.row.tolist(), self.invalid, strict=True):
            if reason:
                rows.setdefault(reason, []).append(str(row))
        if not rows:
            return ""
        count = sum(map(len, rows.values()))
        why = [f"row {listed(same)}: {reason}" for reason, same in rows.items()]
        more = f"; and {len(why) - NAMED:,} other reasons" if len(why) > NAMED else ""
        told = "; ".join(why[:NAMED])
        return f"{count:,} of {len(self):,} rows of the postures are not tried: {told}{more}"

    def digest(self) -> str:
        """Return a hash (16 hex digits) of everything that decides a build."""
        digest = hashlib.sha256()
        for name in _DECIDING:
            value = getattr(self, name)
            is_array = isinstance(value, np.ndarray)
            digest.update(value.tobytes() if is_array else json.dumps(value).encode())
        return digest.hexdigest()[:16]


def ranked(table: Rows, of: Sequence[Any] | npt.NDArray[Any]) -> Rows:
    """Return a table with the rank of each row among the rows with the same target.

    The row with the greatest confidence is first; of equal ones, the row that was given first.
    Invalid rows without a confidence are last.

    Args:
        table: The grasps.
        of: (n,), target of each row, e.g. a row of a dataset.
    """
    _, number, counts = np.unique(np.asarray(of), return_inverse=True, return_counts=True)
    falling = np.zeros(len(table)) if table.confidence is None else -table.confidence
    order = np.lexsort((falling, number))
    ranks = np.zeros(len(table), dtype=np.int64)
    ranks[order] = np.arange(len(table)) - np.repeat(np.cumsum(counts) - counts, counts)
    return replace(table, rank=ranks)


def taken(value: Any, rows: Sequence[int]) -> Any:
    """Return some rows of a column: an array, a tuple or a list."""
    if isinstance(value, np.ndarray):
        return value[rows]
    return type(value)(value[i] for i in rows)


def make_attempts(
    hand: Hand,
    objects: Sequence[str],
    X_FG: npt.ArrayLike,
    q_grasp: npt.ArrayLike | None = None,
    *,
    q_pregrasp: npt.ArrayLike | None = None,
    q_squeeze: npt.ArrayLike | None = None,
    joints: Sequence[str] | None = None,
    link: str | None = None,
    resting: npt.ArrayLike | None = None,
    X_TO: npt.ArrayLike | None = None,
    frame: str = "object",
    X_TC: npt.ArrayLike | None = None,
    scale: npt.ArrayLike | None = None,
    said: Sequence[str] | None = None,
    invalid: Sequence[str] | None = None,
    preshape: Sequence[str | None] | None = None,
    conditions: npt.ArrayLike | None = None,
    of_row: Any = None,
    confidence: Any = None,
    alone: npt.ArrayLike = False,
) -> GraspTable:
    """Return a table of postures, after checking each row separately.

    Args:
        hand: The hand.
        objects: (n,), names of the objects.
        X_FG: (n, 4, 4), poses of the palm, or of the link, in the frame.
        q_grasp: (n, m), joint positions; None if every row is a palm pose alone.
        q_pregrasp: (n, m), joint positions; a row of NaN means that none are given.
        q_squeeze: (n, m), joint positions; a row of NaN means that none are given.
        joints: (m,), names of the joints; None for all joints in the plant's order. Joints that the
            hand file couples, or that the preshapes of all rows keep, may be missing.
        link: Name of the palm link, or of one of the hand's `frames`, if the poses are poses of it;
            None for the palm frame.
        resting: (n,), index of the object's resting pose; if NaN or None, all are tried.
        X_TO: (n, 4, 4), poses of the objects on the table instead of indices; rows of NaN are not
            given.
        frame: One of `frames.GRASP_FRAMES`.
        X_TC: (n, 4, 4), with the frame "camera".
        scale: (n,), metres per unit of length of the mesh file.
        said: (n,), origin of each row, in words.
        invalid: (n,), reason why a row is known to be invalid, or empty.
        preshape: (n,), names of the hand's preshapes; empty if all fingers close. A palm pose alone
            may be tried in `EACH`.
        conditions: (n, 3), `CONDITIONS`; NaN for those of the object and of the configuration.
        of_row: (n,), see `GraspTable`.
        confidence: (n,), see `GraspTable`.
        alone: (n,), whether a row is a palm pose alone, without joints at any stage.

    Raises:
        GraspError: If there is no row, the arrays differ in length, or the joints or the link do
            not belong to the hand.
        HandError: If the hand has no such link.
    """
    count, size = len(objects), (len(objects), len(hand.joint_names))
    if not count:
        raise GraspError("postures must be at least one row, got none")
    validate_frame(frame)
    if (X_TC is None) == (frame == "camera"):
        raise GraspError("X_TC must be given with the frame camera, and only then")

    # What each row has or may lack; `bad` gets a row's first fault.
    bad = [""] * count if invalid is None else list(invalid)
    palms = np.broadcast_to(np.asarray(q_grasp is None or alone, dtype=bool), (count,))
    poses = _resting(resting, count, bad)
    under = _conditions(conditions, count, bad)
    names, kept = _preshapes(preshape, palms, hand, bad)

    # The joints in the plant's order, and the pose of the palm frame.
    stages = {"q_grasp": q_grasp, "q_pregrasp": q_pregrasp, "q_squeeze": q_squeeze}
    q = _in_order(hand, list(hand.joint_order if joints is None else joints), stages, kept)
    if link is not None:
        X_FG = multiply(np.asarray(X_FG), hand.palm_in(link))
    for stage in ("q_pregrasp", "q_squeeze"):
        q[stage] = _numbers(q[stage], size, stage, bad, some=True)
        for i in np.flatnonzero(palms & ~np.isnan(q[stage]).all(axis=1)):
            bad[i] = bad[i] or f"{stage} must be {BESIDE_GRASP}"
    return GraspTable(
        objects=tuple(objects),
        X_FG=_poses(X_FG, count, "the palm's pose", bad),
        q_grasp=_numbers(q["q_grasp"], size, "q_grasp", bad, some=palms),
        q_pregrasp=q["q_pregrasp"],
        q_squeeze=q["q_squeeze"],
        frame=frame,
        X_TC=None if X_TC is None else _poses(X_TC, count, "X_TC", bad),
        scale=_numbers(scale, (count,), "scale", bad, some=True),
        said=("",) * count if said is None else tuple(said),
        preshape=names,
        conditions=under,
        row=np.arange(count, dtype=np.int64),
        resting=poses,
        X_TO=_poses(X_TO, count, "X_TO", bad, some=True),
        invalid=tuple(bad),
        of_row=of_row,
        confidence=None if confidence is None else read_confidence(confidence, (count,), bad),
    )


def make_posture(
    hand: Hand,
    X_FG: npt.ArrayLike,
    q_grasp: npt.ArrayLike | None = None,
    q_pregrasp: npt.ArrayLike | None = None,
    q_squeeze: npt.ArrayLike | None = None,
    *,
    frame: str = "object",
    X_TO: npt.ArrayLike | None = None,
    X_TC: npt.ArrayLike | None = None,
    joints: Sequence[str] | None = None,
    preshape: str | None = None,
) -> Posture:
    """Return the posture of a table of one row, whose palm pose is given in one of four frames.

    Args:
        hand: The hand.
        X_FG: Pose of the palm in the frame, (4, 4).
        q_grasp: (j,), joint positions of the grasp [rad or m]; None if the open hand closes.
        q_pregrasp: (j,), start of the trial.
        q_squeeze: (j,), target of the motors beyond the grasp.
        frame: "object" {O}, "table" {T}, "camera" {C} or "world" {W}.
        X_TO: Pose of the object on the table, (4, 4), for any frame but "object".
        X_TC: Pose of the camera in the table-top frame, (4, 4), for the frame "camera".
        joints: Names of the joints in the order of the vectors; None for the plant's order. Joints
            that the hand file couples may be missing.
        preshape: Name of one of the hand's preshapes; None if all fingers close.

    Raises:
        GraspError: If a pose is invalid, a vector has another length or is not finite, a pregrasp
            or a squeeze is given without a grasp, a joint is missing, the hand has no such
            preshape, or the frame is unknown or lacks its pose.
    """
    if frame in ("table", "world", "camera") and X_TO is None:
        raise GraspError(f"X_TO must be given with the frame {frame}, got None")
    stages = {"q_grasp": q_grasp, "q_pregrasp": q_pregrasp, "q_squeeze": q_squeeze}
    poses = {"X_FG": X_FG, "X_TO": X_TO, "X_TC": X_TC}
    row: dict[str, Any] = {
        name: [value] for name, value in (stages | poses).items() if value is not None
    }
    table = make_attempts(hand, [""], **row, frame=frame, joints=joints, preshape=[preshape])
    if table.invalid[0]:
        raise GraspError(table.invalid[0])
    return table.posture(0, table.X_TO[0])


def read_confidence(stated: Any, shape: tuple[int, ...], invalid: Sequence[str] = ()) -> Array:
    """Return the confidence that is stated, an array of a shape.

    Args:
        stated: The confidence.
        shape: Its shape, (n,) for n rows, or (n, m) for m predictions per row.
        invalid: (n,), reasons why rows are not valid; these rows may have none.

    Raises:
        GraspError: If it is not one finite number per row.
    """
    must = f"confidence must be {shape} finite numbers, one per grasp"
    confidence = as_numbers(stated, must)
    if confidence.shape != shape:
        raise GraspError(f"{must}, got {confidence.shape}")
    valid = np.array([not reason for reason in invalid] or True)
    if (wrong := confidence[valid & ~np.isfinite(confidence)]).size:
        raise GraspError(f"{must}, got {wrong[0]:g}")
    return confidence


def _resting(told: npt.ArrayLike | None, count: int, bad: list[str]) -> npt.NDArray[np.int64]:
    """Return indices (n,) of resting poses, `UNTOLD` for NaN."""
    where = _numbers(told, (count,), "resting", bad, some=True)
    named = (where >= 0) & (where < MOST_POSES) & (where == np.floor(where))
    for i in np.flatnonzero(~(named | np.isnan(where))):
        bad[i] = bad[i] or f"resting must be the index of a resting pose, got {where[i]:g}"
    return np.where(named, where, UNTOLD).astype(np.int64)


def _conditions(told: npt.ArrayLike | None, count: int, bad: list[str]) -> Array:
    """Return the `CONDITIONS` (n, 3); those that are given must be positive."""
    known = _numbers(told, (count, len(CONDITIONS)), "conditions", bad, each=True)
    for i, k in np.argwhere(known <= 0.0):
        bad[i] = bad[i] or f"{CONDITIONS[k]} must be positive, got {known[i, k]:g}"
    return known


def join_attempts(parts: Sequence[GraspTable | str]) -> GraspTable:
    """Return the concatenated rows of some tables.

    Args:
        parts: Tables of one hand. A string is the reason why a file is bad, and becomes one row.

    Raises:
        GraspError: If no part is a table, or the tables are in different frames.
    """
    tables = [part for part in parts if isinstance(part, GraspTable)]
    if not tables:
        raise GraspError(str(parts[0]))
    if len(frames := {table.frame for table in tables}) > 1:
        raise GraspError(f"files must be in one frame, got {', '.join(sorted(frames))}")

    # The numbers of a bad row do not matter, because nothing reads them.
    nothing = replace(tables[0].at([0]), objects=("",), said=("",))
    whole = [p if isinstance(p, GraspTable) else replace(nothing, invalid=(p,)) for p in parts]
    return join_rows(whole)


def join_rows(tables: Sequence[Rows]) -> Rows:
    """Return the concatenated rows of some tables of one kind; the first states the rest."""
    joined: dict[str, Any] = {}
    for name, value in tables[0]:
        values = [getattr(part, name) for part in tables]
        if any(each is None for each in values):
            joined[name] = None
        elif isinstance(value, tuple):
            joined[name] = tuple(each for every in values for each in every)
        else:
            joined[name] = np.concatenate(values)
    return replace(tables[0], **{**joined, "row": np.arange(len(joined["row"]), dtype=np.int64)})


def _in_order(
    hand: Hand, joints: list[str], stages: Mapping[str, Any], kept: Sequence[Mapping[str, float]]
) -> dict[str, Array]:
    """Return the joint positions (n, j) of each stage in the plant's order; NaN if not given.

    For each row, `kept` has the positions of the joints that its preshape keeps.
    """
    order = hand.joint_order
    if unknown := [name for name in joints if name not in order]:
        raise GraspError(
            f"joints must be those of the hand, got {unknown[0]!r}: rename them in the file, or "
            f"draft a hand of their model (`drakegrasp hand new`); the hand has {listed(order)}"
        )
    if len(set(joints)) < len(joints):
        raise GraspError("joints must be named once each, got one twice")

    # Joints that the hand file moves or keeps may be left out.
    leaders = {
        c.joint: (hand.fingers[i].closing_joint, c)
        for i in hand.motor_fingers
        for c in hand.followers(i)
    }
    still = set(order).intersection(*kept)
    if missing := [name for name in order if name not in {*joints, *leaders, *still}]:
        raise GraspError(f"joints must include {listed(missing)}, got {listed(joints)}")
    found = dict[str, Array]()
    turning = [hand.joint_units[name] == "rad" for name in joints]
    for stage, values in stages.items():
        if values is None:
            found[stage] = np.full((len(kept), len(order)), np.nan)
            continue
        rows = _array(values, (len(kept), len(joints)), f"{stage.removeprefix('q_')} joints")
        _validate_radians(rows[:, turning], stage.removeprefix("q_"))
        columns = dict(zip(joints, rows.T, strict=True))
        for name in still - columns.keys():
            columns[name] = np.where(np.isnan(rows[:, 0]), np.nan, [row[name] for row in kept])
        for name, (leader, coupling) in leaders.items():
            if name not in columns:
                columns[name] = coupling.ratio * columns[leader] + coupling.offset
        found[stage] = np.column_stack([columns[name] for name in order])
    return found


def _validate_radians(angles: Array, stage: str) -> None:
    """Reject angles (n, m) of revolute joints that look like degrees."""
    # Most rows would have a joint beyond a whole turn.
    largest = np.abs(angles[np.isfinite(angles).all(axis=1)]).max(axis=1, initial=0.0)
    if len(largest) and np.median(largest) > 2.0 * np.pi:
        raise GraspError(
            f"{stage} joints must be in radians, got up to {largest.max():.4g}: these look like "
            "degrees"
        )


def _array(values: Any, shape: tuple[int, ...], name: str) -> Array:
    """Return numbers of a shape."""
    array = as_numbers(values, f"{name} must be numbers of shape {shape}")
    if array.shape != shape:
        raise GraspError(f"{name} must be of shape {shape}, got {array.shape}")
    return array


def _numbers(
    value: npt.ArrayLike | None,
    shape: tuple[int, ...],
    name: str,
    bad: list[str],
    *,
    some: bool | npt.NDArray[np.bool_] = False,
    each: bool = False,
) -> Array:
    """Return an array of a shape; `bad` gets the reason for each row that is not finite.

    A row of the mask `some` may be all NaN. With `each`, individual numbers may be NaN.
    """
    if value is None:
        return np.full(shape, np.nan)
    array = _array(value, shape, name)
    rows = array.reshape(len(array), -1)
    missing = np.isnan(rows)
    if each:
        rows = np.where(missing, 0.0, rows)
    for i in np.flatnonzero(~np.isfinite(rows).all(axis=1) & ~(some & missing.all(axis=1))):
        bad[i] = bad[i] or f"{name} must be finite numbers, got others"
    return np.ascontiguousarray(array)


def _preshapes(
    named: Sequence[str | None] | None, palms: npt.NDArray[np.bool_], hand: Hand, bad: list[str]
) -> tuple[tuple[str, ...], list[Mapping[str, float]]]:
    """Return the names (n,) of preshapes, and the positions of the joints that each keeps.

    The mask `palms` (n,) selects rows with a palm pose alone. `bad` gets the reason for each row
    whose preshape the hand lacks.
    """
    names = tuple(name or "" for name in named or [""] * len(palms))
    if len(names) != len(palms):
        raise GraspError(f"preshape must be of {len(palms)} rows, got {len(names)}")
    # A row without joints, or whose preshape does not exist, keeps none that has to be known.
    kept: list[Mapping[str, float]] = [dict.fromkeys(hand.joint_order, np.nan)] * len(names)
    for i, name in enumerate(names):
        if not (name == EACH and palms[i] and hand.preshapes):
            try:
                kept[i] = hand.at(preshape_index(hand, name or None)).preshape
            except GraspError as error:
                bad[i] = bad[i] or str(error)
    return names, kept


def quaternion_poses(
    positions: npt.ArrayLike, quaternions: npt.ArrayLike
) -> tuple[Array, list[str]]:
    """Return poses (n, 4, 4) of positions (n, 3) [m] and quaternions (n, 4) w, x, y, z.

    Returns:
        The poses, NaN for an invalid pose; and the reason for each invalid pose, else empty.

    Raises:
        GraspError: If the arguments are not numbers, or have other shapes.
    """
    p, wxyz = (
        as_numbers(each, "position and quaternion must be numbers")
        for each in (positions, quaternions)
    )
    if p.ndim != 2 or p.shape[1] != 3 or wxyz.shape != (len(p), 4):
        raise GraspError(
            "positions must be of shape (n, 3) and quaternions of (n, 4), "
            f"got {p.shape} and {wxyz.shape}"
        )
    length = np.linalg.norm(wxyz, axis=1)
    good = np.isfinite(p).all(axis=1) & (np.abs(length - 1.0) <= UNIT_TOLERANCE)
    reasons = [
        ""
        if is_good
        else "position and quaternion must be finite, and the quaternion of length 1, got "
        f"{p[i].tolist()} and {wxyz[i].tolist()}"
        for i, is_good in enumerate(good.tolist())
    ]
    # In single precision, the length of a quaternion is off by about 1e-7.
    X = np.full((len(p), 4, 4), np.nan)
    if good.any():
        R = Rotation.from_quat(wxyz[good] / length[good, None], scalar_first=True).as_matrix()
        X[good] = make_poses(R, p[good])
    return X, reasons


def _poses(
    value: npt.ArrayLike | None, count: int, name: str, bad: list[str], *, some: bool = False
) -> Array:
    """Return poses (n, 4, 4); `bad` gets the reason for each invalid pose, see `_numbers`."""
    array = _numbers(value, (count, 4, 4), name, bad, some=some).copy()
    for i, X in enumerate(array):
        if bad[i] or (some and np.isnan(X).all()):
            continue
        try:
            array[i] = exact_pose(X, name)
            if (far := np.abs(X[:3, 3]).max()) > FARTHEST:
                bad[i] = f"{name} must be within {FARTHEST:g} m, got {far:g} m"
        except GraspError as error:
            bad[i] = str(error)
    return array


def unknown_objects(table: GraspTable, names: Sequence[str]) -> list[str]:
    """Return for each row the reason why its object does not exist; empty if it exists."""
    known, must = set(names), f"object must be one of {listed(list(names))}"
    return ["" if each in known else f"{must}, got {each!r}" for each in table.objects]


def misfits(table: GraspTable, name: str, scale: float, poses: Array) -> list[str]:
    """Return for each row of an object why it does not fit the object; empty for other rows.

    Args:
        table: Rows of any objects.
        name: Name of the object.
        scale: Metres per unit of length of the object's mesh file.
        poses: Resting poses of the object, (r, 4, 4).
    """
    must = f"0 to {len(poses) - 1}" if len(poses) > 1 else "0, the only one"
    found = [""] * len(table)
    for i, each in enumerate(table.objects):
        if each != name or table.invalid[i]:
            continue
        given, stated = np.isfinite(table.X_TO[i]).all(), table.scale[i]
        if not table.resting_of(i, poses):
            found[i] = (
                f"resting pose of {name} must be {must} (objects.resting_poses drops more), "
                f"got {'another X_TO' if given else table.resting[i]}"
            )
        elif np.isfinite(stated) and not np.isclose(stated, scale, rtol=1e-3):
            found[i] = (
                f"scale must be that of {name}, {scale:g} (objects.yaml states it), got {stated:g}"
            )
    return found


#: Columns of postures that a plan has in addition to their palm poses.
_IN_PLAN = ("q_grasp", "q_pregrasp", "q_squeeze", "row", "preshape")


def given_candidates(
    model: ObjectModel, X_TO: Array, table: GraspTable, config: Config
) -> Candidates:
    """Return the postures of an object as its palm poses, up to `candidates.max` of them.

    Rows for a resting pose or a scale that the object does not have are left out.

    Args:
        model: The object.
        X_TO: Resting poses of the object, (r, 4, 4).
        table: Rows of any objects.
        config: The configuration.
    """
    # Rows in {O}: one per resting pose if none is named, and one per preshape if `EACH` is named.
    table = table.refuse(misfits(table, model.name, model.scale, X_TO)).of_object(model.name)
    hand = load_hand(config.hand_source)
    tried = [
        (i, k, shape)
        for i in range(len(table))
        for k in table.resting_of(i, X_TO)
        for shape in table.shapes(i, hand)
    ]
    tried = tried[: config.candidates.max]
    count, table = len(tried), table.at([i for i, _, _ in tried])
    table = replace(table, preshape=tuple(shape for _, _, shape in tried))
    resting = np.array([k for _, k, _ in tried], dtype=np.int64)
    X_OG = [table.posture(i, X_TO[k], model.X_OM).X_OG for i, k in enumerate(resting)]

    return Candidates(
        X_OG=np.array(X_OG).reshape(-1, 4, 4),
        distance=np.full(count, np.nan),
        resting=resting,
        source=np.full(count, Source.POSTURES, dtype=np.int64),
        spread=np.full(count, np.nan),
        preshape_index=np.full(count, -1),
        postures=Table({name: getattr(table, name) for name in _IN_PLAN}),
    )


def _posture(rows: GraspTable | Table, i: int, X_OG: Array) -> Posture:
    """Return the posture of a row; NaN means that it lacks a stage."""
    grasp, before, after = (
        None if np.isnan(q).any() else q
        for q in (rows.q_grasp[i], rows.q_pregrasp[i], rows.q_squeeze[i])
    )
    return Posture(X_OG, grasp, before, after, str(rows.preshape[i]) or None)


def posture_attempts(
    candidates: Candidates, indices: range, hand: Hand, *, name: str, seed: int
) -> Iterator[Attempt]:
    """Yield the attempts of a range of an object's postures; each is one row of the dataset.

    Args:
        candidates: Candidates of the object, with postures.
        indices: The range.
        hand: The hand.
        name: The object's name.
        seed: Seed of the dataset.
    """
    given = candidates.postures
    assert given is not None

    for i in indices:
        yield replace(
            start_of(_posture(given, i, candidates.X_OG[i]), hand),
            candidate=i,
            seed=Stream(seed, object_key(name), i).key,
            resting=int(candidates.resting[i]),
            source=Source.POSTURES,
            posture_row=float(given.row[i]),
        )
