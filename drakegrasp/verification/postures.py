"""Tables of grasps on their objects: postures, and contacts by way of `placing`.

Input: a table of contacts or of postures, with an object, with rows of a dataset, or with a dataset
whose objects the postures name. Output: a `PlacedGrasp` for each row. A bad row keeps the reason.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from drakegrasp.config import Config
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.errors import GraspError
from drakegrasp.hand.description import load_hand
from drakegrasp.simulation.attempts import (
    UNTOLD,
    Attempts,
    GraspRows,
    misfits,
    unknown_objects,
)
from drakegrasp.simulation.placement import PlacedObject, canonical_pose, place_object
from drakegrasp.simulation.settle import find_resting_poses
from drakegrasp.verification.placing import (
    PlacedGrasp,
    contacts_on_object,
    contacts_on_rows,
    objects_of_rows,
    overridden_keys,
    resting_objects,
    stated,
    under,
)
from drakegrasp.verification.prediction import ContactRows, RowChoice, choose_rows

#: Poses of an object at rest that differ by less than this are equal; a file has rounding errors.
SAME_POSE = 1e-6


def place_on_object(
    table: GraspRows, placed: PlacedObject, *, overrides: Sequence[str] = (), **how: Any
) -> list[PlacedGrasp]:
    """Return the rows of a table on one object, in their order.

    Postures are tried on this object, whatever object name they give. Postures that name no resting
    pose are tried in all resting poses of a build.

    Args:
        table: The grasps.
        placed: The object.
        overrides: Settings of the caller; they take precedence over the conditions of a posture.
        how: For contacts, see `contacts_on_object`.

    Raises:
        GraspError: As `drakegrasp.verify_grasps`.
    """
    if isinstance(table, ContactRows):
        return contacts_on_object(table, placed, **how)
    assert isinstance(table, Attempts)
    stands, config = [placed], placed.config
    if config.objects.resting_poses > 1:
        others = find_resting_poses(placed.model, config)[1:]
        stands += [replace(placed, X_TO=resting.X_TO) for resting in others]
    table = replace(table, objects=(placed.model.name,) * len(table))
    return _on_stands(table, range(len(table)), stands, config, overridden_keys(overrides))


def place_on_rows(
    table: GraspRows,
    dataset: GraspDataset,
    rows: RowChoice = None,
    *,
    config: Config,
    drawn: bool = True,
    overrides: Sequence[str] = (),
    frame: str = "camera",
) -> list[PlacedGrasp]:
    """Return the rows of a table on the objects of a dataset's rows; see `contacts_on_rows`.

    Postures are tried on the object and in the resting pose of their rows, whatever they state
    themselves.
    """
    if isinstance(table, ContactRows):
        how: dict[str, Any] = {"drawn": drawn, "overrides": overrides, "frame": frame}
        return contacts_on_rows(table, dataset, rows, config=config, **how)
    assert isinstance(table, Attempts)
    _validate_no_mesh_frame(table)
    chosen = choose_rows(dataset, table.of_row if rows is None else rows, len(table))
    found = []
    for i, placed, used in objects_of_rows(dataset, chosen, config, drawn, overrides):
        row = replace(
            table.at([i]),
            objects=(placed.model.name,),
            resting=np.zeros(1, dtype=np.int64),
            X_TO=np.full((1, 4, 4), np.nan),
        )
        row = row.refuse(misfits(row, placed.model.name, placed.model.scale, placed.X_TO[None]))
        found.append(_placed_row(row, 0, i, (placed,), used))
    return found


def place_on_dataset(
    table: Attempts, out: Path, config: Config | None = None, *, overrides: Sequence[str] = ()
) -> list[PlacedGrasp]:
    """Return postures on the objects of a dataset that they name.

    Rows of an object in a resting pose are adjacent, so that its scene is built once.

    Args:
        table: The postures.
        out: Directory of the dataset.
        config: Configuration for the trials; None for each object's configuration.
        overrides: Settings of the caller; they take precedence over the conditions of a row.

    Raises:
        GraspError: If the postures are in the frames of mesh files.
        DataError: If the dataset cannot be used.
    """
    _validate_no_mesh_frame(table)
    manifest = read_manifest(out)
    names = [entry.name for entry in manifest.objects]
    table, found = table.refuse(unknown_objects(table, names)), list[PlacedGrasp]()
    for name in dict.fromkeys(table.objects):
        # An object that does not exist is known by its name alone.
        there = name if name in names else names[0]
        stands = resting_objects(out, there, manifest.config)
        if name not in names:
            model = replace(stands[0].model, name=name)
            stands = [replace(stands[0], model=model, X_TO=np.full((4, 4), np.nan))]
        rows = [i for i, each in enumerate(table.objects) if each == name]
        rows.sort(key=table.resting.__getitem__)
        used = config or stands[0].config
        found += _on_stands(table, rows, stands, used, overridden_keys(overrides))
    return found


def _validate_no_mesh_frame(table: Attempts) -> None:
    """Reject postures in frames of meshes: a file cannot say which of both meshes it means.

    Meshes of a dataset are exported in {O}.
    """
    if table.frame == "mesh":
        raise GraspError(
            "frame must not be mesh for postures on a dataset, got mesh: for its exported meshes "
            "use --frame object, or give the mesh itself (drakegrasp verify FILE --object MESH)"
        )


def _on_stands(
    table: Attempts,
    rows: Iterable[int],
    stands: Sequence[PlacedObject],
    config: Config,
    overridden: set[str],
) -> list[PlacedGrasp]:
    """Return some rows on one object, given in each of its resting poses.

    A row that gives the pose of the object is tried in that pose, even if no drop ended in it.
    """
    anywhere = replace(table, X_TO=np.full_like(table.X_TO, np.nan))
    model, poses = stands[0].model, np.array([each.X_TO for each in stands])
    table = table.refuse(misfits(anywhere, model.name, model.scale, poses))
    given, found = list[PlacedObject](), list[PlacedGrasp]()
    for i in rows:
        tried: Sequence[PlacedObject] = stands[:1]
        if not table.invalid[i]:
            try:
                tried = _stands_of(table, i, stands, given)
            except GraspError as error:
                table = table.refuse([str(error) if k == i else "" for k in range(len(table))])
        drawn = [under(each, config, table.conditions[i], overridden) for each in tried]
        found.append(_placed_row(table, i, i, tuple(each for each, _ in drawn), drawn[0][1]))
    return found


def _stands_of(
    table: Attempts, i: int, stands: Sequence[PlacedObject], given: list[PlacedObject]
) -> Sequence[PlacedObject]:
    """Return the object in each pose that a row is tried in.

    Args:
        table: The postures.
        i: Index of the row.
        stands: The object in its resting poses.
        given: The object in poses that rows gave; a new one is added, and equal ones are shared.

    Raises:
        GraspError: If the row gives a pose in which the object does not stand on the table.
    """
    if np.isnan(table.X_TO[i]).any():
        named = int(table.resting[i])
        return stands if named == UNTOLD else [stands[named]]
    stood = canonical_pose(table.X_TO[i])
    for each in (*stands, *given):
        if np.abs(each.X_TO_simulated - stood).max() < SAME_POSE:
            return [each]
    given.append(place_object(stands[0], X_TO=table.X_TO[i]))
    return given[-1:]


def _placed_row(
    table: Attempts, i: int, index: int, stands: tuple[PlacedObject, ...], config: Config
) -> PlacedGrasp:
    """Return the posture of a row, which is number `index` of the caller's grasps."""
    hand = load_hand(config.hand_source)
    nothing = np.full((hand.num_fingers, 3), np.nan)
    tried = () if table.invalid[i] else stands
    return PlacedGrasp(
        index=index,
        stands=stands,
        config=config,
        invalid=table.invalid[i],
        **stated(table, i),
        p_AQ=nothing,
        nhat_Q_A=nothing,
        postures=tuple(table.posture(i, each.X_TO, each.model.X_OM) for each in tried),
        preshapes=table.shapes(i, hand),
        named=table.names_pose(i),
    )
