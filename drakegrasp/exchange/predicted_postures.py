"""Files of postures that were predicted for rows of a dataset.

In: a file of postures with `row`, or samples of the dataset that were exported, and the split. Out:
a `PostureTable` whose objects and cameras are those of the rows, and the rows.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.errors import GraspError
from drakegrasp.exchange.posture_files import files_in, named, read_rows
from drakegrasp.exchange.posture_rows import Rows, table_of
from drakegrasp.frames import unpack_pose
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.simulation.posture_table import PostureTable, join_tables
from drakegrasp.verification.placing import choose_rows, dataset_config


def read_predicted_postures(
    path: Path, data: GraspDataset
) -> tuple[PostureTable, npt.NDArray[np.int64], Any]:
    """Return predicted postures, the row (n,) of each, and the stated confidence, None without.

    A posture is one of the object of its row, as it lies there; the frame "camera" is that of the
    row's camera. A posture that names another object is none.

    Args:
        path: As `posture_files.read_rows` reads it, with `row`, or one posture for each row of the
            split; or a file or a folder of exported samples, of which those of the split count.
        data: The split.

    Raises:
        GraspError: If the file holds anything else; the message names it.
        ConfigError, HandError, DataError, MachineError: If dataset or hand cannot be used.
    """
    hand = load_hand(dataset_config(data).hand_source)
    files = files_in(path) if path.is_dir() else [path]
    tables, rows, confidence = list[PostureTable](), list[npt.NDArray[np.int64]](), None
    for each in files:
        with named(each):
            read = _of_split(read_rows(each, hand, nameless=True), data)
            if len(read.objects):
                table, chosen = _on_rows(read, data, hand)
                tables.append(table)
                rows.append(chosen)
                confidence = read.confidence
    if not tables:
        raise GraspError(
            f"{path}: samples must be of {data.split} in {data.path.name} (--split), got none"
        )
    return join_tables(tables), np.concatenate(rows), confidence if len(files) == 1 else None


def _of_split(read: Rows, data: GraspDataset) -> Rows:
    """Return exported samples that are of the split, with their rows; other postures as they are.

    The trial of a sample says which row it is.
    """
    if read.of_row is not None or read.of_trial is None:
        return read
    rows = {trial: row for row, trial in enumerate(data.column("trial_id").tolist())}
    there = [i for i, trial in enumerate(read.of_trial.tolist()) if trial in rows]
    known = read.at(there)
    return replace(known, of_row=np.array([rows[int(read.of_trial[i])] for i in there], np.int64))


def _on_rows(
    read: Rows, data: GraspDataset, hand: Hand
) -> tuple[PostureTable, npt.NDArray[np.int64]]:
    """Return the postures of a file on their rows, and the rows."""
    if read.X_TC is not None:
        raise GraspError("X_TC must be left out: the camera is that of the row; got it")
    rows = choose_rows(data, read.of_row, len(read.objects))

    # What the rows say of object and camera.
    objects = data.column("object_props/object_name")[rows].tolist()
    X_TC = unpack_pose(data.column(f"object_props/frame_work2cam_{data.camera}")[rows])
    other = [
        f"object must be that of row {row}, {true}, got {told}" if told not in ("", true) else ""
        for row, told, true in zip(rows.tolist(), read.objects, objects, strict=True)
    ]
    camera = X_TC if read.frame == "camera" else None
    of_rows = replace(read, objects=objects, X_TC=camera)
    return table_of(hand, of_rows).refuse(other), rows
