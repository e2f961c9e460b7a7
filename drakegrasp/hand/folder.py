"""The folder that holds all files of a hand, and a digest of its content.

Input: a hand. Output: which files it has: hand file, model, weights, licences, and meshes with the
files that they name. They lie in the folder of the hand file or below it, so that the folder can be
copied: a file elsewhere is rejected.

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
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path, PurePath
from typing import Any
from xml.sax.saxutils import unescape

from drakegrasp.config import CarriedHand, Config, HandSource
from drakegrasp.errors import DataError, HandError
from drakegrasp.hand.file_format import HandFile, hand_file, parse_hand_file, validate_inside
from drakegrasp.runtime.files import atomic_folder, disk_full_named, sync

#: Maximum total size [byte], YAML size [byte] and number of a hand's files; a stranger may have
#: written them.
LARGEST, LARGEST_YAML, MOST_FILES = 2**29, 2**18, 1000
#: Number of hands whose files a process remembers.
KEPT = 32
#: Names of licence files next to a hand file or its model.
_LICENCE = re.compile(r"(LICEN[CS]E|COPYING|NOTICE)([._ -].*)?", re.IGNORECASE)
#: References in a model: meshes and models in SDFormat, meshes in URDF, then textures.
REFERENCES = re.compile(
    rb"<uri>\s*(?P<uri>.*?)\s*</uri>|<mesh\b[^>]*\bfilename\s*=\s*[\"'](?P<mesh>.*?)[\"']"
    rb"|<texture\b[^>]*\bfilename\s*=\s*[\"'](?P<texture>.*?)[\"']"
    rb"|<drake:diffuse_map>\s*(?P<map>.*?)\s*</drake:diffuse_map>"
)
#: References in files by their suffixes: models and what they include, materials of a Wavefront
#: file, their textures at the end of a line, and parts of a glTF file.
_NAMED = {
    **dict.fromkeys((".sdf", ".urdf", ".xml"), REFERENCES),
    ".obj": re.compile(rb"^[ \t]*mtllib[ \t]+(.+?)[ \t\r]*$", re.MULTILINE),
    ".mtl": re.compile(
        rb"^[ \t]*(?:map_\w+|bump|disp|norm)[ \t](?:.*[ \t])?(\S+)[ \t\r]*$", re.MULTILINE
    ),
    ".gltf": re.compile(rb'"uri"\s*:\s*"(?!data:)([^"]+)"'),
}


def hand_digest(source: HandSource) -> str:
    """Return a hash (16 hex digits) of a hand's files, see `HandFolder.digest`.

    It differs between two hands of the same name. `description.load_hand` rejects missing files.

    Raises:
        HandError: As `hand_folder`.
    """
    return hand_folder(source).digest


def hand_folder(source: HandSource) -> HandFolder:
    """Return the files of a hand; they are read again if one of them has changed.

    Raises:
        HandError: If there is no such hand, a key or value of the hand file is invalid, a file
            cannot be read, the files are too large, or one of them names a file outside of the
            folder.
    """
    place = hand_file(source).absolute(), isinstance(source, CarriedHand)
    found = _read_folder(*place)
    if found.stamp != file_stamp(found.asked):
        _read_folder.cache_clear()
        found = _read_folder(*place)
    return found


@lru_cache(maxsize=KEPT)
def _read_folder(path: Path, is_carried: bool) -> HandFolder:
    """Return the files of the hand of a hand file."""
    found = HandFolder(root=path.parent, name=path.name, is_carried=is_carried)
    found.described = parse_hand_file(path, found.add(path.name))
    model = found.place_of(found.described.model, "")
    found.add(model)
    found.add_licences(path.stem.removesuffix("_hand"), model)
    found.stamp = file_stamp(found.asked)
    return found


def file_stamp(files: Collection[Path]) -> tuple[int, ...]:
    """Return sizes [byte] and modification times [ns] of the files that exist."""
    stats = [path.stat() for path in files if path.exists()]
    return tuple(number for s in stats for number in (s.st_size, s.st_mtime_ns))


# Not frozen: its files are collected, and hashed, one by one.
@dataclass(kw_only=True, eq=False)
class HandFolder:
    """The files of a hand. A place is a path in its folder.

    Attributes:
        root: The folder.
        name: Name of the hand file.
        is_carried: Whether it is the hand of a dataset, which a stranger may have written.
        files: Paths of the files that exist, by place: the hand file, the model, what they name,
            and licences.
        licences: Places of the licences.
        asked: Paths of the named files, whether they exist or not.
        stamp: Sizes and times of these files.
        size: Total size of the files [byte].
        described: Contents of the hand file.
        sha256: Hash of all files but licences, independent of the folder.
    """

    root: Path
    name: str
    is_carried: bool
    files: dict[str, Path] = field(default_factory=dict)
    licences: list[str] = field(default_factory=list)
    asked: dict[Path, bool] = field(default_factory=dict)
    stamp: tuple[int, ...] = ()
    size: int = 0
    described: HandFile = field(init=False)
    sha256: Any = field(default_factory=hashlib.sha256)

    def content(self, place: str) -> bytes:
        """Return the bytes of a file; empty if it does not exist."""
        return self.files[place].read_bytes() if place in self.files else b""

    @property
    def digest(self) -> str:
        """The first 16 hexadecimal digits of the hash."""
        return str(self.sha256.hexdigest()[:16])

    def place_of(self, reference: str, base: str) -> str:
        """Return the place of a file that a file in the folder `base` names.

        Raises:
            HandError: If it is outside of the folder.
        """
        place = posixpath.normpath(posixpath.join(base, reference))
        if "://" in reference or reference.startswith("/") or place.split("/")[0] == "..":
            raise HandError(
                f"{self.root}: must name files in it only, got {reference!r}: copy the files into "
                "the folder of the hand file, as `drakegrasp hand new` does"
            )
        return place

    def has(self, path: Path) -> bool:
        """Record a file, and return whether it exists.

        Raises:
            HandError: If the file is outside the folder of a dataset's hand, is a pipe or a device,
                or makes the files too large.
        """
        # Count a file once; a file of a dataset's hand must be in its folder.
        if path in self.asked:
            return self.asked[path]
        if "\0" in str(path):
            return False
        if self.is_carried and os.path.lexists(path):
            validate_inside(path, self.root)
        self.asked[path] = path.is_file()
        if not self.asked[path]:
            if path.exists() and not path.is_dir():  # Drake would read it without end
                raise HandError(f"{path}: must be a file, got a pipe, a socket or a device")
            return False

        # A stranger's files must not fill the memory, and parsed YAML takes many times its size.
        size = path.stat().st_size
        self.size += size
        long = path.suffix.lower() in (".yaml", ".yml") and size > LARGEST_YAML
        if self.size > LARGEST or long or len(self.asked) > MOST_FILES:
            raise HandError(
                f"{path}: the files of a hand must be at most {MOST_FILES} and {LARGEST >> 20} MB "
                f"in all, its YAML {LARGEST_YAML >> 10} kB, got more"
            )
        return True

    def add(self, place: str) -> bytes:
        """Add a file and the files that it names, unless it is missing or already added.

        Returns:
            The content of the file; empty if it is not added.

        Raises:
            HandError: If a file cannot be read, or as `has` and `place_of`.
        """
        path = self.root / place
        if place in self.files or not self.has(path):
            return b""
        try:
            content = path.read_bytes()
        except OSError as error:
            raise HandError(f"{path}: must be readable, got: {error.strerror}") from None
        self.files[place] = path
        self.sha256.update(content)
        for reference in _references(path, content):
            self.add(self.place_of(reference, posixpath.dirname(place)))
        return content

    def add_licences(self, hand: str, model: str) -> None:
        """Add the licences beside the hand file and the model."""
        for base in dict.fromkeys(("", posixpath.dirname(model))):
            folder = self.root / base
            for path in sorted(folder.iterdir()) if folder.is_dir() else ():
                # In a folder with several hands, the name of a licence may begin with the hand's
                # name.
                name = path.name.removeprefix(f"{hand}_")
                if _LICENCE.fullmatch(name) and self.has(path):
                    place = name if name not in self.files else f"{name}-{len(self.licences)}"
                    self.files[place] = path
                    self.licences.append(place)


def _references(path: Path, content: bytes) -> Iterator[str]:
    """Yield each file that a model, a mesh or a material names."""
    pattern = _NAMED.get(path.suffix.lower())
    for match in pattern.finditer(content) if pattern else ():
        reference = match[match.lastindex or 0].decode(errors="surrogateescape")
        yield unescape(reference) if pattern is REFERENCES else reference


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
    content = hand_folder(config.hand_source)
    carried = CarriedHand(path=path, digest=content.digest)
    if known is None and not isinstance(config.hand_source, CarriedHand):
        _validate_no_other_files(content, path)
    try:
        is_there = hand_digest(carried) == carried.digest
    except HandError:
        is_there = False
    if not is_there:
        with disk_full_named(out):
            _write(content, path)
    return config.with_hand(name, carried)


def _file_name(hand: str) -> str:
    """Return the file name in a dataset of a hand, given by the name of the hand or its file."""
    return PurePath(hand).name if "/" in hand or hand.endswith(".yaml") else f"{hand}_hand.yaml"


def _validate_no_other_files(content: HandFolder, path: Path) -> None:
    """Reject a folder that contains user files, because a build replaces and removes its content.

    Args:
        content: The files of the hand.
        path: Their hand file in the dataset's directory.

    Raises:
        DataError: If the folder exists and is not a copy of the hand from a build that was killed.
    """
    folder = path.parent
    if not os.path.lexists(folder):
        return
    there = {path for path in folder.rglob("*") if not path.is_dir()}
    copies = {to: content.content(place) for place, to in _copies(content, path).items()}
    is_source = any(path.resolve().is_relative_to(folder.resolve()) for path in content.asked)
    if is_source or there != copies.keys() or any(p.read_bytes() != copies[p] for p in there):
        raise DataError(
            f"{folder}: must not be there before a build, which puts the hand's files there, "
            "got a folder; choose another --out"
        )


def _copies(content: HandFolder, path: Path) -> dict[str, Path]:
    """Return the path of each file's copy, by its place, if that of the hand file is `path`."""
    return {place: path.parent / place for place in content.files} | {content.name: path}


def _write(content: HandFolder, path: Path) -> None:
    """Write the files of a hand, and remove files of another hand that a build left there."""
    folder = path.parent
    shutil.rmtree(folder, ignore_errors=True)
    with atomic_folder(folder) as temporary:
        for place, copy in _copies(content, temporary / path.name).items():
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_bytes(content.content(place))
            sync(copy)
