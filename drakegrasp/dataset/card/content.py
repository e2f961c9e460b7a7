"""What a data card says, as plain data, from the manifest and the three files of a dataset.

In: the directory of a dataset. Out: a dictionary of JSON types, the content of `DATACARD.json`. It
has no time and no machine in it: the same files give the same card.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from drakegrasp.arithmetic import norm
from drakegrasp.config import CarriedHand, Config
from drakegrasp.dataset.card.holding import holding_lines, holding_of
from drakegrasp.dataset.hdf5 import read_names
from drakegrasp.dataset.manifest import Manifest, ObjectEntry, read_manifest
from drakegrasp.dataset.opening import open_samples
from drakegrasp.dataset.paths import DATA_FILES, SCENES_FILE, TRIALS_FILE
from drakegrasp.dataset.scenes.reader import SceneDataset, count_scenes
from drakegrasp.dataset.scenes.rows import refuse_other_state
from drakegrasp.dataset.schema import CONVENTIONS, SCHEMA_VERSION, SPLITS
from drakegrasp.dataset.statistics import (
    Funnel,
    funnel_of,
    held_note,
    split_rule_of,
    splits_of,
)
from drakegrasp.dataset.trials import Trials
from drakegrasp.errors import DataError, HandError, printable
from drakegrasp.hand.file_format import HandFile, rated_load, read_hand_file
from drakegrasp.hand.files import hand_file, hand_names
from drakegrasp.hand.folder import HandFolder, hand_folder
from drakegrasp.outcomes import Outcome, Removal

#: What the licence is called of meshes for which none is stated.
NOT_STATED = "not stated"
#: The licence of a hand that comes with the package and has none of its own.
OWN_LICENCE = "BSD-3-Clause, that of drakegrasp"
#: Signs of a licence's first line.
LONGEST_LINE = 100
#: Known limits, and the page of drakegrasp's docs that says more.
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
        "benchmarks.md",
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


#: The files of a dataset that a reader needs, in words.
FILES = {
    "grasping_oto.hdf5, grasping_otm.hdf5": "the samples, as each camera sees them",
    "trials.hdf5": "every attempt with its outcome, also those that failed",
    "manifest.json": "all settings, versions, objects and refused meshes",
    "objects/": "what was simulated of each mesh",
    "hand/": "the hand: its file, model, meshes and licence",
}


def card_content(out: Path) -> dict[str, Any]:
    """Return what the card of a dataset says, as JSON types.

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


def content_of(manifest: Manifest, trials: Path, data: Path) -> dict[str, Any]:
    """Return what the card says of a manifest and of files that may not have their names yet.

    Args:
        manifest: Of the dataset.
        trials: Its trials.hdf5.
        data: One of its data files.

    Raises:
        DataError: If one of the files is missing or damaged.
    """
    # The manifest has more objects than the files while a build goes on that adds some.
    attempts = Trials(trials, any_name=True)
    funnel, holding = funnel_of(attempts), holding_of(attempts)
    entries = [entry for entry in manifest.objects if entry.name in funnel.names]

    # The known limits, and one that follows from the counts.
    limits = [*LIMITS]
    if note := held_note(funnel):
        limits.append((f"{note[0].upper()}{note[1:]}.", "reference/outcomes.md"))

    return {
        "title": f"Simulated grasps of {len(entries)} object{'s' * (len(entries) != 1)}",
        "hand": Path(manifest.config.hand).stem,
        "hand_digest": manifest.versions.get("hand", ""),
        "hand_licences": _hand_licences(manifest.config),
        "fingers": list(manifest.fingers),
        "joints": list(manifest.joints),
        "schema_version": SCHEMA_VERSION,
        "seeds": sorted({entry.config_in(manifest.config).seed for entry in entries}),
        "config_hash": manifest.config.simulation_hash(),
        "settings": _settings(manifest.config),
        "split_by": split_rule_of(data),
        "versions": manifest.versions,
        "licences": licences(entries),
        "counts": _counts(data, funnel),
        **_loads(data, manifest.config),
        # The same bytes as before there were repeats, where there are none.
        **(
            {}
            if holding is None
            else {"p_hold": {"in_words": holding_lines(holding), **asdict(holding)}}
        ),
        "refused": {mesh.name: mesh.reason for mesh in manifest.refused},
        "files": FILES,
        "conventions": CONVENTIONS,
        "limits": [{"limit": text, "docs": f"docs/{page}"} for text, page in limits],
    }


def _count_scenes(out: Path) -> dict[str, dict[str, int]] | None:
    """Return the counts of scenes.hdf5; None if there is none, or a damaged or older one."""
    path = out / SCENES_FILE
    if not path.is_file():
        return None
    try:
        refuse_other_state(path, Trials(out, any_name=True))
        return count_scenes(SceneDataset(path, points=None).tables)
    except DataError:
        return None  # `drakegrasp check` says why


def licences(entries: Iterable[ObjectEntry]) -> dict[str, list[str]]:
    """Return the objects' names by the licence of their meshes, in the order of the names."""
    found: dict[str, list[str]] = {}
    for entry in entries:
        found.setdefault(entry.licence or NOT_STATED, []).append(entry.name)
    return dict(sorted(found.items()))


def _settings(config: Config) -> dict[str, Any]:
    """Return the settings that a reader asks for first; the manifest has all of them."""
    keys = {
        "candidates": ("method", "max", "standoffs"),
        "physics": ("friction_hand", "friction_table"),
        "objects": ("mass",),
        "lift": ("drive",),
        "filters": ("require", "max_slip", "max_turn_deg"),
        "camera": ("size",),
    }
    tree = config.to_dict()
    settings = {f"{room}.{key}": tree[room][key] for room, names in keys.items() for key in names}

    # Labels depend on the drive. The file of an older dataset's hand may be elsewhere now.
    if config.lift.drive is None:
        known = _known_hand(config)
        settings["lift.drive"] = known[0].drive if known else "that of the hand file"
    return settings


def _known_hand(config: Config) -> tuple[HandFile, HandFolder] | None:
    """Return the hand of the dataset or the package; None if it is neither's, or has changed."""
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


def _hand_licences(config: Config) -> dict[str, str]:
    """Return the first line of each licence of a hand, by the name of its file."""
    if (known := _known_hand(config)) is None:
        return {}
    folder = known[1]
    found = {place: _first_line(folder.content(place)) for place in folder.licences}
    return found or ({"LICENSE": OWN_LICENCE} if config.hand in hand_names() else {})


def _loads(data: Path, config: Config) -> dict[str, Any]:
    """Return how the samples' forces compare with the hand's rated load; nothing if it is unknown.

    A fingertip's force is the larger one of after closing and after the lift.
    """
    known = _known_hand(config)
    rated = None if known is None else rated_load(known[0])
    if rated is None:
        return {}

    with open_samples(data) as file:
        forces = np.concatenate(
            [
                np.maximum(
                    *(norm(file[split][f"grasp_props/f_Q_C{when}"][:]) for when in ("", "_held"))
                )
                for split in SPLITS
            ]
        )
    # A finger that a preshape leaves out has none.
    largest = np.nan_to_num(forces).max(axis=1, initial=0.0)
    loads = {"rated_N": rated, "above": int((largest > rated).sum()), "samples": len(forces)}
    if len(forces):
        loads["median_N"] = round(float(np.median(largest)), 1)
    return {"fingertip_loads": loads}


def _first_line(text: bytes) -> str:
    """Return the first line of a text that says something, shortened."""
    lines = (printable(line.strip()) for line in text.decode(errors="replace").splitlines())
    return next(filter(None, lines), "")[:LONGEST_LINE]


def _counts(data: Path, funnel: Funnel) -> dict[str, Any]:
    """Return the numbers of attempts, grasps and samples: of all, by class, object and split."""
    samples = _samples_by_object(data)
    rows = {name: _row(funnel, samples, [i]) for i, name in enumerate(funnel.names)}
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
        "splits": {
            row.split: {
                "samples": row.samples,
                "in effect": None if np.isnan(row.effective) else round(row.effective),
                "objects": row.objects,
                "classes": row.classes,
            }
            for row in splits_of(data)
        },
        "classes": {
            name: {"objects": len(places), **_row(funnel, samples, places)}
            for name, places in sorted(members.items())
        },
        "objects": {
            name: {"class": kind, **rows[name]}
            for name, kind in zip(funnel.names, funnel.classes, strict=True)
        },
    }


def _row(
    funnel: Funnel, samples: dict[str, dict[str, int]], objects: Iterable[int]
) -> dict[str, int]:
    """Return the counts of some objects together."""
    places = list(objects)
    names = [funnel.names[i] for i in places]
    return {
        "attempts": int(funnel.outcomes[places].sum()),
        "held": int(funnel.outcomes[places, Outcome.SUCCESS].sum()),
        "precision": int(funnel.precision[places].sum()),
        "stable": int(funnel.stable[places].sum()),
        "refined": int(funnel.refined[places, 2].sum()),
        "samples": int(funnel.samples[places].sum()),
        **{split: sum(samples[split].get(name, 0) for name in names) for split in SPLITS},
    }


def _samples_by_object(data: Path) -> dict[str, dict[str, int]]:
    """Return the numbers of samples by split and object; the files were read before."""
    found = {}
    with open_samples(data) as file:
        for split in SPLITS:
            found[split] = dict(Counter(read_names(file[split]["object_props/object_name"])))
    return found
