"""The requests of a caller: each attempt in {O} of its object on the table.

Input: contacts or postures, with an object, with the objects of a dataset, or with rows of a
dataset. Output: a `PlacedGrasp` for each. Every mistake of the caller is found here, before
anything is simulated; a bad row is not a mistake of the caller.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from drakegrasp.config import Config
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.prepared_objects import load_prepared
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.dataset.schema import CAMERAS
from drakegrasp.errors import GraspError, HandError
from drakegrasp.frames import (
    Array,
    as_numbers,
    read_pose,
    rotate_vectors,
    transform_points,
    unpack_pose,
)
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.folder import hand_digest
from drakegrasp.hand.settings import override_config
from drakegrasp.simulation.attempts import (
    CONDITIONS,
    UNTOLD,
    Attempts,
    misfits,
    read_confidence,
    unknown_objects,
)
from drakegrasp.simulation.placement import (
    PlacedObject,
    canonical_pose,
    place_object,
    refuse_no_config,
    refuse_other_objects,
)
from drakegrasp.simulation.posture import Posture
from drakegrasp.simulation.settle import find_resting_poses
from drakegrasp.verification.prediction import in_frame, read_grasps

#: The row of a split for each of n grasps, or one row for all; None for all rows, in order.
RowChoice: TypeAlias = Sequence[int] | npt.NDArray[np.int64] | int | None
#: Names of the frames of a dataset's cameras: the data file's own camera, and the other camera.
CAMERA, OTHER_CAMERA = "the camera's frame (camera)", "the frame of the dataset's other camera"
#: Poses of an object at rest that differ by less than this are equal; a file has rounding errors.
SAME_POSE = 1e-6
#: How contacts are verified.
METHODS = ("hand", "forces")


@dataclass(frozen=True, kw_only=True, eq=False)
class PlacedGrasp:
    """An attempt on an object on the table, with everything that its verification needs.

    Attributes:
        index: Index among the caller's grasps.
        attempt: The grasp's row of a table: contacts, a posture, or the reason why it is invalid.
        stands: The object in its resting pose; in each of its resting poses for a posture that
            names none.
        method: "hand" or "forces" for contacts, "posture" for postures.
        config: Hand, physics, lift and rules. The setting that ends lifts (`lift.stop_when`) has no
            effect, because the verdict is that of a whole lift.
        snap_points: Whether to move contact points to the surface.
        cameras: Poses X_TC (4, 4) of cameras in whose frames the grasp could be, by the names of
            these frames.
    """

    index: int
    attempt: Attempts
    stands: tuple[PlacedObject, ...]
    method: str
    config: Config
    snap_points: bool = False
    cameras: Mapping[str, Array] = field(default_factory=dict)

    @property
    def placed(self) -> PlacedObject:
        """The object on the table, in the first of the resting poses."""
        return self.stands[0]

    @property
    def invalid(self) -> str:
        """Reason why the grasp is invalid; empty if it is valid."""
        return self.attempt.invalid[0]

    def X_OA(self, thing: PlacedObject) -> Array:
        """Return the pose (4, 4) of the frame of the grasp's numbers in {O} of a resting object."""
        return self.attempt.frame_pose(0, thing.X_TO, thing.model.X_OM)

    def posture(self, thing: PlacedObject) -> Posture:
        """Return wrist and joints of a posture, in {O} of a resting object."""
        return self.attempt.posture(0, thing.X_TO, thing.model.X_OM)

    def contacts(self) -> tuple[Array, Array]:
        """Return points p_OQ [m] and unit normals nhat_Q_O (k, 3) in {O}; NaN without contacts."""
        points, normals = self.attempt.points, self.attempt.normals
        if points is None or normals is None:
            nothing = np.full((load_hand(self.config.hand_source).num_fingers, 3), np.nan)
            return nothing, nothing
        X_OA = self.X_OA(self.placed)
        return transform_points(X_OA, points[0]), rotate_vectors(X_OA, normals[0])


def place_on_object(
    grasps: npt.ArrayLike | Attempts,
    placed: PlacedObject,
    *,
    frame: str = "object",
    X_TC: npt.ArrayLike | None = None,
    method: str = "hand",
    snap_points: bool = False,
    overrides: Sequence[str] = (),
) -> list[PlacedGrasp]:
    """Return grasps in {O} of one object, in their order; see `drakegrasp.verify_grasps`.

    Postures are tried on this object, whatever object name they give. Postures that name no resting
    pose are tried in all resting poses of a build. `overrides` are settings of the caller; they
    take precedence over the conditions of a posture.

    Raises:
        GraspError: As `drakegrasp.verify_grasps`.
    """
    table, things, config = _read(grasps, method, placed.config), [placed], placed.config
    if table.points is not None:
        table = in_frame(table, frame, None if X_TC is None else read_pose(X_TC, "X_TC"))
    elif config.objects.resting_poses > 1:
        others = find_resting_poses(placed.model, config)[1:]
        things += [replace(placed, X_TO=resting.X_TO) for resting in others]
    table = replace(table, objects=(placed.model.name,) * len(table))
    how: dict[str, Any] = {"method": method, "snap_points": snap_points, "overrides": overrides}
    return _placed(table, range(len(table)), things, config, **how)


def place_on_rows(
    grasps: npt.ArrayLike | Attempts,
    dataset: GraspDataset,
    rows: RowChoice = None,
    *,
    frame: str = "camera",
    hand: str | Path | None = None,
    method: str = "hand",
    snap_points: bool = False,
    config: Config | None = None,
    overrides: tuple[str, ...] = (),
) -> list[PlacedGrasp]:
    """Return grasps in {O} of the objects of a dataset's rows.

    Grasps of the same object are adjacent, so that its scene is built once. Arguments and errors
    are those of `drakegrasp.verify_grasps` and of `dataset_config`. One row may be given for all
    grasps. Without a configuration, each grasp has the friction and mass that were drawn for its
    row, except for overridden values. Postures are tried on the object and in the resting pose of
    their rows, whatever they state themselves.
    """
    # Read all grasps before any object, so that a wrong number is reported at once.
    used = dataset_config(dataset, config, hand, overrides)
    table = _read(grasps, method, used)
    count = len(table)
    chosen = choose_rows(dataset, table.of_row if rows is None else rows, count)
    cameras = cameras_of_rows(dataset, chosen)
    if table.points is not None:
        table = in_frame(table, frame, cameras[CAMERA] if frame == "camera" else None)

    # Object, resting pose and drawn conditions are those of the rows.
    table = replace(
        table,
        objects=tuple(dataset.column("object_props/object_name")[chosen].tolist()),
        resting=dataset.column("grasp_props/resting")[chosen].astype(np.int64),
        X_TO=np.full((count, 4, 4), np.nan),
        conditions=_drawn(dataset, chosen) if config is None else np.full((count, 3), np.nan),
    )
    how: dict[str, Any] = {"method": method, "snap_points": snap_points, "overrides": overrides}
    return place_on_dataset(table, dataset.path.parent, used, cameras=cameras, **how)


def cameras_of_rows(dataset: GraspDataset, rows: npt.NDArray[np.int64]) -> dict[str, Array]:
    """Return the poses X_TC (n, 4, 4) of a dataset's cameras in rows (n,), by their frames.

    The first camera is the data file's own. A camera of scenes is the only one.
    """
    names = {dataset.camera: CAMERA}
    if dataset.camera in CAMERAS:
        names |= {camera: OTHER_CAMERA for camera in CAMERAS if camera != dataset.camera}
    return {
        name: read_pose(
            unpack_pose(dataset.column(f"object_props/frame_work2cam_{camera}")[rows]),
            "the camera's pose",
        )
        for camera, name in names.items()
    }


def overridden_keys(overrides: Sequence[str]) -> set[str]:
    """Return the paths of the keys that overrides set, e.g. "physics.friction_hand".

    An overridden value takes precedence over the value drawn for a row, even if both are equal.
    """
    return {text.partition("=")[0].strip() for text in overrides}


def dataset_config(
    dataset: GraspDataset,
    config: Config | None = None,
    hand: str | Path | None = None,
    overrides: tuple[str, ...] = (),
) -> Config:
    """Return the configuration for a dataset's objects.

    Args:
        dataset: The data file.
        config: The given configuration; None for the dataset's.
        hand: Name or YAML file of the hand; None for the configuration's.
        overrides: Strings `"a.b=c"`, applied to the configuration.

    Raises:
        ConfigError: If config is not a `Config`, or the objects were prepared with other values.
        HandError: If the files of the dataset's hand have changed, and the caller names no hand.
        DataError: If the dataset cannot be used.
    """
    if config is not None:
        refuse_no_config(config)
    manifest = read_manifest(dataset.path.parent)
    known, digest = manifest.config, manifest.versions.get("hand")
    if config is not None and config.hand == known.hand:
        config = config.with_hand(known.hand, known.hand_source)
    used = override_config(config or known, overrides) if overrides else config or known
    used = used if hand is None else override_config(used, [], hand=str(hand))
    refuse_other_objects(used, known, "as in the dataset, whose objects are prepared")
    own = hand is None and used.hand == known.hand and digest is not None
    if own and (found := hand_digest(used.hand_source)) != digest:
        raise HandError(
            f"{used.hand}: files of the hand must be those of the dataset ({digest}), got others "
            f"({found}); name the hand to verify with it as it is now"
        )
    return used


def _read(grasps: npt.ArrayLike | Attempts, method: str, config: Config) -> Attempts:
    """Return a given table of attempts, or read contacts of the configuration's hand."""
    if method not in METHODS:
        raise GraspError(f"method must be one of {', '.join(METHODS)}, got {method!r}")
    if isinstance(grasps, Attempts):
        return grasps
    return read_grasps(grasps, load_hand(config.hand_source).num_fingers)


def _drawn(dataset: GraspDataset, rows: npt.NDArray[np.int64]) -> Array:
    """Return the `CONDITIONS` (n, 3) that were drawn for rows of a dataset; NaN if not drawn."""
    rules = read_manifest(dataset.path.parent).config.randomize
    told = np.full((len(rows), 3), np.nan)
    # If one coefficient was drawn, both are taken from the row.
    if rules.friction_hand is not None or rules.friction_table is not None:
        for k, name in enumerate(("friction_hand", "friction_table")):
            told[:, k] = dataset.column(f"conditions/{name}")[rows]
    if rules.mass is not None:
        told[:, 2] = dataset.column("object_props/work2mass")[rows, 0]
    return told


def choose_rows(
    dataset: GraspDataset,
    rows: RowChoice,
    count: int,
    *,
    said: str = "`rows` says for which rows they are",
) -> npt.NDArray[np.int64]:
    """Return the row (n,) of the dataset's split for each of `count` grasps; one may be for all.

    `said` is the part of the error message that explains how to give rows.

    Raises:
        GraspError: If there is not exactly one row per grasp, or a row does not exist.
    """
    chosen = np.arange(count) if rows is None else np.asarray(rows)
    # NumPy treats an empty list as real numbers.
    if chosen.size and chosen.dtype.kind not in "iu":
        raise GraspError(f"rows must be whole numbers, got values of type {chosen.dtype}")
    chosen = chosen.astype(np.int64)
    chosen = np.full(count, chosen) if chosen.ndim == 0 else chosen.ravel()

    # Check that there is one row per grasp.
    if len(chosen) != count:
        raise GraspError(f"rows must be one per grasp ({count}), got {len(chosen)}")
    if not len(dataset):
        raise GraspError(f"{dataset.path}: {dataset.emptiness}")
    if rows is None and count != len(dataset):
        raise GraspError(
            f"without rows there must be a grasp for each of the {len(dataset)} rows of "
            f"{dataset.split} in {dataset.path.name}, got {count} grasps ({said})"
        )

    # Check that the rows exist.
    wrong = chosen[(chosen < 0) | (chosen >= len(dataset))]
    if len(wrong):
        raise GraspError(
            f"rows must be 0 to {len(dataset) - 1} of {dataset.split} in {dataset.path.name}, "
            f"got {wrong[0]}"
        )
    return chosen


def read_several(
    grasps: npt.ArrayLike,
    data: GraspDataset,
    *,
    fingers: int,
    rows: RowChoice = None,
    confidence: npt.ArrayLike | None = None,
) -> Attempts:
    """Return predicted contacts for rows of a split; a row may have several predictions.

    Args:
        grasps: (n, 6k), or (n, m, 6k) with m grasps per row. NaN is kept: it is a bad prediction,
            not a mistake of the caller.
        data: The split.
        fingers: Number of fingers, k.
        rows: (n,), row that each prediction is for, with repeats; None for all rows in order.
        confidence: (n,) or (n, m), greater is better.

    Raises:
        GraspError: If the shapes do not match, or a row does not exist.
    """
    array = as_numbers(grasps, "grasps must be numbers")
    if array.ndim not in (2, 3) or array.size == 0:
        raise GraspError(f"grasps must be (n, 6k), or (n, m, 6k) for m per row, got {array.shape}")
    of_row = np.repeat(choose_rows(data, rows, len(array)), array[0, ..., 0].size)
    stated = None
    if confidence is not None:
        stated = read_confidence(confidence, array.shape[:-1]).ravel()
    flat = array.reshape(-1, array.shape[-1])
    return read_grasps(flat, fingers, rows=of_row, confidence=stated)


def place_on_dataset(
    table: Attempts, out: Path, config: Config | None = None, **how: Any
) -> list[PlacedGrasp]:
    """Return the rows of a table on the objects of a dataset that they name.

    Rows of an object in a resting pose are adjacent, so that its scene is built once.

    Args:
        table: The attempts.
        out: Directory of the dataset.
        config: Configuration for the trials; None for each object's configuration.
        how: See `_placed`.

    Raises:
        GraspError: If the rows are postures in the frames of mesh files.
        DataError: If the dataset cannot be used.
    """
    if table.frame == "mesh" and table.points is None:
        # Meshes of a dataset are exported in {O}: a file cannot say which of both meshes it means.
        raise GraspError(
            "frame must not be mesh for postures on a dataset, got mesh: for its exported meshes "
            "use --frame object, or give the mesh itself (drakegrasp verify FILE --object MESH)"
        )
    manifest, placed = read_manifest(out), list[PlacedGrasp]()
    names = [entry.name for entry in manifest.objects]
    table = table.refuse(unknown_objects(table, names))
    for name in dict.fromkeys(table.objects):
        # An object that does not exist is known by its name alone.
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
        rows.sort(key=lambda i: table.resting[i])
        placed += _placed(table, rows, things, config or own, **how)
    return placed


def _placed(
    table: Attempts,
    rows: Iterable[int],
    things: Sequence[PlacedObject],
    config: Config,
    *,
    method: str = "hand",
    snap_points: bool = False,
    overrides: Sequence[str] = (),
    cameras: Mapping[str, Array] | None = None,
) -> list[PlacedGrasp]:
    """Return some rows of a table on one object, given in each of its resting poses.

    Args:
        table: The attempts.
        rows: Indices of the rows.
        things: The object in its resting poses.
        config: Configuration for the trials.
        method: Method for contacts.
        snap_points: See `PlacedGrasp`.
        overrides: Settings of the caller; they take precedence over the conditions of a row.
        cameras: Poses X_TC (n, 4, 4) for all rows of the table, by their frames.
    """
    model, known_cameras = things[0].model, dict(cameras or {})
    if table.points is None:
        method = "posture"
        known_cameras |= {} if table.X_TC is None else {CAMERA: table.X_TC}

    # A row that gives the pose of the object is tried in that pose, even if no drop ended in it.
    anywhere = replace(table, X_TO=np.full_like(table.X_TO, np.nan))
    poses = np.array([thing.X_TO for thing in things])
    table = table.refuse(misfits(anywhere, model.name, model.scale, poses))
    stands, overridden, found = _Stands(things), overridden_keys(overrides), list[PlacedGrasp]()
    for i in rows:
        attempt, lying = table.at([i]), things[:1]
        try:
            lying = lying if table.invalid[i] else stands.of(table, i)
        except GraspError as error:
            attempt = attempt.refuse([str(error)])
        tried = [stands.under(each, config, table.conditions[i], overridden) for each in lying]
        found.append(
            PlacedGrasp(
                index=i,
                attempt=attempt,
                stands=tuple(thing for thing, _ in tried),
                method=method,
                config=tried[0][1],
                snap_points=snap_points,
                cameras={name: X_TC[i] for name, X_TC in known_cameras.items()},
            )
        )
    return found


class _Stands:
    """An object in its resting poses and in poses that rows give; equal poses share an object."""

    def __init__(self, things: Sequence[PlacedObject]) -> None:
        self._dropped, self._told = list(things), list[PlacedObject]()
        self._known: dict[tuple[int, bytes], tuple[PlacedObject, Config]] = {}

    def of(self, table: Attempts, i: int) -> Sequence[PlacedObject]:
        """Return the object in each pose that a row is tried in.

        Raises:
            GraspError: If the row gives a pose in which the object does not stand on the table.
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
            mass, model = told.pop("mass"), thing.model
            if np.isfinite(list(told.values())).any():
                frictions = {n: v if np.isfinite(v) else model.friction for n, v in told.items()}
                used = {
                    name: value
                    for name, value in frictions.items()
                    if value is not None and f"physics.{name}" not in overridden
                }
                # The configuration's values come before the object's own, which would win
                # otherwise.
                physics = config.physics.model_copy(update=used)
                config = config.model_copy(update={"physics": physics})
                model = replace(model, friction=None)
            if np.isfinite(mass) and "objects.mass" not in overridden and mass != model.mass:
                # The inertia scales with the mass.
                model = replace(model, mass=mass, I_OOcm_O=mass / model.mass * model.I_OOcm_O)
            same = model is thing.model
            self._known[key] = thing if same else replace(thing, model=model), config
        return self._known[key]
