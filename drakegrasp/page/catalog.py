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
from collections.abc import Callable, Mapping
from dataclasses import dataclass
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
    TRIALS_FILE,
    model_path,
)
from drakegrasp.dataset.quality import COLUMNS, PARTS, suspicion
from drakegrasp.dataset.rejections import AttemptKey
from drakegrasp.dataset.trials import Stamp, Trials, stamp
from drakegrasp.errors import DataError
from drakegrasp.foreign_files import is_name, parse_json
from drakegrasp.hand.folder import carried_hand
from drakegrasp.outcomes import Outcome
from drakegrasp.table import AnyArray, Table, join

Found = TypeVar("Found")
#: Quantities for filtering and sorting, besides the parts of the suspicion.
EXTRA = ("suspicion", "force")
FEATURES = (*EXTRA, *(part.name for part in PARTS))
#: Columns that identify an attempt.
IDENTITY = ("object", "candidate", "standoff_index")
#: Further column from which features are computed.
_READ = "closed_f_Q_O"
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
#: Columns of n attempts in memory, in the order of the dataset's rows. First a table of n rows with
#: the columns _KEPT and `held`; `removal` is NONE for an attempt that is not a success, `split`
#: is NONE for one that is not a sample. Then a table with a row for each attempt whose hand closed:
#: `place` (m,) int32, rising indices into the first table, and FEATURES as float32, NaN if an
#: attempt ended before, and infinite if a contact has no normal.
Kept: TypeAlias = tuple[Table, Table]


def read_attempts(trials: Trials) -> Kept:
    """Return the columns of attempts for memory, read block by block.

    Raises:
        DataError: If a file cannot be read.
    """
    names = dict.fromkeys((*_KEPT, *COLUMNS, _READ))
    blocks = [_columns_of(block) for block in trials.blocks(list(names))]
    tables, few = zip(*blocks, strict=True)
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
    extra = {
        "suspicion": doubts.score,
        "force": norm(forces).max(axis=1, initial=-np.inf),
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
        trials: The attempts in trials.hdf5.
        table, closed: Columns of the attempts in memory, see `Kept`.
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
    own_hashes: Mapping[str, str]
    stamps: Mapping[Path, Stamp]
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
        DataError: If the directory holds no dataset, or one whose build has not ended.
    """

    def __init__(self, out: Path) -> None:
        self.out = out
        self._lock = threading.Lock()
        self._snapshot: Snapshot | None = None
        self.current()

    def current(self) -> Snapshot:
        """Return the state of the files.

        Raises:
            DataError: If the files cannot be read.
        """
        with self._lock:
            stamps = {self.out / name: stamp(self.out / name) for name in ASSEMBLED_FILES}
            if self._snapshot is None or stamps != self._snapshot.stamps:
                self._snapshot = _read_snapshot(self.out, stamps)
            return self._snapshot


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


def _read_snapshot(out: Path, stamps: Mapping[Path, Stamp]) -> Snapshot:
    """Return the state of a dataset, of which only trials.hdf5 is required."""
    if not os.path.lexists(out / TRIALS_FILE):  # a link that leads nowhere is damage
        read_manifest(out)  # what is no dataset at all gets another message
        raise DataError(
            f"{out}: must be a finished dataset, got one without {TRIALS_FILE}; finish it first, "
            "with the same command that began to build it"
        )
    try:
        manifest = read_manifest(out)
    except DataError:
        manifest = None

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
    return Snapshot(
        out=out,
        config=config,
        config_hash=str(trials.attributes.get("config_hash", "")),
        names=names,
        classes=classes,
        meshes=meshes,
        trials=trials,
        table=table,
        closed=closed,
        own_hashes=_own_hashes(manifest),
        stamps=stamps,
        missing=tuple(missing),
    )


def _own_hashes(manifest: Manifest | None) -> dict[str, str]:
    """Return `Snapshot.own_hashes`; empty if there is no manifest."""
    if manifest is None:
        return {}
    return {
        entry.name: entry.config_in(manifest.config).simulation_hash()
        for entry in manifest.objects
        if entry.seed is not None
    }
