"""The present content of a dataset's directory, read again when its files change.

A `Snapshot` is one state of the files. It is never changed: a request uses one snapshot to its end,
whatever a build writes in the meantime. Its attempts are columns in memory with what filters and
sorting need: about twenty bytes per attempt, and fifty more if the hand closed. Images and poses
stay in the files.
"""

from __future__ import annotations

import hashlib
import json
import os
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Generic, TypeAlias, TypeVar

import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import norm
from drakegrasp.config import Config, parse_stored
from drakegrasp.dataset.manifest import Manifest, read_manifest
from drakegrasp.dataset.paths import (
    ASSEMBLED_FILES,
    DATA_FILES,
    FILE_NAME,
    TRIALS_FILE,
    model_path,
)
from drakegrasp.dataset.quality import COLUMNS, PARTS, suspicion
from drakegrasp.dataset.rejections import AttemptKey
from drakegrasp.dataset.shards import ShardHeader
from drakegrasp.dataset.trials import Stamp, TrialPart, Trials, shard_part, stamp
from drakegrasp.errors import DataError
from drakegrasp.foreign_files import is_name, parse_json
from drakegrasp.hand.folder import carried_hand
from drakegrasp.outcomes import Outcome
from drakegrasp.table import AnyArray, Table, join

Found = TypeVar("Found")
#: Quantities for filtering and sorting, besides the parts of the suspicion.
EXTRA = ("suspicion", "force", "p_hold")
FEATURES = (*EXTRA, *(part.name for part in PARTS))
#: Columns that identify an attempt.
IDENTITY = ("object", "candidate", "standoff_index")
#: Further columns from which features are computed.
_READ = ("closed_f_Q_O", "p_hold_samples", "p_hold_repeats")
#: Columns that the table of attempts copies, and their types.
_KEPT: dict[str, type[np.generic]] = {
    "object": np.int32,
    "candidate": np.int32,
    "standoff_index": np.uint8,
    "outcome": np.uint8,
    "removal": np.uint8,
    "split": np.uint8,
    "precision": np.bool_,
    "stable": np.bool_,
}
#: Interval [s] at which new shards are listed while a build runs.
LISTING_PERIOD = 5.0
#: Maximum number of damaged shards that are named.
NAMED = 3


#: Columns of n attempts in memory, in the order of the dataset's rows. First a table of n rows with
#: the columns _KEPT and `held`; `removal` is NONE for an attempt that is not a success or not yet
#: decided, `split` is NONE for one that is not a sample. Then a table with a row for each attempt
#: whose hand closed: `place` (m,) int32, rising indices into the first table, and FEATURES as
#: float32, NaN if an attempt ended before, and infinite if a contact has no normal.
Kept: TypeAlias = tuple[Table, Table]


def read_attempts(trials: Trials) -> Kept:
    """Return the columns of attempts for memory, read block by block.

    Raises:
        DataError: If a file cannot be read.
    """
    names = dict.fromkeys((*_KEPT, *COLUMNS, *_READ))
    return _join([_columns_of(block) for block in trials.blocks(list(names))])


def _join(parts: Sequence[Kept]) -> Kept:
    """Return one or more parts joined to one, in order."""
    tables, few = zip(*parts, strict=True)
    starts = np.cumsum([0, *(table.count for table in tables)]).tolist()
    moved = [
        closed.with_columns(place=closed.place + start)
        for closed, start in zip(few, starts, strict=False)
    ]
    return join(tables), join(moved)


def _columns_of(columns: Mapping[str, AnyArray]) -> Kept:
    """Return the columns of a block of attempts for memory."""
    # Most attempts never close the hand; only those that do have features.
    (closed,) = np.nonzero(np.isfinite(columns["time_close"]))
    few = {name: values[closed] for name, values in columns.items()}
    doubts = suspicion(few)

    # The largest force of a fingertip, after the lift if there was one.
    lifted = np.isfinite(few["time_lift"])[:, None, None]
    forces = np.where(lifted, few["lifted_f_Q_O"], few["closed_f_Q_O"])
    repeats = few["p_hold_repeats"]
    extra = {
        "suspicion": doubts.score,
        "force": norm(forces).max(axis=1, initial=-np.inf),
        "p_hold": np.where(repeats > 0, few["p_hold_samples"] / np.maximum(repeats, 1), np.nan),
    }

    # A value that a contact without a normal lacks counts as the largest part, so it is infinite.
    values = {
        name: np.where(np.isnan(v) & np.isfinite(doubts.shares[name]), np.inf, v)
        for name, v in doubts.values.items()
    }
    features = {name: v.astype(np.float32) for name, v in (extra | values).items()}
    kept = {name: columns[name].astype(dtype) for name, dtype in _KEPT.items()}
    table = Table(kept, held=kept["outcome"] == Outcome.SUCCESS)
    return table, Table(features, place=closed.astype(np.int32))


@dataclass(frozen=True, kw_only=True, eq=False)
class Snapshot:
    """One state of a dataset's files.

    Attributes:
        out: Directory of the dataset.
        config: Configuration of the dataset.
        config_hash: Hash of the settings that determine a shard, as the files have it.
        own_hashes: The same hash for each object with its own seed, by name.
        names, classes: Names and classes of the objects, by number.
        meshes: Hashes of the objects' meshes, hexadecimal.
        trials: The attempts in their files.
        table, closed: Columns of the attempts in memory, see `Kept`.
        assembled: Whether the attempts are rows of trials.hdf5; otherwise they are in shards.
        stamps: Stamps of the assembled files; shards never change.
        missing: What is missing, in sentences.
    """

    out: Path
    config: Config
    config_hash: str
    names: tuple[str, ...]
    classes: tuple[str, ...]
    meshes: tuple[str, ...]
    trials: Trials
    table: Table
    closed: Table
    assembled: bool
    own_hashes: Mapping[str, str] = field(default_factory=dict)
    stamps: Mapping[Path, Stamp] = field(default_factory=dict)
    missing: tuple[str, ...]

    @cached_property
    def codes(self) -> tuple[str, ...]:
        """A code of each object for addresses, from configuration, mesh and name.

        Its number is not used, since it changes when objects are added.
        """
        identities = zip(self.meshes, self.names, strict=True)
        texts = (json.dumps([self.config_hash, *identity]) for identity in identities)
        return tuple(hashlib.sha256(text.encode()).hexdigest()[:12] for text in texts)

    @cached_property
    def numbers(self) -> Mapping[str, int]:
        """Numbers of the objects by their codes."""
        return {code: number for number, code in enumerate(self.codes)}

    def feature(self, name: str) -> npt.NDArray[np.float32]:
        """Return a feature of all attempts (n,); NaN for an attempt without a value."""
        values = np.full(self.table.count, np.nan, dtype=np.float32)
        values[self.closed.place] = self.closed[name]
        return values

    def value(self, name: str, i: int) -> float:
        """Return a feature of one attempt; NaN if it has no value."""
        k = int(np.searchsorted(self.closed.place, i))
        there = k < self.closed.count and self.closed.place[k] == i
        return float(self.closed[name][k]) if there else float("nan")

    def key(self, i: int) -> AttemptKey:
        """Return the identity of an attempt by its index in the table."""
        number, *rest = (int(self.table[name][i]) for name in IDENTITY)
        return AttemptKey(self.names[number], *rest)

    def label(self, i: int) -> str:
        """Return the ID of an attempt as used in URLs, e.g. `9f86d081884c-345-2`.

        An attempt keeps its ID when the files change, and no other attempt gets this ID.
        """
        key, code = self.key(i), self.codes[self.table.object[i]]
        return f"{code}-{key.candidate}-{key.standoff_index}"

    def find(self, label: str) -> int | None:
        """Return the index of the attempt with a label, or None if there is none."""
        code, *numbers = label.split("-")
        if len(numbers) != 2 or not all(n.isascii() and n.isdecimal() for n in numbers):
            return None
        return self._place(self.numbers.get(code), *map(int, numbers))

    def find_key(self, key: AttemptKey) -> int | None:
        """Return the index of an attempt by its identity, or None if it does not exist."""
        number = self.names.index(key.object) if key.object in self.names else None
        return self._place(number, key.candidate, key.standoff_index)

    def _place(self, number: int | None, candidate: int, standoff_index: int) -> int | None:
        table = self.table
        (found,) = np.nonzero(
            (table.candidate == candidate)
            & (table.standoff_index == standoff_index)
            & (table.object == (-1 if number is None else number))
        )
        return int(found[0]) if len(found) else None

    def trial_id(self, i: int) -> int | None:
        """Return the row of an attempt in trials.hdf5, or None if it is not there yet."""
        return i if self.assembled else None

    def refuse_replaced(self) -> None:
        """Raise an error if a file was replaced while it was being read.

        Raises:
            DataError: If a file was replaced.
        """
        for path, before in self.stamps.items():
            if stamp(path) != before:
                raise DataError(f"{path}: must stay while it is read, got another; load it again")


class Catalog:
    """The files of a dataset in their present state.

    Args:
        out: Directory of the dataset.

    Raises:
        DataError: If the directory holds neither a trials.hdf5 nor a manifest.
    """

    def __init__(self, out: Path) -> None:
        self.out = out
        self._lock = threading.Lock()
        self._parts: dict[ShardHeader, tuple[TrialPart, Kept]] = {}
        self._stamps: dict[Path, Stamp] = {}
        self._listed = -LISTING_PERIOD
        # The assembled files, if there are any, and the manifest of a build not yet in them.
        self._assembled: Snapshot | None = None
        self._manifest: Manifest | None = None
        self._snapshot: Snapshot | None = None
        self.current()

    def current(self) -> Snapshot:
        """Return the state of the files.

        Raises:
            DataError: If the files cannot be read.
        """
        with self._lock:
            stamps = {self.out / n: stamp(self.out / n) for n in (*ASSEMBLED_FILES, FILE_NAME)}
            changed = self._snapshot is None or stamps != self._stamps
            if changed:
                self._read_files(stamps)
            waited = time.monotonic() - self._listed >= LISTING_PERIOD
            if self._snapshot is None or changed or (self._manifest is not None and waited):
                self._snapshot = self._list_shards()
                self._stamps, self._listed = stamps, time.monotonic()
            return self._snapshot

    def _read_files(self, stamps: Mapping[Path, Stamp]) -> None:
        """Read the assembled files, and the manifest of a build not yet in them."""
        assembled = os.path.lexists(self.out / TRIALS_FILE)  # a link that leads nowhere is damage
        self._assembled, self._manifest = None, None
        try:
            self._manifest = read_manifest(self.out)
        except DataError:
            if not assembled:
                raise  # else the assembled files are enough
        if assembled:
            self._parts.clear()
            self._assembled, signature = _read_assembled(self.out, self._manifest, stamps)
            if self._manifest is not None and self._manifest.signature() == signature:
                self._manifest = None

    def _list_shards(self) -> Snapshot:
        """Return the state of the files with the existing shards."""
        before, manifest, assembled = self._snapshot, self._manifest, self._assembled
        if assembled is None:
            assert manifest is not None
            return self._read_shards(manifest)
        if manifest is None or not (newer := _count_newer(assembled, manifest)):
            return assembled
        notice = (
            f"{TRIALS_FILE} and the data files are of an earlier state: {newer:,} work units are "
            "newer. They are shown when the build has ended."
        )
        if before is not None and before.table is assembled.table and notice in before.missing:
            return before
        return replace(assembled, missing=(notice, *assembled.missing))

    def _read_shards(self, manifest: Manifest) -> Snapshot:
        """Return the state of a build that runs or was stopped."""
        # Shards never change, so only new ones are read; those of removed objects are dropped.
        entries = manifest.objects
        numbers = {entry.name: i for i, entry in enumerate(entries)}
        objects = {
            key: np.array([getattr(entry, key) for entry in entries], dtype=object)
            for key in ("name", "class_name")
        }
        parts, damaged = {}, []
        for header in _done_headers(self.out, manifest):
            try:
                if (read := self._parts.get(header)) is None:
                    part = shard_part(self.out, header, numbers[header.object_name])
                    read = part, read_attempts(Trials.of_parts(self.out, objects, [part]))
                parts[header] = read
            except DataError:
                damaged.append(header.path(self.out).relative_to(self.out))
        self._parts = parts

        # The number of an object is its position in this manifest, which may have grown.
        own, rows = [], []
        for header, (part, (table, closed)) in parts.items():
            number = numbers[header.object_name]
            own.append(replace(part, object=number))
            column = np.full(table.count, number, dtype=np.int32)
            rows.append((table.with_columns(object=column), closed))
        trials = Trials.of_parts(self.out, objects, own)
        table, closed = _join(rows) if rows else read_attempts(trials)

        missing = [
            f"{TRIALS_FILE} and the data files are not there yet: {len(parts):,} of "
            f"{manifest.units:,} work units are done. Filters and split are decided at the end."
        ]
        if damaged:
            named = ", ".join(map(str, damaged[:NAMED]))
            more = f" and {len(damaged) - NAMED:,} more" if len(damaged) > NAMED else ""
            missing.append(f"Damaged, and not shown: {named}{more}. The build makes them again.")
        return Snapshot(
            out=self.out,
            config=manifest.config,
            config_hash=manifest.config.simulation_hash(),
            names=tuple(entry.name for entry in entries),
            classes=tuple(entry.class_name for entry in entries),
            meshes=tuple(entry.mesh_sha256 for entry in entries),
            trials=trials,
            table=table,
            closed=closed,
            assembled=False,
            own_hashes=_own_hashes(manifest),
            missing=tuple(missing),
        )


class Watched(Generic[Found]):
    """A further file of a dataset, read again when it or the dataset changes.

    Args:
        path: The file.
        read: Function that reads the file, given its stamp and a state of the dataset.
    """

    def __init__(self, path: Path, read: Callable[[Path, Stamp, Snapshot], Found]) -> None:
        self.path = path
        self._read = read
        self._lock = threading.Lock()
        self._known: tuple[Snapshot, Stamp, Found] | None = None

    def current(self, snapshot: Snapshot) -> Found:
        """Return the content of the file for a state of the dataset.

        Raises:
            DataError: If the file cannot be read, or belongs to another dataset.
        """
        with self._lock:
            now = stamp(self.path)
            if self._known is None or self._known[0] is not snapshot or self._known[1] != now:
                self._known = snapshot, now, self._read(self.path, now, snapshot)
            return self._known[2]


def find_model(out: Path, name: str) -> Path | None:
    """Return the file of an object's meshes, or None if it does not exist.

    An untrusted dataset may contain names that are not valid names of files; they are only shown.
    """
    path = model_path(out, name) if is_name(name) else None
    return path if path is not None and path.is_file() else None


def _read_assembled(
    out: Path, manifest: Manifest | None, stamps: Mapping[Path, Stamp]
) -> tuple[Snapshot, str]:
    """Return the state of a dataset with a trials.hdf5, and the signature of its manifest then.

    No other file is required.
    """
    # Objects and configuration.
    trials = Trials(out, any_name=True)
    try:
        config = parse_stored(parse_json(trials.attributes["config"]))
    except ValueError as error:
        path = out / TRIALS_FILE
        raise DataError(f"{path}: attribute config must be one, got {error}") from None
    versions = json.loads(str(trials.attributes.get("versions", "{}")))
    carried = carried_hand(out, config.hand, str(versions.get("hand", "")))
    config = config.with_hand(config.hand, carried)
    names, classes, meshes = (
        tuple(trials.objects[key].tolist()) for key in ("name", "class_name", "mesh_sha256")
    )

    # What is missing.
    missing = [
        f"{name} is not there: images come from the shards, if they are."
        for name in DATA_FILES.values()
        if not os.path.lexists(out / name)
    ]
    gone = [name for name in names if find_model(out, name) is None]
    if gone:
        missing.append(f"{len(gone):,} of {len(names):,} objects have no mesh: no 3D view of them.")

    table, closed = read_attempts(trials)
    state = Snapshot(
        out=out,
        config=config,
        config_hash=str(trials.attributes.get("config_hash", "")),
        names=names,
        classes=classes,
        meshes=meshes,
        trials=trials,
        table=table,
        closed=closed,
        assembled=True,
        own_hashes=_own_hashes(manifest),
        stamps={path: then for path, then in stamps.items() if path.name in ASSEMBLED_FILES},
        missing=tuple(missing),
    )
    return state, str(trials.attributes.get("signature", ""))


def _own_hashes(manifest: Manifest | None) -> dict[str, str]:
    """Return `Snapshot.own_hashes`; empty if there is no manifest."""
    if manifest is None:
        return {}
    return {
        entry.name: entry.config_in(manifest.config).simulation_hash()
        for entry in manifest.objects
        if entry.seed is not None
    }


def _count_newer(state: Snapshot, manifest: Manifest) -> int:
    """Return the number of finished work units that are not in the assembled files."""
    # Each object's last palm pose in the files.
    table = state.table
    last = np.full(len(state.names), -1, dtype=np.int32)
    np.maximum.at(last, table.object, table.candidate)

    numbers = {key: i for i, key in enumerate(zip(state.names, state.meshes, strict=True))}
    newer = 0
    for header in _done_headers(state.out, manifest):
        number = numbers.get((header.object_name, header.mesh_sha256))
        newer += number is None or header.start > last[number]
    return newer


def _done_headers(out: Path, manifest: Manifest) -> Iterator[ShardHeader]:
    """Yield the work units whose shards exist, in the order of the dataset's rows."""
    # One listing per object, since checking each file of a large build takes seconds.
    folder, names = None, frozenset[str]()
    for header in manifest.headers():
        path = header.path(out)
        if path.parent != folder:
            folder, names = path.parent, _names_in(path.parent)
        if path.name in names:
            yield header


def _names_in(folder: Path) -> frozenset[str]:
    try:
        return frozenset(os.listdir(folder))
    except OSError:
        return frozenset()
