"""How a file must be laid out: its attributes, groups and datasets, as the table has them.

In: an open HDF5 file. Out: its configuration, and a `Violation` for all that differs from
the table of fields (`schema`) or from that configuration. No row is read.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping

import h5py
import numpy as np

from drakegrasp.config import Config, parse_config
from drakegrasp.dataset.checks.findings import Violation
from drakegrasp.dataset.schema import CONVENTIONS, SCHEMA_VERSION, SPLITS, Field, sizes
from drakegrasp.errors import ConfigError, first_line
from drakegrasp.vision.camera import intrinsics

#: K, near and far are float64 copies of what the configuration gives.
CAMERA_TOLERANCE = 1e-9
#: Datasets whose second axis tells a letter of the shapes, and how often it counts there.
WIDTHS = (
    *((f"{split}/grasps", "k", 6) for split in SPLITS),
    *((f"trials/{name}", "k", 1) for name in ("closed_touching", "closed_area", "lifted_area")),
    *((f"trials/{name}", "j", 1) for name in ("closed_q", "lifted_q")),
)


def read_config(name: str, file: h5py.File) -> tuple[Config | None, list[Violation]]:
    """Return the configuration that is stored in a file, if it is sound."""
    try:
        return parse_config(json.loads(str(file.attrs["config"]))), []
    except KeyError:
        got = "none"
    except (json.JSONDecodeError, ConfigError) as error:
        got = f"another ({first_line(error)})"
    what = "attribute config must be a configuration of drakegrasp as JSON"
    return None, [Violation(file=name, what=what, got=got)]


def attributes(
    name: str, file: h5py.File, config: Config | None, camera: str
) -> Iterator[Violation]:
    """The attributes say what the file is of, and agree with its configuration.

    Args:
        name: Of the file, for the violations.
        file: The file.
        config: That it holds.
        camera: `oto` or `otm`; empty for the trials.
    """
    attrs = file.attrs

    def broken(what: str, got: object) -> Violation:
        return Violation(file=name, what=f"attribute {what}", got=str(got))

    required = [*(f"convention_{key}" for key in CONVENTIONS), "signature", "versions"]
    for key in required:
        if not str(attrs.get(key, "")).strip():
            yield broken(f"{key} must be there", "none")
    expected: dict[str, object] = {"schema_version": SCHEMA_VERSION}
    if camera:
        expected["camera"] = camera
    if config is not None:
        expected |= {"config_hash": config.simulation_hash(), "seed": config.seed}
    for key, value in expected.items():
        if attrs.get(key) != value:
            yield broken(f"{key} must be {value}", attrs.get(key, "none"))
    if "versions" in attrs and not _is_json_object(str(attrs["versions"])):
        yield broken("versions must be a JSON object", attrs["versions"])
    if config is not None:
        numbers = {
            "K": intrinsics(config.camera),
            "near": np.array(config.camera.near),
            "far": np.array(config.camera.far),
        }
        for key, number in numbers.items():
            found = np.asarray(attrs.get(key, np.nan))
            if found.shape != number.shape or not np.allclose(
                found, number, rtol=CAMERA_TOLERANCE, atol=CAMERA_TOLERANCE
            ):
                yield broken(f"{key} must be {number.tolist()}", found.tolist())


def structure(
    name: str, file: h5py.File, fields: Mapping[str, tuple[Field, ...]], config: Config | None
) -> Iterator[Violation]:
    """Groups, datasets, types, shapes and their attributes are those of the table.

    Args:
        name: Of the file, for the violations.
        file: The file.
        fields: Of each group.
        config: Says how large the images are, if it is known.
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
        found = _datasets(group)
        for key in sorted(set(found) - {f.name for f in table}):
            yield Violation(
                file=name,
                group=f"/{group_name}",
                what="datasets must be those of the schema",
                got=f"{key} too",
            )
        counts = [len(group[f.name]) for f in table if f.name in found and group[f.name].shape]
        rows = max(counts, key=counts.count, default=0)
        for f in table:
            dataset = group[f.name] if f.name in found else None
            yield from _field(name, f"/{group_name}/{f.name}", dataset, f, rows, letters)


def _datasets(group: h5py.Group) -> list[str]:
    """Return the names of all datasets in a group, those of its groups with their path."""
    found: list[str] = []

    def visit(name: str, node: h5py.Dataset | h5py.Group) -> None:
        if isinstance(node, h5py.Dataset):
            found.append(name)

    group.visititems(visit)
    return found


def _field(
    name: str,
    place: str,
    dataset: h5py.Dataset | None,
    field: Field,
    rows: int,
    letters: Mapping[str, int],
) -> Iterator[Violation]:
    def broken(what: str, got: object) -> Violation:
        return Violation(file=name, group=place, what=what, got=str(got))

    if dataset is None:
        yield broken("the dataset must be there", "none")
        return
    text = h5py.check_string_dtype(dataset.dtype) is not None
    if text != (field.dtype == "str") or not (text or dataset.dtype == np.dtype(field.dtype)):
        yield broken(f"type must be {field.dtype}", dataset.dtype)
    try:
        shape = (rows, *field.row_shape(letters))
    except KeyError:
        shape = (rows, *dataset.shape[1:])  # a letter whose size no sound dataset tells
    if dataset.shape != shape:
        yield broken(f"shape must be {shape}", dataset.shape)
    for key, value in (("unit", field.unit), ("frame", field.frame)):
        if dataset.attrs.get(key) != value:
            yield broken(f"attribute {key} must be {value!r}", repr(dataset.attrs.get(key)))
    # Wording may improve without a new version of the schema.
    if not str(dataset.attrs.get("meaning", "")):
        yield broken("attribute meaning must be there", "none")


def _letters(file: h5py.File, config: Config | None) -> dict[str, int]:
    """Return the sizes of the letters in the shapes, from the file's own majority."""
    found: dict[str, list[int]] = {"k": [], "j": []}
    for place, letter, each in WIDTHS:
        dataset = file.get(place)
        if isinstance(dataset, h5py.Dataset) and dataset.ndim > 1:
            found[letter].append(dataset.shape[1] // each)
    k, j = (max(widths, key=widths.count, default=0) for widths in found.values())
    known = sizes(fingers=k, joints=j, image=config.camera.size if config else 0)
    return {letter: size for letter, size in known.items() if size}


def _is_json_object(text: str) -> bool:
    try:
        return isinstance(json.loads(text), dict)
    except json.JSONDecodeError:
        return False
