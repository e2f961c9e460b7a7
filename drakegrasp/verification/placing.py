"""Grasps in {O} of their objects on the table: on an object, on rows of a dataset, on its objects.

Input: contacts or postures, with an object, with rows of a dataset, or with a dataset whose objects
the postures name. Output: a `PlacedGrasp` for each. Every mistake of the caller is found here,
before anything is simulated. A bad row is not a mistake of the caller; it keeps the reason.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from drakegrasp.config import Config, with_whole_lifts
from drakegrasp.dataset.clutter import load_scene
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.prepared_objects import load_prepared
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.dataset.scenes import SceneRows
from drakegrasp.dataset.schema import CAMERAS
from drakegrasp.errors import GraspError, HandError
from drakegrasp.frames import (
    Array,
    frame_in_object,
    invert_pose,
    read_pose,
    rotate_vectors,
    transform_points,
    unpack_pose,
    validate_frame,
)
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.folder import hand_digest
from drakegrasp.hand.settings import override_config
from drakegrasp.simulation.attempts import (
    CONDITIONS,
    UNTOLD,
    GraspRows,
    GraspTable,
    misfits,
    unknown_objects,
)
from drakegrasp.simulation.placement import (
    PlacedObject,
    canonical_pose,
    place_object,
    validate_config,
    validate_same_objects,
)
from drakegrasp.simulation.posture import Posture
from drakegrasp.simulation.settle import find_resting_poses
from drakegrasp.verification.prediction import ContactRows, RowChoice, choose_rows, read_grasps

#: Names of the frames of a dataset's cameras: the data file's own camera, and the other camera.
CAMERA, OTHER_CAMERA = "the camera's frame (camera)", "the frame of the dataset's other camera"
#: Poses of an object at rest that differ by less than this are equal; a file has rounding errors.
SAME_POSE = 1e-6


@dataclass(frozen=True, kw_only=True, eq=False)
class PlacedGrasp:
    """A grasp on an object on the table, with everything that its verification needs.

    Attributes:
        index: Index among the caller's grasps.
        stands: The object in its resting pose; in each of its resting poses for a posture that
            names none.
        config: Hand, physics, lift and rules. Lifts are whole (`lift.stop_when` is never), because
            the verdict is that of a whole lift.
        invalid: Reason why the grasp is invalid; empty if it is valid.
        confidence: Confidence that the caller states; NaN if none is stated.
        rank: Rank by confidence among the grasps for the same row, or of the same object; 0 for the
            best, -1 without confidence.
        p_AQ, nhat_Q_A: (k, 3), contact points [m] and outward unit normals in the frame {A} of the
            caller; NaN for a posture and for an invalid row.
        X_OA: Pose (4, 4) of this frame in {O}.
        cameras: Poses X_TC (4, 4) of cameras in whose frames contacts could be, by the names of
            these frames.
        normalised: Whether a normal was not of unit length.
        postures: Wrist and joints in {O} for each of the stands; none for contacts and for an
            invalid row.
        preshapes: The preshapes in which a posture is tried; the name is empty if all fingers
            close.
        named: Whether a posture names its resting pose.
    """

    index: int
    stands: tuple[PlacedObject, ...]
    config: Config
    invalid: str = ""
    confidence: float = np.nan
    rank: int = -1
    p_AQ: Array
    nhat_Q_A: Array
    X_OA: Array = field(default_factory=lambda: np.eye(4))
    cameras: Mapping[str, Array] = field(default_factory=dict)
    normalised: bool = False
    postures: tuple[Posture, ...] = ()
    preshapes: tuple[str, ...] = ("",)
    named: bool = True

    @property
    def placed(self) -> PlacedObject:
        """The object on the table, in the first of the resting poses."""
        return self.stands[0]

    def in_object_frame(self) -> tuple[Array, Array]:
        """Return points p_OQ [m] and unit normals nhat_Q_O (k, 3) in {O}; NaN without contacts."""
        return transform_points(self.X_OA, self.p_AQ), rotate_vectors(self.X_OA, self.nhat_Q_A)


def contacts_on_object(
    grasps: npt.ArrayLike | GraspRows,
    placed: PlacedObject,
    *,
    frame: str = "object",
    X_TC: npt.ArrayLike | None = None,
) -> list[PlacedGrasp]:
    """Return contacts on one object, in their order.

    Args:
        grasps: An array, see `read_grasps`, or a table of contacts.
        placed: The object.
        frame: Frame of the contacts.
        X_TC: With frame "camera": pose of the camera in {T}, (4, 4), or one per grasp (n, 4, 4).

    Raises:
        GraspError: As `drakegrasp.verify_grasps`.
    """
    table, config = _read(grasps, frame, placed.config), with_whole_lifts(placed.config)
    poses, found = _camera_poses(X_TC, frame, len(table)), list[PlacedGrasp]()
    for i, pose in enumerate(poses):
        # A caller who gives the pose of a camera may mean its inverse.
        inverse = {} if pose is None else {"the inverse of X_TC": invert_pose(pose)}
        found.append(_placed_contacts(table, i, placed, config, frame, pose, inverse))
    return found


def contacts_on_rows(
    grasps: npt.ArrayLike | GraspRows,
    dataset: GraspDataset,
    rows: RowChoice = None,
    *,
    config: Config,
    drawn: bool = True,
    frame: str = "camera",
    overrides: Sequence[str] = (),
) -> list[PlacedGrasp]:
    """Return contacts on the objects of a dataset's rows.

    Grasps of the same object are adjacent, so that its scene is built once.

    Args:
        grasps: See `contacts_on_object`.
        dataset: The split.
        rows: Row of each grasp, or one row for all; None for those of the table, else all rows.
        config: Configuration of `dataset_config`.
        drawn: Whether each grasp has the friction and mass that were drawn for its row.
        frame: Frame of the contacts.
        overrides: Settings of the caller; they take precedence over drawn values.

    Raises:
        GraspError: As `drakegrasp.verify_grasps`.
    """
    # Read all grasps before any object, so that a wrong number is reported at once.
    table = _read(grasps, frame, config)
    chosen = choose_rows(dataset, table.of_row if rows is None else rows, len(table))
    cameras, found = _cameras_of_rows(dataset, chosen), list[PlacedGrasp]()
    for i, placed, used in _objects_of_rows(dataset, chosen, config, drawn, overrides):
        seen = {name: X_TC[i] for name, X_TC in cameras.items()}
        found.append(_placed_contacts(table, i, placed, used, frame, seen[CAMERA], seen))
    return found


def place_on_object(
    grasps: npt.ArrayLike | GraspRows,
    placed: PlacedObject,
    *,
    frame: str = "object",
    overrides: Sequence[str] = (),
) -> list[PlacedGrasp]:
    """Return contacts or postures on one object, in their order.

    Postures are tried on this object, whatever object name they give. Postures that name no resting
    pose are tried in all resting poses of a build.

    Args:
        grasps: A table of postures, or see `contacts_on_object`.
        placed: The object.
        frame: Frame of contacts; postures have their own.
        overrides: Settings of the caller; they take precedence over the conditions of a posture.

    Raises:
        GraspError: As `drakegrasp.verify_grasps`.
    """
    if not isinstance(grasps, GraspTable):
        return contacts_on_object(grasps, placed, frame=frame)
    stands, config = [placed], placed.config
    if config.objects.resting_poses > 1:
        others = find_resting_poses(placed.model, config)[1:]
        stands += [replace(placed, X_TO=resting.X_TO) for resting in others]
    table = replace(grasps, objects=(placed.model.name,) * len(grasps))
    return _on_stands(table, range(len(table)), stands, config, overridden_keys(overrides))


def place_on_rows(
    grasps: npt.ArrayLike | GraspRows,
    dataset: GraspDataset,
    rows: RowChoice = None,
    *,
    config: Config,
    drawn: bool = True,
    frame: str = "camera",
    overrides: Sequence[str] = (),
) -> list[PlacedGrasp]:
    """Return contacts or postures on the objects of a dataset's rows; see `contacts_on_rows`.

    Postures are tried on the object and in the resting pose of their rows, whatever they state
    themselves.

    Raises:
        GraspError: As `contacts_on_rows`, or if postures are in the frames of mesh files.
    """
    if not isinstance(grasps, GraspTable):
        how: dict[str, Any] = {"drawn": drawn, "frame": frame, "overrides": overrides}
        return contacts_on_rows(grasps, dataset, rows, config=config, **how)
    _validate_no_mesh_frame(grasps)
    chosen = choose_rows(dataset, grasps.of_row if rows is None else rows, len(grasps))
    on_rows = _objects_of_rows(dataset, chosen, config, drawn, overrides)
    return [_posture_of_row(grasps, i, placed, used) for i, placed, used in on_rows]


def place_on_dataset(
    table: GraspTable, out: Path, config: Config | None = None, *, overrides: Sequence[str] = ()
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
        stands = _resting_objects(out, there, manifest.config)
        if name not in names:
            model = replace(stands[0].model, name=name)
            stands = [replace(stands[0], model=model, X_TO=np.full((4, 4), np.nan))]
        rows = [i for i, each in enumerate(table.objects) if each == name]
        rows.sort(key=table.resting.__getitem__)
        used = config or stands[0].config
        found += _on_stands(table, rows, stands, used, overridden_keys(overrides))
    return found


def _read(grasps: npt.ArrayLike | GraspRows, frame: str, config: Config) -> ContactRows:
    """Return a given table, or read contacts of the configuration's hand."""
    validate_frame(frame)
    if isinstance(grasps, GraspRows):
        assert isinstance(grasps, ContactRows)
        return grasps
    return read_grasps(grasps, load_hand(config.hand_source).num_fingers)


def _camera_poses(X_TC: npt.ArrayLike | None, frame: str, count: int) -> Sequence[Array | None]:
    """Return for each grasp the pose (4, 4) of its camera; None in other frames than "camera".

    Raises:
        GraspError: If the pose is missing, is given for another frame, or is not one per grasp.
    """
    if X_TC is None:
        if frame == "camera":
            raise GraspError(
                "X_TC must be the camera's pose in the table-top frame (frame_work2cam in the "
                "files) if frame is camera, got None"
            )
        return [None] * count
    poses = read_pose(X_TC, "X_TC")
    if frame != "camera":
        raise GraspError(f"X_TC must be None if frame is {frame}, got a pose")
    if poses.ndim == 3 and len(poses) != count:
        raise GraspError(f"X_TC must be one pose, or one per grasp ({count}), got {len(poses)}")
    return list(np.broadcast_to(poses, (count, 4, 4)))


def _placed_contacts(
    table: ContactRows,
    i: int,
    placed: PlacedObject,
    config: Config,
    frame: str,
    X_TC: Array | None,
    cameras: Mapping[str, Array],
) -> PlacedGrasp:
    """Return the contacts of a row on their object."""
    return PlacedGrasp(
        index=i,
        stands=(placed,),
        config=config,
        invalid=table.invalid[i],
        **_stated(table, i),
        p_AQ=table.points[i],
        nhat_Q_A=table.normals[i],
        X_OA=frame_in_object(frame, placed.X_TO, placed.model.X_OM, X_TC),
        cameras=cameras,
        normalised=bool(table.normalised[i]),
    )


def _validate_no_mesh_frame(table: GraspTable) -> None:
    """Reject postures in frames of meshes: a file cannot say which of both meshes it means.

    Meshes of a dataset are exported in {O}.
    """
    if table.frame == "mesh":
        raise GraspError(
            "frame must not be mesh for postures on a dataset, got mesh: for its exported meshes "
            "use --frame object, or give the mesh itself (drakegrasp verify FILE --object MESH)"
        )


def _on_stands(
    table: GraspTable,
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
        drawn = [_under(each, config, table.conditions[i], overridden) for each in tried]
        found.append(_placed_posture(table, i, i, tuple(each for each, _ in drawn), drawn[0][1]))
    return found


def _stands_of(
    table: GraspTable, i: int, stands: Sequence[PlacedObject], given: list[PlacedObject]
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


def _posture_of_row(table: GraspTable, i: int, placed: PlacedObject, config: Config) -> PlacedGrasp:
    """Return a posture on the object of its row, whatever pose of the object it states itself."""
    row = replace(
        table.at([i]),
        objects=(placed.model.name,),
        resting=np.zeros(1, dtype=np.int64),
        X_TO=np.full((1, 4, 4), np.nan),
    )
    row = row.refuse(misfits(row, placed.model.name, placed.model.scale, placed.X_TO[None]))
    return _placed_posture(row, 0, i, (placed,), config)


def _placed_posture(
    table: GraspTable, i: int, index: int, stands: tuple[PlacedObject, ...], config: Config
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
        **_stated(table, i),
        p_AQ=nothing,
        nhat_Q_A=nothing,
        postures=tuple(table.posture(i, each.X_TO, each.model.X_OM) for each in tried),
        preshapes=table.shapes(i, hand),
        named=table.names_pose(i),
    )


def _stated(table: GraspRows, i: int) -> dict[str, Any]:
    """Return the confidence of a row and its rank, as arguments of `PlacedGrasp`."""
    if table.confidence is None:
        return {}
    rank = -1 if table.rank is None else int(table.rank[i])
    return {"confidence": float(table.confidence[i]), "rank": rank}


def _objects_of_rows(
    dataset: GraspDataset,
    rows: npt.NDArray[np.int64],
    config: Config,
    drawn: bool,
    overrides: Sequence[str],
) -> Iterator[tuple[int, PlacedObject, Config]]:
    """Yield each index of rows (n,), with the row's object on the table and the configuration.

    Indices with the same object and resting pose are adjacent. Arguments are those of
    `place_on_rows`.
    """
    names = dataset.column("object_props/object_name")[rows].tolist()
    resting = dataset.column("grasp_props/resting")[rows].astype(np.int64)
    known = _drawn(dataset, rows) if drawn else np.full((len(rows), 3), np.nan)
    overridden, out = overridden_keys(overrides), dataset.path.parent
    if isinstance(dataset, SceneRows) and dataset.several:
        yield from _objects_in_scenes(dataset, rows, config, overridden)
        return
    manifest = read_manifest(out)
    for name in dict.fromkeys(names):
        stands = _resting_objects(out, name, manifest.config)
        of_object = [i for i, each in enumerate(names) if each == name]
        for i in sorted(of_object, key=resting.__getitem__):
            yield i, *_under(stands[resting[i]], config, known[i], overridden)


def _objects_in_scenes(
    dataset: SceneRows, rows: npt.NDArray[np.int64], config: Config, overridden: set[str]
) -> Iterator[tuple[int, PlacedObject, Config]]:
    """Yield the same for rows of scenes of several objects, where nothing is drawn for a row."""
    scenes, places, nothing = dataset.scenes[rows], dataset.places[rows], np.full(3, np.nan)
    for number in np.unique(scenes).tolist():
        scene = load_scene(dataset.path, number)
        for place in np.unique(places[scenes == number]).tolist():
            placed = scene.placed(place)
            for i in np.flatnonzero((scenes == number) & (places == place)).tolist():
                yield i, *_under(placed, config, nothing, overridden)


def _resting_objects(out: Path, name: str, config: Config) -> list[PlacedObject]:
    """Return an object of a dataset, with its configuration, in each of its resting poses."""
    prepared = load_prepared(out, name, config)
    return [
        PlacedObject(model=prepared.model, X_TO=X_TO, config=config)
        for X_TO in prepared.resting_poses
    ]


def _under(
    placed: PlacedObject, config: Config, conditions: Array, overridden: set[str]
) -> tuple[PlacedObject, Config]:
    """Return the object and the configuration under the `CONDITIONS` (3,) of a row; NaN: not drawn.

    Lifts are whole. Overridden values take precedence over those of the row.
    """
    config = with_whole_lifts(config)
    told, model = dict(zip(CONDITIONS, conditions.tolist(), strict=True)), placed.model
    mass = told.pop("mass")
    if np.isfinite(list(told.values())).any():
        frictions = {n: v if np.isfinite(v) else model.friction for n, v in told.items()}
        used = {
            name: value
            for name, value in frictions.items()
            if value is not None and f"physics.{name}" not in overridden
        }
        # The configuration's values come before the object's own, which would win otherwise.
        physics = config.physics.model_copy(update=used)
        config = config.model_copy(update={"physics": physics})
        model = replace(model, friction=None)
    if np.isfinite(mass) and "objects.mass" not in overridden and mass != model.mass:
        # The inertia scales with the mass.
        model = replace(model, mass=mass, I_OOcm_O=mass / model.mass * model.I_OOcm_O)
    return (placed if model is placed.model else replace(placed, model=model)), config


def _cameras_of_rows(dataset: GraspDataset, rows: npt.NDArray[np.int64]) -> dict[str, Array]:
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
        validate_config(config)
    manifest = read_manifest(dataset.path.parent)
    known, digest = manifest.config, manifest.versions.get("hand")
    if config is not None and config.hand == known.hand:
        config = config.with_hand(known.hand, known.hand_source)
    used = override_config(config or known, overrides) if overrides else config or known
    used = used if hand is None else override_config(used, [], hand=str(hand))
    validate_same_objects(used, known, "as in the dataset, whose objects are prepared")
    own = hand is None and used.hand == known.hand and digest is not None
    if own and (found := hand_digest(used.hand_source)) != digest:
        raise HandError(
            f"{used.hand}: files of the hand must be those of the dataset ({digest}), got others "
            f"({found}); name the hand to verify with it as it is now"
        )
    return used


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
