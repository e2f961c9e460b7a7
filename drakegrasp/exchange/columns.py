"""Files of arrays, as other programs write them, and the contacts or palm poses of some of them.

Input: a NumPy or HDF5 file. Output: its arrays as they are stored; or the grasps as k points and k
outward normals each, with dataset rows and confidence; or the predictions of GraspGen (github
NVlabs/GraspGen); or an error in one line. The meaning of arrays of postures is a matter of
`attempts`.

GraspGen's predictions are the HDF5 file that its `scripts/inference_graspgen.py` writes, with palm
poses without joints for many objects, and their confidence. They are poses of its gripper frame
(`graspgen` in a hand file) in the axes of the mesh file, in metres. Its demo writes isaac_grasp,
which `exchange.isaac_grasp` reads.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from drakegrasp.dataset.hdf5 import open_hdf5
from drakegrasp.errors import GraspError, first_line, one_line
from drakegrasp.foreign_files import read_npz, validate_regular
from drakegrasp.frames import Array, as_numbers
from drakegrasp.hand.description import Hand

#: Suffixes of HDF5 files, of all files of several arrays, and of files that can hold contacts.
HDF5_SUFFIXES = (".h5", ".hdf5")
ARRAYS, CONTACTS = (".npz", *HDF5_SUFFIXES), (".npy", *HDF5_SUFFIXES)
#: Maximum total size of the arrays of a file [bytes]: two million postures of a hand with 16
#: joints.
MOST_BYTES = 1_000_000_000
#: Advice for a file that holds poses instead of contacts.
_POSES = ": poses of the palm go with joints into a file of postures, as X_FG, object and q_grasp"
#: Names of the arrays of contacts in an HDF5 file.
GRASPS, ROWS, CONFIDENCE = NAMES = ("grasps", "rows", "confidence")


def array_names(path: Path) -> list[str]:
    """Return the names of the arrays of a file, of an HDF5 file those at its root."""
    if path.suffix.lower() in HDF5_SUFFIXES:
        with open_hdf5(path) as file:
            return list(file)
    return list(read_arrays(path))


def read_arrays(path: Path) -> dict[str, Any]:
    """Return the arrays of a NumPy file of several (.npz), or those at the root of an HDF5 file."""
    try:
        if path.suffix.lower() == ".npz":
            return read_npz(path, MOST_BYTES)
        with open_hdf5(path) as file:
            validate_size(sum(getattr(item, "nbytes", 0) for item in file.values()))
            return {name: _dataset(item) for name, item in file.items()}
    except Exception as error:  # parsers raise all kinds of exceptions on foreign bytes
        raise GraspError(f"must be a readable file of arrays, got: {one_line(error)}") from None


def _dataset(item: h5py.Dataset | h5py.Group) -> Any:
    if not isinstance(item, h5py.Dataset):
        raise GraspError(f"{item.name} must be a dataset, got a group")
    return item.asstr()[()] if h5py.check_string_dtype(item.dtype) else item[()]


def validate_size(size: int) -> None:
    """Reject arrays larger than any file of postures; a small file can unpack to terabytes."""
    if size > MOST_BYTES:
        raise GraspError(f"arrays must be at most {MOST_BYTES:.0e} bytes, got {size:.1e}")


def read_numbers(path: Path) -> Array:
    """Return the real numbers of a `.npy` file, of any shape. Pickled objects are not loaded.

    Args:
        path: Path of the file.

    Raises:
        GraspError: If the file cannot be read, or does not hold real numbers.
    """
    try:
        validate_regular(path)
        with path.open("rb") as file:
            array = np.lib.format.read_array(file, allow_pickle=False)
    # A damaged header may state any size, and then NumPy raises a MemoryError.
    except (OSError, EOFError, ValueError, TypeError, ArithmeticError, MemoryError) as error:
        raise GraspError(
            f"{path}: must be a .npy file of numbers, got none ({first_line(error)})"
        ) from None
    return as_numbers(array, f"{path}: must hold real numbers")


# Contacts


def read_contacts(path: Path, *, split: str | None = None, axes: int = 2) -> dict[str, Any]:
    """Return the `grasps`, `rows` and `confidence` of a file.

    The grasps are (n, m), or (n, j, m) for j grasps per row, with n at least 1. The rows (n,) are
    row numbers in a dataset's split. The confidence is returned as stored. Rows or confidence that
    the file does not have are None.

    Args:
        path: A `.npy` file, (n, m) or (m,); or an HDF5 file (`.h5`, `.hdf5`) with an array
            `grasps`, and optionally `rows` and `confidence`, all at the root or all in one group.
        split: Name of the group to read in an HDF5 file. If it is None or there is no such group,
            the root is read. If it is None and the root has no grasps, the only group with grasps
            is read.
        axes: Maximum number of axes of the array of grasps; 3 allows several grasps per row.

    Raises:
        GraspError: If the file cannot be read as one of these; the message names the file.
    """
    suffix, where = path.suffix.lower(), str(path)
    if suffix not in CONTACTS:
        *names, last = CONTACTS
        raise GraspError(f"{path}: must be a file {', '.join(names)} or {last}, got {suffix!r}")
    if not path.is_file():
        raise GraspError(f"{path}: must be a file of grasps, got none")
    try:
        if suffix == ".npy":
            arrays = {GRASPS: read_numbers(path)}
        else:
            with open_hdf5(path) as file:
                group = _choose_group(path, file, split)
                where = f"{path}: {group.name.rstrip('/')}"
                arrays = {n: group[n][()] for n in NAMES if isinstance(group.get(n), h5py.Dataset)}
    except GraspError:
        raise
    except Exception as error:  # parsers raise all kinds of exceptions on foreign bytes
        raise GraspError(
            f"{path}: must be a file of grasps, rows of equally many numbers by the name "
            f"{GRASPS!r}, got none ({first_line(error)})"
        ) from None

    # One row per grasp.
    name = f"{where}/{GRASPS}" if suffix in HDF5_SUFFIXES else where
    grasps = _grasps(as_numbers(arrays[GRASPS], f"{name}: must hold real numbers"), name, axes)
    rows = arrays.get(ROWS)
    if rows is not None:
        rows = np.asarray(rows)
        if rows.dtype.kind not in "iu" or rows.shape != (len(grasps),):
            raise GraspError(
                f"{where}/{ROWS} must hold one whole number for each of the {len(grasps)} grasps, "
                f"got {rows.dtype} of shape {rows.shape}"
            )
        rows = rows.astype(np.int64)
    return {GRASPS: grasps, ROWS: rows, CONFIDENCE: arrays.get(CONFIDENCE)}


def _choose_group(path: Path, file: h5py.File, split: str | None) -> h5py.Group:
    """Return the group of an HDF5 file from which to read the grasps; see `read_contacts`."""
    # Find all groups with grasps; the root has an empty name here.
    groups = {"": file} | {k: v for k, v in file.items() if isinstance(v, h5py.Group)}
    groups = {k: v for k, v in groups.items() if isinstance(v.get(GRASPS), h5py.Dataset)}
    for name in (split, ""):
        if name in groups:
            return groups[name]
    if split is None and len(groups) == 1:
        return next(iter(groups.values()))

    # No group has grasps, or several have them and none was chosen.
    must = f"in /{split} or at the root" if split else "at the root or in one group"
    got = ", ".join(f"/{name}" for name in groups)
    choose = "; choose with --split" if groups else ""
    raise GraspError(
        f"{path}: must hold an array {GRASPS!r} {must}, "
        f"got {f'them in {got}' if got else 'none'}{choose}"
    )


def _grasps(array: Array, where: str, axes: int) -> Array:
    """Return an array with one row per grasp; a single grasp (m,) becomes one row."""
    if array.size == 0:
        raise GraspError(f"{where}: must hold at least one grasp, got none")
    if not 1 <= array.ndim <= axes:
        raise GraspError(
            f"{where}: must be an array with a row per grasp, or one grasp, "
            f"got an array of shape {array.shape}{_POSES if array.shape[-2:] == (4, 4) else ''}"
        )
    return np.atleast_2d(array)


# Predictions of GraspGen


def is_graspgen(names: Iterable[str]) -> bool:
    """Return whether an HDF5 file with these names at its root holds predictions of GraspGen."""
    return {"misc", "objects"} <= set(names)


def read_graspgen(path: Path, hand: Hand) -> dict[str, Any] | None:
    """Return the predictions of GraspGen in a file as arguments of `make_attempts`.

    Returns:
        The arguments; None if the file does not hold such predictions.

    Raises:
        GraspError: If the file holds such predictions but is damaged.
    """
    with open_hdf5(path) as file:
        if not is_graspgen(file):
            return None
        groups = list[h5py.Group]()
        file["objects"].visititems(
            lambda _, item: groups.append(item) if "pred_grasps" in _names(item) else None
        )
        validate_size(sum(group["pred_grasps"].nbytes for group in groups))

        # What the groups of the objects and the file as a whole state.
        try:
            parts = [_predicted(group) for group in groups]
            gripper = file.get("misc/gripper_name")
            gripper = None if gripper is None else gripper.asstr()[()]
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise GraspError(
                f"{path}: objects must have asset_path, asset_scale, pred_grasps and confidence, "
                f"got others ({one_line(error)})"
            ) from None
    if not parts:
        raise GraspError(f"{path}: objects must have pred_grasps, got none")
    names, poses, scales, confidences = zip(*parts, strict=True)
    confidence = np.concatenate(confidences)
    return {
        "gripper": gripper,
        "objects": [name for each in names for name in each],
        "X_FG": np.concatenate(poses),
        "link": "graspgen",
        "frame": "mesh",
        "scale": np.concatenate(scales),
        "confidence": confidence,
        "said": [f"grasp {i}, confidence {stated:g}" for i, stated in enumerate(confidence)],
        "of_objects": True,
    }


def _names(item: object) -> list[str]:
    return list(item) if isinstance(item, h5py.Group) else []


def _predicted(group: h5py.Group) -> tuple[list[str], Array, Array, Array]:
    """Return object name, pose (4, 4), scale and confidence of each grasp of one object."""
    X_MA = as_numbers(group["pred_grasps"][()], "poses must be numbers")
    if X_MA.ndim != 3 or X_MA.shape[1:] != (4, 4):
        raise ValueError(f"poses must be of shape (n, 4, 4), got {X_MA.shape}")
    name = Path(group["asset_path"].asstr()[()]).stem
    confidence = as_numbers(group["confidence"][()], "confidence must be numbers")
    scale = np.full(len(X_MA), float(group["asset_scale"][()]))
    return [name] * len(X_MA), X_MA, scale, confidence.ravel()
