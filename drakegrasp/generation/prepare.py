"""Prepares one mesh as a task, and refuses a mesh whose preparation crashes or hangs.

Input: a mesh and the configuration, as plain data. Output: the object's files, and the entry in the
manifest, which describes the object or states why the mesh was refused. The task reads and hashes
the mesh file once.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np

from drakegrasp.config import Config
from drakegrasp.dataset.manifest import ObjectEntry, RefusedMesh
from drakegrasp.dataset.paths import model_path, object_files
from drakegrasp.dataset.prepared_objects import PreparedObject, load_prepared, save_prepared
from drakegrasp.errors import DrakegraspError, MeshError
from drakegrasp.frames import Array
from drakegrasp.generation.directory import DatasetTask
from drakegrasp.objects.model import ObjectModel, prepare_object
from drakegrasp.objects.sources import MeshSource, read_source, source_sha256
from drakegrasp.runtime.environment import one_thread, release_memory
from drakegrasp.runtime.files import disk_full_named
from drakegrasp.runtime.journal import PREPARE, Verdict, inject_fault, open_journal
from drakegrasp.simulation.attempts import GraspTable, given_candidates
from drakegrasp.simulation.candidates import Drawing
from drakegrasp.simulation.settle import find_resting_poses

#: Number of objects whose samplers a process keeps.
KEPT_DRAWINGS = 16
#: Smallest number of palm poses that a build with a target draws first.
FIRST_PALMS = 64
#: Computing time after which the preparation of a mesh is considered to hang [s].
PREPARE_SECONDS = 1800.0


@dataclass(frozen=True, kw_only=True)
class PrepareTask(DatasetTask):
    """The input of a task that prepares a mesh.

    Attributes:
        source: The mesh.
        postures: Postures to try instead of palm poses of samplers; None: use the samplers.
        restartable: Whether the process that runs the task is restarted when it dies. If so, only
            the mesh is lost by a crash or a hang; if not, it propagates to the caller.
    """

    source: MeshSource
    postures: GraspTable | None = None
    restartable: bool

    @property
    def journal(self) -> Path:
        """Path of the journal, see `drakegrasp.runtime.journal`."""
        return model_path(self.out, self.source.name).with_suffix(".journal")

    @property
    def outputs(self) -> tuple[Path, ...]:
        """The object's files and the journal."""
        return *object_files(self.out, self.source.name), self.journal

    @property
    def _mesh_place(self) -> str:
        # Messages name the file, so the copy keeps its name.
        return f"meshes/{self.source.name}/{self.source.path.name}"

    def reads(self) -> dict[str, Path]:
        """Return the files of the mesh, the hand and an earlier run by their places."""
        return {self._mesh_place: self.source.path, **super().reads()}

    def moved(self, folder: Path) -> Self:
        """Return the task in a directory with copies of the files."""
        source = replace(self.source, path=folder / self._mesh_place)
        return replace(super().moved(folder), source=source)


@dataclass(frozen=True, kw_only=True)
class DrawTask(DatasetTask):
    """The input of a task that draws more palm poses of a prepared object.

    Attributes:
        name: Name of the object.
        count: Number of palm poses, with those that are drawn already.
    """

    name: str
    count: int

    @property
    def outputs(self) -> tuple[Path, ...]:
        """The object's files."""
        return object_files(self.out, self.name)


@one_thread
def draw_palms(task: DrawTask) -> tuple[str, ObjectEntry]:
    """Draw palm poses of a prepared object, and return its name and its entry in the manifest.

    Raises:
        DataError: If the object's files are missing or damaged.
        DiskFullError: If there is no space for the object's files.
    """
    out, config = task.out, task.config
    with disk_full_named(out):
        prepared = load_prepared(out, task.name, config)
        if prepared.asked < task.count:
            drawing = _drawing(prepared.model, prepared.resting_poses, config)
            drawn = drawing.candidates(task.count)
            prepared = replace(prepared, candidates=drawn, asked=task.count)
            save_prepared(prepared, out, config)
    return task.name, prepared.entry()


#: The latest drawings of this process, by object and configuration: a process that draws more palm
#: poses of an object need not begin again.
_drawings: dict[tuple[str, str, str], Drawing] = {}


def _drawing(model: ObjectModel, resting_poses: Array, config: Config) -> Drawing:
    """Return the drawing of an object, the one of before if there is one."""
    key = model.name, model.mesh_sha256, config.simulation_hash()
    drawing = _drawings.pop(key, None) or Drawing(model, resting_poses, config)
    _drawings[key] = drawing
    for old in list(_drawings)[:-KEPT_DRAWINGS]:
        del _drawings[old]
    return drawing


@one_thread
def prepare_one(task: PrepareTask) -> tuple[str, ObjectEntry | RefusedMesh]:
    """Prepare one mesh, and return its name and its entry in the manifest.

    The entry of a refused mesh is a `RefusedMesh`. An object whose files are complete is not
    prepared again.

    Raises:
        MeshError: If the mesh file cannot be read.
        DiskFullError: If there is no space for the object's files.
        MachineError: If something other than the mesh kills the process repeatedly.
    """
    out, name, config = task.out, task.source.name, task.config
    with disk_full_named(out):
        # The worker or the client may have died before the object was in the manifest.
        read = _, digest = read_source(task.source)
        entry = find_entry(task.source, out, config, digest)
        if entry is not None:
            return name, entry

        # The journal identifies a mesh that kills its process, which is then refused.
        release_memory()
        config_hash = config.simulation_hash()
        identity = {"name": name, "mesh_sha256": digest, "config_hash": config_hash}
        with open_journal(task.journal, identity, restartable=task.restartable) as journal:
            verdict = journal.verdict(PREPARE)
            if verdict is not None:
                # More memory may help, so the next build tries again.
                again = verdict is Verdict.VANISHED
                reason = f"preparing it {verdict.value}"
                return name, RefusedMesh(name=name, mesh_sha256=digest, reason=reason, again=again)
            journal.validate_no_loop(f"{name}, preparing it")
            with journal.step(PREPARE, PREPARE_SECONDS):
                inject_fault(name)
                return name, _prepared_entry(task, read)


def find_entry(
    source: MeshSource, out: Path, config: Config, digest: str | None = None
) -> ObjectEntry | None:
    """Return the entry of a prepared object; None if its mesh must be prepared.

    Its files decide, since a build that died may not have written its entry.

    Args:
        source: The mesh.
        out: Directory of the dataset.
        config: Configuration of the dataset.
        digest: SHA-256 of the mesh as it is now; None: the file is read if the object is there.

    Raises:
        MeshError: If the mesh file cannot be read.
    """
    try:
        prepared = load_prepared(out, source.name, config)
    except DrakegraspError:
        return None
    model, digest = prepared.model, digest or source_sha256(source)
    same = (model.class_name, model.mesh_sha256) == (source.class_name, digest)
    return prepared.entry() if same and prepared.asked >= first_palms(config) else None


def _prepared_entry(task: PrepareTask, read: tuple[bytes, str]) -> ObjectEntry | RefusedMesh:
    try:
        prepared = prepare(task.source, task.config, task.postures, read)
    except MeshError as error:
        # The entry already has the name.
        reason = str(error).removeprefix(f"{task.source.path.name}: ")
        return RefusedMesh(name=task.source.name, mesh_sha256=read[1], reason=reason)
    save_prepared(prepared, task.out, task.config)
    return prepared.entry()


def prepare(
    source: MeshSource,
    config: Config,
    postures: GraspTable | None = None,
    read: tuple[bytes, str] | None = None,
) -> PreparedObject:
    """Return a mesh as an object at rest on the table, with its palm poses.

    Args:
        source: The mesh.
        config: Configuration of the dataset.
        postures: Postures to try instead of palm poses of samplers.
        read: Content and hash of the file, see `read_source`; None: the file is read now.

    Raises:
        MeshError: If the mesh cannot be repaired, its size is implausible, or the object does
            not come to rest.
    """
    model = prepare_object(source, config.objects, read)
    resting = find_resting_poses(model, config)

    # Compute the distance field here as well. If it hangs or needs too much memory, only the mesh
    # is rejected; later it would stop the build.
    if config.screen.mode == "on":
        inject_fault(source.name, "distances")
        _ = model.field
    poses = np.array([pose.X_TO for pose in resting])
    asked = first_palms(config)
    if postures is None:
        candidates = _drawing(model, poses, config).candidates(asked)
    else:
        candidates = given_candidates(model, poses, postures, config)
    return PreparedObject(
        model=replace(model, notes=(*model.notes, *resting[0].notes)),
        resting_poses=poses,
        probability=np.array([pose.probability for pose in resting]),
        table_force=np.array([pose.table_force for pose in resting]),
        stopped=np.array([pose.stopped for pose in resting]),
        candidates=candidates,
        asked=asked,
    )


def first_palms(config: Config) -> int:
    """Return the number of palm poses that are drawn when an object is prepared.

    A build with a target draws a few, and more when it needs them.
    """
    most = config.candidates.max
    if not config.has_target or config.candidates.postures is not None:
        return most
    return next((u.stop for u in config.unit_ranges(most) if u.stop >= FIRST_PALMS), most)
