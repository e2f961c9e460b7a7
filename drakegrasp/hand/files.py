"""Locates the files of a hand and the files that they name. Does not import Drake."""

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

#: Folder of the package's hand files `<name>_hand.yaml`, their models and the table's model.
MODELS = Path(__file__).resolve().parent.parent / "models"


def hand_names() -> list[str]:
    """Return the names of the package's hands and of the hands that plugins register."""
    ours = (path.name.removesuffix("_hand.yaml") for path in MODELS.glob("*_hand.yaml"))
    return sorted({*ours, *registry.names("hands")})


def hand_file(source: HandSource) -> Path:
    """Return the YAML file of a registered hand, of a dataset's hand, or the given file.

    Raises:
        HandError: If there is no such file, or the path of a dataset's hand leads elsewhere.
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
    """Reject a path that is not a plain file of a folder; the folder may be a stranger's.

    Raises:
        HandError: If the path is missing or no file, or if it or the folder is a link.
    """
    try:
        found, real = path.resolve(strict=True), folder.parent.resolve() / folder.name
    except (OSError, RuntimeError, ValueError):
        raise HandError(f"{path}: must be a file of the dataset's hand, got none") from None
    if not (found.is_relative_to(real) and found.is_file()):
        raise HandError(f"{path}: must be a file in {folder}, got a link or no file")


def find_packages(folder: Path, model: str, packages: Mapping[str, str]) -> dict[str, Path]:
    """Return the folder of each package whose files a hand's model may name.

    These are the packages that the hand file names and the packages that contain the model. The
    latter are the folders above the model with a `package.xml`, under the name given in that file.

    Args:
        folder: Folder of the hand file.
        model: Path of the model, relative to `folder`.
        packages: Package folders by name, relative to `folder`.

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
    """Return the package name in a package.xml; the name of its folder if it gives no name."""
    try:
        name = ElementTree.parse(manifest).findtext("name")
    except ElementTree.ParseError:
        name = None
    return (name or manifest.parent.name).strip()


#: Suffixes of models and of files that a model may include.
MODEL_SUFFIXES = (".sdf", ".urdf", ".xml")
PACKAGE = "package://"
#: References in a model: meshes and models in SDFormat, meshes in URDF, then textures.
_NAMED = re.compile(
    rb"<uri>\s*(?P<uri>.*?)\s*</uri>|<mesh\b[^>]*\bfilename\s*=\s*[\"'](?P<mesh>.*?)[\"']"
    rb"|<texture\b[^>]*\bfilename\s*=\s*[\"'](?P<texture>.*?)[\"']"
    rb"|<drake:diffuse_map>\s*(?P<map>.*?)\s*</drake:diffuse_map>"
)
#: References in Wavefront files: materials, and their textures at the end of a line.
_MATERIALS = re.compile(rb"^[ \t]*mtllib[ \t]+(.+?)[ \t\r]*$", re.MULTILINE)
_TEXTURES = re.compile(rb"^[ \t]*(?:map_\w+|bump|disp|norm)[ \t](?:.*[ \t])?(\S+)[ \t\r]*$", re.M)


def rewritten(model: bytes, place: Callable[[str, bool], str]) -> bytes:
    """Return the text of a model with each reference replaced.

    Args:
        model: The text.
        place: Returns the replacement of a reference. Its arguments are the reference and whether
            it is geometry. If the replacement equals the reference, the bytes do not change.
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
    """Yield each reference in a mesh or a material file and whether it is geometry."""
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
            return  # Drake rejects it
        yield from ((str(uri), counts) for uri, counts in named if not str(uri).startswith("data:"))


def file_of(uri: str, folder: Path, packages: Mapping[str, Path]) -> Path:
    """Return the file of a reference in a model; the file may not exist.

    Args:
        uri: The reference.
        folder: Folder of the model.
        packages: Folders of `package://` URIs by package name.
    """
    if not uri.startswith(PACKAGE):
        return folder / uri.removeprefix("file://")
    package, _, rest = uri.removeprefix(PACKAGE).partition("/")
    return packages.get(package, folder / package) / rest
