"""An arm: its URDF, where it stands, and how it carries a hand.

Input: the name of an arm or a URDF file, and the pose of its base. Output: an `Arm`, plain data
that any process can turn into a diagram of Drake (`cell.py`). Of the file, only links and joints
are used: no masses, motors, couplings and pictures. What is beyond the flange is left out, because
the hand takes its place, and joints beside the way to the flange stay at zero.

Meshes of any kind that trimesh reads become their convex hulls; Drake's queries take hulls, too.
Frames: T the table's top, F flange, B palm link of the hand.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
import numpy.typing as npt
import trimesh
from pydrake.math import RollPitchYaw

from drakegrasp.errors import ConfigError, first_line
from drakegrasp.foreign_files import read_text
from drakegrasp.frames import Array, make_pose, read_pose, rotation_about
from drakegrasp.hand.description import Hand
from drakegrasp.hand.file_format import MODELS
from drakegrasp.yaml_text import parse_yaml

#: The package that has the arms below, installed by the extra `arms`.
PACKAGE = "example-robot-data"
#: Arms by name: the file in this package, and the flange.
ARMS: Mapping[str, tuple[str, str]] = {
    "panda": ("panda_description/urdf/panda.urdf", "panda_link8"),
    "ur5": ("ur_description/urdf/ur5_robot.urdf", "tool0"),
    "ur10": ("ur_description/urdf/ur10_robot.urdf", "tool0"),
}
#: The slab of the table in {T} [m]: what is seen of `models/table.urdf`.
TABLE_SIZE = (1.6, 1.6, 0.1)
#: Kinds of joints of a URDF.
MOVING, FIXED = ("revolute", "continuous", "prismatic"), "fixed"


@dataclass(frozen=True, kw_only=True)
class Arm:
    """An arm on its base, as plain data.

    Attributes:
        name: Name of the arm, or of its file without suffix.
        urdf: Links and joints between base and flange, without meshes.
        hulls: The convex hulls of meshes: link, corners in the link's frame as bytes of (n, 3).
        digest: Hash of the file and of its meshes, hexadecimal.
        flange: Link that carries the hand.
        joints: Names of the a joints from base to flange.
        base: X, Y [m], Z [m] and yaw [rad] of the first link in {T}.
        mount: Pose X_FB (4, 4) of the hand's palm link on the flange, row by row; None for the
            usual one of a hand of the package.
    """

    name: str
    urdf: str
    hulls: tuple[tuple[str, bytes], ...]
    digest: str
    flange: str
    joints: tuple[str, ...]
    base: tuple[float, float, float, float]
    mount: tuple[float, ...] | None = None

    def described(self) -> dict[str, Any]:
        """Return what decides an answer, as JSON types."""
        about = ("name", "digest", "flange", "base", "mount")
        return {key: getattr(self, key) for key in about}

    @property
    def X_TA(self) -> Array:
        """Pose (4, 4) of the first link in {T}."""
        return make_pose(rotation_about([0.0, 0.0, 1.0], self.base[3]), self.base[:3])


def load_arm(
    source: str | Path,
    base: Sequence[float],
    *,
    flange: str | None = None,
    mount: npt.ArrayLike | None = None,
) -> Arm:
    """Return an arm.

    Args:
        source: One of ARMS, or the path of a URDF file.
        base: X, Y [m], Z [m] and yaw [rad] of the arm's first link in the table's frame {T}.
        flange: Link that carries the hand; None for that of ARMS, or for the one last link.
        mount: Pose X_FB (4, 4) of the hand's palm link on the flange; None for the usual one, which
            only hands of the package have.

    Raises:
        ConfigError: If the arm or its flange is unknown, a mesh is missing, a joint cannot be used,
            or the base is inside the table.
        GraspError: If the mount is not a pose.
    """
    path, usual = _find(source)
    place = _validate_base(base)
    try:
        content = read_text(path)
        root = ElementTree.fromstring(content)
    except (OSError, UnicodeDecodeError, ElementTree.ParseError) as error:
        raise ConfigError(f"{path}: must be the URDF of an arm, got {first_line(error)}") from None
    if root.tag != "robot":
        raise ConfigError(f"{path}: must be the URDF of an arm, got XML of <{root.tag}>")

    # A link of this name would be Drake's own world, and no part of the arm.
    for each in root.iter():
        for key in ("name", "link"):
            if each.get(key) == "world":
                each.set(key, "arm_world")

    # The chain to the flange, with nothing beyond.
    joints = {_link(joint, "child"): joint for joint in root.findall("joint")}
    links = {link.get("name", ""): link for link in root.findall("link")}
    flange = flange or usual or _last_link(path, links, joints)
    if flange not in links:
        raise ConfigError(f"flange must be a link of {path.name}, got {flange!r}")
    chain = list(_chain(flange, joints))[::-1]
    moving = [joint for joint in chain if joint.get("type") in MOVING]
    for joint in chain:
        _validate_joint(path, joint)
    if not moving:
        raise ConfigError(f"{path}: a joint must move the flange {flange!r}, got none")

    # Shapes of the links that are left.
    kept = [name for name in links if flange not in _above(name, joints)]
    hulls = [(name, hull) for name in kept for hull in _take_meshes(path, links[name])]
    return Arm(
        name=path.stem if source not in ARMS else str(source),
        urdf=_plain_urdf({name: links[name] for name in kept}, joints, chain),
        hulls=tuple((name, hull.tobytes()) for name, hull in hulls),
        digest=_digest(content, hulls),
        flange=flange,
        joints=tuple(joint.get("name", "") for joint in moving),
        base=place,
        mount=None if mount is None else tuple(read_pose(mount, "mount").ravel().tolist()),
    )


def _find(source: str | Path) -> tuple[Path, str | None]:
    """Return the file of an arm, and the flange of a known one."""
    if source in ARMS:
        place, flange = ARMS[str(source)]
        return _shared_folder() / "robots" / place, flange
    path = Path(source)
    if path.suffix.lower() != ".urdf" or not path.is_file():
        known = ", ".join(ARMS)
        raise ConfigError(f"arm must be {known} or a .urdf file, got {str(source)!r}")
    return path, None


@cache
def _shared_folder() -> Path:
    """Return the folder of the package with the known arms, which has no module to import."""
    try:
        files = metadata.files(PACKAGE) or []
    except metadata.PackageNotFoundError:
        raise ConfigError(
            f"arms by name must come from {PACKAGE}, got none: pip install 'drakegrasp[arms]'"
        ) from None
    found = next(file for file in files if file.match("robots/panda_description/LICENSE"))
    return Path(str(found.locate())).resolve().parents[2]


def _validate_base(base: Sequence[float]) -> tuple[float, float, float, float]:
    place = tuple(float(value) for value in base)
    if len(place) != 4 or not np.isfinite(place).all():
        raise ConfigError(f"base must be four numbers X, Y, Z, YAW, got {list(base)}")
    x, y, z, yaw = place
    half = TABLE_SIZE[0] / 2.0, TABLE_SIZE[1] / 2.0
    if abs(x) < half[0] and abs(y) < half[1] and -TABLE_SIZE[2] < z < 0.0:
        raise ConfigError(
            f"base must be on the table, z >= 0, or beside it, |x| or |y| >= {half[0]:g} m, "
            f"got x={x:g}, y={y:g}, z={z:g} inside of it"
        )
    return x, y, z, yaw


def _validate_joint(path: Path, joint: Element) -> None:
    """Reject a joint that cannot be driven, or whose limits leave no motion."""
    name, kind = joint.get("name", ""), joint.get("type", "")
    if kind not in (*MOVING, FIXED):
        allowed = ", ".join((*MOVING, FIXED))
        raise ConfigError(f"{path}: joint {name!r} must be {allowed}, got {kind!r}")
    if kind not in ("revolute", "prismatic"):
        return
    limit = joint.find("limit")
    try:
        lower, upper = (float(limit.get(key, "nan")) for key in ("lower", "upper"))  # type: ignore[union-attr]
    except (AttributeError, ValueError):
        lower = upper = np.nan
    if not lower < upper:
        raise ConfigError(
            f"{path}: joint {name!r} must have a lower limit below its upper one, got "
            f"{lower:g}..{upper:g}"
        )


# The tree of links


def _link(joint: Element, end: str) -> str:
    found = joint.find(end)
    return "" if found is None else found.get("link", "")


def _chain(link: str, joints: Mapping[str, Element]) -> Iterator[Element]:
    """Yield the joints from a link up to the first link."""
    seen = set[str]()
    while link in joints and link not in seen:
        seen.add(link)
        yield joints[link]
        link = _link(joints[link], "parent")


def _above(link: str, joints: Mapping[str, Element]) -> set[str]:
    """Return the links between the first one and a link, without it."""
    return {_link(joint, "parent") for joint in _chain(link, joints)}


def _last_link(path: Path, links: Mapping[str, Element], joints: Mapping[str, Element]) -> str:
    parents = {_link(joint, "parent") for joint in joints.values()}
    ends = [name for name in links if name not in parents]
    if len(ends) != 1:
        names = ", ".join(ends[:8])
        raise ConfigError(f"{path}: flange must be named, as the model ends at {names}")
    return ends[0]


def _plain_urdf(
    links: Mapping[str, Element], joints: Mapping[str, Element], chain: Sequence[Element]
) -> str:
    """Return a URDF with links and joints, and nothing else, in which only a chain moves."""
    root = Element("robot", name="arm")
    for name, link in links.items():
        plain = ElementTree.SubElement(root, "link", name=name)
        plain.extend(link.findall("collision"))
        if name not in joints:
            continue
        joint = joints[name]
        moves = joint in chain and joint.get("type") in MOVING
        kind = joint.get("type", "") if moves else FIXED
        own = ElementTree.SubElement(root, "joint", name=joint.get("name", ""), type=kind)
        parts = ("origin", "parent", "child", *(("axis", "limit") if moves else ()))
        own.extend(part for key in parts for part in joint.findall(key))
    for each in root.iter():
        each.text = each.tail = None  # a file of a dataset has it on one line
    return ElementTree.tostring(root, encoding="unicode")


# Meshes


def _take_meshes(path: Path, link: Element) -> list[Array]:
    """Remove the collision meshes from a link; return the corners (n, 3) of their hulls [m]."""
    found = []
    for collision in link.findall("collision"):
        mesh = collision.find("geometry/mesh")
        if mesh is None:
            continue
        link.remove(collision)
        file = _mesh_file(path, mesh.get("filename", ""))
        try:
            corners = trimesh.load(file, force="mesh").convex_hull.vertices
        except Exception as error:  # trimesh raises errors of every kind
            raise ConfigError(f"{file}: must be a mesh, got {first_line(error)}") from None
        scale = [float(value) for value in mesh.get("scale", "1 1 1").split()]
        X_LS = _origin(collision)
        found.append(np.asarray(corners * scale) @ X_LS[:3, :3].T + X_LS[:3, 3])
    return found


def _origin(collision: Element) -> Array:
    origin = collision.find("origin")
    given: Mapping[str, str] = {} if origin is None else origin.attrib
    rpy, xyz = ([float(v) for v in given.get(key, "0 0 0").split()] for key in ("rpy", "xyz"))
    return mount_pose(xyz, np.rad2deg(rpy).tolist())


def _mesh_file(path: Path, name: str) -> Path:
    """Return the file of a mesh; a package is looked for in the folders around the URDF."""
    scheme, _, rest = name.rpartition("://")
    places = [path.parent / rest]
    if scheme == "package":
        package, _, inner = rest.partition("/")
        folders = path.resolve().parents
        places = [f / inner if f.name == package else f / package / inner for f in folders]
    elif scheme not in ("", "file"):
        places = []
    file = next((place for place in places if place.is_file()), None)
    if file is None:
        raise ConfigError(f"{path}: its meshes must be there, got none at {name!r}")
    return file


def _digest(content: str, hulls: Sequence[tuple[str, Array]]) -> str:
    digest = hashlib.sha256(content.encode())
    for name, corners in hulls:
        digest.update(name.encode())
        digest.update(corners.tobytes())
    return digest.hexdigest()


# Mounts


def mount_of(arm: Arm, hand: Hand) -> Array:
    """Return the pose X_FB (4, 4) of the palm link of a hand on an arm's flange.

    Raises:
        ConfigError: If the arm states none, and the hand has no usual one.
    """
    if arm.mount is not None:
        return np.array(arm.mount).reshape(4, 4)
    mounts: dict[str, dict[str, Any]] = parse_yaml(read_text(MODELS / "mounts.yaml"))
    if hand.name not in mounts:
        known = ", ".join(mounts)
        raise ConfigError(f"mount must be given for a hand other than {known}, got {hand.name!r}")
    zero = [0.0, 0.0, 0.0]
    stated = mounts[hand.name]
    return mount_pose(stated.get("p_FB", zero), stated.get("rpy_deg", zero))


def mount_pose(p_FB: Sequence[float], rpy_deg: Sequence[float]) -> Array:
    """Return X_FB (4, 4) from a position (3,) [m] and roll, pitch and yaw (3,) [degrees]."""
    return make_pose(RollPitchYaw(np.deg2rad(rpy_deg)).ToRotationMatrix().matrix(), p_FB)
