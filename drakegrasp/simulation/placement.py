"""An object at rest on the table, against which grasps are verified, and the trial of a posture.

Input: a mesh file, a trimesh or a prepared object. Output: the object and its resting pose.
Verification simulates at `canonical_pose`, so that no verdict depends on where the object stands on
the table and how it is turned about the vertical.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt
import trimesh

from drakegrasp.arithmetic import multiply
from drakegrasp.config import Config, with_whole_lifts
from drakegrasp.errors import ConfigError, GraspError, MeshError
from drakegrasp.frames import Array, invert_pose, make_pose, read_pose, transform_points
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.settings import load_config, override_config
from drakegrasp.mesh.loading import clean_triangles
from drakegrasp.objects.model import ObjectModel, make_object, prepare_object
from drakegrasp.objects.sources import UNITS, find_mesh, validate_units
from drakegrasp.objects.surroundings import Neighbourhood
from drakegrasp.runtime.environment import one_thread
from drakegrasp.simulation.attempts import make_posture
from drakegrasp.simulation.posture import Posture, start_of
from drakegrasp.simulation.scene_cache import run_cached
from drakegrasp.simulation.settle import settle
from drakegrasp.simulation.trial import TrialRecord

#: Largest distance of the object's lowest point from the table at a given pose [m].
MAX_GAP = 0.005
#: Poses whose entries differ by less than this are the same, [m] and of unit vectors: a few times
#: the grid of resting poses.
SAME_PLACE = 5e-6


@dataclass(frozen=True, kw_only=True, eq=False)
class PlacedObject:
    """An object on the table.

    Attributes:
        model: Meshes and mass properties.
        X_TO: Pose in the table-top frame, (4, 4).
        config: The configuration with which the object was prepared and dropped; by default that
            of `load_config()`.
        around: Neighbours and walls around it; None if it is alone on the table.
        X_TO_rest: Resting pose (4, 4) from which X_TO differs only by yaw, a shift and rounding;
            None if it is not known.
    """

    model: ObjectModel
    X_TO: Array
    config: Config = field(default_factory=load_config)
    around: Neighbourhood | None = None
    X_TO_rest: Array | None = None

    @cached_property
    def X_TO_simulated(self) -> Array:
        """Pose (4, 4) moved to the table's centre, without yaw; verdicts depend on neither."""
        return canonical_pose(self.X_TO if self.X_TO_rest is None else self.X_TO_rest)

    @property
    def around_simulated(self) -> Neighbourhood | None:
        """What is around the object at `X_TO_simulated`."""
        if self.around is None:
            return None
        return self.around.moved(multiply(self.X_TO_simulated, invert_pose(self.X_TO)))

    def __repr__(self) -> str:
        model, z = self.model, self.X_TO[2, 3]
        size = " x ".join(f"{2e3 * half:.0f}" for half in model.half_extents)
        return f"PlacedObject({model.name!r}): {size} mm, {model.mass:g} kg, p_TO at z = {z:.4f} m"


@one_thread
def place_object(
    mesh: str | Path | trimesh.Trimesh | PlacedObject,
    *,
    units: str | None = None,
    X_TO: npt.ArrayLike | None = None,
    hand: str | Path | None = None,
    config: Config | None = None,
) -> PlacedObject:
    """Return an object on the table, prepared once for any number of grasps.

    Args:
        mesh: Path of a mesh file, a mesh, or a placed object. The origin of {O} is the centre of
            the bounding box, not the origin of the file.
        units: Unit of the mesh's lengths: m, cm or mm; metres if None. An `objects.yaml` in
            the folder of the mesh overrides it. Grasps are always in metres.
        X_TO: Pose of the object on the table, (4, 4); if None, the object is dropped as in a build.
        hand: Name or YAML file of the hand; None for the configuration's ("barrett").
        config: Hand, physics, lift and rules; if None, the configuration of a placed object, or
            else the defaults.

    Raises:
        MeshError: If the mesh cannot be simulated or does not come to rest.
        GraspError: If X_TO is not a pose or does not put the object on the table, or the object is
            among others.
        ConfigError: If config is not a `Config`, or the object was placed with other values.
        HandError: If the hand cannot be used.
    """
    # Check the arguments that do not depend on the kind of mesh.
    config = config_for(mesh, config)
    if hand is not None:
        config = override_config(config, [], hand=str(hand))
    validate_units(units or "m")

    # Prepare the object, unless it is already prepared.
    if isinstance(mesh, PlacedObject):
        if units is not None:
            raise MeshError(f"units must be None for a prepared object, got {units!r}")
        validate_same_objects(config, mesh.config, "as the object was placed with")
        if X_TO is None:
            return replace(mesh, config=config)
        if mesh.around is not None:
            raise GraspError("X_TO must be None for an object among others, got a pose")
        model = mesh.model
    elif isinstance(mesh, trimesh.Trimesh):
        model = _model_of(mesh, units or "m", config)
    elif isinstance(mesh, str | Path):
        model = prepare_object(find_mesh(mesh, units=units or "m"), config.objects)
    else:
        raise MeshError(
            "mesh must be a mesh file, a trimesh.Trimesh or a placed object, "
            f"got {type(mesh).__name__}"
        )

    # Take the given pose, or drop the object.
    if X_TO is None:
        return PlacedObject(model=model, X_TO=settle(model, config).X_TO, config=config)
    return PlacedObject(model=model, X_TO=_standing(model, read_pose(X_TO, "X_TO")), config=config)


@one_thread
def run_trial(placed: PlacedObject, posture: Posture, config: Config | None = None) -> TrialRecord:
    """Close a simulated hand by a posture, lift the object, and return what happened.

    The object is simulated at `PlacedObject.X_TO_simulated`. If the closed hand may lift, it always
    lifts until it is certain whether it holds, regardless of the section `lift`. Contacts are those
    of the fingers of the posture's preshape.

    Args:
        placed: The object on the table, see `place_object`.
        posture: Wrist and joints, see `simulation.attempts.make_posture`.
        config: Hand, physics and lift; None for the configuration of the placed object.

    Raises:
        GraspError: If the posture does not fit the hand, or `placed` is not a placed object.
        ConfigError: If the object was placed with other values, or the hand cannot have the drive.
        HandError: If the hand cannot be used.
    """
    if not isinstance(placed, PlacedObject):
        raise GraspError(f"placed must be of place_object, got a {type(placed).__name__}")
    if not isinstance(posture, Posture):
        raise GraspError(f"posture must be a Posture, got a {type(posture).__name__}")
    config = with_whole_lifts(config_for(placed, config))
    validate_same_objects(config, placed.config, "as the object was placed with")
    hand, q = (
        load_hand(config.hand_source),
        (posture.q_grasp, posture.q_pregrasp, posture.q_squeeze),
    )
    checked = make_posture(hand, posture.X_OG, *q, preshape=posture.preshape)
    start = start_of(checked, hand)
    return run_cached(placed.model, placed.X_TO_simulated, start, config, placed.around_simulated)


def config_for(mesh: object, config: Config | None) -> Config:
    """Return the given configuration, or else that of a placed object, or else the defaults.

    Raises:
        ConfigError: If the given configuration is not a `Config`.
    """
    if config is None:
        return mesh.config if isinstance(mesh, PlacedObject) else load_config()
    validate_config(config)
    return config


def validate_config(config: object) -> None:
    """Reject anything but a `Config`, such as the name of a preset.

    Raises:
        ConfigError: If `config` is not a `Config`.
    """
    if not isinstance(config, Config):
        raise ConfigError(
            f"config must be a Config, see load_config, got a {type(config).__name__}"
        )


def validate_same_objects(config: Config, known: Config, must_be: str) -> None:
    """Reject a configuration that prepares and drops objects differently from a known one.

    Raises:
        ConfigError: If the section `objects` or `settle` differs.
    """
    for name in ("objects", "settle"):
        if getattr(config, name) != getattr(known, name):
            raise ConfigError(f"{name} must be {must_be}, got other values; give the mesh instead")


def canonical_pose(X_TO: Array) -> Array:
    """Return the pose (4, 4) that differs from X_TO only by yaw and by a shift on the table.

    Its position is over the table's centre. Its rotation is the smallest rotation with the same up
    direction in {O} as X_TO. It is computed in closed form, because SciPy's
    `Rotation.align_vectors` calls LAPACK, whose bits depend on the CPU, and is not defined for an
    upside-down pose.
    """
    up = X_TO[2, :3]
    axis = np.cross(up, [0.0, 0.0, 1.0])
    x, y, z = axis
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])

    # Rodrigues' formula R = 1 + K + K K / (1 + cos), with |axis| = sin and up_z = cos. If cos is
    # negative, 1 + cos = sin^2 / (1 - cos) avoids cancellation. Upside down, R is half a turn about
    # x.
    upright = 1.0 + up[2] if up[2] > 0.0 else axis @ axis / (1.0 - up[2])
    R = np.eye(3) + K + K @ K / upright if upright > 1e-20 else np.diag([1.0, -1.0, -1.0])
    return make_pose(R, [0.0, 0.0, X_TO[2, 3]])


def aligned_pose(X_TO: Array, resting_poses: Array) -> Array:
    """Return the pose (4, 4) at which an object is simulated that stands among others.

    Args:
        X_TO: Its pose, (4, 4).
        resting_poses: Its resting poses, (r, 4, 4).

    Returns:
        The resting pose from which X_TO differs only by yaw and by a shift, so that an object alone
        gives the bits of its own trials; otherwise `canonical_pose(X_TO)`.
    """
    stands = canonical_pose(X_TO)
    for known in resting_poses:
        if np.abs(canonical_pose(known) - stands).max() < SAME_PLACE:
            return np.asarray(known)
    return stands


def _model_of(mesh: trimesh.Trimesh, units: str, config: Config) -> ObjectModel:
    """Return the object of a mesh."""
    given = np.asarray(mesh.vertices, dtype=float), np.asarray(mesh.faces, dtype=np.int64)
    clean = clean_triangles(*given, "mesh")
    vertices = clean.vertices * UNITS[units]
    digest = hashlib.sha256(vertices.tobytes() + clean.faces.tobytes()).hexdigest()
    try:
        return make_object(
            vertices,
            clean.faces,
            config.objects,
            name="mesh",
            class_name="mesh",
            mesh_sha256=digest,
            unit=f" with 1 unit = {UNITS[units]:g} m",
        )
    except MeshError as reason:
        raise MeshError(f"mesh: {reason}") from reason


def _standing(model: ObjectModel, X_TO: Array) -> Array:
    if X_TO.shape != (4, 4):
        raise GraspError(f"X_TO must be one pose, got an array of shape {X_TO.shape}")
    lowest = float(transform_points(X_TO, model.collision_vertices)[:, 2].min())
    if abs(lowest) > MAX_GAP:
        raise GraspError(
            f"X_TO must put the object on the table, its lowest point within {1e3 * MAX_GAP:g} mm, "
            f"got one at {1e3 * lowest:.3g} mm"
        )
    return X_TO
