"""Creates clutter.hdf5 of an assembled dataset: scenes of several objects, with grasps in them.

Input: the directory of a dataset with samples, and what scenes to make. Output: a file in the
format of scenes.hdf5. A scene is a task: its objects come to rest together, cameras see it, and
each sample of each object is moved with the object. Geometry then decides which grasps are free,
and some of the free ones are tried among the movable neighbours.

A task writes a sealed file of its scene into OUT/clutter. So a killed command continues, and more
scenes keep those that are there. The bytes do not depend on the workers.
"""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drakegrasp.dataset.hdf5 import opened_sealed, read_texts
from drakegrasp.dataset.lock import build_lock
from drakegrasp.dataset.manifest import Manifest, origin_attributes, read_manifest
from drakegrasp.dataset.paths import CLUTTER_FILE, clutter_path
from drakegrasp.dataset.prepared_objects import load_prepared
from drakegrasp.dataset.scenes import GRASPS_FOLLOW_FROM, count_scenes
from drakegrasp.dataset.schema import SCENE_TABLES
from drakegrasp.dataset.trials import Trials
from drakegrasp.errors import ConfigError, DataError
from drakegrasp.generation.clutter_scene import IMAGES, OBJECTS, ClutterTask, make_scene
from drakegrasp.generation.scenes import (
    Columns,
    find_splits,
    numbered,
    object_row,
    write_images,
    write_table,
)
from drakegrasp.hand.description import load_hand
from drakegrasp.objects.surroundings import Surroundings
from drakegrasp.runtime.executor import Executor, run_here
from drakegrasp.runtime.files import atomic_hdf5, disk_full_named
from drakegrasp.runtime.progress import Report, silent
from drakegrasp.seeding import Draw, Stream

#: Number of sets of objects that are drawn for a scene.
SETS = 4
#: Most objects of a scene; larger piles take minutes.
MOST_OBJECTS = 20


@dataclass(frozen=True, kw_only=True, eq=False)
class ClutterRequest:
    """Which scenes to make.

    Attributes:
        scenes: Number of scenes.
        objects: Smallest and largest number of objects of a scene.
        surroundings: What is around the objects; scenes take them in turn.
        tries: Number of free grasps of a scene that are tried.
    """

    scenes: int = 50
    objects: tuple[int, int] = (2, 6)
    surroundings: Sequence[Surroundings]
    tries: int = 10

    def validate(self) -> None:
        """Raise a ConfigError if a number or the names of the surroundings are not possible."""
        low, high = self.objects
        for name, value, least in (("scenes", self.scenes, 1), ("tries", self.tries, 0)):
            if value < least:
                raise ConfigError(f"{name} must be at least {least}, got {value}")
        if not 1 <= low <= high <= MOST_OBJECTS:
            raise ConfigError(
                f"objects must be a range within 1 to {MOST_OBJECTS}, got {low}..{high}"
            )

        # The file knows what is around a scene by its name.
        names = [each.name for each in self.surroundings]
        if not names or len(set(names)) < len(names):
            raise ConfigError(
                f"surroundings must have different names, got {', '.join(names) or 'none'}"
            )

    def stored(self) -> dict[str, Any]:
        """Return what a scene depends on besides its number, as JSON types."""
        trees = {each.name: each.tree() for each in self.surroundings}
        return {"objects": list(self.objects), "surroundings": trees, "tries": self.tries}


def make_clutter(
    out: str | Path,
    request: ClutterRequest,
    *,
    execute: Executor = run_here,
    restartable: bool = False,
    progress: Report = silent,
) -> dict[str, dict[str, int]]:
    """Write clutter.hdf5 of a dataset; the file of an earlier request is replaced.

    Args:
        out: Directory of an assembled dataset.
        request: Which scenes to make.
        execute: Runs the tasks.
        restartable: Whether a process of `execute` that dies is started again; then a grasp that
            crashes or hangs ends only its own trial.
        progress: Called with the numbers of finished scenes and of all scenes.

    Raises:
        ConfigError: If the request is not possible.
        DataError: If there is no dataset, it has no samples or is damaged, another process builds
            in it, or objects do not come to rest.
        BlankImageError: If OpenGL failed.
        DiskFullError: If the disk is full.

    Returns:
        The numbers of scenes, objects, views and grasps by split, see `count_scenes`.
    """
    request.validate()
    out = Path(out)
    read_manifest(out)  # fails for a missing directory, which the lock would create
    with build_lock(out), disk_full_named(out):
        manifest, trials = read_manifest(out), Trials(out)
        tasks, names = _tasks(out, manifest, trials, request, restartable)
        progress(0, request.scenes)
        for done, _ in enumerate(execute(make_scene, tasks), start=1):
            progress(done, request.scenes)
        return _assemble(out, manifest, trials, request, names)


def _tasks(
    out: Path, manifest: Manifest, trials: Trials, request: ClutterRequest, restartable: bool
) -> tuple[Iterator[ClutterTask], list[str]]:
    """Return a task per scene, and the names of the objects that have samples."""
    splits, is_sample = find_splits(out, manifest, trials)
    objects, config = trials["object"], manifest.config
    usable = [i for i in range(len(manifest.objects)) if (is_sample & (objects == i)).any()]
    if not usable:
        raise DataError(f"{out}: must have samples to be grasped among others, got none")
    signature = str(trials.attributes["signature"])
    about = json.dumps([request.stored(), config.simulation_hash(), signature], sort_keys=True)
    digest = hashlib.sha256(about.encode()).hexdigest()
    joints = manifest.joints or load_hand(config.hand_source).joint_order
    row_of = {i: row for row, i in enumerate(usable)}

    def task(number: int) -> ClutterTask:
        sets = list(_draw_sets(number, usable, splits, request, config.seed))
        drawn = sorted({i for own in sets for i in own})
        samples = {i: trials[np.flatnonzero(is_sample & (objects == i))] for i in drawn}

        return ClutterTask(
            out=out,
            config=config,
            number=number,
            digest=digest,
            split=splits[sets[0][0]],
            sets=tuple(tuple(row_of[i] for i in own) for own in sets),
            names={row_of[i]: manifest.objects[i].name for i in drawn},
            most=request.objects[1],
            surroundings=request.surroundings[number % len(request.surroundings)],
            tries=request.tries,
            joints=joints,
            trials={row_of[i]: {**samples[i].columns(GRASPS_FOLLOW_FROM)} for i in drawn},
            restartable=restartable,
        )

    return map(task, range(request.scenes)), [manifest.objects[i].name for i in usable]


def _draw_sets(
    number: int, usable: Sequence[int], splits: Sequence[int], request: ClutterRequest, seed: int
) -> Iterator[list[int]]:
    """Yield sets of objects for a scene, each of the split of its first object.

    The first object is each in turn. An object is twice in a scene only if there are too few.
    """
    first, (low, high) = usable[number % len(usable)], request.objects
    others = [i for i in usable if splits[i] == splits[first] and i != first]
    for attempt in range(SETS):
        stream = Stream(seed, number, attempt, OBJECTS, Draw.CLUTTER)
        count = low + int(stream.integers(high - low + 1, 1)[0])
        chosen = [first]
        while len(chosen) < count:
            chosen += [others[i] for i in stream.permutation(len(others))] or [first]
        yield chosen[:count]


def _assemble(
    out: Path, manifest: Manifest, trials: Trials, request: ClutterRequest, names: Sequence[str]
) -> dict[str, dict[str, int]]:
    """Write clutter.hdf5 from the files of its scenes."""
    config, tables = manifest.config, dict[str, list[Columns]]()
    rows = Counter[str]()
    origin = config, manifest.versions, manifest.fingers, manifest.joints
    tables["objects"] = [object_row(load_prepared(out, name, config)) for name in names]
    with atomic_hdf5(out / CLUTTER_FILE, sealed=True) as file:
        file.attrs.update(origin_attributes(*origin))
        file.attrs.update({"near": config.scenes.near, "far": config.scenes.far})
        file.attrs.update({key: trials.attributes[key] for key in ("signature", "shards")})
        file.attrs["clutter"] = json.dumps(request.stored(), sort_keys=True)
        for number in range(request.scenes):
            own, images = _read_scene(clutter_path(out, number))
            write_images(file, images, rows["views"], config)
            for group, columns in own.items():
                tables.setdefault(group, []).append(numbered(group, columns, rows))
            rows.update({group: len(next(iter(of.values()))) for group, of in own.items()})
        for group, parts in tables.items():
            write_table(file, group, parts)
        return count_scenes(file)


def _read_scene(path: Path) -> tuple[dict[str, Columns], dict[str, list[bytes]]]:
    """Return the columns and packed images of the file of a scene."""
    tables, images = dict[str, Columns](), dict[str, list[bytes]]()
    with opened_sealed(path, "scene") as (file, _):
        for name, fields in SCENE_TABLES.items():
            if name not in file:
                continue
            stored = {f.name: file[name][f.name] for f in fields if f.name in file[name]}
            text = {f.name for f in fields if f.dtype == "str"}
            tables[name] = {
                key: np.array(read_texts(data), dtype=object) if key in text else data[:]
                for key, data in stored.items()
                if not (name == "views" and key in IMAGES)
            }
        for key in IMAGES:
            data = file["views"][key]
            places = ((row, *(0,) * (data.ndim - 1)) for row in range(len(data)))
            images[key] = [data.id.read_direct_chunk(place)[1] for place in places]
    return tables, images
