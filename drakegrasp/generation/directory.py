"""What a build begins with: a configuration that ends, and the directory in which it works.

Input: a path, and the configuration that a caller states. Output: while the block runs, a directory
that this process holds, that contains the hand, and whose manifest the build completes. A
configuration or a directory that cannot be used is rejected before any worker starts.

`DatasetTask` is what the tasks of a build have in common: plain data, and the files of the
directory that they use. A worker that does not see the directory gets copies of these files, see
`FileTask` of `drakegrasp.runtime.executor`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

from drakegrasp.config import MOST_PALMS, CarriedHand, Config
from drakegrasp.dataset.lock import build_lock
from drakegrasp.dataset.manifest import (
    Manifest,
    claim_directory,
    package_versions,
    release_directory,
)
from drakegrasp.dataset.paths import MANIFEST_FILE, places, reach_path
from drakegrasp.dataset.successes import own_filters
from drakegrasp.errors import ConfigError, DataError, counted, listed
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.hand.folder import carry_hand, hand_places, moved_hand
from drakegrasp.runtime.files import disk_full_named, sweep_temporary
from drakegrasp.simulation.attempts import GraspTable
from drakegrasp.simulation.candidates import validate_samplers
from drakegrasp.simulation.drive import drive_of

#: Name that requests the built-in objects instead of a directory of meshes.
BUILTIN = "builtin"
#: Number of samples of each object that a build makes if nothing else ends it.
SAMPLES_PER_OBJECT = 20


def build_config(config: Config, postures: GraspTable | None = None) -> Config:
    """Return the configuration of a build, which ends and names its postures.

    Without a target and a number of palm poses, samplers without an end would go on for hours, so
    each object then ends with `SAMPLES_PER_OBJECT` samples.

    Args:
        config: Configuration that the caller states.
        postures: Postures to try instead of palm poses of samplers.

    Raises:
        ConfigError: If the configuration names other postures, or a class that cannot be used.
        HandError: If the hand cannot be used, or a sampler cannot be used with it.
    """
    config = _with_postures(config, postures)
    rules = config.candidates
    endless = "closing" in rules.method and rules.postures is None
    if endless and rules.max == MOST_PALMS and not config.has_target:
        config = config.model_copy(update={"samples_per_object": SAMPLES_PER_OBJECT})

    # The hand, and classes that are not of this package.
    drive_of(load_hand(config.hand_source), config.lift)
    if rules.postures is None:
        validate_samplers(config)
    own_filters(config.filters)
    return config


def _with_postures(config: Config, postures: GraspTable | None) -> Config:
    """Return a configuration that names the given postures.

    Raises:
        ConfigError: If it names other postures.
    """
    digest, named = None if postures is None else postures.digest(), config.candidates.postures
    if named not in (None, digest):
        must = "left out; the postures that are given decide" if digest else "given with postures"
        raise ConfigError(f"candidates.postures must be {must}, got {named!r}")
    if digest is None:
        return config
    # A posture has no stand-off, so there is one attempt per posture.
    rules = config.candidates
    changed = {"postures": digest, "standoffs": rules.standoffs[:1]}
    return config.model_copy(update={"candidates": rules.model_copy(update=changed)})


@dataclass(frozen=True, kw_only=True)
class BuildDirectory:
    """A directory that this process holds for a build.

    Attributes:
        out: The directory.
        manifest: Manifest of the dataset, with the hand in the directory. If the build continues a
            dataset, it has the objects of that dataset; the file is not changed yet.
        is_new: Whether there is no dataset yet.
        notices: What was repaired in the directory, in words.
    """

    out: Path
    manifest: Manifest
    is_new: bool
    notices: tuple[str, ...]


@contextmanager
def open_directory(out: Path, config: Config, names: Collection[str]) -> Iterator[BuildDirectory]:
    """Hold a directory for a build while the block runs.

    If the block does not write a manifest, everything that was put into the directory is removed.

    Args:
        out: The directory; new, empty, or with a dataset of this configuration.
        config: Configuration of the build, see `build_config`.
        names: Names of the objects of the build.

    Raises:
        DataError: If the directory cannot be used, another process builds there, or the dataset
            has a mesh that is not among the objects.
        ConfigError: If `filters.reachable` names an arm that was not asked.
        HandError: If the hand's files cannot be read.
        DiskFullError: If the disk is full, also if it fills while the block runs.
    """
    with build_lock(out) as dead, disk_full_named(out):
        known = claim_directory(out, config)
        if known is not None:
            _validate_complete(known, names, out)
        _validate_reach(config, out)

        # The directory can be used: from here on, its files are changed.
        hand = load_hand(config.hand_source)
        config = carry_hand(out, config, known.config.hand if known else None)
        notices = [] if dead is None else [f"the lock of a dead build was taken over: {dead}"]
        if swept := [str(path.relative_to(out)) for path in sweep_temporary(out)]:
            files = counted(len(swept), "temporary file")
            notices.append(f"{files} ({listed(swept)}) of dead processes removed")
        try:
            yield BuildDirectory(
                out=out,
                manifest=_manifest(config, known, hand),
                is_new=known is None,
                notices=tuple(notices),
            )
        finally:
            if not (out / MANIFEST_FILE).exists():
                release_directory(out)


def _validate_reach(config: Config, out: Path) -> None:
    """Reject a filter of an arm that was not asked; it could only fail when all is simulated."""
    name = config.filters.reachable
    if name is not None and not reach_path(out, name).is_file():
        raise ConfigError(
            f"filters.reachable must be null until `drakegrasp reach` has asked the arm, got {name}"
        )


def _manifest(config: Config, known: Manifest | None, hand: Hand) -> Manifest:
    """Return the manifest with which a build begins; its hand is that of the directory."""
    source = config.hand_source
    assert isinstance(source, CarriedHand)
    versions = package_versions() if known is None else known.versions
    return replace(
        known or Manifest(config=config, versions=versions, fingers=hand.finger_names),
        config=config,
        joints=hand.joint_order,
        versions={**versions, "hand": source.digest},
    )


def _validate_complete(known: Manifest, names: Collection[str], out: Path) -> None:
    """Check that all meshes from which a dataset was built are given to continue it.

    Raises:
        DataError: If a mesh is missing.
    """
    built = [entry.name for entry in known.objects] + [mesh.name for mesh in known.refused]
    missing = [name for name in built if name not in names]
    if missing:
        raise DataError(
            f"{out}: must be given every mesh that it was built from, got none named "
            f"{missing[0]}; choose another --out"
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class DatasetTask:
    """The input of a task on files of a dataset, as plain data.

    Attributes:
        out: Directory of the dataset, as a path of the process that runs the task.
        config: Configuration of the dataset.
    """

    out: Path
    config: Config

    @property
    def inputs(self) -> tuple[Path, ...]:
        """Files of the dataset that the task reads if they exist, without those of the hand."""
        return self.outputs

    @property
    def outputs(self) -> tuple[Path, ...]:
        """Files of the dataset that the task writes or removes."""
        raise NotImplementedError

    def reads(self) -> dict[str, Path]:
        """Return the files that the task reads by their places, see `FileTask`."""
        return {**hand_places(self.config), **places(self.out, *self.inputs)}

    def writes(self) -> tuple[str, ...]:
        """Return the places of the files that the task writes or removes."""
        return tuple(path.relative_to(self.out).as_posix() for path in self.outputs)

    def moved(self, folder: Path) -> Self:
        """Return the task in a directory with copies of the files."""
        return replace(self, out=folder, config=moved_hand(self.config, folder))
