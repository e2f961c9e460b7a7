"""The one door through which a vendor's model is read.

Input: a URDF, SDFormat or MJCF file. Output: a `VendorModel`. Nothing is downloaded.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from urllib.parse import unquote
from xml.etree import ElementTree

from drakegrasp.errors import HandError
from drakegrasp.hand.draft.drake_model import parse_model
from drakegrasp.hand.draft.mujoco_model import compile_model
from drakegrasp.hand.draft.vendor import VendorModel, weld

#: The reader of each format.
READERS = {".urdf": parse_model, ".sdf": parse_model, ".xml": compile_model, ".mjcf": compile_model}


def read_model(path: Path, packages: Mapping[str, Path] | None = None) -> VendorModel:
    """Return a vendor's model, with bodies that are fixed to each other as one link.

    Args:
        path: A URDF, SDFormat or MJCF file.
        packages: Folders of package:// URIs, in addition to those that contain the model.

    Raises:
        HandError: If it is not a tree of rigid links with readable meshes. The message has one
            line, which states how to repair it.
    """
    suffix, packages = path.suffix.lower(), packages or {}
    if suffix == ".xacro":
        raise HandError(f"{path}: must be URDF, got xacro: run `xacro {path.name} > hand.urdf`")
    if suffix not in READERS:
        raise HandError(f"{path}: must end in .urdf, .sdf or .xml (MJCF), got {path.suffix!r}")
    for name, folder in packages.items():
        if not folder.is_dir():
            raise HandError(f"package {name} must be a folder, got {str(folder)!r}")
    known = {**_packages_above(path), **packages}
    return weld(READERS[suffix](path, lambda uri, base: _file_of(uri, base, path, known)))


def _packages_above(path: Path) -> dict[str, Path]:
    """Return the folders above a model that have a `package.xml`, by the name in that file."""
    found: dict[str, Path] = {}
    for above in path.resolve().parents:
        manifest = above / "package.xml"
        if manifest.is_file():
            try:
                name = ElementTree.parse(manifest).findtext("name")
            except ElementTree.ParseError:
                name = None
            found.setdefault((name or above.name).strip(), above)
    return found


def _file_of(uri: str, base: Path, model: Path, packages: Mapping[str, Path]) -> Path:
    """Return the file of a mesh's URI or path; relative ones start at `base`.

    Raises:
        HandError: If it is an address, or in an unknown package.
    """
    scheme, separator, rest = uri.partition("://")
    if not separator or scheme == "file":
        return base / unquote(rest if separator else uri)
    if scheme not in ("package", "model"):
        raise HandError(f"model: mesh {uri!r} must be a file, got an address: nothing is fetched")

    # A package is a known one, or a folder of its name above the model.
    name, _, rest = rest.partition("/")
    above = (folder for folder in model.resolve().parents if folder.name == name)
    folder = packages.get(name) or next(above, None)
    if folder is None:
        raise HandError(
            f"model: mesh {uri!r} must lie in a known package: say where it is with "
            f"--package {name}=FOLDER"
        )
    return folder / unquote(rest)
