"""What assembling reads from the shards before it writes a row, and what it decides.

A task surveys the shards of one object: it verifies their seals, counts the rows of each, and
collects for each success the values that the filters need. From the surveys of all objects follows
which successes are samples (by the rules of `filters`, user-defined filters, outliers and
rejections), and in which split each sample is. `assembly.pack` packs the rows accordingly, and
`assemble` writes them.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from drakegrasp import registry
from drakegrasp.config import CameraConfig, Config, FilterConfig, is_own_class
from drakegrasp.dataset.assembly.split import Home, find_homes, split_samples
from drakegrasp.dataset.hdf5 import AnyArray, read_column
from drakegrasp.dataset.manifest import Manifest, origin_attributes
from drakegrasp.dataset.quality import COLUMNS, suspicion
from drakegrasp.dataset.rejections import AttemptKey
from drakegrasp.dataset.schema import (
    CAMERAS,
    OBJECT_FIELDS,
    SUCCESS_FIELDS,
    sizes,
    sources_of,
    with_derived,
)
from drakegrasp.dataset.shards import (
    ShardHeader,
    open_shard,
    read_field,
    trial_columns,
)
from drakegrasp.errors import ConfigError, DataError, listed
from drakegrasp.filters import NEEDED, Flags, Removal, Rule, first_removal, is_outlier
from drakegrasp.frames import Array, invert_pose, transform_points, unpack_pose
from drakegrasp.grasp import pack_grasp, transform_grasp, unpack_grasp, unused_fingers
from drakegrasp.outcomes import Outcome
from drakegrasp.registry import own_class, run_own
from drakegrasp.runtime.executor import Executor, run_here
from drakegrasp.runtime.files import read_seal
from drakegrasp.table import Table, join
from drakegrasp.vision.camera import intrinsics, project


@dataclass(frozen=True, kw_only=True, eq=False)
class SurveyTask:
    """An object whose shards are to be surveyed.

    Attributes:
        out: Directory of the dataset.
        object: Row of the object in /objects.
        headers: The object's work units, in the order of their candidates.
        tried: Number of palm poses after which the object's rows end; None for all rows.
        camera: Camera that sees the grasps.
    """

    out: str
    object: int
    headers: tuple[ShardHeader, ...]
    tried: int | None
    camera: CameraConfig


@dataclass(frozen=True, kw_only=True, eq=False)
class Survey:
    """Row counts and successes of the shards of an object.

    Attributes:
        object: Row of the object in /objects.
        rows: Number of rows that the dataset takes from each shard, counted from the first; shards
            after the last palm pose that the dataset takes are not listed.
        seals: Hash of the seals of these shards.
        successes: Successes in these rows, with the columns of `successes_of`; `trial_id` counts
            from the object's first row.
        sizes: Lengths of the letters in the shapes of `schema`.
    """

    object: int
    rows: tuple[int, ...]
    seals: bytes
    successes: Table
    sizes: Mapping[str, int]


def survey_tasks(out: Path, manifest: Manifest) -> Iterator[SurveyTask]:
    """Yield the task of each object that has a palm pose."""
    for i, headers in enumerate(headers_by_object(manifest)):
        if headers:
            yield SurveyTask(
                out=str(out),
                object=i,
                headers=headers,
                tried=manifest.objects[i].tried,
                camera=manifest.config.camera,
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
        DataError: If a shard is missing or damaged.
    """
    out, first = Path(task.out), 0
    rows, parts, digest = list[int](), list[Table](), hashlib.sha256()
    letters: Mapping[str, int] = {}
    for header in task.headers:
        with open_shard(header.path(out), header) as (file, _):
            # The rows end with the last palm pose that the dataset takes. So a dataset does not
            # depend on how many more attempts the workers had begun.
            palm = read_column(file["trials"], "candidate")
            count = len(palm) if task.tried is None else int(np.count_nonzero(palm < task.tried))
            outcome = read_column(file["trials"], "outcome")[:count]
            hits = np.flatnonzero(outcome == Outcome.SUCCESS)

            own = (f for f in trial_columns() if f.name in TRIAL_COLUMNS)
            found = {f.name: read_field(file["trials"], f)[hits] for f in own}
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
        manifest: Manifest of the dataset.
        execute: Executor that reads the seals, one task for each object.

    Raises:
        DataError: If a shard is missing.
    """
    digests = dict(execute(_read_seals, survey_tasks(out, manifest)))
    return join_seals(digests)


def join_seals(digests: Mapping[int, bytes]) -> str:
    """Return one hash for the seals of all objects.

    Args:
        digests: `Survey.seals` of each object, by its row of /objects.
    """
    return hashlib.sha256(b"".join(digests[i] for i in sorted(digests))).hexdigest()


def _read_seals(task: SurveyTask) -> tuple[int, bytes]:
    """Return the row of an object and its `Survey.seals`; the seals are not verified."""
    digest = hashlib.sha256()
    for header in task.headers:
        digest.update(read_seal(header.path(Path(task.out))))
    return task.object, digest.digest()


def _fingers(t: Table, camera: CameraConfig | None = None) -> tuple[AnyArray, ...]:
    """Return which fingers the preshape leaves out, and whether all others touch at both times."""
    unused = unused_fingers(t["unused"], t["closed_touching"].shape[1])
    return unused, np.all(t["closed_touching"] & t["lifted_touching"] | unused, axis=1)


def _grasp_T(t: Table) -> Array:
    """Return the grasps (n, 6k) in {T}."""
    rows = zip(unpack_pose(t["X_TO"]), t["closed_p_OQ"], t["closed_nhat_Q_O"], strict=True)
    grasps = [transform_grasp(X_TO, pack_grasp(p, n)) for X_TO, p, n in rows]
    return np.array(grasps).reshape(-1, 6 * t["closed_touching"].shape[1])


def _held_O(t: Table) -> Array:
    """Return the contacts (n, 6k) in {O} at the end of the lift."""
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
    """Return whether all contacts of a grasp are in front of a camera and within its image."""
    p_TQ, _ = unpack_grasp(grasp_T)
    p_CQ = transform_points(invert_pose(unpack_pose(X_TC)), p_TQ[~unused])
    uv = project(K, p_CQ)
    return bool(np.all(p_CQ[:, 2] > 0.0) and np.all(uv >= 0.0) and np.all(uv <= size - 1))


def _largest(t: Table, name: str) -> AnyArray:
    """Return the largest value (n,) among the used fingers."""
    unused, _ = _fingers(t)
    largest: AnyArray = np.where(unused, 0.0, t[name]).max(axis=1, initial=0.0)
    return largest


def _doubts(t: Table, camera: CameraConfig) -> tuple[AnyArray, ...]:
    """Return the suspicion score and three of its parts, (n,) each."""
    doubts = suspicion(t)
    parts = "penetration", "imbalance", "normal_sum"
    return doubts.score, *(doubts.values[name] for name in parts)


_TOUCHING = ("unused", "closed_touching", "lifted_touching")
_IN_T = ("X_TO", "closed_p_OQ", "closed_nhat_Q_O", "closed_touching")
_MASKS, _CAMERAS = (tuple(f"{name}_{c}" for c in CAMERAS) for name in ("mask", "X_TC"))
#: Columns of successes that are derived from columns of the files: their names, the columns of
#: `/trials` and `/looks` that they need, and the function that derives them from these and the
#: camera.
_DERIVED: tuple[tuple[tuple[str, ...], tuple[str, ...], Callable[[Table, CameraConfig], Any]], ...]
_DERIVED = (
    # (n, k) bool, the fingers that the preshape leaves out; and (n,) bool, whether all others touch
    # after closing and after the lift.
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
    # Height above the table [m]; both cameras are at the same point.
    (("camera_height",), ("X_TC_otm",), lambda t, c: [unpack_pose(t["X_TC_otm"])[:, 2, 3]]),
    # Variance of the otm depth image [m^2].
    (
        ("depth_variance",),
        ("depth_otm",),
        lambda t, camera: [t["depth_otm"].astype(float).var(axis=(1, 2))],
    ),
    # Largest value of the contacts [m], [rad].
    *(
        ((name,), (*_TOUCHING, name), lambda t, c, name=name: [_largest(t, name)])
        for name in ("surface_distance", "normal_angle")
    ),
    (("suspicion", "penetration", "imbalance", "normal_sum"), COLUMNS, _doubts),
    (("X_OG",), ("X_OG",), lambda t, camera: [unpack_pose(t["X_OG"])]),
)
#: Columns of successes that are copied from the files: the identity of the attempt, what the rules
#: need, and what is copied to /successes.
_COPIED = tuple(
    dict.fromkeys(
        name
        for name in ("candidate", "standoff_index", "resting", "slip", "turn", *NEEDED)
        if not any(name in names for names, *_ in _DERIVED)
    )
)
#: Columns of `/looks`, besides the depths of the otm image.
LOOK_COLUMNS = (*_MASKS, *_CAMERAS)
#: Columns of `/trials` from which the columns of successes follow.
TRIAL_COLUMNS = sources_of(
    name
    for name in (*_COPIED, *(name for _, needs, _ in _DERIVED for name in needs))
    if name not in (*LOOK_COLUMNS, "depth_otm")
)


def successes_of(rows: Table, camera: CameraConfig, *, object: int = 0) -> Table:
    """Return what filters and splits need of n successes; `trial_id` counts from 0.

    A column whose sources are missing, e.g. the images of a trial that was not rendered, is left
    out; rules that need it are then not applied.

    Args:
        rows: Columns of the successes' rows of `/trials` and `/looks`, by their names there;
            `depth_otm` (n, S, S) are their otm depth images [m].
        camera: Camera that sees the grasps.
        object: Row of the successes' object in /objects.
    """
    found: dict[str, AnyArray] = {
        "trial_id": np.arange(rows.count, dtype=np.int64),
        "object": np.full(rows.count, object, dtype=np.int32),
    }
    rows = Table(with_derived(rows))
    found |= rows.only(*_COPIED)
    for names, needs, derive in _DERIVED:
        if rows.has(*needs):
            found |= zip(names, derive(rows, camera), strict=True)
    return Table(found)


@dataclass(frozen=True, kw_only=True)
class ShardSlice:
    """The rows of a shard that the dataset takes, and their ids.

    Attributes:
        header: Header of the shard.
        object: Row of the shard's object in /objects.
        first: Id of the trial in the shard's first row.
        rows: Number of rows taken, from the first.
    """

    header: ShardHeader
    object: int
    first: int
    rows: int


@dataclass(frozen=True, kw_only=True, eq=False)
class Shards:
    """Rows and successes of all shards of a dataset.

    Attributes:
        slices: The rows that the dataset takes from each shard, in order.
        successes: All successes among these rows, with the ids of their trials.
        sizes: Lengths of the letters in the shapes of the fields.
        seals: Hash of the seals of the shards, hexadecimal.
    """

    slices: Sequence[ShardSlice]
    successes: Table
    sizes: Mapping[str, int]
    seals: str

    @property
    def count(self) -> int:
        """Number of rows of /trials."""
        return self.slices[-1].first + self.slices[-1].rows


@dataclass(frozen=True, kw_only=True, eq=False)
class Decisions:
    """What is decided about the n successes of a dataset.

    Attributes:
        manifest: Manifest of the dataset, in which each object that has samples has its split, if
            whole objects are split.
        shards: Rows and successes of the dataset's shards.
        removal: (n,) uint8, the `Removal` of each success.
        splits: Indices of the samples of each split among the successes, in rising order.
    """

    manifest: Manifest
    shards: Shards
    removal: AnyArray
    splits: Mapping[str, npt.NDArray[np.int64]]

    @cached_property
    def ids(self) -> dict[str, npt.NDArray[np.int64]]:
        """For each split the ids of the trials that are samples, in rising order."""
        return {
            split: self.shards.successes["trial_id"][rows] for split, rows in self.splits.items()
        }

    def columns(self) -> dict[str, AnyArray]:
        """Return the columns of /successes: why each success is, or is not, a sample."""
        own = self.shards.successes.only(*(f.name for f in SUCCESS_FIELDS))
        return {"removal": self.removal, **own}


def number_rows(surveys: Sequence[Survey], manifest: Manifest) -> Shards:
    """Return the rows of each shard, and all successes, from the surveys of a dataset's objects."""
    headers = headers_by_object(manifest)
    first, slices, parts = 0, list[ShardSlice](), []
    for survey in surveys:
        ids = survey.successes["trial_id"] + first
        parts.append(survey.successes.with_columns(trial_id=ids))
        for header, rows in zip(headers[survey.object], survey.rows, strict=True):
            slices.append(ShardSlice(header=header, object=survey.object, first=first, rows=rows))
            first += rows
    return Shards(
        slices=slices,
        successes=join(parts),
        sizes=surveys[0].sizes,
        seals=join_seals({survey.object: survey.seals for survey in surveys}),
    )


def keys_of(manifest: Manifest, successes: Table) -> dict[AttemptKey, int]:
    """Return the trial id of each success, by the identity of its attempt."""
    names = ("object", "candidate", "standoff_index", "trial_id")
    rows = zip(*(successes[name].tolist() for name in names), strict=True)
    return {AttemptKey(manifest.objects[i].name, *key): t for i, *key, t in rows}


def decide(manifest: Manifest, shards: Shards) -> Decisions:
    """Decide which successes are samples, and the split of each sample.

    Args:
        manifest: Manifest of the dataset, with filters, split and rejected attempts.
        shards: Rows and successes of the dataset's shards.
    """
    # Apply the filters.
    successes = shards.successes
    known = keys_of(manifest, successes)
    rejected = [known[key] for key in manifest.rejected if key in known]
    removal = judge_successes(successes, manifest.config.filters, rejected)

    # Split the samples.
    kept = np.flatnonzero(removal == Removal.KEPT)
    manifest = _with_homes(manifest, set(successes["object"][kept].tolist()))
    split = split_samples(
        successes["object"][kept],
        [entry.mesh_name for entry in manifest.objects],
        [entry.class_name for entry in manifest.objects],
        manifest.groups,
        known_homes(manifest),
        manifest.config.split,
        manifest.config.seed,
    )
    splits = {name: kept[rows] for name, rows in split.items()}
    return Decisions(manifest=manifest, shards=shards, removal=removal, splits=splits)


def known_homes(manifest: Manifest) -> dict[str, Home]:
    """Return the split of each group that was in one before; none if the split is by class.

    Raises:
        DataError: If objects of a group were in two splits.
    """
    homes, first = dict[str, Home](), dict[str, str]()
    if manifest.config.split.by == "class":
        return homes
    for group, entry in zip(manifest.groups, manifest.objects, strict=True):
        if entry.split is None:
            continue
        if homes.setdefault(group, entry.split) != entry.split:
            raise DataError(
                f"{first[group]} and {entry.name} must be in one split to be of one group "
                f"({group}), got them in {homes[group]} and {entry.split}"
            )
        first.setdefault(group, entry.name)
    return homes


def _with_homes(manifest: Manifest, present: Collection[int]) -> Manifest:
    """Return a manifest with the splits of its objects.

    Args:
        manifest: The manifest.
        present: Rows in /objects of the objects that have samples.
    """
    rules, groups = manifest.config.split, manifest.groups
    if rules.by == "class":
        return manifest
    known = known_homes(manifest)
    homes = {**known, **find_homes({groups[i] for i in present}, known, rules)}
    objects = tuple(
        replace(entry, split=homes.get(group))
        for group, entry in zip(groups, manifest.objects, strict=True)
    )
    return replace(manifest, objects=objects)


def object_columns(manifest: Manifest) -> dict[str, AnyArray]:
    """Return the columns of /objects."""
    columns = {}
    for field in OBJECT_FIELDS:
        own = [getattr(entry, field.name) for entry in manifest.objects]
        values = [np.nan if value is None else value for value in own]
        columns[field.name] = np.array(
            values, dtype=object if field.dtype == "str" else field.dtype
        )
    return columns


def file_attributes(manifest: Manifest, seals: str, camera: str = "") -> dict[str, Any]:
    """Return the attributes of a file.

    Args:
        manifest: Manifest of the dataset.
        seals: Hash of the seals of the shards, hexadecimal.
        camera: `oto` or `otm`; empty for the trials.
    """
    lens, own = manifest.config.camera, dict[str, Any]()
    if camera:
        own = {"camera": camera, "split_by": manifest.config.split.by}
    return {
        **origin_attributes(manifest.config, manifest.versions, manifest.fingers, manifest.joints),
        "K": intrinsics(lens),
        "near": lens.near,
        "far": lens.far,
        "signature": manifest.signature(),
        "shards": seals,
        **own,
    }


#: The setting that names user-defined filters.
_OWN = "filters.own"
#: A filter: returns which successes it keeps, (n,) of bool if it is correct.
_Keep: TypeAlias = Callable[[Table], Any]


def judge_successes(
    successes: Table,
    config: FilterConfig,
    rejected: Sequence[int] = (),
) -> npt.NDArray[np.uint8]:
    """Return the `Removal` (n,) of each success.

    Args:
        successes: The n successes, with the columns of `dataset.assembly.survey`.
        config: Limits of the filters.
        rejected: Ids of trials that an inspection rejects.

    Raises:
        ConfigError: If a user-defined filter cannot be run, or returns something else than bools.
    """
    # Filters that judge each grasp by itself.
    removal, own = first_removal(successes, config), _removed_by_own(config, successes)
    removal[own & (removal == Removal.KEPT)] = Removal.OWN

    # Outliers among the remaining grasps of an object that use the same fingers.
    kept = removal == Removal.KEPT
    if config.outlier_sigma > 0.0:
        groups = np.column_stack([successes["object"], successes["unused"]])
        for group in np.unique(groups[kept], axis=0):
            rows = np.flatnonzero(kept & (groups == group).all(axis=1))
            outside = is_outlier(successes["grasp_T"][rows], config.outlier_sigma)
            removal[rows[outside]] = Removal.OUTLIER

    # The inspection comes last, since it only saw samples.
    listed = np.isin(successes["trial_id"], np.asarray(rejected, dtype=np.int64))
    removal[listed & (removal == Removal.KEPT)] = Removal.REJECTED
    return removal


def own_filters(config: FilterConfig) -> list[_Keep]:
    """Return the filters that the configuration names: classes in files, or rules of packages.

    Raises:
        ConfigError: If a filter cannot be imported, or is not a filter.
    """
    return [_own_filter(name, config) for name in config.own]


def _own_filter(name: str, config: FilterConfig) -> _Keep:
    if is_own_class(name):
        found = own_class(name, config.code, key=_OWN, method="keep", takes=("successes",))
        return lambda successes: found().keep(successes)
    rule = registry.find("rules", name)
    if not isinstance(rule, Rule):
        raise ConfigError(f"rules: {name} must be a Rule, got {type(rule).__name__}")

    def keep(successes: Table) -> Flags:
        if missing := [column for column in rule.needs if not successes.has(column)]:
            columns = listed(sorted(successes.names))
            raise ConfigError(f"{name}: needs must be some of {columns}, got {listed(missing)}")
        return np.asarray(~rule.refuses(successes, config))

    return keep


def own_setting(config: FilterConfig) -> str:
    """Return the setting `KEY=VALUE` that names the user-defined filters; empty if there are none.

    A dataset stores the names of their files without folders.
    """
    names = [name.partition("@")[0] for name in config.own]
    value = names[0] if len(names) == 1 else f"[{', '.join(names)}]"
    return f"{_OWN}={value}" if names else ""


def _removed_by_own(config: FilterConfig, successes: Table) -> Flags:
    """Return which successes (n,) are removed by a user-defined filter."""
    due = (successes.count,)
    removed = np.zeros(due, dtype=np.bool_)
    if due == (0,):
        return removed
    for name, keep in zip(config.own, own_filters(config), strict=True):
        kept = np.asarray(run_own(name, keep, successes))
        if kept.dtype != np.bool_ or kept.shape != due:
            raise ConfigError(
                f"{name.partition('@')[0]}: keep must return {due} of bool, "
                f"got {kept.shape} of {kept.dtype}"
            )
        removed |= ~kept
    return removed


def find_hits(out: Path, header: ShardHeader, config: Config) -> list[tuple[int, int]]:
    """Return the candidates and stand-offs of a shard's attempts that count for a target.

    These are the successes with `max_grasps`, and otherwise those that pass all filters except the
    one of outliers, which needs all grasps of an object.

    Raises:
        DataError: If the shard is missing or damaged.
    """
    task = SurveyTask(out=str(out), object=0, headers=(header,), tried=None, camera=config.camera)
    found = survey_object(task).successes
    filters = config.filters.model_copy(update={"outlier_sigma": 0.0})
    kept = judge_successes(found, filters) == Removal.KEPT
    rows = np.arange(len(kept)) if config.max_grasps is not None else np.flatnonzero(kept)
    places = (found[name][rows].tolist() for name in ("candidate", "standoff_index"))
    return list(zip(*places, strict=True))
