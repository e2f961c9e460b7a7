"""Postures that a caller asks to be verified: each in {O} of its object on the table.

In: a table of postures, with an object, with the objects of a dataset, or with rows of one. Out: a
`PlacedGrasp` for each row of the table, in their order but for objects; a row that is no posture is
an invalid grasp.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from drakegrasp.config import Config
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.prepared_objects import load_prepared
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.frames import Array, invert_pose
from drakegrasp.hand.description import load_hand
from drakegrasp.simulation.placement import PlacedObject
from drakegrasp.simulation.postures.table import PostureTable, misfits, unknown_objects
from drakegrasp.verification.hints import known_frames
from drakegrasp.verification.placed_grasp import (
    CAMERA,
    as_drawn,
    cameras_of_rows,
    choose_rows,
    dataset_config,
    objects_of_rows,
)
from drakegrasp.verification.verify import PlacedGrasp


def place_postures_on_object(table: PostureTable, placed: PlacedObject) -> list[PlacedGrasp]:
    """Return the postures of a table on one object, whatever they call it.

    Raises:
        GraspError: If they are in the frame of a mesh file.
    """
    named = replace(table, objects=(placed.model.name,) * len(table))
    return _placed(named, range(len(table)), [placed], placed.config)


def place_postures_on_dataset(
    table: PostureTable, out: Path, config: Config | None = None
) -> list[PlacedGrasp]:
    """Return the postures of a table on the objects of a dataset that they name.

    Args:
        table: The postures.
        out: Directory of the dataset.
        config: By which they are tried; that of each object if None.

    Raises:
        GraspError: If they are in the frames of mesh files.
        DataError: If the dataset cannot be used.
    """
    manifest, placed = read_manifest(out), list[PlacedGrasp]()
    names = [entry.name for entry in manifest.objects]
    table = table.refuse(unknown_objects(table, names))
    for name in dict.fromkeys(table.objects):
        # An object that is not there is known by its name alone.
        there = name if name in names else names[0]
        own = manifest.config_of(there)
        prepared = load_prepared(out, there, own)
        things = [
            PlacedObject(model=prepared.model, X_TO=X_TO, config=own)
            for X_TO in prepared.resting_poses
        ]
        if name != there:
            nobody = replace(prepared.model, name=name)
            things = [PlacedObject(model=nobody, X_TO=np.full((4, 4), np.nan), config=own)]
        rows = [i for i, each in enumerate(table.objects) if each == name]
        placed += _placed(table, rows, things, config or own)
    return placed


def place_postures_on_rows(
    table: PostureTable,
    dataset: GraspDataset,
    rows: Sequence[int],
    *,
    overrides: tuple[str, ...] = (),
) -> list[PlacedGrasp]:
    """Return postures on the objects of a dataset's rows, with the friction and mass drawn there.

    Args:
        table: The postures, whose own objects and resting poses do not count.
        dataset: The data file.
        rows: (n,), the row of its split for each.
        overrides: As for `place_on_rows`.

    Raises:
        GraspError: If a row does not exist, or the postures are in the frames of mesh files.
        ConfigError, HandError, DataError: As `dataset_config`.
    """
    config, chosen = (
        dataset_config(dataset, overrides=overrides),
        choose_rows(dataset, rows, len(table)),
    )
    placed, cameras = list[PlacedGrasp](), cameras_of_rows(dataset, chosen)
    table = replace(table, resting=np.zeros_like(table.resting))
    for thing, indices in objects_of_rows(dataset, chosen):
        named = replace(table, objects=(thing.model.name,) * len(table))
        placed += _placed(named, indices.tolist(), [thing], config, cameras)
    return as_drawn(placed, dataset, chosen, overrides)


def _placed(
    table: PostureTable,
    rows: Sequence[int],
    things: Sequence[PlacedObject],
    config: Config,
    cameras: Mapping[str, Array] | None = None,
) -> list[PlacedGrasp]:
    """Return some rows of a table on one object, which is there in each of its resting poses.

    `cameras` are poses X_TC (n, 4, 4) for the rows of the table, by their frames.
    """
    # The cameras that are known, and what no posture has.
    model, found = things[0].model, list[PlacedGrasp]()
    table = table.refuse(misfits(table, model.name, model.scale, len(things)))
    known = dict(cameras or {})
    if table.X_TC is not None:
        known[CAMERA] = table.X_TC
    nothing = np.full((load_hand(config.hand_source).num_fingers, 3), np.nan)

    for i in rows:
        reason = table.invalid[i]
        thing = things[0 if reason else int(table.resting[i])]
        posture = None if reason else table.posture(i, thing.X_TO)
        own = {name: X_TC[i] for name, X_TC in known.items()}
        found.append(
            PlacedGrasp(
                index=i,
                placed=thing,
                p_OQ=nothing,
                nhat_Q_O=nothing,
                method="posture",
                config=config,
                invalid=reason,
                posture=posture,
                X_OA=None if posture is None else posture.X_OG @ invert_pose(table.X_FG[i]),
                frames=known_frames(thing.X_TO, own),
            )
        )
    return found
