"""Morphs: one object comes in, others of its kind with other proportions go out.

The radial morph of the Grasping 3D Database [Kleinhans2016], whose morphs include the paper's
objects. Let p be the projection of a vertex on an axis, normalised to -1..1, and r its distance
from the axis. The distance is scaled by max(0.25, c1 + c2 p + c3 p^2), and the projection by c4 +
c5 (r / r_max)^2.

Axis and origin are our own choice: the axis is x, y or z, and passes through the centre of the
footprint at the height of the base. So what is flat at the base stays flat and on the table.

`morph_meshes` writes morphs of all meshes of a directory: `<class>_<name>_m<k>.obj` in metres, +z
up. An `objects.yaml` in their folder assigns to each morph the class of its mesh (otherwise each
morph would be its own class) and the name of the mesh as its group: in a split by object all morphs
of a mesh, and the mesh itself, stay together.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import yaml

from drakegrasp.arithmetic import norm
from drakegrasp.config import ObjectConfig
from drakegrasp.errors import MeshError
from drakegrasp.frames import Array
from drakegrasp.mesh.crossings import crossing_faces
from drakegrasp.mesh.remeshing import subdivide
from drakegrasp.mesh.repair import repair_solid
from drakegrasp.mesh.surfaces import Faces, diagonal, is_solid_surface, signed_volume
from drakegrasp.mesh.wavefront import obj_text
from drakegrasp.objects.sources import (
    MANIFEST_NAME,
    MeshSource,
    find_meshes,
    load_source,
    upright_vertices,
)
from drakegrasp.runtime.files import atomic_folder
from drakegrasp.runtime.progress import Report, silent
from drakegrasp.seeding import Stream, object_key

#: Bounds of the draws: of c1 and c4, and of c2, c3 and c5 (those of the database).
SCALE, CURVE = (0.75, 1.5), (-0.25, 0.25)
#: Smallest scale of the distance (that of the database).
LEAST_SCALE = 0.25
#: Longest edge of a surface to be morphed, as a fraction of the diagonal, and the number of faces
#: up to which longer edges are split: a long straight edge would not bend.
BEND, MAX_FACES = 0.06, 4000
#: If faces of a mesh pass through others, their number in a morph may be larger by this factor: the
#: morph keeps the curves along which faces cross, but not which faces are there.
SLACK = 1.5
#: Number of draws of one morph after which its mesh is given up.
MAX_DRAWS = 20
#: Number of decimals of the coordinates [m].
DECIMALS = 7
#: Smallest thickness of a morph.
MIN_EXTENT = 2e-3  # [m]


@dataclass(frozen=True, kw_only=True, eq=False)
class Original:
    """An object to be morphed.

    Attributes:
        vertices: (n, 3) [m], +z up.
        faces: (m, 3), a closed surface.
        crossing: Number of faces that pass through others; 0 unless the mesh itself has such faces.
    """

    vertices: Array
    faces: Faces
    crossing: int


def draw_morph(stream: Stream) -> tuple[int, Array]:
    """Return the next draw of a stream: the axis (0 to 2 for x to z), and c1 .. c5 (5,)."""
    (axis,) = stream.integers(3, 1).tolist()
    low, high = np.array([SCALE, CURVE, CURVE, SCALE, CURVE]).T
    return axis, low + (high - low) * stream.uniform(5)


def morph_points(points: Array, axis: int, c: npt.ArrayLike) -> Array | None:
    """Return the morphed vertices of an object, (n, 3) [m].

    Args:
        points: (n, 3) [m].
        axis: 0, 1 or 2 for x, y or z.
        c: The coefficients c1 .. c5.

    Returns:
        The points (n, 3) [m], or None if the morph turns a part of space inside out.
    """
    # Coordinates relative to the centre of the footprint.
    low, high = points.min(axis=0), points.max(axis=0)
    origin = np.array([(low[0] + high[0]) / 2.0, (low[1] + high[1]) / 2.0, low[2]])
    local = points - origin
    across = [k for k in range(3) if k != axis]
    along, r = local[:, axis], norm(local[:, across])
    p = along / max(float(np.abs(along).max()), 1e-300)
    share = (r / max(float(r.max()), 1e-300)) ** 2

    # The two scales; the morph is valid if its determinant is positive everywhere.
    c1, c2, c3, c4, c5 = np.asarray(c, dtype=float).tolist()
    radial, axial = c1 + c2 * p + c3 * p * p, c4 + c5 * share
    slope = np.where(radial > LEAST_SCALE, c2 + 2.0 * c3 * p, 0.0)
    radial = np.maximum(LEAST_SCALE, radial)
    if (axial * radial - 2.0 * c5 * share * p * slope <= 0.0).any():
        return None

    moved = np.empty_like(local)
    moved[:, across] = local[:, across] * radial[:, None]
    moved[:, axis] = along * axial
    return moved + origin


def load_original(source: MeshSource) -> Original:
    """Return the repaired surface of a mesh, fine enough to bend.

    Raises:
        MeshError: If the mesh cannot become a solid or has an implausible size.
    """
    limits = ObjectConfig()
    mesh, _ = load_source(source)
    try:
        vertices = upright_vertices(mesh, source)
        if not limits.min_diagonal <= diagonal(vertices) <= limits.max_diagonal:
            raise MeshError(
                f"the diagonal must be {limits.min_diagonal:g} m to {limits.max_diagonal:g} m, "
                f"got {diagonal(vertices):.4g} m: give the file's unit"
            )
        solid = repair_solid(vertices, np.asarray(mesh.faces))
    except MeshError as reason:
        raise MeshError(f"{source.path.name}: {reason}") from reason
    fine = subdivide(solid, BEND * diagonal(solid.vertices), MAX_FACES)
    return Original(
        vertices=np.round(fine.vertices, DECIMALS) + 0.0,
        faces=fine.faces,
        crossing=len(crossing_faces(fine.vertices, fine.faces)),
    )


def morph_object(original: Original, name: str, number: int, seed: int) -> tuple[Array, int]:
    """Return a morph of an object: watertight, and about as free of self-intersections as it is.

    The result is the morph's vertices (n, 3) [m] and the number of draws. The morph has the faces
    of the original and is as high above z = 0.

    Args:
        original: Result of `load_original`.
        name: Name of the original.
        number: Number of the morph among the morphs of the original.
        seed: Seed of the draws.

    Raises:
        MeshError: If none of `MAX_DRAWS` draws can be used.
    """
    stream = Stream(seed, object_key(name), number)
    for draw in range(1, MAX_DRAWS + 1):
        points = morph_points(original.vertices, *draw_morph(stream))
        if points is None:
            continue
        vertices, faces = np.round(points, DECIMALS) + 0.0, original.faces
        # It must bound a solid, and its crossing faces must be within the limit.
        if (
            is_solid_surface(faces)
            and signed_volume(vertices, faces) > 0.0
            and float(np.ptp(vertices, axis=0).min()) > MIN_EXTENT
            and len(crossing_faces(vertices, faces)) <= SLACK * original.crossing
        ):
            return vertices, draw
    raise MeshError(
        f"{name}: one of {MAX_DRAWS} draws must give a morph that does not pass through itself, "
        "got none"
    )


@dataclass(frozen=True, kw_only=True)
class MorphReport:
    """Summary of the written morphs.

    Attributes:
        morphs: Number of morphs.
        first_draws: Number of morphs whose first draw could be used.
        crossing: Number of faces that pass through other faces, keyed by the name of the mesh; only
            meshes with such faces. Their morphs have about as many.
        refused: Reasons why meshes have no morphs, one line each.
    """

    morphs: int
    first_draws: int
    crossing: dict[str, int]
    refused: tuple[str, ...]


def morph_meshes(
    directory: str | Path,
    out: str | Path,
    *,
    per_mesh: int,
    seed: int = 0,
    units: str = "m",
    manifest: str | Path | None = None,
    progress: Report = silent,
) -> MorphReport:
    """Write morphs of all meshes of a directory; the same seed produces the same bytes.

    Args:
        directory: Directory of the meshes, as for `find_meshes`.
        out: Directory of the morphs, new or empty. It appears completely or not at all.
        per_mesh: Number of morphs of each mesh.
        seed: Seed of the draws.
        units: Unit of length of the meshes.
        manifest: YAML file of the meshes, if it is not in the same folder.
        progress: Called for each morph.

    Raises:
        MeshError: If there is no mesh, if `out` is not empty, or if no mesh can be morphed.
    """
    # The requested morphs, and the results.
    sources = find_meshes(directory, units=units, manifest=manifest)
    total, draws, refused = len(sources) * per_mesh, list[int](), list[str]()
    entries: dict[str, dict[str, Any]] = {}
    crossing: dict[str, int] = {}

    with _whole_directory(Path(out)) as folder:
        # Mesh by mesh; a mesh without morphs does not affect others.
        for source in sources:
            try:
                texts, tries, faces = _morphs_of(source, per_mesh, seed)
                if known := texts.keys() & entries.keys():
                    raise MeshError(
                        f"{source.name} of class {source.class_name}: its morphs must have names "
                        f"of their own, got {min(known)}, which another mesh has; rename it"
                    )
            except MeshError as reason:
                refused.append(str(reason))
                total -= per_mesh
                continue
            entry: dict[str, Any] = {"class": source.class_name}
            entry["group"] = source.group or source.name
            for key in ("mass", "density", "friction", "licence"):
                if (value := getattr(source, key)) is not None:
                    entry[key] = value
            for (name, text), count in zip(texts.items(), tries, strict=True):
                (folder / f"{name}.obj").write_text(text, encoding="ascii")
                entries[name] = dict(entry)
                draws.append(count)
                progress(len(draws), total)
            if faces:
                crossing[source.name] = faces

        # The manifest, which keeps classes and groups.
        if not draws:
            raise MeshError(f"{directory}: one mesh must have morphs, got none: {refused[0]}")
        content = {"units": "m", "objects": entries}
        text = yaml.safe_dump(content, sort_keys=False, allow_unicode=True)
        (folder / MANIFEST_NAME).write_text(text, encoding="utf-8")
    return MorphReport(
        morphs=len(draws), first_draws=draws.count(1), crossing=crossing, refused=tuple(refused)
    )


def _morphs_of(
    source: MeshSource, per_mesh: int, seed: int
) -> tuple[dict[str, str], list[int], int]:
    """Return the Wavefront files of a mesh's morphs by name, their draws, and its crossing faces.

    Raises:
        MeshError: If the mesh has no morphs.
    """
    original = load_original(source)
    texts, draws = dict[str, str](), list[int]()
    for number in range(1, per_mesh + 1):
        # The constructor also checks the name, which becomes the name of a file.
        name = f"{source.class_name}_{source.name}_m{number}"
        MeshSource(name=name, class_name=source.class_name, path=source.path)
        vertices, draw = morph_object(original, source.name, number, seed)
        texts[name] = obj_text(vertices, original.faces, normals=False)
        draws.append(draw)
    return texts, draws, original.crossing


@contextmanager
def _whole_directory(out: Path) -> Iterator[Path]:
    """Yield a new directory, which becomes `out` if the block succeeds.

    Raises:
        MeshError: If `out` is not empty, or cannot be written.
    """
    try:
        if out.exists() and (not out.is_dir() or any(out.iterdir())):
            raise MeshError(f"{out}: must be new or an empty directory, got one that holds others")
        with atomic_folder(out) as folder:
            yield folder
    except OSError as error:
        raise MeshError(
            f"{out}: must be a directory that can be written, got: {error.strerror}"
        ) from error
