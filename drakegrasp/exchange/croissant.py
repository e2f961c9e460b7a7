"""Croissant metadata of a folder for the Hub (version 1.0 of mlcommons.org/croissant).

In: the Parquet files of the folder and their columns. Out: the content of `croissant.json`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drakegrasp.dataset.schema import Field

#: Types of Croissant by NumPy's letter of a kind.
_TYPES = {"f": "sc:Float", "i": "sc:Integer", "u": "sc:Integer", "b": "sc:Boolean"}
#: Terms of Croissant that mean what its vocabulary says.
_TERMS = (
    *("citeAs", "column", "extract", "field", "fileProperty", "fileObject", "fileSet", "format"),
    *("includes", "isLiveDataset", "jsonPath", "key", "md5", "parentField", "path", "recordSet"),
    *("references", "regex", "repeated", "replace", "separator", "source", "subField", "transform"),
)
#: The context that the specification prescribes.
_CONTEXT: dict[str, Any] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/",
    "dct": "http://purl.org/dc/terms/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "sc": "https://schema.org/",
    "conformsTo": "dct:conformsTo",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "examples": {"@id": "cr:examples", "@type": "@json"},
    **{term: f"cr:{term}" for term in _TERMS},
}


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
    source: dict[str, Any] = {"fileObject": {"@id": path}, "extract": {"column": column}}
    if field is None:  # an image: the bytes of a PNG file
        source["transform"] = {"jsonPath": "bytes"}
        kind, meaning = "sc:ImageObject", f"PNG file of the {column}."
    else:
        kind = "sc:Text" if field.dtype == "str" else _TYPES[np.dtype(field.dtype).kind]
        meaning = f"{field.meaning}{'' if field.unit == '-' else f' [{field.unit}]'}"
    return {
        "@type": "cr:Field",
        "@id": f"{record_set}/{column}",
        "name": column,
        "description": meaning,
        "dataType": kind,
        "repeated": field is not None and bool(field.axes),
        "source": source,
    }
