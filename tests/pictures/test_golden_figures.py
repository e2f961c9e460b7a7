"""What figures of a dataset and hands show, compared with stored texts; see `helpers/golden.py`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from helpers.golden import Golden, drawn, points
from helpers.pages import surface_of
from matplotlib.figure import Figure
from pydrake.geometry import Cylinder, Role

from drakegrasp.frames import Array
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.shapes import link_shapes
from drakegrasp.pictures import figures, still_scene
from drakegrasp.pictures.figures import NUMBERS_FILE, write_figures
from drakegrasp.pictures.still_scene import StillScene, link_surfaces, picture_hand


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


def test_pads_are_drawn_on_both_sides_and_face_out() -> None:
    pad = np.array([[[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 2.0, 0.0]]])
    vertices, faces = still_scene._lifted(pad)
    np.testing.assert_allclose(vertices[:, 2], [4e-4] * 3 + [-4e-4] * 3)
    sides = np.cross(*(vertices[faces[:, k]] - vertices[faces[:, 0]] for k in (1, 2)))
    np.testing.assert_allclose(sides, [[0.0, 0.0, 4.0], [0.0, 0.0, -4.0]], atol=1e-12)


def test_each_link_fills_its_collision_shapes() -> None:
    """The Barrett Hand is shown as it collides, so the boxes around both are equal."""
    hand = load_hand()
    shapes, surfaces = link_shapes(hand.model), link_surfaces(StillScene(hand))
    assert set(surfaces) == {link for link, parts in shapes.items() if parts}
    for link, content in surfaces.items():
        corners = np.concatenate(shapes[link])
        box = np.array([corners.min(axis=0), corners.max(axis=0)])
        # The corners of a cylinder enclose its circle.
        np.testing.assert_allclose(surface_of(content).bounds, box, atol=1.5e-3)
