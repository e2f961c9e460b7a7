"""What assembling learns of an object's shards before it writes a row.

In: the work units of an object. Out: how many rows each shard gives, a hash of the seals, and of
each success what the filters need. A task surveys one object, and verifies the seals of its shards.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drakegrasp.config import CameraConfig
from drakegrasp.dataset.hdf5 import read_column
from drakegrasp.dataset.manifest import Manifest
from drakegrasp.dataset.quality import COLUMNS, suspicion
from drakegrasp.dataset.schema import CAMERAS, CERTIFICATE_FIELDS, sizes, sources_of, with_derived
from drakegrasp.dataset.shards import ShardHeader, open_shard, read_trials
from drakegrasp.filters import NEEDED
from drakegrasp.frames import Array, invert_pose, transform_points, unpack_pose
from drakegrasp.grasp import pack_grasp, transform_grasp, unpack_grasp, unused_fingers
from drakegrasp.outcomes import Outcome
from drakegrasp.runtime.executor import Executor, run_here
from drakegrasp.runtime.files import read_seal
from drakegrasp.table import AnyArray, Table, join
from drakegrasp.vision.camera import intrinsics, project


@dataclass(frozen=True, kw_only=True, eq=False)
class SurveyTask:
    """An object whose shards are to be surveyed.

    Attributes:
        out: Directory of the dataset.
        object: Row of the object in /objects.
        headers: Its work units, in the order of their candidates.
        wanted: Number of grasps after which its rows end; None for all rows.
        camera: That sees the grasps.
    """

    out: str
    object: int
    headers: tuple[ShardHeader, ...]
    wanted: int | None
    camera: CameraConfig


@dataclass(frozen=True, kw_only=True, eq=False)
class Survey:
    """What the shards of an object hold.

    Attributes:
        object: Row of the object in /objects.
        rows: Number of rows that the dataset takes of each shard, from the first; a shard behind
            the last wanted grasp is not in it.
        seals: Hash of the seals of these shards.
        successes: Those in the rows, with the columns of `successes_of`; `trial_id` counts from the
            object's first row.
        sizes: Lengths of the letters in the shapes of `schema`.
    """

    object: int
    rows: tuple[int, ...]
    seals: bytes
    successes: Table
    sizes: Mapping[str, int]


def survey_tasks(out: Path, manifest: Manifest) -> Iterator[SurveyTask]:
    """Yield the task of each object that has a palm pose."""
    config = manifest.config
    for i, headers in enumerate(headers_by_object(manifest)):
        if headers:
            yield SurveyTask(
                out=str(out),
                object=i,
                headers=headers,
                wanted=config.max_grasps,
                camera=config.camera,
            )


def headers_by_object(manifest: Manifest) -> list[tuple[ShardHeader, ...]]:
    """Return the work units of each object."""
    by_name: dict[str, list[ShardHeader]] = {entry.name: [] for entry in manifest.objects}
    for header in manifest.headers():
        by_name[header.object_name].append(header)
    return [tuple(headers) for headers in by_name.values()]


def survey_object(task: SurveyTask) -> Survey:
    """Survey the shards of an object.

    Raises:
        DataError: If one of them is missing or damaged.
    """
    out, first, left = Path(task.out), 0, task.wanted
    rows, parts, digest = list[int](), list[Table](), hashlib.sha256()
    letters: Mapping[str, int] = {}
    for header in task.headers:
        if left == 0:
            break
        with open_shard(header.path(out), header) as (file, _):
            # The rows end with the last wanted grasp. So a dataset does not depend on how many
            # more attempts the workers had begun when enough grasps were there.
            outcome = read_column(file["trials"], "outcome")
            hits = np.flatnonzero(outcome == Outcome.SUCCESS)[:left]
            left = None if left is None else left - len(hits)
            count = int(hits[-1]) + 1 if left == 0 else len(outcome)

            found = {n: read_column(file["trials"], n)[hits] for n in TRIAL_COLUMNS}
            found |= {n: read_column(file["looks"], n)[: len(hits)] for n in LOOK_COLUMNS}
            images = file["looks/image_otm"]
            found["depth_otm"] = images[: len(hits), 3] if len(hits) else np.zeros((0, 1, 1))
            successes = successes_of(Table(found), task.camera, object=task.object)
            parts.append(successes.with_columns(trial_id=first + hits))
            letters = letters or sizes(
                fingers=found["closed_touching"].shape[1],
                joints=file["trials/closed_q"].shape[1],
                image=images.shape[-1],
            )
        digest.update(read_seal(header.path(out)))
        rows.append(count)
        first += count
    return Survey(
        object=task.object,
        rows=tuple(rows),
        seals=digest.digest(),
        successes=join(parts),
        sizes=letters,
    )


def shards_sha256(out: Path, manifest: Manifest, execute: Executor = run_here) -> str:
    """Return a hash of the seals of all shards that the files are made from, hexadecimal.

    Args:
        out: Directory of the dataset.
        manifest: Of the dataset.
        execute: Reads the seals, a task for each object.

    Raises:
        DataError: If a shard is missing.
    """
    digests = dict(execute(_read_seals, survey_tasks(out, manifest)))
    return join_seals(digests)


def join_seals(digests: Mapping[int, bytes]) -> str:
    """Return the hash of the hashes of all objects' seals, by their rows of /objects."""
    return hashlib.sha256(b"".join(digests[i] for i in sorted(digests))).hexdigest()


def _read_seals(task: SurveyTask) -> tuple[int, bytes]:
    """Return the row of an object, and what `Survey.seals` is; seals are not verified."""
    out, left, digest = Path(task.out), task.wanted, hashlib.sha256()
    for header in task.headers:
        if left is not None and left <= 0:
            break
        digest.update(read_seal(header.path(out)))
        if left is not None:
            rows = read_trials(header.path(out), header, ("outcome",), verify_seal=False)
            left -= int(np.count_nonzero(rows["outcome"] == Outcome.SUCCESS))
    return task.object, digest.digest()


def _fingers(t: Table, camera: CameraConfig | None = None) -> tuple[AnyArray, ...]:
    """Return which fingers the preshape leaves out, and whether all others touch both times."""
    unused = unused_fingers(t["unused"], t["closed_touching"].shape[1])
    return unused, np.all(t["closed_touching"] & t["lifted_touching"] | unused, axis=1)


def _grasp_T(t: Table) -> Array:
    """Return the grasps (n, 6k) in {T}."""
    rows = zip(unpack_pose(t["X_TO"]), t["closed_p_OQ"], t["closed_nhat_Q_O"], strict=True)
    grasps = [transform_grasp(X_TO, pack_grasp(p, n)) for X_TO, p, n in rows]
    return np.array(grasps).reshape(-1, 6 * t["closed_touching"].shape[1])


def _held_O(t: Table) -> Array:
    """Return the contacts (n, 6k) at the end of the lift in {O}."""
    parts = [t[f"lifted_{name}"] for name in ("p_OQ", "nhat_Q_O")]
    return np.concatenate(parts, axis=1).reshape(t.count, 6 * parts[0].shape[1])


def _all_in_view(t: Table, camera: CameraConfig) -> AnyArray:
    """Return whether both cameras see all contacts of each grasp."""
    unused, _ = _fingers(t)
    K, poses = intrinsics(camera), [t[f"X_TC_{name}"] for name in CAMERAS]
    rows = zip(_grasp_T(t), unused, *poses, strict=True)
    seen = [
        all(_in_view(K, camera.size, X_TC, grasp, lacking) for X_TC in X_TCs)
        for grasp, lacking, *X_TCs in rows
    ]
    return np.array(seen, dtype=bool)


def _in_view(K: Array, size: int, X_TC: Array, grasp_T: Array, unused: AnyArray) -> bool:
    """Return whether all contacts of a grasp are before a camera and within its image."""
    p_TQ, _ = unpack_grasp(grasp_T)
    p_CQ = transform_points(invert_pose(unpack_pose(X_TC)), p_TQ[~unused])
    uv = project(K, p_CQ)
    return bool(np.all(p_CQ[:, 2] > 0.0) and np.all(uv >= 0.0) and np.all(uv <= size - 1))


def _largest(t: Table, name: str) -> AnyArray:
    """Return the largest value (n,) of the fingers that are used."""
    unused, _ = _fingers(t)
    largest: AnyArray = np.where(unused, 0.0, t[name]).max(axis=1, initial=0.0)
    return largest


def _doubts(t: Table, camera: CameraConfig) -> tuple[AnyArray, ...]:
    """Return the suspicion score and parts of it, (n,) each."""
    doubts = suspicion(t)
    parts = "penetration", "imbalance", "normal_sum"
    return doubts.score, *(doubts.values[name] for name in parts)


_TOUCHING = ("unused", "closed_touching", "lifted_touching")
_IN_T = ("X_TO", "closed_p_OQ", "closed_nhat_Q_O", "closed_touching")
_MASKS, _CAMERAS = (tuple(f"{name}_{c}" for c in CAMERAS) for name in ("mask", "X_TC"))
#: Columns of successes that follow from those of the files: names, what they need of `/trials` and
#: `/looks`, and what gives the columns, given these and the camera.
_DERIVED: tuple[tuple[tuple[str, ...], tuple[str, ...], Callable[[Table, CameraConfig], Any]], ...]
_DERIVED = (
    # (n, k) bool, the fingers that the preshape leaves out; and whether all others touch, after
    # closing and after the lift.
    (("unused", "complete"), _TOUCHING, _fingers),
    (("grasp_T",), _IN_T, lambda t, camera: [_grasp_T(t)]),
    (("held_O",), ("lifted_p_OQ", "lifted_nhat_Q_O"), lambda t, camera: [_held_O(t)]),
    (("other_links",), ("lifted_other_links",), lambda t, camera: [t["lifted_other_links"]]),
    # Whether both masks have object pixels.
    (
        ("seen",),
        _MASKS,
        lambda t, camera: [
            np.all([t[f"mask_{name}"].any(axis=(1, 2)) for name in CAMERAS], axis=0)
        ],
    ),
    (("in_view",), (*_IN_T, *_TOUCHING, *_CAMERAS), lambda t, c: [_all_in_view(t, c)]),
    # [m] above the table; both cameras are at the same point.
    (("camera_height",), ("X_TC_otm",), lambda t, c: [unpack_pose(t["X_TC_otm"])[:, 2, 3]]),
    # [m^2], of the otm depth image.
    (
        ("depth_variance",),
        ("depth_otm",),
        lambda t, camera: [t["depth_otm"].astype(float).var(axis=(1, 2))],
    ),
    # The largest of the contacts [m], [rad].
    *(
        ((name,), (*_TOUCHING, name), lambda t, c, name=name: [_largest(t, name)])
        for name in ("surface_distance", "normal_angle")
    ),
    (("suspicion", "penetration", "imbalance", "normal_sum"), COLUMNS, _doubts),
    (("X_OG",), ("X_OG",), lambda t, camera: [unpack_pose(t["X_OG"])]),
)
#: Columns of successes as the files hold them: which attempt each one is, what rules need, and what
#: is copied to /successes.
_COPIED = tuple(
    dict.fromkeys(
        name
        for name in ("candidate", "standoff_index", "child", "resting", "slip", "turn", *NEEDED)
        if not any(name in names for names, *_ in _DERIVED)
    )
)
#: Columns of `/looks`, besides the depths of the otm image.
LOOK_COLUMNS = (
    *_MASKS,
    *_CAMERAS,
    *(field.name for field in CERTIFICATE_FIELDS),
)
#: Columns of `/trials` from which those of successes follow.
TRIAL_COLUMNS = sources_of(
    name
    for name in (*_COPIED, *(name for _, needs, _ in _DERIVED for name in needs))
    if name not in (*LOOK_COLUMNS, "depth_otm")
)


def successes_of(rows: Table, camera: CameraConfig, *, object: int = 0) -> Table:
    """Return what filters and splits look at, of n successes; their `trial_id` counts from 0.

    Columns whose sources are not there, as the images of a trial that nobody rendered, are left
    out: the rules that need them say nothing.

    Args:
        rows: Columns of their rows of `/trials` and `/looks`, by their names there; `depth_otm`
            (n, S, S) are their otm depth images [m].
        camera: That sees the grasps.
        object: Row of their object in /objects.
    """
    found: dict[str, AnyArray] = {
        "trial_id": np.arange(rows.count, dtype=np.int64),
        "object": np.full(rows.count, object, dtype=np.int32),
    }
    rows = Table(with_derived(rows))
    certificates = (field.name for field in CERTIFICATE_FIELDS)
    found |= rows.only(*_COPIED, *certificates)
    for names, needs, derive in _DERIVED:
        if rows.has(*needs):
            found |= zip(names, derive(rows, camera), strict=True)
    return Table(found)
