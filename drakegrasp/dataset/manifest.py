"""`manifest.json`: what a dataset's directory is of, and what it is made of.

It is written before the first work unit, so a directory without a readable manifest holds
no dataset, and one with another configuration's is refused. It says nothing of the time,
the machine or the number of workers: the same command gives the same bytes.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib import metadata
from pathlib import Path
from typing import Any

import h5py

from drakegrasp.config import POSTPROCESSING_KEYS, Config, override_config, parse_config
from drakegrasp.dataset import log as build_log
from drakegrasp.dataset.paths import FILE_NAME, OWN_FILES, OWN_FOLDERS
from drakegrasp.dataset.schema import CONVENTIONS, SCHEMA_VERSION
from drakegrasp.dataset.shards import ShardHeader
from drakegrasp.errors import ConfigError, DataError
from drakegrasp.hand.files import hand_digest
from drakegrasp.runtime.files import sync_and_rename, temporary_name

#: Packages whose versions may change a result.
VERSIONED = ("drakegrasp", "drake", "numpy", "scipy", "trimesh", "manifold3d", "embreex", "h5py")
#: Those that a dataset is never continued with another version of.
DECISIVE = ("drakegrasp", "drake", "hand")


@dataclass(frozen=True, kw_only=True)
class Manifest:
    """What a dataset is of.

    Attributes:
        config: Resolved configuration, with the seed.
        objects: `PreparedObject.summary` of each object, by name.
        refused: Name and reason of each mesh that was refused.
        versions: Of the packages that made it, and a hash of the hand's files.
    """

    config: Config
    objects: tuple[dict[str, Any], ...] = ()
    refused: tuple[dict[str, str], ...] = ()
    versions: dict[str, str]

    def headers(self) -> Iterator[ShardHeader]:
        """Yield the work units of the dataset in the order of its rows."""
        step, config_hash = self.config.unit_candidates, self.config.simulation_hash()
        for entry in self.objects:
            for start in range(0, entry["candidates"], step):
                yield ShardHeader(
                    config_hash=config_hash,
                    mesh_sha256=entry["mesh_sha256"],
                    object_name=entry["name"],
                    start=start,
                    stop=min(start + step, entry["candidates"]),
                )

    @property
    def units(self) -> int:
        """Number of work units."""
        step = self.config.unit_candidates
        return sum(-(-entry["candidates"] // step) for entry in self.objects)


def installed_versions(config: Config) -> dict[str, str]:
    """Return the versions of what may change a result: packages, and the hand's files."""
    packages = {name: metadata.version(name) for name in VERSIONED}
    return {**packages, "hand": hand_digest(config.hand)}


def write_origin(file: h5py.File, config: Config, versions: dict[str, str]) -> None:
    """Write what every file says of itself: conventions, configuration and versions."""
    file.attrs.update({f"convention_{key}": text for key, text in CONVENTIONS.items()})
    file.attrs["schema_version"] = SCHEMA_VERSION
    file.attrs["config"] = json.dumps(config.to_dict(), sort_keys=True)
    file.attrs["config_hash"] = config.simulation_hash()
    file.attrs["seed"] = config.seed
    file.attrs["versions"] = json.dumps(versions, sort_keys=True)


def write_manifest(manifest: Manifest, out: Path) -> None:
    """Write the manifest, atomically."""
    content = {
        "schema_version": SCHEMA_VERSION,
        "config_hash": manifest.config.simulation_hash(),
        "seed": manifest.config.seed,
        "config": manifest.config.to_dict(),
        "versions": manifest.versions,
        "objects": list(manifest.objects),
        "refused": list(manifest.refused),
    }
    path = out / FILE_NAME
    temporary = temporary_name(path)
    try:
        temporary.write_text(
            json.dumps(content, indent=1, ensure_ascii=False) + "\n", encoding="utf-8"
        )
        sync_and_rename(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def read_manifest(out: Path) -> Manifest:
    """Return the manifest of a dataset's directory.

    Raises:
        DataError: If there is none, or it cannot be read.
    """
    path = out / FILE_NAME
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if content["schema_version"] != SCHEMA_VERSION:
            raise DataError(
                f"{path}: schema must be {SCHEMA_VERSION}, got {content['schema_version']}"
            )
        return Manifest(
            config=parse_config(content["config"]),
            objects=tuple(content["objects"]),
            refused=tuple(content["refused"]),
            versions=content["versions"],
        )
    except FileNotFoundError:
        raise DataError(
            f"{out}: must be the directory of a dataset, got one without {FILE_NAME}"
        ) from None
    except (OSError, KeyError, TypeError, json.JSONDecodeError) as error:
        raise DataError(
            f"{path}: must be a readable manifest, got a broken one ({error})"
        ) from None


def claim_directory(out: Path, config: Config) -> Manifest | None:
    """Make sure that a dataset of this configuration may be built in a directory.

    Returns:
        The manifest that is there, or None in an empty or new directory.

    Raises:
        DataError: If the directory holds something else, another configuration's dataset, or
            cannot be written; nothing in it is changed.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        probe = temporary_name(out / "probe")
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise DataError(
            f"{out}: must be a directory that can be written, got: {error.strerror}"
        ) from None
    if not (out / FILE_NAME).exists():
        strangers = sorted(
            p.name
            for p in out.iterdir()
            if not p.name.startswith(".") and p.name not in (*OWN_FOLDERS, *OWN_FILES)
        )
        if strangers:
            raise DataError(
                f"{out}: must be empty or hold a dataset of drakegrasp, got {strangers[0]!r} "
                "and no manifest.json; choose another --out"
            )
        return None
    manifest = read_manifest(out)
    if manifest.config.simulation_hash() != config.simulation_hash():
        raise DataError(
            f"{out}: must be empty or hold this configuration's dataset, got one that differs in "
            f"{_differences(manifest.config, config)}; choose another --out"
        )
    for name in DECISIVE:
        then, now = manifest.versions.get(name), installed_versions(config)[name]
        if then != now:
            raise DataError(
                f"{out}: must be continued with {name} {then}, which made it, got {now}; "
                "choose another --out"
            )
    return manifest


def release_directory(out: Path) -> None:
    """Take back a claim on a directory in which nothing was made."""
    for name in (FILE_NAME, build_log.FILE_NAME):
        (out / name).unlink(missing_ok=True)
    # A directory that holds anything else was there before.
    for folder in (*(out / name for name in OWN_FOLDERS), out):
        with suppress(OSError):
            folder.rmdir()


def change_postprocessing(out: Path, overrides: Sequence[str]) -> None:
    """Change values of the filters or the split in a dataset's manifest.

    Raises:
        ConfigError: If a value cannot be used, or would change what was simulated.
    """
    manifest = read_manifest(out)
    config = override_config(manifest.config, overrides)
    if config.simulation_hash() != manifest.config.simulation_hash():
        raise ConfigError(
            "assemble may change values of filters and split only, got one that changes what was "
            f"simulated: {_differences(manifest.config, config)}"
        )
    write_manifest(replace(manifest, config=config), out)


def _differences(theirs: Config, ours: Config) -> str:
    def flat(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
        found: dict[str, Any] = {}
        for key, value in tree.items():
            if isinstance(value, dict):
                found |= flat(value, f"{prefix}{key}.")
            else:
                found[prefix + key] = value
        return found

    a, b = flat(theirs.to_dict()), flat(ours.to_dict())
    keys = [k for k in a if a[k] != b[k] and k.partition(".")[0] not in POSTPROCESSING_KEYS]
    return ", ".join(f"{k} ({a[k]} there, {b[k]} here)" for k in keys)
