"""The trial in MuJoCo: another simulator, the same rules."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.objects import box_model, from_above, standing

from drakegrasp.config import Config
from drakegrasp.frames import X_WT, invert_pose, make_pose
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.kinematics import fingertip_poses, joint_positions
from drakegrasp.hand.settings import load_config, override_config
from drakegrasp.hand_setup import trial_grasps
from drakegrasp.objects.model import ObjectModel
from drakegrasp.outcomes import Outcome
from drakegrasp.simulation.attempt import usual_conditions

pytest.importorskip("mujoco")
pytest.importorskip("coacd")

import mujoco
from mujoco_baseline import MujocoBaseline
from mujoco_scene import build_mujoco_scene

from drakegrasp.mjcf import TORSION_RADIUS

pytestmark = pytest.mark.sim

STANDOFF = 0.06


def test_cube_is_held_and_nothing_is_left_of_a_run(cube: ObjectModel) -> None:
    baseline, attempt = peer(cube), from_above(cube, STANDOFF)
    first, again = baseline.run(attempt), baseline.run(attempt)
    assert first.outcome is Outcome.SUCCESS and first.tried
    assert again == first
    below = make_pose(attempt.X_OG[:3, :3], [0.0, 0.0, -cube.half_extents[2]])
    for lost, outcome in (
        (from_above(cube, 0.3), Outcome.MISSING_FINGERTIP),
        (from_above(cube, 0.001), Outcome.START_COLLISION),
        (replace(attempt, ray_hits=False), Outcome.RAY_MISS),
        (replace(attempt, X_OG=below), Outcome.BELOW_TABLE),
    ):
        trial = baseline.run(lost)
        assert (trial.outcome, trial.tried) == (outcome, False)


def test_friction_and_mass_of_an_attempt_are_those_of_a_model_built_with_them(
    cube: ObjectModel, config: Config
) -> None:
    slick = override_config(config, ["physics.friction_hand=0.3", "physics.friction_table=0.4"])
    heavy = replace(cube, mass=1.5, I_OOcm_O=1.5 * cube.I_OOcm_O)
    built = MujocoBaseline(heavy, standing(cube), slick)
    conditions = usual_conditions(heavy, slick.physics)

    # What ran before leaves nothing.
    found, attempt = MujocoBaseline(cube, standing(cube), config), from_above(cube, STANDOFF)
    before = found.run(attempt)
    other = found.run(replace(attempt, conditions=conditions))
    for name in ("body_mass", "body_inertia", "body_invweight0", "dof_M0", "geom_friction"):
        one, two = getattr(found._model, name), getattr(built._model, name)
        np.testing.assert_allclose(one[1:], two[1:], rtol=1e-9, err_msg=name)
    expected = built.run(attempt)
    assert other.outcome is expected.outcome is Outcome.SUCCESS
    assert other.slip == pytest.approx(expected.slip, rel=1e-3)
    assert found.run(attempt) == before != other


def test_fingertips_are_where_kinematics_puts_them(cube: ObjectModel) -> None:
    """At 90 degrees of spread the fingers still have every joint of the hand's files."""
    baseline, attempt = peer(cube), from_above(cube, STANDOFF, spread=float(np.deg2rad(90.0)))
    baseline.run(attempt)
    m, d, hand = baseline._model, baseline._data, load_hand()
    mujoco.mj_kinematics(m, d)
    closing = [float(d.joint(finger.closing_joint).qpos[0]) for finger in hand.fingers]
    palm = d.body(hand.palm_link)
    X_WG = make_pose(palm.xmat.reshape(3, 3), palm.xpos) @ hand.X_BG
    expected = X_WG @ fingertip_poses(hand, spread=attempt.spread, closing=closing)
    for finger, X_WF in zip(hand.fingers, expected, strict=True):
        assert d.body(finger.fingertip).xpos == pytest.approx(X_WF[:3, 3], abs=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["allegro", "franka"])
def test_fingertips_of_other_hands_are_where_kinematics_puts_them(name: str) -> None:
    """In the posture in which all fingers have closed a bit: also of fingers that slide."""
    hand, config = load_hand(name), load_config(hand=name)
    model, X_TO, *_ = next(trial_grasps(hand, "box"))
    peer = MujocoBaseline(model, X_TO, config)
    m, d = peer._model, peer._data
    closing = 0.3 * hand.closing_unit
    for joint, position in joint_positions(hand, 0.0, closing).items():
        if joint not in hand.preshape:
            d.qpos[m.joint(joint).qposadr[0]] = position
    mujoco.mj_kinematics(m, d)

    def pose(body: str) -> np.ndarray:
        found = d.body(body)
        return make_pose(found.xmat.reshape(3, 3), found.xpos)

    X_GW = invert_pose(pose(hand.palm_link) @ hand.X_BG)
    X_GF = np.array([X_GW @ pose(link) for link in hand.fingertip_links])
    expected = fingertip_poses(hand, spread=0.0, closing=closing)
    np.testing.assert_allclose(X_GF, expected, atol=1e-6)


def peer(model: ObjectModel, *overrides: str) -> MujocoBaseline:
    return MujocoBaseline(model, standing(model), load_config(overrides=overrides))


@pytest.fixture(scope="module")
def pinched(tmp_path_factory: pytest.TempPathFactory) -> ObjectModel:
    """A box that two fingers and one opposing finger of twice their torque pinch."""
    return box_model(tmp_path_factory.mktemp("box"), [0.06, 0.06, 0.10])


@pytest.mark.parametrize(
    ("drive", "friction", "slip", "turn"),
    [
        ("worm", 0.71, (0.0, 1e-4), (0.0, 0.1)),
        ("locked", 0.71, (0.0, 1e-4), (0.0, 0.1)),
        # The box pushes the fingers open.
        ("torque", 0.71, (0.01, 1.0), (5.0, 180.0)),
        # Pads with 2, 2 and 4 N m carry 1 kg from a coefficient of about 0.154 on.
        ("worm", 0.17, (0.0, 1e-4), (0.0, 0.1)),
        ("worm", 0.13, (5e-3, 10.0), (0.0, 180.0)),
    ],
)
def test_drive_and_friction_decide_whether_a_pinched_box_stays(
    pinched: ObjectModel,
    drive: str,
    friction: float,
    slip: tuple[float, float],
    turn: tuple[float, float],
) -> None:
    """Slip [m] and turn [degrees] lie between two limits."""
    rules = (f"lift.drive={drive}", f"physics.friction_hand={friction}")
    trial = peer(pinched, *rules).run(from_above(pinched, STANDOFF))
    assert slip[0] <= trial.slip < slip[1]
    assert np.deg2rad(turn[0]) <= trial.turn <= np.deg2rad(turn[1])


def test_own_friction_of_the_object_is_that_of_both_pairs(cube: ObjectModel) -> None:
    config = load_config()
    own = build_mujoco_scene(replace(cube, friction=0.2), load_hand(config.hand), config).model
    body = own.body("object").id
    assert own.geom("table").friction[0] == 0.2
    assert set(own.geom_friction[own.geom_bodyid == body, 0].tolist()) == {0.2}
    np.testing.assert_allclose(own.geom_friction[:, 1], own.geom_friction[:, 0] * TORSION_RADIUS)


def test_nothing_moves_the_object_while_the_hand_closes(cube: ObjectModel) -> None:
    """A palm off the middle closes with one finger first, which pushes on the cube."""
    attempt = from_above(cube, STANDOFF)
    attempt = replace(attempt, X_OG=attempt.X_OG @ make_pose(np.eye(3), [0.0, 0.02, 0.0]))
    baseline = peer(cube)
    baseline._reset(X_WT @ standing(cube) @ attempt.X_OG, 0.0)
    baseline._close()
    data = baseline._data
    assert baseline._contacts().touching.any()
    assert np.abs(data.qacc[baseline._object_v]).max() < 0.01


def test_a_worm_yields_beyond_what_it_holds_and_then_holds_again(cube: ObjectModel) -> None:
    """While its finger opens, the motor pushes back with what the worm can hold."""
    baseline = peer(cube)
    baseline.run(from_above(cube, 0.3))  # in the air: nothing pushes but the test
    m, d, drive, finger = baseline._model, baseline._data, baseline._drive, load_hand().fingers[0]
    joint, motor = m.joint(finger.closing_joint), m.actuator(finger.name)
    (v,) = joint.dofadr
    d.joint(joint.id).qpos = 1.0
    held, yielding = (1.0, finger.effort_limit), (0.0, finger.holding_effort)
    drive.engage(d)
    for share, speed, (lower, torque) in (
        (0.99, -1.0, held),
        (1.01, -1.0, yielding),
        (0.5, -0.1, yielding),
        (0.5, 0.1, held),
    ):
        d.qfrc_applied[v], d.qvel[v] = -share * finger.holding_effort, speed
        drive.update(d)
        assert joint.range[0] == pytest.approx(lower)
        assert motor.forcerange == pytest.approx([-torque, torque])
    d.qfrc_applied[v] = 0.0
    drive.disengage()
