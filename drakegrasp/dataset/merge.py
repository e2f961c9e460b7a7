"""Several datasets as one: halves of the objects, or the same objects under several seeds.

In: directories whose work units are all done. Out: a new directory with the files of their objects
and work units, assembled as a build would. An attempt is known by its seed, object, resting pose,
palm pose, stand-off and number in its family, so what several directories hold is taken once.
Imports no Drake.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from drakegrasp.config import Config
from drakegrasp.dataset.assemble import Assembly, assemble_locked
from drakegrasp.dataset.hdf5 import AnyArray
from drakegrasp.dataset.manifest import (
    Manifest,
    ObjectEntry,
    differing_values,
    read_manifest,
    refuse_older,
)
from drakegrasp.dataset.paths import model_path, plan_path
from drakegrasp.dataset.shards import ShardHeader, read_shard
from drakegrasp.errors import DataError
from drakegrasp.runtime.executor import Executor, run_here
from drakegrasp.runtime.files import atomic_folder, atomic_hdf5, disk_full_named
from drakegrasp.runtime.progress import Report, silent

#: Values that may differ: the seed is told of each object, the hand by its digest, and the others
#: only said where a build stopped.
_FREE = ("seed", "hand", "samples", "samples_per_object", "samples_patience", "attempt_seconds")


@dataclass(frozen=True, kw_only=True)
class _Part:
    """An object of a dataset.

    Attributes:
        out: Directory of the dataset.
        manifest: Of the dataset.
        entry: The object.
    """

    out: Path
    manifest: Manifest
    entry: ObjectEntry

    @property
    def seed(self) -> int:
        """With which its attempts were drawn."""
        return self.manifest.config_of(self.entry.name).seed

    @property
    def drawn_name(self) -> str:
        """The name with which its attempts were drawn: an earlier merge may have added the seed."""
        return self.entry.name.removesuffix(f" seed {self.entry.seed}")

    @property
    def headers(self) -> list[ShardHeader]:
        """Its work units."""
        return list(replace(self.manifest, objects=(self.entry,)).headers())


def merge(
    into: Path,
    outs: Sequence[Path],
    *,
    execute: Executor = run_here,
    progress: Report = silent,
) -> Assembly:
    """Make one dataset of several, in a new directory; they stay as they are.

    Objects keep their names. Of an object that was built under several seeds, those of the second
    and later seed have the seed in the name; all have one `group`, so that a split keeps them
    together. Seed and versions are those of the first dataset, and `seed` of an object is told
    where it is another.

    Args:
        into: Directory of the new dataset, missing or empty.
        outs: Directories of the datasets, complete.
        execute: Does the work of assembling.
        progress: Called with the number of tasks that are done and to do.

    Raises:
        DataError: If `into` holds anything, a dataset is missing, damaged, incomplete or of an
            older schema, or they contradict each other; nothing is written.
        DiskFullError: If there is no room; nothing is written.
    """
    if into.exists() and (not into.is_dir() or any(into.iterdir())):
        raise DataError(f"{into}: must be a new or empty directory, got one with files in it")
    manifests = {out: read_manifest(out) for out in outs}
    for out, manifest in manifests.items():
        refuse_older(manifest, out)
        _refuse_others(out, manifest, outs[0], manifests[outs[0]])

    # The objects, those of several seeds with names of their own.
    parts = _merged_parts(manifests)
    merged = _merged_manifest(manifests, parts)
    with disk_full_named(into), atomic_folder(into) as folder:
        for part, entry in zip(parts, merged.objects, strict=True):
            _take_object(part, entry, merged, folder)
        # Nobody else knows this folder, so it needs no lock.
        return assemble_locked(folder, merged, execute=execute, progress=progress)


def _refuse_others(out: Path, manifest: Manifest, first: Path, known: Manifest) -> None:
    """Refuse a dataset whose labels mean something else than those of the first.

    Raises:
        DataError: If they do; the values or versions that differ are named.
    """
    values = differing_values(known.config, manifest.config, _FREE)
    versions = [
        f"{name} ({known.versions.get(name)} there, {manifest.versions.get(name)} here)"
        for name in sorted({*known.versions, *manifest.versions})
        if known.versions.get(name) != manifest.versions.get(name)
    ]
    if values or versions:
        different = ", ".join([*values, *versions])
        raise DataError(f"{out}: must be like {first}, got one that differs in {different}")


def _merged_parts(manifests: Mapping[Path, Manifest]) -> list[_Part]:
    """Return each object under each seed once, in the order of the datasets.

    Raises:
        DataError: If two of the same name are of other meshes, or of other work units.
    """
    found: dict[tuple[str, int], _Part] = {}
    by_name: dict[str, _Part] = {}
    for out, manifest in manifests.items():
        for entry in manifest.objects:
            part = _Part(out=out, manifest=manifest, entry=entry)
            _refuse_unfinished(part)

            # A name stands for one mesh.
            namesake = by_name.setdefault(part.drawn_name, part)
            if namesake.entry.mesh_sha256 != entry.mesh_sha256:
                raise DataError(
                    f"{out}: {part.drawn_name} must be of the same mesh as in {namesake.out}, "
                    "got another"
                )

            # Of the same attempts the longer list counts, which begins like the shorter.
            key = part.drawn_name, part.seed
            known = found.get(key)
            if known is not None:
                _refuse_other_units(known, part)
            if known is None or len(part.headers) > len(known.headers):
                found[key] = part
    return list(found.values())


def _refuse_unfinished(part: _Part) -> None:
    for header in part.headers:
        if not header.path(part.out).is_file():
            raise DataError(
                f"{part.out}: must be complete, got no results of {header.label}; give the command "
                "that builds it again"
            )


def _refuse_other_units(known: _Part, part: _Part) -> None:
    """Refuse an object if the work units that two datasets have of it differ."""
    for ours, theirs in zip(part.headers, known.headers, strict=False):
        if ours.stop != theirs.stop:
            continue  # the last unit of a smaller dataset may be shorter
        paths = ours.path(part.out), theirs.path(known.out)
        mine, other = (read_shard(path) for path in paths)
        for a, b in ((mine.trials, other.trials), (mine.looks, other.looks)):
            if not all(_equal(a[name], b[name]) for name in a):
                raise DataError(f"{paths[0]}: must equal {paths[1]}, which is of the same attempts")


def _equal(a: AnyArray, b: AnyArray) -> bool:
    return np.array_equal(a, b, equal_nan=a.dtype.kind == "f")


def _merged_manifest(manifests: Mapping[Path, Manifest], parts: Sequence[_Part]) -> Manifest:
    """Return the manifest of the new dataset; its objects are those of `parts`."""
    first = next(iter(manifests.values()))
    seeds: dict[str, list[int]] = {}
    for part in parts:
        seeds.setdefault(part.drawn_name, []).append(part.seed)

    # Of each object its name, and what it needs to be drawn again.
    names, entries = dict[tuple[Path, str], str](), list[ObjectEntry]()
    for part in parts:
        several = seeds[part.drawn_name]
        own = part.seed == several[0]
        name = part.drawn_name if own else f"{part.drawn_name} seed {part.seed}"
        group = part.entry.group or (part.drawn_name if len(several) > 1 else None)
        seed = None if part.seed == first.config.seed else part.seed
        entries.append(replace(part.entry, name=name, group=group, seed=seed))
        names[part.out, part.entry.name] = name

    # Meshes that no dataset could use, and what inspections rejected.
    built = {entry.mesh_sha256 for entry in entries}
    refused = {
        refusal.mesh_sha256: refusal
        for manifest in manifests.values()
        for refusal in manifest.refused
        if refusal.mesh_sha256 not in built
    }
    rejected = {
        replace(key, object=names[out, key.object])
        for out, manifest in manifests.items()
        for key in manifest.rejected
        if (out, key.object) in names
    }
    return replace(
        first,
        config=_joined_targets([manifest.config for manifest in manifests.values()]),
        objects=tuple(entries),
        refused=tuple(refused.values()),
        rejected=tuple(sorted(rejected)),
    )


def _joined_targets(configs: Sequence[Config]) -> Config:
    """Return the first configuration, with the sum of the targets of samples if all have one."""
    targets = [config.samples for config in configs]
    total = None if None in targets else sum(filter(None, targets))
    return configs[0].model_copy(update={"samples": total})


def _take_object(part: _Part, entry: ObjectEntry, merged: Manifest, folder: Path) -> None:
    """Put the files of an object into the new dataset, by links where they can stay as they are."""
    own = replace(merged, objects=(entry,))
    config_hash = own.config_of(entry.name).simulation_hash()
    _take(model_path(part.out, part.entry.name), model_path(folder, entry.name), {})
    plan = plan_path(folder, entry.name)
    _take(plan_path(part.out, part.entry.name), plan, {"config_hash": config_hash})
    for old, new in zip(part.headers, own.headers(), strict=True):
        _take(old.path(part.out), new.path(folder), asdict(new))


def _take(old: Path, new: Path, attributes: Mapping[str, Any]) -> None:
    """Link a file, or copy it where that is impossible; sealed files with these attributes."""
    new.parent.mkdir(parents=True, exist_ok=True)
    if attributes:
        with h5py.File(old) as file:
            if any(file.attrs[key] != value for key, value in attributes.items()):
                with atomic_hdf5(new, sealed=True) as copy:
                    for name in file:
                        file.copy(name, copy)
                    copy.attrs.update({**file.attrs, **attributes})
                return
    try:
        os.link(old, new)
    except OSError:  # another file system, or one without links
        shutil.copyfile(old, new)
