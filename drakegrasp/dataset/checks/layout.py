"""Rules of a file's layout: its attributes, groups and datasets are those of the schema.

In: an open HDF5 file. Out: its configuration, and a `Violation` for each difference from the
fields of `schema` or from that configuration. No row is read.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping

import h5py
import numpy as np

from drakegrasp.config import Config, parse_config
from drakegrasp.dataset.checks.findings import Violation
from drakegrasp.dataset.schema import (
    CONVENTIONS,
    OTHER_SCHEMA,
    SCHEMA_VERSION,
    SPLITS,
    Field,
    sizes,
)
from drakegrasp.errors import ConfigError, first_line
from drakegrasp.vision.camera import intrinsics

#: K, near and far are float64 copies of the configuration's values.
CAMERA_TOLERANCE = 1e-9
#: Datasets whose second axis has the length of a letter of the shapes, and its factor there.
WIDTHS = (
    *((f"{split}/{name}", "k", 6) for split in SPLITS for name in ("grasps", "grasps_held")),
    *((f"{split}/grasp_props/{name}", "k", 1) for split in SPLITS for name in ("area", "f_Q_C")),
    *((f"{split}/grasp_props/{name}", "j", 1) for split in SPLITS for name in ("q", "q_held")),
    *((f"trials/{name}", "k", 1) for name in ("closed_touching", "closed_area", "lifted_area")),
    *((f"trials/{name}", "j", 1) for name in ("closed_q", "lifted_q")),
)


def read_config(name: str, file: h5py.File) -> tuple[Config | None, list[Violation]]:
    """Return the configuration in a file, if it is sound, and what is wrong with it."""
    try:
        return parse_config(json.loads(str(file.attrs["config"]))), []
    except KeyError:
        got = "none"
    except (json.JSONDecodeError, ConfigError) as error:
        got = f"another ({first_line(error)})"
    what = "attribute config must be a configuration of drakegrasp as JSON"
    return None, [Violation(file=name, what=what, got=got)]


def version(name: str, file: h5py.File) -> Iterator[Violation]:
    """The file is of this version of the schema."""
    got = file.attrs.get("schema_version", "none")
    if got != SCHEMA_VERSION:
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

    # Texts that must be there, whatever they say.
    required = [*(f"convention_{key}" for key in CONVENTIONS), "signature", "shards", "versions"]
    for key in required:
        if not str(attrs.get(key, "")).strip():
            yield broken(f"{key} must be there", "none")

    # Values that are known.
    expected: dict[str, object] = {"camera": camera} if camera else {}
    if config is not None:
        expected |= {"config_hash": config.simulation_hash(), "seed": config.seed}
    for key, value in expected.items():
        if attrs.get(key) != value:
            yield broken(f"{key} must be {value}", attrs.get(key, "none"))
    if "versions" in attrs and not _is_json_object(str(attrs["versions"])):
        yield broken("versions must be a JSON object", attrs["versions"])

    # Numbers that follow from the configuration.
    if config is not None:
        numbers = {
            "K": intrinsics(config.camera),
            "near": np.array(config.camera.near),
            "far": np.array(config.camera.far),
        }
        for key, number in numbers.items():
            stored = np.asarray(attrs.get(key, np.nan))
            if stored.shape != number.shape or not np.allclose(
                stored, number, rtol=CAMERA_TOLERANCE, atol=CAMERA_TOLERANCE
            ):
                yield broken(f"{key} must be {number.tolist()}", stored.tolist())


def structure(
    name: str, file: h5py.File, fields: Mapping[str, tuple[Field, ...]], config: Config | None
) -> Iterator[Violation]:
    """Groups, datasets, types, shapes and the datasets' attributes are those of the schema.

    Args:
        name: Name of the file, for the violations.
        file: The file.
        fields: Fields of each group.
        config: Its configuration, if it is sound, for the size of the images.
    """
    for extra in sorted(set(file) - set(fields)):
        yield Violation(file=name, what="groups must be those of the schema", got=f"/{extra} too")
    letters = _letters(file, config)
    for group_name, table in fields.items():
        group = file.get(group_name)
        if not isinstance(group, h5py.Group):
            yield Violation(
                file=name, group=f"/{group_name}", what="the group must be there", got="none"
            )
            continue

        # No other datasets.
        datasets = _datasets(group)
        for key in sorted(set(datasets) - {f.name for f in table}):
            yield Violation(
                file=name,
                group=f"/{group_name}",
                what="datasets must be those of the schema",
                got=f"{key} too",
            )

        # Each field by itself; the number of rows is that of most datasets.
        counts = [len(group[f.name]) for f in table if f.name in datasets and group[f.name].shape]
        rows = max(counts, key=counts.count, default=0)
        for f in table:
            dataset = group[f.name] if f.name in datasets else None
            yield from _field(name, f"/{group_name}/{f.name}", dataset, f, rows, letters)


def _datasets(group: h5py.Group) -> list[str]:
    """Return the paths of all datasets in a group and the groups in it."""
    paths: list[str] = []

    def visit(name: str, node: h5py.Dataset | h5py.Group) -> None:
        if isinstance(node, h5py.Dataset):
            paths.append(name)

    group.visititems(visit)
    return paths


def _field(
    name: str,
    place: str,
    dataset: h5py.Dataset | None,
    field: Field,
    rows: int,
    letters: Mapping[str, int],
) -> Iterator[Violation]:
    """A dataset has the type, shape and attributes of its field.

    Args:
        name: Name of the file, for the violations.
        place: Path of the dataset.
        dataset: The dataset; None if it is missing.
        field: The field.
        rows: Number of rows that it must have.
        letters: Lengths of the letters in the shapes, where they are known.
    """

    def broken(what: str, got: object) -> Violation:
        return Violation(file=name, group=place, what=what, got=str(got))

    if dataset is None:
        yield broken("the dataset must be there", "none")
        return

    # Type and shape.
    text = h5py.check_string_dtype(dataset.dtype) is not None
    if text != (field.dtype == "str") or not (text or dataset.dtype == np.dtype(field.dtype)):
        yield broken(f"type must be {field.dtype}", dataset.dtype)
    try:
        shape = (rows, *field.row_shape(letters))
    except KeyError:
        shape = (rows, *dataset.shape[1:])  # no sound dataset tells the length of a letter
    if dataset.shape != shape:
        yield broken(f"shape must be {shape}", dataset.shape)

    # Attributes.
    for key, value in (("unit", field.unit), ("frame", field.frame)):
        if dataset.attrs.get(key) != value:
            yield broken(f"attribute {key} must be {value!r}", repr(dataset.attrs.get(key)))
    # Wording may improve without a new version of the schema.
    if not str(dataset.attrs.get("meaning", "")):
        yield broken("attribute meaning must be there", "none")


def _letters(file: h5py.File, config: Config | None) -> dict[str, int]:
    """Return the lengths of the letters in the shapes that most datasets of the file agree on."""
    widths: dict[str, list[int]] = {"k": [], "j": []}
    for place, letter, each in WIDTHS:
        dataset = file.get(place)
        if isinstance(dataset, h5py.Dataset) and dataset.ndim > 1:
            widths[letter].append(dataset.shape[1] // each)
    k, j = (max(lengths, key=lengths.count, default=0) for lengths in widths.values())
    known = sizes(fingers=k, joints=j, image=config.camera.size if config else 0)
    return {letter: size for letter, size in known.items() if size}


def _is_json_object(text: str) -> bool:
    try:
        return isinstance(json.loads(text), dict)
    except json.JSONDecodeError:
        return False
