"""Locates and hashes a hand's files. Does not import Drake."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import yaml

from drakegrasp.errors import HandError
from drakegrasp.yaml_text import parse_yaml

#: Folder of the table and of the hands that come with the package, as `<name>_hand.yaml`.
MODELS = Path(__file__).resolve().parent.parent / "models"
#: The files that a model names: meshes in SDFormat, and in URDF.
_URIS = re.compile(rb"<uri>\s*(.*?)\s*</uri>|<mesh\b[^>]*\bfilename\s*=\s*[\"'](.*?)[\"']")
_PACKAGE = "package://"


def hand_names() -> list[str]:
    """Return the names of the hands that come with the package."""
    return sorted(path.name.removesuffix("_hand.yaml") for path in MODELS.glob("*_hand.yaml"))


def hand_file(name_or_yaml: str | Path) -> Path:
    """Return the YAML file of a hand that comes with the package, or the given YAML file.

    Raises:
        HandError: If there is no such file.
    """
    if name_or_yaml in hand_names():
        return MODELS / f"{name_or_yaml}_hand.yaml"
    path = Path(name_or_yaml)
    if not path.is_file():
        names = ", ".join(hand_names())
        raise HandError(f"hand must be one of {names} or a YAML file, got {str(name_or_yaml)!r}")
    return path


def chance_file(name_or_yaml: str | Path) -> Path:
    """Return the file of the weights by which lifts are chosen, which few hands have.

    It lies beside the hand file: `<name>_chance.yaml` of `<name>_hand.yaml`.

    Raises:
        HandError: If there is no such hand.
    """
    path = hand_file(name_or_yaml)
    return path.with_name(f"{path.stem.removesuffix('_hand')}_chance.yaml")


def find_packages(folder: Path, model: str, packages: Mapping[str, str]) -> dict[str, Path]:
    """Return the folder of each package whose files a hand's model may name.

    Those are the packages that the hand file names, and those in which the model lies: the folders
    above it with a `package.xml`, by the name that this file gives.

    Args:
        folder: Of the hand file.
        model: Path of the model, relative to it.
        packages: Folders by name, relative to it.

    Raises:
        HandError: If a package is not a folder.
    """
    found: dict[str, Path] = {}
    for above in (folder / model).resolve().parents:
        manifest = above / "package.xml"
        if manifest.is_file():
            found.setdefault(_package_name(manifest), above)
    for name, place in packages.items():
        if not (folder / place).is_dir():
            raise HandError(f"packages.{name}: must be a folder, got {place!r}")
        found[name] = folder / place
    return found


def hand_digest(name_or_yaml: str | Path) -> str:
    """Return a hash (16 hex digits) of a hand's YAML, its model, meshes and weights.

    It distinguishes two hands of the same name. A missing file counts as empty; refusing it is
    left to `description.load_hand`.

    Raises:
        HandError: If there is no such hand.
    """
    digest = hashlib.sha256()
    for path in hand_files(name_or_yaml):
        digest.update(path.read_bytes() if path.is_file() else b"")
    return digest.hexdigest()[:16]


def hand_files(name_or_yaml: str | Path) -> list[Path]:
    """Return the files of a hand: YAML, model, weights of lifts, meshes; some may not exist.

    Raises:
        HandError: If there is no such hand.
    """
    # The hand file, and the model that it names.
    path = hand_file(name_or_yaml)
    described = _described(path)
    name = str(described.get("model", ""))
    model = path.parent / name
    text = model.read_bytes() if model.is_file() else b""

    # The files that the model names, in the order of their names.
    packages = described.get("packages")
    named = packages.items() if isinstance(packages, dict) else ()
    folders = {str(k): path.parent / str(v) for k, v in named}
    if _PACKAGE.encode() in text:
        folders = find_packages(path.parent, name, {}) | folders
    uris = sorted({(one or other).decode() for one, other in _URIS.findall(text)})
    meshes = [_mesh_file(uri, model.parent, folders) for uri in uris]
    return [path, model, chance_file(path), *meshes]


def _mesh_file(uri: str, folder: Path, packages: Mapping[str, Path]) -> Path:
    """Return the file of a URI in a model, which may not exist."""
    if not uri.startswith(_PACKAGE):
        return folder / uri.removeprefix("file://")
    package, _, rest = uri.removeprefix(_PACKAGE).partition("/")
    return packages.get(package, folder / package) / rest


def _described(path: Path) -> Mapping[str, Any]:
    """Return the keys of a hand file; none if it is not one."""
    try:
        tree = parse_yaml(path.read_bytes())
    except (yaml.YAMLError, UnicodeDecodeError):
        return {}
    return tree if isinstance(tree, dict) else {}


def _package_name(manifest: Path) -> str:
    """Return the name that a package.xml gives; its folder's name if it gives none."""
    try:
        name = ElementTree.parse(manifest).findtext("name")
    except ElementTree.ParseError:
        name = None
    return (name or manifest.parent.name).strip()
