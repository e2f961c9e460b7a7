"""The object that Drake simulates: a mesh file comes in, an `ObjectModel` goes out.

An `ObjectModel` is a watertight solid in metres with its origin {O} at the centre of the bounding
box, mass properties of uniform density, and a collision mesh that is not too fine for hydroelastic
contact. Drake accepts open, inverted and flat meshes without a warning and simulates nonsense, so
all that it needs is checked here. Faults are repaired (`drakegrasp.mesh.repair`) and noted, or the
mesh is refused with a `MeshError`.
"""

from __future__ import annotations

import hashlib
import io
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import trimesh

from drakegrasp.arithmetic import dot
from drakegrasp.config import ObjectConfig, PhysicsConfig
from drakegrasp.errors import MeshError, one_line
from drakegrasp.foreign_files import is_name, read_npz
from drakegrasp.frames import Array, make_pose
from drakegrasp.mesh.components import count_parts
from drakegrasp.mesh.distance_field import DistanceField, make_distance_field
from drakegrasp.mesh.remeshing import coarsen, decimate, resting_hull
from drakegrasp.mesh.repair import repair_solid
from drakegrasp.mesh.surfaces import Solid, diagonal, signed_volume
from drakegrasp.objects.sources import (
    MANIFEST_NAME,
    UNITS,
    UPRIGHT,
    MeshSource,
    load_source,
    upright_vertices,
)
from drakegrasp.runtime.files import write_atomic

#: Smaller objects are sheets or specks, which hydroelastic contact does not resolve.
MIN_EXTENT = 0.5e-3  # [m]
MIN_VOLUME = 1e-9  # [m^3]
#: Type and shape of each array of a model.
_ARRAYS = {
    **dict.fromkeys(("visual_vertices", "collision_vertices"), (np.float64, (None, 3))),
    **dict.fromkeys(("visual_faces", "collision_faces"), (np.int32, (None, 3))),
    **dict.fromkeys(("p_OOcm", "p_OM"), (np.float64, (3,))),
    "I_OOcm_O": (np.float64, (3, 3)),
}


@dataclass(frozen=True, kw_only=True, eq=False)
class ObjectModel:
    """A rigid object, ready to be simulated. Lengths are in [m]; all arrays are read-only.

    Attributes:
        name: Unique name.
        class_name: Name of the class.
        mesh_sha256: Hash of the source file's bytes and of its attributes, see `source_sha256`,
            hexadecimal.
        visual_vertices: (n, 3) float64, in {O}, full resolution.
        visual_faces: (m, 3) int32, counter-clockwise seen from outside.
        collision_vertices: (k, 3) float64, in {O}.
        collision_faces: (l, 3) int32.
        mass: Mass [kg].
        p_OOcm: (3,) centre of mass.
        p_OM: (3,) origin of the source file, see `X_OM`.
        I_OOcm_O: (3, 3) rotational inertia about the centre of mass, in axes of {O} [kg m^2].
        collision_error: Largest distance between visual and collision surface.
        notes: What was repaired, and what is unexpected about how the object rests, in sentences.
        friction: The object's own effective coefficient of friction with hand and table; None:
            the configuration's coefficients.
        scale: Metres per unit of length of the source file.
        up: Axis of the source file that is +z of {O}.
    """

    name: str
    class_name: str
    mesh_sha256: str
    visual_vertices: Array
    visual_faces: npt.NDArray[np.int32]
    collision_vertices: Array
    collision_faces: npt.NDArray[np.int32]
    mass: float
    p_OOcm: Array
    p_OM: Array
    I_OOcm_O: Array
    collision_error: float
    notes: tuple[str, ...] = ()
    friction: float | None = None
    scale: float = 1.0
    up: str = "+z"

    def __post_init__(self) -> None:
        for key, (dtype, shape) in _ARRAYS.items():
            array = np.array(getattr(self, key), dtype=dtype, order="C")
            if len(array.shape) != len(shape) or array.shape[-1] != 3 or not array.size:
                raise MeshError(f"{self.name}: {key} must have shape {shape}, got {array.shape}")
            array.setflags(write=False)
            object.__setattr__(self, key, array)

    def __getstate__(self) -> dict[str, Any]:
        """Return the fields alone: the R-tree of a surface that was used is empty once pickled."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @property
    def half_extents(self) -> Array:
        """Half of the bounding box's edges (3,) [m]; its centre is the origin of {O}."""
        return np.asarray(np.ptp(self.visual_vertices, axis=0) / 2.0)

    @property
    def X_OM(self) -> Array:
        """Pose (4, 4) in {O} of the frame of the source file, with lengths in metres."""
        return make_pose(UPRIGHT[self.up], self.p_OM)

    @property
    def volume(self) -> float:
        """Volume of the solid [m^3]."""
        return signed_volume(self.visual_vertices, self.visual_faces.astype(np.int64))

    @property
    def density(self) -> float:
        """Mass over volume [kg/m^3]."""
        return self.mass / self.volume

    def own_physics(self, physics: PhysicsConfig) -> PhysicsConfig:
        """Return the physics with the object's own friction, if it has one."""
        if self.friction is None:
            return physics
        own = {"friction_hand": self.friction, "friction_table": self.friction}
        return physics.model_copy(update=own)

    @cached_property
    def visual(self) -> trimesh.Trimesh:
        """The visual surface in {O}."""
        return trimesh.Trimesh(self.visual_vertices, self.visual_faces, process=False)

    @cached_property
    def collision(self) -> trimesh.Trimesh:
        """The collision surface in {O}."""
        return trimesh.Trimesh(self.collision_vertices, self.collision_faces, process=False)

    @property
    def collision_solid(self) -> Solid:
        """The collision surface in {O}, which touches the hand."""
        return Solid(vertices=self.collision_vertices, faces=self.collision_faces.astype(np.int64))

    @cached_property
    def resting_surface(self) -> Solid:
        """The surface in {O} that touches the table: the convex hull of the collision surface."""
        return resting_hull(self.collision_vertices)

    @cached_property
    def field(self) -> DistanceField:
        """Distances from the collision surface."""
        return make_distance_field(self.collision_vertices, self.collision_faces)


# Preparation


def prepare_object(
    source: MeshSource,
    config: ObjectConfig | None = None,
    read: tuple[bytes, str] | None = None,
) -> ObjectModel:
    """Return the simulated object of a mesh file, repaired if that invents no shape.

    Args:
        source: The mesh file, with its unit of length.
        config: Mass of objects without their own mass, and limits of size and faces; the defaults
            if None.
        read: Content and hash of the file, see `read_source`; None: the file is read now.

    Raises:
        MeshError: If the file is not a mesh, its size is implausible, or it cannot become a solid;
            the message has the reason.
    """
    mesh, digest = load_source(source, read)
    vertices, faces = upright_vertices(mesh, source), np.asarray(mesh.faces)
    del mesh  # it may be large
    config = config or ObjectConfig()
    if source.mass is not None:
        config = config.model_copy(update={"mass": source.mass})
    try:
        model = make_object(
            vertices,
            faces,
            config,
            name=source.name,
            class_name=source.class_name,
            mesh_sha256=digest,
            unit=f" with 1 unit = {source.scale:g} m",
        )
    except MeshError as reason:
        raise MeshError(f"{source.path.name}: {reason}") from reason

    # Add what the triangles do not specify.
    model = replace(model, friction=source.friction, scale=source.scale, up=source.up)
    if source.density is None:
        return model
    factor = source.density / model.density
    return replace(model, mass=factor * model.mass, I_OOcm_O=factor * model.I_OOcm_O)


def make_object(
    vertices: npt.ArrayLike,
    faces: npt.ArrayLike,
    config: ObjectConfig,
    *,
    name: str,
    class_name: str,
    mesh_sha256: str,
    unit: str = "",
) -> ObjectModel:
    """Return the simulated object of a surface, see `prepare_object`.

    Args:
        vertices: (n, 3) [m].
        faces: (m, 3).
        config: Mass, and limits of size and faces.
        name: Name of the object.
        class_name: Class of the object.
        mesh_sha256: Hash of the object's source.
        unit: The assumed unit of length, for the message if the size is refused.

    Raises:
        MeshError: If the size is implausible, or the surface cannot become a solid.
    """
    # A wrong unit results in an implausible size.
    vertices, faces = np.asarray(vertices, dtype=float), np.asarray(faces)
    size = diagonal(vertices)
    if not config.min_diagonal <= size <= config.max_diagonal:
        raise MeshError(
            f"the diagonal of the bounding box must be {config.min_diagonal:g} m to "
            f"{config.max_diagonal:g} m, got {size:.4g} m{unit}: state the "
            f"unit of the file with --units (units in Python; {', '.join(UNITS)}) or in "
            f"{MANIFEST_NAME}"
        )

    # One watertight solid, with no more faces than there is memory to repair.
    vertices, faces, reduced = coarsen(vertices, faces)
    solid = repair_solid(vertices, faces)
    _validate_solid(solid)
    notes = (*reduced, *solid.notes)
    parts = count_parts(solid.vertices, solid.faces)
    if parts > 1:
        notes = (*notes, f"{parts} parts do not touch and will move as one")
    solid = replace(solid, notes=notes)
    return object_of(solid, config, name=name, class_name=class_name, mesh_sha256=mesh_sha256)


def object_of(
    solid: Solid, config: ObjectConfig, *, name: str, class_name: str, mesh_sha256: str
) -> ObjectModel:
    """Return the object of a sound solid; its `p_OM` is the origin of the solid's frame.

    Raises:
        MeshError: If no solid has such mass properties, or the surface cannot be decimated.
    """
    # In {O}, whose origin is the centre of the bounding box.
    centre = (solid.vertices.min(axis=0) + solid.vertices.max(axis=0)) / 2.0
    visual = Solid(vertices=solid.vertices - centre, faces=solid.faces)
    p_OOcm, I_OOcm_O = _mass_properties(visual, config.mass)
    collision, error = decimate(visual, config.max_collision_faces)
    return ObjectModel(
        name=name,
        class_name=class_name,
        mesh_sha256=mesh_sha256,
        visual_vertices=visual.vertices,
        visual_faces=visual.faces.astype(np.int32),
        collision_vertices=collision.vertices,
        collision_faces=collision.faces.astype(np.int32),
        mass=config.mass,
        p_OOcm=p_OOcm,
        p_OM=-centre,
        I_OOcm_O=I_OOcm_O,
        collision_error=error,
        notes=solid.notes,
    )


def _validate_solid(solid: Solid) -> None:
    """Raise an error for sheets, specks, and a volume that contradicts the convex hull."""
    extents = np.ptp(solid.vertices, axis=0)
    if extents.min() < MIN_EXTENT:
        raise MeshError(
            f"the object must be at least {MIN_EXTENT * 1e3:g} mm thick, "
            f"got {extents.min() * 1e3:.3g} mm"
        )
    volume = signed_volume(solid.vertices, solid.faces)
    if volume < MIN_VOLUME:
        raise MeshError(f"the volume must be at least {MIN_VOLUME:g} m^3, got {volume:.3g} m^3")
    hull = trimesh.Trimesh(solid.vertices, solid.faces, process=False).convex_hull.volume
    if volume > hull * (1.0 + 1e-6):
        raise MeshError(
            f"the volume must be within the convex hull's, {hull:.4g} m^3, got {volume:.4g} m^3"
        )


def _mass_properties(solid: Solid, mass: float) -> tuple[Array, Array]:
    """Return p_OOcm (3,) [m] and I_OOcm_O (3, 3) [kg m^2] of a solid of uniform density."""
    triangles = solid.vertices[solid.faces]
    volume = signed_volume(solid.vertices, solid.faces)
    properties = trimesh.triangles.mass_properties(triangles, density=mass / volume)
    p_OOcm = np.asarray(properties["center_mass"])
    inertia = np.asarray(properties["inertia"])
    I_OOcm_O = (inertia + inertia.T) / 2.0

    # Values that are impossible for a solid are due to an error of the surface.
    moments = np.linalg.eigvalsh(I_OOcm_O)
    if not (moments[0] > 0.0 and moments[0] + moments[1] >= moments[2] * (1.0 - 1e-9)):
        raise MeshError(f"the moments of inertia must obey the triangle inequality, got {moments}")
    hull = trimesh.Trimesh(solid.vertices, solid.faces, process=False).convex_hull
    outside = np.einsum("ij,ij->i", p_OOcm - hull.triangles[:, 0], hull.face_normals).max()
    if outside > 1e-9:
        raise MeshError(f"the centre of mass must be inside the convex hull, got {p_OOcm}")
    return p_OOcm, I_OOcm_O


# Storage


def save_object(model: ObjectModel, path: str | Path) -> str:
    """Write an object to a .npz file, atomically, and return the file's hexadecimal hash."""
    # Equal objects produce equal bytes, since `np.savez` stores no time stamps.
    content: dict[str, Any] = {f.name: np.asarray(getattr(model, f.name)) for f in fields(model)}
    content["notes"] = np.array(model.notes, dtype=np.str_)
    content["friction"] = np.float64(np.nan if model.friction is None else model.friction)
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **content)
    write_atomic(Path(path), buffer.getvalue())
    return hashlib.sha256(buffer.getbuffer()).hexdigest()


def load_object(path: str | Path, content: bytes | None = None) -> ObjectModel:
    """Return an object that `save_object` wrote.

    Args:
        path: Path of the file.
        content: Content of the file; None: it is read now.

    Raises:
        MeshError: If the file is missing, damaged or something else.
    """
    # Read the arrays as they are in the file.
    path = Path(path)
    try:
        arrays = read_npz(path if content is None else io.BytesIO(content))
        values: dict[str, Any] = {f.name: arrays[f.name] for f in fields(ObjectModel)}
    except Exception as error:
        raise MeshError(
            f"{path.name}: must be an object file of drakegrasp, got: {one_line(error)}"
        ) from error

    # Convert types, then validate.
    try:
        for key in ("name", "class_name", "mesh_sha256", "mass", "collision_error", "scale", "up"):
            values[key] = values[key].item()
        friction = values["friction"].item()
        values["friction"] = None if np.isnan(friction) else friction
        values["notes"] = tuple(values["notes"].tolist())
        mistake = _mistake(values)
    except (TypeError, ValueError) as error:
        mistake = one_line(error)
    if mistake is not None:
        raise MeshError(f"{path.name}: must be an object file of drakegrasp, got: {mistake}")
    return ObjectModel(**values)


def _mistake(values: dict[str, Any]) -> str | None:
    """Describe the first invalid value of an object file, or return None."""
    # Texts.
    for key in ("name", "class_name"):
        if not (isinstance(values[key], str) and is_name(values[key])):
            return f"{key} {values[key]!r}"
    if values["up"] not in UPRIGHT:
        return f"up {values['up']!r}"
    if not all(isinstance(note, str) for note in values["notes"]):
        return "notes that are no texts"

    # Numbers.
    for key in ("mass", "scale", "friction", "collision_error"):
        number = values[key]
        unsaid = key == "friction" and number is None
        least = 0.0 if key == "collision_error" else np.nextafter(0.0, 1.0)
        if not unsaid and not (isinstance(number, float) and least <= number < np.inf):
            return f"{key} {number!r}"

    # Arrays; a face names three vertices.
    for key, (dtype, _) in _ARRAYS.items():
        numbers = values[key]
        if dtype is np.float64 and not (numbers.dtype.kind == "f" and np.isfinite(numbers).all()):
            return f"{key} that are not finite numbers"
    if values["I_OOcm_O"].shape != (3, 3) or np.linalg.eigvalsh(values["I_OOcm_O"]).min() <= 0.0:
        return "an inertia that no solid has"
    for kind in ("visual", "collision"):
        faces, count = values[f"{kind}_faces"], len(values[f"{kind}_vertices"])
        if faces.dtype.kind != "i" or (faces.size and not 0 <= faces.min() <= faces.max() < count):
            return f"{kind}_faces of vertices that are not there"
    return None


#: On a wall thinner than twice this, the face behind a contact may be nearer than the contact's own
#: face, so the face nearest to the point this far ahead along the normal counts as well [m].
AHEAD = 2e-3


@dataclass(frozen=True, eq=False)
class ContactFit:
    """How well n contacts fit the full mesh.

    Attributes:
        distance: (n,), distance of the points from the mesh [m]; NaN for a point that is NaN.
        normal_angle: (n,), angle between each normal and that of a face [rad]: the face nearest to
            the point, or the face nearest to the point `AHEAD` of it, whichever agrees better. It
            is pi for a normal that is NaN, i.e. has no direction, and NaN for a point that is NaN.
    """

    distance: Array
    normal_angle: Array


def fit_contacts(model: ObjectModel, p_OQ: Array, nhat_Q_O: Array) -> ContactFit:
    """Return how well contacts fit an object.

    Args:
        model: The object.
        p_OQ: (n, 3), points [m]; NaN for a fingertip that does not touch.
        nhat_Q_O: (n, 3), unit normals out of the object.
    """
    # Points that exist.
    fit = ContactFit(*np.full((2, len(p_OQ)), np.nan))
    there = np.asarray(np.isfinite(p_OQ).all(axis=1))
    if not there.any():
        return fit
    p, n, mesh = p_OQ[there], nhat_Q_O[there], model.visual

    # The faces nearest to the points, and to the points ahead of them.
    known = np.asarray(np.isfinite(n).all(axis=1))
    _, fit.distance[there], own = mesh.nearest.on_surface(p)
    _, _, ahead = mesh.nearest.on_surface(p + AHEAD * np.where(known[:, None], n, 0.0))
    cosine = np.maximum(dot(n, mesh.face_normals[own]), dot(n, mesh.face_normals[ahead]))
    fit.normal_angle[there] = np.where(known, np.arccos(np.clip(cosine, -1.0, 1.0)), np.pi)
    return fit
