"""What assembling learns of an object's shards before it writes a row.

In: the work units of an object. Out: how many rows each shard gives, a hash of the seals, and of
each success what the filters need. A task surveys one object, and verifies the seals of its shards.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from drakegrasp.config import Config
from drakegrasp.dataset.filters import Successes, judge_successes
from drakegrasp.dataset.hdf5 import AnyArray, read_column
from drakegrasp.dataset.manifest import Manifest
from drakegrasp.dataset.schema import CAMERAS, CERTIFICATE_FIELDS, sizes
from drakegrasp.dataset.shards import ShardHeader, open_shard, read_trials
from drakegrasp.dataset.suspicion import COLUMNS, suspicion
from drakegrasp.frames import Array, invert_pose, transform_points, unpack_pose
from drakegrasp.grasp import pack_grasp, transform_grasp, unpack_grasp, unused_fingers
from drakegrasp.outcomes import Outcome, Removal
from drakegrasp.runtime.executor import Executor, run_here
from drakegrasp.runtime.files import read_seal
from drakegrasp.vision.camera import intrinsics, project

#: Columns of `/trials` from which the filters' numbers follow.
SURVEYED = (
    *COLUMNS,
    *("candidate", "standoff_index", "child", "resting", "X_TO", "X_OG", "closed_p_OQ"),
    *("lifted_p_OQ", "lifted_nhat_Q_O", "lifted_touching", "unused"),
)
#: Columns of `/looks`, besides the depths of the otm image.
_LOOKS = (
    *(f"{name}_{camera}" for name in ("mask", "X_TC") for camera in CAMERAS),
    *(field.name for field in CERTIFICATE_FIELDS),
)


@dataclass(frozen=True, kw_only=True, eq=False)
class SurveyTask:
    """An object whose shards are to be surveyed.

    Attributes:
        out: Directory of the dataset.
        object: Row of the object in /objects.
        headers: Its work units, in the order of their candidates.
        wanted: Number of grasps after which its rows end; None for all rows.
        K: Camera matrix (3, 3) [px].
    """

    out: str
    object: int
    headers: tuple[ShardHeader, ...]
    wanted: int | None
    K: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class Survey:
    """What the shards of an object hold.

    Attributes:
        object: Row of the object in /objects.
        rows: Number of rows that the dataset takes of each shard, from the first; a shard behind
            the last wanted grasp is not in it.
        seals: Hash of the seals of these shards.
        successes: Those in the rows; `trial_id` counts from the object's first row.
        sizes: Lengths of the letters in the shapes of `schema`.
    """

    object: int
    rows: tuple[int, ...]
    seals: bytes
    successes: Successes
    sizes: Mapping[str, int]


def survey_tasks(out: Path, manifest: Manifest) -> Iterator[SurveyTask]:
    """Yield the task of each object that has a palm pose."""
    K = intrinsics(manifest.config.camera)
    for i, headers in enumerate(headers_by_object(manifest)):
        if headers:
            yield SurveyTask(
                out=str(out), object=i, headers=headers, wanted=manifest.config.max_grasps, K=K
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
    rows, parts, digest = list[int](), list[Successes](), hashlib.sha256()
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

            trials = {name: read_column(file["trials"], name)[hits] for name in SURVEYED}
            looks = {name: read_column(file["looks"], name)[: len(hits)] for name in _LOOKS}
            images = file["looks/image_otm"]
            depths = images[: len(hits), 3] if len(hits) else np.zeros((0, 1, 1))
            successes = successes_of(trials, looks, depths, object=task.object, K=task.K)
            parts.append(replace(successes, trial_id=first + hits))
            letters = letters or sizes(
                fingers=trials["closed_touching"].shape[1],
                joints=file["trials/closed_q"].shape[1],
                image=looks["mask_oto"].shape[1],
            )
        digest.update(read_seal(header.path(out)))
        rows.append(count)
        first += count
    return Survey(
        object=task.object,
        rows=tuple(rows),
        seals=digest.digest(),
        successes=join_successes(parts),
        sizes=letters,
    )


def count_samples(out: Path, header: ShardHeader, config: Config) -> int:
    """Return how many successes of a shard pass the filters, but for that of outliers.

    Raises:
        DataError: If the shard is missing or damaged.
    """
    K, filters = intrinsics(config.camera), config.filters.model_copy(update={"outlier_sigma": 0.0})
    task = SurveyTask(out=str(out), object=0, headers=(header,), wanted=None, K=K)
    removal = judge_successes(survey_object(task).successes, filters)
    return int(np.count_nonzero(removal == Removal.KEPT))


def join_successes(parts: Sequence[Successes]) -> Successes:
    """Return the successes of several surveys as one."""
    names = [f.name for f in dataclasses.fields(Successes)]
    return Successes(**{n: np.concatenate([getattr(part, n) for part in parts]) for n in names})


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


def successes_of(
    trials: Mapping[str, AnyArray],
    looks: Mapping[str, AnyArray],
    depths: AnyArray,
    *,
    object: int,
    K: Array,
) -> Successes:
    """Return what the filters need of n successes; their `trial_id` counts from 0.

    Args:
        trials: Their rows of `/trials`, by the names of `SURVEYED` and more.
        looks: Their rows of `/looks`, without the images.
        depths: (n, S, S), their otm depth images [m].
        object: Row of their object in /objects.
        K: Camera matrix (3, 3) [px].
    """
    # The grasps in {T}, and whether both cameras see all their contacts.
    X_TO = unpack_pose(trials["X_TO"])
    grasps = [
        transform_grasp(X, pack_grasp(p, n))
        for X, p, n in zip(X_TO, trials["closed_p_OQ"], trials["closed_nhat_Q_O"], strict=True)
    ]
    fingers = trials["closed_touching"].shape[1]
    length, unused = 6 * fingers, unused_fingers(trials["unused"], fingers)
    in_view = [
        all(
            _in_view(K, looks[f"mask_{c}"][i], looks[f"X_TC_{c}"][i], grasp, unused[i])
            for c in CAMERAS
        )
        for i, grasp in enumerate(grasps)
    ]

    doubts = suspicion(trials)
    return Successes(
        candidate=trials["candidate"],
        standoff_index=trials["standoff_index"],
        child=trials["child"],
        resting=trials["resting"],
        X_OG=unpack_pose(trials["X_OG"]),
        trial_id=np.arange(len(X_TO), dtype=np.int64),
        object=np.full(len(X_TO), object, dtype=np.int32),
        grasp_T=np.array(grasps).reshape(-1, length),
        held_O=np.concatenate(
            [
                trials[f"lifted_{name}"].reshape(len(X_TO), length // 2)
                for name in ("p_OQ", "nhat_Q_O")
            ],
            axis=1,
        ),
        complete=np.all(trials["closed_touching"] & trials["lifted_touching"] | unused, axis=1),
        unused=unused,
        other_links=trials["lifted_other_links"],
        slip=trials["slip"],
        turn=trials["turn"],
        seen=np.all([looks[f"mask_{c}"].any(axis=(1, 2)) for c in CAMERAS], axis=0),
        in_view=np.array(in_view, dtype=bool),
        # Both cameras are at the same point.
        camera_height=unpack_pose(looks["X_TC_otm"])[:, 2, 3],
        depth_variance=depths.astype(float).var(axis=(1, 2)),
        surface_distance=_largest(trials["surface_distance"], unused),
        normal_angle=_largest(trials["normal_angle"], unused),
        suspicion=doubts.score,
        **{name: doubts.values[name] for name in ("penetration", "imbalance", "normal_sum")},
        **{field.name: looks[field.name] for field in CERTIFICATE_FIELDS},
    )


def _largest(values: Array, unused: AnyArray) -> Array:
    """Return the largest value (n,) of the fingers (n, k) that are used."""
    return np.asarray(np.where(unused, 0.0, values).max(axis=1, initial=0.0))


def _in_view(K: Array, mask: AnyArray, X_TC: Array, grasp_T: Array, unused: AnyArray) -> bool:
    """Return whether all contacts of a grasp are before a camera and within its image."""
    p_TQ, _ = unpack_grasp(grasp_T)
    p_CQ = transform_points(invert_pose(unpack_pose(X_TC)), p_TQ[~unused])
    uv = project(K, p_CQ)
    return bool(np.all(p_CQ[:, 2] > 0.0) and np.all(uv >= 0.0) and np.all(uv <= len(mask) - 1))
