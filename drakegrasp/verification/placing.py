"""The requests of a caller: each grasp in {O} of its object on the table.

Input: contacts or postures, with an object, with the objects of a dataset, or with rows of a
dataset. Output: a `PlacedGrasp` for each. Every mistake of the caller is found here, before
anything is simulated; a bad row is not a mistake of the caller.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from drakegrasp.config import Config, with_whole_lifts
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.prepared_objects import load_prepared
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.dataset.schema import CAMERAS
from drakegrasp.errors import GraspError, HandError, listed
from drakegrasp.frames import (
    Array,
    as_numbers,
    frame_in_object,
    read_pose,
    refuse_other_frames,
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
    GraspRows,
    misfits,
    read_confidence,
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
from drakegrasp.verification.prediction import FRAMES, ContactRows, read_grasps

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
    """A grasp on an object on the table, with everything that its verification needs.

    Attributes:
        index: Index among the caller's grasps.
        stands: The object in its resting pose; in each of its resting poses for a posture that
            names none.
        method: "hand" or "forces" for contacts, "posture" for postures.
        config: Hand, physics, lift and rules. Lifts are whole (`lift.stop_when` is never), because
            the verdict is that of a whole lift.
        invalid: Reason why the grasp is invalid; empty if it is valid.
        frame: Frame {A} of the grasp's numbers.
        X_TC: Pose (4, 4) of the camera, for the frame "camera".
        cameras: Poses X_TC (4, 4) of cameras in whose frames the grasp could be, by the names of
            these frames.
        confidence: Confidence that the caller states; NaN if none is stated.
        rank: Rank by confidence among the grasps for the same row, or of the same object; 0 for the
            best, -1 without confidence.
        p_AQ, nhat_Q_A: (k, 3), contact points [m] and outward unit normals in {A}; NaN for a
            posture and for an invalid row.
        normalised: Whether a normal was not of unit length.
        snap_points: Whether to move contact points to the surface.
        postures: Wrist and joints in {O} for each of the stands; none for contacts and for an
            invalid row.
        preshapes: The preshapes in which a posture is tried; the name is empty if all fingers
            close.
        named: Whether a posture names its resting pose.
        X_AG: Pose (4, 4) of the palm of a posture in {A}; None for contacts.
        link: See `Attempts.link`.
        X_AG_xyzw: X_AG read with its quaternion in the order x, y, z, w; None if it has none.
    """

    index: int
    stands: tuple[PlacedObject, ...]
    method: str
    config: Config
    invalid: str = ""
    frame: str = "object"
    X_TC: Array | None = None
    cameras: Mapping[str, Array] = field(default_factory=dict)
    confidence: float = np.nan
    rank: int = -1
    p_AQ: Array
    nhat_Q_A: Array
    normalised: bool = False
    snap_points: bool = False
    postures: tuple[Posture, ...] = ()
    preshapes: tuple[str, ...] = ("",)
    named: bool = True
    X_AG: Array | None = None
    link: str = ""
    X_AG_xyzw: Array | None = None

    @property
    def placed(self) -> PlacedObject:
        """The object on the table, in the first of the resting poses."""
        return self.stands[0]

    def X_OA(self, placed: PlacedObject) -> Array:
        """Return the pose (4, 4) of the frame of the grasp's numbers in {O} of a resting object."""
        return frame_in_object(self.frame, placed.X_TO, placed.model.X_OM, self.X_TC)

    def in_object_frame(self) -> tuple[Array, Array]:
        """Return points p_OQ [m] and unit normals nhat_Q_O (k, 3) in {O}; NaN without contacts."""
        X_OA = self.X_OA(self.placed)
        return transform_points(X_OA, self.p_AQ), rotate_vectors(X_OA, self.nhat_Q_A)


def place_on_object(
    grasps: npt.ArrayLike | GraspRows,
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
    stands, config = [placed], placed.config
    table = _read(grasps, method, config)
    if isinstance(table, ContactRows):
        poses = _camera_poses(frame, X_TC, len(table))
        request = _Request(table=table, method=method, snap_points=snap_points, frame=frame,
                           X_TC=poses)  # fmt: skip
    else:
        request = _Request.of_postures(
            replace(table, objects=(placed.model.name,) * len(table)), overrides
        )
        if config.objects.resting_poses > 1:
            others = find_resting_poses(placed.model, config)[1:]
            stands += [replace(placed, X_TO=resting.X_TO) for resting in others]
    return request.place(range(len(table)), stands, config)


def place_on_rows(
    grasps: npt.ArrayLike | GraspRows,
    dataset: GraspDataset,
    rows: RowChoice = None,
    *,
    config: Config,
    drawn: bool = True,
    frame: str = "camera",
    method: str = "hand",
    snap_points: bool = False,
    overrides: Sequence[str] = (),
) -> list[PlacedGrasp]:
    """Return grasps in {O} of the objects of a dataset's rows.

    Grasps of the same object are adjacent, so that its scene is built once. Arguments and errors
    are those of `drakegrasp.verify_grasps`; the configuration is of `dataset_config`. One row may
    be given for all grasps. With `drawn`, each grasp has the friction and mass that were drawn for
    its row, except for overridden values. Postures are tried on the object and in the resting pose
    of their rows, whatever they state themselves.
    """
    # Read all grasps before any object, so that a wrong number is reported at once.
    table = _read(grasps, method, config)
    chosen = choose_rows(dataset, table.of_row if rows is None else rows, len(table))
    cameras = cameras_of_rows(dataset, chosen)

    # Object, resting pose and drawn conditions are those of the rows.
    objects = tuple(dataset.column("object_props/object_name")[chosen].tolist())
    resting = dataset.column("grasp_props/resting")[chosen].astype(np.int64)
    known = _drawn(dataset, chosen) if drawn else np.full((len(table), 3), np.nan)
    if isinstance(table, ContactRows):
        X_TC = _camera_poses(frame, cameras[CAMERA] if frame == "camera" else None, len(table))
        request = _Request(table=table, method=method, snap_points=snap_points, frame=frame,
                           X_TC=X_TC, resting=resting, conditions=known,
                           overrides=overrides)  # fmt: skip
    else:
        nowhere = np.full((len(table), 4, 4), np.nan)
        table = replace(table, objects=objects, resting=resting, X_TO=nowhere, conditions=known)
        request = _Request.of_postures(table, overrides)
    request = replace(request, cameras={**cameras, **request.cameras})
    return request.place_on_objects(objects, dataset.path.parent, config)


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
    return _Request.of_postures(table, overrides).place_on_objects(table.objects, out, config)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Request:
    """n grasps of a caller, and where they are; columns as in `Attempts`, None if not stated."""

    table: ContactRows | Attempts
    method: str
    snap_points: bool = False
    overrides: Sequence[str] = ()
    frame: str
    X_TC: Array | None = None
    cameras: Mapping[str, Array] = field(default_factory=dict)
    resting: npt.NDArray[np.int64] | None = None
    X_TO: Array | None = None
    conditions: Array | None = None

    @classmethod
    def of_postures(cls, table: Attempts, overrides: Sequence[str]) -> _Request:
        """Return the request of postures, which state themselves where they are."""
        return cls(
            table=table,
            method="posture",
            overrides=overrides,
            frame=table.frame,
            X_TC=table.X_TC,
            cameras={} if table.X_TC is None else {CAMERA: table.X_TC},
            resting=table.resting,
            X_TO=table.X_TO,
            conditions=table.conditions,
        )

    def place_on_objects(
        self, objects: Sequence[str], out: Path, config: Config | None
    ) -> list[PlacedGrasp]:
        """Return the rows on the objects (n,) of a dataset, object by object."""
        if self.frame == "mesh" and isinstance(self.table, Attempts):
            # Meshes of a dataset are exported in {O}: a file cannot say which of both meshes it
            # means.
            raise GraspError(
                "frame must not be mesh for postures on a dataset, got mesh: for its exported "
                "meshes use --frame object, or give the mesh itself (drakegrasp verify FILE "
                "--object MESH)"
            )
        manifest, placed = read_manifest(out), list[PlacedGrasp]()
        names = [entry.name for entry in manifest.objects]
        for name in dict.fromkeys(objects):
            # An object that does not exist is known by its name alone.
            there = name if name in names else names[0]
            own = manifest.config
            prepared = load_prepared(out, there, own)
            model, poses, request = prepared.model, [*prepared.resting_poses], self
            if name != there:
                model, poses = replace(model, name=name), [np.full((4, 4), np.nan)]
                reason = f"object must be one of {listed(names)}, got {name!r}"
                request = replace(self, table=self.table.refuse([reason] * len(objects)))
            stands = [PlacedObject(model=model, X_TO=X_TO, config=own) for X_TO in poses]
            rows = [i for i, each in enumerate(objects) if each == name]
            if self.resting is not None:
                rows.sort(key=self.resting.__getitem__)
            placed += request.place(rows, stands, config or own)
        return placed

    def place(
        self, rows: Iterable[int], stands: Sequence[PlacedObject], config: Config
    ) -> list[PlacedGrasp]:
        """Return some rows on one object, given in each of its resting poses."""
        table, config = self.table, with_whole_lifts(config)
        nothing = np.full((load_hand(config.hand_source).num_fingers, 3), np.nan)
        if isinstance(table, Attempts):
            # A row that gives the pose of the object is tried in that pose, even if no drop ended
            # in it.
            anywhere = replace(table, X_TO=np.full_like(table.X_TO, np.nan))
            poses, model = np.array([each.X_TO for each in stands]), stands[0].model
            table = table.refuse(misfits(anywhere, model.name, model.scale, poses))
        overridden = overridden_keys(self.overrides)
        given, found = list[PlacedObject](), list[PlacedGrasp]()
        for i in rows:
            invalid, tried = table.invalid[i], stands[:1]
            if not invalid:
                try:
                    tried = self._stands_of(i, stands, given)
                except GraspError as error:
                    invalid = str(error)
            told = np.full(3, np.nan) if self.conditions is None else self.conditions[i]
            under = [_under(each, config, told, overridden) for each in tried]
            grasp = PlacedGrasp(
                index=i,
                stands=tuple(each for each, _ in under),
                method=self.method,
                config=under[0][1],
                invalid=invalid,
                frame=self.frame,
                X_TC=None if self.X_TC is None else self.X_TC[i],
                cameras={name: X_TC[i] for name, X_TC in self.cameras.items()},
                confidence=np.nan if table.confidence is None else float(table.confidence[i]),
                rank=-1 if table.confidence is None or table.rank is None else int(table.rank[i]),
                p_AQ=nothing,
                nhat_Q_A=nothing,
                snap_points=self.snap_points,
            )
            if isinstance(table, ContactRows):
                found.append(_with_contacts(grasp, table, i))
            else:
                found.append(_with_posture(grasp, table, i))
        return found

    def _stands_of(
        self, i: int, stands: Sequence[PlacedObject], given: list[PlacedObject]
    ) -> Sequence[PlacedObject]:
        """Return the object in each pose that a row is tried in.

        Args:
            i: Index of the row.
            stands: The object in its resting poses.
            given: The object in poses that rows gave; a new one is added, and equal ones are
                shared.

        Raises:
            GraspError: If the row gives a pose in which the object does not stand on the table.
        """
        if self.X_TO is None or np.isnan(self.X_TO[i]).any():
            named = UNTOLD if self.resting is None else int(self.resting[i])
            if named >= len(stands):
                raise GraspError(f"resting must be 0 to {len(stands) - 1}, got {named}")
            return stands if named == UNTOLD else [stands[named]]
        stood = canonical_pose(self.X_TO[i])
        for each in (*stands, *given):
            if np.abs(each.X_TO_simulated - stood).max() < SAME_POSE:
                return [each]
        given.append(place_object(stands[0], X_TO=self.X_TO[i]))
        return given[-1:]


def _with_contacts(grasp: PlacedGrasp, table: ContactRows, i: int) -> PlacedGrasp:
    """Return a grasp with the contacts of a row."""
    return replace(
        grasp,
        p_AQ=table.points[i],
        nhat_Q_A=table.normals[i],
        normalised=bool(table.normalised[i]),
    )


def _with_posture(grasp: PlacedGrasp, table: Attempts, i: int) -> PlacedGrasp:
    """Return a grasp with the posture of a row."""
    xyzw = None if table.X_FG_xyzw is None else table.X_FG_xyzw[i]
    there = () if grasp.invalid else grasp.stands
    return replace(
        grasp,
        postures=tuple(table.posture(i, each.X_TO, each.model.X_OM) for each in there),
        preshapes=table.shapes(i, load_hand(grasp.config.hand_source)),
        named=table.names_pose(i),
        X_AG=table.X_FG[i],
        link=table.link,
        X_AG_xyzw=None if xyzw is None or np.isnan(xyzw).any() else xyzw,
    )


def _under(
    placed: PlacedObject, config: Config, conditions: Array, overridden: set[str]
) -> tuple[PlacedObject, Config]:
    """Return the object and the configuration under the `CONDITIONS` (3,) of a row."""
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


def _read(grasps: npt.ArrayLike | GraspRows, method: str, config: Config) -> ContactRows | Attempts:
    """Return a given table of grasps, or read contacts of the configuration's hand."""
    if method not in METHODS:
        raise GraspError(f"method must be one of {', '.join(METHODS)}, got {method!r}")
    if isinstance(grasps, GraspRows):
        assert isinstance(grasps, ContactRows | Attempts)
        return grasps
    return read_grasps(grasps, load_hand(config.hand_source).num_fingers)


def _camera_poses(frame: str, X_TC: npt.ArrayLike | None, count: int) -> Array | None:
    """Return the poses (n, 4, 4) of the cameras in whose frames contacts are; None without one.

    Args:
        frame: "object" {O}, "camera" {C}, "table" {T} or "mesh" {M}.
        X_TC: With the frame "camera": pose of the camera, (4, 4), or one per grasp (n, 4, 4).
        count: Number of grasps, n.

    Raises:
        GraspError: If the frame is unknown, or the camera's pose is missing, is given for another
            frame, or is not one per grasp.
    """
    refuse_other_frames(frame, FRAMES)
    if X_TC is None:
        if frame == "camera":
            raise GraspError(
                "X_TC must be the camera's pose in the table-top frame (frame_work2cam in the "
                "files) if frame is camera, got None"
            )
        return None
    poses = read_pose(X_TC, "X_TC")
    if frame != "camera":
        raise GraspError(f"X_TC must be None if frame is {frame}, got a pose")
    each = np.broadcast_to(poses, (count, 4, 4)) if poses.ndim == 2 else poses
    if len(each) != count:
        raise GraspError(f"X_TC must be one pose, or one per grasp ({count}), got {len(each)}")
    return each


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
) -> ContactRows:
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
