"""From shards to trials.hdf5, grasping_oto.hdf5 and grasping_otm.hdf5.

Input: a directory whose work units are all done, and their summaries, or the shards from which
these are read. Output: the three files, all or none. `survey` decides which successes become
samples, in which split. Then the rows go from the shards into the files, some thousand at a time.
This process keeps a few numbers per success, whatever the number of attempts. It does not import
Drake.
"""

from __future__ import annotations

import hashlib
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
    read_columns,
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
from drakegrasp.dataset.successes import UnitSummary, judge_successes, read_summary
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
        surveyed = survey(out, manifest, rejected=rejected, progress=progress)
        return assemble_locked(out, surveyed, progress=progress)


def assemble_locked(out: Path, surveyed: Survey, *, progress: Report = silent) -> Assembly:
    """Write the three files and the manifest; the caller holds the lock.

    Args:
        out: Directory of the dataset.
        surveyed: The survey of its shards; its filters and split may differ from those on disk.
        progress: As for `assemble`.
    """
    manifest, successes = surveyed.manifest, surveyed.successes
    sweep_temporary(out)
    with disk_full_named(out), replaced_together(out) as new:
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
    return surveyed.assembly


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
        has_read: Whether the survey has read the shards, and so verified them.
    """

    manifest: Manifest
    shards: Sequence[ShardRows]
    successes: Table
    samples: Mapping[str, npt.NDArray[np.int64]]
    sizes: Mapping[str, int]
    seals: str
    has_read: bool

    @property
    def count(self) -> int:
        """Number of rows of /trials."""
        return self.shards[-1].first + self.shards[-1].count

    @property
    def assembly(self) -> Assembly:
        """Numbers of rows in the files."""
        removal = Counter(self.successes["removal"].tolist())
        return Assembly(
            trials=self.count,
            grasps=self.successes.count,
            removed={Removal(reason): removal[reason] for reason in sorted(removal)},
            samples={split: len(self.samples[split]) for split in SPLITS},
        )


def survey(
    out: Path,
    manifest: Manifest,
    known: Mapping[ShardHeader, UnitSummary] | None = None,
    *,
    rejected: Sequence[int | AttemptKey] | None = None,
    progress: Report = silent,
) -> Survey:
    """Survey the shards of a dataset, and decide which successes are samples.

    Args:
        out: Directory of the dataset.
        manifest: Its manifest, with filters and split.
        known: The summaries of its work units; None: they are read from the shards.
        rejected: As for `assemble`; if None, the rejections of the manifest that are successes.
        progress: Called with the number of surveyed shards and twice the number of all.

    Raises:
        DataError: If a shard is missing or damaged, no object has a palm pose, or a rejected trial
            is not a success.
    """
    headers, seals = list(manifest.headers()), dict[ShardHeader, bytes]()
    numbers = {entry.name: i for i, entry in enumerate(manifest.objects)}
    shards, tables, first = list[ShardRows](), list[Table](), 0
    for header in headers:
        i = numbers[header.object_name]
        unit = known[header] if known else read_summary(out, header, manifest.config)

        # The rows end with the last palm pose that the dataset takes. So a dataset does not depend
        # on how many more attempts the workers had begun.
        tried = manifest.objects[i].tried
        palms = None if tried is None else tried - header.start
        count = int(unit.attempts[:palms].sum())
        successes = unit.successes[unit.successes["trial_id"] < count]
        own = np.full(successes.count, i, dtype=np.int32)
        ids = first + successes["trial_id"]
        tables.append(successes.with_columns(object=own, trial_id=ids))
        shards.append(ShardRows(header, i, first, count))
        seals[header] = unit.seal
        first += count
        progress(len(shards), 2 * len(headers))
    if not shards:
        raise DataError(f"{out}: no object has a palm pose to try")

    # Decide about the successes.
    successes = join(tables)
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
        sizes=unit.sizes,
        seals=shards_sha256(out, manifest, seals),
        has_read=not known,
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


def shards_sha256(
    out: Path, manifest: Manifest, known: Mapping[ShardHeader, bytes] | None = None
) -> str:
    """Return a hash of the seals of all shards that the files are made from, hexadecimal.

    Args:
        out: Directory of the dataset.
        manifest: Its manifest.
        known: The seal of each shard; None: they are read, and not verified.

    Raises:
        DataError: If a shard is missing.
    """
    whole = hashlib.sha256()
    for headers in filter(None, manifest.headers_by_object()):
        seals = (known[header] if known else read_seal(header.path(out)) for header in headers)
        whole.update(hashlib.sha256(b"".join(seals)).digest())
    return whole.hexdigest()


def is_assembled(out: Path, manifest: Manifest, seals: str | None = None) -> bool:
    """Return whether the three files exist and are what assembling would write now.

    Args:
        out: Directory of the dataset.
        manifest: Its manifest.
        seals: Hash of the seals of its shards, see `shards_sha256`; None: they are not compared.

    Raises:
        DataError: If a file stores values outside of itself.
    """
    stored = set[tuple[str, str]]()
    try:
        for name in ASSEMBLED_FILES:
            with open_hdf5(out / name) as file:
                stored.add((str(file.attrs["signature"]), str(file.attrs["shards"])))
    except (OSError, KeyError):
        return False
    signatures, shards = map(set, zip(*stored, strict=True))
    return signatures == {manifest.signature()} and (seals is None or shards == {seals})


def validate_assembled(out: Path) -> None:
    """Reject a dataset whose files are missing, or of another state than its manifest.

    Raises:
        DataError: If it is rejected.
    """
    if is_assembled(out, read_manifest(out)):
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
    shards, trials, group = surveyed.shards, list[Table](), files[""]["trials"]
    samples, written = defaultdict[Place, list[_Samples]](list), Counter[Place]()
    start, chunk = 0, group["trial_id"].chunks[0]
    with ThreadPoolExecutor(available_cores()) as pool:
        for done, shard in enumerate(shards, 1):
            rows, parts = _read_rows(out, surveyed, shard)
            trials.append(rows)
            for place, part in parts.items():
                samples[place].append(part)
            is_last, count = done == len(shards), shard.first + shard.count - start
            if count < BLOCK and not is_last:
                continue

            # Write the full chunks; copies of the other rows begin the next block.
            block, whole = join(trials), count if is_last else count - count % chunk
            _write_chunks(group, block[:whole], start, pool)
            trials, start = [join([block[whole:]])], start + whole
            for place in product(surveyed.samples, CAMERAS):
                split, camera = place
                if own := samples.pop(place, None):
                    data, first = files[camera][split], written[place]
                    written[place] += _write_samples(data, own, first, surveyed.manifest)
            progress(len(shards) + done, 2 * len(shards))


def _read_rows(
    out: Path, surveyed: Survey, shard: ShardRows
) -> tuple[Table, dict[Place, _Samples]]:
    """Return the rows of /trials that are taken from a shard, and the samples among them."""
    header, samples = shard.header, dict[Place, _Samples]()
    names = [f.name for f in _fields(surveyed.manifest, TRIAL_FIELDS)]
    stored = [name for name in names if name not in ASSEMBLED_FIELDS]
    with open_shard(header.path(out), header, verify=not surveyed.has_read) as (file, _):
        trials = read_columns(file["trials"], TRIAL_FIELDS, stored)
        trials = trials[: shard.count].with_columns(
            trial_id=shard.first + np.arange(shard.count, dtype=np.int64),
            object=np.full(shard.count, shard.object, dtype=np.int32),
        )

        # The samples of these rows, for each camera.
        for split, ids in surveyed.samples.items():
            own = ids[slice(*np.searchsorted(ids, (shard.first, shard.first + shard.count)))]
            for camera in CAMERAS if len(own) else ():
                model = _load(model_path(out, header.object_name))
                rows = own - shard.first
                samples[split, camera] = _samples_of(file["looks"], trials, rows, model, camera)
    return trials, samples


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
