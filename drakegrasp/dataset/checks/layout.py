"""Rules of a file's layout: its attributes, groups and datasets are those of the schema.

In: an open HDF5 file. Out: its configuration, and a `Violation` for each difference from the
fields of `schema` or from that configuration. No row is read.
"""

from __future__ import annotations

from collections.abc import Iterator

import h5py
import numpy as np

from drakegrasp.config import Config, parse_stored
from drakegrasp.dataset.checks.findings import Violation
from drakegrasp.dataset.layout.attributes import OF_CAMERA, ORIGIN, attribute_mistakes
from drakegrasp.dataset.layout.structure import Difference, Tables, differences
from drakegrasp.dataset.schema import (
    CONVENTIONS,
    OTHER_SCHEMA,
    SCHEMA_VERSION,
)
from drakegrasp.errors import first_line
from drakegrasp.runtime.json_text import parse_json
from drakegrasp.vision.camera import intrinsics

#: K, near and far are float64 copies of the configuration's values.
CAMERA_TOLERANCE = 1e-9


def read_config(name: str, file: h5py.File) -> tuple[Config | None, list[Violation]]:
    """Return the configuration in a file, if it is sound, and what is wrong with it."""
    try:
        return parse_stored(parse_json(str(file.attrs["config"]))), []
    except KeyError:
        got = "none"
    except ValueError as error:  # no JSON, or no configuration
        got = f"another ({first_line(error)})"
    what = "attribute config must be a configuration of drakegrasp as JSON"
    return None, [Violation(file=name, what=what, got=got)]


def version(name: str, file: h5py.File) -> Iterator[Violation]:
    """The file is of this version of the schema."""
    got = file.attrs.get("schema_version", "none")
    if not isinstance(got, int | np.integer) or got != SCHEMA_VERSION:
        what = f"attribute schema_version must be {SCHEMA_VERSION}"
        yield Violation(file=name, what=what, got=f"{got}; {OTHER_SCHEMA}")


def attributes(
    name: str, file: h5py.File, config: Config | None, camera: str
) -> Iterator[Violation]:
    """The attributes are there and agree with the configuration.

    Args:
        name: Name of the file, for the violations.
        file: The file.
        config: Its configuration, if it is sound.
        camera: `oto` or `otm`; empty for the trials.
    """
    attrs = file.attrs

    def broken(what: str, got: object) -> Violation:
        return Violation(file=name, what=f"attribute {what}", got=str(got))

    # Each by itself. What it says is compared if it says something.
    wrong = set()
    for mistake in attribute_mistakes(file, OF_CAMERA if camera else ORIGIN):
        wrong.add(mistake.key)
        if mistake.key != "config":  # `read_config` says it
            yield broken(f"{mistake.key} must be {mistake.must}", mistake.got)
    for key in CONVENTIONS:
        if not str(attrs.get(f"convention_{key}", "")).strip():
            yield broken(f"convention_{key} must be there", "none")

    # Values that are known.
    expected: dict[str, object] = {"camera": camera} if camera else {}
    if config is not None:
        expected |= {"config_hash": config.simulation_hash(), "seed": config.seed}
    for key, value in expected.items():
        if key not in wrong and attrs[key] != value:
            yield broken(f"{key} must be {value}", attrs[key])

    # Numbers that follow from the configuration.
    if config is not None:
        numbers = {
            "K": intrinsics(config.camera),
            "near": np.array(config.camera.near),
            "far": np.array(config.camera.far),
        }
        for key, number in numbers.items():
            stored = np.asarray(number if key in wrong else attrs[key])
            if not np.allclose(stored, number, rtol=CAMERA_TOLERANCE, atol=CAMERA_TOLERANCE):
                yield broken(f"{key} must be {number.tolist()}", stored.tolist())


def structure(
    name: str, file: h5py.File, tables: Tables, config: Config | None
) -> Iterator[tuple[Violation, Difference]]:
    """Groups, datasets, types, shapes and the datasets' attributes are those of the schema.

    Args:
        name: Name of the file, for the violations.
        file: The file.
        tables: Fields of each group.
        config: Its configuration, if it is sound, for the size of the images.
    """
    image = None if config is None else config.camera.size
    for found in differences(file, tables, image=image, thorough=True):
        yield Violation(file=name, group=found.path, what=found.what, got=found.got), found
