"""The one door through which a vendor's model is read.

Input: a URDF, SDFormat or MJCF file. Output: a `VendorModel` in which bodies that are fixed to each
other are one link, every link has a mass and an inertia that a body can have, and each follower
names the joint that leads it. Nothing is downloaded.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from urllib.parse import unquote

import numpy as np
from pydrake.geometry import Convex
from pydrake.math import RotationMatrix
from pydrake.multibody.tree import CalcSpatialInertia, SpatialInertia, UnitInertia

from drakegrasp.errors import HandError
from drakegrasp.frames import Array, invert_pose, transform_points
from drakegrasp.hand.draft.drake_model import parse_model
from drakegrasp.hand.draft.vendor import Link, Shape, VendorJoint, VendorModel
from drakegrasp.hand.parsing import Mimic, validate_limits
from drakegrasp.runtime.environment import require_mujoco

#: Smallest fraction of a leader's range that the limits of a follower must leave to it.
ROOM = 0.5
#: Smallest and largest size of a hand, including an arm [m]; other sizes mean other units.
SIZES = (0.03, 3.0)
#: Mass [kg] and radius [m] of a moving link that has neither mass nor shape.
BARE_MASS, BARE_RADIUS = 1e-3, 0.016
#: Mean density of links whose model gives no mass [kg/m^3]; own choice, that of solid plastic.
DENSITY = 1200.0


def read_model(path: Path, packages: Mapping[str, Path] | None = None) -> VendorModel:
    """Return a vendor's model, with bodies that are fixed to each other as one link.

    Args:
        path: A URDF, SDFormat or MJCF file.
        packages: Folders of package:// URIs by name. Other packages are folders of their name above
            the model.

    Raises:
        HandError: If it is not a tree of rigid links with readable meshes. The message has one
            line, which states how to repair it.
        MachineError: If it is MJCF and MuJoCo is not installed.
    """
    suffix, packages = path.suffix.lower(), packages or {}
    if suffix == ".xacro":
        raise HandError(f"{path}: must be URDF, got xacro: run `xacro {path.name} > hand.urdf`")
    if suffix not in (".urdf", ".sdf", ".xml", ".mjcf"):
        raise HandError(f"{path}: must end in .urdf, .sdf or .xml (MJCF), got {path.suffix!r}")
    for name, folder in packages.items():
        if not folder.is_dir():
            raise HandError(f"package {name} must be a folder, got {str(folder)!r}")

    def find(uri: str, base: Path) -> Path:
        return _file_of(uri, base, path, packages)

    if suffix in (".urdf", ".sdf"):
        return _welded(parse_model(path, find))
    require_mujoco("mujoco")
    from drakegrasp.hand.draft.mujoco_model import compile_model

    return _welded(compile_model(path, find))


def _file_of(uri: str, base: Path, model: Path, packages: Mapping[str, Path]) -> Path:
    """Return the file of a mesh's URI or path; relative ones start at `base`.

    Raises:
        HandError: If it is an address, or in an unknown package.
    """
    scheme, separator, rest = uri.partition("://")
    if not separator or scheme == "file":
        return base / unquote(rest if separator else uri)
    if scheme not in ("package", "model"):
        raise HandError(f"model: mesh {uri!r} must be a file, got an address: nothing is fetched")

    name, _, rest = rest.partition("/")
    above = (folder for folder in model.resolve().parents if folder.name == name)
    folder = packages.get(name) or next(above, None)
    if folder is None:
        raise HandError(
            f"model: mesh {uri!r} must lie in a known package: say where it is with "
            f"--package {name}=FOLDER"
        )
    return folder / unquote(rest)


def _welded(model: VendorModel) -> VendorModel:
    """Return a model in which bodies that are fixed to each other are one link.

    Raises:
        HandError: If it is not one tree of links of a hand's size, or joints cannot follow their
            leaders. The message has one line.
    """
    carriers = _carriers(model)
    places, links, notes = _places(model, carriers), dict[str, Link](), list(model.notes)
    for head in dict.fromkeys(head for head, _ in places.values()):
        members = [(model.links[b], X_LB) for b, (at, X_LB) in places.items() if at == head]
        links[head], remarks = _weld(members)
        notes += remarks

    # The joints that move, each between two links.
    joints = {}
    for head, link in links.items():
        if head in carriers:
            joint = carriers[head]
            validate_limits(joint.name, *joint.limits)
            above, X_LP = places[joint.parent]
            joints[joint.name] = replace(
                joint,
                parent=links[above].name,
                child=link.name,
                X_PJ=X_LP @ joint.X_PJ,
                X_CJ=np.eye(4),
            )
    mimics = _leaders(model.mimics, joints)
    named = {link.name: link for link in links.values()}
    welded = replace(model, links=named, joints=joints, mimics=mimics, notes=tuple(notes))
    _validate_size(welded)
    return welded


def _carriers(model: VendorModel) -> dict[str, VendorJoint]:
    """Return the joint that carries each body except for the root."""
    found: dict[str, VendorJoint] = {}
    for joint in model.joints.values():
        if joint.child in found:
            raise HandError(
                f"model: link {joint.child!r} must be carried by one joint, got "
                f"{found[joint.child].name!r} and {joint.name!r}: cut the closed loop"
            )
        found[joint.child] = joint
    roots = [name for name in model.links if name not in found]
    if len(roots) != 1:
        got = f"{len(roots)} ({', '.join(roots)})" if roots else "none: its joints form a loop"
        raise HandError(f"model: must be one tree of links, with one root, got {got}")
    return found


def _places(
    model: VendorModel, carriers: Mapping[str, VendorJoint]
) -> dict[str, tuple[str, Array]]:
    """Return for each body the first body of its link, and its pose (4, 4) in the link.

    Bodies come after their parents.
    """
    # Go from the root outwards. The frame of a link is that of its joint.
    order = [model.root]
    places: dict[str, tuple[str, Array]] = {}
    for body in order:
        joint = carriers.get(body)
        if joint is None:
            places[body] = body, np.eye(4)
        elif joint.moves:
            places[body] = body, invert_pose(joint.X_CJ)
        else:
            head, X_LP = places[joint.parent]
            places[body] = head, X_LP @ joint.X_PJ @ invert_pose(joint.X_CJ)
        order += model.below(body)
    if len(order) < len(model.links):
        lost = next(name for name in model.links if name not in places)
        raise HandError(f"model: must be one tree of links, got a loop at link {lost!r}")

    # The frame of the root is that of its heaviest body.
    members = [body for body, (head, _) in places.items() if head == model.root]
    heaviest = max(members, key=lambda body: model.links[body].weight)
    X_LR = invert_pose(places[heaviest][1])
    return places | {body: (model.root, X_LR @ places[body][1]) for body in members}


def _weld(members: Sequence[tuple[Link, Array]]) -> tuple[Link, list[str]]:
    """Return the link of bodies with poses (4, 4) in its frame, and notes of what was added."""
    # Join the shapes; without collision shapes, the visual shapes also collide.
    name, notes = max((body for body, _ in members), key=lambda body: body.weight).name, []
    solids, pictures = (
        [replace(s, X_LS=X_LB @ s.X_LS) for body, X_LB in members for s in getattr(body, kind)]
        for kind in ("collisions", "pictures")
    )
    if pictures and not solids:
        notes.append(f"link {name}: the model has no collision shapes; hulls of its pictures")
    collisions = [shape.hull() for shape in solids or pictures]

    # Add the inertias about the link's origin.
    total = SpatialInertia.Zero()
    for body, X_LB in members:
        if body.inertia.get_mass() > 0.0:
            own = body.inertia.ReExpress(RotationMatrix(X_LB[:3, :3])).Shift(-X_LB[:3, 3])
            total = added(total, own)

    # Vendors leave out masses of small links, and give inertias that no body has.
    ball = SpatialInertia(BARE_MASS, np.zeros(3), UnitInertia.SolidSphere(BARE_RADIUS))
    if total.get_mass() == 0.0:
        total = solid_inertia(collisions) if collisions else ball
        if collisions:
            mass = f"{1e3 * total.get_mass():.0f} g by its size"
            notes.append(f"link {name}: the model gives no mass; {mass}")
    elif wrong := next((body.impossible for body, _ in members if body.impossible), ""):
        notes.append(
            f"link {name}: the model's inertia is impossible ({wrong}); that of its shapes is used"
        )
        likely = solid_inertia(collisions) if collisions else ball
        total = SpatialInertia(total.get_mass(), likely.get_com(), likely.get_unit_inertia())
    return Link(name=name, inertia=total, collisions=tuple(collisions)), notes


def _leaders(given: Mapping[str, Mimic], joints: Mapping[str, VendorJoint]) -> dict[str, Mimic]:
    """Return the leader of each following joint, through chains of mimics.

    Raises:
        HandError: If mimics form a circle, name something that is not a moving joint, or limits
            keep a joint from following.
    """
    found: dict[str, Mimic] = {}
    for name, mimic in given.items():
        must = f"model: joint {name!r} must"
        if name not in joints:
            raise HandError(f"{must} turn or slide, as it follows {mimic.leader!r}")

        # Follow the leaders up to a joint that follows none.
        ratio, offset, leader, seen = mimic.ratio, mimic.offset, mimic.leader, {name}
        while leader in given and leader not in seen:
            seen.add(leader)
            above = given[leader]
            ratio, offset, leader = ratio * above.ratio, offset + ratio * above.offset, above.leader
        if leader in seen:
            raise HandError(f"{must} follow a joint that leads, got a circle of mimics")
        if leader not in joints:
            raise HandError(f"{must} follow a joint that moves, got {leader!r}")
        if ratio == 0.0:
            raise HandError(f"{must} follow {leader!r} by a ratio, got 0")
        found[name] = Mimic(joint=name, leader=leader, ratio=ratio, offset=offset)

        # Limits of some vendors' followers have the wrong sign.
        lower, upper = joints[name].limits
        led = np.sort(ratio * joints[leader].limits + offset)
        shared = min(led[1], upper) - max(led[0], lower)
        if np.isfinite(led).all() and shared < ROOM * (led[1] - led[0]):
            raise HandError(
                f"{must} have limits that let it follow {leader!r}, {led[0]:g}..{led[1]:g}, got "
                f"{lower:g}..{upper:g}"
            )
    return found


def _validate_size(model: VendorModel) -> None:
    """Reject a model without shapes, or a model whose units are not metres."""
    points = [transform_points(model.pose(n, {}), own.corners()) for n, own in model.links.items()]
    cloud = np.concatenate(points)
    if not len(cloud):
        raise HandError("model: must have shapes, got links without any")
    size = float(np.ptp(cloud, axis=0).max())
    if not SIZES[0] <= size <= SIZES[1]:
        raise HandError(
            f"model: must be a hand in metres, got one of {size:.3g} m: check units and scales of "
            "its meshes"
        )


def solid_inertia(shapes: Sequence[Shape]) -> SpatialInertia:
    """Return M_LLo_L of convex shapes of a link, solids of `DENSITY`, which may overlap."""
    total = SpatialInertia.Zero()
    for shape in shapes:
        # Flat shapes have no volume, so half a millimetre is added on all sides.
        corners = shape.corners()
        solid = Convex(np.concatenate([corners - 5e-4, corners + 5e-4]).T, "hull")
        try:
            total = added(total, CalcSpatialInertia(solid, DENSITY))
        except (RuntimeError, ValueError):  # lengths whose powers overflow
            reach = float(np.abs(corners).max())
            raise HandError(
                f"model: must be a hand in metres, got a shape that reaches {reach:.3g} m from its "
                "link and has no inertia"
            ) from None
    return total


def added(one: SpatialInertia, other: SpatialInertia) -> SpatialInertia:
    """Return the inertia of two bodies about the same point, in the same axes."""
    if one.get_mass() == 0.0:
        return other
    total = one.Shift(np.zeros(3))
    total += other
    return total
