"""Decisions of an inspection: `reject.json`.

`drakegrasp inspect` writes `reject.json` into a dataset's directory, a new file for every decision;
`drakegrasp assemble --reject` reads it. The file identifies an attempt by its object, palm pose and
stand-off, which stay valid while a build runs and after other attempts were added.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, with_config

from drakegrasp.dataset.json_files import Name, read_mapping, stated, validated
from drakegrasp.errors import DataError, listed, printable
from drakegrasp.runtime.files import write_atomic

REJECT_FILE = "reject.json"
#: Version of the file's layout.
VERSION = 1


@with_config(ConfigDict(extra="forbid"))
@dataclass(frozen=True, order=True)
class AttemptKey:
    """The identity of an attempt in a dataset.

    Attributes:
        object: Name of its object.
        candidate: Index of its palm pose among the object's candidates.
        standoff_index: Index into the configuration's stand-offs.
    """

    object: Name
    candidate: Annotated[int, Field(ge=0, le=2**31 - 1)]
    standoff_index: Annotated[int, Field(ge=0, le=255)]

    def __str__(self) -> str:
        return f"{self.object}, palm pose {self.candidate}, stand-off {self.standoff_index}"


@dataclass(frozen=True, kw_only=True)
class Decisions:
    """What an inspection decided.

    Attributes:
        rejected: Attempts that must not become samples.
        kept: Attempts that a person looked at and found good; they only inform people.
    """

    rejected: frozenset[AttemptKey] = field(default_factory=frozenset)
    kept: frozenset[AttemptKey] = field(default_factory=frozenset)

    def of(self, key: AttemptKey) -> str:
        """Return `rejected`, `kept`, or an empty text if there is no decision."""
        return "rejected" if key in self.rejected else "kept" if key in self.kept else ""

    def with_decision(self, key: AttemptKey, decision: str) -> Decisions:
        """Return the decisions with a new one for an attempt; an empty text withdraws the old one.

        Raises:
            ValueError: If the text is not a decision.
        """
        if decision not in ("rejected", "kept", ""):
            raise ValueError(f"decision must be rejected, kept or empty, got {decision!r}")
        rejected, kept = self.rejected - {key}, self.kept - {key}
        if decision == "rejected":
            rejected |= {key}
        elif decision == "kept":
            kept |= {key}
        return Decisions(rejected=rejected, kept=kept)


def read_decisions(path: Path) -> Decisions:
    """Return the decisions in a `reject.json`; no decisions if there is no such file.

    Raises:
        DataError: If the file is not a list of rejections of this version.
    """
    try:
        tree, content = read_mapping(path, "a list of rejections of drakegrasp inspect")
    except FileNotFoundError:
        return Decisions()
    version = tree.get("version")
    if type(version) is not int or version != VERSION:
        got = printable(repr(version)[:40])
        raise DataError(
            f"{path}: must be a list of rejections of drakegrasp inspect of version {VERSION}, "
            f"got version {got}"
        )
    stored = validated(path, content, _Stored)
    return Decisions(rejected=frozenset(stored.rejected), kept=frozenset(stored.kept))


class _Stored(BaseModel):
    """The keys of the file."""

    version: int
    rejected: tuple[AttemptKey, ...]
    kept: tuple[AttemptKey, ...]


def write_decisions(path: Path, decisions: Decisions) -> None:
    """Write a `reject.json` atomically; equal decisions produce equal bytes."""
    content = {
        "version": VERSION,
        "rejected": [stated(key) for key in sorted(decisions.rejected)],
        "kept": [stated(key) for key in sorted(decisions.kept)],
    }
    write_atomic(path, (json.dumps(content, indent=1, ensure_ascii=False) + "\n").encode())


def find_keys(
    rejected: Sequence[int | AttemptKey], ids: Mapping[AttemptKey, int], out: Path
) -> tuple[AttemptKey, ...]:
    """Return the identities of the rejected attempts, sorted and each once.

    A key that is not a success of the dataset is left out: its object may have been removed, or
    a target may end before it. An id must be that of a success, since ids belong to these
    files.

    Args:
        rejected: Ids of trials, or keys of attempts.
        ids: Ids of all successes.
        out: Directory of the dataset, for the message.

    Raises:
        DataError: If an id is not that of a success.
    """
    keys = {number: key for key, number in ids.items()}
    used = {entry for entry in rejected if isinstance(entry, AttemptKey) and entry in ids}
    for entry in rejected:
        if not isinstance(entry, AttemptKey):
            if entry not in keys:
                raise DataError(f"{out}: rejected trials must be successes, got trial {entry}")
            used.add(keys[entry])
    return tuple(sorted(used))


def unused_rejections(
    out: Path, given: Sequence[int | AttemptKey], used: Sequence[AttemptKey]
) -> list[str]:
    """Return what a person must know of rejections without effect, one sentence for each case.

    Args:
        out: Directory of the dataset.
        given: Requested rejections.
        used: Attempts that are now rejected.
    """
    # Requested rejections that are not successes of the dataset.
    keys = {key for key in given if isinstance(key, AttemptKey)}
    skipped = sorted(keys - set(used))
    if skipped:
        named = listed([str(key) for key in skipped], separator="; ")
        return [
            f"skipped {len(skipped):,} of {len(keys):,} rejections, which name no success of the "
            f"dataset: {named}"
        ]

    # Rejections of an inspection that were not requested.
    path = out / REJECT_FILE
    try:
        forgotten = read_decisions(path).rejected - set(used)
    except (DataError, OSError):
        forgotten = frozenset()
    if forgotten and not keys:
        return [
            f"{path}: rejections that were not used: {len(forgotten):,}; "
            f"--reject {shlex.quote(str(path))} uses them"
        ]
    return []
