"""Morphs: one object comes in, others of its kind and of other proportions go out.

The radial morph of the Grasping 3D Database [Kleinhans2016], from whose morphs the paper's objects
come. Around an axis, with p the projection of a vertex on it, normalised to -1..1,
and r its distance from it: the distance is scaled by max(0.25, c1 + c2 p + c3 p^2), and the
projection by c4 + c5 (r / r_max)^2.

Axis and origin are our own choice: the axis is one of x, y and z, and passes through the middle of
the footprint at the height of the base. So what is flat at the base stays flat and on the table.

`morph_meshes` writes morphs of all meshes of a directory: `<class>_<name>_m<k>.obj` in metres, +z
up. An `objects.yaml` in their folder keeps the class of each one's mesh (else each would be a
class of its own) and its name as their group: in a split by object all morphs of a mesh, and
the mesh itself, stay together.
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

#: Bounds of the draws: of c1 and c4, and of c2, c3 and c5 (the database's).
SCALE, CURVE = (0.75, 1.5), (-0.25, 0.25)
#: The distance is scaled by at least this (the database's).
LEAST_SCALE = 0.25
#: Longest edge of what is morphed, as a fraction of the diagonal, and faces up to which longer ones
#: are split: a long straight edge would not bend.
BEND, MAX_FACES = 0.06, 4000
#: A morph of a mesh whose faces pass through others may have so many times as many of them: a morph
#: of space keeps the curves along which they do, but not which faces lie there.
SLACK = 1.5
#: Draws of one morph before its mesh is given up.
MAX_DRAWS = 20
#: Decimals of the coordinates [m].
DECIMALS = 7
#: Least thickness of a morph.
MIN_EXTENT = 2e-3  # [m]


@dataclass(frozen=True, kw_only=True, eq=False)
class Original:
    """An object to make morphs of.

    Attributes:
        vertices: (n, 3) [m], +z up.
        faces: (m, 3), a closed surface.
        crossing: Number of faces that pass through others: 0 unless the mesh itself is so.
    """

    vertices: Array
    faces: Faces
    crossing: int


def draw_morph(stream: Stream) -> tuple[int, Array]:
    """Return the next draw of a stream: the axis, 0 to 2 for x to z, and c1 .. c5 (5,)."""
    (axis,) = stream.integers(3, 1).tolist()
    low, high = np.array([SCALE, CURVE, CURVE, SCALE, CURVE]).T
    return axis, low + (high - low) * stream.uniform(5)


def morph_points(points: Array, axis: int, c: npt.ArrayLike) -> Array | None:
    """Return where a morph puts the vertices of an object (n, 3) [m].

    Args:
        points: (n, 3) [m].
        axis: 0, 1 or 2 for x, y or z.
        c: The coefficients c1 .. c5.

    Returns:
        The points (n, 3) [m], or None if the morph turns a part of space inside out.
    """
    # Coordinates about the middle of the footprint.
    low, high = points.min(axis=0), points.max(axis=0)
    origin = np.array([(low[0] + high[0]) / 2.0, (low[1] + high[1]) / 2.0, low[2]])
    local = points - origin
    across = [k for k in range(3) if k != axis]
    along, r = local[:, axis], norm(local[:, across])
    p = along / max(float(np.abs(along).max()), 1e-300)
    share = (r / max(float(r.max()), 1e-300)) ** 2

    # The two scales; space keeps its sides where the determinant is positive.
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
        MeshError: If the mesh cannot be a solid or is of implausible size.
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
    """Return one morph of an object: watertight, and no more self-intersecting than it.

    Of the same faces, it is its vertices (n, 3) [m], as high above z = 0 as the original, and the
    number of draws that it took.

    Args:
        original: From `load_original`.
        name: Of the original.
        number: Of the morph among those of the original.
        seed: Of the draws.

    Raises:
        MeshError: If no draw of `MAX_DRAWS` can be used.
    """
    stream = Stream(seed, object_key(name), number)
    for draw in range(1, MAX_DRAWS + 1):
        points = morph_points(original.vertices, *draw_morph(stream))
        if points is None:
            continue
        vertices, faces = np.round(points, DECIMALS) + 0.0, original.faces
        # It bounds a solid, and crosses itself no more than the original.
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
    """What was written.

    Attributes:
        morphs: Number of morphs.
        first_draws: Number of those whose first draw could be used.
        crossing: Number of faces that pass through others in a mesh, by its name, if any: its
            morphs have about as many.
        refused: Why a mesh has no morphs, a line each.
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
    """Write morphs of all meshes of a directory; the same bytes for the same seed.

    Args:
        directory: The meshes, as for `find_meshes`.
        out: Directory of the morphs: new or empty. It appears whole or not at all.
        per_mesh: Morphs of each mesh.
        seed: Of the draws.
        units: Unit of the meshes' lengths.
        manifest: Their YAML file, if it is not in the same folder.
        progress: Called for each morph.

    Raises:
        MeshError: If there is no mesh, `out` holds anything, or no mesh can be morphed.
    """
    # What is wanted, and what comes of it.
    sources = find_meshes(directory, units=units, manifest=manifest)
    total, draws, refused = len(sources) * per_mesh, list[int](), list[str]()
    entries: dict[str, dict[str, Any]] = {}
    crossing: dict[str, int] = {}

    with _whole_directory(Path(out)) as folder:
        # Mesh by mesh; one that has no morphs costs no other.
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

        # The manifest, which keeps their classes and groups.
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
    """Return the Wavefront texts of a mesh's morphs by name, their draws, and its crossing faces.

    Raises:
        MeshError: If it has no morphs.
    """
    original = load_original(source)
    texts, draws = dict[str, str](), list[int]()
    for number in range(1, per_mesh + 1):
        # Also checks the name, which is that of a file.
        name = f"{source.class_name}_{source.name}_m{number}"
        MeshSource(name=name, class_name=source.class_name, path=source.path)
        vertices, draw = morph_object(original, source.name, number, seed)
        texts[name] = obj_text(vertices, original.faces, normals=False)
        draws.append(draw)
    return texts, draws, original.crossing


@contextmanager
def _whole_directory(out: Path) -> Iterator[Path]:
    """Yield a new directory that becomes `out` when the block ends well.

    Raises:
        MeshError: If `out` holds anything, or cannot be written.
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
