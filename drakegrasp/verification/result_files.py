"""Files of verification results: JSON lines and HDF5.

Input: `Verification`s in the order of the caller's grasps. Output: a file with one object of strict
JSON per line, and an HDF5 file with the fields `schema.VERIFICATION_FIELDS`. Equal results give
equal HDF5 files, because only the JSON contains wall-clock times.
"""

from __future__ import annotations

import json
import math
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from drakegrasp.config import Config
from drakegrasp.dataset.hdf5 import AnyArray, write_field
from drakegrasp.dataset.manifest import finger_names, installed_versions, origin_attributes
from drakegrasp.dataset.reader import PredictedRows
from drakegrasp.dataset.schema import VERIFICATION_FIELDS, Field, sizes
from drakegrasp.errors import DataError
from drakegrasp.frames import pack_pose
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.parsing import position_order
from drakegrasp.runtime.files import atomic_hdf5, probe_folder, sync_and_rename
from drakegrasp.simulation.lift import Lift
from drakegrasp.simulation.trial import Closed
from drakegrasp.verification.result import Verification

#: Group of the HDF5 file that holds the fields.
GROUP = "grasps"
#: Suffixes of the two files, and suffixes that a caller may append to their common name.
JSON_SUFFIX, HDF5_SUFFIX = ".jsonl", ".h5"
_KNOWN_SUFFIXES = (JSON_SUFFIX, HDF5_SUFFIX, ".hdf5", ".json")
#: Significant digits of the numbers in JSON: a micrometre in a metre.
DIGITS = 6


def result_paths(out: Path) -> tuple[Path, Path]:
    """Return the paths of the JSON lines and of the HDF5 file for a common name."""
    stem = out.with_suffix("") if out.suffix.lower() in _KNOWN_SUFFIXES else out
    return stem.with_name(stem.name + JSON_SUFFIX), stem.with_name(stem.name + HDF5_SUFFIX)


def refuse_unwritable(out: Path) -> None:
    """Reject a common name under which the files cannot be written, see `result_paths`.

    Raises:
        DataError: See `refuse_unwritable_files`.
    """
    if out.is_dir():
        raise DataError(f"{out}: must be a name for files, got a folder; choose another --out")
    refuse_unwritable_files(out, *result_paths(out), part_path(out))


def refuse_unwritable_files(out: Path, *others: Path) -> None:
    """Reject a file that cannot be written, or others in its folder; no file is left behind.

    Raises:
        DataError: If a folder has the name of one of the files, or the folder of the files cannot
            be written (if it does not exist: the first existing folder above it).
    """
    for path in (out, *others):
        if path.is_dir():
            raise DataError(f"{path}: must be a file, got a folder; choose another --out")

    # Find the first existing folder above the files.
    folder = out.absolute().parent
    while not os.path.lexists(folder):
        folder = folder.parent
    if not (folder.is_dir() and _is_writable(folder)):
        raise DataError(
            f"{out}: must be in a folder that can be written, got {folder}; choose another --out"
        )


def _is_writable(folder: Path) -> bool:
    """Return whether a file can be created in a folder."""
    try:
        probe_folder(folder)
    except OSError:
        return False
    return True


# JSON


@contextmanager
def text_lines(out: Path | None, *, echo: bool = False) -> Iterator[Callable[[str], None]]:
    """Yield a function that writes the next line of NAME.jsonl, and flushes it.

    Until the block ends, the lines are in NAME.part.jsonl; they stay there if the block raises. No
    file is created before the first line.

    Args:
        out: The common name of the files, see `result_paths`; None for standard output.
        echo: Whether the lines of a file are also written to standard output.

    Raises:
        OSError: If the disk is full or the folder cannot be written.
    """
    streams = [sys.stdout] if echo or out is None else []
    with ExitStack() as stack:
        opened = list[TextIO]()

        def write(line: str) -> None:
            if out is not None and not opened:
                part_path(out).parent.mkdir(parents=True, exist_ok=True)
                opened.append(stack.enter_context(part_path(out).open("w", encoding="utf-8")))
            for stream in (*opened, *streams):
                stream.write(line + "\n")
                stream.flush()

        yield write
    if out is not None and opened:
        # Do not use `atomic_path`: the lines of a run that is stopped must stay.
        sync_and_rename(part_path(out), result_paths(out)[0])


def part_path(out: Path) -> Path:
    """Return the path of the JSON lines while they are incomplete, for a common name."""
    lines, _ = result_paths(out)
    return lines.with_suffix(f".part{JSON_SUFFIX}")


def json_line(index: int, result: Verification) -> str:
    """Return a verdict as a line of strict JSON; NaN and infinity become null.

    Keys that are also HDF5 fields have the same meaning there.

    Args:
        index: Index of the grasp.
        result: The verdict on the grasp.
    """
    fit, trial, forces = result.fit, result.trial, result.forces
    values = {field.name: field.value_of(result) for field in VERIFICATION_FIELDS}

    def fields(*names: str) -> dict[str, Any]:
        return {name: values[name] for name in names}

    def degrees(name: str) -> Any:
        return None if values[name] is None else np.rad2deg(values[name])

    # The order is for human readers: verdict, contacts, hand, lift, margin.
    line = {
        "index": index,
        **fields("object", "method", "success", "held", "precision", "stable", "sample"),
        "removal": None if result.removal is None else result.removal.label,
        "unjudged": [] if result.removal is None else [each.label for each in result.unjudged],
        "outcome": result.outcome.label,
        "reason": result.reason,
        "explain": result.explain(),
        "hints": list(result.hints),
        **fields("confidence"),
        "rank": None if result.rank < 0 else result.rank,
        **fields("held_any", "tries"),
        "outcomes": [each.trial.outcome.label for each in result.tries],
        **fields("X_TO", "p_OQ", "nhat_Q_O", "normalised", "snapped", "surface_distance"),
        **fields("X_OG", "spread", "closing", "fit_residual"),
        "fit_normal_error_deg": degrees("fit_normal_error"),
        **fields("contact_error"),
        "normal_error_deg": degrees("normal_error"),
        "solver": None if fit is None else _attributes(fit, "status", "message", "iterations"),
        "closed": None if trial is None else _end_as_dict(trial.closed),
        "lifted": None if trial is None else _end_as_dict(trial.lift),
        "slip": values["slip"],
        "turn_deg": degrees("turn"),
        **fields("epsilon", "smallest_friction"),
        # A null above is either infinity or not computed; this key distinguishes them.
        "friction_can_hold": None
        if math.isnan(result.smallest_friction)
        else math.isfinite(result.smallest_friction),
        "forces": None
        if forces is None
        else {
            **fields("planned_force", "planned_share", "points_share", "patches_share"),
            **fields("selected_p_OQ", "selected_nhat_Q_O", "selected_distance"),
            "selected_inside": forces.contacts.inside,
            "selected_angle_deg": np.rad2deg(forces.contacts.angle),
        },
        "seconds": result.seconds,
    }
    return json.dumps(_plain(line), ensure_ascii=False, allow_nan=False)


def _attributes(source: object, *names: str) -> dict[str, Any]:
    return {name: getattr(source, name) for name in names}


def _end_as_dict(stage: Closed | Lift | None) -> dict[str, Any] | None:
    """Return the JSON object of the contacts and joint positions at the end of a stage."""
    if stage is None:
        return None
    names = ("touching", "p_OQ", "nhat_Q_O", "f_Q_O", "other_links", "hand_on_table")
    return {**_attributes(stage.contacts, *names, "object_on_table"), "q": stage.q}


def _plain(value: Any) -> Any:
    """Return a value converted to types of strict JSON."""
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


# HDF5


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
