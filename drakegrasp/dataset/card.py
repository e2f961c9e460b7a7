"""The data card: what a dataset is, how it was made, how much it holds, and what it cannot do.

Input: the directory of a dataset. Output: the content of its card, a dictionary of JSON types, and
two files with this content, `DATACARD.json` for programs and `DATACARD.md` for people. The card
contains no time and no machine: the same files produce the same card.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import h5py

from drakegrasp.config import CarriedHand, Config
from drakegrasp.dataset.hdf5 import AnyArray, read_names
from drakegrasp.dataset.manifest import Manifest, ObjectEntry, read_manifest
from drakegrasp.dataset.opening import open_samples
from drakegrasp.dataset.paths import CARD_FILES, DATA_FILES, SCENES_FILE, TRIALS_FILE
from drakegrasp.dataset.scenes import SceneDataset, count_scenes, refuse_other_state
from drakegrasp.dataset.schema import CONVENTIONS, SCHEMA_VERSION, SPLITS
from drakegrasp.dataset.statistics import (
    Funnel,
    by_band,
    distinct_samples,
    funnel_of,
    held_note,
    splits_of,
)
from drakegrasp.dataset.trials import Trials
from drakegrasp.errors import DataError, HandError, printable
from drakegrasp.filters import Removal
from drakegrasp.hand.file_format import HandFile, read_hand_file
from drakegrasp.hand.files import hand_file, hand_names
from drakegrasp.hand.folder import HandFolder, hand_folder
from drakegrasp.outcomes import Outcome
from drakegrasp.runtime.files import write_atomic

#: Licence shown for meshes without a stated one.
NOT_STATED = "not stated"
#: Licence of a hand that comes with the package and has no licence file of its own.
OWN_LICENCE = "BSD-3-Clause, that of drakegrasp"
#: Maximum number of characters shown of a licence's first line.
LONGEST_LINE = 100
#: Known limits, each with the page of drakegrasp's docs that says more.
LIMITS = (
    ("Everything is simulated: no grasp was tried on a real robot.", "explanation/physics.md"),
    (
        "There is a free-floating hand and one rigid object of uniform density on a table: no arm, "
        "no reachability, no clutter, no texture.",
        "explanation/physics.md",
    ),
    (
        "Labels depend on the drive of the fingers, on friction and mass. With the Barrett Hand "
        "about 3 % of the simulated attempts change their outcome when the time step is halved.",
        "results/labels.md",
    ),
    (
        "Samples are successes that passed the filters, so they say nothing of how often a grasp "
        "fails. Among the attempts the outcomes solver_error, timeout and crashed say nothing "
        "about a grasp.",
        "reference/outcomes.md",
    ),
    (
        "The palm poses are drawn: how often a region of an object is grasped says nothing about "
        "how often people grasp it there.",
        "explanation/physics.md",
    ),
    (
        "Simulated values may differ on other machines and versions; what is drawn does not.",
        "explanation/determinism.md",
    ),
)


#: The settings that a reader needs first.
SETTINGS = (
    *("candidates.method", "candidates.max", "candidates.standoffs", "physics.friction_hand"),
    *("physics.friction_table", "objects.mass", "lift.drive", "filters.require"),
    *("filters.max_slip", "filters.max_turn_deg", "camera.size"),
)
#: A hand whose files were found: its hand file, and the folder of all its files.
KnownHand = tuple[HandFile, HandFolder]
#: The files of a dataset that a reader needs, in words.
FILES = {
    "grasping_oto.hdf5, grasping_otm.hdf5": "the samples, as each camera sees them",
    "trials.hdf5": "every attempt with its outcome, also those that failed",
    "manifest.json": "all settings, versions, objects and refused meshes",
    "objects/": "what was simulated of each mesh",
    "hand/": "the hand: its file, model, meshes and licence",
}


def card_content(out: Path) -> dict[str, Any]:
    """Return the content of a dataset's card, as JSON types.

    Args:
        out: Directory of the dataset.

    Raises:
        DataError: If the manifest or one of the three files is missing or damaged.
    """
    content = content_of(read_manifest(out), out / TRIALS_FILE, out / DATA_FILES["oto"])
    if (counts := _count_scenes(out)) is not None:
        content["scenes"] = counts
        content["files"] = {**content["files"], SCENES_FILE: "the scenes"}
    return content


def card_counts(out: Path) -> dict[str, Any]:
    """Return the counts of a dataset's card.

    Raises:
        DataError: If one of the files is missing or damaged.
    """
    attempts = Trials(out, any_name=True)
    with open_samples(out / DATA_FILES["oto"]) as file:
        return _counts(file, funnel_of(attempts), distinct_samples(attempts))


def content_of(manifest: Manifest, trials: Path, data: Path) -> dict[str, Any]:
    """Return the card's content for a manifest and for files that may still have temporary names.

    Args:
        manifest: Manifest of the dataset.
        trials: Path of its trials.hdf5.
        data: Path of one of its data files.

    Raises:
        DataError: If one of the files is missing or damaged.
    """
    # While a build that adds objects runs, the manifest has more objects than the files.
    attempts, config = Trials(trials, any_name=True), manifest.config
    funnel, hand = funnel_of(attempts), _known_hand(config)
    entries = [entry for entry in manifest.objects if entry.name in funnel.names]
    with open_samples(data) as file:
        rule = str(file.attrs.get("split_by", "class"))
        counts = _counts(file, funnel, distinct_samples(attempts))

    # The known limits, and one limit that follows from the counts.
    limits = [*LIMITS]
    if note := held_note(funnel):
        limits.append((f"{note[0].upper()}{note[1:]}.", "reference/outcomes.md"))

    return {
        "title": f"Simulated grasps of {len(entries)} object{'s' * (len(entries) != 1)}",
        "hand": Path(config.hand).stem,
        "hand_digest": manifest.versions.get("hand", ""),
        "hand_licences": _hand_licences(config, hand),
        "fingers": list(manifest.fingers),
        "joints": list(manifest.joints),
        "schema_version": SCHEMA_VERSION,
        "seed": config.seed,
        "config_hash": config.simulation_hash(),
        "settings": _settings(config, hand),
        "split_by": rule,
        "versions": manifest.versions,
        "licences": licences(entries),
        "counts": counts,
        "refused": {mesh.name: mesh.reason for mesh in manifest.refused},
        "files": FILES,
        "conventions": CONVENTIONS,
        "limits": [{"limit": text, "docs": f"docs/{page}"} for text, page in limits],
    }


def _count_scenes(out: Path) -> dict[str, dict[str, int]] | None:
    """Return the counts of scenes.hdf5; None if it is missing, damaged or outdated."""
    path = out / SCENES_FILE
    if not path.is_file():
        return None
    try:
        refuse_other_state(path, Trials(out, any_name=True))
        return count_scenes(SceneDataset(path, points=None).tables)
    except DataError:
        return None  # `drakegrasp check` says why


def licences(entries: Iterable[ObjectEntry]) -> dict[str, list[str]]:
    """Return the names of the objects for each licence of their meshes, sorted by licence."""
    found: dict[str, list[str]] = {}
    for entry in entries:
        found.setdefault(entry.licence or NOT_STATED, []).append(entry.name)
    return dict(sorted(found.items()))


def _settings(config: Config, hand: KnownHand | None) -> dict[str, Any]:
    """Return the settings that a reader needs first; the manifest has all settings."""
    tree = config.to_dict()
    settings = {key: tree[room][name] for key in SETTINGS for room, name in [key.split(".")]}
    # Labels depend on the drive. The file of an older dataset's hand may have moved.
    if config.lift.drive is None:
        settings["lift.drive"] = hand[0].drive if hand else "that of the hand file"
    return settings


def _known_hand(config: Config) -> KnownHand | None:
    """Return the hand if it is in the dataset or the package and unchanged, or else None."""
    source = config.hand_source
    if not isinstance(source, CarriedHand) and config.hand not in hand_names():
        return None
    try:
        folder = hand_folder(source)
        if isinstance(source, CarriedHand) and folder.digest != source.digest:
            return None
        return read_hand_file(hand_file(source)), folder
    except HandError:
        return None


def _hand_licences(config: Config, hand: KnownHand | None) -> dict[str, str]:
    """Return the first line of each licence of a hand, by the name of the licence file."""
    if hand is None:
        return {}
    found = {}
    for place in hand[1].licences:
        # The first line of the text that is not empty, shortened.
        text = hand[1].content(place).decode(errors="replace")
        lines = (printable(line.strip()) for line in text.splitlines())
        found[place] = next(filter(None, lines), "")[:LONGEST_LINE]
    return found or ({"LICENSE": OWN_LICENCE} if config.hand in hand_names() else {})


def _counts(file: h5py.File, funnel: Funnel, distinct: AnyArray) -> dict[str, Any]:
    """Return the numbers of attempts, grasps and samples: in total, by class, object and split."""
    samples = {
        split: Counter(read_names(file[split]["object_props/object_name"])) for split in SPLITS
    }
    members: dict[str, list[int]] = {}
    for i, name in enumerate(funnel.classes):
        members.setdefault(name, []).append(i)

    outcomes, removals = funnel.outcomes.sum(axis=0), funnel.removals.sum(axis=0)
    return {
        "all": _row(funnel, samples, range(len(funnel.names))),
        "outcomes": {o.label: int(outcomes[o]) for o in Outcome if outcomes[o]},
        "removed": {
            r.label: int(removals[r]) for r in Removal if r is not Removal.KEPT and removals[r]
        },
        "approaches": {
            "cells": int(funnel.approach_cells.sum()),
            "elevations": by_band(funnel.elevations.sum(axis=0)),
        },
        "splits": {
            row.split: {key: value for key, value in asdict(row).items() if key != "split"}
            for row in splits_of(file, distinct)
        },
        "classes": {
            name: {"objects": len(places), **_row(funnel, samples, places)}
            for name, places in sorted(members.items())
        },
        "objects": {
            name: {"class": funnel.classes[i], **_row(funnel, samples, [i])}
            for i, name in enumerate(funnel.names)
        },
    }


def _row(
    funnel: Funnel, samples: Mapping[str, Counter[str]], objects: Sequence[int]
) -> dict[str, int]:
    """Return the summed counts of several objects."""
    counts = {
        "attempts": funnel.outcomes,
        "held": funnel.outcomes[:, Outcome.SUCCESS],
        "precision": funnel.precision,
        "stable": funnel.stable,
        "samples": funnel.samples,
        "distinct": funnel.distinct,
    }
    return {
        **{name: int(values[objects].sum()) for name, values in counts.items()},
        **{split: sum(samples[split][funnel.names[i]] for i in objects) for split in SPLITS},
    }


# As files


def write_card(out: Path) -> None:
    """Write both files of the card, each completely or not at all.

    Args:
        out: Directory of the dataset, in which the three files exist.

    Raises:
        DataError: If a file of the dataset is missing or damaged.
        OSError: If the disk is full.
    """
    for name, text in card_files(card_content(out)).items():
        write_atomic(out / name, text)


def card_files(content: dict[str, Any]) -> dict[str, bytes]:
    """Return the bytes of both files, by their names.

    Args:
        content: Content of the card, see `card_content`.
    """
    text = json.dumps(content, indent=1, ensure_ascii=False) + "\n"
    return dict(zip(CARD_FILES, (text.encode(), card_text(content).encode()), strict=True))


def card_text(content: Mapping[str, Any]) -> str:
    """Return a card as Markdown.

    Args:
        content: Content as `card_content` returns it, or a part of it.
    """
    sections = [section(content) for key, section in SECTIONS if key in content]
    text = "\n\n".join(filter(None, sections))
    return f"# {_plain(content['title'])}\n\n{text}\n"


def _what(content: Mapping[str, Any]) -> str:
    said = (("fingers in the order of a grasp", "fingers"), ("joints in that of a `q`", "joints"))
    fingers, joints = (
        f" The {what}: {', '.join(map(_plain, content[key]))}." if content[key] else ""
        for what, key in said
    )
    conventions = "\n".join(f"* **{k}**: {text}" for k, text in content["conventions"].items())
    return f"""## What it is

Every sample is a grasp that a simulated hand (`{content["hand"]}`) closed, lifted and held, with
colour, depth and mask as a camera behind the palm sees the object before. Made by drakegrasp; its
docs explain every field.{fingers}{joints}

{conventions}"""


def _files(content: Mapping[str, Any]) -> str:
    rows = [(f"`{name}`", what) for name, what in content["files"].items()]
    return f"""## Files

{_table(("file", "what is in it"), rows)}"""


def _how(content: Mapping[str, Any]) -> str:
    settings = _table(("setting", "value"), [(f"`{k}`", v) for k, v in content["settings"].items()])
    versions = ", ".join(f"{name} {version}" for name, version in content["versions"].items())
    return f"""## How it was made

Schema {content["schema_version"]}, seed {content["seed"]}, configuration
`{content["config_hash"]}`.

{settings}

Versions: {versions}."""


def _licences(content: Mapping[str, Any]) -> str:
    rows = [(licence, ", ".join(names)) for licence, names in content["licences"].items()]
    hand = _table(("file", "its first line"), list(content["hand_licences"].items()))
    return f"""## Licence of the hand

The files of the hand `{content["hand"]}` are in `hand/`, digest `{content["hand_digest"]}`.

{hand if content["hand_licences"] else "Its licence is not stated."}

## Licence of the meshes

As it was stated in `objects.yaml`; that of the built-in objects is the package's.

{_table(("licence", "objects"), rows)}"""


def _how_many(content: Mapping[str, Any]) -> str:
    counts = content["counts"]
    names = tuple(counts["all"])
    splits = [(name, *row.values()) for name, row in counts["splits"].items()]
    classes = [(name, *row.values()) for name, row in counts["classes"].items()]
    classes.append(("**all**", len(counts["objects"]), *counts["all"].values()))
    objects = [(name, *row.values()) for name, row in counts["objects"].items()]

    # The share of the distinct grasps by the elevation of the approach.
    distinct, (cells, elevations) = counts["all"]["distinct"], counts["approaches"].values()
    approaches = [
        (f"{band}°", number, f"{number / distinct:.0%}")
        for band, number in elevations.items()
        if distinct
    ]

    # Tables that would be empty are left out.
    tables = [
        (
            f"Samples by split, which is by {content['split_by']}",
            ("split", "samples", "distinct", "objects", "classes"),
            splits,
        ),
        ("From where the palm comes", ("above the table", "distinct", "share"), approaches),
        ("By class", ("class", "objects", *names), classes),
        ("By object", ("object", "class", *names), objects),
        ("Outcomes of the attempts", ("outcome", "attempts"), list(counts["outcomes"].items())),
        ("Held grasps that are no samples", ("filter", "grasps"), list(counts["removed"].items())),
        ("Meshes that were refused", ("mesh", "reason"), list(content["refused"].items())),
    ]
    parts = [f"### {head}\n\n{_table(heads, rows)}" for head, heads, rows in tables if rows]
    head = f"""## How many

*Held* are the attempts that lifted the object and kept it in the hand; *precision* grasps are those
of them that the fingertips held alone; *stable* those of these in which the object moved by less
than 5 mm and 5 degrees in the hand; *samples* those that passed all filters; *distinct* those
samples whose palm is not within 20 mm and 30 degrees of that of another distinct one of the same
object in the same resting pose, in the order of the rows. Seen from their objects, the palms of the
samples come from {cells:,} cells, of 42 directions each."""
    return "\n\n".join([head, *parts])


def _scenes(content: Mapping[str, Any]) -> str:
    rows = [(split, *counts.values()) for split, counts in content["scenes"].items()]
    heads = ("split", *next(iter(content["scenes"].values())))
    return f"""## Scenes

A scene is an object in a resting pose, anywhere on the table, with views by cameras that know no
grasp, and all hands that closed on the object in that pose. *Tested* are grasps that were lifted to
a verdict. No object is in two splits.

{_table(heads, rows)}"""


def _limits(content: Mapping[str, Any]) -> str:
    lines = "\n".join(f"* {each['limit']} ({each['docs']})" for each in content["limits"])
    return f"## Known limits\n\nThe pages are those of drakegrasp's repository.\n\n{lines}"


#: The sections of the card in order, each with the key of the content that it needs.
SECTIONS: tuple[tuple[str, Callable[[Mapping[str, Any]], str]], ...] = (
    ("conventions", _what),
    ("files", _files),
    ("settings", _how),
    ("licences", _licences),
    ("counts", _how_many),
    ("scenes", _scenes),
    ("limits", _limits),
)


def _table(heads: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a Markdown table; columns of integers are aligned to the right."""
    rows = list(rows)
    sides = ["--:" if all(type(r[k]) is int for r in rows) else "---" for k in range(len(heads))]
    lines = [heads, sides, *([_cell(value) for value in row] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _cell(value: object) -> str:
    if value is None:
        return "null"
    return f"{value:,}" if type(value) is int else _plain(str(value))


def _plain(text: str) -> str:
    """Return a text without characters that are special in Markdown tables and HTML."""
    signs = {"&": "&amp;", "<": "&lt;", ">": "&gt;", "\\": "\\\\", "|": "\\|"}
    for sign, written in signs.items():
        text = text.replace(sign, written)
    return " ".join(text.split())
