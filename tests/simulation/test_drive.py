"""What keeps fingers from being pushed open during a lift: nothing, a worm gear, or a lock.

Then two jaws that one motor closes: what the object pushes, what follows, where the palm stands.
"""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import trimesh
from helpers.hands import slider_fingers, write_pincer, write_slider
from helpers.objects import STANDOFF, box_model, from_above, standing
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import ExternallyAppliedSpatialForce

from drakegrasp.config import Config, ObjectConfig
from drakegrasp.errors import ConfigError
from drakegrasp.frames import X_WT, make_pose
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.hand.finger_sweep import find_opposition, find_pinch
from drakegrasp.hand.settings import load_config, override_config
from drakegrasp.objects.model import ObjectModel, make_object
from drakegrasp.outcomes import Outcome
from drakegrasp.simulation import drive as drive_module
from drakegrasp.simulation import lift as lifting
from drakegrasp.simulation.attempt import Attempt, usual_materials
from drakegrasp.simulation.closing import centred
from drakegrasp.simulation.construction import build_scene
from drakegrasp.simulation.drive import disengage, drive_of, engage, hand_over, opening_torques
from drakegrasp.simulation.scene import (
    Scene,
    TrialTimeout,
    advance,
    closing_angles,
    hand_positions,
    joint_limits,
    move_wrist,
    palm_pose,
    release,
    reset_attempt,
    start_limits,
    transfer_state,
)
from drakegrasp.simulation.trial import run_attempt

pytestmark = pytest.mark.sim

#: Rounding and the compliance of Drake's joint limits [rad].
STILL = np.deg2rad(0.02)


def test_configuration_overrides_the_drive_of_the_hand(config: Config, hand: Hand) -> None:
    assert drive_of(hand, config.lift) == "worm"
    assert drive_of(hand, override_config(config, ["lift.drive=torque"]).lift) == "torque"


def test_worm_needs_a_holding_torque(cube: ObjectModel, config: Config, tmp_path: Path) -> None:
    """It is the caller's mistake, not an outcome."""
    pincer = load_hand(write_pincer(tmp_path))
    assert drive_of(pincer, config.lift) == "torque"
    worm = override_config(config, ["lift.drive=worm"])
    scene = build_scene(cube, config.physics, pincer)
    with pytest.raises(ConfigError, match=r"lift\.drive: must be torque or locked .* got 'worm'"):
        run_attempt(scene, standing(cube), from_above(cube, STANDOFF), worm)


def test_pinched_carton_stays_where_it_is_unless_fingers_are_pushed_open(
    config: Config, hand: Hand, tmp_path: Path
) -> None:
    """Finger 3 is as strong as the two that it opposes: nothing centres the carton."""
    carton = box_model(tmp_path, [0.06, 0.06, 0.10])
    scene, attempt = build_scene(carton, config.physics, hand), from_above(carton, STANDOFF)
    for drive in ("worm", "locked", "torque"):
        rules = override_config(config, [f"lift.drive={drive}"])
        record = run_attempt(scene, standing(carton), attempt, rules)
        motion = record.lift.slip, record.lift.turn
        if drive == "torque":
            assert motion[0] > 15e-3 and motion[1] > np.deg2rad(8.0)
        else:
            assert record.outcome is Outcome.SUCCESS
            assert motion[0] < 1e-3 and motion[1] < np.deg2rad(1.0)


@pytest.mark.parametrize(
    ("drive", "force", "steps"),
    [
        ("worm", 1.0, 20),
        ("worm in coarse steps", 1.0, 20),
        ("torque", 1.0, 40),
        ("locked", 5.0, 20),
    ],
)
def test_worm_lets_no_finger_open_and_a_lock_lets_none_move(
    scene: Scene, cube: ObjectModel, config: Config, drive: str, force: float, steps: int
) -> None:
    """A force that the motors cannot hold, in steps of either kind and across their change."""
    current, (name, *coarse) = _closed_on(scene, cube), drive.split()
    engage(current, name)
    if coarse:
        current = _continued_in_coarse_steps(scene, config)

    angles = _pushed(current, force * FORCE, steps=steps)
    loads = opening_torques(current)
    disengage(current)
    if name == "worm":
        torques = [finger.torque_limit for finger in current.hand.fingers]
        assert np.any(loads > 1.2 * np.array(torques))
        assert np.diff(angles, axis=0).min() > -STILL
    elif name == "torque":
        assert (angles[-1] - angles[0]).min() < np.deg2rad(-1.0)
    else:
        assert np.abs(angles - angles[0]).max() < STILL


def test_worm_yields_beyond_its_strength_and_holds_again(
    cube: ObjectModel, config: Config, hand: Hand
) -> None:
    """While it opens, a finger still pushes back with what it can hold."""
    strength = 2.5
    fingers = tuple(replace(finger, holding_torque=strength) for finger in hand.fingers[:2])
    weak = replace(hand, fingers=(*fingers, hand.fingers[2]))
    scene = build_scene(cube, config.physics, weak)
    _closed_on(scene, cube)
    engage(scene, "worm")
    opened = _pushed(scene, FORCE, steps=24)
    loads = opening_torques(scene)[:2]
    assert (opened[-1] - opened[0])[:2].max() < np.deg2rad(-0.2)
    assert loads == pytest.approx(strength, rel=0.02)

    # Once the load is gone the motors close the fingers, with their own torque again.
    stood = _pushed(scene, 0.0, steps=20)
    assert np.diff(stood[2:, :2], axis=0).min() > -STILL
    limits = [motor.effort_limit() for motor in scene.motors[:2]]
    assert limits == [finger.torque_limit for finger in weak.fingers[:2]]
    disengage(scene)


@pytest.mark.parametrize(("rate", "stands"), [(-1.5e-4, False), (-0.9e-4, True), (1.0, True)])
def test_worm_yields_until_its_finger_opens_no_more(
    scene: Scene, cube: ObjectModel, monkeypatch: pytest.MonkeyPatch, rate: float, stands: bool
) -> None:
    """A tenth of a milliradian per second is rest."""
    _closed_on(scene, cube)
    engage(scene, "worm")
    for motor, own in zip(scene.motors, scene.effort_limits, strict=True):
        motor.set_effort_limit(2.0 * own)
    monkeypatch.setattr(drive_module, "closing_rates", lambda _: np.full(len(scene.motors), rate))
    scene.simulator.get_monitor()(scene.simulator.get_context())
    held = [motor.effort_limit() for motor in scene.motors] == [*scene.effort_limits]
    disengage(scene)
    assert held is stands


def test_worm_holds_what_is_within_its_strength(scene: Scene, cube: ObjectModel) -> None:
    """The loads that it carries are those of the contacts: force times lever, motor included."""
    _closed_on(scene, cube)
    assert opening_torques(scene) == pytest.approx([2.0, 2.0, 4.0], rel=0.02)


@pytest.mark.parametrize("broken", [None, "a look", "a look in coarse steps", "the drive"])
def test_lift_leaves_the_hand_as_it_was(
    scene: Scene, cube: ObjectModel, config: Config, monkeypatch, broken: str | None
) -> None:
    """Also where it is cut off: limits belong to the plants, which the next attempt uses."""
    stages, materials = (scene, scene.coarse_scene()), usual_materials(cube, config.physics)

    def limits() -> list[float]:
        lower = [joint_limits(joint)[0] for stage in stages for joint in stage.closing_joints]
        return [*lower, *(motor.effort_limit() for stage in stages for motor in stage.motors)]

    def look(monitor: lifting._Monitor, current: Scene, *_: object) -> bool:
        if broken == "a look" or current is stages[1]:
            raise TrialTimeout
        monitor.at_rest = True
        return False

    before = limits()
    if broken == "the drive":
        monkeypatch.setattr(drive_module, "opening_torques", Mock(side_effect=RuntimeError))
    elif broken:
        monkeypatch.setattr(lifting._Monitor, "update", look)
    _closed_on(scene, cube)
    with pytest.raises((TrialTimeout, RuntimeError)) if broken else nullcontext():
        lifting.lift(scene, start_limits(config), config, materials)
    assert limits() == before
    assert [stage.simulator.get_monitor() for stage in stages] == [None, None]


#: Pulls the cube towards fingers 1 and 2 [N]; their motors hold what finger 3 pushes with.
FORCE = 40.0


def _closed_on(scene: Scene, cube: ObjectModel) -> Scene:
    """Return the scene with the hand closed on the cube, which is free."""
    X_WO = X_WT @ standing(cube)
    reset_attempt(scene, X_WO, X_WO @ from_above(cube, STANDOFF).X_OG, spread=0.0)
    advance(scene, 2.4)
    release(scene)
    return scene


def _continued_in_coarse_steps(scene: Scene, config: Config) -> Scene:
    coarse = scene.coarse_scene()
    motion = move_wrist(scene, X_WT[:3, 3] + config.lift.p_TG, 1.0, begin=1e3)
    transfer_state(coarse, scene, 2.4, motion)
    hand_over(coarse, scene)
    return coarse


def _pushed(scene: Scene, force: float, *, steps: int) -> np.ndarray:
    """Return the closing angles (steps + 1, k) [rad] while a force [N] pulls along y of {O}."""
    R_WO = scene.pose(scene.object)[:3, :3]
    applied = ExternallyAppliedSpatialForce()
    applied.body_index = scene.object.index()
    applied.p_BoBq_B = np.zeros(3)
    applied.F_Bq_W = SpatialForce(np.zeros(3), R_WO @ [0.0, force, 0.0])
    scene.plant.get_applied_spatial_force_input_port().FixValue(scene.context, [applied])
    angles = [closing_angles(scene)]
    for _ in range(steps):
        advance(scene, 0.024)
        angles.append(closing_angles(scene))
    applied.F_Bq_W = SpatialForce(np.zeros(3), np.zeros(3))
    scene.plant.get_applied_spatial_force_input_port().FixValue(scene.context, [applied])
    return np.array(angles)


def test_worm_holds_a_finger_that_is_a_little_beyond_its_limit(tmp_path: Path) -> None:
    """A joint limit gives way by some micrometres; limits that cross would end Drake."""
    hand = load_hand("franka")
    scene = build_scene(box_model(tmp_path, [0.03] * 3), load_config().physics, hand)
    X_WG = make_pose(np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, 1.2])
    reset_attempt(scene, X_WT, X_WG, spread=0.0, closing=[0.04 + 1e-5] * 2)
    engage(scene, "worm")
    assert [j.position_lower_limits()[0] for j in scene.closing_joints] == [0.04]
    disengage(scene)
    assert [j.position_lower_limits()[0] for j in scene.closing_joints] == [0.0]


#: Each jaw presses with so much [N] on a box of this width [m].
PRESS, WIDTH = 60.0, 0.045


@pytest.fixture
def gripper(tmp_path: Path) -> Hand:
    return load_hand(write_slider(tmp_path, fingers=slider_fingers(PRESS, finger="left")))


def thin_box(width: float = WIDTH) -> ObjectModel:
    mesh = trimesh.creation.box([0.03, width, 0.06]).subdivide().subdivide()
    rules = ObjectConfig(mass=0.18)
    named = {"name": "box", "class_name": "box", "mesh_sha256": ""}
    return make_object(mesh.vertices, mesh.faces, rules, **named)


def _pinched(hand: Hand) -> Scene:
    """Return the scene with the gripper closed on a box that is free, high above the table."""
    pinch = find_pinch(hand, WIDTH)
    assert pinch is not None
    scene = build_scene(thin_box(pinch.width), load_config().physics, hand)
    X_WG = make_pose(np.eye(3), [0.0, 0.0, 2.0])
    X_WO = make_pose(np.eye(3), X_WG[:3, 3] + pinch.p_GM)
    reset_attempt(scene, X_WO, X_WG, spread=0.0, closing=0.9 * pinch.closing)
    advance(scene, 0.4)
    release(scene)
    return scene


@pytest.mark.parametrize("axis", [0, 1, 2], ids=["across", "closing", "approach"])
def test_a_pinch_stays_whichever_way_gravity_acts(gripper: Hand, axis: int) -> None:
    """For a second; the pair follows within micrometres, under 60 N and the weight."""
    assert abs(find_opposition(gripper)[0][1]) == pytest.approx(1.0)
    scene = _pinched(gripper)
    assert len(scene.motors) == 1
    scene.plant.mutable_gravity_field().set_gravity_vector(9.81 * np.eye(3)[axis])
    engage(scene, drive_of(gripper, load_config().lift))
    before = np.linalg.inv(palm_pose(scene)) @ scene.pose(scene.object)
    advance(scene, 1.0)
    after = np.linalg.inv(palm_pose(scene)) @ scene.pose(scene.object)
    disengage(scene)
    assert np.linalg.norm(after[:3, 3] - before[:3, 3]) < 2e-5
    assert np.ptp(hand_positions(scene)) < 3e-6


def test_the_load_of_a_motor_is_that_of_all_its_fingers(gripper: Hand) -> None:
    assert opening_torques(_pinched(gripper)) == pytest.approx([2.0 * PRESS], rel=0.02)


def test_a_weak_worm_yields_with_both_fingers(
    gripper: Hand, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Beyond what it holds each finger opens against half of that; then the motor closes again."""
    fingers = (replace(gripper.fingers[0], holding_force=150.0), gripper.fingers[1])
    scene = _pinched(replace(gripper, fingers=fingers))
    (motor,) = scene.motors
    monkeypatch.setattr(drive_module, "opening_torques", lambda _: np.array([151.0]))
    engage(scene, "worm")
    assert [actuator.effort_limit() for actuator in motor.actuators] == [75.0, 75.0]
    monkeypatch.setattr(drive_module, "opening_torques", lambda _: np.array([149.0]))
    advance(scene, 0.05)
    assert [actuator.effort_limit() for actuator in motor.actuators] == [PRESS, PRESS]
    disengage(scene)


@pytest.mark.parametrize(
    ("place", "centre"),
    [((0.002, y), (0.002, 0.0)) for y in (0.0, 0.004, -0.015, 0.02)] + [((0.2, 0.01), (0.2, 0.01))],
)
def test_a_palm_stands_where_both_jaws_meet_the_object(
    gripper: Hand, place: tuple[float, float], centre: tuple[float, float]
) -> None:
    """It stays where nothing is between them."""
    X_OG = make_pose(np.diag([1.0, -1.0, -1.0]), [*place, 0.08])
    (found,) = centred(thin_box(), gripper, [Attempt(X_OG=X_OG, spread=0.0)])
    np.testing.assert_allclose(found.X_OG[:3, 3], [*centre, 0.08], atol=2e-4)
    np.testing.assert_array_equal(found.X_OG[:3, :3], X_OG[:3, :3])
