"""What is in a dataset's directory now, read again when its files change.

A `Snapshot` is one state of the files. It is never changed: a request works on one snapshot to its
end, whatever a build writes meanwhile.
"""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from drakegrasp.config import Config, parse_config
from drakegrasp.dataset.hdf5 import read_texts
from drakegrasp.dataset.layout.opening import open_trials
from drakegrasp.dataset.manifest import Manifest, read_manifest
from drakegrasp.dataset.paths import DATA_FILES, FILE_NAME, TRIALS_FILE, model_path
from drakegrasp.dataset.rejections import AttemptKey
from drakegrasp.dataset.shards import ShardHeader
from drakegrasp.errors import DataError
from drakegrasp.inspection.table import (
    AttemptTable,
    empty_table,
    join,
    read_sample_ids,
    read_shard_part,
    read_trials_table,
)
from drakegrasp.runtime.json_text import parse_json
from drakegrasp.runtime.names import is_name

#: While a build runs, its new shards are looked for this often [s].
LISTING_PERIOD = 5.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Snapshot:
    """One state of a dataset's files.

    Attributes:
        out: Directory of the dataset.
        config: Its configuration.
        names, classes: Of the objects, by their number.
        table: The attempts.
        sources: Files that hold the attempts; `AttemptTable.source` counts them.
        sample_ids: Trial ids of the samples by split, in rising order.
        assembled: Whether the attempts are rows of trials.hdf5; else they are of shards.
        missing: What is not there, in sentences.
    """

    out: Path
    config: Config
    names: tuple[str, ...]
    classes: tuple[str, ...]
    table: AttemptTable
    sources: tuple[Path, ...]
    sample_ids: dict[str, npt.NDArray[np.int64]]
    assembled: bool
    missing: tuple[str, ...]

    def key(self, i: int) -> AttemptKey:
        """Return the identity of an attempt by its place in the table."""
        table = self.table
        name = self.names[table.object[i]]
        return AttemptKey(name, int(table.candidate[i]), int(table.standoff_index[i]))

    def label(self, i: int) -> str:
        """Return the identity of an attempt as three numbers, for addresses: `12-345-2`."""
        table = self.table
        return f"{table.object[i]}-{table.candidate[i]}-{table.standoff_index[i]}"

    def find(self, label: str) -> int | None:
        """Return the place of the attempt of a label, or None if there is none."""
        numbers = label.split("-")
        if len(numbers) != 3 or not all(n.isascii() and n.isdecimal() for n in numbers):
            return None
        object_, candidate, standoff = (int(n) for n in numbers)
        return self.table.find(object_, candidate, standoff)

    def trial_id(self, i: int) -> int | None:
        """Return the row of an attempt in trials.hdf5, or None before there is one."""
        return int(self.table.row[i]) if self.assembled else None


class Catalog:
    """The files of a dataset, as they are now.

    Args:
        out: Directory of the dataset.

    Raises:
        DataError: If the directory holds neither a trials.hdf5 nor a manifest.
    """

    def __init__(self, out: Path) -> None:
        self.out = out
        self._lock = threading.Lock()
        self._parts: dict[ShardHeader, AttemptTable] = {}
        self._stamp: Any = None
        self._listed = -LISTING_PERIOD
        self._snapshot: Snapshot | None = None
        self.current()

    def current(self) -> Snapshot:
        """Return the state of the files.

        Raises:
            DataError: If they cannot be read.
        """
        with self._lock:
            names = (TRIALS_FILE, *DATA_FILES.values(), FILE_NAME)
            stamp = tuple(_stamp(self.out / name) for name in names)
            building = self._snapshot is not None and not self._snapshot.assembled
            waited = time.monotonic() - self._listed >= LISTING_PERIOD
            if self._snapshot is None or stamp != self._stamp or (building and waited):
                self._snapshot = self._read()
                self._stamp, self._listed = stamp, time.monotonic()
            return self._snapshot

    def _read(self) -> Snapshot:
        if (self.out / TRIALS_FILE).is_file():
            self._parts.clear()
            return _read_assembled(self.out)
        return self._read_shards(read_manifest(self.out))

    def _read_shards(self, manifest: Manifest) -> Snapshot:
        """Return the state of a build that runs or was stopped."""
        # Shards never change: only new ones are read.
        numbers = {entry.name: i for i, entry in enumerate(manifest.objects)}
        done = [header for header in manifest.headers() if header.path(self.out).is_file()]
        for header in done:
            if header not in self._parts:
                number = numbers[header.object_name]
                self._parts[header] = read_shard_part(self.out, header, 0, number)

        # Each shard's number is its place among those that are done.
        parts = [self._parts[header] for header in done]
        for number, part in enumerate(parts):
            part.source[:] = number
        missing = (
            f"{TRIALS_FILE} and the data files are not there yet: {len(done):,} of "
            f"{manifest.units:,} work units are done. Filters and split are decided at the end.",
        )
        return Snapshot(
            out=self.out,
            config=manifest.config,
            names=tuple(entry.name for entry in manifest.objects),
            classes=tuple(entry.class_name for entry in manifest.objects),
            table=join(parts) if parts else empty_table(),
            sources=tuple(header.path(self.out) for header in done),
            sample_ids={},
            assembled=False,
            missing=missing,
        )


def find_model(out: Path, name: str) -> Path | None:
    """Return the file of an object's meshes, or None if it is not there.

    A stranger's dataset may hold names that no file can have; they are shown as they are.
    """
    path = model_path(out, name) if is_name(name) else None
    return path if path is not None and path.is_file() else None


def _read_assembled(out: Path) -> Snapshot:
    """Return the state of a dataset with a trials.hdf5; nothing else has to be there."""
    # Objects and configuration.
    path = out / TRIALS_FILE
    with open_trials(path) as file:
        try:
            config = parse_config(parse_json(file.attrs["config"]))
        except ValueError as error:
            raise DataError(f"{path}: attribute config must be one, got {error}") from None
        names, classes = (read_texts(file["objects"][key]) for key in ("name", "class_name"))

    # What else there is.
    missing = [
        f"{name} is not there: images come from the shards, if they are."
        for name in DATA_FILES.values()
        if not (out / name).is_file()
    ]
    gone = [name for name in names if find_model(out, name) is None]
    if gone:
        missing.append(f"{len(gone):,} of {len(names):,} objects have no mesh: no 3D view of them.")

    return Snapshot(
        out=out,
        config=config,
        names=names,
        classes=classes,
        table=read_trials_table(path),
        sources=(path,),
        sample_ids=read_sample_ids(out),
        assembled=True,
        missing=tuple(missing),
    )


def _stamp(path: Path) -> tuple[int, ...] | None:
    """Return what changes when a file is replaced; None if it is not there."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_ino, status.st_size, status.st_mtime_ns
