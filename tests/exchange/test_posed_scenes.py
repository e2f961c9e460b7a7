"""Posed scenes: every node is where the body is, and up is up."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from drakegrasp.dataset.paths import model_path
from drakegrasp.exchange.export import ClosedGrasp
from drakegrasp.exchange.glb import X_UT, link_meshes, posed_scene
from drakegrasp.frames import invert_pose
from drakegrasp.hand.description import load_hand
from drakegrasp.objects.model import load_object
from drakegrasp.pictures.still_scene import StillScene


@pytest.fixture(scope="module")
def folder(exported: Callable[[str], Path]) -> Path:
    return exported("glb")


def test_bodies_are_where_they_are(folder: Path, grasps: list[ClosedGrasp]) -> None:
    hand = load_hand()
    posed = StillScene(hand)
    assert len(list(folder.rglob("*.glb"))) == len(grasps)
    for grasp in grasps:
        scene = trimesh.load_scene(folder / grasp.object_name / f"{grasp.trial_id}.glb")
        poses = {
            name: invert_pose(X_UT) @ scene.graph.get(name)[0]
            for name in scene.graph.nodes_geometry
        }
        assert poses.pop(f"object/{grasp.object_name}") == pytest.approx(grasp.X_TO, abs=1e-6)
        posed.pose(grasp.X_TG, grasp.q)
        nodes = {f"hand/{link}": posed.link_pose(link) for link in posed.links}
        assert {f"hand/{name}" for name in hand.fingertip_links} <= set(poses) <= set(nodes)
        for name, X_TL in poses.items():
            assert pytest.approx(nodes[name], abs=1e-6) == X_TL


def test_up_is_y(folder: Path, grasps: list[ClosedGrasp]) -> None:
    """The object of the dataset is a box that stands on the table, and the palm is above it."""
    grasp = grasps[0]
    scene = trimesh.load_scene(folder / grasp.object_name / f"{grasp.trial_id}.glb")
    X, name = scene.graph.get(f"object/{grasp.object_name}")
    corners = trimesh.transform_points(scene.geometry[name].vertices, X)
    assert corners[:, 1].min() == pytest.approx(0.0, abs=1e-6)
    palm = np.array(scene.graph.get(f"hand/{load_hand().palm_link}")[0])
    assert palm[1, 3] > corners[:, 1].max()


@pytest.mark.parametrize("name", ["scene", "palm"])
def test_an_object_may_have_any_name(dataset: Path, grasps: list[ClosedGrasp], name: str) -> None:
    hand = load_hand()
    links = link_meshes(hand)
    model = load_object(model_path(dataset, grasps[0].object_name))
    named = replace(model, name=hand.palm_link if name == "palm" else name)
    scene = posed_scene(named, StillScene(hand), links, grasps[0])
    assert len(scene.graph.nodes_geometry) == len(links) + 1
    X, _ = scene.graph.get(f"object/{named.name}")
    assert invert_pose(X_UT) @ X == pytest.approx(grasps[0].X_TO, abs=1e-6)


def test_scene_is_turned_and_no_mirror_image(folder: Path, grasps: list[ClosedGrasp]) -> None:
    """The x of {T} stays x, z is up, and y, which is left of x seen from above, comes to -z."""
    for grasp in grasps:
        scene = trimesh.load_scene(folder / grasp.object_name / f"{grasp.trial_id}.glb")
        X, _ = scene.graph.get(f"object/{grasp.object_name}")
        x, y, z = grasp.X_TO[:3, :3]
        np.testing.assert_allclose(np.array(X)[:3, :3], [x, z, -y], atol=1e-6)
        assert np.linalg.det(np.array(X)[:3, :3]) == pytest.approx(1.0)
