"""Bad files of predicted grasps, of cameras' poses, and of prepared objects."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from helpers.bad_inputs.hdf5_kinds import WAYS, dataset_kind
from helpers.bad_inputs.kinds import ANY_FILE, Kind

from drakegrasp.runtime.files import seal

#: Three contacts on the sides of a box, then their normals: a sound grasp.
GRASP = np.array([0.03, 0, 0, -0.03, 0, 0, 0, 0.025, 0, 1, 0, 0, -1, 0, 0, 0, 1, 0.0])
#: Two of them for the first rows of a split.
ROWS = {"grasps": np.tile(GRASP, (2, 1)), "rows": np.arange(2)}


def _npy(name: str, array: Any) -> Kind:
    """Return a kind whose file holds an array, pickled if it must be."""
    return Kind(name, lambda path: np.save(path, np.asarray(array), allow_pickle=True))


PREDICTIONS_NPY: tuple[Kind, ...] = (
    *ANY_FILE,
    _npy("without columns", np.zeros((3, 0))),
    _npy("17 numbers", GRASP[:17]),
    _npy("a column per grasp", np.asfortranarray(np.tile(GRASP, (3, 1)).T)),
    _npy("pairs", np.zeros(18, dtype=[("a", "f8")])),
    _npy("objects", np.array([None] * 18, dtype=object)),
)


def _predictions_hdf5(name: str, edit: Callable[[h5py.File], object]) -> Kind:
    def spoil(path: Path) -> None:
        with h5py.File(path, "r+") as file:
            edit(file)

    return Kind(name, spoil)


def _instead(key: str, value: Any) -> Callable[[h5py.File], None]:
    def edit(file: h5py.File) -> None:
        del file[key]
        file[key] = value

    return edit


def _grouped(file: h5py.File) -> None:
    for name in ("a", "b"):
        file[f"{name}/grasps"] = file["grasps"][:]
    del file["grasps"]


def _beyond(file: h5py.File) -> None:
    del file["grasps"]
    file.create_dataset("grasps", shape=(2**40, 18), dtype="f8", chunks=(1, 18))


PREDICTIONS_HDF5: tuple[Kind, ...] = (
    *ANY_FILE,
    Kind("no array", lambda path: h5py.File(path, "w").close()),
    *(
        Kind(f"grasps {way}", dataset_kind("grasps", way).spoil)
        for way in WAYS
        if way not in ("of another type", "one row less", "one row more")
    ),
    *(Kind(f"rows {way}", dataset_kind("rows", way).spoil) for way in WAYS if way != "missing"),
    _predictions_hdf5("rows that do not exist", _instead("rows", np.array([0, 99]))),
    _predictions_hdf5("rows below zero", _instead("rows", np.array([0, -1]))),
    _predictions_hdf5("rows beyond 64 bits", _instead("rows", np.full(2, 2**64 - 1, np.uint64))),
    _predictions_hdf5("rows that are a group", _instead("rows", 1)),
    _predictions_hdf5("grasps in two groups", _grouped),
    _predictions_hdf5("grasps beyond memory", _beyond),
    _predictions_hdf5("17 numbers", _instead("grasps", np.zeros((2, 17)))),
    _predictions_hdf5("a null space", _instead("grasps", h5py.Empty("f8"))),
)


def _npz(name: str, edit: Callable[[dict[str, Any]], object]) -> Kind:
    """Return a kind of a prepared object, vouched for by its plan as whoever spoils it can."""

    def spoil(path: Path) -> None:
        with np.load(path, allow_pickle=False) as content:
            values = dict(content)
        edit(values)
        buffer = io.BytesIO()
        np.savez(buffer, **values)
        path.write_bytes(buffer.getvalue())
        _vouch(path)

    return Kind(name, spoil)


def _vouch(path: Path) -> None:
    plan = path.with_suffix(".plan.h5")
    with h5py.File(plan, "r+") as file:
        file.attrs["model_sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
    seal(plan)


def _vouched(kind: Kind) -> Kind:
    def spoil(path: Path) -> None:
        kind.spoil(path)
        _vouch(path)

    return Kind(f"{kind.name}, vouched for", spoil)


def _put(key: str, value: Any) -> Callable[[dict[str, Any]], None]:
    return lambda values: values.__setitem__(key, np.asarray(value))


_NOT_OBJECTS = ("a directory", "a link to itself")
MODEL: tuple[Kind, ...] = (
    *ANY_FILE,
    *(_vouched(kind) for kind in ANY_FILE if kind.name not in _NOT_OBJECTS),
    *(
        _npz(f"{key} missing", lambda values, k=key: values.pop(k))
        for key in ("name", "mass", "visual_vertices", "visual_faces", "notes", "friction", "up")
    ),
    *(
        _npz(f"{key} {name}", _put(key, value))
        for key, name, value in (
            ("name", "is a number", 5),
            ("name", "leads outside", "../../outside"),
            ("mass", "is a text", "x"),
            ("mass", "is zero", 0.0),
            ("mass", "are two", [1.0, 2.0]),
            ("up", "is no axis", "north"),
            ("friction", "are two", [1.0, 2.0]),
            ("notes", "is a number", 5),
            ("visual_vertices", "is empty", np.zeros((0, 3))),
            ("visual_vertices", "is NaN", np.full((8, 3), np.nan)),
            ("visual_vertices", "of two axes", np.zeros((8, 2))),
            ("visual_faces", "after the last vertex", np.full((12, 3), 99, np.int32)),
            ("visual_faces", "of fractions", np.full((12, 3), 0.5)),
            ("collision_faces", "after the last vertex", np.full((12, 3), 99_999, np.int32)),
            ("p_OOcm", "is NaN", np.full(3, np.nan)),
            ("I_OOcm_O", "is NaN", np.full((3, 3), np.nan)),
            ("I_OOcm_O", "of zeros", np.zeros((3, 3))),
        )
    ),
)
