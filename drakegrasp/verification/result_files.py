"""Verification results as lines of JSON and as an HDF5 file.

Input: `Verification`s in the order of the caller's grasps. Output: one object of strict JSON per
line, and an HDF5 file, both with the fields `schema.VERIFICATION_FIELDS`. Equal results give equal
HDF5 files, because only the JSON contains wall-clock times.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from drakegrasp.config import Config
from drakegrasp.dataset.hdf5 import AnyArray, write_field
from drakegrasp.dataset.manifest import finger_names, installed_versions, origin_attributes
from drakegrasp.dataset.reader import PredictedRows
from drakegrasp.dataset.schema import VERIFICATION_FIELDS, Field, sizes
from drakegrasp.errors import DataError
from drakegrasp.filters import Removal
from drakegrasp.frames import pack_pose
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.parsing import position_order
from drakegrasp.outcomes import Outcome
from drakegrasp.runtime.files import atomic_hdf5, probe_folder
from drakegrasp.verification.result import Verification

#: Group of the HDF5 file that holds the fields.
GROUP = "grasps"
#: Significant digits of the numbers in JSON: a micrometre in a metre.
DIGITS = 6


def validate_writable(out: Path) -> None:
    """Reject a file that cannot be written; no file is left behind.

    Raises:
        DataError: If it is a folder, or the folder of the file cannot be written (if it does not
            exist: the first existing folder above it).
    """
    if out.is_dir():
        raise DataError(f"{out}: must be a file, got a folder; choose another --out")

    # Find the first existing folder above the file.
    folder = out.absolute().parent
    while not os.path.lexists(folder):
        folder = folder.parent
    try:
        probe_folder(folder)
    except OSError:
        raise DataError(
            f"{out}: must be in a folder that can be written, got {folder}; choose another --out"
        ) from None


def json_line(index: int, result: Verification) -> str:
    """Return a verdict as a line of strict JSON; NaN and infinity become null.

    Keys are those of the HDF5 fields, and what only people and logs need.

    Args:
        index: Index of the grasp.
        result: The verdict on the grasp.
    """
    values = {field.name: field.value_of(result) for field in VERIFICATION_FIELDS}
    line = {
        "index": index,
        **values,
        "unjudged": result.unjudged if result.removal is not None else (),
        "outcomes": [each.trial.outcome for each in result.tries],
        "explain": result.explain(),
        "seconds": result.seconds,
    }
    return json.dumps(_plain(line), ensure_ascii=False, allow_nan=False)


def _plain(value: Any) -> Any:
    """Return a value converted to types of strict JSON; outcomes and removals by their names."""
    if isinstance(value, Outcome | Removal):
        return value.label
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float):
        # Adding zero turns -0.0 into 0.0.
        return float(f"{value:.{DIGITS}g}") + 0.0 if math.isfinite(value) else None
    return value


def write_results(
    results: Sequence[Verification],
    path: Path,
    config: Config,
    rows: PredictedRows | None = None,
) -> None:
    """Write results to an HDF5 file, which appears complete or not at all.

    Args:
        results: The results, in the order of the grasps.
        path: The file.
        config: Configuration of the verification.
        rows: Rows of the dataset that the grasps are for, in the same order; None without a
            dataset.

    Raises:
        OSError: If the disk is full or the folder cannot be written.
    """
    hand = load_hand(config.hand_source)
    shape = sizes(fingers=hand.num_fingers, joints=len(hand.joint_names), image=0)
    with atomic_hdf5(path) as file:
        versions, fingers = installed_versions(config), finger_names(config)
        joints = position_order(hand.model, hand.palm_link)
        origin = origin_attributes(config, versions, fingers, joints)
        file.attrs.update(origin)
        group = file.create_group(GROUP)
        for field in VERIFICATION_FIELDS:
            write_field(group, field, _column(field, results, shape))
        if rows is not None:
            rows.write(file)


def _column(field: Field, results: Sequence[Verification], shape: dict[str, int]) -> AnyArray:
    """Return the values of a field for all results; empty values for stages not reached."""
    if field.dtype == "str":
        return np.array([field.value_of(result) for result in results], dtype=object)
    column = field.empty(len(results), shape)
    for i, result in enumerate(results):
        value = field.value_of(result)
        if value is not None:
            column[i] = pack_pose(value) if field.shape == "12" else value
    return column
