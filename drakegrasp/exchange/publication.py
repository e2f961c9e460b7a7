"""What only the people who publish a dataset can say of it: name, version, authors, date.

In: a YAML file. Out: a `Publication`, for the dataset card of the Hub and for Croissant.
"""

from __future__ import annotations

import datetime
from pathlib import Path

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from drakegrasp.config import describe_mistake
from drakegrasp.errors import DataError, one_line
from drakegrasp.foreign_files import read_text
from drakegrasp.yaml_text import parse_yaml


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

    name: str | None = Field(default=None, min_length=1)
    version: str | None = Field(default=None, pattern=r"^\d+\.\d+\.\d+([-+].+)?$")
    url: str | None = Field(default=None, pattern=r"^https?://\S+$")
    creators: tuple[str, ...] = ()
    published: datetime.date | None = None
    licence: str | None = Field(default=None, min_length=1)
    citation: str | None = Field(default=None, min_length=1)


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
