"""Many postures of several objects, as a file gives them, and the palm poses of a build from them.

In: rows of a file, checked, with their joints in the plant's order. Out: a `PostureTable`, which
is plain data and can be sent to another process; of an object its `Candidates`; and the `Attempt`
of each.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import multiply
from drakegrasp.config import Config
from drakegrasp.errors import GraspError, listed
from drakegrasp.frames import X_WT, Array, invert_pose
from drakegrasp.hand.description import Hand
from drakegrasp.objects.model import ObjectModel
from drakegrasp.seeding import Stream, object_key
from drakegrasp.simulation.candidates import (
    Attempt,
    Candidates,
    GivenPostures,
    Source,
    is_audited,
)
from drakegrasp.simulation.postures.posture import Posture, exact_pose, preshape_index, start_of

#: Frames of a table: those of a posture, and {M}, the axes and the origin of the mesh file.
TableFrame = Literal["object", "table", "camera", "world", "mesh"]
TABLE_FRAMES: tuple[str, ...] = get_args(TableFrame)


@dataclass(frozen=True, kw_only=True, eq=False)
class PostureTable:
    """n postures of hands with j joints, in the plant's order.

    Attributes:
        objects: (n,), name of the object of each.
        resting: (n,), index of its resting pose.
        X_FG: (n, 4, 4), pose of the palm in the frame.
        q_grasp: (n, j), joint positions of the grasp [rad or m].
        q_pregrasp, q_squeeze: (n, j); a row of NaN: not given.
        frame: One of `TABLE_FRAMES`.
        X_TC: (n, 4, 4), pose of the camera in {T}, for the frame "camera".
        scale: (n,), metres per unit of length of the mesh file that the posture is for; NaN: any.
        log_density: (n,), logarithm of the density of the draw; NaN: not known.
        said: (n,), where it comes from, in words.
        preshape: (n,), name of the hand's preshape; empty: all fingers close.
        row: (n,), row in the file.
    """

    objects: tuple[str, ...]
    resting: npt.NDArray[np.int64]
    X_FG: Array
    q_grasp: Array
    q_pregrasp: Array
    q_squeeze: Array
    frame: str = "object"
    X_TC: Array | None = None
    scale: Array
    log_density: Array
    said: tuple[str, ...]
    preshape: tuple[str, ...]
    row: npt.NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.objects)

    def of_object(self, name: str) -> PostureTable:
        """Return the rows of an object, in their order."""
        rows = [i for i, each in enumerate(self.objects) if each == name]
        chosen: dict[str, Any] = {
            f.name: tuple(value[i] for i in rows) if isinstance(value, tuple) else value[rows]
            for f in fields(self)
            if (value := getattr(self, f.name)) is not None and f.name != "frame"
        }
        return replace(self, **chosen)

    def digest(self) -> str:
        """Return a hash (16 hex digits) of all that the table says."""
        digest = hashlib.sha256()
        for f in fields(self):
            value = getattr(self, f.name)
            if f.name == "preshape" and not any(value):
                continue  # of a table as it was before there were preshapes
            is_array = isinstance(value, np.ndarray)
            digest.update(value.tobytes() if is_array else json.dumps(value).encode())
        return digest.hexdigest()[:16]


def make_table(
    hand: Hand,
    objects: Sequence[str],
    X_FG: npt.ArrayLike,
    q_grasp: npt.ArrayLike,
    *,
    q_pregrasp: npt.ArrayLike | None = None,
    q_squeeze: npt.ArrayLike | None = None,
    resting: npt.ArrayLike | None = None,
    frame: str = "object",
    X_TC: npt.ArrayLike | None = None,
    scale: npt.ArrayLike | None = None,
    log_density: npt.ArrayLike | None = None,
    said: Sequence[str] | None = None,
    preshape: Sequence[str] | None = None,
) -> PostureTable:
    """Return a table of postures, after checking every row.

    Args:
        hand: The hand.
        objects: (n,), names of the objects.
        X_FG: (n, 4, 4), poses of the palm in the frame.
        q_grasp: (n, j), in the plant's order.
        q_pregrasp: (n, j); rows of NaN are not given.
        q_squeeze: (n, j); rows of NaN are not given.
        resting: (n,), index of the object's resting pose; 0 if None.
        frame: One of `TABLE_FRAMES`.
        X_TC: (n, 4, 4), with the frame "camera".
        scale: (n,), metres per unit of length of the mesh file.
        log_density: (n,), of the draws.
        said: (n,), where each comes from.
        preshape: (n,), names of the hand's preshapes; empty: all fingers close.

    Raises:
        GraspError: If there is no row, the arrays differ in length, or a row is no posture; the
            message names the first.
    """
    count, joints = len(objects), len(hand.joint_names)
    if not count:
        raise GraspError("postures must be at least one row, got none")
    if frame not in TABLE_FRAMES:
        raise GraspError(f"frame must be one of {', '.join(TABLE_FRAMES)}, got {frame!r}")
    if (X_TC is None) == (frame == "camera"):
        raise GraspError("X_TC must be given with the frame camera, and only then")

    # Numbers that every row must have, and those that a row may lack.
    where = np.zeros(count) if resting is None else _numbers(resting, (count,), "resting")
    if not np.array_equal(where, where.astype(np.int64)) or (where < 0).any():
        raise GraspError("resting must be indices of resting poses, got other numbers")
    pregrasp, squeeze = (
        _numbers(q, (count, joints), name, some=True)
        for name, q in (("q_pregrasp", q_pregrasp), ("q_squeeze", q_squeeze))
    )
    return PostureTable(
        objects=tuple(objects),
        resting=where.astype(np.int64),
        X_FG=_poses(X_FG, count, "the palm's pose"),
        q_grasp=_numbers(q_grasp, (count, joints), "q_grasp"),
        q_pregrasp=pregrasp,
        q_squeeze=squeeze,
        frame=frame,
        X_TC=None if X_TC is None else _poses(X_TC, count, "X_TC"),
        scale=_numbers(scale, (count,), "scale", some=True),
        log_density=_numbers(log_density, (count,), "log_density", some=True),
        said=("",) * count if said is None else tuple(said),
        preshape=("",) * count if preshape is None else known_preshapes(preshape, count, hand),
        row=np.arange(count, dtype=np.int64),
    )


def _numbers(
    value: npt.ArrayLike | None, shape: tuple[int, ...], name: str, *, some: bool = False
) -> Array:
    """Return an array of a shape; one row of it is all finite, or all NaN where `some`."""
    if value is None:
        return np.full(shape, np.nan)
    try:
        array = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        raise GraspError(f"{name} must be numbers of shape {shape}, got something else") from None
    if array.shape != shape:
        raise GraspError(f"{name} must be of shape {shape}, got {array.shape}")
    rows = array.reshape(len(array), -1)
    bad = ~np.isfinite(rows).all(axis=1) & ~(some & np.isnan(rows).all(axis=1))
    if bad.any():
        raise GraspError(f"row {int(np.argmax(bad))}: {name} must be finite numbers, got others")
    return np.ascontiguousarray(array)


def known_preshapes(names: Sequence[str | None], count: int, hand: Hand) -> tuple[str, ...]:
    """Return the names of the preshapes of a number of rows, empty where there is none.

    Raises:
        GraspError: If they are of another number of rows, or the hand lacks one of them.
    """
    if len(names) != count:
        raise GraspError(f"preshape must be of {count} rows, got {len(names)}")
    for i, name in enumerate(names):
        try:
            preshape_index(hand, name or None)
        except GraspError as error:
            raise GraspError(f"row {i}: {error}") from None
    return tuple(name or "" for name in names)


def _poses(value: npt.ArrayLike, count: int, name: str) -> Array:
    array = _numbers(value, (count, 4, 4), name)
    return np.array([exact_pose(X, f"row {i}: {name}") for i, X in enumerate(array)])


def refuse_unknown_objects(table: PostureTable, names: Sequence[str]) -> None:
    """Refuse postures of objects that are not there.

    Raises:
        GraspError: If there is one; the message names the first row.
    """
    known = set(names)
    for i, name in enumerate(table.objects):
        if name not in known:
            raise GraspError(
                f"postures, row {i}: object must be one of {listed(list(names))}, got {name!r}"
            )


def given_candidates(
    model: ObjectModel, X_TO: Array, table: PostureTable, X_OM: Array, config: Config
) -> Candidates:
    """Return the postures of an object as its palm poses, up to `candidates.max` of them.

    Args:
        model: The object.
        X_TO: Its resting poses, (r, 4, 4).
        table: Its rows.
        X_OM: Pose of its mesh file's frame in {O}, (4, 4).
        config: All the rules.

    Raises:
        GraspError: If a row is for a resting pose or a scale that the object does not have.
    """
    # Each row must be of a pose and a scale that the object has.
    count = min(len(table), config.candidates.max)
    for i in range(count):
        place = f"postures, row {table.row[i]} ({model.name})"
        if table.resting[i] >= len(X_TO):
            must = f"0 to {len(X_TO) - 1}" if len(X_TO) > 1 else "0, the only one"
            raise GraspError(
                f"{place}: resting pose must be {must} (objects.resting_poses drops more), "
                f"got {table.resting[i]}"
            )
        if np.isfinite(table.scale[i]) and not np.isclose(table.scale[i], model.scale, rtol=1e-3):
            raise GraspError(
                f"{place}: scale must be that of the object, {model.scale:g} (objects.yaml states "
                f"it), got {table.scale[i]:g}"
            )

    # All palm poses in {O}.
    frames = [_frame_in_object(table, i, X_TO[table.resting[i]], X_OM) for i in range(count)]
    poses = [multiply(X_OF, X) for X_OF, X in zip(frames, table.X_FG, strict=False)]
    return Candidates(
        X_OG=np.array(poses).reshape(-1, 4, 4),
        distance=np.full(count, np.nan),
        resting=table.resting[:count],
        source=np.full(count, Source.POSTURES, dtype=np.int64),
        log_density=table.log_density[:count],
        combinations=count,
        valid=count,
        distinct=count,
        postures=GivenPostures(
            q_grasp=table.q_grasp[:count],
            q_pregrasp=table.q_pregrasp[:count],
            q_squeeze=table.q_squeeze[:count],
            row=table.row[:count],
            said=table.said[:count],
            preshape=table.preshape[:count],
        ),
    )


def _frame_in_object(table: PostureTable, i: int, X_TO: Array, X_OM: Array) -> Array:
    """Return the pose (4, 4) of the frame of a row in {O}."""
    if table.frame == "object":
        return np.eye(4)
    if table.frame == "mesh":
        return X_OM
    X_OT = invert_pose(X_TO)
    if table.frame == "table":
        return X_OT
    return multiply(X_OT, invert_pose(X_WT) if table.X_TC is None else table.X_TC[i])


def posture_attempts(
    candidates: Candidates, indices: range, hand: Hand, *, name: str, seed: int
) -> Iterator[Attempt]:
    """Yield the attempts of a range of an object's postures; each is one row of the dataset.

    Args:
        candidates: Of the object, with postures.
        indices: The range.
        hand: The hand.
        name: The object's name.
        seed: Of the dataset.
    """
    given = candidates.postures
    assert given is not None

    # A stage that a row lacks is NaN in the plan.
    for i in indices:
        posture = Posture(
            candidates.X_OG[i],
            given.q_grasp[i],
            None if np.isnan(given.q_pregrasp[i]).any() else given.q_pregrasp[i],
            None if np.isnan(given.q_squeeze[i]).any() else given.q_squeeze[i],
            given.preshape[i] or None,
        )
        start = start_of(posture, hand)
        yield Attempt(
            candidate=i,
            standoff_index=0,
            standoff=np.nan,
            spread=start.spread,
            closing=start.closing,
            path=start.path,
            preshape=start.preshape,
            unused=start.unused,
            X_OG=posture.X_OG,
            seed=Stream(seed, object_key(name), i).key,
            resting=int(candidates.resting[i]),
            source=Source.POSTURES,
            log_density=float(candidates.log_density[i]),
            posture_row=float(given.row[i]),
            audited=is_audited(seed, object_key(name), i, 0, 0),
        )
