"""An HDF5 file of a dataset while it is checked.

In: a file with any content. Out: batches of the rows of those groups whose layout is sound. Rows
that break a rule, or cannot be read, are remembered, so that no further rule judges them. A
`FilePlace` is what another process needs to open the file as well.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from drakegrasp.config import Config
from drakegrasp.dataset.checks import layout as layout_rules
from drakegrasp.dataset.checks.findings import AnyArray, Batch, Findings, Violation, of_file
from drakegrasp.dataset.hdf5 import open_hdf5
from drakegrasp.dataset.layout.structure import DATA_TABLES, TRIAL_TABLES
from drakegrasp.dataset.schema import Field
from drakegrasp.errors import DataError, first_line

Rule = Callable[[Batch], Iterator[Violation]]


@dataclass(eq=False)
class OpenFile:
    """An open file.

    Attributes:
        name: Name of the file, for the violations.
        file: The file.
        config: Its configuration, if it is sound.
        fields: Fields of each group, by the group's name.
        groups: Groups by name, without those whose layout is broken.
        bad_rows: (n,) rows of each group that break a rule or cannot be read, in rising order.
    """

    name: str
    file: h5py.File
    config: Config | None
    fields: Mapping[str, tuple[Field, ...]]
    groups: dict[str, h5py.Group] = field(default_factory=dict)
    bad_rows: dict[str, npt.NDArray[np.int64]] = field(default_factory=dict)

    def place(self, bad_rows: Mapping[str, npt.NDArray[np.int64]]) -> FilePlace:
        """Return what a task needs to open the file, with the bad rows that it must know of."""
        return FilePlace(
            path=self.file.filename,
            identity=_identity(self.file),
            name=self.name,
            config=self.config,
            fields=self.fields,
            groups=tuple(self.groups),
            bad_rows=bad_rows,
        )

    def count(self, group: str) -> int:
        """Return the number of rows of a group; 0 if it is missing or broken."""
        return len(self.groups[group][self.fields[group][0].name]) if group in self.groups else 0

    def bad(self, group: str) -> npt.NDArray[np.int64]:
        """Return the rows (n,) of a group that break a rule or cannot be read."""
        return self.bad_rows.get(group, np.zeros(0, dtype=np.int64))

    def mark_bad(self, group: str, rows: npt.NDArray[np.int64]) -> None:
        """Remember rows (n,) of a group that break a rule or cannot be read."""
        if len(rows):
            self.bad_rows[group] = np.union1d(self.bad(group), rows)

    def read(self, group: str, rows: AnyArray, names: Sequence[str] | None = None) -> Batch:
        """Return some rows of a group.

        Args:
            group: Name of the group.
            rows: (n,), numbers of the rows, rising.
            names: Fields to read; all if None.

        Raises:
            OSError, UnicodeDecodeError: If the file is damaged there.
        """
        fields = [f for f in self.fields[group] if names is None or f.name in names]
        # HDF5 reads a slice far faster than the same rows as a list.
        dense = len(rows) > 0 and rows[-1] - rows[0] + 1 == len(rows)
        choice = slice(int(rows[0]), int(rows[-1]) + 1) if dense else rows
        columns = {f.name: column(self.groups[group][f.name], f)[choice] for f in fields}
        return Batch(file=self.name, group=f"/{group}", rows=rows, columns=columns)

    def batches(
        self, group: str, start: int, stop: int, size: int, findings: Findings
    ) -> Iterator[Batch]:
        """Yield the rows of a group from `start` to before `stop`, `size` at a time.

        Rows that cannot be read are a finding.
        """
        for first in range(start, stop, size):
            rows = np.arange(first, min(first + size, stop))
            try:
                yield self.read(group, rows)
            except (OSError, UnicodeDecodeError) as error:
                what = f"rows {first} to {rows[-1]} must be readable"
                findings.add([of_file(self.name, what, first_line(error), f"/{group}")])
                self.mark_bad(group, rows)

    def judge(self, batch: Batch, findings: Findings, *rules: Rule) -> Batch:
        """Apply rules that do not build on each other; return the rows that break none."""
        if not len(batch):
            return batch
        rows: set[int] = set()
        for rule in rules:
            rows |= findings.add(rule(batch))
        self.mark_bad(batch.group[1:], np.array(sorted(rows), dtype=np.int64))
        return batch.without(rows)


@dataclass(frozen=True, kw_only=True, eq=False)
class FilePlace:
    """A file that a task opens.

    Attributes:
        path: Of the file.
        identity: What tells it from another file at the same path.
        name, config, fields: As of the `OpenFile`.
        groups: Names of the groups whose layout is sound.
        bad_rows: As of the `OpenFile`, of those rows that the task deals with.
    """

    path: str
    identity: tuple[int, int]
    name: str
    config: Config | None
    fields: Mapping[str, tuple[Field, ...]]
    groups: tuple[str, ...]
    bad_rows: Mapping[str, npt.NDArray[np.int64]]

    @contextmanager
    def opened(self) -> Iterator[OpenFile]:
        """Open the file while the block runs.

        Raises:
            DataError: If it is another file by now.
            OSError: If it cannot be opened.
        """
        with open_hdf5(Path(self.path), again=True) as file:
            if _identity(file) != self.identity:
                raise DataError(f"{self.path}: must stay while it is checked, got another file")
            yield OpenFile(
                name=self.name,
                file=file,
                config=self.config,
                fields=self.fields,
                groups={name: file[name] for name in self.groups},
                bad_rows=dict(self.bad_rows),
            )


def _identity(file: h5py.File) -> tuple[int, int]:
    """Return what tells an open file from others, also from one of the same name."""
    found = os.fstat(file.id.get_vfd_handle())
    return found.st_dev, found.st_ino


def open_file(name: str, file: h5py.File, camera: str, findings: Findings) -> OpenFile:
    """Check the attributes and the layout of a file, and return it for the rules of its rows.

    Args:
        name: Name of the file, for the violations.
        file: The file.
        camera: `oto` or `otm`; empty for the trials.
        findings: Where violations go.
    """
    # Another version has another layout: its version is all that is told.
    fields = DATA_TABLES if camera else TRIAL_TABLES
    other = list(layout_rules.version(name, file))
    if other:
        findings.add(other)
        return OpenFile(name, file, None, fields)

    # Its attributes.
    config, broken = layout_rules.read_config(name, file)
    findings.add([*broken, *layout_rules.attributes(name, file, config, camera)])

    # Its layout: a group with a broken dataset is not read.
    opened = OpenFile(name, file, config, fields)
    broken_groups = set()
    for violation, difference in layout_rules.structure(name, file, fields, config):
        findings.add([violation])
        if not difference.text_only:
            broken_groups.add(violation.group[1:].split("/")[0])
    opened.groups = {g: file[g] for g in fields if g in file and g not in broken_groups}
    return opened


def column(dataset: h5py.Dataset, field: Field) -> Any:
    """Return a dataset whose rows read as values of the field: text as str."""
    return dataset.asstr() if field.dtype == "str" else dataset
