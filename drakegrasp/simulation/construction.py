"""Building a scene: object, table and hand as one Drake diagram.

Input: an object, the physics configuration and, for grasps, a hand. Output: a `scene.Scene`, or a
`scene.ObjectScene` without a hand.

The hand is attached to the world by three prismatic joints and a frame that is welded to the palm.
The rotation of this frame is set in the context. So the palm's orientation is exact and constant,
and the plant needs no rotational wrist joints (our own construction).

Friction and mass are values of a scene's context. They are set for an attempt without building the
scene again, and the results have the same bits as those of a scene that was built with them.

Three pitfalls of Drake 1.51.1 affect this module. With geometry on the world body, Drake crashes as
soon as a joint is locked, so the table is a separate body. `AddMultibodyPlantSceneGraph` leaks the
plant. Sampled output ports report the contacts of the previous step.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from itertools import product
from typing import Any

import numpy as np
from pydrake.common import MemoryFile
from pydrake.geometry import (
    AddCompliantHydroelasticProperties,
    AddContactMaterial,
    AddRigidHydroelasticProperties,
    Box,
    CollisionFilterDeclaration,
    Convex,
    GeometryId,
    GeometryInstance,
    GeometrySet,
    InMemoryMesh,
    Mesh,
    Meshcat,
    MeshcatVisualizer,
    MeshcatVisualizerParams,
    ProximityProperties,
    RoleAssign,
    SceneGraph,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import (
    AddMultibodyPlant,
    CoulombFriction,
    MultibodyPlant,
    MultibodyPlantConfig,
)
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    JointActuator,
    ModelInstanceIndex,
    PdControllerGains,
    PrismaticJoint,
    RigidBody,
    RotationalInertia,
    SpatialInertia,
)
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import TrajectorySource
from pydrake.trajectories import PiecewisePolynomial

from drakegrasp.arithmetic import multiply
from drakegrasp.config import PhysicsConfig
from drakegrasp.frames import X_WT, Array
from drakegrasp.hand.description import FINGER_DAMPING, Hand
from drakegrasp.hand.file_format import MODELS, Finger, with_efforts
from drakegrasp.hand.kinematics import within_load
from drakegrasp.hand.parsing import add_model, make_parser
from drakegrasp.hand.shapes import hull_corners
from drakegrasp.mesh.surfaces import Solid, hull_text, obj_text
from drakegrasp.objects.model import ObjectModel
from drakegrasp.objects.surroundings import Hull, Neighbourhood
from drakegrasp.simulation.attempt import Materials
from drakegrasp.simulation.scene import Motor, Neighbour, ObjectScene, Scene, joint_limits
from drakegrasp.vision.camera import object_colour

#: Mass of each of the three bodies of the wrist [kg]; small compared to the hand's.
WRIST_BODY_MASS = 0.02
#: Wrist gains [N/m], [N s/m]: under 2 kg the wrist sags by 0.02 mm.
WRIST_STIFFNESS, WRIST_DAMPING = 1e6, 1e4
#: Drake requires a positive stiffness [N m/rad]; this one adds less than a millionth of the torque.
FINGER_STIFFNESS = 1e-6
#: A separate motor that is this far from its path [rad, or 0.1 m] applies its full torque, and its
#: damping is its stiffness times this time [s]; own choices.
SOFT, LAG = 0.1, 0.1
#: Distance above the table at which the solver considers a contact before it has a force [m].
#: Without it, a flat base on a stiff table jitters (RobotLocomotion/drake#21514). An edge or a tip
#: sinks in by about twice as much.
TABLE_MARGIN = 5e-5
#: Resolution hint for the few hand parts that are cylinders [m]; boxes and meshes ignore it.
RESOLUTION_HINT = 0.005
#: Directions (n, 3) of the simpler hulls.
HULL_DIRECTIONS = np.array([d for d in product(range(-2, 3), repeat=3) if any(d)], dtype=float)
#: Frames per simulated second in Meshcat [Hz]. A power of two makes their times exact, so that
#: rounding errors do not merge any two of them.
MESHCAT_RATE = 32.0

#: Colour of walls in recordings, R, G, B and opacity.
WALL_COLOUR = np.array([0.62, 0.64, 0.68, 0.5])

#: Group and name of a shape's coefficient of friction.
FRICTION = ("material", "coulomb_friction")


def build_scene(
    model: ObjectModel,
    physics: PhysicsConfig,
    hand: Hand,
    *,
    meshcat: Meshcat | None = None,
    around: Neighbourhood | None = None,
) -> Scene:
    """Return the scene of an object, the table and a hand.

    The object has two rigid hydroelastic surfaces: the hand meets its exact collision mesh, the
    table a surface that provides stable support. The table and every part of the hand are
    compliant, so that each contact with the object is hydroelastic.

    `Scene.coarse_scene` builds the scene with coarse steps when it is first called, and
    `Scene.own_motors` the scene with a motor for each joint of the fingers.

    Args:
        model: The object; its own friction, if it has one, takes precedence.
        physics: Materials, solver and time step.
        hand: The hand.
        meshcat: Where to show the scene while it is simulated; the results have the same bits.
        around: Neighbours and walls around the object; None if it is alone on the table.
    """
    physics, hand = model.own_physics(physics), within_load(hand, physics.finger_load)
    build = partial(_with_coarse, model, physics, hand, meshcat, around)
    return replace(build(), own_motors=cache(partial(build, own_motors=True)))


def _with_coarse(
    model: ObjectModel,
    physics: PhysicsConfig,
    hand: Hand,
    meshcat: Meshcat | None,
    around: Neighbourhood | None,
    *,
    own_motors: bool = False,
) -> Scene:
    """Return a scene that can build its scene with coarse steps."""
    build = partial(_build, model, hand=hand, meshcat=meshcat, around=around, own_motors=own_motors)
    scene = build(physics=physics)
    if physics.coarse_steps == 1:
        return scene
    time_step = physics.coarse_steps * physics.time_step
    coarse = physics.model_copy(update={"time_step": time_step})
    return replace(scene, coarse_scene=cache(partial(build, physics=coarse)))


def build_object_scene(
    model: ObjectModel,
    physics: PhysicsConfig,
    *,
    meshcat: Meshcat | None = None,
    resting_surface: Solid | None = None,
    around: Neighbourhood | None = None,
) -> ObjectScene:
    """Return the scene of an object and the table; see `build_scene`.

    Args:
        model: The object; its own friction, if it has one, takes precedence.
        physics: Materials, solver and time step.
        meshcat: Where to show the scene while it is simulated.
        resting_surface: Surface that meets the table, in {O}; None for the object's
            `resting_surface`.
        around: Neighbours and walls around the object; None if it is alone on the table.
    """
    physics = model.own_physics(physics)
    # If nothing is around it, the object meets the table alone.
    surfaces = {"table": resting_surface or model.resting_surface}
    if around is not None:
        surfaces = {"hand": model.collision_solid, **surfaces}
    builder, drawn = _draft(model, physics, surfaces, meshcat, around)
    drawn["plant"].Finalize()
    if around is not None:
        _part_surfaces(drawn)
    return ObjectScene(simulator=Simulator(builder.Build()), **drawn)


def _draft(
    model: ObjectModel,
    physics: PhysicsConfig,
    surfaces: Mapping[str, Solid],
    meshcat: Meshcat | None,
    around: Neighbourhood | None,
) -> tuple[DiagramBuilder, dict[str, Any]]:
    """Return a diagram with the free object and the table, and attributes of `ObjectScene`.

    Args:
        model: The object.
        physics: Materials, solver and time step.
        surfaces: The object's surfaces in {O}, by their contact partners `hand` and `table`.
        meshcat: Where to show the scene.
        around: Neighbours and walls around the object.
    """
    builder = DiagramBuilder()
    config = MultibodyPlantConfig(
        time_step=physics.time_step,
        contact_model="hydroelastic_with_fallback",
        discrete_contact_approximation="lagged",
        # Sampled ports would report the contacts of the previous step.
        use_sampled_output_ports=False,
    )
    plant, scene_graph = AddMultibodyPlant(config, builder)
    object_body = plant.AddRigidBody(
        "object", plant.AddModelInstance("object"), object_inertia(model, model.mass)
    )
    sides = {
        name: _add_surface(plant, object_body, name, surface, physics)
        for name, surface in surfaces.items()
    }
    table = _add_table(plant, scene_graph, physics)
    surrounding = {} if around is None else _add_around(plant, object_body, model, around, physics)

    # A recording needs a visual shape.
    if meshcat is not None:
        _add_visual(plant, object_body, model)
        for neighbour in surrounding.get("neighbours", ()):
            _add_visual(plant, neighbour.body, neighbour.model)
        rate = MeshcatVisualizerParams(publish_period=1.0 / MESHCAT_RATE)
        MeshcatVisualizer.AddToBuilder(builder, scene_graph, meshcat, rate)
    return builder, {
        "model": model,
        "physics": physics,
        "plant": plant,
        "scene_graph": scene_graph,
        "object": object_body,
        "table_side": sides["table"],
        "table": table,
        **surrounding,
    }


def _build(
    model: ObjectModel,
    physics: PhysicsConfig,
    hand: Hand,
    meshcat: Meshcat | None,
    around: Neighbourhood | None,
    own_motors: bool,
) -> Scene:
    # The object on the table, and the hand on its wrist, which follows a trajectory.
    surfaces = {"hand": model.collision_solid, "table": model.resting_surface}
    builder, drawn = _draft(model, physics, surfaces, meshcat, around)
    plant, scene_graph = drawn["plant"], drawn["scene_graph"]
    trajectory = builder.AddSystem(
        TrajectorySource(PiecewisePolynomial(np.zeros((3, 1))), output_derivative_order=1)
    )
    drawn |= _add_hand(plant, scene_graph, hand, own_motors)
    instance, fingertips = drawn["instance"], drawn["fingertips"]
    tips, friction = {body.index() for body in fingertips}, physics.friction_hand
    for index in plant.GetBodyIndices(instance):
        modulus = physics.fingertip_modulus if index in tips else physics.link_modulus
        _make_compliant(plant, scene_graph, plant.get_body(index), modulus, friction, physics)
    plant.Finalize()

    # Add what needs the finalized plant: collision filters and the wrist's input.
    _part_surfaces(drawn, [geometry for geometry, _ in drawn["parts"]])
    _filter_within_hand(plant, scene_graph, instance, fingertips)
    builder.Connect(
        trajectory.get_output_port(),
        plant.get_desired_state_input_port(drawn["wrist_instance"]),
    )

    # Separate motors follow a path; the command of the hand file's motors never changes.
    command, path = plant.get_desired_state_input_port(instance), None
    if own_motors:
        still = PiecewisePolynomial(np.zeros((len(drawn["motors"]), 1)))
        path = builder.AddSystem(TrajectorySource(still, output_derivative_order=1))
        builder.Connect(path.get_output_port(), command)
    paths = {"wrist_trajectory": trajectory, "joint_trajectory": path}
    scene = Scene(simulator=Simulator(builder.Build()), **drawn, **paths)
    if not own_motors:
        # The constant [q_d; v_d] that closes all fingers at the hand's speed.
        closing = np.concatenate([np.zeros(hand.num_fingers), hand.closing_speed])
        command.FixValue(scene.context, closing)
    return scene


def _add_surface(
    plant: MultibodyPlant, body: RigidBody, name: str, surface: Solid, physics: PhysicsConfig
) -> GeometryId:
    """Add a rigid hydroelastic surface in {O} to the object, named after its contact partner."""
    properties = ProximityProperties()
    AddRigidHydroelasticProperties(properties)
    _add_material(properties, object_friction(physics), physics)
    text = obj_text(surface.vertices, surface.faces, normals=False)
    mesh = Mesh(InMemoryMesh(mesh_file=MemoryFile(text, ".obj", name)))
    return plant.RegisterCollisionGeometry(body, RigidTransform(), mesh, name, properties)


def _add_around(
    plant: MultibodyPlant,
    object_body: RigidBody,
    model: ObjectModel,
    around: Neighbourhood,
    physics: PhysicsConfig,
) -> dict[str, Any]:
    """Add free neighbours and fixed walls, and return the attributes of `ObjectScene` about them.

    A neighbour has the surfaces of the object. Drake finds no hydroelastic contact between two
    rigid meshes, so objects meet each other by a third shape: their convex hull, as compliant as
    the table. An object in the hollow of another one would therefore be pushed out of it.
    """
    neighbours = []
    for i, (other, X_TN) in enumerate(zip(around.models, around.X_TN, strict=True)):
        name = f"neighbour_{i}"
        body = plant.AddRigidBody(
            name, plant.AddModelInstance(name), object_inertia(other, other.mass)
        )
        own = other.own_physics(physics)
        _add_surface(plant, body, "hand", other.collision_solid, own)
        _add_surface(plant, body, "table", other.resting_surface, own)
        _add_hull(plant, body, other, own)
        neighbours.append(Neighbour(body=body, model=other, X_WN=multiply(X_WT, X_TN)))
    if neighbours:
        _add_hull(plant, object_body, model, physics)
    if not around.walls:
        return {"neighbours": tuple(neighbours)}

    # The walls are of the table's material, on a body of their own, see the module.
    walls = plant.AddRigidBody("walls", plant.AddModelInstance("walls"), SpatialInertia.NaN())
    plant.WeldFrames(plant.world_frame(), walls.body_frame(), RigidTransform(X_WT))
    properties = ProximityProperties()
    AddCompliantHydroelasticProperties(RESOLUTION_HINT, physics.table_modulus, properties)
    _add_material(properties, partner_friction(physics.friction_table, physics), physics)
    for i, wall in enumerate(around.walls):
        X_TB = RigidTransform(wall.X_TB)
        shape = Convex(wall.vertices.T, "hull") if isinstance(wall, Hull) else Box(*wall.size)
        plant.RegisterCollisionGeometry(walls, X_TB, shape, f"wall_{i}", properties)
        plant.RegisterVisualGeometry(walls, X_TB, shape, f"wall_{i}", WALL_COLOUR)
    return {"neighbours": tuple(neighbours), "walls": walls}


def _add_hull(
    plant: MultibodyPlant, body: RigidBody, model: ObjectModel, physics: PhysicsConfig
) -> None:
    """Add the compliant convex hull by which an object meets its neighbours.

    Drake refuses a hull with a face without an area, as those of dense points may have; then the
    hull is that of the points which are farthest in some directions.
    """
    properties = ProximityProperties()
    AddCompliantHydroelasticProperties(RESOLUTION_HINT, physics.table_modulus, properties)
    _add_material(properties, object_friction(physics), physics)
    points = model.collision_vertices
    text = obj_text(points, model.collision_faces, normals=False)
    hull = Convex(InMemoryMesh(mesh_file=MemoryFile(text, ".obj", "hull")), 1.0)
    if not accepts_hull(hull):
        text = hull_text(points[np.unique(multiply(points, HULL_DIRECTIONS.T).argmax(axis=0))])
        hull = Convex(InMemoryMesh(mesh_file=MemoryFile(text, ".obj", "hull")), 1.0)
    plant.RegisterCollisionGeometry(body, RigidTransform(), hull, "hull", properties)


def accepts_hull(shape: Convex) -> bool:
    """Return whether Drake accepts a shape; a plant that refused one cannot be used any more."""
    properties, modulus = ProximityProperties(), PhysicsConfig().table_modulus
    AddCompliantHydroelasticProperties(RESOLUTION_HINT, modulus, properties)
    graph, instance = SceneGraph(), GeometryInstance(RigidTransform(), shape, "hull")
    instance.set_proximity_properties(properties)
    try:
        graph.RegisterAnchoredGeometry(graph.RegisterSource("trial"), instance)
    except (RuntimeError, SystemExit):  # SystemExit: failed assertion in Drake
        return False
    return True


def object_inertia(model: ObjectModel, mass: float) -> SpatialInertia:
    """Return the spatial inertia of an object in {O}, scaled to a mass [kg]."""
    # Mass properties are about Ocm in {O}; Drake shifts them to the origin of {O}.
    I = mass / model.mass * model.I_OOcm_O  # noqa: E741
    return SpatialInertia.MakeFromCentralInertia(
        mass,
        model.p_OOcm,
        RotationalInertia(I[0, 0], I[1, 1], I[2, 2], I[0, 1], I[0, 2], I[1, 2]),
    )


def _add_visual(plant: MultibodyPlant, body: RigidBody, model: ObjectModel) -> None:
    # Show the collision surface: its number of faces is bounded, unlike that of the file.
    text = obj_text(model.collision_vertices, model.collision_faces, normals=True)
    mesh = Mesh(InMemoryMesh(mesh_file=MemoryFile(text, ".obj", model.name)))
    colour = np.array([*object_colour(model.name), 1.0])
    plant.RegisterVisualGeometry(body, RigidTransform(), mesh, "visual", colour)


def _add_table(plant: MultibodyPlant, scene_graph: SceneGraph, physics: PhysicsConfig) -> RigidBody:
    (instance,) = make_parser(plant).AddModels(MODELS / "table.urdf")
    body = plant.GetBodyByName("table", instance)
    plant.WeldFrames(plant.world_frame(), body.body_frame(), RigidTransform(X_WT))
    modulus, friction = physics.table_modulus, physics.friction_table
    _make_compliant(plant, scene_graph, body, modulus, friction, physics, margin=TABLE_MARGIN)
    return body


def object_friction(rules: PhysicsConfig | Materials) -> float:
    """Return the object's own friction coefficient.

    Drake combines the coefficients a, b of a pair to 2 a b / (a + b). If the object has the larger
    of the two effective values, each effective value results from a positive coefficient of the
    partner.
    """
    return max(rules.friction_hand, rules.friction_table)


def partner_friction(effective: float, rules: PhysicsConfig | Materials) -> float:
    """Return the coefficient of hand or table that results in an effective one with the object.

    With the object's own coefficient a, Drake's rule is solved for the partner's coefficient b:

        μ = 2 a b / (a + b)   ⇔   b = μ a / (2 a − μ)
    """
    mu = object_friction(rules)
    return effective * mu / (2.0 * mu - effective)


def _add_material(properties: ProximityProperties, mu: float, physics: PhysicsConfig) -> None:
    AddContactMaterial(
        dissipation=physics.dissipation,
        friction=CoulombFriction(mu, mu),
        properties=properties,
    )


def _make_compliant(
    plant: MultibodyPlant,
    scene_graph: SceneGraph,
    body: RigidBody,
    modulus: float,
    effective: float,
    physics: PhysicsConfig,
    *,
    margin: float | None = None,
) -> None:
    """Give a body a stiffness [Pa], its effective friction with the object, and a margin [m]."""
    properties = ProximityProperties()
    AddCompliantHydroelasticProperties(RESOLUTION_HINT, modulus, properties)
    if margin is not None:
        properties.AddProperty("hydroelastic", "margin", margin)
    _add_material(properties, partner_friction(effective, physics), physics)
    for geometry in plant.GetCollisionGeometriesForBody(body):
        scene_graph.AssignRole(plant.get_source_id(), geometry, properties, RoleAssign.kReplace)


def _add_hand(
    plant: MultibodyPlant, scene_graph: SceneGraph, hand: Hand, own_motors: bool
) -> dict[str, Any]:
    """Add the hand on its wrist, and return the attributes of `Scene` that describe them."""
    # Weld the palm to the wrist by frames whose poses are parameters of the context.
    wrist_instance = plant.AddModelInstance("wrist")
    wrist_joints = _add_wrist(plant, wrist_instance)
    instance = add_model(plant, hand.model)
    base = plant.GetBodyByName(hand.palm_link, instance)
    # Links in the hand's model may have any name: our frame's name must differ from them.
    palm = plant.AddFrame(
        FixedOffsetFrame("drakegrasp_palm", base.body_frame(), RigidTransform(hand.X_BG), instance)
    )
    carrier = wrist_joints[-1].child_body().body_frame()
    wrist_frame = plant.AddFrame(FixedOffsetFrame("wrist", carrier, RigidTransform()))
    plant.WeldFrames(wrist_frame, palm, RigidTransform())

    motors = (_add_own_motors if own_motors else _add_actuation)(plant, hand, instance)
    # The arm, which is not simulated, supports the weight of the hand.
    for weightless in (instance, wrist_instance):
        plant.set_gravity_enabled(weightless, False)

    return {
        **motors,
        "hand": hand,
        "instance": instance,
        "wrist_instance": wrist_instance,
        "wrist_joints": wrist_joints,
        "wrist_frame": wrist_frame,
        "fingertips": tuple(plant.GetBodyByName(f.fingertip, instance) for f in hand.fingers),
        "parts": _points_inside(plant, scene_graph, instance),
    }


def _points_inside(
    plant: MultibodyPlant, scene_graph: SceneGraph, instance: ModelInstanceIndex
) -> tuple[tuple[GeometryId, Array], ...]:
    """Return each collision shape of a model with a point inside it, (3,) in its own frame [m]."""
    inspector, points = scene_graph.model_inspector(), []
    for index in plant.GetBodyIndices(instance):
        for geometry in plant.GetCollisionGeometriesForBody(plant.get_body(index)):
            corners = hull_corners(inspector, geometry)
            # The origin of a primitive's frame is its centre.
            points.append((geometry, np.zeros(3) if corners is None else corners.mean(axis=0)))
    return tuple(points)


def _add_wrist(plant: MultibodyPlant, instance: ModelInstanceIndex) -> tuple[PrismaticJoint, ...]:
    parent = plant.world_body()
    joints = []
    for name, axis in zip("xyz", np.eye(3), strict=True):
        inertia = SpatialInertia.SolidSphereWithMass(WRIST_BODY_MASS, 0.02)
        body = plant.AddRigidBody(f"wrist_{name}", instance, inertia)
        joint = plant.AddJoint(
            PrismaticJoint(f"wrist_{name}", parent.body_frame(), body.body_frame(), axis)
        )
        actuator = plant.AddJointActuator(f"wrist_{name}", joint)
        actuator.set_controller_gains(PdControllerGains(p=WRIST_STIFFNESS, d=WRIST_DAMPING))
        joints.append(joint)
        parent = body
    return tuple(joints)


def _add_actuation(
    plant: MultibodyPlant, hand: Hand, instance: ModelInstanceIndex
) -> dict[str, Any]:
    """Add each finger's motor, and couple the joints that follow its closing joint.

    With the closing joint's position q and the speed ω at which the hand closes, a motor applies

        τ = K (0 − q) + D (ω − dq/dt), cut off at ± the finger's effort limit,
        K = `FINGER_STIFFNESS` / u², D = `FINGER_DAMPING` / u²,

    where u = 1 rad, or the slide that is treated as equal to 1 rad (`Hand.closing_unit`). A rotor
    of inertia I behind a gear of ratio n adds n² I to the joint. A coupled joint is at r q + q₀,
    with the ratio and the offset of the hand file. The joints of a finger that this finger drives
    are coupled in the same way.

    Returns:
        The attributes of `Scene` that describe the motors.
    """
    # Fingers that share a motor push equally, so that the couplings only transmit differences. In
    # Drake, couplings are stiff, but not rigid.
    actuators = []
    for i, unit in enumerate(hand.closing_unit.tolist()):
        finger = _with_share(hand, i)
        joint = plant.GetJointByName(finger.closing_joint, instance)
        gains = PdControllerGains(p=FINGER_STIFFNESS / unit**2, d=FINGER_DAMPING / unit**2)
        actuators.append(_add_motor(plant, finger.name, joint, finger, gains))

    # Each motor moves the closing joint of its finger, and the joints that follow it.
    motors, driven = [], []
    for m, i in enumerate(hand.motor_fingers):
        own = [i, *(j for j in np.flatnonzero(hand.motor_of == m).tolist() if j != i)]
        ratio = float(hand.closing_ratio[:, m].sum())
        motors.append(Motor(actuators=tuple(actuators[j] for j in own), ratio=ratio))
        joint = actuators[i].joint()
        driven.append({joint: 1.0})
        for coupling in hand.followers(i):
            follower = plant.GetJointByName(coupling.joint, instance)
            plant.AddCouplerConstraint(follower, joint, coupling.ratio, coupling.offset)
            driven[-1][follower] = coupling.ratio
    fingers = [hand.fingers[i] for i in hand.motor_fingers]
    units = hand.closing_unit[hand.motor_fingers]
    return _of_motors(motors, driven, fingers, units, hand.locked_joints)


def _add_own_motors(
    plant: MultibodyPlant, hand: Hand, instance: ModelInstanceIndex
) -> dict[str, Any]:
    """Add a motor for every joint between the palm and a fingertip that can have one.

    With the position q of the joint and the position q_d and speed of its path, a motor applies

        τ = K (q_d − q) + D (dq_d/dt − dq/dt), cut off at ± the effort limit τ_max,
        K = τ_max / (`SOFT` u), D = K `LAG`,

    with effort limit, holding effort, rotor and gear of the finger's closing joint. Fingers that
    share a motor have equal fractions of its efforts. `Hand.own_motors` lists these joints.

    Returns:
        The attributes of `Scene` that describe the motors.
    """
    motors: list[Motor] = []
    fingers, own = list[Finger](), hand.own_motors
    for name, i in own.items():
        finger = _with_share(hand, i)
        p = finger.effort_limit / (SOFT * hand.closing_unit[i])
        gains, joint = PdControllerGains(p=p, d=LAG * p), plant.GetJointByName(name, instance)
        actuator = _add_motor(plant, f"{finger.name}/{name}", joint, finger, gains)
        motors.append(Motor(actuators=(actuator,)))
        fingers.append(finger)
    still = tuple(name for name in hand.joint_names if name not in own)
    driven = [{motor.actuators[0].joint(): 1.0} for motor in motors]
    return _of_motors(motors, driven, fingers, hand.closing_unit[list(own.values())], still)


def _with_share(hand: Hand, i: int) -> Finger:
    """Return a finger with its fraction of efforts if all fingers of its motor press equally."""
    ratio = hand.closing_ratio[:, hand.motor_of[i]]
    share, finger = float(ratio[i] / ratio.sum()), hand.fingers[i]
    holding = None if finger.holding_effort is None else share * finger.holding_effort
    return with_efforts(finger, share * finger.effort_limit, holding, slides=finger.slides)


def _add_motor(
    plant: MultibodyPlant, name: str, joint: Any, finger: Finger, gains: PdControllerGains
) -> JointActuator:
    actuator = plant.AddJointActuator(name, joint, finger.effort_limit)
    actuator.set_default_rotor_inertia(finger.rotor_inertia)
    actuator.set_default_gear_ratio(finger.gear_ratio)
    actuator.set_controller_gains(gains)
    return actuator


def _of_motors(
    motors: Sequence[Motor],
    driven: Sequence[dict[Any, float]],
    fingers: Sequence[Finger],
    units: Array,
    still: tuple[str, ...],
) -> dict[str, Any]:
    joints = tuple(motor.actuators[0].joint() for motor in motors)
    return {
        "motors": tuple(motors),
        "closing_joints": joints,
        "closing_limits": tuple(joint_limits(joint) for joint in joints),
        "closing_units": units,
        "effort_limits": np.array([motor.effort_limit() for motor in motors]),
        "holding_efforts": tuple(finger.holding_effort for finger in fingers),
        "driven": tuple(driven),
        "still_joints": still,
    }


def _part_surfaces(drawn: dict[str, Any], parts: Sequence[GeometryId] = ()) -> None:
    """Let each of the surfaces of an object meet only its partners.

    Of an object and its neighbours, the first surface meets the hand's parts, the second one the
    table and the walls, and the hull the hulls of the others.
    """
    plant = drawn["plant"]
    geometries = plant.GetCollisionGeometriesForBody
    bodies = [drawn["object"], *(each.body for each in drawn.get("neighbours", ()))]
    surfaces = [geometries(body) for body in bodies]
    hand_sides, table_sides, hulls = (
        GeometrySet([own[i] for own in surfaces if len(own) > i]) for i in range(3)
    )
    fixed = geometries(drawn["table"])
    if "walls" in drawn:
        fixed = [*fixed, *geometries(drawn["walls"])]
    declare = CollisionFilterDeclaration()
    declare.ExcludeBetween(hand_sides, GeometrySet(fixed))
    declare.ExcludeBetween(table_sides, GeometrySet(parts))
    if len(bodies) > 1:
        declare.ExcludeWithin(hand_sides).ExcludeWithin(table_sides)
        declare.ExcludeBetween(hand_sides, table_sides)
        for others in (hand_sides, table_sides, GeometrySet(parts), GeometrySet(fixed)):
            declare.ExcludeBetween(hulls, others)
    drawn["scene_graph"].collision_filter_manager().Apply(declare)


def _filter_within_hand(
    plant: MultibodyPlant,
    scene_graph: SceneGraph,
    instance: ModelInstanceIndex,
    fingertips: Sequence[RigidBody],
) -> None:
    """Let only fingertips of different fingers collide within the hand.

    The shapes of the other links overlap at their joints by design, and the fingertips meet before
    other links can.
    """
    links = {
        index: plant.GetCollisionGeometriesForBody(plant.get_body(index))
        for index in plant.GetBodyIndices(instance)
    }
    tips = [links.pop(body.index()) for body in fingertips]
    every_tip = GeometrySet([geometry for tip in tips for geometry in tip])
    others = GeometrySet([geometry for link in links.values() for geometry in link])

    # Exclude all pairs except for pairs of two fingertips.
    manager = scene_graph.collision_filter_manager()
    manager.Apply(CollisionFilterDeclaration().ExcludeWithin(others))
    manager.Apply(CollisionFilterDeclaration().ExcludeBetween(others, every_tip))
    for tip in tips:
        manager.Apply(CollisionFilterDeclaration().ExcludeWithin(GeometrySet(tip)))


def set_materials(scene: Scene, materials: Materials) -> None:
    """Set the friction and mass of a scene to those of an attempt, unless it already has them.

    Args:
        scene: Scene of the object and a hand.
        materials: Friction and mass from now on.
    """
    if scene.object.get_mass(scene.context) != materials.mass:
        inertia = object_inertia(scene.model, materials.mass)
        scene.object.SetSpatialInertiaInBodyFrame(scene.context, inertia)
    _set_friction(scene, scene.object, object_friction(materials))
    for fixed in filter(None, (scene.table, scene.walls)):
        _set_friction(scene, fixed, partner_friction(materials.friction_table, materials))
    for link in scene.links:
        _set_friction(scene, link, partner_friction(materials.friction_hand, materials))


def _set_friction(scene: Scene, body: RigidBody, mu: float) -> None:
    """Set the own coefficient of friction of each shape of a body, if it has another one."""
    source = scene.plant.get_source_id()
    for geometry in scene.plant.GetCollisionGeometriesForBody(body):
        inspector = scene.plant.EvalSceneGraphInspector(scene.context)
        properties = ProximityProperties(inspector.GetProximityProperties(geometry))
        # Assigning properties recomputes the shape's hydroelastic representation, which takes time.
        if properties.GetProperty(*FRICTION).dynamic_friction() != mu:
            properties.UpdateProperty(*FRICTION, CoulombFriction(mu, mu))
            scene.scene_graph.AssignRole(
                scene.graph_context, source, geometry, properties, RoleAssign.kReplace
            )
