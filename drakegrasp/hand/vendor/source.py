"""The text of a vendor's model.

In: a URDF, SDFormat or MJCF file. Out: its XML, complete by itself but for meshes. A file that asks
for too much (entities, depth, includes without end) is refused before anything else reads it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from drakegrasp.errors import HandError, one_line
from drakegrasp.foreign_files import read_content
from drakegrasp.hand.files import find_packages
from drakegrasp.hand.vendor.folders import Folders

#: Formats by the tag of the root.
FORMATS = {"robot": "urdf", "sdf": "sdf", "mujoco": "xml"}
SUFFIXES = (".urdf", ".sdf", ".xml", ".mjcf")
#: A model's text has at most so many bytes, elements within each other, and files of its own.
LONGEST, DEEPEST, MOST_INCLUDES = 20_000_000, 200, 50
#: Bytes that are parsed at a time.
BITE = 65_536
#: Attributes that a class of MJCF gives to the elements of each tag.
_Defaults = dict[str, dict[str, str]]
#: What an element of a model may not lead to: Drake would look for the file itself.
_ELSEWHERE = {"robot": ("drake:include",), "sdf": ("include",), "mujoco": ("hfield", "plugin")}


@dataclass(frozen=True, kw_only=True)
class Source:
    """A vendor's model, read.

    Attributes:
        root: Its XML, with what it includes.
        folders: Of its meshes.
    """

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
    # What it is.
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

    # What it is made of.
    folder = path.resolve().parent
    known = {**find_packages(folder, path.name, {}), **packages}
    folders = Folders(model=folder, packages=known, given=tuple(given))
    if root.tag == "mujoco":
        _include(root, folders, [0])
        main: _Defaults = {}
        for default in root.findall("default"):
            main = _inherit(default, main)
    for element in root.iter():
        if element.tag in _ELSEWHERE[root.tag] and (element.get("file") or len(element)):
            raise HandError(
                f"{path}: must be complete by itself, got <{element.tag}>: put what it names into "
                "the file"
            )
    return Source(root=root, folders=folders)


def _parse(path: Path) -> Element:
    """Return the root of an XML file that defines no entities and is not nested too deeply."""
    # Entities come with a document type.
    try:
        text = read_content(path, LONGEST)
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


def _include(root: Element, folders: Folders, count: list[int]) -> None:
    """Put the content of included MJCF files in place of their <include>."""
    for parent in list(root.iter()):
        for child in [c for c in parent if c.tag == "include"]:
            count[0] += 1
            if count[0] > MOST_INCLUDES:
                raise HandError("model: must include other files once each, got a loop of them")
            included = _parse(folders.find(child.get("file", ""), folders.model))
            _include(included, folders, count)
            place = list(parent).index(child)
            parent.remove(child)
            parent[place:place] = list(included)


def _inherit(default: Element, above: _Defaults) -> _Defaults:
    """Write what a class of MJCF has from the classes around it into it; return what it gives.

    Drake looks only as far as the next class: what that one does not name would be lost.
    """
    given = {tag: dict(attributes) for tag, attributes in above.items()}
    own = [element for element in default if element.tag != "default"]
    for element in own:
        given.setdefault(element.tag, {}).update(element.attrib)
        element.attrib.update(given[element.tag])
    present = {element.tag for element in own}
    default.extend(Element(tag, given[tag]) for tag in given if tag not in present)
    for nested in default.findall("default"):
        _inherit(nested, given)
    return given
