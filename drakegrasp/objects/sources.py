"""Sources of meshes: a directory comes in; names, classes and units of its meshes go out.

`find_meshes` lists the files of a directory and `load_source` reads one file;
`drakegrasp.objects.model` prepares the object that Drake simulates.

File names and `objects.yaml`: a mesh called `<number>_<class>_<rest>.ext` belongs to `<class>`,
which may itself contain underscores: the number is dropped, and so is the last part if at least two
parts remain (24_mug_final and 1_mug are mugs, 30_fruit_juicer_final is a fruit_juicer). A name
without a number is its own class. A file `objects.yaml` in the folder of the meshes overrides
the class of single meshes, and the unit of single or all meshes. It also states the
licence of the meshes, and properties that a file of triangles cannot specify:

    units: cm
    licence: CC-BY-4.0
    objects:
      95_boots_final: {units: m, class: boots, name: boots, mass: 0.4, friction: 0.9}
      7_scan: {scale: 1.02, up: +y, density: 700}
      8_scan_bent: {group: 7_scan}

Objects of a group are variants of one mesh: a split by object keeps them together. The group of an
object that names none is its own name.
"""

from __future__ import annotations

import hashlib
import unicodedata
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import pydantic
import trimesh
import yaml

from drakegrasp.arithmetic import multiply
from drakegrasp.config import Licence, Positive, describe_mistake
from drakegrasp.errors import MeshError, one_line
from drakegrasp.foreign_files import NAME_RULE, is_name, read_text
from drakegrasp.frames import Array
from drakegrasp.mesh.loading import SUFFIXES, clean_triangles, parse_mesh, read_bytes
from drakegrasp.yaml_text import parse_yaml

#: Metres per unit of length of a file.
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
#: Rotations (3, 3) that turn an axis of a file to +z; the one for +z is the identity.
UPRIGHT = {
    "+x": ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    "-x": ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
    "+y": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    "-y": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "+z": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "-z": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
}
MANIFEST_NAME = "objects.yaml"


@dataclass(frozen=True, kw_only=True)
class MeshSource:
    """A mesh file and what is known about it before it is read.

    Attributes:
        name: Unique name of the object; the file's stem unless the manifest states another one.
        class_name: Class of the object.
        path: The mesh file.
        scale: Metres per unit of length of the file.
        up: Axis of the file that points up, e.g. "+y"; it becomes +z of {O}.
        mass: Mass [kg]; None: it follows from the density, or from the configuration.
        density: Density [kg/m^3], instead of the mass.
        friction: Effective coefficient of friction with hand and table; None: the
            configuration's coefficients.
        licence: Identifier of the mesh's licence, e.g. one of spdx.org/licenses; None: not stated.
        group: Name shared by objects of the same mesh; None: the object's name.
    """

    name: str
    class_name: str
    path: Path
    scale: float = 1.0
    up: str = "+z"
    mass: float | None = None
    density: float | None = None
    friction: float | None = None
    licence: str | None = None
    group: str | None = None

    def __post_init__(self) -> None:
        names = {"name": self.name, "class": self.class_name, "group": self.group or self.name}
        for what, text in names.items():
            if not is_name(text):
                raise MeshError(f"{self.path.name}: the {what} must be {NAME_RULE}, got {text!r}")
        for what in ("scale", "mass", "density", "friction"):
            value = getattr(self, what)
            if value is not None and not (np.isfinite(value) and value > 0.0):
                raise MeshError(f"{self.path.name}: {what} must be positive, got {value}")
        if self.up not in UPRIGHT:
            raise MeshError(
                f"{self.path.name}: up must be one of {', '.join(UPRIGHT)}, got {self.up!r}"
            )
        if self.mass is not None and self.density is not None:
            raise MeshError(
                f"{self.path.name}: mass must not be given with density, got {self.mass:g} kg "
                f"and {self.density:g} kg/m^3"
            )


# Finding meshes


class _Entry(pydantic.BaseModel):
    model_config = pydantic.ConfigDict(extra="forbid", coerce_numbers_to_str=True)

    units: Literal["m", "cm", "mm"] | None = None
    scale: Positive = 1.0
    up: Literal["+x", "-x", "+y", "-y", "+z", "-z"] = "+z"
    class_name: str | None = pydantic.Field(default=None, alias="class")
    name: str | None = None
    mass: Positive | None = None
    density: Positive | None = None
    friction: Positive | None = None
    licence: Licence | None = None
    group: str | None = None

    @pydantic.field_validator("scale", "mass", "density", "friction", mode="before")
    @classmethod
    def _no_truth_values(cls, value: object) -> object:
        # YAML reads "yes" as true, which pydantic would accept as the number 1.
        return str(value) if isinstance(value, bool) else value


class _Manifest(pydantic.BaseModel):
    model_config = pydantic.ConfigDict(extra="forbid", coerce_numbers_to_str=True)

    units: Literal["m", "cm", "mm"] | None = None
    licence: Licence | None = None
    objects: dict[str, _Entry] = pydantic.Field(default_factory=dict)

    @pydantic.field_validator("objects", mode="before")
    @classmethod
    def _empty_section(cls, value: object) -> object:
        # A section whose keys are all commented out is read as None.
        return {} if value is None else value


def _read_manifest(path: Path) -> _Manifest:
    """Return the content of an `objects.yaml`."""
    try:
        content = parse_yaml(read_text(path))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise MeshError(f"{path}: must be a readable YAML file, got: {one_line(error)}") from error
    try:
        return _Manifest.model_validate({} if content is None else content)
    except pydantic.ValidationError as error:
        mistake = error.errors()[0]
        model = _Entry if mistake["loc"][:1] == ("objects",) else _Manifest
        keys = ", ".join(field.alias or name for name, field in model.model_fields.items())
        line = describe_mistake(mistake, whole="the file", legal=f"a known key ({keys})")
        raise MeshError(f"{path}: {line}") from error


def _class_of(stem: str) -> str:
    """Return the class that a file's stem names, as the module's docstring describes."""
    number, *parts = stem.split("_")
    if not (number.isdigit() and parts):
        return stem
    return "_".join(parts[:-1] if len(parts) > 1 else parts) or stem


def find_meshes(
    directory: str | Path, *, units: str = "m", manifest: str | Path | None = None
) -> list[MeshSource]:
    """Return the meshes of a directory, sorted by name; subdirectories are not searched.

    Args:
        directory: Directory of .obj, .stl, .ply and .glb files.
        units: Unit of length of the files: m, cm or mm. The manifest's unit for all meshes
            overrides it, and the manifest's unit for one mesh overrides both.
        manifest: A YAML file as the module's docstring describes; if None, `objects.yaml` in
            `directory`, if it exists.

    Raises:
        MeshError: If there is no mesh, two have the same name, or the manifest is invalid.
    """
    # The mesh files.
    directory = Path(directory)
    validate_units(units)
    try:
        paths = [
            path
            for path in directory.iterdir()
            if path.suffix.lower() in SUFFIXES and path.name[0] != "." and path.is_file()
        ]
    except (OSError, ValueError) as error:
        got = getattr(error, "strerror", None) or error
        raise MeshError(f"{directory}: must be a directory of meshes, got: {got}") from error
    if not paths:
        raise MeshError(
            f"{directory}: must hold at least one mesh ({', '.join(SUFFIXES)}), got none"
        )

    # The stems of the files; some file systems store é as two characters, the manifest as one.
    stems = {path: unicodedata.normalize("NFC", path.stem) for path in sorted(paths)}

    # The manifest, which may only refer to these files.
    if manifest is None and (directory / MANIFEST_NAME).is_file():
        manifest = directory / MANIFEST_NAME
    table = _Manifest() if manifest is None else _read_manifest(Path(manifest))
    entries = _entries(table)
    unknown = sorted(set(entries) - set(stems.values()))
    if unknown:
        raise MeshError(
            f"{manifest}: objects must be names of meshes in {directory}: "
            f"{', '.join(sorted(stems.values()))}; got {', '.join(unknown)}"
        )

    sources = [_source(path, stem, table, units) for path, stem in stems.items()]
    _validate_distinct(directory, {source.path: source.name for source in sources})
    return sorted(sources, key=lambda source: source.name)


def find_mesh(path: str | Path, *, units: str = "m") -> MeshSource:
    """Return one mesh file in the form of `find_meshes`, whatever else is in its directory.

    Raises:
        MeshError: If the file is not a mesh file, or the manifest beside it is invalid.
    """
    path = Path(path)
    validate_units(units)
    if path.suffix.lower() not in SUFFIXES or not path.is_file():
        got = repr(path.suffix) if path.is_file() else "none"
        raise MeshError(f"{path}: must be a mesh file ({', '.join(SUFFIXES)}), got {got}")
    manifest = path.with_name(MANIFEST_NAME)
    table = _read_manifest(manifest) if manifest.is_file() else _Manifest()
    return _source(path, unicodedata.normalize("NFC", path.stem), table, units)


def _entries(table: _Manifest) -> dict[str, _Entry]:
    """Return the manifest's entries by stem, with stems normalised as in `find_meshes`."""
    return {unicodedata.normalize("NFC", key): entry for key, entry in table.objects.items()}


def _source(path: Path, stem: str, table: _Manifest, units: str) -> MeshSource:
    entry = _entries(table).get(stem, _Entry())
    said = entry.model_dump(exclude={"units", "scale"}, exclude_none=True)
    usual = {"name": stem, "class_name": _class_of(stem), "licence": table.licence}
    scale = UNITS[entry.units or table.units or units] * entry.scale
    return MeshSource(path=path.absolute(), scale=scale, **(usual | said))


def validate_units(units: str) -> None:
    """Raise an error for an unknown unit of length.

    Raises:
        MeshError: If the unit is unknown.
    """
    if units not in UNITS:
        raise MeshError(f"units must be one of {', '.join(UNITS)}, got {units!r}")


def _validate_distinct(directory: Path, names: dict[Path, str]) -> None:
    for name, count in Counter(names.values()).items():
        if count > 1:
            twins = ", ".join(path.name for path, other in names.items() if other == name)
            raise MeshError(f"{directory}: names must be unique, got {name!r} for {twins}")


# Reading a mesh


def read_source(source: MeshSource) -> tuple[bytes, str]:
    """Return a mesh file's bytes, and the SHA-256 of them and of the object's attributes.

    The hash is hexadecimal. Name, class, licence and group do not affect it.

    Raises:
        MeshError: If the file cannot be read.
    """
    content = read_bytes(source.path)
    return content, _sha256(content, source)


def source_sha256(source: MeshSource) -> str:
    """Return the hash of `read_source`.

    Raises:
        MeshError: If the file cannot be read.
    """
    return read_source(source)[1]


def load_source(
    source: MeshSource, read: tuple[bytes, str] | None = None
) -> tuple[trimesh.Trimesh, str]:
    """Return a mesh in the file's units and axes, and its hash as in `read_source`.

    The file is read once, so the hash certainly belongs to these triangles.

    Args:
        source: The mesh file.
        read: What `read_source` returned; None: the file is read now.

    Raises:
        MeshError: If the file cannot be read or contains no finite triangles.
    """
    content, digest = read or read_source(source)
    vertices, faces = parse_mesh(source.path.name, content)
    return clean_triangles(vertices, faces, source.path.name), digest


def upright_vertices(mesh: trimesh.Trimesh, source: MeshSource) -> Array:
    """Return the vertices (n, 3) of a file [m], turned so that the file's axis `up` is +z."""
    vertices = np.asarray(mesh.vertices) * source.scale
    return vertices if source.up == "+z" else multiply(vertices, np.transpose(UPRIGHT[source.up]))


def _sha256(content: bytes, source: MeshSource) -> str:
    # Attributes that are not given do not affect the hash.
    said = [f"\nscale {source.scale!r}"]
    said += [] if source.up == "+z" else [f"up {source.up}"]
    for what in ("mass", "density", "friction"):
        value = getattr(source, what)
        said += [] if value is None else [f"{what} {value!r}"]
    digest = hashlib.sha256(content)
    digest.update("\n".join(said).encode())
    return digest.hexdigest()
