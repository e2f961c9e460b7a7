"""Objects at rest with their palm poses, and their files.

In: an object that `generation.prepare` made. Out: `objects/<name>.npz` with the object and
`objects/<name>.plan.h5` with its resting pose and palm poses, in the dataset's directory. Work
units, `check` and `replay` read these two files and do not need the mesh file.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from drakegrasp.config import Config
from drakegrasp.dataset.hdf5 import AnyArray
from drakegrasp.dataset.manifest import ObjectEntry, RestingEntry
from drakegrasp.dataset.opening import PLAN_TABLES, POSTURE_FIELDS, POSTURE_TEXTS, opened
from drakegrasp.dataset.paths import (
    model_file_sha256,
    model_path,
    plan_path,
    recorded_model,
    refuse_changed_model,
)
from drakegrasp.errors import DataError, one_line
from drakegrasp.foreign_files import parse_json
from drakegrasp.frames import Array
from drakegrasp.objects.model import ObjectModel, load_object, save_object
from drakegrasp.runtime.files import atomic_hdf5
from drakegrasp.simulation.candidates import Candidates
from drakegrasp.table import Table

#: What an object's entry in the manifest has of its model, and of its palm poses.
_OF_MODEL = (
    *("name", "class_name", "mesh_sha256", "scale", "up", "mass", "density", "friction"),
    *("collision_error", "notes"),
)
_COUNTS = ("combinations", "valid", "distinct")


@dataclass(frozen=True, kw_only=True, eq=False)
class PreparedObject:
    """An object that rests on the table, with the palm poses to try.

    Attributes:
        model: Meshes and mass properties.
        resting_poses: (r, 4, 4), resting poses X_TO; the first is the paper's.
        probability: (r,), share of the drops that ended in each.
        table_force: (r,), upward force of the table at rest [N].
        stopped: (r,) bool, whether the object would have rolled on and was stopped, see
            `settle.settle`.
        candidates: Palm poses and their rays.
    """

    model: ObjectModel
    resting_poses: Array
    probability: Array
    table_force: Array
    stopped: npt.NDArray[np.bool_]
    candidates: Candidates

    @property
    def X_TO(self) -> Array:
        """The first resting pose, (4, 4)."""
        return np.asarray(self.resting_poses[0])

    def entry(self) -> ObjectEntry:
        """Return the object's entry in the manifest."""
        columns = self.resting_poses, self.probability.tolist(), self.stopped.tolist()
        resting = tuple(
            RestingEntry(X_TO=tuple(X_TO[:3].ravel().tolist()), probability=share, rolled=rolled)
            for X_TO, share, rolled in zip(*columns, strict=True)
        )

        # What is known of the object, its poses at rest, and how many palm poses there are.
        return ObjectEntry(
            **{name: getattr(self.model, name) for name in _OF_MODEL},
            resting=resting,
            candidates=len(self.candidates),
            **{name: getattr(self.candidates, name) for name in _COUNTS},
        )


def save_prepared(prepared: PreparedObject, out: Path, config: Config) -> None:
    """Write both files of an object; the plan comes last, with the hash of the other file.

    Args:
        prepared: The object.
        out: Directory of the dataset.
        config: Configuration of the dataset.
    """
    model, candidates = prepared.model, prepared.candidates
    save_object(model, model_path(out, model.name))
    with atomic_hdf5(plan_path(out, model.name), sealed=True) as file:
        file.attrs["model_sha256"] = model_file_sha256(out, model.name)
        file.attrs["config_hash"] = config.simulation_hash()
        file.attrs["mesh_sha256"] = model.mesh_sha256
        file.attrs["max"] = config.candidates.max
        for name in _COUNTS:
            file.attrs[name] = getattr(candidates, name)
        arrays = {**vars(candidates), **vars(prepared), "X_TO": prepared.resting_poses}
        for field in chain(*PLAN_TABLES):
            file.create_dataset(field.name, data=arrays[field.name], dtype=field.dtype)
        if candidates.postures is not None:
            _save_postures(candidates.postures, file)


def _save_postures(postures: Table, file: h5py.File) -> None:
    """Write the arrays of postures; texts are JSON."""
    for field in (*POSTURE_FIELDS, *POSTURE_TEXTS):
        data = postures[field.name]
        if field.optional and not any(data.tolist()):
            continue
        if data.dtype.kind == "U":
            data = np.frombuffer(json.dumps(data.tolist()).encode(), dtype=np.uint8)
        file.create_dataset(field.name, data=data, dtype=field.dtype)


def load_prepared(out: Path, name: str, config: Config) -> PreparedObject:
    """Return an object as `save_prepared` wrote it.

    Raises:
        DataError: If its files are missing, damaged, of another configuration or of another
            number of palm poses.
        MeshError: If the file of its meshes is of another version.
    """
    path = plan_path(out, name)

    # Both files must be as they were written, and of this configuration.
    refuse_changed_model(out, name, recorded_model(out, name))
    with opened(path, "the plan of an object") as file:
        attributes = dict(file.attrs)
        resting, palms = ({f.name: file[f.name][:] for f in fields} for fields in PLAN_TABLES)
        names = [field.name for field in (*POSTURE_FIELDS, *POSTURE_TEXTS)]
        given = {name: file[name][:] for name in names if name in file}
    for key, of, due in (
        ("config_hash", "configuration", config.simulation_hash()),
        ("max", "candidates.max", config.candidates.max),
    ):
        if attributes[key] != due:
            raise DataError(f"{path}: must be of {of} {due}, got {attributes[key]}")
    counts: dict[str, Any] = {name: int(attributes[name]) for name in _COUNTS}
    return PreparedObject(
        model=load_object(model_path(out, name)),
        resting_poses=resting.pop("X_TO"),
        **resting,
        candidates=Candidates(
            **palms,
            **counts,
            postures=_given_postures(given, path),
        ),
    )


def _given_postures(arrays: dict[str, AnyArray], path: Path) -> Table | None:
    """Return the postures of a plan, or None if its palm poses come from samplers."""
    if not arrays:
        return None
    try:
        texts: dict[str, AnyArray] = {
            name: np.array(list(map(str, parse_json(arrays[name].tobytes()))), dtype=str)
            for name in ("said", "preshape")
            if name in arrays
        }
        nothing = np.full(len(arrays["row"]), "")
        return Table({"preshape": nothing, "said": texts["said"], **arrays, **texts})
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f"{path}: must hold postures, got none: {one_line(error)}") from None
