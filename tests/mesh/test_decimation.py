"""Decimation keeps the solid."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from helpers.meshes import assert_sound, prepare, solid_of, write
from helpers.scripts import load_script

from drakegrasp.errors import MeshError
from drakegrasp.mesh.decimation import _decimate_parted, decimate
from drakegrasp.mesh.surfaces import is_solid_surface


def test_decimation_keeps_the_solid(tmp_path):
    # So small that no edge is subdivided again.
    ring = trimesh.creation.torus(0.02, 0.008, major_sections=100, minor_sections=50)
    model = prepare(write(tmp_path / "ring.obj", ring), max_collision_faces=2000)
    assert_sound(model)
    assert len(model.visual_faces) == 10_000 and len(model.collision_faces) <= 2000
    assert 0.0 < model.collision_error < 2e-4
    assert model.collision.euler_number == 0
    assert model.collision.volume == pytest.approx(model.volume, rel=0.01)
    again = prepare(tmp_path / "ring.obj", max_collision_faces=2000)
    np.testing.assert_array_equal(again.collision_vertices, model.collision_vertices)


def test_decimation_falls_back(tmp_path, monkeypatch):
    solid = solid_of(trimesh.creation.icosphere(4, radius=0.05))
    monkeypatch.setattr("drakegrasp.mesh.decimation._decimate_quadric", lambda *_: None)
    reduced, error = decimate(solid, 1000)
    assert is_solid_surface(reduced.faces) and len(reduced.faces) <= 1000 and 0.0 < error < 1e-3
    monkeypatch.setattr("drakegrasp.mesh.decimation._simplify_manifold", lambda *_: None)
    reduced, error = decimate(solid, 1000)
    assert is_solid_surface(reduced.faces) and len(reduced.faces) <= 1000 and 0.0 < error < 1e-3
    for way in ("parted", "twice"):
        monkeypatch.setattr(f"drakegrasp.mesh.decimation._decimate_{way}", lambda *_: None)
    with pytest.raises(MeshError, match="at most 1000 faces"):
        decimate(solid, 1000)


def test_mesh_with_few_faces_too_many_is_not_decimated_twice(monkeypatch):
    """The first of two decimations aims at more faces than are allowed, or than there are."""
    solid = solid_of(trimesh.creation.icosphere(4, radius=0.05))
    for way in ("decimate_quadric", "simplify_manifold", "decimate_parted"):
        monkeypatch.setattr(f"drakegrasp.mesh.decimation._{way}", lambda *_: None)
    with pytest.raises(MeshError, match="at most 4000 faces, got a broken one from 5120"):
        decimate(solid, 4000)


def test_first_decimation_that_went_far_enough_is_parted_as_it_is():
    """Of thousands of specks, few faces are left: there is nothing to aim at any more."""
    few = solid_of(trimesh.creation.icosphere(1))
    assert _decimate_parted(few, 1000) is few


def test_thin_noisy_scan_keeps_its_shape(tmp_path):
    """Quadric decimation alone leaves edges with four faces where the wall touches itself."""
    scans = load_script("measurements/scanned_meshes")
    bowl = scans.scan(*scans.SCANS["bowl"], seed=2)
    bowl.export(tmp_path / "bowl.ply")
    model = prepare(tmp_path / "bowl.ply")
    assert_sound(model)
    assert 14_000 < len(model.visual_faces) < 18_000
    assert 0.0 < model.collision_error < 2e-3
    assert model.collision.volume == pytest.approx(model.volume, rel=0.05)
    assert "parted" in model.notes[0]
