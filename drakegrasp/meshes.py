"""From a directory of mesh files to objects that Drake can simulate.

`find_meshes` lists the files with their classes and units, `prepare_object` turns one
of them into an `ObjectModel`: a watertight solid in metres with its origin {O} at the
centre of the bounding box, mass properties of uniform density, and a collision mesh
that is not too fine for hydroelastic contact. Drake itself accepts open, inverted and
flat meshes without a word and simulates nonsense, so everything it needs is checked
here; what is wrong is mended (`drakegrasp.mend`) and noted, or refused as `MeshError`.

File names and `objects.yaml`: a mesh called `<number>_<class>_<rest>.ext` belongs to
`<class>`, which may itself contain underscores: the number goes, and so does the last
part if at least two parts remain (24_mug_final and 1_mug are mugs, 30_fruit_juicer_final
is a fruit_juicer). A name without a number is its own class. A file `objects.yaml`
beside the meshes overrides that, per set or per mesh, and tells lengths:

    units: cm
    objects:
      95_boots_final: {units: m, class: boots, name: boots}
"""

from __future__ import annotations

import hashlib
import io
import os
import tempfile
import unicodedata
from collections import Counter
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import pydantic
import trimesh
import yaml
from scipy.sparse import coo_matrix

from drakegrasp.errors import MeshError
from drakegrasp.frames import Array
from drakegrasp.mend import (
    Faces,
    Solid,
    count_parts,
    decimate,
    diagonal,
    mend_solid,
    signed_volume,
    weld,
)

Status = Literal["fit", "mended", "refused"]

#: Mesh files that are read; everything else in the directory is ignored.
SUFFIXES = (".obj", ".stl", ".ply", ".glb")
#: Metres per unit of length of a file.
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
MANIFEST_NAME = "objects.yaml"
#: Below these an object is a sheet or a speck, which no hydroelastic contact resolves.
MIN_EXTENT = 0.5e-3  # [m]
MIN_VOLUME = 1e-9  # [m^3]
#: Faces that meet at less than this angle are shaded as one smooth surface.
CREASE_DEG = 30.0


@dataclass(frozen=True, kw_only=True)
class MeshSource:
    """A mesh file and what is known about it before it is opened.

    Attributes:
        name: Unique name of the object; the file's stem unless the manifest says otherwise.
        class_name: Class of the object.
        path: The mesh file.
        scale: Metres per unit of length of the file.
    """

    name: str
    class_name: str
    path: Path
    scale: float = 1.0

    def __post_init__(self) -> None:
        for what, text in (("name", self.name), ("class", self.class_name)):
            # Names become keys of HDF5 groups and parts of file names.
            if not text.strip() or any(c in "/\\" or not c.isprintable() for c in text):
                raise MeshError(
                    f"{self.path.name}: the {what} must be printable, not empty and without "
                    f"slashes, got {text!r}"
                )
        if not (np.isfinite(self.scale) and self.scale > 0.0):
            raise MeshError(f"{self.path.name}: scale must be positive, got {self.scale}")


@dataclass(frozen=True, kw_only=True, eq=False)
class ObjectModel:
    """A rigid object, ready to be simulated. Lengths in [m], all arrays read-only.

    Attributes:
        name: Unique name.
        class_name: Class.
        mesh_sha256: Digest of the source file's bytes and its scale, hexadecimal.
        visual_vertices: (n, 3) float64, in {O}, full resolution.
        visual_faces: (m, 3) int32, counter-clockwise seen from outside.
        collision_vertices: (k, 3) float64, in {O}.
        collision_faces: (l, 3) int32.
        mass: [kg]
        p_OOcm: (3,) centre of mass.
        I_OOcm_O: (3, 3) rotational inertia about the centre of mass, in axes of {O} [kg m^2].
        collision_error: Largest distance between visual and collision surface.
        notes: What was mended, in sentences.
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
    I_OOcm_O: Array
    collision_error: float
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        shapes = {
            "visual_vertices": (np.float64, (None, 3)),
            "visual_faces": (np.int32, (None, 3)),
            "collision_vertices": (np.float64, (None, 3)),
            "collision_faces": (np.int32, (None, 3)),
            "p_OOcm": (np.float64, (3,)),
            "I_OOcm_O": (np.float64, (3, 3)),
        }
        for key, (dtype, shape) in shapes.items():
            array = np.array(getattr(self, key), dtype=dtype, order="C")
            if len(array.shape) != len(shape) or array.shape[-1] != 3 or not array.size:
                raise MeshError(f"{self.name}: {key} must have shape {shape}, got {array.shape}")
            array.setflags(write=False)
            object.__setattr__(self, key, array)

    @property
    def half_extents(self) -> Array:
        """Half of the bounding box's edges (3,) [m]; its centre is the origin of {O}."""
        return np.asarray(np.ptp(self.visual_vertices, axis=0) / 2.0)

    @property
    def volume(self) -> float:
        """Volume of the solid [m^3]."""
        return signed_volume(self.visual_vertices, self.visual_faces.astype(np.int64))

    @cached_property
    def visual(self) -> trimesh.Trimesh:
        """The visual surface in {O}."""
        return trimesh.Trimesh(self.visual_vertices, self.visual_faces, process=False)

    @cached_property
    def collision(self) -> trimesh.Trimesh:
        """The collision surface in {O}."""
        return trimesh.Trimesh(self.collision_vertices, self.collision_faces, process=False)


@dataclass(frozen=True, kw_only=True)
class AuditRow:
    """What would happen to one mesh; sizes are None where the file gave none.

    Attributes:
        name: Name of the object.
        class_name: Its class.
        status: "fit" as it is, "mended", or "refused".
        notes: What was mended, or the one reason of the refusal.
        faces: Number of faces, of the solid or, if refused, of the file.
        extents: Edges of the bounding box [m], likewise.
        volume: Volume of the solid [m^3].
    """

    name: str
    class_name: str
    status: Status
    notes: tuple[str, ...]
    faces: int | None
    extents: tuple[float, float, float] | None
    volume: float | None


# Finding meshes


class _Entry(pydantic.BaseModel):
    model_config = pydantic.ConfigDict(extra="forbid", coerce_numbers_to_str=True)

    units: Literal["m", "cm", "mm"] | None = None
    class_name: str | None = pydantic.Field(default=None, alias="class")
    name: str | None = None


class _Manifest(pydantic.BaseModel):
    model_config = pydantic.ConfigDict(extra="forbid", coerce_numbers_to_str=True)

    units: Literal["m", "cm", "mm"] | None = None
    objects: dict[str, _Entry] = pydantic.Field(default_factory=dict)


def _read_manifest(path: Path) -> _Manifest:
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise MeshError(f"{path}: must be a readable YAML file, got: {_one_line(error)}") from error
    try:
        return _Manifest.model_validate({} if content is None else content)
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"]) or "the file"
        legal = "; legal keys: " + (
            "units, class, name" if first["loc"][:1] == ("objects",) else "units, objects"
        )
        raise MeshError(
            f"{path}: {place}: {first['msg']}, got {first['input']!r}"
            + (legal if first["type"] == "extra_forbidden" else "")
        ) from error


def _class_of(stem: str) -> str:
    number, *parts = stem.split("_")
    if not (number.isdigit() and parts):
        return stem
    return "_".join(parts[:-1] if len(parts) > 1 else parts) or stem


def find_meshes(
    directory: str | Path, *, units: str = "m", manifest: str | Path | None = None
) -> list[MeshSource]:
    """Return the meshes of a directory, sorted by name; subdirectories are not searched.

    Args:
        directory: Holds .obj, .stl, .ply and .glb files.
        units: Unit of the files' lengths: m, cm or mm. The manifest's unit for the set
            overrides it, and the manifest's unit for a mesh overrides both.
        manifest: A YAML file as the module describes; without it `objects.yaml` in
            `directory`, if there is one.

    Raises:
        MeshError: If there is no mesh, two have the same name, or the manifest is wrong.
    """
    directory = Path(directory)
    if units not in UNITS:
        raise MeshError(f"--units must be one of {', '.join(UNITS)}, got {units!r}")
    try:
        paths = [
            path
            for path in directory.iterdir()
            if path.suffix.lower() in SUFFIXES and path.name[0] != "." and path.is_file()
        ]
    except OSError as error:
        raise MeshError(
            f"{directory}: must be a directory of meshes, got: {error.strerror or error}"
        ) from error
    if not paths:
        raise MeshError(
            f"{directory}: must hold at least one mesh ({', '.join(SUFFIXES)}), got none"
        )

    # Some file systems store é as two characters; the manifest's author typed one.
    stems = {path: unicodedata.normalize("NFC", path.stem) for path in sorted(paths)}
    _refuse_twins(directory, stems)
    if manifest is None and (directory / MANIFEST_NAME).is_file():
        manifest = directory / MANIFEST_NAME
    table = _Manifest() if manifest is None else _read_manifest(Path(manifest))
    entries = {unicodedata.normalize("NFC", key): entry for key, entry in table.objects.items()}
    unknown = sorted(set(entries) - set(stems.values()))
    if unknown:
        raise MeshError(
            f"{manifest}: objects must be names of meshes in {directory}: "
            f"{', '.join(sorted(stems.values()))}; got {', '.join(unknown)}"
        )

    sources = []
    for path, stem in stems.items():
        entry = entries.get(stem, _Entry())
        source = MeshSource(
            name=stem if entry.name is None else entry.name,
            class_name=_class_of(stem) if entry.class_name is None else entry.class_name,
            path=path,
            scale=UNITS[entry.units or table.units or units],
        )
        sources.append(source)
    _refuse_twins(directory, {source.path: source.name for source in sources})
    return sorted(sources, key=lambda source: source.name)


def _refuse_twins(directory: Path, names: dict[Path, str]) -> None:
    for name, count in Counter(names.values()).items():
        if count > 1:
            twins = ", ".join(path.name for path, other in names.items() if other == name)
            raise MeshError(f"{directory}: names must be unique, got {name!r} for {twins}")


# Loading


def load_mesh(path: str | Path) -> trimesh.Trimesh:
    """Return the triangles of a mesh file, in the file's units and axes.

    All geometries of a scene are put together with their transforms. Equal vertices
    are merged and duplicate and degenerate faces dropped; materials are not read.

    Raises:
        MeshError: If the file cannot be read or holds no finite triangles.
    """
    path = Path(path)
    return _parse(path, _read(path))


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise MeshError(
            f"{path.name}: must be a readable file, got: {error.strerror or error}"
        ) from error


def _parse(path: Path, data: bytes) -> trimesh.Trimesh:
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise MeshError(f"{path.name}: must be one of {', '.join(SUFFIXES)}, got {suffix!r}")
    if not data:
        raise MeshError(f"{path.name}: must hold a mesh, got an empty file")
    # Parsers fail on foreign bytes in countless ways, none of them of use to a caller.
    try:
        with np.errstate(all="ignore"):
            scene = trimesh.load_scene(
                io.BytesIO(data), file_type=suffix[1:], process=False, skip_materials=True
            )
            parts = []
            for node in scene.graph.nodes_geometry:
                X_SN, key = scene.graph[node]
                part = scene.geometry[key]
                if isinstance(part, trimesh.Trimesh) and len(part.faces):
                    part = trimesh.Trimesh(part.vertices, part.faces, process=False)
                    parts.append(part.apply_transform(X_SN))
            vertices, faces = _concatenate(parts)
    except Exception as error:
        raise MeshError(
            f"{path.name}: must be a valid {suffix} mesh, got: {_one_line(error)}"
        ) from error
    if not len(faces):
        raise MeshError(f"{path.name}: must hold triangles, got no faces")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise MeshError(
            f"{path.name}: faces must use vertices 0..{len(vertices) - 1}, "
            f"got {faces.min()}..{faces.max()}"
        )
    used = vertices[faces.ravel()]
    if not np.isfinite(used).all():
        bad = int((~np.isfinite(used)).any(axis=1).sum())
        raise MeshError(f"{path.name}: vertices must be finite, got NaN or inf at {bad} corners")
    vertices, faces = weld(vertices, faces)
    if not len(faces):
        raise MeshError(f"{path.name}: must hold triangles, got only degenerate faces")
    return trimesh.Trimesh(vertices, faces, process=False)


def _concatenate(parts: list[trimesh.Trimesh]) -> tuple[Array, Faces]:
    if not parts:
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)
    offsets = np.cumsum([0] + [len(part.vertices) for part in parts[:-1]])
    faces = [part.faces + offset for part, offset in zip(parts, offsets, strict=True)]
    vertices = np.vstack([part.vertices for part in parts])
    return np.array(vertices, dtype=np.float64), np.vstack(faces).astype(np.int64)


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__


# Preparing


def source_sha256(source: MeshSource) -> str:
    """Return the hash of a mesh file's bytes and its scale, hexadecimal.

    Raises:
        MeshError: If the file cannot be read.
    """
    return hashlib.sha256(_read(source.path) + f"\nscale {source.scale!r}".encode()).hexdigest()


def prepare_object(
    source: MeshSource,
    *,
    mass: float = 1.0,
    max_collision_faces: int = 3000,
    min_diagonal: float = 0.01,
    max_diagonal: float = 2.0,
) -> ObjectModel:
    """Return the simulated object of a mesh file, mended where that is honest.

    Args:
        source: Where the mesh is and what unit it is in.
        mass: [kg]
        max_collision_faces: The collision mesh is decimated if it has more faces than
            this; it is never refined.
        min_diagonal: Shortest diagonal of the bounding box [m] that is no mistake of unit.
        max_diagonal: Longest diagonal [m].

    Raises:
        MeshError: If the file is no mesh, has an implausible size, or no solid can be
            made of it; the message gives the reason.
    """
    if not (np.isfinite(mass) and mass > 0.0):
        raise MeshError(f"mass must be positive [kg], got {mass}")
    if max_collision_faces < 4:
        raise MeshError(f"max_collision_faces must be at least 4, got {max_collision_faces}")
    file = source.path.name
    data = _read(source.path)
    mesh = _parse(source.path, data)
    vertices, faces = np.asarray(mesh.vertices) * source.scale, np.asarray(mesh.faces)
    size = diagonal(vertices)
    if not min_diagonal <= size <= max_diagonal:
        raise MeshError(
            f"{file}: the diagonal of the bounding box must be {min_diagonal:g} m to "
            f"{max_diagonal:g} m, got {size:.4g} m with 1 unit = {source.scale:g} m: give the "
            f"file's unit with --units ({', '.join(UNITS)}) or for this mesh in {MANIFEST_NAME}"
        )
    try:
        solid = mend_solid(vertices, faces)
        _refuse_slight(solid)
        centre = (solid.vertices.min(axis=0) + solid.vertices.max(axis=0)) / 2.0
        visual = Solid(vertices=solid.vertices - centre, faces=solid.faces)
        p_OOcm, I_OOcm_O = _mass_properties(visual, mass)
        collision, error = decimate(visual, max_collision_faces)
    except MeshError as reason:
        raise MeshError(f"{file}: {reason}") from reason
    notes = solid.notes
    parts = count_parts(solid.vertices, solid.faces)
    if parts > 1:
        notes = (*notes, f"{parts} parts do not touch and will move as one")
    return ObjectModel(
        name=source.name,
        class_name=source.class_name,
        mesh_sha256=source_sha256(source),
        visual_vertices=visual.vertices,
        visual_faces=visual.faces.astype(np.int32),
        collision_vertices=collision.vertices,
        collision_faces=collision.faces.astype(np.int32),
        mass=float(mass),
        p_OOcm=p_OOcm,
        I_OOcm_O=I_OOcm_O,
        collision_error=error,
        notes=notes,
    )


def _refuse_slight(solid: Solid) -> None:
    """Refuse sheets, specks, and a volume that the convex hull contradicts."""
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
    """Return p_OOcm (3,) and I_OOcm_O (3, 3) of a solid of uniform density."""
    triangles = solid.vertices[solid.faces]
    volume = signed_volume(solid.vertices, solid.faces)
    properties = trimesh.triangles.mass_properties(triangles, density=mass / volume)
    p_OOcm = np.asarray(properties["center_mass"])
    inertia = np.asarray(properties["inertia"])
    I_OOcm_O = (inertia + inertia.T) / 2.0
    moments = np.linalg.eigvalsh(I_OOcm_O)
    if not (moments[0] > 0.0 and moments[0] + moments[1] >= moments[2] * (1.0 - 1e-9)):
        raise MeshError(f"the moments of inertia must obey the triangle inequality, got {moments}")
    # A centre of mass outside the hull is impossible for a solid, and trimesh's search
    # for resting poses never returns from it.
    hull = trimesh.Trimesh(solid.vertices, solid.faces, process=False).convex_hull
    outside = np.einsum("ij,ij->i", p_OOcm - hull.triangles[:, 0], hull.face_normals).max()
    if outside > 1e-9:
        raise MeshError(f"the centre of mass must be inside the convex hull, got {p_OOcm}")
    return p_OOcm, I_OOcm_O


# Keeping and handing on


def save_object(model: ObjectModel, path: str | Path) -> None:
    """Write an object to a .npz file, atomically; equal objects give equal bytes."""
    path = Path(path)
    content: dict[str, Any] = {f.name: np.asarray(getattr(model, f.name)) for f in fields(model)}
    content["notes"] = np.array(model.notes, dtype=np.str_)
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **content)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(buffer.getvalue())
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def load_object(path: str | Path) -> ObjectModel:
    """Return an object that `save_object` wrote.

    Raises:
        MeshError: If the file is missing, damaged or something else.
    """
    path = Path(path)
    try:
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as content:
            values: dict[str, Any] = {f.name: content[f.name] for f in fields(ObjectModel)}
    except Exception as error:
        raise MeshError(
            f"{path.name}: must be an object file of drakegrasp, got: {_one_line(error)}"
        ) from error
    for key in ("name", "class_name", "mesh_sha256", "mass", "collision_error"):
        values[key] = values[key].item()
    values["notes"] = tuple(values["notes"].tolist())
    return ObjectModel(**values)


def obj_text(vertices: npt.ArrayLike, faces: npt.ArrayLike, *, normals: bool) -> str:
    """Return a triangle mesh as Wavefront text, for Drake's in-memory meshes.

    Coordinates are written so that they read back exactly. With `normals`, every corner
    gets the area-weighted mean normal of those faces at its vertex that are within 30
    degrees of its own face: curved surfaces look smooth, edges of boxes stay crisp.
    """
    v = np.asarray(vertices, dtype=np.float64)
    f = np.asarray(faces, dtype=np.int64)
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in v.tolist()]
    if not normals:
        lines += [f"f {a} {b} {c}" for a, b, c in (f + 1).tolist()]
        return "\n".join(lines) + "\n"
    vn, index = np.unique(np.round(_corner_normals(v, f), 6), axis=0, return_inverse=True)
    lines += [f"vn {x:.6f} {y:.6f} {z:.6f}" for x, y, z in (vn + 0.0).tolist()]
    corners = np.stack((f, index.reshape(f.shape)), axis=2).reshape(-1, 6) + 1
    lines += ["f {}//{} {}//{} {}//{}".format(*row) for row in corners.tolist()]
    return "\n".join(lines) + "\n"


def _corner_normals(vertices: Array, faces: Faces) -> Array:
    """Return the shading normal of every corner (3m, 3)."""
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    weighted = np.cross(b - a, c - a)
    unit = weighted / np.maximum(np.linalg.norm(weighted, axis=1, keepdims=True), 1e-300)
    corner = np.arange(faces.size)
    at_vertex = coo_matrix(
        (np.ones(faces.size), (faces.ravel(), corner // 3)), shape=(len(vertices), len(faces))
    ).tocsr()
    pairs = at_vertex[faces.ravel()].tocoo()
    smooth = (unit[pairs.row // 3] * unit[pairs.col]).sum(axis=1) >= np.cos(np.radians(CREASE_DEG))
    smooth |= pairs.row // 3 == pairs.col
    rows, columns = pairs.row[smooth], pairs.col[smooth]
    mean = (
        coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(faces.size, len(faces))).tocsr()
        @ weighted
    )
    return np.asarray(mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-300))


def audit(
    directory: str | Path, *, units: str = "m", manifest: str | Path | None = None
) -> list[AuditRow]:
    """Return, mesh by mesh, whether it is fit to be simulated, was mended, or is refused.

    Raises:
        MeshError: As `find_meshes`; a bad mesh is a row, not an error.
    """
    return [_audit_one(source) for source in find_meshes(directory, units=units, manifest=manifest)]


def _audit_one(source: MeshSource) -> AuditRow:
    status: Status
    try:
        model = prepare_object(source)
        vertices, faces, volume = model.visual_vertices, len(model.visual_faces), model.volume
        notes, status = model.notes, "mended" if model.notes else "fit"
    except MeshError as error:
        notes, status, volume = (str(error),), "refused", None
        try:
            mesh = load_mesh(source.path)
            vertices, faces = np.asarray(mesh.vertices) * source.scale, len(mesh.faces)
        except MeshError:
            vertices, faces = None, None
    extents: tuple[float, float, float] | None = None
    if vertices is not None:
        x, y, z = np.ptp(vertices, axis=0).tolist()
        extents = (x, y, z)
    return AuditRow(
        name=source.name,
        class_name=source.class_name,
        status=status,
        notes=notes,
        faces=faces,
        extents=extents,
        volume=volume,
    )
