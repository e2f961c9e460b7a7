"""The scenes of one object: places, pictures, closed hands, and what the cameras see of them.

In: a prepared object and the rows of its closed hands in trials.hdf5. Out: rows of the groups of
scenes.hdf5, numbered from the object's first on; `make` puts them together.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import Array, multiply
from drakegrasp.config import Config
from drakegrasp.dataset.hdf5 import AnyArray, packed_chunk
from drakegrasp.dataset.prepared_objects import PreparedObject, load_prepared
from drakegrasp.dataset.schema import (
    DEPTH_UNIT,
    NO_PRESHAPE,
    SCENE_GRASP_FIELDS,
    SURFACE_POINTS,
    VIEW_FIELDS,
    VIEW_KINDS,
    stored_fields,
)
from drakegrasp.dataset.trials import Trials
from drakegrasp.frames import make_pose, pack_pose, rotation_about, unpack_pose
from drakegrasp.generation.attempts import find_attempt
from drakegrasp.generation.scenes.visible import visible_contacts
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.hand.kinematics import joint_positions
from drakegrasp.mesh.surfaces import even_points, on_faces, unit_normals
from drakegrasp.outcomes import Outcome
from drakegrasp.runtime.environment import one_thread
from drakegrasp.seeding import Stream, object_key
from drakegrasp.simulation.candidates import Source
from drakegrasp.simulation.conditions import Conditions, conditions_from, usual_materials
from drakegrasp.simulation.scene_cache import cached_renderer
from drakegrasp.vision.camera import Lens
from drakegrasp.vision.rendering import Renderer, capture, paint
from drakegrasp.vision.viewpoints import RING, draw_viewpoint, fixed_viewpoints

#: Last number of the place of a scene's streams; streams of other things have other ones.
_PLACE = 4
#: The number before it: of where the object lies, how the scene looks, and of the first camera.
_WHERE, _LOOK, _CAMERA = 0, 1, 2
#: Outcomes of lifts to a verdict; `table_contact` after closing is none.
LIFTED = (
    *(Outcome.SUCCESS, Outcome.SLIPPED, Outcome.PARTLY_HELD, Outcome.DROPPED),
    Outcome.TABLE_CONTACT,
)
#: Fields of /grasps that are columns of /trials, by their names here.
_COPIED = {f.name: f.of for f in SCENE_GRASP_FIELDS if f.of} | {
    name: name for name in ("trial_id", "outcome", "precision", "stable", "preshape", "unused")
}
#: Further columns of /trials that they follow from.
_READ = (
    *("candidate", "standoff_index", "child", "resting", "spread", "time_lift"),
    *("X_OG", "X_OG_lifted"),
    *(f"{when}_{name}" for when in ("closed", "lifted") for name in ("p_OQ", "nhat_Q_O", "f_Q_O")),
)
Columns = dict[str, AnyArray]


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneTask:
    """The scenes of an object to make.

    Attributes:
        out: Directory of the dataset.
        name: Of the object.
        split: Of its scenes, an index into SPLITS.
        config: Of the object.
        joints: Names of the hand's joints, in the order of the files.
        trial_ids: (n,), rows of trials.hdf5 of its closed hands.
        weights: (n,), of those that are samples, NaN of others.
    """

    out: Path
    name: str
    split: int
    config: Config
    joints: Sequence[str]
    trial_ids: npt.NDArray[np.int64]
    weights: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class ObjectScenes:
    """Rows of the groups of scenes.hdf5; rows of others are counted from the object's first.

    Attributes:
        tables: Columns by group, without images.
        images: Packed chunks of the rows of /views, by the names of their fields.
    """

    tables: Mapping[str, Columns]
    images: Mapping[str, Sequence[bytes]]


@one_thread
def make_scenes_of(task: SceneTask) -> ObjectScenes:
    """Return the scenes of an object.

    Raises:
        DataError: If a file of the dataset is missing or damaged.
        BlankImageError: If OpenGL failed.
    """
    prepared = load_prepared(task.out, task.name, task.config)
    X_TO = np.array([_place(prepared, k, task.config) for k in range(len(prepared.resting_poses))])
    grasps = _grasps(task, prepared, X_TO)
    views, images, visible = _views(task, prepared, X_TO, grasps)
    return ObjectScenes(
        tables={
            "objects": _object(prepared),
            "scenes": _scenes(task, prepared, X_TO),
            "views": views,
            "grasps": grasps,
            "visible": visible,
        },
        images=images,
    )


def _stream(config: Config, name: str, resting: int, number: int) -> Stream:
    return Stream(config.seed, object_key(name), resting, number, _PLACE)


def _place(prepared: PreparedObject, resting: int, config: Config) -> Array:
    """Return X_TO (4, 4) of a resting pose, turned about Tz and moved to a drawn place."""
    u = _stream(config, prepared.model.name, resting, _WHERE).uniform(3)
    turn = make_pose(rotation_about([0.0, 0.0, 1.0], 2.0 * np.pi * u[0]), np.zeros(3))
    X_TO = multiply(turn, prepared.resting_poses[resting])
    X_TO[:2, 3] = config.scenes.place * (2.0 * u[1:] - 1.0)
    return X_TO


def _object(prepared: PreparedObject) -> Columns:
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
    """Return the rows of /scenes, a scene per resting pose; there is one object in each."""
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
    numbers: dict[str, list[Any]] = {f.name: [] for f in VIEW_FIELDS if not f.sample}
    images: dict[str, list[bytes]] = {f.name: [] for f in VIEW_FIELDS if f.sample}
    visible: dict[str, list[AnyArray]] = {"view": [], "grasp": [], "visible": []}
    for k, X in enumerate(X_TO):
        look = conditions_from(_stream(config, name, k, _LOOK), prepared.model, config)
        own = np.flatnonzero(grasps["scene"] == k)
        paint(renderer, look.appearance)
        for number, (kind, X_TC) in enumerate(_cameras(task, name, k, X)):
            depth, mask = _picture(renderer, lens, X, X_TC, images)
            row = {
                "scene": k,
                "kind": kind,
                "K": lens.K.ravel(),
                "X_TC": pack_pose(X_TC),
                **_conditions(look, _stream(config, name, k, _CAMERA + number)),
            }

            # What it sees of the contacts.
            p_TQ, nhat_Q_T = (grasps[key][own] for key in ("p_TQ", "nhat_Q_T"))
            sees = visible_contacts(p_TQ, nhat_Q_T, X_TC, lens.K, depth, mask)
            visible["visible"].append(sees)
            visible["view"].append(np.full(len(own), len(numbers["scene"])))
            visible["grasp"].append(own)
            for key, values in numbers.items():
                values.append(row[key])

    columns = {key: np.array(values) for key, values in numbers.items()}
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


def _picture(
    renderer: Renderer, lens: Lens, X_TO: Array, X_TC: Array, images: dict[str, list[bytes]]
) -> tuple[npt.NDArray[np.uint16], npt.NDArray[np.uint8]]:
    """Render a view, add its packed images to lists, and return its depth image and its mask."""
    seen = capture(renderer, lens, X_TO, X_TC)
    far = np.where(np.isfinite(seen.depth), np.rint(seen.depth / DEPTH_UNIT), 0)
    depth = far.astype(np.uint16)
    stored = {"rgb": seen.rgb, "depth": depth, "mask": seen.mask}
    for key, image in stored.items():
        images[key].append(packed_chunk(np.ascontiguousarray(image)[None], 1))
    return depth, seen.mask


def _conditions(look: Conditions, camera: Stream) -> dict[str, Any]:
    """Return the looks of a scene and the noise of a camera, by their names in the schema."""
    values = {key: value for key, value in look.values().items() if key in _VIEW_CONDITIONS}
    return values | {"depth_seed": camera.key if look.sensor.noise else 0}


_VIEW_CONDITIONS = {f.name for f in VIEW_FIELDS if f.of}


# Grasps


def _grasps(task: SceneTask, prepared: PreparedObject, X_TO: Array) -> Columns:
    """Return the rows of /grasps, scene by scene in the order of the attempts."""
    stored = stored_fields(SCENE_GRASP_FIELDS, certified=task.config.certified)
    copied = {f.name: _COPIED[f.name] for f in stored if f.name in _COPIED}
    names = list(dict.fromkeys([*copied.values(), *_READ]))
    trials = Trials(task.out)[task.trial_ids].columns(names)
    order = np.argsort(trials["resting"], kind="stable")
    trials = {name: values[order] for name, values in trials.items()}
    weights, outcome, scene = task.weights[order], trials["outcome"], trials["resting"]
    X = X_TO[scene]
    R_OT = np.swapaxes(X[:, :3, :3], 1, 2)

    columns = {name: trials[of] for name, of in copied.items()}
    columns |= {
        "scene": scene.astype(np.int64),
        "object": np.zeros(len(scene), dtype=np.int64),
        "tested": np.isin(outcome, LIFTED) & np.isfinite(trials["time_lift"]),
        "held": outcome == Outcome.SUCCESS,
        "sample": np.isfinite(weights),
        "weight": np.nan_to_num(weights),
        "family": _families(scene, trials),
        "q_open": _open_hands(task, prepared, trials),
    }
    for suffix, when, X_OG in (("", "closed", "X_OG"), ("_held", "lifted", "X_OG_lifted")):
        columns[f"X_TG{suffix}"] = pack_pose(multiply(X, unpack_pose(trials[X_OG])))
        points, normals, forces = (trials[f"{when}_{n}"] for n in ("p_OQ", "nhat_Q_O", "f_Q_O"))
        columns[f"p_TQ{suffix}"] = multiply(points, R_OT) + X[:, None, :3, 3]
        columns[f"nhat_Q_T{suffix}"] = multiply(normals, R_OT)
        columns[f"f_Q_T{suffix}"] = multiply(forces, R_OT)
    return columns


def _families(scene: AnyArray, trials: Columns) -> npt.NDArray[np.int64]:
    """Return the number (n,) of each attempt's family in its scene."""
    keys = np.column_stack([scene, trials["candidate"], trials["standoff_index"]])
    known, family = np.unique(keys, axis=0, return_inverse=True)
    first = np.searchsorted(known[:, 0], np.arange(known[:, 0].max(initial=0) + 1))
    return np.asarray(family.ravel() - first[scene])


def _open_hands(task: SceneTask, prepared: PreparedObject, trials: Columns) -> Array:
    """Return the positions (n, j) of the hand's joints before it closes."""
    hand, known = load_hand(task.config.hand_source), dict[tuple[float, int], Array]()
    rows = np.zeros((len(trials["spread"]), len(task.joints)))
    for i, spread in enumerate(trials["spread"].tolist()):
        if trials["source"][i] == Source.POSTURES:
            rows[i] = _given_start(task, prepared, hand, {n: int(trials[n][i]) for n in _IDENTITY})
            continue
        key = spread, int(trials["preshape"][i])
        if key not in known:
            shaped = hand.at(None if key[1] == NO_PRESHAPE else key[1])
            known[key] = _positions(task, shaped, spread, np.zeros(shaped.num_fingers))
        rows[i] = known[key]
    return rows


#: What names an attempt of an object.
_IDENTITY = ("candidate", "standoff_index", "child")


def _given_start(
    task: SceneTask, prepared: PreparedObject, hand: Hand, identity: Mapping[str, int]
) -> Array:
    """Return the positions (j,) of the joints from which a posture closes."""
    attempt = find_attempt(prepared, **identity, config=task.config)
    if attempt.path is not None:
        return attempt.path.start
    shaped = hand.at(attempt.preshape)
    closing = np.zeros(shaped.num_fingers) if attempt.closing is None else attempt.closing
    return _positions(task, shaped, attempt.spread, closing)


def _positions(task: SceneTask, hand: Hand, spread: float, closing: Array) -> Array:
    named = joint_positions(hand, spread, closing)
    return np.array([named[name] for name in task.joints])
