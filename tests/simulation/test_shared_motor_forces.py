"""Two jaws that one motor closes: what the object pushes, what follows, where the palm stands."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from helpers.hands import slider_fingers, write_slider

from drakegrasp.config import ObjectConfig
from drakegrasp.frames import make_pose
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.hand.finger_sweep import find_opposition, find_pinch
from drakegrasp.hand.settings import load_config
from drakegrasp.objects.model import ObjectModel, make_object
from drakegrasp.simulation import drive as drive_module
from drakegrasp.simulation.attempt import Attempt
from drakegrasp.simulation.closing import centred
from drakegrasp.simulation.construction import build_scene
from drakegrasp.simulation.drive import disengage, drive_of, engage, opening_torques
from drakegrasp.simulation.scene import (
    Scene,
    advance,
    hand_positions,
    palm_pose,
    release,
    reset_attempt,
)

pytestmark = pytest.mark.sim
#: Each jaw presses with so much [N].
FORCE = 60.0
WIDTH = 0.045


def gripper(folder: Path, *, one_motor: bool, **changes: object) -> Hand:
    fingers = slider_fingers(FORCE, **({"finger": "left"} if one_motor else {}))
    return load_hand(write_slider(folder, fingers=fingers, **changes))


def box(width: float = WIDTH) -> ObjectModel:
    mesh = trimesh.creation.box([0.03, width, 0.06]).subdivide().subdivide()
    rules = ObjectConfig(mass=0.18)
    named = {"name": "box", "class_name": "box", "mesh_sha256": ""}
    return make_object(mesh.vertices, mesh.faces, rules, **named)


def pinched(hand: Hand) -> Scene:
    """Return the scene with the gripper closed on a box, high above the table."""
    pinch = find_pinch(hand, WIDTH)
    assert pinch is not None
    scene = build_scene(box(pinch.width), load_config().physics, hand)
    X_WG = make_pose(np.eye(3), [0.0, 0.0, 2.0])
    X_WO = make_pose(np.eye(3), X_WG[:3, 3] + pinch.p_GM)
    reset_attempt(scene, X_WO, X_WG, spread=0.0, closing=0.9 * pinch.closing)
    advance(scene, 0.4)
    return scene


def slip(scene: Scene, down: np.ndarray) -> float:
    """Return how far the box moves in the hand in a second if gravity acts along a direction."""
    scene.plant.mutable_gravity_field().set_gravity_vector(9.81 * down)
    release(scene)
    engage(scene, drive_of(scene.hand, load_config().lift))
    before = np.linalg.inv(palm_pose(scene)) @ scene.pose(scene.object)
    advance(scene, 1.0)
    after = np.linalg.inv(palm_pose(scene)) @ scene.pose(scene.object)
    disengage(scene)
    return float(np.linalg.norm(after[:3, 3] - before[:3, 3]))


@pytest.mark.parametrize("axis", [0, 1, 2], ids=["across", "closing", "approach"])
def test_a_pinch_stays_whichever_way_gravity_acts(tmp_path: Path, axis: int) -> None:
    """The pair follows within micrometres, under 60 N and the weight."""
    hand = gripper(tmp_path, one_motor=True)
    assert abs(find_opposition(hand)[0][1]) == pytest.approx(1.0)
    scene = pinched(hand)
    assert len(scene.motors) == 1
    assert slip(scene, np.eye(3)[axis]) < 2e-5
    assert np.ptp(hand_positions(scene)) < 3e-6


def test_the_load_of_a_motor_is_that_of_all_its_fingers(tmp_path: Path) -> None:
    scene = pinched(gripper(tmp_path, one_motor=True))
    release(scene)
    assert opening_torques(scene) == pytest.approx([2.0 * FORCE], rel=0.02)


def test_a_weak_worm_yields_with_both_fingers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Beyond what it holds each finger opens against half of that; then the motor closes again."""
    hand = gripper(tmp_path, one_motor=True)
    fingers = (replace(hand.fingers[0], holding_force=150.0), hand.fingers[1])
    scene = pinched(replace(hand, fingers=fingers))
    release(scene)
    (motor,) = scene.motors
    monkeypatch.setattr(drive_module, "opening_torques", lambda _: np.array([151.0]))
    engage(scene, "worm")
    assert [actuator.effort_limit() for actuator in motor.actuators] == [75.0, 75.0]
    monkeypatch.setattr(drive_module, "opening_torques", lambda _: np.array([149.0]))
    advance(scene, 0.05)
    assert [actuator.effort_limit() for actuator in motor.actuators] == [FORCE, FORCE]
    disengage(scene)


@pytest.mark.parametrize("off", [0.0, 0.004, -0.015, 0.02])
def test_a_palm_stands_where_both_jaws_meet_the_object(tmp_path: Path, off: float) -> None:
    hand, model = gripper(tmp_path, one_motor=True), box()
    X_OG = make_pose(np.diag([1.0, -1.0, -1.0]), [0.002, off, 0.08])
    (found,) = centred(model, hand, [Attempt(X_OG=X_OG, spread=0.0)])
    np.testing.assert_allclose(found.X_OG[:3, 3], [0.002, 0.0, 0.08], atol=2e-4)
    np.testing.assert_array_equal(found.X_OG[:3, :3], X_OG[:3, :3])


def test_a_palm_stays_where_nothing_is_between_its_jaws(tmp_path: Path) -> None:
    hand, model = gripper(tmp_path, one_motor=True), box()
    X_OG = make_pose(np.diag([1.0, -1.0, -1.0]), [0.2, 0.01, 0.08])
    (found,) = centred(model, hand, [Attempt(X_OG=X_OG, spread=0.0)])
    np.testing.assert_array_equal(found.X_OG, X_OG)
