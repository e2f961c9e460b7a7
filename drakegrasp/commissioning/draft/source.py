"""The text of a vendor's model, and the folders whose files it may use.

Input: a URDF, SDFormat or MJCF file. Output: its XML, complete except for meshes. A file with
entities, too much nesting or endless includes is rejected before anything else reads it. Nothing is
downloaded, and no file outside the folders is read.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from drakegrasp.errors import HandError, one_line
from drakegrasp.foreign_files import read_content
from drakegrasp.hand.files import find_packages

#: Formats by the tag of the root.
FORMATS = {"robot": "urdf", "sdf": "sdf", "mujoco": "xml"}
SUFFIXES = (".urdf", ".sdf", ".xml", ".mjcf")
#: Maximum size of a model's text [bytes], depth of nested elements, and number of included files.
LONGEST, DEEPEST, MOST_INCLUDES = 20_000_000, 200, 50
#: Number of bytes that are parsed at a time.
BITE = 65_536
#: Names of numbers in URDF (attributes) and SDFormat (elements), in MJCF, and of infinite ones.
_NUMBERS = {
    *("xyz", "rpy", "ixx", "ixy", "ixz", "iyy", "iyz", "izz", "mass", "lower", "upper", "pose"),
    *("effort", "velocity", "multiplier", "offset", "reference", "radius", "length", "size"),
    *("scale", "rgba", "damping", "friction"),
}
_MJCF_NUMBERS = {
    *("pos", "quat", "euler", "axisangle", "xyaxes", "zaxis", "axis", "fromto", "size", "kp"),
    *("scale", "mass", "density", "diaginertia", "fullinertia", "range", "ref", "polycoef"),
    *("coef", "gear", "ctrlrange", "forcerange", "actuatorfrcrange", "gainprm", "biasprm"),
    "damping",
}
_ENDLESS = ("lower", "upper", "effort", "velocity", "range", "ctrlrange", "forcerange")
_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")
#: Elements that would make Drake look for other files.
_ELSEWHERE = {"robot": ("drake:include",), "sdf": ("include",), "mujoco": ("plugin",)}
#: Elements of MJCF whose files are read, or not needed.
_FILES = ("mesh", "texture", "skin")


@dataclass(frozen=True, kw_only=True)
class Source:
    """A vendor's model that was read.

    Attributes:
        root: Its XML, with included files.
        folder: Folder of the model.
        packages: Folders of package:// URIs, by name.
        given: Folders outside the model's folder that it may use, as named by the user.
    """

    root: Element
    folder: Path
    packages: Mapping[str, Path]
    given: tuple[Path, ...]

    def find(self, uri: str, base: Path) -> Path:
        """Return the file of a URI or path; relative ones start at `base`.

        Raises:
            HandError: If the URI is of another kind, or the file is outside the folders.
        """
        # A package is a known one, or a folder of its name above the model.
        scheme, separator, rest = uri.partition("://")
        if separator and scheme not in ("package", "file", "model"):
            raise HandError(
                f"model: mesh {uri!r} must be a file, got an address: nothing is fetched"
            )
        if separator and scheme != "file":
            name, _, rest = rest.partition("/")
            above = (f for f in (self.folder, *self.folder.parents) if f.name == name)
            folder = self.packages.get(name) or next(above, None)
            if folder is None:
                raise HandError(
                    f"model: mesh {uri!r} must lie in a known package: say where it is with "
                    f"--package {name}=FOLDER"
                )
            path, allowed = folder / unquote(rest), [folder]
        else:
            path, allowed = base / unquote(rest if separator else uri), [self.folder]

        # Check the target of links and `..`, not their text.
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


def read_source(path: Path, packages: Mapping[str, Path], given: Sequence[Path] = ()) -> Source:
    """Return the XML of a model.

    Args:
        path: A URDF, SDFormat or MJCF file.
        packages: Folders of package:// URIs, in addition to those that contain the model.
        given: Folders outside the model's folder that it may use.

    Raises:
        HandError: If the model cannot be read; the message has one line, which states how to repair
            it.
    """
    # Check the kind of file.
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

    # Read its parts.
    folder = path.resolve().parent
    known = {**find_packages(folder, path.name, {}), **packages}
    source = Source(root=root, folder=folder, packages=known, given=tuple(given))
    if root.tag == "mujoco":
        _include(root, source, [0])
    for element in root.iter():
        named = element.tag in _ELSEWHERE[root.tag]
        other = named or (root.tag == "mujoco" and element.tag not in _FILES)
        if (named and len(element)) or (other and element.get("file")):
            raise HandError(
                f"{path}: must be complete by itself, got <{element.tag}>: put what it names into "
                "the file"
            )
    _refuse_xacro(root, path)
    _refuse_words(root, root.tag == "mujoco", f"<{root.tag}>")
    return source


def _parse(path: Path) -> Element:
    """Return the root of an XML file that defines no entities and is not nested too deeply."""
    # Entities come with a document type.
    try:
        text = read_content(path, LONGEST)
    except OSError as error:
        raise HandError(f"{path}: must be a readable file, got: {error.strerror}") from None
    if b"<!DOCTYPE" in text or b"<!ENTITY" in text:
        raise HandError(f"{path}: must be XML without a document type, got <!DOCTYPE>")

    # Parse it in small pieces, so that a text that is nested too deeply is never built.
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


def _refuse_xacro(root: Element, path: Path) -> None:
    """Reject text that xacro would have replaced."""
    for element in root.iter():
        names = [element.tag, *element.attrib]
        texts = [element.text or "", *element.attrib.values()]
        left = [f"<{n.rpartition('}')[2]}>" for n in names if "xacro" in n.rpartition("}")[0]]
        left += [text.strip() for text in texts if "${" in text or "$(" in text]
        if left:
            raise HandError(
                f"{path}: must be a model without xacro, got {left[0]!r}: first convert "
                "the file with `xacro`"
            )


def _refuse_words(element: Element, mjcf: bool, owner: str) -> None:
    """Reject text where a model has numbers: parsers would read only its beginning, or nothing."""
    owner = f"{element.tag} {element.get('name')!r}" if "name" in element.attrib else owner
    known = _MJCF_NUMBERS if mjcf else _NUMBERS
    found = [(key, text) for key, text in element.attrib.items() if key in known]
    if not mjcf and element.tag == "mass" and "value" in element.attrib:
        found.append(("mass", element.attrib["value"]))
    elif not mjcf and element.tag in known and not (len(element) or element.attrib):
        found.append((element.tag, element.text or ""))
    for key, text in found:
        words = text.split() or [""]
        ends = ("inf", "infinity") if key in _ENDLESS else ()
        if not all(_NUMBER.fullmatch(w) or w.lower().lstrip("+-") in ends for w in words):
            raise HandError(f"model: {key} of {owner} must be a number, got {text!r}")
    for child in element:
        _refuse_words(child, mjcf, owner)


def _include(root: Element, source: Source, count: list[int]) -> None:
    """Replace each <include> by the content of the MJCF file that it names."""
    for parent in list(root.iter()):
        for child in [c for c in parent if c.tag == "include"]:
            count[0] += 1
            if count[0] > MOST_INCLUDES:
                raise HandError("model: must include other files once each, got a loop of them")
            included = _parse(source.find(child.get("file", ""), source.folder))
            _include(included, source, count)
            place = list(parent).index(child)
            parent.remove(child)
            parent[place:place] = list(included)
