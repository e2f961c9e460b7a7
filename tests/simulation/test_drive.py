"""What keeps fingers from being pushed open during a lift: nothing, a worm gear, or a lock."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.hands import write_pincer
from helpers.objects import STANDOFF, box_model, from_above, standing
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import ExternallyAppliedSpatialForce

from drakegrasp.config import Config
from drakegrasp.errors import ConfigError
from drakegrasp.frames import X_WT, make_pose
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.hand.settings import load_config, override_config
from drakegrasp.objects.model import ObjectModel
from drakegrasp.outcomes import Outcome
from drakegrasp.simulation import drive as drive_module
from drakegrasp.simulation import lift as lifting
from drakegrasp.simulation.attempt import usual_materials
from drakegrasp.simulation.construction import build_scene
from drakegrasp.simulation.drive import disengage, drive_of, engage, hand_over, opening_torques
from drakegrasp.simulation.scene import (
    Scene,
    TrialTimeout,
    advance,
    closing_angles,
    move_wrist,
    release,
    reset_attempt,
    start_limits,
    transfer_state,
)
from drakegrasp.simulation.trial import run_attempt

#: Rounding and the compliance of Drake's joint limits [rad].
STILL = np.deg2rad(0.02)


def test_configuration_overrides_the_drive_of_the_hand(config: Config, hand: Hand) -> None:
    assert drive_of(hand, config.lift) == "worm"
    assert drive_of(hand, override_config(config, ["lift.drive=torque"]).lift) == "torque"


@pytest.mark.sim
def test_worm_needs_a_holding_torque(cube: ObjectModel, config: Config, tmp_path: Path) -> None:
    """It is the caller's mistake, not an outcome."""
    pincer = load_hand(write_pincer(tmp_path))
    assert drive_of(pincer, config.lift) == "torque"
    worm = override_config(config, ["lift.drive=worm"])
    scene = build_scene(cube, config.physics, pincer)
    with pytest.raises(ConfigError, match=r"lift\.drive: must be torque or locked .* got 'worm'"):
        run_attempt(scene, standing(cube), from_above(cube, STANDOFF), worm)


@pytest.mark.sim
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


@pytest.mark.sim
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


@pytest.mark.sim
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


@pytest.mark.sim
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


@pytest.mark.sim
def test_worm_holds_what_is_within_its_strength(scene: Scene, cube: ObjectModel) -> None:
    """The loads that it carries are those of the contacts: force times lever, motor included."""
    _closed_on(scene, cube)
    assert opening_torques(scene) == pytest.approx([2.0, 2.0, 4.0], rel=0.02)


@pytest.mark.sim
@pytest.mark.parametrize(
    ("broken", "error"),
    [
        (None, None),
        ("lift._Monitor.update", TrialTimeout()),
        ("drive.opening_torques", RuntimeError("no solution")),
    ],
)
def test_lift_leaves_the_hand_as_it_was(
    scene: Scene, cube: ObjectModel, config: Config, monkeypatch, broken, error
) -> None:
    """Also where it is cut off: limits belong to the plant, which the next attempt uses."""

    def limits() -> list[float]:
        lower = [float(joint.position_lower_limits()[0]) for joint in scene.closing_joints]
        return [*lower, *(motor.effort_limit() for motor in scene.motors)]

    def fail(*_: object) -> None:
        raise error

    before, materials = limits(), usual_materials(cube, config.physics)
    if broken is not None:
        monkeypatch.setattr(f"drakegrasp.simulation.{broken}", fail)
    _closed_on(scene, cube)
    with pytest.raises(type(error)) if error else nullcontext():
        lifting.lift(scene, start_limits(config), config, materials)
    assert limits() == before
    assert scene.simulator.get_monitor() is None


@pytest.mark.sim
def test_lift_cut_off_in_coarse_steps_leaves_their_scene_as_it_was(
    scene: Scene, cube: ObjectModel, config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    coarse, materials = scene.coarse_scene(), usual_materials(cube, config.physics)
    hand = coarse.hand
    updates = []

    def rest_then_fail(monitor: lifting._Monitor, current: Scene, *_: object) -> bool:
        updates.append(current)
        if current is coarse:
            raise TrialTimeout
        monitor.at_rest = True
        return False

    monkeypatch.setattr(lifting._Monitor, "update", rest_then_fail)
    _closed_on(scene, cube)
    with pytest.raises(TrialTimeout):
        lifting.lift(scene, start_limits(config), config, materials)
    assert updates == [scene, coarse]
    lower = [float(joint.position_lower_limits()[0]) for joint in coarse.closing_joints]
    assert lower == [limits[0] for limits in coarse.closing_limits]
    efforts = [motor.effort_limit() for motor in coarse.motors]
    assert efforts == [finger.torque_limit for finger in hand.fingers]
    assert coarse.simulator.get_monitor() is None


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
