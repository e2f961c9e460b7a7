"""Creates scenes.hdf5 of an assembled dataset, with one task per object.

Input: the directory of a dataset, each prepared object and the rows of its closed hands in
trials.hdf5. Output: the file, with object poses, images, closed hands and the contacts that the
cameras see. It appears when it is complete, and its bytes do not depend on the workers.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import Array, multiply
from drakegrasp.config import Config
from drakegrasp.dataset.hdf5 import (
    AnyArray,
    create_field,
    open_samples,
    packed_chunk,
    write_field,
)
from drakegrasp.dataset.lock import build_lock
from drakegrasp.dataset.manifest import Manifest, origin_attributes, read_manifest
from drakegrasp.dataset.paths import DATA_FILES, SCENES_FILE
from drakegrasp.dataset.prepared_objects import PreparedObject, load_prepared
from drakegrasp.dataset.scenes import GRASPS_FOLLOW_FROM, count_scenes, grasps_of_trials
from drakegrasp.dataset.schema import (
    DEPTH_UNIT,
    NO_PRESHAPE,
    ROW_NUMBERS,
    SCENE_GRASP_FIELDS,
    SCENE_TABLES,
    SPLITS,
    SURFACE_POINTS,
    VIEW_FIELDS,
    VIEW_KINDS,
    stored_fields,
)
from drakegrasp.dataset.split import home_by_rank, may_train, rank_in_split
from drakegrasp.dataset.trials import Trials
from drakegrasp.errors import ConfigError
from drakegrasp.frames import make_pose, pack_pose, rotation_about
from drakegrasp.generation.attempts import find_attempt
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.hand.kinematics import joint_positions
from drakegrasp.hand.settings import override_config
from drakegrasp.mesh.surfaces import even_points, on_faces, unit_normals
from drakegrasp.outcomes import Outcome
from drakegrasp.runtime.environment import one_thread
from drakegrasp.runtime.executor import Executor, in_order, run_here
from drakegrasp.runtime.files import atomic_path, disk_full_named, new_hdf5
from drakegrasp.runtime.progress import Report, silent
from drakegrasp.seeding import Draw, Stream, object_key
from drakegrasp.simulation.attempt import (
    Attempt,
    Conditions,
    Source,
    conditions_from,
    usual_materials,
)
from drakegrasp.simulation.scene_cache import cached_renderer
from drakegrasp.vision.camera import RING, Lens, draw_viewpoint, fixed_viewpoints, visible_contacts
from drakegrasp.vision.rendering import RenderedView, paint, render


def make_scenes(
    out: Path,
    *,
    overrides: Sequence[str] = (),
    execute: Executor = run_here,
    progress: Report = silent,
) -> dict[str, dict[str, int]]:
    """Write scenes.hdf5 of a dataset, and the card with its counts; existing files are replaced.

    Args:
        out: Directory of an assembled dataset.
        overrides: `scenes.key=value` strings, which apply to this file only.
        execute: Runs the tasks.
        progress: Called with the number of completed objects and of all objects.

    Raises:
        ConfigError: If an override cannot be used.
        DataError: If there is no dataset, the dataset is damaged, or another process builds in it.
        BlankImageError: If OpenGL failed.
        DiskFullError: If the disk is full.

    Returns:
        The numbers of scenes, objects, views and grasps by split, see `count_scenes`.
    """
    read_manifest(out)  # fails for a missing directory, which the lock would create
    with build_lock(out):
        return _make_scenes(out, overrides, execute, progress)


def _make_scenes(
    out: Path, overrides: Sequence[str], execute: Executor, progress: Report
) -> dict[str, dict[str, int]]:
    """Write scenes.hdf5, see `make_scenes`; the caller holds the lock."""
    manifest = read_manifest(out)
    config = _with_scenes(manifest.config, overrides)
    hand = load_hand(config.hand_source)
    joints = manifest.joints or hand.joint_order
    manifest = replace(manifest, config=config, joints=joints)
    trials = Trials(out)
    tasks, count = _tasks(out, manifest, trials), len(manifest.objects)

    rows, tables = Counter[str](), dict[str, list[Columns]]()
    with (
        disk_full_named(out),
        atomic_path(out / SCENES_FILE) as temporary,
        new_hdf5(temporary, sealed=True) as file,
    ):
        # Copy the attributes of trials.hdf5 that state the origin of the data.
        origin = config, manifest.versions, manifest.fingers, manifest.joints
        file.attrs.update(origin_attributes(*origin))
        file.attrs.update({"near": config.scenes.near, "far": config.scenes.far})
        file.attrs.update({key: trials.attributes[key] for key in ("signature", "shards")})
        progress(0, count)
        for done, (own, images) in enumerate(in_order(execute)(make_scenes_of, tasks), start=1):
            write_images(file, images, rows["views"], config)
            for group, columns in own.items():
                tables.setdefault(group, []).append(numbered(group, columns, rows))
            rows.update({group: len(next(iter(of.values()))) for group, of in own.items()})
            progress(done, count)
        for group, parts in tables.items():
            write_table(file, group, parts)
        return count_scenes(file)


def _with_scenes(config: Config, overrides: Sequence[str]) -> Config:
    """Return a configuration with overrides of keys of `scenes`.

    Raises:
        ConfigError: If an override is for another key.
    """
    for text in overrides:
        if not text.strip().startswith("scenes."):
            raise ConfigError(f"only keys of scenes can change, as scenes.views=8, got {text!r}")
    return override_config(config, overrides)


def _tasks(out: Path, manifest: Manifest, trials: Trials) -> Iterator[SceneTask]:
    """Yield one task per object, in the order of the dataset."""
    columns = trials.columns(("object", "outcome", "time_close"))
    splits, is_sample = find_splits(out, manifest, trials)

    # Use all hands that closed, with any outcome, except those for which the simulator failed.
    failed = [outcome for outcome in Outcome if outcome.inconclusive]
    closed = np.isfinite(columns["time_close"]) & ~np.isin(columns["outcome"], failed)
    for i, entry in enumerate(manifest.objects):
        ids = np.flatnonzero(closed & (columns["object"] == i))
        yield SceneTask(
            out=out,
            name=entry.name,
            split=splits[i],
            config=manifest.config,
            joints=manifest.joints,
            trials={**trials[ids].columns(GRASPS_FOLLOW_FROM)},
            samples=is_sample[ids],
        )


def find_splits(
    out: Path, manifest: Manifest, trials: Trials
) -> tuple[list[int], npt.NDArray[np.bool_]]:
    """Return the split of each object, see `split_objects`, and whether each trial is a sample."""
    sample_split, objects = np.full(len(trials), len(SPLITS)), trials["object"]
    with open_samples(out / DATA_FILES["oto"]) as file:
        for number, split in enumerate(SPLITS):
            sample_split[file[split]["trial_id"][:]] = number
    is_sample = sample_split < len(SPLITS)
    present = [
        set(sample_split[(objects == i) & is_sample].tolist()) for i in range(len(manifest.objects))
    ]
    return split_objects(manifest, present), is_sample


def split_objects(manifest: Manifest, present: Sequence[set[int]]) -> list[int]:
    """Return the split of each object as an index into SPLITS; no object is in two splits.

    All objects of a group are in the same split. In a split by object, a group is in the split of
    its samples, or without samples in one that follows from its rank. In a split by class, a group
    with samples in `test` is in `test`, and samples of every other object are in `valid`; so the
    fraction `valid_fraction` of the other groups with the highest ranks is in `valid`.

    Args:
        manifest: Manifest of the dataset.
        present: For each object, the splits that have samples of it.
    """
    config, seed = manifest.config.split, manifest.config.seed
    if config.by == "object":
        homes = manifest.homes()
        return [SPLITS.index(homes.get(g) or home_by_rank(g, config)) for g in manifest.groups]
    train, valid, test = range(len(SPLITS))
    groups = manifest.groups
    found = {group: set[int]() for group in groups}
    for group, splits in zip(groups, present, strict=True):
        found[group] |= splits
    classes = Counter(entry.class_name for entry in manifest.objects)
    tested = {group for group, splits in found.items() if test in splits}
    for entry, group in zip(manifest.objects, groups, strict=True):
        if not found[group] and not may_train(entry.class_name, classes[entry.class_name], config):
            tested.add(group)
    others = sorted(found.keys() - tested, key=lambda group: (rank_in_split(group, seed), group))
    validating = set(others[len(others) - round(config.valid_fraction * len(others)) :])
    return [test if g in tested else valid if g in validating else train for g in groups]


# Writing


def write_images(
    file: h5py.File, images: Mapping[str, Sequence[bytes]], start: int, config: Config
) -> None:
    """Add the packed images of an object's views, of which the first has row `start`."""
    group, sizes = (
        file.require_group("views"),
        {"h": config.scenes.height, "w": config.scenes.width},
    )
    for field in VIEW_FIELDS:
        if field.sample:
            if field.name not in group:
                create_field(group, field, field.row_shape(sizes))
            dataset, chunks = group[field.name], images[field.name]
            dataset.resize(start + len(chunks), axis=0)
            for row, chunk in enumerate(chunks, start):
                dataset.id.write_direct_chunk((row, *(0,) * len(field.axes)), chunk)


def numbered(group: str, columns: Columns, rows: Mapping[str, int]) -> Columns:
    """Return columns whose row numbers count from the first row of the file.

    Args:
        group: Name of the group.
        columns: The columns of an object, whose row numbers count from the object's first row.
        rows: The object's first row in each group.
    """
    added = {name: rows[of] for name, of in ROW_NUMBERS.get(group, {}).items()}
    return {name: v + added[name] if name in added else v for name, v in columns.items()}


def write_table(file: h5py.File, name: str, parts: Sequence[Columns]) -> None:
    """Write the columns of a group, except the images of views."""
    group = file.require_group(name)
    for field in SCENE_TABLES[name]:
        if field.name not in group and field.name in parts[0]:
            values = np.concatenate([part[field.name] for part in parts])
            dtype = object if field.dtype == "str" else field.dtype
            write_field(group, field, values.astype(dtype))


# The scenes of one object

#: Number before the last one of the place of a scene's streams: for the object's place, for the
#: scene's appearance, and for the first camera.
_WHERE, _LOOK, _CAMERA = 0, 1, 2
Columns = dict[str, AnyArray]


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneTask:
    """The input of a task that creates the scenes of an object; its result are the scenes.

    Attributes:
        out: Directory of the dataset.
        config: Configuration of the dataset.
        name: Name of the object.
        split: Split of the scenes, as an index into SPLITS.
        joints: Names of the hand's joints, in the order of the files.
        trials: Columns GRASPS_FOLLOW_FROM of trials.hdf5 (n rows) of the object's closed hands.
        samples: (n,), which of these rows are samples.
    """

    out: Path
    config: Config
    name: str
    split: int
    joints: Sequence[str]
    trials: Columns
    samples: AnyArray


@one_thread
def make_scenes_of(task: SceneTask) -> tuple[dict[str, Columns], dict[str, list[bytes]]]:
    """Return the scenes of an object, with rows counted from the object's first row.

    Returns:
        The columns of each group without images, and the packed images of the rows of /views by the
        names of their fields.

    Raises:
        DataError: If a file of the dataset is missing or damaged.
        BlankImageError: If OpenGL failed.
    """
    prepared = load_prepared(task.out, task.name, task.config)
    X_TO = np.array([_place(prepared, k, task.config) for k in range(len(prepared.resting_poses))])
    grasps = _grasps(task, prepared, X_TO)
    views, images, visible = _views(task, prepared, X_TO, grasps)
    tables = {
        "objects": object_row(prepared),
        "scenes": _scenes(task, prepared, X_TO),
        "views": views,
        "grasps": grasps,
        "visible": visible,
    }
    return tables, images


def _stream(config: Config, name: str, resting: int, number: int) -> Stream:
    return Stream(config.seed, object_key(name), resting, number, Draw.SCENE)


def _place(prepared: PreparedObject, resting: int, config: Config) -> Array:
    """Return X_TO (4, 4) of a resting pose, rotated about Tz and moved to a random place."""
    u = _stream(config, prepared.model.name, resting, _WHERE).uniform(3)
    turn = make_pose(rotation_about([0.0, 0.0, 1.0], 2.0 * np.pi * u[0]), np.zeros(3))
    X_TO = multiply(turn, prepared.resting_poses[resting])
    X_TO[:2, 3] = config.scenes.place * (2.0 * u[1:] - 1.0)
    return X_TO


def object_row(prepared: PreparedObject) -> Columns:
    """Return the row of /objects."""
    model = prepared.model
    faces = model.visual_faces.astype(np.int64)
    points, picked = on_faces(model.visual_vertices, faces, even_points(SURFACE_POINTS))
    return {
        **{n: np.array([getattr(model, n)]) for n in ("name", "class_name", "mesh_sha256")},
        "p_OS": points[None],
        "nhat_S_O": unit_normals(model.visual_vertices[faces[picked]])[None],
    }


def _scenes(task: SceneTask, prepared: PreparedObject, X_TO: Array) -> Columns:
    """Return the rows of /scenes, with one scene per resting pose and one object per scene."""
    count = len(X_TO)
    materials = usual_materials(prepared.model, task.config.physics)
    return {
        "split": np.full(count, task.split),
        "object": np.zeros((count, 1), dtype=np.int64),
        "resting": np.arange(count)[:, None],
        "probability": prepared.probability[:, None],
        "X_TO": pack_pose(X_TO)[:, None],
        **{name: np.full((count, 1), value) for name, value in vars(materials).items()},
    }


# Views


def _views(
    task: SceneTask, prepared: PreparedObject, X_TO: Array, grasps: Columns
) -> tuple[Columns, dict[str, list[bytes]], Columns]:
    """Return the rows of /views without their images, the images, and the rows of /visible."""
    config, name = task.config, prepared.model.name
    lens, renderer = Lens.of(config.scenes), cached_renderer(prepared.model, config.camera)
    rows = list[dict[str, Any]]()
    images: dict[str, list[bytes]] = {f.name: [] for f in VIEW_FIELDS if f.sample}
    visible: dict[str, list[AnyArray]] = {"view": [], "grasp": [], "visible": []}
    for k, X in enumerate(X_TO):
        look = conditions_from(_stream(config, name, k, _LOOK), prepared.model, config)
        own = np.flatnonzero(grasps["scene"] == k)
        paint(renderer, look.appearance)
        for number, (kind, X_TC) in enumerate(_cameras(task, name, k, X)):
            seen = render(renderer, X, X_TC, lens)
            depth = picture(seen, images)
            row = {
                "scene": k,
                "kind": kind,
                "K": lens.K.ravel(),
                "X_TC": pack_pose(X_TC),
                **_conditions(look, _stream(config, name, k, _CAMERA + number)),
            }

            # Find the contacts that the camera sees.
            p_TQ, nhat_Q_T = (grasps[key][own] for key in ("p_TQ", "nhat_Q_T"))
            sees = visible_contacts(p_TQ, nhat_Q_T, X_TC, lens.K, depth * DEPTH_UNIT, seen.mask)
            visible["visible"].append(sees)
            visible["view"].append(np.full(len(own), len(rows)))
            visible["grasp"].append(own)
            rows.append(row)

    columns = {key: np.array([row[key] for row in rows]) for key in rows[0]}
    return columns, images, {key: np.concatenate(parts) for key, parts in visible.items()}


def _cameras(task: SceneTask, name: str, resting: int, X_TO: Array) -> list[tuple[int, Array]]:
    """Return the kind and the pose X_TC (4, 4) of each camera of a scene."""
    drawn, ring, single = range(len(VIEW_KINDS))
    if task.split:
        fixed = fixed_viewpoints()
        return [(ring if i < len(RING) else single, X_TC) for i, X_TC in enumerate(fixed)]
    scenes = task.config.scenes
    streams = (_stream(task.config, name, resting, _CAMERA + i) for i in range(scenes.views))
    return [(drawn, draw_viewpoint(stream, X_TO[:3, 3], scenes)) for stream in streams]


def picture(seen: RenderedView, images: dict[str, list[bytes]]) -> npt.NDArray[np.uint16]:
    """Add the packed images of a view to lists, and return its depth image [DEPTH_UNIT]."""
    far = np.where(np.isfinite(seen.depth), np.rint(seen.depth / DEPTH_UNIT), 0)
    depth = far.astype(np.uint16)
    stored = {"rgb": seen.rgb, "depth": depth, "mask": seen.mask}
    for key, image in stored.items():
        images[key].append(packed_chunk(np.ascontiguousarray(image)[None], 1))
    return depth


def _conditions(look: Conditions, camera: Stream) -> dict[str, Any]:
    """Return the appearance of a scene and the noise of a camera, by their names in the schema."""
    values = {key: value for key, value in look.values().items() if key in _VIEW_CONDITIONS}
    return values | {"depth_seed": camera.key if look.sensor.noise else 0}


_VIEW_CONDITIONS = {f.name for f in VIEW_FIELDS if f.of}


# Grasps


def _grasps(task: SceneTask, prepared: PreparedObject, X_TO: Array) -> Columns:
    """Return the rows of /grasps, ordered by scene and then by attempt."""
    order = np.argsort(task.trials["resting"], kind="stable")
    trials = {name: values[order] for name, values in task.trials.items()}
    scene = trials["resting"]
    columns = grasps_of_trials(trials, X_TO[scene], task.samples[order])
    stored = {
        f.name
        for f in stored_fields(SCENE_GRASP_FIELDS, repeats=task.config.robustness.repeats > 0)
    }
    return {name: values for name, values in columns.items() if name in stored} | {
        "scene": scene.astype(np.int64),
        "object": np.zeros(len(scene), dtype=np.int64),
        "q_open": open_hands(prepared, task.config, task.joints, trials),
    }


#: Columns of trials that `open_hands` needs.
OPEN_FOLLOWS_FROM = ("spread", "preshape", "source", "candidate", "standoff_index")


def open_hands(
    prepared: PreparedObject, config: Config, joints: Sequence[str], trials: Columns
) -> Array:
    """Return the positions (n, j) of the hand's joints before it closes.

    Args:
        prepared: The object of the trials.
        config: Configuration of the dataset.
        joints: Names of the joints, in the order of the files.
        trials: Columns OPEN_FOLLOWS_FROM of n trials.
    """
    hand, known = load_hand(config.hand_source), dict[tuple[float, int], Array]()
    rows = np.zeros((len(trials["spread"]), len(joints)))
    for i, spread in enumerate(trials["spread"].tolist()):
        if trials["source"][i] == Source.POSTURES:
            identity = {name: int(trials[name][i]) for name in _IDENTITY}
            rows[i] = _given_start(prepared, config, joints, hand, identity)
            continue
        key = spread, int(trials["preshape"][i])
        if key not in known:
            shaped = hand.at(None if key[1] == NO_PRESHAPE else key[1])
            known[key] = _positions(joints, shaped, spread, np.zeros(shaped.num_fingers))
        rows[i] = known[key]
    return rows


#: Columns that identify an attempt of an object.
_IDENTITY = ("candidate", "standoff_index")


def _given_start(
    prepared: PreparedObject,
    config: Config,
    joints: Sequence[str],
    hand: Hand,
    identity: Mapping[str, int],
) -> Array:
    """Return the positions (j,) of the joints from which the hand of a posture closes."""
    return open_joints(find_attempt(prepared, **identity, config=config), hand, joints)


def open_joints(attempt: Attempt, hand: Hand, joints: Sequence[str]) -> Array:
    """Return the positions (j,) of the joints from which the hand of an attempt closes."""
    if attempt.path is not None:
        return attempt.path[0]
    shaped = hand.at(attempt.preshape)
    closing = np.zeros(shaped.num_fingers) if attempt.closing is None else attempt.closing
    return _positions(joints, shaped, attempt.spread, closing)


def _positions(joints: Sequence[str], hand: Hand, spread: float, closing: Array) -> Array:
    named = joint_positions(hand, spread, closing)
    return np.array([named[name] for name in joints])
