"""What a hub folder says of itself: the dataset card for people, Croissant metadata for programs.

In: a dataset and the Parquet files that were written of it. Out: the text of `README.md`, whose
head in YAML the Hub and `datasets` read, and the content of `croissant.json` (version 1.0 of
mlcommons.org/croissant).
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from drakegrasp.dataset.card.content import card_content
from drakegrasp.dataset.card.text import card_text
from drakegrasp.dataset.layout.opening import open_samples
from drakegrasp.dataset.paths import DATA_FILES
from drakegrasp.dataset.schema import CAMERAS, SPLITS, Field

#: Depth of one unit of a depth image [m]: a tenth of a millimetre, up to 6.5 m.
DEPTH_UNIT = 1e-4
#: Columns that are images, made of the fields `images` and `masks`, and what they hold.
IMAGES = {
    "image": "colour, 8-bit PNG",
    "depth": "16-bit PNG in units of 0.1 mm",
    "mask": "8-bit PNG, 255 where the object is seen, else 0",
}
#: The files of a folder, in words.
FILES = {
    "oto/, otm/": "the samples, as each camera sees them, in Parquet files",
    "croissant.json": "the same for programs, with a hash of each file",
}
#: What is not as in the files of a dataset.
CONVENTIONS = {
    "depth": "z of the camera frame in units of 0.1 mm; see Camera for pixels that show nothing",
    "images": "PNG files; row 0 is the top",
}
#: Types of Croissant by NumPy's letter of a kind.
_TYPES = {"f": "sc:Float", "i": "sc:Integer", "u": "sc:Integer", "b": "sc:Boolean"}


@dataclass(frozen=True, kw_only=True)
class ParquetFile:
    """A file of a hub folder.

    Attributes:
        camera: `oto` or `otm`.
        split: `train`, `valid` or `test`.
        path: Below the folder.
        rows: Number of samples.
    """

    camera: str
    split: str
    path: str
    rows: int


def card(
    out: Path,
    files: Sequence[ParquetFile],
    columns: Mapping[str, Field | None],
    *,
    licence: str,
) -> str:
    """Return the text of the dataset card.

    Args:
        out: Directory of the dataset.
        files: The files that were written.
        columns: Fields by the columns' names; None for an image.
        licence: Identifier of the licence.
    """
    content = card_content(out) | {"files": FILES}
    content["conventions"] = {**content["conventions"], **CONVENTIONS}
    rows = {
        (c, s): sum(f.rows for f in files if (f.camera, f.split) == (c, s))
        for c in CAMERAS
        for s in SPLITS
    }

    # The head, which names the files of each configuration and split.
    head = {
        "license": licence,
        "pretty_name": content["title"],
        "task_categories": ["robotics"],
        "tags": ["robotics", "grasping", "simulation", "croissant"],
        "configs": [
            {
                "config_name": camera,
                "data_files": [
                    {"split": split, "path": f"{camera}/{split}-*.parquet"}
                    for split in SPLITS
                    if rows[camera, split]
                ],
            }
            for camera in CAMERAS
        ],
    }

    # The text: the card of the dataset, how much is in each file, and what its columns are.
    counts = "\n".join(
        f"| {split} | {rows['oto', split]:,} | {rows['otm', split]:,} |" for split in SPLITS
    )
    return f"""---
{yaml.safe_dump(head, sort_keys=False).strip()}
---

{card_text(content)}
## Samples by camera

| split | camera `oto` | camera `otm` |
|---|---|---|
{counts}

{_camera_text(out)}
## Columns

| column | shape | unit | frame | what it is |
|---|---|---|---|---|
{_column_rows(columns)}
"""


def _camera_text(out: Path) -> str:
    """Return how a pixel of a depth image is a point before the camera."""
    with open_samples(out / DATA_FILES["oto"]) as file:
        K, near, far = (np.asarray(file.attrs[name]).tolist() for name in ("K", "near", "far"))
    (fx, _, cx), (_, fy, cy) = K[:2]
    return f"""## Camera

Both cameras have focal lengths {fx:.6f} and {fy:.6f} and their centre at ({cx:g}, {cy:g}) [px].
A pixel (u, v) of depth z [m], {1.0 / DEPTH_UNIT:g} units of the image to a metre, is the point
((u - {cx:g}) z / {fx:.6f}, (v - {cy:g}) z / {fy:.6f}, z) in the camera's frame. The camera sees
from {near:g} m on; where nothing is before {far:g} m, the depth is {far:g} m.
"""


def _column_rows(columns: Mapping[str, Field | None]) -> str:
    """Return a row of a Markdown table per column."""
    rows = []
    for name, field in columns.items():
        if field is None:
            rows.append(f"| `{name}` | | | | {IMAGES[name]} |")
        else:
            shape = " x ".join(map(str, field.axes))
            meaning = field.meaning.replace("|", "\\|")
            rows.append(f"| `{name}` | {shape} | {field.unit} | {field.frame} | {meaning} |")
    return "\n".join(rows)


def croissant(
    folder: Path,
    files: Sequence[ParquetFile],
    columns: Mapping[str, Field | None],
    *,
    licence: str,
) -> dict[str, Any]:
    """Return the content of `croissant.json`.

    Args:
        folder: With the files.
        files: The files that were written.
        columns: Fields by the columns' names; None for an image.
        licence: Identifier of the licence.
    """
    # Each file with its hash, so that a damaged download shows.
    distribution = [
        {
            "@type": "cr:FileObject",
            "@id": file.path,
            "name": file.path,
            "contentUrl": file.path,
            "encodingFormat": "application/x-parquet",
            "sha256": hashlib.sha256((folder / file.path).read_bytes()).hexdigest(),
        }
        for file in files
    ]

    # The dataset, with the columns of each file.
    return {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "name": "drakegrasp",
        "description": "Simulated multi-finger grasps, each with the images of its camera.",
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "license": licence,
        "version": "1.0.0",
        "distribution": distribution,
        "recordSet": [_record_set(file, columns) for file in files],
    }


def _record_set(file: ParquetFile, columns: Mapping[str, Field | None]) -> dict[str, Any]:
    name = file.path.removesuffix(".parquet")
    return {
        "@type": "cr:RecordSet",
        "@id": name,
        "name": name,
        "description": f"Samples of split {file.split} as camera {file.camera} sees them.",
        "field": [_field(name, file.path, column, field) for column, field in columns.items()],
    }


def _field(record_set: str, path: str, column: str, field: Field | None) -> dict[str, Any]:
    # An image is the bytes of a PNG file.
    if field is None:
        return {
            "@type": "cr:Field",
            "@id": f"{record_set}/{column}",
            "name": column,
            "description": f"PNG file of the {column}.",
            "dataType": "sc:ImageObject",
            "source": {
                "fileObject": {"@id": path},
                "extract": {"column": column},
                "transform": {"jsonPath": "bytes"},
            },
        }

    # Everything else is text, a number, or an array of numbers.
    text = field.dtype == "str"
    units = "" if field.unit == "-" else f" [{field.unit}]"
    return {
        "@type": "cr:Field",
        "@id": f"{record_set}/{column}",
        "name": column,
        "description": f"{field.meaning}{units}",
        "dataType": "sc:Text" if text else _TYPES[_kind(field.dtype)],
        "repeated": bool(field.axes),
        "source": {"fileObject": {"@id": path}, "extract": {"column": column}},
    }


def _kind(dtype: str) -> str:
    return np.dtype(dtype).kind


#: The context that the specification prescribes.
_CONTEXT = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "citeAs": "cr:citeAs",
    "column": "cr:column",
    "conformsTo": "dct:conformsTo",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "dct": "http://purl.org/dc/terms/",
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "extract": "cr:extract",
    "field": "cr:field",
    "fileProperty": "cr:fileProperty",
    "fileObject": "cr:fileObject",
    "fileSet": "cr:fileSet",
    "format": "cr:format",
    "includes": "cr:includes",
    "isLiveDataset": "cr:isLiveDataset",
    "jsonPath": "cr:jsonPath",
    "key": "cr:key",
    "md5": "cr:md5",
    "parentField": "cr:parentField",
    "path": "cr:path",
    "recordSet": "cr:recordSet",
    "references": "cr:references",
    "regex": "cr:regex",
    "repeated": "cr:repeated",
    "replace": "cr:replace",
    "sc": "https://schema.org/",
    "separator": "cr:separator",
    "source": "cr:source",
    "subField": "cr:subField",
    "transform": "cr:transform",
}
