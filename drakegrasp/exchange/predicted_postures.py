"""Files of postures that were predicted for rows of a dataset.

In: a file of postures with `row`, and the split. Out: a `PostureTable` whose objects, resting poses
and cameras are those of the rows, and the rows.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.errors import GraspError
from drakegrasp.exchange.posture_files import named, read_rows
from drakegrasp.exchange.posture_rows import table_of
from drakegrasp.frames import unpack_pose
from drakegrasp.hand.description import load_hand
from drakegrasp.simulation.postures.table import PostureTable
from drakegrasp.verification.placed_grasp import choose_rows, dataset_config


def read_predicted_postures(
    path: Path, data: GraspDataset
) -> tuple[PostureTable, npt.NDArray[np.int64], Any]:
    """Return predicted postures, the row (n,) of each, and the stated confidence, None without.

    A posture is one of the object of its row, as it lies there; the frame "camera" is that of the
    row's camera. A posture that names another object is none.

    Args:
        path: As `posture_files.read_rows` reads it, with `row`, or one posture for each row of the
            split.
        data: The split.

    Raises:
        GraspError: If the file holds anything else; the message names it.
        ConfigError, HandError, DataError, MachineError: If dataset or hand cannot be used.
    """
    hand = load_hand(dataset_config(data).hand_source)
    with named(path):
        read = read_rows(path, hand)
        if read.X_TC is not None:
            raise GraspError("X_TC must be left out: the camera is that of the row; got it")
        rows = choose_rows(data, read.of_row, len(read.objects))

        # What the rows say of object and camera.
        objects = data.column("object_props/object_name")[rows].tolist()
        X_TC = unpack_pose(data.column(f"object_props/frame_work2cam_{data.camera}")[rows])
        other = [
            f"object must be that of row {row}, {true}, got {told}"
            if told not in ("", true)
            else ""
            for row, told, true in zip(rows.tolist(), read.objects, objects, strict=True)
        ]
        resting = data.column("grasp_props/resting")[rows]
        of_rows = replace(
            read,
            objects=objects,
            X_TC=X_TC if read.frame == "camera" else None,
            numbers={**read.numbers, "resting": resting},
        )
        return table_of(hand, of_rows).refuse(other), rows, read.confidence
