"""Audit: a directory of meshes comes in; how well each can be simulated goes out."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from drakegrasp.errors import MeshError
from drakegrasp.frames import Array
from drakegrasp.mesh.components import face_components, pair_half_edges
from drakegrasp.mesh.surfaces import (
    Faces,
    diagonal,
    is_solid_surface,
    signed_volume,
)
from drakegrasp.objects.model import ObjectModel, prepare_object
from drakegrasp.objects.sources import (
    UNITS,
    MeshSource,
    find_meshes,
    load_source,
    upright_vertices,
)
from drakegrasp.runtime.progress import Report, silent

Status = Literal["fit", "repaired", "refused"]

#: Diagonals of objects that a hand grasps [m]; a unit that results in such a size is plausible.
HOUSEHOLD = (0.03, 0.6)
#: Densities of real objects, from foam to steel [kg/m^3].
DENSITIES = (20.0, 8000.0)
#: Fraction of the volume that a repair may change without a warning.
NOTED_CHANGE = 0.02


@dataclass(frozen=True, kw_only=True)
class AuditRow:
    """What a build would do with one mesh. Unknown values are None.

    Attributes:
        name: Name of the object.
        class_name: Class of the object.
        status: "fit" without changes, "repaired", or "refused".
        notes: What was repaired, or the one reason of the refusal.
        warnings: Possible problems in a mesh that was accepted.
        faces: Number of faces of the file.
        bodies: Number of connected pieces of surface in the file.
        watertight: Whether each edge of the file has two faces that agree.
        extents: Edges of the bounding box [m] of the solid or, if refused, of the file.
        units_guess: Unit with which the object would have a plausible size, if it does not have one
            with the given unit; None if it does, or if no unit fits.
        volume: Volume of the solid [m^3].
        volume_change: Volume that repair added to that within the file's faces, as a fraction.
        mass: Mass of the object [kg].
        density: Density of the object [kg/m^3].
        collision_faces: Number of faces for contact.
        collision_error: Largest distance of these faces from the solid [m].
        model: The object.
    """

    name: str
    class_name: str
    status: Status
    notes: tuple[str, ...]
    warnings: tuple[str, ...] = ()
    faces: int | None = None
    bodies: int | None = None
    watertight: bool | None = None
    extents: tuple[float, float, float] | None = None
    units_guess: str | None = None
    volume: float | None = None
    volume_change: float | None = None
    mass: float | None = None
    density: float | None = None
    collision_faces: int | None = None
    collision_error: float | None = None
    model: ObjectModel | None = field(default=None, repr=False, compare=False)

    def to_json(self) -> dict[str, Any]:
        """Return the row as JSON types, without the model."""
        return {k: v for k, v in asdict(replace(self, model=None)).items() if k != "model"}


def audit(
    directory: str | Path,
    *,
    units: str = "m",
    manifest: str | Path | None = None,
    progress: Report = silent,
) -> list[AuditRow]:
    """Return for each mesh whether it is fit to be simulated, needs repair, or is refused.

    Objects are prepared with the default `objects` of the configuration.

    Args:
        directory: Directory of the meshes, as for `find_meshes`.
        units: Unit of length of the meshes.
        manifest: YAML file of the meshes, if it is not in the same folder.
        progress: Called for each mesh.

    Raises:
        MeshError: As `find_meshes` does; a faulty mesh results in a row, not an error.
    """
    sources, rows = find_meshes(directory, units=units, manifest=manifest), list[AuditRow]()
    for source in sources:
        rows.append(_audit_one(source))
        progress(len(rows), len(sources))
    return rows


def _audit_one(source: MeshSource) -> AuditRow:
    """Return the row of a mesh: what the file contains, then what a build makes of it."""
    known: dict[str, Any] = {"name": source.name, "class_name": source.class_name}
    try:
        mesh, _ = load_source(source)
    except MeshError as error:
        return AuditRow(**known, status="refused", notes=_reason(error, source))

    # The file's surface.
    vertices, faces = upright_vertices(mesh, source), np.asarray(mesh.faces)
    x, y, z = np.ptp(vertices, axis=0).tolist()
    pieces, _ = face_components(pair_half_edges(vertices, faces, radial=False), len(faces))
    known |= {
        "faces": len(faces),
        "bodies": pieces,
        "watertight": is_solid_surface(faces),
        "extents": (x, y, z),
        "units_guess": guess_units(diagonal(vertices), source.scale),
    }

    # Prepare it as a build would.
    try:
        model = prepare_object(source)
    except MeshError as error:
        row = AuditRow(**known, status="refused", notes=_reason(error, source))
    else:
        known |= _measures(model, vertices, faces)
        known["units_guess"] = guess_units(diagonal(model.visual_vertices), source.scale)
        status: Status = "repaired" if model.notes else "fit"
        row = AuditRow(**known, status=status, notes=model.notes, model=model)
    return replace(row, warnings=tuple(_warnings(row)))


def _reason(error: MeshError, source: MeshSource) -> tuple[str]:
    """Return why a mesh is refused, without its file name, which the row states."""
    return (str(error).removeprefix(f"{source.path.name}: "),)


def guess_units(size: float, scale: float) -> str | None:
    """Return the unit with which a file has a plausible size, if it does not have one already.

    Args:
        size: Diagonal with the given unit [m].
        scale: The given unit [m].
    """
    low, high = HOUSEHOLD
    if low <= size <= high:
        return None
    # If several fit, take the one with the most usual size, one or two decimetres.
    fits = {unit: size / scale * metres for unit, metres in UNITS.items()}
    usual = [unit for unit, diagonal_then in fits.items() if low <= diagonal_then <= high]
    return min(usual, key=lambda unit: abs(np.log(fits[unit] / 0.15)), default=None)


def _measures(model: ObjectModel, vertices: Array, faces: Faces) -> dict[str, Any]:
    """Return measures of an object and of its file's surface, vertices (n, 3) [m], faces (m, 3)."""
    # Volume within the file's surface, and size of the solid.
    before = abs(signed_volume(vertices, faces))
    x, y, z = np.ptp(model.visual_vertices, axis=0).tolist()

    return {
        "extents": (x, y, z),
        "volume": model.volume,
        "volume_change": model.volume / before - 1.0 if model.notes and before > 0.0 else 0.0,
        "mass": model.mass,
        "density": model.density,
        "collision_faces": len(model.collision_faces),
        "collision_error": model.collision_error,
    }


def _warnings(row: AuditRow) -> Iterator[str]:
    """Yield possible problems of an object that a build would accept.

    Args:
        row: The object; unknown values yield no warning.
    """
    if row.units_guess is not None:
        yield f"its lengths may be in {row.units_guess}"
    if row.model is None:
        return
    if row.density is not None and not DENSITIES[0] <= row.density <= DENSITIES[1]:
        yield f"{row.mass:g} kg make {row.density:,.0f} kg/m^3: give its mass or density"
    if row.volume_change is not None and abs(row.volume_change) > NOTED_CHANGE:
        yield f"repair changed the volume by {row.volume_change:+.0%}"
