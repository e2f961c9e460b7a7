"""What a model file says of masses, of efforts, and of joints that follow others.

In: the XML of a URDF or SDFormat file. Out: its own figures. Drake does not tell them: it
replaces a mass of zero by one of its own, and couples joints by constraints or not at all.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from drakegrasp.errors import HandError

#: Moments and products of inertia that URDF and SDFormat have where a model gives none.
_MOMENTS = [
    dict.fromkeys(("xx", "yy", "zz", "xy", "xz", "yz"), "0"),
    {"xx": "1", "yy": "1", "zz": "1", "xy": "0", "xz": "0", "yz": "0"},
]


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


def impossible_inertias(root: Element) -> dict[str, str]:
    """Return the links with a mass whose inertia no body can have, with what is wrong.

    Drake replaces such an inertia by one of its own.
    """
    masses, found = declared_masses(root), {}
    for link in root.iter("link"):
        name, inertia = link.get("name", ""), link.find("inertial/inertia")
        if inertia is None or not masses.get(name, 0.0) > 0.0:
            continue
        given = [
            _number(_value(inertia, f"i{axes}", default), f"inertia of link {name!r}")
            for axes, default in _MOMENTS[len(inertia) > 0].items()
        ]
        xx, yy, zz, xy, xz, yz = given
        moments = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        slack = 1e-9 * abs(moments).max()
        if not moments[2] > 0.0:
            found[name] = "0"
        elif moments[0] < -slack or moments[2] > moments[0] + moments[1] + slack:
            found[name] = "principal moments " + ", ".join(f"{m:.3g}" for m in moments)
    return found


def declared_efforts(root: Element) -> dict[str, float]:
    """Return the largest effort [N m or N] of each joint that the <limit>s of a model give one."""
    efforts = {}
    for joint in root.iter("joint"):
        for limit in joint.iter("limit"):
            name, text = joint.get("name", ""), _value(limit, "effort", "0")
            efforts[name] = abs(_number(text, f"effort of joint {name!r}"))
    return {name: effort for name, effort in efforts.items() if effort > 0.0}


def declared_mimics(root: Element) -> list[Mimic]:
    """Return the joints of a model in URDF or SDFormat that follow others."""
    # URDF, SDFormat and Drake each have their own way to write it.
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
    return found


def _value(tag: Element, name: str, default: str) -> str:
    return tag.get(name) or tag.findtext(name) or default


def _number(text: str, what: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise HandError(f"model: {what} must be a number, got {text!r}") from None
