"""Locates the files of a hand, and what they name. Does not import Drake."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from xml.etree import ElementTree
from xml.sax.saxutils import escape, unescape

from drakegrasp import registry
from drakegrasp.config import CarriedHand, HandSource
from drakegrasp.errors import HandError
from drakegrasp.foreign_files import parse_json

#: Folder of the table and of the hands that come with the package, as `<name>_hand.yaml`.
MODELS = Path(__file__).resolve().parent.parent / "models"


def hand_names() -> list[str]:
    """Return the names of the hands that come with the package, and of those of others."""
    ours = (path.name.removesuffix("_hand.yaml") for path in MODELS.glob("*_hand.yaml"))
    return sorted({*ours, *registry.names("hands")})


def hand_file(source: HandSource) -> Path:
    """Return the YAML file of a hand that comes with the package, or the one that is given.

    Raises:
        HandError: If there is no such file, or that of a dataset is elsewhere.
    """
    if isinstance(source, CarriedHand):
        refuse_outside(source.path, source.path.parent)
        return source.path
    path = MODELS / f"{source}_hand.yaml"
    if source in hand_names() and not path.exists():
        path = Path(registry.find("hands", str(source)))
    elif source not in hand_names():
        path = Path(source)
    if not path.is_file():
        names = ", ".join(hand_names())
        raise HandError(f"hand must be one of {names} or a YAML file, got {str(source)!r}")
    return path


def refuse_outside(path: Path, folder: Path) -> None:
    """Refuse what is no plain file of a folder, which may be a stranger's.

    Raises:
        HandError: If it is missing or something else, or it or the folder is a link.
    """
    try:
        found, real = path.resolve(strict=True), folder.parent.resolve() / folder.name
    except (OSError, RuntimeError, ValueError):
        raise HandError(f"{path}: must be a file of the dataset's hand, got none") from None
    if not (found.is_relative_to(real) and found.is_file()):
        raise HandError(f"{path}: must be a file in {folder}, got a link or no file")


def chance_file(source: HandSource) -> Path:
    """Return the file of the weights by which lifts are chosen, which few hands have.

    It lies next to the hand file: `<name>_chance.yaml` of `<name>_hand.yaml`.

    Raises:
        HandError: If there is no such hand.
    """
    path = hand_file(source)
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


def _package_name(manifest: Path) -> str:
    """Return the name that a package.xml gives; its folder's name if it gives none."""
    try:
        name = ElementTree.parse(manifest).findtext("name")
    except ElementTree.ParseError:
        name = None
    return (name or manifest.parent.name).strip()


#: Suffixes of models, which a model may include.
MODEL_SUFFIXES = (".sdf", ".urdf", ".xml")
PACKAGE = "package://"
#: What a model names: meshes and models in SDFormat, meshes in URDF; then textures.
_NAMED = re.compile(
    rb"<uri>\s*(?P<uri>.*?)\s*</uri>|<mesh\b[^>]*\bfilename\s*=\s*[\"'](?P<mesh>.*?)[\"']"
    rb"|<texture\b[^>]*\bfilename\s*=\s*[\"'](?P<texture>.*?)[\"']"
    rb"|<drake:diffuse_map>\s*(?P<map>.*?)\s*</drake:diffuse_map>"
)
#: What Wavefront files name: materials, and their textures at the end of a line.
_MATERIALS = re.compile(rb"^[ \t]*mtllib[ \t]+(.+?)[ \t\r]*$", re.MULTILINE)
_TEXTURES = re.compile(rb"^[ \t]*(?:map_\w+|bump|disp|norm)[ \t](?:.*[ \t])?(\S+)[ \t\r]*$", re.M)


def model_references(model: bytes) -> Iterator[tuple[str, bool]]:
    """Yield what a model names, and whether it is geometry: the rest is textures."""
    for match in _NAMED.finditer(model):
        kind = str(match.lastgroup)
        yield unescape(match[kind].decode(errors="surrogateescape")), kind in ("uri", "mesh")


def rewritten(model: bytes, place: Callable[[str, bool], str]) -> bytes:
    """Return the text of a model with each reference replaced.

    Args:
        model: The text.
        place: Returns what to write in place of a reference; called with it and with whether it is
            geometry. Bytes stay where that is the same.
    """

    def replaced(match: re.Match[bytes]) -> bytes:
        kind = str(match.lastgroup)
        uri = unescape(match[kind].decode(errors="surrogateescape"))
        new = place(uri, kind in ("uri", "mesh"))
        if new == uri:
            return match[0]
        start, stop = (position - match.start() for position in match.span(kind))
        written = escape(new).encode(errors="surrogateescape")
        return match[0][:start] + written + match[0][stop:]

    return _NAMED.sub(replaced, model)


def mesh_references(path: Path) -> Iterator[tuple[str, bool]]:
    """Yield what a mesh or a material names, and whether it is geometry."""
    suffix = path.suffix.lower()
    if suffix in (".obj", ".mtl"):
        for name in (_MATERIALS if suffix == ".obj" else _TEXTURES).findall(path.read_bytes()):
            yield name.decode(errors="surrogateescape"), False
    elif suffix == ".gltf":
        try:
            tree = parse_json(path.read_bytes())
            named = [(part["uri"], key == "buffers") for key in ("buffers", "images")
                     for part in tree.get(key, ()) if "uri" in part]  # fmt: skip
        except (ValueError, TypeError, AttributeError):
            return  # Drake refuses it
        yield from ((str(uri), counts) for uri, counts in named if not str(uri).startswith("data:"))


def file_of(uri: str, folder: Path, packages: Mapping[str, Path]) -> Path:
    """Return the file of a reference in a model, which may not exist.

    Args:
        uri: The reference.
        folder: Of the model.
        packages: Folders of `package://` URIs by name.
    """
    if not uri.startswith(PACKAGE):
        return folder / uri.removeprefix("file://")
    package, _, rest = uri.removeprefix(PACKAGE).partition("/")
    return packages.get(package, folder / package) / rest
