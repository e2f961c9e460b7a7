"""The text of a vendor's model, and the mesh files that it names.

In: a URDF, SDFormat or MJCF file and the folders that it may use. Out: its XML, in which every mesh
is a Wavefront file of a scratch folder, and notes of what was left out. Nothing is fetched, and no
file outside of the folders is read.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from drakegrasp.errors import HandError, one_line
from drakegrasp.hand.files import find_packages

#: Formats by the tag of the root.
FORMATS = {"robot": "urdf", "sdf": "sdf", "mujoco": "xml"}
SUFFIXES = (".urdf", ".sdf", ".xml", ".mjcf")
#: A model's text has at most so many bytes, elements within each other, and files of its own.
LONGEST, DEEPEST, MOST_INCLUDES = 20_000_000, 200, 50
#: Bytes that are parsed at a time.
BITE = 65_536
#: What an element of a model may not lead to: Drake would look for the file itself.
_ELSEWHERE = {"robot": ("drake:include",), "sdf": ("include",), "mujoco": ("hfield", "plugin")}


@dataclass(frozen=True, kw_only=True)
class Folders:
    """The folders whose files a model may use.

    Attributes:
        model: That of the model.
        packages: Of package:// URIs, by name.
        given: Those that the user named.
    """

    model: Path
    packages: Mapping[str, Path]
    given: tuple[Path, ...]

    def find(self, uri: str, base: Path) -> Path:
        """Return the file of a URI or path; relative ones start at `base`.

        Raises:
            HandError: If it is a URI of another kind, or lies outside of the folders.
        """
        scheme, separator, rest = uri.partition("://")
        if separator and scheme not in ("package", "file", "model"):
            raise HandError(
                f"model: mesh {uri!r} must be a file, got an address: nothing is fetched"
            )
        if separator and scheme != "file":
            name, _, rest = rest.partition("/")
            folder = self.packages.get(name) or self._above(name)
            if folder is None:
                raise HandError(
                    f"model: mesh {uri!r} must lie in a known package: say where it is with "
                    f"--package {name}=FOLDER"
                )
            path, allowed = folder / unquote(rest), [folder]
        else:
            path, allowed = base / unquote(rest if separator else uri), [self.model]

        # What a link or `..` leads to is what counts.
        try:
            real = path.resolve()
        except (OSError, RuntimeError, ValueError):
            raise HandError(f"model: mesh {uri!r} must be a path, got none") from None
        allowed += [*self.given, *self.packages.values()]
        if not any(real.is_relative_to(folder.resolve()) for folder in allowed):
            raise HandError(
                f"model: mesh {uri!r} must lie in the model's folder, got {str(real)!r}: allow "
                f"its folder with --root FOLDER"
            )
        return real

    def _above(self, name: str) -> Path | None:
        """Return the folder of a name in which the model lies; None if there is none."""
        return next((f for f in (self.model, *self.model.parents) if f.name == name), None)


@dataclass(frozen=True, kw_only=True)
class Source:
    """A vendor's model, read.

    Attributes:
        path: The file.
        root: Its XML, with what it includes.
        folders: Of its meshes.
    """

    path: Path
    root: Element
    folders: Folders


def read_source(path: Path, packages: Mapping[str, Path], given: Sequence[Path] = ()) -> Source:
    """Return the XML of a model.

    Args:
        path: A URDF, SDFormat or MJCF file.
        packages: Folders of package:// URIs, beside those in which the model lies.
        given: Folders outside of the model's that it may use.

    Raises:
        HandError: If it cannot be read, in one line that says how to mend it.
    """
    path = Path(path)
    if path.suffix.lower() == ".xacro":
        raise HandError(f"{path}: must be URDF, got xacro: run `xacro {path.name} > hand.urdf`")
    if path.suffix.lower() not in SUFFIXES:
        raise HandError(f"{path}: must end in .urdf, .sdf or .xml (MJCF), got {path.suffix!r}")
    for name, folder in packages.items():
        if not folder.is_dir():
            raise HandError(f"package {name} must be a folder, got {str(folder)!r}")
    root = _parse(path)
    if root.tag not in FORMATS:
        raise HandError(
            f"{path}: must be a model in URDF, SDFormat or MJCF, got XML of <{root.tag}>"
        )
    folder = path.resolve().parent
    known = {**find_packages(folder, path.name, {}), **packages}
    source = Source(
        path=path,
        root=root,
        folders=Folders(model=folder, packages=known, given=tuple(given)),
    )
    if root.tag == "mujoco":
        _include(root, folder, source.folders, [0])
    for element in root.iter():
        if element.tag in _ELSEWHERE[root.tag] and (element.get("file") or len(element)):
            raise HandError(
                f"{path}: must be complete by itself, got <{element.tag}>: put what it names into "
                "the file"
            )
    return source


def _parse(path: Path) -> Element:
    """Return the root of an XML file that defines no entities and is not nested too deeply."""
    try:
        if path.stat().st_size > LONGEST:
            raise HandError(f"{path}: must be a model of at most {LONGEST // 10**6} MB, got more")
        text = path.read_bytes()
    except OSError as error:
        raise HandError(f"{path}: must be a readable file, got: {error.strerror}") from None
    if b"<!DOCTYPE" in text or b"<!ENTITY" in text:
        raise HandError(f"{path}: must be XML without a document type, got <!DOCTYPE>")

    # It is read bit by bit: what is too deep need not be built.
    depth, root = 0, None
    parser: Any = ElementTree.XMLPullParser(("start", "end"))
    try:
        for start in range(0, len(text) + 1, BITE):
            parser.feed(text[start : start + BITE])
            for event, element in parser.read_events():
                root = element if root is None else root
                depth += 1 if event == "start" else -1
                if depth > DEEPEST:
                    raise HandError(f"{path}: must be XML of at most {DEEPEST} levels, got more")
        parser.close()
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise HandError(f"{path}: must be XML, got text that is not ({one_line(error)})") from None
    assert isinstance(root, Element)
    return root


def _include(root: Element, base: Path, folders: Folders, count: list[int]) -> None:
    """Put the content of included MJCF files in place of their <include>."""
    for parent in list(root.iter()):
        for child in [c for c in parent if c.tag == "include"]:
            count[0] += 1
            if count[0] > MOST_INCLUDES:
                raise HandError("model: must include other files once each, got a loop of them")
            path = folders.find(child.get("file", ""), base)
            included = _parse(path)
            _include(included, base, folders, count)
            place = list(parent).index(child)
            parent.remove(child)
            parent[place:place] = list(included)


#: Turns a mesh file into a Wavefront file of the scratch folder, whose path it returns.
Convert = Callable[[Path], Path]


def replace_meshes(source: Source, convert: Convert) -> list[str]:
    """Replace every mesh in the XML by its conversion, and return notes of what was left out.

    A picture of a link that cannot be read is left out: its collision shapes are drawn instead.

    Raises:
        HandError: If a mesh of a collision shape cannot be read.
    """
    if source.root.tag == "mujoco":
        _replace_assets(source, convert)
        return []
    notes: list[str] = []
    for link in source.root.iter("link"):
        for tag in ("collision", "visual"):
            for element in link.findall(tag):
                for mesh in element.iter("mesh"):
                    try:
                        _replace(mesh, source, convert)
                    except HandError as error:
                        if tag == "collision":
                            raise
                        notes.append(f"not drawn: {str(error).removeprefix('model: ')}")
                        link.remove(element)
                        break
    return notes


def _replace(mesh: Element, source: Source, convert: Convert) -> None:
    """Replace the file of a mesh in URDF or SDFormat."""
    if source.root.tag == "robot":
        path = source.folders.find(mesh.get("filename", ""), source.folders.model)
        mesh.set("filename", convert(path).name)
        return
    uri = mesh.find("uri")
    if uri is None or mesh.find("submesh") is not None:
        raise HandError("model: a mesh must be a whole file, got <submesh> or no <uri>")
    path = source.folders.find((uri.text or "").strip(), source.folders.model)
    uri.text = convert(path).name


def _replace_assets(source: Source, convert: Convert) -> None:
    """Replace the files of an MJCF model's meshes, and leave out its textures."""
    folder = source.folders.model
    for compiler in source.root.iter("compiler"):
        place = compiler.attrib.pop("meshdir", None) or compiler.attrib.pop("assetdir", None)
        folder = folder / place if place else folder
        for key in ("assetdir", "texturedir", "strippath"):
            compiler.attrib.pop(key, None)
    for assets in source.root.iter("asset"):
        for element in list(assets):
            if element.tag == "texture":
                assets.remove(element)
            elif element.tag == "material":
                element.attrib.pop("texture", None)
            elif element.tag == "mesh" and element.get("file"):
                name = element.get("file", "")
                element.attrib.setdefault("name", Path(name).stem)
                element.set("file", convert(source.folders.find(name, folder)).name)
