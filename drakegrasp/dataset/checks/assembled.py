"""The three files are what assembling gives: it is done again from the shards, and compared.

In: the surveys of all objects, which `object_files` makes, and the manifest. Out: a violation for
each attribute, row of /objects and /successes, attempt and sample that differs. Samples are derived
by the functions that write them; stored images are compared byte for byte.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import h5py
import numpy as np

from drakegrasp.dataset.assembly.decisions import (
    Decisions,
    Shards,
    decide,
    file_attributes,
    number_rows,
    object_columns,
)
from drakegrasp.dataset.assembly.pack import IMAGES, SplitSamples
from drakegrasp.dataset.assembly.survey import Survey
from drakegrasp.dataset.checks.findings import Findings, Violation, of_file
from drakegrasp.dataset.checks.rows import AnyArray, Batch, CheckedFile, Rule
from drakegrasp.dataset.hdf5 import unpacked_chunk
from drakegrasp.dataset.manifest import Manifest
from drakegrasp.dataset.paths import FILE_NAME
from drakegrasp.outcomes import Removal

#: Attributes that say of what a file was assembled, the cause of others first.
ORIGIN = ("config", "split_by", "versions", "fingers", "joints", "shards", "signature")


@dataclass(frozen=True, kw_only=True, eq=False)
class Again:
    """A dataset assembled again, but for its rows.

    Attributes:
        out: Directory of the dataset.
        manifest: Its manifest.
        shards: What the shards hold.
        decisions: What becomes of the successes.
    """

    out: Path
    manifest: Manifest
    shards: Shards
    decisions: Decisions

    @classmethod
    def of(
        cls, out: Path, manifest: Manifest, surveys: Sequence[Survey], trials: CheckedFile | None
    ) -> Again:
        """Decide again which successes are samples, given the surveys of all objects.

        Code of a dataset is never imported: what the user's own filters removed is read from
        `trials`, if these can be read.
        """
        shards = number_rows(surveys, manifest)
        removed = np.zeros(0, dtype=np.int64)
        if manifest.config.filters.own and trials is not None and "successes" in trials.counts:
            # Columns that cannot be read are a finding later.
            with suppress(OSError), trials.opened() as file:
                ids, reasons = (file["successes"][name][:] for name in ("trial_id", "removal"))
            removed = ids[reasons == Removal.OWN]
        own = np.isin(shards.successes.trial_id, removed)
        decisions = decide(manifest, shards.successes, own)
        return cls(out=out, manifest=manifest, shards=shards, decisions=decisions)

    def counts(self, camera: str) -> dict[str, int]:
        """Return how many rows each group of a file must have, see `file_attributes`."""
        if camera:
            return {split: len(ids) for split, ids in self.decisions.ids.items()}
        return {
            "objects": len(self.manifest.objects),
            "trials": self.shards.count,
            "successes": len(self.decisions.removal),
        }


def origin(file: CheckedFile, manifest: Manifest, seals: str, camera: str) -> Iterator[Violation]:
    """A file is of the manifest's configuration and of the shards that are there.

    Args:
        file: The file.
        manifest: Of the dataset.
        seals: Hash of the seals of the shards; empty if they are not all known.
        camera: `oto` or `otm`; empty for the trials.
    """
    due = file_attributes(manifest, seals, camera)
    for key in ORIGIN:
        if key not in due or key not in file.attributes or (key == "shards" and not seals):
            continue
        if _rows_depend_on(key, str(file.attributes[key])) != _rows_depend_on(key, due[key]):
            of = "the shards that are there" if key == "shards" else FILE_NAME
            got = "another" if key in ("config", "signature") else file.attributes[key]
            yield of_file(
                file.name,
                f"attribute {key} must be that of {of}",
                f"{got}; run `drakegrasp assemble` again",
            )
            return  # others follow from it


def row_counts(file: CheckedFile, again: Again, camera: str) -> Iterator[Violation]:
    """Each group has the number of rows that assembling gives."""
    for group, due in again.counts(camera).items():
        count = file.counts.get(group, due)
        if count != due:
            yield of_file(file.name, f"number of rows must be {due}", count, f"/{group}")


def objects_and_successes(
    trials: CheckedFile, manifest: Manifest, again: Again | None, findings: Findings
) -> None:
    """Compare /objects with the manifest, and /successes with what is decided again."""
    tables = {"objects": (object_columns(manifest), FILE_NAME)}
    if again is not None:
        tables["successes"] = again.decisions.columns(), "the shards, the filters and the split"
    with trials.opened() as file:
        for group, (columns, of) in tables.items():
            count = len(next(iter(columns.values())))
            if trials.counts.get(group) != count:
                continue  # a finding already, or no group
            for batch in trials.batches(file, group, np.arange(count), max(count, 1), findings):
                trials.judge(batch, findings, *_rules(columns, batch, of))


def compare_trials(
    file: h5py.File,
    trials: CheckedFile,
    columns: Mapping[str, AnyArray],
    start: int,
    findings: Findings,
    size: int,
) -> Iterator[Batch]:
    """Yield rows of /trials that are those of their shards; others become findings.

    Args:
        file: The file, opened.
        trials: What is known of it.
        columns: The rows derived again, (n, ...) each.
        start: First of the rows.
        findings: Takes the violations.
        size: Rows of a batch.
    """
    rows = np.arange(start, start + len(columns["trial_id"]))
    for batch in trials.batches(file, "trials", rows, size, findings):
        rows = batch.rows - start
        place = slice(rows[0], rows[-1] + 1) if rows[-1] - rows[0] + 1 == len(rows) else rows
        own = {name: values[place] for name, values in columns.items()}
        yield trials.judge(batch, findings, *_rules(own, batch, "its shard"))


def compare_samples(
    data: CheckedFile,
    camera: str,
    split: str,
    first: int,
    samples: SplitSamples,
    texts: Mapping[str, Sequence[str]],
    findings: Findings,
) -> None:
    """Compare some samples of a data file with those that are derived again.

    Args:
        data: The file; it remembers the rows that differ.
        camera: `oto` or `otm`.
        split: Name of the split.
        first: Row of the first sample.
        samples: What is derived again.
        texts: See `sample_texts`.
        findings: Takes the violations.
    """
    records, rows = samples.numbers(camera), np.arange(first, first + len(samples.objects))
    due: dict[str, AnyArray] = {name: records[name] for name in records.dtype.names or ()}
    for name, of_objects in texts.items():
        due[name] = np.array([of_objects[i] for i in samples.objects], dtype=object)
    with data.opened() as file:
        for batch in data.batches(file, split, rows, max(len(rows), 1), findings, list(due)):
            # A sample of another trial differs in all else.
            own = {name: values[batch.rows - first] for name, values in due.items()}
            trial_id = {"trial_id": own.pop("trial_id")}
            same = data.judge(batch, findings, *_rules(trial_id, batch, "shards and manifest"))
            own = {n: v[np.isin(batch.rows, same.rows)] for n, v in own.items()}
            same = data.judge(same, findings, *_rules(own, same, "its trial"))
            for name in IMAGES:
                dataset, stored = file[split][name], samples.images[camera, name]
                bad = [_differs(dataset, row, *stored[row - first]) for row in same.rows.tolist()]
                what = f"{name} must be what the shard holds"
                same = data.judge(same, findings, _images_rule(what, np.array(bad, dtype=bool)))


def _images_rule(what: str, bad: AnyArray) -> Rule:
    return lambda batch: batch.broken(what, bad, lambda i: "another image")


def _rules(columns: Mapping[str, AnyArray], batch: Batch, of: str) -> list[Rule]:
    """Return the rules that each field of a batch has the values of a column."""
    names = [name for name in columns if name in batch.columns]
    return [partial(Batch.follows, name=name, due=columns[name], what=of) for name in names]


def _differs(dataset: h5py.Dataset, row: int, chunk: bytes, skipped: int) -> bool:
    """Return whether an image is another than a chunk of a shard; mostly the bytes are the same."""
    try:
        stored = dataset.id.read_direct_chunk((row, *(0,) * (dataset.ndim - 1)))
    except RuntimeError:  # packed otherwise, or not there
        stored = None
    if stored == (skipped, chunk):
        return False
    try:
        return not np.array_equal(dataset[row : row + 1], unpacked_chunk(chunk, skipped, dataset))
    except OSError:
        return False  # it cannot be read, as the rules of samples find


def _rows_depend_on(key: str, text: str) -> str:
    """Return an attribute without what no row depends on: the section `verify` of a configuration.

    Version 0.2 had other keys there, and its files are still assembled.
    """
    if key != "config":
        return text
    try:
        config = json.loads(text)
        config.pop("verify", None)
    except (AttributeError, ValueError):
        return text
    return json.dumps(config, sort_keys=True)
