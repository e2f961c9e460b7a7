"""Meshes as files, and boxes with faults."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from drakegrasp.config import ObjectConfig
from drakegrasp.mesh.surfaces import Solid
from drakegrasp.objects.model import ObjectModel, prepare_object
from drakegrasp.objects.sources import MeshSource
from drakegrasp.shapes import kitchen
from drakegrasp.shapes.catalog import wavefront

G3DB = Path(__file__).resolve().parents[3] / "shared/meshes/g3db"


needs_g3db = pytest.mark.skipif(not G3DB.is_dir(), reason="the G3DB meshes are not here")


BOX = (0.06, 0.10, 0.04)


#: Objects of fixed sizes, whatever the ranges of their classes are; easy to grasp.
FIXED = {
    "8_wineglass_flute": kitchen.wineglass(
        foot_radius=0.034,
        stem_radius=0.006,
        belly_radius=0.028,
        rim_radius=0.026,
        height=0.180,
        stem_height=0.065,
    ),
    "10_box_tall": kitchen.box(width=0.070, depth=0.050, height=0.150),
}


def write_fixed(folder: Path, *names: str) -> None:
    """Write some of the objects of fixed sizes into a folder, which is made."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        (folder / f"{name}.obj").write_bytes(wavefront(FIXED[name]))


def write(path: Path, *meshes: trimesh.Trimesh) -> Path:
    """Write meshes as one Wavefront file, exactly and without repair."""
    lines, offset = [], 1
    for mesh in meshes:
        lines += ["v {!r} {!r} {!r}".format(*row) for row in mesh.vertices.tolist()]
        lines += ["f {} {} {}".format(*row) for row in (mesh.faces + offset).tolist()]
        offset += len(mesh.vertices)
    path.write_text("\n".join(lines) + "\n")
    return path


def prepare(path: Path, scale: float = 1.0, **options: float) -> ObjectModel:
    source = MeshSource(name=path.stem, class_name="thing", path=path, scale=scale)
    return prepare_object(source, ObjectConfig(**options))


def box(extents=BOX, at=(0.0, 0.0, 0.0)) -> trimesh.Trimesh:
    mesh = trimesh.creation.box(extents)
    return trimesh.Trimesh(mesh.vertices + np.asarray(at), mesh.faces, process=False)


def solid_of(mesh: trimesh.Trimesh) -> Solid:
    return Solid(vertices=np.array(mesh.vertices), faces=np.array(mesh.faces, dtype=np.int64))


def box_distance(p: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Return the signed distance (n,) of points (n, 3) from a box about the origin [m]."""
    beyond = np.abs(p) - half
    outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
    return outside + np.minimum(beyond.max(axis=1), 0.0)


def without_faces(mesh: trimesh.Trimesh, keep: np.ndarray) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces[keep], process=False)


def flipped(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces[:, ::-1], process=False)


def open_box() -> trimesh.Trimesh:
    mesh = box()
    return without_faces(mesh, mesh.face_normals[:, 2] < 0.5)


def box_inertia(m: float, x: float, y: float, z: float) -> np.ndarray:
    return np.diag([y * y + z * z, x * x + z * z, x * x + y * y]) * m / 12.0


def assert_sound(model: ObjectModel) -> None:
    for mesh in (model.visual, model.collision):
        assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0.0
    low, high = model.visual_vertices.min(axis=0), model.visual_vertices.max(axis=0)
    np.testing.assert_allclose(low + high, 0.0, atol=1e-12)
    np.testing.assert_allclose(model.half_extents, high, atol=1e-12)


#: Four units of each object of the small dataset, enough for samples to train and to test on.
SMALL = [
    *(
        "candidates.max=16",
        "unit_candidates=4",
        "split.by=class",
        "split.train_classes=[wineglass]",
    ),
    *("filters.outlier_sigma=0", "filters.require=lifted", "filters.max_normal_angle_deg=null"),
    *("lift.max_speed=2", "lift.max_acceleration=20", "lift.hold_time=0.1"),
]
