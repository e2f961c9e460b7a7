"""Makes scenes.hdf5 of an assembled dataset: a task per object, put together in their order.

In: the directory of a dataset. Out: the file, which appears when it is complete; nothing else
changes. Its bytes do not depend on who does the tasks.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import numpy as np

from drakegrasp.config import Config
from drakegrasp.dataset.assembly.split import may_train, rank_in_split
from drakegrasp.dataset.card.text import write_card
from drakegrasp.dataset.hdf5 import create_field, write_field
from drakegrasp.dataset.lock import build_lock
from drakegrasp.dataset.manifest import Manifest, origin_attributes, read_manifest
from drakegrasp.dataset.opening import SCENE_TABLES, open_samples
from drakegrasp.dataset.paths import DATA_FILES, SCENES_FILE
from drakegrasp.dataset.scenes.reader import count_scenes
from drakegrasp.dataset.schema import SPLITS, VIEW_FIELDS
from drakegrasp.dataset.trials import Trials
from drakegrasp.errors import ConfigError
from drakegrasp.generation.scenes.content import Columns, ObjectScenes, SceneTask, make_scenes_of
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.parsing import position_order
from drakegrasp.hand.settings import override_config
from drakegrasp.outcomes import Outcome
from drakegrasp.runtime.executor import Executor, in_order, run_here
from drakegrasp.runtime.files import atomic_hdf5, disk_full_named
from drakegrasp.runtime.progress import Report, silent

#: Columns that count rows of other groups, which a task counts from its object's first.
_ROWS_OF = {
    ("scenes", "object"): "objects",
    ("views", "scene"): "scenes",
    ("grasps", "scene"): "scenes",
    ("visible", "view"): "views",
    ("visible", "grasp"): "grasps",
}


@dataclass(frozen=True, kw_only=True)
class Scenes:
    """What scenes.hdf5 holds.

    Attributes:
        path: Of the file.
        scenes, views: Numbers of them by split.
        grasps: Number of closed hands.
    """

    path: Path
    scenes: Mapping[str, int]
    views: Mapping[str, int]
    grasps: int


def make_scenes(
    out: Path,
    *,
    overrides: Sequence[str] = (),
    execute: Executor = run_here,
    progress: Report = silent,
) -> Scenes:
    """Write scenes.hdf5 of a dataset, and its card, which counts them; what is there is replaced.

    Args:
        out: Directory of an assembled dataset.
        overrides: `scenes.key=value` texts, for this file alone.
        execute: Does the work.
        progress: Called with the number of objects that are done and to do.

    Raises:
        ConfigError: If an override cannot be used.
        DataError: If there is no dataset, or it is damaged, or another process builds in it.
        BlankImageError: If OpenGL failed.
        DiskFullError: If there is no room.
    """
    read_manifest(out)  # the lock would make a missing directory
    with build_lock(out):
        return make_scenes_locked(out, overrides=overrides, execute=execute, progress=progress)


def make_scenes_locked(
    out: Path,
    *,
    overrides: Sequence[str] = (),
    execute: Executor = run_here,
    progress: Report = silent,
) -> Scenes:
    """Write scenes.hdf5 and the card, see `make_scenes`; the caller holds the lock."""
    manifest = read_manifest(out)
    config = _with_scenes(manifest.config, overrides)
    hand = load_hand(config.hand_source)
    joints = manifest.joints or position_order(hand.model, hand.palm_link)
    manifest = replace(manifest, config=config, joints=joints)
    trials = Trials(out)
    tasks = _tasks(out, manifest, trials)

    path, rows, tables = out / SCENES_FILE, Counter[str](), dict[str, list[Columns]]()
    with disk_full_named(out), atomic_hdf5(path) as file:
        file.attrs.update(_attributes(manifest, trials))
        progress(0, len(tasks))
        for done, made in enumerate(in_order(execute)(make_scenes_of, tasks), start=1):
            _write_images(file, made, rows["views"], manifest)
            for group, columns in made.tables.items():
                tables.setdefault(group, []).append(_numbered(group, columns, rows))
            rows.update({group: _length(columns) for group, columns in made.tables.items()})
            progress(done, len(tasks))
        for group, parts in tables.items():
            _write_table(file, group, parts)
        summary = _summary(path, file)
    write_card(out)
    return summary


def _with_scenes(config: Config, overrides: Sequence[str]) -> Config:
    """Return a configuration with other scenes.

    Raises:
        ConfigError: If an override is of anything else.
    """
    for text in overrides:
        if not text.strip().startswith("scenes."):
            raise ConfigError(f"only keys of scenes can change, as scenes.views=8, got {text!r}")
    return override_config(config, overrides)


def _tasks(out: Path, manifest: Manifest, trials: Trials) -> list[SceneTask]:
    """Return a task per object, in the order of the dataset."""
    columns = trials.columns(("object", "outcome", "time_close"))
    weights = np.full(len(trials), np.nan)
    sample_split = np.full(len(trials), len(SPLITS))
    with open_samples(out / DATA_FILES["oto"]) as file:
        for number, split in enumerate(SPLITS):
            ids = file[split]["trial_id"][:]
            weights[ids] = file[split]["grasp_props/weight"][:]
            sample_split[ids] = number

    # Hands that closed, whatever became of them; a simulator that failed says nothing.
    failed = [outcome for outcome in Outcome if outcome.inconclusive]
    closed = np.isfinite(columns["time_close"]) & ~np.isin(columns["outcome"], failed)
    present = [
        set(sample_split[(columns["object"] == i) & (sample_split < len(SPLITS))].tolist())
        for i in range(len(manifest.objects))
    ]
    splits = split_objects(manifest, present)
    return [
        SceneTask(
            out=out,
            name=entry.name,
            split=splits[i],
            config=manifest.config_of(entry.name),
            joints=manifest.joints,
            trial_ids=(ids := np.flatnonzero(closed & (columns["object"] == i))),
            weights=weights[ids],
        )
        for i, entry in enumerate(manifest.objects)
    ]


def split_objects(manifest: Manifest, present: Sequence[set[int]]) -> list[int]:
    """Return the split of each object as an index into SPLITS: no object is in two.

    Objects of a group go together. A group whose samples are tested is tested. By object, a group
    validates if its samples do. By class every object has samples that validate, so of the groups
    that are not tested a share as large validates: those of the highest rank. A group without
    samples goes where its rank, or its class, would take it.

    Args:
        manifest: Of the dataset.
        present: Of each object the splits that have samples of it.
    """
    config, seed = manifest.config.split, manifest.config.seed
    train, valid, test = range(len(SPLITS))
    groups, by_class = manifest.groups, manifest.split_rule == "class"
    found = {group: set[int]() for group in groups}
    for group, splits in zip(groups, present, strict=True):
        found[group] |= splits
    ranks = {group: rank_in_split(group, seed) for group in found}
    classes = Counter(entry.class_name for entry in manifest.objects)

    tested = {group for group, splits in found.items() if test in splits}
    last = max((ranks[group] for group in tested), default=-1.0)
    for entry, group in zip(manifest.objects, groups, strict=True):
        trains = may_train(entry.class_name, classes[entry.class_name], config)
        if not found[group] and (not trains if by_class else ranks[group] < last):
            tested.add(group)
    others = sorted(found.keys() - tested, key=lambda group: (ranks[group], group))
    if by_class:
        validating = set(others[len(others) - round(config.valid_fraction * len(others)) :])
    else:
        first = min((ranks[g] for g in others if found[g] == {valid}), default=2.0)
        validating = {group for group in others if ranks[group] >= first}
    return [test if g in tested else valid if g in validating else train for g in groups]


def _attributes(manifest: Manifest, trials: Trials) -> dict[str, object]:
    """Return the attributes of the file: those of trials.hdf5 that say of what it was made."""
    config = manifest.config
    return {
        **origin_attributes(config, manifest.versions, manifest.fingers, manifest.joints),
        "near": config.scenes.near,
        "far": config.scenes.far,
        **{key: trials.attributes[key] for key in ("signature", "shards")},
    }


# Writing


def _write_images(file: h5py.File, made: ObjectScenes, start: int, manifest: Manifest) -> None:
    """Add the packed images of an object's views."""
    scenes, group = manifest.config.scenes, file.require_group("views")
    sizes = {"h": scenes.height, "w": scenes.width}
    for field in VIEW_FIELDS:
        if field.sample:
            if field.name not in group:
                create_field(group, field, field.row_shape(sizes))
            dataset, chunks = group[field.name], made.images[field.name]
            dataset.resize(start + len(chunks), axis=0)
            for row, chunk in enumerate(chunks, start):
                dataset.id.write_direct_chunk((row, *(0,) * len(field.axes)), chunk)


def _numbered(group: str, columns: Columns, rows: Mapping[str, int]) -> Columns:
    """Return columns whose numbers count the rows of the file."""
    added = {name: rows[of] for (own, name), of in _ROWS_OF.items() if own == group}
    return {name: v + added[name] if name in added else v for name, v in columns.items()}


def _length(columns: Columns) -> int:
    return len(next(iter(columns.values())))


def _write_table(file: h5py.File, name: str, parts: Sequence[Columns]) -> None:
    """Write the columns of a group that are no images of views."""
    group = file.require_group(name)
    for field in SCENE_TABLES[name]:
        if field.name not in group and field.name in parts[0]:
            values = np.concatenate([part[field.name] for part in parts])
            dtype = object if field.dtype == "str" else field.dtype
            write_field(group, field, values.astype(dtype))


def _summary(path: Path, file: h5py.File) -> Scenes:
    counts = count_scenes(file)
    return Scenes(
        path=path,
        scenes={split: row["scenes"] for split, row in counts.items()},
        views={split: row["views"] for split, row in counts.items()},
        grasps=len(file["grasps/scene"]),
    )
