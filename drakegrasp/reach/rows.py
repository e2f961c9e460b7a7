"""What an arm can do about the grasps of a dataset: OUT/reach/NAME.hdf5, OUT/reach/clutter/...

Input: an assembled dataset and an arm. Output: a file with a row per grasp that is a sample, or per
free grasp of clutter.hdf5. Samples are known by object, palm pose and stand-off, so that a dataset
which grew gets the missing rows only, and rows of grasps that are no samples now are kept. Grasps
of scenes are known by their row, as long as the scenes are of the same request and the same
samples. There is one task per object, or object of a scene; the file does not depend on the
workers.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from drakegrasp.arithmetic import multiply
from drakegrasp.config import Config
from drakegrasp.dataset.clutter import Clutter, load_scene
from drakegrasp.dataset.hdf5 import open_clutter_reach, open_reach, read_columns, write_field
from drakegrasp.dataset.lock import build_lock
from drakegrasp.dataset.manifest import Manifest, origin_attributes, read_manifest
from drakegrasp.dataset.paths import CLUTTER_FILE, REACH_FOLDER, reach_path
from drakegrasp.dataset.prepared_objects import load_prepared
from drakegrasp.dataset.reach import IDENTITY, NO_ROW, OWN_IDENTITY, rows_by_identity
from drakegrasp.dataset.rejections import AttemptKey
from drakegrasp.dataset.scenes import SceneDataset, validate_state
from drakegrasp.dataset.schema import CLUTTER_REACH_FIELDS, REACH_FIELDS, REACHES, SHAPE_FIELDS
from drakegrasp.dataset.trials import Stamp, Trials, stamp
from drakegrasp.errors import DataError
from drakegrasp.filters import Removal
from drakegrasp.foreign_files import validate_no_link
from drakegrasp.frames import Array, invert_pose, pack_pose, unpack_pose
from drakegrasp.generation.scenes import OPEN_FOLLOWS_FROM, open_hands
from drakegrasp.hand.description import load_hand
from drakegrasp.mesh.distance_field import DistanceField
from drakegrasp.reach.arm import Arm, mount_of
from drakegrasp.reach.cell import Cell, make_cell
from drakegrasp.reach.reaching import Grasp, draw_arm, reach_grasp
from drakegrasp.runtime.environment import one_thread
from drakegrasp.runtime.executor import Executor, in_order, run_here
from drakegrasp.runtime.files import atomic_hdf5, disk_full_named
from drakegrasp.runtime.progress import Report, silent
from drakegrasp.table import AnyArray, Table

#: Columns of trials from which the rows follow.
_FOLLOW_FROM = (*OPEN_FOLLOWS_FROM, "X_TO", "X_OG", "closed_q")
#: When an arm has the joints of `Reach.q`.
WHEN = ("approach", "grasp", "lift")
#: Attributes that another file of a name must not have, and those that make rows of scenes old.
_OF_ARM = ("arm_sha256", "flange", "base", "mount", "config_hash")
_OF_SCENES = ("shards", "signature", "clutter")
#: Group of the rows of samples and of scenes, their fields, and what opens the file.
_SAMPLES = "reach", REACH_FIELDS, open_reach
_SCENES = "clutter", CLUTTER_REACH_FIELDS, open_clutter_reach


def reach_dataset(
    out: str | Path,
    arm: Arm,
    *,
    name: str | None = None,
    clutter: bool = False,
    execute: Executor = run_here,
    progress: Report = silent,
) -> Table:
    """Write what an arm can do about the samples of a dataset, or the rows that are missing.

    Args:
        out: Directory of an assembled dataset.
        arm: The arm, see `load_arm`.
        name: Name of the file; None for the arm's.
        clutter: Whether to ask for the free grasps of clutter.hdf5, among what is around their
            objects, in place of the samples.
        execute: Runs the tasks.
        progress: Called with the number of completed objects and of all objects.

    Raises:
        ConfigError: If the arm, or the dataset's hand on it, cannot be used.
        DataError: If there is no dataset, the dataset is damaged, another process builds in it, the
            file is of another arm, base or mount, or there are no scenes of these trials.
        DiskFullError: If the disk is full.

    Returns:
        The rows (n, ...) of the file.
    """
    out = Path(out)
    read_manifest(out)  # fails for a missing directory, which the lock would create
    with build_lock(out):
        path = reach_path(out, name or arm.name, clutter=clutter)
        return (_reach_clutter if clutter else _reach)(out, arm, path, execute, progress)


def _reach(out: Path, arm: Arm, path: Path, execute: Executor, progress: Report) -> Table:
    manifest, trials = read_manifest(out), Trials(out)
    file = _ArmFile(out, path, arm, manifest, trials)
    old = file.rows()

    # New rows, in the order of the objects, and old rows with the numbers of their trials now.
    asked = np.isin(trials["removal"], (Removal.KEPT, Removal.UNREACHABLE))
    tasks = list(sample_tasks(out, manifest, _without(trials[asked], old), arm))
    rows = _numbered(_with_answers(old, tasks, execute, progress), trials)
    file.write(rows)
    return rows


def _reach_clutter(out: Path, arm: Arm, path: Path, execute: Executor, progress: Report) -> Table:
    manifest, trials, scenes = read_manifest(out), Trials(out), out / CLUTTER_FILE
    validate_state(scenes, trials)
    data = SceneDataset(scenes, points=None)
    file = _ArmFile(out, path, arm, manifest, trials, data.around)
    old, free = file.rows(), np.flatnonzero(data.tables["grasps"]["free"])
    old = old[np.isin(old.grasp, free)]

    # New rows, in the order of the scenes.
    missing = free[~np.isin(free, old.grasp)]
    tasks = list(_clutter_tasks(out, manifest, trials, data, missing, arm))
    rows = _with_answers(old, tasks, execute, progress)
    rows = rows[np.argsort(rows.grasp)]
    file.write(rows)
    return rows


def _with_answers(
    old: Table, tasks: Sequence[ReachTask], execute: Executor, progress: Report
) -> Table:
    """Return old rows, then those of tasks."""
    parts = [old]
    progress(0, len(tasks))
    for count, columns in enumerate(in_order(execute)(reach_object, tasks), start=1):
        parts.append(Table(columns))
        progress(count, len(tasks))
    return Table({name: np.concatenate([part[name] for part in parts]) for name in old.names})


# The file


@dataclass(frozen=True, eq=False)
class _ArmFile:
    """The file of an arm.

    Attributes:
        out: Directory of the dataset.
        path: Path of the file.
        arm: The arm.
        manifest: The manifest of the dataset.
        trials: Its trials.
        scenes: What was asked for in clutter.hdf5, of whose grasps the rows are; None for samples.
    """

    out: Path
    path: Path
    arm: Arm
    manifest: Manifest
    trials: Trials
    scenes: str | None = None

    @cached_property
    def attributes(self) -> dict[str, Any]:
        """The attributes that it gets now."""
        manifest, known, arm = self.manifest, self.trials.attributes, self.arm
        X_FB = mount_of(arm, load_hand(manifest.config.hand_source))
        origin = manifest.config, manifest.versions, manifest.fingers, manifest.joints
        found = {
            **origin_attributes(*origin),
            "shards": known["shards"],
            "arm": arm.name,
            "arm_sha256": arm.digest,
            "arm_urdf": arm.urdf,
            "flange": arm.flange,
            "arm_joints": json.dumps(arm.joints),
            "base": np.array(arm.base),
            "mount": pack_pose(X_FB),
        }
        if self.scenes is not None:
            found |= {"signature": known["signature"], "clutter": self.scenes}
        return found

    def rows(self) -> Table:
        """Return the rows that are there; none if there is no file, or it is of other scenes.

        Raises:
            ConfigError: If the arm, or the dataset's hand on it, cannot be used.
            DataError: If it is of another arm, base or mount.
        """
        due, source = self.attributes, self.manifest.config.hand_source
        cell = make_cell(self.arm, source, mount_of(self.arm, load_hand(source)))  # fails early
        group, fields, opened = _SAMPLES if self.scenes is None else _SCENES
        if self.path.exists():
            with opened(self.path) as file:
                for key in _OF_ARM:
                    if not np.array_equal(file.attrs[key], due[key]):
                        raise DataError(
                            f"{self.path}: must be of the same {key}, got another; choose another "
                            "--name or remove the file"
                        )
                if self.scenes is None or all(file.attrs[key] == due[key] for key in _OF_SCENES):
                    return read_columns(file[group], fields)
        return Table({f.name: f.empty(0, {"a": len(cell.limits)}) for f in fields})

    def write(self, rows: Table) -> None:
        """Write the file with these rows.

        Raises:
            DiskFullError: If the disk is full.
        """
        group, fields, _ = _SAMPLES if self.scenes is None else _SCENES
        for folder in (self.out / REACH_FOLDER, self.path.parent):
            validate_no_link(folder)
        with disk_full_named(self.out):
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with atomic_hdf5(self.path, sealed=True) as file:
                file.attrs.update(self.attributes)
                for field in fields:
                    write_field(file.require_group(group), field, rows[field.name])
                for field in SHAPE_FIELDS:
                    write_field(file.require_group("shapes"), field, _shapes(self.arm)[field.name])


def _shapes(arm: Arm) -> dict[str, AnyArray]:
    """Return the columns of SHAPE_FIELDS of an arm."""
    hulls = [np.frombuffer(corners).reshape(-1, 3) for _, corners in arm.hulls]
    numbers = np.repeat(np.arange(len(hulls), dtype=np.uint16), [len(hull) for hull in hulls])
    links = np.array([link for link, _ in arm.hulls], dtype=object)
    return {
        "link": links[numbers],
        "hull": numbers,
        "p_LC": np.concatenate([np.zeros((0, 3)), *hulls]),
    }


def draw_row(path: Path, config: Config, key: AttemptKey) -> dict[str, Array]:
    """Return triangles (t, 3, 3) [m] of an arm at a grasp, see `draw_arm`.

    Args:
        path: File of the arm.
        config: Configuration of the dataset.
        key: The grasp.

    Raises:
        DataError: If the file is missing or damaged.
    """
    with open_reach(path) as file:
        about, rows = dict(file.attrs), read_columns(file["reach"], REACH_FIELDS)
        shapes = read_columns(file["shapes"], SHAPE_FIELDS)
    wanted = [np.array([value]) for value in (key.object, key.candidate, key.standoff_index)]
    (place,) = rows_by_identity([rows[name] for name in OWN_IDENTITY], wanted)
    if place == NO_ROW:
        return {}
    hulls = [shapes[shapes.hull == number] for number in np.unique(shapes.hull)]
    arm = Arm(
        name=about["arm"],
        urdf=about["arm_urdf"],
        hulls=tuple((hull.link[0], hull.p_LC.tobytes()) for hull in hulls),
        digest=about["arm_sha256"],
        flange=about["flange"],
        joints=tuple(json.loads(about["arm_joints"])),
        base=tuple(about["base"].tolist()),
        mount=tuple(unpack_pose(about["mount"]).ravel().tolist()),
    )
    return draw_arm(arm, np.array([rows[f"q_{when}"][place] for when in WHEN]), config)


# Which grasps are asked for


def _without(trials: Trials, old: Table) -> Trials:
    """Return the trials that have no row in a table."""
    wanted = trials.columns(IDENTITY)
    return trials[rows_by_identity([old[k] for k in OWN_IDENTITY], [*wanted.values()]) == NO_ROW]


def _numbered(rows: Table, trials: Trials) -> Table:
    """Return rows in the order of their trials, with the numbers that the trials have now."""
    now = trials.columns(IDENTITY)
    ids = rows_by_identity([*now.values()], [rows[key] for key in OWN_IDENTITY])
    order = np.argsort(ids, kind="stable")
    return rows.with_columns({"trial_id": ids})[order[ids[order] != NO_ROW]]


def sample_tasks(out: Path, manifest: Manifest, trials: Trials, arm: Arm) -> Iterator[ReachTask]:
    """Yield a task for the trials of each object that has any.

    Args:
        out: Directory of the dataset.
        manifest: Its manifest.
        trials: The trials.
        arm: The arm.
    """
    names, places = trials["object_name"], trials.columns(("candidate", "standoff_index"))
    identity = Table(places, object=np.asarray(names, dtype=object), trial_id=trials.trial_ids)
    for entry in manifest.objects:
        if (own := names == entry.name).any():
            yield _task(out, manifest, trials[own], arm, identity[own])


def _clutter_tasks(
    out: Path, manifest: Manifest, trials: Trials, data: SceneDataset, rows: AnyArray, arm: Arm
) -> Iterator[ReachTask]:
    """Yield a task for those of some rows of /grasps that are of one object in one scene."""
    scene, place = (data.tables["grasps"][name][rows] for name in ("scene", "object"))
    identity = Table(grasp=rows, scene=scene, object=place)
    for s, i in sorted({*zip(scene.tolist(), place.tolist(), strict=True)}):
        own = (scene == s) & (place == i)
        ids = data.tables["grasps"]["trial_id"][rows[own]]
        yield replace(_task(out, manifest, trials[ids], arm, identity[own]), scene=s, place=i)


def _task(
    out: Path, manifest: Manifest, trials: Trials, arm: Arm, identity: Mapping[str, AnyArray]
) -> ReachTask:
    """Return the task of some grasps of an object."""
    hand = load_hand(manifest.config.hand_source)
    return ReachTask(
        out=out,
        name=str(trials["object_name"][0]),
        config=manifest.config,
        joints=manifest.joints or hand.joint_order,
        arm=arm,
        trials=trials.columns(_FOLLOW_FROM),
        identity=identity,
    )


# The grasps of one object


@dataclass(frozen=True, kw_only=True, eq=False)
class ReachTask:
    """The input of a task that asks an arm for the grasps of an object.

    Attributes:
        out: Directory of the dataset.
        name: Name of the object.
        config: Configuration of the dataset.
        joints: Names of the hand's joints, in the order of the files.
        arm: The arm.
        trials: Columns of n grasps of trials.hdf5.
        identity: Columns (n, ...) that tell which grasps they are.
        scene: Number of the scene of clutter.hdf5 in which they are; None for the object alone.
        place: Index of the object in the scene.
    """

    out: Path
    name: str
    config: Config
    joints: Sequence[str]
    arm: Arm
    trials: Mapping[str, AnyArray]
    identity: Mapping[str, AnyArray]
    scene: int | None = None
    place: int = 0

    def asked(self) -> tuple[Cell, DistanceField, list[Grasp]]:
        """Return the arm with its hand, the distances from the object, and the n grasps.

        Raises:
            DataError: If a file of the dataset is missing or damaged.
        """
        # The object alone, or in its scene, where it was moved from where it is simulated.
        trials, moved, around = dict(self.trials), np.eye(4), None
        X_TO, X_OG = (unpack_pose(trials[key]) for key in ("X_TO", "X_OG"))
        if self.scene is None:
            prepared = load_prepared(self.out, self.name, self.config)
        else:
            path, i = self.out / CLUTTER_FILE, self.place
            clutter = _scene_at(path, self.scene, stamp(path))
            prepared, around = clutter.prepared[i], clutter.around(i)
            X_TO = np.broadcast_to(clutter.X_TO[i], X_TO.shape)
            moved = multiply(clutter.X_TO[i], invert_pose(clutter.simulated(i)[0]))

        source = self.config.hand_source
        cell = make_cell(self.arm, source, mount_of(self.arm, load_hand(source)), around)
        q_open = open_hands(prepared, self.config, self.joints, trials)
        grasps = [
            Grasp(
                X_TO=X_TO[i],
                X_TG=multiply(X_TO[i], X_OG[i]),
                q_open=q_open[i],
                q_closed=trials["closed_q"][i],
                p_TG_lifted=moved[:3, :3] @ self.config.lift.p_TG + moved[:3, 3],
                around=around,
            )
            for i in range(len(X_TO))
        ]
        return cell, prepared.model.field, grasps


@lru_cache(maxsize=1)
def _scene_at(path: Path, number: int, known: Stamp) -> Clutter:
    """Return a scene; a process keeps the last one, whose objects know distances from them."""
    return load_scene(path, number)


@one_thread
def reach_object(task: ReachTask) -> dict[str, AnyArray]:
    """Return the columns (n, ...) of the rows of an object's grasps.

    Raises:
        DataError: If a file of the dataset is missing or damaged.
    """
    cell, field, grasps = task.asked()
    count = len(grasps)
    q = np.full((count, 3, len(cell.limits)), np.nan)
    outcome, clearance = np.zeros(count, dtype=np.uint8), np.full(count, np.nan)
    for i, grasp in enumerate(grasps):
        found = reach_grasp(cell, field, grasp)
        outcome[i] = REACHES.index(found.outcome)
        q[i], clearance[i] = found.q, found.clearance
    return {
        **task.identity,
        "reachable": outcome == 0,
        "reach_outcome": outcome,
        **{f"q_{when}": q[:, k] for k, when in enumerate(WHEN)},
        "clearance": clearance,
    }
