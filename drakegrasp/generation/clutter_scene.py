"""One scene of several objects: at rest, seen, and with labels of the grasps in it.

Input: the objects of a dataset that a scene may have, with their samples. Output: a sealed file
with the scene's rows of clutter.hdf5, counted from the scene's first row, and its packed images.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drakegrasp.arithmetic import Array
from drakegrasp.dataset.clutter import Clutter
from drakegrasp.dataset.hdf5 import AnyArray, opened_sealed
from drakegrasp.dataset.paths import clutter_path, object_files
from drakegrasp.dataset.prepared_objects import PreparedObject, load_prepared
from drakegrasp.dataset.scenes import TRIED, grasps_of_trials
from drakegrasp.dataset.schema import (
    DEPTH_UNIT,
    HITS_NOTHING,
    HITS_TABLE,
    NO_OBJECT,
    NOT_TRIED,
    VIEW_FIELDS,
    VIEW_KINDS,
)
from drakegrasp.errors import DataError
from drakegrasp.filters import Removal
from drakegrasp.frames import pack_pose
from drakegrasp.generation.attempts import disturbance_of, find_attempt, judge_sample
from drakegrasp.generation.directory import DatasetTask
from drakegrasp.generation.scenes import (
    Columns,
    open_hands,
    picture,
    write_images,
    write_table,
)
from drakegrasp.objects.surroundings import Neighbourhood, Surroundings
from drakegrasp.outcomes import Outcome
from drakegrasp.runtime.environment import one_thread
from drakegrasp.runtime.files import atomic_hdf5
from drakegrasp.runtime.journal import ATTEMPT, Journal, Verdict, inject_fault, open_journal
from drakegrasp.seeding import Draw, Stream
from drakegrasp.simulation.attempt import Attempt, usual_materials
from drakegrasp.simulation.free import first_hit
from drakegrasp.simulation.pile import PileError, pile_up
from drakegrasp.simulation.placement import aligned_pose
from drakegrasp.simulation.scene_cache import cached_scene, run_cached
from drakegrasp.vision.camera import (
    RING,
    Lens,
    fixed_viewpoints,
    usual_appearance,
    visible_contacts,
)
from drakegrasp.vision.rendering import build_renderer, outline_sizes, render

#: Number of piles of a set of objects before the next set is tried.
PILES = 5
#: Computing time after which the objects of a scene are considered to hang while they settle [s].
STAGE_SECONDS = 600.0
#: An attempt hangs if it takes this many times its limit of computing time.
HANG_FACTOR = 1.5
#: Last numbers of the streams of a scene: its objects, the grasps to try, and the first pile.
OBJECTS, _TRIES, _PILE = 0, 1, 2
#: Index of the resting pose of an object that lies otherwise, and of no neighbour.
_NONE = 255
#: Fields of /views that are images.
IMAGES = [f.name for f in VIEW_FIELDS if f.sample]


@dataclass(frozen=True, kw_only=True, eq=False)
class ClutterTask(DatasetTask):
    """The input of a task that makes a scene; objects are known by their row in /objects.

    Attributes:
        number: Number of the scene.
        digest: Hash of the request and of the dataset.
        split: Split of the scene, as an index into SPLITS.
        sets: Sets of objects, of which the first is used that comes to rest.
        names: Names of these objects.
        most: Length of the axis of objects in the file.
        surroundings: What is around them.
        tries: Number of free grasps to try.
        joints: Names of the hand's joints, in the order of the files.
        trials: Columns GRASPS_FOLLOW_FROM of the samples of each object.
        restartable: Whether the process is started again when it dies.
    """

    number: int
    digest: str
    split: int
    sets: tuple[tuple[int, ...], ...]
    names: Mapping[int, str]
    most: int
    surroundings: Surroundings
    tries: int
    joints: Sequence[str]
    trials: Mapping[int, Columns]
    restartable: bool = False

    @property
    def path(self) -> Path:
        """Path of the file of the scene."""
        return clutter_path(self.out, self.number)

    @property
    def inputs(self) -> tuple[Path, ...]:
        """The files of the objects, and those of the scene if they are there."""
        files = [path for name in self.names.values() for path in object_files(self.out, name)]
        return *files, *self.outputs

    @property
    def outputs(self) -> tuple[Path, ...]:
        """The file of the scene, and the journal."""
        return self.path, self.path.with_suffix(".journal")

    def stream(self, *place: int) -> Stream:
        """Return a stream of the scene."""
        return Stream(self.config.seed, self.number, *place, Draw.CLUTTER)


@one_thread
def make_scene(task: ClutterTask) -> int:
    """Make a scene and write its file, unless it is there; return its number.

    Raises:
        DataError: If a file of the dataset is missing or damaged, or no set of objects comes to
            rest.
        BlankImageError: If OpenGL failed.
        MachineError: If the process died repeatedly in this scene.
    """
    path, identity = task.path, {"number": task.number, "digest": task.digest}
    if _is_made(path, identity):
        return task.number

    # A process that dies leaves the journal, which says in which grasp.
    with open_journal(path.with_suffix(".journal"), identity, restartable=task.restartable) as log:
        log.validate_no_loop(f"scene {task.number}")
        made = _Scene(task, log)
        views, images, visible = made.views()
        tables = {
            "scenes": made.scenes(),
            "views": views,
            "grasps": made.grasps,
            "visible": visible,
        }
        path.parent.mkdir(exist_ok=True)
        with atomic_hdf5(path, sealed=True) as file:
            file.attrs.update(identity)
            write_images(file, images, 0, task.config)
            for group, columns in tables.items():
                write_table(file, group, [columns])
    return task.number


def _is_made(path: Path, identity: Mapping[str, Any]) -> bool:
    """Return whether the file of a scene is there, whole and of this request."""
    try:
        with opened_sealed(path, "scene") as (file, _):
            return all(file.attrs.get(key) == value for key, value in identity.items())
    except DataError:
        return False


class _Scene:
    """A scene whose objects are at rest, with its grasps."""

    def __init__(self, task: ClutterTask, journal: Journal) -> None:
        self._task, self._config, self._journal = task, task.config, journal
        with journal.step("settle", STAGE_SECONDS):
            self._objects, self._clutter = _settled(task)
        self._models, self._X_TN = self._clutter.models, self._clutter.X_TO
        self.grasps = self._label_grasps()

    def scenes(self) -> Columns:
        """Return the row of /scenes."""
        task, n = self._task, len(self._objects)
        physics = self._config.physics
        materials = [vars(usual_materials(model, physics)) for model in self._models]

        # What each of the n objects has.
        values: dict[str, Any] = {
            "object": self._objects,
            "resting": [
                _resting(*pair) for pair in zip(self._clutter.prepared, self._X_TN, strict=True)
            ],
            "probability": np.full(n, np.nan),
            "X_TO": pack_pose(self._X_TN),
            **{name: [each[name] for each in materials] for name in materials[0]},
        }

        # Rows of all scenes have the same length.
        row: Columns = {"split": np.array([task.split])}
        for name, value in values.items():
            column = np.asarray(value)
            empty = {"object": NO_OBJECT, "resting": _NONE}.get(name, np.nan)
            row[name] = np.full((1, task.most, *column.shape[1:]), empty, dtype=column.dtype)
            row[name][0, :n] = column

        row["surroundings"] = np.array([task.surroundings.name], dtype=object)
        row["seed"] = np.array([task.stream().key], dtype=np.uint64)
        return row

    # Views

    def views(self) -> tuple[Columns, dict[str, list[bytes]], Columns]:
        """Return the rows of /views without images, the packed images, and those of /visible."""
        task, config, around = self._task, self._config, self._clutter.around(0)
        lens = Lens.of(config.scenes)
        renderer = build_renderer(self._models[0], config.camera, around)
        bare = Neighbourhood(models=around.models, X_TN=around.X_TN)
        alone = build_renderer(self._models[0], config.camera, bare) if around.walls else renderer
        look = usual_appearance(self._models[0].name)

        images: dict[str, list[bytes]] = {name: [] for name in IMAGES}
        rows, visible = list[dict[str, Any]](), list[Columns]()
        count = len(self.grasps["scene"])
        for number, X_TC in enumerate(fixed_viewpoints()):
            seen = render(renderer, self._X_TN[0], X_TC, lens, self._X_TN[1:])
            depth = picture(seen, images)

            # How much of each object nothing hides.
            outlines = outline_sizes(alone, self._X_TN, X_TC, lens)
            share = np.full(task.most, np.nan)
            pixels = np.array([(seen.mask == i + 1).sum() for i in range(len(outlines))])
            # An object in front of another one may cover a pixel more than its outline has.
            share[: len(outlines)] = np.minimum(pixels / np.where(outlines, outlines, np.nan), 1.0)

            rows.append(
                {
                    "scene": 0,
                    "kind": VIEW_KINDS.index("ring" if number < len(RING) else "single"),
                    "K": lens.K.ravel(),
                    "X_TC": pack_pose(X_TC),
                    **vars(look),
                    "depth_noise": 0.0,
                    "depth_seed": 0,
                    "visible_share": share,
                }
            )

            # Which contacts of the grasps it shows.
            sees = np.zeros((count, self.grasps["p_TQ"].shape[1]), dtype=bool)
            for i in range(len(outlines)):
                own = self.grasps["object"] == i
                p_TQ, nhat_Q_T = (self.grasps[key][own] for key in ("p_TQ", "nhat_Q_T"))
                mask = (seen.mask == i + 1).astype(np.uint8)
                about = X_TC, lens.K, depth * DEPTH_UNIT, mask
                sees[own] = visible_contacts(p_TQ, nhat_Q_T, *about)
            numbers = {"view": np.full(count, number), "grasp": np.arange(count)}
            visible.append({**numbers, "visible": sees})

        columns = {key: np.array([row[key] for row in rows]) for key in rows[0]}
        return (
            columns,
            images,
            {key: np.concatenate([each[key] for each in visible]) for key in visible[0]},
        )

    # Grasps

    def _label_grasps(self) -> Columns:
        """Return the rows of /grasps, object by object, with both kinds of labels."""
        parts, attempts = list[Columns](), list[Attempt]()
        for i, prepared in enumerate(self._clutter.prepared):
            trials = self._task.trials[self._objects[i]]
            n = len(trials["resting"])
            X_TO, known = np.tile(self._X_TN[i], (n, 1, 1)), np.ones(n, dtype=bool)
            columns = grasps_of_trials(trials, X_TO, known)
            columns["scene"] = np.zeros(n, dtype=np.int64)
            columns["object"] = np.full(n, i)
            columns["q_open"] = open_hands(prepared, self._config, self._task.joints, trials)
            places = zip(trials["candidate"], trials["standoff_index"], strict=True)
            own = [find_attempt(prepared, int(c), int(s), self._config) for c, s in places]
            hits = self._hits(i, own, trials["closed_q"])
            columns |= {"hit": hits, "free": hits == HITS_NOTHING, **_untried(n)}
            parts.append(columns)
            attempts += own
        grasps = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}

        # Some of the free grasps are tried, object by object, as each has its own scene.
        free = np.flatnonzero(grasps["free"])
        drawn = free[self._task.stream(_TRIES).permutation(len(free))[: self._task.tries]]
        for row in sorted(drawn.tolist()):
            i = int(grasps["object"][row])
            for name, value in self._try(row, i, attempts[row]).items():
                grasps[name][row] = value
        return grasps

    def _hits(self, i: int, attempts: Sequence[Attempt], q_closed: AnyArray) -> AnyArray:
        """Return what the hand meets first in each attempt on object i, by codes of the schema."""
        X_TO, around = self._clutter.simulated(i)
        others = [j for j in range(len(self._models)) if j != i]
        hits, config = np.full(len(attempts), HITS_NOTHING, dtype=np.uint8), self._config
        for row, attempt in enumerate(attempts):
            about = config.physics, config.hand_source, attempt.preshape
            scene = cached_scene(self._models[i], *about, around or None)
            bodies = [each.body.index() for each in scene.neighbours]
            with self._journal.step(f"free {i} {row}", self._limit):
                met = first_hit(scene, X_TO, attempt, q_closed[row])
            if met is not None:
                hits[row] = others[bodies.index(met)] if met in bodies else HITS_TABLE
        return hits

    def _try(self, row: int, i: int, attempt: Attempt) -> dict[str, Any]:
        """Return the labels of a grasp on object i that is tried in the scene."""
        step = f"{ATTEMPT} {row}"
        verdict = self._journal.verdict(step)
        if verdict is not None:
            outcome = Outcome.TIMEOUT if verdict is Verdict.HUNG else Outcome.CRASHED
            return {"outcome": outcome}
        with self._journal.step(step, self._limit):
            inject_fault(f"scene {self._task.number}", row)
            return try_grasp(self._clutter, i, attempt)

    @property
    def _limit(self) -> float:
        return HANG_FACTOR * self._config.attempt_seconds


def _settled(task: ClutterTask) -> tuple[tuple[int, ...], Clutter]:
    """Return the objects of a scene, by their rows and at rest together.

    Raises:
        DataError: If no set of objects comes to rest.
    """
    reason = ""
    for a, objects in enumerate(task.sets):
        prepared = [load_prepared(task.out, task.names[i], task.config) for i in objects]
        for pile in range(PILES):
            # Draw a resting pose of each object, then how they fall.
            stream = task.stream(a, _PILE + pile)
            models, u = [each.model for each in prepared], stream.uniform(len(prepared))
            resting = [
                each.resting_poses[int(np.searchsorted(np.cumsum(each.probability), share))]
                for each, share in zip(prepared, u * (1.0 - 1e-9), strict=True)
            ]
            try:
                X_TN = pile_up(models, resting, task.surroundings, task.config, stream)
            except PileError as error:
                reason = str(error)
                continue
            return objects, Clutter(
                names=tuple(task.names[row] for row in objects),
                X_TO=X_TN,
                surroundings=task.surroundings,
                config=task.config,
                prepared=tuple(prepared),
            )
    raise DataError(
        f"scene {task.number}: its objects must come to rest in the {task.surroundings.name}, in "
        f"one of {len(task.sets) * PILES} draws, got: {reason}"
    )


def _resting(prepared: PreparedObject, X_TO: Array) -> int:
    """Return the index of the resting pose in which an object stands, or `_NONE`."""
    found = aligned_pose(X_TO, prepared.resting_poses)
    same = [k for k, X in enumerate(prepared.resting_poses) if np.array_equal(X, found)]
    return same[0] if same else _NONE


def _untried(count: int) -> Columns:
    """Return labels of grasps that are not tried."""
    nothing = np.zeros(count, dtype=bool)
    return {
        "outcome": np.full(count, NOT_TRIED, dtype=np.uint8),
        **{name: nothing.copy() for name in _FLAGS},
        "neighbour": np.full(count, _NONE, dtype=np.uint8),
        "neighbour_shift": np.full(count, np.nan),
        "neighbour_turn": np.full(count, np.nan),
    }


_FLAGS = ("tested", "lifted", "kept", "clean", "precision", "stable")


def try_grasp(clutter: Clutter, i: int, attempt: Attempt) -> dict[str, Any]:
    """Return the labels of a grasp on object i among the others, by their names in the schema."""
    config, model, (X_TO, around) = clutter.config, clutter.models[i], clutter.simulated(i)
    record = run_cached(model, X_TO, attempt, config, around or None)
    outcome, moved = record.outcome, disturbance_of(record, around)
    labels = {
        "outcome": outcome,
        "tested": outcome in TRIED and record.lift is not None,
        "lifted": outcome is Outcome.SUCCESS,
        "kept": judge_sample(model, record, config, views=False) is Removal.KEPT,
        "precision": record.precision,
        "stable": record.stable,
    }
    if moved is None:
        return labels | {"clean": labels["kept"]}
    return labels | {
        "clean": labels["kept"] and moved.is_small,
        "neighbour": moved.neighbour + (moved.neighbour >= i),
        "neighbour_shift": moved.shift,
        "neighbour_turn": moved.turn,
    }
