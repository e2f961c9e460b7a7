"""A surface of very many triangles is reduced before it is mended, and no other is touched."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from helpers.meshes import assert_sound, prepare, write

from drakegrasp.mesh import decimation
from drakegrasp.mesh.components import face_components, pair_half_edges
from drakegrasp.mesh.decimation import coarsen
from drakegrasp.mesh.surfaces import is_solid_surface, signed_volume

RADIUS = 0.05


@pytest.fixture(autouse=True)
def few_faces(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(decimation, "MOST_FACES", 3_000)
    monkeypatch.setattr(decimation, "MOST_DECIMATED", 6_000)


def ball(subdivisions: int, radius: float = RADIUS) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions, radius=radius)


def arrays(mesh: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray]:
    return np.array(mesh.vertices), np.array(mesh.faces, dtype=np.int64)


def test_surface_with_few_faces_stays_as_it_is() -> None:
    vertices, faces = arrays(ball(3))
    same = coarsen(vertices, faces)
    assert same[0] is vertices and same[1] is faces and same[2] == ()


@pytest.mark.parametrize("subdivisions", [4, 5])
def test_ball_stays_a_ball(subdivisions: int) -> None:
    """5,120 faces are decimated; 20,480 are clustered before."""
    vertices, faces, (note,) = coarsen(*arrays(ball(subdivisions)))
    assert len(faces) <= 3_000 and is_solid_surface(faces)
    assert signed_volume(vertices, faces) == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.01)
    assert np.abs(np.linalg.norm(vertices, axis=1) - RADIUS).max() < 2e-4
    assert note.startswith(f"its {20 * 4**subdivisions:,} faces were reduced to {len(faces):,}, ")
    # A chord of an edge of 3 mm is 0.03 mm from the ball.
    assert 0.0 < float(note.split()[-2]) < 0.2


def test_sheets_that_lie_close_to_each_other_stay_two() -> None:
    """A hollow ball with a wall far thinner than a cell of the clusters."""
    outer, inner = ball(5), ball(5, RADIUS - 5e-5)
    inner.invert()
    _, faces, _ = coarsen(*arrays(trimesh.util.concatenate([outer, inner])))
    pieces, _ = face_components(pair_half_edges(faces[:0], faces, radial=False), len(faces))
    assert pieces == 2


def test_open_scan_is_reduced_and_then_mended(tmp_path: Path) -> None:
    full = ball(5)
    keep = full.triangles_center[:, 2] < 0.98 * RADIUS
    open_ball = trimesh.Trimesh(full.vertices, full.faces[keep], process=False)
    model = prepare(write(tmp_path / "1_ball.obj", open_ball))
    assert_sound(model)
    assert len(model.visual_faces) < 3_200
    assert "were reduced to" in model.notes[0] and "1 open rims were closed" in model.notes[1]


def test_same_surface_gives_the_same_bits() -> None:
    first, second = coarsen(*arrays(ball(5))), coarsen(*arrays(ball(5)))
    assert first[0].tobytes() == second[0].tobytes() and first[1].tobytes() == second[1].tobytes()
