"""Drake's contact results as the contacts of a grasp, in the object's frame.

The contact of a fingertip is the union of all hydroelastic patches between its pad and the object.
A patch whose pressure is mostly on the hand file's pad region counts for the fingertip as a whole.
A patch that is mostly beside the region is split by the centroids of its faces, and the part beside
the region counts as a contact of another link. The contact's point is the pressure-weighted centre
of the patches. Its normal is the pressure-weighted mean of the face normals and points out of the
object. Both belong to the rigid object's surface, because a patch between a rigid and a compliant
body is a piece of the rigid surface.

`ClearanceMonitor` computes how close the hand comes to the table: the smallest height of its
collision shapes above the table's top between the observed states of the scene. It only reads
positions, so the simulation is the same with and without it. Between two observations, each joint
moves in one direction. A link depends only on the joints of its own finger, which move in fixed
ratios. A straight line from state to state in joint space therefore passes through all postures of
each finger, no matter which finger was faster.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from pydrake.geometry import ContactSurface, HydroelasticContactRepresentation
from pydrake.multibody.plant import HydroelasticContactInfo
from pydrake.multibody.tree import BodyIndex, RigidBody

from drakegrasp.arithmetic import dot, multiply, norm
from drakegrasp.config import CloseConfig
from drakegrasp.frames import X_WT, Array, invert_pose, rotate_vectors, transform_points
from drakegrasp.hand.description import Hand
from drakegrasp.hand.kinematics import posed_links
from drakegrasp.hand.shapes import link_rims
from drakegrasp.mesh.surfaces import winding_numbers
from drakegrasp.objects.model import ObjectModel
from drakegrasp.simulation.scene import (
    ObjectScene,
    Scene,
    hand_joint_names,
    hand_positions,
    palm_pose,
)

#: Largest fraction of a patch's pressure that may lie beside the pad of a fingertip's contact; own
#: choice, see docs/explanation/physics.md, "Pads".
MAX_BESIDE = 0.5


@dataclass(frozen=True, kw_only=True, eq=False)
class Contacts:
    """The contacts at one instant, for a hand of k fingers.

    Attributes:
        touching: (k,) bool, whether the pad of fingertip i presses on the object with more force
            than `physics.contact_force`.
        p_OQ: (k, 3), contact point of each fingertip in {O} [m]; NaN if not touching.
        nhat_Q_O: (k, 3), unit normal out of the object in {O}; NaN if not touching.
        f_Q_O: (k, 3), force of the fingertip on the object in {O} [N]; 0 if not touching.
        area: (k,), area of the patches [m^2]; 0 if not touching.
        penetration: (k,), largest depth of the object's surface in the fingertip [m]; 0 if not
            touching.
        other_links: Number of links of the hand that touch the object beside the pads, including
            fingertip links whose patch is mostly beside the pad.
        hand_on_table, object_on_table: Whether hand and object touch the table.
        table_force: (3,), force of the table on the object in {W} [N].
        point_contacts: Number of point contacts (not hydroelastic) that involve the object.
    """

    touching: np.ndarray
    p_OQ: Array
    nhat_Q_O: Array
    f_Q_O: Array
    area: Array
    penetration: Array
    other_links: int
    hand_on_table: bool
    object_on_table: bool
    table_force: Array
    point_contacts: int


def read_contacts(scene: Scene) -> Contacts:
    """Return the present contacts of the scene; contacts weaker than the limit do not count."""
    results = scene.plant.get_contact_results_output_port().Eval(scene.context)
    reader = _Reader(scene)
    for i in range(results.num_hydroelastic_contacts()):
        reader.add_patch(results.hydroelastic_contact_info(i))
    for i in range(results.num_point_pair_contacts()):
        pair = results.point_pair_contact_info(i)
        reader.add_point_pair({pair.bodyA_index(), pair.bodyB_index()})
    return reader.contacts()


def table_force(scene: ObjectScene) -> Array:
    """Return the present force (3,) of the table on the object, in {W} [N]."""
    return forces_on_object(scene).get(scene.table.index(), np.zeros(3))


def bodies_on_object(scene: ObjectScene) -> set[BodyIndex]:
    """Return the bodies that now touch the object with more than `physics.contact_force`.

    These are the bodies of the contacts of `read_contacts`, without points, normals and areas.
    """
    return _pressing(scene, forces_on_object(scene))


def presses_on_neighbour(scene: Scene) -> bool:
    """Return whether the hand now presses on a neighbour with more than that force."""
    hand = hand_bodies(scene)
    return any(_pressing(scene, forces_on(scene, each.body)) & hand for each in scene.neighbours)


def _pressing(scene: ObjectScene, forces: dict[BodyIndex, Array]) -> set[BodyIndex]:
    limit = scene.physics.contact_force
    return {body for body, force in forces.items() if float(norm(force)) > limit}


def forces_on_object(scene: ObjectScene) -> dict[BodyIndex, Array]:
    """Return the force (3,) of each body on the object, in {W} [N]: the sum of its patches."""
    return forces_on(scene, scene.object)


def forces_on(scene: ObjectScene, body: RigidBody) -> dict[BodyIndex, Array]:
    """Return the force (3,) of each other body on a body, as `forces_on_object`."""
    results = scene.plant.get_contact_results_output_port().Eval(scene.context)
    grasped, forces = body.index(), dict[BodyIndex, Array]()
    for i in range(results.num_hydroelastic_contacts()):
        info = results.hydroelastic_contact_info(i)
        surface, force_on_M = info.contact_surface(), np.array(info.F_Ac_W().translational())
        M, N = _body_of(scene, surface.id_M()), _body_of(scene, surface.id_N())
        if grasped in (M, N):
            other, force = (N, force_on_M) if grasped == M else (M, -force_on_M)
            forces[other] = forces.get(other, np.zeros(3)) + force
    return forces


def open_hand_meets(scene: Scene) -> dict[str, list[str]]:
    """Return the links of the hand that intersect other bodies, by the names of these.

    The names are "object", "table", also for walls, and those of the neighbours' models. Neither
    fingers that meet each other count, nor the object on the table.
    """
    links = hand_meets(scene)
    bodies = [(scene.object, "object"), (scene.table, "table")]
    bodies += [(each.body, each.model.name) for each in scene.neighbours]
    return {name: links[body.index()] for body, name in bodies if body.index() in links}


def hand_meets(scene: Scene) -> dict[BodyIndex, list[str]]:
    """Return the links of the hand that intersect other bodies, by body; walls are the table.

    This is a geometry query without a contact solve. Drake returns contact surfaces if surfaces
    intersect. A part that is completely inside an object has no contact surface, so a point inside
    each part is also tested against the object's volume.
    """
    plant, hand, meetings = scene.plant, hand_bodies(scene), _meetings(scene)
    query = plant.get_geometry_query_input_port().Eval(scene.context)
    objects = [(scene.object, scene.model), *((n.body, n.model) for n in scene.neighbours)]
    for geometry, p in scene.parts:
        p_WP = (query.GetPoseInWorld(geometry) @ p)[None]
        meetings += [
            (_body_of(scene, geometry), body.index())
            for body, model in objects
            if is_inside(model, scene.pose(body), p_WP)
        ]

    found = dict[BodyIndex, set[BodyIndex]]()
    for pair in meetings:
        for link, other in (pair, pair[::-1]):
            if link in hand and other not in hand:
                found.setdefault(other, set()).add(link)
    return {
        other: sorted(plant.get_body(link).name() for link in links)
        for other, links in found.items()
    }


def object_meets_something(scene: ObjectScene) -> bool:
    """Return whether the object intersects a neighbour, a wall or the table."""
    return any(scene.object.index() in pair for pair in _meetings(scene))


def _meetings(scene: ObjectScene) -> list[tuple[BodyIndex, BodyIndex]]:
    """Return the pairs of bodies whose surfaces intersect; walls are the table."""
    query = scene.plant.get_geometry_query_input_port().Eval(scene.context)
    surfaces, pairs = query.ComputeContactSurfacesWithFallback(
        HydroelasticContactRepresentation.kPolygon
    )
    meetings = [(_body_of(scene, s.id_M()), _body_of(scene, s.id_N())) for s in surfaces]
    return meetings + [(_body_of(scene, p.id_A), _body_of(scene, p.id_B)) for p in pairs]


def is_inside(model: ObjectModel, X_WO: Array, p_WP: Array) -> bool:
    """Return whether any of the points (n, 3) [m] is inside the volume of an object at X_WO.

    Drake's point distance rejects meshes with very sharp edges; winding numbers work on them.
    """
    p_OP = transform_points(invert_pose(X_WO), p_WP)
    near = p_OP[np.all(np.abs(p_OP) <= model.half_extents, axis=1)]
    if not len(near):
        return False
    winding = winding_numbers(
        near, model.collision_vertices, model.collision_faces.astype(np.int64)
    )
    return bool(np.any(winding > 0.5))


class _Reader:
    """Sums the patches of each pair of bodies in one pass over the results."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._X_OW = invert_pose(scene.pose(scene.object))
        self._tips = [body.index() for body in scene.fingertips]
        self._hand = hand_bodies(scene)
        self._neighbours = {each.body.index() for each in scene.neighbours}
        k = len(self._tips)
        self._force_W, self._area = np.zeros((k, 3)), np.zeros(k)
        self._weight, self._penetration = np.zeros(k), np.zeros(k)
        self._moment_p, self._moment_n = np.zeros((k, 3)), np.zeros((k, 3))
        self._other_force: dict[BodyIndex, float] = {}
        self._table_force, self._hand_table_force = np.zeros(3), 0.0
        self._point_contacts, self._hand_on_table = 0, False

    def add_patch(self, info: HydroelasticContactInfo) -> None:
        """Add one hydroelastic patch to the sums of its pair of bodies."""
        scene, surface = self._scene, info.contact_surface()
        M, N = _body_of(scene, surface.id_M()), _body_of(scene, surface.id_N())
        force_on_M = np.array(info.F_Ac_W().translational())
        grasped, table = scene.object.index(), scene.table.index()

        # Of the patches without the object, only those of hand and table count.
        if grasped not in (M, N):
            if table in (M, N) and self._hand & {M, N}:
                self._hand_table_force += float(norm(force_on_M))
            return

        # The other body of a patch is the table, a fingertip, or another link.
        other = N if grasped == M else M
        force_on_object = force_on_M if grasped == M else -force_on_M
        if other == table:
            self._table_force += force_on_object
        elif other in self._neighbours:
            return
        elif other in self._tips:
            self._add_tip_patch(self._tips.index(other), surface, force_on_object, grasped == M)
        else:
            magnitude = float(norm(force_on_object))
            self._other_force[other] = self._other_force.get(other, 0.0) + magnitude

    def _add_tip_patch(
        self, i: int, surface: ContactSurface, force_W: Array, object_is_M: bool
    ) -> None:
        """Add a patch of fingertip i and the object, split into pad and rest of the link.

        Face e of a patch has the area A, the pressure p at its centroid c, and the object's outward
        normal n; its weight is w_e = A_e p_e. Over the faces of all patches that belong to the pad,

            point = Σ w_e c_e / Σ w_e,   normal = Σ w_e n_e / |Σ w_e n_e|.

        σ = (Σ_pad w_e) / (Σ w_e) is the pad's fraction of a patch with the force f on the object.
        If σ is at least 1 − `MAX_BESIDE`, the whole patch belongs to the pad. If not, the pad's
        force is

            f_pad = − Σ_pad w_e n_e + σ (f + Σ w_e n_e):

        the pressure of its own faces, plus its fraction of the forces of friction and damping.
        """
        areas, centres_W, normals_W, pressures, depths = _read_faces(surface, object_is_M)

        # Find the faces on the pad, and their fraction of the patch.
        tip = self._scene.fingertips[i]
        p_FiQ = transform_points(invert_pose(self._scene.pose(tip)), centres_W)
        on_pad = self._scene.hand.fingers[i].on_pad(p_FiQ)
        weight = areas * pressures
        moment_n = weight[:, None] * normals_W

        # A patch that reaches over the pad's border belongs to the fingertip as a whole. A patch
        # that lies mostly beside the pad is split, and its rest is a contact of another link. Drake
        # reports only the force of the whole patch. The normal part of the force belongs to the
        # faces, and friction and damping are divided like the pressure.
        share = weight[on_pad].sum() / weight.sum() if weight.any() else 0.0
        if share >= 1.0 - MAX_BESIDE:
            on_pad = np.ones_like(on_pad)
            pad_force_W = force_W
        else:
            rest = force_W + moment_n.sum(axis=0)
            pad_force_W = -moment_n[on_pad].sum(axis=0) + share * rest
            other = float(norm(force_W - pad_force_W))
            self._other_force[tip.index()] = self._other_force.get(tip.index(), 0.0) + other

        # Sums over the pad's faces.
        self._force_W[i] += pad_force_W
        self._area[i] += areas[on_pad].sum()
        self._weight[i] += weight[on_pad].sum()
        self._moment_p[i] += (weight[:, None] * centres_W)[on_pad].sum(axis=0)
        self._moment_n[i] += moment_n[on_pad].sum(axis=0)
        self._penetration[i] = max(self._penetration[i], *depths[on_pad], 0.0)

    def add_point_pair(self, bodies: set[BodyIndex]) -> None:
        """Add a point contact of two bodies."""
        scene = self._scene
        if scene.object.index() in bodies:
            self._point_contacts += 1
        if scene.table.index() in bodies and self._hand & bodies:
            self._hand_on_table = True

    def contacts(self) -> Contacts:
        """Return the contacts of all added patches and pairs."""
        # A fingertip touches if its patches press with enough force.
        limit = self._scene.physics.contact_force
        touching = (norm(self._force_W) > limit) & (self._weight > 0.0)

        # Pressure-weighted means; NaN if nothing touches or opposite normals cancel.
        weight = np.where(touching, self._weight, np.nan)[:, None]
        length = norm(self._moment_n)[:, None]
        normal_W = self._moment_n / np.where(touching[:, None] & (length > 0), length, np.nan)

        return Contacts(
            touching=touching,
            p_OQ=transform_points(self._X_OW, self._moment_p / weight),
            nhat_Q_O=rotate_vectors(self._X_OW, normal_W),
            f_Q_O=rotate_vectors(self._X_OW, np.where(touching[:, None], self._force_W, 0.0)),
            area=np.where(touching, self._area, 0.0),
            penetration=np.where(touching, self._penetration, 0.0),
            other_links=sum(force > limit for force in self._other_force.values()),
            hand_on_table=self._hand_on_table or self._hand_table_force > limit,
            object_on_table=bool(norm(self._table_force) > limit),
            table_force=self._table_force,
            point_contacts=self._point_contacts,
        )


def hand_bodies(scene: Scene) -> set[BodyIndex]:
    """Return the links of the scene's hand."""
    return set(scene.plant.GetBodyIndices(scene.instance))


def _read_faces(
    surface: ContactSurface, object_is_M: bool
) -> tuple[Array, Array, Array, Array, Array]:
    """Return the n faces of a patch on the object.

    The fingertip's pressure p is zero at its surface and grows with the depth below it. To first
    order, the depth of a face is therefore p / |∇p|.

    Returns:
        Areas (n,) [m^2]; centroids (n, 3) in {W} [m]; unit normals (n, 3) out of the object in {W};
        pressures (n,) at the centroids [Pa]; depths (n,) of the surface in the fingertip [m].
    """
    field, compliant_is_M = surface.poly_e_MN(), not object_is_M
    has_gradient = surface.HasGradE_M() if compliant_is_M else surface.HasGradE_N()
    gradient = surface.EvaluateGradE_M_W if compliant_is_M else surface.EvaluateGradE_N_W
    # Face normals point out of N into M.
    outward = -1.0 if object_is_M else 1.0

    indices = range(surface.num_faces())
    centres = np.array([surface.centroid(face) for face in indices]).reshape(-1, 3)
    pressures = np.array(
        [field.EvaluateCartesian(face, centre) for face, centre in enumerate(centres)]
    )
    slopes = np.array([norm(gradient(face)) if has_gradient else np.inf for face in indices])
    areas = np.array([surface.area(face) for face in indices])
    normals = np.array([surface.face_normal(face) for face in indices]).reshape(-1, 3)
    return areas, centres, outward * normals, pressures, pressures / slopes


def _body_of(scene: ObjectScene, geometry_id: object) -> BodyIndex:
    """Return the body of a shape; walls belong to the table, as their contacts mean the same."""
    inspector = scene.scene_graph.model_inspector()
    body = scene.plant.GetBodyFromFrameId(inspector.GetFrameId(geometry_id))
    is_wall = scene.walls is not None and body.index() == scene.walls.index()
    return scene.table.index() if is_wall else body.index()


#: Largest step of a joint between two postures whose height is computed [rad or m]. A point 0.3 m
#: from its joint is at most 0.02 mm lower in between.
STEP = 0.02


class ClearanceMonitor:
    """The observed states of a hand in one attempt; none if the clearance is not measured."""

    def __init__(self, rules: CloseConfig) -> None:
        self._measures = rules.scrape_depth is not None
        self._states: list[Array] = []
        self._scene: Scene | None = None

    def look(self, scene: Scene) -> None:
        """Add the present state of the scene; all scenes must have the same hand."""
        if self._measures:
            X_TG = multiply(invert_pose(X_WT), palm_pose(scene))
            self._states.append(np.concatenate([X_TG[2], hand_positions(scene)]))
            self._scene = scene

    def least(self) -> float:
        """Return the smallest height of the hand above the table's top [m]; negative below it.

        It is NaN if it is not measured.
        """
        if self._scene is None:
            return np.nan
        states = _between(np.array(self._states))
        names = hand_joint_names(self._scene)
        return least_height(self._scene.hand, names, states[:, 4:], states[:, :4])


def scrapes(clearance: float, rules: CloseConfig) -> bool:
    """Return whether a hand with this clearance [m] was deeper below the table's top than allowed.

    A hand whose clearance was not measured, NaN, was not.
    """
    return rules.scrape_depth is not None and clearance < -rules.scrape_depth


def least_height(hand: Hand, names: list[str], q: Array, up_G: Array) -> float:
    """Return the smallest height of a hand above the table's top in n postures [m].

    Args:
        hand: The hand.
        names: Names of its j joints.
        q: Positions of the joints, (n, j) [rad or m].
        up_G: Third rows (n, 4) of the palm's poses X_TG.
    """
    lowest, rims = np.inf, link_rims(hand.model)
    for link, X_GL in posed_links(hand, dict(zip(names, q.T, strict=True))).items():
        if not len(rims[link]):
            continue
        up_L, (p, axis) = multiply(up_G[:, None], X_GL), (rims[link][:, :3], rims[link][:, 3:6])
        heights = dot(up_L[..., :3], p) + up_L[..., 3]
        # The lowest point of a disc is below its centre by radius times sine of the tilt.
        round_ = rims[link][:, 6] > 0.0
        if round_.any():
            cosine = dot(up_L[..., :3], axis[round_])
            sine = np.sqrt(np.maximum(0.0, 1.0 - cosine**2))
            heights[:, round_] -= rims[link][round_, 6] * sine
        lowest = min(lowest, float(heights.min()))
    return lowest


def _between(states: Array) -> Array:
    """Return states (m, ...) that connect states (n, 4 + j) in steps of at most `STEP`."""
    parts = [states[:1]]
    for a, b in pairwise(states):
        count = int(np.ceil(np.abs(b - a)[4:].max() / STEP))
        if count:
            share = np.arange(1, count + 1)[:, None] / count
            parts.append(a + share * (b - a))
        else:
            parts.append(b[None])
    return np.concatenate(parts)
