"""What a model file says of masses, of efforts, and of joints that follow others.

In: the XML of a URDF, SDFormat or MJCF file. Out: its own figures. Drake does not tell them: it
replaces a mass of zero by one of its own, and couples joints by constraints or not at all.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from drakegrasp.errors import HandError


@dataclass(frozen=True, kw_only=True)
class Mimic:
    """A joint that follows another one: its position is ratio * leader + offset [rad or m]."""

    joint: str
    leader: str
    ratio: float
    offset: float


def read_xml(path: Path) -> Element:
    """Return the root of a model file."""
    return ElementTree.parse(path).getroot()


def declared_masses(root: Element) -> dict[str, float]:
    """Return the mass [kg] of each link of a model in URDF or SDFormat; 0 where it gives none."""
    masses = {}
    for link in root.iter("link"):
        name = link.get("name")
        if name is None:
            continue  # URDF's <child link="..."/> has other tags, so this is no link
        found = link.find("inertial/mass")
        text = None if found is None else found.get("value", found.text)
        masses[name] = _number(text or "0", f"mass of link {name!r}")
    return masses


def declared_efforts(root: Element) -> dict[str, float]:
    """Return the largest effort [N m or N] of each joint that the <limit>s of a model give one."""
    efforts = {}
    for joint in root.iter("joint"):
        for limit in joint.iter("limit"):
            name, text = joint.get("name", ""), _value(limit, "effort", "0")
            efforts[name] = abs(_number(text, f"effort of joint {name!r}"))
    return {name: effort for name, effort in efforts.items() if effort > 0.0}


def declared_mimics(root: Element) -> list[Mimic]:
    """Return the joints of a model that follow others."""
    # URDF, SDFormat, Drake and MJCF each have their own way to write it.
    found = []
    for joint in root.iter("joint"):
        for tag in joint.iter():
            if tag.tag.rpartition("}")[2].rpartition(":")[2] != "mimic":
                continue
            # Attributes in URDF and Drake, elements with a reference in SDFormat.
            ratio = _number(_value(tag, "multiplier", "1"), "multiplier of a mimic")
            reference = _number(_value(tag, "reference", "0"), "reference of a mimic")
            offset = _number(_value(tag, "offset", "0"), "offset of a mimic") - ratio * reference
            leader = tag.get("joint", "")
            name = joint.get("name", "")
            found.append(Mimic(joint=name, leader=leader, ratio=ratio, offset=offset))
    for equality in root.iter("equality"):
        found += [_equal_joints(joint) for joint in equality.iter("joint") if joint.get("joint2")]
    return found


def _equal_joints(joint: Element) -> Mimic:
    """Return an equality of MJCF: joint1 is a polynomial of joint2, of which a line is read."""
    name, leader = joint.get("joint1", ""), joint.get("joint2", "")
    what = f"polycoef of joint {name!r}"
    offset, ratio, *rest = [
        _number(x, what) for x in joint.get("polycoef", "0 1 0 0 0").split()
    ] + [0.0, 0.0]
    if any(rest):
        raise HandError(f"model: {what} must be a line, got a curve")
    return Mimic(joint=name, leader=leader, ratio=ratio, offset=offset)


def _value(tag: Element, name: str, default: str) -> str:
    return tag.get(name) or tag.findtext(name) or default


def _number(text: str, what: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise HandError(f"model: {what} must be a number, got {text!r}") from None
