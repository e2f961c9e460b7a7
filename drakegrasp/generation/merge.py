"""Merges datasets of different objects that were built separately.

Input: directories of datasets of one configuration. Output: a directory with the files of their
objects and shards, and the assembled files.
"""

from __future__ import annotations

import filecmp
import os
import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePath

from drakegrasp.config import CarriedHand, Config
from drakegrasp.dataset.assemble import (
    Assembly,
    assemble_locked,
    is_assembled,
    shards_sha256,
    survey,
)
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
from drakegrasp.dataset.paths import object_files
from drakegrasp.dataset.successes import own_filters
from drakegrasp.errors import DataError
from drakegrasp.hand.folder import carry_hand
from drakegrasp.runtime.files import atomic_folder, disk_full_named, sync
from drakegrasp.runtime.progress import Report, silent

#: What a build may end with. A merged dataset has none of it.
_ENDS = ("samples", "samples_per_object")
#: Keys in which datasets may differ.
_FREE = ("samples_patience", *_ENDS)


def merge(
    into: Path, outs: Sequence[Path], *, overrides: Sequence[str] = (), progress: Report = silent
) -> Assembly:
    """Merge several datasets into a new one, which appears when it is complete.

    The given datasets are not changed. An object that several datasets have is used once. Files are
    hard links if the file system allows them.

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
    _validate_comparable(manifests)
    manifest = _merged_manifest(manifests)
    own_filters(manifest.config.filters)

    with disk_full_named(into), atomic_folder(into) as folder, build_lock(folder):
        for out, part in manifests.items():
            _take_files(out, part, folder)
        manifest = _with_hand(manifest, manifests.values(), folder)
        write_manifest(manifest, folder)
        surveyed = survey(folder, manifest, progress=progress)
        return assemble_locked(folder, surveyed, progress=progress)


def _read_complete(out: Path) -> Manifest:
    """Return the manifest of a complete dataset."""
    manifest = read_manifest(out)
    if not is_assembled(out, manifest, shards_sha256(out, manifest)):
        raise DataError(
            f"{out}: must be a complete dataset, got one whose files are not of all its shards; "
            "complete it with `drakegrasp build` or `assemble`"
        )
    return manifest


def _validate_comparable(manifests: Mapping[Path, Manifest]) -> None:
    """Check that the labels of the datasets can be compared.

    Raises:
        DataError: If datasets differ in configuration or versions.
    """
    (first, known), *others = manifests.items()
    for out, manifest in others:
        config = _with_hand_of(known.config, manifest.config)
        if differing := differences(known.config, config, _FREE):
            raise DataError(
                f"{out}: must be of the configuration of {first}, got one that differs in "
                f"{differing}"
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


def _merged_manifest(manifests: Mapping[Path, Manifest]) -> Manifest:
    """Return the manifest of the merged dataset.

    Raises:
        DataError: If two datasets have an object of the same name and it differs.
    """
    objects, homes = dict[str, ObjectEntry](), dict[str, tuple[Path, str]]()
    for out, manifest in manifests.items():
        for entry in manifest.objects:
            # Files of an object, and so its entry, follow from its mesh and the configuration.
            known = objects.setdefault(entry.name, entry)
            theirs, ours = known.to_json(), entry.to_json()
            others = [key for key in {**theirs, **ours} if theirs.get(key) != ours.get(key)]
            if others not in ([], ["split"]):
                raise DataError(
                    f"{out}: {entry.name} must be equal in all datasets that have it, got others "
                    f"in {', '.join(others)}"
                )

            # An object keeps its split, so it must not have two.
            if entry.split is not None:
                objects[entry.name] = entry
                first, split = homes.setdefault(entry.group or entry.name, (out, entry.split))
                if split != entry.split:
                    raise DataError(
                        f"{out}: {entry.name} must be in one split of all datasets, got it in "
                        f"{entry.split}, and in {split} of {first}; --set split.seed=1 draws all "
                        "splits anew"
                    )

    of_first = next(iter(manifests.values()))
    refused = [mesh for manifest in manifests.values() for mesh in manifest.refused]
    rejected = [key for manifest in manifests.values() for key in manifest.rejected]
    return replace(
        of_first,
        config=of_first.config.model_copy(update=dict.fromkeys(_ENDS)),
        objects=tuple(objects.values()),
        refused=tuple({mesh.name: mesh for mesh in refused if mesh.name not in objects}.values()),
        rejected=tuple(dict.fromkeys(rejected)),
    )


def _with_hand(manifest: Manifest, parts: Iterable[Manifest], folder: Path) -> Manifest:
    """Return a merged manifest with the hand copied to its folder, if a dataset contains it."""
    for part in parts:
        if isinstance(part.config.hand_source, CarriedHand):
            config = manifest.config.with_hand(part.config.hand, part.config.hand_source)
            return replace(manifest, config=carry_hand(folder, config), joints=part.joints)
    return manifest


def _take_files(out: Path, manifest: Manifest, folder: Path) -> None:
    """Link or copy the files of a dataset's objects into a folder.

    Raises:
        DataError: If another dataset has put different files there.
    """
    files = [path for entry in manifest.objects for path in object_files(out, entry.name)]
    files += [header.path(out) for header in manifest.headers()]
    for source in files:
        target = folder / source.relative_to(out)
        if not target.exists():
            _link(source, target)
        elif not filecmp.cmp(source, target, shallow=False):
            raise DataError(f"{source}: must be equal in all datasets that have it, got another")


def _link(source: Path, target: Path) -> None:
    """Create a hard link to a file, or copy the file if links are not supported."""
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)
        sync(target)
