"""What a publication says: who publishes a dataset, and its metadata in Croissant 1.1.

In: a YAML file of what only the publishers can say (name, version, authors, date); the Parquet
files of a folder for the Hub, their columns and the data card. Out: a `Publication`, and the
content of `croissant.json` (mlcommons.org/croissant), with the fields of its RAI vocabulary 1.0.
"""

from __future__ import annotations

import datetime
import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml
from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic import Field as Key

from drakegrasp.config import describe_mistake
from drakegrasp.dataset.schema import Field
from drakegrasp.errors import DataError, one_line
from drakegrasp.foreign_files import read_text
from drakegrasp.yaml_text import parse_yaml

if TYPE_CHECKING:
    from drakegrasp.exchange.hub import ParquetFile


class Publication(BaseModel):
    """Attributes are the keys of the file, all optional.

    Attributes:
        name: Of the dataset, e.g. "Mugs and bowls, Allegro Hand".
        version: Semantic version of the dataset, e.g. 1.0.0.
        url: Address of its page.
        creators: Names of people or groups.
        published: Day on which it was published.
        licence: Identifier, e.g. cc-by-4.0.
        citation: How to cite it, as BibTeX.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str | None = Key(default=None, min_length=1)
    version: str | None = Key(default=None, pattern=r"^\d+\.\d+\.\d+([-+].+)?$")
    url: str | None = Key(default=None, pattern=r"^https?://\S+$")
    creators: tuple[str, ...] = ()
    published: datetime.date | None = None
    licence: str | None = Key(default=None, min_length=1)
    citation: str | None = Key(default=None, min_length=1)


#: What Croissant 1.1 demands and no program knows.
REQUIRED = ("name", "url", "creators", "published", "licence")


def read_publication(path: Path) -> Publication:
    """Return the content of a file.

    Raises:
        DataError: If it is not readable YAML, has an unknown key, or a value of another form.
    """
    try:
        content = parse_yaml(read_text(path))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise DataError(f"{path}: must be a readable YAML file, got: {one_line(error)}") from error
    try:
        return Publication.model_validate({} if content is None else content)
    except ValidationError as error:
        keys = ", ".join(Publication.model_fields)
        line = describe_mistake(error.errors()[0], whole="the file", legal=f"a known key ({keys})")
        raise DataError(f"{path}: {line}") from error


def not_said(publication: Publication) -> list[str]:
    """Return the keys that a published dataset must have and this one lacks."""
    return [key for key in REQUIRED if not getattr(publication, key)]


#: Types of Croissant by NumPy's letter of a kind.
_TYPES = {"f": "sc:Float", "i": "sc:Integer", "u": "sc:Integer", "b": "sc:Boolean"}
#: Terms of Croissant that mean what its vocabulary says.
_TERMS = (
    *("arrayShape", "citeAs", "column", "containedIn", "equivalentProperty", "extract", "field"),
    *("fileProperty", "fileObject", "fileSet", "format", "includes", "isArray", "isLiveDataset"),
    *("jsonPath", "key", "md5", "parentField", "path", "recordSet", "references", "regex"),
    *("repeated", "replace", "samplingRate", "separator", "source", "subField", "transform"),
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
    "description": {"@container": "@language"},
    "name": {"@container": "@language"},
    **{term: f"cr:{term}" for term in _TERMS},
}


def croissant(
    folder: Path,
    files: Sequence[ParquetFile],
    card: Mapping[str, Any],
    publication: Publication,
) -> dict[str, Any]:
    """Return the content of `croissant.json`.

    Args:
        folder: With the files.
        files: The files that were written.
        card: Content of the data card (`card_content`).
        publication: What the publishers say; keys that they do not say are left out.
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
    said = {
        "license": publication.licence,
        "version": publication.version,
        "url": publication.url,
        "creator": [{"@type": "sc:Organization", "name": name} for name in publication.creators],
        "datePublished": publication.published and publication.published.isoformat(),
        "citeAs": publication.citation,
    }
    return {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "name": publication.name or card["title"],
        "description": "Simulated multi-finger grasps, each with the images of its camera.",
        "conformsTo": [
            "http://mlcommons.org/croissant/1.1",
            "http://mlcommons.org/croissant/RAI/1.0",
        ],
        **{key: value for key, value in said.items() if value},
        **_responsibility(card),
        "distribution": distribution,
        "recordSet": [_record_set(file) for file in files],
    }


def _responsibility(card: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of Croissant's RAI vocabulary, all from the data card."""
    # How many, of what, by which programs.
    counts = card["counts"]
    everything, removals = counts["all"], counts["removed"]
    samples = [row["samples"] for row in counts["classes"].values()]
    versions = ", ".join(f"{name} {card['versions'][name]}" for name in ("drakegrasp", "drake"))
    reasons = ", ".join(f"{count} {reason}" for reason, count in removals.items()) or "none"

    # Only what is known of every dataset that drakegrasp makes.
    return {
        "rai:dataCollection": (
            f"Simulated with {versions}, hand {card['hand']}: {everything['attempts']} attempts to "
            f"grasp, of which {everything['held']} hold. No people and no robot took part."
        ),
        "rai:dataCollectionType": "Software Collection",
        "rai:dataPreprocessingProtocol": (
            f"Filters removed {sum(removals.values())} held grasps: {reasons}."
        ),
        "rai:dataAnnotationProtocol": (
            "Each label is the outcome of a simulated lift; no network made or corrected one."
        ),
        "rai:dataBiases": [
            f"{len(counts['objects'])} objects of {len(counts['classes'])} classes, with "
            f"{min(samples)} to {max(samples)} samples each."
        ],
        "rai:dataLimitations": [entry["limit"] for entry in card["limits"]],
        "rai:dataUseCases": ["Training and testing of networks that predict grasps from images."],
        "rai:personalSensitiveInformation": ["None."],
    }


def _record_set(file: ParquetFile) -> dict[str, Any]:
    columns, name = file.table.columns, file.path.removesuffix(".parquet")
    return {
        "@type": "cr:RecordSet",
        "@id": name,
        "name": name,
        "description": file.table.what,
        "field": [_field(name, file.path, column, field) for column, field in columns.items()],
    }


def _field(record_set: str, path: str, column: str, field: Field | None) -> dict[str, Any]:
    source: dict[str, Any] = {"fileObject": {"@id": path}, "extract": {"column": column}}
    if field is None or field.sample:  # an image: the bytes of a PNG file
        source["transform"] = {"jsonPath": "bytes"}
        kind, repeated = "sc:ImageObject", False
    else:
        kind = "sc:Text" if field.dtype == "str" else _TYPES[np.dtype(field.dtype).kind]
        repeated = bool(field.axes)
    meaning = f"PNG file of the {column}."
    if field is not None:
        meaning = f"{field.meaning}{'' if field.unit == '-' else f' [{field.unit}]'}"
    return {
        "@type": "cr:Field",
        "@id": f"{record_set}/{column}",
        "name": column,
        "description": meaning,
        "dataType": kind,
        "repeated": repeated,
        "source": source,
    }
