"""What Drake is given: the object's mass properties, the materials, the solver, the motors.

Of every hand that comes with the package: the numbers of its hand file.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from helpers.hands import write_tongs
from helpers.objects import from_above, model_of, standing
from pydrake.multibody.plant import DiscreteContactApproximation
from pydrake.multibody.tree import BodyIndex, RigidBody

from drakegrasp.config import Config
from drakegrasp.frames import X_WT
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.hand.file_format import hand_names
from drakegrasp.hand.settings import override_config
from drakegrasp.objects.model import ObjectModel
from drakegrasp.simulation.construction import (
    build_object_scene,
    build_scene,
    object_friction,
    partner_friction,
)
from drakegrasp.simulation.scene import (
    Scene,
    advance,
    closing_angles,
    hand_joint_names,
    hand_positions,
    release,
    reset_attempt,
    reset_object,
)

pytestmark = pytest.mark.sim

#: A cone on its side: neither its centre of mass nor its principal axes are those of {O}.
RADIUS, HEIGHT = 0.03, 0.1


@pytest.fixture(scope="module")
def cone(tmp_path_factory: pytest.TempPathFactory) -> ObjectModel:
    mesh = trimesh.creation.cone(radius=RADIUS, height=HEIGHT, sections=64)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(0.7, [1, 0, 0]))
    return model_of(mesh, tmp_path_factory.mktemp("cone"))


def test_plant_has_the_mass_properties_of_the_model(cone: ObjectModel, config: Config) -> None:
    assert np.linalg.norm(cone.p_OOcm) > 0.005
    scene = build_object_scene(cone, config.physics)
    M = scene.object.CalcSpatialInertiaInBodyFrame(scene.context)
    assert M.get_mass() == pytest.approx(cone.mass)
    np.testing.assert_allclose(M.get_com(), cone.p_OOcm, atol=1e-12)
    about_com = M.Shift(M.get_com()).CalcRotationalInertia().CopyToFullMatrix3()
    np.testing.assert_allclose(about_com, cone.I_OOcm_O, rtol=1e-9, atol=1e-12)
    assert np.abs(np.triu(cone.I_OOcm_O, 1)).max() > 1e-5


def properties(scene: Scene, body: RigidBody, group: str, name: str) -> list[object]:
    """Return a proximity property of each shape of a body."""
    inspector = scene.scene_graph.model_inspector()
    return [
        inspector.GetProximityProperties(geometry).GetProperty(group, name)
        for geometry in scene.plant.GetCollisionGeometriesForBody(body)
    ]


def test_materials_are_the_configured_ones(cone: ObjectModel, config: Config, hand: Hand) -> None:
    """None of them has its usual value: stiffness, dissipation and friction of each body."""
    other = override_config(
        config,
        [
            "physics.dissipation=3.5",
            "physics.fingertip_modulus=2.5e5",
            "physics.link_modulus=3.5e6",
            "physics.table_modulus=4.5e6",
            "physics.friction_hand=0.35",
            "physics.friction_table=0.85",
        ],
    )
    physics = other.physics
    scene = build_scene(cone, physics, hand)
    palm = scene.plant.GetBodyByName(hand.palm_link, scene.instance)
    own, held = object_friction(physics), partner_friction(0.35, physics)
    assert (own, 2.0 * own * held / (own + held)) == (0.85, pytest.approx(0.35))
    for body, modulus, friction in (
        (scene.object, None, own),
        (scene.table, 4.5e6, partner_friction(0.85, physics)),
        (palm, 3.5e6, held),
        *((tip, 2.5e5, held) for tip in scene.fingertips),
    ):
        assert set(properties(scene, body, "material", "hunt_crossley_dissipation")) == {3.5}
        for found in properties(scene, body, "material", "coulomb_friction"):
            assert found.static_friction() == found.dynamic_friction() == pytest.approx(friction)
        if modulus is not None:
            assert set(properties(scene, body, "hydroelastic", "hydroelastic_modulus")) == {modulus}


def test_solver_and_step_are_the_configured_ones(
    cone: ObjectModel, config: Config, hand: Hand
) -> None:
    physics = override_config(config, ["physics.time_step=0.003", "physics.coarse_steps=4"]).physics
    scene = build_scene(cone, physics, hand)
    assert scene.coarse_scene is not None
    for plant, step in ((scene.plant, 0.003), (scene.coarse_scene().plant, 0.012)):
        assert plant.get_discrete_contact_approximation() == DiscreteContactApproximation.kLagged
        assert plant.time_step() == pytest.approx(step)


def test_the_arm_carries_the_hand(scene: Scene, cube: ObjectModel, config: Config) -> None:
    """Only the object has a weight: the hand hangs still where nothing touches it."""
    plant = scene.plant
    weightless = (scene.instance, scene.wrist_instance)
    assert [plant.is_gravity_enabled(i) for i in weightless] == [False, False]
    assert plant.is_gravity_enabled(scene.object.model_instance())


def test_motors_are_those_of_the_hand_file(scene: Scene, hand: Hand) -> None:
    for motor, joint, finger in zip(scene.motors, scene.closing_joints, hand.fingers, strict=True):
        (actuator,) = motor.actuators
        assert actuator.joint().name() == joint.name() == finger.closing_joint
        assert motor.effort_limit() == actuator.effort_limit() == finger.effort_limit
        assert actuator.default_rotor_inertia() == finger.rotor_inertia
        assert actuator.default_gear_ratio() == finger.gear_ratio
    for driven, finger in zip(scene.driven, hand.fingers, strict=True):
        ratios = {joint.name(): ratio for joint, ratio in driven.items()}
        coupled = {coupling.joint: coupling.ratio for coupling in finger.coupled}
        assert ratios == {finger.closing_joint: 1.0, **coupled}


def test_only_fingertips_of_different_fingers_meet(scene: Scene) -> None:
    plant = scene.plant
    inspector = scene.scene_graph.model_inspector()
    bodies = [plant.get_body(i) for i in plant.GetBodyIndices(scene.instance)]
    tips = {body.name() for body in scene.fingertips}
    for a in bodies:
        for b in bodies:
            meet = {
                not inspector.CollisionFiltered(g, h)
                for g in plant.GetCollisionGeometriesForBody(a)
                for h in plant.GetCollisionGeometriesForBody(b)
                if g != h
            }
            different = a.name() != b.name() and {a.name(), b.name()} <= tips
            assert meet <= {different}, (a.name(), b.name())


def partners(scene: Scene, name: str) -> set[str]:
    """Return the bodies that one of the object's surfaces meets now, by name."""
    plant, inspector = scene.plant, scene.plant.EvalSceneGraphInspector(scene.context)
    geometries = plant.GetCollisionGeometriesForBody(scene.object)
    (surface,) = [g for g in geometries if inspector.GetName(g) == f"object::{name}"]
    bodies = [plant.get_body(i) for i in map(BodyIndex, range(plant.num_bodies()))]
    return {
        body.name()
        for body in bodies
        if any(
            not inspector.CollisionFiltered(surface, g)
            for g in plant.GetCollisionGeometriesForBody(body)
            if g != surface
        )
    }


def test_hand_and_table_meet_a_surface_of_their_own(
    scene: Scene, cube: ObjectModel, config: Config, hand: Hand
) -> None:
    """Whatever part of an attempt comes next, and whatever was allowed before."""
    X_WO = X_WT @ standing(cube)
    X_WG = X_WO @ from_above(cube, 0.1).X_OG
    links = {scene.plant.get_body(i).name() for i in scene.plant.GetBodyIndices(scene.instance)}
    for _ in range(2):
        reset_attempt(scene, X_WO, X_WG, spread=0.0)
        assert (partners(scene, "hand"), partners(scene, "table")) == (links, set())
        release(scene)
        assert (partners(scene, "hand"), partners(scene, "table")) == (links, {"table"})

    alone = build_object_scene(cube, config.physics)
    assert partners(alone, "table") == {"table"}
    reset_object(alone, X_WO)
    assert partners(alone, "table") == {"table"}


def test_hand_meets_the_collision_mesh_and_the_table_its_hull(
    config: Config, hand: Hand, tmp_path: Path
) -> None:
    """The hull of a ring has no hole."""
    ring = trimesh.creation.annulus(r_min=0.03, r_max=0.04, height=0.02, sections=32)
    model = model_of(ring, tmp_path)
    assert len(model.collision_faces) == len(ring.faces)
    scene = build_scene(model, config.physics, hand)
    coarse = scene.coarse_scene
    assert coarse is not None
    for stage in (scene, coarse()):
        inspector, faces = stage.scene_graph.model_inspector(), {}
        for geometry in stage.plant.GetCollisionGeometriesForBody(stage.object):
            surface = inspector.maybe_get_hydroelastic_mesh(geometry)
            faces[inspector.GetName(geometry)] = surface.num_triangles()
        assert faces == {
            "object::hand": len(ring.faces),
            "object::table": len(model.resting_surface.faces),
        }


def test_positions_are_in_the_order_of_a_tree_that_the_palm_is_the_root_of(
    tmp_path: Path, cube: ObjectModel, config: Config
) -> None:
    """Not the arm that carries it: its wrist comes where the file has it, after the fingers."""
    path = write_tongs(tmp_path)
    model = tmp_path / "tongs.urdf"
    box = '<link name="arm"><inertial><mass value="1"/><inertia ixx="1e-3" iyy="1e-3" izz="1e-3" '
    wrist = (
        f'{box}ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="wrist" type="revolute">'
        '<parent link="arm"/><child link="palm"/><axis xyz="1 0 0"/>'
        '<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
    )
    model.write_text(model.read_text().replace("</robot>", f"{wrist}</robot>"))
    path.write_text(f"{path.read_text()}preshape: {{wrist: 0.0}}\n")
    hand = load_hand(path)
    names = hand_joint_names(build_scene(cube, config.physics, hand))
    assert names == list(hand.joint_order)
    assert names[-1] == "wrist"
    # It has a unit, too, though no chain of the palm's has it.
    assert hand.joint_units == dict.fromkeys(hand.joint_names, "rad")


@pytest.fixture(scope="module", params=hand_names())
def shipped(request: pytest.FixtureRequest, cube: ObjectModel, config: Config) -> Scene:
    """The hand high above the cube, after it closed for 0.2 s from a tenth of its way."""
    hand = load_hand(request.param)
    scene, X_WO = build_scene(cube, config.physics, hand), X_WT @ standing(cube)
    start = 0.1 * hand.closing_unit
    X_WG = X_WO @ from_above(cube, 0.5).X_OG
    reset_attempt(scene, X_WO, X_WG, spread=0.0, closing=start)
    advance(scene, 0.2)
    return scene


def test_gains_are_of_joints_that_turn_or_slide(shipped: Scene) -> None:
    """A motor that is 0.1 rad/s, or 0.01 m/s, too slow gives 2 N m, or 20 N."""
    for finger in shipped.hand.fingers:
        (actuator,) = (
            a for m in shipped.motors for a in m.actuators
            if a.joint().name() == finger.closing_joint
        )  # fmt: skip
        d, p = (2000.0, 1e-4) if finger.slides else (20.0, 1e-6)
        gains = actuator.get_controller_gains()
        assert (gains.d, gains.p) == (pytest.approx(d), pytest.approx(p))


def test_fingers_close_at_their_speed(shipped: Scene) -> None:
    hand = shipped.hand
    start = 0.1 * hand.closing_unit[hand.motor_fingers]
    expected = start + 0.2 * np.asarray(hand.closing_speed)[hand.motor_fingers]
    np.testing.assert_allclose(closing_angles(shipped), expected, rtol=0.02)


def test_coupled_joints_are_where_the_hand_file_has_them(shipped: Scene) -> None:
    """And those of the preshape, to the bit."""
    q = dict(zip(hand_joint_names(shipped), hand_positions(shipped), strict=True))
    assert {joint: q[joint] for joint in shipped.hand.preshape} == dict(shipped.hand.preshape)
    for finger in shipped.hand.fingers:
        for coupling in finger.coupled:
            expected = coupling.ratio * q[finger.closing_joint] + coupling.offset
            assert q[coupling.joint] == pytest.approx(expected, abs=2e-3), coupling.joint
