"""Objects at rest with their palm poses, and the files that hold them.

Input: an object that `generation.prepare` has prepared. Output: `objects/<name>.npz` with the
object and `objects/<name>.plan.h5` with its resting poses and palm poses, in the dataset's
directory. Work units, `check` and `replay` read these two files and do not need the mesh file.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import numpy as np
import numpy.typing as npt

from drakegrasp.config import Config
from drakegrasp.dataset.hdf5 import AnyArray, opened_sealed
from drakegrasp.dataset.manifest import ObjectEntry, RestingEntry
from drakegrasp.dataset.paths import model_path, plan_path, read_model_file
from drakegrasp.errors import DataError
from drakegrasp.foreign_files import parse_json
from drakegrasp.frames import Array
from drakegrasp.objects.model import ObjectModel, load_object, save_object
from drakegrasp.runtime.files import atomic_hdf5
from drakegrasp.simulation.candidates import Candidates
from drakegrasp.table import Table

#: Fields of an object's entry in the manifest that come from its model.
_OF_MODEL = (
    *("name", "class_name", "mesh_sha256", "scale", "up", "mass", "density", "friction"),
    *("collision_error", "notes"),
)
#: Arrays of a plan and their types: resting poses; palm poses; postures from outside, which are as
#: many as the palm poses.
_RESTING = {
    "X_TO": "float64",
    "probability": "float64",
    "table_force": "float64",
    "stopped": "bool",
}
_PALMS = {
    "X_OG": "float64",
    "distance": "float64",
    "resting": "int64",
    "source": "int64",
    "spread": "float64",
    "preshape_index": "int64",
}
_POSTURES = {**dict.fromkeys(("q_grasp", "q_pregrasp", "q_squeeze"), "float64"), "row": "int64"}
#: Fields of the entry that change when more palm poses are drawn.
_DRAWN = ("candidates", "ended")


@dataclass(frozen=True, kw_only=True, eq=False)
class PreparedObject:
    """An object that rests on the table, with the palm poses to try.

    Attributes:
        model: Meshes and mass properties.
        resting_poses: (r, 4, 4), resting poses X_TO; the first is the one of the paper.
        probability: (r,), fraction of the drops that ended in each resting pose.
        table_force: (r,), upward force of the table on the object at rest [N].
        stopped: (r,) bool, whether the object would have rolled on and was stopped, see
            `settle.settle`.
        candidates: Palm poses and their rays.
        asked: Number of palm poses for which the samplers were asked; if there are fewer, there are
            no more.
    """

    model: ObjectModel
    resting_poses: Array
    probability: Array
    table_force: Array
    stopped: npt.NDArray[np.bool_]
    candidates: Candidates
    asked: int

    def entry(self) -> ObjectEntry:
        """Return the object's entry in the manifest."""
        columns = self.resting_poses, self.probability.tolist(), self.stopped.tolist()
        resting = tuple(
            RestingEntry(X_TO=tuple(X_TO[:3].ravel().tolist()), probability=share, rolled=rolled)
            for X_TO, share, rolled in zip(*columns, strict=True)
        )

        # Facts of the object, its resting poses, and the number of palm poses.
        return ObjectEntry(
            **{name: getattr(self.model, name) for name in _OF_MODEL},
            resting=resting,
            candidates=len(self.candidates),
            ended=len(self.candidates) < self.asked,
        )


def with_drawn(entry: ObjectEntry, drawn: ObjectEntry) -> ObjectEntry:
    """Return an object's entry in the manifest with the numbers of palm poses of another one."""
    return replace(entry, **{name: getattr(drawn, name) for name in _DRAWN})


def save_prepared(prepared: PreparedObject, out: Path, config: Config) -> None:
    """Write both files of an object; the plan is written last, with the hash of the other file.

    Args:
        prepared: The object.
        out: Directory of the dataset.
        config: Configuration of the dataset.
    """
    model, candidates = prepared.model, prepared.candidates
    sha256 = save_object(model, model_path(out, model.name))
    with atomic_hdf5(plan_path(out, model.name), sealed=True) as file:
        file.attrs["model_sha256"] = sha256
        file.attrs["config_hash"] = config.simulation_hash()
        file.attrs["mesh_sha256"] = model.mesh_sha256
        file.attrs["asked"] = prepared.asked
        arrays = {**vars(candidates), **vars(prepared), "X_TO": prepared.resting_poses}
        for name, dtype in {**_RESTING, **_PALMS}.items():
            file.create_dataset(name, data=arrays[name], dtype=dtype)
        if candidates.postures is not None:
            _save_postures(candidates.postures, file)


def _save_postures(postures: Table, file: h5py.File) -> None:
    """Write the columns of the postures; their preshapes are stored as JSON."""
    for name, dtype in _POSTURES.items():
        file.create_dataset(name, data=postures[name], dtype=dtype)
    texts = json.dumps(postures.preshape.tolist()).encode()
    file.create_dataset("preshape", data=np.frombuffer(texts, dtype=np.uint8))


def load_prepared(out: Path, name: str, config: Config) -> PreparedObject:
    """Return an object that `save_prepared` wrote.

    Raises:
        DataError: If its files are missing or damaged, or belong to another configuration.
        MeshError: If the file of its meshes has another version.
    """
    path = plan_path(out, name)

    # Both files must be unchanged, and belong to this configuration.
    with opened_sealed(path, "plan of an object") as (file, _):
        attributes = dict(file.attrs)
        resting, palms = ({name: file[name][:] for name in names} for names in (_RESTING, _PALMS))
        given = {name: file[name][:] for name in (*_POSTURES, "preshape") if name in file}
    content = read_model_file(out, name, str(attributes["model_sha256"]))
    due = config.simulation_hash()
    if attributes["config_hash"] != due:
        raise DataError(f"{path}: must be of configuration {due}, got {attributes['config_hash']}")
    return PreparedObject(
        model=load_object(model_path(out, name), content),
        resting_poses=resting.pop("X_TO"),
        **resting,
        candidates=Candidates(**palms, postures=_given_postures(given)),
        asked=int(attributes["asked"]),
    )


def _given_postures(arrays: dict[str, AnyArray]) -> Table | None:
    """Return the postures of a plan, or None if its palm poses come from samplers."""
    if not arrays:
        return None
    preshape = np.array(parse_json(arrays.pop("preshape").tobytes()), dtype=str)
    return Table({**arrays, "preshape": preshape})
