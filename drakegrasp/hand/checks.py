"""Checks of a hand's files and geometry; nothing is simulated.

Input: a loaded hand. Output: a `Finding` per check: masses, limits, couplings and efforts of its
files; palm, finger order, pads, and links that collide when the hand closes.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np
import trimesh
from pydrake.geometry import QueryObject
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder
from scipy.linalg import block_diag

from drakegrasp.config import Config
from drakegrasp.errors import HandError
from drakegrasp.frames import GRAVITY, Array, transform_points
from drakegrasp.hand.description import FINGER_DAMPING, Hand, load_hand
from drakegrasp.hand.file_format import Finger
from drakegrasp.hand.finger_sweep import (
    Opposition,
    closing_path,
    find_opposition,
    find_pinch,
    pad_fronts,
    pad_points_at,
    reach,
)
from drakegrasp.hand.kinematics import (
    closed_positions,
    coordinate_limits,
    fingertip_forces,
    fingertip_poses,
    joint_positions,
    link_poses,
    still_links,
)
from drakegrasp.hand.parsing import (
    Mimic,
    ModelFile,
    add_model,
    declared_masses,
    declared_mimics,
    impossible_inertias,
    joint_slides,
    moving_joint,
    read_xml,
)
from drakegrasp.hand.shapes import hull_triangles, link_shapes, pad_surfaces, ray_span

#: Smallest range of a closing joint, in its unit; a smaller range does not close a hand.
LEAST_RANGE = np.deg2rad(5.0)
#: Largest difference of a coupling from the model's own.
SAME = 1e-3
#: The origin of {G} may be this deep in the hand [m]; in the Barrett Hand it is 1.35 mm deep.
PALM_DEPTH = 0.005
#: Length of the palm ray that must be free [m].
RAY = 0.3
#: Pads that come this close to each other meet [m].
MEETING = 0.008
#: Largest reach of the hand beyond its pinch along +Gz [m]; with more, the palm cannot face a
#: table.
BEYOND_PINCH = 0.1
#: Number of postures from the open to the closed hand.
POSTURES = 40
#: Links of different fingers may overlap by this before their fingertips meet [m].
OVERLAP = 0.002
#: Width of an object that every hand must be able to hold [m].
WIDTH = 0.02
#: Largest distance of a pad point from the surface of its fingertip [m].
ON_SURFACE = 0.003
#: Places are the same within this [m].
SAME_PLACE = 1e-7


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One check of a hand.

    Attributes:
        name: What was checked.
        ok: Whether the check passed.
        text: What was found; for a fault, its place and the requirement.
    """

    name: str
    ok: bool
    text: str


def judge(name: str, faults: Sequence[str], fine: str) -> Finding:
    """Return the finding of a check: its faults, or the text `fine` if there are none."""
    return Finding(name=name, ok=not faults, text="; ".join(faults) or fine)


def check_files(name_or_yaml: str | Path, config: Config) -> Iterator[Finding]:
    """Yield the findings of the checks without a simulation, see `check_hand`."""
    # The files: without them there is no hand.
    try:
        hand = load_hand(name_or_yaml)
        count = sum(map(len, link_shapes(hand.model).values()))
    except HandError as error:
        own = f"{Path(name_or_yaml).absolute()}: "
        yield judge("files", [str(error).removeprefix(own)], "")
        return
    joints, model = len(hand.joint_names), hand.model.path.name
    fine = f"{hand.num_fingers} fingers, {joints} joints, {count} shapes in {model}"
    yield judge("files", [], fine)

    # Masses, limits and couplings. The other checks close the hand, for which they need its limits.
    yield check_masses(hand)
    limits = check_limits(hand)
    yield limits
    yield check_couplings(hand)
    if limits.ok:
        yield check_efforts(hand, config)
        yield from check_geometry(hand)


def check_masses(hand: Hand) -> Finding:
    """Return whether every link has a mass and a physically possible inertia."""
    # Drake replaces what is missing or impossible by its own values, so the text is read.
    root = read_xml(hand.model.path)
    masses = declared_masses(root)
    faults = [
        f"link {name!r} must have a mass above 0 kg, got {mass:g}"
        for name, mass in masses.items()
        if not mass > 0.0
    ]
    faults += [
        f"link {name!r} must have an inertia that a body can have, got {got}"
        for name, got in impossible_inertias(root).items()
    ]
    return judge("masses", faults, f"{len(masses)} links, {sum(masses.values()):.3g} kg in all")


def check_limits(hand: Hand) -> Finding:
    """Return whether each closing joint has limits between which it can close, from zero."""
    # Check the closing joints' own limits, then the range that their coupled joints leave.
    faults, ranges = [], []
    of_joint = dict(zip(hand.joint_names, hand.joint_limits, strict=True))
    for finger, (lower, upper), unit in zip(
        hand.fingers, coordinate_limits(hand)[1:], hand.closing_unit.tolist(), strict=True
    ):
        own, joint = of_joint[finger.closing_joint], f"joint {finger.closing_joint!r}"
        left, got = f"{lower:.3g}..{upper:.3g}", f"got {own[0]:.3g}..{own[1]:.3g}"
        if not np.isfinite(own).all():
            faults.append(f"{joint} must have limits, {got}")
        elif not (own[0] <= 0.0 and own[1] >= LEAST_RANGE * unit):
            faults.append(f"{joint} must reach from 0, the open hand, to a positive limit, {got}")
        elif lower > SAME * unit or upper < LEAST_RANGE * unit:
            rules = ", ".join(f"{c.joint} by {c.ratio:g} and {c.offset:g}" for c in finger.coupled)
            faults.append(
                f"finger {finger.name!r} must be open at 0 and able to close, but limits of its "
                f"coupled joints ({rules}) leave {left}: check signs of ratios, and offsets"
            )
        shown = f"{1e3 * upper:.0f} mm" if finger.slides else f"{np.rad2deg(upper):.0f}°"
        ranges.append(f"{finger.name} {shown}")

    # Check the spreads.
    least, most = np.rad2deg(coordinate_limits(hand)[0])
    for spread in hand.spreads_deg:
        if not least - 1e-6 <= spread <= most + 1e-6:
            faults.append(f"spreads_deg must be {least:g}..{most:g}, got {spread:g}")
    return judge("limits", faults, f"closing up to {', '.join(ranges)}")


def check_couplings(hand: Hand) -> Finding:
    """Return whether the couplings agree with those of the model, if the model has any."""
    faults = [
        f"joint {mimic.joint!r} must be coupled to {mimic.leader!r} by {mimic.ratio:g} and "
        f"{mimic.offset:g}, as in the model: by `coupled`, or `driven_by` between two fingers"
        for mimic in declared_mimics(read_xml(hand.model.path))
        if not _moves_as(hand, mimic)
    ]
    own = [f"{c.joint} {c.ratio:+g}" for finger in hand.fingers for c in finger.coupled]
    return judge("couplings", faults, ", ".join(own) or "none")


def _moves_as(hand: Hand, mimic: Mimic) -> bool:
    """Return whether two joints of a hand move according to a coupling of its model."""
    if not {mimic.joint, mimic.leader} <= set(hand.joint_names):
        return False

    # Positions are linear in the coordinates: those of the spread, of a motor, or none.
    j, i = (hand.joint_names.index(name) for name in (mimic.joint, mimic.leader))
    gains = hand.joint_gain @ block_diag(1.0, hand.closing_ratio)
    gain = gains[j] - mimic.ratio * gains[i]
    offset = hand.joint_offset[j] - mimic.ratio * hand.joint_offset[i] - mimic.offset
    return bool(np.abs(gain).max() <= SAME and abs(offset) <= SAME)


def check_efforts(hand: Hand, config: Config) -> Finding:
    """Return whether motors reach their efforts and close the hand in time, and what it presses."""
    # A motor is a gain on the speed error: a stalled motor gives gain * speed, up to its limit.
    faults = []
    limits, units = coordinate_limits(hand)[1:, 1], hand.closing_unit
    for finger, speed, limit, unit in zip(
        hand.fingers, hand.closing_speed, limits, units, strict=True
    ):
        stalled = FINGER_DAMPING * speed / unit**2
        if finger.driven_by is None and stalled < finger.effort_limit:
            faults.append(
                f"finger {finger.name!r} must close fast enough for its motor: at its speed a "
                f"stalled one gives {stalled:.3g} of {finger.effort_limit:g} {finger.effort_unit}"
            )
        if np.isfinite(limit) and limit / speed > config.close.max_time:
            faults.append(
                f"finger {finger.name!r} must close within close.max_time, "
                f"{config.close.max_time:g} s, got {limit / speed:.2g} s"
            )

    # Compute the fingertip forces, and whether friction then supports the payload.
    forces = fingertip_forces(hand, "torque")
    carried = config.physics.friction_hand * float(forces.sum()) / GRAVITY
    if hand.payload is not None and carried < hand.payload:
        # Round down to grams, because the reported payload must pass the check.
        most = np.floor(1e3 * carried) / 1e3
        faults.append(
            f"payload must be at most {most:g} kg, which friction carries, got {hand.payload:g} kg"
        )
    listed = ", ".join(f"{f:.3g}" for f in forces)
    carries = f"friction carries {carried:.2g} kg"
    return judge("efforts", faults, f"{config.lift.drive or hand.drive}; {listed} N; {carries}")


def check_geometry(hand: Hand) -> Iterator[Finding]:
    """Yield findings on a hand's geometry; nothing is simulated."""
    # The palm comes first: seen from behind, the order of the fingers is reversed.
    palm = check_palm(hand)
    yield palm
    if not palm.ok:
        return
    yield check_order(hand)
    pads = check_pads(hand)
    yield pads
    if pads.ok:
        yield check_meeting(hand)
    yield check_overlaps(hand)


def check_palm(hand: Hand) -> Finding:
    """Return whether +Gz leaves the hand at the palm, towards where the fingertips close."""
    # Compute how far the ray from the origin of {G} along +Gz is inside the open hand.
    opened, shapes, faults = np.zeros(hand.num_fingers), link_shapes(hand.model), []
    depths = [(0.0, "")]
    for link in hand.link_chains:
        X_GL = link_poses(hand, link, spread=0.0, closing=opened)
        depths += [(ray_end(transform_points(X_GL, corners)), link) for corners in shapes[link]]
    worst, blocked = max(depths, key=lambda pair: pair[0])
    if not any(len(shapes[link]) for link in still_links(hand)):
        faults.append(
            f"link {hand.palm_link!r}, or one that is fixed to it, must have a collision shape, "
            "got none"
        )
    if worst > PALM_DEPTH:
        faults.append(
            f"the palm ray along +Gz must be free, got link {blocked!r} up to "
            f"{1e3 * worst:.0f} mm from the origin of {{G}}: check palm.p_BG and palm.rpy_deg"
        )

    # Check that the fingertips close in front of the palm.
    height = float(pad_points_at(hand, 0.5 * closed_positions(hand))[:, 2].mean())
    if height <= 0.0:
        faults.append(
            f"+Gz must point to where the fingertips close, got them {-1e3 * height:.0f} mm behind "
            "the palm: check palm.rpy_deg"
        )
    text = f"the ray along +Gz is free; half-closed fingertips {1e3 * height:.0f} mm ahead"
    pinch = None if faults else find_pinch(hand, WIDTH)
    if pinch is not None:
        # Links beyond the pinch would meet the table before the fingertips meet the object.
        beyond = reach(hand, np.array([0.0, 0.0, 1.0])) - float(pinch.p_GM[2])
        text += f"; the hand reaches {1e3 * beyond:.0f} mm beyond the pinch"
        if beyond > BEYOND_PINCH:
            faults.append(
                "the palm must be able to face a table, but the hand reaches "
                f"{1e3 * beyond:.0f} mm beyond the pinch along +Gz: turn "
                "palm.rpy_deg, or keep fingers that do not grasp away with preshape"
            )
    return judge("palm", faults, text)


def ray_end(corners: Array) -> float:
    """Return the distance [m] at which the ray along +Gz leaves a convex hull; 0 if it misses.

    Args:
        corners: (n, 3), points in {G} that span the convex hull [m].
    """
    span = ray_span(corners, np.zeros(3), np.array([0.0, 0.0, 1.0]))
    return 0.0 if span is None or span[0] > RAY else max(span[1], 0.0)


def check_order(hand: Hand) -> Finding:
    """Return whether the fingers are in their order around +Gz.

    Seen from the object, which faces the palm, the order must be counter-clockwise. For two
    fingers, every order is correct.
    """
    # Angles of the pad points about Gz, measured from the first finger, must increase.
    points = pad_points_at(hand, np.zeros(hand.num_fingers))[:, :2]
    centred = points - points.mean(axis=0)
    angles = np.arctan2(centred[:, 1], centred[:, 0])
    order = np.argsort(np.mod(angles - angles[0], 2.0 * np.pi), kind="stable")
    right = ", ".join(hand.fingers[i].name for i in order)
    got = ", ".join(finger.name for finger in hand.fingers)
    fault = f"fingers must run counter-clockwise about +Gz ({right}), got {got}"
    return judge("finger order", [fault] if right != got else [], got)


def check_pads(hand: Hand) -> Finding:
    """Return whether each pad is on its fingertip's surface and faces where the finger closes."""
    # Motion of the pad points as the fingers close.
    half, step = 0.5 * closed_positions(hand), 1e-4 * hand.closing_unit
    motions = pad_points_at(hand, half + step) - pad_points_at(hand, half)
    X_GF, shapes = fingertip_poses(hand, spread=0.0, closing=half), link_shapes(hand.model)
    pads, faults, areas = pad_surfaces(hand.model, hand.fingers), [], []
    for i, (finger, pad) in enumerate(zip(hand.fingers, pads, strict=True)):
        parts = shapes[finger.fingertip]
        if not parts:
            faults.append(f"link {finger.fingertip!r} must have a collision shape, got none")
            continue
        distance = _distances(np.concatenate([*map(hull_triangles, parts)]), finger.p_FiP).min()
        if distance > ON_SURFACE:
            faults.append(
                f"fingers.{i}.pad_point must lie on the surface of link {finger.fingertip!r}, "
                f"got one {1e3 * distance:.1f} mm away"
            )

        # The pad must face the direction of its motion.
        normal = X_GF[i, :3, :3] @ _mean_normal(finger, pad, np.concatenate(parts).mean(axis=0))
        if normal @ motions[i] <= 0.0:
            faults.append(
                f"the pad of finger {finger.name!r} must face where the finger closes, got its "
                "back: check the pad_region, and the axis of the closing joint, which must close "
                "from 0 in the open hand"
            )
        areas.append(1e6 * float(trimesh.triangles.area(pad).sum()))
    return judge("pads", faults, f"{', '.join(f'{area:.0f}' for area in areas)} mm²")


def _distances(triangles: Array, point: Array) -> Array:
    """Return the distances (n,) of triangles (n, 3, 3) from a point (3,) [m]."""
    near = trimesh.triangles.closest_point(triangles, np.tile(point, (len(triangles), 1)))
    return np.asarray(np.linalg.norm(near - point, axis=1))


def _mean_normal(finger: Finger, pad: Array, centre: Array) -> Array:
    """Return the mean normal (3,) of a pad's triangles (n, 3, 3), out of its fingertip.

    Without a region the pad is the whole closed surface, whose mean normal is zero. Then only the
    triangles at the pad point count.
    """
    if not finger.pad_region:
        distances = _distances(pad, finger.p_FiP)
        pad = pad[distances <= distances.min() + SAME_PLACE]
    normals = np.cross(pad[:, 1] - pad[:, 0], pad[:, 2] - pad[:, 0])
    inward = np.einsum("ij,ij->i", normals, pad.mean(axis=1) - centre) < 0.0
    normals[inward] *= -1.0
    return np.asarray(normals.sum(axis=0))


def check_meeting(hand: Hand) -> Finding:
    """Return whether the pads of opposed fingers meet when the hand closes."""
    opposition = _, group = find_opposition(hand)
    first, second = (
        [f.name for f, is_first in zip(hand.fingers, group, strict=True)
         if is_first == own] for own in (True, False)
    )  # fmt: skip
    if not first or not second:
        fault = "fingers must close against each other, got all of them in one direction: check "
        return judge("fingertips", [fault + "the axes of the closing joints"], "")

    # Each pad must reach those opposite, and an object must fit between them.
    text = f"{' and '.join(first)} against {' and '.join(second)}"
    short = _shortfall(hand, opposition)
    missing = {f.name: 1e3 * s for f, s in zip(hand.fingers, short, strict=True) if s > MEETING}
    if not missing and find_pinch(hand, WIDTH) is not None:
        return judge("fingertips", [], f"{text} meet")
    got = ", ".join(f"that of {name} {gap:.0f} mm short" for name, gap in missing.items())
    fault = f"pads of {text} must meet when they close, got {got or 'no posture that pinches'}"
    if any(finger.coupled for finger in hand.fingers if finger.name in missing):
        fault += "; check the signs of the ratios of coupled joints"
    return judge("fingertips", [fault], "")


def _shortfall(hand: Hand, opposition: Opposition) -> Array:
    """Return the gap (k,) between each pad and the pads opposite, along their line [m]."""
    (axis, group), (_, front) = opposition, pad_fronts(hand, opposition)
    reached = (front @ axis * np.where(group, 1.0, -1.0)).max(axis=0)
    opposite = [-reached[group != own].max() for own in group]
    return np.asarray(opposite - reached)


def check_overlaps(hand: Hand) -> Finding:
    """Return whether only fingertips of different fingers meet until the hand is closed.

    In the simulation, other links pass through each other, so they must not touch.
    """
    # The finger whose closing moves each link. A link above the palm is not in the palm's tree.
    moves = {link: chain.gain[:, 1:].any(axis=0) for link, chain in hand.link_chains.items()}
    movers = {link: int(by.argmax()) for link, by in moves.items() if by.any()}
    postures = (joint_positions(hand, 0.0, closing) for closing in closing_path(hand, POSTURES))
    query = overlap_query(hand.model, hand.palm_link)
    texts = [
        f"links {one!r} and {other!r} must not meet before fingertips do, got {1e3 * depth:.1f} mm "
        "of overlap"
        for (one, other), depth in early_overlaps(
            query, postures, movers, hand.fingertip_links
        ).items()
        if depth > OVERLAP
    ]
    return judge("self-collision", texts, "fingertips meet before any other links")


#: Names of two links, and how deep one is in the other [m].
Overlap: TypeAlias = tuple[tuple[str, str], float]
#: Returns which links overlap at positions of all joints.
OverlapQuery: TypeAlias = Callable[[Mapping[str, float]], list[Overlap]]


def early_overlaps(
    overlaps: OverlapQuery,
    postures: Iterable[Mapping[str, float]],
    movers: Mapping[str, int],
    tips: Collection[str],
) -> dict[tuple[str, str], float]:
    """Return the links of two fingers that overlap before two fingertips do, and how deep [m].

    Args:
        overlaps: See `overlap_query`.
        postures: Positions of all joints, from the open hand to the closed one.
        movers: The finger that moves each link; other links may overlap.
        tips: The fingertip links.
    """
    found: dict[tuple[str, str], float] = {}
    for posture in postures:
        met = [
            (links, depth)
            for links, depth in overlaps(posture)
            if len({movers.get(link) for link in links} - {None}) == 2
        ]
        if any(set(links) <= set(tips) for links, _ in met):
            break
        for links, depth in met:
            found[links] = max(found.get(links, 0.0), depth)
    return found


def overlap_query(model: ModelFile, palm_link: str) -> OverlapQuery:
    """Return a function of the positions of a hand's joints that returns which links overlap.

    Args:
        model: The hand's model.
        palm_link: The link that keeps its place.

    Raises:
        HandError: If the model cannot be read.
    """
    builder = DiagramBuilder()
    plant, graph = AddMultibodyPlantSceneGraph(builder, 0.0)
    instance = add_model(plant, model)
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName(palm_link, instance))
    plant.Finalize()
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    state, scene = plant.GetMyContextFromRoot(context), graph.GetMyContextFromRoot(context)
    found = [plant.get_joint(index) for index in plant.GetJointIndices(instance)]
    joints = [joint for joint in found if moving_joint(joint)]

    def overlaps(positions: Mapping[str, float]) -> list[Overlap]:
        for joint in joints:
            place = joint.set_translation if joint_slides(joint) else joint.set_angle
            place(state, positions[joint.name()])
        query: QueryObject = graph.get_query_output_port().Eval(scene)
        pairs = []
        for pair in query.ComputePointPairPenetration():
            frames = (query.inspector().GetFrameId(shape) for shape in (pair.id_A, pair.id_B))
            one, other = (plant.GetBodyFromFrameId(frame).name() for frame in frames)
            pairs.append(((one, other), pair.depth))
        return pairs

    return overlaps
