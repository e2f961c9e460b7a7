"""What all figures of a dataset show, compared with stored texts; see `helpers/golden.py`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from helpers.golden import Golden, drawn, points
from matplotlib.figure import Figure
from pydrake.geometry import Cylinder, Role

from drakegrasp.frames import Array
from drakegrasp.hand.description import load_hand
from drakegrasp.pictures import figures, still_scene
from drakegrasp.pictures.figures import NUMBERS_FILE, write_figures
from drakegrasp.pictures.still_scene import StillScene, camera_pose, picture_hand


@pytest.fixture
def pages(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """The figures that are written, in turn, which are not rasterized."""
    found: list[Figure] = []

    def keep(figure: Figure, **_: object) -> bytes:
        found.append(figure)
        return b""

    monkeypatch.setattr(figures, "png_bytes", keep)
    monkeypatch.setattr(figures, "svg_bytes", lambda *_, **__: b"")
    return found


def test_figures_of_a_dataset(
    sound: Path, tmp_path: Path, pages: list[Figure], golden: Golden
) -> None:
    written = write_figures(sound, tmp_path)
    for name, figure in zip(written.names, pages, strict=True):
        golden(f"figures/{name}", drawn(figure))
    golden("figures/numbers", (tmp_path / NUMBERS_FILE).read_text(encoding="utf-8"))


def shapes_of(scene: StillScene) -> Iterator[str]:
    """Yield a line for each shape that shows a scene, with its size, pose and colour."""
    inspector = scene._graph.model_inspector()
    for shape in inspector.GetAllGeometryIds(Role.kIllustration):
        what, properties = inspector.GetShape(shape), inspector.GetIllustrationProperties(shape)
        colour = properties.GetProperty("phong", "diffuse")
        pose = inspector.GetPoseInFrame(shape).GetAsMatrix34()
        size = [what.radius(), what.length()] if isinstance(what, Cylinder) else []
        rgb = colour.r(), colour.g(), colour.b()
        yield f"{inspector.GetName(shape)} {size} {points(pose)} {points([rgb])}"


def test_hand_with_its_pads_and_frames(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, golden: Golden
) -> None:
    """The palm's axes and those of other tools, pads, and three panels from one camera."""
    lines: list[str] = []

    def picture(scene: StillScene, X_WC: Array, edge: int) -> np.ndarray:
        lines.extend([] if lines else shapes_of(scene))
        lines.append(
            f"panel {edge, edge} {points(X_WC)} {points(scene.link_pose(scene.links[-1]))}"
        )
        return np.zeros((2, 2, 3), np.uint8)

    monkeypatch.setattr(StillScene, "picture", picture)

    def save(figure: Figure, *_: object, **__: object) -> None:
        lines.append(drawn(figure))

    monkeypatch.setattr(still_scene, "save_figure", save)
    picture_hand(load_hand("franka"), tmp_path / "hand.png", across=np.deg2rad(30.0))
    golden("figures/hand", "\n".join(lines))


def test_camera_of_a_still_scene() -> None:
    """It looks along a line of a known direction at the middle of points, which fill its view."""
    points_W = np.array([[0.1, 0.2, 0.3], [0.3, 0.2, 0.3]])
    X_WC = camera_pose(points_W, np.deg2rad(90.0), np.deg2rad(30.0), fill=2.0)
    # From +y and 30 degrees above; the sphere's radius is half the distance, and the links'.
    distance = (0.1 + 0.035) / np.sin(np.deg2rad(13.0)) / 2.0
    back = np.array([0.0, np.cos(np.pi / 6.0), 0.5])
    np.testing.assert_allclose(X_WC[:3, 3], [0.2, 0.2, 0.3] + distance * back, atol=1e-12)
    np.testing.assert_allclose(X_WC[:3, :3].T, [[-1, 0, 0], [0, 0.5, -(0.75**0.5)], -back],
                               atol=1e-12)  # fmt: skip


def test_pads_are_drawn_on_both_sides_and_face_out() -> None:
    pad = np.array([[[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 2.0, 0.0]]])
    vertices, faces = still_scene._lifted(pad)
    np.testing.assert_allclose(vertices[:, 2], [4e-4] * 3 + [-4e-4] * 3)
    sides = np.cross(*(vertices[faces[:, k]] - vertices[faces[:, 0]] for k in (1, 2)))
    np.testing.assert_allclose(sides, [[0.0, 0.0, 4.0], [0.0, 0.0, -4.0]], atol=1e-12)
