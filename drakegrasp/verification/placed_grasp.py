"""What a caller asks to be verified: each grasp in {O} of its object on the table.

In: grasp vectors in one of three frames, with a mesh, or with rows of a dataset. Out: a
`PlacedGrasp` for each. Every mistake of the caller is found here, before anything is simulated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
import trimesh

from drakegrasp.config import Config, RandomizeConfig
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.prepared_objects import load_prepared
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.errors import GraspError, HandError
from drakegrasp.frames import Array, read_pose, unpack_pose
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.files import hand_digest
from drakegrasp.hand.settings import override_config
from drakegrasp.simulation.placement import (
    Placed,
    PlacedObject,
    config_of,
    place_object,
    refuse_no_config,
    refuse_other_objects,
)
from drakegrasp.verification.prediction import (
    boxes_away,
    read_grasps,
    refuse_other_units,
    to_object_frame,
)
from drakegrasp.verification.result import Verification
from drakegrasp.verification.verify import METHODS, verify_contacts

Mesh: TypeAlias = str | Path | trimesh.Trimesh | Placed


@dataclass(frozen=True, kw_only=True, eq=False)
class VerifyArguments:
    """The keyword arguments of `api.verify_grasps` that say what is verified, and how; see there.

    `api.verify_grasp` has the same, but for `row`, which is a list of one here, and `overrides`.

    Attributes:
        overrides: `"a.b=c"` strings, applied to the configuration. Unlike a configuration they
            leave what was drawn for a dataset's rows, but for what they name.
    """

    mesh: Mesh | None = None
    frame: str | None = None
    X_TC: npt.ArrayLike | None = None
    X_TO: npt.ArrayLike | None = None
    units: str | None = None
    hand: str | Path | None = None
    method: str = "hand"
    config: Config | None = None
    overrides: tuple[str, ...] = ()
    dataset: GraspDataset | None = None
    rows: Sequence[int] | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class PlacedGrasp:
    """A grasp of k contacts on an object on the table: all that its verification needs.

    Attributes:
        index: Its place among the caller's grasps.
        placed: The object on the table.
        p_OQ, nhat_Q_O: (k, 3), contact points [m] and outward unit normals in {O}.
        method: "hand" or "forces".
        config: Hand, physics, lift and limits.
    """

    index: int
    placed: PlacedObject
    p_OQ: Array
    nhat_Q_O: Array
    method: str
    config: Config


@dataclass(frozen=True, kw_only=True, eq=False)
class _Target:
    """An object, and which of the caller's grasps are for it.

    Attributes:
        placed: The object on the table.
        indices: (m,), of the grasps.
        X_TC: For grasps in {C}: pose of the camera, (4, 4), or one per grasp (m, 4, 4).
    """

    placed: PlacedObject
    indices: npt.NDArray[np.int64]
    X_TC: Array | None


def verify_placed(grasp: PlacedGrasp) -> Verification:
    """Return whether a grasp holds its object, see `verify.verify_contacts`."""
    return verify_contacts(
        grasp.placed, grasp.p_OQ, grasp.nhat_Q_O, method=grasp.method, config=grasp.config
    )


def place_grasps(grasps: npt.ArrayLike, arguments: VerifyArguments) -> list[PlacedGrasp]:
    """Return grasps in {O} of the objects that they are for.

    Args:
        grasps: (n, 6k), or (6k,) for one.
        arguments: What else the caller gave.

    Returns:
        One per grasp; those of the same object stand together, so that its scene is built once.

    Raises:
        GraspError: If a grasp, frame or pose cannot be used.
        MeshError: If the mesh cannot be simulated.
        ConfigError, HandError, DataError: If configuration, hand or dataset cannot be used.
    """
    _refuse_contradictions(arguments)
    known, config = _known_config(arguments), chosen_config(arguments)
    frame = _frame(arguments)

    # Read all grasps before any mesh: a wrong number is reported at once.
    points, normals = read_grasps(grasps, load_hand(config.hand).num_fingers)

    # Put the objects on the table.
    if arguments.dataset is None:
        targets = [_target_of_mesh(arguments, config, len(points))]
    else:
        rows = _choose_rows(arguments.dataset, arguments.rows, len(points))
        targets = _targets_of_rows(arguments.dataset, rows, in_camera=frame == "camera")

    # Express the contacts in {O} of their objects.
    placed_grasps: list[PlacedGrasp] = []
    for target in targets:
        contacts = to_object_frame(
            points[target.indices],
            normals[target.indices],
            frame=frame,
            X_TC=target.X_TC,
            X_TO=target.placed.X_TO,
        )
        placed_grasps += [
            PlacedGrasp(
                index=int(index),
                placed=target.placed,
                p_OQ=p_OQ,
                nhat_Q_O=nhat_Q_O,
                method=arguments.method,
                config=config,
            )
            for index, p_OQ, nhat_Q_O in zip(target.indices, *contacts, strict=True)
        ]
    _refuse_other_units(placed_grasps)
    if arguments.dataset is None or arguments.config is not None:
        return placed_grasps
    kept = {text.partition("=")[0].strip() for text in arguments.overrides}
    return _as_tried(placed_grasps, arguments.dataset, rows, known.randomize, kept)


def _refuse_contradictions(arguments: VerifyArguments) -> None:
    """Refuse arguments of the wrong kind, and those that do not go together.

    Raises:
        GraspError: If there are any.
        ConfigError: If the configuration is not a `Config`.
    """
    mesh, dataset = arguments.mesh, arguments.dataset
    if arguments.method not in METHODS:
        raise GraspError(f"method must be one of {', '.join(METHODS)}, got {arguments.method!r}")
    if (mesh is None) == (dataset is None):
        got = "neither" if mesh is None else "both"
        raise GraspError(f"a mesh or a dataset must be given, got {got}")
    if arguments.config is not None:
        refuse_no_config(arguments.config)
    if dataset is None:
        if arguments.rows is not None:
            raise GraspError("rows must be None without a dataset, got rows")
        return

    # A dataset has the objects, their poses and the cameras' poses.
    if not isinstance(dataset, GraspDataset):
        raise GraspError(
            "dataset must be a GraspDataset, which has a file and a split, "
            f"got a {type(dataset).__name__}"
        )
    for name in ("X_TC", "X_TO", "units"):
        if getattr(arguments, name) is not None:
            raise GraspError(f"{name} must be None with a dataset, which defines it, got a value")


def _known_config(arguments: VerifyArguments) -> Config:
    """Return the configuration of the dataset, else that of the mesh."""
    if arguments.dataset is not None:
        return read_manifest(arguments.dataset.path.parent).config
    return config_of(arguments.mesh)


def chosen_config(arguments: VerifyArguments) -> Config:
    """Return the given configuration, else the known one, with the overrides and the given hand.

    Raises:
        ConfigError: If a dataset's objects were prepared with other values.
        HandError: If a dataset's hand has other files now, and the caller names none.
        DataError: If the dataset cannot be used.
    """
    known = _known_config(arguments)
    config = known if arguments.config is None else arguments.config
    config = override_config(config, arguments.overrides) if arguments.overrides else config
    if arguments.hand is not None:
        config = override_config(config, [], hand=str(arguments.hand))
    if arguments.dataset is not None:
        refuse_other_objects(config, known, "as in the dataset, whose objects are prepared")
        if arguments.hand is None and config.hand == known.hand:
            _refuse_other_hand(arguments.dataset, config.hand)
    return config


def _refuse_other_hand(dataset: GraspDataset, hand: str) -> None:
    """Refuse the hand of a dataset if its files have changed since.

    Raises:
        HandError: If so, or if they are gone.
    """
    known = read_manifest(dataset.path.parent).versions.get("hand")
    found = hand_digest(hand)
    if known not in (None, found):
        raise HandError(
            f"{hand}: files of the hand must be those of the dataset ({known}), got others "
            f"({found}); name the hand to verify with it as it is now"
        )


def _frame(arguments: VerifyArguments) -> str:
    """Return the given frame, else the camera of a dataset or the object of a mesh."""
    return arguments.frame or ("object" if arguments.dataset is None else "camera")


def _target_of_mesh(arguments: VerifyArguments, config: Config, count: int) -> _Target:
    """Return the given mesh on the table, as the target of all `count` grasps."""
    assert arguments.mesh is not None
    placed = place_object(arguments.mesh, units=arguments.units, X_TO=arguments.X_TO, config=config)
    X_TC = None if arguments.X_TC is None else read_pose(arguments.X_TC, "X_TC")
    return _Target(placed=placed, indices=np.arange(count), X_TC=X_TC)


def _targets_of_rows(
    dataset: GraspDataset, rows: npt.NDArray[np.int64], *, in_camera: bool
) -> list[_Target]:
    """Return the objects of a dataset's rows.

    Args:
        dataset: The data file.
        rows: (n,), the row of each grasp.
        in_camera: Whether the grasps are in {C}.
    """
    # The object, its resting pose, and the camera of each row.
    names = dataset.column("object_props/object_name")[rows]
    resting = dataset.column("grasp_props/resting")[rows]
    X_TC = unpack_pose(dataset.column(f"object_props/frame_work2cam_{dataset.camera}")[rows])

    # Each object in each resting pose once, with its grasps.
    out, targets = dataset.path.parent, []
    manifest = read_manifest(out)
    for name, k in dict.fromkeys(zip(names.tolist(), resting.tolist(), strict=True)):
        indices = np.flatnonzero((names == name) & (resting == k))
        config = manifest.config_of(name)
        prepared = load_prepared(out, name, config)
        X_TO = prepared.resting_poses[k]
        placed = PlacedObject(model=prepared.model, X_TO=X_TO, config=config)
        poses = read_pose(X_TC[indices], "the camera's pose") if in_camera else None
        targets.append(_Target(placed=placed, indices=indices, X_TC=poses))
    return targets


def _as_tried(
    grasps: Sequence[PlacedGrasp],
    dataset: GraspDataset,
    rows: npt.NDArray[np.int64],
    rules: RandomizeConfig,
    overridden: set[str],
) -> list[PlacedGrasp]:
    """Return grasps with the friction and mass that were drawn for their rows.

    Args:
        grasps: On the objects of a dataset.
        dataset: The data file.
        rows: (n,), the row of each grasp, by its index.
        rules: What was drawn for the dataset.
        overridden: Paths of keys that the caller sets, e.g. "physics.friction_hand".
    """
    # Use each row's drawn friction and mass; what the caller sets wins. Where one coefficient was
    # drawn, both are taken from the row.
    drawn_friction = rules.friction_hand is not None or rules.friction_table is not None
    frictions = {
        name: dataset.column(f"conditions/{name}")[rows].astype(float)
        for name in ("friction_hand", "friction_table")
        if drawn_friction and f"physics.{name}" not in overridden
    }
    masses = dataset.column("object_props/work2mass")[rows, 0].astype(float)

    tried = []
    for grasp in grasps:
        i, placed, config = grasp.index, grasp.placed, grasp.config
        if drawn_friction:
            used = {name: float(values[i]) for name, values in frictions.items()}
            physics = config.physics.model_copy(update=used)
            config = config.model_copy(update={"physics": physics})
            # They come from the object's own, which would win otherwise.
            placed = replace(placed, model=replace(placed.model, friction=None))
        if rules.mass is not None:
            mass, known = float(masses[i]), placed.model
            inertia = mass / known.mass * known.I_OOcm_O
            placed = replace(placed, model=replace(known, mass=mass, I_OOcm_O=inertia))
        tried.append(replace(grasp, placed=placed, config=config))
    return tried


def _choose_rows(
    dataset: GraspDataset, rows: Sequence[int] | None, count: int
) -> npt.NDArray[np.int64]:
    """Return the row (n,) of the dataset's split for each of `count` grasps.

    Raises:
        GraspError: If there is not exactly one row per grasp, or a row does not exist.
    """
    chosen = np.arange(count) if rows is None else np.asarray(rows)
    # NumPy takes an empty list for real numbers.
    if chosen.size and chosen.dtype.kind not in "iu":
        raise GraspError(f"rows must be whole numbers, got values of type {chosen.dtype}")
    chosen = chosen.astype(np.int64).ravel()

    # One row per grasp.
    if len(chosen) != count:
        raise GraspError(f"rows must be one per grasp ({count}), got {len(chosen)}")
    if rows is None and count != len(dataset):
        raise GraspError(
            f"without rows there must be a grasp for each of the {len(dataset)} rows of "
            f"{dataset.split} in {dataset.path.name}, got {count} grasps"
        )

    # Rows that exist.
    wrong = chosen[(chosen < 0) | (chosen >= len(dataset))]
    if len(wrong):
        raise GraspError(
            f"rows must be 0 to {len(dataset) - 1} of {dataset.split} in {dataset.path.name}, "
            f"got {wrong[0]}"
        )
    return chosen


def _refuse_other_units(grasps: Sequence[PlacedGrasp]) -> None:
    """Refuse grasps that are all far from their objects; single ones are wrong predictions."""
    if grasps:
        nearest = min(grasps, key=lambda g: boxes_away(g.p_OQ, g.placed.model.half_extents))
        refuse_other_units(nearest.p_OQ, nearest.placed.model.half_extents)
