"""What a model file says of masses and of joints that follow others.

In: an SDFormat or URDF file. Out: its own figures. Drake does not tell them: it replaces a mass of
zero by one of its own, and couples joints by constraints.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element


@dataclass(frozen=True, kw_only=True)
class Mimic:
    """A joint that follows another one: its position is ratio * leader + offset [rad or m]."""

    joint: str
    leader: str
    ratio: float
    offset: float


def declared_masses(path: Path) -> dict[str, float]:
    """Return the mass [kg] of each link of a model file; 0 where the file gives none."""
    masses = {}
    for link in _root(path).iter("link"):
        name = link.get("name")
        if name is None:
            continue  # URDF's <child link="..."/> has other tags, so this is no link
        found = link.find("inertial/mass")
        text = None if found is None else found.get("value", found.text)
        masses[name] = float(text or 0.0)
    return masses


def declared_mimics(path: Path) -> list[Mimic]:
    """Return the joints of a model file that follow others."""
    # URDF, SDFormat and Drake each have their own way to write it.
    found = []
    for joint in _root(path).iter("joint"):
        for tag in joint.iter():
            if tag.tag.rpartition("}")[2].rpartition(":")[2] != "mimic":
                continue
            # Attributes in URDF and Drake, elements with a reference in SDFormat.
            ratio = float(_value(tag, "multiplier", "1"))
            reference = float(_value(tag, "reference", "0"))
            offset = float(_value(tag, "offset", "0")) - ratio * reference
            leader = tag.get("joint", "")
            name = joint.get("name", "")
            found.append(Mimic(joint=name, leader=leader, ratio=ratio, offset=offset))
    return found


def _value(tag: Element, name: str, default: str) -> str:
    return tag.get(name) or tag.findtext(name) or default


def _root(path: Path) -> Element:
    return ElementTree.parse(path).getroot()
