"""The hand that a dataset carries: copied at the start of a build, read there from then on.

In: the directory of a dataset and a configuration, whose hand may be anywhere. Out: `hand/` in the
directory, whole or not at all, and the configuration with the hand in it, so that workers and later
commands need no other file of the hand. Does not import Drake.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path, PurePath

from drakegrasp.config import CarriedHand, Config
from drakegrasp.errors import DataError, HandError
from drakegrasp.hand.folder import HandFolder, hand_digest, hand_folder
from drakegrasp.runtime.files import atomic_folder, disk_full_named, sync

#: Folder of the hand's files in a dataset's directory.
HAND_FOLDER = "hand"


def carried_hand(out: Path, hand: str, digest: str) -> CarriedHand | None:
    """Return the hand in a dataset's directory; None for a dataset that carries none.

    Args:
        out: Directory of the dataset.
        hand: What the dataset's configuration names.
        digest: What the dataset says of the hand's files.
    """
    path = out.absolute() / HAND_FOLDER / _file_name(hand)
    own = hand == f"{HAND_FOLDER}/{path.name}"
    named = not any(sign in hand for sign in "/\\\0") and os.path.lexists(path)
    return CarriedHand(path=path, digest=digest) if own or named else None


def carry_hand(out: Path, config: Config, known: str | None = None) -> Config:
    """Copy the files of a hand into a dataset's directory, unless they are there.

    Args:
        out: The directory, which the caller holds.
        config: The configuration.
        known: What the dataset in the directory names, whose hand is the same; None for a new one.

    Returns:
        The configuration with the hand in the directory.

    Raises:
        HandError: If the hand's files cannot be read, or are too large.
        DataError: If the directory is a new dataset's, and has files of somebody in that place.
        DiskFullError: If there is no room for them.
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
    """Return the name of the hand file in a dataset, of a hand of the package or a hand file."""
    return PurePath(hand).name if "/" in hand or hand.endswith(".yaml") else f"{hand}_hand.yaml"


def _is_there(carried: CarriedHand) -> bool:
    """Return whether a directory holds a hand already."""
    try:
        return hand_digest(carried) == carried.digest
    except HandError:
        return False


def _refuse_other_files(content: HandFolder, folder: Path) -> None:
    """Refuse a folder that may be somebody's own: a build replaces and removes what is in its own.

    Raises:
        DataError: If it is there, and no copy of the hand that a build left when it was killed.
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
    """Write the files of a hand; what a build has left there of another one goes."""
    shutil.rmtree(folder, ignore_errors=True)
    with atomic_folder(folder) as temporary:
        for place in (*content.texts, *content.files):
            path = temporary / place
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content.content(place))
            sync(path)
