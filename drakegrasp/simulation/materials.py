"""Friction and mass of a scene that is built: set for an attempt, without building it anew.

Both are values of the scene's context. The results are the same bits as those of a scene that is
built with these values, whatever the scene had before.
"""

from __future__ import annotations

from collections.abc import Iterator

from pydrake.geometry import GeometryId, ProximityProperties, RoleAssign
from pydrake.multibody.plant import CoulombFriction
from pydrake.multibody.tree import RigidBody

from drakegrasp.simulation.conditions import Materials
from drakegrasp.simulation.construction import (
    object_friction,
    object_inertia,
    partner_friction,
)
from drakegrasp.simulation.scene import Scene

#: Group and name of a shape's coefficient of friction.
FRICTION = ("material", "coulomb_friction")


def set_materials(scene: Scene, materials: Materials) -> None:
    """Give a scene the friction and mass of an attempt; nothing is done where it has them.

    Args:
        scene: Of the object and a hand.
        materials: What the scene has from now on.
    """
    if scene.object.get_mass(scene.context) != materials.mass:
        inertia = object_inertia(scene.model, materials.mass)
        scene.object.SetSpatialInertiaInBodyFrame(scene.context, inertia)
    for geometry, mu in list(_coefficients(scene, materials)):
        _set_friction(scene, geometry, mu)


def copy_materials(scene: Scene, before: Scene) -> None:
    """Give a scene the friction and mass of another one of the same object and hand."""
    if scene.object.get_mass(scene.context) != before.object.get_mass(before.context):
        inertia = before.object.CalcSpatialInertiaInBodyFrame(before.context)
        scene.object.SetSpatialInertiaInBodyFrame(scene.context, inertia)
    for geometry, other in zip(_geometries(scene), _geometries(before), strict=True):
        _set_friction(scene, geometry, _friction(before, other))


def _set_friction(scene: Scene, geometry: GeometryId, mu: float) -> None:
    """Give a shape its own coefficient of friction, if it has another one."""
    # Assigning properties computes the shape's hydroelastic form again, which takes time.
    if _friction(scene, geometry) == mu:
        return
    properties = ProximityProperties(_properties(scene, geometry))
    properties.UpdateProperty(*FRICTION, CoulombFriction(mu, mu))
    scene.scene_graph.AssignRole(
        scene.scene_graph.GetMyMutableContextFromRoot(scene.simulator.get_mutable_context()),
        scene.plant.get_source_id(),
        geometry,
        properties,
        RoleAssign.kReplace,
    )


def _friction(scene: Scene, geometry: GeometryId) -> float:
    return float(_properties(scene, geometry).GetProperty(*FRICTION).dynamic_friction())


def _properties(scene: Scene, geometry: GeometryId) -> ProximityProperties:
    return scene.plant.EvalSceneGraphInspector(scene.context).GetProximityProperties(geometry)


def _coefficients(scene: Scene, materials: Materials) -> Iterator[tuple[GeometryId, float]]:
    """Yield each shape with its own coefficient of friction."""
    physics = scene.physics.model_copy(
        update={
            "friction_hand": materials.friction_hand,
            "friction_table": materials.friction_table,
        }
    )
    hand = partner_friction(physics.friction_hand, physics)
    own = {
        scene.object.index(): object_friction(physics),
        scene.table.index(): partner_friction(physics.friction_table, physics),
    }
    for body in _bodies(scene):
        for geometry in scene.plant.GetCollisionGeometriesForBody(body):
            yield geometry, own.get(body.index(), hand)


def _geometries(scene: Scene) -> list[GeometryId]:
    geometries = scene.plant.GetCollisionGeometriesForBody
    return [geometry for body in _bodies(scene) for geometry in geometries(body)]


def _bodies(scene: Scene) -> list[RigidBody]:
    """Return object, table and the links of the hand."""
    return [scene.object, scene.table, *scene.links]
