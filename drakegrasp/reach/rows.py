"""What an arm can do about the grasps of a dataset: OUT/reach/NAME.hdf5.

Input: an assembled dataset and an arm. Output: a file with a row per grasp that is a sample. Rows
are known by object, palm pose and stand-off, so that a dataset which grew gets the missing rows
only, and rows of grasps that are no samples now are kept. There is one task per object; the file
does not depend on the workers.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drakegrasp.arithmetic import multiply
from drakegrasp.config import Config
from drakegrasp.dataset.hdf5 import AnyArray, open_reach, read_columns, write_field
from drakegrasp.dataset.lock import build_lock
from drakegrasp.dataset.manifest import Manifest, origin_attributes, read_manifest
from drakegrasp.dataset.paths import reach_path
from drakegrasp.dataset.prepared_objects import load_prepared
from drakegrasp.dataset.reach import IDENTITY, NO_ROW, OWN_IDENTITY, rows_by_identity
from drakegrasp.dataset.rejections import AttemptKey
from drakegrasp.dataset.schema import REACH_FIELDS, REACHES, SHAPE_FIELDS
from drakegrasp.dataset.trials import Trials
from drakegrasp.errors import DataError
from drakegrasp.filters import Removal
from drakegrasp.foreign_files import validate_no_link
from drakegrasp.frames import Array, pack_pose, unpack_pose
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
from drakegrasp.table import Table

#: Columns of trials from which the rows follow.
_FOLLOW_FROM = (*OPEN_FOLLOWS_FROM, "X_TO", "X_OG", "closed_q")
#: When an arm has the joints of `Reach.q`.
WHEN = ("approach", "grasp", "lift")


def reach_dataset(
    out: str | Path,
    arm: Arm,
    *,
    name: str | None = None,
    execute: Executor = run_here,
    progress: Report = silent,
) -> Table:
    """Write what an arm can do about the samples of a dataset, or the rows that are missing.

    Args:
        out: Directory of an assembled dataset.
        arm: The arm, see `load_arm`.
        name: Name of the file; None for the arm's.
        execute: Runs the tasks.
        progress: Called with the number of completed objects and of all objects.

    Raises:
        ConfigError: If the arm, or the dataset's hand on it, cannot be used.
        DataError: If there is no dataset, the dataset is damaged, another process builds in it, or
            the file is of another arm, base or mount.
        DiskFullError: If the disk is full.

    Returns:
        The rows (n, ...) of the file.
    """
    out = Path(out)
    read_manifest(out)  # fails for a missing directory, which the lock would create
    with build_lock(out):
        return _reach(out, arm, reach_path(out, name or arm.name), execute, progress)


def _reach(out: Path, arm: Arm, path: Path, execute: Executor, progress: Report) -> Table:
    manifest, trials = read_manifest(out), Trials(out)
    X_FB = mount_of(arm, load_hand(manifest.config.hand_source))
    cell = make_cell(arm, manifest.config.hand_source, X_FB)  # fails early
    attributes = _attributes(manifest, trials, arm, X_FB)
    old = _old_rows(path, attributes)

    # New rows, in the order of the objects, and old rows with the numbers of their trials now.
    asked = np.isin(trials["removal"], (Removal.KEPT, Removal.UNREACHABLE))
    tasks = list(sample_tasks(out, manifest, _without(trials[asked], old), arm))
    parts = [_no_rows(len(cell.limits)) if old is None else old]
    progress(0, len(tasks))
    for count, columns in enumerate(in_order(execute)(reach_object, tasks), start=1):
        parts.append(Table(columns))
        progress(count, len(tasks))
    rows = Table({f.name: np.concatenate([part[f.name] for part in parts]) for f in REACH_FIELDS})
    rows = _numbered(rows, trials)

    validate_no_link(path.parent)
    with disk_full_named(out):
        path.parent.mkdir(exist_ok=True)
        with atomic_hdf5(path, sealed=True) as file:
            file.attrs.update(attributes)
            for field in REACH_FIELDS:
                write_field(file.require_group("reach"), field, rows[field.name])
            for field in SHAPE_FIELDS:
                write_field(file.require_group("shapes"), field, _shapes(arm)[field.name])
    return rows


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


def _attributes(manifest: Manifest, trials: Trials, arm: Arm, X_FB: Array) -> dict[str, Any]:
    origin = manifest.config, manifest.versions, manifest.fingers, manifest.joints
    return {
        **origin_attributes(*origin),
        "shards": trials.attributes["shards"],
        "arm": arm.name,
        "arm_sha256": arm.digest,
        "arm_urdf": arm.urdf,
        "flange": arm.flange,
        "arm_joints": json.dumps(arm.joints),
        "base": np.array(arm.base),
        "mount": pack_pose(X_FB),
    }


def _old_rows(path: Path, due: Mapping[str, Any]) -> Table | None:
    """Return the rows of a file that is there.

    Raises:
        DataError: If it is of another arm, base or mount.
    """
    if not path.exists():
        return None
    with open_reach(path) as file:
        for key in ("arm_sha256", "flange", "base", "mount", "config_hash"):
            if not np.array_equal(file.attrs[key], due[key]):
                raise DataError(
                    f"{path}: must be of the same {key}, got another; choose another --name or "
                    "remove the file"
                )
        return read_columns(file["reach"], REACH_FIELDS)


def _no_rows(joints: int) -> Table:
    """Return a table of no grasps of an arm with a number of joints."""
    dtypes = {f.name: object if f.dtype == "str" else f.dtype for f in REACH_FIELDS}
    shapes = {f.name: (0, *f.row_shape({"a": joints})) for f in REACH_FIELDS}
    return Table({name: np.zeros(shapes[name], dtypes[name]) for name in dtypes})


def _without(trials: Trials, old: Table | None) -> Trials:
    """Return the trials that have no row in a table."""
    if old is None:
        return trials
    wanted = trials.columns(IDENTITY)
    return trials[rows_by_identity([old[k] for k in OWN_IDENTITY], [*wanted.values()]) == NO_ROW]


def sample_tasks(out: Path, manifest: Manifest, trials: Trials, arm: Arm) -> Iterator[ReachTask]:
    """Yield a task for the trials of each object that has any.

    Args:
        out: Directory of the dataset.
        manifest: Its manifest.
        trials: The trials.
        arm: The arm.
    """
    hand, names = load_hand(manifest.config.hand_source), trials["object_name"]
    for entry in manifest.objects:
        own = trials[names == entry.name]
        if len(own):
            yield ReachTask(
                out=out,
                name=entry.name,
                config=manifest.config,
                joints=manifest.joints or hand.joint_order,
                arm=arm,
                trials=own.columns(_FOLLOW_FROM),
                trial_ids=own.trial_ids,
            )


def _numbered(rows: Table, trials: Trials) -> Table:
    """Return rows in the order of their trials, with the numbers that the trials have now."""
    now = trials.columns(IDENTITY)
    ids = rows_by_identity([*now.values()], [rows[key] for key in OWN_IDENTITY])
    order = np.argsort(ids, kind="stable")
    return rows.with_columns({"trial_id": ids})[order[ids[order] != NO_ROW]]


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
        trial_ids: (n,), their rows there.
    """

    out: Path
    name: str
    config: Config
    joints: Sequence[str]
    arm: Arm
    trials: Mapping[str, AnyArray]
    trial_ids: AnyArray

    def asked(self) -> tuple[Cell, DistanceField, list[Grasp]]:
        """Return the arm with its hand, the distances from the object, and the n grasps.

        Raises:
            DataError: If a file of the dataset is missing or damaged.
        """
        source, trials = self.config.hand_source, dict(self.trials)
        cell = make_cell(self.arm, source, mount_of(self.arm, load_hand(source)))
        prepared = load_prepared(self.out, self.name, self.config)
        X_TO, X_OG = (unpack_pose(trials[key]) for key in ("X_TO", "X_OG"))
        q_open = open_hands(prepared, self.config, self.joints, trials)
        grasps = [
            Grasp(
                X_TO=X_TO[i],
                X_TG=multiply(X_TO[i], X_OG[i]),
                q_open=q_open[i],
                q_closed=trials["closed_q"][i],
                p_TG_lifted=np.array(self.config.lift.p_TG),
            )
            for i in range(len(self.trial_ids))
        ]
        return cell, prepared.model.field, grasps


@one_thread
def reach_object(task: ReachTask) -> dict[str, AnyArray]:
    """Return the columns (n, ...) of REACH_FIELDS of an object's grasps.

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
        "object": np.full(count, task.name, dtype=object),
        **{key: task.trials[key] for key in ("candidate", "standoff_index")},
        "trial_id": np.asarray(task.trial_ids),
        "reachable": outcome == 0,
        "reach_outcome": outcome,
        **{f"q_{when}": q[:, k] for k, when in enumerate(WHEN)},
        "clearance": clearance,
    }
