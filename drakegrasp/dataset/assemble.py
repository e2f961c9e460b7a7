"""From shards to trials.hdf5, grasping_oto.hdf5 and grasping_otm.hdf5.

Input: a directory whose work units are all done. Output: the three files, all or none.
`survey` verifies the seals of the shards, counts their rows, reads the successes, and decides which
of them become samples, in which split. Then the rows go from the shards into the files, some
thousand at a time. This process keeps a few numbers per success, whatever the number of attempts.
It does not import Drake.
"""

from __future__ import annotations

import hashlib
from bisect import bisect_left, bisect_right
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import chain, product
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import multiply
from drakegrasp.dataset.hdf5 import (
    COLUMN_CHUNK,
    AnyArray,
    create_field,
    open_hdf5,
    open_samples,
    open_trials,
    packed_chunk,
    read_codes,
    read_columns,
    sizes_in,
    write_field,
)
from drakegrasp.dataset.lock import build_lock
from drakegrasp.dataset.manifest import (
    Manifest,
    manifest_text,
    origin_attributes,
    read_manifest,
    with_postprocessing,
)
from drakegrasp.dataset.paths import (
    ASSEMBLED_FILES,
    DATA_FILES,
    MANIFEST_FILE,
    TRIALS_FILE,
    model_path,
)
from drakegrasp.dataset.reach import is_reachable
from drakegrasp.dataset.rejections import AttemptKey, find_keys
from drakegrasp.dataset.schema import (
    CAMERAS,
    DATA_FIELDS,
    LOOK_FIELDS,
    OBJECT_FIELDS,
    SPLITS,
    SUCCESS_FIELDS,
    TRIAL_FIELDS,
    Field,
    stored_fields,
)
from drakegrasp.dataset.shards import ASSEMBLED_FIELDS, ShardHeader, open_shard
from drakegrasp.dataset.split import find_homes, split_samples
from drakegrasp.dataset.successes import judge_successes, shard_successes, successes_of
from drakegrasp.errors import DataError
from drakegrasp.filters import Flags, Removal
from drakegrasp.frames import X_WT, invert_pose, pack_pose, unpack_pose
from drakegrasp.objects.model import ObjectModel, load_object
from drakegrasp.runtime.environment import available_cores
from drakegrasp.runtime.files import (
    disk_full_named,
    new_hdf5,
    read_seal,
    replaced_together,
    sweep_temporary,
)
from drakegrasp.runtime.progress import Report, silent
from drakegrasp.table import Table, join
from drakegrasp.vision.camera import intrinsics

#: Rows that are written at once: about ten of the largest shards, 30 MB in memory.
BLOCK = 8 * COLUMN_CHUNK
#: Image fields of a sample, copied from /looks as they are stored, and their names there.
IMAGES = {"images": "image", "masks": "mask"}
#: Text fields of a sample, and the attributes of its object that they repeat.
TEXTS = {"object_props/object_name": "name", "object_props/class_name": "class_name"}


@dataclass(frozen=True, kw_only=True)
class Assembly:
    """Numbers of rows in the files of a dataset.

    Attributes:
        trials: Number of attempts.
        grasps: Number of successes.
        removed: Number of successes for each reason of removal; the key `Removal.KEPT` counts the
            samples.
        samples: Number of samples in each split.
    """

    trials: int
    grasps: int
    removed: dict[Removal, int]
    samples: dict[str, int]


def assemble(
    out: Path,
    *,
    overrides: Sequence[str] = (),
    rejected: Sequence[int | AttemptKey] = (),
    progress: Report = silent,
) -> Assembly:
    """Write the three files of a dataset whose work units are all done.

    Args:
        out: Directory of the dataset.
        overrides: `key=value` strings that change settings of the dataset on which no shard
            depends, e.g. of the filters. If the split changes, all objects are drawn anew.
        rejected: Trials that an inspection rejects, as ids or identities; they do not become
            samples.
        progress: Called with the number of finished steps and the number of all steps.

    Raises:
        ConfigError: If an override cannot be used; nothing is changed.
        DataError: If a shard is missing or damaged, if a rejected trial is not a success, or if
            another process is building in the directory; the old files and filters are left
            unchanged.
        DiskFullError: If the disk is full; the old files and filters are left unchanged.
    """
    # The lock would create a missing directory.
    if not out.is_dir():
        read_manifest(out)
    with build_lock(out):
        manifest = with_postprocessing(read_manifest(out), overrides)
        return assemble_locked(out, manifest, rejected=rejected, progress=progress)


def assemble_locked(
    out: Path,
    manifest: Manifest,
    *,
    rejected: Sequence[int | AttemptKey] | None = None,
    known: Mapping[ShardHeader, Table] | None = None,
    surveyed: Survey | None = None,
    progress: Report = silent,
) -> Assembly:
    """Write the three files and the manifest; the caller holds the lock.

    Args:
        out: Directory of the dataset.
        manifest: Manifest of the dataset; its filters and split may differ from those on disk.
        rejected: As for `assemble`; if None, the rejections of the manifest that are successes.
        known: The successes of each shard, see `survey`.
        surveyed: The survey of the shards, if there is one already.
        progress: As for `assemble`.
    """
    sweep_temporary(out)
    with disk_full_named(out), replaced_together(out) as new:
        # Decide which successes become samples, and in which split.
        if surveyed is None:
            surveyed = survey(out, manifest, known, rejected=rejected, progress=progress)
        manifest, successes = surveyed.manifest, surveyed.successes

        # Write the small tables, and allocate all rows.
        paths = {camera: new(name) for camera, name in {"": TRIALS_FILE, **DATA_FILES}.items()}
        with ExitStack() as stack:
            files = {
                c: stack.enter_context(new_hdf5(path, sealed=True)) for c, path in paths.items()
            }
            for camera, file in files.items():
                file.attrs.update(file_attributes(manifest, surveyed.seals, camera))
                counts = {split: len(ids) for split, ids in surveyed.samples.items()}
                for name, count in (counts if camera else {"trials": surveyed.count}).items():
                    group = file.create_group(name)
                    for f in _fields(manifest, DATA_FIELDS if camera else TRIAL_FIELDS):
                        create_field(group, f, f.row_shape(surveyed.sizes), count)
            _write_table(files[""], "objects", OBJECT_FIELDS, object_columns(manifest))
            _write_table(files[""], "successes", SUCCESS_FIELDS, successes)
            _write_rows(out, surveyed, files, progress)

        # The manifest, with filters, split and rejections, changes together with the files.
        new(MANIFEST_FILE).write_bytes(manifest_text(manifest))
    return summarise(out)


def summarise(out: Path) -> Assembly:
    """Return the numbers of rows in the files of a dataset.

    Raises:
        DataError: If the files are missing or damaged.
    """
    with open_trials(out / TRIALS_FILE) as trials, open_samples(out / DATA_FILES["oto"]) as data:
        removal = read_codes(trials["successes/removal"], list(Removal))
        reasons, counts = np.unique(removal, return_counts=True)
        return Assembly(
            trials=len(trials["trials/outcome"]),
            grasps=len(removal),
            removed={Removal(int(r)): int(n) for r, n in zip(reasons, counts, strict=True)},
            samples={split: len(data[split]["trial_id"]) for split in SPLITS},
        )


def file_attributes(manifest: Manifest, seals: str, camera: str = "") -> dict[str, Any]:
    """Return the attributes of a file.

    Args:
        manifest: Manifest of the dataset.
        seals: Hash of the seals of the shards, hexadecimal.
        camera: `oto` or `otm`; empty for the trials.
    """
    lens = manifest.config.camera
    own = {"camera": camera, "split_by": manifest.config.split.by} if camera else {}
    return {
        **origin_attributes(manifest.config, manifest.versions, manifest.fingers, manifest.joints),
        "K": intrinsics(lens),
        "near": lens.near,
        "far": lens.far,
        "signature": manifest.signature(),
        "shards": seals,
        **own,
    }


def _fields(manifest: Manifest, fields: Sequence[Field]) -> tuple[Field, ...]:
    return stored_fields(fields, repeats=manifest.config.robustness.repeats > 0)


def object_columns(manifest: Manifest) -> dict[str, AnyArray]:
    """Return the columns (n, ...) of /objects, in the order of the manifest."""
    columns = {}
    for field in OBJECT_FIELDS:
        own = [getattr(entry, field.name) for entry in manifest.objects]
        values = [np.nan if value is None else value for value in own]
        columns[field.name] = np.array(
            values, dtype=object if field.dtype == "str" else field.dtype
        )
    return columns


def _write_table(
    file: h5py.File, name: str, fields: Sequence[Field], columns: Mapping[str, AnyArray]
) -> None:
    """Write a group all of whose rows are known."""
    group = file.create_group(name)
    for field in fields:
        write_field(group, field, columns[field.name])


# The survey of the shards


@dataclass(frozen=True)
class ShardRows:
    """The rows that the dataset takes from a shard: the first ones.

    Attributes:
        header: Header of the shard.
        object: Row of the shard's object in /objects.
        first: Id of the trial in the shard's first row.
        count: Number of rows taken.
    """

    header: ShardHeader
    object: int
    first: int
    count: int


@dataclass(frozen=True, kw_only=True, eq=False)
class Survey:
    """What is known, and decided, of all rows of a dataset before they are written.

    Attributes:
        manifest: Manifest of the dataset, in which each object that has samples has its split, if
            whole objects are split.
        shards: The rows that the dataset takes from each shard, in order.
        successes: The successes among these rows, with the columns of `successes_of`, the ids of
            their trials, and `removal`, the `Removal` of each.
        samples: For each split the ids of the trials that are samples, in rising order.
        sizes: Lengths of the letters in the shapes of the fields.
        seals: Hash of the seals of the shards, see `shards_sha256`.
    """

    manifest: Manifest
    shards: Sequence[ShardRows]
    successes: Table
    samples: Mapping[str, npt.NDArray[np.int64]]
    sizes: Mapping[str, int]
    seals: str

    @property
    def count(self) -> int:
        """Number of rows of /trials."""
        return self.shards[-1].first + self.shards[-1].count


def survey(
    out: Path,
    manifest: Manifest,
    known: Mapping[ShardHeader, Table] | None = None,
    *,
    rejected: Sequence[int | AttemptKey] | None = None,
    progress: Report = silent,
) -> Survey:
    """Survey the shards of a dataset, and decide which successes are samples.

    Args:
        out: Directory of the dataset.
        manifest: Its manifest, with filters and split.
        known: The successes of each shard, as `successes_of` returns them; None: they are read
            from the shards.
        rejected: As for `assemble`; if None, the rejections of the manifest that are successes.
        progress: Called with the number of surveyed shards and twice the number of all.

    Raises:
        DataError: If a shard is missing or damaged, no object has a palm pose, or a rejected trial
            is not a success.
    """
    headers, letters = list(manifest.headers()), dict[str, int]()
    numbers = {entry.name: i for i, entry in enumerate(manifest.objects)}
    shards, tables, first = list[ShardRows](), list[Table](), 0
    for header in headers:
        i = numbers[header.object_name]
        with open_shard(header.path(out), header) as file:
            # The rows end with the last palm pose that the dataset takes. So a dataset does not
            # depend on how many more attempts the workers had begun.
            palms, tried = file["trials/candidate"][:], manifest.objects[i].tried
            count = len(palms) if tried is None else int(np.count_nonzero(palms < tried))
            if known is None:
                successes = successes_of(shard_successes(file), manifest.config)
            else:
                successes = known[header]
            if not letters:
                letters = sizes_in(file["trials"], TRIAL_FIELDS)
                letters |= sizes_in(file["looks"], LOOK_FIELDS)
        successes = successes[successes["trial_id"] < count]
        own = np.full(successes.count, i, dtype=np.int32)
        ids = first + successes["trial_id"]
        tables.append(successes.with_columns(object=own, trial_id=ids))
        shards.append(ShardRows(header, i, first, count))
        first += count
        progress(len(shards), 2 * len(headers))
    if not shards:
        raise DataError(f"{out}: no object has a palm pose to try")

    # Decide about the successes.
    successes, seals = join(tables), shards_sha256(out, manifest)
    by_key = _ids_by_key(manifest, successes)
    if rejected is not None:
        manifest = replace(manifest, rejected=find_keys(rejected, by_key, out))
    rejected_ids = [by_key[key] for key in manifest.rejected if key in by_key]
    unreachable = _unreachable(out, manifest, successes)
    removal = judge_successes(successes, manifest.config.filters, rejected_ids, unreachable)
    manifest, samples = _split(manifest, successes[removal == Removal.KEPT])
    return Survey(
        manifest=manifest,
        shards=shards,
        successes=successes.with_columns(removal=removal),
        samples=samples,
        sizes=letters,
        seals=seals,
    )


def _unreachable(out: Path, manifest: Manifest, successes: Table) -> Flags | None:
    """Return which successes (n,) the arm of `filters.reachable` does not reach; None without it.

    Raises:
        DataError: If the arm has no file.
    """
    name = manifest.config.filters.reachable
    if name is None:
        return None
    names = np.array([entry.name for entry in manifest.objects], dtype=object)
    identity = successes.with_columns(object_name=names[successes["object"]])
    return ~is_reachable(out, name, identity)[1]


def _ids_by_key(manifest: Manifest, successes: Table) -> dict[AttemptKey, int]:
    """Return the trial id of each success, by the identity of its attempt."""
    names = ("object", "candidate", "standoff_index", "trial_id")
    rows = zip(*(successes[name].tolist() for name in names), strict=True)
    return {AttemptKey(manifest.objects[i].name, *key): t for i, *key, t in rows}


def _split(manifest: Manifest, samples: Table) -> tuple[Manifest, dict[str, npt.NDArray[np.int64]]]:
    """Return the manifest with the splits of its objects, and the trial ids of each split.

    Args:
        manifest: The manifest; with a split by class, its objects have none.
        samples: The successes that no filter removes.
    """
    config, groups, entries = manifest.config, manifest.groups, manifest.objects
    homes = manifest.homes()
    if config.split.by == "object":
        homes |= find_homes({groups[i] for i in samples["object"].tolist()}, homes, config.split)
        split = (homes.get(group) for group in groups)
        objects = tuple(replace(e, split=home) for e, home in zip(entries, split, strict=True))
        manifest = replace(manifest, objects=objects)
    rows = split_samples(
        samples["object"],
        [entry.name for entry in entries],
        [entry.class_name for entry in entries],
        groups,
        homes,
        config.split,
        config.seed,
    )
    return manifest, {name: samples["trial_id"][own] for name, own in rows.items()}


def shards_sha256(out: Path, manifest: Manifest) -> str:
    """Return a hash of the seals of all shards that the files are made from, hexadecimal.

    The seals are not verified.

    Raises:
        DataError: If a shard is missing.
    """
    whole = hashlib.sha256()
    for headers in filter(None, manifest.headers_by_object()):
        seals = b"".join(read_seal(header.path(out)) for header in headers)
        whole.update(hashlib.sha256(seals).digest())
    return whole.hexdigest()


def is_assembled(out: Path, *, verify_shards: bool = False) -> bool:
    """Return whether the three files exist and are what assembling would write now.

    Args:
        out: Directory of the dataset.
        verify_shards: Whether to compare the shards as well, which opens each of them.

    Raises:
        DataError: If a file stores values outside of itself, or a shard is missing.
    """
    manifest, stored = read_manifest(out), set[tuple[str, str]]()
    try:
        for name in ASSEMBLED_FILES:
            with open_hdf5(out / name) as file:
                stored.add((str(file.attrs["signature"]), str(file.attrs["shards"])))
    except (OSError, KeyError):
        return False
    signatures, shards = map(set, zip(*stored, strict=True))
    current = signatures == {manifest.signature()}
    return current and (not verify_shards or shards == {shards_sha256(out, manifest)})


def validate_assembled(out: Path) -> None:
    """Reject a dataset whose files are missing, or of another state than its manifest.

    Raises:
        DataError: If it is rejected.
    """
    if is_assembled(out):
        return
    for name in ASSEMBLED_FILES:
        with open_trials(out / name) if name == TRIALS_FILE else open_samples(out / name):
            pass  # the mistake of a file is told first
    raise DataError(
        f"{out}: files must be those of {MANIFEST_FILE}, got others: `drakegrasp assemble` or the "
        "same build again writes them"
    )


# Rows

#: A split and a camera.
Place = tuple[str, str]


class _Samples(NamedTuple):
    """Some samples as one camera sees them.

    Attributes:
        values: Their numbers, by the names of DATA_FIELDS, and `object`, their row of /objects.
        images: For each field of IMAGES the stored chunk of each sample, with the mask of the
            filters that HDF5 skipped.
    """

    values: Table
    images: Mapping[str, list[tuple[int, bytes]]]


def _write_rows(
    out: Path, surveyed: Survey, files: Mapping[str, h5py.File], progress: Report
) -> None:
    """Write all rows into their allocated places, from the first to the last.

    Args:
        out: Directory of the dataset.
        surveyed: The survey of its shards.
        files: For each camera its open data file; for the key "" the file of the trials.
        progress: As for `assemble`.
    """
    shards, count = surveyed.shards, surveyed.count
    firsts = [shard.first for shard in shards]
    written: Counter[Place] = Counter()
    with ThreadPoolExecutor(available_cores()) as pool:
        for start in range(0, count, BLOCK):
            # From the shard in which the block begins to the shard in which it ends.
            stop = min(start + BLOCK, count)
            last = bisect_left(firsts, stop)
            own = shards[bisect_right(firsts, start) - 1 : last]
            trials, samples = _read_block(out, surveyed, own, start, stop)

            _write_chunks(files[""]["trials"], trials, start, pool)
            for place in product(surveyed.samples, CAMERAS):
                split, camera = place
                if parts := samples.get(place):
                    group, first = files[camera][split], written[place]
                    written[place] += _write_samples(group, parts, first, surveyed.manifest)
            progress(len(shards) + last, 2 * len(shards))


def _read_block(
    out: Path, surveyed: Survey, shards: Sequence[ShardRows], start: int, stop: int
) -> tuple[Table, dict[Place, list[_Samples]]]:
    """Return the rows `start` to `stop` - 1 of /trials, and the samples among them.

    The seals are not verified here, since the survey has verified them.
    """
    tables, samples = list[Table](), defaultdict[Place, list[_Samples]](list)
    names = [f.name for f in _fields(surveyed.manifest, TRIAL_FIELDS)]
    for shard in shards:
        header = shard.header
        with open_shard(header.path(out), header, verify_seal=False) as file:
            stored = [name for name in names if name not in ASSEMBLED_FIELDS]
            trials = read_columns(file["trials"], TRIAL_FIELDS, stored)
            trials = trials.with_columns(
                trial_id=shard.first + np.arange(trials.count, dtype=np.int64),
                object=np.full(trials.count, shard.object, dtype=np.int32),
            )
            first, last = max(start, shard.first), min(stop, shard.first + shard.count)
            tables.append(trials[first - shard.first : last - shard.first])

            # The samples of these rows, for each camera.
            for split, ids in surveyed.samples.items():
                own = ids[slice(*np.searchsorted(ids, (first, last)))]
                for camera in CAMERAS if len(own) else ():
                    model = _load(model_path(out, header.object_name))
                    part = _samples_of(file["looks"], trials, own - shard.first, model, camera)
                    samples[split, camera].append(part)
    return join(tables), samples


#: The shards of an object follow each other.
_load = lru_cache(1)(load_object)


def _samples_of(
    looks: h5py.Group, trials: Table, rows: AnyArray, model: ObjectModel, camera: str
) -> _Samples:
    """Return samples of a shard.

    Args:
        looks: Group /looks of the shard.
        trials: The rows of /trials of the shard.
        rows: (n,), the samples' rows.
        model: The object.
        camera: `oto` or `otm`.
    """
    poses = read_columns(looks, LOOK_FIELDS, ("row", "X_CI_otm", *(f"X_TC_{c}" for c in CAMERAS)))
    places = np.searchsorted(poses["row"], rows)
    values = sample_values(model, trials[rows], poses[places], camera)
    images = {}
    for name, own in IMAGES.items():
        stored = looks[f"{own}_{camera}"]
        images[name] = [stored.id.read_direct_chunk((k, *_within(stored))) for k in places.tolist()]
    known = {name: trials[name][rows] for name in ASSEMBLED_FIELDS}
    return _Samples(Table(values | known), images)


def sample_values(
    model: ObjectModel, trials: Table, looks: Table, camera: str
) -> dict[str, AnyArray]:
    """Return the numbers of n samples of one object, by the names of DATA_FIELDS.

    Args:
        model: The object.
        trials: Rows of the samples' trials, with the columns of /trials.
        looks: Their rows of /looks; images are not needed.
        camera: `oto` or `otm`.
    """
    # Poses of each sample.
    X_TO = unpack_pose(trials["X_TO"])
    X_TC = {c: unpack_pose(looks[f"X_TC_{c}"]) for c in CAMERAS}
    X_CO = multiply(invert_pose(X_TC[camera]), X_TO)
    R_OC, p_CO = np.swapaxes(X_CO[:, :3, :3], 1, 2), X_CO[:, None, :3, 3]

    # Grasp, palm and forces in the frame of the file's camera. The lifted grasp is expressed with
    # the object in its resting pose: both grasps are transformed with X_CO.
    values: dict[str, AnyArray] = {}
    for suffix, when, X_OG in (("", "closed", "X_OG"), ("_lifted", "lifted", "X_OG_lifted")):
        p_OQ, nhat_Q_O, f_Q_O = (trials[f"{when}_{n}"] for n in ("p_OQ", "nhat_Q_O", "f_Q_O"))
        vectors = multiply(p_OQ, R_OC) + p_CO, multiply(nhat_Q_O, R_OC)
        values[f"grasps{suffix}"] = np.concatenate(vectors, axis=1).reshape(trials.count, -1)
        values[f"grasp_props/X_CG{suffix}"] = pack_pose(multiply(X_CO, unpack_pose(trials[X_OG])))
        values[f"grasp_props/f_Q_C{suffix}"] = multiply(f_Q_O, R_OC)

    # Frames and mass properties, which do not depend on the camera of the file.
    R_TO = X_TO[:, :3, :3]
    R_OT = np.swapaxes(R_TO, 1, 2)
    I_OOcm_T = multiply(multiply(R_TO, model.I_OOcm_O), R_OT).reshape(-1, 9)
    properties = {
        "work2com": multiply(model.p_OOcm[None], R_OT)[:, 0] + X_TO[:, :3, 3],
        "work2inertia": (trials["mass"] / model.mass)[:, None] * I_OOcm_T,
        "frame_cam2img_otm": looks["X_CI_otm"],
        **{f"frame_cam2work_{c}": pack_pose(invert_pose(X)) for c, X in X_TC.items()},
        **{f"frame_work2cam_{c}": pack_pose(X) for c, X in X_TC.items()},
        "frame_world2obj": pack_pose(multiply(X_WT, X_TO)),
        "frame_world2work": np.tile(pack_pose(X_WT), (trials.count, 1)),
    }
    values |= {f"object_props/{name}": value for name, value in properties.items()}

    # All other fields are columns of the trial.
    copied = {f.name: trials[f.of] for f in DATA_FIELDS if trials.has(f.of)}
    return values | copied | {"object_props/work2mass": trials["mass"][:, None]}


def _write_chunks(group: h5py.Group, columns: Table, first: int, pool: ThreadPoolExecutor) -> None:
    """Write columns whose first row begins a chunk; the pool compresses the chunks."""
    rows = group["trial_id"].chunks[0]

    def pack(place: tuple[str, int]) -> bytes:
        name, start = place
        return packed_chunk(columns[name][start : start + rows], rows)

    places = list(product(sorted(columns), range(0, columns.count, rows)))
    for (name, start), chunk in zip(places, pool.map(pack, places), strict=True):
        column = group[name]
        column.id.write_direct_chunk((first + start, *_within(column)), chunk)


def _write_samples(
    group: h5py.Group, parts: Sequence[_Samples], first: int, manifest: Manifest
) -> int:
    """Write samples of one split and camera from a row on, and return their number."""
    values = join([part.values for part in parts])
    for name in IMAGES:
        images = group[name]
        for row, (skipped, chunk) in enumerate(chain(*(part.images[name] for part in parts))):
            images.id.write_direct_chunk((first + row, *_within(images)), chunk, skipped)
    rows = slice(first, first + values.count)
    for field in _fields(manifest, DATA_FIELDS):
        if field.name not in (*IMAGES, *TEXTS):
            group[field.name][rows] = values[field.name].astype(field.dtype)
    for name, attribute in TEXTS.items():
        texts = [getattr(entry, attribute) for entry in manifest.objects]
        group[name][rows] = [texts[i] for i in values["object"].tolist()]
    return values.count


def _within(column: h5py.Dataset) -> tuple[int, ...]:
    """Return the position of a chunk without its row."""
    return (0,) * (column.ndim - 1)
