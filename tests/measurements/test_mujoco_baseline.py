"""The trial in MuJoCo: another simulator, the same rules."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.objects import CUBE, box_model, from_above, standing

from drakegrasp.config import Config
from drakegrasp.frames import X_WT, invert_pose, make_pose
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.file_format import PAD_BAND
from drakegrasp.hand.kinematics import fingertip_poses, joint_positions
from drakegrasp.hand.settings import load_config, override_config
from drakegrasp.hand_setup import trial_grasps
from drakegrasp.objects.model import ObjectModel
from drakegrasp.outcomes import Outcome
from drakegrasp.simulation.attempt import usual_conditions

pytest.importorskip("mujoco")
pytest.importorskip("coacd")

import mujoco
import mujoco_baseline
import mujoco_scene
from mujoco_baseline import MujocoBaseline
from mujoco_scene import build_mujoco_scene

from drakegrasp.mjcf import STIFF, TIME_STEP, TORSION_RADIUS, make_spec, pair_friction

pytestmark = pytest.mark.sim

STANDOFF = 0.06


@pytest.fixture(scope="module")
def cube(tmp_path_factory: pytest.TempPathFactory) -> ObjectModel:
    return box_model(tmp_path_factory.mktemp("cube"), [CUBE, CUBE, CUBE])


@pytest.fixture(scope="module")
def config() -> Config:
    return load_config()


@pytest.fixture(scope="module")
def baseline(cube: ObjectModel, config: Config) -> MujocoBaseline:
    return MujocoBaseline(cube, standing(cube), config)


def test_cube_is_held_across_its_faces(baseline: MujocoBaseline, cube: ObjectModel) -> None:
    attempt = from_above(cube, STANDOFF)
    first, again = baseline.run(attempt), baseline.run(attempt)
    assert first.outcome is Outcome.SUCCESS
    assert first.tried
    assert again == first  # nothing is left of the first run


@pytest.mark.parametrize(
    ("standoff", "outcome"), [(0.3, Outcome.MISSING_FINGERTIP), (0.001, Outcome.START_COLLISION)]
)
def test_attempts_fail_where_they_should(
    baseline: MujocoBaseline, cube: ObjectModel, standoff: float, outcome: Outcome
) -> None:
    trial = baseline.run(from_above(cube, standoff))
    assert (trial.outcome, trial.tried) == (outcome, False)


def test_what_geometry_decides_is_not_simulated(
    baseline: MujocoBaseline, cube: ObjectModel
) -> None:
    attempt = from_above(cube, STANDOFF)
    assert baseline.run(replace(attempt, ray_hits=False)).outcome is Outcome.RAY_MISS
    for height in (-0.1, 0.0):
        below = make_pose(attempt.X_OG[:3, :3], [0.0, 0.0, height - cube.half_extents[2]])
        assert baseline.run(replace(attempt, X_OG=below)).outcome is Outcome.BELOW_TABLE


def test_slippery_cube_is_not_held(cube: ObjectModel, config: Config) -> None:
    slick = override_config(config, ["physics.friction_hand=0.05"])
    trial = MujocoBaseline(cube, standing(cube), slick).run(from_above(cube, STANDOFF))
    assert trial.tried
    assert trial.outcome in (Outcome.DROPPED, Outcome.SLIPPED, Outcome.PARTLY_HELD)


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


def test_fingertips_are_where_kinematics_puts_them(
    baseline: MujocoBaseline, cube: ObjectModel
) -> None:
    """At 90 degrees of spread the fingers still have every joint of the hand's files."""
    attempt = from_above(cube, STANDOFF, spread=float(np.deg2rad(90.0)))
    baseline.run(attempt)
    m, d, hand = baseline._model, baseline._data, load_hand()
    mujoco.mj_kinematics(m, d)
    closing = [float(d.joint(finger.closing_joint).qpos[0]) for finger in hand.fingers]
    X_WB = make_pose(d.body(hand.palm_link).xmat.reshape(3, 3), d.body(hand.palm_link).xpos)
    for finger, X_GF in zip(
        hand.fingers, fingertip_poses(hand, spread=attempt.spread, closing=closing), strict=True
    ):
        found = d.body(finger.fingertip).xpos
        assert found == pytest.approx((X_WB @ hand.X_BG @ X_GF)[:3, 3], abs=1e-4)


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


@pytest.mark.parametrize("drive", ["worm", "locked"])
def test_worm_keeps_a_pinched_box_in_place(pinched: ObjectModel, drive: str) -> None:
    trial = peer(pinched, f"lift.drive={drive}").run(from_above(pinched, STANDOFF))
    assert trial.outcome is Outcome.SUCCESS
    assert trial.slip < 1e-4
    assert trial.turn < np.deg2rad(0.1)


def test_torque_lets_the_box_push_fingers_open(pinched: ObjectModel) -> None:
    trial = peer(pinched, "lift.drive=torque").run(from_above(pinched, STANDOFF))
    assert trial.slip > 0.01
    assert trial.turn > np.deg2rad(5.0)


def test_friction_is_that_of_coulomb(pinched: ObjectModel) -> None:
    """Two pads with 2 N m and one with 4 N m carry 1 kg from a coefficient of about 0.154 on."""
    attempt = from_above(pinched, STANDOFF)
    held = peer(pinched, "lift.drive=worm", "physics.friction_hand=0.17").run(attempt)
    assert held.outcome is Outcome.SUCCESS
    assert held.slip < 1e-4
    lost = peer(pinched, "lift.drive=worm", "physics.friction_hand=0.13").run(attempt)
    assert lost.slip > 5e-3


@pytest.mark.parametrize("coefficient", [0.3, 0.71, 1.5])
def test_sphere_turns_on_a_plane_beyond_friction_times_torsion_radius(coefficient: float) -> None:
    """What a model says of turning is torque per normal force, whatever the coefficient."""
    radius, force = 0.02, 10.0
    spec = make_spec(TIME_STEP, mujoco_scene.FRICTION_STIFFNESS, mujoco_scene.NOSLIP_ITERATIONS)
    spec.option.gravity = [0.0, 0.0, 0.0]
    surface = {"friction": pair_friction(coefficient), "solref": STIFF, "condim": 4}
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1.0, 1.0, 0.1], **surface)
    ball = spec.worldbody.add_body(name="ball", pos=[0.0, 0.0, radius])
    ball.add_freejoint()
    kind = mujoco.mjtGeom.mjGEOM_SPHERE
    ball.add_geom(type=kind, size=[radius, 0.0, 0.0], mass=0.1, **surface)
    model = spec.compile()

    def speed(share: float) -> float:
        data = mujoco.MjData(model)
        torque = share * coefficient * TORSION_RADIUS * force
        data.body("ball").xfrc_applied[[2, 5]] = -force, torque
        mujoco.mj_step(model, data, 250)
        return float(data.qvel[5])

    assert speed(0.97) < 0.1
    assert speed(1.03) > 1.0


def weak(monkeypatch: pytest.MonkeyPatch, **changes: object) -> None:
    """Let the hand of the next peers have other fingers."""
    hand = load_hand()
    fingers = tuple(replace(finger, **changes) for finger in hand.fingers)  # type: ignore[arg-type]
    monkeypatch.setattr(
        mujoco_baseline, "load_plain_hand", lambda *_: replace(hand, fingers=fingers)
    )


def test_contact_beside_the_pad_and_its_band_is_of_another_link(
    cube: ObjectModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A corner of each fingertip's shape meets the cube, 54.7 mm from the distal joint."""
    attempt, x = from_above(cube, STANDOFF), 0.0547
    at = (0.06, 0.0, 0.0)
    weak(monkeypatch, pad_region=((1.0, 0.0, 0.0, x + 0.5 * PAD_BAND),), pad_point=at)
    baseline = peer(cube)
    assert baseline.run(attempt).outcome is Outcome.SUCCESS
    assert baseline._contacts().other_links == 0

    weak(monkeypatch, pad_region=((1.0, 0.0, 0.0, x + 1.5 * PAD_BAND),), pad_point=at)
    baseline = peer(cube)
    assert baseline.run(attempt).outcome is Outcome.MISSING_FINGERTIP
    assert baseline._contacts().other_links == 3


def test_contact_weaker_than_the_limit_does_not_count(cube: ObjectModel) -> None:
    attempt = from_above(cube, STANDOFF)
    trial = peer(cube, "physics.contact_force=100").run(attempt)
    assert trial.outcome is Outcome.MISSING_FINGERTIP


def test_friction_with_the_table_is_the_tables(cube: ObjectModel) -> None:
    X_TO = standing(cube)
    X_TO[2, 3] -= 1e-4
    config = load_config(overrides=["physics.friction_hand=7.1", "physics.friction_table=0.3"])
    baseline = MujocoBaseline(cube, X_TO, config)
    baseline.run(from_above(cube, 0.3))
    data = baseline._data
    coefficients = [contact.friction[0] for contact in data.contact[: data.ncon]]
    assert coefficients
    assert coefficients == pytest.approx([0.3] * len(coefficients))


def test_own_friction_of_the_object_is_that_of_both_pairs(cube: ObjectModel) -> None:
    config = load_config()
    own = build_mujoco_scene(replace(cube, friction=0.2), load_hand(config.hand), config).model
    body = own.body("object").id
    assert own.geom("table").friction[0] == 0.2
    assert set(own.geom_friction[own.geom_bodyid == body, 0].tolist()) == {0.2}
    np.testing.assert_allclose(own.geom_friction[:, 1], own.geom_friction[:, 0] * TORSION_RADIUS)


def test_wrist_is_light_but_no_contact_moves_it(cube: ObjectModel, config: Config) -> None:
    own = build_mujoco_scene(cube, load_hand(config.hand), config).model
    for name in ("wrist_x", "wrist_y", "wrist_z"):
        assert own.body(name).mass[0] == 0.01
        assert own.dof_armature[own.joint(name).dofadr[0]] == mujoco_scene.IMMOVABLE


def test_wrist_waits_while_the_object_is_released(
    cube: ObjectModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After closing it stands for the release time, and then follows its path to the target."""
    baseline, path = peer(cube, "lift.release_time=0.5"), []
    step, close = baseline._step, baseline._close

    def record(p_WB: np.ndarray) -> None:
        path.append(np.array(p_WB))
        step(p_WB)

    def close_and_forget() -> None:
        close()
        path.clear()

    monkeypatch.setattr(baseline, "_step", record)
    monkeypatch.setattr(baseline, "_close", close_and_forget)
    attempt = from_above(cube, STANDOFF)
    assert baseline.run(attempt).outcome is Outcome.SUCCESS
    positions, wait = np.array(path), round(0.5 / TIME_STEP)
    np.testing.assert_allclose(positions[:wait], positions[[0] * wait], atol=1e-12)
    assert np.linalg.norm(positions[wait + 50] - positions[0]) > 1e-4
    config, hand = baseline._config, load_hand()
    X_WG = X_WT @ standing(cube) @ attempt.X_OG
    shift = X_WT[:3, 3] + config.lift.p_TG - X_WG[:3, 3]
    start = (X_WG @ np.linalg.inv(hand.X_BG))[:3, 3]
    np.testing.assert_allclose(positions[0], start, atol=1e-6)
    np.testing.assert_allclose(positions[-1], start + shift, atol=1e-6)
    np.testing.assert_allclose(baseline._data.qpos[baseline._wrist_q], start + shift, atol=1e-4)


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
