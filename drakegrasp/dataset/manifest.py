"""`manifest.json`: the configuration, the objects and the versions of a dataset.

A build writes it before the first work unit. A directory without a readable manifest contains no
dataset, and a build rejects a directory with the manifest of another configuration. The manifest
contains no time, no machine and no number of workers: the same command produces the same bytes.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields, replace
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, with_config

from drakegrasp.config import (
    POSTPROCESSING_KEYS,
    Config,
    Licence,
    NonNegative,
    NonNegativeCount,
    Number,
    Positive,
    Seed,
    Share,
    parse_stored,
)
from drakegrasp.dataset.json_files import Name, read_mapping, stated, validated
from drakegrasp.dataset.lock import FOLDERS, LOCK_FILE, unwritable
from drakegrasp.dataset.paths import MANIFEST_FILE
from drakegrasp.dataset.rejections import AttemptKey
from drakegrasp.dataset.schema import (
    CONVENTIONS,
    SCHEMA_VERSION,
    validate_schema_version,
)
from drakegrasp.dataset.shards import ShardHeader
from drakegrasp.dataset.split import Home
from drakegrasp.errors import ConfigError, DataError, GraspError
from drakegrasp.frames import read_pose, unpack_pose
from drakegrasp.hand.folder import HAND_FOLDER, carried_hand, hand_digest
from drakegrasp.hand.settings import override_config
from drakegrasp.runtime.files import probe_folder, write_atomic

#: Packages whose versions may change a result.
VERSIONED = ("drakegrasp", "drake", "numpy", "scipy", "trimesh", "manifold3d", "h5py")
#: Versions that must not change within a dataset, nor differ between a client and its workers.
REQUIRED_VERSIONS = ("drakegrasp", "drake", "hand")


def _validate_pose(packed: tuple[float, ...]) -> tuple[float, ...]:
    """Raise an error if the numbers are not a rigid motion."""
    try:
        read_pose(unpack_pose(np.array(packed)), "it")
    except GraspError as error:
        raise ValueError(str(error)) from None
    return packed


def _validate_printable(text: str) -> str:
    """Raise an error if a text is not printable, since it could control a terminal."""
    if not text.isprintable():
        raise ValueError(f"it must be printable, got {text!r}")
    return text


#: Key of the hash of all other keys.
DIGEST = "sha256"
#: Types of the values in a manifest; they are checked when a manifest is read.
Axis = Annotated[str, Field(pattern=r"^[+-][xyz]$")]
Hex = Annotated[str, Field(pattern="^[0-9a-f]+$")]
Text = Annotated[str, AfterValidator(_validate_printable)]
Whole = Annotated[int, Field(ge=0, le=2**63 - 1)]
Pose = Annotated[
    tuple[Number, ...], Field(min_length=12, max_length=12), AfterValidator(_validate_pose)
]


@with_config(ConfigDict(extra="forbid"))
@dataclass(frozen=True, kw_only=True)
class RestingEntry:
    """A resting pose of an object, in the manifest.

    Attributes:
        X_TO: The pose, (12,): the first three rows of the 4x4 matrix [m, -].
        probability: Fraction of the drops that ended in the pose.
        rolled: Whether the object would have rolled on and was stopped.
    """

    X_TO: Pose
    probability: Share
    rolled: bool


@with_config(ConfigDict(extra="forbid"))
@dataclass(frozen=True, kw_only=True)
class ObjectEntry:
    """A prepared object, in the manifest.

    Attributes:
        name, class_name: Names of the object and of its class.
        mesh_sha256: Hash of the mesh file and of its entry in `objects.yaml`, hexadecimal.
        scale: Metres per unit of length of the mesh file.
        up: Axis of the mesh file that is +z of {O}.
        mass: Mass [kg].
        density: Mass over volume [kg/m^3].
        friction: The object's own coefficient of friction with hand and table; None: the
            configuration's coefficients.
        collision_error: Largest distance between mesh and collision surface [m].
        resting: Resting poses of the object.
        candidates: Number of palm poses to try.
        notes: What was repaired in the mesh.
        licence: Identifier of the mesh's licence; None: not stated.
        tried: Number of palm poses that the dataset takes, because a target was met; None: all.
        ended: Whether the samplers have no more palm poses.
        split: Split of the object in a split by object, once it has samples; None before.
        group: Name shared by objects of the same mesh, which stay in one split; None: the object's
            name.
    """

    name: Name
    class_name: Annotated[Name, Field(validation_alias="class")]
    mesh_sha256: Hex
    scale: Positive
    up: Axis
    mass: Positive
    density: Positive
    friction: Positive | None
    collision_error: NonNegative
    resting: Annotated[tuple[RestingEntry, ...], Field(min_length=1)]
    candidates: NonNegativeCount
    notes: tuple[str, ...]
    licence: Licence | None = None
    tried: Whole | None = None
    ended: bool = False
    split: Home | None = None
    group: Name | None = None

    def to_json(self) -> dict[str, Any]:
        """Return the entry as JSON types, in the order of the manifest."""
        return {"class" if key == "class_name" else key: v for key, v in stated(self).items()}


@with_config(ConfigDict(extra="forbid"))
@dataclass(frozen=True, kw_only=True)
class RefusedMesh:
    """A mesh that cannot be simulated, in the manifest.

    Attributes:
        name: Name of the object.
        mesh_sha256: Hash of the mesh file and of its entry in `objects.yaml`, hexadecimal.
        reason: Why the mesh was refused, in words.
        again: Whether the machine may be the cause, so that the next build tries the mesh again.
    """

    name: Name
    mesh_sha256: Hex
    reason: str
    again: bool = False


@dataclass(frozen=True, kw_only=True)
class Manifest:
    """The description of a dataset.

    Attributes:
        config: Resolved configuration, with the seed.
        objects: The objects, in the order of the dataset's rows.
        refused: The meshes that were refused.
        rejected: Attempts that an inspection rejects: successes that are not samples.
        versions: Versions of the packages that built the dataset, and a hash of the hand's files.
        fingers: Names of the fingers in grasp order, each with whether a grasp needs its fingertip.
        joints: Names of the hand's joints in the order of the fields `q`.
        schema_version: Version of the schema of the dataset's files.
    """

    config: Config
    objects: tuple[ObjectEntry, ...] = ()
    refused: tuple[RefusedMesh, ...] = ()
    rejected: tuple[AttemptKey, ...] = ()
    versions: dict[str, str]
    fingers: dict[str, bool] = field(default_factory=dict)
    joints: tuple[str, ...] = ()
    schema_version: int = SCHEMA_VERSION

    def headers(self) -> Iterator[ShardHeader]:
        """Yield the work units of the dataset in the order of its rows."""
        config_hash = self.config.simulation_hash()
        for entry in self.objects:
            for unit in self.config.unit_ranges(entry.candidates):
                if entry.tried is not None and unit.start >= entry.tried:
                    break
                yield ShardHeader(
                    config_hash=config_hash,
                    mesh_sha256=entry.mesh_sha256,
                    object_name=entry.name,
                    start=unit.start,
                    stop=unit.stop,
                )

    def headers_by_object(self) -> list[tuple[ShardHeader, ...]]:
        """Return the work units of each object."""
        by_name: dict[str, list[ShardHeader]] = {entry.name: [] for entry in self.objects}
        for header in self.headers():
            by_name[header.object_name].append(header)
        return [tuple(headers) for headers in by_name.values()]

    @property
    def units(self) -> int:
        """Number of work units."""
        return sum(1 for _ in self.headers())

    @property
    def groups(self) -> list[str]:
        """Group of each object, equal for variants of the same mesh."""
        return [entry.group or entry.name for entry in self.objects]

    def homes(self) -> dict[str, Home]:
        """Return the split of each group that was in one before; none if the split is by class.

        Raises:
            DataError: If objects of a group were in two splits.
        """
        homes, first = dict[str, Home](), dict[str, str]()
        for group, entry in zip(self.groups, self.objects, strict=True):
            if entry.split is None or self.config.split.by == "class":
                continue
            if homes.setdefault(group, entry.split) != entry.split:
                raise DataError(
                    f"{first[group]} and {entry.name} must be in one split to be of one group "
                    f"({group}), got them in {homes[group]} and {entry.split}"
                )
            first.setdefault(group, entry.name)
        return homes

    def signature(self) -> str:
        """Return a hash of everything that determines a row of the dataset, hexadecimal."""
        unlicensed = tuple(replace(entry, licence=None) for entry in self.objects)
        content = _content(replace(self, objects=unlicensed, refused=()))
        del content["config"]["verify"]
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def installed_versions(config: Config) -> dict[str, str]:
    """Return all versions that may change a result: those of packages, and the hand's hash."""
    return {**package_versions(), "hand": hand_digest(config.hand_source)}


def package_versions() -> dict[str, str]:
    """Return the versions of all packages that may change a result."""
    return {name: metadata.version(name) for name in VERSIONED}


def other_version(then: Mapping[str, str], now: Mapping[str, str]) -> str | None:
    """Return the first of `REQUIRED_VERSIONS` by which results may differ, or None."""
    return next((n for n in REQUIRED_VERSIONS if then.get(n, "") != now.get(n, "")), None)


def origin_attributes(
    config: Config, versions: dict[str, str], fingers: Mapping[str, bool], joints: Sequence[str]
) -> dict[str, Any]:
    """Return the attributes of every file: conventions, settings, versions, fingers, joints."""
    return {
        **{f"convention_{key}": text for key, text in CONVENTIONS.items()},
        "schema_version": SCHEMA_VERSION,
        "config": json.dumps(config.to_dict(), sort_keys=True),
        "config_hash": config.simulation_hash(),
        "seed": config.seed,
        "versions": json.dumps(versions, sort_keys=True),
        "fingers": json.dumps(dict(fingers)),
        "joints": json.dumps(list(joints)),
    }


def write_manifest(manifest: Manifest, out: Path) -> None:
    """Write the manifest into a dataset's directory, atomically."""
    write_atomic(out / MANIFEST_FILE, manifest_text(manifest))


def manifest_text(manifest: Manifest) -> bytes:
    """Return the bytes of a manifest's file."""
    content = _content(manifest)
    content[DIGEST] = manifest_digest(content)
    return (json.dumps(content, indent=1, ensure_ascii=False) + "\n").encode()


def manifest_digest(content: Mapping[str, Any]) -> str:
    """Return the hash of a manifest's other keys; it does not depend on the layout of the file."""
    said = {key: value for key, value in content.items() if key != DIGEST}
    return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()


def _content(manifest: Manifest) -> dict[str, Any]:
    content = {
        "schema_version": SCHEMA_VERSION,
        "config_hash": manifest.config.simulation_hash(),
        "seed": manifest.config.seed,
        "config": manifest.config.to_dict(),
        "split_by": manifest.config.split.by,
        "versions": manifest.versions,
        "fingers": manifest.fingers,
        "joints": list(manifest.joints),
        "objects": [entry.to_json() for entry in manifest.objects],
        "refused": [stated(entry) for entry in manifest.refused],
    }
    # Most datasets have no rejections.
    if manifest.rejected:
        content["rejected"] = [stated(key) for key in manifest.rejected]
    return content


def read_manifest(out: Path) -> Manifest:
    """Return the manifest of a dataset's directory.

    Raises:
        DataError: If the manifest is missing, cannot be read or has another schema.
    """
    path = out / MANIFEST_FILE
    # A missing file gets another message than a broken one.
    try:
        tree, content = read_mapping(path, "a readable manifest")
    except (FileNotFoundError, NotADirectoryError):
        raise DataError(
            f"{out.absolute()}: must be the directory of a dataset, got one without {MANIFEST_FILE}"
        ) from None

    # Check the version first: another schema may have other keys.
    validate_schema_version(path, tree.get("schema_version"))
    stored = validated(path, content, _Stored)
    try:
        config = parse_stored(stored.config)
    except ConfigError as error:
        raise DataError(f"{path}: {error}") from None

    # A dataset that was passed on contains its hand.
    carried = carried_hand(out, config.hand, stored.versions.get("hand", ""))
    manifest = Manifest(
        config=config.with_hand(config.hand, carried),
        **{f.name: getattr(stored, f.name) for f in fields(Manifest) if f.name != "config"},
    )
    # What remains is a valid value that was changed.
    if stored.sha256 != manifest_digest(tree):
        raise DataError(
            f"{path}: must be as it was written, got one with another {DIGEST}: it is damaged or "
            "was edited"
        )
    return manifest


class _Stored(BaseModel):
    """The keys of the file."""

    schema_version: int
    config_hash: Hex
    seed: Seed
    config: dict[str, Any]
    split_by: str
    versions: dict[str, str]
    fingers: dict[str, bool] = {}
    joints: tuple[Text, ...] = ()
    objects: tuple[ObjectEntry, ...]
    refused: tuple[RefusedMesh, ...]
    rejected: tuple[AttemptKey, ...] = ()
    sha256: Hex


def claim_directory(out: Path, config: Config) -> Manifest | None:
    """Return the manifest of the dataset that a build with this configuration continues.

    Args:
        out: The directory; created if it is missing.
        config: Configuration of the build.

    Returns:
        The manifest in the directory, or None if the directory is empty or new.

    Raises:
        DataError: If the directory holds other files or the dataset of another configuration, or
            cannot be written; nothing in it is changed.
    """
    # The directory must be writable: it is better to fail now than after the first work unit.
    try:
        out.mkdir(parents=True, exist_ok=True)
        probe_folder(out)
    except OSError as error:
        raise unwritable(out, error) from None

    # Without a manifest, it may only contain what an interrupted build leaves.
    if not (out / MANIFEST_FILE).exists():
        _validate_no_other_files(out)
        return None

    # With a manifest, the build must continue the same dataset.
    manifest = read_manifest(out)
    installed = installed_versions(config)
    if installed["hand"] == manifest.versions.get("hand"):  # wherever the hand's files are
        config = config.with_hand(manifest.config.hand)
    if manifest.config.simulation_hash() != config.simulation_hash():
        raise DataError(
            f"{out}: must be empty or hold this configuration's dataset, got one that differs in "
            f"{differences(manifest.config, config)}; choose another --out"
        )
    if (name := other_version(manifest.versions, installed)) is not None:
        raise DataError(
            f"{out}: must be continued with {name} {manifest.versions.get(name)}, which made it, "
            f"got {installed[name]}; choose another --out"
        )
    return manifest


def _validate_no_other_files(out: Path) -> None:
    """Raise an error if a directory has files that none of our builds writes.

    Raises:
        DataError: If there is such a file.
    """
    own = (*FOLDERS, LOCK_FILE)
    names = (path.name for path in out.iterdir())
    others = sorted(name for name in names if not name.startswith(".") and name not in own)
    if others:
        raise DataError(
            f"{out}: must be empty or hold a dataset of drakegrasp, got {others[0]!r} "
            f"and no {MANIFEST_FILE}; choose another --out"
        )


def release_directory(out: Path) -> None:
    """Remove the files of a build that produced nothing, and the directory if it is then empty."""
    (out / MANIFEST_FILE).unlink(missing_ok=True)
    if not (out / HAND_FOLDER).is_symlink():
        shutil.rmtree(out / HAND_FOLDER, ignore_errors=True)
    # A directory with any other content existed before.
    for folder in (*(out / name for name in FOLDERS), out):
        with suppress(OSError):
            folder.rmdir()


def with_postprocessing(manifest: Manifest, overrides: Sequence[str]) -> Manifest:
    """Return a manifest with other values of settings on which no shard depends.

    If the split changes, no object has one any more, so that all are drawn anew.

    Args:
        manifest: Manifest of the dataset.
        overrides: `key=value` texts, e.g. "split.valid_fraction=0.2".

    Raises:
        ConfigError: If a value cannot be used, or would change what was simulated.
    """
    config = override_config(manifest.config, overrides)
    if config.simulation_hash() != manifest.config.simulation_hash():
        raise ConfigError(
            f"only values of {', '.join(POSTPROCESSING_KEYS)} can change, got one that changes "
            f"what was simulated: {differences(manifest.config, config)}"
        )
    if config.split != manifest.config.split:
        objects = tuple(replace(entry, split=None) for entry in manifest.objects)
        manifest = replace(manifest, objects=objects)
    return replace(manifest, config=config)


def differences(
    theirs: Config, ours: Config, ignored: Collection[str] = POSTPROCESSING_KEYS
) -> str:
    """Return the differing values in words; by default only those that change the simulation."""
    a, b = _flatten(theirs.to_dict()), _flatten(ours.to_dict())
    keys = [k for k in a | b if a.get(k) != b.get(k) and k.partition(".")[0] not in ignored]
    return ", ".join(f"{k} ({a.get(k)} there, {b.get(k)} here)" for k in keys)


def _flatten(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return the leaves of a tree of dicts, by their dotted keys."""
    leaves: dict[str, Any] = {}
    for key, value in tree.items():
        if isinstance(value, dict):
            leaves |= _flatten(value, f"{prefix}{key}.")
        else:
            leaves[prefix + key] = value
    return leaves
