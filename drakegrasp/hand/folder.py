"""A folder that holds all files of a hand, and a digest of its content.

Input: a hand. Output: the content of such a folder: hand file, model, weights, licences, and meshes
with the files that they name. Files below the hand file keep their places and bytes. The hand file
and the model are rewritten only where they name something outside the folder or by an absolute path
or a `package://` URI. The hand in such a folder produces the same folder and digest again.

A dataset contains such a folder, see `carry_hand`. It is copied at the start of a build and read
from then on, so that workers and later commands need no other file of the hand. Does not import
Drake.
"""

from __future__ import annotations

import hashlib
import os
import posixpath
import re
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePath
from typing import Any

import yaml

from drakegrasp.config import CarriedHand, Config, HandSource
from drakegrasp.errors import DataError, HandError
from drakegrasp.hand.file_format import hand_keys
from drakegrasp.hand.files import (
    MODEL_SUFFIXES,
    PACKAGE,
    file_of,
    find_packages,
    hand_file,
    mesh_references,
    refuse_outside,
    rewritten,
)
from drakegrasp.runtime.files import atomic_folder, disk_full_named, sync
from drakegrasp.yaml_text import parse_yaml

#: Maximum total size [byte], YAML size [byte] and number of a hand's files; a stranger may have
#: written them.
LARGEST, LARGEST_YAML, MOST_FILES = 2**29, 2**18, 1000
#: Names of licence files next to a hand file or its model.
_LICENCE = re.compile(r"(LICEN[CS]E|COPYING|NOTICE)([._ -].*)?", re.IGNORECASE)
#: The keys of a hand file that name other files.
_MODEL_LINE = re.compile(r"^model:.*$", re.MULTILINE)
_PACKAGES_LINES = re.compile(r"^packages:.*\n(?:[ \t]+\S.*\n)*", re.MULTILINE)


def hand_digest(source: HandSource) -> str:
    """Return a hash (16 hex digits) of a hand's files, see `HandFolder.digest`.

    It differs between two hands of the same name. A missing file has the hash of an empty file;
    `description.load_hand` rejects missing files.

    Raises:
        HandError: As `hand_folder`.
    """
    return hand_folder(source).digest


def hand_folder(source: HandSource, name: str | None = None) -> HandFolder:
    """Return the content of a folder with all files of a hand.

    Args:
        source: The hand.
        name: Name of the hand file in the folder; None keeps its name.

    Raises:
        HandError: If there is no such hand, its files are too large, or a dataset's hand names
            files outside its folder.
    """
    # The hand file; a model outside its folder is copied into this folder.
    path = hand_file(source)
    found = HandFolder(within=path.parent if isinstance(source, CarriedHand) else None)
    found.has(path)
    name, described = name or path.name, _described(path)
    packages = found.packages_of(path, described)
    model = str(described.get("model", ""))
    place = found.place_of(model, "") or Path(model).name
    moved = place != posixpath.normpath(model)
    found.texts[name] = _with_model(path, place) if moved or packages else path.read_bytes()

    # The model, and licences.
    if found.has(path.parent / model):
        found.add_model(place, path.parent / model, packages, found.uris)
    folders = dict.fromkeys([path.parent, (path.parent / model).parent, *packages.values()])
    found.licences = found.add_licences(list(folders), path.stem.removesuffix("_hand"))
    uris = (found.uris[uri] for uri in sorted(found.uris))
    found.counted = (name, place, *uris, *found.parts.values())
    return found


@dataclass(kw_only=True)
class HandFolder:
    """The content of a folder with the files of a hand. A place is a path in the folder.

    Attributes:
        within: Folder that no file may leave, for a dataset's hand; None for another hand.
        texts: Bytes of hand file and models, keyed by place.
        files: Current paths of all other files, keyed by place.
        counted: Places of the files in the digest, in their order; some of the files may be
            missing.
        licences: Places of the licences.
        uris: Places of the geometry that the model names, by the references in the rewritten model.
        parts: Places of the geometry that other files name; each key is its value.
        sources: Whether each requested file exists.
        size: Total size of the files [byte].
    """

    within: Path | None
    texts: dict[str, bytes] = field(default_factory=dict)
    files: dict[str, Path] = field(default_factory=dict)
    counted: tuple[str, ...] = ()
    licences: tuple[str, ...] = ()
    uris: dict[str, str] = field(default_factory=dict)
    parts: dict[str, str] = field(default_factory=dict)
    sources: dict[Path, bool] = field(default_factory=dict)
    size: int = 0

    def content(self, place: str) -> bytes:
        """Return the bytes of a file; empty if it does not exist."""
        if place in self.texts:
            return self.texts[place]
        return self.files[place].read_bytes() if place in self.files else b""

    @property
    def digest(self) -> str:
        """A hash (16 hex digits) of hand file, model and meshes, independent of paths."""
        return _digest(map(self.content, self.counted))

    def place_of(self, reference: str, base: str) -> str | None:
        """Return the place of a file that a file in the folder `base` names; None if outside.

        Raises:
            HandError: If it is outside, and the hand is a dataset's.
        """
        place = posixpath.normpath(posixpath.join(base, reference))
        is_relative = "://" not in reference and not reference.startswith("/")
        if is_relative and place.split("/")[0] != "..":
            return place
        if self.within is not None:
            raise HandError(f"{self.within}: must name files in it only, got {reference!r}")
        return None

    def has(self, path: Path) -> bool:
        """Record a file, and return whether it exists.

        Raises:
            HandError: If the file is outside the folder of a dataset's hand, is a pipe or a device,
                or makes the files too large.
        """
        # Count a file once; a file of a dataset's hand must be in its folder.
        if path in self.sources:
            return self.sources[path]
        if "\0" in str(path):
            return False
        if self.within is not None and os.path.lexists(path):
            refuse_outside(path, self.within)
        self.sources[path] = path.is_file()
        if not self.sources[path]:
            if path.exists() and not path.is_dir():  # Drake would read it without end
                raise HandError(f"{path}: must be a file, got a pipe, a socket or a device")
            return False

        # A stranger's files must not fill the memory, and parsed YAML takes many times its size.
        size = path.stat().st_size
        self.size += size
        long = path.suffix.lower() in (".yaml", ".yml") and size > LARGEST_YAML
        if self.size > LARGEST or long or len(self.sources) > MOST_FILES:
            raise HandError(
                f"{path}: the files of a hand must be at most {MOST_FILES} and {LARGEST >> 20} MB "
                f"in all, its YAML {LARGEST_YAML >> 10} kB, got more"
            )
        return True

    def packages_of(self, path: Path, described: Mapping[str, Any]) -> dict[str, Path]:
        """Return the folders of the packages that a hand file or its model names.

        Raises:
            HandError: If the hand file of a dataset names packages.
        """
        if self.within is None:
            return _packages(path)
        if described.get("packages"):
            raise HandError(f"{path}: must name files in its folder only, got packages")
        return {}

    def add(self, place: str, path: Path) -> None:
        """Add a file and the files that it names, unless it is missing or already added."""
        if place in self.files or place in self.texts or not self.has(path):
            return
        if path.suffix.lower() in MODEL_SUFFIXES:
            self.add_model(place, path, {}, self.parts)
            return
        self.files[place] = path
        for reference, is_geometry in mesh_references(path):
            inner = self.place_of(reference, posixpath.dirname(place))
            if inner is None:
                continue  # the mesh is drawn without it
            if is_geometry:
                self.parts[inner] = inner
            self.add(inner, path.parent / reference)

    def add_model(
        self, place: str, path: Path, packages: Mapping[str, Path], counted: dict[str, str]
    ) -> None:
        """Add an existing model and the files that it names; rewrite references to outside files.

        Args:
            place: Place of the model.
            path: Present path of the model.
            packages: Folders of `package://` URIs by package name.
            counted: Receives the places of geometry by their references.
        """
        base = posixpath.dirname(place)

        def add_named(uri: str, is_geometry: bool) -> str:
            named, inner = file_of(uri, path.parent, packages), self.place_of(uri, base)
            if inner is None:
                inner = _elsewhere(named, self.has(named))
                uri = posixpath.relpath(inner, base or ".")
            if is_geometry:
                counted[uri] = inner
            self.add(inner, named)
            return uri

        self.texts[place] = b""  # for a model that includes itself
        self.texts[place] = rewritten(path.read_bytes(), add_named)

    def add_licences(self, folders: list[Path], hand: str) -> tuple[str, ...]:
        """Add the licences in some folders; return their places."""
        places = list[str]()
        for folder in folders:
            for path in sorted(folder.iterdir()) if folder.is_dir() else ():
                # In a folder with several hands, the name of a licence may begin with the hand's
                # name.
                name = path.name.removeprefix(f"{hand}_")
                if _LICENCE.fullmatch(name):
                    place = name if name not in self.files else f"{name}-{len(places)}"
                    self.add(place, path)
                    places += [place] if place in self.files else []
        return tuple(places)


def _elsewhere(path: Path, there: bool) -> str:
    """Return the place of a file that is not below the hand file."""
    if not there:
        return f"absent/{path.name}"
    return f"files/{hashlib.sha256(path.read_bytes()).hexdigest()[:16]}/{path.name}"


def _described(path: Path) -> Mapping[str, Any]:
    """Return the keys of a hand file; empty if the file is not a YAML mapping."""
    try:
        tree = hand_keys(path)
    except HandError:
        return {}
    return tree if isinstance(tree, dict) else {}


def _packages(path: Path) -> dict[str, Path]:
    """Return the folders of the packages that a hand file or its model names."""
    described = _described(path)
    named, model = described.get("packages"), path.parent / str(described.get("model", ""))
    own = named.items() if isinstance(named, dict) else ()
    folders = {str(k): path.parent / str(v) for k, v in own}
    if model.is_file() and PACKAGE.encode() in model.read_bytes():
        return find_packages(path.parent, str(described.get("model")), {}) | folders
    return folders


def _with_model(path: Path, place: str) -> bytes:
    """Return the text of a hand file with the model at another place and without packages."""
    keys = {**_described(path), "model": place}
    keys.pop("packages", None)

    # Keep comments, unless the keys are written in an unusual way.
    try:
        text = path.read_text(encoding="utf-8")
        text = _MODEL_LINE.sub(lambda match: yaml.safe_dump({"model": place}).strip(), text)
        text = _PACKAGES_LINES.sub("", text)
        same = parse_yaml(text) == keys
    except (yaml.YAMLError, UnicodeDecodeError):
        same = False
    return text.encode() if same else yaml.safe_dump(keys, sort_keys=False).encode()


def _digest(contents: Iterable[bytes]) -> str:
    """Return a hash (16 hex digits) of concatenated contents."""
    digest = hashlib.sha256()
    for content in contents:
        digest.update(content)
    return digest.hexdigest()[:16]


#: Folder of the hand's files in a dataset's directory.
HAND_FOLDER = "hand"


def carried_hand(out: Path, hand: str, digest: str) -> CarriedHand | None:
    """Return the hand in a dataset's directory; None if the dataset does not contain its hand.

    Args:
        out: Directory of the dataset.
        hand: Hand that the dataset's configuration names.
        digest: Digest of the hand's files that the dataset stores.
    """
    path = out.absolute() / HAND_FOLDER / _file_name(hand)
    own = hand == f"{HAND_FOLDER}/{path.name}"
    named = not any(sign in hand for sign in "/\\\0") and os.path.lexists(path)
    return CarriedHand(path=path, digest=digest) if own or named else None


def hand_places(config: Config) -> dict[str, Path]:
    """Return the hand files in a dataset, keyed by their paths in the dataset's directory."""
    carried = config.hand_source
    if not isinstance(carried, CarriedHand):
        return {}
    folder = carried.path.parent
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {f"{HAND_FOLDER}/{path.relative_to(folder).as_posix()}": path for path in files}


def moved_hand(config: Config, folder: Path) -> Config:
    """Return a configuration whose hand is a copy in another directory, at its `hand_places`."""
    carried = config.hand_source
    if not isinstance(carried, CarriedHand):
        return config
    path = folder / HAND_FOLDER / carried.path.name
    return config.with_hand(config.hand, replace(carried, path=path))


def carry_hand(out: Path, config: Config, known: str | None = None) -> Config:
    """Copy the files of a hand into a dataset's directory, unless they are already there.

    Args:
        out: The directory, locked by the caller.
        config: The configuration.
        known: Hand that the dataset in the directory names, the same hand; None for a new dataset.

    Returns:
        The configuration with the hand in the directory.

    Raises:
        HandError: If the hand's files cannot be read, or are too large.
        DataError: If the directory is for a new dataset and contains other files in that place.
        DiskFullError: If the disk has no room for the files.
    """
    # A hand of the package keeps its name; the name of a hand file is in the hash of every shard.
    name = known or config.hand
    if PurePath(name).name != name or name.endswith(".yaml"):
        name = f"{HAND_FOLDER}/{_file_name(name)}"
    path = out.absolute() / HAND_FOLDER / _file_name(name)
    content = hand_folder(config.hand_source, path.name)
    carried = CarriedHand(path=path, digest=content.digest)
    if known is None and not isinstance(config.hand_source, CarriedHand):
        _refuse_other_files(content, path.parent)
    if not _is_there(carried):
        with disk_full_named(out):
            _write(content, path.parent)
    return config.with_hand(name, carried)


def _file_name(hand: str) -> str:
    """Return the file name in a dataset of a hand, given by the name of the hand or its file."""
    return PurePath(hand).name if "/" in hand or hand.endswith(".yaml") else f"{hand}_hand.yaml"


def _is_there(carried: CarriedHand) -> bool:
    """Return whether a directory already contains a hand."""
    try:
        return hand_digest(carried) == carried.digest
    except HandError:
        return False


def _refuse_other_files(content: HandFolder, folder: Path) -> None:
    """Reject a folder that contains user files, because a build replaces and removes its content.

    Raises:
        DataError: If the folder exists and is not a copy of the hand from a build that was killed.
    """
    if not os.path.lexists(folder):
        return
    there = {path for path in folder.rglob("*") if not path.is_dir()}
    copies = {folder / place: content.content(place) for place in (*content.texts, *content.files)}
    is_source = any(path.resolve().is_relative_to(folder.resolve()) for path in content.sources)
    if is_source or there != copies.keys() or any(p.read_bytes() != copies[p] for p in there):
        raise DataError(
            f"{folder}: must not be there before a build, which puts the hand's files there, "
            "got a folder; choose another --out"
        )


def _write(content: HandFolder, folder: Path) -> None:
    """Write the files of a hand, and remove files of another hand that a build left there."""
    shutil.rmtree(folder, ignore_errors=True)
    with atomic_folder(folder) as temporary:
        for place in (*content.texts, *content.files):
            path = temporary / place
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content.content(place))
            sync(path)
