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
from drakegrasp.errors import GraspError
from drakegrasp.frames import Array, invert_pose
from drakegrasp.hand.description import load_hand
from drakegrasp.simulation.placement import PlacedObject, canonical_pose, place_object
from drakegrasp.simulation.postures.posture import Posture
from drakegrasp.simulation.postures.table import (
    CONDITIONS,
    UNTOLD,
    PostureTable,
    misfits,
    unknown_objects,
)
from drakegrasp.simulation.settle import find_resting_poses
from drakegrasp.verification.hints import known_frames
from drakegrasp.verification.placed_grasp import (
    CAMERA,
    as_drawn,
    cameras_of_rows,
    choose_rows,
    dataset_config,
    objects_of_rows,
    overridden_keys,
    with_friction,
    with_mass,
)
from drakegrasp.verification.verify import PlacedGrasp

#: Poses of an object at rest that differ by less are one: what is left of rounding in a file.
SAME_POSE = 1e-6


def place_postures_on_object(
    table: PostureTable, placed: PlacedObject, *, overrides: Sequence[str] = ()
) -> list[PlacedGrasp]:
    """Return the postures of a table on one object, whatever they call it.

    Args:
        table: The postures.
        placed: The object as it is dropped; its other resting poses are those of a build.
        overrides: What the caller sets, which is stronger than the conditions of a posture.

    Raises:
        GraspError: If they are in the frame of a mesh file.
    """
    named = replace(table, objects=(placed.model.name,) * len(table))
    things, config = [placed], placed.config
    if config.objects.resting_poses > 1:
        others = find_resting_poses(placed.model, config)[1:]
        things += [replace(placed, X_TO=resting.X_TO) for resting in others]
    return _placed(named, range(len(table)), things, config, overrides)


def place_postures_on_dataset(
    table: PostureTable,
    out: Path,
    config: Config | None = None,
    *,
    overrides: Sequence[str] = (),
) -> list[PlacedGrasp]:
    """Return the postures of a table on the objects of a dataset that they name.

    Args:
        table: The postures.
        out: Directory of the dataset.
        config: By which they are tried; that of each object if None.
        overrides: What the caller sets, which is stronger than the conditions of a posture.

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
        placed += _placed(table, rows, things, config or own, overrides)
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
    table = replace(
        table,
        resting=np.zeros_like(table.resting),
        X_TO=np.full_like(table.X_TO, np.nan),
        conditions=np.full_like(table.conditions, np.nan),
    )
    for thing, indices in objects_of_rows(dataset, chosen):
        named = replace(table, objects=(thing.model.name,) * len(table))
        placed += _placed(named, indices.tolist(), [thing], config, cameras=cameras)
    return as_drawn(placed, dataset, chosen, overrides)


def _placed(
    table: PostureTable,
    rows: Sequence[int],
    things: Sequence[PlacedObject],
    config: Config,
    overrides: Sequence[str] = (),
    cameras: Mapping[str, Array] | None = None,
) -> list[PlacedGrasp]:
    """Return some rows of a table on one object, which is there in each of its resting poses.

    `cameras` are poses X_TC (n, 4, 4) for the rows of the table, by their frames.
    """
    # The cameras that are known, and what no posture has.
    model, found = things[0].model, list[PlacedGrasp]()
    known_cameras = dict(cameras or {})
    if table.X_TC is not None:
        known_cameras[CAMERA] = table.X_TC

    # A row that tells how the object lies is tried so, whether or not it was dropped so.
    anywhere = replace(table, X_TO=np.full_like(table.X_TO, np.nan))
    poses = np.array([thing.X_TO for thing in things])
    table = table.refuse(misfits(anywhere, model.name, model.scale, poses))
    nothing = np.full((load_hand(config.hand_source).num_fingers, 3), np.nan)
    stands, known = _Stands(things), overridden_keys(overrides)
    for i in rows:
        tried, used, reason = list[tuple[PlacedObject, Posture]](), config, table.invalid[i]
        if not reason:
            try:
                for thing in stands.of(table, i):
                    posture = table.posture(i, thing.X_TO)
                    told, used = stands.under(thing, config, table.conditions[i], known)
                    tried.append((told, posture))
            except GraspError as error:
                if table.frame == "mesh":
                    raise
                tried, reason = [], str(error)
        first = tried[0][1] if tried else None
        stood = tried[0][0] if tried else things[0]
        own = {name: X_TC[i] for name, X_TC in known_cameras.items()}
        found.append(
            PlacedGrasp(
                index=i,
                placed=stood,
                p_OQ=nothing,
                nhat_Q_O=nothing,
                method="posture",
                config=used,
                invalid=reason,
                posture=first,
                others=tuple(tried[1:]),
                X_OA=None if first is None else first.X_OG @ invert_pose(table.X_FG[i]),
                frames=known_frames(stood.X_TO, own),
            )
        )
    return found


class _Stands:
    """An object in its resting poses, and as rows tell: one `PlacedObject` for all equal ones."""

    def __init__(self, things: Sequence[PlacedObject]) -> None:
        self._dropped, self._told = list(things), list[PlacedObject]()
        self._known: dict[tuple[int, bytes], tuple[PlacedObject, Config]] = {}

    def of(self, table: PostureTable, i: int) -> list[PlacedObject]:
        """Return the object as a row may be for it.

        Raises:
            GraspError: If the row tells a pose in which it does not stand on the table.
        """
        X_TO = table.X_TO[i]
        if np.isnan(X_TO).any():
            named = int(table.resting[i])
            return self._dropped if named == UNTOLD else [self._dropped[named]]
        stood = canonical_pose(X_TO)
        for thing in (*self._dropped, *self._told):
            if np.abs(thing.X_TO_simulated - stood).max() < SAME_POSE:
                return [thing]
        self._told.append(place_object(self._dropped[0], X_TO=X_TO))
        return self._told[-1:]

    def under(
        self, thing: PlacedObject, config: Config, conditions: Array, overridden: set[str]
    ) -> tuple[PlacedObject, Config]:
        """Return the object and the configuration under the conditions of a row."""
        key = (id(thing), conditions.tobytes())
        if key not in self._known:
            told = dict(zip(CONDITIONS, conditions.tolist(), strict=True))
            mass, placed, own = told.pop("mass"), thing, thing.model.friction
            if np.isfinite(list(told.values())).any():
                frictions = {n: v if np.isfinite(v) else own for n, v in told.items()}
                used = {
                    name: value
                    for name, value in frictions.items()
                    if value is not None and f"physics.{name}" not in overridden
                }
                placed, config = with_friction(placed, config, used)
            if np.isfinite(mass) and "objects.mass" not in overridden and mass != thing.model.mass:
                placed = with_mass(placed, mass)
            self._known[key] = placed, config
        return self._known[key]
