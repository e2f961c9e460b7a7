"""Merges datasets that were built separately, by objects, by seeds or by work units.

Input: directories of datasets with the same configuration, except for the seed. Output: a directory
with the files of their objects and shards, under names that distinguish seeds, and the assembled
files. A mesh that was built with several seeds counts as one object in the split.
"""

from __future__ import annotations

import filecmp
import os
import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePath
from typing import TypeAlias

from drakegrasp.config import CarriedHand, Config
from drakegrasp.dataset.assemble import Assembly, assemble_locked
from drakegrasp.dataset.lock import build_lock
from drakegrasp.dataset.manifest import (
    Manifest,
    ObjectEntry,
    differences,
    other_version,
    read_manifest,
    with_postprocessing,
    write_manifest,
)
from drakegrasp.dataset.paths import ASSEMBLED_FILES, model_path, plan_path, shards_folder
from drakegrasp.dataset.prepared_objects import with_drawn
from drakegrasp.dataset.shards import ShardHeader
from drakegrasp.dataset.statistics import is_assembled
from drakegrasp.dataset.successes import own_filters
from drakegrasp.dataset.survey import headers_by_object
from drakegrasp.errors import DataError
from drakegrasp.hand.folder import carry_hand
from drakegrasp.runtime.files import atomic_folder, disk_full_named, sync
from drakegrasp.runtime.progress import Report, silent

#: What a build may end with. A merged dataset has none of it.
_ENDS = ("samples", "samples_per_object", "max_grasps")
#: Keys in which datasets may differ. The merged dataset has the seed of the first dataset.
_FREE = ("seed", "samples_patience", *_ENDS)


#: An object of one of the datasets: the directory, the object's entry there, its work units, and
#: its entry in the merged dataset.
_Part: TypeAlias = tuple[Path, ObjectEntry, Sequence[ShardHeader], ObjectEntry]


def merge(
    into: Path,
    outs: Sequence[Path],
    *,
    overrides: Sequence[str] = (),
    progress: Report = silent,
) -> Assembly:
    """Merge several datasets into a new one, which appears when it is complete.

    The given datasets are not changed. An object that several datasets have with the same seed is
    used once. Files are hard links if the file system allows them.

    Args:
        into: Directory of the merged dataset, new or empty.
        outs: Directories of the datasets; the objects are merged in this order.
        overrides: Overrides as for `assemble`, applied to all datasets, which may differ in the
            keys that these set.
        progress: As for `assemble`.

    Raises:
        ConfigError: If an override or a user-defined filter cannot be used.
        DataError: If the directory is in use, a dataset is not complete, or two datasets differ in
            configuration, hand or version, or in an object that both have.
        HandError: If the files of the hand in a dataset have changed.
        DiskFullError: If the disk is full.
    """
    # Reject invalid input before anything is written.
    if into.exists() and (not into.is_dir() or any(into.iterdir())):
        raise DataError(f"{into}: must be a new or empty directory, got one that is in use")
    manifests = {out: with_postprocessing(_read_complete(out), overrides) for out in outs}
    incomplete = [out for out in outs if _is_part(out)]
    _refuse_differences(manifests)
    parts = _parts(manifests)
    manifest = _merged_manifest(manifests, parts)
    own_filters(manifest.config.filters)

    with disk_full_named(into), atomic_folder(into) as folder, build_lock(folder):
        drawn = {entry.name: entry.candidates for entry in manifest.objects}
        for part in parts:
            _take_files(part, drawn, folder)
        manifest = _with_hand(manifest, manifests.values(), folder)
        write_manifest(manifest, folder)
        _refuse_missing(manifest, folder, incomplete)
        return assemble_locked(folder, manifest, progress=progress)


def _read_complete(out: Path) -> Manifest:
    """Return the manifest of a complete dataset, or of a part of a dataset."""
    manifest = read_manifest(out)
    if not _is_part(out) and not is_assembled(out, verify_shards=True):
        raise DataError(
            f"{out}: must be a complete dataset, got one whose files are not of all its shards; "
            "complete it with `drakegrasp build` or `assemble`"
        )
    return manifest


def _is_part(out: Path) -> bool:
    """Return whether a directory has no assembled files, so holds a part of a dataset."""
    return not any((out / name).exists() for name in ASSEMBLED_FILES)


def _refuse_missing(manifest: Manifest, folder: Path, parts: Sequence[Path]) -> None:
    """Check that parts together have all work units.

    Raises:
        DataError: If a work unit is missing.
    """
    missing = [header for header in manifest.headers() if not header.path(folder).exists()]
    if parts and missing:
        first = missing[0]
        raise DataError(
            f"{parts[0]}: must be a complete dataset, or given with all other parts of its build, "
            f"got none that has {first.object_name}, palm poses {first.start} to {first.stop - 1}"
        )


def _refuse_differences(manifests: Mapping[Path, Manifest]) -> None:
    """Check that the labels of the datasets can be compared.

    Raises:
        DataError: If datasets differ in configuration or versions.
    """
    (first, known), *others = manifests.items()
    for out, manifest in others:
        config = _with_hand_of(known.config, manifest.config)
        if differing := differences(known.config, config, _FREE):
            raise DataError(
                f"{out}: must be of the configuration of {first} but for the seed, got one that "
                f"differs in {differing}"
            )
        if (name := other_version(manifest.versions, known.versions)) is not None:
            raise DataError(
                f"{out}: must be of {name} {known.versions.get(name)}, as {first} is, "
                f"got {manifest.versions.get(name)}"
            )


def _with_hand_of(known: Config, config: Config) -> Config:
    """Return a configuration with the hand's path of another, if both paths have the same name.

    Hands are compared by the digest of their files, so their paths may differ.
    """
    if PurePath(known.hand).stem != PurePath(config.hand).stem:
        return config
    return config.with_hand(known.hand)


def _parts(manifests: Mapping[Path, Manifest]) -> list[_Part]:
    """Return the objects of all datasets, with their names and seeds in the merged dataset.

    Raises:
        DataError: If objects of the same name have different meshes, classes or groups.
    """
    seed = next(iter(manifests.values())).config.seed
    entries = [
        (out, entry, headers, entry.config_in(manifest.config).seed)
        for out, manifest in manifests.items()
        for entry, headers in zip(manifest.objects, headers_by_object(manifest), strict=True)
    ]

    # Collect the seeds of each mesh.
    meshes, seeds = dict[str, tuple[Path, ObjectEntry]](), dict[str, set[int]]()
    for out, entry, _, own in entries:
        seeds.setdefault(entry.mesh_name, set()).add(own)
        first, known = meshes.setdefault(entry.mesh_name, (out, entry))
        for key in ("mesh_sha256", "class_name", "group"):
            if getattr(known, key) != getattr(entry, key):
                raise DataError(
                    f"{out}: {entry.mesh_name} must have the {key} that it has in {first}, "
                    f"{getattr(known, key)}, got {getattr(entry, key)}"
                )

    # An object keeps its split, so it must not have two.
    homes = dict[str, tuple[Path, str]]()
    for out, entry, _, _ in entries:
        if entry.split is not None:
            first, split = homes.setdefault(entry.group or entry.mesh_name, (out, entry.split))
            if split != entry.split:
                raise DataError(
                    f"{out}: {entry.mesh_name} must be in one split of all datasets, got it in "
                    f"{entry.split}, and in {split} of {first}; --set split.seed=1 draws all "
                    "splits anew"
                )

    # A mesh keeps its name with the first seed, or if it has only one seed.
    parts = list[_Part]()
    for out, entry, headers, own in entries:
        mesh, alone = entry.mesh_name, own == seed or len(seeds[entry.mesh_name]) == 1
        merged = replace(
            entry,
            name=mesh if alone else f"{mesh}-seed-{own}",
            seed=None if own == seed else own,
            drawn_as=None if alone else mesh,
        )
        parts.append((out, entry, headers, merged))
    return parts


def _merged_manifest(manifests: Mapping[Path, Manifest], parts: Iterable[_Part]) -> Manifest:
    """Return the manifest of the merged dataset.

    Raises:
        DataError: If two parts have the same name and differ.
    """
    # Use each object once.
    objects, names = dict[str, ObjectEntry](), dict[tuple[Path, str], str]()
    for out, entry, _, merged in parts:
        names[out, entry.name] = merged.name
        known = objects.setdefault(merged.name, merged)
        if with_drawn(replace(merged, tried=known.tried, split=known.split), known) != known:
            theirs, ours = known.to_json(), with_drawn(merged, known).to_json()
            keys = [key for key in {**theirs, **ours} if theirs.get(key) != ours.get(key)]
            others = ", ".join(key for key in keys if key not in ("tried", "split"))
            raise DataError(
                f"{out}: {merged.name} must be equal in all datasets that have it under the same "
                f"seed, got others in {others}"
            )
        objects[merged.name] = _longer(known, merged)

    first = next(iter(manifests.values()))
    refused = [mesh for manifest in manifests.values() for mesh in manifest.refused]
    rejected = [
        replace(key, object=names[out, key.object])
        for out, manifest in manifests.items()
        for key in manifest.rejected
        if (out, key.object) in names
    ]
    return replace(
        first,
        config=first.config.model_copy(update=dict.fromkeys(_ENDS)),
        objects=tuple(objects.values()),
        refused=tuple({mesh.name: mesh for mesh in refused if mesh.name not in objects}.values()),
        rejected=tuple(dict.fromkeys(rejected)),
    )


def _longer(known: ObjectEntry, other: ObjectEntry) -> ObjectEntry:
    """Return an object's entry with the palm poses of both entries that two datasets have of it."""
    more = max(known, other, key=lambda entry: entry.candidates)
    rows = max(entry.candidates if entry.tried is None else entry.tried for entry in (known, other))
    tried = None if rows == more.candidates else rows
    return replace(more, tried=tried, split=known.split or other.split)


def _with_hand(manifest: Manifest, parts: Iterable[Manifest], folder: Path) -> Manifest:
    """Return a merged manifest with the hand copied to its folder, if a dataset contains it."""
    for part in parts:
        if isinstance(part.config.hand_source, CarriedHand):
            config = manifest.config.with_hand(part.config.hand, part.config.hand_source)
            return replace(manifest, config=carry_hand(folder, config), joints=part.joints)
    return manifest


def _take_files(part: _Part, drawn: Mapping[str, int], folder: Path) -> None:
    """Link or copy the files of an object into a folder.

    Args:
        part: The object in one of the datasets.
        drawn: Number of palm poses of each object in the merged dataset.
        folder: Directory of the merged dataset.

    Raises:
        DataError: If another part has put different files there.
    """
    out, entry, headers, merged = part
    pairs = [(model_path(out, entry.name), model_path(folder, merged.name))]
    for header in headers:
        # Another part of a build has the missing ones.
        if header.path(out).exists():
            pairs.append((header.path(out), shards_folder(folder, merged.name) / header.file_name))
    for source, target in pairs:
        if not target.exists():
            _link(source, target)
        elif not filecmp.cmp(source, target, shallow=False):
            raise DataError(
                f"{source}: must be equal in all datasets with {entry.mesh_name} under the "
                "same seed, got another"
            )

    # The longest plan has the palm poses of all others.
    plan = plan_path(folder, merged.name)
    if entry.candidates == drawn[merged.name] and not plan.exists():
        _link(plan_path(out, entry.name), plan)


def _link(source: Path, target: Path) -> None:
    """Create a hard link to a file, or copy the file if links are not supported."""
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)
        sync(target)
