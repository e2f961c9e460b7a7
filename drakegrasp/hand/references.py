"""What the files of a hand name: meshes of a model, materials of a mesh. Does not import Drake.

In: the text of a file. Out: the references in it, as they are written there.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from xml.sax.saxutils import escape, unescape

from drakegrasp.foreign_files import parse_json

#: Suffixes of models, which a model may include.
MODELS = (".sdf", ".urdf", ".xml")
_PACKAGE = "package://"
#: What a model names: meshes and models in SDFormat, meshes in URDF; then textures.
_NAMED = re.compile(
    rb"<uri>\s*(?P<uri>.*?)\s*</uri>|<mesh\b[^>]*\bfilename\s*=\s*[\"'](?P<mesh>.*?)[\"']"
    rb"|<texture\b[^>]*\bfilename\s*=\s*[\"'](?P<texture>.*?)[\"']"
    rb"|<drake:diffuse_map>\s*(?P<map>.*?)\s*</drake:diffuse_map>"
)
#: What Wavefront files name: materials, and their textures at the end of a line.
_MATERIALS = re.compile(rb"^[ \t]*mtllib[ \t]+(.+?)[ \t\r]*$", re.MULTILINE)
_TEXTURES = re.compile(rb"^[ \t]*(?:map_\w+|bump|disp|norm)[ \t](?:.*[ \t])?(\S+)[ \t\r]*$", re.M)


def names_packages(model: bytes) -> bool:
    """Return whether a model names files by their packages."""
    return _PACKAGE.encode() in model


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
    if not uri.startswith(_PACKAGE):
        return folder / uri.removeprefix("file://")
    package, _, rest = uri.removeprefix(_PACKAGE).partition("/")
    return packages.get(package, folder / package) / rest
