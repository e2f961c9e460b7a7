"""Audit: a directory of meshes comes in; whether each can be simulated goes out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from drakegrasp.errors import MeshError
from drakegrasp.mesh.loading import load_mesh
from drakegrasp.objects.model import prepare_object
from drakegrasp.objects.sources import MeshSource, find_meshes

Status = Literal["fit", "repaired", "refused"]


@dataclass(frozen=True, kw_only=True)
class AuditRow:
    """What a build would do with one mesh; sizes are None if the file cannot be read.

    Attributes:
        name: Name of the object.
        class_name: Its class.
        status: "fit" as it is, "repaired", or "refused".
        notes: What was repaired, or the one reason of the refusal.
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


def audit(
    directory: str | Path, *, units: str = "m", manifest: str | Path | None = None
) -> list[AuditRow]:
    """Return, mesh by mesh, whether it is fit to be simulated, needs repair, or is refused.

    Raises:
        MeshError: As `find_meshes` does; a bad mesh is a row, not an error.
    """
    return [_audit_one(source) for source in find_meshes(directory, units=units, manifest=manifest)]


def _audit_one(source: MeshSource) -> AuditRow:
    status: Status
    # Prepare it as a build would; of a refused mesh, still tell the file's size if possible.
    try:
        model = prepare_object(source)
        vertices, faces, volume = model.visual_vertices, len(model.visual_faces), model.volume
        notes, status = model.notes, "repaired" if model.notes else "fit"
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
