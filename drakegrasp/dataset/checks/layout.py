"""Rules of a file's layout: its attributes, groups and datasets are those of the schema.

In: an HDF5 file with any content. Out: what is known of it, with those groups whose rows can be
read; a `Violation` for each difference from the schema or from its configuration. No row is read.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import h5py
import numpy as np

from drakegrasp.config import Config, parse_stored
from drakegrasp.dataset.assembly.decisions import lens_attributes
from drakegrasp.dataset.checks.findings import Findings, Violation, of_file
from drakegrasp.dataset.checks.rows import CheckedFile, identity
from drakegrasp.dataset.opening import (
    DATA_TABLES,
    OF_CAMERA,
    OF_SCENES,
    ORIGIN,
    SCENE_TABLES,
    TRIAL_TABLES,
    attribute_mistakes,
    differences,
)
from drakegrasp.dataset.schema import CAMERAS, CONVENTIONS, OTHER_SCHEMA, SCHEMA_VERSION
from drakegrasp.errors import first_line
from drakegrasp.foreign_files import parse_json

#: Key of scenes.hdf5 among the files that are checked.
SCENES = "scenes"
#: K, near and far are float64 copies of the configuration's values.
CAMERA_TOLERANCE = 1e-9


def look_at(name: str, file: h5py.File, camera: str, findings: Findings) -> CheckedFile:
    """Check the attributes and the layout of a file, and return what the rules of rows need.

    Args:
        name: Name of the file, for the violations.
        file: The file.
        camera: `oto` or `otm`; empty for the trials.
        findings: Where violations go.
    """
    scenes = camera == SCENES
    fields = SCENE_TABLES if scenes else DATA_TABLES if camera else TRIAL_TABLES
    rules = OF_SCENES if scenes else OF_CAMERA if camera else ORIGIN
    config, attributes, counts = None, dict[str, Any](), dict[str, int]()

    # Another version has another layout: its version is all that is told.
    version = file.attrs.get("schema_version", "none")
    if not isinstance(version, int | np.integer) or version != SCHEMA_VERSION:
        what = f"attribute schema_version must be {SCHEMA_VERSION}"
        findings.add([of_file(name, what, f"{version}; {OTHER_SCHEMA}")])
    else:
        # Its attributes: those that break no rule of their own are compared.
        mistakes = attribute_mistakes(file, rules)
        attributes = {key: value for key, value in file.attrs.items() if key not in mistakes}
        for key, mistake in mistakes.items():
            if key != "config":  # `_read_config` says it
                findings.add([of_file(name, mistake.what, mistake.got)])
        config = _read_config(name, file, findings)
        findings.add(_attributes(name, attributes, config, camera))

        # Its layout: a group with a broken dataset is not read.
        image, broken = None if config is None else config.camera.size, set()
        for found in differences(file, fields, image=image, thorough=True):
            findings.add([of_file(name, found.what, found.got, found.path)])
            if not found.text_only:
                broken.add(found.path[1:].split("/")[0])
        sound = [group for group in fields if group in file and group not in broken]
        counts = {group: len(file[group][fields[group][0].name]) for group in sound}
    return CheckedFile(
        path=file.filename,
        identity=identity(file),
        name=name,
        attributes=attributes,
        config=config,
        fields=fields,
        counts=counts,
    )


def _read_config(name: str, file: h5py.File, findings: Findings) -> Config | None:
    """Return the configuration in a file, if it is sound."""
    try:
        return parse_stored(parse_json(str(file.attrs["config"])))
    except KeyError:
        got = "none"
    except ValueError as error:  # no JSON, or no configuration
        got = f"another ({first_line(error)})"
    findings.add([of_file(name, "attribute config must be a configuration of drakegrasp", got)])
    return None


def _attributes(
    name: str, attributes: Mapping[str, Any], config: Config | None, camera: str
) -> Iterator[Violation]:
    """The attributes agree with the configuration; conventions are there."""
    for key in CONVENTIONS:
        if not str(attributes.get(f"convention_{key}", "")).strip():
            yield of_file(name, f"attribute convention_{key} must be there", "none")

    due: dict[str, Any] = {"camera": camera} if camera in CAMERAS else {}
    if config is not None:
        due |= {"config_hash": config.simulation_hash(), "seed": config.seed}
        if camera == SCENES:
            due |= {"near": config.scenes.near, "far": config.scenes.far}
        else:
            due |= lens_attributes(config.camera)
    for key in due.keys() & attributes.keys():
        value, expected = attributes[key], due[key]
        same = value == expected
        if not isinstance(expected, str | int):
            same = np.allclose(value, expected, rtol=CAMERA_TOLERANCE, atol=CAMERA_TOLERANCE)
        if not same:
            expected = expected.tolist() if isinstance(expected, np.ndarray) else expected
            yield of_file(name, f"attribute {key} must be {expected}", value)
